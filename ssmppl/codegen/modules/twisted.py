"""The generated module of the twisted particle filter, and the guide that it goes by.

The guide is computed anew for every theta and data set and handed to the filter as further columns
of the inputs, so that the filter's kernels are the same as for any other proposal. Where the noises
are many, the moves are functions with loops instead; see `kernels/twisted/twisting.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap
from ssmppl.analysis.proposals.twisted import LookaheadModel, twisted, twisting_order
from ssmppl.codegen.kernels.twisted import twisting
from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.codegen.native.loading import Loaded, load
from ssmppl.codegen.text.kernel_functions import (
    add_conditional_smc,
    add_filters,
    add_predictions,
    conditional_passes,
    filter_functions,
)
from ssmppl.codegen.text.module import (
    PARTICLE,
    Layout,
    ModuleText,
    Section,
    Target,
    level_of,
    listed,
)
from ssmppl.codegen.text.render import depends, identifier
from ssmppl.compiling import one_at_a_time
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, constant, symbol
from ssmppl.language.model.trace import Trace


def twisted_section(
    trace: Trace, layout: Layout, found: LookaheadModel, plain: Proposal
) -> Section:
    """What the moves need to know of the model: its laws by their noise, and back."""
    section = Section(layout, "twisted")
    first, later = found.initial, found.transition
    guide = twisting_order(len(trace.state_symbols), len(first.noise))
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


def varies(found: LookaheadModel) -> bool:
    """Whether dx_t / de depends on the particle."""
    spread = list(found.transition.spread().ravel())
    level = depends(spread, level_of)
    return any(level[e] == PARTICLE for e in spread)


def twisted_moves(out: ModuleText, section: Section, found: LookaheadModel) -> dict[str, str]:
    """Write the moves; what the filters' parameters for them stand for."""
    own = {"varies": str(varies(found))}
    for name in twisting.SPECIALISED:
        out.algorithm(vars(twisting)[name], name, section, "exact", dict(own))
        own[name.removeprefix("twisted_")] = name
    return own


@dataclass
class TwistedFilter:
    """The twisted filter of a model: `entry` gives its kernels, `guide` what they go by.

    gaussian : the approximation that the guide is made from.
    """

    trace: Trace
    gaussian: GaussianApproximation
    proposals: dict[str, Proposal]
    module: Loaded = field(repr=False)

    def entry(self, name: str, proposal: str = "twisted", horizon: int = 0) -> Guided:
        """`filter`, `alive_filter`, `filtered_path` or `conditional_smc`, called like those of
        other proposals.

        horizon : rows after which the guide starts anew and so is blind to what comes later; 0:
        never. Up to the last row of each stretch the particles are worth most as a sample of
        what is known by then.
        """
        return Guided(getattr(self.module, f"{name}_{proposal}"), self.gaussian, horizon)

    def guide(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray, horizon: int = 0,
        e: np.ndarray | None = None, at_mode: bool = True,
    ) -> np.ndarray:  # fmt: skip
        """The inputs (T, U), and behind them each row's guide: precision, slope, centre.

        horizon : as of `entry`. e : noise (T, R') of a trajectory from which the search for the
        likeliest begins; at_mode : whether it is that already.
        """
        return self.gaussian.guides(
            theta, y, seen, u, e=e, at_mode=at_mode, horizon=horizon
        ).rows  # fmt: skip

    @cached_property
    def order(self) -> list[Expr]:
        """The guide's symbols, in the order of its columns."""
        found = self.gaussian.found
        return twisting_order(len(self.trace.state_symbols), len(found.initial.noise))


@dataclass(frozen=True)
class Guided:
    """A twisted filter's kernel, called like those of other proposals.

    run : the kernel, which takes the guide with the inputs. gaussian : what the guide is made from.
    horizon : as of `TwistedFilter.entry`.
    """

    run: Callable[..., Any]
    gaussian: GaussianApproximation
    horizon: int = 0

    def __call__(self, theta: Any, y: Any, seen: Any, u: Any, *rest: Any) -> Any:
        guided = self.gaussian.guides(theta, y, seen, u, horizon=self.horizon)
        return self.run(theta, y, seen, guided.rows, *rest)


@one_at_a_time
def compile_twisted(
    trace: Trace, missing: Missing, gaussian: GaussianApproximation | NotApplicable
) -> TwistedFilter | NotApplicable:
    """Generate, write and import the twisted filter; the reason where there is none.

    gaussian : the model's Gaussian approximation, or why there is none.
    """
    if isinstance(gaussian, NotApplicable):
        return gaussian
    proposal = twisted(trace, missing)
    assert isinstance(proposal, Proposal)
    found = gaussian.found
    layout = Layout(trace, twisting_order(len(trace.state_symbols), len(found.initial.noise)))
    out = ModuleText(layout)
    add_predictions(out, trace, layout, missing)
    plain = bootstrap(trace, missing)
    own = {"ahead": "GUIDED"}
    if found.written_out:
        section = filter_functions(layout, proposal)
        conditional_passes(trace, layout, section, plain)
        out.add(f"particle filter, {proposal.explanation}", section)
    else:
        section = twisted_section(trace, layout, found, plain)
        out.add(f"particle filter, {proposal.explanation}", section)
        own |= twisted_moves(out, section, found)
    add_filters(out, section, own)
    add_conditional_smc(out, section, trace, own)
    lines = [f"Generated by ssmppl: the twisted particle filter of the model {trace.name!r}."]
    module = load(out, identifier(trace.name) + "_twisted", lines)
    return TwistedFilter(trace, gaussian, {proposal.name: proposal}, module)
