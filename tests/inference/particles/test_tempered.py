"""The tempered particle filter (`proposal="tempered"`), against the Kalman filter and smoother."""

import numpy as np
import pytest
from scipy import special

import ssmppl as ssm
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.kernels.particle.tempered_filter import accept
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.run.problem import pose

COVARIANCE = np.array([[1.0, 0.6], [0.6, 1.0]])


def pair():
    """Two correlated states, a delayed copy of one, and readings sharper than their noise."""
    model = ssm.Model("pair")
    model.prior(lambda: {"a": ssm.Uniform(-1, 1)})
    model.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=COVARIANCE),
                           "old": ssm.Dirac(0.5)})  # fmt: skip
    model.transition(lambda x, a: {"x": ssm.MvNormal(a * x, covariance=COVARIANCE),
                                   "old": ssm.Dirac(x[1])})  # fmt: skip
    model.observation(lambda x, old: {"y": ssm.Normal(x[0] + 0.5 * old, sd=0.1),
                                      "z": ssm.Normal(x[0] - x[1], sd=0.2)})  # fmt: skip
    return model


PAIR, AT = pair(), {"a": 0.7}


def pair_data(steps=6, seed=1):
    made = ssm.simulate(PAIR, AT, steps=steps, seed=seed)
    y, z = made["y"].values[0], made["z"].values[0]
    y[2] = z[2] = z[-1] = np.nan
    return {"y": y, "z": z}


def growth():
    """A positive state, whose logarithm is linear and Gaussian, as are the readings' logarithms."""
    model = ssm.Model("growth")
    model.initial(lambda: {"x": ssm.LogNormal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.LogNormal(0.8 * np.log(x), sd=0.7)})
    model.observation(lambda x: {"y": ssm.LogNormal(np.log(x), sd=0.05)})
    return model


def assert_mean_one(log_ratio):
    ratio = np.exp(log_ratio)
    error = ratio.std(ddof=1) / np.sqrt(len(ratio))
    assert error < 0.08
    assert abs(ratio.mean() - 1) < 4 * error


@pytest.mark.slow
def test_unbiased_with_correlated_and_deterministic_states_and_missing_values():
    data = [pair_data(), pair_data(3, 2)]
    (exact,) = ssm.log_likelihood(PAIR, data, AT)
    found = ssm.log_likelihood(
        PAIR, data, AT, particles=60, repeats=1000, proposal="tempered", seed=3
    )
    assert_mean_one(found - exact)
    plain = ssm.log_likelihood(
        PAIR, data, AT, particles=60, repeats=200, proposal="bootstrap", seed=3
    )
    assert np.var(found) < 0.1 * np.var(plain)


def test_unbiased_with_a_positive_state():
    model, log_model = growth(), ssm.Model("log growth")
    log_model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    log_model.transition(lambda x: {"x": ssm.Normal(0.8 * x, sd=0.7)})
    log_model.observation(lambda x: {"y": ssm.Normal(x, sd=0.05)})
    y = ssm.simulate(model, {}, steps=8, seed=1)["y"].values[0]
    (exact,) = ssm.log_likelihood(log_model, {"y": np.log(y)}, {})
    found = ssm.log_likelihood(
        model, {"y": y}, {}, particles=60, repeats=1000, proposal="tempered", seed=4
    )
    assert_mean_one(found - exact + np.sum(np.log(y)))


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["genealogy", "exact"])
def test_genealogies_and_backward_draws_against_the_kalman_smoother(kernel):
    data, runs = pair_data(), 20
    exact = ssm.smooth(PAIR, data, AT)
    method = ssm.FFBSi(proposal="tempered", kernel=kernel)
    found = [
        ssm.smooth(PAIR, data, AT, method, particles=400, trajectories=200, seed=s)
        for s in range(runs)
    ]
    for name in ("x", "old"):
        sd, mean = exact[f"{name}_sd"].values[0], exact[name].values[0]
        off = np.stack([f[name].values for f in found]) - mean  # (runs, trajectory, time, ...)
        for moment, wanted in ((off.mean(axis=1), 0.0), ((off**2).mean(axis=1), sd**2)):
            error = moment.std(axis=0, ddof=1) / np.sqrt(runs)
            assert np.all(error <= 0.15 * np.maximum(sd, sd**2))
            # means of ratios: a bias of order 1 / N is left
            assert np.all(np.abs(moment.mean(axis=0) - wanted) < 4.5 * error + 0.01 * sd + 1e-9)


@pytest.mark.slow
def test_filter_means_against_the_kalman_filter():
    data = pair_data()
    exact = ssm.kalman_filter(PAIR, data, AT)
    found = ssm.particle_filter(
        PAIR, data, AT, particles=1000, repeats=100, proposal="tempered", seed=6
    )  # fmt: skip
    for name in ("x", "old", "x_sd", "y_predicted", "z_predicted", "z_predicted_sd"):
        draws = found[name].values
        error = draws.std(axis=0, ddof=1) / 10.0
        # means of ratios: a bias of order 1 / N is left
        assert np.all(np.abs(draws.mean(axis=0) - exact[name].values[0]) < 4.5 * error + 2e-3)


@pytest.mark.slow
def test_posterior_of_pmmh_against_quadrature():
    data = pair_data(15)
    grid = np.linspace(-0.995, 0.995, 400)
    log_p = np.array([ssm.log_likelihood(PAIR, data, {"a": a})[0] for a in grid])
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    mean = np.sum(grid * p)
    sd = np.sqrt(np.sum((grid - mean) ** 2 * p))
    idata = ssm.sample(
        PAIR, data, ssm.PMMH(particles=100, proposal="tempered"), draws=1500, warmup=500, chains=2,
        seed=1, progress=False,
    )  # fmt: skip
    row = ssm.summary(idata).loc["a"]
    assert row["ess_bulk"] > 200
    assert abs(row["mean"] - mean) < 4 * sd / np.sqrt(row["ess_bulk"])
    assert abs(row["sd"] / sd - 1) < 4 / np.sqrt(2 * row["ess_bulk"])


def counts():
    model = ssm.Model("counts")
    model.initial(lambda: {"n": ssm.Poisson(5.0)})
    model.transition(lambda n: {"n": ssm.Poisson(1.0 + n)})
    model.observation(lambda n: {"y": ssm.Normal(n, sd=0.1)})
    return model


def position():
    model = ssm.Model("position")
    model.initial(lambda: {"v": ssm.Normal(0, sd=1), "p": ssm.Dirac(0.0)})
    model.transition(lambda v, p: {"v": ssm.Normal(v, sd=1), "p": ssm.Dirac(p + v)})
    model.observation(lambda p: {"y": ssm.Normal(p, sd=0.1)})
    return model


@pytest.mark.parametrize(
    ("model", "reason"),
    [(counts, "no state has a continuous transition"), (position, "depends on no state")],
)
def test_models_that_it_does_not_apply_to(model, reason):
    with pytest.raises(ssm.ArgumentError, match=reason):
        ssm.log_likelihood(model(), {"y": np.zeros(3)}, {}, proposal="tempered")


def test_calls_that_it_does_not_apply_to():
    for settings in ({"rescue": 10}, {"resampling": "residual"}, {"ess_threshold": 0.5}):
        with pytest.raises(ssm.ArgumentError, match="systematically at every temperature"):
            ssm.log_likelihood(PAIR, pair_data(), AT, proposal="tempered", **settings)
    with pytest.raises(ssm.ArgumentError, match="conditional_smc"):
        ssm.smooth(PAIR, pair_data(), AT, ssm.PGAS(proposal="tempered"), seed=1)
    with pytest.raises(ssm.ArgumentError, match="without temperatures"):
        ssm.sample(
            PAIR, pair_data(), ssm.PMMH(particles=20, proposal="tempered", correlation=0.9),
            progress=False, seed=1,
        )  # fmt: skip


def test_it_is_explained_and_chosen_where_nothing_better_is_derived():
    def opaque(x):  # x, by way of functions without a derivative in their first argument
        s = 1.0 + x * x
        return x * (special.gammainc(s, 1.0) + special.gammaincc(s, 1.0))

    model = ssm.Model("opaque")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(opaque(x), sd=0.01)})
    assert "increasing powers" in str(ssm.explain(model))
    problem = pose(model, {"y": np.array([0.3, -1.2, 2.0, 4.0, 3.0])})
    assert choose_by_pilot(problem, np.empty(0), whole=True, temper=True).name == "tempered"
    assert choose_by_pilot(problem, np.empty(0), whole=True).name == "bootstrap"
    assert "increasing powers" not in str(ssm.explain(PAIR))


def test_no_particle_moves_to_where_the_density_is_infinite():
    rng = new_state(np.random.SeedSequence(1))
    x, log_f, log_g = np.zeros((1, 4)), np.zeros(4), np.zeros(4)
    x_new = np.arange(4.0)[None]
    log_f_new, log_g_new = np.array([0.0, np.inf, 0.0, np.nan]), np.array([np.inf, 0.0, 9.0, 0.0])
    assert accept(rng, 0.5, x, log_f, log_g, x_new, log_f_new, log_g_new) == 0.25
    np.testing.assert_array_equal(x, [[0.0, 0.0, 2.0, 0.0]])
    np.testing.assert_array_equal(log_g, [0.0, 0.0, 9.0, 0.0])
