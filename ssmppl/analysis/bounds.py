"""Where a block may lie, and how large a function of it can get there.

`interval` is interval arithmetic (Moore, 1966) over an expression: it encloses the range, so a
finite upper end is a bound that rejection sampling may rely on. It need not be sharp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from ssmppl.expressions.expr import Expr, topological

Interval = tuple[float, float]
WHOLE: Interval = (-math.inf, math.inf)
LONGEST = 60  # times of a loop that are followed


def interval(expression: Expr, domain: Mapping[Expr, Interval]) -> Interval:
    """An enclosure of the values of `expression` where it is defined, symbols in `domain`."""
    return _intervals([expression], domain)[expression]


def _intervals(roots: Sequence[Expr], domain: Mapping[Expr, Interval]) -> dict[Expr, Interval]:
    done: dict[Expr, Interval] = {}
    ends: dict[Expr, list[Interval]] = {}
    for node in topological(roots):
        if node.op == "const":
            done[node] = (node.data, node.data)
        elif node.op == "symbol":
            done[node] = domain.get(node, WHOLE)
        elif node.op == "loop":
            done[node], ends[node] = WHOLE, _of_loop(node, [done[a] for a in node.args])
        elif node.op == "item" and node.args[0].op == "loop":
            done[node] = ends[node.args[0]][node.data[0]]
        elif node.op == "mul" and node.args[0] is node.args[1]:
            done[node] = _pow(done[node.args[0]], 2.0)
        elif node.op == "pow" and node.args[1].op == "const":
            done[node] = _pow(done[node.args[0]], node.args[1].data)
        elif node.op in _RULES:
            done[node] = _RULES[node.op](*(done[a] for a in node.args))
        else:
            done[node] = WHOLE
        if any(math.isnan(e) for e in done[node]):
            done[node] = WHOLE
    return done


def _of_loop(node: Expr, args: list[Interval]) -> list[Interval]:
    """Bounds of the numbers of a loop at its end, step by step; unknown for a long one."""
    loop = node.data
    x, held = args[: loop.states], dict(zip(loop.held, args[loop.states : -1], strict=True))
    least, most = args[-1]
    reached: list[Interval] = []
    for k in range(LONGEST + 1):
        if k >= least:
            reached = reached or x
            reached = [(min(a[0], b[0]), max(a[1], b[1])) for a, b in zip(reached, x, strict=True)]
        if k >= most:
            return reached
        found = _intervals(loop.update, held | dict(zip(loop.moving, x, strict=True)))
        x = [found[e] for e in loop.update]
    return [WHOLE] * loop.states


def _sum(a: float, b: float, otherwise: float) -> float:
    total = a + b
    return otherwise if math.isnan(total) else total


def _add(a: Interval, b: Interval) -> Interval:
    return _sum(a[0], b[0], -math.inf), _sum(a[1], b[1], math.inf)


def _neg(a: Interval) -> Interval:
    return -a[1], -a[0]


def _mul(a: Interval, b: Interval) -> Interval:
    ends = [0.0 if x == 0.0 or y == 0.0 else x * y for x in a for y in b]
    return min(ends), max(ends)


def _reciprocal(a: Interval) -> Interval:
    if a[0] < 0.0 < a[1]:
        return WHOLE
    if a[0] >= 0.0:
        low = 0.0 if a[1] == math.inf else 1.0 / a[1] if a[1] else math.inf
        return low, (math.inf if a[0] == 0.0 else 1.0 / a[0])
    return _neg(_reciprocal(_neg(a)))


def _pow(a: Interval, e: float) -> Interval:
    if e < 0:
        return _reciprocal(_pow(a, -e))
    if not e.is_integer():  # defined for positive numbers only
        a = (max(a[0], 0.0), max(a[1], 0.0))
        return _power(a[0], e), _power(a[1], e)
    ends = [_power(x, e) for x in a]
    if int(e) % 2:
        return ends[0], ends[1]
    return (0.0 if a[0] <= 0.0 <= a[1] else min(ends)), max(ends)


def _power(x: float, e: float) -> float:
    try:
        return math.pow(x, e)
    except OverflowError:
        return math.inf


def _monotone(function: Callable[[float], float], low: float = -math.inf) -> Callable:
    """A rising function defined above `low`."""

    def rule(a: Interval) -> Interval:
        out = []
        for x in a:
            if x <= low:
                out.append(_limit(function, low))
            else:
                out.append(_limit(function, x))
        return out[0], out[1]

    return rule


def _limit(function: Callable[[float], float], x: float) -> float:
    try:
        return function(x)
    except OverflowError:
        return math.inf
    except ValueError:  # the singularity at the lower end of the domain
        return -math.inf


_RULES: dict[str, Callable[..., Interval]] = {
    "add": _add,
    "sub": lambda a, b: _add(a, _neg(b)),
    "neg": _neg,
    "mul": _mul,
    "div": lambda a, b: _mul(a, _reciprocal(b)),
    "exp": _monotone(lambda x: 0.0 if x == -math.inf else math.exp(x)),
    "log": _monotone(lambda x: math.log(x) if x > 0 else -math.inf, 0.0),
    "log1p": _monotone(lambda x: math.log1p(x) if x > -1 else -math.inf, -1.0),
    "sqrt": _monotone(lambda x: math.sqrt(max(x, 0.0)), 0.0),
    "expm1": _monotone(lambda x: -1.0 if x == -math.inf else math.expm1(x)),
    "tanh": _monotone(math.tanh),
    "arctan": _monotone(math.atan),
    "log_ndtr": lambda a: (-math.inf, 0.0),
    "ndtr": lambda a: (0.0, 1.0),
    "sin": lambda a: (-1.0, 1.0),
    "cos": lambda a: (-1.0, 1.0),
    "abs": lambda a: (0.0 if a[0] <= 0 <= a[1] else min(map(abs, a)), max(map(abs, a))),
    "where": lambda c, a, b: (min(a[0], b[0]), max(a[1], b[1])),
    "minimum": lambda a, b: (min(a[0], b[0]), min(a[1], b[1])),
    "maximum": lambda a, b: (max(a[0], b[0]), max(a[1], b[1])),
}
