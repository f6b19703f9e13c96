"""What `maximize` returns stands for parameters in every verb; values of components by label."""

from __future__ import annotations

import numpy as np
import pytest

import ssmppl as ssm
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
