"""Components in cells of a notebook, which are run again."""

from __future__ import annotations

import pytest

from ssmppl.errors import ArgumentError
from ssmppl.language.tracing import trace
from tests.language.model.test_executions import cell

__all__ = ["cell"]  # a fixture

PARTS = """
trend = ssm.structural.trend(m{})
season = ssm.structural.seasonal(m, 4)
ssm.structural.observe(m, "y", trend, season)
"""


@pytest.mark.filterwarnings("ignore:@")
def test_a_cell_that_is_run_again_writes_its_components_anew(cell):
    for _ in range(2):
        model = cell(PARTS.format(""), id="a")["m"]
        assert list(trace(model).transition) == ["level", "slope", "season", "season_past"]
    with pytest.warns(UserWarning, match="trend_transition of model 'm' has changed"):
        model = cell(PARTS.format(", level_sd=0"), id="a")["m"]
    assert "level_sd" not in trace(model).parameters
    assert list(model.components) == ["trend", "season", "y"]
    model = cell(PARTS.replace("season", "quarter").replace("quarteral", "seasonal").format(""),
                 id="a")["m"]  # fmt: skip
    assert list(trace(model).observations) == ["y"]


def test_another_cell_gives_them_twice(cell):
    cell(PARTS.format(""), id="a")
    with pytest.raises(ArgumentError, match="named 'trend' already"):
        cell("ssm.structural.trend(m)", id="b")
