"""Exact inference where the states take few values: hidden Markov models and what is like them.

Laws may depend on parameters, inputs, time and observations before. The densities are evaluated by
the interpreter, over all values and rows at once, and handed to the compiled passes of
`codegen/kernels/hidden_markov.py`.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ssmppl.analysis.channels import channels
from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.finite import FiniteStates, finite_states
from ssmppl.codegen.exact import exact_entry
from ssmppl.codegen.kernels.random import fill_uniform
from ssmppl.codegen.kits import predictive
from ssmppl.data import Experiment, spelled
from ssmppl.errors import NotApplicable, SamplingError
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, constant
from ssmppl.inference.exact.kalman_matrices import values_of
from ssmppl.inference.exact.kalman_moments import SmoothedMoments
from ssmppl.inference.exact.mixtures import inverted
from ssmppl.inference.exact.scored import Scored
from ssmppl.language.trace import Trace, previous, seen

ENTRIES = 2_000_000  # of an array over rows and pairs of values: more rows are done in pieces


@dataclass(frozen=True)
class Filtered:
    """What the forward pass tells of one experiment (T rows, K values).

    log_increments : (T,) log p(y_t | y_{1:t-1}). predicted, filtered : (T, K) laws of x_t given
    y_{1:t-1} and y_{1:t}. move : (T or 1, K, K) as of the kernels.
    """

    log_increments: np.ndarray
    predicted: np.ndarray
    filtered: np.ndarray
    move: np.ndarray


@dataclass(frozen=True)
class HiddenMarkov(Scored):
    """A traced model as one of finitely many values (K, D), and its exact passes."""

    form: FiniteStates
    _densities: dict[str, Expr] = field(default_factory=dict, repr=False)

    @property
    def values(self) -> np.ndarray:
        return self.form.values

    # -- likelihood and laws
    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it does not exist at theta."""
        total = 0.0
        for e in experiments:
            found = self._forward(e, theta)
            if isinstance(found, int):
                return -np.inf
            total += float(found.log_increments.sum())
        return total

    def filter(self, experiment: Experiment, theta: np.ndarray) -> Filtered:
        """The laws of x_t given what came up to t.

        Raises
        ------
        SamplingError : no value is possible at some row; names it and the parameters.
        """
        found = self._forward(experiment, theta)
        if isinstance(found, int):
            site = next(iter(self.trace.observations.values()))
            raise SamplingError(
                f"no value of the states is possible at t={found + 1}; parameters: "
                f"{spelled(self.trace, theta)}",
                fix="check this row of the data, and whether the laws leave each value a chance",
                where=site.distribution.location,
            )
        return found

    def probabilities(self, experiment: Experiment, theta: np.ndarray) -> np.ndarray:
        """(T, K) of each combination of values given all data."""
        return self._smoothed(self.filter(experiment, theta), pairs=False)[0]

    def laws(self, experiment: Experiment, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(T, K) of x_t, and (T, K, K) of (x_{t-1}, x_t), row 0 zero, given all data.

        Raises
        ------
        SamplingError : as of `filter`.
        """
        return self._smoothed(self.filter(experiment, theta), pairs=True)

    def smooth(self, experiment: Experiment, theta: np.ndarray) -> SmoothedMoments:
        """Moments of the states given all data.

        Raises
        ------
        SamplingError : as of `filter`.
        """
        found = self.filter(experiment, theta)
        law, pairs = self._smoothed(found, pairs=True)
        x = self.values
        mean = law @ x
        square = np.einsum("tk,ki,kj->tij", law, x, x)
        product = np.einsum("tab,bi,aj->tij", pairs, x, x)
        before = np.concatenate([mean[:1], mean[:-1]])
        cross = product - mean[:, :, None] * before[:, None, :]
        cross[0] = 0.0
        return SmoothedMoments(
            mean, square - mean[:, :, None] * mean[:, None, :], cross,
            float(found.log_increments.sum()),
        )  # fmt: skip

    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """Independent draws of x_{1:T} given y_{1:T}, (draws, T, D), by backward sampling.

        Raises
        ------
        SamplingError : as of `filter`.
        """
        found = self.filter(experiment, theta)
        uniforms = np.empty(draws * experiment.steps)
        fill_uniform(stream, uniforms)
        paths = np.empty((draws, experiment.steps), dtype=np.int64)
        exact_entry("finite_draw")(found.move, found.filtered, uniforms.reshape(paths.shape), paths)
        return self.values[paths]

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
        self, e: Experiment, theta: np.ndarray, law: np.ndarray
    ) -> np.ndarray:
        """(T, 4, K): mean, variance, P(Y <= y) and P(Y < y) of each channel, by the laws (T, K)
        of the combinations that are predicted."""
        out = []
        for site in self.trace.observations.values():
            for figures in predictive(site):
                mean, variance, below, strictly = (
                    self._over_values(f, e, theta, "observation") for f in figures
                )
                middle = np.sum(law * mean, axis=1)
                square = np.sum(law * (variance + mean**2), axis=1)
                shares = [np.sum(law * np.broadcast_to(b, law.shape), axis=1)
                          for b in (below, strictly)]  # fmt: skip
                out.append(np.stack([middle, square - middle**2, *shares], axis=1))
        return np.stack(out, axis=2)

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
                    own = self._over_values(f, replace(e, y=y), theta, "observation")
                    return np.sum(law * np.where(law > 0.0, own, 0.0), axis=1)

                for j, level in enumerate(levels):
                    own = self._over_values(channel.quantile(level), e, theta, "observation")
                    low = np.min(np.where(law > 0.0, own, np.inf), axis=1)
                    high = np.max(np.where(law > 0.0, own, -np.inf), axis=1)
                    out[:, j, k] = inverted(below, level, low, high, channel.whole)
        return out

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
        for e in experiments:
            found = self._forward(e, theta)
            if isinstance(found, int):
                return -np.inf, np.where(wanted, np.nan, 0.0)
            law, pairs = self._smoothed(found, pairs=True)
            total += float(found.log_increments.sum())
            for role in ("initial", "transition", "observation"):
                own = pairs if role == "transition" else law
                slopes = [self.density(role, e, s) for s in symbols]
                gradient[wanted] += self.expected(e, theta, role, slopes, own)
        return total, gradient

    # -- the pieces
    def _forward(self, e: Experiment, theta: np.ndarray) -> Filtered | int:
        """The forward pass, or the row at which it came to an end."""
        size = len(self.values)
        start = np.exp(self._over_values(self.density("initial", e), e, theta, "initial")[0])
        move = np.exp(self._over_values(self.density("transition", e), e, theta, "transition"))
        log_g = self._over_values(self.density("observation", e), e, theta, "observation")
        log_g = np.ascontiguousarray(np.broadcast_to(log_g, (e.steps, size)))
        out = Filtered(
            np.empty(e.steps), np.empty((e.steps, size)), np.empty((e.steps, size)), move
        )
        stopped = exact_entry("finite_forward")(
            start, move, log_g, out.log_increments, out.predicted, out.filtered
        )
        return out if stopped < 0 else int(stopped)

    def _smoothed(self, found: Filtered, pairs: bool) -> tuple[np.ndarray, np.ndarray]:
        steps, size = found.filtered.shape
        law, both = np.empty((steps, size)), np.empty((steps if pairs else 0, size, size))
        exact_entry("finite_backward")(found.move, found.predicted, found.filtered, law, both)
        return law, both

    def density(self, role: str, e: Experiment, by: Expr | None = None) -> Expr:
        """The log density of a role, or its derivative by a parameter."""
        missing = Missing(partial=e.partial)
        key = f"{role} {sorted(e.partial)}"
        if key not in self._densities:
            total = constant(0.0)
            for t in terms(self.trace, role, missing):
                total = total + t.guarded()
            self._densities[key] = total
        if by is None:
            return self._densities[key]
        slope = f"{key} by {by!r}"
        if slope not in self._densities:
            self._densities[slope] = differentiate([self._densities[key]], by)[0]
        return self._densities[slope]

    def expected(
        self, e: Experiment, theta: np.ndarray, role: str, expressions: Sequence[Expr],
        law: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Sums over rows and values of each expression, weighed by a law of `laws`: of pairs for
        "transition". What has no weight does not count, be it infinite."""
        law = law[:1] if role == "initial" else law
        out = np.empty(len(expressions))
        for k, expression in enumerate(expressions):
            values = self._over_values(expression, e, theta, role)
            out[k] = np.sum(law * np.where(law > 0.0, values, 0.0))
        return out

    def _over_values(
        self, expression: Expr, e: Experiment, theta: np.ndarray, role: str
    ) -> np.ndarray:
        """(R, K), or (R, K, K) over x_{t-1} and x_t for "transition"; R is T, or 1 where it is the
        same in all rows (and for "initial")."""
        given = values_of(self.trace, e, theta)
        rows = {s: v for s, v in given.items() if np.ndim(v)}
        for s, y, known in zip(self.trace.observation_symbols, e.y.T, e.seen.T, strict=True):
            rows[s], rows[seen(s)] = y, known
        numbers = {s: v for s, v in given.items() if not np.ndim(v)}
        size, pair = len(self.values), role == "transition"
        states: dict[Expr, np.ndarray] = {}
        for s, column in zip(self.trace.state_symbols, self.values.T, strict=True):
            states[s] = column[None, None, :] if pair else column[None, :]
            if pair:
                states[previous(s)] = column[None, :, None]
        shape = (size, size) if pair else (size,)

        def over(first: int, last: int) -> np.ndarray:
            own = {s: v[first:last].reshape(-1, *(1,) * len(shape)) for s, v in rows.items()}
            found = np.asarray(evaluate(expression, {**numbers, **own, **states}), dtype=float)
            found = found.reshape((1,) * (1 + len(shape) - found.ndim) + found.shape)
            return np.broadcast_to(found, (found.shape[0], *shape))

        if role == "initial":
            return np.array(over(0, 1))
        step = max(2, ENTRIES // int(np.prod(shape)))
        first = over(0, min(step, e.steps))
        if first.shape[0] == 1:
            return np.array(first)
        parts = [over(a, min(a + step, e.steps)) for a in range(step, e.steps, step)]
        return np.ascontiguousarray(np.concatenate([first, *parts]))


Densities = dict[str, Expr]
_forms: dict[int, tuple[weakref.ref[Trace], FiniteStates | NotApplicable, Densities]] = {}


def hidden_markov(trace: Trace) -> HiddenMarkov | NotApplicable:
    """The finite form of a traced model, derived once; or the reason why it has none."""
    key = id(trace)
    if key not in _forms:
        reference = weakref.ref(trace, lambda _: _forms.pop(key, None))
        _forms[key] = reference, finite_states(trace), {}
    _, form, densities = _forms[key]
    return form if isinstance(form, NotApplicable) else HiddenMarkov(trace, form, densities)
