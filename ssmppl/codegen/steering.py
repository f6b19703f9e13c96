"""Functions of the twisted filter where the noises are many; see `kernels/steering.py`."""

from __future__ import annotations

from ssmppl.analysis.moves import Proposal
from ssmppl.analysis.twisted import Guided, guide_order
from ssmppl.codegen.kernels import steering
from ssmppl.codegen.kits import conditional_passes
from ssmppl.codegen.module import PARTICLE, Layout, Section, Target, level_of, listed
from ssmppl.codegen.render import depends
from ssmppl.codegen.text import ModuleText
from ssmppl.expressions.expr import constant, symbol
from ssmppl.language.traced import Trace


def steered_section(trace: Trace, layout: Layout, found: Guided, plain: Proposal) -> Section:
    """What the moves need to know of the model: its laws by their noise, and back."""
    section = Section(layout, "twisted")
    first, later = found.initial, found.transition
    guide = guide_order(len(trace.state_symbols), len(first.noise))
    section.s.update((e, k) for k, e in enumerate([constant(float(len(later.noise))), *guide]))
    section.normals, section.uniforms = len(later.noise), 1
    section.fits.update((e, k) for k, e in enumerate(later.noise))
    for role, form, arguments in (
        ("begin", first, "theta, c, s, fits, states"),
        ("follow", later, "theta, c, s, states_prev, fits, states"),
    ):
        targets = [Target(f"states[{k}, i]", e) for k, e in enumerate(form.value)]
        section.particle_pass(role, "x by the noise that drives it.", arguments, targets)
    section.particle_pass(
        "rest", "x_t without noise.", "theta, c, s, states_prev, states",
        [Target(f"states[{k}, i]", e) for k, e in enumerate(later.at_rest())],
    )  # fmt: skip
    section.particle_pass(
        "spread", "dx_t / de without noise.", "theta, c, s, states_prev, states, out",
        listed(later.spread().ravel()),
    )  # fmt: skip
    for role, form, arguments in (
        ("recover_initial", first, "theta, c, s, states, out"),
        ("recover", later, "theta, c, s, states_prev, states, out"),
    ):
        section.particle_pass(role, "The noise by x.", arguments, listed(form.recovered))
    conditional_passes(trace, layout, section, plain)
    kept = 1 + (len(later.noise) * (len(later.noise) + 1) // 2 if varies(found) else 0)
    extra = [symbol("guide", "kept", (k,)) for k in range(kept)]
    section.fits.update((e, len(later.noise) + k) for k, e in enumerate(extra))
    return section


def varies(found: Guided) -> bool:
    """Whether dx_t / de depends on the particle."""
    spread = list(found.transition.spread().ravel())
    level = depends(spread, level_of)
    return any(level[e] == PARTICLE for e in spread)


def steered_moves(out: ModuleText, section: Section, found: Guided) -> dict[str, str]:
    """Write the moves; what the filters' parameters for them stand for."""
    own = {"varies": str(varies(found))}
    for name in steering.SPECIALISED:
        out.algorithm(vars(steering)[name], name, section, "exact", dict(own))
        own[name.removeprefix("steered_")] = name
    return own
