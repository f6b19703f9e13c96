"""Generated modules for the variants of PMMH: filters with scores, filters on given numbers.

Each holds the functions of one proposal's particle filter once more, so that the program that every
model gets is free of what only these variants need.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.density import terms
from ssmppl.analysis.moves import Proposal
from ssmppl.analysis.structure import deterministic
from ssmppl.codegen.kernels.correlated import correlated_path
from ssmppl.codegen.kernels.filter_with_score import filter_with_score
from ssmppl.codegen.kits import filter_kit
from ssmppl.codegen.loading import Loaded, load
from ssmppl.codegen.module import Layout, Section, Target
from ssmppl.codegen.program import Program
from ssmppl.codegen.render import identifier
from ssmppl.codegen.text import ModuleText
from ssmppl.compiling import one_at_a_time
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import NotDifferentiable, gradient, hessian
from ssmppl.expressions.expr import Expr, constant, depends_on, topological

XI_INITIAL = "theta, c, s, states, out"
XI = "theta, c, s, states_prev, states, out"
STEERED = {
    "twisted": "these filters do not compute the guide of the twisted proposal",
    "tempered": "these filters weigh a row once, without temperatures",
}


@dataclass(frozen=True)
class ScoredFilter:
    """A generated filter that estimates derivatives in `wanted`, a sequence of parameter symbols.

    module.filter_with_score(theta, y, seen, u, particles, rng, trajectory, log_increment, lag,
    score, information), see the kernel.
    """

    module: Loaded
    wanted: tuple[Expr, ...]


@one_at_a_time
def scored_filter(
    program: Program, proposal: Proposal, wanted: Sequence[Expr], second: bool
) -> ScoredFilter | NotApplicable:
    """The filter of a proposal with the score in `wanted`, and with the information if `second`.

    NotApplicable where a law has no derivatives, or a deterministic one depends on a parameter:
    given the states there is then no density for Fisher's identity.
    """
    trace, missing = program.trace, program.missing
    if proposal.name in STEERED:
        return NotApplicable(STEERED[proposal.name])
    for role, sites in (("initial", trace.initial), ("transition", trace.transition)):
        for site in deterministic(list(sites.values())):
            if any(depends_on(e, wanted) for e in array(site.distribution.mean()).ravel()):
                where = site.distribution.location
                return NotApplicable(
                    f"the {role} law of {site.name} is Dirac and depends on a parameter", where
                )
    layout = Layout(trace)
    section = filter_kit(layout, proposal)
    for role, name, arguments in (
        ("initial", "_initial", XI_INITIAL), ("transition", "", XI),
    ):  # fmt: skip
        sites = trace.initial if role == "initial" else trace.transition
        known = {s.name for s in deterministic(list(sites.values()))}
        total = constant(0.0)
        for t in [*terms(trace, role, guard=False), *terms(trace, "observation", missing, False)]:
            if t.site.name not in known:
                total = total + t.guarded()
        try:
            slopes = gradient(total, wanted)
            curvatures = _lower(hessian(total, wanted)) if second else []
        except NotDifferentiable as error:
            where = next(iter(sites.values())).distribution.location
            return NotApplicable(f"a law has no derivative in closed form: {error.found}", where)
        what = "log { mu(x_1) g(y_1 | x_1) }" if name else "log { f(x_t | x_{t-1}) g(y_t | x_t) }"
        _outputs(section, f"gradient{name}", f"Gradient of {what}.", arguments, slopes)
        if second:
            doc = f"Second derivatives of {what}, row by row of the lower half."
            _outputs(section, f"hessian{name}", doc, arguments, curvatures)
    roles = {} if second else {"hessian_initial": "hessian_initial", "hessian": "hessian"}
    roles["second"] = str(second)
    module = _module(program, proposal, section, filter_with_score, "score", roles)
    return ScoredFilter(module, tuple(wanted))


@dataclass(frozen=True)
class NumberedFilter:
    """A generated filter on given numbers; normals, uniforms : how many a particle takes a step.

    module.correlated_path(theta, y, seen, u, particles, normals, uniforms, points, trajectory,
    log_increment), see the kernel.
    """

    module: Loaded
    normals: int
    uniforms: int


@one_at_a_time
def numbered_filter(program: Program, proposal: Proposal) -> NumberedFilter | NotApplicable:
    """The filter of a proposal on given numbers.

    NotApplicable where particles are drawn by rejection, which takes a random count of numbers.
    """
    trace = program.trace
    if proposal.name in STEERED:
        return NotApplicable(STEERED[proposal.name])
    for draws, sites in ((proposal.initial_draw, trace.initial), (proposal.draw, trace.transition)):
        for symbol, e in draws.items():
            for node in topological([e]):
                if node.op == "random" and node.data[0] not in ("normal", "uniform"):
                    site = next(s for s in sites.values() if symbol in set(s.value.ravel()))
                    return NotApplicable(
                        f"{site.name} is drawn by the {node.data[0]} sampler, which takes a random "
                        "count of random numbers, so that they cannot be moved a little",
                        site.distribution.location,
                    )
    section = filter_kit(Layout(trace), proposal)
    module = _module(program, proposal, section, correlated_path, "correlated", {})
    return NumberedFilter(module, section.normals, section.uniforms)


def _lower(matrix: np.ndarray) -> list[Expr]:
    return [matrix[i, j] for i in range(len(matrix)) for j in range(i + 1)]


def _outputs(section: Section, role: str, doc: str, arguments: str, values: Sequence[Expr]) -> None:
    targets = [Target(f"out[{k}, i]", e) for k, e in enumerate(values)]
    section.particle_pass(role, doc, arguments, targets)


def _module(
    program: Program, proposal: Proposal, section: Section, kernel: Callable[..., Any], name: str,
    bound: dict[str, str],
) -> Loaded:  # fmt: skip
    trace = program.trace
    out = ModuleText(section.layout)
    out.add(f"particle filter, {proposal.name}: {proposal.explanation}", section)
    ahead = "NO_LOOK_AHEAD"
    if proposal.look_ahead is not None:
        ahead = "EXACT" if proposal.exact_look_ahead else "APPROXIMATE"
    out.algorithm(kernel, kernel.__name__, section, "entry", {"ahead": ahead, **bound})
    lines = [f"Generated by ssmppl from the model {trace.name!r}: {kernel.__name__}.", ""]
    return load(out, f"{identifier(trace.name)}_{proposal.name}_{name}", lines)
