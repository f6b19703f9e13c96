"""A servo axis in its control loop: friction that all expect, and noise that says next to nothing.

Here a wandering input is one row ahead nearly as good as friction, as it was on a real axis
(Janot, Gautier and Brunot 2019, "Data set and reference models of EMPS"), and simulates no better
than nothing.
"""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.modelfile import load_model
from tests.statistics.checks import seed_of

DT, SUBSTEPS = 0.02, 20


def axis():
    model = ssm.Model("axis", inputs=("u",))
    model.prior(
        lambda: {
            "b": ssm.HalfNormal(sd=5), "d": ssm.HalfNormal(sd=5),
            "q": ssm.HalfNormal(sd=0.05), "r": ssm.HalfNormal(sd=0.01),
        }
    )  # fmt: skip
    model.initial(lambda: {"p": ssm.Normal(0, sd=0.01), "v": ssm.Normal(0, sd=0.01)})

    @model.transition
    def transition(p, v, u, b, d, q):
        a = b * u - d * v
        return {
            "p": ssm.Dirac(p + DT * v + DT**2 / 2 * a),
            "v": ssm.Normal(v + DT * a, sd=q),
        }

    model.observation(lambda p, r: {"y": ssm.Normal(p, sd=r)})
    return model


def record(rows):
    """An axis with Coulomb friction and a load, moved to and fro by a controller that sees the
    encoder: force per row and position."""
    rng = np.random.default_rng(seed_of("servo"))
    t = DT * np.arange(rows)
    wanted = 0.08 * np.sin(0.9 * t) + 0.05 * np.sin(2.3 * t + 1.0)
    p, v, u, y = 0.0, 0.0, np.empty(rows), np.empty(rows)
    before = 0.0
    for k in range(rows):
        y[k] = p + 1e-5 * rng.standard_normal()
        u[k] = 8.0 * (wanted[k] - y[k]) - 1.5 * (y[k] - before) / DT
        before = y[k]
        for _ in range(SUBSTEPS):
            friction = 0.22 * np.tanh(v / 0.002) + 0.03
            v += DT / SUBSTEPS * (1.1 * u[k] - 1.9 * v - friction)
            p += DT / SUBSTEPS * v
    return {"u": u, "y": y}


@pytest.mark.slow
def test_friction_is_named_before_an_unknown_input_and_simulations_improve(tmp_path):
    report = ssm.diagnose(axis(), record(700), seed=1, progress=False, horizon=25)
    assert report.verdict == "effect"
    assert not len(report.left_out)
    first = report.causes.iloc[0]
    assert first["effect"] in ("coulomb friction", "stribeck")
    assert first["kind"] == "mechanism"
    assert report.chosen[0].startswith(first["effect"])
    window = report.closed.set_index("horizon").loc["1 to 25"]
    assert window["low"] > 0.5
    # Its own parameters for that are handed back beside those of the likelihood.
    assert set(report.estimates["simulation"]) == set(report.estimates["after"])
    assert "simulates many rows ahead best" in report.model_text
    # What an input that wanders gains one row ahead it does not gain in simulations.
    assert "missing input" in set(report.causes["effect"])
    report.save(tmp_path)
    again = load_model(str(tmp_path / "augmented_model.py"))
    assert again.name.startswith("axis")
