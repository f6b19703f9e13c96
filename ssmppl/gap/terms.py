"""Which parts of expressions belong to a parameter: the terms that an effect has added."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from ssmppl.expressions.expr import Expr, dependent, depends_on, topological

_ADDITIVE = ("add", "sub", "neg")


def terms_with(roots: Iterable[Expr], parameter: Expr) -> list[Expr]:
    """The largest parts of sums that hold the parameter."""
    out: list[Expr] = []
    stack = [r for r in roots if depends_on(r, [parameter])]
    while stack:
        node = stack.pop(0)
        if node.op in _ADDITIVE:
            stack += [a for a in node.args if depends_on(a, [parameter])]
        elif node.args and node not in out:
            out.append(node)
    return out


def parts_of(roots: Iterable[Expr], parameter: Expr, own: Callable[[str], bool]) -> list[Expr]:
    """The largest expressions that hold the parameter and else only quantities that are `own`."""
    order = topological(roots)
    inside = {n: n.op != "symbol" or n is parameter or own(n.data[1]) for n in order}
    for n in order:
        inside[n] &= all(inside[a] for a in n.args)
    holds = dependent(order, [parameter])
    used = {a for n in order if not inside[n] for a in n.args} | set(roots)
    return [n for n in order if n.args and n in holds and inside[n] and n in used]
