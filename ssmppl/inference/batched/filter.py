"""The extended Kalman filter of many parameter vectors at once, in NumPy.

The same filter as `codegen/kernels/twisted/lookahead.py:follow_filter`, whose update is the mode of
each row; here every number is an array over lanes, a lane for each parameter vector and data set,
so that a simulator in the transition is called once a row, whatever the number of vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.twisted import LookaheadModel, jacobian, lookahead_model
from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, depends_on
from ssmppl.inference.batched.observed import Part, Seen, gaussian_observation
from ssmppl.inference.optimisation.parts import Predictions
from ssmppl.language.model.trace import Trace

NEWTON_STEPS, HALVINGS, CLOSE = 10, 40, 0.05  # as in the compiled filter
RESOLVED = 1e-13


@dataclass(frozen=True)
class Moments:
    """Moments of x_t in each of L lanes: mean (L, D) and covariance (L, D, D) given y_{1:t},
    predicted (L, D) and its covariance (L, D, D) given y_{1:t-1}, cross (L, D, D) of x_{t-1} with
    x_t."""

    mean: np.ndarray
    covariance: np.ndarray
    predicted: np.ndarray
    predicted_covariance: np.ndarray
    cross: np.ndarray


class BatchedFilter:
    """The filter of a model. found : the model by its noises.

    States that follow from parameters and inputs alone, as the line of an input's delay, are moved
    and have no covariance: the filter is of the others, of whom there are N.
    """

    def __init__(self, trace: Trace, found: LookaheadModel):
        self.trace, self.flat = trace, found.flat
        d = self.size = len(trace.state_symbols)
        first, later = found.initial, found.transition
        self.own = own = _uncertain(found, trace)
        n, both = len(own), np.ix_(own, own)
        slope, curvature = jacobian(later, trace)[both], found.curvature[both]
        half = [curvature[i, j] for i in range(n) for j in range(i + 1)]
        place = np.zeros((n, n), dtype=int)  # of each entry of a curvature among these
        place[np.tril_indices(n)] = np.arange(len(half))
        self._half = np.maximum(place, place.T).ravel()
        self._begin = Part(trace, [*first.at_rest(), *first.spread()[own].ravel()])
        self._move = Part(trace, [*later.at_rest(), *slope.ravel(), *later.spread()[own].ravel()])
        self._look = Part(trace, [found.observed, *found.slope[own], *half])
        self._predict = gaussian_observation(trace, own)
        self._everywhere = n == d

    def log_likelihoods(
        self, experiments: Sequence[Experiment], theta: np.ndarray,
        record: list[Moments] | None = None,
    ) -> np.ndarray:  # fmt: skip
        """(B,) log p(y | theta) of each row of theta (B, P), summed over the data sets; -inf where
        it is not finite, or to none that floating point resolves.

        record : takes the moments of each row; of a single data set.
        """
        increments = self.increments(experiments, theta, record)
        total: np.ndarray = increments.sum(axis=1)
        return total

    def increments(
        self, experiments: Sequence[Experiment], theta: np.ndarray,
        record: list[Moments] | None = None,
    ) -> np.ndarray:  # fmt: skip
        """(B, R) likewise, of each of the R rows of all data sets; -inf in all of them where a
        point has no number."""
        return self._followed(_Lanes(self.trace, experiments, np.asarray(theta)), record, None)

    def increments_and_predictions(
        self, experiments: Sequence[Experiment], theta: np.ndarray
    ) -> tuple[np.ndarray, Predictions | None]:
        """The increments, and the predictions of each row by what is linear there; None of
        observations that are not Gaussian."""
        lanes, seen = _Lanes(self.trace, experiments, np.asarray(theta)), list[Seen]()
        rows = self._followed(lanes, None, seen)
        if not seen or len(seen) < lanes.steps:
            return rows, None
        error, covariance = (np.stack(part, axis=1) for part in zip(*seen, strict=True))
        return rows, Predictions(lanes.of_vectors(error), lanes.of_vectors(covariance))

    def _followed(
        self, lanes: _Lanes, record: list[Moments] | None, seen: list[Seen] | None
    ) -> np.ndarray:
        """(B, R) increments; `seen` takes the predictions of each row."""
        out = np.zeros((lanes.count, lanes.steps))
        dead = np.zeros(lanes.count, dtype=bool)
        x = covariance = np.empty(0)
        with np.errstate(all="ignore"):
            for t in range(lanes.steps):
                lanes.at(t)
                if t == 0:
                    rest, spread = self._started(lanes)
                    p = spread @ spread.transpose(0, 2, 1)
                    cross = np.zeros_like(p)
                else:
                    rest, slope, spread = self._moved(lanes, x)
                    cross = covariance @ slope.transpose(0, 2, 1)
                    p = slope @ cross + spread @ spread.transpose(0, 2, 1)
                if seen is not None and self._predict is not None:
                    seen.append(self._predict(lanes, rest, p))
                increment, x, covariance = self._updated(lanes, rest, p)
                after, before = (np.einsum("lii->li", c) for c in (covariance, p))
                fine = (after >= RESOLVED * before) & np.isfinite(x[:, self.own])
                going = lanes.going
                if not (fine.all() and np.isfinite(increment).all()):
                    dead |= ~(fine.all(axis=1) & np.isfinite(increment)) & going
                    if dead.all():
                        break
                out[:, t] = increment if going is True else np.where(going, increment, 0.0)
                if record is not None:
                    after, before, cross = map(self._embedded, (covariance, p, cross))
                    record.append(Moments(x, after, rest, before, cross))
                if dead.any():  # in place of what is no number
                    alive = int(np.argmin(dead))
                    x = np.where(dead[:, None], x[alive], x)
                    covariance = np.where(dead[:, None, None], covariance[alive], covariance)
        out[dead] = -np.inf
        return lanes.of_vectors(out)

    def _started(self, lanes: _Lanes) -> tuple[np.ndarray, np.ndarray]:
        d, n = self.size, len(self.own)
        values = self._begin(lanes, None, None)
        return values[:, :d], values[:, d:].reshape(len(values), n, -1)

    def _moved(self, lanes: _Lanes, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        d, n = self.size, len(self.own)
        values = self._move(lanes, None, x)
        slope, spread = values[:, d : d + n * n], values[:, d + n * n :]
        count = len(values)
        return values[:, :d], slope.reshape(count, n, n), spread.reshape(count, n, -1)

    def _moved_on(self, rest: np.ndarray, by: np.ndarray) -> np.ndarray:
        """States (L, D), those of the filter moved by (L, N)."""
        if self._everywhere:
            return rest + by
        out = rest.copy()
        out[:, self.own] += by
        return out

    def _embedded(self, covariance: np.ndarray) -> np.ndarray:
        """(L, D, D) of one (L, N, N), 0 of states that are known."""
        if self._everywhere:
            return covariance
        out = np.zeros((len(covariance), self.size, self.size))
        rows, columns = np.ix_(self.own, self.own)
        out[:, rows, columns] = covariance
        return out

    def _seen(self, lanes: _Lanes, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """log g (L,), its slope (L, N) and minus its curvature (L, N, N), not negative."""
        n = len(self.own)
        values = self._look(lanes, x, None)
        h = values[:, 1 + n + self._half].reshape(-1, n, n)
        if not self.flat:
            h = _positive_part(h)
        return values[:, 0], values[:, 1 : 1 + n], h

    def _updated(
        self, lanes: _Lanes, rest: np.ndarray, p: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Increments (L,) of the log-likelihood, means (L, D) and covariances (L, N, N) after."""
        height, g, h = self._seen(lanes, rest)
        log_det, after, move = _step(p, h, g, np.zeros_like(g))
        if self.flat:  # quadratic: one step, whose gain is known
            # log g at the mode, less (g - H move)' move / 2, the prior's part
            gained = 0.5 * np.einsum("li,li->l", g, move)
            return height + gained - 0.5 * log_det, self._moved_on(rest, move), after
        return self._climbed(lanes, rest, p, (height, g, h), (log_det, after, move))

    def _climbed(
        self, lanes: _Lanes, rest: np.ndarray, p: np.ndarray, seen: tuple[np.ndarray, ...],
        step: tuple[np.ndarray, ...],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """Newton's method, each lane with its own share of a step and its own end."""
        (height, g, h), (log_det, after, move) = seen, step
        toward, lead = np.zeros_like(g), np.zeros_like(g)
        active = np.ones(len(rest), dtype=bool)
        for _ in range(NEWTON_STEPS):
            target = g + np.einsum("lij,lj->li", h, toward - move)
            share = np.ones(len(rest))
            waiting = active.copy()
            best = height.copy()
            found = np.zeros(len(rest), dtype=bool)
            for _ in range(HALVINGS):
                gone = toward + share[:, None] * (move - toward)
                ahead = lead + share[:, None] * (target - lead)
                value = self._seen(lanes, self._moved_on(rest, gone))[0]
                new = value - 0.5 * np.sum(ahead * gone, axis=1)
                better = (new >= height) | (np.isfinite(new) & ~np.isfinite(height))
                taken = waiting & better
                best, found = np.where(taken, new, best), found | taken
                waiting &= ~better
                if not waiting.any():
                    break
                share = np.where(waiting, 0.5 * share, share)
            went = (share * found)[:, None]
            lead, toward = lead + went * (target - lead), toward + went * (move - toward)
            gained, height = best - height, best
            _, g_new, h_new = self._seen(lanes, self._moved_on(rest, toward))
            g = np.where(found[:, None], g_new, g)
            h = np.where(found[:, None, None], h_new, h)
            new_det, new_after, new_move = _step(p, h, g, toward)
            log_det = np.where(found, new_det, log_det)
            after = np.where(found[:, None, None], new_after, after)
            move = np.where(found[:, None], new_move, move)
            active &= found & ~(gained < CLOSE)
            if not active.any():
                break
        return height - 0.5 * log_det, self._moved_on(rest, toward), after


def _uncertain(found: LookaheadModel, trace: Trace) -> np.ndarray:
    """(N,) the places of the states that parameters and data up to a row do not determine."""
    initial, later = found.initial, found.transition
    uncertain = {
        k for form in (initial, later) for k, e in enumerate(form.value)
        if depends_on(e, form.noise)
    }  # fmt: skip
    before = dict(enumerate(trace.state_prev_symbols))
    while True:
        sources = [before[k] for k in uncertain]
        more = {k for k, e in enumerate(later.value) if depends_on(e, sources)} - uncertain
        if not more:
            return np.array(sorted(uncertain), dtype=int)
        uncertain |= more


class _Lanes:
    """Parameters and data of each lane: lane e B + b has the data set e and the vector b."""

    def __init__(self, trace: Trace, experiments: Sequence[Experiment], theta: np.ndarray):
        self.vectors, self.sets = len(theta), len(experiments)
        self.count = self.vectors * self.sets
        self.ends = np.repeat([e.steps for e in experiments], self.vectors)
        self.steps, self.shortest = int(self.ends.max()), int(self.ends.min())
        self.columns: dict[tuple[str, Any], int] = {}
        for kind, symbols in (
            ("observation", trace.observation_symbols), ("input", trace.input_symbols),
        ):  # fmt: skip
            self.columns |= {(kind, s.data[1:]): k for k, s in enumerate(symbols)}
        tiled = np.tile(np.asarray(theta, dtype=float), (self.sets, 1))
        self.theta = {s: tiled[:, k] for k, s in enumerate(trace.parameter_symbols)}
        self.arrays = {
            "observation": [e.y for e in experiments], "seen": [e.seen for e in experiments],
            "input": [e.u for e in experiments],
        }  # fmt: skip
        self.t, self.kept = 0, dict[Expr, Any]()

    def at(self, t: int) -> None:
        """Go to a row."""
        self.t, self.kept = t, {}

    @property
    def going(self) -> Any:
        """(L,) whether the lane's data have this row; True where all have."""
        return True if self.t < self.shortest else self.t < self.ends

    def measured(self) -> tuple[np.ndarray, np.ndarray]:
        """(L, K) the readings of the row in each lane, and whether there are any; none behind the
        end of a lane's data."""
        y, seen = (
            np.repeat([a[min(self.t, len(a) - 1)] for a in self.arrays[name]], self.vectors, axis=0)
            for name in ("observation", "seen")
        )  # fmt: skip
        return y, (seen == 1.0) & (self.t < self.ends)[:, None]

    def value(self, symbol: Expr) -> Any:
        """A number, or (L,), of a symbol that is no state's."""
        found = self.theta.get(symbol)
        if found is not None:
            return found
        if symbol not in self.kept:
            self.kept[symbol] = self._of_row(symbol)
        return self.kept[symbol]

    def _of_row(self, symbol: Expr) -> Any:
        kind, name, index = symbol.data
        if kind in ("time", "time_prev"):
            return self.t + (1.0 if kind == "time" else 0.0)
        base = kind.removesuffix("_prev")
        column = self.columns["observation" if base == "seen" else base, (name, index)]
        row = max(self.t - 1, 0) if kind.endswith("_prev") else self.t
        values = [a[min(row, len(a) - 1), column] for a in self.arrays[base]]
        return values[0] if self.sets == 1 else np.repeat(values, self.vectors)

    def of_vectors(self, rows: np.ndarray) -> np.ndarray:
        """(B, R, ...) of lanes (L, T, ...): the rows of all data sets, one after the other."""
        sets = rows.reshape(self.sets, self.vectors, *rows.shape[1:])
        return np.concatenate(sets, axis=1)


def _step(
    p: np.ndarray, h: np.ndarray, g: np.ndarray, toward: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One step of the update in information form: log det(I + P H), (I + P H)^-1 P, the step."""
    d = p.shape[1]
    s = p @ h
    np.einsum("lii->li", s)[:] += 1.0
    if d == 1:
        determinant, after = s[:, 0, 0], p / s
    elif d == 2:  # written out: a call of LAPACK for many small matrices takes longer
        determinant = s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] * s[:, 1, 0]
        adjugate = np.empty_like(s)
        adjugate[:, 0, 0], adjugate[:, 1, 1] = s[:, 1, 1], s[:, 0, 0]
        adjugate[:, 0, 1], adjugate[:, 1, 0] = -s[:, 0, 1], -s[:, 1, 0]
        after = (adjugate @ p) / determinant[:, None, None]
    else:
        fine = np.isfinite(s).all(axis=(1, 2))
        safe = np.where(fine[:, None, None], s, np.eye(d))
        determinant = np.where(fine, np.linalg.det(safe), np.nan)
        regular = fine & (determinant != 0.0)
        safe = np.where(regular[:, None, None], s, np.eye(d))
        after = np.where(regular[:, None, None], np.linalg.solve(safe, p), np.nan)
    after = 0.5 * (after + after.transpose(0, 2, 1))
    pull = g + np.einsum("lij,lj->li", h, toward)
    return np.log(np.abs(determinant)), after, np.einsum("lij,lj->li", after, pull)


def _positive_part(h: np.ndarray) -> np.ndarray:
    if h.shape[1] == 1:
        return np.maximum(h, 0.0)
    fine = np.isfinite(h).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(fine[:, None, None], h, 0.0))
    lifted = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    below = (values < 0.0).any(axis=1)
    return np.where((fine & below)[:, None, None], lifted, h)


def batched_filter(trace: Trace, missing: Missing) -> BatchedFilter | NotApplicable:
    """The filter of a traced model, or why there is none."""
    found = lookahead_model(trace, missing)
    return found if isinstance(found, NotApplicable) else BatchedFilter(trace, found)
