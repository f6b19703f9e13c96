"""The verb `maximize`: maximum likelihood, and posterior modes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ssmppl.analysis.structure import flat_start, noisy_start
from ssmppl.arguments import checked_with
from ssmppl.data import check_values, unpack_parameters
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError, listing, warn, written_as
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.batched.reckoning import reckon
from ssmppl.inference.gaussian.likelihood import laplace_approximation
from ssmppl.inference.maximum import (
    direct_optimization,
    em,
    iterated_filtering,
    particle_em,
    psaem,
    score_ascent,
)
from ssmppl.inference.maximum.ascent import Ascent, Edges, Maximization
from ssmppl.inference.maximum.edges import edges
from ssmppl.inference.maximum.estimate import NO_METHOD, Estimate, make_estimate
from ssmppl.inference.methods.methods import (
    EM,
    IF2,
    PSAEM,
    DirectOptimization,
    ParticleEM,
    ScoreAscent,
)
from ssmppl.inference.methods.settings import check_settings
from ssmppl.inference.particles.filtering import FilterSettings, estimates_task, log_of_mean
from ssmppl.inference.particles.scores import Smoothing, combine, complete_scores, several_runs
from ssmppl.inference.preparation.exact_models import exact_kind
from ssmppl.inference.preparation.exact_score import ExactScore
from ssmppl.inference.preparation.method_choice import choose_maximiser, start_as_parameter
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.preparation.space import Space, free_components, space_of
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.labels import model_attributes
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.inference.run.seeds import seed_sequence
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model.model import Model
from ssmppl.status import LOG

# The methods: what climbs under each class of settings.
METHODS: dict[type, Callable[[Maximization, Any], Ascent]] = {
    DirectOptimization: direct_optimization.climb,
    EM: em.climb,
    ParticleEM: particle_em.climb,
    PSAEM: psaem.climb,
    ScoreAscent: score_ascent.climb,
    IF2: iterated_filtering.climb,
}
OBJECTIVES = ("likelihood", "posterior")
PARTICLES, REPEATS = 1000, 16  # of the log-likelihood and the information at the estimate
TRAJECTORIES = 1000
CLIMB = 20  # passes over the data of a climb where a simulator is called, most often


@checked_with(METHODS)
def maximize(
    model: Model,
    data: Any,
    method: Any = None,
    *,
    start: Mapping[str, Any] | None = None,
    fixed: Mapping[str, Any] | None = None,
    objective: str = "likelihood",
    seed: int | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> Estimate:
    """Maximise the likelihood of the parameters, or their posterior density.

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    method : settings such as `ssm.DirectOptimization(...)`; None chooses by structure, and the
        attributes say what and why.
    start : parameter values to begin from; what is not given begins at a pilot's mode (at moderate
        values, where the likelihood is exact).
    fixed : parameters held at these values.
    objective : "likelihood", for which the priors serve as supports only; or "posterior", which
        adds the log prior density on the parameters' own scale, without a Jacobian.
    seed : the same seed gives the same estimate, whatever the executor; None: a random one.
    executor : any `concurrent.futures.Executor`; None: threads.
    progress : whether to show how far it is, on stderr.

    Returns
    -------
    Estimate
        Parameters, covariance from the observed information, log-likelihood, iterates. Ctrl-C ends
        the climb early and returns the best so far, with the attribute `interrupted`.

    Raises
    ------
    ModelError, DataError, ArgumentError, SamplingError : what is wrong, where, and the fix.
    """
    began = time.perf_counter()
    if objective not in OBJECTIVES:
        raise ArgumentError(
            f"objective={objective!r}", fix=f"use one of: {listing(str(objective), OBJECTIVES)}"
        )
    if method is not None and type(method) not in METHODS:
        names = ", ".join(f"ssm.{c.__name__}(...)" for c in METHODS)
        raise ArgumentError(
            f"method={method!r} is not a maximisation method",
            fix=written_as(method, METHODS) or f"use {names} or None",
        )
    check_executor(executor)
    check_settings(method)
    problem = pose(model, data, noting=True)
    fixed_values = check_values(problem.trace, fixed, argument="fixed")
    near = check_values(problem.trace, start, argument="start")
    twice = [n for n in near if n in fixed_values]
    if twice:
        raise ArgumentError(
            f"{twice[0]!r} is given in start and in fixed", fix=f"leave {twice[0]!r} out of one"
        )
    root = seed_sequence(seed)
    space, fixed_values, idle = _without_idle(problem, objective, fixed_values, near)
    if method is None:
        reckon("maximize", problem, space.theta, CLIMB, progress)
    setup = Maximization(problem, space, objective, fixed_values, near, root, executor, progress)
    if not len(space.positions):
        chosen, reason = None, "every parameter is fixed, or the model has none"
        ascent = Ascent(space.theta, None, space.theta[None], {"converged": True})
    else:
        chosen, reason = (method, "by the user") if method is not None else choose_method(setup)
        if method is None:
            LOG.info(
                "maximize of model %r: %s, as %s", problem.trace.name, type(chosen).__name__, reason
            )
        ascent = METHODS[type(chosen)](setup, chosen)
        if method is None and ascent.report.get("approximate") and not ascent.interrupted:
            setup, chosen, reason = _without_laplace(setup, ascent)
            ascent = METHODS[type(chosen)](setup, chosen)
    attrs: dict[str, Any] = {
        **model_attributes(problem.trace),
        "method": type(chosen).__name__ if chosen is not None else NO_METHOD,
        "method_chosen": reason,
        "objective": objective,
        "settings": asdict(chosen) if chosen is not None else {},
        "fixed": dict(fixed or {}),
        **({"only_in_priors": idle} if idle else {}),
        **ascent.report,
        "interrupted": ascent.interrupted,
        "seed": str(root.entropy),
    }
    if isinstance(setup.exact, Extended) and isinstance(chosen, DirectOptimization):
        attrs["approximate"] = True
    value = _log_likelihood(setup, ascent, attrs)
    covariance = _covariance(setup, ascent, attrs)
    if ascent.error is not None:
        trace, errors = problem.trace, np.diagonal(ascent.error)
        labels = map(trace.label, trace.parameter_symbols)
        free = free_components(problem.trace, fixed_values)
        attrs["monte_carlo_errors"] = {
            label: float(np.sqrt(max(e, 0.0)))
            for label, e, f in zip(labels, errors, free, strict=True)
            if f
        }
    attrs["measured_rows"] = int(sum(e.seen.any(axis=1).sum() for e in problem.experiments))
    attrs["flat_starts"] = sum(len(s.components) for s in flat_start(problem.trace))
    attrs["flat_starts"] *= len(problem.experiments)
    attrs["seconds"] = time.perf_counter() - began
    return make_estimate(
        problem.trace, ascent.theta, covariance, value, ascent.iterates, fixed_values, attrs,
        ascent.figures,
    )  # fmt: skip


def _without_idle(
    problem: Problem, objective: str, fixed: Mapping[str, np.ndarray], near: Mapping[str, Any]
) -> tuple[Space, dict[str, np.ndarray], list[str]]:
    """Where a climb begins, and what it leaves as it is: parameters of priors that no other
    distribution holds, which the likelihood says nothing about."""
    trace, space = problem.trace, space_of(problem, dict(fixed), dict(near))
    sites = (trace.initial, trace.transition, trace.observations)
    read = symbols_of(e for group in sites for s in group.values()
                      for e in s.distribution.expressions())  # fmt: skip
    idle = [n for n, site in trace.parameters.items()
            if n not in fixed and read.isdisjoint(site.components)]  # fmt: skip
    if objective != "likelihood" or not idle:
        return space, dict(fixed), []
    values = unpack_parameters(trace, space.theta)
    held = {**fixed, **{n: values[n] for n in idle}}
    return space_of(problem, held, {n: v for n, v in near.items() if n not in idle}), held, idle


def choose_method(setup: Maximization) -> tuple[Any, str]:
    """The method for a model's structure, and why."""
    trace, laplace = setup.problem.trace, None
    if isinstance(setup.exact, NotApplicable):
        found = laplace_approximation(setup.problem)
        laplace = found if isinstance(found, NotApplicable) else None
    chosen, reason = choose_maximiser(exact_kind(setup.exact), trace, laplace)
    if isinstance(chosen, ScoreAscent) and noisy_start(trace):
        warn(
            f"{type(chosen).__name__} may take minutes for each hundred rows here: "
            f"{start_as_parameter(trace)}"
        )
    return chosen, f"automatically: {reason}"


def _without_laplace(setup: Maximization, ascent: Ascent) -> tuple[Maximization, Any, str]:
    """The next method, from where Laplace's approximation has its top, and why."""
    problem = setup.problem
    none = NotApplicable("it could not be corrected")
    chosen, reason = choose_maximiser(exact_kind(setup.exact), problem.trace, none)
    near = unpack_parameters(problem.trace, ascent.theta)
    near = {n: v for n, v in near.items() if n not in setup.fixed}
    why = f"{reason}; started from {ascent.report['likelihood']}"
    space = space_of(problem, setup.fixed, near)
    return replace(setup, space=space, near=near), chosen, f"automatically: {why}"


def _log_likelihood(setup: Maximization, ascent: Ascent, attrs: dict[str, Any]) -> float:
    """log p(y | theta): the method's own, else exact, else estimated, its error into `attrs`."""
    if ascent.log_likelihood is not None:
        return ascent.log_likelihood
    problem, theta = setup.problem, ascent.theta
    if not isinstance(setup.exact, NotApplicable):
        return setup.exact.log_likelihood(problem.experiments, theta)
    try:
        settings = FilterSettings(PARTICLES, choose_by_pilot(problem, theta, temper=True).name)
        task = estimates_task(problem, theta, settings, setup.seed(1))
        pieces = [range(r, r + 1) for r in range(REPEATS)]
        log_z = np.concatenate(run_tasks(task, pieces, executor=setup.executor))
    except (SamplingError, KeyboardInterrupt):
        return np.nan
    value, error = log_of_mean(log_z)
    if value > -np.inf:
        attrs["log_likelihood_error"] = error
    return value


def _covariance(setup: Maximization, ascent: Ascent, attrs: dict[str, Any]) -> np.ndarray:
    """(P, P) inverse observed information of the free components; `attrs` says how, or why not."""
    p, where = len(ascent.theta), setup.space.positions
    nothing = np.full((p, p), np.nan)
    if not len(where):
        return nothing
    information = ascent.information
    if ascent.report.get("without_maximum"):
        attrs["covariance"] = "the likelihood has no maximum"
        return nothing
    if information is None and ascent.interrupted:
        attrs["covariance"] = "none: interrupted before the observed information was known"
        return nothing
    if ascent.no_information:
        attrs["covariance"] = f"none: {ascent.no_information}"
        return nothing
    found, score = ascent.held, None
    if information is None and found is None:
        information = _information(setup, ascent.theta, None)
    if found is None and information is not None and not isinstance(setup.exact, NotApplicable):
        found = edges(setup, ascent.theta, information)
    if found is not None:
        trace = setup.problem.trace
        labels = [trace.label(s) for s in trace.parameter_symbols]
        attrs["held_at_edge"] = {labels[i]: edge for i, edge in found.components.items()}
        if not found.kept.any():
            attrs["covariance"] = "every parameter is at the boundary of its parameter space"
            return nothing
        if ascent.information is None:
            information = _information(setup, ascent.theta, found)
        if found.moving and not isinstance(setup.exact, NotApplicable):
            score = _score_of(setup, found).score(ascent.theta)[1]
    if information is None:
        attrs["covariance"] = "none: no second derivatives of the log-likelihood"
        return nothing
    covariance = natural_covariance(setup, ascent.theta, information, found, score)
    if isinstance(covariance, NotApplicable):
        attrs["covariance"] = f"none: {covariance.reason}"
        return nothing
    attrs["covariance"] = "inverse observed information"
    if found is not None:
        attrs["covariance"] += f", with {', '.join(attrs['held_at_edge'])} held at the boundary"
    return covariance


def _information(setup: Maximization, theta: np.ndarray, found: Edges | None) -> np.ndarray | None:
    if not isinstance(setup.exact, NotApplicable):
        return _score_of(setup, found).information(theta)
    try:
        scores = complete_scores(setup.problem, setup.fixed)
        settings = FilterSettings(
            PARTICLES, choose_by_pilot(setup.problem, theta, exact=False, temper=True).name
        )
        smoothing = Smoothing(settings, TRAJECTORIES)
        runs = several_runs(
            scores, theta, smoothing, True, setup.seed(2), range(REPEATS), setup.executor
        )
    except (ArgumentError, SamplingError):
        return None
    return combine(runs).information


def _score_of(setup: Maximization, found: Edges | None) -> ExactScore:
    """The score of an exact likelihood, in what is free and not held at an edge that stays where it
    is."""
    free = free_components(setup.problem.trace, setup.fixed)
    free[[] if found is None else [i for i in found.components if i not in found.moving]] = False
    return setup.exact_score(free)


def natural_covariance(
    setup: Maximization,
    theta: np.ndarray,
    information: np.ndarray,
    found: Edges | None = None,
    score: np.ndarray | None = None,
) -> np.ndarray | NotApplicable:
    """The delta method: J (J' I J - d2 log prior)^-1 J' over all components of theta.

    At a maximum the gradient in theta vanishes, so that the second derivatives of theta(z) drop out
    of the likelihood's part. The prior counts for objective "posterior" only.

    found : parameters at an edge, which are held there and have NaN. score : (P,) the gradient of
    the likelihood where it does not vanish, as such an edge moves with other parameters.
    """
    try:
        z = setup.space_at(theta) if found is None else found.z
    except (ValueError, np.linalg.LinAlgError):
        return NotApplicable("the estimate lies on the boundary of the parameter space")
    kept = np.ones(len(z), dtype=bool) if found is None else found.kept
    point = setup.transform.at(z)
    jacobian = point.jacobian[:, kept]
    with np.errstate(all="ignore"):
        curvature = jacobian.T @ information @ jacobian
    if setup.with_prior or score is not None:
        slope = point.inverse().T @ point.d_log_prior if score is None else -score
        second = setup.transform.curvature(z, slope)
        curvature = curvature + second.theta[np.ix_(kept, kept)]
    if setup.with_prior:
        curvature = curvature - second.log_prior[np.ix_(kept, kept)]
    if not np.all(np.isfinite(curvature)):
        return NotApplicable("the observed information is not finite at the estimate")
    scale = np.sqrt(np.abs(np.diagonal(curvature)))
    if not np.all(scale > 0.0):
        return NotApplicable("the observed information is singular: a parameter is not identified")
    values = np.linalg.eigvalsh(curvature / np.outer(scale, scale))
    if values[0] < 1e-10:
        return NotApplicable(
            "the observed information is not positive definite: the estimate is no interior "
            "maximum, or some parameters are not identified"
        )
    covariance = jacobian @ np.linalg.solve(curvature, jacobian.T)
    at_edge = [] if found is None else list(found.components)
    covariance[at_edge, :] = covariance[:, at_edge] = np.nan
    return covariance
