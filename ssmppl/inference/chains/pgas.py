"""PGAS within Gibbs: trajectories by conditional SMC, parameters by their derived updates.

Lindsten, Jordan and Schön (2014), algorithm 3; Schön et al. (2015), algorithm 7. Parameters may be
integrated out of the first of these (`elimination.py`).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np

from ssmppl.analysis.structure import deterministic_memory, singular_covariance
from ssmppl.codegen.kernels.data_sets.each import conditional_smc_each
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.native.entries import over_data_sets
from ssmppl.errors import NotApplicable
from ssmppl.inference.chains.elimination import (
    Eliminating,
    EliminationState,
    describe_elimination,
    explain_elimination,
    requested_elimination,
)
from ssmppl.inference.chains.gibbs_updates import (
    GibbsUpdates,
    draw_parameters,
    log_joint,
    plan_updates,
)
from ssmppl.inference.chains.interweaving import (
    Interweaving,
    InterweavingTuning,
    applicable,
    prepare_interweaving,
    requested_noises,
    with_states,
)
from ssmppl.inference.chains.sampling import (
    ELIMINATED,
    INTERWEAVED,
    TRAJECTORIES,
    Derived,
    PlanRows,
    PreparedChains,
    SamplingMethod,
    SamplingSetup,
    reason_and_line,
)
from ssmppl.inference.methods.methods import PGAS
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.particles.backward import sweep_failure
from ssmppl.inference.particles.filtering import FilterSettings, failure
from ssmppl.inference.preparation.exact_models import exact_model
from ssmppl.inference.preparation.pilot import Pilot, dispersed, find_mode
from ssmppl.inference.preparation.proposal_choice import choose_for_csmc
from ssmppl.inference.run.convergence import PathMovement, update_rate_attributes
from ssmppl.inference.run.draws import Block
from ssmppl.inference.run.problem import Problem, joined

PARTICLES = 25
PARTICLES_WITHOUT_ANCESTORS = 200
PREDICTIVE_PARTICLES = 500


def prepare(setup: SamplingSetup, method: PGAS) -> PreparedChains:
    """Derive the updates, find a mode, and start the chains from particle filters."""
    problem, space = setup.problem, setup.space
    need_density(problem.trace, "PGAS", "sample")
    by_transition = method.proposal == "auto" and method.eliminate not in (False, "auto")
    proposal = "bootstrap" if by_transition else method.proposal
    settings = csmc_settings(problem, method.particles, proposal)
    eliminated = requested_elimination(problem, method.eliminate, setup.fixed, settings.proposal)
    requested_noises(problem, method.interweave, None)  # refused before anything is compiled
    if space.positions.size:
        pilot = setup.once("pilot", lambda: find_mode(space, setup.root))
    else:
        pilot = Pilot(np.empty(0), np.empty(0), 0.0)
    interweaving, interweaved = prepare_interweaving(setup, method.interweave, pilot)
    updates = plan_updates(problem, setup.fixed)
    plan = "\n".join(str(u.explanation) for u in updates)
    elimination = None
    if not isinstance(eliminated, NotApplicable):
        adapting = setup.warmup * setup.thin
        elimination = Eliminating(problem, eliminated.updates, settings.particles, adapting)
        gone = set(eliminated.components)
        updates = tuple(u for u in updates if not gone.issuperset(u.components))
    sweep = SweepSetup(problem, updates, settings, interweaving, elimination)
    starts = setup.once(
        "starts", lambda: dispersed(space, pilot, setup.chains, setup.root, "bootstrap")
    )
    states = []
    for chain, z in enumerate(starts):
        generator, stream = setup.streams(chain)
        theta, _ = space.parameters(z) if len(z) else (space.theta, 0.0)
        begun = start_chain(sweep, theta, generator, stream)
        if not setup.states:
            begun = replace(begun, path_movement=PathMovement(setup.warmup))
        states.append(begun)
    report = {
        "particles": settings.particles,
        "proposal": settings.proposal,
        "settings": asdict(method),
        "ancestor_sampling": deterministic_memory(problem.trace) is not None,
        "plan": plan,
        "eliminated": describe_elimination(eliminated),
        "interweaving": interweaved,
        "pilot_mode": setup.by_name(space.parameters(pilot.z)[0]) if len(pilot.z) else {},
    }
    step = partial(pgas_block, sweep, setup.thin, method.log_likelihood)
    return PreparedChains(step, states, report)


def csmc_settings(problem: Problem, particles: int | None, proposal: str) -> FilterSettings:
    """Settings of the conditional particle filter: what was asked for, else what suits the
    model."""
    if proposal == "auto":
        proposal = choose_for_csmc(problem)
    problem.proposal(proposal)
    if particles is None:
        has_ancestor_sampling = deterministic_memory(problem.trace) is not None
        particles = PARTICLES if has_ancestor_sampling else PARTICLES_WITHOUT_ANCESTORS
    return FilterSettings(int(particles), proposal)


@dataclass(frozen=True)
class SweepSetup(GibbsUpdates):
    """A problem with its updates: what one iteration of PGAS needs.

    settings : of the conditional particle filter. interweaving : the further steps of a sweep.
    elimination : the sweeps where parameters are eliminated; `updates` are those of the others.
    """

    settings: FilterSettings
    interweaving: Interweaving | None = None
    elimination: Eliminating | None = None


@dataclass(frozen=True)
class PGASState:
    """Where a chain stands: theta (P,), one trajectory (T, D) per experiment, random states, how
    its further steps are tuned and what it has learned; and how the trajectories have moved, where
    the draws leave them out."""

    theta: np.ndarray
    paths: tuple[np.ndarray, ...]
    generator: np.random.Generator
    stream: np.ndarray
    tuning: InterweavingTuning | None = None
    elimination_state: EliminationState | None = None
    path_movement: PathMovement | None = None


def start_chain(
    sweep: SweepSetup, theta: np.ndarray, generator: np.random.Generator, stream: np.ndarray
) -> PGASState:
    """A chain at theta, with a path of a particle filter for its first trajectory.

    Raises
    ------
    SamplingError : no path has a positive density, even with many particles.
    """
    problem, stream = sweep.problem, stream.copy()
    run = problem.program.entry(f"filtered_path_{sweep.settings.proposal}")
    paths = []
    for e in problem.experiments:
        path = np.empty((e.steps, len(problem.trace.state_symbols)))
        particles, status, t = max(200, sweep.settings.particles), -1, 0
        while status != OK and particles <= 200_000:
            status, t, _ = run(theta, e.y, e.seen, e.u, particles, stream, path, np.empty(e.steps))
            particles *= 8
        if status != OK:
            raise failure(problem, theta, status, t, e)
        paths.append(path)
    interweaving = sweep.interweaving
    tuning = interweaving.begin() if interweaving is not None else None
    elimination, elimination_state = sweep.elimination, None
    if elimination is not None:
        elimination_state = elimination.begin(theta, tuple(paths))
    return PGASState(theta.copy(), tuple(paths), generator, stream, tuning, elimination_state)


def pgas_block(
    sweep: SweepSetup, thin: int, predictive: bool, state: PGASState, n: int
) -> tuple[PGASState, Block]:
    """n draws of one chain, each after `thin` sweeps.

    predictive : whether to estimate log p(y_t | y_1:t-1, theta) at each, by a particle filter.
    """
    generator, stream = copy.deepcopy(state.generator), state.stream.copy()
    theta, paths, tuning = state.theta.copy(), [p.copy() for p in state.paths], state.tuning
    interweaving, elimination = sweep.interweaving, sweep.elimination
    elimination_state = state.elimination_state
    path_movement, draws = state.path_movement, dict[str, list[np.ndarray]](theta=[])
    draws |= {f"path_{i}": [] for i in range(len(paths)) if path_movement is None}
    stats: dict[str, list[float]] = {"lp": [], "update_rate": [], "ess": [], "acceptance_rate": []}
    if interweaving is not None:
        stats["interweaved"] = []
    for _ in range(n):
        moved, ess, accepted, made, interweaved = 0.0, 0.0, 0, 0, 0.0
        for _ in range(thin):
            if elimination is not None and elimination_state is not None:
                elimination_state, rates = elimination.sweep(
                    elimination_state, theta, paths, stream, generator
                )
            else:
                rates = run_conditional_smc(sweep, theta, paths, stream)
            infos = draw_parameters(sweep, theta, paths, generator)
            if interweaving is not None and tuning is not None:
                tuning, share = interweaving.step(tuning, theta, paths, generator)
                interweaved += share / thin
            moved, ess = moved + rates[0] / thin, ess + rates[1] / thin
            accepted, made = accepted + sum(infos), made + len(infos)
        draws["theta"].append(theta.copy())
        if path_movement is not None:
            path_movement = path_movement.after(paths)
        for i, path in enumerate(paths if path_movement is None else ()):
            draws[f"path_{i}"].append(path.copy())
        if predictive:
            for i, increments in enumerate(_predictive(sweep, theta, stream)):
                draws.setdefault(f"increment_{i}", []).append(increments)
        stats["lp"].append(log_joint(sweep, theta, paths))
        stats["update_rate"].append(moved)
        stats["ess"].append(ess)
        stats["acceptance_rate"].append(accepted / made if made else 1.0)
        if interweaving is not None:
            stats["interweaved"].append(interweaved)
    state = PGASState(
        theta, tuple(paths), generator, stream, tuning, elimination_state, path_movement
    )
    return state, Block.of(draws, stats)


def _predictive(sweep: SweepSetup, theta: np.ndarray, stream: np.ndarray) -> list[np.ndarray]:
    """log p(y_t | y_1:t-1, theta) of each experiment, (T,); -inf from where the filter dies."""
    problem = sweep.problem
    run = problem.program.entry(f"filter_{sweep.settings.proposal}")
    own = stream.copy()  # a stream beside the chain's, so that the draws stay the same without
    own[1] ^= np.uint64(0x5851F42D4C957F2D)
    out = []
    for e in problem.experiments:
        increments, ess = np.empty(e.steps), np.empty(e.steps)
        run(
            theta, e.y, e.seen, e.u, PREDICTIVE_PARTICLES, None, 1.0, own, increments, ess, None
        )  # fmt: skip
        out.append(increments)
    return out


def run_conditional_smc(
    sweep: SweepSetup, theta: np.ndarray, paths: list[np.ndarray], stream: np.ndarray
) -> tuple[float, float]:
    """New trajectories given theta, in place; (share of steps that changed, ESS / N)."""
    problem, settings, every = sweep.problem, sweep.settings, sweep.problem.end_to_end
    one = problem.program.entry(f"conditional_smc_{settings.proposal}")
    old, figures = joined(paths), np.empty((len(paths), 2))
    new = np.empty_like(old)
    status, t, e = over_data_sets(conditional_smc_each, one)(
        theta, *every.data, settings.particles, stream, old, new, figures
    )
    if status != OK:
        raise sweep_failure(problem, theta, status, t, problem.experiments[e])
    paths[:] = every.split(new)
    rates = np.add.reduce(figures / len(paths))
    return float(rates[0]), float(rates[1])


def explain(plan: Derived) -> Mapping[str, PlanRows]:
    """What the plan says of trajectories, and of what else can move with or without them."""
    exact = exact_model(plan.trace)
    found = applicable(plan.noises, None if isinstance(exact, NotApplicable) else exact)
    if isinstance(found, NotApplicable):
        interweaved = [("nothing", reason_and_line(found))]
    else:
        interweaved = [("PGAS", with_states(found))]
    return {
        TRAJECTORIES: [("PGAS", _trajectories_of(plan))],
        INTERWEAVED: interweaved,
        ELIMINATED: explain_elimination(plan.eliminable),
    }


def _trajectories_of(plan: Derived) -> str:
    singular = singular_covariance(plan.trace)
    if singular is not None:
        return f"does not apply: {reason_and_line(singular)}"
    flat = [s.name for s in plan.trace.initial.values() if not s.distribution.proper]
    if flat:
        return (
            f"does not apply: {', '.join(flat)} {'has' if len(flat) == 1 else 'have'} an improper "
            "(flat) initial distribution, which cannot be sampled"
        )
    steps = plan.deterministic_memory
    if steps is None:
        return (
            "conditional SMC without ancestor sampling, which is impossible: the model has a "
            "deterministic state with infinite memory; take more particles, or PMMH"
        )
    if steps == 0:
        return "conditional SMC with ancestor sampling, weights w f(x'_t | x_{t-1})"
    last = "noisy state" if steps == 1 else f"{steps} noisy states"
    return (
        "conditional SMC with ancestor sampling over the noisy states: deterministic states depend "
        f"on the last {last} only, whose densities enter the ancestor weights"
    )


METHOD = SamplingMethod(
    prepare,
    state_classes=(PGASState, InterweavingTuning, EliminationState, PathMovement, Pilot),
    by_row=lambda method: method.log_likelihood,
    attributes=update_rate_attributes,
    explain=explain,
)
