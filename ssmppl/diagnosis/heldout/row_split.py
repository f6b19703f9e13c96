"""Training and held-out rows: each experiment cut in two, or cross-validation blocks.

A filter runs over all rows before the one that it predicts, so that a part needs no rows to settle
in: with parameters fitted to earlier rows only, one-step predictions of later ones are honest
(A. P. Dawid, "Present position and potential developments: some personal views. Statistical theory:
the prequential approach", *JRSS A* 147, 1984). The gaps between the parts keep a disturbance at
their border from counting on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.data import Experiment

SHARES = (0.4, 0.7)  # of the rows, where the first and the second part end
SHORTEST = 300  # rows in all, below which blocks are left out in turn instead
LEAST_HELD_OUT = 10  # held-out rows, below which they are, too
GAP = 5  # rows between the parts
FOLDS = 10


@dataclass(frozen=True)
class RowSplit:
    """The rows of each experiment by their use: train = [0, second), held_out = [second, T).

    Effects are looked for and chosen on `train`. The reference of the gain ratio is fitted to
    [0, first) and chosen by the rest of `train`, before it is fitted to all of that.
    """

    experiments: tuple[Experiment, ...]
    first: tuple[int, ...]
    second: tuple[int, ...]

    @property
    def reference_train(self) -> tuple[Experiment, ...]:
        """The first rows of each experiment."""
        return tuple(head(e, n) for e, n in zip(self.experiments, self.first, strict=True))

    @property
    def train(self) -> tuple[Experiment, ...]:
        """The rows before the held-out ones."""
        return tuple(head(e, n) for e, n in zip(self.experiments, self.second, strict=True))

    @property
    def held_out(self) -> list[np.ndarray]:
        """For each experiment (T,), whether a row is held out."""
        return [_behind(n, e.steps) for e, n in zip(self.experiments, self.second, strict=True)]

    @property
    def reference_validation(self) -> list[np.ndarray]:
        """For each experiment (T2,), whether a row of `train` chooses the reference."""
        return [_behind(a, b) for a, b in zip(self.first, self.second, strict=True)]


def _behind(cut: int, rows: int) -> np.ndarray:
    """(rows,) whether a row lies behind a cut and its gap, or is the last one behind the cut."""
    return np.arange(rows) >= max(cut, min(cut + GAP, rows - 1))


def head(e: Experiment, rows: int) -> Experiment:
    """The first rows of an experiment."""
    return replace(
        e, y=e.y[:rows], seen=e.seen[:rows], u=e.u[:rows], steps=rows,
        time=None if e.time is None else e.time[:rows],
        observed={n: v[:rows] for n, v in e.observed.items()},
        inputs={n: v[:rows] for n, v in e.inputs.items()},
    )  # fmt: skip


def three_parts(experiments: Sequence[Experiment]) -> RowSplit:
    """Every experiment cut at the same shares of its rows; one of up to three is for `train`."""
    a, b = SHARES
    return RowSplit(
        tuple(experiments),
        tuple(min(e.steps, max(2, round(a * e.steps))) for e in experiments),
        tuple(min(e.steps, max(3, round(b * e.steps))) for e in experiments),
    )


def long_enough(experiments: Sequence[Experiment]) -> bool:
    """Whether there are rows for three parts: of many short experiments few are behind the cuts."""
    held_out = sum(int(c.sum()) for c in three_parts(experiments).held_out)
    return sum(e.steps for e in experiments) >= SHORTEST and held_out >= LEAST_HELD_OUT


@dataclass(frozen=True)
class Fold:
    """left_out : for each experiment (T,), whether a row is set missing; train : without them."""

    left_out: tuple[np.ndarray, ...]
    train: tuple[Experiment, ...]


def folds(
    experiments: Sequence[Experiment], count: int = FOLDS, *, fed_back: bool = False
) -> list[Fold]:
    """Contiguous blocks of rows, over all experiments in a row, set missing in turn.

    fed_back : a transition names observations, so that it reads them where they are missing, too.
    """
    sizes = [e.steps for e in experiments]
    number = np.minimum(np.arange(sum(sizes)) * count // sum(sizes), count - 1)
    each = np.split(number, np.cumsum(sizes)[:-1])
    out = []
    for k in range(count):
        left = tuple(n == k for n in each)
        train = tuple(without(e, rows, fed_back) for e, rows in zip(experiments, left, strict=True))
        out.append(Fold(left, train))
    return out


def without(e: Experiment, rows: np.ndarray, fed_back: bool = False) -> Experiment:
    """An experiment with the observations of these rows missing; rows (T,) bool.

    What is fed back stays in `y`, as an input does: only its density is left out.
    """
    seen = np.where(rows[:, None], 0.0, e.seen)
    observed = {
        n: np.where(rows.reshape(-1, *[1] * (v.ndim - 1)), np.nan, v) for n, v in e.observed.items()
    }
    y = e.y if fed_back else np.where(seen == 1.0, e.y, 0.0)
    return replace(e, seen=seen, y=y, observed=observed)
