"""Effects in the sensors, in the noise distributions, and in where the system starts.

Each function of a sensor is the increment of the noise-free value h of its channel, of a noise
distribution that of the log variance; l is the strength.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.diagnosis.effects.effect import (
    MOST_STRENGTH,
    Auxiliary,
    declared,
    effect,
    firsts,
    means,
    numbers,
    quantiles,
    rows,
    sds,
)
from ssmppl.language.distributions import Dirac, Normal


# -- sensors
@effect(on="channel", kind="observation", name="sensor bias", note="l")
def sensor_bias(h, strength):
    """A constant bias: the increment l."""
    return strength


@effect(on="channel", kind="observation", name="sensor drift", given={"w": "profile"},
        constant="sensor bias", profile="drift", shapes={"rows": rows(1.0)})  # fmt: skip
def sensor_drift(h, w, strength):
    """l (t / T - 1/2)"""
    return strength * w


@effect(on="channel", kind="observation", name="sensor gain nonlinearity", form="quadratic",
        shapes={"middle": means(1.0)})  # fmt: skip
def quadratic_gain(h, strength, middle):
    """l (h - m)^2, m the middle of the range"""
    return strength * (h - middle) ** 2


@effect(on="channel", kind="observation", name="sensor gain nonlinearity", form="cubic",
        shapes={"middle": means(1.0)})  # fmt: skip
def cubic_gain(h, strength, middle):
    """l (h - m)^3, m the middle of the range"""
    return strength * (h - middle) ** 3


@effect(on="channel", kind="observation", name="sensor gain nonlinearity", form="saturating",
        shapes={"s": sds(1.0, 2.0, between=(0.5, 3.0)), "middle": means(1.0)})  # fmt: skip
def saturating_gain(h, strength, s, middle):
    """l (s tanh((h - m) / s) - (h - m)), m the middle of the range"""
    return strength * (s * np.tanh((h - middle) / s) - (h - middle))


@effect(on="channel", kind="observation", name="sensor clipping", form="upper", lower=0,
        upper=MOST_STRENGTH, shapes={"c": quantiles(0.8, 0.95, between=(0.5, 0.99))})  # fmt: skip
def upper_clipping(h, strength, c):
    """-l max(h - c, 0)"""
    return -strength * np.maximum(h - c, 0.0)


@effect(on="channel", kind="observation", name="sensor clipping", form="lower", lower=0,
        upper=MOST_STRENGTH, shapes={"c": quantiles(0.2, 0.05, between=(0.01, 0.5))})  # fmt: skip
def lower_clipping(h, strength, c):
    """l max(c - h, 0)"""
    return strength * np.maximum(c - h, 0.0)


@effect(on="channel", kind="observation", name="sensor clipping", form="both ends", lower=0,
        upper=MOST_STRENGTH,
        shapes={"c": sds(1.0, 1.5, between=(0.3, 2.5)), "middle": means(1.0)})  # fmt: skip
def both_clippings(h, strength, c, middle):
    """-l (h - clip(h, m - c, m + c)), m the middle of the range"""
    return -strength * (h - np.clip(h, middle - c, middle + c))


@effect(on="channel", kind="observation", name="sensor rectification", lower=0, upper=1,
        requires="additive", afresh=0.9)  # fmt: skip
def sensor_rectification(h, strength):
    """l (|h| - h): 1/2 cuts what is below 0 off, 1 folds it up"""
    return strength * (np.abs(h) - h)


@effect(on="channel", kind="state", name="sensor lag", lower=0, upper=2, states=("sensed",),
        shapes={"k": numbers(2, 5, between=(1.0, 30.0)), "start": firsts(1.0)})  # fmt: skip
def sensor_lag(h, sensed, strength, k, start):
    """l (s - h), s following h with the time constant of k rows"""
    return Auxiliary(strength * (sensed - h), {"sensed": Dirac(sensed + (h - sensed) / k)},
                     {"sensed": Dirac(start)})  # fmt: skip


@effect(on="channel", kind="state", name="sensor delay", lower=0, upper=MOST_STRENGTH,
        states={"earlier": "delay"},
        shapes={"delay": numbers(1, 3), "start": firsts(1.0)})  # fmt: skip
def sensor_delay(h, earlier, strength, delay, start):
    """l (h_{t - delay} - h_t)"""
    newest_first = np.stack([h, *earlier[:-1]])
    return Auxiliary(strength * (earlier[-1] - h), {"earlier": Dirac(newest_first)},
                     {"earlier": Dirac(np.full(int(delay), start))})  # fmt: skip


@effect(on="channel", kind="observation", name="quantisation", lower=0, upper=MOST_STRENGTH,
        requires="additive", shapes={"d": sds(0.25, 0.5, 1.0)})  # fmt: skip
def quantisation(h, strength, d):
    """l (round(h / d) d - h)"""
    turn = 2.0 * math.pi / d  # without floor(), which would have no derivative in what moves h
    return -strength / turn * np.arctan2(np.sin(turn * h), np.cos(turn * h))


# -- noise laws, of states and channels
@effect(on="any", kind="tail", name="outliers", lower=0, upper=0.5)
def outliers(h, strength):
    """Student's t with 1 / df = l in place of the normal distribution"""
    return strength


@effect(on="any", kind="noise", name="heteroscedastic noise", form="with its own size",
        shapes={"s": sds(1.0)})  # fmt: skip
def noise_by_size(x, strength, s):
    """log variance + l |x| / s"""
    return strength * np.abs(x) / s


@effect(on="any", kind="noise", name="heteroscedastic noise", form="with another state",
        given={"other": "other state"}, shapes={"s": sds(1.0, of="other")})  # fmt: skip
def noise_by_state(x, other, strength, s):
    """log variance + l |x_j| / s"""
    return strength * np.abs(other) / s


@effect(on="any", kind="noise", name="heteroscedastic noise", form="with an input",
        given={"u": "any input"}, shapes={"s": sds(1.0, of="u")})  # fmt: skip
def noise_by_input(x, u, strength, s):
    """log variance + l |u| / s"""
    return strength * np.abs(u) / s


@effect(on="channel", kind="state", name="coloured noise", lower=0, states=("colour",),
        constant="sensor bias", process="ar1",
        shapes={"memory": numbers(0.5, 0.9, between=(0.05, 0.99))})  # fmt: skip
def coloured_noise(h, colour, strength, memory):
    """l w, w an autoregression of standard deviation 1"""
    noise = np.sqrt(1.0 - memory**2)
    return Auxiliary(strength * colour, {"colour": Normal(memory * colour, sd=noise)},
                     {"colour": Normal(0, sd=1.0)})  # fmt: skip


# -- the start
@effect(on="any", kind="initial", name="wrong initial state")
def wrong_initial_state(x, strength):
    """x_1 + l"""
    return strength


EFFECTS = declared(globals())
