"""The laws of a model of finitely many values, as tables over these.

They may depend on parameters, inputs, time and observations before. The densities are evaluated by
the interpreter, over all values, rows and data sets of one shape at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.finite import FiniteStates
from ssmppl.data import Experiment
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, constant
from ssmppl.inference.exact.histories import Histories, histories
from ssmppl.inference.exact.scored import Scored
from ssmppl.language.traced import previous

ENTRIES = 2_000_000  # of an array over rows and pairs of values: more rows are done in pieces


@dataclass(frozen=True)
class FiniteLaws(Scored):
    """A traced model as one of finitely many values (K, D)."""

    form: FiniteStates
    _densities: dict[str, Expr] = field(default_factory=dict, repr=False)

    @property
    def values(self) -> np.ndarray:
        return self.form.values

    def histories_of(self, experiments: Iterable[Experiment]) -> tuple[Histories, ...]:
        entries = max(1, ENTRIES // len(self.values) ** 2)
        return histories(self.trace, tuple(experiments), entries)

    def density(self, role: str, h: Histories, by: Expr | None = None) -> Expr:
        """The log density of a role, or its derivative by a parameter."""
        missing = Missing(partial=h.partial)
        key = f"{role} {sorted(h.partial)}"
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
        self, h: Histories, theta: np.ndarray, role: str, expressions: Sequence[Expr],
        law: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Sums over data sets, rows and values of each expression, weighed by a law of `laws`: of
        pairs for "transition". What has no weight does not count, be it infinite."""
        out = np.zeros(len(expressions))
        law = law * h.weights.reshape(-1, *(1,) * (law.ndim - 1))
        for rows, found in self._by_rows(expressions, h, theta, role):
            own = law[:, rows]
            out += [np.sum(own * np.where(own > 0.0, values, 0.0)) for values in found]
        return out

    def over_values(
        self, expression: Expr, h: Histories, theta: np.ndarray, role: str
    ) -> np.ndarray:
        """(Q, R, K), or (Q, R, K, K) over x_{t-1} and x_t for "transition"; Q is S, or 1 where it
        is the same for all histories, and R is T, or 1 where it is the same in all rows (and for
        "initial")."""
        parts = []
        for _, (found,) in self._by_rows([expression], h, theta, role):
            parts.append(found)
            if found.shape[1] == 1:
                break
        return np.ascontiguousarray(np.concatenate(parts, axis=1) if parts[1:] else parts[0])

    def _by_rows(
        self, expressions: Sequence[Expr], h: Histories, theta: np.ndarray, role: str
    ) -> Iterator[tuple[slice, list[np.ndarray]]]:
        """The rows of a role, and each expression over them as of `over_values`, as many rows at a
        time as memory allows."""
        size, pair = len(self.values), role == "transition"
        given: dict[Expr, np.ndarray] = dict(zip(self.trace.parameter_symbols, theta, strict=True))
        for s, column in zip(self.trace.state_symbols, self.values.T, strict=True):
            given[s] = column
            if pair:
                given[previous(s)] = column[:, None]
        shape = (size, size) if pair else (size,)
        last = 1 if role == "initial" else h.steps
        step = max(2, ENTRIES // (h.size * int(np.prod(shape)) * max(1, len(expressions))))
        for a in range(0, last, step):
            rows = slice(a, min(a + step, last))
            own = {s: v[:, rows].reshape(len(v), -1, *(1,) * len(shape))
                   for s, v in h.rows.items()}  # fmt: skip
            found = []
            for values in evaluate(expressions, {**given, **own}):
                values = np.asarray(values, dtype=float)
                values = values.reshape((1,) * (2 + len(shape) - values.ndim) + values.shape)
                found.append(np.broadcast_to(values, (*values.shape[:2], *shape)))
            yield rows, found
