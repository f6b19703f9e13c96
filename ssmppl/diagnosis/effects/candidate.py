"""Candidates: effects bound to one equation of one model, with their shapes in numbers.

Of effects that are functions of time, every date and period is a candidate, and one column serves
them all: the column of an increment held at 1 gives the statistic of any function of time as a
weighted sum over its rows, so that every date of a break or of a pulse can be tried, and every
period of a wave: it costs a sum.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.effect import PROFILES, Effect
from ssmppl.errors import ArgumentError, ModelError, listing
from ssmppl.expressions.expr import Expr

WHOLE = (0,)  # one experiment

# Rows up to which every date is tried, and how many dates beyond: a break that is dated some rows
# off is still seen, a pulse is not.
ALL_DATES = {"step": 300, "pulse": 1000}
DATES = {"step": 60, "pulse": 300}
EDGE = 0.1  # share of the rows at either end where a break cannot be separated from a shift
LEAST_EDGE = 2  # rows at either end without a pulse
DATED = ("step", "pulse")  # profiles that have a date
SHORTEST = 4.0  # period in rows
LEAST_TURNS = 2.0  # of a wave in a record
WAVES = 100  # periods at most, the longest first
PHASES = 3  # that are tried: a wave between two of them keeps three quarters of its nats

# What a state, a channel, ... has changed by an effect of kind "state".
OF_ROLE = {"state": "transition", "channel": "observation", "input": "input",
           "parameter": "parameter"}  # fmt: skip


@dataclass(frozen=True)
class Candidate:
    """An effect bound to one equation of one model, its shape parameters in numbers.

    equation : label of what is changed: "v", "x[0]", "y", an input, a parameter.
    shape : (name, number) of each shape parameter; a symbol may stand for a number that is no
        length of an auxiliary state.
    bound : (argument, label) of each argument that is another state, an input, a position.
    strength : name of its parameter; 0 gives the model back.
    role : what the equation is: "state", "channel", "input" or "parameter".
    held : its process is held at 1: see `increment`.
    reaction : (label, factor) of each equation that moves with its own, by so many times as much
        (`shared_terms`). carried : likewise of what integrates its new value. halfway : likewise of
        what integrates it over the row, where that is not part of its step's own text.
    alike : labels of further inputs in which the same happens, with the same strength.
    force : the argument of a simulator through which it acts, in whose unit its strength is; "" for
        an increment of the equation itself.
    shares : candidates of the same text here have the same shapes, which then are one parameter.
    """

    effect: Effect
    equation: str
    shape: tuple[tuple[str, Any], ...] = ()
    bound: tuple[tuple[str, str], ...] = ()
    role: str = "state"
    strength: str = "strength"
    held: bool = False
    shares: str = ""
    reaction: tuple[tuple[str, Expr], ...] = ()
    carried: tuple[tuple[str, Expr], ...] = ()
    halfway: tuple[tuple[str, Expr], ...] = ()
    force: str = ""
    alike: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """The kind of its effect; "state" effects keep it."""
        return self.effect.kind

    @property
    def form(self) -> str:
        """The form of its effect, with what else it is bound to."""
        free = [a for a, role in self.effect.given.items() if role in ("other state", "any input")]
        others = [label for a, label in self.bound if a in free]
        parts = [self.effect.form, *(f"by {label}" for label in others)]
        parts += [f"through {self.force}"] if self.force else []
        if self.reaction:
            parts.append(f"with {' and '.join(label for label, _ in self.reaction)}")
        return ", ".join(filter(None, parts))

    @property
    def group(self) -> str:
        """The same for candidates that differ in their shape only."""
        own = [self.effect.name, self.form]
        if self.held:
            own = [self.effect.constant, ""] if self.effect.constant else [*own, "held"]
        return " | ".join([*own, self.change, self.place])

    @property
    def place(self) -> str:
        """The equation, or all inputs in which it acts: "u1 and u2"."""
        return " and ".join([self.equation, *self.alike])

    @property
    def each(self) -> list[Candidate]:
        """The same in each of the inputs in which it happens, its own first."""
        return [replace(self, equation=label, alike=()) for label in (self.equation, *self.alike)]

    @cached_property
    def key(self) -> str:
        """One text for each candidate; the same for increments that are the same."""
        profile = PROFILES.get(self.effect.profile)
        time = inspect.signature(profile).parameters if profile and self.held else {}
        hidden = {s for s, _ in self.shape} if self.held and self.effect.process else {*time}
        shape = ", ".join(f"{n}={v if isinstance(v, Expr) else f'{v:.14g}'}"
                          for n, v in self.shape if n not in hidden)  # fmt: skip
        return f"{self.group} | {shape}" if shape else self.group

    @property
    def change(self) -> str:
        """What it does to its equation, as a kind other than "state"."""
        return OF_ROLE[self.role] if self.kind == "state" else self.kind

    @property
    def reads_next(self) -> bool:
        """Whether it is given the mean of the step, that with other effects in it."""
        return "next" in self.effect.given.values()

    @property
    def sided(self) -> int:
        """The sign that its strength must have, 0 for both."""
        return int(self.effect.lower >= 0.0) - int(self.effect.upper <= 0.0)

    def variable(self, argument: str) -> str:
        """The label of what an argument stands for; "" is the first."""
        own = {"": self.equation, self.effect.arguments[0]: self.equation}
        return {**own, **dict(self.bound)}.get(argument, argument)

    @property
    def first_order(self) -> bool:
        """False where the strength scales a process of mean zero, so that its score is zero."""
        return self.held or not self.effect.process

    @property
    def process(self) -> str:
        """ "random walk", "ar1" (shape "memory"), or ""."""
        return "" if self.held else self.effect.process

    @property
    def increment(self) -> Candidate:
        """The candidate with its process (or function of time) held at 1.

        Its column is what a quadratic form in the process's covariance, or `weights`, turn into
        the statistic.
        """
        return replace(self, held=True) if self.effect.process or self.effect.profile else self

    def weights(self, n: int) -> np.ndarray:
        """Its function of time at the rows 1, ..., n; ones where it has none. (n,)

        The score of the step into a row stands in that row, while its t is that of the row before.
        """
        if not self.effect.profile:
            return np.ones(n)
        t = np.arange(1.0, n + 1.0) - (self.change == "transition")
        function = PROFILES[self.effect.profile]
        shape = {k: v for k, v in self.shape if k in inspect.signature(function).parameters}
        return np.asarray(function(t, **shape), dtype=float)

    def with_shape(self, **shape: float) -> Candidate:
        """The same candidate with other values of its shape parameters."""
        known = dict(self.shape)
        if unknown := [n for n in shape if n not in known]:
            raise ModelError(
                f"{self.effect.name!r} has no shape parameter {unknown[0]!r}",
                fix=f"its shape parameters are: {listing(unknown[0], known)}",
                where=self.effect.where,
            )
        values = {**known, **{n: float(v) for n, v in shape.items()}}
        return replace(self, shape=tuple(values.items()))

    def __str__(self) -> str:
        form = f" ({self.form})" if self.form else ""
        shape = ", ".join(f"{n} = {shape_text(v)}" for n, v in self.shape)
        return f"{self.effect.name}{form} in {self.place}" + (f" with {shape}" if shape else "")


def shape_text(value: float | Expr) -> str:
    """The value of a shape parameter, a round one in full; or the symbol that stands for it."""
    if isinstance(value, Expr):
        return repr(value)
    whole = f"{value:.14g}"
    return whole if float(whole) == value else f"{value:g}"


def is_dated(candidate: Candidate) -> bool:
    """Whether it happens once: a break or a pulse."""
    return candidate.effect.profile in DATED


def is_pulse(candidate: Candidate) -> bool:
    """Whether it happens in one row, so that no later rows can validate it."""
    return candidate.effect.profile == "pulse"


def with_all_dates(candidates: Sequence[Candidate], rows: int) -> list[Candidate]:
    """The candidates, with one for every date (`DATES` of them in long records), period and phase.

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
        if not is_dated(c) or "date" not in dict(c.shape):
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
    """Periods in rows: frequencies a half of the record's resolution apart, from two turns on, as
    what has not come again is no period."""
    turns = np.arange(LEAST_TURNS, rows / SHORTEST, 0.5)[:WAVES]
    return rows / turns if len(turns) else np.array([rows / LEAST_TURNS])


def refine_wave(c: Candidate, column: np.ndarray, starts: Sequence[int], rows: int) -> Candidate:
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
        columns = np.array(self.columns, dtype=int)
        index, kind = self._begins
        for s in segments(len(rows), starts):
            part, n = rows[s], s.stop - s.start
            onwards = np.concatenate(
                [np.cumsum(part[::-1], axis=0)[::-1], np.zeros((1, len(part.T)))]
            )
            step, pulse = kind == "step", kind == "pulse"
            at = np.clip(index, 0, n)
            out[step] += onwards[at[step], columns[step]]
            inside = pulse & (index < n)
            out[inside] += part[at[inside], columns[inside]]
            other = np.flatnonzero(kind == "")
            if len(other):
                out[other] += np.sum(self._weights(n) * part[:, columns[other]], axis=0)
        return out

    @cached_property
    def _begins(self) -> tuple[np.ndarray, np.ndarray]:
        """(K,) rows, from 0, in which dated ones begin, and (K,) their kind, "" for others."""
        index = np.array([_index(c) for c in self.candidates], dtype=int)
        return index, np.array([c.effect.profile if is_dated(c) else "" for c in self.candidates])

    def _weights(self, n: int) -> np.ndarray:
        """(n, K) of those that are no one-off event."""
        if n not in self.known:
            plain = [c for c in self.candidates if not is_dated(c)]
            self.known[n] = np.stack([c.weights(n) for c in plain], axis=1)
        return self.known[n]


def _index(c: Candidate) -> int:
    """The row, from 0, in which a dated candidate begins: see `Candidate.weights`."""
    if not is_dated(c):
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


def starts_of(experiments: Sequence[Experiment]) -> list[int]:
    """The first row of each experiment in arrays that have them one below the other."""
    return np.cumsum([0, *(e.steps for e in experiments[:-1])]).tolist()
