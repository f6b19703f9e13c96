"""Data sets end to end, each distinct one once.

One pass goes over the rows of all. Data sets that are equal in every row have equal likelihoods,
which count as often as the data set occurs; histories of captured and recaptured animals, say, are
few even where the animals are many.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from operator import is_

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.data import Experiment
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.inference.run.problem import missing_of
from ssmppl.language.model.trace import Trace, previous, seen


@dataclass(frozen=True)
class Histories:
    """S distinct data sets end to end, R rows in all.

    first : (S + 1,) the row at which each begins, and R. weights : (S,) how often each occurs.
    members : (E,) positions, in the list of all, of the data sets that these are, and which : (E,)
    the history of each. missing : what they lack. y, seen, u : (R, ...), as of `Experiment`.
    rows : symbol -> (R,), of all symbols that have a value for each row.
    """

    first: np.ndarray
    weights: np.ndarray
    members: np.ndarray
    which: np.ndarray
    missing: Missing
    y: np.ndarray
    seen: np.ndarray
    u: np.ndarray
    rows: dict[Expr, np.ndarray]

    @property
    def size(self) -> int:
        """The number S of distinct data sets."""
        return len(self.weights)

    @property
    def steps(self) -> np.ndarray:
        """(S,) the number of rows of each."""
        return np.diff(self.first)

    def of(self, s: int) -> slice:
        """The rows of history s."""
        return slice(self.first[s], self.first[s + 1])


def histories(
    trace: Trace, experiments: Sequence[Experiment], entries: int
) -> tuple[Histories, ...]:
    """The data sets in pieces of no more than `entries` rows unless one alone has more.

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
            and all(map(is_, [r() for r in self.experiments], experiments))
        )


_kept: dict[tuple[int, int], _Kept] = {}


def _grouped(
    trace: Trace, experiments: Sequence[Experiment], entries: int
) -> list[Histories]:  # fmt: skip
    missing = missing_of(experiments)
    # history -> positions; a dict keeps the order in which they came
    distinct: dict[tuple[bytes, ...], list[int]] = {}
    for i, e in enumerate(experiments):
        distinct.setdefault((e.y.tobytes(), e.seen.tobytes(), e.u.tobytes()), []).append(i)
    pieces: list[list[list[int]]] = []
    room = 0
    for places in distinct.values():
        steps = experiments[places[0]].steps
        if steps > room:
            pieces.append([])
            room = max(entries, steps)
        pieces[-1].append(places)
        room -= steps
    return [_joined(trace, experiments, own, missing) for own in pieces]


def _joined(
    trace: Trace, experiments: Sequence[Experiment], own: list[list[int]], missing: Missing
) -> Histories:
    """The histories of one piece, each by the positions at which it occurs."""
    each = [experiments[places[0]] for places in own]
    first = np.concatenate([[0], np.cumsum([e.steps for e in each])])
    weights = np.array([len(places) for places in own])
    y, known, u = (np.concatenate([getattr(e, n) for e in each]) for n in ("y", "seen", "u"))
    t = np.arange(first[-1]) - np.repeat(first[:-1], np.diff(first))
    before = np.arange(first[-1]) - (t > 0)  # of a first row, itself
    rows = {symbol("time", "t"): t + 1.0, symbol("time_prev", "t"): t + 0.0}
    for k, s in enumerate(trace.input_symbols):
        rows[s], rows[previous(s)] = u[:, k], u[before, k]
    for k, s in enumerate(trace.observation_symbols):
        rows[s], rows[previous(s)], rows[seen(s)] = y[:, k], y[before, k], known[:, k]
    members, which = np.concatenate(own).astype(np.int64), np.repeat(np.arange(len(own)), weights)
    return Histories(first, weights, members, which, missing, y, known, u, rows)
