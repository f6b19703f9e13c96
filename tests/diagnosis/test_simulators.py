"""`diagnose` on a simulator that is a function of NumPy: what it lacks acts through its force."""

import numpy as np
import pytest

import ssmppl as ssm

T, H, STEPS = 150, 0.01, 5


def swung(state, torque, k, d, dry=0.0):
    q, v = state.T
    for _ in range(STEPS):
        v = v + H * (torque - k * np.sin(q) - d * v - dry * np.tanh(v / 0.05))
        q = q + H * v
    return np.stack([q, v], axis=1)


@ssm.simulator(state=["q", "v"], inputs=["u", "push"], parameters=["k", "d"], forces={"push": "v"})
def pendulum(state, inputs, parameters):
    return swung(state, inputs.sum(axis=1), *parameters.T)


def model():
    made = ssm.Model("pendulum", inputs=("u",))
    made.prior(lambda: {"k": ssm.LogNormal(2, sd=0.5), "d": ssm.LogNormal(-1, sd=1),
                        "s": ssm.LogNormal(-3, sd=1)})  # fmt: skip
    made.initial(lambda: {"q": ssm.Normal(0, sd=0.1), "v": ssm.Normal(0, sd=0.1)})

    @made.transition
    def transition(q, v, u, k, d, s):
        new = pendulum([q, v], [u, 0.0], [k, d])
        return {"q": ssm.Dirac(new.q), "v": ssm.Normal(new.v, sd=s)}

    made.observation(lambda q: {"y": ssm.Normal(q, sd=0.01)})
    return made


def record(dry, seed):
    rng = np.random.default_rng(seed)
    u = 4.0 * np.sin(np.arange(T) / 5.0) + 2.0 * np.sin(np.arange(T) / 1.9)
    x, y = np.zeros((1, 2)), []
    for torque in u:
        y.append(x[0, 0] + 0.01 * rng.standard_normal())
        x = swung(x, torque, 9.0, 0.3, dry) + [[0.0, 0.04 * rng.standard_normal()]]
    return {"y": np.array(y), "u": u}


@pytest.mark.slow
def test_dry_friction_is_named_and_acts_through_the_force():
    report = ssm.diagnose(model(), record(0.8, 1), mode="fast", progress=False, debug=True)
    best = report.causes.iloc[0]
    assert report.verdict == "effect"
    members = report.causes[report.causes["class_id"] == best["class_id"]]
    (dry,) = members.index[members["effect"] == "coulomb friction"]
    assert "through push" in report.causes.loc[dry, "form"]
    assert report.causes.loc[dry, "equation"] == "v"
    assert abs(report.causes.loc[dry, "estimate"] - 0.8) < 4.0 * report.causes.loc[dry, "se"]
    assert report.attributes == {}


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is_missing():
    report = ssm.diagnose(model(), record(0.0, 2), mode="fast", progress=False, debug=True)
    assert report.verdict == "no measurable gap"
