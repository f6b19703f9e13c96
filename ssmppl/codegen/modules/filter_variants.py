"""Generated modules of the particle filters that only some methods need.

Each is a module of its own, so that the program that every model gets is free of it: filters with
scores and filters on given numbers (PMMH), a filter that can stop at a row and go on (SMC^2), one
whose particles carry their parameters (iterated filtering), one that is continuous in the
parameters; and smoothed scores and one-step predictions row by row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.proposals.perturbed import Perturbed
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap
from ssmppl.analysis.structure import deterministic, simulators
from ssmppl.codegen.kernels.particle.conditional_smc import filtered_path
from ssmppl.codegen.kernels.particle.continuous_filters import correlated_path, smooth_filter
from ssmppl.codegen.kernels.particle.iterated_filter import iterated_filter
from ssmppl.codegen.kernels.particle.particle_filter import filter_rows
from ssmppl.codegen.kernels.particle.scored_filters import (
    complete_rows,
    path_score,
    row_predictions,
    row_predictions_at,
    row_scores,
)
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.modules.program import Program
from ssmppl.codegen.native.loading import Loaded, load
from ssmppl.codegen.text.kernel_functions import filter_functions, prediction_functions
from ssmppl.codegen.text.module import Layout, ModuleText, Section, Target
from ssmppl.codegen.text.render import identifier
from ssmppl.compiling import one_at_a_time
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import NotDifferentiable, gradient, hessian
from ssmppl.expressions.expr import Expr, constant, depends_on, topological
from ssmppl.language.model.trace import Trace

XI_INITIAL = "theta, c, s, states, out"
XI = "theta, c, s, states_prev, states, out"
TOGETHER = 48  # derivatives in one loop
BEGIN = "theta, c, s, states_prev, states, normals, uniforms, rng"


@dataclass(frozen=True)
class ScoredFilter:
    """A generated filter that estimates derivatives in `wanted`, a sequence of parameter symbols.

    module : its kernels `filtered_path` and `path_score`.
    """

    module: Loaded
    wanted: tuple[Expr, ...]

    def run(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray, particles: int,
        rng: np.ndarray, trajectory: np.ndarray, log_increment: np.ndarray, lag: int,
        score: np.ndarray, information: np.ndarray,
    ) -> tuple[int, int, float]:  # fmt: skip
        """(status, t, log Z) of `filtered_path`; what is derived is written where that is OK."""
        (steps, d), data = trajectory.shape, (theta, y, seen, u)
        x, w = np.empty((steps, d, particles)), np.empty((steps, particles))
        kept = x, w, np.zeros((steps, particles), dtype=np.int32)
        status, t, log_z = self.module.filtered_path(
            *data, particles, rng, trajectory, log_increment, kept
        )
        if status == OK:
            self.module.path_score(*data, *kept, lag, score, information)
        return status, t, log_z


@one_at_a_time
def scored_filter(
    program: Program, proposal: Proposal, wanted: Sequence[Expr], second: bool
) -> ScoredFilter | NotApplicable:
    """The filter of a proposal with the score in `wanted`, and with the information if `second`.

    NotApplicable where a law has no derivatives, or a deterministic one depends on a parameter:
    given the states there is then no density for Fisher's identity.
    """
    trace, missing = program.trace, program.missing
    if proposal.unsuited:
        return NotApplicable(proposal.unsuited)
    for role, sites in (("initial", trace.initial), ("transition", trace.transition)):
        for site in deterministic(list(sites.values())):
            if any(depends_on(e, wanted) for e in array(site.distribution.mean()).ravel()):
                where = site.distribution.location
                return NotApplicable(
                    f"the {role} distribution of {site.name} is Dirac and depends on a parameter",
                    where,
                )
    layout = Layout(trace)
    section = filter_functions(layout, proposal)
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
            return NotApplicable(
                f"a distribution has no derivative in closed form: {error.found}", where
            )
        what = "log { mu(x_1) g(y_1 | x_1) }" if name else "log { f(x_t | x_{t-1}) g(y_t | x_t) }"
        _outputs(section, f"gradient{name}", f"Gradient of {what}.", arguments, slopes)
        if second:
            doc = f"Second derivatives of {what}, row by row of the lower half."
            _outputs(section, f"hessian{name}", doc, arguments, curvatures)
    module = _module(
        program, proposal, section, "score",
        (filtered_path, {"ahead": proposal.look_ahead_kind}), (path_score, {"second": str(second)}),
    )  # fmt: skip
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
    if proposal.unsuited:
        return NotApplicable(proposal.unsuited)
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
    section = filter_functions(Layout(trace), proposal)
    own = {"ahead": proposal.look_ahead_kind}
    module = _module(program, proposal, section, "correlated", (correlated_path, own))
    return NumberedFilter(module, section.normals, section.uniforms)


def _lower(matrix: np.ndarray) -> list[Expr]:
    return [matrix[i, j] for i in range(len(matrix)) for j in range(i + 1)]


def _outputs(section: Section, role: str, doc: str, arguments: str, values: Sequence[Expr]) -> None:
    targets = [Target(f"out[{k}, i]", e) for k, e in enumerate(values)]
    section.particle_pass(role, doc, arguments, targets)


def _module(
    program: Program, proposal: Proposal, section: Section, name: str,
    *kernels: tuple[Callable[..., Any], dict[str, str]],
) -> Loaded:  # fmt: skip
    trace = program.trace
    out = ModuleText(section.layout)
    out.add(f"particle filter, {proposal.name}: {proposal.explanation}", section)
    for kernel, bound in kernels:
        out.algorithm(kernel, kernel.__name__, section, "entry", bound)
    names = ", ".join(kernel.__name__ for kernel, _ in kernels)
    lines = [f"Generated by ssmppl from the model {trace.name!r}: {names}.", ""]
    return load(out, f"{identifier(trace.name)}_{proposal.name}_{name}", lines)


@one_at_a_time
def compile_row_scores(
    trace: Trace, predicted: Trace, initial: Sequence[Expr], later: Sequence[Expr],
    missing: Missing, follows: Mapping[str, Sequence[tuple[Expr, Expr]]],
) -> Loaded:  # fmt: skip
    """`row_scores`, `row_predictions` (and `row_predictions_at` where a simulator is called),
    `complete_rows`; see the kernels for their arguments.

    predicted : the trace that predictions are made with, whose parameters come first in theta.
    initial, later : the derivatives (F) at row 1 and at the others, over the trace's symbols.
    follows : for "initial" and "transition" (component, value) of what follows from the others.
    """
    layout = Layout(trace)
    out = ModuleText(layout)
    section = Section(layout, "rows")
    _passes(section, "gradient_initial", XI_INITIAL, initial)
    _passes(section, "gradient", XI, later)
    out.add("smoothed scores, row by row", section)
    out.algorithm(row_scores, "row_scores", section, "entry")
    if follows:
        _followers(out, layout, follows)
    plain = bootstrap(predicted, missing)
    prediction = prediction_functions(predicted, Layout(predicted), plain, drawn=False)
    out.add("one-step predictions", prediction)
    out.algorithm(row_predictions, "row_predictions", prediction, "entry")
    if simulators(predicted):
        out.algorithm(row_predictions_at, "row_predictions_at", prediction, "entry")
    lines = [f"Generated by ssmppl from the model {trace.name!r}: scores of its rows.", ""]
    return load(out, identifier(trace.name) + "_rows", lines)


def _followers(
    out: ModuleText, layout: Layout, follows: Mapping[str, Sequence[tuple[Expr, Expr]]]
) -> None:
    section = Section(layout, "follow")
    for role, name, arguments in (
        ("initial", "begin", "theta, c, s, states"),
        ("transition", "follow", "theta, c, s, states_prev, states"),
    ):
        pairs = sorted(follows[role], key=lambda pair: layout.column(pair[0]))
        targets = [Target(f"states[{layout.column(c)}, i]", e) for c, e in pairs]
        section.particle_pass(name, "Set what follows from the others.", arguments, targets)
    out.add("components that follow from the others", section)
    out.algorithm(complete_rows, "complete_rows", section, "entry")


def _passes(section: Section, role: str, arguments: str, values: Sequence[Expr]) -> None:
    """A function that writes out[k, i] for all derivatives k, by functions of a few of them."""
    targets = [Target(f"out[{k}, i]", e) for k, e in enumerate(values)]
    parts = [targets[k : k + TOGETHER] for k in range(0, len(targets), TOGETHER)]
    doc = "Derivatives of the complete-data log density of one row."
    for k, part in enumerate(parts):
        section.particle_pass(f"{role}_{k}", doc, arguments, part)
    section.roles[role] = arguments
    calls = [f"    {section.name(f'{role}_{k}')}({arguments})" for k in range(len(parts))]
    head = [f"@kernel\ndef {section.name(role)}({arguments}):", f'    """{doc}"""']
    section.functions.append("\n".join([*head, *(calls or ["    pass"])]) + "\n")


@one_at_a_time
def compile_iterated_filter(model: Perturbed) -> Callable[..., Any]:
    """Generate, write and import `iterated_filter(theta, y, seen, u, rng, swarm, log_increment,
    means)`, see the kernel."""
    layout = Layout(model.trace)
    out = ModuleText(layout)
    section = filter_functions(layout, model.proposal, BEGIN)
    out.add(f"a swarm: {model.proposal.explanation}", section)
    out.algorithm(iterated_filter, "iterated_filter", section, "entry")
    lines = [f"Generated by ssmppl from the model {model.trace.name!r}: iterated filtering.", ""]
    lines.append(f"theta        {', '.join(map(repr, model.trace.parameter_symbols))}")
    lines.append(f"states       {', '.join(map(repr, model.trace.state_symbols))}")
    lines.append(f"u            {', '.join(map(repr, model.trace.input_symbols))}")
    loaded = load(out, identifier(model.trace.name) + "_iterated", lines)
    run: Callable[..., Any] = loaded.iterated_filter
    return run


@one_at_a_time
def compile_filter_rows(trace: Trace, proposal: Proposal) -> Callable[..., Any]:
    """Generate, write and import `filter_rows(theta, y, seen, u, start, stop, rng, x, w,
    log_increment)`, see the kernel; for a proposal without look-ahead."""
    layout = Layout(trace)
    out = ModuleText(layout)
    section = filter_functions(layout, proposal)
    out.add(f"particle filter, {proposal.name}: {proposal.explanation}", section)
    out.algorithm(filter_rows, "filter_rows", section, "entry")
    lines = [f"Generated by ssmppl from the model {trace.name!r}: a filter row by row."]
    run: Callable[..., Any] = load(out, identifier(trace.name) + "_rows", lines).filter_rows
    return run


@one_at_a_time
def compile_smooth_filter(trace: Trace, missing: Missing) -> Callable[..., Any]:
    """Generate, write and import the filter, for models to which it applies."""
    layout = Layout(trace)
    out = ModuleText(layout)
    section = filter_functions(layout, bootstrap(trace, missing))
    out.add("particles that move by the transition", section)
    out.algorithm(smooth_filter, "smooth_filter", section, "entry")
    lines = [f"Generated by ssmppl: the continuous filter of the model {trace.name!r}."]
    run: Callable[..., Any] = load(out, identifier(trace.name) + "_smooth", lines).smooth_filter
    return run
