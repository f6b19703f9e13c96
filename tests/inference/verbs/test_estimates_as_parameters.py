"""What `maximize` returns stands for parameters in every verb; values of components by label."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.datasets import nile
from ssmppl.errors import ArgumentError

model = ssm.Model("walk", dims={"b": ["season"]}, coords={"season": ["wet", "dry"]})
model.prior(lambda: {"q": ssm.HalfNormal(sd=1), "b": ssm.Normal(np.zeros(2), sd=3)})
model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
model.transition(lambda x, q, b: {"x": ssm.Normal(x + b[0], sd=q)})
model.observation(lambda x, b: {"y": ssm.Normal(x + b[1], sd=0.3)})
DATA = {"y": [0.1, 0.5, 0.4, 1.2, 1.0, 1.9]}


@pytest.fixture(scope="module")
def estimate():
    return ssm.maximize(model, DATA, seed=1, progress=False)


def test_verbs_take_an_estimate(estimate):
    own = estimate.parameters
    assert ssm.log_likelihood(model, DATA, estimate)[0] == ssm.log_likelihood(model, DATA, own)[0]
    for verb in (ssm.kalman_filter, ssm.smooth):
        np.testing.assert_array_equal(verb(model, DATA, estimate)["x"], verb(model, DATA, own)["x"])
    drawn = (ssm.simulate(model, p, steps=4, seed=1)["y"] for p in (estimate, own))
    np.testing.assert_array_equal(*drawn)
    assert ssm.score(model, DATA, estimate).gradient["q"] == pytest.approx(0.0, abs=1e-3)


def test_predict_says_what_draws_at_an_estimate(estimate):
    with pytest.raises(ArgumentError, match=r"ssm\.simulate\(model, estimate"):
        ssm.predict(model, estimate, DATA)


def test_values_by_label():
    plain = ssm.log_likelihood(model, DATA, {"q": 0.5, "b": [0.2, 0.1]})[0]
    named = {"q": 0.5, "b": {"dry": 0.1, "wet": 0.2}}
    assert ssm.log_likelihood(model, DATA, named)[0] == plain


@pytest.mark.parametrize(
    ("given", "fix"),
    [
        ({"wet": 0.2}, "give a value for each of dry, wet"),
        ({"wet": 0.2, "dri": 0.1}, "give a value for each of dry, wet"),
    ],
)
def test_labels_are_all_there(given, fix):
    with pytest.raises(ArgumentError, match=fix):
        ssm.log_likelihood(model, DATA, {"q": 0.5, "b": given})


def test_a_number_has_no_labels():
    with pytest.raises(ArgumentError, match="give one number"):
        ssm.log_likelihood(model, DATA, {"q": {"wet": 0.5}, "b": [0.2, 0.1]})


def test_criteria_are_those_of_statsmodels_but_for_the_flat_starts_constant():
    """Which has d / 2 log(2 pi) less log-likelihood for d flat starts."""
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    y = np.asarray(nile(), dtype=float)
    y[[10, 11, 40]] = np.nan
    model = ssm.Model("level")
    ssm.structural.observe(model, "y", ssm.structural.level(model))
    found = ssm.maximize(model, {"y": y}, seed=1)
    other = UnobservedComponents(y, "llevel", use_exact_diffuse=True).fit(disp=False)
    assert found.free_numbers == other.df_model
    assert found.aic == pytest.approx(other.aic - np.log(2 * np.pi), abs=1e-3)
    # statsmodels counts rows without data among those that the criterion is of
    penalty = found.free_numbers * (np.log(len(y)) - np.log(len(y) - 3))
    assert found.bic == pytest.approx(other.bic - penalty - np.log(2 * np.pi), abs=1e-3)
    held = ssm.maximize(model, {"y": y}, fixed={"y_sd": 120.0}, seed=1)
    assert held.free_numbers == 2
    mode = ssm.maximize(model, {"y": y}, objective="posterior", seed=1)
    assert np.isnan(mode.aic)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("params", "estimate.parameters"), ("get_forecast", "ssm.forecast(model, estimate"),
        ("append", "the verb with the longer data"), ("nonsense", "has no attribute 'nonsense'"),
    ],
)  # fmt: skip
def test_what_others_call_it_is_answered(name, said):
    model = ssm.Model("level")
    ssm.structural.observe(model, "y", ssm.structural.level(model))
    found = ssm.maximize(model, {"y": [1.0, 2.0, 0.5, 1.7]}, fixed={"level_sd": 0.5}, seed=1)
    with pytest.raises(AttributeError) as error:
        getattr(found, name)
    assert said in str(error.value)
    assert pickle.loads(pickle.dumps(found)).parameters == found.parameters
