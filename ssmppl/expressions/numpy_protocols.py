"""What NumPy's functions mean on symbols.

NumPy hands every ufunc and array function that meets an `Expr` or an `ExprArray` to
`apply_ufunc` and `apply_function` below (NEP 13 and NEP 18). Functions that only move elements
run as NumPy has them; those that compute stand in the table `FUNCTIONS`; all others are refused
by name, with what `UNSUPPORTED` says to write for them, or the nearest that exist.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Iterable
from functools import cache, partial
from inspect import signature
from typing import Any

import numpy as np

from ssmppl.expressions.arrays import (
    ExprArray,
    array,
    cholesky,
    choose,
    clip,
    cumsum,
    det,
    dot,
    elementwise,
    inner,
    inverse,
    matmul,
    mean,
    norm,
    plain,
    reduced,
    refuse,
    scalar_or_array,
    slogdet,
    trace,
    var,
    vdot,
)
from ssmppl.expressions.expr import Expr, apply, as_expr
from ssmppl.expressions.node import behaviour, conditions
from ssmppl.expressions.operations import OPERATIONS

SHOWN = 3
_ROUNDED = "np.floor(x + 0.5), which takes halves up, where NumPy takes them to even numbers"
_SORTED = "np.minimum and np.maximum of the elements"
_TABLE = "np.where(...) by pieces, or wrap the table by @ssm.primitive"
# by the names that NumPy, SciPy and their ufuncs have
UNSUPPORTED: dict[str, str] = {
    **dict.fromkeys(["round", "rint", "around"], _ROUNDED),
    **dict.fromkeys(["trunc", "fix"], "np.sign(x) * np.floor(np.abs(x))"),
    **dict.fromkeys(["select", "piecewise"], "np.where(condition, a, b), one inside another"),
    **dict.fromkeys(["interp", "interp1d", "searchsorted", "digitize"], _TABLE),
    **dict.fromkeys(["any", "logical_xor"], "conditions joined by |"),
    "all": "conditions joined by &",
    **dict.fromkeys(["sort", "median", "partition"], _SORTED),
    **dict.fromkeys(["argmax", "argmin"], "np.where(x[0] >= x[1], 0, 1), and so on"),
    "cumprod": "np.exp(np.cumsum(np.log(x))) of positive numbers, or the products one by one",
    "nan_to_num": "np.where(np.isnan(x), 0.0, x)",
    "sinc": "np.where(x == 0, 1.0, np.sin(np.pi * x) / (np.pi * x))",
    "gamma": "np.exp(scipy.special.gammaln(x)) of positive numbers",
    "erfcx": "2 * np.exp(x**2 + scipy.special.log_ndtr(-np.sqrt(2) * x))",
    "factorial": "np.exp(scipy.special.gammaln(x + 1))",
    "beta": "np.exp(scipy.special.betaln(a, b))",
    **dict.fromkeys(["comb", "binom"], "np.exp(gammaln(n + 1) - gammaln(k + 1) - "
                    "gammaln(n - k + 1)), with scipy.special.gammaln"),
    "poch": "np.exp(scipy.special.gammaln(x + m) - gammaln(x))",
    "logsumexp": "np.logaddexp(a, b), for more one inside another",
    "softmax": "np.exp(x) / np.sum(np.exp(x))",
    "log_softmax": "x - np.log(np.sum(np.exp(x)))",
    "log_expit": "-np.logaddexp(0, -x)",
    "cdf": "scipy.special.ndtr(z) for a normal distribution, gammainc and betainc for a gamma and "
    "a beta distribution",
    "logcdf": "scipy.special.log_ndtr(z) for a normal distribution",
    "sf": "scipy.special.ndtr(-z) for a normal distribution, gammaincc for a gamma distribution",
    "ppf": "scipy.special.ndtri(p) for a normal distribution",
    **dict.fromkeys(["pdf", "pmf"], "the formula of the density"),
    **dict.fromkeys(["logpdf", "logpmf"], "the formula of the log density"),
    **dict.fromkeys(["quad", "odeint", "solve_ivp"], "a fixed number of steps in a Python loop, "
                    "such as Euler's or Runge-Kutta's, or wrap it by @ssm.primitive"),
    "expm": "the solution in closed form, or some terms of its series",
    **dict.fromkeys(["eig", "eigh", "eigvals", "svd", "pinv", "lstsq"],
                    "np.linalg.inv, solve, det or cholesky, or the eigenvalues in closed form"),
}  # fmt: skip


def fix_for(name: str, known: Iterable[str]) -> str:
    """What to write for a function of this name: what is known to do, else those that are spelled
    nearly so."""
    if name in UNSUPPORTED:
        return f"write {UNSUPPORTED[name]}"
    if name in known:  # a namesake in another module, as in np.linalg
        return f"write np.{name}"
    near = ", ".join(difflib.get_close_matches(name, sorted(known), SHOWN))
    return (f"there are {near}; else " if near else "") + (
        "write the computation by functions that symbols have, or wrap it by @ssm.primitive"
    )


# NumPy's and scipy.special's ufuncs by name: each an operation on the operands.
_UFUNCS = {f.__name__: n for n, o in OPERATIONS.items() if isinstance(f := o.called, np.ufunc)} | {
    "fabs": "abs", "true_divide": "div", "float_power": "pow", "bitwise_and": "and",
    "bitwise_or": "or", "invert": "not", "digamma": "digamma",
}  # fmt: skip


def _floor_divide(a: Expr, b: Expr) -> Expr:
    """NumPy's: 1.0 // 0.1 is 9, as 0.1 is more than a tenth, though 1.0 / 0.1 is rounded to 10."""
    if b.op == "const" and b.data.is_integer() and b.data != 0.0:
        return apply("floor", a / b)
    whole = (a - a % b) / b  # but for rounding
    below = apply("floor", whole)
    return apply("where", apply("eq", b, 0.0), a / b, below + (whole - below > 0.5))


def _unless_nan(op: str) -> Callable[[Expr, Expr], Expr]:
    """`op` of two numbers; where one of them is nan, the other."""

    def run(a: Expr, b: Expr) -> Expr:
        return _if_nan(a, b, _if_nan(b, a, apply(op, a, b)))

    return run


def _if_nan(a: Expr, value: Any, otherwise: Any) -> Expr:
    return apply("where", apply("ne", a, a), value, otherwise)


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
    "floor_divide": _floor_divide,
    "fmax": _unless_nan("maximum"),
    "fmin": _unless_nan("minimum"),
    "deg2rad": lambda a: a * (np.pi / 180.0),
    "radians": lambda a: a * (np.pi / 180.0),
    "rad2deg": lambda a: a * (180.0 / np.pi),
    "degrees": lambda a: a * (180.0 / np.pi),
    "heaviside": lambda a, b: _if_nan(
        a, a, apply("where", apply("eq", a, 0.0), b, apply("lt", 0.0, a))
    ),
    "isnan": lambda a: apply("ne", a, a),
    "positive": lambda a: a,
    "conjugate": lambda a: a,
}
# What a user can call, by a ufunc of NumPy's or of scipy.special's.
_CALLABLE = {*_UFUNCS, *_COMPOSED}


def apply_ufunc(ufunc: np.ufunc, method: str, inputs: tuple, kwargs: dict) -> Any:
    """A NumPy ufunc on symbols: called, reduced (np.add.reduce) or as an outer product."""
    name = ufunc.__name__
    called = name if method == "__call__" else f"{name}.{method}"
    if any(a is not None for a in kwargs.pop("out", ())):
        refuse(f"np.{called} with out=, and assignment in place on an array of numbers",
                "write the new array as an expression, a + b instead of a += b")  # fmt: skip
    if method == "reduce" and name in ("add", "multiply", "maximum", "minimum"):
        given = _meant(called, {"axis": 0, **kwargs}, _REDUCING)
        return reduced(_UFUNCS[name], inputs[0], **given)
    if method == "accumulate" and name == "add":
        return cumsum(inputs[0], **_meant(called, {"axis": 0, **kwargs}, ("axis",)))
    _meant(called, kwargs, ())
    if name == "matmul" and method == "__call__":
        return matmul(*inputs)
    if method == "outer":
        a, b = (plain(i) for i in inputs)
        inputs = (a.reshape(a.shape + (1,) * b.ndim), b)
    elif method != "__call__":
        refuse(f"np.{called}", "write it out")
    if name in _COMPOSED:
        arrays = np.broadcast_arrays(*(plain(i) for i in inputs))
        out = np.empty(arrays[0].shape, dtype=object)
        for index in np.ndindex(out.shape):
            out[index] = _COMPOSED[name](*(as_expr(a[index]) for a in arrays))
        return scalar_or_array(out)
    if sign := {"bitwise_and": "&", "bitwise_or": "|", "invert": "~"}.get(name):
        conditions(sign, *(e for i in inputs for e in plain(i).ravel()))
    if name not in _UFUNCS:
        refuse(f"the function {name}", fix_for(name, _CALLABLE))
    return elementwise(_UFUNCS[name], *inputs)


behaviour["ufunc"] = apply_ufunc


# Of no consequence for values, whatever they are.
_IRRELEVANT = frozenset({"order", "subok", "optimize", "device"})
_DEFAULTS: dict[str, tuple[Any, ...]] = {
    "out": (None,), "keepdims": (False,), "where": (True,), "mode": ("raise",), "axis": (None,),
    "casting": ("same_kind", "safe"), "signature": (None,), "axes": (None,), "initial": (None,),
    "mean": (None,), "correction": (None,),
}  # fmt: skip
_REDUCING = ("axis", "keepdims", "initial", "where")


def _meant(called: str, given: dict[str, Any], known: Collection[str]) -> dict[str, Any]:
    """Of the arguments given those that are known; all others must be as NumPy has them anyway."""
    out = {}
    for name, value in given.items():
        if value is np._NoValue:
            continue
        if name in known:
            out[name] = value
        elif not _changes_nothing(name, value):
            refuse(
                f"np.{called} with {name}={_shown(value)}", _FIXES.get(name, f"leave {name} out")
            )
    return out


_FIXES = {
    "out": "write the new array as an expression",
    "where": "use np.where(condition, a, b)",
    "dtype": "leave dtype out: symbols are real numbers; round by np.floor or np.ceil",
}


def _changes_nothing(name: str, value: Any) -> bool:
    if name == "dtype":
        return value is None or value is float or value is object or value == np.dtype(float)
    if isinstance(value, np.bool):
        value = bool(value)
    return name in _IRRELEVANT or any(
        type(value) is type(d) and value == d for d in _DEFAULTS.get(name, ())
    )


def _shown(value: Any) -> str:
    text = value.__name__ if isinstance(value, type) else repr(value)
    return text if len(text) < 60 else f"{text[:56]} ..."


def _where(*branches: Any) -> Any:
    if len(branches) != 3:
        refuse("np.where with a condition only", "give both branches: np.where(c, a, b)")
    return elementwise("where", *branches)


def _std(
    a: Any, axis: Any = None, ddof: float | None = None, keepdims: bool = False, where: Any = True,
    correction: float | None = None,
) -> Any:  # fmt: skip
    return elementwise("sqrt", var(a, axis, ddof, keepdims, where, correction))


def _outer(a: Any, b: Any) -> Any:
    return elementwise("mul", plain(a).reshape(-1, 1), plain(b).reshape(1, -1))


def _einsum(*operands: Any) -> Any:
    return scalar_or_array(np.einsum(*_strip(operands)))


def _take(a: Any, indices: Any, axis: int | None = None, mode: Any = "raise") -> Any:
    if isinstance(indices, Expr):
        if mode != "raise":
            refuse(f"np.take by a symbol with mode={mode!r}", "leave mode out, and bound the index")
        return choose(
            indices, np.ravel(plain(a)) if axis is None else np.moveaxis(plain(a), axis, 0)
        )
    return scalar_or_array(np.take(plain(a), np.asarray(indices, dtype=int), axis, mode=mode))


def _choose(a: Any, choices: Any) -> Any:
    wrong = [i for i in array(a).flat if i.op == "const" and i.data not in range(len(choices))]
    if wrong:
        refuse(f"np.choose by {wrong[0]!r} from {len(choices)}", "give an index from 0 below that")
    return choose(a, choices)


def _diff(
    a: Any, n: int = 1, axis: int = -1, prepend: Any = np._NoValue, append: Any = np._NoValue
) -> Any:
    ends = _strip((prepend, append))
    return scalar_or_array(np.diff(plain(a), n, axis, *ends))


def _copyto(dst: Any, src: Any, casting: str = "", where: Any = True) -> None:
    if np.asarray(dst).dtype != object:  # np.full(shape, symbol) comes with an object array
        refuse("copying symbols into an array of numbers", "build the array by np.stack([...])")
    if isinstance(where, (Expr, ExprArray)):
        refuse("np.copyto where a symbol decides", "use np.where(condition, a, b)")
    np.copyto(np.asarray(dst).view(np.ndarray), plain(src), where=where)


def _full(a: Any, value: Any, shape: Any) -> Any:
    out = np.empty(plain(a).shape if shape is None else shape, dtype=object)
    out[...] = plain(value)
    return scalar_or_array(out)


_ALL = "a axis dtype out keepdims initial where"
_SPREAD = "a axis dtype out ddof keepdims where mean correction"
_LIKE = "dtype order subok shape device"
# What each does on symbols, and NumPy's arguments in their order; "" where any number are operands.
# Arguments that it does not have are refused, unless they say what NumPy does anyway.
FUNCTIONS: dict[Callable[..., Any], tuple[Callable[..., Any], str]] = {
    np.where: (_where, ""),
    np.sum: (partial(reduced, "add"), _ALL),
    np.prod: (partial(reduced, "mul"), _ALL),
    np.max: (partial(reduced, "maximum"), "a axis out keepdims initial where"),
    np.min: (partial(reduced, "minimum"), "a axis out keepdims initial where"),
    np.mean: (mean, "a axis dtype out keepdims where"),
    np.var: (var, _SPREAD),
    np.std: (_std, _SPREAD),
    np.cumsum: (cumsum, "a axis dtype out"),
    np.dot: (dot, "a b out"),
    np.vdot: (vdot, "a b"),
    np.inner: (inner, "a b"),
    np.outer: (_outer, "a b out"),
    np.kron: (lambda a, b: scalar_or_array(np.kron(plain(a), plain(b))), "a b"),
    np.einsum: (_einsum, ""),
    np.clip: (clip, "a a_min a_max out min max"),
    np.trace: (trace, "a offset axis1 axis2 dtype out"),
    np.take: (_take, "a indices axis out mode"),
    np.choose: (_choose, "a choices out mode"),
    np.diff: (_diff, "a n axis prepend append"),
    np.copyto: (_copyto, "dst src casting where"),
    np.zeros_like: (lambda a, shape=None: _full(a, 0.0, shape), f"a {_LIKE}"),
    np.ones_like: (lambda a, shape=None: _full(a, 1.0, shape), f"a {_LIKE}"),
    np.full_like: (
        lambda a, fill_value, shape=None: _full(a, fill_value, shape), f"a fill_value {_LIKE}"
    ),
    np.shape: (lambda a: plain(a).shape, "a"),
    np.ndim: (lambda a: plain(a).ndim, "a"),
    np.size: (lambda a, axis=None: np.size(plain(a), axis), "a axis"),
    np.linalg.inv: (inverse, "a"),
    np.linalg.det: (det, "a"),
    np.linalg.slogdet: (slogdet, "a"),
    np.linalg.cholesky: (cholesky, "a upper"),
    np.linalg.solve: (lambda a, b: matmul(inverse(a), b), "a b"),
    np.linalg.norm: (norm, "x ord axis keepdims"),
}  # fmt: skip
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
    name = func.__name__
    if func in FUNCTIONS:
        does, order = FUNCTIONS[func]
        if not order:
            _meant(name, kwargs, ())
            return does(*args)
        names = order.split()
        if len(args) > len(names):
            refuse(f"np.{name} with {len(args)} arguments", f"it takes {', '.join(names)}")
        given = {**dict(zip(names, args, strict=False)), **kwargs}
        return does(**_meant(name, given, _parameters(does)))
    if func in STRUCTURAL:
        result = func(*_strip(args), **_strip(kwargs))
        if isinstance(result, (list, tuple)):
            return type(result)(array(r) for r in result)
        return scalar_or_array(result)
    known = {f.__name__ for f in [*FUNCTIONS, *STRUCTURAL]}
    module = str(func.__module__).replace("numpy", "np", 1)
    refuse(f"{module}.{name}", fix_for(name, known))


@cache
def _parameters(does: Callable[..., Any]) -> Collection[str]:
    """The arguments that are implemented."""
    return signature(does).parameters


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
