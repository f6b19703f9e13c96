"""The experiment that tells rival models apart best, of those that their inputs allow.

The family of signals of each input (`signals.py`) is gone through in three steps, each with data
sets of its own and fewer signals than the one before: with the rivals as they are, which bounds how
far they can come apart at hardly any cost; with the rivals fitted to each other's data; and the
best few on more data sets, whose figure is the one that is reported. What drives the outputs
farther than they were recorded is left out: neither the model nor the machine is known there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.experiment.rivals import (
    NEEDED,
    Look,
    Rival,
    look_at,
    observed_range,
    together,
)
from ssmppl.diagnosis.experiment.signals import Signal, family
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.seeds import child_seed
from ssmppl.language.model.trace import Trace

MOST_ROWS = 15_000  # of a record, beyond which the fits would take too long
MOST_VARIED = 4  # inputs that are replaced in turn
MOST_ALIKE = 2  # signals of one shape that are looked at again
ROOM = 0.1  # of the recorded range of what is observed, by which it may be left at either end
SURE = 1.0  # nats, below which a ratio cannot be told from none with so few sets

# Why a signal has no figure.
OUTSIDE = "leaves the recorded range"
ASTRAY = "a rival model fails"
ALIKE = "the rivals predict nearly the same"
BEHIND = "others separate better"


@dataclass(frozen=True)
class Effort:
    """How many signals are tried of each input, under how many of them rivals are fitted, how many
    are looked at again, and with how many data sets from each rival, as under the recorded
    inputs; and how many rivals, the leading ones, are compared."""

    tried: int = 1000
    compared: int = 8
    finalists: int = 3
    sets: int = 6
    rivals: int = 3


PLAIN, CALLED = Effort(), Effort(12, 2, 1, 2, 2)  # CALLED : of a model that calls a simulator


@dataclass(frozen=True, eq=False)
class Tried:
    """A signal of one input that was tried. nats : the expected log-likelihood ratio of the pair
    that is hardest to tell apart; NaN where it was not computed, and then `note` says why."""

    input: str
    signal: Signal
    nats: float = math.nan
    note: str = ""


@dataclass(frozen=True, eq=False)
class Separation:
    """How far rival effects come apart, in the record at hand and in the best other experiment.

    Ratios are the expected log-likelihood ratios, in nats, of the pair of rivals that is hardest to
    tell apart, in a record as long as the longest.

    effects : (effect, equation) of the rivals that were compared. members : of the class that these
    are the first of. recorded : the ratio with the recorded inputs (T, U). rows : T. records : how
    many there are. tried : the signals, best first; none where no input varies, or no other one is
    needed. inputs : (T, U) of the best experiment; None where none would do. needed : the ratio
    with which the right one of a pair is ahead in 95% of records.
    """

    effects: tuple[tuple[str, str], ...]
    members: int
    recorded: float
    recorded_inputs: np.ndarray
    records: int
    tried: tuple[Tried, ...] = ()
    inputs: np.ndarray | None = None
    needed: float = NEEDED

    @property
    def rows(self) -> int:
        return len(self.recorded_inputs)

    @property
    def best(self) -> Tried | None:
        """The signal with the largest ratio; None where none has one."""
        return next((t for t in self.tried if not math.isnan(t.nats)), None)

    @property
    def runs(self) -> int:
        """How often the best experiment has to be run; 0 where that cannot be told, or where it
        would be more often than there are records."""
        nats = self.best.nats if self.best else 0.0
        runs = math.ceil(self.needed / nats) if nats >= SURE else 0
        return runs if runs <= self.records else 0

    @property
    def as_recorded(self) -> bool:
        """Whether another record with the same inputs is expected to tell them apart."""
        return self.recorded >= self.needed

    @property
    def times_as_many(self) -> float:
        """How many records with the recorded inputs are needed; infinite where that cannot be
        told."""
        return self.needed / self.recorded if self.recorded >= SURE else math.inf


def separate(
    augmented: AugmentedModels, trace: Trace, rivals: Sequence[Rival], members: int,
    experiments: Sequence[Experiment], seed: np.random.SeedSequence, checkpoint: Checkpoint,
) -> Separation | None:  # fmt: skip
    """How far these rivals come apart, and the experiment in which they do so best; None where that
    cannot be told, as all of them happen once or they fail under the recorded inputs.

    members : of the class that the rivals are of, the best first.
    """
    effort = CALLED if simulators(trace) else PLAIN
    rivals = list(rivals[: effort.rivals])
    if all(r.happens_once for r in rivals):
        return None
    longest = max(experiments, key=lambda e: e.steps)
    search = _Search(augmented, rivals, longest, effort, seed, checkpoint)
    nats, within = search.recorded(experiments)
    if math.isnan(nats):
        return None
    effects = tuple((r.candidates[0].effect.name, r.candidates[0].place) for r in rivals)
    found = Separation(effects, members, max(nats, 0.0), longest.u, len(experiments))
    if found.as_recorded:
        return found
    signals = list(signals_of(trace, experiments, longest.steps, effort.tried))
    columns = list(map(repr, trace.input_symbols))
    found = replace(found, tried=tuple(search.best_first(columns, signals, within)))
    if not found.runs or found.best is None:
        return found
    column = columns.index(found.best.input)
    return replace(found, inputs=with_input(longest, column, found.best.signal.values).u)


def signals_of(
    trace: Trace, experiments: Sequence[Experiment], rows: int, most: int
) -> Iterator[Tried]:
    """The signals of the inputs that vary within an experiment, at most so many of each.

    What does not vary is no drive (a setting), and stays; so does the length of a step.
    """
    step = None if trace.time_step is None else trace.time_step[0]
    varied = [
        k for k, symbol in enumerate(trace.input_symbols)
        if symbol.data[1] != step and any(np.ptp(e.u[:, k]) > 0.0 for e in experiments)
    ]  # fmt: skip
    for k in varied[:MOST_VARIED]:
        name = repr(trace.input_symbols[k])
        made = family([e.u[:, k] for e in experiments], name, rows)
        spread = np.linspace(0, len(made) - 1, min(most, len(made))).round().astype(int)
        yield from (Tried(name, made[i]) for i in spread)


@dataclass(frozen=True)
class _Search:
    """The steps of a search, over signals in one experiment."""

    augmented: AugmentedModels
    rivals: Sequence[Rival]
    experiment: Experiment
    effort: Effort
    seed: np.random.SeedSequence
    checkpoint: Checkpoint

    def recorded(
        self, experiments: Sequence[Experiment]
    ) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
        """The ratio with the recorded inputs; the least and the largest value (K,) of each channel
        that another experiment may lead to."""
        stage = "rivals under the recorded inputs"
        (found,) = self._look(stage, [self.experiment], Look(self.effort.sets, True), 1)
        low, high = observed_range(experiments)
        low, high = np.fmin(low, found.get("low", low)), np.fmax(high, found.get("high", high))
        room = ROOM * (high - low)
        return self._ratio(found), (low - room, high + room)

    def best_first(
        self, inputs: Sequence[str], signals: Sequence[Tried],
        within: tuple[np.ndarray, np.ndarray],
    ) -> list[Tried]:  # fmt: skip
        """The signals, those with a ratio first and the largest first. inputs : what the columns of
        the experiment's inputs are called."""
        effort, left, done = self.effort, list(signals), []
        steps = [
            ("rivals under other inputs", len(left), Look(1, False, within)),
            ("rivals fitted to each other", effort.compared, Look(1, True, within)),
            ("rivals under the best inputs", effort.finalists, Look(effort.sets, True, within)),
        ]
        for place, (stage, most, look) in enumerate(steps, start=2):
            left, behind = _of_many_shapes(left, most)
            under = [
                with_input(self.experiment, inputs.index(t.input), t.signal.values) for t in left
            ]
            found = self._look(stage, under, look, place)
            judged = [self._judged(t, f, look) for t, f in zip(left, found, strict=True)]
            done += [replace(t, nats=math.nan, note=BEHIND) for t in behind]
            done += [t for t in judged if t.note]
            left = sorted((t for t in judged if not t.note), key=lambda t: -t.nats)
        return [*left, *done]

    def _judged(self, tried: Tried, found: Numbers, look: Look) -> Tried:
        """A signal with its ratio, or with why it is left out."""
        nats, note = self._ratio(found), ""
        if not found.get("inside", True):
            note = OUTSIDE
        elif math.isnan(nats):
            note = ASTRAY
        elif not look.fitted and nats < SURE:
            note = ALIKE
        return replace(tried, nats=math.nan if note else max(nats, 0.0), note=note)

    def _look(
        self, stage: str, under: Sequence[Experiment], look: Look, place: int
    ) -> list[Numbers]:
        """What came of each of the experiments; nothing where a fault ended it."""
        look, rivals = replace(look, apart=len(under) == 1), len(self.rivals)
        one = partial(
            look_at, self.augmented, self.rivals, under, look, child_seed(self.seed, place)
        )
        failures, tasks = self.checkpoint.failures, len(under) * (rivals if look.apart else 1)
        found = [{} if failures.record_task(f"the {stage}", f) else f
                 for f in self.checkpoint.map(stage, tasks, one)]  # fmt: skip
        return [together(found)] if look.apart else found

    def _ratio(self, found: Numbers) -> float:
        """The mean ratio of the hardest pair; NaN where a pair has none in half of the sets."""
        if "ratios" not in found:
            return math.nan
        truths = np.array([not r.happens_once for r in self.rivals])
        pairs = truths[:, None] & ~np.eye(len(truths), dtype=bool)
        ratios = found["ratios"][:, pairs]
        if np.any(2 * np.isnan(ratios).sum(axis=0) >= len(ratios)):
            return math.nan
        return float(np.nanmean(ratios, axis=0).min())


def _of_many_shapes(tried: Sequence[Tried], most: int) -> tuple[list[Tried], list[Tried]]:
    """The first of the signals, few of each shape, so many in all; and the others."""
    first: list[Tried] = []
    for t in tried:
        alike = sum(t.signal.shape == f.signal.shape and t.input == f.input for f in first)
        if len(first) < most and (alike < MOST_ALIKE or most >= len(tried)):
            first.append(t)
    return first, [t for t in tried if t not in first]


def with_input(e: Experiment, column: int, values: np.ndarray) -> Experiment:
    """The experiment with a column of its inputs (T, U) replaced."""
    u = e.u.copy()
    u[:, column] = values
    return replace(e, u=u)
