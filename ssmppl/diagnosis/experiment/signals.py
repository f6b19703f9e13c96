"""Signals that an input might be given in a further experiment, each within its recorded range.

Sines, triangles and square waves of several periods, over the whole range and over parts of it;
chirps and multisines, which hold many periods at once; random steps between two levels (a random
telegraph signal) and among many (its amplitude modulated, for what is not linear: O. Nelles,
*Nonlinear System Identification* 2001, section 17.7); staircases, for what depends on the place and
on the way there; pulses and releases, for what is seen in a decay. Which of them suits which effect
is not asked: the models are simulated under all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ssmppl.drawing.numerals import number

SIZES = (1.0, 0.7, 0.5, 0.35, 0.2)  # of the range, about its middle
PERIODS, FEWEST_ROWS = 6, 5  # periods at most, from one of the whole record down to so many rows
LEVELS = 8  # of a staircase
HOLDS = (12, 40)  # mean times at a level of random signals, so many in the record; and the shortest
PULSES, SHORT = 8, 8  # in the record; how many times shorter than the time between two
RELEASES = 3  # in the record
DIGITS = 5  # of a value, in units of the range: what is tried is what is written to a file
SWITCHES = 3  # of an input with two values, from which on it is taken for a switch


class Range(NamedTuple):
    """The least and the largest value of an input, or a part of its range."""

    low: float
    high: float

    def at(self, share: np.ndarray | float) -> np.ndarray:
        """The values at shares of the way from low to high."""
        return np.asarray(self.low + (self.high - self.low) * np.asarray(share))

    def part(self, first: float, last: float) -> Range:
        """The range between two shares of this one."""
        return Range(float(self.at(first)), float(self.at(last)))

    def __str__(self) -> str:
        return f"between {number(self.low)} and {number(self.high)}"


@dataclass(frozen=True)
class Signal:
    """A course of one input. shape : its kind, as "sine". words : what it is called, "a sine of u
    between −1 and 1 with a period of 40 rows". values : (T,), within the recorded range."""

    shape: str
    words: str
    values: np.ndarray


def family(recorded: Sequence[np.ndarray], name: str, rows: int) -> list[Signal]:
    """The signals that an input might be given, those once that come out the same.

    An input that jumped to and fro between two values is a switch, and gets no other value.

    Parameters
    ----------
    recorded : (T_e,) the input in each experiment, with at least two values in all.
    name : what the input is called.
    rows : T, of the signals.
    """
    values = np.unique(np.concatenate(list(recorded)))
    within = Range(float(values[0]), float(values[-1]))
    jumps = sum(int(np.count_nonzero(np.diff(u))) for u in recorded)
    switch = len(values) == 2 and jumps >= SWITCHES
    made = _of_two_values(within, name, rows) if switch else _of_a_range(within, name, rows)
    digits = DIGITS - int(np.floor(np.log10(within.high - within.low)))
    known: dict[bytes, Signal] = {}
    for s in made:
        u = s.values if switch else np.clip(np.round(s.values, digits), *within)
        known.setdefault(u.tobytes(), replace(s, values=u))
    return list(known.values())


def periods(rows: int) -> list[int]:
    """Periods in rows, from that of the whole record down, in equal ratios of at least 2."""
    longest = max(rows, FEWEST_ROWS)
    count = min(PERIODS, 1 + int(np.log2(longest / FEWEST_ROWS)))
    return [int(p) for p in np.geomspace(longest, FEWEST_ROWS, count).round()]


def holds(rows: int) -> list[int]:
    """Mean times in rows that a random signal stays at a level."""
    return [h for h in dict.fromkeys((*(rows // n for n in HOLDS), FEWEST_ROWS)) if h >= 2]


def _of_a_range(whole: Range, name: str, rows: int) -> Iterator[Signal]:
    """All of the family, of an input that takes any value of its range."""
    every = periods(rows)
    second = every[1::2] or every
    for size in SIZES:
        part = whole.part(0.5 - 0.5 * size, 0.5 + 0.5 * size)
        yield from _periodic("sine", sine, every, part, name, rows)
        yield from _periodic("triangle", triangle, every[:-1] or every, part, name, rows)
        yield from _random_levels(part, name, rows)
        first, last = every[min(1, len(every) - 1)], every[-1]
        yield Signal(
            "chirp",
            f"a chirp of {name} {part} with periods from {first} down to {last} rows",
            part.at(chirp(rows, first, last)),
        )
        yield Signal(
            "multisine",
            f"a multisine of {name} {part} with periods from {rows} down to {last} rows",
            part.at(multisine(rows, last)),
        )
        if part != whole:
            yield from _periodic("square wave", square, every[:-1] or every, part, name, rows)
            yield from _telegraph(part, name, rows)
    for part in (whole.part(0.5, 1.0), whole.part(0.0, 0.5)):
        yield from _periodic("sine", sine, second, part, name, rows)
        yield from _periodic("square wave", square, second, part, name, rows)
    for part in (whole, whole.part(0.25, 0.75)):
        yield from _staircases(part, name, rows)
        for p in second:
            yield Signal(
                "growing sine",
                f"a growing sine of {name}, in the end {part}, with a period of {p} rows",
                part.at(0.5 + (sine(rows, p) - 0.5) * np.linspace(0.0, 1.0, rows)),
            )
    yield from _of_two_values(whole, name, rows)


def _of_two_values(whole: Range, name: str, rows: int) -> Iterator[Signal]:
    """Those that take two values, which a switch can take too."""
    every = periods(rows)
    yield from _periodic("square wave", square, every[:-1] or every, whole, name, rows)
    yield from _telegraph(whole, name, rows)
    apart = max(rows // PULSES, 2)
    width = max(apart // SHORT, 1)
    for rest, pulse in (whole, whole[::-1]):
        yield Signal(
            "pulses",
            f"pulses of {name} from {number(rest)} to {number(pulse)}, {_rows(width)} long, one "
            f"every {_rows(apart)}",
            np.where(np.arange(rows) % apart < width, pulse, rest),
        )
    # Zero, or what is nearest to it: a release to it shows the system by itself.
    rest = float(np.clip(0.0, *whole))
    half = max(rows // (2 * RELEASES), 1)
    for value in whole:
        if value != rest:
            yield Signal(
                "release",
                f"{name} held at {number(value)} for {_rows(half)} and let go to {number(rest)} "
                "for as long, again and again",
                np.where(np.arange(rows) // half % 2 == 0, value, rest),
            )
    for value in dict.fromkeys((whole.low, rest, whole.high)):
        yield Signal("constant", f"{name} held at {number(value)}", np.full(rows, value))


def _staircases(whole: Range, name: str, rows: int) -> Iterator[Signal]:
    up = stairs(rows, LEVELS) / (LEVELS - 1.0)
    twice = stairs(rows, 2 * LEVELS)
    there_and_back = np.minimum(twice, 2 * LEVELS - 1 - twice) / (LEVELS - 1.0)
    low, high = number(whole.low), number(whole.high)
    for way, share, hold in [
        (f"from {low} up to {high}", up, rows // LEVELS),
        (f"from {high} down to {low}", 1.0 - up, rows // LEVELS),
        (f"from {low} up to {high} and down again", there_and_back, rows // (2 * LEVELS)),
    ]:
        yield Signal(
            "staircase",
            f"a staircase of {name} {way}, {LEVELS} levels of about {_rows(max(hold, 1))}",
            whole.at(share),
        )


def _periodic(
    shape: str, course: Callable[[int, int], np.ndarray], own: Sequence[int], part: Range,
    name: str, rows: int,
) -> Iterator[Signal]:  # fmt: skip
    for p in own:
        yield Signal(shape, f"a {shape} of {name} {part} with a period of {p} rows",
                     part.at(course(rows, p)))  # fmt: skip


def _telegraph(part: Range, name: str, rows: int) -> Iterator[Signal]:
    for hold in holds(rows):
        yield Signal(
            "random steps",
            f"steps of {name} {part} at random times, held for {hold} rows on average",
            part.at(telegraph(rows, hold)),
        )


def _random_levels(part: Range, name: str, rows: int) -> Iterator[Signal]:
    for hold in holds(rows):
        yield Signal(
            "random levels",
            f"random levels of {name} {part}, held for {hold} rows on average",
            part.at(random_levels(rows, hold)),
        )


def _rows(count: int) -> str:
    return f"{count} row{'s' * (count != 1)}"


# -- courses between 0 and 1, (rows,)
def sine(rows: int, period: int) -> np.ndarray:
    return 0.5 + 0.5 * np.sin(2.0 * np.pi * np.arange(rows) / period)


def triangle(rows: int, period: int) -> np.ndarray:
    """From the middle up, down, and up again."""
    phase = (np.arange(rows) / period + 0.25) % 1.0
    return 1.0 - np.abs(2.0 * phase - 1.0)


def square(rows: int, period: int) -> np.ndarray:
    """Up for the first half of a period."""
    return np.where(2 * (np.arange(rows) % period) < period, 1.0, 0.0)


def stairs(rows: int, count: int) -> np.ndarray:
    """0, 1, ..., count - 1, each for as many rows."""
    return np.arange(rows) * count // rows * 1.0


def telegraph(rows: int, hold: int) -> np.ndarray:
    """Two levels, with geometric times of this mean at each; the same at each call."""
    rng = np.random.default_rng((rows, hold))
    return np.cumsum(rng.random(rows) < 1.0 / hold) % 2 * 1.0


def random_levels(rows: int, hold: int) -> np.ndarray:
    """Uniform levels, with geometric times of this mean at each; the same at each call."""
    rng = np.random.default_rng((rows, hold))
    which = np.cumsum(rng.random(rows) < 1.0 / hold)
    return rng.random(rows + 1)[which]


def chirp(rows: int, slow: int, fast: int) -> np.ndarray:
    """A sine whose frequency grows in equal ratios from one period to the other."""
    frequency = np.geomspace(1.0 / slow, 1.0 / fast, rows)
    return 0.5 + 0.5 * np.sin(2.0 * np.pi * np.cumsum(frequency))


def multisine(rows: int, fast: int) -> np.ndarray:
    """The harmonics of the record down to a period, of equal size, with the phases that keep the
    peaks low (M. Schroeder, *IEEE Transactions on Information Theory* 16, 1970)."""
    k = np.arange(1, max(rows // fast, 1) + 1)
    angles = 2.0 * np.pi * np.outer(np.arange(rows) / rows, k) - np.pi * k * (k - 1) / len(k)
    wave = np.cos(angles).sum(axis=1)
    largest = np.abs(wave).max()
    return 0.5 + 0.5 * wave / largest if largest > 0.0 else np.full(rows, 0.5)
