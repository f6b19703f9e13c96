"""Parameters of which each experiment has its own, `@model.prior(per="experiment")`."""

from __future__ import annotations

import pickle

import arviz as az
import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.errors import ArgumentError, DataError, ModelError

SHARED = {"mu": 0.5, "q": 0.3}
OWN = {"oak": -20.0, "elm": 3.0, "ash": 30.0}
THETA = {**SHARED, "b": np.array(list(OWN.values())), "c": np.arange(6.0).reshape(3, 2)}


def declared(**options) -> ssm.Model:
    """In every role a parameter of each experiment: b a number, c a vector."""
    model = ssm.Model("growth", inputs=("w",), **options)

    @model.prior
    def shared():
        return {"mu": ssm.Normal(0, sd=1), "q": ssm.InverseGamma(3, scale=1)}

    @model.prior(per="experiment")
    def own(mu):
        return {"b": ssm.Normal(mu, sd=10), "c": ssm.Normal(np.zeros(2), sd=[1.0, 2.0])}

    @model.initial
    def initial(b):
        return {"x": ssm.Normal(b, sd=2)}

    @model.transition
    def transition(x, b, c, w, q):
        return {"x": ssm.Normal(0.8 * x + b + c[0] * w, variance=q)}

    @model.observation
    def observation(x, c, w):
        return {"y": ssm.Normal(x + c[1] * w, sd=0.5)}

    return model


MODEL, TREES = declared(), declared(experiment="tree")


def alone(k: int) -> dict:
    return {**SHARED, "b": THETA["b"][k], "c": THETA["c"][k]}


def measured(k: int, rows: int) -> dict:
    w = np.random.default_rng(k).normal(size=rows)
    simulated = ssm.simulate(MODEL, alone(k), inputs={"w": w}, seed=k)
    return {"w": w, "y": simulated["y"].values[0]}


SETS = {k: measured(i, rows) for i, (k, rows) in enumerate(zip(OWN, (7, 5, 6), strict=True))}
LONG = pd.concat([pd.DataFrame({"tree": k, **v}) for k, v in SETS.items()], ignore_index=True)
FORMS = {
    "a dictionary": (MODEL, SETS),
    "a long table": (TREES, LONG),
    "a list": (MODEL, list(SETS.values())),
}


@pytest.mark.parametrize("form", list(FORMS))
def test_each_experiment_has_its_own_values(form):
    model, data = FORMS[form]
    each = [float(ssm.log_likelihood(MODEL, d, alone(k))[0]) for k, d in enumerate(SETS.values())]
    assert len(set(np.round(each, 3))) == 3
    assert float(ssm.log_likelihood(model, data, THETA)[0]) == pytest.approx(sum(each), rel=1e-12)
    score = ssm.score(model, data, THETA).gradient
    for k, d in enumerate(SETS.values()):
        own = ssm.score(MODEL, d, alone(k)).gradient
        np.testing.assert_allclose(score["b"][k], own["b"], rtol=1e-8)
        np.testing.assert_allclose(score["c"][k], own["c"], rtol=1e-8)


def test_particles_have_them_too():
    found = ssm.log_likelihood(
        MODEL, SETS, THETA, proposal="guided", particles=2000, repeats=8, seed=1
    )
    exact = float(ssm.log_likelihood(MODEL, SETS, THETA)[0])
    ratio = np.exp(found - exact)
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std(ddof=1) / np.sqrt(len(ratio))


def pooled() -> tuple[ssm.Model, dict]:
    """y_t ~ N(b, 2), b ~ N(mu, 1), mu ~ N(0, 2^2): Gaussian, once x is integrated out."""
    model = ssm.Model("pooled")
    model.prior(lambda: {"mu": ssm.Normal(0, sd=2)})
    model.prior(per="experiment")(lambda mu: {"b": ssm.Normal(mu, sd=1)})
    model.initial(lambda b: {"x": ssm.Normal(b, sd=1)})
    model.transition(lambda b: {"x": ssm.Normal(b, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    data = {"i": {"y": [1.2, 0.4, 2.0]}, "j": {"y": [-2.0, -1.1]}, "k": {"y": [4.0]}}
    return model, data


def exact_pooled(data: dict) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean and covariance of (mu, b_i, b_j, b_k), by its precision matrix."""
    n = len(data)
    precision, shift = np.diag([0.25 + n, *[1.0] * n]), np.zeros(n + 1)
    precision[0, 1:] = precision[1:, 0] = -1.0
    for k, d in enumerate(data.values(), start=1):
        precision[k, k] += len(d["y"]) / 2.0
        shift[k] = np.sum(d["y"]) / 2.0
    covariance = np.linalg.inv(precision)
    return covariance @ shift, covariance


METHODS = {
    "default": None,
    "Gibbs": ssm.Gibbs(),
    "MetropolisHastings": ssm.MetropolisHastings(),
    "PGAS": ssm.PGAS(particles=15),
    "PMMH": ssm.PMMH(particles=30),
}


def mcse(draws: np.ndarray, method: str) -> float:
    """Of draws (chain, draw)."""
    n = float(az.ess(az.convert_to_dataset({"x": draws}), method=method)["x"])
    return float(draws.std() / np.sqrt(n if method == "mean" else 2.0 * n))  # of a Gaussian


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n != "Gibbs" else ()) for n in METHODS]
)
def test_the_posterior_of_a_panel_is_the_exact_one(name):
    model, data = pooled()
    idata = ssm.sample(
        model, data, METHODS[name], draws=2000, warmup=500, seed=3, states=False, progress=False
    )
    posterior = idata["posterior"]
    draws = np.concatenate([posterior["mu"].values[..., None], posterior["b"].values], axis=-1)
    mean, covariance = exact_pooled(data)
    for k in range(4):
        one = draws[..., k]
        sd = np.sqrt(covariance[k, k])
        assert abs(one.mean() - mean[k]) < 4.5 * mcse(one, "mean")
        assert abs(one.std() - sd) < 4.5 * mcse(one, "sd")


def test_results_name_the_experiments():
    idata = ssm.sample(TREES, LONG, draws=20, warmup=20, chains=2, seed=1, progress=False)
    posterior = idata["posterior"]
    assert posterior["b"].dims == ("chain", "draw", "experiment")
    assert posterior["c"].dims == ("chain", "draw", "experiment", "c_dim_1")
    assert posterior["experiment"].values.tolist() == list(OWN)
    assert "b[elm]" in az.summary(idata, var_names=["b"]).index
    assert list(idata["constant_data"].data_vars) == ["w"]
    assert ssm.plot_prior_posterior(idata, TREES, var_names=["b"]).size == 3
    text = str(ssm.explain(TREES, LONG))
    assert "of each of the 3 experiments" in text
    assert "0.8*x_prev + b + c[0]*w_prev" in text
    assert "of each experiment" in str(ssm.explain(TREES))


def test_forecasts_and_predictions_are_of_the_own_values():
    idata = ssm.sample(TREES, LONG, draws=50, warmup=50, chains=2, seed=1, progress=False)
    later = {"w": np.zeros(40)}
    ahead = ssm.forecast(TREES, idata, inputs=later, seed=1)
    level = ahead["b"].mean("draw") / 0.2  # where x settles
    at_end = ahead["x"].isel(time=-1).mean("draw")
    np.testing.assert_allclose(at_end, level, atol=1.0)
    one = ssm.forecast(TREES, idata, inputs=later, experiment="ash", seed=1)
    np.testing.assert_allclose(one["x"].isel(time=-1).mean(), level.sel(experiment="ash"), atol=1.0)
    assert ssm.plot_forecast(one, idata) is not None
    shuffled = {k: SETS[k] for k in ("ash", "oak", "elm")}
    predicted = ssm.predict(MODEL, idata, shuffled, conditional=False, seed=1)
    means = predicted["posterior_predictive"]["y"].mean(("chain", "draw")).isel(time=4)
    for k, b in OWN.items():
        assert np.sign(float(means.sel(experiment=k))) == np.sign(b)
    known = ssm.forecast(MODEL, THETA, data=SETS, inputs=later, draws=50, seed=1)
    np.testing.assert_allclose(
        known["x"].isel(time=-1).mean("draw"), np.array(list(OWN.values())) / 0.2, atol=1.0
    )


def test_what_only_priors_hold_is_not_estimated_by_the_likelihood():
    found = ssm.maximize(TREES, LONG, seed=1, progress=False)
    assert found.attrs["only_in_priors"] == ["mu"]
    assert "mu" not in found.standard_errors
    assert "mu: held where the search began, as only priors depend on it" in str(found)
    assert np.isfinite(found.standard_errors["b"]).all()
    whole = ssm.maximize(TREES, LONG, objective="posterior", seed=1, progress=False)
    assert "only_in_priors" not in whole.attrs
    assert np.isfinite(whole.standard_errors["mu"])


def test_random_effects_as_states_have_the_likelihood_of_a_mixed_model():
    """Balanced one-way random effects: the maximum in closed form (Searle et al. 1992, section
    3.7)."""
    model = ssm.Model("mixed")
    model.prior(lambda: {"m": ssm.Flat(), "between": ssm.HalfFlat(), "noise": ssm.HalfFlat()})
    model.initial(lambda m, between: {"effect": ssm.Normal(m, variance=between)})
    model.transition(lambda effect: {"effect": ssm.Dirac(effect)})
    model.observation(lambda effect, noise: {"y": ssm.Normal(effect, variance=noise)})
    rng, n = np.random.default_rng(3), 8
    y = rng.normal(20, 4, size=(5, 1)) + rng.normal(0, 1.5, size=(5, n))
    found = ssm.maximize(model, [{"y": own} for own in y], seed=1, progress=False)
    noise = y.var(axis=1, ddof=1).mean()
    between = y.mean(axis=1).var() - noise / n
    assert found.parameters == pytest.approx({"m": y.mean(), "between": between, "noise": noise})


def test_own_dims_stay_beside_the_experiments():
    model = declared(dims={"c": ["of"]}, coords={"of": ["input", "sensor"]})
    found = ssm.maximize(model, SETS, fixed={"b": THETA["b"], "q": 1.0}, seed=1, progress=False)
    assert [*found.covariance.index[:2]] == ["c[oak, input]", "c[oak, sensor]"]


def test_a_prior_declared_again_for_each_experiment_counts():
    model = ssm.Model("again")
    model.initial(lambda b: {"x": ssm.Normal(b, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})

    def prior():
        return {"b": ssm.Flat()}

    model.prior(prior)
    data = [{"y": [1.0, 2.0]}, {"y": [5.0]}]
    assert np.shape(ssm.maximize(model, data, seed=1, progress=False).parameters["b"]) == ()
    model.functions["prior"].clear()
    model.prior(per="experiment")(prior)
    own = ssm.maximize(model, data, seed=1, progress=False).parameters["b"]
    alone = [ssm.maximize(model, d, seed=1, progress=False).parameters["b"] for d in data]
    np.testing.assert_allclose(own, alone, rtol=1e-6)


def test_other_columns_may_have_other_lengths():
    more = {k: {**v, "remarks": np.arange(50)} for k, v in SETS.items()}
    assert ssm.log_likelihood(MODEL, more, THETA)[0] == ssm.log_likelihood(MODEL, SETS, THETA)[0]


def test_held_values_of_each_experiment_go_into_forecasts():
    held = {n: THETA[n] for n in ("b", "c")}
    idata = ssm.sample(
        TREES, LONG, fixed=held, draws=20, warmup=20, chains=2, seed=1, progress=False
    )
    ahead = ssm.forecast(TREES, idata, inputs={"w": np.zeros(40)}, seed=1)
    np.testing.assert_allclose(
        ahead["x"].isel(time=-1).mean("draw"), np.array(list(OWN.values())) / 0.2, atol=1.0
    )


def test_values_of_all_experiments_are_not_those_of_one():
    with pytest.raises(ArgumentError, match="those of the experiments in the data"):
        ssm.log_likelihood(MODEL, {"elm": SETS["elm"]}, THETA)


def test_a_pickled_model_has_them():
    other = pickle.loads(pickle.dumps(MODEL))
    assert ssm.log_likelihood(other, SETS, THETA)[0] == ssm.log_likelihood(MODEL, SETS, THETA)[0]


def test_a_single_data_set_has_plain_parameters():
    simulated = ssm.simulate(MODEL, alone(0), inputs={"w": np.zeros(4)}, seed=1)
    assert simulated["y"].dims == ("draw", "time")
    found = ssm.maximize(
        MODEL, SETS["oak"], fixed={"c": [0.0, 0.0], "q": 1.0}, seed=1, progress=False
    )
    assert isinstance(found.parameters["b"], float)


def test_future_rows_are_left_out_of_every_experiment():
    late = {k: {**v, "time": np.arange(len(v["y"])) + (4 if k == "elm" else 0)}
            for k, v in SETS.items()}  # fmt: skip
    found = ssm.leave_future_out(
        MODEL, late, first=4, seed=1, draws=50, warmup=50, chains=2, progress=False
    )
    scored = np.isfinite(found["elpd"]).sum("time")
    assert scored.sel(experiment=list(SETS)).values.tolist() == [4, 5, 3]


def test_updates_are_checked_at_the_values_of_experiments():
    """1 / K is no number where none of the experiments is meant."""
    model = ssm.Model("gompertz")
    model.prior(lambda: {"r": ssm.Normal(0.5, sd=0.5), "q": ssm.InverseGamma(3, scale=0.1)})
    model.prior(per="experiment")(lambda: {"K": ssm.LogNormal(4, sd=0.5)})
    model.initial(lambda K: {"n": ssm.LogNormal(np.log(K), sd=0.5)})
    model.transition(
        lambda n, r, K, q: {"n": ssm.LogNormal(np.log(n) + r * (1 - n / K), sd=np.sqrt(q))}
    )
    model.observation(lambda n: {"y": ssm.LogNormal(np.log(n), sd=0.1)})
    text = str(ssm.explain(model, [{"y": [30.0, 40.0, 44.0]}, {"y": [100.0, 120.0]}]))
    assert "could not be checked" not in text
    assert "r ~ Normal(" in text
    assert "q ~ inverse Gamma(" in text


def joint(model):
    model.prior(per="experiment")(lambda: {"b": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))})
    return {"y": [1.0]}


def reads_own(model):
    model.prior(per="experiment")(lambda: {"b": ssm.Normal(0, sd=1)})
    model.prior(lambda b: {"d": ssm.Normal(b, sd=1)})
    return {"y": [1.0]}


def wrong_word(model):
    model.prior(per="unit")
    return {"y": [1.0]}


@pytest.mark.parametrize(
    ("change", "found", "fix"),
    [
        (joint, "'b' is of each experiment, and its prior MvNormal is a joint", "cholesky @ z"),
        (reads_own, "names 'b', of which each experiment has its own", "all experiments share"),
        (wrong_word, "per='unit'", 'per="experiment"'),
    ],
)
def test_what_cannot_be_is_refused(change, found, fix):
    model = ssm.Model("refused")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.raises(ModelError) as error:
        ssm.explain(model, change(model))
    assert found in str(error.value)
    assert fix in str(error.value)
    assert "test_per_experiment.py" in str(error.value)


def test_another_experiment_than_the_sampled_ones_is_refused():
    idata = ssm.sample(TREES, LONG, draws=5, warmup=5, chains=1, seed=1, progress=False)
    with pytest.raises(DataError, match="'b' has no value for the experiment 'fir'"):
        ssm.predict(MODEL, idata, {"fir": SETS["oak"]}, seed=1)
