"""Which rows are used for what."""

import numpy as np
import pytest

from ssmppl.data import bind
from ssmppl.gap.parts import FOLDS, GAP, folds, long_enough, three_parts, without
from ssmppl.language.trace import trace
from tests.gap import models
from tests.gap.small import level, levels


def experiments(*sizes):
    return bind(trace(level()), [levels(n) for n in sizes])


@pytest.mark.parametrize("sizes", [(300,), (1000,), (200, 150)])
def test_parts_follow_each_other(sizes):
    parts = three_parts(experiments(*sizes))
    for e, a, b, chosen, confirm in zip(
        parts.screen, parts.first, parts.second, parts.chosen, parts.confirm, strict=True
    ):
        assert e.steps == a < b
        np.testing.assert_array_equal(np.flatnonzero(chosen), np.arange(a + GAP, b))
        np.testing.assert_array_equal(np.flatnonzero(confirm), np.arange(b + GAP, len(confirm)))
    whole = experiments(*sizes)
    for e, part in zip(whole, parts.train, strict=True):
        np.testing.assert_array_equal(e.y[: part.steps], part.y)
        np.testing.assert_array_equal(e.observed["y"][: part.steps], part.observed["y"])


def test_what_is_long_enough():
    assert long_enough(experiments(300))
    assert long_enough(experiments(200, 100))
    assert not long_enough(experiments(299))


@pytest.mark.parametrize("sizes", [(80,), (50, 37)])
def test_every_row_is_left_out_once(sizes):
    whole = experiments(*sizes)
    found = folds(whole)
    assert len(found) == FOLDS
    for i, e in enumerate(whole):
        times = np.sum([f.left_out[i] for f in found], axis=0)
        np.testing.assert_array_equal(times, np.ones(e.steps))
        for f in found:
            rows, train = f.left_out[i], f.train[i]
            assert not train.seen[rows].any()
            assert train.seen[~rows].all()
            assert not train.y[rows].any()
            assert np.isnan(train.observed["y"][rows]).all()
            np.testing.assert_array_equal(train.y[~rows], e.y[~rows])
    sizes = [sum(int(rows.sum()) for rows in f.left_out) for f in found]
    assert max(sizes) - min(sizes) <= 1


def test_what_is_missing_stays_missing():
    data = models.simulated("vector", 30)
    data["y"][4, 1] = np.nan
    (e,) = bind(trace(models.build("vector")), data)
    rows = np.arange(30) >= 25
    found = without(e, rows)
    assert found.seen[4].tolist() == [1.0, 0.0]
    assert not found.seen[25:].any()
    assert np.isnan(found.observed["y"][25:]).all()
