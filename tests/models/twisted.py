"""Models for the twisted filter: a steered state that is not seen itself, and noise that is not
additive or not Gaussian, with exact likelihoods of short series by quadrature."""

from __future__ import annotations

import numpy as np
from scipy import stats

import ssmppl as ssm

# --- a pendulum of which only the angle is seen --------------------------------------------------

pendulum = ssm.Model("pendulum by its angle")
STEP, STIFF, DAMPING, SWING, SHAKE, ERROR = 0.2, 6.0, 0.4, 0.8, 0.5, 0.1


@pendulum.initial
def pendulum_initial():
    return {"angle": ssm.Normal(1.0, sd=0.3), "speed": ssm.Normal(0.0, sd=SWING)}


@pendulum.transition
def pendulum_transition(angle, speed):
    pull = -STIFF * np.sin(angle) - DAMPING * speed
    return {
        "angle": ssm.Dirac(angle + STEP * speed),
        "speed": ssm.Normal(speed + STEP * pull, sd=SHAKE),
    }


@pendulum.observation
def pendulum_observation(angle):
    return {"y": ssm.Normal(np.sin(angle), sd=ERROR)}


def pendulum_path(e, start=None):
    """States (T, 2) that noise e (T + 1,) leads to: two for the start, one for each later row; or
    from a given start."""
    out = [np.array([1.0 + 0.3 * e[0], SWING * e[1]]) if start is None else start]
    for shock in e[2:]:
        angle, speed = out[-1]
        pull = -STIFF * np.sin(angle) - DAMPING * speed
        out.append(np.array([angle + STEP * speed, speed + STEP * pull + SHAKE * shock]))
    return np.array(out)


# --- stochastic volatility; where the state is at `hole` there is no noise to see ----------------

volatility = ssm.Model("volatility with a hole")
PHI, SIGMA = 0.9, 0.5


@volatility.prior
def volatility_prior():
    return {"hole": ssm.Normal(0, sd=10), "sigma": ssm.HalfNormal(sd=1)}


@volatility.initial
def volatility_initial(sigma):
    return {"x": ssm.Normal(0.0, sd=2 * sigma)}


@volatility.transition
def volatility_transition(x, sigma):
    return {"x": ssm.Normal(PHI * x, sd=sigma)}


@volatility.observation
def volatility_observation(x, hole):
    return {"y": ssm.Normal(0.0, sd=np.exp(x / 2) * abs(x - hole))}


def volatility_log_likelihood(y, hole, sigma, points=1200):
    """By a point-mass filter; an even count of points leaves out a hole at zero."""
    x, h = np.linspace(-12 * sigma, 12 * sigma, points, retstep=True)
    move = stats.norm.pdf(x[:, None], PHI * x[None, :], sigma) * h
    log_g = stats.norm.logpdf(np.asarray(y)[:, None], 0.0, np.exp(x / 2) * np.abs(x - hole))
    log_g[np.isnan(y)] = 0.0
    return point_mass(stats.norm.pdf(x, 0.0, 2 * sigma), move, log_g, h)


# --- animals that multiply, counted; the noise stands in the exponent ----------------------------

ricker = ssm.Model("ricker")
GROWTH, CROWDING, LUCK, SHARE = 1.2, 0.1, 0.4, 2.0


@ricker.initial
def ricker_initial():
    return {"n": ssm.LogNormal(1.0, sd=0.7)}


@ricker.transition
def ricker_transition(n):
    return {"n": ssm.LogNormal(np.log(n) + GROWTH - CROWDING * n, sd=LUCK)}


@ricker.observation
def ricker_observation(n):
    return {"y": ssm.Poisson(SHARE * n)}


def ricker_log_likelihood(y, points=1600):
    """By a point-mass filter of log n."""
    z, h = np.linspace(-9, 7, points, retstep=True)
    n = np.exp(z)
    move = stats.norm.pdf(z[:, None], (z + GROWTH - CROWDING * n)[None, :], LUCK) * h
    log_g = stats.poisson.logpmf(np.nan_to_num(np.asarray(y))[:, None], SHARE * n)
    log_g[np.isnan(y)] = 0.0
    return point_mass(stats.norm.pdf(z, 1.0, 0.7), move, log_g, h)


# The same in the logarithm of the population, which falls by hundreds after a good year: its
# exponential underflows, and a linearised prediction is off by hundreds of standard deviations.
crash = ssm.Model("crash")
RATE, BIRTHS, COUNTED = 3.94, 1.56, 10.16


@crash.initial
def crash_initial():
    return {"x": ssm.Normal(0, sd=1)}


@crash.transition
def crash_transition(x):
    return {"x": ssm.Normal(x + RATE - np.exp(x), variance=BIRTHS)}


@crash.observation
def crash_observation(x):
    return {"y": ssm.Poisson(COUNTED * np.exp(x))}


def crash_log_likelihood(y, points=4000):
    """By a point-mass filter."""
    x, h = np.linspace(-60, 12, points, retstep=True)
    move = stats.norm.pdf(x[:, None], (x + RATE - np.exp(x))[None, :], BIRTHS**0.5) * h
    log_g = stats.poisson.logpmf(np.nan_to_num(np.asarray(y))[:, None], COUNTED * np.exp(x))
    log_g[np.isnan(y)] = 0.0
    return point_mass(stats.norm.pdf(x, 0.0, 1.0), move, log_g, h)


def point_mass(density, move, log_g, h):
    """log p(y) from the first state's density (n,), the masses moved (n, n), log g (T, n).

    The integrands are smooth and vanish at both ends of the grid, so that the trapezoidal rule
    converges faster than any power of its spacing.
    """
    total = 0.0
    for t, row in enumerate(log_g):
        density = (move @ density if t else density) * np.exp(row - row.max())
        mass = density.sum() * h
        total += row.max() + np.log(mass)
        density /= mass
    return float(total)
