"""Maximum likelihood by way of the Gaussian approximation, corrected by the twisted filter.

First Newton's ascent of Laplace's log-likelihood L (Kristensen, Nielsen, Berg, Skaug and Bell 2016,
"TMB: automatic differentiation and Laplace approximation"), which is smooth and takes a
millisecond. What it lacks, log Z - L, is estimated by twisted particle filters with common random
numbers, seed by seed, at the ends of the ellipsoid of one standard deviation round its top: there
it is small and nearly straight. Its slopes move the top and its curvature the information, until
the top rests. The slopes' scatter over the seeds gives the estimate's Monte Carlo error.

Where a transition or an observation has corners, as dry friction, a stop or a dead zone makes them,
the likeliest trajectory leans against them, and Laplace's L has jumps in the parameters. The
extended Kalman filter's, which linearises about each filtered mean, has fewer and smaller ones: it
is L there, and its differences are taken over a standard deviation too, so that they go out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.codegen.modules.twisted import TwistedFilter
from ssmppl.codegen.store.beforehand import beforehand
from ssmppl.errors import ArgumentError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import bends
from ssmppl.expressions.expr import dependent, symbols_of
from ssmppl.inference.gaussian.likelihood import ExtendedLikelihood, LaplaceLikelihood, use_mode
from ssmppl.inference.maximum.ascent import Ascent, Maximization
from ssmppl.inference.maximum.edges import Edges, edges
from ssmppl.inference.methods.methods import DirectOptimization
from ssmppl.inference.optimisation.newton import (
    GOOD,
    Top,
    climb,
    climb_by_slope,
    information_at,
    information_by_slope,
)
from ssmppl.inference.particles.filtering import log_of_mean
from ssmppl.inference.preparation.pilot import explained, finite_point
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model.trace import Trace

REACH = 1.0  # standard deviations by which the points lie off the top
FINE = 0.02  # and those of the differences that give the slope of L
ROUNDS = 8
WIDENINGS = 3  # of the differences for the information, where the likelihood jumps
FAR = 0.5  # standard deviations of a step after which the information is looked at again
LEAST_CURVATURE = 0.25  # of the likelihood, in that of L
HALVINGS, TOLERANCE = 8, 1e-6  # of a step that leads downhill; nats that do not count
RESTS = 0.1  # steps, in Monte Carlo errors and in standard deviations, with which the top rests
LEAST = 0.01
PRECISE = 0.2  # sd of log Z that is aimed at, by more particles
HOPELESS = 1.5  # and from which there is no correction
FEWEST = 50  # particles
KNOWN = 1e-4  # information in z from which a direction is looked into: a standard error of 100
FURTHER = 2  # starts more, where a climb has not come to a top
CONVERGED = 1.0  # nats that a rest is worth, beside a height that is estimated

Approximate = LaplaceLikelihood | ExtendedLikelihood


def climb_gaussian(
    setup: Maximization, method: DirectOptimization, found: GaussianApproximation
) -> Ascent:
    """The ascent by Laplace's log-likelihood, by the extended Kalman filter's where that comes to
    no top; with corners by the filter's first, by Laplace's where that is not corrected. Where both
    are left, the higher end.

    Raises
    ------
    ArgumentError : neither is finite at any point tried for a start.
    """
    problem = setup.problem
    order: list[Approximate] = [
        LaplaceLikelihood(problem, found), ExtendedLikelihood(problem, found)
    ]  # fmt: skip
    bent = has_corners(problem.trace)
    if bent:  # which makes Laplace's slow to fail
        order.reverse()
    ends: list[tuple[float, Ascent]] = []
    for approximate in order:
        one = GaussianClimb(setup, method, approximate)
        try:
            end = one.run()
        except ArgumentError:
            if approximate is order[-1] and not ends:
                raise
            continue
        corrected = end.report["converged"] and end.log_likelihood is not None
        if end.interrupted or corrected or (one.arrived and not bent):
            return end
        ends.append((_height(setup, one, end), end))
    return max(ends, key=lambda pair: pair[0])[1]


def _height(setup: Maximization, climb: GaussianClimb, end: Ascent) -> float:
    """What the objective is at the end, by the approximation where it was not corrected."""
    if end.log_likelihood is None:
        return climb.best_value
    prior = setup.log_prior(setup.space_at(end.theta))
    return end.log_likelihood + prior + CONVERGED * bool(end.report["converged"])


def has_corners(trace: Trace) -> bool:
    """Whether a transition or an observation depends on states by corners or jumps."""
    sites = [*trace.transition.values(), *trace.observations.values()]
    roots = [e for s in sites for a in s.distribution.parameters.values() for e in array(a).ravel()]
    moving = [s for s in symbols_of(roots) if s.data[0] in ("state", "state_prev")]
    return any(map(bends, dependent(roots, moving)))


class GaussianClimb:
    """Ascent of an approximate log-likelihood, and its correction.

    arrived : whether `run` came to a top of it.

    Raises
    ------
    ArgumentError : the approximation is not finite at every point tried for a start.
    """

    def __init__(self, setup: Maximization, method: DirectOptimization, approximate: Approximate):
        self.setup, self.method, self.approximate = setup, method, approximate
        self.arrived = False
        self.evaluations = 0
        self.best, self.best_value = np.empty(0), -np.inf  # of all points looked at
        self.iterates: list[np.ndarray] = []

    def run(self) -> Ascent:
        """Both. Ctrl-C ends it early, with the best so far."""
        try:
            with beforehand(*self._later()):
                top, started = self._climbed()
                information = self.information(top.z)
        except KeyboardInterrupt:
            if not len(self.best):
                raise
            self.iterates.append(self._theta(self.best))
            report: dict[str, Any] = {"converged": False, "evaluations": self.evaluations}
            return self._interrupted(self.best, None, report)
        self.iterates.append(self._theta(top.z))
        report = {
            "converged": top.distance < GOOD, "evaluations": self.evaluations,
            "likelihood": self.approximate.title, "restarts": started - 1,
        }  # fmt: skip
        self.arrived = bool(report["converged"] and np.all(np.isfinite(information)))
        if not np.all(np.isfinite(information)):
            return self._uncorrected(top.z, None, report, "it has no second derivatives at its top")
        held = None
        if np.linalg.eigvalsh(information)[0] < KNOWN:
            held = self._edges(top.z, information)
            if held is None:
                return self._uncorrected(top.z, None, report, "its top is flat")
            information[~held.kept, :] = information[:, ~held.kept] = 0.0
            report["converged"] = self._rests(top.z, information)
        twisted = self.setup.problem.program.twisted
        if not isinstance(twisted, TwistedFilter):
            return self._uncorrected(top.z, information, report, twisted.reason)
        try:
            found = _Correction(self, top.z, information).run()
        except KeyboardInterrupt:
            return self._interrupted(top.z, information, report)
        if isinstance(found, str):
            return self._uncorrected(top.z, information, report, found)
        report |= {
            "converged": report["converged"] and found.rests, "evaluations": self.evaluations,
            "likelihood": f"{self.approximate.title}, corrected by twisted particle filters with "
            f"common random numbers ({found.particles} particles, {self.method.averages} seeds)",
            "log_likelihood_error": found.value_error,
            "approximate_log_likelihood": found.approximate,
        }  # fmt: skip
        self.iterates.append(self._theta(found.z))
        return Ascent(
            self._theta(found.z), found.value, np.array(self.iterates), report,
            self._natural(found.z, found.information),
            self.setup.natural_error(found.z, found.error), held=held,
        )  # fmt: skip

    def _later(self) -> tuple[Callable[[], object], ...]:
        """What the climb comes to, and its correction, for another process to compile."""
        problem, theta = self.setup.problem, self.setup.space.theta
        calls: list[Callable[[], object]] = []
        if isinstance(self.approximate, LaplaceLikelihood):
            calls.append(partial(use_mode, problem, theta))
        if isinstance(problem.program.twisted, TwistedFilter):
            sets = range(len(problem.experiments))
            streams = [random_state(np.random.SeedSequence(0), i) for i in sets]
            nowhere = [None for _ in sets]
            calls.append(partial(twisted_log_z, problem, FEWEST, [streams], nowhere, theta))
        return tuple(calls)

    def _edges(self, z: np.ndarray, information: np.ndarray) -> Edges | None:
        """Which parameters are at an edge of their support, with information about all others;
        None where there is nothing known of some that is not."""
        held = edges(self.setup, self._theta(z), self._natural(z, information), self.objective)
        if held is None or not held.kept.any() or held.moving:
            return None
        rest = information[np.ix_(held.kept, held.kept)]
        return held if np.linalg.eigvalsh(rest)[0] > KNOWN else None

    def _rests(self, z: np.ndarray, information: np.ndarray) -> bool:
        """Whether the quadratic expects next to nothing in the directions of which it knows."""
        slope = self.slope(z)[1] if self.approximate.differentiable else np.full(len(z), np.nan)
        along = slope @ axes_of(information)
        return bool(0.5 * along @ along < GOOD)

    def objective(self, z: np.ndarray) -> float:
        """The approximate log-likelihood at z (F,), with the prior where it counts."""
        value = self.log_likelihood(z)
        if value > -np.inf:
            value += self.setup.log_prior(z)
        if value > self.best_value:
            self.best, self.best_value = np.array(z), value
        return value

    def slope(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """The objective and its gradient (F,) at z; NaN where that is none."""
        self.evaluations += 1
        point = self.setup.transform.at(z)
        if point.log_prior == -np.inf:
            return -np.inf, np.full(len(z), np.nan)
        value, gradient = self.approximate.score(point.theta)
        slope = point.pull(gradient)
        if self.setup.with_prior:
            value, slope = value + point.log_prior, slope + point.d_log_prior
        if value > self.best_value:
            self.best, self.best_value = np.array(z), value
        return value, slope

    def information(self, z: np.ndarray) -> np.ndarray:
        """(F, F) minus the second derivatives of the objective at z (F,); NaN where there are
        none."""
        if self.approximate.differentiable:
            found = information_by_slope(self.slope, z)
            if np.all(np.isfinite(found)):
                return found
        found = information_at(self.objective, z)
        for _ in range(WIDENINGS if self.approximate.jumps else 0):
            found = self._over_a_deviation(z, found)
        return found

    def _over_a_deviation(self, z: np.ndarray, information: np.ndarray) -> np.ndarray:
        """The same by differences over about one standard deviation, as differences over less take
        a jump for a bend; as it was where that makes no top."""
        if not np.all(np.isfinite(information)) or np.linalg.eigvalsh(information)[0] < KNOWN:
            return information
        axes = axes_of(information)
        steps, n = REACH * axes.T, len(z)
        here, bent = self.objective(z), np.zeros((n, n))
        for i in range(n):
            bent[i, i] = self.objective(z + steps[i]) - 2.0 * here + self.objective(z - steps[i])
            for j in range(i):
                signs = ((1, 1), (-1, -1), (1, -1), (-1, 1))
                f = [self.objective(z + a * steps[i] + b * steps[j]) for a, b in signs]
                bent[i, j] = bent[j, i] = (f[0] + f[1] - f[2] - f[3]) / 4.0
        inverse = np.linalg.inv(axes)
        found = -inverse.T @ bent @ inverse / REACH**2
        well = np.all(np.isfinite(found)) and np.linalg.eigvalsh(found)[0] > KNOWN
        return found if well else information

    def log_likelihood(self, z: np.ndarray) -> float:
        """The approximation's; -inf off the support."""
        self.evaluations += 1
        theta, log_prior = self.setup.space.parameters(z)
        return self.approximate(theta) if log_prior > -np.inf else -np.inf

    def _theta(self, z: np.ndarray) -> np.ndarray:
        return self.setup.space.parameters(z)[0].copy()

    def _climb(self, z: np.ndarray) -> Top | None:
        """The top near z (F,): by the gradient, where that gets there."""
        found = None
        if self.approximate.differentiable:
            found = climb_by_slope(self.slope, z)
            if found is not None and found.distance < GOOD and found.is_top:
                return found
        return climb(self.objective, z if found is None else found.z)

    def _climbed(self) -> tuple[Top, int]:
        """The highest top of the starts, and how many there were."""
        given = self.setup.space.z[self.setup.space.positions]
        rng = np.random.default_rng(self.setup.seed(0))
        try:
            start = finite_point(given, self.objective, rng)
        except ArgumentError as error:
            raise explained(error, self.setup.space) from None
        most = FURTHER if self.method.restarts is None else self.method.restarts
        best, k = self._climb(start), 1
        while k <= most:
            arrived = best is not None and best.distance < GOOD
            if arrived and self.method.restarts is None:
                break
            centre = start if best is None else best.z
            self.approximate.forget()
            there = finite_point(centre + rng.standard_normal(len(start)), self.objective, rng)
            found = self._climb(there)
            if found is not None and (best is None or found.value > best.value):
                best = found
            k += 1
        if best is None:
            raise ArgumentError(
                f"{self.approximate.title} is not finite (NaN or infinite) at every point tried",
                fix="give start={name: value} near plausible values",
            )
        return best, k

    def _uncorrected(
        self, z: np.ndarray, information: np.ndarray | None, report: dict[str, Any], why: str
    ) -> Ascent:
        """The top of the approximation, called one."""
        report |= {
            "likelihood": f"{self.approximate.title}, not corrected: {why}",
            "approximate": True,
        }
        natural = None if information is None else self._natural(z, information)
        return Ascent(self._theta(z), None, np.array(self.iterates), report, natural)

    def _interrupted(
        self, z: np.ndarray, information: np.ndarray | None, report: dict[str, Any]
    ) -> Ascent:
        return replace(self._uncorrected(z, information, report, "interrupted"), interrupted=True)

    def _natural(self, z: np.ndarray, information: np.ndarray) -> np.ndarray:
        """(P, P) information of the likelihood alone in theta, from that of the objective in z."""
        if self.setup.with_prior:
            nothing = np.zeros(len(self.setup.space.theta))
            information = information + self.setup.transform.curvature(z, nothing).log_prior
        return self.setup.natural(z, information)


@dataclass(frozen=True)
class _Corrected:
    """z (F,), information and Monte Carlo covariance (F, F) there; log-likelihood with its error,
    and the approximate one; particles of the filters; whether the top rests."""

    z: np.ndarray
    information: np.ndarray
    error: np.ndarray
    value: float
    value_error: float
    approximate: float
    particles: int
    rests: bool


class _Correction:
    """The steps from the maximum of L to that of the likelihood.

    z : (F,) where L has its top, information (F, F) minus its second derivatives there.
    """

    def __init__(self, climb: GaussianClimb, z: np.ndarray, information: np.ndarray):
        self.climb, self.z, self.information = climb, z, information
        self.axes = axes_of(information)
        self.particles = FEWEST
        self.root = climb.setup.seed(9)

    def run(self) -> _Corrected | str:
        """The corrected top; why there is none, where there is none."""
        middle = self._enough_particles()
        if isinstance(middle, str):
            return middle
        rests, far = False, False
        for _ in range(ROUNDS):
            if far:  # the ellipsoid is another one there
                self.information = self.climb.information(self.z)
                if not np.all(np.isfinite(self.information)):
                    return "its second derivatives are not finite on the way"
                self.axes = axes_of(self.information)
            smooth, own, lacking, spread, bend = self._slopes(middle)
            slope = smooth + lacking
            if not (np.all(np.isfinite(slope)) and np.all(np.isfinite(bend))):
                return "the particle filter is not finite one standard deviation from its maximum"
            curvature = np.maximum(own - bend, LEAST_CURVATURE)
            step = slope / curvature
            step *= self._share(step, lacking, bend)
            self.z = self.z + self.axes @ step
            (middle,) = self._log_z(self.z)
            errors = np.sqrt(np.diagonal(spread)) / curvature
            if np.all(np.abs(step) < np.maximum(RESTS * errors, LEAST)):
                rests = bool(np.all(np.abs(slope / curvature) < np.maximum(RESTS * errors, LEAST)))
                break
            far = bool(np.linalg.norm(step) > FAR)
        value, value_error = log_of_mean(middle)
        inverse = np.linalg.pinv(self.axes)
        information = self.information - inverse.T @ np.diag(bend + 1.0 - own) @ inverse
        scaled = self.axes / curvature
        error = scaled @ (spread + np.outer(step, step)) @ scaled.T
        return _Corrected(
            self.z, information, error, value, value_error,
            self.climb.log_likelihood(self.z), self.particles, rests,
        )  # fmt: skip

    def _share(self, step: np.ndarray, lacking: np.ndarray, bend: np.ndarray) -> float:
        """How much of a step is taken: no further than one standard deviation, and not downhill,
        with L itself and what it lacks as it was measured. 0 where all of it leads down."""
        share = min(1.0, REACH / max(float(np.linalg.norm(step)), REACH))
        if self.climb.approximate.jumps:
            return share
        here = self.climb.objective(self.z)
        for _ in range(HALVINGS):
            s = share * step
            there = self.climb.objective(self.z + self.axes @ s)
            if there + lacking @ s + 0.5 * bend @ s**2 > here - TOLERANCE:
                return share
            share *= 0.5
        return 0.0

    def _enough_particles(self) -> np.ndarray | str:
        """(K,) log Z at the top by so many particles that their scatter is small."""
        while True:
            (found,) = self._log_z(self.z)
            scatter = float(np.std(found, ddof=1)) if np.all(np.isfinite(found)) else np.inf
            if scatter < PRECISE or self.particles >= self.climb.method.particles:
                break
            self.particles = min(4 * self.particles, self.climb.method.particles)
        if not np.isfinite(scatter):
            return "the particle filter is not finite at its maximum"
        if scatter > HOPELESS:
            return (
                f"the sd of log Z is {scatter:.2g} with twisted particle filters of "
                f"{self.particles} particles"
            )
        return found

    def _log_z(self, *points: np.ndarray) -> np.ndarray:
        """(points, K) log Z of the seeds at each z."""
        setup = self.climb.setup
        inside = [setup.space.parameters(z) for z in points]
        seeds = [
            [random_state(self.root, k, i) for i in range(len(setup.problem.experiments))]
            for k in range(self.climb.method.averages)
        ]
        near = [None if mode is None else mode.e for mode in self.climb.approximate.modes]
        task = partial(twisted_log_z, setup.problem, self.particles, seeds, near)
        out = np.full((len(points), len(seeds)), -np.inf)
        there = [i for i, (_, log_prior) in enumerate(inside) if log_prior > -np.inf]
        found = run_tasks(task, [inside[i][0].copy() for i in there], executor=setup.executor)
        for i, log_z in zip(there, found, strict=True):
            out[i] = log_z
        return out

    def _slopes(self, middle: np.ndarray) -> tuple[np.ndarray, ...]:
        """In units of the axes, (N,): the slope of L with the prior, and minus its second
        derivatives; the slope of log Z - L, with its covariance (N, N) over the seeds; and its
        second derivatives."""
        climb, k, n = self.climb, len(middle), self.axes.shape[1]
        weight = np.exp(middle - middle.max())
        weight /= weight.sum()
        here = middle - climb.log_likelihood(self.z)
        steps = REACH * self.axes.T
        points = [*(self.z + steps), *(self.z - steps)]
        lacking = self._log_z(*points) - np.array([[climb.log_likelihood(z)] for z in points])
        up, down = lacking[:n], lacking[n:]
        slopes, bends = (up - down) / (2.0 * REACH), (up + down - 2.0 * here) / REACH**2
        smooth, own = self._of_approximation()
        mean = slopes @ weight
        off = weight * (slopes - mean[:, None])
        return smooth, own, mean, off @ off.T * k / (k - 1), bends @ weight

    def _of_approximation(self) -> tuple[np.ndarray, np.ndarray]:
        """(N,) the slope of L with the prior, in units of the axes, and minus its second
        derivatives: those that made the axes; where L has jumps both over one standard deviation,
        as those of log Z - L are, from which they then go out."""
        climb, ones = self.climb, np.ones(self.axes.shape[1])
        if climb.approximate.jumps:
            wide = REACH * self.axes.T
            here = climb.objective(self.z)
            up, down = (np.array([climb.objective(self.z + sign * s) for s in wide])
                        for sign in (1.0, -1.0))  # fmt: skip
            return (up - down) / (2.0 * REACH), (2.0 * here - up - down) / REACH**2
        if climb.approximate.differentiable:
            _, slope = climb.slope(self.z)
            if np.all(np.isfinite(slope)):
                return slope @ self.axes, ones
        fine = FINE * self.axes.T
        values = [[climb.objective(self.z + sign * s) for sign in (1.0, -1.0)] for s in fine]
        return np.array([(up - down) / (2.0 * FINE) for up, down in values]), ones


def axes_of(information: np.ndarray) -> np.ndarray:
    """(F, N) one standard deviation along each eigenvector of which something is known."""
    values, vectors = np.linalg.eigh(information)
    known = values > KNOWN
    return vectors[:, known] / np.sqrt(values[known])


def twisted_log_z(
    problem: Problem, particles: int, seeds: Sequence[Sequence[np.ndarray]],
    near: Sequence[np.ndarray | None], theta: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(K,) log Z at theta (P,) by the twisted filter, for each seed's streams.

    near : by experiment the noise (T, R') of a mode at another theta, from which that of this one
        is looked for, which the guide goes by.
    """
    twisted = problem.program.twisted
    assert isinstance(twisted, TwistedFilter)
    run = twisted.module.filter_twisted
    out = np.zeros(len(seeds))
    for i, e in enumerate(problem.experiments):
        given = theta, e.y, e.seen, e.u
        mode = None if near[i] is None else twisted.gaussian.laplace(*given, near[i])
        guided = twisted.guide(*given, e=None if mode is None else mode.e)  # the same for all
        increments, ess = np.empty(e.steps), np.empty(e.steps)
        for k, streams in enumerate(seeds):
            status, _ = run(
                theta, e.y, e.seen, guided, particles, None, 1.0, streams[i].copy(), increments,
                ess, None, None,
            )  # fmt: skip
            # A weight that is infinite or no number, too, makes the point none.
            out[k] = out[k] + total_of(increments) if status == OK else -np.inf
    return out
