"""Exact inference where the states take few values: hidden Markov models and what is like them.

The laws (`finite_laws.py`) of data sets of one shape (`histories.py`) are handed all at once to the
compiled passes of `codegen/kernels/hidden_markov.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ssmppl.analysis.channels import channels
from ssmppl.analysis.finite import FiniteStates, finite_states
from ssmppl.codegen.exact import exact_entry
from ssmppl.codegen.kernels.random import fill_uniform
from ssmppl.codegen.kits import predictive
from ssmppl.data import Experiment, spelled
from ssmppl.errors import NotApplicable, SamplingError
from ssmppl.expressions.expr import Expr
from ssmppl.inference.exact.finite_laws import FiniteLaws
from ssmppl.inference.exact.histories import Histories
from ssmppl.inference.exact.kalman_moments import SmoothedMoments
from ssmppl.inference.exact.mixtures import inverted
from ssmppl.language.trace import Trace, once_per_trace


@dataclass(frozen=True)
class Filtered:
    """What the forward pass tells of one experiment (T rows, K values).

    log_increments : (T,) log p(y_t | y_{1:t-1}). predicted, filtered : (T, K) laws of x_t given
    y_{1:t-1} and y_{1:t}. move : (T or 1, K, K) as of the kernels.

    Of S histories at once every array has one axis more, the first.
    """

    log_increments: np.ndarray
    predicted: np.ndarray
    filtered: np.ndarray
    move: np.ndarray

    def of(self, s: int) -> Filtered:
        """What it tells of history s."""
        move = self.move[s if len(self.move) > 1 else 0]
        return Filtered(self.log_increments[s], self.predicted[s], self.filtered[s], move)


@dataclass(frozen=True)
class HiddenMarkov(FiniteLaws):
    """A traced model as one of finitely many values (K, D), and its exact passes."""

    # -- likelihood and laws
    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it does not exist at theta."""
        total = 0.0
        for h in self.histories_of(experiments):
            found, stopped = self._forward(h, theta)
            if np.any(stopped >= 0):
                return -np.inf
            total += float(h.weights @ found.log_increments.sum(axis=1))
        return total

    def filter(self, experiment: Experiment, theta: np.ndarray) -> Filtered:
        """The laws of x_t given what came up to t.

        Raises
        ------
        SamplingError : no value is possible at some row; names it and the parameters.
        """
        return self.filter_each([experiment], theta)[0]

    def filter_each(self, experiments: Sequence[Experiment], theta: np.ndarray) -> list[Filtered]:
        """As `filter`, of each experiment.

        Raises
        ------
        SamplingError : as of `filter`; names the data set too where there are several.
        """
        passes = self._passes(experiments, theta)
        return _in_order([(h, [f.of(s) for s in range(h.size)]) for h, f in passes])

    def probabilities(self, experiment: Experiment, theta: np.ndarray) -> np.ndarray:
        """(T, K) of each combination of values given all data."""
        _, found = next(self._passes([experiment], theta))
        return self._smoothed(found, pairs=False)[0][0]

    def laws(
        self, experiments: Sequence[Experiment], theta: np.ndarray
    ) -> list[tuple[Histories, np.ndarray, np.ndarray]]:
        """Of all experiments, by histories: (S, T, K) of x_t, and (S, T, K, K) of (x_{t-1}, x_t),
        row 0 zero, given all data.

        Raises
        ------
        SamplingError : as of `filter_each`.
        """
        passes = self._passes(experiments, theta)
        return [(h, *self._smoothed(found, pairs=True)) for h, found in passes]

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
        """As `smooth`, of each experiment; and the laws (T, K) of the combinations of values.

        Raises
        ------
        SamplingError : as of `filter_each`.
        """
        out = []
        for h, found in self._passes(experiments, theta):
            law, pairs = self._smoothed(found, pairs=True)
            value = found.log_increments.sum(axis=1)
            each = [
                (self._moments(law[s], pairs[s], float(value[s])), law[s]) for s in range(h.size)
            ]
            out.append((h, each))
        return _in_order(out)

    def _moments(self, law: np.ndarray, pairs: np.ndarray, value: float) -> SmoothedMoments:
        x = self.values
        mean = law @ x
        square = np.einsum("tk,ki,kj->tij", law, x, x)
        product = np.einsum("tab,bi,aj->tij", pairs, x, x)
        before = np.concatenate([mean[:1], mean[:-1]])
        cross = product - mean[:, :, None] * before[:, None, :]
        cross[0] = 0.0
        return SmoothedMoments(
            mean, square - mean[:, :, None] * mean[:, None, :], cross, value
        )  # fmt: skip

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
        uniforms = []
        for e, stream in zip(experiments, streams, strict=True):
            uniforms.append(np.empty(draws * e.steps))
            fill_uniform(stream, uniforms[-1])
        out: list[np.ndarray] = [np.empty(0)] * len(experiments)
        for h, found in self._passes(experiments, theta):
            own = np.concatenate([uniforms[i] for i in h.members]).reshape(-1, h.steps)
            paths, which = np.empty(own.shape, dtype=np.int64), np.repeat(h.which, draws)
            exact_entry("finite_draw")(found.move, found.filtered, which, own, paths)
            drawn = self.values[paths.reshape(-1, draws, h.steps)]
            for i, x in zip(h.members, drawn, strict=True):
                out[i] = x
        return out

    def quantiles(self, law: np.ndarray, levels: np.ndarray) -> np.ndarray:
        """(T, P, D) smallest values of each component whose distribution function, by the laws
        (T, K) of the combinations, reaches the levels (P,)."""
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
        the laws (T, K) of the combinations that are predicted."""
        each = []
        for h in self.histories_of(experiments):
            first = h.members[np.searchsorted(h.which, np.arange(h.size))]
            law = np.stack([laws[i] for i in first])
            out = []
            for site in self.trace.observations.values():
                for figures in predictive(site):
                    mean, variance, below, strictly = (
                        self.over_values(f, h, theta, "observation") for f in figures
                    )
                    middle = np.sum(law * mean, axis=2)
                    square = np.sum(law * (variance + mean**2), axis=2)
                    shares = [np.sum(law * b, axis=2) for b in (below, strictly)]
                    out.append(np.stack([middle, square - middle**2, *shares], axis=2))
            each.append((h, list(np.stack(out, axis=3))))
        return _in_order(each)

    def predicted_quantiles(
        self, e: Experiment, theta: np.ndarray, law: np.ndarray, levels: np.ndarray
    ) -> np.ndarray:
        """(T, P, K) at the levels (P,), likewise: of the mixture of the laws given each value. NaN
        where these have no distribution function."""
        out = np.full((e.steps, len(levels), e.y.shape[1]), np.nan)
        k = -1
        for site in self.trace.observations.values():
            for channel in channels(site):
                k += 1
                if channel is None:
                    continue

                def below(values: np.ndarray, k: int = k, f: Expr = channel.below) -> np.ndarray:
                    y = e.y.copy()
                    y[:, k] = values
                    own = self._observed(f, replace(e, y=y), theta)
                    return np.sum(law * np.where(law > 0.0, own, 0.0), axis=1)

                for j, level in enumerate(levels):
                    own = [self._observed(f, e, theta) for f in channel.ends(level)]
                    low = np.min([np.where(law > 0.0, q, np.inf) for q in own], axis=(0, 2))
                    high = np.max([np.where(law > 0.0, q, -np.inf) for q in own], axis=(0, 2))
                    out[:, j, k] = inverted(below, level, low, high, channel.whole)
        return out

    def _observed(self, expression: Expr, e: Experiment, theta: np.ndarray) -> np.ndarray:
        """(T or 1, K) an expression of the observation's law, of one experiment."""
        (h,) = self.histories_of([e])
        return self.over_values(expression, h, theta, "observation")[0]

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
        symbols = [s for s, w in zip(self.trace.parameter_symbols, wanted, strict=True) if w]
        total, gradient = 0.0, np.zeros(len(theta))
        for h in self.histories_of(experiments):
            found, stopped = self._forward(h, theta)
            if np.any(stopped >= 0):
                return -np.inf, np.where(wanted, np.nan, 0.0)
            law, pairs = self._smoothed(found, pairs=True)
            total += float(h.weights @ found.log_increments.sum(axis=1))
            for role in ("initial", "transition", "observation"):
                own = pairs if role == "transition" else law
                slopes = [self.density(role, h, s) for s in symbols]
                gradient[wanted] += self.expected(h, theta, role, slopes, own)
        return total, gradient

    # -- the pieces
    def _forward(self, h: Histories, theta: np.ndarray) -> tuple[Filtered, np.ndarray]:
        """The forward pass, and (S,) the row at which it came to an end, -1 if at none."""
        shape = h.size, h.steps, len(self.values)
        start = np.exp(self.over_values(self.density("initial", h), h, theta, "initial")[:, 0])
        move = np.exp(self.over_values(self.density("transition", h), h, theta, "transition"))
        log_g = self.over_values(self.density("observation", h), h, theta, "observation")
        log_g = np.ascontiguousarray(np.broadcast_to(log_g, shape))
        out = Filtered(np.empty(shape[:2]), np.empty(shape), np.empty(shape), move)
        stopped = np.empty(h.size, dtype=np.int64)
        exact_entry("finite_forward")(
            start, move, log_g, out.log_increments, out.predicted, out.filtered, stopped
        )
        return out, stopped

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
                site = next(iter(self.trace.observations.values()))
                raise SamplingError(
                    f"no value of the states is possible at t={t + 1}{of}; parameters: "
                    f"{spelled(self.trace, theta)}",
                    fix="check this row of the data, and whether the laws leave each value a "
                    "chance",
                    where=site.distribution.location,
                )
            yield h, found

    def _smoothed(self, found: Filtered, pairs: bool) -> tuple[np.ndarray, np.ndarray]:
        shape = found.filtered.shape
        law, both = np.empty(shape), np.empty((*shape, shape[-1]) if pairs else (0, 0, 0, 0))
        exact_entry("finite_backward")(found.move, found.predicted, found.filtered, law, both)
        return law, both


T = TypeVar("T")


def _in_order(each: Sequence[tuple[Histories, Sequence[T]]]) -> list[T]:
    """What is known of each history, in the order of the data sets."""
    places = {
        int(i): found[s] for h, found in each for i, s in zip(h.members, h.which, strict=True)
    }
    return [places[i] for i in range(len(places))]


@once_per_trace
def _form(trace: Trace) -> tuple[FiniteStates | NotApplicable, dict[str, Expr]]:
    """The finite form, and where its densities are kept."""
    return finite_states(trace), {}


def hidden_markov(trace: Trace) -> HiddenMarkov | NotApplicable:
    """The finite form of a traced model, derived once; or the reason why it has none."""
    form, densities = _form(trace)
    return form if isinstance(form, NotApplicable) else HiddenMarkov(trace, form, densities)
