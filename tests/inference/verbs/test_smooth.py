"""The verb `smooth`: what each method gives, against exact moments; what it says and refuses."""

from __future__ import annotations

import warnings

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError
from ssmppl.inference.particles.backward import genealogy, particle_system
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.particles.fixed_lag import lag_moments
from ssmppl.inference.run.seeds import random_state
from tests.inference.smoothing_cases import (
    CASES,
    assert_moments,
    exact_moments,
    moments_of,
    smoothing_case,
)
from tests.models import standard as models
from tests.statistics.checks import assert_moments as assert_chain_moments
from tests.statistics.checks import seed_of
from tests.statistics.exact import DenseGaussian

ONE = "one state, gaps"


def call(label, *args, **kwargs):
    _, _, _, data, parameters = smoothing_case(label)
    return ssm.smooth(CASES[label][0], data, parameters, *args, **kwargs)


# -- exact
@pytest.mark.parametrize("label", [ONE, "four states", "echo"])
def test_exact_moments(label):
    _, _, exact, *_ = smoothing_case(label)
    found = call(label)
    mean, covariance, pair = exact_moments(exact)
    assert dict(found.sizes)["draw"] == 1
    stacked = np.concatenate(
        [np.atleast_3d(found[n].values[0].reshape(len(mean), -1))[..., 0] for n in states(label)],
        axis=1,
    )
    np.testing.assert_allclose(stacked, mean, atol=1e-9)
    np.testing.assert_allclose(found["covariance"].values[0], covariance, atol=1e-9)
    np.testing.assert_allclose(found["covariance_previous"].values[0, 1:], pair, atol=1e-9)
    assert np.isnan(found["covariance_previous"].values[0, 0]).all()
    assert found.attrs["log_likelihood"] == pytest.approx(exact.log_likelihood, abs=1e-8)
    assert found.attrs["method"] == "KalmanSmoother"
    assert "linear Gaussian" in found.attrs["method_chosen"]
    name = states(label)[0]
    level = found[f"{name}_quantile"].sel(quantile=0.95)
    expected = found[name] + stats.norm.ppf(0.95) * found[f"{name}_sd"]
    np.testing.assert_allclose(level, expected, atol=1e-9)


def states(label):
    return [s.data[1] for s in smoothing_case(label)[0].trace.state_symbols if not any(s.data[2])]


def test_exact_draws():
    _, _, exact, *_ = smoothing_case("four states")
    found = call("four states", trajectories=4000, seed=seed_of("exact draws"))
    assert found["x"].dims == ("trajectory", "time", "x_dim_0")
    parts = np.split(found["x"].values, 80)
    assert_moments([moments_of(p, exact) for p in parts], exact, "exact draws")


# -- particles
def test_backward_simulation_of_the_verb():
    found = call(ONE, ssm.FFBSi(proposal="bootstrap"), particles=400, trajectories=300, seed=1)
    again = call(ONE, ssm.FFBSi(proposal="bootstrap"), particles=400, trajectories=300, seed=1)
    assert found["x"].identical(again["x"])
    assert found["x"].shape == (300, 40)
    assert found.attrs["kernel"] == "rejection"
    assert found["ess"].dims == ("time",)
    assert np.all(found["ess"] <= 400)
    _, _, exact, *_ = smoothing_case(ONE)
    spread = exact.sd[:, 0] * np.sqrt(1 / 300 + 5 / 400)
    assert np.all(np.abs(found["x"].mean("trajectory") - exact.mean[:, 0]) < 5 * spread)
    genealogy = ssm.FFBSi("genealogy", proposal="bootstrap")
    lines = call(ONE, genealogy, particles=400, trajectories=300, seed=seed_of("genealogy"))
    assert 4 * lines["distinct"].values[0] < found["distinct"].values[0]


def test_pgas_as_a_smoother():
    _, _, exact, *_ = smoothing_case(ONE)
    found = call(ONE, ssm.PGAS(5, "bootstrap"), trajectories=3000, seed=seed_of("pgas smoother"))
    assert found.attrs["particles"] == 5
    assert 0.3 < found.attrs["update_rate"] < 1
    assert_chain_moments(found["x"].values[None, ..., None], exact, "pgas", 1)


@pytest.mark.parametrize("lag", [0, 3])
def test_fixed_lag_targets_the_law_given_so_much_more_data(lag):
    """x_t given y_{1:t+lag}, each from an exact smoother of the shortened data."""
    *_, data, parameters = smoothing_case(ONE)
    steps, y = 12, data["y"][:12]
    target = np.empty((3, steps))
    for t in range(steps):
        d = DenseGaussian(y[: t + lag + 1], **models.lgss_matrices(**parameters))
        full = d.covariance
        target[:, t] = d.mean[t, 0], full[t, t], full[t, t - 1] if t else 0.0
    runs = []
    for k in range(60):
        found = ssm.smooth(
            models.lgss, {"y": y}, parameters, ssm.FixedLag(lag, "bootstrap"), particles=2000,
            seed=seed_of("lag", lag, k), quantiles=(0.5,),
        )  # fmt: skip
        mean, sd = found["x"].values[0], np.sqrt(found["covariance"].values[0, :, 0, 0])
        cross = np.nan_to_num(found["covariance_previous"].values[0, :, 0, 0])
        runs.append([mean, sd**2, cross, found["x_quantile"].values[0, :, 0]])
    runs = np.array(runs)
    error = runs.std(0, ddof=1) / np.sqrt(len(runs))
    wanted = np.concatenate([target, target[:1]])  # the median is the mean
    z = (runs.mean(0) - wanted) / np.where(error > 0, error, np.inf)
    limit = float(stats.t.isf(0.001 / (2 * z.size), len(runs) - 1))
    print(f"lag {lag}: worst {np.max(np.abs(z)):.2f} of {limit:.2f}")
    assert np.max(np.abs(z)) < limit


def test_longest_lag_is_the_whole_genealogy():
    problem, theta, *_ = smoothing_case(ONE)
    stream = random_state(np.random.SeedSequence(seed_of("whole")))
    settings = FilterSettings(50, "bootstrap")
    system = particle_system(problem, theta, settings, problem.experiments[0], stream)
    found = lag_moments(system, 1000, np.array([0.5]))
    paths = genealogy(system, 200_000, stream)
    np.testing.assert_allclose(found.mean, paths.mean(0), atol=0.02)
    assert np.all(np.diff(found.distinct) >= 0)
    for t in (0, 20, 39):
        assert set(np.unique(paths[:, t])) <= set(system.particles[t, 0])
        assert len(np.unique(paths[:, t])) <= found.distinct[t]


def test_nonlinear_model_chooses_particles_and_says_why():
    y = ssm.simulate(models.varves, {"phi": 0.9, "tau": 20.0}, steps=15, seed=1)["y"].values[0]
    y[3] = np.nan
    index = pd.RangeIndex(1990, 2005, name="year")
    data = [pd.DataFrame({"y": y}, index=index), {"y": y[:9]}]
    found = ssm.smooth(models.varves, data, {"phi": 0.9, "tau": 20.0}, particles=200,
                       trajectories=30, seed=1)  # fmt: skip
    assert [f.sizes["time"] for f in found] == [15, 9]
    assert found[0]["time"].values[0] == 1990
    assert found[0].attrs["method"] == "FFBSi"
    assert "y is Gamma" in found[0].attrs["method_chosen"]
    assert np.isfinite(found[0]["x"]).all()


# -- refusals
@pytest.mark.parametrize(("args", "more", "words"), [
    (("ffbsy",), {}, ["method='ffbsy' is unknown", "ffbsi"]),
    ((ssm.PMMH(),), {}, ["not a smoothing method", "ssm.FFBSi(...)"]),
    ((ssm.KalmanSmoother(),), {"particles": 10}, ["KalmanSmoother works without", "ssm.FFBSi()"]),
    (("fixed_lag",), {"trajectories": 5}, ["marginals only", "ssm.FFBSi()"]),
    ((ssm.FixedLag(-1),), {}, ["lag=-1"]),
    ((ssm.FFBSi(moves=-1),), {}, ["moves=-1"]),
    ((ssm.FFBSi(proposal="kalman"),), {}, ["has no particles"]),
    ((ssm.FFBSi(resampling="best"),), {}, ["resampling='best'", "systematic"]),
    ((), {"trajectories": 0}, ["trajectories=0"]),
    ((), {"quantiles": (2,)}, ["quantiles=(2,)"]),
])  # fmt: skip
def test_refusals(args, more, words):
    with pytest.raises(ArgumentError) as caught:
        call(ONE, *args, **more)
    for word in words:
        assert word in str(caught.value)


def test_settings_of_a_class_of_ones_own():
    class Mine(ssm.FFBSi):
        """Settings derived from a method's are that method's."""

    y = np.zeros(5)
    for method in (ssm.FFBSi(), Mine()):
        found = ssm.smooth(models.varves, {"y": y + 1.0}, {"phi": 0.9, "tau": 9.0}, method,
                           particles=20, trajectories=5, seed=1)  # fmt: skip
        assert found.attrs["method"] == type(method).__name__
        assert np.all(np.isfinite(found["x"]))


def test_kalman_on_a_nonlinear_model():
    with pytest.raises(ArgumentError, match=r"(?s)varves_observation.*y is Gamma.*ssm.FFBSi"):
        ssm.smooth(models.varves, {"y": [1.0, 2.0]}, {"phi": 0.9, "tau": 20}, "kalman")


def still(sd):
    """A level that hardly moves, or moves, seen through its cube root."""
    model = ssm.Model("still")
    model.initial(lambda: {"x": ssm.Normal(0, sd=30)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=sd)})
    model.observation(lambda x: {"y": ssm.Normal(np.arctan(x), sd=0.2)})
    return model


@pytest.mark.parametrize("method", [pytest.param("ffbsi", marks=pytest.mark.slow), "fixed_lag"])
def test_a_smoother_that_collapsed_says_so(method):
    """Where x hardly moves, one of the first particles is the ancestor of all."""
    y = np.arctan(0.7) + 0.2 * np.random.default_rng(4).normal(size=60)
    call = {"particles": 400, "seed": 5}
    method = {"fixed_lag": ssm.FixedLag(lag=60), "ffbsi": ssm.FFBSi(proposal="bootstrap")}[method]
    with pytest.warns(
        UserWarning, match=r"particle degeneracy at t=.*: only . distinct particles? among"
    ):
        found = ssm.smooth(still(1e-7), {"y": y}, {}, method, **call)
    assert "Use more particles" in found.attrs["smoothing_warning"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ssm.smooth(still(0.3), {"y": y}, {}, "ffbsi", **call)
    assert "smoothing_warning" not in found.attrs


@pytest.mark.slow
def test_where_the_transition_collapses_the_twisted_proposal_is_taken():
    """The same data: a particle of the first row, fixed by all rows, has a known posterior."""
    y = np.arctan(0.7) + 0.2 * np.random.default_rng(4).normal(size=60)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ssm.smooth(still(1e-7), {"y": y}, {}, "ffbsi", particles=400, seed=5)
    assert found.attrs["proposal"] == "twisted"
    x = np.linspace(-6.0, 6.0, 20_001)  # x stands still but for 1e-7
    log_p = -0.5 * (x / 30.0) ** 2 - 0.5 * np.sum((y[:, None] - np.arctan(x)) ** 2, axis=0) / 0.04
    weight = np.exp(log_p - log_p.max())
    weight /= weight.sum()
    mean = weight @ x
    sd = np.sqrt(weight @ (x - mean) ** 2)
    first = found["x"].to_numpy().reshape(-1, 60)[:, 0]
    assert abs(first.mean() - mean) < 5.0 * sd / np.sqrt(400.0)


@pytest.mark.slow
def test_few_values_are_no_collapse():
    """Of a discrete state, and of a start that is known."""
    model = ssm.Model("counts of a switch")
    model.initial(lambda: {"k": ssm.Bernoulli(0.5), "x": ssm.Dirac(0.0)})
    model.transition(lambda k, x: {"k": ssm.Bernoulli(0.2 + 0.6 * k), "x": ssm.Normal(x, sd=1)})
    model.observation(lambda k, x: {"y": ssm.StudentT(4, x + k, scale=1.0)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ssm.smooth(model, {"y": np.zeros(10)}, {}, "ffbsi", particles=300, seed=1)


def test_a_count_that_the_data_tell_is_no_collapse():
    """Of many counts among the particles, measurements that are nearly exact leave one."""
    model = ssm.Model("counted animals")
    model.initial(lambda: {"n": ssm.Poisson(2000.0)})
    model.transition(lambda n: {"n": ssm.Poisson(n)})
    model.observation(lambda n: {"y": ssm.Normal(n, sd=0.05)})
    counts = np.array([2011.0, 1987.0, 1990.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ssm.smooth(
            model, {"y": counts}, {}, "ffbsi", particles=3000, trajectories=300, seed=1
        )
    assert np.all(found["n"].values == counts)
