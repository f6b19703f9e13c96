"""Functional forms of the withheld effects, each different from the catalogue's.

Every effect has a slot in one vector `e` of strengths; all slots zero is the base model. Forms of
states are compiled and scalar; forms of the measured input act on the whole series, since it is
known.

| effect | catalogue | here |
|---|---|---|
| Coulomb friction | tanh(v/v0) | bristle with pre-sliding (Dahl 1968; LuGre) |
| Stribeck | exp(-(v/vs)^2) tanh(v/v0) | bristle whose level falls as 1/(1 + (v/vs)^2) |
| drag | v abs(v) | sign(v) abs(v)^1.85 |
| stiffness | x^3 | (sinh(2x) - 2x)/2: all odd powers |
| stop | max(x - h, 0) | softplus |
| saturation | clipping | u/(1 + abs(au)^3)^(1/3) |
| dead zone | piecewise linear | u - w tanh(u/w) |
| asymmetry | u^2, abs(u) | softplus of u, centred |
| backlash | play | mean of three plays of unequal width |
| delay | whole steps | fractional, interpolated |
| lag | first order | two equal lags in a row |
| drift | linear in time | logistic, or a half cosine |
| break | step | logistic over a few steps |
| missing input | random walk, AR(1) | second-order smooth noise |
| periodic forcing | sine and cosine | triangular wave |
| sensor gain | polynomial | arsinh |
| outliers | Student's t | contamination by a four times wider normal |
| coarse discretisation | two half steps | eight substeps |
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

SLOTS = (
    "saturation", "dead_zone", "asymmetry", "backlash", "delay", "lag",
    "coulomb", "stribeck", "asymmetric", "load_friction", "drag", "stiffness", "stop", "coupling",
    "loss", "load", "hysteresis", "damping", "periodic", "drift", "break_", "missing", "coarse",
    "gain", "clipping", "sensor_lag", "sensor_drift", "coloured", "outliers", "scedastic",
    "outside",
)  # fmt: skip
(
    SATURATION, DEAD_ZONE, ASYMMETRY, BACKLASH, DELAY, LAG,
    COULOMB, STRIBECK, ASYMMETRIC, LOAD_FRICTION, DRAG, STIFFNESS, STOP, COUPLING,
    LOSS, LOAD, HYSTERESIS, DAMPING, PERIODIC, DRIFT, BREAK, MISSING, COARSE,
    GAIN, CLIPPING, SENSOR_LAG, SENSOR_DRIFT, COLOURED, OUTLIERS, SCEDASTIC,
    OUTSIDE,
) = range(len(SLOTS))  # fmt: skip
ON_INPUT = (SATURATION, DEAD_ZONE, ASYMMETRY, BACKLASH, DELAY, LAG)
WILD = 4.0  # how many times wider the contamination is


@njit
def softplus(x):
    """log(1 + exp(x)) without overflow."""
    return max(x, 0.0) + np.log1p(np.exp(-abs(x)))


@njit
def logistic(x):
    return 1.0 / (1.0 + np.exp(-x))


@njit
def triangle(phase):
    """Triangular wave of period 1 and height 1, rising through 0 at 0."""
    p = (phase + 0.25) % 1.0
    return 4.0 * p - 1.0 if p < 0.5 else 3.0 - 4.0 * p


@njit
def signed_power(v, p):
    return np.sign(v) * abs(v) ** p


@njit
def bristle(z, v, dt, reach, level):
    """Deflection, in units of the full friction, after a step at speed v: the exact solution of
    z' = v/reach - abs(v) z/(reach level)."""
    return level * np.sign(v) + (z - level * np.sign(v)) * np.exp(-abs(v) * dt / (reach * level))


@njit
def arsinh_gain(y, a):
    """arsinh(a y)/a: a sensor that compresses both ways; y at a = 0."""
    a = abs(a)
    return y if a < 1e-9 else np.arcsinh(a * y) / a


@njit
def forget(tau):
    """Share that one step of a first-order lag of tau steps keeps."""
    return 0.0 if tau < 1e-3 else np.exp(-1.0 / tau)


@njit
def rk4(rate, x, v, h, z, u, t, p, e):
    """Position and speed after a time h of x' = v, v' = rate(x, v, z, u, t, p, e)."""
    a1 = rate(x, v, z, u, t, p, e)
    v2 = v + 0.5 * h * a1
    a2 = rate(x + 0.5 * h * v, v2, z, u, t, p, e)
    v3 = v + 0.5 * h * a2
    a3 = rate(x + 0.5 * h * v2, v3, z, u, t, p, e)
    v4 = v + h * a3
    a4 = rate(x + h * v3, v4, z, u, t, p, e)
    return x + h * (v + 2 * v2 + 2 * v3 + v4) / 6, v + h * (a1 + 2 * a2 + 2 * a3 + a4) / 6


def driven(U: np.ndarray, e: np.ndarray) -> np.ndarray:
    """What reaches the system of the measured inputs (T, m): the effects act on the first."""
    if not e[list(ON_INPUT)].any():
        return U
    U = U.copy()
    u = U[:, 0]
    size = np.std(U[:, 0])
    if e[ASYMMETRY]:
        bent = np.logaddexp(0, 3 * u / size) * size / 3 - u / 2
        u = u + e[ASYMMETRY] * (bent - bent.mean())
    if e[SATURATION]:
        u = u / (1 + np.abs(e[SATURATION] * u) ** 3) ** (1 / 3)
    if e[DEAD_ZONE]:
        width = abs(e[DEAD_ZONE])
        u = u - width * np.tanh(u / width)
    if e[BACKLASH]:
        u = np.mean([play(u, abs(e[BACKLASH]) * part) for part in (0.5, 0.9, 1.6)], axis=0)
    if e[LAG]:
        for _ in range(2):
            u = lagged(u, abs(e[LAG]) / 2)
    if e[DELAY]:
        u = delayed(u, abs(e[DELAY]))
    U[:, 0] = u
    return U


def delayed(u: np.ndarray, steps: float) -> np.ndarray:
    """u at t - steps, between the samples interpolated; before the first, as the first."""
    at = np.maximum(np.arange(len(u)) - steps, 0)
    return np.interp(at, np.arange(len(u)), u)


@njit
def lagged(u, tau):
    keep, z, out = forget(tau), u[0], np.empty_like(u)
    for t in range(len(u)):
        z = keep * z + (1 - keep) * u[t]
        out[t] = z
    return out


@njit
def play(u, width):
    """Output of a play of half-width `width`, at rest in its middle at first."""
    z, out = u[0], np.empty_like(u)
    for t in range(len(u)):
        z = min(max(z, u[t] - width), u[t] + width)
        out[t] = z
    return out


def multisine(
    rng: np.random.Generator, T: int, lowest: int, highest: int, period: int = 150
) -> np.ndarray:
    """Multisine of unit variance with the lines lowest .. highest of a period of so many rows.

    Of 40 draws of its phases the one with the lowest peak is taken, as who designs an experiment
    does: every draw and every part of it then excites the system about alike.
    """
    k = np.arange(lowest, highest + 1)
    phase = rng.uniform(0, 2 * np.pi, (40, len(k), 1))
    waves = np.cos(2 * np.pi * np.outer(k, np.arange(T)) / period + phase).sum(1)
    waves /= waves.std(axis=1, keepdims=True)
    return waves[np.argmin(np.abs(waves).max(axis=1))]


def holds(
    rng: np.random.Generator, T: int, shortest: int, longest: int, levels: ArrayLike
) -> np.ndarray:
    """Steps between levels, each held for a random time; all levels before one comes again."""
    out, t = np.empty(T), 0
    left: list[float] = []
    while t < T:
        left = left or list(rng.permutation(levels))
        length = int(rng.integers(shortest, longest + 1))
        out[t : t + length] = left.pop()
        t += length
    return out


def smooth_noise(rng: np.random.Generator, T: int, tau: float) -> np.ndarray:
    """Noise through two lags of tau steps, of about unit variance."""
    noise = rng.standard_normal(T + int(10 * tau))
    return (lagged(lagged(noise, tau), tau) * np.sqrt(4 * tau))[-T:]
