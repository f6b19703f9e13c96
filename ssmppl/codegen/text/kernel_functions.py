"""Which generated functions each algorithm needs, written from the findings of the analyses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmppl.analysis.density import Missing, Term, terms
from ssmppl.analysis.proposals.channels import channel_draws, observation_draws, of_components
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap
from ssmppl.analysis.structure import deterministic, deterministic_memory
from ssmppl.codegen.kernels.math.sums import constrain, log_prior, sum_of_path
from ssmppl.codegen.kernels.particle.alive_filter import alive_filter
from ssmppl.codegen.kernels.particle.conditional_smc import conditional_smc, filtered_path
from ssmppl.codegen.kernels.particle.particle_filter import particle_filter
from ssmppl.codegen.kernels.particle.simulation import predict_step
from ssmppl.codegen.text.module import PARTICLE, Layout, ModuleText, Section, Target, level_of
from ssmppl.codegen.text.render import Names, Writer, depends
from ssmppl.codegen.text.sums import add_entry, add_sums, scalar_function, time_sum
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, constant
from ssmppl.language.model.trace import Site, Trace
from ssmppl.language.model.transforms import transforms

DRAW_INITIAL = "theta, c, s, states, normals, uniforms, rng"
DRAW = "theta, c, s, states_prev, states, normals, uniforms, rng"
WEIGH_INITIAL = "theta, c, s, states, log_w"
WEIGH_CONNECTED = "theta, c, s, states_prev, states, log_w"
FIT = "theta, c, s, states_prev, fits"
LOOK_AHEAD = "theta, c, s, states_prev, fits, log_w"
FITTED_DRAW = "theta, c, s, states_prev, fits, states, normals, uniforms, rng"
WEIGH = "theta, c, s, states_prev, fits, states, log_w"
OBSERVE = "theta, c, s, states, out, normals, uniforms, rng"
TRANSFORM = "theta, z, free, total"
DENSITY = "theta, total"


def add_predictions(out: ModuleText, trace: Trace, layout: Layout, missing: Missing) -> None:
    """Write `predict`, by which the filters of a module predict the next row."""
    section = prediction_functions(trace, layout, bootstrap(trace, missing))
    out.add("one-step predictions", section)
    out.algorithm(predict_step, "predict", section, "exact")


def add_filters(out: ModuleText, section: Section, bound: dict[str, str]) -> None:
    """Write the particle filters of a section that was added: `filter`, `alive_filter` and
    `filtered_path`, each with the section's suffix.

    bound : what their parameter `ahead` stands for, and functions that are not the section's own.
    """
    predicting = bound | {"predict": "predict"}
    out.algorithm(particle_filter, section.name("filter"), section, "entry", predicting)
    out.algorithm(alive_filter, section.name("alive_filter"), section, "entry", predicting)
    out.algorithm(filtered_path, section.name("filtered_path"), section, "entry", bound)


def add_conditional_smc(
    out: ModuleText, section: Section, trace: Trace, bound: dict[str, str], eliminated: bool = False
) -> None:
    """Write `conditional_smc` of a section that has `conditional_passes`; bound : as of
    `add_filters`."""
    own = bound | {"horizon": horizon(trace), "eliminated": str(int(eliminated))}
    out.algorithm(conditional_smc, section.name("conditional_smc"), section, "entry", own)


def horizon(trace: Trace) -> str:
    """The steps for which deterministic components remember an ancestor; -1: for ever."""
    memory = deterministic_memory(trace)
    return "-1" if memory is None else str(memory)


def state_targets(layout: Layout, draws: dict[Expr, Expr]) -> list[Target]:
    """States as targets, by their rows."""
    ordered = sorted(draws.items(), key=lambda p: layout.column(p[0]))
    return [Target(f"states[{layout.column(s)}, i]", e) for s, e in ordered]


def weight_targets(weight: Sequence[Term]) -> list[Target]:
    """Terms of a log weight as targets, guarded where a measurement may be missing."""
    found = [Target("log_w[i]", t.log_density, t.guard) for t in weight]
    return found or [Target("log_w[i]", constant(0.0))]


def moves(
    section: Section, initial: dict[Expr, Expr], draw: dict[Expr, Expr], arguments: str = DRAW,
    begin: str = DRAW_INITIAL,
) -> None:  # fmt: skip
    """`draw_initial` and `draw`: how particles are born and move; with these arguments."""
    section.particle_pass(
        "draw_initial", "Draw x_1 for each particle.", begin,
        state_targets(section.layout, initial),
    )  # fmt: skip
    section.particle_pass(
        "draw", "Draw x_t given x_{t-1} for each particle.", arguments,
        state_targets(section.layout, draw),
    )  # fmt: skip


def filter_functions(layout: Layout, proposal: Proposal, begin: str = DRAW_INITIAL) -> Section:
    """The particle filter's functions under one proposal; `begin`: arguments of `draw_initial`."""
    section = Section(layout, proposal.name)
    level = depends(proposal.fit, level_of)
    kept = dict.fromkeys(f for f in proposal.fit if level[f] == PARTICLE)  # each once
    section.fits.update((e, k) for k, e in enumerate(kept))
    if section.fits:
        section.particle_pass(
            "fit", "What the proposal knows of x_t from x_{t-1} and y_t.", FIT,
            [Target(f"fits[{k}, i]", e) for e, k in section.fits.items()],
        )  # fmt: skip
    moves(section, proposal.initial_draw, proposal.draw, FITTED_DRAW, begin)
    section.particle_pass(
        "weigh_initial", "Log weight of x_1.", WEIGH_INITIAL,
        weight_targets(proposal.initial_weight), accumulate="log_w",
    )  # fmt: skip
    section.particle_pass(
        "weigh", "Log weight of x_t: log f + log g - log q.", WEIGH,
        weight_targets(proposal.weight), accumulate="log_w",
    )  # fmt: skip
    if proposal.look_ahead is not None:
        section.particle_pass(
            "look_ahead", "About log p(y_t | x_{t-1}).", LOOK_AHEAD,
            [Target("log_w[i]", proposal.look_ahead)],
        )  # fmt: skip
    return section


def _values(sites: Sequence[Site]) -> list[tuple[Expr, Expr]]:
    """The components of deterministic sites, each with its value."""
    return [
        pair
        for site in sites
        for pair in zip(site.value.ravel(), array(site.distribution.mean()).ravel(), strict=True)
    ]


def conditional_passes(trace: Trace, layout: Layout, section: Section, plain: Proposal) -> None:
    """What conditional SMC needs on top of a filter: densities of joining the reference."""
    value = dict(_values(deterministic(list(trace.transition.values()))))
    given = {s: f"reference[{layout.column(s)}]" for s in trace.state_symbols}
    joined = {s: value.get(s, s) for s in trace.state_symbols}
    section.particle_pass(
        "connect", "The reference's noisy components, with what follows from them and x_{t-1}.",
        "theta, c, s, states_prev, reference, states", state_targets(layout, joined),
        scalars=given,
    )  # fmt: skip
    noisy = [t for t in terms(trace, "transition") if t.site.value.ravel()[0] not in value]
    section.particle_pass(
        "weigh_connected", "log f(x_t | x_{t-1}).", WEIGH_CONNECTED, weight_targets(noisy),
        accumulate="log_w",
    )  # fmt: skip
    section.particle_pass(
        "weigh_observed", "log g(y_t | x_t).", WEIGH_INITIAL, weight_targets(plain.weight),
        accumulate="log_w",
    )  # fmt: skip


def backward_functions(
    trace: Trace, layout: Layout, plain: Proposal, height: Expr | NotApplicable
) -> Section:
    """The functions of backward simulation; `bound` where the transition density has one."""
    section = Section(layout, "backward")
    conditional_passes(trace, layout, section, plain)
    value = dict(_values(deterministic(list(trace.transition.values()))))
    section.particle_pass(
        "complete", "The deterministic components of x_t, from x_{t-1}.",
        "theta, c, s, states_prev, states", state_targets(layout, value),
    )  # fmt: skip
    given = {s: f"reference[{layout.column(s)}]" for s in trace.state_symbols}
    noisy = [t for t in terms(trace, "transition") if t.site.value.ravel()[0] not in value]
    section.particle_pass(
        "weigh_following", "log f(x_t | x_{t-1}) of a given x_t.",
        "theta, c, s, states_prev, reference, log_w", weight_targets(noisy), accumulate="log_w",
        scalars=given,
    )  # fmt: skip
    if not isinstance(height, NotApplicable):
        section.particle_pass(
            "bound", "The largest that log f(x_t | x_{t-1}) can get over x_{t-1}.",
            WEIGH_INITIAL, [Target("log_w[i]", height)],
        )  # fmt: skip
    return section


def simulation_functions(trace: Trace, layout: Layout, plain: Proposal) -> Section:
    """Functions that simulate states and observations."""
    section = Section(layout, "simulate")
    moves(section, plain.initial_draw, plain.draw)
    targets = [Target(f"out[{k}, i]", e) for k, e in enumerate(observation_draws(trace))]
    section.particle_pass("observe", "Draw y_t given x_t.", OBSERVE, targets)
    return section


def prediction_functions(
    trace: Trace, layout: Layout, plain: Proposal, drawn: bool = True
) -> Section:
    """Functions for one-step predictions of the observations.

    drawn : whether these are drawn, too; the normals and uniforms that one draw takes are further
        sizes of the section, as the moves have their own.
    """
    section = Section(layout, "predict")
    moves(section, plain.initial_draw, plain.draw)
    targets = []
    k = 0
    for site in trace.observations.values():
        for mean, variance, below, strictly in predictive(site):
            for j, e in enumerate((mean, variance, below, strictly)):
                targets.append(Target(f"out[{4 * k + j}, i]", e))
            k += 1
    section.particle_pass(
        "moments", "Mean, variance and distribution function of y_t given x_t.",
        "theta, c, s, states, out", targets,
    )  # fmt: skip
    if drawn:
        draws = Section(layout, section.suffix, section.c, section.s)
        draws.particle_pass(
            "observe", "Draw each channel of y_t given x_t.", OBSERVE,
            [Target(f"out[{k}, i]", e) for k, e in enumerate(channel_draws(trace))],
        )  # fmt: skip
        section.functions += draws.functions
        section.roles["observe"] = OBSERVE
        section.further = draws.normals, draws.uniforms
    return section


def predictive(site: Site) -> list[tuple[Expr, Expr, Expr, Expr]]:
    """(mean, variance, P(Y <= y), P(Y < y)) for every component; nan where there is none."""
    d, y = of_components(site.distribution), site.value
    nothing = array(np.full(site.shape, np.nan))
    if d.multivariate:
        below = strictly = nothing
    else:
        below = array(d.cdf(y))
        strictly = array(d.cdf_below(y)) if d.discrete or d.atoms else below
    forms = [array(np.broadcast_to(array(f).view(np.ndarray), site.shape))
             for f in (d.mean(), d.variance(), below, strictly)]  # fmt: skip
    first = {s: i for i, s in reversed(list(enumerate(y.ravel())))}
    return [tuple(f.ravel()[first[s]] for f in forms) for s in site.components]


def add_log_joint(out: ModuleText, trace: Trace, layout: Layout, missing: Missing) -> None:
    """`log_joint(theta, y, seen, u, trajectory, total)`: log p(x, y | theta) without the prior.

    Deterministic components are set to what follows from the noisy ones, so that this is the
    density of the noisy components and the observations.
    """
    parts, fixed = {}, {}
    for role in ("initial", "transition", "observation"):
        sites = {"initial": trace.initial, "transition": trace.transition}.get(role, {})
        known = deterministic(list(sites.values()))
        skipped = {s.name for s in known}
        total = constant(0.0)
        for t in terms(trace, role, missing):
            if t.site.name not in skipped:
                total = total + t.guarded()
        parts[role] = [total]
        fixed[role] = _values(known)
    doc = "log p(x, y | theta); deterministic components of x are set on the way."
    text = time_sum(layout, "log_joint", doc, parts, 1, fixed)
    add_sums(out, "complete-data log density", "log_joint", sum_of_path, text)


def add_parameters(out: ModuleText, trace: Trace, layout: Layout) -> None:
    """`constrain(theta, z, free)` and `log_prior(theta)`."""
    names = Names()
    known = {s: f"theta[{i}]" for i, s in enumerate(trace.parameter_symbols)}
    lines = [
        f"@exact\ndef transform_constrain({TRANSFORM}):",
        '    """Write the free parameters into theta from the unconstrained z; log Jacobian."""',
        "    total[0] = 0.0",
    ]
    at = 0
    for k, t in enumerate(transforms(trace)):
        own = known | {s: f"z[{at + i}]" for i, s in enumerate(t.free)}
        at += len(t.free)
        writer = Writer(own, names, trace.locations, " " * 8)
        targets = [(known[c], v) for c, v in zip(t.components, t.values, strict=True)]
        writer.assign([("total[0]", t.log_jacobian)], "+=")
        writer.assign(targets)
        lines += [f"    if free[{k}]:  # {t.site.name}", *writer.lines]
    text = "\n".join([*lines, ""])
    add_entry(out, "parameters", "constrain", constrain, {"transform": TRANSFORM}, text)
    total = constant(0.0)
    for term in terms(trace, "prior"):
        total = total + term.log_density
    text = scalar_function(
        layout, "density_log_prior", DENSITY, "Log prior density; -inf outside the support.",
        [("total[0]", total)],
    )  # fmt: skip
    add_entry(out, "prior", "log_prior", log_prior, {"density": DENSITY}, text)
