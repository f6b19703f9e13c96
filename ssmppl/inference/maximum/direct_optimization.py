"""Direct optimisation: quasi-Newton ascent of the log-likelihood on the unconstrained scale.

Schön et al. (2015), section on direct optimisation. On linear Gaussian models, on those of
finitely many states and on those without noise in their states the likelihood and its score are
exact, and Newton steps with the observed information polish the result.

For one scalar state the particle filter of Malik and Pitt (2011; see
`codegen/kernels/particle/continuous_filters.py`) with common random numbers is one continuous
function for each seed. Several are averaged, as likelihoods, which takes away most of the bias of
log Z; slopes are central differences over a small share of the likelihood's own width, and the
scatter of the seeds' slopes at the top gives the estimate's Monte Carlo error.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import scipy

from ssmppl.analysis.proposals.smooth import smooth_filter_applies
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.modules.filter_variants import compile_smooth_filter
from ssmppl.compiling import once_property
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.exact.hidden_markov import HiddenMarkov
from ssmppl.inference.gaussian.likelihood import laplace_approximation
from ssmppl.inference.maximum.ascent import ELSEWHERE, Ascent, Edges, Maximization
from ssmppl.inference.maximum.edges import AT_MOST, FLAT, INWARDS, edges, held_at
from ssmppl.inference.maximum.gaussian_climb import climb_gaussian
from ssmppl.inference.methods.methods import DirectOptimization
from ssmppl.inference.optimisation.batched_newton import climb_together
from ssmppl.inference.optimisation.parts import Parts, parts_of, summed
from ssmppl.inference.optimisation.quasi_newton import quasi_newton
from ssmppl.inference.optimisation.units import units_at
from ssmppl.inference.preparation.exact_models import ExactModel, likelihood_by
from ssmppl.inference.preparation.pilot import UNITS
from ssmppl.inference.preparation.space import free_components
from ssmppl.inference.preparation.vanishing import without_maximum
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.progress import announced
from ssmppl.inference.run.seeds import random_state

SLOPE_STEP = 0.03  # of the differences for slopes, in standard deviations of the likelihood
CURVE_STEP = 0.5  # of those for second derivatives
FAR = 1e30
CLOSE = 0.05  # standard deviations from the top: where the climb has arrived; counted in the error
NEWTON_STEPS = 8
GRADIENT = 1e-9  # relative to the root of the curvature: where Newton's steps are at an end
EXACT_RESTARTS = 2
# Of states that take finitely many values, whose likelihood has many maxima: short climbs from all
# round the start, the best of which are gone on with (Biernacki, Celeux and Govaert 2003).
SHORT_CLIMBS, SHORT_STEPS, SPREAD, GONE_ON_WITH = 24, 10, 2.0, 3
FLATS = 3  # that a climb leaves
LOOKED_AT = 47  # points round the start, where many cost little more than one
SIDE_BY_SIDE = 2  # climbs beside the first


def climb(setup: Maximization, method: DirectOptimization) -> Ascent:
    """The maximum of the likelihood, or of the posterior density, by direct optimisation.

    setup : model, data, start and objective. method : its settings. The `Ascent` has the end, the
    iterates and the report.

    Raises
    ------
    ArgumentError : the model is neither linear Gaussian nor one of a single scalar state.
    """
    if isinstance(setup.exact, NotApplicable):
        found = laplace_approximation(setup.problem)
        if method.laplace and not isinstance(found, NotApplicable):
            with announced("DirectOptimization", "maximising the likelihood", shown=setup.progress):
                return climb_gaussian(setup, method, found)
        reason = smooth_filter_applies(setup.problem.trace)
        if reason is not None:
            raise ArgumentError(
                f"DirectOptimization needs a linear Gaussian model, or one scalar state: "
                f"{setup.exact.reason}; {reason.reason}",
                fix="use ssm.ScoreAscent(), ssm.PSAEM() or ssm.ParticleEM()",
                where=reason.where or setup.exact.where,
            )
    with announced("DirectOptimization", "maximising the likelihood", shown=setup.progress):
        if isinstance(setup.exact, NotApplicable):
            with ThreadPoolExecutor() as pool:  # the filter runs without Python's lock
                return SmoothClimb(setup, method, pool).run()
        if isinstance(setup.exact, Extended):
            return BatchedClimb(setup, setup.exact, method).run()
        return ExactClimb(setup, setup.exact, method).run()


class SmoothLikelihood:
    """log Z of S seeds as continuous functions of theta (P,)."""

    def __init__(self, problem: Problem, particles: int, seeds: int, root: np.random.SeedSequence):
        self.problem, self.particles = problem, particles
        self.states = [
            [random_state(root, k, i) for i in range(len(problem.experiments))]
            for k in range(seeds)
        ]

    @once_property
    def run(self) -> Any:
        return compile_smooth_filter(self.problem.trace, self.problem.program.missing)

    def one(self, theta: np.ndarray, seed: int) -> float:
        """log Z of one seed, over the experiments; -inf where it does not exist."""
        total = 0.0
        for e, state in zip(self.problem.experiments, self.states[seed], strict=True):
            increments = np.empty(e.steps)
            status, _ = self.run(
                theta, e.y, e.seen, e.u, self.particles, state.copy(), increments
            )  # fmt: skip
            if status != OK:
                return -np.inf
            total += total_of(increments)
        return total


class SmoothClimb:
    """Ascent of the averaged likelihood, in units of its own width."""

    def __init__(self, setup: Maximization, method: DirectOptimization, pool: ThreadPoolExecutor):
        self.setup, self.method, self.pool = setup, method, pool
        self.likelihood = SmoothLikelihood(
            setup.problem, method.particles, method.averages, setup.seed(3)
        )
        self.best, self.best_value = np.empty(0), -np.inf
        self.unit = np.empty(0)
        self.iterates: list[np.ndarray] = []
        self.evaluations = 0

    def run(self) -> Ascent:
        """Climb from the start, look at the top, and once more where it is not there yet."""
        restarts = self.method.restarts or 0
        interrupted, gap, error, information = False, np.inf, None, None
        try:
            start, self.unit = self.setup.start, self.setup.pilot.scale
            for k in range(restarts + 1):
                self._quasi_newton(start)
                rng = np.random.default_rng(self.setup.seed(k))
                centre = self.best if len(self.best) else self.setup.start
                start = centre + 3.0 * self.unit * rng.standard_normal(len(centre))
            for _ in range(3 if len(self.best) else 0):
                gap, information, error = self._top()
                if gap < CLOSE or not np.isfinite(gap):
                    break
                self._quasi_newton(self.best)
        except KeyboardInterrupt:
            if not len(self.best):
                raise
            interrupted = True
        if not len(self.best):
            raise SamplingError(
                "the likelihood of the continuous particle filter is zero at the start",
                fix="give start={name: value} near plausible values, or more particles",
            )
        theta = self.setup.transform.at(self.best).theta
        report = {
            "converged": bool(gap < CLOSE), "evaluations": self.evaluations,
            "likelihood": f"particle filter continuous in the parameters (Malik and Pitt 2011), "
            f"{self.method.particles} particles, averaged over {self.method.averages} seeds",
            "restarts": restarts,
        }  # fmt: skip
        return Ascent(
            theta, None, np.array(self.iterates), report,
            None if information is None else self.setup.natural(self.best, information),
            None if error is None else self.setup.natural_error(self.best, error), interrupted,
        )  # fmt: skip

    def log_z(self, z: np.ndarray) -> np.ndarray:
        """(S,) at z (F,); -inf where there is nothing."""
        self.evaluations += 1
        seeds = range(self.method.averages)
        theta, log_prior = self.setup.space.parameters(z)
        if log_prior == -np.inf:
            return np.full(len(seeds), -np.inf)
        return np.array(list(self.pool.map(partial(self.likelihood.one, theta), seeds)))

    def value(self, z: np.ndarray) -> float:
        """The objective: log of the mean likelihood, with the prior where it counts."""
        value = _log_mean(self.log_z(z)) + self.setup.log_prior(z)
        if value > self.best_value:
            self.best, self.best_value = np.array(z), value
        return value

    def _slope(self, function: Any, z: np.ndarray) -> np.ndarray:
        """Central differences in units of the width, last axis F."""
        steps = SLOPE_STEP * np.diag(self.unit)
        with np.errstate(invalid="ignore"):
            slopes = [(function(z + s) - function(z - s)) / (2.0 * SLOPE_STEP) for s in steps]
        return np.stack(slopes, axis=-1)

    def _quasi_newton(self, start: np.ndarray) -> None:
        def downhill(v: np.ndarray) -> tuple[float, np.ndarray]:
            z = start + self.unit * v
            value = self.value(z)
            slope = self._slope(self.value, z) if value > -np.inf else np.full(len(v), np.nan)
            if not np.all(np.isfinite(slope)):
                return FAR, np.zeros(len(v))
            return -value, -slope

        def remember(v: np.ndarray) -> None:
            self.iterates.append(self.setup.space.parameters(start + self.unit * v)[0].copy())

        remember(np.zeros(len(start)))
        scipy.optimize.minimize(
            downhill, np.zeros(len(start)), jac=True, method="L-BFGS-B", callback=remember,
            options={"maxiter": self.method.steps, "ftol": 1e-9, "gtol": 3e-3},
        )  # fmt: skip

    def _top(self) -> tuple[float, np.ndarray | None, np.ndarray | None]:
        """(distance to the top in standard deviations, information and error in z) at the best."""
        z, n, units = self.best, len(self.best), CURVE_STEP * np.diag(self.unit)
        middle = _log_mean(self.log_z(z))
        curvature = np.empty((n, n))
        for i in range(n):
            for j in range(i + 1):
                a, b = units[i], units[j]
                if i == j:
                    total = self._at(z + a) - 2.0 * middle + self._at(z - a)
                else:
                    total = 0.25 * (self._at(z + a + b) - self._at(z + a - b)
                                    - self._at(z - a + b) + self._at(z - a - b))  # fmt: skip
                curvature[i, j] = curvature[j, i] = -total / CURVE_STEP**2
        slopes = self._slope(self.log_z, z)  # (S, F)
        whole_slope = self._slope(lambda v: _log_mean(self.log_z(v)) + self.setup.log_prior(v), z)
        if not (np.all(np.isfinite(curvature)) and np.all(np.isfinite(slopes))):
            return np.inf, None, None
        scale = np.outer(self.unit, self.unit)
        information = curvature / scale
        whole = curvature if not self.setup.with_prior else curvature - scale * self._prior_curve(z)
        if np.linalg.eigvalsh(whole)[0] <= 0.0:
            return np.inf, information, None
        step = np.linalg.solve(whole, whole_slope)
        log_z = self.log_z(z)
        w = np.exp(log_z - log_z.max())
        w /= w.sum()
        off = w[:, None] * (slopes - w @ slopes)
        noise = off.T @ off * len(w) / (len(w) - 1)
        inverse = np.linalg.inv(whole)
        error = inverse @ noise @ inverse + np.outer(step, step)
        return float(np.sqrt(whole_slope @ step)), information, error * scale

    def _at(self, z: np.ndarray) -> float:
        return _log_mean(self.log_z(z))

    def _prior_curve(self, z: np.ndarray) -> np.ndarray:
        """Second derivatives of the log prior in z."""
        return self.setup.transform.curvature(z, np.zeros(len(self.setup.space.theta))).log_prior


def _log_mean(log_z: np.ndarray) -> float:
    top = float(np.max(log_z))
    return top if not np.isfinite(top) else top + float(np.log(np.mean(np.exp(log_z - top))))


class _WithoutMaximum(Exception):
    """The likelihood grows without bound, which ends the climb; says why."""


class ExactClimb:
    """Ascent of an exact log-likelihood with its exact score, in units in which it changes."""

    def __init__(self, setup: Maximization, model: ExactModel, method: DirectOptimization):
        self.setup, self.model, self.method = setup, model, method
        self.experiments = setup.problem.experiments
        self.exact = setup.exact_score(free_components(setup.problem.trace, setup.fixed))
        self.best, self.best_value = np.empty(0), -np.inf
        self.without_slope = ""  # at the last point of that kind
        self.iterates: list[np.ndarray] = []
        self.values: list[float] = []
        self.evaluations = 0
        self.held: Edges | None = None
        self.known: dict[bytes, float] = {}  # objective at the points since the last iterate
        self.unit = np.ones(len(setup.space.positions))  # (F,) what a climb takes for one
        self.fitted = np.full(len(self.unit), np.nan)  # z where that was measured last

    def run(self) -> Ascent:
        """All climbs, and Newton's steps from the best point."""
        restarts = self.method.restarts
        many = restarts is None and isinstance(self.model, HiddenMarkov)
        restarts = EXACT_RESTARTS if restarts is None else restarts
        interrupted, stopped, unbounded, gap = False, "", "", np.inf
        try:
            starts: Iterator[np.ndarray] = self._starts(restarts)
            if many and len(self.setup.start):
                restarts = SHORT_CLIMBS
                starts = iter([self.setup.start, *self._short_climbs()])
            for start in starts:
                stopped = self._quasi_newton(start)
                if len(self.best):
                    self._check(self.setup.transform.at(self.best).theta)
            if len(self.best):
                self._leave_flats()
                gap = self._polish()
        except KeyboardInterrupt:
            if not np.isfinite(self.best_value):
                raise
            interrupted = True
        except _WithoutMaximum as reason:
            unbounded = stopped = str(reason)
        if not np.isfinite(self.best_value):
            if self.without_slope:
                raise ArgumentError(
                    f"the likelihood cannot be maximised (no gradient): {self.without_slope}",
                    fix=ELSEWHERE,
                )
            raise ArgumentError(
                "the likelihood is zero at every point that was tried",
                fix="give start={name: value} near plausible values",
            )
        if not np.isfinite(gap) and not (interrupted or unbounded):
            stopped = (
                "no interior maximum was reached from this start; where scales are of other sizes "
                "than one, give start={name: value} of theirs"
            )
        point = self.setup.transform.at(self.best)
        report = {
            "converged": bool(gap < 1e-4), "stopped": stopped, "evaluations": self.evaluations,
            "likelihood": likelihood_by(self.model), "restarts": restarts,
        }  # fmt: skip
        if unbounded:
            report["without_maximum"] = True
        if self.exact.differences:
            report["central_differences"] = self.exact.differences
        return Ascent(
            point.theta, self.model.log_likelihood(self.experiments, point.theta),
            np.array(self.iterates), report, interrupted=interrupted,
            figures={"objective": np.array(self.values)},
            held=held_at(self.setup, self.held, point.theta),
        )  # fmt: skip

    def _starts(self, restarts: int) -> Iterator[np.ndarray]:
        """The start, and so many others about the best place by then."""
        yield self.setup.start
        for k in range(1, restarts + 1):
            rng = np.random.default_rng(self.setup.seed(k))
            centre = self.best if len(self.best) else self.setup.start
            yield centre + self.unit * rng.standard_normal(len(centre))

    def _short_climbs(self) -> list[np.ndarray]:
        """Where the best of many short climbs ended."""
        found = []
        self._fit_units(self.setup.start)
        for k in range(1, SHORT_CLIMBS + 1):
            rng = np.random.default_rng(self.setup.seed(k))
            iterates: list[np.ndarray] = []
            away = SPREAD * self.unit * rng.standard_normal(len(self.unit))
            self._in_units(self.setup.start + away, SHORT_STEPS, iterates.append)
            found.append((self.value(iterates[-1])[0], iterates[-1]))
        self.known.clear()
        return [z for _, z in sorted(found, key=lambda one: -one[0])[:GONE_ON_WITH]]

    def value(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """The objective and its gradient (F,) at z; -inf and zeros where there is none."""
        self.evaluations += 1
        nothing = -np.inf, np.zeros(len(z))
        point = self.setup.transform.at(z)
        if point.log_prior == -np.inf:
            return nothing
        try:
            value, gradient = self.exact.score(point.theta)
        except SamplingError:
            self._check(point.theta)
            if not np.isfinite(self.best_value):
                raise
            return nothing  # a step too far: rounding, as where scales are of all sizes
        slope = point.pull(gradient)
        if self.setup.with_prior:
            value, slope = value + point.log_prior, slope + point.d_log_prior
        if not np.isfinite(value) or not np.all(np.isfinite(slope)):
            self.without_slope = (
                self.setup.transform.without_slope(value, point.theta, gradient)
                or self.without_slope
            )
            return nothing
        self.known[z.tobytes()] = value
        if value > self.best_value:
            self.best, self.best_value = np.array(z), value
        return value, slope

    def _check(self, theta: np.ndarray) -> None:
        reason = without_maximum(self.model, self.experiments, theta)
        if reason is not None:
            raise _WithoutMaximum(reason.reason)

    def _quasi_newton(self, start: np.ndarray) -> str:
        """A climb from start (F,), gone on with where other units fit at its end."""
        end, stopped = start, ""

        def visit(z: np.ndarray) -> None:
            nonlocal end
            end = z
            self._remember(z)

        self._fit_units(start)
        for _ in range(UNITS):
            before = self.unit
            stopped = self._in_units(end, self.method.steps, visit)
            self._fit_units(end)
            if np.array_equal(self.unit, before):
                break
        return stopped

    def _in_units(self, start: np.ndarray, steps: int, visit: Callable[[np.ndarray], None]) -> str:
        """A climb in steps of the units, of at most so many; as `quasi_newton`."""
        unit = self.unit

        def value(v: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = self.value(unit * v)
            return value, unit * slope

        return quasi_newton(value, start / unit, steps, lambda v: visit(unit * v))

    def _fit_units(self, z: np.ndarray) -> None:
        """Units that fit the objective round z (F,), of numbers of the whole line, which may be of
        any size; those of logarithms and shares stay one."""
        if not np.array_equal(z, self.fitted):
            self.unit = units_at(self._objective, z, self.unit, self.setup.space.on_the_line)
            self.fitted = z

    def _objective(self, z: np.ndarray) -> float:
        try:
            return self.setup.exact_objective(z)
        except SamplingError:
            return -np.inf

    def _leave_flats(self) -> None:
        """Climb again from the other side of a flat stretch: a spread that is a millionth of the
        others counts for nothing, and nothing tells that it should be larger."""
        for _ in range(FLATS):
            z, before = self.best, self.best_value
            curvature = np.diagonal(_curvature(self.setup, self.exact, z))
            for j in np.flatnonzero(curvature * self.unit**2 < FLAT):
                for step in (sign * s for s in INWARDS for sign in (-1.0, 1.0)):
                    there = z.copy()
                    there[j] += step
                    with contextlib.suppress(SamplingError, _WithoutMaximum):
                        if self.setup.exact_objective(there) > self.best_value:  # no slope yet
                            self.value(there)
            if not self.best_value > before + AT_MOST:
                break
            self._quasi_newton(self.best)

    def _polish(self) -> float:
        """Newton's steps while they climb; how far the quadratic says that the top still is.

        Parameters whose maximum is at an edge of their support stay where the climb left them.
        """
        gap = np.inf
        theta = self.setup.transform.at(self.best).theta
        found = self.held = edges(self.setup, theta, self.exact.information(theta))
        kept = np.ones(len(self.best), dtype=bool) if found is None else found.kept
        free = self.exact.free.copy()
        free[list(found.components) if found is not None else []] = False
        if not kept.any():
            return 0.0
        exact = self.setup.exact_score(free)
        for _ in range(NEWTON_STEPS):
            value, slope = self.value(self.best)
            curvature = _curvature(self.setup, exact, self.best)[np.ix_(kept, kept)]
            if not _positive_definite(curvature):
                return np.inf
            slope, step = slope[kept], np.zeros(len(kept))
            step[kept] = np.linalg.solve(curvature, slope)
            gap = float(np.sqrt(max(float(slope @ step[kept]), 0.0)))
            if gap < GRADIENT:
                break
            z, size = self.best, 1.0
            new, _ = self.value(z + step)
            while new < value and size > 1e-3:
                size *= 0.5
                new, _ = self.value(z + size * step)
            if not new > value:
                if gap < 1e-5:  # a gain below the rounding of the likelihood: the step is right
                    self.best = z + step
                break
            self._remember(self.best)
        return gap

    def _remember(self, z: np.ndarray) -> None:
        """z is one of the iterates."""
        if z.tobytes() not in self.known:
            self.value(z)
        self.iterates.append(self.setup.space.parameters(z)[0].copy())
        self.values.append(self.known.get(z.tobytes(), -np.inf))
        self.known.clear()


class BatchedClimb:
    """Ascent of the extended Kalman filter's log-likelihood where the model calls a simulator: all
    points of a step together, from the best of some places round the start."""

    def __init__(self, setup: Maximization, model: Extended, method: DirectOptimization):
        self.setup, self.model, self.method = setup, model, method
        self.evaluations = 0
        self.best, self.best_value = np.empty(0), -np.inf

    def run(self) -> Ascent:
        """The climb. Ctrl-C ends it early, with the best so far."""
        setup = self.setup
        try:
            found = climb_together(self.parts, self._starts())
        except KeyboardInterrupt:
            if not len(self.best):
                raise
            report: dict[str, Any] = {"converged": False, "evaluations": self.evaluations}
            report["likelihood"] = likelihood_by(self.model)
            theta = self._theta(self.best)
            return Ascent(theta, None, theta[None], report, interrupted=True)
        if found is None:
            raise ArgumentError(
                "the extended Kalman filter is not finite (NaN or infinite) at every point tried",
                fix="give start={name: value} near plausible values, or look whether the simulator "
                "gives NaN",
            )
        top, path = found.top, [self._theta(z) for z in found.path]
        information, held, report = top.information, None, {
            "converged": found.ended, "evaluations": self.evaluations,
            "likelihood": likelihood_by(self.model),
        }  # fmt: skip
        theta = self._theta(top.z)
        if setup.with_prior:
            nothing = np.zeros(len(theta))
            information = information + setup.transform.curvature(top.z, nothing).log_prior
        natural = setup.natural(top.z, information)
        if _lowest(top.information) < FLAT:
            held = edges(setup, theta, natural, self.objective)
            if held is not None:
                report["converged"] = True
        return Ascent(
            theta, self.model.log_likelihood(setup.problem.experiments, theta), np.array(path),
            report, natural, held=held,
        )  # fmt: skip

    def _starts(self) -> np.ndarray:
        """The user's own point where all is given; else the best of some round the start."""
        space, trace = self.setup.space, self.setup.problem.trace
        z = space.z[space.positions]
        restarts = self.method.restarts
        if set(trace.parameters) - set(self.setup.fixed) <= set(self.setup.near) and not restarts:
            return z[None]
        rng = np.random.default_rng(self.setup.seed(0))
        points = np.vstack([z, z + SPREAD * rng.standard_normal((LOOKED_AT, len(z)))])
        values = self.objectives(points)
        best = np.argsort(-values)[: 1 + (SIDE_BY_SIDE if restarts is None else restarts)]
        return points[best]

    def objectives(self, z: np.ndarray) -> np.ndarray:
        """(B,) the log-likelihood at z (B, F), with the prior where it counts; -inf for none."""
        return summed(self.parts(z))

    def parts(self, z: np.ndarray) -> Parts:
        """The same sums, the last part 0 where the prior does not count."""
        self.evaluations += len(z)
        found = [self.setup.space.point(row) for row in z]
        theta, prior, _ = (np.array(part) for part in zip(*found, strict=True))
        data = self.setup.problem.experiments
        if not self.setup.with_prior:  # it says where the density is, and no more
            prior = np.where(prior > -np.inf, 0.0, -np.inf)
        out = parts_of(partial(self.model.increments_and_predictions, data), theta, prior)
        total = summed(out)
        k = int(np.argmax(total))
        if total[k] > self.best_value:
            self.best, self.best_value = z[k].copy(), float(total[k])
        return out

    def objective(self, z: np.ndarray) -> float:
        """Likewise, of one point."""
        return float(self.objectives(z[None])[0])

    def _theta(self, z: np.ndarray) -> np.ndarray:
        return self.setup.space.parameters(z)[0].copy()


def observed_information(setup: Maximization, z: np.ndarray) -> np.ndarray:
    """Minus the second derivatives of the objective in z (F,), (F, F), by the exact score."""
    free = free_components(setup.problem.trace, setup.fixed)
    return _curvature(setup, setup.exact_score(free), z)


def _curvature(setup: Maximization, exact: Any, z: np.ndarray) -> np.ndarray:
    point = setup.transform.at(z)
    _, gradient = exact.score(point.theta)
    second = setup.transform.curvature(z, gradient)
    out = point.jacobian.T @ exact.information(point.theta) @ point.jacobian - second.theta
    return out - second.log_prior if setup.with_prior else out


def _positive_definite(matrix: np.ndarray) -> bool:
    """Whether it is, as a matrix of correlations: rounding of its largest entries says nothing of
    the others, which are in other units."""
    with np.errstate(all="ignore"):
        scale = np.sqrt(np.diagonal(matrix))
        scaled = matrix / np.outer(scale, scale)
    return bool(np.all(np.isfinite(scaled))) and _lowest(scaled) > 0.0


def _lowest(matrix: np.ndarray) -> float:
    return float(np.linalg.eigvalsh(matrix)[0])
