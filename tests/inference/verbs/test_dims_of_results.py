"""What is told of the same components has the same dims: a difference is no table of all pairs."""

import numpy as np
import pytest

import ssmppl as ssm

model = ssm.Model("two of each", inputs={"u": 2})


@model.initial
def initial():
    return {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))}


@model.transition
def transition(x, u):
    return {"x": ssm.MvNormal(0.9 * x + u, covariance=np.eye(2))}


@model.observation
def observation(x):
    return {"y": ssm.MvNormal(x + np.array([0.0, 10.0]), covariance=np.eye(2))}


INPUT = np.random.default_rng(1).normal(size=(12, 2))
DATA = {"u": INPUT, "y": ssm.simulate(model, inputs={"u": INPUT}, seed=1)["y"].values[0]}
OF = {"x": ("x", "x_sd"), "y": ("y_observed", "y_predicted", "y_predicted_sd", "y_pit"),
      "u": ("u_input",)}  # fmt: skip
RUNS = {
    "kalman": lambda: ssm.kalman_filter(model, DATA, {}),
    "particles": lambda: ssm.particle_filter(model, DATA, {}, particles=50, history=True, seed=1),
    "smoothed": lambda: ssm.smooth(model, DATA, {}),
    "trajectories": lambda: ssm.smooth(model, DATA, {}, trajectories=3, seed=1),
}


@pytest.mark.parametrize("run", RUNS)
def test_components_have_one_dim_whatever_is_told_of_them(run):
    found = RUNS[run]()
    assert not [d for d in found.dims if str(d).count("_dim_") and str(d)[0:5] not in
                ("x_dim", "y_dim", "u_dim")]  # fmt: skip
    for name, variables in OF.items():
        for variable in variables:
            assert variable not in found or found[variable].dims[-1] == f"{name}_dim_0"
            spread = f"{variable}_quantile"
            assert spread not in found or found[spread].dims[-2:] == (f"{name}_dim_0", "quantile")
    if "y_predicted" in found:
        errors = found["y_observed"] - found["y_predicted"]
        assert errors.size == DATA["y"].size
        np.testing.assert_allclose(
            errors.transpose("draw", "time", "y_dim_0").values[0],
            DATA["y"] - found["y_predicted"].values[0],
        )
