"""Fits of a model and of its augmentations: the mode of the posterior.

Models are climbed by the extended Kalman filter's log-likelihood where there is one, which is
smooth and takes a millisecond. For linear Gaussian models it is exact; where that climb does not
end at its top, and from starts that nothing is known of, they are climbed with their exact score.
Others are climbed from several starts, and from there by the particle smoother's score. How far the
top still is is measured in nats: g' H^-1 g / 2 is what a quadratic would still gain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.compiling import once_property
from ssmppl.data import Experiment, unpack_parameters
from ssmppl.diagnosis.fitting.bounds import flat_outwards, hold_at_bounds
from ssmppl.diagnosis.fitting.densities import (
    best_of_many,
    densities_of,
    density_of,
    one_by_one,
)
from ssmppl.diagnosis.fitting.information import not_inflated, positive_definite
from ssmppl.diagnosis.fitting.noisy_ascent import NEAR, stochastic_quasi_newton
from ssmppl.diagnosis.fitting.scoring import climb_by_scoring
from ssmppl.diagnosis.model.initial_law import InitialStateMeans, ProperInitialLaw
from ssmppl.diagnosis.model.score_columns import ScoreExpressions, score_columns
from ssmppl.diagnosis.model.simulated_records import Simulator
from ssmppl.diagnosis.model.smoothing import Pass, Settings, Smoother
from ssmppl.diagnosis.run.expected_time import timed
from ssmppl.diagnosis.run.seeds import Stream
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.batched.call import thriftily
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.batched.extended import Extended, extended_model
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.inference.maximum.ascent import Maximization, UnconstrainedTransform
from ssmppl.inference.maximum.direct_optimization import climb as climb_exactly
from ssmppl.inference.maximum.direct_optimization import observed_information
from ssmppl.inference.methods.methods import DirectOptimization
from ssmppl.inference.optimisation.batched_newton import climb_together
from ssmppl.inference.optimisation.batched_newton import information_at as information_of_many
from ssmppl.inference.optimisation.newton import (
    GOOD,
    Top,
    climb,
    information_at,
)
from ssmppl.inference.optimisation.parts import Increments, Parts, Predictions, parts_of, summed
from ssmppl.inference.particles.backward import particle_system
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.preparation.pilot import climb_to_mode
from ssmppl.inference.preparation.space import Space, at, space_of
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model.transforms import transforms

# Climbs.
NOISE_SHARES = (1.0, 0.3, 0.1)  # of the transition's noise, from which climbs start
ASTRAY = 3.0  # nats that the climb of the approximation may cost by the particle filter
SCORED = 0.05  # nats that a climb by scoring may leave

# Likelihoods and information by simulation.
PILOT_PARTICLES = 300
PRECISE, DOUBLINGS = 0.2, 2  # nats: error of a log-likelihood for which particles are doubled
TOGETHER = 16  # points that are timed, where many are looked at in one call
INFORMATION_SETS = 24  # simulated data sets behind a first information matrix
LEAST_INFORMATION = 1e-10  # least eigenvalue of the scaled information that is more than rounding
LARGEST = 1e100  # of a score: what is beyond is an overflow

NUMBERS = (  # of a fit, in a checkpoint
    "theta", "z", "log_likelihood", "error", "information", "distance", "converged", "at_bound",
)  # fmt: skip


@dataclass(frozen=True)
class Effort:
    """Settings of a fit: how much is done for it.

    pilot : look for a better start around the one that is given. standard_errors : of linear
    Gaussian models alone, whose information takes derivatives of its own: climb to the very top,
    and take the information there; else climb to within what a decision needs, and there is none
    (NaN). All other fits have the one that their climb has used or built up, either way.
    approximate : the top of the extended Kalman filter's likelihood will do, where there is one,
    for what is fitted many times. levels : from how many levels of the process noise it is climbed,
    the largest that of the start.
    """

    pilot: bool = True
    standard_errors: bool = True
    approximate: bool = False
    levels: int = len(NOISE_SHARES)


FROM_START = Effort(pilot=False)
WITHOUT_ERRORS = Effort(pilot=False, standard_errors=False)
APPROXIMATELY = Effort(pilot=False, standard_errors=False, approximate=True, levels=1)
FROM_NEARBY = Effort(pilot=False, standard_errors=False, levels=1)


@dataclass(frozen=True)
class Fit:
    """A model fitted to experiments (P parameters, F free numbers on the unconstrained scale).

    theta : (P,). z : (F,). log_likelihood : at theta; error : its Monte Carlo standard deviation,
    0 where exact. information : (F, F), minus the Hessian in z of log p(y | theta) + log prior
    density of theta (no Jacobian), approximate unless `with_information` was called; NaN or
    meaningless where at_bound.
    distance : nats from the top by the last score. converged : whether that is a small number.
    at_bound : (F,) bool, which numbers ran to a bound of their support, where they are held: they
    are left out of the information (`bounds`).
    """

    space: Space
    theta: np.ndarray
    z: np.ndarray
    log_likelihood: float
    error: float
    information: np.ndarray
    distance: float
    converged: bool
    at_bound: np.ndarray

    @property
    def bounds(self) -> list[str]:
        """Components that ran to a bound of their support, by their text."""
        return component_names(self.space, self.at_bound)

    @property
    def problem(self) -> Problem:
        return self.space.problem

    @property
    def by_component(self) -> dict[str, float]:
        """Values by the text of each component, `k`, `beta[0]`."""
        symbols = self.problem.trace.parameter_symbols
        return {repr(s): float(v) for s, v in zip(symbols, self.theta, strict=True)}

    @property
    def by_parameter(self) -> dict[str, np.ndarray]:
        """Values by the name of each parameter, as of another fit's `start`."""
        return dict(unpack_parameters(self.problem.trace, self.theta))

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """All that a checkpoint has to keep; see `Fitter.restored`."""
        return {n: np.asarray(getattr(self, n)) for n in NUMBERS}


def standard_errors(fit: Fit, fixed: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Standard errors by the text of each component, from `Fit.information`; 0 for what is fixed.

    In a report "before" is of the model's own fit as it came: of a linear Gaussian model from the
    exact second derivatives; of others from those of the extended Kalman filter's likelihood where
    its top was kept, else from the matrix that the climb built up. "after" is of the chosen model,
    `Fitter.with_information` called (`add_standard_errors`): from the exact second derivatives, or
    the mean square of scores simulated at the fit.

    NaN where there is no information: for what ran to a bound of its support, and for all where the
    information about the others is not positive definite.
    """
    symbols, free = fit.problem.trace.parameter_symbols, ~fit.at_bound
    nothing = {repr(s): 0.0 if s.data[1] in fixed else np.nan for s in symbols}
    information = fit.information[np.ix_(free, free)]
    if not np.all(np.isfinite(information)):
        return nothing
    scale = np.sqrt(np.abs(np.diagonal(information)))
    if not np.all(scale > 0.0):
        return nothing
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if len(values) and values[0] <= LEAST_INFORMATION:
        return nothing
    jacobian = UnconstrainedTransform(fit.space).at(fit.z).jacobian
    root = (jacobian[:, free] / scale) @ (vectors / np.sqrt(values))
    spread = np.sqrt(np.sum(root**2, axis=1))
    held = np.any(jacobian[:, fit.at_bound] != 0.0, axis=1)
    spread = np.where(held, np.nan, spread)
    return {repr(s): float(v) for s, v in zip(symbols, spread, strict=True)}


@dataclass(frozen=True)
class _Scores:
    """The scores of a model and what smooths them, made once for all copies of a fitter and only
    where they are asked for: a fit that is looked at again has no need of them."""

    problem: Problem
    held: tuple[str, ...]
    settings: Settings

    @once_property
    def columns(self) -> ScoreExpressions:
        trace, missing = self.problem.trace, self.problem.program.missing
        return score_columns(trace, trace, (), self.held, missing)

    @once_property
    def smoother(self) -> Smoother:
        return Smoother(self.columns, self.problem.program.missing, self.settings)


class Fitter:
    """Fits one model to any of its data sets."""

    def __init__(
        self, problem: Problem, fixed: Mapping[str, np.ndarray], settings: Settings,
        initial_law: ProperInitialLaw | None = None,
    ):  # fmt: skip
        """initial_law : of x_1, in place of a flat one."""
        self.problem, self.fixed, self.settings = problem, dict(fixed), settings
        self.initial_law = initial_law
        self.kalman = kalman_model(problem.trace)
        self._scores = _Scores(problem, tuple(self.fixed), settings)

    @property
    def columns(self) -> ScoreExpressions:
        """The scores in the parameters that were free to begin with."""
        return self._scores.columns

    @property
    def smoother(self) -> Smoother:
        return self._scores.smoother

    @property
    def where(self) -> np.ndarray:
        """(C,) places of the parameters that have a score."""
        place = {s: i for i, s in enumerate(self.problem.trace.parameter_symbols)}
        return np.array([place[s] for s in self.columns.nuisance], dtype=int)

    def with_fixed(self, values: Mapping[str, Any]) -> Fitter:
        """The same with other values of parameters that are fixed."""
        if not values:
            return self
        out = copy(self)
        out.fixed = self.fixed | {n: np.asarray(v, dtype=float) for n, v in values.items()}
        return out

    @property
    def pilot_particles(self) -> int:
        """Particles where an approximate answer will do."""
        return min(PILOT_PARTICLES, self.settings.particles)

    @property
    def exact(self) -> bool:
        return isinstance(self.kalman, KalmanModel)

    @property
    def smooth(self) -> bool:
        """Whether `value` has no Monte Carlo error."""
        gaussian = self.problem.program.gaussian
        filtered = isinstance(gaussian, GaussianApproximation)
        return self.exact or (filtered and self.settings.proposal == "twisted")

    @cached_property
    def simulator(self) -> Simulator:
        """Draws data sets from the model."""
        program, held = self.problem.program, self.initial_law.laws if self.initial_law else ()
        first = InitialStateMeans(self.smoother) if self.initial_law else None
        return Simulator(program, program.missing, self.kalman, tuple(held), first)

    @property
    def log_correction(self) -> float:
        """Nats for each experiment that a proper initial distribution in place of a flat one
        takes."""
        return self.initial_law.log_correction if self.initial_law else 0.0

    def restored(self, experiments: Sequence[Experiment], numbers: Mapping[str, np.ndarray]) -> Fit:
        """The fit to `experiments` that had these `Fit.numbers`."""
        problem = replace(self.problem, experiments=tuple(experiments))
        theta = np.array(numbers["theta"])
        start = unpack_parameters(problem.trace, theta)
        space = at(space_of(problem, self.fixed, start), theta)
        value, error, distance = (
            float(numbers[n]) for n in ("log_likelihood", "error", "distance")
        )
        return Fit(space, theta, np.array(numbers["z"]), value, error,
                   np.array(numbers["information"]), distance, bool(numbers["converged"]),
                   np.array(numbers["at_bound"], dtype=bool))  # fmt: skip

    def fit(
        self, experiments: Sequence[Experiment], seed: np.random.SeedSequence,
        start: Mapping[str, np.ndarray], effort: Effort = Effort(), *,
        information: np.ndarray | None = None,
    ) -> Fit:  # fmt: skip
        """The mode of the posterior, climbed to from `start`.

        information : (P, P) of the parameters where it starts, about; None: by simulation.

        Raises
        ------
        ArgumentError : the likelihood is zero at every point that was tried.
        SamplingError : the weights of the filter vanish where it starts.
        """
        problem = replace(self.problem, experiments=tuple(experiments))
        space = space_of(problem, self.fixed, dict(start))
        if isinstance(self.kalman, KalmanModel):
            return self._fit_linear_gaussian(self.kalman, space, dict(start), seed, effort)
        if information is not None:
            information = self._unconstrained(space, space.theta, information, seed)
        smooth = self._extended_log_likelihood(problem)
        many = self._extended_of_many(problem)
        if smooth is not None and many is not None:
            return self._fit_together(space, smooth, many, seed, effort)
        if effort.pilot:

            def estimate(theta: np.ndarray, seed: np.random.SeedSequence) -> float:
                if smooth is not None:
                    return smooth(theta)
                return self._estimate(problem, theta, self.pilot_particles, random_state(seed))

            z, _ = climb_to_mode(space, seed, estimate)
            space = at(space, space.parameters(z)[0].copy())
        if smooth is None:
            return self._fit_by_particles(space, seed, information)
        shares = NOISE_SHARES[: effort.levels]
        space, top = self._top_of_extended_filter(space, smooth, seed, shares, effort.approximate)
        if top is not None:
            information = positive_definite(top.information, ~space.on_the_line)
        fit = None
        if top is None or not effort.approximate:
            fit = self._fit_by_particles(space, seed, information)
        if top is not None:
            fit = self._better_of(fit, space, top, seed)
        assert fit is not None
        if effort.approximate:
            return fit
        values = one_by_one(density_of(space, smooth))
        z, mask = hold_at_bounds(values, fit.z, ~space.on_the_line)
        if not mask.any():
            return fit
        theta = space.parameters(z)[0].copy()
        value, error = self.log_likelihood(problem.experiments, theta, seed)
        return replace(fit, space=at(space, theta), theta=theta, z=z, log_likelihood=value,
                       error=error, at_bound=mask)  # fmt: skip

    def value(self, experiments: Sequence[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta) as climbs see it: exact, by the extended filter, or by particles."""
        problem = replace(self.problem, experiments=tuple(experiments))
        smooth = self._extended_log_likelihood(problem)
        if smooth is None and isinstance(self.kalman, KalmanModel):
            return self.kalman.log_likelihood(experiments, theta)
        return smooth(theta) if smooth else self.estimate(experiments, theta, random_state(
            np.random.SeedSequence(0)))  # fmt: skip

    def seconds_of_value(self, experiments: Sequence[Experiment], theta: np.ndarray) -> float:
        """How long `value` takes at one of the points that a climb looks at together."""
        many = self._extended_of_many(replace(self.problem, experiments=tuple(experiments)))
        if many is None:
            return timed(lambda: self.value(experiments, theta))[0]
        points = theta * (1.0 + 1e-6 * np.arange(TOGETHER))[:, None]
        return timed(lambda: many(points))[0] / TOGETHER

    # -- by the extended Kalman filter
    def _extended_log_likelihood(self, problem: Problem) -> Callable[[np.ndarray], float] | None:
        """theta (P,) -> log p(y | theta) by the extended Kalman filter, -inf where it has no
        number; None where the model has no such filter. Of a linear Gaussian model by the exact
        filter where rounding leaves that one without a number, as next to a vague initial
        distribution."""
        found = problem.program.gaussian if self.settings.proposal == "twisted" else None
        if not isinstance(found, GaussianApproximation):
            return None

        def value(theta: np.ndarray) -> float:
            total = 0.0
            for e in problem.experiments:
                total += found.extended_log_likelihood(theta, e.y, e.seen, e.u)
                total += self.log_correction
            if isinstance(self.kalman, KalmanModel) and not np.isfinite(total):
                shift = len(problem.experiments) * self.log_correction
                total = self.kalman.log_likelihood(problem.experiments, theta) + shift
            return total if np.isfinite(total) else -np.inf

        return value

    def _extended_of_many(self, problem: Problem) -> Increments | None:
        """(B, P) parameter vectors -> (B, R), the increments of log p(y | theta) by the extended
        Kalman filter, and its predictions, where the model calls a simulator, so that many at once
        take little longer than one; else None."""
        found = extended_model(problem.trace)
        if isinstance(found, NotApplicable) or self.settings.proposal != "twisted":
            return None
        shift = len(problem.experiments) * self.log_correction

        def values(theta: np.ndarray) -> tuple[np.ndarray, Predictions | None]:
            with thriftily():  # climbs look at differences that are far larger than its error
                rows, predictions = found.increments_and_predictions(problem.experiments, theta)
            rows[:, 0] += shift
            return rows, predictions

        return values

    def _fit_together(
        self, space: Space, smooth: Callable[[np.ndarray], float],
        many: Increments, seed: np.random.SeedSequence, effort: Effort,
    ) -> Fit:  # fmt: skip
        """The top of the extended filter's likelihood, whose points are looked at together, to
        within what a decision needs."""
        z = space.z[space.positions]
        densities = densities_of(space, many)
        starts = z[None]
        if effort.pilot:
            begun = [self._with_process_noise(space, share) for share in NOISE_SHARES[1:]]
            starts = best_of_many(densities, [z, *(s.z[s.positions] for s in begun)], seed)
        found = climb_together(densities, starts, precise=False)
        if found is None:
            raise ArgumentError(
                "the extended Kalman filter is not finite (NaN or infinite) at every point tried",
                fix="give the parameters priors round plausible values, or look whether the "
                "simulator gives NaN",
            )
        top = found.top
        if effort.pilot:
            exact = information_of_many(densities, top.z, top.information)
            top = replace(top, information=exact) if np.isfinite(exact).all() else top
        there = at(space, space.parameters(top.z)[0].copy())
        fit = self._better_of(None, there, top, seed)
        if effort.approximate:
            return fit
        level = flat_outwards(densities, fit.z) & ~there.on_the_line
        z, mask = hold_at_bounds(lambda points: summed(densities(points)), fit.z, level)
        if not mask.any():
            return fit
        theta = there.parameters(z)[0].copy()
        return replace(fit, space=at(there, theta), theta=theta, z=z, log_likelihood=smooth(theta),
                       at_bound=mask)  # fmt: skip

    def _top_of_extended_filter(
        self, space: Space, smooth: Callable[[np.ndarray], float], seed: np.random.SeedSequence,
        shares: Sequence[float], approximate: bool,
    ) -> tuple[Space, Top | None]:  # fmt: skip
        """The space at the top of that, from where it stands; as it is, and None, where the
        particle filter knows better. approximate : to within a few hundredths of a nat."""
        function = density_of(space, smooth)
        tops = []
        for share in shares:
            begin = self._with_process_noise(space, share)
            z = begin.z[begin.positions]
            top = self._scored(space, z) or climb(function, z)
            if top is not None:
                tops.append(top)

        def estimate(s: Space) -> float:
            n = self.settings.particles
            return self._estimate(s.problem, s.theta, n, random_state(seed, Stream.TOP))

        was = estimate(space)
        for top in sorted(tops, key=lambda top: -top.value):
            there = at(space, space.parameters(top.z)[0].copy())
            if estimate(there) >= was - ASTRAY:
                if not approximate and (higher := climb(function, top.z)) is not None:
                    there, top = at(space, space.parameters(higher.z)[0].copy()), higher
                return there, top
        return space, None

    def _scored(self, space: Space, z: np.ndarray) -> Top | None:
        """The top near z (F,) by Fisher's scoring, where that applies and comes to its end."""
        gaussian = space.problem.program.gaussian
        if not isinstance(gaussian, GaussianApproximation):
            return None
        top = climb_by_scoring(space, gaussian, z, self.log_correction)
        return top if top is not None and top.distance < SCORED else None

    def _better_of(
        self, fit: Fit | None, space: Space, top: Top, seed: np.random.SeedSequence
    ) -> Fit:
        """The fit, or the top of the approximation where the particles' score led to nothing
        higher: with next to no noise in a distribution that score is mostly Monte Carlo error."""
        value, error = self.log_likelihood(space.problem.experiments, space.theta, seed)
        if fit is not None:
            prior = density_of(space, lambda theta: 0.0)
            gained = fit.log_likelihood + prior(fit.z) - value - prior(top.z)
            if gained > 2.0 * np.hypot(error, fit.error):
                distance = min(fit.distance, top.distance)
                return replace(fit, distance=distance, converged=distance < 3.0 * NEAR)
        # As it is: a matrix made positive definite for steps would give standard errors of nothing.
        nowhere = np.zeros(len(top.z), dtype=bool)
        return Fit(space, space.theta, top.z, value, error, top.information, top.distance,
                   top.distance < 3.0 * NEAR, nowhere)  # fmt: skip

    def _with_process_noise(self, space: Space, share: float) -> Space:
        """The space with the scales of the transition's noise at a share of what they are."""
        names = [n for n in self.process_noise_scales if n not in self.fixed]
        if share == 1.0 or not names:
            return space
        trace = space.problem.trace
        theta = np.array([
            v * share if s.data[1] in names else v
            for s, v in zip(trace.parameter_symbols, space.theta, strict=True)
        ])  # fmt: skip
        return at(space, theta)

    @cached_property
    def process_noise_scales(self) -> set[str]:
        """Positive parameters that the noise of the transition is made of."""
        gaussian, trace = self.problem.program.gaussian, self.problem.trace
        if not isinstance(gaussian, GaussianApproximation):
            return set()
        inside = {s.data[1] for s in symbols_of(list(gaussian.found.transition.spread().ravel()))
                  if s.data[0] == "parameter"}  # fmt: skip
        out = set()
        for name in inside:
            support = trace.parameters[name].distribution.support()
            ends = [e for end in (support.lower, support.upper) for e in array(end).ravel()]
            if support.kind == "interval" and all(e.op == "const" for e in ends):
                if {e.data for e in ends} == {0.0, np.inf}:
                    out.add(name)
        return out

    def _fit_linear_gaussian(
        self, kalman: KalmanModel, space: Space, start: dict[str, np.ndarray],
        seed: np.random.SeedSequence, effort: Effort,
    ) -> Fit:  # fmt: skip
        problem = space.problem
        setup = Maximization(problem, space, "posterior", self.fixed, start, seed)
        # The extended filter's is the same here, and needs no matrices to be put together. Where
        # errors are wanted it has to end at its top; else to within what a decision needs.
        smooth = self._extended_log_likelihood(problem) or partial(
            kalman.log_likelihood, problem.experiments
        )
        function = density_of(space, smooth)
        top = None
        if not effort.pilot:
            top = self._scored(space, space.z[space.positions])
            if top is None or effort.standard_errors:
                top = climb(function, space.z[space.positions] if top is None else top.z)
        if top is not None and top.distance < (GOOD if effort.standard_errors else NEAR):
            theta, converged = space.parameters(top.z)[0].copy(), True
        elif len(space.positions):
            ascent = climb_exactly(setup, DirectOptimization(restarts=int(effort.pilot)))
            theta, converged = ascent.theta, bool(ascent.report["converged"])
        else:
            theta, converged = space.theta, True
        z, mask = hold_at_bounds(one_by_one(function), setup.space_at(theta), ~space.on_the_line)
        theta = space.parameters(z)[0].copy() if mask.any() else theta
        value = kalman.log_likelihood(problem.experiments, theta)
        size = len(space.positions)
        information = np.full((size, size), np.nan)
        fit = Fit(at(space, theta), theta, z, value, 0.0, information, 0.0, converged, mask)
        return self.with_information(fit, seed) if effort.standard_errors else fit

    def states(
        self, e: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 16
    ) -> np.ndarray:
        """(T, draws, D) draws of each x_t: of trajectories where exact, else filtered."""
        if isinstance(self.kalman, KalmanModel):
            return np.swapaxes(self.kalman.draw(e, theta, stream, draws), 0, 1)
        if isinstance(self.smoother.extended, Extended):
            return np.swapaxes(self.smoother.extended.draw(e, theta, stream, draws), 0, 1)
        system, weights = self.smoother.system(e, theta, stream)
        cumulative = np.cumsum(weights, axis=1)
        levels = (np.arange(draws) + 0.5) / draws
        index = np.stack([np.searchsorted(c, levels * c[-1]) for c in cumulative])
        return np.swapaxes(np.take_along_axis(system.particles, index[:, None], axis=2), 1, 2)

    def gradient(
        self, space: Space, z: np.ndarray, stream: np.ndarray,
        transform: UnconstrainedTransform | None = None,
    ) -> tuple[float, np.ndarray] | None:  # fmt: skip
        """(log p(y) + log prior, its derivatives (F,) in z), estimated; None where none is."""
        point = (transform or UnconstrainedTransform(space)).at(z)
        if point.log_prior == -np.inf:
            return None
        try:
            passes = self.smoother.run(
                space.problem.experiments, point.theta, stream, predicted=False
            )
        except SamplingError:
            return None
        slope = point.pull(self._score(passes, len(point.theta))) + point.d_log_prior
        if not np.all(np.isfinite(slope)):
            return None
        value = sum(total_of(p.log_increments) for p in passes)
        return value + point.log_prior, slope

    def _score(self, passes: Sequence[Pass], size: int) -> np.ndarray:
        """(P,) of the data that was passed over; 0 in what is fixed."""
        score = np.zeros(size)
        score[self.where] = sum(p.rows.sum(axis=0) for p in passes)
        return score

    def _fit_by_particles(
        self, space: Space, seed: np.random.SeedSequence, information: np.ndarray | None
    ) -> Fit:
        stream = random_state(seed, Stream.ASCENT)
        z = space.z[space.positions]
        if information is None:
            information = self._simulated_information(space, space.theta, seed)
        transform = UnconstrainedTransform(space)
        found = self.gradient(space, z, stream, transform)
        if found is None:
            raise SamplingError(
                f"the model {space.problem.trace.name!r} cannot have produced the data where its "
                "fit starts",
                fix="check the data for outliers, or give the parameters priors round plausible "
                "values",
            )
        z, h, distance = stochastic_quasi_newton(
            lambda z: self.gradient(space, z, stream, transform), z, found, information
        )
        theta = space.parameters(z)[0].copy()
        value, error = self.log_likelihood(space.problem.experiments, theta, seed)
        nowhere = np.zeros(len(z), dtype=bool)
        return Fit(at(space, theta), theta, z, value, error, h, distance, distance < 3.0 * NEAR,
                   nowhere)  # fmt: skip

    def log_likelihood(
        self, experiments: Sequence[Experiment], theta: np.ndarray, seed: np.random.SeedSequence,
        repeats: int = 8,
    ) -> tuple[float, float]:  # fmt: skip
        """log p(y | theta) from the mean of independent estimates, and its standard deviation."""
        if isinstance(self.kalman, KalmanModel):
            return self.kalman.log_likelihood(experiments, theta), 0.0
        problem = replace(self.problem, experiments=tuple(experiments))
        smooth = self._extended_log_likelihood(problem)
        if smooth is not None and self._extended_of_many(problem) is not None:
            return smooth(theta), 0.0  # the approximation that fits of simulators go by
        value, error = -np.inf, 0.0
        for doubling in range(DOUBLINGS + 1):
            n = self.settings.particles * 2**doubling

            def one(r: int, n: int = n, doubling: int = doubling) -> float:
                return self._estimate(
                    problem, theta, n, random_state(seed, Stream.LIKELIHOOD, r, doubling)
                )

            log_z = np.array(run_tasks(one, range(repeats)))
            if not np.any(log_z > -np.inf):
                return -np.inf, 0.0
            share = np.exp(log_z - log_z.max())
            error = float(share.std(ddof=1) / share.mean() / np.sqrt(repeats))
            value = float(log_z.max() + np.log(share.mean()))
            if error <= PRECISE:
                break
        return value, error

    def estimate(
        self, experiments: Sequence[Experiment], theta: np.ndarray, stream: np.ndarray
    ) -> float:
        """One estimate of log p(y | theta), -inf where there is none."""
        problem = replace(self.problem, experiments=tuple(experiments))
        return self._estimate(problem, theta, self.settings.particles, stream)

    def estimates(
        self, experiments: Sequence[Experiment], theta: np.ndarray, stream: np.ndarray
    ) -> np.ndarray:
        """(B,) likewise, of each row of theta (B, P), with the same random numbers; by the extended
        Kalman filter where that looks at many points at once."""
        problem = replace(self.problem, experiments=tuple(experiments))
        many = self._extended_of_many(problem)
        if many is not None:
            return summed(parts_of(many, theta, np.zeros(len(theta))))
        particles = self.settings.particles
        return np.array([self._estimate(problem, t, particles, stream.copy()) for t in theta])

    def _estimate(
        self, problem: Problem, theta: np.ndarray, particles: int, stream: np.ndarray
    ) -> float:
        """One estimate of log p(y | theta); -inf where there is none.

        By the variant of the filter that the smoother has compiled already.
        """
        settings = FilterSettings(particles, self.settings.proposal)
        try:
            return sum(
                particle_system(problem, theta, settings, e, stream).log_Z + self.log_correction
                for e in problem.experiments
            )
        except SamplingError:
            return -np.inf

    def with_information(self, fit: Fit, seed: np.random.SeedSequence) -> Fit:
        """The fit with an information matrix worth its name: minus the second derivatives where
        they are exact, else that of scores simulated at it; its own was built up on the way. Of a
        simulator the second derivatives by differences where they are those of a top: where a mean
        bends sharply they see the bends, and its own, by the filter's predictions, does not. NaN
        where nothing that is simulated can be filtered."""
        free = np.ix_(~fit.at_bound, ~fit.at_bound)  # at a bound it says nothing
        if isinstance(self.kalman, KalmanModel):
            if np.all(np.isfinite(fit.information[free])):  # known already, or nothing is free
                return fit
            for found in self._second_derivatives(self.kalman, fit, seed):
                inside = found[free]
                if np.all(np.isfinite(inside)) and np.all(np.linalg.eigvalsh(inside) > 0.0):
                    return replace(fit, information=found)
        many = self._extended_of_many(fit.problem)
        if many is not None:
            found = np.full_like(fit.information, np.nan)
            found[free] = self._curvature(fit, many)
            for information in (found, fit.information):
                inside = information[free]
                if np.all(np.isfinite(inside)) and np.all(np.linalg.eigvalsh(inside) > 0.0):
                    return replace(fit, information=information)
        try:
            found = self._simulated_information(fit.space, fit.theta, seed)
        except SamplingError:  # then there are no standard errors
            found = np.full_like(fit.information, np.nan)
        if (smooth := self._extended_log_likelihood(fit.problem)) is not None:
            found = not_inflated(found, self._curvature_of(smooth, fit), free)
        return replace(fit, information=found)

    def _curvature(self, fit: Fit, many: Increments) -> np.ndarray:
        """(F', F') minus the second derivatives at the fit in what is not at a bound."""
        free, densities = ~fit.at_bound, densities_of(fit.space, many)

        def inside(points: np.ndarray) -> Parts:
            z = np.repeat(fit.z[None], len(points), axis=0)
            z[:, free] = points
            return densities(z)

        return information_of_many(inside, fit.z[free], fit.information[np.ix_(free, free)])

    def _curvature_of(self, smooth: Callable[[np.ndarray], float], fit: Fit) -> np.ndarray:
        """(F, F) minus the second derivatives of the log posterior by the extended filter, NaN in
        what is at a bound."""
        function, free = density_of(fit.space, smooth), ~fit.at_bound

        def inside(free_z: np.ndarray) -> float:
            z = fit.z.copy()
            z[free] = free_z
            return function(z)

        found = np.full((len(free), len(free)), np.nan)
        found[np.ix_(free, free)] = information_at(inside, fit.z[free])
        return found

    def _second_derivatives(
        self, kalman: KalmanModel, fit: Fit, seed: np.random.SeedSequence
    ) -> Iterator[np.ndarray]:
        """(F, F) minus those of the log posterior at the fit, NaN in what is at a bound: the
        cheapest first."""
        if (smooth := self._extended_log_likelihood(fit.problem)) is not None:
            yield self._curvature_of(smooth, fit)
        setup = Maximization(fit.problem, fit.space, "posterior", self.fixed, {}, seed)
        yield observed_information(setup, fit.z)

    def _unconstrained(
        self, space: Space, theta: np.ndarray, information: np.ndarray,
        seed: np.random.SeedSequence,
    ) -> np.ndarray:  # fmt: skip
        """(F, F) in z of a matrix (P, P) in theta, the prior's curvature included."""
        setup = Maximization(space.problem, at(space, theta), "posterior", self.fixed, {}, seed)
        z = setup.space_at(theta)
        jacobian = setup.transform.at(z).jacobian
        curvature = setup.transform.curvature(z, np.zeros(len(theta)))
        prior = -curvature.log_prior
        values, vectors = np.linalg.eigh(0.5 * (prior + prior.T))
        return jacobian.T @ information @ jacobian + (vectors * np.maximum(values, 0.0)) @ vectors.T

    def _simulated_information(
        self, space: Space, theta: np.ndarray, seed: np.random.SeedSequence
    ) -> np.ndarray:
        """(F, F) in z: mean square of the scores of data simulated at theta, prior included."""
        problem = space.problem
        smoother = self.smoother.with_particles(self.pilot_particles)
        simulator = self.simulator

        def one(r: int) -> np.ndarray | None:
            stream = random_state(seed, Stream.INFORMATION, r)
            sets = simulator.sets(problem.experiments, theta, stream)
            try:
                passes = smoother.run(sets, theta, stream, predicted=False)
            except SamplingError:
                return None
            return self._score(passes, len(theta))

        scores = [s for s in run_tasks(one, range(INFORMATION_SETS)) if s is not None]
        scores = [s for s in scores if np.all(np.abs(s) < LARGEST)]
        if not scores:
            raise SamplingError(
                f"the filter failed on every data set simulated from {problem.trace.name!r} at its "
                "fit",
                fix="give the parameters priors round plausible values, or fix known ones",
            )
        square = np.mean([np.outer(s, s) for s in scores], axis=0)
        return self._unconstrained(space, theta, square, seed)


def component_names(space: Space, mask: np.ndarray) -> list[str]:
    """The components of the free numbers in `mask` (F,), by their text: `q`, `s[0]`."""
    every: list[str] = []
    for t in transforms(space.problem.trace):
        single = len(t.free) == len(t.components)
        every += (repr(t.components[k]) if single else t.site.name for k in range(len(t.free)))
    free = [every[i] for i in space.positions]
    return list(dict.fromkeys(n for n, m in zip(free, mask, strict=True) if m))
