"""What NumPy's functions mean on symbols.

NumPy hands every ufunc and array function that meets an `Expr` or an `ExprArray` to
`apply_ufunc` and `apply_function` below (NEP 13 and NEP 18). Functions that only move elements
run as NumPy has them; those that compute stand in the table `FUNCTIONS`; all others are refused
by name, with the nearest that exist.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ssmppl.errors import nearest_first
from ssmppl.expressions.arrays import (
    ExprArray,
    array,
    choose,
    clip,
    cumsum,
    dot,
    elementwise,
    matmul,
    mean,
    plain,
    reduced,
    refuse,
    scalar_or_array,
    trace,
    var,
)
from ssmppl.expressions.expr import TERNARY, UNARY, Expr, apply, as_expr
from ssmppl.expressions.linear import cholesky, det, inverse, norm, slogdet
from ssmppl.expressions.node import behaviour

# NumPy's and scipy.special's ufuncs by name: each an operation on the operands.
_RENAMED = {
    "negative": "neg", "absolute": "abs", "fabs": "abs", "subtract": "sub", "multiply": "mul",
    "divide": "div", "true_divide": "div", "power": "pow", "float_power": "pow",
    "remainder": "mod", "less": "lt", "less_equal": "le", "equal": "eq", "not_equal": "ne",
    "logical_and": "and", "logical_or": "or", "logical_not": "not", "bitwise_and": "and",
    "bitwise_or": "or", "invert": "not", "psi": "digamma", "fmax": "maximum", "fmin": "minimum",
}  # fmt: skip
_COMPOSED: dict[str, Callable[..., Any]] = {
    "greater": lambda a, b: apply("lt", b, a),
    "greater_equal": lambda a, b: apply("le", b, a),
    "square": lambda a: a**2,
    "reciprocal": lambda a: 1.0 / a,
    "cbrt": lambda a: apply("sign", a) * abs(a) ** (1.0 / 3.0),
    "exp2": lambda a: 2.0**a,
    "log2": lambda a: apply("log", a) / np.log(2.0),
    "log10": lambda a: apply("log", a) / np.log(10.0),
    "expit": lambda a: 1.0 / (1.0 + apply("exp", -a)),
    "logit": lambda a: apply("log", a) - apply("log1p", -a),
    "xlogy": lambda a, b: apply("where", apply("eq", a, 0.0), 0.0, a * apply("log", b)),
    "xlog1py": lambda a, b: apply("where", apply("eq", a, 0.0), 0.0, a * apply("log1p", b)),
    "hypot": lambda a, b: apply("sqrt", a**2 + b**2),
    "floor_divide": lambda a, b: apply("floor", a / b),
    "deg2rad": lambda a: a * (np.pi / 180.0),
    "radians": lambda a: a * (np.pi / 180.0),
    "rad2deg": lambda a: a * (180.0 / np.pi),
    "degrees": lambda a: a * (180.0 / np.pi),
    "heaviside": lambda a, b: apply("where", apply("eq", a, 0.0), b, apply("lt", 0.0, a)),
    "isnan": lambda a: apply("ne", a, a),
    "positive": lambda a: a,
    "conjugate": lambda a: a,
}
_DIRECT = {n for n in [*UNARY, *TERNARY] if n not in ("neg", "not", "abs", "where")} | {
    "add", "maximum", "minimum", "arctan2", "logaddexp", "gammainc", "gammaincc", "gammaincinv",
    "gammainccinv",
}  # fmt: skip


def apply_ufunc(ufunc: np.ufunc, method: str, inputs: tuple, kwargs: dict) -> Any:
    """A NumPy ufunc on symbols: called, reduced (np.add.reduce) or as an outer product."""
    name = ufunc.__name__
    if any(v is not None for k, v in kwargs.items() if k in ("out", "where")):
        refuse(f"np.{name} with out= or where=, and assignment in place on an array of numbers",
                "write the new array as an expression, a + b instead of a += b")  # fmt: skip
    if name == "matmul" and method == "__call__":
        return matmul(*inputs)
    if method == "reduce" and name in ("add", "multiply", "maximum", "minimum"):
        return reduced(_RENAMED.get(name, name), inputs[0], kwargs.get("axis", 0))
    if method == "accumulate" and name == "add":
        return cumsum(inputs[0], kwargs.get("axis", 0))
    if method == "outer":
        a, b = (plain(i) for i in inputs)
        inputs = (a.reshape(a.shape + (1,) * b.ndim), b)
    elif method != "__call__":
        refuse(f"np.{name}.{method}", "write it out")
    if name in _COMPOSED:
        arrays = np.broadcast_arrays(*(plain(i) for i in inputs))
        out = np.empty(arrays[0].shape, dtype=object)
        for index in np.ndindex(out.shape):
            out[index] = _COMPOSED[name](*(as_expr(a[index]) for a in arrays))
        return scalar_or_array(out)
    op = _RENAMED.get(name, name if name in _DIRECT else None)
    if op is None:
        known = {*_RENAMED, *_COMPOSED, *_DIRECT}
        refuse(f"the function {name}", f"supported are {', '.join(nearest_first(name, known))}")
    return elementwise(op, *inputs)


behaviour["ufunc"] = apply_ufunc


def _where(condition: Any, *branches: Any) -> Any:
    if len(branches) != 2:
        refuse("np.where with a condition only", "give both branches: np.where(c, a, b)")
    return elementwise("where", condition, *branches)


def _take(a: Any, index: Any, axis: int | None = None, **unused: Any) -> Any:
    if isinstance(index, Expr):
        return choose(index, np.ravel(plain(a)) if axis is None else np.moveaxis(plain(a), axis, 0))
    return scalar_or_array(np.take(plain(a), np.asarray(index, dtype=int), axis))


def _copyto(target: Any, source: Any, **kwargs: Any) -> None:
    if np.asarray(target).dtype != object:  # np.full(shape, symbol) comes with an object array
        refuse("copying symbols into an array of numbers", "build the array by np.stack([...])")
    np.copyto(np.asarray(target).view(np.ndarray), plain(source))


def _like(value: float) -> Callable[..., Any]:
    return lambda a, *unused, **unused_too: scalar_or_array(np.full(plain(a).shape, value))


FUNCTIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    np.where: _where,
    np.sum: lambda a, axis=None, **kw: reduced("add", a, axis, **kw),
    np.prod: lambda a, axis=None, **kw: reduced("mul", a, axis, **kw),
    np.max: lambda a, axis=None, **kw: reduced("maximum", a, axis, **kw),
    np.min: lambda a, axis=None, **kw: reduced("minimum", a, axis, **kw),
    np.mean: mean,
    np.var: var,
    np.std: lambda a, axis=None, **kw: elementwise("sqrt", var(a, axis, **kw)),
    np.cumsum: cumsum,
    np.dot: dot,
    np.vdot: dot,
    np.inner: lambda a, b: dot(a, plain(b).T),
    np.outer: lambda a, b: elementwise("mul", plain(a).reshape(-1, 1), plain(b).reshape(1, -1)),
    np.kron: lambda a, b: scalar_or_array(np.kron(plain(a), plain(b))),
    np.einsum: lambda spec, *ops, optimize=False: scalar_or_array(
        np.einsum(spec, *map(plain, ops))
    ),
    np.clip: clip,
    np.trace: trace,
    np.take: _take,
    np.choose: lambda index, choices, **kw: choose(index, choices),
    np.diff: lambda a, **kw: scalar_or_array(np.diff(plain(a), **kw)),
    np.copyto: _copyto,
    np.zeros_like: _like(0.0),
    np.ones_like: _like(1.0),
    np.full_like: lambda a, value, **kw: scalar_or_array(np.full(plain(a).shape, value)),
    np.shape: lambda a: plain(a).shape,
    np.ndim: lambda a: plain(a).ndim,
    np.size: lambda a: plain(a).size,
    np.linalg.inv: inverse,
    np.linalg.det: det,
    np.linalg.slogdet: slogdet,
    np.linalg.cholesky: cholesky,
    np.linalg.solve: lambda a, b: matmul(inverse(a), b),
    np.linalg.norm: norm,
}
# Functions that move elements and compute nothing run as NumPy has them, on object arrays.
STRUCTURAL = {
    np.concatenate, np.stack, np.hstack, np.vstack, np.column_stack, np.block, np.append,
    np.reshape, np.ravel, np.transpose, np.squeeze, np.expand_dims, np.moveaxis, np.swapaxes,
    np.tile, np.repeat, np.flip, np.roll, np.split, np.array_split, np.diag, np.diagonal,
    np.broadcast_to, np.atleast_1d, np.atleast_2d, np.copy, np.triu, np.tril, np.delete,
    np.diagflat, np.fliplr, np.flipud, np.insert,
}  # fmt: skip


def apply_function(func: Callable[..., Any], args: tuple, kwargs: dict) -> Any:
    """A NumPy array function on symbols."""
    if func in FUNCTIONS:
        return FUNCTIONS[func](*args, **kwargs)
    if func in STRUCTURAL:
        result = func(*_strip(args), **_strip(kwargs))
        return [array(r) for r in result] if isinstance(result, list) else scalar_or_array(result)
    known = {f.__name__ for f in [*FUNCTIONS, *STRUCTURAL]}
    name = func.__name__
    refuse(f"np.{name}", f"supported are {', '.join(nearest_first(name, known))}")


def _strip(value: Any) -> Any:
    """Arguments with every Expr and ExprArray turned to plain object arrays."""
    if isinstance(value, (Expr, ExprArray)):
        return plain(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_strip(v) for v in value)
    if isinstance(value, dict):
        return {k: _strip(v) for k, v in value.items()}
    return value


behaviour["function"] = apply_function
