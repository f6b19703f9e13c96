"""Exact inference where the states take few values: hidden Markov models and what is like them.

The distributions of the model are tables over the values; they may depend on parameters, inputs,
time and observations before. One generated pass writes them down, over all values, rows and data
sets (`histories.py`), and another sums their derivatives up; what lies between are the compiled
passes that know no model. Whatever else is a function of the values, as what is expected of an
observation, is evaluated by the interpreter.

A value that the data have made 1e-300 times as likely as another is no number any more, and yet it
may be the only one that later rows leave: before a change from which no way leads back. The pass in
ordinary numbers tells where that may have happened, and then everything is done by logarithms, at
several times the cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.finite import FiniteStates, finite_states
from ssmppl.analysis.proposals.channels import Channel, channels
from ssmppl.codegen.kernels.hmm.passes import UNSURE
from ssmppl.codegen.modules.exact import compile_slopes, compile_tables, exact_entry, varies_by_row
from ssmppl.codegen.native.loading import Loaded
from ssmppl.codegen.text.kernel_functions import predictive
from ssmppl.data import Experiment, spelled
from ssmppl.errors import NotApplicable, SamplingError
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, constant
from ssmppl.inference.exact.derivatives import Scored
from ssmppl.inference.exact.histories import Histories, histories
from ssmppl.inference.exact.kalman_matrices import SmoothedMoments
from ssmppl.inference.run.invalid_laws import law_without_density_at
from ssmppl.inference.run.seeds import fill_uniform
from ssmppl.language.model.trace import Trace, once_per_trace, previous

ENTRIES = 2_000_000  # of an array over rows and pairs of values: more rows are done in pieces
HALVINGS = 200  # of an interval between any two floats that differ in size by less than 1e40
ROUNDING = 1e-12  # by which sums of probabilities may miss a level
T = TypeVar("T")


@dataclass(frozen=True)
class Filtered:
    """What the forward pass tells of some histories (R rows in all, K values), or of one.

    log_increments : (R,) log p(y_t | y_{1:t-1}). predicted, filtered : (R, K) distributions of x_t
        given
    y_{1:t-1} and y_{1:t}, or their logarithms if `logs`. first : (S + 1,) and move : (R or 1, K,
    K), as of the kernels, likewise.
    """

    log_increments: np.ndarray
    _predicted: np.ndarray
    _filtered: np.ndarray
    _first: np.ndarray
    move: np.ndarray
    logs: bool

    @property
    def predicted(self) -> np.ndarray:
        return np.exp(self._predicted) if self.logs else self._predicted

    @property
    def filtered(self) -> np.ndarray:
        return np.exp(self._filtered) if self.logs else self._filtered

    def of(self, s: int) -> Filtered:
        """What it tells of history s."""
        rows = slice(self._first[s], self._first[s + 1])
        move = self.move[rows] if len(self.move) > 1 else self.move
        own = self.log_increments[rows], self._predicted[rows], self._filtered[rows]
        return Filtered(*own, self._first[s : s + 2] - self._first[s], move, self.logs)

    def smoothed(self, pairs: bool) -> tuple[np.ndarray, np.ndarray]:
        """Distributions (R, K) of x_t given all data, and (R, K, K) of (x_{t-1}, x_t), zero in
        first rows; without pairs the latter is empty."""
        shape = self._filtered.shape
        law, both = np.empty(shape), np.empty((*shape, shape[-1]) if pairs else (0, 0, 0))
        entry = exact_entry("finite_backward_logs" if self.logs else "finite_backward")
        entry(self._first, self.move, self._predicted, self._filtered, law, both)
        return law, both

    def paths(self, which: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
        """Indices of values drawn given all data, path m of history which[m], end to end, by as
        many uniforms."""
        found = np.empty(uniforms.shape, dtype=np.int64)
        entry = exact_entry("finite_draw_logs" if self.logs else "finite_draw")
        entry(self._first, self.move, self._filtered, which, uniforms, found)
        return found


@dataclass(frozen=True)
class Tables:
    """The distributions over the values of some histories, as of the kernels: log_start (S, K),
    log_move and move (R or 1, K, K), log_g (R, K)."""

    log_start: np.ndarray
    log_move: np.ndarray
    move: np.ndarray
    log_g: np.ndarray

    def forward(self, first: np.ndarray) -> tuple[Filtered, np.ndarray]:
        """The forward pass, and (S,) the row at which it came to an end, -1 if at none."""
        shape = self.log_g.shape
        found = np.empty(shape[0]), np.empty(shape), np.empty(shape)
        stopped = np.empty(len(self.log_start), dtype=np.int64)
        logs = self.log_start, self.log_move, self.log_g
        exact_entry("finite_forward")(first, self.move, *logs, *found, stopped)
        if not np.any(stopped == UNSURE):
            return Filtered(*found, first, self.move, logs=False), stopped
        exact_entry("finite_forward_logs")(first, *logs, *found, stopped)
        return Filtered(*found, first, self.log_move, logs=True), stopped


def inverted(
    below: Callable[[np.ndarray], np.ndarray], level: float, low: np.ndarray, high: np.ndarray,
    whole: bool,
) -> np.ndarray:  # fmt: skip
    """The smallest values at which distribution functions reach a level, by bisection.

    below : values -> P(Y <= value), in the shape of low and high, between which they lie: of a
        mixture the least and the largest quantile of its parts. whole : whether values are whole
        numbers.
    """
    low, high = low.copy(), high.copy()
    for _ in range(HALVINGS):
        middle = 0.5 * low + 0.5 * high
        if whole:
            middle = np.floor(middle)
            open_ = low < high
        else:
            open_ = high - low > 2.0**-52 * np.maximum(np.abs(low), np.abs(high))
        if not open_.any():
            break
        reached = below(middle) >= level - ROUNDING * whole
        high = np.where(open_ & reached, middle, high)
        low = np.where(open_ & ~reached, middle + 1.0 if whole else middle, low)
    return high


class Kept:
    """What is derived of a model once, by what it is. It is no part of what is sent elsewhere."""

    def __init__(self) -> None:
        self._made: dict[tuple, Any] = {}

    def __reduce__(self) -> tuple:
        return Kept, ()

    def once(self, key: tuple, make: Callable[..., Any], *arguments: Any) -> Any:
        if key not in self._made:
            self._made[key] = make(*arguments)
        return self._made[key]


@dataclass(frozen=True)
class HiddenMarkov(Scored):
    """A traced model as one of finitely many values (K, D): its distributions as tables over these,
    and its exact passes."""

    form: FiniteStates
    _kept: Kept = field(default_factory=Kept, repr=False, compare=False)

    # -- tables
    @property
    def values(self) -> np.ndarray:
        return self.form.values

    def _over(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """values (D, K), and the pairs of them before and after a move (D, K * K)."""
        return self._kept.once(("values",), self._columns)

    def _columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        columns, size = np.ascontiguousarray(self.values.T), len(self.values)
        return columns, np.repeat(columns, size, axis=1), np.tile(columns, size)

    def tables(self, h: Histories, theta: np.ndarray) -> Tables:
        """The distributions over the values."""
        size, rows = len(self.values), len(h.y)
        given = self.trace, h.missing
        moves = rows if self._kept.once(("varies", h.missing), varies_by_row, *given) else 1
        out = Tables(
            np.empty((h.size, size)), np.empty((moves, size * size)),
            np.empty((moves, size * size)), np.empty((rows, size)),
        )  # fmt: skip
        module = self._kept.once(("tables", h.missing), compile_tables, *given)
        module.write_tables(theta, h.y, h.seen, h.u, h.first, *self._over(), *vars(out).values())
        square = moves, size, size
        return replace(out, log_move=out.log_move.reshape(square), move=out.move.reshape(square))

    def histories_of(self, experiments: Iterable[Experiment]) -> tuple[Histories, ...]:
        entries = max(1, ENTRIES // len(self.values) ** 2)
        return histories(self.trace, tuple(experiments), entries)

    def density(self, role: str, h: Histories, by: Expr | None = None) -> Expr:
        """The log density of a role, or its derivative by a parameter."""
        total = self._kept.once((role, h.missing), self._density, role, h.missing)
        if by is None:
            return total
        return self._kept.once((role, h.missing, by), differentiate, [total], by)[0]

    def _density(self, role: str, missing: Missing) -> Expr:
        return sum((t.guarded() for t in terms(self.trace, role, missing)), start=constant(0.0))

    def expected(
        self, h: Histories, theta: np.ndarray, role: str, expressions: Sequence[Expr],
        law: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Sums over data sets, rows and values of each expression, weighed by a distribution of
        `laws`: of pairs for "transition". What has no weight does not count, be it infinite."""
        out = np.zeros(len(expressions))
        counts = np.repeat(h.weights, h.steps)
        law = law * counts.reshape(-1, *(1,) * (law.ndim - 1))
        for rows, found in self._by_rows(expressions, h, theta, role):
            own = law[rows]
            out += [np.sum(own * np.where(own > 0.0, values, 0.0)) for values in found]
        return out

    def over_values(
        self, expression: Expr, h: Histories, theta: np.ndarray, role: str
    ) -> np.ndarray:
        """(R, K), or (R, K, K) over x_{t-1} and x_t for "transition"; 1 for R where it is the same
        in all rows, and S for "initial"."""
        parts = []
        for _, (found,) in self._by_rows([expression], h, theta, role):
            parts.append(found)
            if len(found) == 1:
                break
        return np.ascontiguousarray(np.concatenate(parts) if parts[1:] else parts[0])

    def _by_rows(
        self, expressions: Sequence[Expr], h: Histories, theta: np.ndarray, role: str
    ) -> Iterator[tuple[slice | np.ndarray, list[np.ndarray]]]:
        """The rows of a role, and each expression over them as of `over_values`, as many rows at a
        time as memory allows."""
        size, pair = len(self.values), role == "transition"
        given: dict[Expr, np.ndarray] = dict(zip(self.trace.parameter_symbols, theta, strict=True))
        for s, column in zip(self.trace.state_symbols, self.values.T, strict=True):
            given[s] = column
            if pair:
                given[previous(s)] = column[:, None]
        shape = (size, size) if pair else (size,)
        which = h.first[:-1] if role == "initial" else np.arange(len(h.y))
        step = max(2, ENTRIES // (int(np.prod(shape)) * max(1, len(expressions))))
        for a in range(0, len(which), step):
            rows = which[a : a + step]
            own = {s: v[rows].reshape(-1, *(1,) * len(shape)) for s, v in h.rows.items()}
            found = []
            for values in evaluate(expressions, {**given, **own}):
                values = np.asarray(values, dtype=float)
                values = values.reshape((1,) * (1 + len(shape) - values.ndim) + values.shape)
                found.append(np.broadcast_to(values, (len(values), *shape)))
            yield rows, found

    # -- likelihood and laws
    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it does not exist at theta."""
        total = 0.0
        for h in self.histories_of(experiments):
            found, stopped = self._forward(h, theta)
            if np.any(stopped >= 0):
                return -np.inf
            total += _total(h, found)
        return total

    def filter(self, experiment: Experiment, theta: np.ndarray) -> Filtered:
        """The distributions of x_t given what came up to t.

        Raises
        ------
        SamplingError : no value is possible at some row; names it and the parameters.
        """
        return self.filter_each([experiment], theta)[0]

    def filter_each(self, experiments: Sequence[Experiment], theta: np.ndarray) -> list[Filtered]:
        """Filter each experiment, as `filter` does one.

        Raises
        ------
        SamplingError : as of `filter`; names the data set too where there are several.
        """
        passes = self._passes(experiments, theta)
        return _in_order([(h, [f.of(s) for s in range(h.size)]) for h, f in passes])

    def probabilities(self, experiment: Experiment, theta: np.ndarray) -> np.ndarray:
        """(T, K) of each combination of values given all data."""
        _, found = next(self._passes([experiment], theta))
        return found.smoothed(pairs=False)[0]

    def laws(
        self, experiments: Sequence[Experiment], theta: np.ndarray
    ) -> list[tuple[Histories, np.ndarray, np.ndarray]]:
        """Of all experiments, by histories: (R, K) of x_t, and (R, K, K) of (x_{t-1}, x_t), zero
        in first rows, given all data.

        Raises
        ------
        SamplingError : as of `filter_each`.
        """
        passes = self._passes(experiments, theta)
        return [(h, *found.smoothed(pairs=True)) for h, found in passes]

    def smooth(self, experiment: Experiment, theta: np.ndarray) -> SmoothedMoments:
        """Moments of the states given all data.

        Raises
        ------
        SamplingError : as of `filter`.
        """
        return self.smooth_each([experiment], theta)[0][0]

    def smooth_each(
        self, experiments: Sequence[Experiment], theta: np.ndarray
    ) -> list[tuple[SmoothedMoments, np.ndarray]]:
        """As `smooth`, of each experiment; and the distributions (T, K) of the combinations of
        values.

        Raises
        ------
        SamplingError : as of `filter_each`.
        """
        out = []
        for h, found in self._passes(experiments, theta):
            law, pairs = found.smoothed(pairs=True)
            each = []
            for s in range(h.size):
                rows = h.of(s)
                value = float(found.log_increments[rows].sum())
                each.append((self._moments(law[rows], pairs[rows], value), law[rows]))
            out.append((h, each))
        return _in_order(out)

    def _moments(self, law: np.ndarray, pairs: np.ndarray, value: float) -> SmoothedMoments:
        mean, covariance, away = self.moments(law)
        cross = np.zeros_like(covariance)
        cross[1:] = _outer(away[1:], pairs[1:].transpose(0, 2, 1) @ away[:-1])
        return SmoothedMoments(mean, covariance, cross, value)

    def moments(self, law: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (T, D) and covariances (T, D, D) by distributions (T, K) of the combinations, and
        what these are away from the means (T, K, D): far from zero, squares of x would differ by
        rounding."""
        mean = law @ self.values
        away = self.values - mean[:, None, :]
        return mean, _outer(away, law[:, :, None] * away), away

    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """Independent draws of x_{1:T} given y_{1:T}, (draws, T, D), by backward sampling.

        Raises
        ------
        SamplingError : as of `filter`.
        """
        return self.draw_each([experiment], theta, [stream], draws)[0]

    def draw_each(
        self, experiments: Sequence[Experiment], theta: np.ndarray, streams: Sequence[np.ndarray],
        draws: int = 1,
    ) -> list[np.ndarray]:  # fmt: skip
        """As `draw`, of each experiment with its own stream, or one and the same.

        Raises
        ------
        SamplingError : as of `filter_each`.
        """
        ends = np.cumsum([draws * e.steps for e in experiments])
        uniforms, begins = np.empty(ends[-1]), np.concatenate([[0], ends[:-1]])
        if all(stream is streams[0] for stream in streams):  # one after the other
            fill_uniform(streams[0], uniforms)
        else:
            for stream, begin, end in zip(streams, begins, ends, strict=True):
                fill_uniform(stream, uniforms[begin:end])
        out: list[np.ndarray] = [np.empty(0)] * len(experiments)
        for h, found in self._passes(experiments, theta):
            sizes = draws * h.steps[h.which]
            at = np.concatenate([[0], np.cumsum(sizes)])
            own = uniforms[np.arange(at[-1]) + np.repeat(begins[h.members] - at[:-1], sizes)]
            drawn = self.values[found.paths(np.repeat(h.which, draws), own)]
            bounds = at.tolist()
            for k, i in enumerate(h.members.tolist()):
                out[i] = drawn[bounds[k] : bounds[k + 1]].reshape(draws, -1, drawn.shape[1])
        return out

    def quantiles(self, law: np.ndarray, levels: np.ndarray) -> np.ndarray:
        """(T, P, D) smallest values of each component whose distribution function, by the
        distributions (T, K) of the combinations, reaches the levels (P,)."""
        out = np.empty((len(law), len(levels), self.values.shape[1]))
        for d, column in enumerate(self.values.T):
            values, index = np.unique(column, return_inverse=True)
            below = np.cumsum(law @ np.eye(len(values))[index], axis=1)
            reached = below[:, None, :] >= levels[None, :, None] - 1e-12
            out[:, :, d] = values[np.argmax(reached, axis=2)]
        return out

    def predicted_observations(
        self, experiments: Sequence[Experiment], theta: np.ndarray, laws: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """(T, 4, K) of each experiment: mean, variance, P(Y <= y) and P(Y < y) of each channel, by
        the distributions (T, K) of the combinations that are predicted."""
        each = []
        for h, law in self._by_history(experiments, laws):
            out = []
            for site in self.trace.observations.values():
                for figures in predictive(site):
                    mean, variance, below, strictly = (  # undefined where there is no weight
                        np.where(law > 0.0, self.over_values(f, h, theta, "observation"), 0.0)
                        for f in figures
                    )
                    middle = np.sum(law * mean, axis=1)
                    spread = np.sum(law * (variance + (mean - middle[:, None]) ** 2), axis=1)
                    shares = [np.sum(law * b, axis=1) for b in (below, strictly)]
                    out.append(np.stack([middle, spread, *shares], axis=1))
            each.append((h, _of_each(h, np.stack(out, axis=2))))
        return _in_order(each)

    def predicted_quantiles(
        self, experiments: Sequence[Experiment], theta: np.ndarray, laws: Sequence[np.ndarray],
        levels: np.ndarray,
    ) -> list[np.ndarray]:  # fmt: skip
        """(T, P, K) of each experiment at the levels (P,), likewise: of the mixture of the
        distributions given each value. NaN where these have no distribution function, or no inverse
        of it."""
        sites = self.trace.observations.values()
        every = [c for site in sites for c in channels(site)]
        each = []
        for h, law in self._by_history(experiments, laws):
            out = np.full((len(law), len(levels), len(every)), np.nan)
            for k, channel in enumerate(every):
                for j, level in enumerate(levels):
                    if channel is not None:
                        out[:, j, k] = self._quantile(h, theta, law, k, channel, level)
            each.append((h, _of_each(h, out)))
        return _in_order(each)

    def _quantile(
        self, h: Histories, theta: np.ndarray, law: np.ndarray, k: int, channel: Channel,
        level: float,
    ) -> np.ndarray:  # fmt: skip
        """(R,) of channel k, by the distributions (R, K) of the combinations that are predicted."""
        own = self.trace.observation_symbols[k]

        def below(values: np.ndarray) -> np.ndarray:
            there = replace(h, rows={**h.rows, own: values})
            found = self.over_values(channel.below, there, theta, "observation")
            return np.sum(law * np.where(law > 0.0, found, 0.0), axis=1)

        ends = [self.over_values(f, h, theta, "observation") for f in channel.ends(level)]
        low = np.min([np.where(law > 0.0, q, np.inf) for q in ends], axis=(0, 2))
        high = np.max([np.where(law > 0.0, q, -np.inf) for q in ends], axis=(0, 2))
        return inverted(below, level, low, high, channel.whole)

    def _by_history(
        self, experiments: Sequence[Experiment], laws: Sequence[np.ndarray]
    ) -> Iterator[tuple[Histories, np.ndarray]]:
        """The distributions (T, K) of each experiment as (R, K) of the distinct ones."""
        for h in self.histories_of(experiments):
            first = h.members[np.searchsorted(h.which, np.arange(h.size))]
            yield h, np.concatenate([laws[i] for i in first])

    # -- derivatives
    def score(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(y | theta) and its gradient (P,), summed over experiments, exact: the expected
        derivatives of the complete-data density given the data (Fisher's identity).

        free : (P,) bool, the parameters that matter; the gradient is 0 in the others. None: all.
        Where the density does not exist at theta: -inf, and NaN for the gradient.
        """
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        total, gradient = 0.0, np.zeros(len(theta))
        for h in self.histories_of(experiments):
            found, stopped = self._forward(h, theta)
            if np.any(stopped >= 0):
                return -np.inf, np.where(wanted, np.nan, 0.0)
            law, pairs = found.smoothed(pairs=True)
            total += _total(h, found)
            module, which = self._slopes(h.missing, wanted)
            own = np.zeros(len(which))
            module.expected_slopes(
                theta, h.y, h.seen, h.u, h.first, h.weights.astype(float), *self._over(),
                len(found.move) > 1, law, pairs.reshape(len(law), -1), own,
            )  # fmt: skip
            gradient[which] += own
        return total, np.where(wanted, gradient, 0.0)

    def _slopes(self, missing: Missing, wanted: np.ndarray) -> tuple[Loaded, np.ndarray]:
        """What sums derivatives up, and the positions of the parameters in which it does: all, as
        long as there are derivatives in all, so that one module serves whatever is wanted.

        Raises
        ------
        NotDifferentiable : there is none in closed form in some parameter that is wanted.
        """
        every = np.arange(len(wanted))
        found = self._kept.once(("slopes", missing), self._tried, missing, every)
        if not isinstance(found, NotDifferentiable):
            return found, every
        which, key = np.flatnonzero(wanted), ("slopes", missing, wanted.tobytes())
        if isinstance(found := self._kept.once(key, self._tried, missing, which), Exception):
            raise found
        return found, which

    def _tried(self, missing: Missing, which: np.ndarray) -> Loaded | NotDifferentiable:
        symbols = self.trace.parameter_symbols
        try:
            return compile_slopes(self.trace, missing, [symbols[i] for i in which])
        except NotDifferentiable as reason:
            return reason

    # -- the pieces
    def _forward(self, h: Histories, theta: np.ndarray) -> tuple[Filtered, np.ndarray]:
        """The forward pass, and (S,) the row at which it came to an end, -1 if at none."""
        return self.tables(h, theta).forward(h.first)

    def _passes(
        self, experiments: Sequence[Experiment], theta: np.ndarray
    ) -> Iterator[tuple[Histories, Filtered]]:
        """The forward passes; an error where one comes to an end."""
        for h in self.histories_of(experiments):
            found, stopped = self._forward(h, theta)
            ends = stopped[h.which]
            if np.any(ends >= 0):
                i, t = min(zip(h.members[ends >= 0], ends[ends >= 0], strict=True))
                of = f" of data set {i + 1}" if len(experiments) > 1 else ""
                where = next(iter(self.trace.observations.values())).distribution.location
                why, fix = "", ("check this row of the data, and whether the distributions leave "
                                "each value a chance")  # fmt: skip
                if none := law_without_density_at(self.trace, theta):
                    why, fix, where = none
                raise SamplingError(
                    f"no value of the states is possible at t={t + 1}{of}; parameters: "
                    f"{spelled(self.trace, theta)}" + (why and f"; {why}"),
                    fix=fix,
                    where=where,
                )
            yield h, found


def _total(h: Histories, found: Filtered) -> float:
    """The log-likelihood of all data sets."""
    each = np.add.reduceat(found.log_increments, h.first[:-1])
    return float(h.weights @ each)


def _of_each(h: Histories, values: np.ndarray) -> list[np.ndarray]:
    """Rows of all histories, by history."""
    return np.split(values, h.first[1:-1])


def _outer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(T, D, D) sums over K of products of a and b (T, K, D)."""
    return a.transpose(0, 2, 1) @ b


def _in_order(each: Sequence[tuple[Histories, Sequence[T]]]) -> list[T]:
    """What is known of each history, in the order of the data sets."""
    places = {
        int(i): found[s] for h, found in each for i, s in zip(h.members, h.which, strict=True)
    }
    return [places[i] for i in range(len(places))]


@once_per_trace
def _form(trace: Trace) -> tuple[FiniteStates | NotApplicable, Kept]:
    """The finite form, and where what is derived of it is kept."""
    return finite_states(trace), Kept()


def hidden_markov(trace: Trace) -> HiddenMarkov | NotApplicable:
    """The finite form of a traced model, derived once; or the reason why it has none."""
    form, kept = _form(trace)
    return form if isinstance(form, NotApplicable) else HiddenMarkov(trace, form, kept)
