"""The diagnosis of a motor whose shaft sticks, from a model of its data sheet without a prior."""

import pytest

import ssmppl as ssm
from tests.models import dc_motor

EFFECTS = ("coulomb friction", "stribeck", "dead zone", "missing input")


@pytest.mark.slow
def test_the_friction_that_holds_the_shaft_is_named():
    """It was a dead zone of the voltage, of T R / K, "distinguished from every other effect": a
    smooth friction does not hold a shaft, and moved the angle only a row later."""
    data = [dc_motor.measured(1), dc_motor.measured(2)]
    report = ssm.diagnose(dc_motor.model(friction=False), data, EFFECTS, seed=1, progress=False)
    assert report.verdict == "effect"
    assert report.chosen == ["coulomb friction"]
    first = report.causes.iloc[0]
    assert (first["effect"], first["form"], first["kind"]) == (
        "coulomb friction", "sticking", "mechanism"
    )  # fmt: skip
    assert first["estimate"] == pytest.approx(dc_motor.taken_in_a_row(), rel=0.02)
    assert 0.0 < first["se"] < 0.01
    free = report.closed[report.closed["horizon"] == "free run"].iloc[0]
    assert free["rmse_after"] < 0.03 * free["rmse_before"]
