"""What distributions of distributions need: whether an inner distribution exists, its density where
the outer distribution has one, and shares of 1, which are the probabilities of Categorical and the
weights of Mixture.

Shares that are numbers and do not sum to 1 are refused where the distribution is made; expressions
have to where they have values. What is chosen by shares has the density `log_sum`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.properties import never_negative
from ssmppl.language.distributions.base import INFINITY, Distribution, is_infinite, where
from ssmppl.language.distributions.continuous import Normal

SUM_ROUNDING = 1e-6  # by which shares that are expressions may miss the sum 1
NUMBERS_ROUNDING = 1e-8  # and such as are numbers
MOST = 700.0  # whose exponential is a number


def holding(conditions: Iterable[ExprArray | None]) -> ExprArray | None:
    """Whether all hold of which there is something to ask."""
    found: ExprArray | None = None
    for condition in conditions:
        if condition is not None:
            found = condition if found is None else array(ew("and", found, condition))
    return found


def exists(law: Distribution) -> ExprArray | None:
    """Whether a distribution's parameters are in range and its support is not empty; None where
    nothing has to be asked. Alone such a distribution has no density, beside another it would pass
    unseen."""
    support = law.support()
    pairs = [array(b) for b in (support.lower, support.upper)]
    ordered = None
    if any(e.op != "const" for b in pairs for e in b.ravel()):
        ordered = array(ew("le" if law.discrete else "lt", *pairs))
    inner = getattr(law, "base", None)
    nested = exists(inner) if inner is not None else law.in_range()
    # a Normal law asks nothing of its own accord: its formulas see to it where it is alone
    own = Distribution.in_range(law) if inner is not None or isinstance(law, Normal) else None
    return holding([ordered, nested, own])


def cut(law: Distribution, value: ExprArray) -> ExprArray:
    """A distribution's log density, -inf outside of its support: computed there at a value inside,
    so that neither it nor a derivative of it is NaN."""
    support = law.support()
    lower, upper = array(support.lower), array(support.upper)
    low_end, high_end = is_infinite(lower), is_infinite(upper)
    closed = law.discrete or law.closed
    within = None
    if not low_end:
        within = array(ew("le" if closed else "lt", lower, value))
    if not high_end:
        below = array(ew("lt" if law.open_above else "le", value, upper))
        within = below if within is None else array(ew("and", within, below))
    if within is None:
        return array(law.log_densities(value))
    middle: Any = 0.5 * (lower + upper)
    if law.discrete:
        middle = upper if low_end else lower
    elif high_end:
        middle = lower + 1.0
    elif low_end:
        middle = upper - 1.0
    inside = law.log_densities(where(within, value, middle))
    return where(within, inside, -INFINITY)


def _sums(shares: Iterable[Any]) -> ExprArray:
    first, *others = shares
    for share in others:
        first = first + share
    return array(first)


def check_sum(shares: Iterable[Any], kind: str, sums: str, fix: str, where: Location) -> None:
    """Refuse numbers that do not sum to 1: the shares of a distribution of this kind.

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
