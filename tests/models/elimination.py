"""Models with parameters that can be integrated out in every way there is, with proper priors."""

from __future__ import annotations

import numpy as np

import ssmppl as ssm

# --- a precision in the initial law and the transition, another parameter held ------------------

scale = ssm.Model("scale, to be eliminated")


@scale.prior
def scale_prior():
    return {"phi": ssm.Uniform(0.2, 0.95), "tau": ssm.Gamma(4, rate=2)}


@scale.initial
def scale_initial(phi, tau):
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@scale.transition
def scale_transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@scale.observation
def scale_observation(x):
    return {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))}


# --- a regression on two lags and an input: Normal-inverse-Gamma, a deterministic state ---------

lags = ssm.Model("lags, to be eliminated", inputs=("u",))


@lags.prior
def lags_prior():
    return {"q": ssm.InverseGamma(4, scale=2), "m": ssm.Normal(0, sd=0.5)}


@lags.prior
def lags_coefficients(q):
    return {"a": ssm.Normal(np.array([0.5, -0.2, 0.3]), variance=np.array([0.2, 0.3, 0.4]) * q)}


@lags.initial
def lags_initial(m):
    return {"x": ssm.Normal(m, sd=1), "before": ssm.Dirac(0.3 * m)}


@lags.transition
def lags_transition(x, before, a, q, u):
    return {
        "x": ssm.Normal(a[0] * x + a[1] * before + a[2] * u, variance=q),
        "before": ssm.Dirac(x),
    }


@lags.observation
def lags_observation(x, before, m):
    return {"y": ssm.Normal(x + 0.4 * before + m, sd=0.5)}


# --- one precision in the transition and the observation, a rate of counts; a vector, feedback --

shared = ssm.Model("shared, to be eliminated", inputs=("u",))


@shared.prior
def shared_prior():
    return {"r": ssm.Gamma(4, rate=3), "rate": ssm.Gamma(3, rate=2), "g": ssm.Normal(0, sd=0.5)}


@shared.initial
def shared_initial(r):
    return {"x": ssm.Normal(np.zeros(2), precision=r)}


@shared.transition
def shared_transition(x, r, level, t):
    mean = np.array([0.6 * x[0] + 0.2 * level, np.sin(x[0]) + 0.1 * t])
    return {"x": ssm.Normal(mean, precision=2 * r)}


@shared.observation
def shared_observation(x, r, rate, g, u):
    return {
        "level": ssm.Normal(x[0] + g * u, precision=r),
        "count": ssm.Poisson(rate * np.exp(0.3 * x[1])),
    }


# --- probabilities: Beta and Dirichlet, and a level for each regime: joint Normal ---------------

regimes = ssm.Model("regimes, to be eliminated")


@regimes.prior
def regimes_prior():
    return {
        "first": ssm.Dirichlet(np.array([2.0, 1.0, 1.5])),
        "p": ssm.Beta(2, 3),
        "level": ssm.Normal(np.array([-1.0, 0.0, 1.5]), sd=0.7),
        "s": ssm.Uniform(0.3, 0.9),
    }


@regimes.initial
def regimes_initial(p):
    return {"k": ssm.Categorical(np.array([0.3, 0.3, 0.4])), "on": ssm.Bernoulli(p)}


@regimes.transition
def regimes_transition(k, on, first, p):
    return {"k": ssm.Categorical(first), "on": ssm.Bernoulli(np.where(on == 1, p, 1 - p))}


@regimes.observation
def regimes_observation(k, on, level, s):
    return {"y": ssm.Normal(np.choose(k, level) + 0.5 * on, sd=s)}


STEPS = 5
MODELS = {"scale": scale, "lags": lags, "shared": shared, "regimes": regimes}
GONE = {  # what is eliminated
    "scale": {"tau"},
    "lags": {"q", "a"},
    "shared": {"r", "rate"},
    "regimes": {"first", "p", "level"},
}
HOLE = {  # values that are missing
    "scale": [("y", 2)],
    "lags": [("y", 3)],
    "shared": [("count", 1), ("count", 4)],
    "regimes": [("y", 0)],
}


def inputs_of(model: ssm.Model) -> dict[str, np.ndarray]:
    return {name: np.cos(np.arange(STEPS)) for name in model.inputs}


def joint_draws(name: str, draws: int, seed: int):
    """(model, simulated Dataset, function from a draw's number to its data), values missing."""
    model = MODELS[name]
    u = inputs_of(model)
    out = ssm.simulate(model, steps=STEPS, inputs=u or None, draws=draws, seed=seed)
    channels = [site for site in ("y", "level", "count") if site in out and site != "level"]
    if name == "shared":
        channels = ["level", "count"]

    def data_of(i: int) -> dict[str, np.ndarray]:
        data = {c: np.array(out[c].values[i], dtype=float) for c in channels}
        for channel, t in HOLE[name]:
            data[channel][t] = np.nan
        return data | u

    return model, out, data_of
