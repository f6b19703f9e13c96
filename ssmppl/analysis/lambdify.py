"""Expr -> plain Python function of a list of numbers, by way of its text.

For what is evaluated once a draw, on scalars, outside the compiled kernels: correction factors,
bounds that depend on other parameters, slice densities. The interpreter defines the meaning:
where `math` raises (1/0, exp(800), log(0), a root of -1: inf, or nan, in NumPy) the interpreter is
asked, as there are conditions and quotients that make a number of it again: 1/(1 + inf) = 0. What
raises an error of `DOMAIN` all the same is a function of the user's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ssmppl.expressions.batched.call import computed
from ssmppl.expressions.evaluate import MEANING, evaluate
from ssmppl.expressions.expr import MATRIX_OPS, Expr, topological
from ssmppl.expressions.loops.loop import Loop
from ssmppl.expressions.operations import (
    MATRICES,
    OPERATIONS,
    Level,
    Operation,
    Phrase,
    call,
    within,
)

DOMAIN = (ValueError, ZeroDivisionError, OverflowError)
Function = Callable[[Sequence[float]], Any]


def _phrase(o: Operation) -> Phrase:
    """By Python's signs and functions, else by the interpreter."""
    if isinstance(o.plain, Phrase):
        return o.plain
    if o.plain:
        return call(o.plain, o.operands)
    asked = call(f"meaning[{o.name!r}]", o.operands)
    return o.written or asked._replace(template=f"float({asked.template})")


_PHRASES = {n: _phrase(o) for n, o in OPERATIONS.items()}
_NEVER_RAISE = {"add", "sub", "mul", "neg", "not", "and", "or", "lt", "le", "eq", "ne", "where",
                "abs", "maximum", "minimum", "logaddexp"}  # fmt: skip


def python_function(expressions: Sequence[Expr], arguments: Sequence[Expr]) -> Function:
    """A function of the arguments' values (in one sequence `v`) giving a tuple of values."""
    return _function(
        "v", expressions, arguments, lambda parts: f"({''.join(f'{p}, ' for p in parts)})"
    )


def python_sum(
    functions: Sequence[Expr], arguments: Sequence[Expr]
) -> Callable[[Sequence[float], Sequence[float]], float]:
    """(v, c) -> sum_i c_i functions_i(v)."""
    return _function(
        "v, c", functions, arguments,
        lambda parts: " + ".join(f"c[{i}]*{p}" for i, p in enumerate(parts)) or "0.0",
    )  # fmt: skip


def _function(
    signature: str, expressions: Sequence[Expr], arguments: Sequence[Expr],
    result: Callable[[list[str]], str],
) -> Callable[..., Any]:  # fmt: skip
    """Statement by statement, each shared subexpression computed once.

    What one case of a condition needs, and could raise, is computed where it is asked for: sqrt(b)
    of `where(b > 0, sqrt(b), b)`. result : the text of the result, from those of the values.
    """
    done = {a: f"v[{i}]" for i, a in enumerate(arguments)}
    lines = [f"def run({signature}):", "  try:"]
    always = _always(expressions)
    later: set[Expr] = set()
    for node in topological(expressions):
        if node in done:
            continue
        text = _written(node, [done[a] for a in node.args])
        if node.op == "const":
            done[node] = text
            continue
        name = f"a{len(lines)}"
        waits = node.op not in _NEVER_RAISE or not later.isdisjoint(node.args)
        if waits and node not in always:
            later.add(node)
            lines.append(f"    {name} = once(lambda: {text})")
            done[node] = f"{name}()"
        else:
            lines.append(f"    {name} = {text}")
            done[node] = name
    lines.append(f"    return {result([done[e] for e in expressions])}")
    lines += ["  except DOMAIN:", "    w = meant(v)"]
    lines.append(f"    return {result([f'w[{i}]' for i in range(len(expressions))])}")
    names = _names(expressions)
    names["meant"] = partial(_meant, expressions, arguments)
    exec("\n".join(lines), names)
    run: Callable[..., Any] = names["run"]
    return run


def _meant(
    expressions: Sequence[Expr], arguments: Sequence[Expr], v: Sequence[float]
) -> list[float]:
    """The values by the interpreter."""
    known = dict(zip(arguments, v, strict=True))
    return [float(value) for value in evaluate(list(expressions), known)]


def _always(expressions: Sequence[Expr]) -> set[Expr]:
    """The nodes whose values are needed whatever conditions hold."""
    found: set[Expr] = set()
    waiting = list(expressions)
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.add(node)
            waiting += node.args[:1] if node.op in ("where", "and", "or") else node.args
    return found


def _once(function: Callable[[], Any]) -> Callable[[], Any]:
    """The function's value, computed when it is first asked for."""
    kept: list[Any] = []

    def value() -> Any:
        if not kept:
            kept.append(function())
        return kept[0]

    return value


def _written(node: Expr, parts: list[str]) -> str:
    """The text of one operation on the texts of its operands, which are short."""
    if node.op == "const":
        return f"({node.data!r})" if math.isfinite(node.data) else f"float('{node.data}')"
    if node.op == "symbol":
        raise KeyError(f"no value given for {node!r}")
    if node.op in MATRIX_OPS:
        return f"matrix_{node.op}({node.data}, ({', '.join(parts)},))"
    if node.op == "item":
        return f"{parts[0]}[{', '.join(map(str, node.data))}]"
    if node.op == "loop":
        return f"loops[{id(node.data)}]({', '.join(parts)})"
    if node.op == "simulator":
        return f"simulators[{id(node.data.function)}]({node.data.index}, ({', '.join(parts)},))"
    if node.op == "call":
        return f"calls[{id(node.data)}]({', '.join(parts)})"
    if node.op == "pow" and node.args[1].op == "const" and node.args[1].data == 2.0:
        return f"({parts[0]}*{parts[0]})"
    return within(_PHRASES[node.op].of([(p, Level.ATOM) for p in parts]), Level.ATOM)


def _logaddexp(a: float, b: float) -> float:
    """NumPy's, which warns of infinite numbers."""
    if a == b:
        return a + math.log(2.0)
    low, high = (a, b) if a < b else (b, a)
    return high + math.log1p(math.exp(low - high))


def _matrix(function: Callable[..., Any]) -> Callable[[int, tuple[float, ...]], Any]:
    def run(n: int, entries: tuple[float, ...]) -> Any:
        try:
            found = function(np.array(entries).reshape(n, n))
        except np.linalg.LinAlgError as error:
            raise ValueError(str(error)) from None
        return found if found.ndim else float(found)

    return run


def _loop(loop: Loop) -> Callable[..., tuple[float, ...]]:
    once = python_function(loop.update, (*loop.moving, *loop.held))

    def run(*args: float) -> tuple[float, ...]:
        x, held = tuple(args[: loop.states]), args[loop.states : -1]
        for _ in range(int(args[-1]) if args[-1] > 0.0 else 0):
            x = once((*x, *held))
        return x

    return run


def _simulator(function: Any) -> Callable[..., np.ndarray]:
    def run(index: tuple[int, ...], args: tuple[float, ...]) -> np.ndarray:
        return computed(function, (index,), np.array([args], dtype=float))[0, :, 0]

    return run


def _names(expressions: Sequence[Expr]) -> dict[str, Any]:
    """What the texts refer to."""
    return {
        "math": math,
        "once": _once,
        "logaddexp": _logaddexp,
        "DOMAIN": DOMAIN,
        "meaning": MEANING,
        "loops": {id(n.data): _loop(n.data) for n in topological(expressions) if n.op == "loop"},
        "simulators": {
            id(n.data.function): _simulator(n.data.function)
            for n in topological(expressions)
            if n.op == "simulator"
        },
        "calls": {id(n.data): n.data for n in topological(expressions) if n.op == "call"},
        **{f"matrix_{op}": _matrix(function) for op, (_, function) in MATRICES.items()},
    }
