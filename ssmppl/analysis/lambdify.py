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

from ssmppl.expressions.evaluate import MEANING, evaluate
from ssmppl.expressions.expr import MATRIX_OPS, Expr, topological

DOMAIN = (ValueError, ZeroDivisionError, OverflowError)
Function = Callable[[Sequence[float]], Any]

_SAME_NAME = [
    "exp", "log", "log1p", "expm1", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "erf",
    "erfc",
]  # fmt: skip
_TEXT = {
    "neg": "(-{0})", "not": "(not {0})", "add": "({0} + {1})", "sub": "({0} - {1})",
    "mul": "({0} * {1})", "div": "({0} / {1})", "pow": "math.pow({0}, {1})", "mod": "({0} % {1})",
    "lt": "({0} < {1})", "le": "({0} <= {1})", "eq": "({0} == {1})", "ne": "({0} != {1})",
    "and": "({0} and {1})", "or": "({0} or {1})", "where": "({1} if {0} else {2})",
    "abs": "abs({0})", "logaddexp": "logaddexp({0}, {1})",
    # max(1.0, nan) is 1.0 in Python, and nan in NumPy
    "maximum": "({0} if {0} >= {1} or {0} != {0} else {1})",
    "minimum": "({0} if {0} <= {1} or {0} != {0} else {1})",
    "gammaln": "math.lgamma({0})", "arcsin": "math.asin({0})", "arccos": "math.acos({0})",
    "arctan": "math.atan({0})", "arcsinh": "math.asinh({0})", "arccosh": "math.acosh({0})",
    "arctanh": "math.atanh({0})", "arctan2": "math.atan2({0}, {1})",
    **{n: f"math.{n}({{0}})" for n in _SAME_NAME},
}  # fmt: skip
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
        text = _spelled(node, [done[a] for a in node.args])
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


def _spelled(node: Expr, parts: list[str]) -> str:
    """The text of one operation on the texts of its operands, which are short."""
    if node.op == "const":
        return f"({node.data!r})" if math.isfinite(node.data) else f"float('{node.data}')"
    if node.op == "symbol":
        raise KeyError(f"no value given for {node!r}")
    if node.op in MATRIX_OPS:
        return f"matrix_{node.op}({node.data}, ({', '.join(parts)},))"
    if node.op == "item":
        return f"{parts[0]}[{node.data[0]}, {node.data[1]}]"
    if node.op == "call":
        return f"calls[{id(node.data)}]({', '.join(parts)})"
    if node.op == "pow" and node.args[1].op == "const" and node.args[1].data == 2.0:
        return f"({parts[0]}*{parts[0]})"
    if node.op in _TEXT:
        return _TEXT[node.op].format(*parts)
    return f"float(meaning[{node.op!r}]({', '.join(parts)}))"


def _logaddexp(a: float, b: float) -> float:
    """NumPy's, which warns of infinite numbers."""
    if a == b:
        return a + math.log(2.0)
    low, high = (a, b) if a < b else (b, a)
    return high + math.log1p(math.exp(low - high))


def _matrix(function: Callable[..., Any]) -> Callable[[int, tuple[float, ...]], Any]:
    def run(n: int, entries: tuple[float, ...]) -> Any:
        try:
            return function(np.array(entries).reshape(n, n))
        except np.linalg.LinAlgError as error:
            raise ValueError(str(error)) from None

    return run


def _names(expressions: Sequence[Expr]) -> dict[str, Any]:
    """What the texts refer to."""
    return {
        "math": math,
        "once": _once,
        "logaddexp": _logaddexp,
        "DOMAIN": DOMAIN,
        "meaning": MEANING,
        "calls": {id(n.data): n.data for n in topological(expressions) if n.op == "call"},
        "matrix_cholesky": _matrix(np.linalg.cholesky),
        "matrix_inverse": _matrix(np.linalg.inv),
        "matrix_det": _matrix(lambda m: float(np.linalg.det(m))),
        "matrix_logdet": _matrix(lambda m: float(np.linalg.slogdet(m)[1])),
    }
