"""Gibbs sampling where the states can be drawn exactly.

Schön et al. (2015), section 4.2: the states given the parameters by the Kalman filter and backward
sampling (Frühwirth-Schnatter 1994; Carter and Kohn 1994) or, where they take few values, by the
forward algorithm and backward sampling (Chib 1996); the parameters given the states by their
derived updates.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from ssmppl.errors import ArgumentError, NotApplicable
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
)
from ssmppl.inference.chains.metropolis import needed_model
from ssmppl.inference.chains.sampling import (
    INTERWEAVED,
    Derived,
    PlanRows,
    PreparedChains,
    SamplingMethod,
    SamplingSetup,
)
from ssmppl.inference.methods.methods import Gibbs
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.preparation.exact_models import (
    ExactModel,
    exact_model,
    filter_of,
    log_increments,
)
from ssmppl.inference.preparation.pilot import (
    Pilot,
    averaged_density,
    dispersed,
    explained,
    find_mode,
    finite_point,
)
from ssmppl.inference.preparation.space import at
from ssmppl.inference.preparation.vanishing import check_mode
from ssmppl.inference.run.draws import Block
from ssmppl.inference.run.seeds import random_state

MANY = 50  # numbers beyond which a simplex does not find the mode, and sweeps tell where it is
SWEEPS = 100  # of which the second half counts


@dataclass(frozen=True)
class GibbsState:
    """Where a chain stands: theta (P,), its random states, and how its further steps are tuned; the
    trajectories are drawn anew."""

    theta: np.ndarray
    generator: np.random.Generator
    stream: np.ndarray
    tuning: InterweavingTuning | None = None


@dataclass(frozen=True)
class GibbsSweeper(GibbsUpdates):
    """A problem with its updates. interweaving : the further steps of a sweep. by_row : whether the
    log-likelihood of each row is kept too."""

    interweaving: Interweaving | None = None
    by_row: bool = False


def prepare(setup: SamplingSetup, method: Gibbs) -> PreparedChains:
    """Derive the updates, find the mode, and start the chains round it.

    Raises
    ------
    ArgumentError : the states cannot be drawn exactly; gives the reason and the line.
    SamplingError : the likelihood grows without bound.
    """
    problem, space = setup.problem, setup.space
    model = needed_model(problem, "Gibbs")
    need_density(problem.trace, "Gibbs", "sample")
    kind, updates = filter_of(model), plan_updates(problem, setup.fixed)
    if space.positions.size:
        if all(u.family is not None for u in updates) and len(space.positions) > MANY:
            bare = GibbsSweeper(problem, updates)
            pilot = setup.once("pilot", lambda: _pilot_by_sweeps(setup, bare, model, kind))
        else:
            pilot = setup.once("pilot", lambda: find_mode(space, setup.root, kind))
        check_mode(model, problem.experiments, space.parameters(pilot.z)[0])
    else:
        pilot = Pilot(np.empty(0), np.empty(0), 0.0)
    interweaving, interweaved = prepare_interweaving(setup, method.interweave, pilot, model)
    steps = GibbsSweeper(problem, updates, interweaving, method.log_likelihood)
    starts = setup.once("starts", lambda: dispersed(space, pilot, setup.chains, setup.root, kind))
    states = []
    for chain, z in enumerate(starts):
        generator, stream = setup.streams(chain)
        theta = space.parameters(z)[0] if len(z) else space.theta
        tuning = interweaving.begin() if interweaving is not None else None
        states.append(GibbsState(theta.copy(), generator, stream, tuning))
    report = {
        "trajectories": "exact draws given the data",
        "settings": asdict(method),
        "plan": "\n".join(str(u.explanation) for u in steps.updates),
        "interweaving": interweaved,
        "pilot_mode": setup.by_name(space.parameters(pilot.z)[0]) if len(pilot.z) else {},
    }
    return PreparedChains(partial(gibbs_block, steps, setup.thin, setup.states), states, report)


def _pilot_by_sweeps(
    setup: SamplingSetup, steps: GibbsSweeper, model: ExactModel, kind: str
) -> Pilot:
    """The mean and standard deviation of plain sweeps, in place of a mode and the scale there.

    Raises
    ------
    ArgumentError : the likelihood is zero at every point that was tried.
    """
    space, root = setup.space, setup.root
    own = np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, 8))
    generator, stream = np.random.default_rng(own), random_state(own)
    density = averaged_density(space, root, kind, 1)
    try:
        z = finite_point(space.z[space.positions], density, generator)
    except ArgumentError as error:
        raise explained(error, space) from None
    theta, found = space.parameters(z)[0].copy(), []
    for _ in range(SWEEPS):
        draw_parameters(steps, theta, draw_paths(steps, model, theta, stream), generator)
        found.append(at(space, theta).z[space.positions])
    half = np.array(found[SWEEPS // 2 :])
    centre = half.mean(axis=0)
    if density(centre) == -np.inf:
        centre = half[-1]
    return Pilot(centre, half.std(axis=0), density(centre))


def gibbs_block(
    steps: GibbsSweeper, thin: int, with_paths: bool, state: GibbsState, n: int
) -> tuple[GibbsState, Block]:
    """n draws of one chain, each after `thin` sweeps; with_paths : whether with trajectories."""
    model = needed_model(steps.problem, "Gibbs")
    generator, stream = copy.deepcopy(state.generator), state.stream.copy()
    theta, tuning, interweaving = state.theta.copy(), state.tuning, steps.interweaving
    draws: dict[str, list[np.ndarray]] = {"theta": []}
    draws |= {f"path_{i}": [] for i in range(len(steps.problem.experiments)) if with_paths}
    stats: dict[str, list[float]] = {"lp": [], "acceptance_rate": []}
    if interweaving is not None:
        stats["interweaved"] = []
    for _ in range(n):
        accepted, made, interweaved = 0, 0, 0.0
        for _ in range(thin):
            if interweaving is not None and tuning is not None:
                tuning, share = interweaving.step(tuning, theta, [], generator)
                interweaved += share / thin
            paths = draw_paths(steps, model, theta, stream)
            infos = draw_parameters(steps, theta, paths, generator)
            accepted, made = accepted + sum(infos), made + len(infos)
        draws["theta"].append(theta.copy())
        for i, path in enumerate(paths if with_paths else ()):
            draws[f"path_{i}"].append(path)
        rows = log_increments(model, steps.problem.experiments, theta) if steps.by_row else ()
        for i, row in enumerate(rows):
            draws.setdefault(f"increment_{i}", []).append(row)
        stats["lp"].append(log_joint(steps, theta, paths))
        stats["acceptance_rate"].append(accepted / made if made else 1.0)
        if interweaving is not None:
            stats["interweaved"].append(interweaved)
    return GibbsState(theta, generator, stream, tuning), Block.of(draws, stats)


def draw_paths(
    steps: GibbsUpdates, model: ExactModel, theta: np.ndarray, stream: np.ndarray
) -> list[np.ndarray]:
    """Independent trajectories (T, D), one per experiment, from p(x_{1:T} | y_{1:T}, theta)."""
    experiments = steps.problem.experiments
    drawn = model.draw_each(experiments, theta, [stream] * len(experiments))
    paths = [np.ascontiguousarray(d[0]) for d in drawn]
    log_joint(steps, theta, paths)  # sets deterministic components to the last digit
    return paths


def explain(plan: Derived) -> Mapping[str, PlanRows]:
    """What the plan says of further steps, where the states can be drawn exactly."""
    exact = exact_model(plan.trace)
    if isinstance(exact, NotApplicable):
        return {}
    found = applicable(plan.noises, exact)
    if isinstance(found, NotApplicable):
        return {}
    how = (
        f"{', '.join(found.tied)}: moved with the states integrated out, if the warmup finds a "
        "parameter slow given the states"
    )
    return {INTERWEAVED: [("Gibbs", how)]}


METHOD = SamplingMethod(
    prepare,
    state_classes=(GibbsState, InterweavingTuning, Pilot),
    by_row=lambda method: method.log_likelihood,
    explain=explain,
)
