"""Effects that are functions of time: every date by a sum, against their weights row by row."""

import numpy as np
import pytest

from ssmppl.diagnosis.effects.candidate import (
    ALL_DATES,
    DATES,
    LEAST_TURNS,
    PHASES,
    SHORTEST,
    WAVES,
    Profiles,
    dates,
    is_dated,
    periods,
    refine_wave,
    with_all_dates,
)
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.language.tracing import trace
from tests.diagnosis.harness import scales
from tests.diagnosis.small import level
from tests.statistics.checks import seed_of

NAMES = ["level break", "parameter break", "parameter drift", "periodic forcing"]


def offered(rows):
    model = trace(level())
    return with_all_dates(offers(model, scales(model, rows), NAMES)[0], rows)


@pytest.mark.parametrize("starts", [[0], [0, 25], [0, 10, 30]])
def test_statistics_are_weighted_sums(starts):
    candidates = offered(40)
    rng = np.random.default_rng(seed_of("profiles", *starts))
    rows = rng.standard_normal((60, 3))
    columns = tuple(rng.integers(3, size=len(candidates)).tolist())
    found = Profiles(tuple(candidates), columns).statistics(rows, starts)
    ends = [*starts, 60]
    lengths = np.diff(ends)
    for k, c in enumerate(candidates):
        weights = np.concatenate([c.weights(n) for n in lengths])
        np.testing.assert_allclose(found[k], weights @ rows[:, columns[k]], atol=1e-12)


def test_every_date_of_a_short_record_is_one_family():
    candidates = [c for c in offered(100) if c.effect.name == "level break"]
    found = [dict(c.shape)["date"] for c in candidates]
    assert found == [float(d) for d in range(3, 99)]
    assert len({c.group for c in candidates}) == 1
    assert len({c.increment.key for c in candidates}) == 1
    assert all(map(is_dated, candidates))


@pytest.mark.parametrize("profile", ["step", "pulse"])
def test_dates_lie_inside(profile):
    for rows in (6, 40, ALL_DATES[profile], ALL_DATES[profile] + 1, 5000):
        found = dates(rows, profile)
        assert found[0] >= 1
        assert found[-1] < rows
        assert len(set(found)) == len(found)
        assert len(found) <= (rows if rows <= ALL_DATES[profile] else DATES[profile])


def test_what_has_no_date_stays():
    candidates = offered(100)
    drifts = [c for c in candidates if c.effect.name == "parameter drift"]
    assert len(drifts) == 2
    assert not any(map(is_dated, drifts))


@pytest.mark.parametrize("rows", [20, 100, 1000])
def test_periods_leave_no_wave_unseen(rows):
    """Of a wave of any period from `SHORTEST` (where all are tried) to half the record's length and
    any phase, some wave that is tried keeps half of the square of its correlation."""
    found = periods(rows)
    assert len(found) <= WAVES
    assert found[0] == rows / LEAST_TURNS
    assert found[-1] >= SHORTEST
    rng = np.random.default_rng(seed_of("periods", rows))
    t = np.arange(rows)
    phases = np.pi / PHASES * np.arange(PHASES)
    tried = np.cos(2 * np.pi * t / found[:, None, None] - phases[:, None]).reshape(-1, rows)
    tried /= np.linalg.norm(tried, axis=1, keepdims=True)
    for _ in range(50):
        frequency = rng.uniform(LEAST_TURNS / rows, 1.0 / found[-1])
        wave = np.cos(2 * np.pi * frequency * t - rng.uniform(0, 2 * np.pi))
        assert np.max(np.abs(tried @ wave)) ** 2 >= 0.5 * wave @ wave


@pytest.mark.parametrize("starts", [[0], [0, 250]])
def test_more_rows_sharpen_a_wave(starts):
    (c,) = [c for c in offered(200) if c.effect.name == "periodic forcing"
            and dict(c.shape) == {"period": 40.0, "phase": 0.0}]  # fmt: skip
    truth = c.with_shape(period=38.3, phase=0.7)
    ends = [*starts, 600]
    column = np.concatenate([truth.weights(n) for n in np.diff(ends)])
    column += np.random.default_rng(seed_of("refine_wave")).standard_normal(600)
    found = refine_wave(c, column, starts, 200)
    kept = np.concatenate([found.weights(n) for n in np.diff(ends)])
    plain = np.concatenate([truth.weights(n) for n in np.diff(ends)])
    assert np.corrcoef(kept, plain)[0, 1] > 0.95
    coarse = np.concatenate([c.weights(n) for n in np.diff(ends)])
    assert np.corrcoef(coarse, plain)[0, 1] < 0.8  # what the screen's own would have kept
