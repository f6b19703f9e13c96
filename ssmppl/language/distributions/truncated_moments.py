"""Moments of distributions between bounds, for those that have them in closed form.

Differences in such forms cancel in intervals that are narrow, or far out in a tail. Those are left
to series and to Gauss-Legendre quadrature of the density, scaled to the interval: the relative
error of a variance stays below some 1e-9 (of counts and of wide intervals, it is that of the
probabilities, times the square of the mean over the variance).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.language.distributions.base import LOG_2PI, Distribution, is_infinite, where

NODES = 20  # exact to 1e-10 where the density falls by e^-FALL
FALL = 30.0
# Likewise, of intervals that are narrow beside their distance from 0; see `moments_from_zero`.
NARROW, NARROW_NODES, NARROW_FALL = 0.1, 12, 10.0
FLAT = 40.0  # standard deviations, or widths of an exponential, beyond which nothing is left


def normal_moments(base: Any, lower: ExprArray, upper: ExprArray) -> tuple[ExprArray, ExprArray]:
    """Of a Normal distribution: by quadrature where the mode is outside or the interval narrow;
    else in closed form: Johnson, Kotz and Balakrishnan (1994), "Continuous univariate
    distributions", section 13.10.1, whose differences cancel there."""
    sd, centre = base.sd(), base.mean()
    a, b = ((bound - centre) / sd for bound in (lower, upper))
    width = where(ew("lt", lower, upper), (upper - lower) / sd, math.nan)

    # From the mode's side, d off the bound there: density exp(-start d - d^2 / 2), start >= 0
    # where the mode is outside.
    above = array(ew("le", b, 0.0))
    start = where(above, -b, a)
    outside = array(ew("maximum", start, 0.0))
    end = ew("minimum", width, 2.0 * FALL / (outside + ew("sqrt", outside**2 + 2.0 * FALL)))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    total = first = second = array(0.0)
    for node, weight in zip(0.5 * (1.0 + nodes), weights, strict=True):
        d = node * end
        mass = weight * array(ew("exp", -d * (start + 0.5 * d)))
        total, first, second = total + mass, first + node * mass, second + node**2 * mass
    share = first / total
    near = where(above, upper - sd * end * share, lower + sd * end * share)
    spread = end**2 * (second / total - share**2)

    # The mode inside.
    log_mass = base.log_mass(lower, upper)
    inside = ew("and", ew("lt", a, 0.0), ew("lt", 0.0, b))
    shift, loss = array(0.0), array(0.0)
    for bound, sign in ((lower, 1.0), (upper, -1.0)):
        if not is_infinite(bound):
            z = ew("minimum", FLAT, ew("maximum", -FLAT, (bound - centre) / sd))
            ratio = sign * array(ew("exp", -0.5 * z**2 - 0.5 * LOG_2PI - log_mass))
            shift, loss = shift + ratio, loss - z * ratio
    closed = ew("and", inside, ew("le", 1.0, width))
    mean = where(closed, centre + sd * shift, near)
    return mean, sd**2 * where(closed, 1.0 - loss - shift**2, spread)


def exponential_moments(
    base: Any, lower: ExprArray, upper: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """Of an Exponential distribution, without memory: those of one cut off at upper - lower, moved
    by lower.

    With h half of that, in units of the scale, they are 1 + h - h coth h and 1 - (h / sinh h)^2;
    where h is small, their series.
    """
    scale = base.mean()
    if is_infinite(upper):
        return lower + scale, array(scale**2 + 0.0 * lower)
    h = where(ew("lt", lower, upper), 0.5 * (upper - lower) / scale, math.nan)
    short, s = array(ew("lt", h, 0.1)), h**2
    cut = array(ew("minimum", h, FLAT))
    long_mean = 1.0 - 2.0 * cut / ew("expm1", 2.0 * cut)
    long_variance = 1.0 - (cut / ew("sinh", cut)) ** 2
    short_mean = h - s * (1 / 3 - s * (1 / 45 - s * (2 / 945 - s / 4725)))
    short_variance = s / 3 * (1.0 - s * (1 / 5 - s * (2 / 63 - s * (1 / 225 - s * (2 / 3465)))))
    mean = lower + scale * where(short, short_mean, long_mean)
    return mean, scale**2 * where(short, short_variance, long_variance)


def weighted_moments(
    base: Distribution, lower: ExprArray, upper: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """From the distributions with density x f(x) and x^2 f(x): `Distribution.weighted`."""
    if base.discrete:
        mean, second = _weighted(base, lower, upper)
        variance = array(ew("maximum", second - mean * (mean - 1.0), 0.0))
        return mean, variance * where(ew("eq", lower, upper), 0.0, 1.0)  # 0 of a single value
    return moments_from_zero(base, lower, upper)


def _weighted(
    base: Distribution, lower: ExprArray, upper: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """E[X] and E[X^2], of counts E[X (X - 1)]."""
    mass, moments = base.log_mass(lower, upper), []
    for power in (1, 2):
        weighted = base.weighted(power)
        assert weighted is not None
        factor, law = weighted
        if base.discrete:
            top = upper - float(power)
            share = ew("exp", law.log_mass(lower - float(power), top) - mass)
            share = where(ew("lt", top, 0.0), 0.0, share)
        else:
            share = array(ew("exp", law.log_mass(lower, upper) - mass))
        moments.append(factor * share)
    return moments[0], moments[1]


def moments_from_zero(
    base: Distribution, lower: ExprArray, upper: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """Of a distribution from 0 on: E[X^2] - E[X]^2, or by quadrature where that cancels, in an
    interval that is narrow beside its distance from 0 and has a density of like size throughout."""
    mean, second = _weighted(base, lower, upper)
    variance = second - mean**2
    known = [e.op == "const" and e.data <= 0.0 for e in lower.ravel()]
    if all(known) or is_infinite(upper):
        return mean, variance
    width = upper - lower
    nodes, weights = np.polynomial.legendre.leggauss(NARROW_NODES)
    nodes = 0.5 * (1.0 + nodes)
    logs = [array(base.log_densities(lower + node * width)) for node in nodes]
    top, low = logs[0], logs[0]
    for log in logs[1:]:
        top, low = array(ew("maximum", top, log)), array(ew("minimum", low, log))
    total = first = square = array(0.0)
    for node, weight, log in zip(nodes, weights, logs, strict=True):
        mass = weight * array(ew("exp", log - top))
        total, first, square = total + mass, first + node * mass, square + node**2 * mass
    share = first / total
    narrow = ew("and", ew("lt", 0.0, width), ew("lt", width, NARROW * lower))
    narrow = ew("and", narrow, ew("lt", top - low, NARROW_FALL))
    spread = width**2 * (square / total - share**2)
    return where(narrow, lower + width * share, mean), where(narrow, spread, variance)
