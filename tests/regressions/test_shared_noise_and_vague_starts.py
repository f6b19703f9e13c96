"""What the messages about a missing row that a transition names, and about a flat start beside
counts, say to write, against quadrature."""

import math

import numpy as np
import pytest
import scipy.stats as st
from scipy.integrate import quad

import ssmppl as ssm
from ssmppl.errors import DataError, ModelError
from tests.statistics.checks import LEVEL, mean_one_p, seed_of

RHO, Y = 0.5, np.array([0.3, -0.2, np.nan, 0.5, 0.1])


def by_observation():
    """The state's noise is correlated with that of the observation before."""
    model = ssm.Model("shared")
    model.prior(lambda: {"rho": ssm.Uniform(-1, 1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})

    @model.transition
    def transition(x, y, rho):
        mean = 0.9 * x + rho * 0.5 * (y - x) / 0.4
        return {"x": ssm.Normal(mean, sd=0.5 * np.sqrt(1 - rho**2))}

    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.4)})
    return model


def by_state():
    """The same with the observation's noise as a state."""
    model = ssm.Model("shared")
    model.prior(lambda: {"rho": ssm.Uniform(-1, 1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "e": ssm.Normal(0, sd=0.4)})

    @model.transition
    def transition(x, e, rho):
        mean = 0.9 * x + rho * 0.5 * e / 0.4
        return {
            "x": ssm.Normal(mean, sd=0.5 * np.sqrt(1 - rho**2)), "e": ssm.Normal(0, sd=0.4),
        }  # fmt: skip

    model.observation(lambda x, e: {"y": ssm.Dirac(x + e)})
    return model


def test_a_shared_noise_with_a_missing_row():
    with pytest.raises(DataError) as error:
        ssm.log_likelihood(by_observation(), {"y": Y}, {"rho": RHO})
    assert "ssm.Dirac(... + e)" in error.value.fix

    def given(missing):
        y = np.where(np.isnan(Y), missing, Y)
        return math.exp(ssm.log_likelihood(by_observation(), {"y": y}, {"rho": RHO})[0])

    expected, _ = quad(given, -8, 8, epsabs=1e-12, epsrel=1e-9)
    found = ssm.log_likelihood(by_state(), {"y": Y}, {"rho": RHO})[0]
    assert found == pytest.approx(math.log(expected), rel=1e-8)


COUNTS = np.array([7.0, 9.0, np.nan, 12.0, 6.0])
SD = 0.2


def counted(start):
    model = ssm.Model("counts")
    model.initial(lambda: {"x": start})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=SD)})
    model.observation(lambda x: {"y": ssm.Poisson(np.exp(x))})
    return model


def flat_likelihood():
    """p(y) under a start of density 1 everywhere, on a grid."""
    x = np.linspace(-3, 6, 2401)
    step = x[1] - x[0]
    move = st.norm(0, SD).pdf(x[:, None] - x) * step
    weight = np.ones(len(x))
    for k, y in enumerate(COUNTS):
        weight = move @ weight if k else weight
        if np.isfinite(y):
            weight = weight * st.poisson(np.exp(x)).pmf(y)
    return weight.sum() * step


@pytest.mark.parametrize("spread", [1e2, 1e4, 1e6])
def test_a_vague_start_is_a_flat_one_but_for_a_constant(spread):
    with pytest.raises(ModelError) as error:
        ssm.log_likelihood(counted(ssm.Flat()), {"y": COUNTS}, {})
    assert "ssm.Normal(0, sd=1e4)" in error.value.fix
    found = ssm.log_likelihood(
        counted(ssm.Normal(0, sd=spread)), {"y": COUNTS}, {}, particles=200, repeats=200,
        seed=seed_of("vague", spread),
    )  # fmt: skip
    constant = math.log(spread) + 0.5 * math.log(2 * math.pi)
    assert np.std(found) < 0.2
    assert mean_one_p(found + constant - math.log(flat_likelihood())) > LEVEL
