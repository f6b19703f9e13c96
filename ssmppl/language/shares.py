"""Shares of 1: the probabilities of Categorical and the weights of Mixture.

Numbers that do not sum to 1 are refused where the law is made, expressions have to where they have
values. What is chosen by shares has the density `log_sum`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.signs import never_negative

SUM_ROUNDING = 1e-6  # by which shares that are expressions may miss the sum 1
NUMBERS_ROUNDING = 1e-8  # and such as are numbers
MOST = 700.0  # whose exponential is a number


def _sums(shares: Iterable[Any]) -> ExprArray:
    first, *others = shares
    for share in others:
        first = first + share
    return array(first)


def check_sum(shares: Iterable[Any], kind: str, sums: str, fix: str, where: Location) -> None:
    """Refuse numbers that do not sum to 1: the shares of a law of this kind.

    sums : the subject and its verb, as in "weights sum".
    """
    known = [total.data for total in _sums(shares).ravel() if total.op == "const"]
    for total in known:
        if abs(total - 1.0) > NUMBERS_ROUNDING:
            raise ModelError(f"{kind}: {sums} to {total:.9g}", fix=fix, where=where)


def sum_holds(shares: Iterable[Any]) -> ExprArray | None:
    """Whether the shares sum to 1, element by element; None where they are numbers."""
    gap = array(_sums(shares) - 1.0)
    if all(e.op == "const" for e in gap.ravel()):
        return None
    return array(ew("le", ew("abs", gap), SUM_ROUNDING))


def log_sum(shares: Iterable[ExprArray], parts: Iterable[ExprArray]) -> ExprArray:
    """log(sum of share * exp(part)), element by element; NaN where a share is below 0.

    Without logarithms of the shares, so that the slope in a share of 0 is a number too; in units of
    the largest part that has a share, so that no part is lost to underflow.
    """
    shares, parts = [*map(array, shares)], [*map(array, parts)]
    top: Any = -math.inf
    for share, part in zip(shares, parts, strict=True):
        top = ew("maximum", top, ew("where", ew("lt", 0.0, share), part, -math.inf))
    # a whole number of them: a constant to derivatives, which no unit changes
    unit = ew("where", ew("lt", ew("abs", top), math.inf), ew("floor", top), 0.0)
    total: Any = 0.0
    for share, part in zip(shares, parts, strict=True):
        most = ew("where", ew("lt", 0.0, share), math.inf, MOST)  # of 0 * inf there is no number
        total = total + none_below_zero(share) * ew("exp", ew("minimum", part - unit, most))
    return array(unit + ew("log", total))


def none_below_zero(share: ExprArray) -> ExprArray:
    """The shares; NaN where they are below 0."""
    if all(map(never_negative, share.ravel())):
        return share
    return array(ew("where", ew("le", 0.0, share), share, math.nan))
