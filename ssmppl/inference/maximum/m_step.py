"""What the methods of the EM family share: the derived M-step of a question, the statistics of
trajectories, and the estimate from the iterates of several chains.

The M-step over trajectories where their density does not separate: its mean climbed as it is.

Newton's method on the unconstrained scale, from the parameters of the iteration before, with the
complete-data scores and second derivatives summed over the trajectories in compiled passes; EM
moves by little, so that two or three steps are enough. BFGS where there are no second derivatives
in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from ssmppl.analysis.conjugacy.m_step import MStep, counted, derive_m_step, unsuited
from ssmppl.analysis.conjugacy.separation import complete_data, restricted
from ssmppl.codegen.modules.trajectory_sums import compile_statistics
from ssmppl.codegen.native.loading import Loaded
from ssmppl.compiling import once_property
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.maximum.ascent import (
    ELSEWHERE,
    Maximization,
    TransformedPoint,
    UnconstrainedTransform,
)
from ssmppl.inference.particles.scores import CompleteScores, complete_scores
from ssmppl.inference.preparation.pilot import dispersed
from ssmppl.inference.preparation.space import Space, at
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import Block, stack
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.updates.q_function import QFunction
from ssmppl.inference.updates.symbolic_newton import LONGEST_STEP, Unconstrained, uphill

STEPS, HALVINGS, BFGS_STEPS = 30, 20, 50
LAST_STEP = 1e-6  # squared length, in standard errors of the complete data; what is left after it
# is about the step's square, where the noise of M trajectories is 1 / sqrt(M)


@dataclass(frozen=True)
class _Height:
    """The mean log density at a point: its value, its slope in z (F,) and in theta (P,)."""

    point: TransformedPoint
    value: float
    slope: np.ndarray
    gradient: np.ndarray


def maximise_over_paths(
    transform: UnconstrainedTransform, scores: CompleteScores, paths: Sequence[np.ndarray],
    weights: np.ndarray, z: np.ndarray, posterior: bool,
) -> np.ndarray:  # fmt: skip
    """theta (P,) where the weighted mean of log p(x, y | theta) has its top, going up from z (F,).

    paths : for each experiment (M, T, D). weights : (M,). posterior : whether the prior counts.
    """
    mean = _Mean(transform, scores, paths, weights, posterior)
    return transform.at(mean.newton(z) if scores.twice else mean.bfgs(z)).theta


class _Mean:
    """The weighted mean of the log density over trajectories, as a function of z."""

    def __init__(
        self, transform: UnconstrainedTransform, scores: CompleteScores,
        paths: Sequence[np.ndarray], weights: np.ndarray, posterior: bool,
    ):  # fmt: skip
        self.transform, self.scores, self.posterior = transform, scores, posterior
        self.paths, self.weights = paths, weights

    def at(self, z: np.ndarray) -> _Height | None:
        """None outside of the support, or where nothing is finite."""
        point = self.transform.at(z)
        if point.log_prior == -np.inf:
            return None
        values, gradients = self.scores.value_and_gradient(point.theta, self.paths)
        value, gradient = float(self.weights @ values), self.weights @ gradients
        slope = point.pull(gradient)
        if self.posterior:
            value, slope = value + point.log_prior, slope + point.d_log_prior
        finite = np.isfinite(value) and np.all(np.isfinite(slope))
        return _Height(point, value, slope, gradient) if finite else None

    def first(self, z: np.ndarray) -> _Height | None:
        """`at` where a climb begins.

        Raises
        ------
        SamplingError : there is a value, and no slope.
        """
        here = self.at(z)
        if here is None:
            point = self.transform.at(z)
            values, gradients = self.scores.value_and_gradient(point.theta, self.paths)
            value, gradient = float(self.weights @ values), self.weights @ gradients
            if reason := self.transform.without_slope(value, point.theta, gradient):
                raise SamplingError(
                    f"the log density of the states cannot be maximised (no gradient): {reason}",
                    fix=ELSEWHERE,
                )
        return here

    def curvature(self, z: np.ndarray, height: _Height) -> np.ndarray:
        """Second derivatives in z, (F, F)."""
        j = height.point.jacobian
        second = np.tensordot(
            self.weights, self.scores.hessian(height.point.theta, self.paths), axes=1
        )
        bent = self.transform.curvature(z, height.gradient)
        out = j.T @ second @ j + bent.theta
        return out + bent.log_prior if self.posterior else out

    def newton(self, z: np.ndarray) -> np.ndarray:
        """The top by Newton's steps, halved until the mean rises."""
        here = self.first(z)
        if here is None:
            return z
        for _ in range(STEPS):
            curvature = self.curvature(z, here)
            if not np.all(np.isfinite(curvature)):
                return self.bfgs(z)
            step = uphill(here.slope, curvature)
            if float(here.slope @ step) < LAST_STEP:
                return z + step
            step *= min(1.0, LONGEST_STEP / float(np.linalg.norm(step)))
            higher = self._higher(z, step, here.value)
            if higher is None:
                break
            z, here = higher
        return z

    def _higher(
        self, z: np.ndarray, step: np.ndarray, value: float
    ) -> tuple[np.ndarray, _Height] | None:
        """The first point above `value` at z + step, z + step / 2, ...; None where none is."""
        for k in range(HALVINGS):
            point = z + 0.5**k * step
            there = self.at(point)
            if there is not None and there.value > value:
                return point, there
        return None

    def bfgs(self, z: np.ndarray) -> np.ndarray:
        """The top by BFGS."""

        def negative(z: np.ndarray) -> tuple[float, np.ndarray]:
            height = self.at(z)
            if height is None:
                return np.inf, np.zeros(len(z))
            return -height.value, -height.slope

        self.first(z)
        found = scipy.optimize.minimize(
            negative, z, jac=True, method="BFGS", options={"maxiter": BFGS_STEPS}
        )
        return found.x if found.fun <= negative(z)[0] else z


DRIFT = 5.0  # standard errors that the halves of the iterates may differ by


@dataclass(frozen=True)
class Maximiser:
    """A question with its M-step; other processes derive it again.

    fixed : names of the parameters that are held. posterior : whether the prior counts.
    """

    space: Space
    fixed: tuple[str, ...]
    posterior: bool

    @property
    def problem(self) -> Problem:
        return self.space.problem

    @once_property
    def step(self) -> MStep | NotApplicable:
        """The M-step from statistics; the reason where the densities do not separate."""
        missing = self.problem.program.missing
        return derive_m_step(self.problem.trace, self.fixed, missing, self.posterior)

    @once_property
    def q(self) -> QFunction:
        assert isinstance(self.step, MStep)
        return QFunction(self.step)

    @once_property
    def module(self) -> Loaded:
        assert isinstance(self.step, MStep)
        return compile_statistics(self.step)

    @cached_property
    def transform(self) -> UnconstrainedTransform:
        return UnconstrainedTransform(self.space)

    @cached_property
    def scores(self) -> CompleteScores:
        """The complete-data scores, for the M-step without statistics."""
        return complete_scores(self.problem, self.fixed)

    def statistics(
        self, theta: np.ndarray, paths: Sequence[np.ndarray], weights: Sequence[np.ndarray]
    ) -> np.ndarray:
        """The C_i averaged over weighted paths, (M, T, D) and (M,) of each experiment."""
        total, theta = self.q.prior(theta), np.ascontiguousarray(theta, dtype=float)
        part = np.empty(len(total))
        run = self.module.weighted_statistics
        for e, some, w in zip(self.problem.experiments, paths, weights, strict=True):
            run(theta, e.y, e.seen, e.u, np.ascontiguousarray(some), w, None, part, total)
        return total

    def from_paths(
        self, theta: np.ndarray, paths: Sequence[np.ndarray], log_z: np.ndarray
    ) -> np.ndarray:
        """theta after an M-step on trajectories of R runs, weighed by their likelihoods.

        paths : for each experiment (R M, T, D), run by run. log_z : (experiments, R).
        """
        m = len(paths[0]) // log_z.shape[1]
        if isinstance(self.step, MStep):
            weights = [np.repeat(ratio_weights(row) / m, m) for row in log_z]
            return self.q.maximise(self.statistics(theta, paths, weights), theta)
        w = np.repeat(ratio_weights(log_z.sum(axis=0)) / m, m)
        return maximise_over_paths(
            self.transform, self.scores, paths, w, self._unconstrained(theta), self.posterior
        )

    def _unconstrained(self, theta: np.ndarray) -> np.ndarray:
        moved = at(self.space, theta)
        return moved.z[moved.positions]

    def __getstate__(self) -> dict:
        return {k: self.__dict__[k] for k in ("space", "fixed", "posterior")}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)


def ratio_weights(log_z: np.ndarray) -> np.ndarray:
    """(R,) weights, of sum 1, of independent runs with likelihood estimates Z; see particle_em."""
    r = len(log_z)
    share = np.exp(log_z - log_z.max())
    share /= share.sum()
    return share if r == 1 else (r * share - 1.0 / r) / (r - 1.0)


def maximiser(setup: Maximization, method: str) -> Maximiser:
    """The M-step of a question.

    Raises
    ------
    ArgumentError : a free parameter cuts off the support of a state or an observation, or sets a
        deterministic state, so that given the states it cannot move; names parameter and line.
    """
    problem = setup.problem
    free = [s for s in problem.trace.parameter_symbols if s.data[1] not in setup.fixed]
    data = counted(complete_data(problem.trace, problem.program.missing), setup.with_prior)
    if method == "ParticleEM":  # its numerical M-step takes the noisy components alone
        reason = restricted(data, free)
        others = "ssm.PMMH()"
    else:
        reason = unsuited(data, free)
        others = "ssm.ParticleEM()"
    if reason is not None:
        raise ArgumentError(
            f"{method} does not apply: {reason.reason}",
            fix=f"use another method, for example {others}, or hold the parameter by fixed={{...}}",
            where=reason.where,
        )
    return Maximiser(setup.space, tuple(setup.fixed), setup.with_prior)


def starts(setup: Maximization, chains: int) -> list[np.ndarray]:
    """theta (P,) for each chain, dispersed round the start on the scale of the pilot's mode.

    So a climb that has not forgotten where it began shows in how the chains differ.
    """
    pilot = setup.pilot
    centre = replace(pilot, z=setup.start, scale=0.5 * pilot.scale)
    points = dispersed(setup.space, centre, chains, setup.seed(4), "bootstrap")
    return [setup.space.parameters(z)[0].copy() for z in points]


@dataclass(frozen=True)
class Chains:
    """What the iterates of independent chains tell: the ascent, without its report's rest."""

    pooled: Pooled
    iterates: np.ndarray
    stats: dict[str, np.ndarray]
    interrupted: bool
    report: dict[str, Any]


def run_to_estimate(
    setup: Maximization, step_block: Callable[[Any, int], tuple[Any, Block]], states: Sequence[Any],
    iterations: int, left_out: int, title: str, by_regression: bool = False,
) -> Chains:  # fmt: skip
    """Run chains whose blocks hold "theta" (n, P), and pool what comes after `left_out`."""
    chains = run_chains(
        step_block, states, iterations, executor=setup.executor, progress=setup.progress,
        title=title, describe=_no_words,
    )  # fmt: skip
    drawn, stats = stack(chains)
    iterates = drawn["theta"]
    interrupted = any(c.interrupted for c in chains)
    first = min(left_out, iterates.shape[1] - 1)
    pooled = pool(setup, iterates[:, first:], by_regression)
    report: dict[str, Any] = {"converged": None}
    if not np.isnan(pooled.drift) and not interrupted:
        moving = pooled.drift > DRIFT and pooled.how == "mean"
        report = {"converged": not moving, "drift": pooled.drift}
        if moving:
            report["stopped"] = (
                f"the iterates still drift ({pooled.drift:.1f} standard errors from the first to "
                "the second half): give more iterations"
            )
    report["estimate"] = (
        f"{pooled.how} of iterations {first + 1} to {iterates.shape[1]} of {len(chains)} chains"
    )
    return Chains(pooled, iterates.mean(axis=0), stats, interrupted, report)


def _no_words(recent: Sequence[Any]) -> str:
    return ""


@dataclass(frozen=True)
class Pooled:
    """An estimate from the iterates of R chains.

    theta : (P,). error : (P, P) its Monte Carlo covariance, from how the chains differ; None for
    one chain. drift : the largest difference between the later and the earlier half of the
    iterates, in its standard errors; nan for one chain. how : mean, or fixed point.
    """

    theta: np.ndarray
    error: np.ndarray | None
    drift: float
    how: str


def pool(setup: Maximization, iterates: np.ndarray, by_regression: bool = False) -> Pooled:
    """One estimate from iterates (R, K, P), on the unconstrained scale.

    by_regression : the fixed point of the regression of iterates on those before, instead of their
    mean.
    """
    free = [s for s in setup.problem.trace.parameter_symbols if s.data[1] not in setup.fixed]
    to_z = Unconstrained(setup.problem.trace, free)
    z = np.array([[to_z(theta) for theta in chain] for chain in iterates])
    chains = len(z)
    centre, how = z.mean(axis=(0, 1)), "mean"
    if chains == 1:
        return Pooled(setup.transform.at(centre).theta, None, np.nan, how)
    left_out = [np.delete(z, r, axis=0) for r in range(chains)]
    points = np.array([some.mean(axis=(0, 1)) for some in left_out])
    if by_regression:
        limit = fixed_point(z)
        limits = [fixed_point(some) for some in left_out]
        found = [x for x in limits if x is not None]
        if limit is not None and len(found) == chains:
            centre, points, how = limit, np.array(found), "fixed point of the regression"
    off = points - points.mean(axis=0)
    spread = (chains - 1.0) / chains * off.T @ off
    half = z.shape[1] // 2
    change = z[:, -half:].mean(axis=1) - z[:, :half].mean(axis=1) if half else 0.0 * z[:, 0]
    error = change.std(axis=0, ddof=1) / np.sqrt(chains)
    with np.errstate(invalid="ignore", divide="ignore"):
        drift = np.nanmax(np.abs(change.mean(axis=0)) / error, initial=0.0)
    point = setup.transform.at(centre)
    return Pooled(point.theta, point.jacobian @ spread @ point.jacobian.T, float(drift), how)


def fixed_point(z: np.ndarray) -> np.ndarray | None:
    """(F,) where the regression z_{k+1} = c + B z_k + noise over chains (R, K, F) comes to rest.

    None where it does not come to rest, or where there are too few iterates to tell.
    """
    before, after = z[:, :-1].reshape(-1, z.shape[2]), z[:, 1:].reshape(-1, z.shape[2])
    f = z.shape[2]
    if len(before) < 10 * f:
        return None
    centre = before.mean(axis=0)
    slope, *_ = np.linalg.lstsq(before - centre, after - after.mean(axis=0), rcond=None)
    if np.abs(np.linalg.eigvals(slope)).max() >= 1.0:
        return None
    return centre + np.linalg.solve(np.eye(f) - slope.T, after.mean(axis=0) - centre)
