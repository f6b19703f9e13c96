"""`plot_components`: what it draws, against the states and their covariances; what it refuses."""

from __future__ import annotations

import warnings
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError

st = ssm.structural
ROWS = 24
RNG = np.random.default_rng(3)
DATA = {"y": 2.0 + 0.3 * RNG.normal(size=ROWS), "u": RNG.normal(size=ROWS),
        "w": RNG.normal(size=(ROWS, 2))}  # fmt: skip
DATA["y"][5] = np.nan
THETA = {"level_sd": 0.1, "season_sd": 0.05, "y_sd": 0.2, "u_coefficient": 0.3, "step_9": 0.5}


def made() -> ssm.Model:
    model = ssm.Model("drawn", inputs={"u": None, "w": 2})
    st.observe(
        model,
        "y",
        st.level(model),
        st.seasonal(model, 5, form="trigonometric"),
        st.regression(model, "u"),
        st.regression(model, "w", random_walk=True, sd=0, name="moving"),
        st.intervention(model, 9),
    )
    return model


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def curves(ax: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The 5%, 50% and 95% curves of a panel."""
    corners = ax.collections[0].get_paths()[0].vertices
    x = ax.lines[0].get_xdata()
    ends = [(lambda own: (own.min(), own.max()))(corners[corners[:, 0] == t, 1]) for t in x]
    low, high = np.array(ends).T
    return low, np.asarray(ax.lines[0].get_ydata()), high


def test_sums_of_states_have_the_spread_of_their_covariance():
    model = made()
    smoothed = ssm.smooth(model, DATA, THETA)
    axes = ssm.plot_components(model, smoothed, parameters=THETA)
    assert [a.get_ylabel() for a in axes] == [
        "y", "level", "season", "regression", "moving", "step_9"
    ]  # fmt: skip
    states = list(smoothed["state"].values)
    slopes = {
        "season": {"season[0]": np.ones(ROWS), "season[2]": np.ones(ROWS)},
        "moving": {f"w_coefficient[{k}]": DATA["w"][:, k] for k in range(2)},
        "level": {"level": np.ones(ROWS)},
    }
    slopes["y"] = {n: c for own in list(slopes.values()) for n, c in own.items()}
    known = 0.3 * DATA["u"] + 0.5 * (np.arange(1, ROWS + 1) >= 9)
    values = {
        "level": smoothed["level"][0].values,
        "season": smoothed["season"][0].values[:, [0, 2]].sum(axis=1),
        "moving": (smoothed["w_coefficient"][0].values * DATA["w"]).sum(axis=1),
    }
    values["y"] = sum(values.values()) + known
    for panel in axes:
        name = panel.get_ylabel()
        if name not in slopes:
            continue
        c = np.zeros((ROWS, len(states)))
        for state, own in slopes[name].items():
            c[:, states.index(state)] = own
        spread = np.sqrt(np.einsum("ti,tij,tj->t", c, smoothed["covariance"][0].values, c))
        low, middle, high = curves(panel)
        np.testing.assert_allclose(middle, values[name], atol=1e-9)
        z = scipy.stats.norm.ppf(0.95)
        np.testing.assert_allclose(high, middle + z * spread, atol=1e-9)
        np.testing.assert_allclose(low, middle - z * spread, atol=1e-9)
    step = axes[-1]
    np.testing.assert_allclose(curves(step)[1], 0.5 * (np.arange(1, ROWS + 1) >= 9))
    seen = axes[0].lines[1].get_ydata()
    np.testing.assert_array_equal(seen, DATA["y"][np.isfinite(DATA["y"])])


def test_draws_of_the_posterior():
    model = made()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # so few have not converged
        idata = ssm.sample(
            model, DATA, draws=15, warmup=10, chains=2, seed=1, progress=False,
            fixed={"u_coefficient": 0.3},
        )  # fmt: skip
    axes = ssm.plot_components(model, idata, components=["moving", "y", "step_9", "regression"])
    own = {n: v.values.reshape(30, *v.shape[2:]) for n, v in idata.posterior.items()}
    moving = (own["w_coefficient"] * DATA["w"]).sum(axis=-1)
    step = own["step_9"][:, None] * (np.arange(1, ROWS + 1) >= 9)
    fixed = 0.3 * DATA["u"][None]
    total = own["level"] + own["season"][..., [0, 2]].sum(axis=-1) + moving + step + fixed
    for ax, draws in zip(axes, (moving, total, step, fixed), strict=True):
        found = np.array(curves(ax))
        np.testing.assert_allclose(found, np.quantile(draws, [0.05, 0.5, 0.95], axis=0), atol=1e-9)


def test_trajectories_and_several_experiments():
    model = made()
    several = ssm.smooth(model, [DATA, DATA], THETA, trajectories=4, seed=1)
    axes = ssm.plot_components(model, several, components="season", parameters=THETA)
    assert axes.shape == (2,)
    for ax, one in zip(axes, several, strict=True):
        draws = one["season"].values[..., [0, 2]].sum(axis=-1)
        np.testing.assert_allclose(curves(ax)[1], np.median(draws, axis=0), atol=1e-9)


def test_counts_are_drawn_by_their_logarithm():
    model, start = ssm.Model("counts"), ssm.Normal(0, sd=1)
    st.observe(model, "n", st.level(model, sd=0.1, initial=start), distribution="poisson")
    n = np.array([0.0, 1.0, 3.0, 2.0, 5.0])
    smoothed = ssm.smooth(model, {"n": n}, {}, trajectories=20, seed=1)
    top, level = ssm.plot_components(model, smoothed)
    assert (top.get_ylabel(), level.get_ylabel()) == ("log mean of n", "level")
    np.testing.assert_allclose(top.lines[1].get_ydata(), np.log(n[1:]))


def plain() -> ssm.Model:
    model = ssm.Model("plain")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return model


BAD = {
    "no model": (lambda m, s: ssm.plot_components(s, m), "for the model", "(model, result)"),
    "no components": (lambda m, s: ssm.plot_components(plain(), s), "no components", "plot_states"),
    "a name": (
        lambda m, s: ssm.plot_components(m, s, components="trend"), "no component 'trend'", "level"
    ),
    "no parameters": (
        lambda m, s: ssm.plot_components(m, s), "depends on the parameters", "parameters="
    ),
    "another result": (
        lambda m, s: ssm.plot_components(m, s["level"], parameters=THETA), "cannot draw",
        "ssm.sample",
    ),
    "of another model": (
        lambda m, s: ssm.plot_components(m, s.drop_vars("season"), parameters=THETA),
        "cannot draw", "ssm.sample",
    ),
    "no covariances": (
        lambda m, s: ssm.plot_components(m, s.drop_vars("covariance"), parameters=THETA),
        "moments of single states", "trajectories=",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_refused(name: str):
    bad, found, fix = BAD[name]
    model = made()
    smoothed = ssm.smooth(model, DATA, THETA)
    with pytest.raises(ArgumentError) as caught:
        bad(model, smoothed)
    assert found in caught.value.found
    assert fix in caught.value.fix
