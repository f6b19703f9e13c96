"""Laws inside of laws: whether they exist, and their density where the outer law has one."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.language.continuous import Normal, _where
from ssmppl.language.distribution import INFINITY, Distribution


def holding(conditions: Iterable[ExprArray | None]) -> ExprArray | None:
    """Whether all hold of which there is something to ask."""
    found: ExprArray | None = None
    for condition in conditions:
        if condition is not None:
            found = condition if found is None else array(ew("and", found, condition))
    return found


def exists(law: Distribution) -> ExprArray | None:
    """Whether a law's parameters are in range and its support is not empty; None where nothing
    has to be asked. Alone such a law has no density, beside another it would pass unseen."""
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
    """A law's log density, -inf outside of its support: computed there at a value inside, so that
    neither it nor a derivative of it is NaN."""
    support = law.support()
    lower, upper = array(support.lower), array(support.upper)
    low_end, high_end = (all(e.op == "const" and math.isinf(e.data) for e in b.ravel())
                         for b in (lower, upper))  # fmt: skip
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
    if law.discrete or high_end:
        middle = lower + (0.0 if law.discrete else 1.0)
    elif low_end:
        middle = upper - 1.0
    inside = law.log_densities(_where(within, value, middle))
    return _where(within, inside, -INFINITY)
