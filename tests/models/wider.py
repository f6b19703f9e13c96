"""Further models with proper, informative priors, for the tests of calibration: what the models of
`standard.py` do not have.

leverage : stochastic volatility whose transition names the observation before.
ricker : a population that overshoots, counted with negative binomial error.
growth : the nonlinear benchmark of Gordon, Salmond and Smith (1993), with time in its transition.
bounded : parameters between bounds (Beta, truncated Normal), outliers, gaps in the data.
delay : an input, and a state that acts two steps later.
garch : a variance that follows from the observations before, without noise of its own.
"""

from __future__ import annotations

import numpy as np

import ssmppl as ssm

leverage = ssm.Model("leverage")


@leverage.prior
def leverage_prior():
    return {
        "mu": ssm.Normal(-0.5, sd=0.4),
        "phi": ssm.Uniform(0.5, 0.95),
        "tau": ssm.Gamma(12, rate=1),
        "k": ssm.Normal(-0.2, sd=0.15),
    }


@leverage.initial
def leverage_initial(mu):
    return {"x": ssm.Normal(mu, sd=0.5)}


@leverage.transition
def leverage_transition(x, y, mu, phi, tau, k):
    return {"x": ssm.Normal(mu + phi * (x - mu) + k * y * np.exp(-x / 2), precision=tau)}


@leverage.observation
def leverage_observation(x):
    return {"y": ssm.Normal(0, sd=np.exp(x / 2))}


ricker = ssm.Model("ricker")


@ricker.prior
def ricker_prior():
    return {
        "log_r": ssm.Normal(1.2, sd=0.3),
        "q": ssm.InverseGamma(10, scale=1.2),
        "scale": ssm.Gamma(20, rate=2),
        "dispersion": ssm.Gamma(20, rate=4),
    }


@ricker.initial
def ricker_initial():
    return {"x": ssm.Normal(0, sd=0.4)}


@ricker.transition
def ricker_transition(x, log_r, q):
    return {"x": ssm.Normal(x + log_r - np.exp(x), variance=q)}


@ricker.observation
def ricker_observation(x, scale, dispersion):
    return {"y": ssm.NegativeBinomial(scale * np.exp(x), dispersion=dispersion)}


growth = ssm.Model("growth")


@growth.prior
def growth_prior():
    return {
        "a": ssm.Normal(0.5, sd=0.1),
        "b": ssm.Normal(10, sd=2),
        "q": ssm.InverseGamma(8, scale=14),
        "r": ssm.InverseGamma(8, scale=7),
    }


@growth.initial
def growth_initial():
    return {"x": ssm.Normal(0, sd=2)}


@growth.transition
def growth_transition(x, t, a, b, q):
    return {"x": ssm.Normal(a * x + b * x / (1 + x**2) + 8 * np.cos(1.2 * t), variance=q)}


@growth.observation
def growth_observation(x, r):
    return {"y": ssm.Normal(x**2 / 20, variance=r)}


bounded = ssm.Model("bounded")


@bounded.prior
def bounded_prior():
    return {
        "phi": ssm.Beta(8, 2),
        "s": ssm.Truncated(ssm.Normal(0.5, sd=0.3), lower=0.2, upper=1.2),
    }


@bounded.initial
def bounded_initial(s):
    return {"x": ssm.Normal(0, sd=2 * s)}


@bounded.transition
def bounded_transition(x, phi, s):
    return {"x": ssm.Normal(phi * x, sd=s)}


@bounded.observation
def bounded_observation(x):
    return {"y": ssm.StudentT(4, x, scale=0.4)}


delay = ssm.Model("delay", inputs=("u",))


@delay.prior
def delay_prior():
    return {
        "a": ssm.Normal(0.5, sd=0.15),
        "c": ssm.Normal(-0.3, sd=0.15),
        "b": ssm.Normal(1, sd=0.4),
        "q": ssm.InverseGamma(8, scale=4),
    }


@delay.initial
def delay_initial():
    return {"x": ssm.Normal(0, sd=1), "before": ssm.Dirac(0.0)}


@delay.transition
def delay_transition(x, before, u, a, c, b, q):
    return {"x": ssm.Normal(a * x + c * before + b * u, variance=q), "before": ssm.Dirac(x)}


@delay.observation
def delay_observation(x):
    return {"y": ssm.Normal(x, sd=0.5)}


garch = ssm.Model("garch")


@garch.prior
def garch_prior():
    return {
        "w": ssm.Gamma(4, rate=20),
        "a": ssm.Beta(2, 8),
        "b": ssm.Beta(6, 4),
        "h_1": ssm.InverseGamma(4, scale=3),
    }


@garch.initial
def garch_initial(h_1):
    return {"h": ssm.Dirac(h_1)}


@garch.transition
def garch_transition(h, y, w, a, b):
    return {"h": ssm.Dirac(w + a * y**2 + b * h)}


@garch.observation
def garch_observation(h):
    return {"y": ssm.Normal(0, variance=h)}


# A count of arrivals, drawn within the step by the new value of a level, feeds a second level.
arrivals = ssm.Model("arrivals")


@arrivals.prior
def arrivals_prior():
    return {
        "phi": ssm.Beta(4, 2),
        "q": ssm.InverseGamma(4, scale=0.5),
        "b": ssm.Normal(0.5, sd=0.3),
    }


@arrivals.initial
def arrivals_initial():
    return {"x": ssm.Normal(0, sd=0.5), "z": ssm.Normal(0, sd=1)}


@arrivals.transition
def arrivals_level(x, phi, q):
    return {"x": ssm.Normal(phi * x, variance=q)}


@arrivals.transition
def arrivals_count(x_next):
    return {"count": ssm.Poisson(np.exp(x_next))}


@arrivals.transition
def arrivals_fed(z, b, count_next, x_next):
    return {"z": ssm.Normal(0.5 * z + b * count_next - x_next, sd=0.3)}


@arrivals.observation
def arrivals_observation(z):
    return {"y": ssm.Normal(z, sd=0.3)}
