"""A small motor in a loop, with an encoder and dry friction: scales of 1e-5, a shaft that rests."""

import numpy as np
import pytest

import ssmppl as ssm
from tests.inference.maximum.test_corners import DT, MOTOR, measured

EFFECTS = ("coulomb friction", "stribeck", "dead zone", "missing input")


def without_friction():
    """As somebody writes it who has the data sheet, and no prior."""
    model = ssm.Model("dc motor", inputs=("voltage",))
    model.prior(lambda: {n: ssm.HalfFlat() for n in ("J", "b", "q", "r")})
    model.initial(lambda: {"th": ssm.Normal(0, sd=0.01), "om": ssm.Normal(0, sd=0.1)})
    resistance, constant = MOTOR["R"], MOTOR["K"]

    def step(th, om, voltage, J, b, q):
        def rhs(th, om):
            current = (voltage - constant * om) / resistance
            return {"th": om, "om": (constant * current - b * om) / J}

        new = ssm.integrate(rhs, {"th": th, "om": om}, DT)
        return {"th": ssm.Dirac(new["th"]), "om": ssm.Normal(new["om"], sd=q)}

    model.transition(step)
    model.observation(lambda th, r: {"angle": ssm.Normal(th, sd=r)})
    return model


@pytest.mark.slow
def test_the_friction_that_holds_the_shaft_is_named():
    """It was a dead zone of the voltage, of T R / K, "distinguished from every other effect": a
    smooth friction does not hold a shaft, and moved the angle only a row later."""
    report = ssm.diagnose(without_friction(), [measured(1), measured(2)], EFFECTS, seed=1,
                          progress=False)  # fmt: skip
    assert report.verdict == "effect"
    assert report.chosen == ["coulomb friction"]
    first = report.causes.iloc[0]
    assert (first["effect"], first["form"], first["kind"]) == (
        "coulomb friction", "sticking", "mechanism"
    )  # fmt: skip
    lag = MOTOR["J"] / (MOTOR["K"] ** 2 / MOTOR["R"] + MOTOR["b"])
    over_a_row = MOTOR["dry"] / MOTOR["J"] * lag * (1.0 - np.exp(-DT / lag))
    assert first["estimate"] == pytest.approx(over_a_row, rel=0.02)
    assert 0.0 < first["se"] < 0.01
    free = report.closed[report.closed["horizon"] == "free run"].iloc[0]
    assert free["rmse_after"] < 0.03 * free["rmse_before"]
