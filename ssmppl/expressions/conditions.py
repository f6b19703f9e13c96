"""What the conditions of expressions ask."""

from __future__ import annotations

from collections.abc import Iterable

from ssmppl.expressions.expr import Expr, topological

__all__ = ["affirmed", "conditions_of"]


def conditions_of(forms: Iterable[Expr]) -> list[Expr]:
    """What `where` asks, without the words between: comparisons, and numbers that are 0 or not."""
    found: dict[Expr, None] = {}
    waiting = [n.args[0] for n in topological(list(forms)) if n.op == "where"]
    while waiting:
        node = waiting.pop()
        if node.op in ("and", "or", "not"):
            waiting += node.args
        elif node.op != "const":
            found[node] = None
    return list(found)


def affirmed(condition: Expr) -> tuple[Expr, bool]:
    """(the condition that this one is, or is the opposite of; whether it is the opposite)."""
    if condition.op == "le":  # a <= b is not b < a
        return Expr("lt", condition.args[::-1]), True
    return (Expr("eq", condition.args), True) if condition.op == "ne" else (condition, False)
