"""Effects that are functions of time: every date by a sum, against their weights row by row."""

import numpy as np
import pytest

from ssmppl.gap.candidates import offers
from ssmppl.gap.profiles import ALL_DATES, DATES, Profiles, dated, dates, one_off
from ssmppl.language.trace import trace
from tests.gap.harness import scales
from tests.gap.small import level
from tests.statistics.checks import seed_of

NAMES = ["level break", "parameter break", "parameter drift", "periodic forcing"]


def offered(rows):
    model = trace(level())
    return dated(offers(model, scales(model, rows), NAMES)[0], rows)


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
    assert all(map(one_off, candidates))


@pytest.mark.parametrize("profile", ["step", "pulse"])
def test_dates_lie_inside(profile):
    for rows in (6, 40, ALL_DATES, ALL_DATES + 1, 5000):
        found = dates(rows, profile)
        assert found[0] >= 1
        assert found[-1] < rows
        assert len(set(found)) == len(found)
        assert len(found) <= (rows if rows <= ALL_DATES else DATES)


def test_what_has_no_date_stays():
    candidates = offered(100)
    drifts = [c for c in candidates if c.effect.name == "parameter drift"]
    assert len(drifts) == 2
    assert not any(map(one_off, drifts))
