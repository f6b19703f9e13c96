"""Expectation maximisation where the smoother is exact, and so every step.

Dempster, Laird and Rubin (1977); Shumway and Stoffer (1982); Schön et al. (2015), section on EM.
The E-step takes the smoother's moments; where the states take few values, sums over the values of
x_t and over the pairs of x_{t-1} and x_t (L. Baum, T. Petrie, G. Soules and N. Weiss, *Annals of
Mathematical Statistics* 41 (1970)). The M-step is derived (`analysis/conjugacy/m_step.py`). Where
the densities do not separate, the expected density Q is climbed as it stands, by BFGS with its
symbolic gradient, evaluated over all rows at once.

EM nears its limit by a constant factor at each step, close to one where the states tell much more
of the parameters than the data do. So its steps are extrapolated by SQUAREM (Varadhan and Roland
2008, "Simple and globally convergent methods for accelerating the convergence of any EM
algorithm", scheme S3) on the unconstrained scale, followed by an EM step, and what was extrapolated
is kept only where the exact log-likelihood is at least that of two plain steps: it never falls. The
same extrapolation tells how far the limit still is, which, and not the length of a step, decides
when to stop.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import scipy

from ssmppl.analysis.conjugacy.m_step import (
    IN_TIME,
    ExpectedDensity,
    MStep,
    expected_density,
    expected_statistics,
    moments_of,
)
from ssmppl.analysis.density import terms
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError, warn
from ssmppl.expressions.calculus import gradient as gradient_of
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.exact.hidden_markov import HiddenMarkov
from ssmppl.inference.exact.histories import Histories
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.inference.maximum.ascent import ELSEWHERE, Ascent, Maximization
from ssmppl.inference.maximum.m_step import maximiser
from ssmppl.inference.methods.methods import EM
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.particles.deterministic import Deterministic
from ssmppl.inference.preparation.exact_models import filter_name
from ssmppl.inference.preparation.vanishing import without_maximum
from ssmppl.inference.updates.symbolic_newton import Unconstrained
from ssmppl.language.model.trace import Trace, previous, seen


def maximise_expectation(
    setup: Maximization, theta: np.ndarray,
    expected: Callable[[np.ndarray], tuple[float, np.ndarray]], with_slope: bool,
) -> np.ndarray:  # fmt: skip
    """Where theta' -> (Q, its derivatives (P,)) has its top near theta, by BFGS on the
    unconstrained scale; Nelder and Mead's simplex where the derivatives are not there.

    Raises
    ------
    SamplingError : Q has a value and no slope at theta itself.
    """
    transform = setup.transform

    def at(z: np.ndarray) -> tuple[float, np.ndarray]:
        """-Q and its derivatives in z."""
        point = transform.at(z)
        if not np.all(np.isfinite(point.theta)):
            return np.inf, np.zeros(len(z))
        total, gradient = expected(point.theta)
        if not np.isfinite(total) or not np.all(np.isfinite(gradient)):
            return np.inf, np.zeros(len(z))
        return -total, -point.pull(gradient)

    z = setup.space_at(theta)
    value, gradient = expected(theta)
    if with_slope and (reason := transform.without_slope(value, theta, gradient)):
        raise SamplingError(
            f"the expected log density cannot be maximised (no gradient): {reason}", fix=ELSEWHERE
        )
    before = at(z)[0]
    found = scipy.optimize.minimize(
        at if with_slope else (lambda v: at(v)[0]), z, jac=with_slope or None,
        method="BFGS" if with_slope else "Nelder-Mead",
        options={"gtol": 1e-7} if with_slope else {"xatol": 1e-9, "fatol": 1e-12},
    )  # fmt: skip
    return transform.at(found.x).theta if found.fun <= before else theta


class FiniteSteps:
    """theta -> theta after one E-step and one M-step."""

    def __init__(self, setup: Maximization, model: HiddenMarkov):
        self.setup, self.model = setup, model
        self.maximum = maximiser(setup, "EM")
        self.step: MStep | NotApplicable = self.maximum.step
        self.free = [
            s for s in setup.problem.trace.parameter_symbols if s.data[1] not in setup.fixed
        ]

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        laws = self.model.laws(self.setup.problem.experiments, theta)
        if not isinstance(self.step, MStep):
            return maximise_expectation(self.setup, theta, lambda at: self._density(laws, at), True)
        total = self.maximum.q.prior(theta)
        for role, summands in self.step.update.coefficients.items():
            if role in IN_TIME:
                for h, law, pairs in laws:
                    own = pairs if role == "transition" else law
                    total += self.model.expected(h, theta, role, summands, own)
        return self.maximum.q.maximise(total, theta)

    def _density(
        self, laws: list[tuple[Histories, np.ndarray, np.ndarray]], at: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """(Q, its derivatives) at theta' of the distributions of the states at another theta."""
        trace = self.setup.problem.trace
        place = {s: i for i, s in enumerate(trace.parameter_symbols)}
        total, gradient = 0.0, np.zeros(len(place))
        for h, law, pairs in laws:
            for role in IN_TIME:
                own = pairs if role == "transition" else law
                both = [self.model.density(role, h),
                        *(self.model.density(role, h, s) for s in self.free)]  # fmt: skip
                found = self.model.expected(h, at, role, both, own)
                total += found[0]
                gradient[[place[s] for s in self.free]] += found[1:]
        if self.setup.with_prior:
            here = dict(zip(trace.parameter_symbols, at, strict=True))
            for term in terms(trace, "prior"):
                both = [term.log_density, *gradient_of(term.log_density, self.free)]
                found = np.array([float(v) for v in evaluate(both, here)])
                total += found[0]
                gradient[[place[s] for s in self.free]] += found[1:]
        return total, gradient


SHORTENINGS = 2  # of an extrapolation that lost, before plain steps are taken
ROUNDING = 1e-13  # of the log-likelihood, relative
PATIENCE = 60.0  # seconds of all steps, beyond which it is said that they are slow
CALM = 2  # cycles in a row that have to find the limit near


def climb(setup: Maximization, method: EM) -> Ascent:
    """The maximum of the likelihood, or of the posterior density, by EM.

    setup : model, data, start and objective. method : its settings. The `Ascent` has the end, the
    iterates and the report.

    Raises
    ------
    ArgumentError : the model has no exact smoother, or its states cannot be the missing data.
    """
    if isinstance(setup.exact, NotApplicable):
        raise ArgumentError(
            "EM needs a linear Gaussian model, or one of finitely many states: "
            f"{setup.exact.reason}",
            fix="use ssm.ParticleEM() or ssm.PSAEM()",
            where=setup.exact.where,
        )
    if isinstance(setup.exact, Deterministic):
        site = next(iter(setup.problem.trace.transition.values()))
        raise ArgumentError(
            "EM takes the states for missing data, and in this model they follow from the "
            "parameters",
            fix="use ssm.DirectOptimization(), whose likelihood and score are exact",
            where=site.distribution.location,
        )
    if isinstance(setup.exact, Extended):
        raise ArgumentError(
            "EM needs the exact distribution of the states, and this model calls a simulator",
            fix="use ssm.DirectOptimization(), on the extended Kalman filter's likelihood, or None",
        )
    need_density(setup.problem.trace, "EM", "maximize")
    return _Climb(setup, setup.exact, method).run()


class ExactSteps:
    """theta -> theta after one E-step and one M-step."""

    def __init__(self, setup: Maximization, kalman: KalmanModel):
        self.setup, self.kalman = setup, kalman
        trace = setup.problem.trace
        self.maximum = maximiser(setup, "EM")
        self.step: MStep | NotApplicable = self.maximum.step
        self.density: ExpectedDensity | None = None
        self.coefficients: dict[str, list[Expr]] = {}
        if isinstance(self.step, MStep):
            found = expected_statistics(self.step)
            if isinstance(found, NotApplicable):
                self.step = found
            else:
                self.coefficients = found
        if not isinstance(self.step, MStep):
            missing = setup.problem.program.missing
            density = expected_density(trace, tuple(setup.fixed), missing, setup.with_prior)
            if isinstance(density, NotApplicable):
                raise ArgumentError(
                    f"EM does not apply: {density.reason}",
                    fix="use ssm.DirectOptimization()",
                    where=density.where,
                )
            self.density = density
        self.rows = [row_values(trace, e) for e in setup.problem.experiments]

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        if isinstance(self.step, MStep):
            return self.maximum.q.maximise(self.statistics(theta), theta)
        return self._climbed(theta)

    def statistics(self, theta: np.ndarray) -> np.ndarray:
        """S = E[C | y, theta], summed over rows and experiments, with the prior's part."""
        total = self.maximum.q.prior(theta)
        for e, rows in zip(self.setup.problem.experiments, self.rows, strict=True):
            values = self._values(e, rows, theta)
            for role, summands in self.coefficients.items():
                total += summed(summands, values, role, e.steps)
        return total

    def _values(
        self, experiment: Experiment, rows: dict[Expr, np.ndarray], theta: np.ndarray
    ) -> dict[Expr, np.ndarray]:
        """Every symbol of the summands, smoothed at theta."""
        smoothed = self.kalman.smooth(experiment, theta)
        trace = self.setup.problem.trace
        own = moments_of(smoothed.mean, smoothed.covariance, smoothed.cross, trace)
        return {**rows, **own, **dict(zip(trace.parameter_symbols, theta, strict=True))}

    def _climbed(self, theta: np.ndarray) -> np.ndarray:
        """The M-step on Q as it stands."""
        assert self.density is not None
        symbols = self.setup.problem.trace.parameter_symbols
        density, slopes = self.density, self.density.slopes
        series = [
            (self._values(e, rows, theta), e.steps)
            for e, rows in zip(self.setup.problem.experiments, self.rows, strict=True)
        ]
        place = [i for i, s in enumerate(symbols) if s.data[1] not in self.setup.fixed]

        def expected(at: np.ndarray) -> tuple[float, np.ndarray]:
            here = dict(zip(symbols, at, strict=True))
            total, gradient = 0.0, np.zeros(len(symbols))
            for k, (values, steps) in enumerate(series):
                for role, e in density.summands.items():
                    if role == "prior" and k:
                        continue
                    both = [e, *(slopes[role] if isinstance(slopes, dict) else [])]
                    found = summed(both, {**values, **here}, role, steps)
                    total += found[0]
                    gradient[place] += found[1:] if len(found) > 1 else 0.0
            return total, gradient

        return maximise_expectation(self.setup, theta, expected, isinstance(slopes, dict))


def row_values(trace: Trace, experiment: Experiment) -> dict[Expr, np.ndarray]:
    """Symbol -> (T,): time, inputs and observations of each row, and of the row before."""
    t = np.arange(experiment.steps)
    before = np.maximum(t - 1, 0)
    values: dict[Expr, np.ndarray] = {
        symbol("time", "t"): t + 1.0,
        symbol("time_prev", "t"): t + 0.0,
    }
    for s, column in zip(trace.input_symbols, experiment.u.T, strict=True):
        values[s], values[previous(s)] = column, column[before]
    for s, column, mask in zip(
        trace.observation_symbols, experiment.y.T, experiment.seen.T, strict=True
    ):
        values[s], values[previous(s)], values[seen(s)] = column, column[before], mask
    return values


def summed(
    summands: list[Expr], values: dict[Expr, np.ndarray], role: str, steps: int
) -> np.ndarray:
    """Each summand added up over the rows of its role: the first, the later ones, or all."""
    rows = {"initial": slice(0, 1), "transition": slice(1, None), "observation": slice(None)}
    if role not in IN_TIME:
        return np.array([float(v) for v in evaluate(summands, values)])
    own = {s: v[rows[role]] if np.ndim(v) else v for s, v in values.items()}
    count = {"initial": 1, "transition": steps - 1, "observation": steps}[role]
    if not count:
        return np.zeros(len(summands))
    return np.array([np.broadcast_to(v, count).sum() for v in evaluate(summands, own)])


class _Climb:
    """The iteration; `best` never has a smaller objective than what came before it."""

    def __init__(self, setup: Maximization, model: KalmanModel | HiddenMarkov, method: EM):
        self.setup, self.model, self.method = setup, model, method
        self.map = (
            FiniteSteps(setup, model)
            if isinstance(model, HiddenMarkov)
            else ExactSteps(setup, model)
        )
        free = [s for s in setup.problem.trace.parameter_symbols if s.data[1] not in setup.fixed]
        self.to_z = Unconstrained(setup.problem.trace, free)
        self.theta = setup.space.parameters(setup.start)[0].copy()
        self.value = self.objective(self.theta)
        self.iterates, self.values = [self.theta], [self.value]
        self.maps = 0

    def objective(self, theta: np.ndarray) -> float:
        """log p(y | theta), with the log prior density for a posterior mode; -inf where none."""
        value = self.model.log_likelihood(self.setup.problem.experiments, theta)
        if self.setup.with_prior:
            value += float(self.setup.problem.program.entry("log_prior")(theta))
        return value if np.isfinite(value) else -np.inf

    def run(self) -> Ascent:
        if self.value == -np.inf:
            raise ArgumentError(
                "the likelihood is zero at the start",
                fix="give start={name: value} near plausible values",
            )
        interrupted, distance, calm = False, np.inf, 0
        experiments = self.setup.problem.experiments
        try:
            while self.maps < self.method.iterations and calm < CALM:
                distance = self._cycle()
                calm = calm + 1 if distance < self.method.tolerance else 0
        except KeyboardInterrupt:
            interrupted = True
        except SamplingError:
            if without_maximum(self.model, experiments, self.theta) is None:
                raise
        unbounded = without_maximum(self.model, experiments, self.theta)
        converged = calm >= CALM and unbounded is None
        report = {
            "converged": converged,
            "stopped": f"the limit is about {distance:.2g} away on the unconstrained scale, after "
            f"{self.maps} EM steps",
            "em_steps": self.maps,
            "distance": float(distance),
            "m_step": str(self.map.step)
            if isinstance(self.map.step, MStep)
            else f"BFGS on the expected log density: {self.map.step.reason}",
            "likelihood": f"exact, by {filter_name(self.model)}",
        }
        if unbounded is not None:
            report |= {"stopped": unbounded.reason, "without_maximum": True}
        likelihood = self.model.log_likelihood(experiments, self.theta)
        return Ascent(
            self.theta, likelihood, np.array(self.iterates), report, interrupted=interrupted,
            figures={"objective": np.array(self.values)},
        )  # fmt: skip

    def _step(self, theta: np.ndarray) -> np.ndarray:
        self.maps += 1
        began = time.perf_counter()
        found = self.map(theta)
        each = time.perf_counter() - began
        if self.maps == 2 and not isinstance(self.map.step, MStep):  # the first may compile
            whole = each * self.method.iterations
            if whole > PATIENCE:
                warn(
                    f"EM may take up to {whole:.0f} s, for {self.method.iterations} steps: the "
                    "maximum of each is climbed to, as it has no closed form "
                    f"({self.map.step.reason}). "
                    "ssm.DirectOptimization() climbs the likelihood itself"
                )
        return found

    def _take(self, theta: np.ndarray, value: float) -> None:
        self.theta, self.value = theta, value
        self.iterates.append(theta)
        self.values.append(value)

    def _cycle(self) -> float:
        """Two EM steps, and from them an extrapolated one; how far the limit seems to be."""
        start = self.to_z(self.theta)
        first = self._step(self.theta)
        self._take(first, self.objective(first))
        second = self._step(first)
        self._take(second, self.objective(second))
        z1, z2 = self.to_z(first), self.to_z(second)
        r, v = z1 - start, (z2 - z1) - (z1 - start)
        left, size = float(np.linalg.norm(r)), float(np.linalg.norm(v))
        if left == 0.0:
            return 0.0
        # a factor of contraction at or above one tells nothing of the limit
        alpha = max(left / size, 1.0) if size > 0.0 else np.inf
        distance = alpha * float(np.abs(z2 - z1).max())
        if not self.method.accelerate or alpha == 1.0 or not np.isfinite(alpha):
            return distance
        for _ in range(SHORTENINGS + 1):
            point = start + 2.0 * alpha * r + alpha**2 * v
            theta, log_prior = self.setup.space.parameters(point)
            if log_prior > -np.inf:
                try:
                    there = self._step(theta.copy())
                except SamplingError:
                    there = theta
                value = self.objective(there)
                if value >= self.value - ROUNDING * abs(self.value):
                    self._take(there, value)
                    break
            alpha = 0.5 * (alpha + 1.0)
        return distance
