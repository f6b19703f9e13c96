"""Effects on the way of an input into the system, and on parameters taken as constant.

Each function gives the input (or parameter) that acts in place of its first argument; l is the
strength. Backlash is the play operator of Krasnosel'skii and Pokrovskii (1989).
"""

from __future__ import annotations

import numpy as np

from ssmppl.diagnosis.effects.effect import (
    MOST_STRENGTH,
    Auxiliary,
    declared,
    effect,
    numbers,
    rows,
    sds,
    sizes,
)
from ssmppl.language.distributions import Dirac, Normal


# -- static nonlinearities
@effect(on="input", kind="input", name="input saturation", lower=0, upper=MOST_STRENGTH,
        shapes={"c": sizes(0.5, 0.75, 0.9, between=(0.1, 0.99))})  # fmt: skip
def input_saturation(u, strength, c):
    """u - l (u - clip(u, -c, c))"""
    return u - strength * (u - np.clip(u, -c, c))


@effect(on="input", kind="input", name="dead zone", lower=0, upper=MOST_STRENGTH,
        shapes={"c": sizes(0.1, 0.25, 0.5, between=(0.01, 0.9))})  # fmt: skip
def dead_zone(u, strength, c):
    """u - l clip(u, -c, c)"""
    return u - strength * np.clip(u, -c, c)


@effect(on="input", kind="input", name="input asymmetry", form="quadratic")
def quadratic_input(u, strength):
    """u + l u^2"""
    return u + strength * u**2


@effect(on="input", kind="input", name="input asymmetry", form="absolute")
def absolute_input(u, strength):
    """u + l |u|"""
    return u + strength * np.abs(u)


@effect(on="input", kind="input", name="input asymmetry", form="offset")
def input_offset(u, strength):
    """u + l"""
    return u + strength


# -- with memory
BEFORE = numbers(
    1.0, 0.0
)  # of the first value: an input that was held before the record, or was off


@effect(on="input", kind="state", name="backlash", lower=0, upper=2, states=("held",),
        shapes={"c": sds(0.25, 0.75, between=(0.125, 3.0))})  # fmt: skip
def backlash(u, held, strength, c):
    """u + l (w - u), w moved by u at the ends of a play of half width c"""
    follows = np.clip(held, u - c, u + c)
    return Auxiliary(u + strength * (follows - u), {"held": Dirac(follows)}, {"held": Dirac(u)})


@effect(on="input", kind="state", name="input delay", lower=0, upper=MOST_STRENGTH,
        states={"past": "delay"}, common=True,
        shapes={"delay": numbers(1, 2, 4), "before": BEFORE})  # fmt: skip
def input_delay(u, past, strength, delay, before):
    """u_t + l (u_{t - delay} - u_t), u before the record `before` times its first value"""
    newest_first = np.stack([u, *past[:-1]])
    return Auxiliary(u + strength * (past[-1] - u), {"past": Dirac(newest_first)},
                     {"past": Dirac(np.stack([before * u] * int(delay)))})  # fmt: skip


@effect(on="input", kind="state", name="actuator lag", lower=0, upper=2, states=("lagged",),
        shapes={"k": numbers(2, 5, 15, between=(1.0, 60.0)), "before": BEFORE},
        common=True)  # fmt: skip
def actuator_lag(u, lagged, strength, k, before):
    """u + l (w - u), w following u with the time constant of k rows, from `before` times the first
    u on"""
    follows = lagged + (u - lagged) / k
    return Auxiliary(u + strength * (follows - u), {"lagged": Dirac(follows)},
                     {"lagged": Dirac(before * u)})  # fmt: skip


# -- parameters: of positive ones the logarithm changes
DATES = rows(1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6)


@effect(on="positive parameter", kind="parameter", name="parameter drift", form="relative",
        constant="relative parameter shift", given={"w": "profile"}, profile="drift",
        shapes={"rows": rows(1.0)})  # fmt: skip
def relative_drift(p, w, strength):
    """p exp(l (t / T - 1/2))"""
    return p * np.exp(strength * w)


@effect(on="other parameter", kind="parameter", name="parameter drift",
        constant="parameter shift", given={"w": "profile"}, profile="drift",
        shapes={"rows": rows(1.0)})  # fmt: skip
def parameter_drift(p, w, strength):
    """p + l (t / T - 1/2)"""
    return p + strength * w


@effect(on="positive parameter", kind="parameter", name="parameter break", form="relative",
        constant="relative parameter shift", given={"w": "profile"}, profile="step",
        shapes={"date": DATES})  # fmt: skip
def relative_break(p, w, strength):
    """p exp(l) from the row `date` on"""
    return p * np.exp(strength * w)


@effect(on="other parameter", kind="parameter", name="parameter break",
        constant="parameter shift", given={"w": "profile"}, profile="step",
        shapes={"date": DATES})  # fmt: skip
def parameter_break(p, w, strength):
    """p + l from the row `date` on"""
    return p + strength * w


@effect(on="positive parameter", kind="state", name="parameter random walk", form="relative",
        constant="relative parameter shift", lower=0, states=("wander",),
        process="random walk")  # fmt: skip
def relative_walk(p, wander, strength):
    """p exp(l w), w a random walk with steps of standard deviation 1"""
    return Auxiliary(p * np.exp(strength * wander), {"wander": Normal(wander, sd=1.0)},
                     {"wander": Normal(0, sd=1.0)})  # fmt: skip


@effect(on="other parameter", kind="state", name="parameter random walk",
        constant="parameter shift", lower=0, states=("wander",),
        process="random walk")  # fmt: skip
def parameter_walk(p, wander, strength):
    """p + l w, w a random walk with steps of standard deviation 1"""
    return Auxiliary(p + strength * wander, {"wander": Normal(wander, sd=1.0)},
                     {"wander": Normal(0, sd=1.0)})  # fmt: skip


EFFECTS = declared(globals())
