"""Models shared by the statistical tests, each defined once, so that each is compiled once.

`LINEAR` gives the linear Gaussian ones a second time, as matrices written down by hand: what the
dense Gaussian of `exact.py` starts from, independent of how the package reads the functions.
"""

from __future__ import annotations

import numpy as np

import ssmppl as ssm

# --- the ice varves, and a copy with priors that can be simulated from --------------------------

varves = ssm.Model("varves")


@varves.prior
def varves_prior():
    return {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)}


@varves.initial
def varves_initial(phi, tau):
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@varves.transition
def varves_transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@varves.observation
def varves_observation(x):
    return {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))}


proper_varves = ssm.Model("proper varves")


@proper_varves.prior
def proper_varves_prior():
    return {"phi": ssm.Uniform(0.5, 0.99), "tau": ssm.Gamma(20, rate=0.4)}


proper_varves.initial(varves_initial)
proper_varves.transition(varves_transition)
proper_varves.observation(varves_observation)


# --- the linear Gaussian series of Schön et al. (2015); c is 0.5 in the main text, 1 after it ----

lgss = ssm.Model("lgss")


@lgss.prior
def lgss_prior():
    return {"theta": ssm.Gamma(0.01, rate=0.01), "c": ssm.Normal(1, sd=1)}


@lgss.initial
def lgss_initial(theta):
    return {"x": ssm.Normal(0, precision=0.51 * theta)}


@lgss.transition
def lgss_transition(x, theta):
    return {"x": ssm.Normal(0.7 * x, precision=theta)}


@lgss.observation
def lgss_observation(x, c):
    return {"y": ssm.Normal(c * x, variance=0.1)}


def lgss_matrices(theta, c):
    return {
        "m": [0.0], "P": [[1 / (0.51 * theta)]], "A": [[0.7]], "b": [0.0], "Q": [[1 / theta]],
        "C": [[c]], "d": [0.0], "R": [[0.1]],
    }  # fmt: skip


# --- one state seen through two components: two channels, and one channel of two components ------

two_channels = ssm.Model("two channels")


@two_channels.initial
def two_channels_initial():
    return {"x": ssm.Normal(0, sd=1.5)}


@two_channels.transition
def two_channels_transition(x):
    return {"x": ssm.Normal(0.8 * x + 0.1, sd=0.9)}


@two_channels.observation
def two_channels_observation(x):
    return {"a": ssm.Normal(x, sd=0.6), "b": ssm.Normal(1.0 - 0.5 * x, sd=0.5)}


joint_channel = ssm.Model("joint channel")
joint_channel.initial(two_channels_initial)
joint_channel.transition(two_channels_transition)

JOINT_COVARIANCE = np.array([[0.36, 0.2], [0.2, 0.25]])


@joint_channel.observation
def joint_channel_observation(x):
    mean = np.array([1.0, -0.5]) * x + np.array([0.0, 1.0])
    return {"y": ssm.MvNormal(mean, covariance=JOINT_COVARIANCE)}


def two_component_matrices(R):
    return {
        "m": [0.0], "P": [[2.25]], "A": [[0.8]], "b": [0.1], "Q": [[0.81]],
        "C": [[1.0], [-0.5]], "d": [0.0, 1.0], "R": R,
    }  # fmt: skip


# --- two noisy states, an input, and a deterministic sum with a memory of one step ---------------

machine = ssm.Model("machine", inputs=("u",))


@machine.initial
def machine_initial():
    return {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2)), "s": ssm.Dirac(0.0)}


@machine.transition
def machine_transition(x, u):
    A = np.array([[0.8, 0.3], [-0.2, 0.7]])
    return {
        "x": ssm.MvNormal(A @ x + np.array([0.5, 0.0]) * u, covariance=np.diag([0.5, 0.3])),
        "s": ssm.Dirac(x[0] - x[1]),
    }


@machine.observation
def machine_observation(x, s, u):
    return {"y": ssm.Normal(x[0] + 0.5 * s + 0.2 * u, sd=0.7)}


def machine_matrices(u):
    b = np.zeros((len(u), 3))
    b[1:, 0] = 0.5 * u[:-1]
    return {
        "m": [0.0, 0.0, 0.0], "P": np.diag([1.0, 1.0, 0.0]),
        "A": [[0.8, 0.3, 0.0], [-0.2, 0.7, 0.0], [1.0, -1.0, 0.0]], "b": b,
        "Q": np.diag([0.5, 0.3, 0.0]), "C": [[1.0, 0.0, 0.5]], "d": 0.2 * u[:, None],
        "R": [[0.49]],
    }  # fmt: skip


# --- an AR(2) in companion form ------------------------------------------------------------------

ar2 = ssm.Model("ar2")


@ar2.initial
def ar2_initial():
    return {"x": ssm.Normal(0, sd=1), "before": ssm.Dirac(0.0)}


@ar2.transition
def ar2_transition(x, before):
    return {"x": ssm.Normal(1.2 * x - 0.5 * before, sd=0.8), "before": ssm.Dirac(x)}


@ar2.observation
def ar2_observation(x):
    return {"y": ssm.Normal(x, sd=1)}


AR2_MATRICES = {
    "m": [0.0, 0.0], "P": np.diag([1.0, 0.0]), "A": [[1.2, -0.5], [1.0, 0.0]], "b": [0.0, 0.0],
    "Q": np.diag([0.64, 0.0]), "C": [[1.0, 0.0]], "d": [0.0], "R": [[1.0]],
}  # fmt: skip


# --- position and velocity; the step h stands in the law of the position -------------------------

vehicle = ssm.Model("vehicle")


@vehicle.prior
def vehicle_prior():
    return {"h": ssm.Normal(0.4, sd=0.2)}


@vehicle.initial
def vehicle_initial():
    return {"v": ssm.Normal(1.0, sd=0.5), "p": ssm.Dirac(0.0)}


@vehicle.transition
def vehicle_transition(p, v, h):
    return {"v": ssm.Normal(0.9 * v + 0.1, sd=0.4), "p": ssm.Dirac(p + h * v)}


@vehicle.observation
def vehicle_observation(p):
    return {"y": ssm.Normal(p, sd=0.5)}


def vehicle_matrices(h):
    return {
        "m": [1.0, 0.0], "P": np.diag([0.25, 0.0]), "A": [[0.9, 0.0], [h, 1.0]], "b": [0.1, 0.0],
        "Q": np.diag([0.16, 0.0]), "C": [[0.0, 1.0]], "d": [0.0], "R": [[0.25]],
    }  # fmt: skip


# --- a parameter inside a deterministic law that forgets -----------------------------------------

echo = ssm.Model("echo")


@echo.prior
def echo_prior():
    return {"g": ssm.Normal(0, sd=1)}


@echo.initial
def echo_initial():
    return {"x": ssm.Normal(0, sd=1), "e": ssm.Dirac(0.0)}


@echo.transition
def echo_transition(x, g):
    return {"x": ssm.Normal(0.6 * x, sd=1), "e": ssm.Dirac(g * x)}


@echo.observation
def echo_observation(x, e):
    return {"y": ssm.Normal(x + e, sd=0.5)}


def echo_matrices(g):
    return {
        "m": [0.0, 0.0], "P": np.diag([1.0, 0.0]), "A": [[0.6, 0.0], [g, 0.0]], "b": [0.0, 0.0],
        "Q": np.diag([1.0, 0.0]), "C": [[1.0, 1.0]], "d": [0.0], "R": [[0.25]],
    }  # fmt: skip


# --- for calibration: a regression on an input, two states, counts -------------------------------

regression = ssm.Model("regression", inputs=("u",))


@regression.prior
def regression_prior():
    return {
        "a": ssm.Normal(0.5, sd=0.2),
        "b": ssm.Normal(0, sd=1),
        "q": ssm.InverseGamma(6, scale=3),
    }


@regression.initial
def regression_initial():
    return {"x": ssm.Normal(0, sd=1)}


@regression.transition
def regression_transition(x, u, a, b, q):
    return {"x": ssm.Normal(a * x + b * u, variance=q)}


@regression.observation
def regression_observation(x):
    return {"y": ssm.Normal(x, sd=0.5)}


stationary = ssm.Model("stationary")


@stationary.prior
def stationary_prior():
    return {"phi": ssm.Uniform(-0.5, 0.98), "tau": ssm.Gamma(6, rate=3)}


@stationary.initial
def stationary_initial(phi, tau):
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@stationary.transition
def stationary_transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@stationary.observation
def stationary_observation(x):
    return {"y": ssm.Normal(x, sd=0.5)}


two_states = ssm.Model("two states")


@two_states.prior
def two_states_prior():
    return {
        "a": ssm.Uniform(0.2, 0.95),
        "k": ssm.Normal(0.5, sd=0.3),
        "precision": ssm.Gamma(8, rate=2),
        "r": ssm.InverseGamma(8, scale=2),
    }


@two_states.initial
def two_states_initial():
    return {"drive": ssm.Normal(0, sd=1), "level": ssm.Normal(0, sd=1)}


@two_states.transition
def two_states_transition(drive, level, a, k, precision):
    return {
        "drive": ssm.Normal(a * drive, precision=precision),
        "level": ssm.Normal(0.7 * level + k * drive, sd=0.3),
    }


@two_states.observation
def two_states_observation(level, r):
    return {"y": ssm.Normal(level, variance=r)}


counts = ssm.Model("counts")


@counts.prior
def counts_prior():
    return {
        "mu": ssm.Normal(1, sd=0.5),
        "phi": ssm.Uniform(0.4, 0.95),
        "tau": ssm.Gamma(10, rate=1),
    }


@counts.initial
def counts_initial(mu):
    return {"x": ssm.Normal(mu, sd=0.5)}


@counts.transition
def counts_transition(x, mu, phi, tau):
    return {"x": ssm.Normal(mu + phi * (x - mu), precision=tau)}


@counts.observation
def counts_observation(x):
    return {"y": ssm.Poisson(np.exp(x))}


# A vector autoregression with its conjugate prior, observed with gaps; one with a prior that is not
# scaled by the noise; and a hidden Markov model with a Dirichlet law for each row of its matrix.

vector_ar = ssm.Model("vector ar")
vector_ar_apart = ssm.Model("vector ar apart")


@vector_ar.prior
@vector_ar_apart.prior
def noise_prior():
    return {"Q": ssm.InverseWishart(8, scale=np.array([[3.0, 1.0], [1.0, 2.0]]))}


@vector_ar.prior
def vector_ar_prior(Q):
    spread = np.array([[0.01, 0.0025], [0.0025, 0.008]])  # few of its draws are explosive
    return {"a": ssm.MvNormal([0.6, 0.2, -0.2, 0.5], covariance=np.kron(Q, spread))}


@vector_ar.transition
def vector_ar_transition(x, a, Q):
    return {"x": ssm.MvNormal(np.reshape(a, (2, 2)) @ x, covariance=Q)}


@vector_ar_apart.prior
def vector_ar_apart_prior():
    return {"a": ssm.Normal([0.6, 0.2, -0.2, 0.5], sd=0.2)}


vector_ar_apart.transition(vector_ar_transition)


@vector_ar.initial
@vector_ar_apart.initial
def vector_ar_initial(Q):
    return {"x": ssm.MvNormal(np.zeros(2), covariance=2 * Q)}


@vector_ar.observation
@vector_ar_apart.observation
def vector_ar_observation(x):
    return {"y": ssm.Normal(x, sd=0.3)}


three_regimes = ssm.Model("three regimes")


@three_regimes.prior
def three_regimes_prior():
    rows = {f"row{i}": ssm.Dirichlet(1.0 + 4.0 * np.eye(3)[i]) for i in range(3)}
    level = ssm.Normal(np.array([-3.0, 0.0, 3.0]), sd=0.4)
    return {**rows, "level": level, "v": ssm.InverseGamma(8, scale=4)}


@three_regimes.initial
def three_regimes_initial():
    return {"k": ssm.Categorical([0.4, 0.3, 0.3])}


@three_regimes.transition
def three_regimes_transition(k, row0, row1, row2):
    return {"k": ssm.Categorical(np.stack([row0, row1, row2])[k])}


@three_regimes.observation
def three_regimes_observation(k, level, v):
    return {"y": ssm.Normal(level[k], variance=v)}
