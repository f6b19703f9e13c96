"""Every algorithm on a model with an opaque step gives what it gives on the step written out."""

import math

import numpy as np
import pytest

import ssmppl as ssm


@ssm.primitive
def step(q, v, u, k, d):
    h = 0.05
    a = u - k * math.sin(q) - d * v
    return q + h * v + 0.5 * h * h * a, v + h * a


def written(q, v, u, k, d):
    h = 0.05
    a = u - k * np.sin(q) - d * v
    return q + h * v + 0.5 * h * h * a, v + h * a


def pendulum(law):
    model = ssm.Model("pendulum", inputs=("u",))
    model.prior(lambda: {"k": ssm.HalfNormal(sd=20), "d": ssm.HalfNormal(sd=2)})
    model.initial(lambda: {"q": ssm.Normal(0, sd=0.2), "v": ssm.Normal(0, sd=0.2)})

    @model.transition
    def transition(q, v, u, k, d):
        angle, rate = law(q, v, u, k, d)
        return {"q": ssm.Normal(angle, sd=0.02), "v": ssm.Normal(rate, sd=0.05)}

    model.observation(lambda q: {"y": ssm.Normal(q, sd=0.05)})
    return model


OPAQUE, PLAIN = pendulum(step), pendulum(written)
THETA = {"k": 9.0, "d": 0.4}


@pytest.fixture(scope="module")
def data():
    u = 4.0 * np.sin(np.arange(40) / 3.0)
    drawn = ssm.simulate(PLAIN, THETA, steps=40, inputs={"u": u}, seed=3)
    return {"y": drawn["y"].values.ravel(), "u": u}


@pytest.mark.parametrize(
    ("proposal", "error"),
    [("bootstrap", 1e-10), ("guided", 1e-10), ("auxiliary", 1e-10), ("unscented", 1e-10),
     ("extended", 1e-6), ("laplace", 1e-6), ("twisted", 1e-6)],
)  # fmt: skip
def test_likelihoods_are_those_of_the_model_written_out(data, proposal, error):
    """Within rounding where derivatives are not used, within that of differences where they are."""
    found, exact = (
        ssm.log_likelihood(m, data, THETA, particles=30, proposal=proposal, repeats=2, seed=1)
        for m in (OPAQUE, PLAIN)
    )
    np.testing.assert_allclose(found, exact, atol=error, rtol=0)


@pytest.mark.slow
def test_scores_and_maxima_are_those_of_the_model_written_out(data):
    scores = [ssm.score(m, data, THETA, seed=1).gradient for m in (OPAQUE, PLAIN)]
    assert scores[0] == pytest.approx(scores[1], rel=1e-6)
    found, exact = (ssm.maximize(m, data, seed=1, progress=False) for m in (OPAQUE, PLAIN))
    assert found.parameters == pytest.approx(exact.parameters, rel=1e-5)
    assert found.standard_errors == pytest.approx(exact.standard_errors, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "draws"),
    [
        (ssm.ISMCMC(particles=30), 500),
        (ssm.PGAS(particles=20), 500),
        (ssm.PMMH(particles=30), 5000),
    ],
)
def test_posteriors_are_those_of_the_model_written_out(data, method, draws):
    """Means within five standard errors of the difference of two chains with an ESS of 50 each."""
    found, exact = (
        ssm.sample(m, data, method, draws=draws, warmup=draws, chains=2, seed=s, progress=False)
        for m, s in ((OPAQUE, 1), (PLAIN, 2))
    )
    for name in THETA:
        a, b = (np.ravel(i.posterior[name].values) for i in (found, exact))
        assert abs(a.mean() - b.mean()) < 5.0 * math.sqrt((a.var() + b.var()) / 50.0)


def test_explain_says_where_derivatives_come_from():
    rows = dict(ssm.explain(OPAQUE).sections())["Derivatives of primitives"]
    assert rows[0][0] == "step"
    assert "central differences of the compiled function" in rows[0][1]
    assert "Derivatives of primitives" not in dict(ssm.explain(PLAIN).sections())
