"""The signals that an input might be given: within its range, and what they are called."""

import re
from collections import Counter

import numpy as np
import pytest

from ssmppl.diagnosis.experiment.signals import (
    FEWEST_ROWS,
    LEVELS,
    chirp,
    family,
    holds,
    multisine,
    periods,
    random_levels,
    sine,
    square,
    stairs,
    telegraph,
    triangle,
)
from tests.statistics.checks import seed_of

ROWS = 300


def recorded(low=-1.2345678, high=2.0, rows=ROWS):
    """An input that goes from one end of its range to the other."""
    return np.linspace(low, high, rows)


# -- the family
@pytest.mark.parametrize("rows", [1, 2, 6, 30, 300, 1000])
@pytest.mark.parametrize(("low", "high"), [(-1.2345678, 2.0), (3.0, 3.001), (-5e6, -1e6)])
def test_every_signal_is_within_the_recorded_range(rows, low, high):
    found = family([recorded(low, high)], "u", rows)
    assert len(found) >= 20
    for s in found:
        assert s.values.shape == (rows,)
        assert low <= s.values.min() <= s.values.max() <= high
    assert len({s.values.tobytes() for s in found}) == len(found)


def test_each_has_words_of_its_own_that_say_its_range_and_its_rows():
    found = family([recorded()], "u", ROWS)
    words = [s.words for s in found]
    assert len(set(words)) == len(words)
    assert all(re.search(r"^u held at| of u\b", w) for w in words)
    assert "a sine of u between −1.23 and 2 with a period of 132 rows" in words
    assert "a triangle of u between −0.426 and 1.19 with a period of 58 rows" in words
    assert "a square wave of u between 0.383 and 2 with a period of 26 rows" in words
    assert "steps of u between −1.23 and 2 at random times, held for 25 rows on average" in words
    assert "random levels of u between −1.23 and 2, held for 7 rows on average" in words
    assert "a staircase of u from −1.23 up to 2, 8 levels of about 37 rows" in words
    assert "a chirp of u between −1.23 and 2 with periods from 132 down to 5 rows" in words
    assert "a growing sine of u, in the end between −1.23 and 2, with a period of 26 rows" in words
    assert "pulses of u from 2 to −1.23, 4 rows long, one every 37 rows" in words
    assert "u held at 2 for 50 rows and let go to 0 for as long, again and again" in words
    shapes = Counter(s.shape for s in found)
    assert set(shapes) == {
        "sine", "triangle", "square wave", "random steps", "random levels", "chirp", "multisine",
        "staircase", "growing sine", "pulses", "release", "constant",
    }  # fmt: skip
    assert len(family([recorded(rows=1000)], "u", 1000)) == len(found) < 200


@pytest.mark.parametrize("name", ["sine", "triangle", "square wave"])
def test_what_is_said_of_a_range_and_a_period_is_so(name):
    """Both ends that are named are reached, and a period later all is as it was."""
    pattern = re.compile(rf"a {name} of u between (\S+) and (\S+) with a period of (\d+) rows")
    seen = 0
    for s in family([recorded()], "u", ROWS):
        if found := pattern.fullmatch(s.words.replace("−", "-")):
            low, high, period = float(found[1]), float(found[2]), int(found[3])
            np.testing.assert_allclose(s.values[period:], s.values[:-period], atol=1e-4)
            if period >= 50:  # sampled finely enough to come near the ends
                assert abs(s.values.min() - low) < 0.06
                assert abs(s.values.max() - high) < 0.06
                seen += 1
    assert seen >= 10


def test_what_is_tried_can_be_written_down():
    """Six digits or so: the file holds what was simulated."""
    for s in family([recorded()], "u", ROWS):
        inside = s.values[(s.values > -1.2345678) & (s.values < 2.0)]
        np.testing.assert_array_equal(inside, np.round(inside, 5))


def test_an_input_that_was_switched_to_and_fro_is_given_its_two_values_only():
    on_off = 0.1234567891 + (np.arange(ROWS) // 7 % 2)
    found = family([on_off], "u", ROWS)
    assert {s.shape for s in found} == {
        "square wave", "random steps", "pulses", "release", "constant"
    }  # fmt: skip
    for s in found:
        assert set(s.values.tolist()) <= set(on_off.tolist())


def test_a_single_step_and_several_records_of_constants_are_no_switch():
    """A step up and down again is how heaters are tried out, which take any value."""
    step = np.where((np.arange(ROWS) > 100) & (np.arange(ROWS) < 200), 50.0, 0.0)
    assert "sine" in {s.shape for s in family([step], "u", ROWS)}
    assert "sine" in {s.shape for s in family([np.zeros(9), np.ones(9)], "u", ROWS)}


def test_the_range_is_that_of_all_records():
    found = family([np.linspace(0.0, 1.0, 50), np.linspace(-3.0, 0.0, 20)], "u", 40)
    assert min(s.values.min() for s in found) == -3.0
    assert max(s.values.max() for s in found) == 1.0


@pytest.mark.parametrize(("low", "high", "rest"), [(-1, 2, 0.0), (1, 2, 1.0), (-3, -1, -1.0)])
def test_it_is_let_go_to_zero_or_what_is_nearest_to_it(low, high, rest):
    released = [s for s in family([recorded(low, high)], "u", ROWS) if s.shape == "release"]
    assert len(released) == (2 if low < 0 < high else 1)
    for s in released:
        assert s.values[0] in (low, high)
        assert s.values[60] == rest  # after a sixth of the record
        assert s.values[110] == s.values[0]


# -- periods and courses
@pytest.mark.parametrize("rows", [10, 11, 50, 333, 1000, 40_000])
def test_periods_go_from_the_record_to_a_few_rows_in_equal_ratios(rows):
    found = periods(rows)
    assert (found[0], found[-1]) == (rows, FEWEST_ROWS)
    ratios = np.array(found[:-1]) / found[1:]
    assert ratios.min() > 1.9
    assert ratios.max() / ratios.min() < 1.35  # but for rounding to rows
    assert len(found) <= 6


def test_of_a_short_record_there_is_one_period():
    assert periods(3) == [FEWEST_ROWS]
    assert periods(9) == [9]
    assert holds(1000) == [83, 25, 5]
    assert holds(30) == [2, 5]


def test_courses():
    np.testing.assert_allclose(sine(8, 8), 0.5 + 0.5 * np.sin(np.arange(8) * np.pi / 4))
    np.testing.assert_allclose(triangle(8, 8), [0.5, 0.75, 1, 0.75, 0.5, 0.25, 0, 0.25])
    np.testing.assert_array_equal(square(10, 5), [1, 1, 1, 0, 0] * 2)
    np.testing.assert_array_equal(stairs(12, 4), np.repeat([0, 1, 2, 3], 3))


def test_a_staircase_takes_all_levels_up_down_and_both_ways():
    found = {
        s.words.split("u ")[1][:30]: s.values
        for s in family([np.array([0.0, 7.0])], "u", 160)
        if (s.shape == "staircase" and "from 0" in s.words) or "from 7 " in s.words
    }
    up, down, both = (v for v in found.values() if len(set(v.tolist())) == LEVELS)
    np.testing.assert_array_equal(up, np.repeat(np.arange(8.0), 20))
    np.testing.assert_array_equal(down, up[::-1])
    half = np.repeat(np.arange(8.0), 10)
    np.testing.assert_array_equal(both, np.concatenate([half, half[::-1]]))


def test_random_signals_stay_as_long_as_they_say():
    """Switches are binomial: within four standard deviations of their mean."""
    rows, hold = 6000, 20
    for found in (telegraph(rows, hold), random_levels(rows, hold)):
        switches = np.count_nonzero(np.diff(found))
        assert abs(switches - rows / hold) < 4 * np.sqrt(rows / hold)
    assert set(telegraph(rows, hold).tolist()) == {0.0, 1.0}
    levels = np.unique(random_levels(rows, hold))
    assert len(levels) > 200
    assert abs(levels.mean() - 0.5) < 4 * np.sqrt(1 / 12 / len(levels))
    np.testing.assert_array_equal(telegraph(rows, hold), telegraph(rows, hold))


def test_a_chirp_goes_from_slow_to_fast():
    wave = chirp(2000, 400, 10) - 0.5
    up = np.flatnonzero((wave[:-1] < 0) & (wave[1:] >= 0))
    lengths = np.diff(up)
    assert np.all(np.diff(lengths) <= 1)
    assert 150 < lengths[0] < 400
    assert 10 <= lengths[-1] <= 11


def test_a_multisine_has_its_harmonics_in_equal_size_and_low_peaks():
    rows, fast = 600, 20
    wave = multisine(rows, fast)
    size = np.abs(np.fft.rfft(wave - 0.5))
    count = rows // fast
    np.testing.assert_allclose(size[1 : count + 1], size[1])
    assert size[count + 1 :].max() < 1e-9 * size[1]
    peak = np.abs(wave - 0.5).max()
    assert peak == pytest.approx(0.5)
    crest = peak / np.sqrt(np.mean((wave - 0.5) ** 2))
    rng = np.random.default_rng(seed_of("phases"))
    t = 2 * np.pi * np.outer(np.arange(rows) / rows, np.arange(1, count + 1))
    others = [np.cos(t + rng.uniform(0, 2 * np.pi, count)).sum(axis=1) for _ in range(50)]
    assert crest < min(np.abs(w).max() / np.sqrt(np.mean(w**2)) for w in others)
