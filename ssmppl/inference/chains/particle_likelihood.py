"""Particle filters as likelihoods for Metropolis-Hastings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.kernels.conditional_smc import draw_index
from ssmppl.codegen.kernels.genealogy import ancestral_path
from ssmppl.codegen.kernels.random import fill_normal, uniform
from ssmppl.codegen.kernels.weights import NO_POINT, OK
from ssmppl.codegen.metropolis import (
    NumberedFilter,
    ScoredFilter,
    numbered_filter,
    scored_filter,
)
from ssmppl.compiling import once_property
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains.walk import Point, Run
from ssmppl.inference.particles.filtering import FilterSettings, failure, run_filter
from ssmppl.inference.particles.marginal import draw_given
from ssmppl.inference.particles.pilot import Space
from ssmppl.inference.problem import Problem
from ssmppl.inference.totals import total_of


@dataclass(frozen=True)
class ParticleLikelihood:
    """An independent run of the particle filter for every point. states : whether draws keep its
    paths."""

    problem: Problem
    settings: FilterSettings
    states: bool = True

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        if self.settings.rescue:
            return self._rescued(theta, stream)
        entry = self.problem.program.entry(f"filtered_path_{self.settings.proposal}")
        carried = len(self.problem.program.carried(self.settings.proposal))
        total, paths, increments = 0.0, [], []
        for e in self.problem.experiments:
            path = np.empty((e.steps, carried))
            increment = np.empty(e.steps)
            status, t, log_z = entry(
                theta, e.y, e.seen, e.u, self.settings.particles, stream, path, increment
            )
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            total += log_z
            paths.append(path)
            increments.append(increment)
        return Run(total, tuple(paths), tuple(increments))

    def _rescued(self, theta: np.ndarray, stream: np.ndarray) -> Run | None:
        """By the alive particle filter; Del Moral et al. (2015), section 4, on its use here."""
        carried = len(self.problem.program.carried(self.settings.proposal))
        total, paths, increments, n = 0.0, [], [], self.settings.particles
        for e in self.problem.experiments:
            path, increment, ess = (
                np.empty((e.steps, carried)),
                np.empty(e.steps),
                np.empty(e.steps),
            )
            particles, weights = np.empty((e.steps, carried, n)), np.empty((e.steps, n))
            kept = particles, weights, np.zeros((e.steps, n), dtype=np.int32)
            status, t = run_filter(
                self.problem, theta, self.settings, e, stream, increment, ess, kept=kept
            )
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            ancestral_path(particles, kept[2], draw_index(weights[-1], uniform(stream)), path)
            total += total_of(increment)
            paths.append(path)
            increments.append(increment)
        return Run(total, tuple(paths), tuple(increments))

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        return kept_of(point, self.states)


@dataclass(frozen=True)
class MarginalLikelihood(ParticleLikelihood):
    """A Rao-Blackwellised filter; what it integrates out is drawn for the kept draws."""

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        found = kept_of(point, self.states)
        for i, e in enumerate(self.problem.experiments):
            path = point.run.paths[i][None]
            # drawn even where it is left out, so that the chain is the same with and without
            drawn = draw_given(self.problem, e, point.theta, path, stream)[0]
            if self.states:
                found[f"path_{i}"] = drawn
        return found


class _WithFilter:
    """Leaves the compiled filter out when it is sent to another process, which makes its own."""

    def __getstate__(self) -> dict:
        return {name: value for name, value in self.__dict__.items() if name != "filter"}


@dataclass(frozen=True)
class ScoredLikelihood(_WithFilter):
    """A particle filter that estimates score and information too, zero for fixed parameters.

    wanted : positions in theta of the free parameters. second : whether the information is wanted.
    """

    problem: Problem
    settings: FilterSettings
    lag: int
    wanted: tuple[int, ...]
    second: bool
    states: bool = True

    @once_property
    def filter(self) -> ScoredFilter:
        program, name = self.problem.program, self.settings.proposal
        symbols = [self.problem.trace.parameter_symbols[i] for i in self.wanted]
        made = scored_filter(program, self.problem.proposal(name), symbols, self.second)
        if isinstance(made, NotApplicable):
            raise ArgumentError(
                f"order={2 if self.second else 1} does not apply: {made.reason}",
                fix="use ssm.PMMH(order=0)",
                where=made.where,
            )
        return made

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        entry, p = self.filter.module.filter_with_score, len(self.wanted)
        total, paths, increments = 0.0, [], []
        slope, curvature = np.zeros(p), np.zeros((p, p))
        for e in self.problem.experiments:
            path = np.empty((e.steps, len(self.problem.trace.state_symbols)))
            increment, own_slope, own = np.empty(e.steps), np.empty(p), np.zeros((p, p))
            status, t, log_z = entry(
                theta, e.y, e.seen, e.u, self.settings.particles, stream, path, increment,
                self.lag, own_slope, own,
            )  # fmt: skip
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            total += log_z
            slope += own_slope
            curvature += own
            paths.append(path)
            increments.append(increment)
        score, information = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        score[list(self.wanted)] = slope
        information[np.ix_(self.wanted, self.wanted)] = curvature
        return Run(total, tuple(paths), tuple(increments), score, information)

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        return kept_of(point, self.states)


@dataclass(frozen=True)
class CorrelatedLikelihood(_WithFilter):
    """A particle filter on random numbers that move by v' = rho v + sqrt(1 - rho^2) e.

    The move leaves the normal law of the numbers invariant and is reversible, so that they may be
    part of the chain's state (Deligiannidis, Doucet and Pitt 2018, section 2.2).
    """

    problem: Problem
    settings: FilterSettings
    correlation: float
    states: bool = True

    @once_property
    def filter(self) -> NumberedFilter:
        program, name = self.problem.program, self.settings.proposal
        made = numbered_filter(program, self.problem.proposal(name))
        if isinstance(made, NotApplicable):
            raise ArgumentError(
                f"correlation={self.correlation} does not apply: {made.reason}",
                fix="use ssm.PMMH(correlation=0.0)",
                where=made.where,
            )
        return made

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        old = None if before is None else before.numbers
        total, paths, increments, numbers = 0.0, [], [], []
        made, n = self.filter, self.settings.particles
        for i, e in enumerate(self.problem.experiments):
            fresh = [(e.steps, made.normals * n), (e.steps, made.uniforms * n), (e.steps + 1,)]
            own = [self._moved(shape, None if old is None else old[i][k], stream)
                   for k, shape in enumerate(fresh)]  # fmt: skip
            path = np.empty((e.steps, len(self.problem.trace.state_symbols)))
            increment = np.empty(e.steps)
            status, t, log_z = made.module.correlated_path(
                theta, e.y, e.seen, e.u, n, *own, path, increment
            )
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            total += log_z
            paths.append(path)
            increments.append(increment)
            numbers.append(own)
        return Run(total, tuple(paths), tuple(increments), numbers=numbers)

    def _moved(
        self, shape: tuple[int, ...], old: np.ndarray | None, stream: np.ndarray
    ) -> np.ndarray:
        new = np.empty(int(np.prod(shape)))
        if new.size:
            fill_normal(stream, new)
        if old is None:
            return new.reshape(shape)
        rho = self.correlation
        return rho * old + np.sqrt(1.0 - rho * rho) * new.reshape(shape)

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        return kept_of(point, self.states)


def kept_of(point: Point, states: bool) -> dict[str, np.ndarray]:
    """The increments of the run and, of the states, its path, by the names of the draws."""
    named = {f"path_{i}": path for i, path in enumerate(point.run.paths if states else ())}
    return named | {f"increment_{i}": v for i, v in enumerate(point.run.increments)}


def run_filters(
    space: Space, theta: np.ndarray, settings: FilterSettings, stream: np.ndarray
) -> tuple[float, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """(log Z, paths, increments) of all experiments; -inf where the estimate is zero."""
    run = ParticleLikelihood(space.problem, settings).run(theta, None, stream)
    return (-np.inf, (), ()) if run is None else (run.log_likelihood, run.paths, run.increments)
