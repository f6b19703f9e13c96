"""Derivatives of loops, which are loops again: of the values and of their slopes together.

x' = f(x, a) has the slopes S' = J S + P da, with J and P the derivatives of f in x and in a
(forward sensitivities; Griewank and Walther 2008, chapter 3). The slopes in all symbols of one kind
(the states, the parameters) are moved by one loop: they share the values, and who asks for one of
them nearly always asks for the others too.
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
    together = tuple(sorted(alike, key=lambda s: (s.data[1], s.data[2])))
    place = {s: k for k, s in enumerate(together)}
    if wanted not in place:
        return [constant(0.0)] * node.data.states
    return _slopes(node, together, differentiate)[place[wanted]]


@lru_cache(maxsize=64)
def _slopes(node: Expr, wanted: tuple[Expr, ...], differentiate: Differentiate) -> list[list[Expr]]:
    first, fixed, times = parts(node)
    n, m, size = node.data.states, node.data.fixed, len(wanted)
    begun = [differentiate(first, w) for w in wanted]
    outer = [differentiate(fixed, w) for w in wanted]
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
