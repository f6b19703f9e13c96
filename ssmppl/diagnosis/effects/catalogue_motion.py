"""Effects in the transitions: friction, stiffness, losses, couplings, loads, disturbances.

Each function is the increment of the equation of its first argument; l is the strength, v a state
whose own motion it is (a velocity, a level, a temperature), x the state that integrates it or v
itself. The friction distributions as in Armstrong-Hélouvry, Dupont and Canudas de Wit (1994),
*Automatica* 30; hysteresis as in Bouc (1967) and Wen (1976), *J. Eng. Mech. Div.* 102.
"""

from __future__ import annotations

import numpy as np

from ssmppl.diagnosis.effects.effect import (
    Auxiliary,
    declared,
    effect,
    means,
    numbers,
    quantiles,
    rows,
    sds,
)
from ssmppl.language.distributions import Dirac, Normal

POSITION, OTHER, LOAD = {"x": "position"}, {"other": "other state"}, {"u": "any input"}
# What meets a stiff stop within a simulator's step is not seen beyond it: where it would come to
# counts. (In a written-out step that would make up for what Euler's method leaves out, too.)
AHEAD = {"x": "ahead"}


# -- friction
@effect(on="rate", name="coulomb friction", lower=0, requires="both signs",
        shapes={"v0": sds(0.05, 0.3, between=(0.025, 1.0))})  # fmt: skip
def coulomb_friction(v, strength, v0):
    """-l tanh(v / v0)"""
    return -strength * np.tanh(v / v0)


@effect(on="rate", name="coulomb friction", form="sticking", lower=0, requires="both signs",
        given={"new": "next"})  # fmt: skip
def sticking_friction(v, new, strength):
    """-clip(v', -l, l), v' the mean of the step without it: what is slower comes to rest"""
    return -np.clip(new, -strength, strength)


@effect(on="rate", name="stribeck", lower=0, requires="both signs",
        shapes={"v0": sds(0.05), "vs": sds(0.2, 0.6, between=(0.1, 2.0))})  # fmt: skip
def stribeck(v, strength, v0, vs):
    """-l exp(-(v / vs)^2) tanh(v / v0)"""
    return -strength * np.exp(-((v / vs) ** 2)) * np.tanh(v / v0)


@effect(on="rate", name="asymmetric friction", form="viscous")
def asymmetric_viscous_friction(v, strength):
    """-l |v|"""
    return -strength * np.abs(v)


@effect(on="rate", name="asymmetric friction", form="dry", requires="both signs",
        shapes={"v0": sds(0.1)})  # fmt: skip
def asymmetric_dry_friction(v, strength, v0):
    """-l |tanh(v / v0)|"""
    return -strength * np.abs(np.tanh(v / v0))


@effect(on="rate", name="load-dependent friction", lower=0, requires="both signs", given=LOAD,
        shapes={"v0": sds(0.1)})  # fmt: skip
def load_dependent_friction(v, u, strength, v0):
    """-l |u| tanh(v / v0)"""
    return -strength * np.abs(u) * np.tanh(v / v0)


@effect(on="rate", name="quadratic drag", lower=0)
def quadratic_drag(v, strength):
    """-l v |v|"""
    return -strength * v * np.abs(v)


# -- stiffness, damping, stops
@effect(on="rate", name="cubic stiffness", given=POSITION)
def cubic_stiffness(v, x, strength):
    """-l x^3"""
    return -strength * x**3


@effect(on="rate", name="quadratic stiffness", given=POSITION)
def quadratic_stiffness(v, x, strength):
    """-l x^2"""
    return -strength * x**2


@effect(on="rate", name="state-dependent damping", given={"x": "integral"})
def state_dependent_damping(v, x, strength):
    """-l x^2 v"""
    return -strength * x**2 * v


@effect(on="rate", name="hard stop", form="upper", lower=0, given=AHEAD,
        shapes={"h": quantiles(0.6, 0.8, 0.95, of="x", between=(0.5, 0.99))})  # fmt: skip
def upper_stop(v, x, strength, h):
    """-l max(x - h, 0)"""
    return -strength * np.maximum(x - h, 0.0)


@effect(on="rate", name="hard stop", form="lower", lower=0, given=AHEAD,
        shapes={"h": quantiles(0.4, 0.2, 0.05, of="x", between=(0.01, 0.5))})  # fmt: skip
def lower_stop(v, x, strength, h):
    """l max(h - x, 0)"""
    return strength * np.maximum(h - x, 0.0)


@effect(
    on="rate",
    name="hard stop",
    form="both ends",
    lower=0,
    given=AHEAD,
    shapes={"h": sds(1.0, 1.5, of="x", between=(0.3, 2.5)), "middle": means(1.0, of="x")},
)
def both_stops(v, x, strength, h, middle):
    """-l (x - clip(x, m - h, m + h)), m the middle of the range"""
    return -strength * (x - np.clip(x, middle - h, middle + h))


@effect(on="rate", name="hard stop", form="overflow into another state", lower=0, given=OTHER,
        shapes={"h": quantiles(0.9, between=(0.5, 0.99))})  # fmt: skip
def overflow(x, other, strength, h):
    """-l max(x - h, 0), and as much into the other state"""
    over = strength * np.maximum(x - h, 0.0)
    return {"x": -over, "other": over}


# -- couplings, losses
@effect(on="rate", name="cross-coupling", form="linear", given=OTHER)
def linear_coupling(x, other, strength):
    """l x_j"""
    return strength * other


@effect(on="rate", name="cross-coupling", form="product", given=OTHER)
def product_coupling(x, other, strength):
    """l x_i x_j"""
    return strength * x * other


@effect(on="rate", name="extra loss", requires="positive",
        shapes={"p": numbers(0.5, 2.0, 4.0, between=(0.25, 6.0)),
                "ambient": means(0.0, 1.0, between=(0.0, 1.5))})  # fmt: skip
def extra_loss(x, strength, p, ambient):
    """-l (x^p - xa^p), x above 0"""
    return -strength * (np.maximum(x, 0.0) ** p - ambient**p)


# -- loads, gravity, hysteresis, disturbances
@effect(on="state", name="constant load", note="l")
def constant_load(v, strength):
    """A constant load: the increment l."""
    return strength


@effect(on="rate", name="gravity", given={"x": "integral"})
def gravity(v, x, strength):
    """-l sin x, x an angle"""
    return -strength * np.sin(x)


@effect(on="rate", name="bouc-wen hysteresis", kind="state", lower=0,
        given={"x": "integral", "moved": "moved"},
        shapes={"d": sds(0.2, 1.0, of="x", between=(0.2, 4.0))},
        states=("hysteresis",))  # fmt: skip
def bouc_wen_hysteresis(v, x, moved, hysteresis, strength, d):
    """-l z, z following x over the distance d: dz = (dx - |dx| z / 2 - dx |z| / 2) / d"""
    slip = 0.5 * (np.abs(moved) * hysteresis + moved * np.abs(hysteresis))
    follows = np.clip(hysteresis + (moved - slip) / d, -1.0, 1.0)
    return Auxiliary(-strength * hysteresis, {"hysteresis": Dirac(follows)},
                     {"hysteresis": Dirac(0.0)})  # fmt: skip


@effect(on="state", name="missing input", form="random walk", kind="state", lower=0,
        constant="constant load", states=("load",), process="random walk")  # fmt: skip
def random_walk_load(v, load, strength):
    """l w, w a random walk with steps of standard deviation 1"""
    return Auxiliary(strength * load, {"load": Normal(load, sd=1.0)}, {"load": Normal(0, sd=1.0)})


@effect(on="state", name="missing input", form="ar1", kind="state", lower=0, states=("load",),
        constant="constant load",
        shapes={"memory": numbers(0.8, 0.97, between=(0.3, 0.995))}, process="ar1")  # fmt: skip
def ar1_load(v, load, strength, memory):
    """l w, w an autoregression of standard deviation 1"""
    noise = np.sqrt(1.0 - memory**2)
    return Auxiliary(strength * load, {"load": Normal(memory * load, sd=noise)},
                     {"load": Normal(0, sd=1.0)})  # fmt: skip


@effect(
    on="state",
    name="periodic forcing",
    given={"wave": "profile"},
    profile="wave",
    constant="constant load",
    shapes={"period": numbers(10.0), "phase": numbers(0.0)},  # all are tried: `profiles`
)
def periodic_forcing(v, wave, strength):
    """l cos(w t - phase)"""
    return strength * wave


@effect(on="state", name="level break", given={"pulse": "profile"}, profile="pulse",
        constant="constant load",
        shapes={"date": rows(1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6)})  # fmt: skip
def level_break(x, pulse, strength):
    """l in the one step that follows the row `date`: the state jumps"""
    return strength * pulse


@effect(on="any", name="coarse discretisation", lower=0, upper=2,
        given={"second_order": "second order"})  # fmt: skip
def coarse_discretisation(x, second_order, strength):
    """l F'F / 2: the second-order term of the step; 1 adds it whole"""
    return strength * second_order


EFFECTS = declared(globals())
