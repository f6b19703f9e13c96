"""Data sets of one shape side by side, each distinct one once.

The laws of a model depend on its parameters, on time and on inputs: data sets of as many rows share
one evaluation of them, and what is the same in all of them stands there once. Data sets that are
equal in every row have equal likelihoods, which count as often as the data set occurs; histories of
captured and recaptured animals, say, are few even where the animals are many.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.data import Experiment
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.language.model.trace import Trace, previous, seen


@dataclass(frozen=True)
class Histories:
    """S distinct data sets of T rows each.

    weights : (S,) how often each occurs. members : (E,) positions, in the list of all, of the data
    sets that these are, and which : (E,) the history of each.
    partial : as of `Experiment`. rows : symbol -> (S or 1, T), of all symbols that have a value for
    each row.
    """

    steps: int
    partial: frozenset[str]
    weights: np.ndarray
    members: np.ndarray
    which: np.ndarray
    rows: dict[Expr, np.ndarray]

    @property
    def size(self) -> int:
        """S."""
        return len(self.weights)


def histories(
    trace: Trace, experiments: Sequence[Experiment], entries: int
) -> tuple[Histories, ...]:
    """The data sets by shape, in pieces of no more than `entries` rows unless one alone has more.

    Found once, and kept for as long as the first of the data sets lives.
    """
    if not experiments:
        return ()
    key = id(experiments[0]), len(experiments)
    kept = _kept.get(key)
    if kept is not None and kept.serves(trace, experiments, entries):
        return kept.found
    found = tuple(_grouped(trace, experiments, entries))
    references = [weakref.ref(e) for e in experiments]
    references[0] = weakref.ref(experiments[0], lambda _: _kept.pop(key, None))
    _kept[key] = _Kept(weakref.ref(trace), references, entries, found)
    return found


@dataclass(frozen=True)
class _Kept:
    trace: weakref.ref[Trace]
    experiments: list[weakref.ref[Experiment]]
    entries: int
    found: tuple[Histories, ...]

    def serves(self, trace: Trace, experiments: Sequence[Experiment], entries: int) -> bool:
        return (
            self.trace() is trace
            and self.entries == entries
            and all(r() is e for r, e in zip(self.experiments, experiments, strict=True))
        )


_kept: dict[tuple[int, int], _Kept] = {}


def _grouped(
    trace: Trace, experiments: Sequence[Experiment], entries: int
) -> list[Histories]:  # fmt: skip
    # shape -> history -> positions; dicts keep the order in which they came
    groups: dict[tuple[int, frozenset[str]], dict[tuple[bytes, ...], list[int]]] = {}
    for i, e in enumerate(experiments):
        same = groups.setdefault((e.steps, e.partial), {})
        same.setdefault((e.y.tobytes(), e.seen.tobytes(), e.u.tobytes()), []).append(i)
    out = []
    for (steps, partial), distinct in groups.items():
        places = list(distinct.values())
        most = max(1, entries // steps)
        for first in range(0, len(places), most):
            own = places[first : first + most]
            weights = np.array([len(p) for p in own])
            out.append(
                Histories(
                    steps, partial, weights, np.concatenate(own).astype(np.int64),
                    np.repeat(np.arange(len(own)), weights),
                    _rows(trace, [experiments[p[0]] for p in own], steps),
                )
            )  # fmt: skip
    return out


def _rows(trace: Trace, distinct: list[Experiment], steps: int) -> dict[Expr, np.ndarray]:
    """As of `Histories`; of what has the same rows in all of them, one."""
    t = np.arange(steps)
    before = np.maximum(t - 1, 0)
    rows = {symbol("time", "t"): t[None] + 1.0, symbol("time_prev", "t"): t[None] + 0.0}
    y, known, u = (np.stack([getattr(e, n) for e in distinct]) for n in ("y", "seen", "u"))
    for k, s in enumerate(trace.input_symbols):
        rows[s] = _shared(u[:, :, k])
        rows[previous(s)] = rows[s][:, before]
    for k, s in enumerate(trace.observation_symbols):
        rows[s], rows[seen(s)] = _shared(y[:, :, k]), _shared(known[:, :, k])
        rows[previous(s)] = rows[s][:, before]
    return rows


def _shared(column: np.ndarray) -> np.ndarray:
    """(S, T), or (1, T) where all rows are the same."""
    return column[:1] if bool(np.all(column == column[:1])) else column
