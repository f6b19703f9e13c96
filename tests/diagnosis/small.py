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


def fished():
    """A stock that is fished, on a log scale: where it falls below what is caught, it dies out."""
    model = ssm.Model("fish stock", inputs=("catch",))

    @model.prior
    def prior():
        return {
            "r": ssm.LogNormal(-1.0, sd=0.7), "K": ssm.LogNormal(6.5, sd=0.8),
            "q": ssm.LogNormal(-2.3, sd=0.6), "s": ssm.LogNormal(-2.0, sd=0.6),
        }  # fmt: skip

    @model.initial
    def initial(K):
        return {"x": ssm.Normal(np.log(K), sd=0.3)}

    @model.transition
    def transition(x, catch, r, K, q):
        return {"x": ssm.Normal(x + r * (1 - np.exp(x) / K) - catch * np.exp(-x), sd=q)}

    @model.observation
    def observation(x, s):
        return {"y": ssm.Normal(x, sd=s)}

    return model


def fished_data(*name):
    """64 rows of it, 3 missing: the catch follows the stock, so that it lives."""
    rng = np.random.default_rng(seed_of("fished", *name))
    x, y, catch = np.log(800.0), [], []
    for t in range(64):
        y.append(x + 0.1 * rng.standard_normal())
        catch.append((0.14 if t < 46 else 0.084) * np.exp(x + 0.3 * rng.standard_normal()))
        growth = 0.28 * (1 - np.exp(x) / 800.0)
        x += growth - catch[-1] * np.exp(-x) + 0.07 * rng.standard_normal()
    out = {"y": np.array(y), "catch": np.array(catch)}
    out["y"][[10, 11, 33]] = np.nan
    return out
