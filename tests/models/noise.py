"""Models whose states are told by their noises in every way there is, with priors to draw from."""

from __future__ import annotations

import numpy as np

import ssmppl as ssm

# --- linear and Gaussian, of one state -----------------------------------------------------------

linear = ssm.Model("linear, by its noises")


@linear.prior
def linear_prior():
    return {
        "phi": ssm.Uniform(0.3, 0.95),
        "q": ssm.InverseGamma(4, scale=2),
        "r": ssm.Gamma(4, rate=8),
    }


@linear.initial
def linear_initial(phi, q):
    return {"x": ssm.Normal(0.0, variance=q / (1 - phi**2))}


@linear.transition
def linear_transition(x, phi, q):
    return {"x": ssm.Normal(phi * x, variance=q)}


@linear.observation
def linear_observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}


# --- a vector, a positive state and a deterministic one; an input, feedback, counts --------------

vector = ssm.Model("vector, by its noises", inputs=("u",))


@vector.prior
def vector_prior():
    return {
        "a": ssm.Uniform(0.2, 0.8),
        "s": ssm.Gamma(5, rate=10),
        "b": ssm.Normal(0, sd=0.5),
        "k": ssm.Uniform(0.5, 1.5),
    }


@vector.initial
def vector_initial(s):
    covariance = s * np.array([[1.0, 0.3], [0.3, 0.5]])
    return {
        "x": ssm.MvNormal(np.zeros(2), covariance=covariance),
        "w": ssm.LogNormal(0.0, sd=s),
        "m": ssm.Dirac(0.5 * s),
    }


@vector.transition
def vector_transition(x, w, m, a, s, b, u, level, t):
    covariance = np.array([[s**2, 0.2 * s], [0.2 * s, 0.4]])
    mean = np.array([a * x[0] + b * u, np.sin(x[0]) + 0.1 * level + 0.05 * t])
    return {
        "x": ssm.MvNormal(mean, covariance=covariance),
        "w": ssm.LogNormal(0.5 * np.log(w) + 0.1 * m, sd=0.5 * s),
        "m": ssm.Dirac(a * x[0] + 0.1 * b),
    }


@vector.observation
def vector_observation(x, w, m, k, u):
    return {
        "level": ssm.Normal(x[0] + 0.2 * m, sd=0.4),
        "count": ssm.Poisson(w * np.exp(k * x[1] + 0.1 * u)),
    }


# --- laws of location and scale that are not Gaussian; a state that stays -----------------------

mixed = ssm.Model("mixed, by its noises")


@mixed.prior
def mixed_prior():
    return {
        "a": ssm.Uniform(0.2, 0.8),
        "s": ssm.Gamma(5, rate=10),
        "df": ssm.Uniform(3, 9),
        "c": ssm.Normal(0, sd=0.5),
    }


@mixed.initial
def mixed_initial(s, c):
    return {
        "x": ssm.StudentT(5, c, scale=s),
        "g": ssm.Gamma(2.0, rate=1 / s),
        "v": ssm.Laplace(np.array([0.0, 1.0]), scale=s),
        "z": ssm.Truncated(ssm.Normal(c, sd=s), lower=-1.0, upper=2.0),
        "k": ssm.Bernoulli(0.5),
    }


@mixed.transition
def mixed_transition(x, g, v, z, k, a, s, df, c):
    return {
        "x": ssm.StudentT(df, a * x + c * k, scale=s * (1 + 0.1 * z**2)),
        "g": ssm.Gamma(2.0 + a, rate=2.0 / (0.2 + s * g)),
        "v": ssm.Laplace(a * v + 0.1 * x, scale=np.array([s, 0.3])),
        "z": ssm.Truncated(ssm.Normal(c + 0.3 * z, sd=s), lower=-1.0, upper=2.0),
        "k": ssm.Bernoulli(1 / (1 + np.exp(-x))),
    }


@mixed.observation
def mixed_observation(x, g, v):
    return {"y": ssm.Normal(x + v[0], sd=0.5), "n": ssm.Normal(v[1] + g, sd=0.5)}


# --- seen through a law that is cut off on one side ----------------------------------------------

cut = ssm.Model("cut off, by its noises")


@cut.prior
def cut_prior():
    return {"s": ssm.Gamma(5, rate=10), "r": ssm.Gamma(5, rate=10)}


@cut.initial
def cut_initial():
    return {"x": ssm.Normal(0.5, sd=1.0)}


@cut.transition
def cut_transition(x, s):
    return {"x": ssm.Normal(0.8 * x, sd=s)}


@cut.observation
def cut_observation(x, r):
    return {"y": ssm.Truncated(ssm.Normal(x, sd=r), lower=0.0)}


STEPS = 4
HOLE = {  # a value that is missing
    "linear": ("y", 2), "vector": ("count", 1), "mixed": ("n", 2), "cut": ("y", 1)
}  # fmt: skip
MODELS = {"linear": linear, "vector": vector, "mixed": mixed, "cut": cut}
CASES = [(name, steered) for name in MODELS for steered in (True, False)]
CASES.remove(("mixed", True))


def inputs_of(model: ssm.Model) -> dict[str, np.ndarray]:
    return {name: np.cos(np.arange(STEPS)) for name in model.inputs}


def joint_draws(name: str, draws: int, seed: int):
    """(model, simulated Dataset, function from a draw's number to its data), a value missing."""
    model = MODELS[name]
    u = inputs_of(model)
    out = ssm.simulate(model, steps=STEPS, inputs=u or None, draws=draws, seed=seed)
    channels = [site for site in ("y", "n", "level", "count") if site in out]

    def data_of(i: int) -> dict[str, np.ndarray]:
        data = {c: np.array(out[c].values[i], dtype=float) for c in channels}
        channel, t = HOLE[name]
        data[channel][t] = np.nan
        return data | u

    return model, out, data_of
