"""Which candidates the test of a refit's gain refits in each simulated set."""

from types import SimpleNamespace

import numpy as np

from ssmppl.diagnosis.screening.familywise import familywise
from ssmppl.diagnosis.selection import refit_test

SHAPES = 200  # of the one group whose largest statistic is high by chance


def test_the_highest_on_the_common_scale_come_first(monkeypatch):
    """A break at any of many dates has the largest statistic of all, and yet stands below what has
    one shape; a candidate that says nothing is not refitted."""
    rng = np.random.default_rng(0)
    groups = np.array([0] * SHAPES + [1, 2, 3])
    sided = np.array([0] * SHAPES + [0, 1, 0])
    null = rng.standard_normal((400, len(groups)))
    statistic = np.zeros(len(groups))
    statistic[17], statistic[SHAPES:] = 3.1, (2.7, -4.0, 9.0)
    family = familywise(statistic, null, sided=sided, groups=groups)
    found = SimpleNamespace(
        statistic=statistic, sided=sided, status=("",) * (len(groups) - 1) + ("constant",)
    )
    screen = SimpleNamespace(groups=groups, family=family)
    assert refit_test._best(screen, found) == [SHAPES, 17, SHAPES + 1]
    monkeypatch.setattr(refit_test, "TRIED", 1)
    assert refit_test._best(screen, found) == [SHAPES]
