"""Draws of a scalar family restricted to an interval, by inversion from the nearer tail."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.special as sp

from ssmppl.analysis.conjugacy.families import Beta, Gamma, Normal, root_of


# -- truncated laws of one number
def truncated_draw(
    family: Gamma | Normal | Beta,
    c: Sequence[float],
    low: float,
    high: float,
    rng: np.random.Generator,
) -> float | None:
    """A draw restricted to (low, high); None where the law is improper or has no mass there."""
    if isinstance(family, Normal):
        h, precision = c[family.linear[0]], -2.0 * c[family.quadratic[0][0]]
        if not precision > 0.0:
            return None
        sd = 1.0 / math.sqrt(precision)
        return _truncated_normal(h / precision, sd, low, high, rng)
    if isinstance(family, Beta):
        a, b = family.parameters(c)
        if not (a > 0.0 and b > 0.0):
            return None
        value = _between(
            lambda x: sp.betainc(a, b, x), lambda x: sp.betaincc(a, b, x),
            lambda p: sp.betaincinv(a, b, p), lambda p: sp.betainccinv(a, b, p),
            max(low, 0.0), min(high, 1.0), rng,
        )  # fmt: skip
        return value
    shape, rate = family.parameters(c)
    if not (shape > 0.0 and rate > 0.0):
        return None
    k = family.power
    if low <= 0.0 and high == math.inf:
        g: float | None = rng.standard_gamma(shape) / rate
    else:
        first, last = sorted((_to_power(max(low, 0.0), k), _to_power(high, k)))
        g = _between(
            lambda x: sp.gammainc(shape, rate * x), lambda x: sp.gammaincc(shape, rate * x),
            lambda p: sp.gammaincinv(shape, p) / rate, lambda p: sp.gammainccinv(shape, p) / rate,
            first, last, rng,
        )  # fmt: skip
    if g is None or not 0.0 < g < math.inf:
        return None
    value = root_of(g, k)
    return value if 0.0 < value < math.inf else None


def _to_power(x: float, k: float) -> float:
    if x == 0.0:
        return 0.0 if k > 0 else math.inf
    return x**k if x < math.inf else (math.inf if k > 0 else 0.0)


def _between(
    cdf: Callable[[float], float],
    survival: Callable[[float], float],
    quantile: Callable[[float], float],
    survival_quantile: Callable[[float], float],
    low: float,
    high: float,
    rng: np.random.Generator,
) -> float | None:
    """Inversion in whichever tail keeps the digits; None where the mass underflows."""
    below, above = float(cdf(low)), float(cdf(high))
    if below > 0.5:
        below, above = float(survival(high)), float(survival(low))
        quantile = survival_quantile
    if not above - below > 1e-280:
        return None
    x = float(quantile(below + rng.random() * (above - below)))
    return min(max(x, low), high)


def _truncated_normal(
    mean: float, sd: float, low: float, high: float, rng: np.random.Generator
) -> float | None:
    for _ in range(4):  # nearly always inside on the first try
        x = mean + sd * rng.standard_normal()
        if low <= x <= high:
            return x
    a, b = (low - mean) / sd, (high - mean) / sd
    flip = a > 0.0
    if flip:
        a, b = -b, -a
    log_a, log_b = float(sp.log_ndtr(a)), float(sp.log_ndtr(b))
    if not log_b > log_a:
        return None
    u = rng.random()
    # log(Phi(a) + u (Phi(b) - Phi(a)))
    log_p = log_b + math.log(max(u - (u - 1.0) * math.exp(log_a - log_b), 1e-320))
    z = float(sp.ndtri_exp(log_p))
    x = mean + sd * (-z if flip else z)
    return min(max(x, low), high) if math.isfinite(x) else None
