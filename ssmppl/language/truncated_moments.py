"""Moments of truncated laws that have them in closed form."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.language.continuous import LOG_2PI, Normal, _where
from ssmppl.language.positive import Exponential


def is_infinite(bound: Any) -> bool:
    """Whether a bound bounds nothing."""
    return all(e.op == "const" and math.isinf(e.data) for e in array(bound).ravel())


def normal_moments(base: Normal, lower: ExprArray, upper: ExprArray) -> tuple[ExprArray, ExprArray]:
    """Johnson, Kotz and Balakrishnan (1994), section 13.10.1, with ratios taken of logs."""
    sd, mass = base.sd(), base.log_mass(lower, upper)
    a, b = ((bound - base.mean()) / sd for bound in (lower, upper))

    def ratio(z: ExprArray) -> ExprArray:
        return array(ew("exp", -0.5 * z**2 - 0.5 * LOG_2PI - mass))

    first = second = array(0.0)
    if not is_infinite(lower):
        first, second = first + ratio(a), second + a * ratio(a)
    if not is_infinite(upper):
        first, second = first - ratio(b), second - b * ratio(b)
    mean, variance = first, 1.0 + second - first**2
    if not is_infinite(lower) and not is_infinite(upper):
        # Narrow, where the differences above cancel: Gauss-Legendre over the interval.
        width, middle = array(b - a), array(0.5 * (a + b))
        steepness = width * array(ew("maximum", 1.0, ew("abs", middle)))
        nodes, weights = np.polynomial.legendre.leggauss(12)
        total = first_sum = second_sum = array(0.0)
        for node, weight in zip(nodes, weights, strict=True):
            d = 0.5 * width * node
            mass_at = weight * array(ew("exp", -d * (middle + 0.5 * d)))
            total = total + mass_at
            first_sum = first_sum + mass_at * node
            second_sum = second_sum + mass_at * node**2
        offset = first_sum / total
        spread = (0.5 * width) ** 2 * (second_sum / total - offset**2)
        offset = 0.5 * width * offset
        narrow = array(ew("lt", steepness, 1.0))
        mean = _where(narrow, middle + offset, mean)
        variance = _where(narrow, spread, variance)
    return base.mean() + sd * mean, sd**2 * variance


def exponential_moments(
    base: Exponential, lower: ExprArray, upper: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """Without memory: those of an exponential cut off at upper - lower, moved by lower."""
    scale = base.mean()
    if is_infinite(upper):
        return lower + scale, array(scale**2 + 0.0 * lower)
    width = (upper - lower) / scale
    lost = width / ew("expm1", width)
    variance = 1.0 - lost**2 * array(ew("exp", width))
    return lower + scale * (1.0 - lost), scale**2 * variance
