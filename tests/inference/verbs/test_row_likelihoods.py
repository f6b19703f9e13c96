"""The log-likelihood of each row beside the draws, and what ArviZ makes of it."""

import arviz as az
import numpy as np
import pytest

import ssmppl as ssm

ROWS = 30
SHORT = {"draws": 20, "warmup": 20, "chains": 2, "progress": False, "seed": 3}


def level():
    """Linear and Gaussian."""
    model = ssm.Model("level")

    @model.prior
    def prior():
        return {"q": ssm.InverseGamma(3, scale=1), "r": ssm.InverseGamma(3, scale=1)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, q):
        return {"x": ssm.Normal(x, variance=q)}

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, variance=r)}

    return model


def switching():
    """Of two states."""
    model = ssm.Model("switching")

    @model.prior
    def prior():
        return {"p": ssm.Beta(8, 2), "m": ssm.Normal(0, sd=2)}

    @model.initial
    def initial():
        return {"s": ssm.Bernoulli(0.5)}

    @model.transition
    def transition(s, p):
        return {"s": ssm.Bernoulli(p * s + (1 - p) * (1 - s))}

    @model.observation
    def observation(s, m):
        return {"y": ssm.Normal(m * s, sd=1)}

    return model


def decay():
    """Without noise in its state."""
    model = ssm.Model("decay")

    @model.prior
    def prior():
        return {"a": ssm.Beta(8, 2), "r": ssm.InverseGamma(3, scale=1)}

    @model.initial
    def initial():
        return {"x": ssm.Dirac(3.0)}

    @model.transition
    def transition(x, a):
        return {"x": ssm.Dirac(a * x)}

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, variance=r)}

    return model


@ssm.simulator(state=["x"], parameters=["a"])
def damped(state, inputs, parameters):
    return parameters * np.sin(state)


def simulated_model():
    """By a simulator, with the extended Kalman filter's likelihood."""
    model = ssm.Model("damped")

    @model.prior
    def prior():
        return {"a": ssm.Beta(8, 2), "q": ssm.InverseGamma(3, scale=1)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, a, q):
        return {"x": ssm.Normal(damped(x=x, a=a).x, variance=q)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    return model


def data(seed):
    y = np.cumsum(np.random.default_rng(seed).normal(size=ROWS))
    y[5] = np.nan
    return {"y": y}


CASES = {
    "Gibbs": (level, ssm.Gibbs, "auto"),
    "walk": (level, ssm.MetropolisHastings, "auto"),
    "Gibbs of two states": (switching, ssm.Gibbs, "auto"),
    "walk of two states": (switching, ssm.MetropolisHastings, "auto"),
    "without noise": (decay, ssm.MetropolisHastings, "auto"),
    "simulator": (simulated_model, ssm.MetropolisHastings, "extended"),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.filterwarnings("ignore")
def test_rows_sum_up_to_the_exact_likelihood_of_the_draw(case):
    build, method, proposal = CASES[case]
    model, records = build(), [data(1), data(2)]
    plain = ssm.sample(model, records, method(), **SHORT)
    asked = ssm.sample(model, records, method(log_likelihood=True), **SHORT)
    for name, drawn in plain["posterior"].data_vars.items():
        np.testing.assert_array_equal(drawn, asked["posterior"][name])
    assert "log_likelihood" not in plain
    rows = asked["log_likelihood"]
    assert rows["one_step"].dims == ("chain", "draw", "row")
    assert rows["experiment"].values.tolist() == [1] * (ROWS - 1) + [2] * (ROWS - 1)
    times = [t for t in range(1, ROWS + 1) if t != 6]  # nothing was measured then
    assert rows["time"].values.tolist() == 2 * times
    for draw in (0, 19):
        theta = {n: float(asked["posterior"][n][1, draw]) for n in model_parameters(model)}
        for i, record in enumerate(records):
            own = rows["one_step"].values[1, draw, rows["experiment"].values == i + 1]
            exact = ssm.log_likelihood(model, record, theta, proposal=proposal)
            np.testing.assert_allclose(float(own.sum()), float(np.ravel(exact)[0]), rtol=1e-6)


def model_parameters(model):
    return [n for f in model.functions["prior"] for n in f()]


ALL = {
    "Gibbs": (level, ssm.Gibbs()),
    "MetropolisHastings": (level, ssm.MetropolisHastings()),
    "PMMH": (level, ssm.PMMH(particles=20)),
    "PGAS": (level, ssm.PGAS(particles=10)),
    "ISMCMC": (level, ssm.ISMCMC(particles=10)),
}


@pytest.mark.parametrize("name", ALL)
@pytest.mark.filterwarnings("ignore")
def test_no_total_passes_for_the_likelihood_of_rows(name):
    """ArviZ 0.x takes a variable `log_likelihood` of `sample_stats` for that of the rows."""
    build, method = ALL[name]
    found = ssm.sample(build(), data(1), method, **SHORT)
    assert "log_likelihood" not in found["sample_stats"]
    if "log_likelihood" in found:
        assert az.loo(found).n_data_points == ROWS - 1  # nothing was measured in one
    else:
        with pytest.raises((TypeError, ValueError, KeyError, AttributeError)):
            az.loo(found)
