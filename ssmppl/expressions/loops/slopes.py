"""Derivatives of loops, which are loops again: of the values and of their slopes together.

x' = f(x, a) has the slopes S' = J S + P da, with J and P the derivatives of f in x and in a
(forward sensitivities; Griewank and Walther 2008, chapter 3). The slopes in all symbols of one kind
(the states, the parameters) are moved by one loop: they share the values, and who asks for one of
them nearly always asks for the others too. Where these are more than the loop's arguments, it is
the slopes in the arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

from ssmppl.expressions.expr import Expr, constant, symbols_of
from ssmppl.expressions.loops.loop import closed, held, moving, parts

Differentiate = Callable[[Sequence[Expr], Expr], list[Expr]]


def loop_slopes(node: Expr, wanted: Expr, differentiate: Differentiate) -> list[Expr]:
    """Derivatives (n,) of a loop's values at the end in a node, a symbol most often."""
    if wanted.op != "symbol":
        return _slopes(node, (wanted,), differentiate)[0]
    kind = wanted.data[0]
    alike = [s for s in symbols_of(node.args) if s.data[0] == kind]
    place = {s: k for k, s in enumerate(sorted(alike, key=lambda s: (s.data[1], s.data[2])))}
    if wanted not in place:
        return [constant(0.0)] * node.data.states
    if len(place) <= sum(a.op != "const" for a in node.args[:-1]):
        return _slopes(node, tuple(place), differentiate)[place[wanted]]
    out = [constant(0.0)] * node.data.states
    for slopes, own in zip(_in_arguments(node, differentiate), node.args, strict=False):
        (moved,) = differentiate([own], wanted)
        out = [total + slope * moved for total, slope in zip(out, slopes, strict=True)]
    return out


def _slopes(node: Expr, wanted: tuple[Expr, ...], differentiate: Differentiate) -> list[list[Expr]]:
    """Slopes in each of these symbols."""
    first, fixed, _ = parts(node)
    begun = [tuple(differentiate(first, w)) for w in wanted]
    outer = [tuple(differentiate(fixed, w)) for w in wanted]
    return _moved(node, tuple(begun), tuple(outer), differentiate)


def _in_arguments(node: Expr, differentiate: Differentiate) -> list[list[Expr]]:
    """Slopes in each argument but the number of times: what does for any number of symbols."""
    n, m = node.data.states, node.data.fixed
    unit = [[constant(float(i == k)) for i in range(n + m)] for k in range(n + m)]
    begun, outer = [tuple(u[:n]) for u in unit], [tuple(u[n:]) for u in unit]
    return _moved(node, tuple(begun), tuple(outer), differentiate)


@lru_cache(maxsize=64)
def _moved(
    node: Expr, begun: tuple[tuple[Expr, ...], ...], outer: tuple[tuple[Expr, ...], ...],
    differentiate: Differentiate,
) -> list[list[Expr]]:  # fmt: skip
    """The slopes at the end in some directions (directions, n), from those of the values to begin
    with (directions, n) and of what stays (directions, m)."""
    first, fixed, times = parts(node)
    n, m, size = node.data.states, node.data.fixed, len(begun)
    update = list(node.data.update)
    in_state = [differentiate(update, moving(k)) for k in range(n)]
    in_held = [differentiate(update, held(j)) for j in range(m)]
    for d in range(size):
        for i in range(n):
            total = constant(0.0)
            for k in range(n):
                total = total + in_state[k][i] * moving(n * (d + 1) + k)
            for j in range(m):
                if outer[d][j] is not constant(0.0):
                    total = total + in_held[j][i] * held(m * (d + 1) + j)
            update.append(total)
    values = closed(
        node.data.name, [*first, *(e for column in begun for e in column)],
        [*fixed, *(e for column in outer for e in column)], update, times,
    )  # fmt: skip
    return [values[n * (d + 1) : n * (d + 2)] for d in range(size)]
