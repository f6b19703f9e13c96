"""Arrays of symbols: a NumPy object array of `Expr`, and what NumPy's functions mean on it.

NumPy hands every ufunc and array function that meets an `Expr` or an `ExprArray` to
`apply_ufunc` and `apply_function` below (NEP 13 and NEP 18). Functions that only move elements
run as NumPy has them; those that compute stand in the table `FUNCTIONS`; all others are refused
by name, with the nearest that exist.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np

from ssmppl.errors import UnsupportedOperation, nearest_first
from ssmppl.expressions.expr import (
    TERNARY,
    UNARY,
    Expr,
    apply,
    as_expr,
    constant,
    item,
    matrix_op,
    pack,
    unpack,
    user_location,
)


def _any_operator(self: Any, other: Any) -> Any: ...


class ExprArray(np.ndarray):
    """An array of scalar expressions (dtype object); indexing down to one gives the `Expr`."""

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        return apply_ufunc(ufunc, method, inputs, kwargs)

    def __array_function__(self, func, types, args, kwargs):
        return apply_function(func, args, kwargs)

    def __getitem__(self, index):
        """As NumPy's; a symbol as the (first) index selects by np.where over the positions."""
        first, *rest = (index or (None,)) if isinstance(index, tuple) else (index,)
        if not isinstance(first, Expr):
            return super().__getitem__(index)
        chosen = super().__getitem__((len(self) - 1, *rest))
        for k in range(len(self) - 2, -1, -1):
            chosen = elementwise("where", apply("eq", first, k), self[(k, *rest)], chosen)
        return chosen

    if TYPE_CHECKING:  # one node where there are no dimensions, else an array
        __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _any_operator  # type: ignore[assignment]
        __truediv__ = __rtruediv__ = __pow__ = __rpow__ = __matmul__ = _any_operator  # type: ignore[assignment]
        __rmatmul__ = __lt__ = __le__ = __gt__ = __ge__ = _any_operator  # type: ignore[assignment]

    def __reduce__(self):  # its nodes in one table, shared parts once
        nodes = [as_expr(e) for e in self.view(np.ndarray).ravel()]
        table = pack(nodes)
        place = {node: i for i, node in enumerate(unpack(table))}
        return _unpack_array, (table, [place[n] for n in nodes], self.shape)

    # NumPy's methods, which would bypass the protocols, by the functions of the same name.
    def sum(self, axis=None, **kwargs):  # type: ignore[override]
        return _reduce("add", self, axis, **kwargs)

    def prod(self, axis=None, **kwargs):  # type: ignore[override]
        return _reduce("mul", self, axis, **kwargs)

    def mean(self, axis=None, **kwargs):  # type: ignore[override]
        return _mean(self, axis, **kwargs)

    def var(self, axis=None, ddof=0, **kwargs):  # type: ignore[override]
        return _var(self, axis, ddof, **kwargs)

    def std(self, axis=None, ddof=0, **kwargs):  # type: ignore[override]
        return elementwise("sqrt", _var(self, axis, ddof, **kwargs))

    def max(self, axis=None, **kwargs):  # type: ignore[override]
        return _reduce("maximum", self, axis, **kwargs)

    def min(self, axis=None, **kwargs):  # type: ignore[override]
        return _reduce("minimum", self, axis, **kwargs)

    def dot(self, other):  # type: ignore[override]
        return _dot(self, other)

    def clip(self, lower=None, upper=None):  # type: ignore[override]
        return _clip(self, lower, upper)

    def trace(self):  # type: ignore[override]
        return _trace(self)

    def cumsum(self, axis=None):  # type: ignore[override]
        return _cumsum(self, axis)


def _unpack_array(table: list, places: list[int], shape: tuple[int, ...]) -> ExprArray:
    nodes = unpack(table)
    return array(array([nodes[i] for i in places]).reshape(shape))


def array(values: Any) -> ExprArray:
    """`values` (nested sequences, arrays, nodes, numbers) as an ExprArray of the same shape."""
    plain = np.asarray(values, dtype=object)
    out = np.empty(plain.shape, dtype=object)
    for index in np.ndindex(plain.shape):
        out[index] = as_expr(plain[index])
    return out.view(ExprArray)


def scalar_or_array(values: Any) -> Expr | ExprArray:
    """A node for zero dimensions, else an ExprArray."""
    if isinstance(values, Expr):
        return values
    result = array(values)
    return result[()] if result.ndim == 0 else result


def elementwise(op: str, *operands: Any) -> Expr | ExprArray:
    """`op` on broadcast operands, element by element."""
    arrays = np.broadcast_arrays(*(_plain(o) for o in operands))
    out = np.empty(arrays[0].shape, dtype=object)
    for index in np.ndindex(out.shape):
        out[index] = apply(op, *(a[index] for a in arrays))
    return scalar_or_array(out)


def _plain(value: Any) -> np.ndarray:
    """As a plain object array, so that NumPy's structural functions run as they are."""
    if isinstance(value, Expr):
        out = np.empty((), dtype=object)
        out[()] = value
        return out
    return np.asarray(value, dtype=object).view(np.ndarray)


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
        _refuse(f"np.{name} with out= or where=, and assignment in place on an array of numbers",
                "write the new array as an expression, a + b instead of a += b")  # fmt: skip
    if name == "matmul" and method == "__call__":
        return _matmul(*inputs)
    if method == "reduce" and name in ("add", "multiply", "maximum", "minimum"):
        return _reduce(_RENAMED.get(name, name), inputs[0], kwargs.get("axis", 0))
    if method == "accumulate" and name == "add":
        return _cumsum(inputs[0], kwargs.get("axis", 0))
    if method == "outer":
        a, b = (_plain(i) for i in inputs)
        inputs = (a.reshape(a.shape + (1,) * b.ndim), b)
    elif method != "__call__":
        _refuse(f"np.{name}.{method}", "write it out")
    if name in _COMPOSED:
        arrays = np.broadcast_arrays(*(_plain(i) for i in inputs))
        out = np.empty(arrays[0].shape, dtype=object)
        for index in np.ndindex(out.shape):
            out[index] = _COMPOSED[name](*(as_expr(a[index]) for a in arrays))
        return scalar_or_array(out)
    op = _RENAMED.get(name, name if name in _DIRECT else None)
    if op is None:
        known = {*_RENAMED, *_COMPOSED, *_DIRECT}
        _refuse(f"the function {name}", f"supported are {', '.join(nearest_first(name, known))}")
    return elementwise(op, *inputs)


def _refuse(what: str, fix: str) -> NoReturn:
    raise UnsupportedOperation(f"{what} has no meaning on symbols", fix=fix, where=user_location())


def _reduce(op: str, a: Any, axis: Any = None, keepdims: bool = False, **unused: Any) -> Any:
    a = _plain(a)
    axes = range(a.ndim) if axis is None else np.atleast_1d(axis) % max(a.ndim, 1)
    axes = tuple(int(i) for i in axes)
    moved = np.moveaxis(a, axes, range(len(axes)))
    rest = moved.shape[len(axes) :]
    flat = moved.reshape((-1, *rest))
    if len(flat) == 0:
        if op not in ("add", "mul"):
            _refuse(f"{op} of no elements", "give at least one element")
        total: Any = np.full(rest, constant(0.0 if op == "add" else 1.0), dtype=object)
    else:
        total = flat[0]
        for part in flat[1:]:
            total = elementwise(op, total, part)
    if keepdims:
        total = _plain(total).reshape([1 if i in axes else n for i, n in enumerate(a.shape)])
    return scalar_or_array(total)


def _mean(a: Any, axis: Any = None, **kwargs: Any) -> Any:
    total = _reduce("add", a, axis, **kwargs)
    return total / (_plain(a).size / _plain(total).size)


def _var(a: Any, axis: Any = None, ddof: int = 0, **kwargs: Any) -> Any:
    a = array(a)
    n = a.size / _plain(_reduce("add", a, axis)).size
    return _reduce("add", (a - _mean(a, axis, keepdims=True)) ** 2, axis, **kwargs) / (n - ddof)


def _matmul(a: Any, b: Any) -> Any:
    a, b = _plain(a), _plain(b)
    if a.ndim == 0 or b.ndim == 0:
        _refuse("@ with a scalar", "use * for a scalar factor")
    if a.shape[-1] != b.shape[-2 if b.ndim > 1 else 0]:
        _refuse(f"@ of shapes {a.shape} and {b.shape}", "make the inner dimensions agree")
    # NumPy's matmul of object arrays is sum_k a_ik * b_kj through + and *.
    return scalar_or_array(np.matmul(a, b))


def _dot(a: Any, b: Any) -> Any:
    a, b = _plain(a), _plain(b)
    return array(a) * array(b) if a.ndim == 0 or b.ndim == 0 else _matmul(a, b)


def _clip(a: Any, a_min: Any = None, a_max: Any = None, **bounds: Any) -> Any:
    lower, upper = bounds.get("min", a_min), bounds.get("max", a_max)
    a = a if lower is None else elementwise("maximum", a, lower)
    return a if upper is None else elementwise("minimum", a, upper)


def _trace(a: Any, **unused: Any) -> Any:
    return _reduce("add", np.diagonal(_plain(a)))


def _cumsum(a: Any, axis: Any = None, **unused: Any) -> Any:
    a = _plain(a).reshape(-1) if axis is None else _plain(a)
    out = np.moveaxis(a.copy(), axis or 0, 0)
    for i in range(1, len(out)):
        out[i] = _plain(elementwise("add", out[i - 1], out[i]))
    return array(np.moveaxis(out, 0, axis or 0))


def square_matrix(a: Any, what: str) -> np.ndarray:
    """`a` as a plain object array, refused unless it is a square matrix."""
    a = _plain(a)
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        _refuse(f"{what} of shape {a.shape}", "pass one square matrix")
    return a


def _constants(a: np.ndarray) -> np.ndarray | None:
    """The matrix as numbers where it holds no symbols."""
    exprs = [as_expr(e) for e in a.flat]
    if any(e.op != "const" for e in exprs):
        return None
    return np.array([e.data for e in exprs]).reshape(a.shape)


def _matrix(op: str, a: Any) -> ExprArray:
    a = square_matrix(a, f"linalg {op}")
    n, numbers = len(a), _constants(a)
    if numbers is not None:
        try:
            return array((np.linalg.inv if op == "inverse" else np.linalg.cholesky)(numbers))
        except np.linalg.LinAlgError as error:
            _refuse(f"{op} of {numbers.tolist()}: {error}", "check the matrix's entries")
    node = matrix_op(op, a.flat, n)
    zero = constant(0.0)
    return array([[zero if op == "cholesky" and j > i else item(node, i, j) for j in range(n)]
                  for i in range(n)])  # fmt: skip


def _is_diagonal(a: Any) -> bool:
    return all(
        a[i] == 0 if not isinstance(a[i], Expr) else a[i].op == "const" and a[i].data == 0
        for i in np.ndindex(a.shape)
        if i[0] != i[1]
    )


def cholesky(a: Any) -> ExprArray:
    """Lower Cholesky factor of a symmetric positive definite matrix (its lower half is read)."""
    a = square_matrix(a, "linalg.cholesky")
    if _is_diagonal(a):
        return array(np.diag(array([apply("sqrt", d) for d in np.diagonal(a)])))
    return _matrix("cholesky", a)


def inverse(a: Any) -> ExprArray:
    """Inverse of a square matrix."""
    a = square_matrix(a, "linalg inverse")
    if _is_diagonal(a):
        return array(np.diag(array([1.0 / as_expr(d) for d in np.diagonal(a)])))
    return _matrix("inverse", a)


def log_determinant(a: Any) -> Expr:
    """log det a of a positive definite matrix."""
    a = square_matrix(a, "linalg log determinant")
    if _is_diagonal(a):
        return _reduce("add", [apply("log", d) for d in np.diagonal(a)])
    numbers = _constants(a)
    if numbers is not None:
        return constant(np.linalg.slogdet(numbers)[1])
    return matrix_op("logdet", a.flat, len(a))


def _det(a: Any) -> Expr:
    a = square_matrix(a, "linalg.det")
    if _is_diagonal(a):
        return _reduce("mul", list(np.diagonal(a)))
    return matrix_op("det", a.flat, len(a))


def _where(condition: Any, *branches: Any) -> Any:
    if len(branches) != 2:
        _refuse("np.where with a condition only", "give both branches: np.where(c, a, b)")
    return elementwise("where", condition, *branches)


def _copyto(target: Any, source: Any, **kwargs: Any) -> None:
    if np.asarray(target).dtype != object:  # np.full(shape, symbol) comes with an object array
        _refuse("copying symbols into an array of numbers", "build the array by np.stack([...])")
    np.copyto(np.asarray(target).view(np.ndarray), _plain(source))


class Slogdet(NamedTuple):
    """What np.linalg.slogdet gives."""

    sign: Expr
    logabsdet: Expr


def _slogdet(a: Any) -> Slogdet:
    a = square_matrix(a, "linalg.slogdet")
    if _is_diagonal(a):
        size = _reduce("add", [apply("log", apply("abs", d)) for d in np.diagonal(a)])
    else:
        size = log_determinant(a)
    return Slogdet(apply("sign", _det(a)), size)


def _norm(a: Any, ord: Any = None, **unused: Any) -> Any:
    if ord not in (None, 2) or _plain(a).ndim != 1:
        _refuse("np.linalg.norm other than the Euclidean norm of a vector", "write it out")
    return apply("sqrt", _reduce("add", elementwise("mul", a, a)))


def _like(value: float) -> Callable[..., Any]:
    return lambda a, *unused, **unused_too: scalar_or_array(np.full(_plain(a).shape, value))


FUNCTIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    np.where: _where,
    np.sum: lambda a, axis=None, **kw: _reduce("add", a, axis, **kw),
    np.prod: lambda a, axis=None, **kw: _reduce("mul", a, axis, **kw),
    np.max: lambda a, axis=None, **kw: _reduce("maximum", a, axis, **kw),
    np.min: lambda a, axis=None, **kw: _reduce("minimum", a, axis, **kw),
    np.mean: _mean,
    np.var: _var,
    np.std: lambda a, axis=None, **kw: elementwise("sqrt", _var(a, axis, **kw)),
    np.cumsum: _cumsum,
    np.dot: _dot,
    np.vdot: _dot,
    np.inner: lambda a, b: _dot(a, _plain(b).T),
    np.outer: lambda a, b: elementwise("mul", _plain(a).reshape(-1, 1), _plain(b).reshape(1, -1)),
    np.kron: lambda a, b: scalar_or_array(np.kron(_plain(a), _plain(b))),
    np.einsum: lambda spec, *ops, optimize=False: scalar_or_array(
        np.einsum(spec, *map(_plain, ops))
    ),
    np.clip: _clip,
    np.trace: _trace,
    np.take: lambda a, index, axis=None: (
        array(a)[index]
        if isinstance(index, Expr) and axis in (None, 0)
        else scalar_or_array(np.take(_plain(a), np.asarray(index, dtype=int), axis))
    ),
    np.diff: lambda a, **kw: scalar_or_array(np.diff(_plain(a), **kw)),
    np.copyto: _copyto,
    np.zeros_like: _like(0.0),
    np.ones_like: _like(1.0),
    np.full_like: lambda a, value, **kw: scalar_or_array(np.full(_plain(a).shape, value)),
    np.shape: lambda a: _plain(a).shape,
    np.ndim: lambda a: _plain(a).ndim,
    np.size: lambda a: _plain(a).size,
    np.linalg.inv: inverse,
    np.linalg.det: _det,
    np.linalg.slogdet: _slogdet,
    np.linalg.cholesky: cholesky,
    np.linalg.solve: lambda a, b: _matmul(inverse(a), b),
    np.linalg.norm: _norm,
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
    _refuse(f"np.{name}", f"supported are {', '.join(nearest_first(name, known))}")


def _strip(value: Any) -> Any:
    """Arguments with every Expr and ExprArray turned to plain object arrays."""
    if isinstance(value, (Expr, ExprArray)):
        return _plain(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_strip(v) for v in value)
    if isinstance(value, dict):
        return {k: _strip(v) for k, v in value.items()}
    return value
