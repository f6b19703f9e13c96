"""What the form of an expression says about its sign, whatever values its symbols have."""

from __future__ import annotations

from ssmppl.expressions.expr import Expr

_OF_ANY = {"exp", "abs", "sqrt"}  # none below 0, of whatever number
_OF_SUCH = {"add", "mul", "div", "maximum", "minimum"}  # of such numbers such a number


def never_negative(e: Expr) -> bool:
    """Whether an expression can have no value below 0; one that is no number may be NaN."""
    if e.op == "const":
        return bool(e.data >= 0.0)
    if e.op in _OF_ANY:
        return True
    if e.op == "maximum" and any(map(never_negative, e.args)):
        return True
    if e.op == "where":
        return all(map(never_negative, e.args[1:]))
    return e.op in _OF_SUCH and all(map(never_negative, e.args))


__all__ = ["never_negative"]
