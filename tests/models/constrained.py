"""Models whose parameters are a correlation matrix, ordered vectors, shares: what moves on a
transform of its own."""

import numpy as np

import ssmppl as ssm

correlated = ssm.Model("correlated")


@correlated.prior
def correlated_prior():
    return {"R": ssm.LKJ(3, 1.5), "sd": ssm.InverseGamma(np.full(3, 6.0), scale=4)}


@correlated.initial
def correlated_initial():
    return {"x": ssm.Normal(np.zeros(3), sd=1)}


@correlated.transition
def correlated_transition(x, R, sd):
    return {"x": ssm.MvNormal(0.6 * x, covariance=sd[:, None] * R * sd[None, :])}


@correlated.observation
def correlated_observation(x):
    return {"y": ssm.Normal(x, sd=0.4)}


# Noises of sensors that are correlated, of a state that moves non-linearly.
sensors = ssm.Model("sensors")


@sensors.prior
def sensors_prior():
    return {"R": ssm.LKJ(2, 2), "q": ssm.Gamma(4, rate=8)}


@sensors.initial
def sensors_initial():
    return {"x": ssm.Normal(0, sd=1)}


@sensors.transition
def sensors_transition(x, q):
    return {"x": ssm.Normal(1.5 * np.tanh(x), sd=q)}


@sensors.observation
def sensors_observation(x, R):
    sd = np.array([0.5, 0.8])
    return {"y": ssm.MvNormal(np.stack([x, x]), covariance=sd[:, None] * R * sd[None, :])}


# Two regimes told apart by the order of their rates; levels of three between bounds.
ordered_counts = ssm.Model("ordered counts")


@ordered_counts.prior
def ordered_counts_prior():
    return {"rate": ssm.Ordered(ssm.Gamma(np.full(2, 2.0), rate=0.4)), "stay": ssm.Beta(8, 2)}


@ordered_counts.initial
def ordered_counts_initial():
    return {"k": ssm.Bernoulli(0.5)}


@ordered_counts.transition
def ordered_counts_transition(k, stay):
    return {"k": ssm.Bernoulli(np.where(k > 0.5, stay, 1 - stay))}


@ordered_counts.observation
def ordered_counts_observation(k, rate):
    return {"y": ssm.Poisson(rate[k])}


ordered_levels = ssm.Model("ordered levels")


@ordered_levels.prior
def ordered_levels_prior():
    return {
        "level": ssm.Ordered(ssm.Normal(np.zeros(2), sd=2)),
        "a": ssm.Ordered(ssm.Uniform(np.zeros(2), 1)),
    }


@ordered_levels.initial
def ordered_levels_initial(level):
    return {"x": ssm.Normal(level, sd=1)}


@ordered_levels.transition
def ordered_levels_transition(x, a, level):
    return {"x": ssm.Normal(level + a * (x - level), sd=0.5)}


@ordered_levels.observation
def ordered_levels_observation(x):
    return {"y": ssm.Normal(x, sd=0.3)}
