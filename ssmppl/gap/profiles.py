"""Effects that are functions of time: their dates and periods, their statistics from one column.

The column of an increment held at 1 gives the statistic of any function of time as a weighted sum
over its rows, so that every date of a break or of a pulse can be tried, and every period of a wave:
it costs a sum.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from ssmppl.errors import ArgumentError
from ssmppl.gap.candidate import Candidate

WHOLE = (0,)  # one experiment

# Rows up to which every date is tried, and how many dates beyond: a break that is dated some rows
# off is still seen, a pulse is not.
ALL_DATES = {"step": 300, "pulse": 1000}
DATES = {"step": 60, "pulse": 300}
EDGE = 0.1  # share of the rows at either end where no break can be told from a shift
LEAST_EDGE = 2  # rows at either end without a pulse
ONE_OFF = ("step", "pulse")  # profiles that have a date
SHORTEST = 4.0  # period in rows
WAVES = 100  # periods at most, the longest first
PHASES = 3  # that are tried: a wave between two of them keeps three quarters of its nats


def one_off(candidate: Candidate) -> bool:
    """Whether it happens once: a break or a pulse."""
    return candidate.effect.profile in ONE_OFF


def passing(candidate: Candidate) -> bool:
    """Whether it happens in one row, so that no later ones can bear it out."""
    return candidate.effect.profile == "pulse"


def dated(candidates: Sequence[Candidate], rows: int) -> list[Candidate]:
    """With a candidate for every date (`DATES` of them in long records) and for every period
    and phase where there is one.

    rows : of the longest experiment.
    """
    out: list[Candidate] = []
    seen: set[str] = set()
    for c in candidates:
        if c.effect.profile == "wave" and {"period", "phase"} <= set(dict(c.shape)):
            if c.group not in seen:
                seen.add(c.group)
                out += [c.with_shape(period=float(p), phase=k * np.pi / PHASES)
                        for p in periods(rows) for k in range(PHASES)]  # fmt: skip
            continue
        if not one_off(c) or "date" not in dict(c.shape):
            out.append(c)
            continue
        rest = [f"{n}={v}" for n, v in c.shape if n != "date"]
        family = " | ".join([c.group, *rest])
        if family not in seen:
            seen.add(family)
            out += [c.with_shape(date=float(d)) for d in dates(rows, c.effect.profile)]
    return out


def dates(rows: int, profile: str) -> np.ndarray:
    """Rows from 1 on at which a break or a pulse is tried."""
    edge = LEAST_EDGE if profile == "pulse" else max(LEAST_EDGE, round(EDGE * rows))
    first, last = 1 + edge, rows - edge
    if last < first:
        return np.array([max(1, rows // 2)])
    every = last - first + 1
    count = every if rows <= ALL_DATES[profile] else min(DATES[profile], every)
    return np.unique(np.linspace(first, last, count).round().astype(int))


def periods(rows: int) -> np.ndarray:
    """In rows: frequencies a half of the record's resolution apart, from one turn on."""
    turns = np.arange(1.0, rows / SHORTEST, 0.5)[:WAVES]
    return rows / turns if len(turns) else np.array([float(rows)])


def sharpened(c: Candidate, column: np.ndarray, starts: Sequence[int], rows: int) -> Candidate:
    """A wave with period and phase by the column (T,) of more rows than those it was found on.

    rows : of the longest experiment it was found on, whose resolution is how far the frequency can
    be off.
    """
    period = dict(c.shape)["period"]
    longest = max(s.stop - s.start for s in segments(len(column), starts))
    near = 1.0 / period + np.arange(-1.0, 1.0 + 1e-9, rows / (8.0 * longest)) / rows
    near = near[(near >= 0.5 / longest) & (near <= 1.0 / SHORTEST)]
    total = np.zeros(len(near), dtype=complex)
    for s in segments(len(column), starts):
        t = np.arange(1.0, s.stop - s.start + 1.0) - (c.change == "transition")
        total += np.exp(2j * np.pi * np.outer(near, t)) @ column[s]
    if not len(near):
        return c
    best = int(np.argmax(np.abs(total)))
    return c.with_shape(period=1.0 / near[best], phase=float(np.angle(total[best])))


@dataclass(frozen=True)
class Profiles:
    """Candidates with a function of time, and the column (F) of each."""

    candidates: tuple[Candidate, ...]
    columns: tuple[int, ...]
    known: dict[int, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def statistics(self, rows: np.ndarray, starts: Sequence[int]) -> np.ndarray:
        """(K,) sums of the columns of rows (T, F), weighted by the functions of time."""
        out = np.zeros(len(self.candidates))
        places = np.array(self.columns, dtype=int)
        index, kind = self._begins
        for s in segments(len(rows), starts):
            part, n = rows[s], s.stop - s.start
            onwards = np.concatenate(
                [np.cumsum(part[::-1], axis=0)[::-1], np.zeros((1, len(part.T)))]
            )
            step, pulse = kind == "step", kind == "pulse"
            at = np.clip(index, 0, n)
            out[step] += onwards[at[step], places[step]]
            inside = pulse & (index < n)
            out[inside] += part[at[inside], places[inside]]
            other = np.flatnonzero(kind == "")
            if len(other):
                out[other] += np.sum(self._weights(n) * part[:, places[other]], axis=0)
        return out

    @cached_property
    def _begins(self) -> tuple[np.ndarray, np.ndarray]:
        """(K,) rows, from 0, in which dated ones begin, and (K,) their kind, "" for others."""
        index = np.array([_index(c) for c in self.candidates], dtype=int)
        return index, np.array([c.effect.profile if one_off(c) else "" for c in self.candidates])

    def _weights(self, n: int) -> np.ndarray:
        """(n, K) of those that are no one-off event."""
        if n not in self.known:
            plain = [c for c in self.candidates if not one_off(c)]
            self.known[n] = np.stack([c.weights(n) for c in plain], axis=1)
        return self.known[n]


def _index(c: Candidate) -> int:
    """The row, from 0, in which a dated candidate begins: see `Candidate.weights`."""
    if not one_off(c):
        return 0
    return int(dict(c.shape)["date"]) - 1 + (c.change == "transition")


def segments(rows: int, starts: Sequence[int] = WHOLE) -> Iterator[slice]:
    """The rows of each experiment.

    Raises
    ------
    ArgumentError : starts that are not increasing from 0 within the rows.
    """
    edges = [*starts, rows]
    if edges[0] != 0 or any(a >= b for a, b in pairwise(edges)):
        raise ArgumentError(
            f"experiments that start at rows {list(starts)}, of {rows} rows",
            fix="give the first row of each experiment, increasing, the first one 0",
        )
    return (slice(a, b) for a, b in pairwise(edges))
