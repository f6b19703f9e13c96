"""A standard deviation below zero: no law, though its square is a variance. The likelihood is 0."""

import numpy as np
import pytest

import ssmppl as ssm
from tests.statistics.checks import assert_within, deviations

DATA = {"y": np.sin(np.arange(10.0))}
ROLES = ("initial", "transition", "observation")


def level(role, prior):
    """A local level in which q is the standard deviation of one law."""
    sd = dict.fromkeys(ROLES, 0.5)
    model = ssm.Model(f"q in {role}")
    model.prior(lambda: {"q": prior})
    model.initial(lambda q: {"x": ssm.Normal(0, sd=({**sd, role: q})["initial"])})
    model.transition(lambda x, q: {"x": ssm.Normal(0.5 * x, sd=({**sd, role: q})["transition"])})
    model.observation(lambda x, q: {"y": ssm.Normal(x, sd=({**sd, role: q})["observation"])})
    return model


@pytest.mark.parametrize("proposal", ["kalman", "bootstrap", "guided", "auxiliary", "twisted"])
@pytest.mark.parametrize("role", ROLES)
def test_the_likelihood_is_zero(role, proposal):
    model = level(role, ssm.HalfNormal(sd=1))
    for q, finite in ((0.3, True), (-0.3, False)):
        (found,) = ssm.log_likelihood(
            model, DATA, {"q": q}, proposal=proposal, particles=200, seed=1
        )
        assert np.isfinite(found) == finite
        assert finite or found == -np.inf


@pytest.mark.parametrize("proposal", ["marginal", "marginal_guided", "marginal_auxiliary"])
def test_so_it_is_with_states_integrated_out(proposal):
    model = ssm.Model("driven")
    model.prior(lambda: {"q": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(0, sd=1)})
    model.transition(lambda x, z, q: {
        "x": ssm.Normal(0.9 * x + np.sin(z), sd=q), "z": ssm.Normal(np.sin(z), sd=1)
    })  # fmt: skip
    model.observation(lambda x, z: {"y": ssm.Normal(x + z, sd=0.5)})
    own = {"proposal": proposal, "particles": 100, "seed": 1}
    assert np.isfinite(ssm.log_likelihood(model, DATA, {"q": 0.3}, **own)[0])
    assert ssm.log_likelihood(model, DATA, {"q": -0.3}, **own)[0] == -np.inf


@pytest.mark.parametrize("proposal", ["bootstrap", "guided", "auxiliary"])
def test_a_state_that_leads_there_is_told(proposal):
    model = ssm.Model("spread by state")
    model.initial(lambda: {"x": ssm.Normal(0.2, sd=0.5)})
    model.transition(lambda x: {"x": ssm.Normal(0.5, sd=0.3 * x)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    with pytest.raises(ssm.SamplingError, match=r"NaN|nan|not a number"):
        ssm.log_likelihood(model, DATA, {}, proposal=proposal, particles=200, seed=1)


@pytest.mark.parametrize(
    "method", [ssm.MetropolisHastings(), ssm.Gibbs()], ids=lambda m: type(m).__name__
)
def test_a_prior_that_reaches_below_zero(method):
    model = level("transition", ssm.Normal(0.2, sd=0.3))
    q = np.linspace(0, 2, 401)[1:]
    log_p = -0.5 * ((q - 0.2) / 0.3) ** 2
    log_p += [ssm.log_likelihood(model, DATA, {"q": v}, proposal="kalman")[0] for v in q]
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    drawn = ssm.sample(
        model, DATA, method, draws=3000, warmup=1000, chains=4, seed=1, progress=False
    )["posterior"]["q"].values
    assert drawn.min() > 0
    assert_within(deviations(drawn, p @ q, np.sqrt(p @ (q - p @ q) ** 2)))
