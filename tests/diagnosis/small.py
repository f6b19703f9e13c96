"""Small models and data for tests of the whole diagnosis."""

import numpy as np

import ssmppl as ssm
from tests.statistics.checks import seed_of

BREAK, DATE = -6.0, 30  # the level jumps in the step that follows row 30


def level(start=None):
    """A random walk behind white noise."""
    model = ssm.Model("level")

    @model.prior
    def prior():
        return {"q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=3)}

    @model.initial
    def initial():
        return {"x": start or ssm.Normal(0, sd=2)}

    @model.transition
    def transition(x, q):
        return {"x": ssm.Normal(x, sd=q)}

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, sd=r)}

    return model


def levels(steps=80, jump=0.0, *name):
    """Data of `level` at q = 0.1, r = 1, with a jump behind row `DATE`."""
    rng = np.random.default_rng(seed_of("levels", steps, *name))
    x = np.cumsum(0.1 * rng.standard_normal(steps))
    x[DATE:] += jump
    return {"y": x + rng.standard_normal(steps)}
