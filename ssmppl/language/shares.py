"""Shares of 1: the probabilities of Categorical and the weights of Mixture.

Numbers that do not sum to 1 are refused where the law is made, expressions have to where they have
values.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew

SUM_ROUNDING = 1e-6  # by which shares that are expressions may miss the sum 1
NUMBERS_ROUNDING = 1e-8  # and such as are numbers


def _sums(shares: Iterable[Any]) -> ExprArray:
    first, *others = shares
    for share in others:
        first = first + share
    return array(first)


def wrong_sum(shares: Iterable[Any]) -> float | None:
    """A sum of numbers that is not 1; None where there is none."""
    known = [total.data for total in _sums(shares).ravel() if total.op == "const"]
    return next((total for total in known if abs(total - 1.0) > NUMBERS_ROUNDING), None)


def sum_holds(shares: Iterable[Any]) -> ExprArray | None:
    """Whether the shares sum to 1, element by element; None where they are numbers."""
    gap = array(_sums(shares) - 1.0)
    if all(e.op == "const" for e in gap.ravel()):
        return None
    return array(ew("le", ew("abs", gap), SUM_ROUNDING))
