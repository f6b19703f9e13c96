"""The Rao-Blackwellised particle filter, and backward simulation over it, in the model's states.

The filter carries the states x that are sampled and the moments of the linear ones, z
(`analysis/elimination/marginal.py`). What is known of z_t is a mixture of Gaussians, one of each
particle: its mean and covariance are exact given the particles, its quantiles come from one draw of
each. Given a path of x, z is drawn by the backward sampler of the Kalman filter.

Paths of x and z together are drawn backwards (F. Lindsten and T. Schön, "Backward simulation
methods for Monte Carlo statistical inference", *Foundations and Trends in Machine Learning* 6,
2013, section 5): given x_{t+1} and z_{t+1}, the index of x_t has the probabilities

    w_t^i p(x_{t+1}, z_{t+1} | x_t^i, m_t^i, P_t^i),

in which z_t is integrated out, and z_t is drawn given all of these. x alone would not do: without
z its future depends on its whole past. Of the joint path only that of x is kept; z is drawn anew
given it by the Kalman filter's backward sampler, and so owes nothing to the particles but x.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssmppl.analysis.density import Term, terms
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.kernels.particle.weights import NAN, OK, summarise
from ssmppl.codegen.modules.marginal import NAMES, MarginalFilter
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.inference.exact import kalman_matrices
from ssmppl.inference.exact.kalman_matrices import Stopped, drawn
from ssmppl.inference.methods.methods import FFBSi
from ssmppl.inference.particles.backward import ParticleSystem, draw_particles, pair_failure
from ssmppl.inference.particles.filtering import FilterRun, FilterSettings, failure, run_filter
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import fill_normal, fill_uniform
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.trace import previous, seen

MOST_VALUES = 100_000  # particles times steps whose moments are computed at a time
MOST_PAIRS = 2_000_000  # particles times trajectories that are weighed at a time
# Particles without weight may lie where the laws are infinite or undefined, and others so far from
# what follows them that their density is zero.
WITHOUT_WEIGHT: dict[str, Any] = {"divide": "ignore", "invalid": "ignore", "over": "ignore"}
NEGLIGIBLE = 1e-12  # of a variance, what rounding leaves of it
ROUNDING, TINY = 1e-13, 1e-300  # of a value, likewise; a variance, so that none is zero


def is_marginal(proposal: str) -> bool:
    """Whether a proposal's name is one of a Rao-Blackwellised filter."""
    return proposal in NAMES


def marginal_of(problem: Problem) -> MarginalFilter:
    """The Rao-Blackwellised filters of a problem that has them."""
    found = problem.program.marginal
    assert not isinstance(found, NotApplicable)
    return found


@dataclass(frozen=True)
class Columns:
    """Where the model's states stand.

    sampled : of each state that is sampled, its index among the model's states and in the filter.
    linear : indices among the model's states of z. coupled : of the coupled x, in the filter.
    channels : indices of the components of y that tell of z.
    """

    sampled: tuple[tuple[int, int], ...]
    linear: tuple[int, ...]
    coupled: tuple[int, ...]
    channels: tuple[int, ...]


def columns_of(problem: Problem) -> Columns:
    """The places of the states of a problem."""
    trace, found = problem.trace, marginal_of(problem).found
    place = {s: i for i, s in enumerate(found.trace.state_symbols)}
    own = {s: i for i, s in enumerate(trace.state_symbols)}
    y = {s: i for i, s in enumerate(trace.observation_symbols)}
    return Columns(
        tuple((i, place[s]) for s, i in own.items() if s in place),
        tuple(own[s] for s in found.split.linear),
        tuple(place[s] for s in found.split.coupled),
        tuple(y[s] for s in found.channels),
    )


def marginal_run(
    problem: Problem, experiment: Experiment, theta: np.ndarray, settings: FilterSettings,
    rng: np.ndarray, probabilities: np.ndarray, stream: np.ndarray,
) -> FilterRun:  # fmt: skip
    """As `full_run` of the other filters, with the means and covariances of z exact given x.

    Raises
    ------
    SamplingError : all weights vanish, or are NaN; names the step, the user's line, the parameters.
    """
    found, n = marginal_of(problem), settings.particles
    d, k = len(found.found.trace.state_symbols), len(problem.trace.observation_symbols)
    steps, nothing = experiment.steps, np.empty(0)
    particles, weights = np.empty((steps, d, n)), np.empty((steps, n))
    increments, ess = np.empty(steps), np.empty(steps)
    size, p = len(problem.trace.state_symbols), len(probabilities)
    predicted = np.empty((steps, 4, k)), np.empty((steps, p, k))
    prediction = predicted[0], probabilities, predicted[1], stream
    moments = nothing, np.empty((steps, d)), np.empty((steps, d, d)), np.empty((steps, 0, d))
    kept = particles, weights, np.zeros((steps, n), dtype=np.int32)
    status, t = run_filter(
        problem, theta, settings, experiment, rng, increments, ess, (*moments, prediction), kept
    )
    if status != OK:
        raise failure(problem, theta, status, t, experiment)
    out = FilterRun(
        increments, ess, np.empty((steps, size)), np.empty((steps, size, size)),
        np.empty((steps, p, size)), *predicted,
    )  # fmt: skip
    chunk = max(1, MOST_VALUES // n)
    for first in range(0, steps, chunk):
        rows = slice(first, min(first + chunk, steps))
        _summarise(problem, experiment, theta, rows, particles, weights, probabilities, rng, out)
    return out


def _summarise(
    problem: Problem, experiment: Experiment, theta: np.ndarray, rows: slice,
    particles: np.ndarray, weights: np.ndarray, probabilities: np.ndarray, rng: np.ndarray,
    out: FilterRun,
) -> None:  # fmt: skip
    """Moments and quantiles of some rows."""
    columns = columns_of(problem)
    mean, covariance = filtered_moments(problem, experiment, theta, rows, particles)
    size, z = out.mean.shape[1], list(columns.linear)
    for t in range(rows.start, rows.stop):
        own, w = np.empty((size, particles.shape[2])), weights[t]
        m, v = mean[t - rows.start], covariance[t - rows.start]  # (n, N), (n, n, N)
        for i, j in columns.sampled:
            own[i] = particles[t, j]
        own[z] = m
        summarise(own, w, np.empty(0), out.mean[t], out.covariance[t], np.empty((0, size)))
        out.covariance[t][np.ix_(z, z)] += np.where(w > 0.0, v, 0.0) @ w
        if len(probabilities):
            normals = np.empty(m.size)
            fill_normal(rng, normals)
            sd = np.sqrt(np.maximum(np.diagonal(v).T, 0.0))
            own[z] = m + sd * normals.reshape(m.shape)
            summarise(
                own, w, probabilities, np.empty(size), np.empty((size, size)), out.quantiles[t]
            )


def filtered_moments(
    problem: Problem, experiment: Experiment, theta: np.ndarray, rows: slice, particles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means (R, n, N) and covariances (R, n, n, N) of z_t given y_t too, for R rows."""
    found = marginal_of(problem).found
    values = {s: at_rows(v, rows) for s, v in values_of(problem, experiment, theta).items()}
    for i, s in enumerate(found.trace.state_symbols):
        values[s] = particles[rows, i]
    flat = [*found.filtered_mean, *found.filtered_covariance.ravel()]
    shape = (rows.stop - rows.start, particles.shape[2])
    with np.errstate(invalid="ignore", divide="ignore"):  # where(measured, ..., 0) computes both
        found_values = [np.broadcast_to(v, shape) for v in evaluate(flat, values)]
    n = len(found.mean)
    mean = np.stack(found_values[:n], axis=1)
    return mean, np.stack(found_values[n:], axis=1).reshape(shape[0], n, n, shape[1])


def at_rows(value: np.ndarray, rows: slice) -> np.ndarray:
    """A number as it is, a column's rows as (R, 1)."""
    return value if np.ndim(value) == 0 else np.asarray(value)[rows, None]


def values_of(
    problem: Problem, experiment: Experiment, theta: np.ndarray
) -> dict[Expr, np.ndarray]:
    """Values of every symbol but those of states, numbers or one for each row."""
    values = kalman_matrices.values_of(problem.trace, experiment, theta)
    for s, column, measured in zip(
        problem.trace.observation_symbols, experiment.y.T, experiment.seen.T, strict=True
    ):
        values[s] = column
        values[seen(s)] = measured
    return values


def draw_given(
    problem: Problem, experiment: Experiment, theta: np.ndarray, paths: np.ndarray,
    stream: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Paths (M, T, D) of all states, those of z drawn given those of x.

    paths : (M, T, D') of the filter, of which the sampled states are read. stream : advanced in
        place.

    Raises
    ------
    SamplingError : the distributions of z have no density given some path.
    """
    m, steps, _ = paths.shape
    width = max(1, MOST_VALUES // steps)
    out = np.empty((m, steps, len(problem.trace.state_symbols)))
    for first in range(0, m, width):
        part = slice(first, first + width)
        _draw_part(problem, experiment, theta, paths[part], stream, out[part])
    return out


def _draw_part(
    problem: Problem, experiment: Experiment, theta: np.ndarray, paths: np.ndarray,
    stream: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    columns, found = columns_of(problem), marginal_of(problem).found
    values = values_of(problem, experiment, theta)
    before = np.maximum(np.arange(paths.shape[1]) - 1, 0)
    for i, s in enumerate(found.trace.state_symbols):
        values[s], values[previous(s)] = paths[:, :, i], paths[:, before, i]
    fields = [getattr(found.given, name) for name in Matrices._fields]
    flat = iter(evaluate([e for f in fields for e in f.ravel()], values))
    entries = [np.empty((*paths.shape[:2], *f.shape)) for f in fields]
    for f, entry in zip(fields, entries, strict=True):
        for place in np.ndindex(f.shape):
            entry[:, :, *place] = next(flat)
    c, exact = list(columns.channels), list(columns.coupled)
    known = np.ones((paths.shape[1], len(exact)))
    seen_rows = np.ascontiguousarray(np.hstack([experiment.seen[:, c], known]))
    for i, path in enumerate(paths):
        model = Matrices(entries[0][i, 0], entries[1][i, 0], *(e[i] for e in entries[2:]))
        y = np.ascontiguousarray(np.hstack([experiment.y[:, c], path[:, exact]]))
        stacked = replace(experiment, y=y, seen=seen_rows)
        try:
            _, z = drawn(model, np.ascontiguousarray(model.m[:, None]), stacked, stream, 1)
        except Stopped as stop:
            raise kalman_matrices.failure(problem.trace, theta, stop.status, stop.t) from None
        out[i][:, list(columns.linear)] = z[0][:, len(exact) :]
    for own, theirs in columns.sampled:
        out[:, :, own] = paths[:, :, theirs]


def may_integrate(problem: Problem, method: FFBSi) -> bool:
    """Whether FFBSi is to draw its paths so: where it was asked for, or left to the model.

    Raises
    ------
    ArgumentError : it was asked for and does not apply; gives the reason.
    """
    asked = is_marginal(method.proposal)
    none = isinstance(problem.program.marginal, NotApplicable)
    if none or not (asked or method.proposal == "auto"):
        return asked  # what does not exist is refused where the proposal is looked up
    reason: NotApplicable | None = _refusal(problem)
    if method.kernel not in ("auto", "exact"):
        reason = NotApplicable(f'kernel="{method.kernel}" is of filters of all states')
    if asked and reason is not None:
        raise ArgumentError(
            f'FFBSi(proposal="{method.proposal}") does not apply: {reason}',
            fix='use kernel="auto" with a proposal of all states, "bootstrap" or "guided"',
        )
    return reason is None


def _refusal(problem: Problem) -> NotApplicable | None:
    """Why paths cannot be drawn so; None where they can."""
    found = marginal_of(problem).found
    moments = {*found.mean, *found.covariance.ravel()}
    before = set(found.trace.state_prev_symbols)
    for site in found.trace.transition.values():
        if isinstance(site.distribution, Dirac) and not moments & set(site.components):
            if before & symbols_of(array(site.distribution.mean()).ravel()):
                return NotApplicable(
                    f"{site.name} follows from the state before without noise, so that no "
                    "particle but its own ancestor can have come before it",
                    site.distribution.location,
                )
    return None


def marginal_paths(
    problem: Problem, theta: np.ndarray, experiment: Experiment, system: ParticleSystem,
    trajectories: int, stream: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Trajectories (M, T, D) of all states; `system` holds the particles of the marginal model."""
    paths, _ = backward_pass(problem, theta, experiment, system, trajectories, stream)
    return draw_given(problem, experiment, theta, paths, stream)


def backward_pass(
    problem: Problem, theta: np.ndarray, experiment: Experiment, system: ParticleSystem,
    trajectories: int, stream: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Paths of the particles (M, T, D') and of z (M, T, n), drawn backwards together."""
    steps, d, n = system.particles.shape
    law = _Law(problem, experiment, theta, system)
    index = draw_particles(system.weights[-1], trajectories, stream)
    paths = np.empty((trajectories, steps, d))
    paths[:, -1] = system.particles[-1][:, index].T
    mean, covariance = law.filtered(steps - 1)
    z = _gaussian(mean[:, index], covariance[:, :, index], stream)
    linear = np.empty((trajectories, steps, len(z)))
    linear[:, -1] = z.T
    for t in range(steps - 2, -1, -1):
        x = paths[:, t + 1].T
        uniforms, chosen = np.empty(trajectories), np.empty(trajectories, dtype=np.int64)
        fill_uniform(stream, uniforms)
        width, earlier = max(1, MOST_PAIRS // n), np.empty_like(z)
        for own in law.alike(x):
            with np.errstate(**WITHOUT_WEIGHT):
                step = law.step(t, x[:, own[0]])
            for first in range(0, len(own), width):
                part = own[first : first + width]
                with np.errstate(**WITHOUT_WEIGHT):
                    log_w = step.log_weights(x[:, part], z[:, part])
                if not np.all(np.isfinite(log_w.max(axis=0))):
                    raise pair_failure(problem, theta, NAN, t, experiment)
                chosen[part] = _drawn_indices(log_w, uniforms[part])
            earlier[:, own] = step.draw(x[:, own], z[:, own], chosen[own], stream)
        z = earlier
        paths[:, t], linear[:, t] = system.particles[t][:, chosen].T, z.T
    return paths, linear


def _drawn_indices(log_w: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
    """An index by each column of unnormalised log weights (N, M)."""
    w = np.exp(log_w - log_w.max(axis=0))
    cumulative = np.cumsum(w, axis=0)
    below = cumulative <= uniforms * cumulative[-1]
    return np.minimum(below.sum(axis=0), len(w) - 1)


class _Law:
    """What the particles know, row by row; moments are computed for many rows at a time."""

    def __init__(
        self, problem: Problem, experiment: Experiment, theta: np.ndarray, system: ParticleSystem
    ):
        self.problem, self.experiment, self.theta, self.system = problem, experiment, theta, system
        self.values = values_of(problem, experiment, theta)
        found = marginal_of(problem).found
        self.found, self.columns = found, columns_of(problem)
        moments = {*found.mean, *found.covariance.ravel(), *found.split.coupled}
        self.free: list[Term] = [
            t for t in terms(found.trace, "transition")
            if not moments & set(t.site.components) and not isinstance(t.site.distribution, Dirac)
        ]  # fmt: skip
        forms = (found.given.A, found.given.b, found.given.Q)
        inside = symbols_of(e for f in forms for e in f.ravel())
        self.read = [i for i, s in enumerate(found.trace.state_symbols) if s in inside]
        self._rows, self._moments = range(0), (np.empty(0), np.empty(0))

    def alike(self, x: np.ndarray) -> list[np.ndarray]:
        """Indices of trajectories, of new values (D', M), under the same distribution of (coupled
        x, z): all of them, or where it reads new values, those that agree in these."""
        if not self.read:
            return [np.arange(x.shape[1])]
        _, which = np.unique(x[self.read], axis=1, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        return np.split(order, np.flatnonzero(np.diff(which.ravel()[order])) + 1)

    def filtered(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Means (n, N) and covariances (n, n, N) of z_t given y_t."""
        if t not in self._rows:
            chunk = max(1, MOST_VALUES // self.system.particles.shape[2])
            rows = slice(max(0, t + 1 - chunk), t + 1)
            self._rows = range(rows.start, rows.stop)
            self._moments = filtered_moments(
                self.problem, self.experiment, self.theta, rows, self.system.particles
            )
        at = t - self._rows.start
        return self._moments[0][at], self._moments[1][at]

    def step(self, t: int, x: np.ndarray) -> _Step:
        """The distribution of row t + 1 given the particles of row t, and new values (D',) where it
        reads any."""
        given, n = self.found.given, self.system.particles.shape[2]
        row = slice(t + 1, t + 2)
        values = {s: at_rows(v, row) for s, v in self.values.items()}
        for i, s in enumerate(self.found.trace.state_symbols):
            values[previous(s)] = self.system.particles[t, i][:, None]
        given_new = {self.found.trace.state_symbols[i]: x[i] for i in self.read}
        k = len(self.found.split.coupled)
        a_form = given.A[:, k:]
        flat = [*a_form.ravel(), *given.b, *given.Q.ravel()]
        found = [np.broadcast_to(v, (n, 1))[:, 0] for v in evaluate(flat, values | given_new)]
        size = len(given.b)
        a = np.reshape(found[: a_form.size], (*a_form.shape, n))
        b = np.reshape(found[a_form.size : a_form.size + size], (size, n))
        q = np.reshape(found[a_form.size + size :], (size, size, n))
        mean, covariance = self.filtered(t)
        cross = np.einsum("ijn,kjn->ikn", covariance, a)  # of z_t with (coupled x, z)_{t+1}
        spread = np.einsum("ijn,jkn->ikn", a, cross) + q
        predicted = np.einsum("ijn,jn->in", a, mean) + b
        log_w = np.log(self.system.weights[t])
        return _Step(self, values, log_w, mean, covariance, cross, predicted, spread)


class _Step:
    """One step back; N particles, M trajectories."""

    def __init__(
        self, law: _Law, values: dict, log_w: np.ndarray, mean: np.ndarray,
        covariance: np.ndarray, cross: np.ndarray, predicted: np.ndarray, spread: np.ndarray,
    ):  # fmt: skip
        self.law, self.values, self.log_w = law, values, log_w
        self.mean, self.covariance, self.cross = mean, covariance, cross
        self.predicted = predicted
        self.factor, self.pivots = _factorised(spread)
        self.variances = np.einsum("jjn->jn", spread)

    def _following(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.concatenate([x[list(self.law.columns.coupled)], z])

    def log_weights(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """log w p(x_{t+1}, z_{t+1} | particle), (N, M), of the particles given."""
        v = self._following(x, z)
        total = np.repeat(self.log_w[:, None], v.shape[1], axis=1)
        residuals: list[np.ndarray] = []
        for j in range(len(v)):
            e = v[j] - self.predicted[j][:, None]
            for i, earlier in enumerate(residuals):
                e = e - self.factor[j, i][:, None] * earlier
            residuals.append(e)
            own = self.pivots[j][:, None]
            known = own == 0.0
            if known.any():
                # Where a particle tells the component exactly the width is that of rounding, not
                # none: one that tells another value did not lead here.
                size = np.abs(v[j]) + np.abs(self.predicted[j])[:, None]
                rounding = NEGLIGIBLE * self.variances[j][:, None] + (ROUNDING * size) ** 2 + TINY
                height = np.where(known, rounding, 0.0).max(axis=0)  # of point masses all alike
                total += -0.5 * np.log(np.where(known, height, own))
                own = np.where(known, rounding, own)
            else:
                total += -0.5 * np.log(own)
            total += -0.5 * e**2 / own
        if self.law.free:
            values = dict(self.values)
            for i, s in enumerate(self.law.found.trace.state_symbols):
                values[s] = x[i]
            for found in evaluate([t.log_density for t in self.law.free], values):
                total += found
        return np.where(self.log_w[:, None] == -np.inf, -np.inf, total)

    def draw(
        self, x: np.ndarray, z: np.ndarray, chosen: np.ndarray, stream: np.ndarray
    ) -> np.ndarray:
        """z_t (n, M) given x_{t+1}, z_{t+1} and the particle that was chosen for each."""
        v = self._following(x, z)
        mean, covariance = self.mean[:, chosen], self.covariance[:, :, chosen]
        factor, pivots = self.factor[:, :, chosen], self.pivots[:, chosen]
        residuals: list[np.ndarray] = []
        crosses: list[np.ndarray] = []
        for j in range(len(v)):
            e = v[j] - self.predicted[j, chosen]
            c = self.cross[:, j, chosen]
            for i, (earlier, before) in enumerate(zip(residuals, crosses, strict=True)):
                e, c = e - factor[j, i] * earlier, c - factor[j, i] * before
            residuals.append(e)
            crosses.append(c)
            known = pivots[j] > 0.0
            weight = np.where(known, 1.0 / np.where(known, pivots[j], 1.0), 0.0)
            mean = mean + c * weight * e
            covariance = covariance - np.einsum("im,jm->ijm", c, c) * weight
        return _gaussian(mean, covariance, stream)


def _factorised(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """L (k, k, N), unit lower triangular, and D (k, N) of covariances (k, k, N) = L D L'.

    A pivot that rounding alone has left is 0, with nothing below it.
    """
    k, n = covariance.shape[0], covariance.shape[2]
    factor, pivots = np.zeros((k, k, n)), np.zeros((k, n))
    for j in range(k):
        for i in range(j, k):
            left = covariance[i, j] - np.sum(factor[i, :j] * factor[j, :j] * pivots[:j], axis=0)
            if i == j:
                pivots[j] = np.where(left > NEGLIGIBLE * covariance[j, j], left, 0.0)
                factor[j, j] = 1.0
            else:
                safe = np.where(pivots[j] > 0.0, pivots[j], 1.0)
                factor[i, j] = np.where(pivots[j] > 0.0, left / safe, 0.0)
    return factor, pivots


def _gaussian(mean: np.ndarray, covariance: np.ndarray, stream: np.ndarray) -> np.ndarray:
    """A draw (n, M) from each of M Gaussians; singular ones too."""
    factor, pivots = _factorised(covariance)
    normals = np.empty(mean.size)
    fill_normal(stream, normals)
    return mean + np.einsum("ijm,jm->im", factor, np.sqrt(pivots) * normals.reshape(mean.shape))
