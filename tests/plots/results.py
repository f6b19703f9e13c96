"""Small models and what the verbs make of them, computed once, for the tests of their plots."""

import functools

import numpy as np
import pandas as pd

import ssmppl as ssm

DATES = pd.date_range("2024-03-01", periods=12, freq="D")

level = ssm.Model("level <1>", inputs=("push",))


@level.prior
def prior():
    return {"q": ssm.HalfNormal(sd=1), "r": ssm.Gamma(2, rate=2)}


@level.initial
def initial():
    return {"x": ssm.Normal(np.zeros(2), sd=1)}


@level.transition
def transition(x, q, push):
    return {"x": ssm.Normal(x + np.array([push, 0.0]), sd=q)}


@level.observation
def observation(x, r):
    return {"y": ssm.Normal(x[0], sd=r), "z": ssm.Normal(x[0] + x[1], sd=r)}


counts = ssm.Model("counts")


@counts.prior
def counts_prior():
    return {"phi": ssm.Uniform(-1, 1), "s": ssm.Exponential(rate=2)}


@counts.initial
def counts_initial():
    return {"x": ssm.Normal(0, sd=1)}


@counts.transition
def counts_transition(x, phi, s):
    return {"x": ssm.Normal(phi * x, sd=s)}


@counts.observation
def counts_observation(x):
    return {"y": ssm.Poisson(np.exp(x))}


TRUTH = {"q": 0.4, "r": 0.5}


@functools.cache
def data(k=0):
    """One experiment, two readings of y missing; of dates; the second has numbers."""
    rng = np.random.default_rng(k)
    y, z, push = rng.normal(size=(3, 12))
    y[[2, 5]] = np.nan
    frame = pd.DataFrame({"y": y, "z": z, "push": push}, index=DATES)
    return frame if k == 0 else frame.iloc[: 12 - k].reset_index(drop=True)


@functools.cache
def smoothed():
    return ssm.smooth(level, data(), TRUTH)


@functools.cache
def filtered():
    return ssm.kalman_filter(level, data(), TRUTH)


@functools.cache
def sampled(several=False):
    given = [data(), data(1)] if several else data()
    return ssm.sample(
        level, given, ssm.Gibbs(), draws=40, warmup=20, chains=2, seed=1, progress=False
    )


@functools.cache
def particles(n=8, proposal="bootstrap", threshold=1.0, history=True, repeats=1):
    return ssm.particle_filter(
        counts, {"y": [0, 1, 3, 2, 0, 0, 5, 1, 1, 0]}, {"phi": 0.9, "s": 0.5}, particles=n,
        proposal=proposal, ess_threshold=threshold, history=history, repeats=repeats, seed=3,
    )  # fmt: skip


@functools.cache
def maximised():
    return ssm.maximize(level, data(), ssm.EM(iterations=30), seed=1, progress=False)
