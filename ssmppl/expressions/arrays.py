"""Arrays of symbols: a NumPy object array of `Expr`, element by element, reduced, multiplied."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from ssmppl.errors import UnsupportedOperation
from ssmppl.expressions.expr import Expr, apply, as_expr, constant, pack, unpack, user_location
from ssmppl.expressions.node import behaviour


def _any_operator(self: Any, other: Any) -> Any: ...


class ExprArray(np.ndarray):
    """An array of scalar expressions (dtype object); indexing down to one gives the `Expr`."""

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        return behaviour["ufunc"](ufunc, method, inputs, kwargs)

    def __array_function__(self, func, types, args, kwargs):
        return behaviour["function"](func, args, kwargs)

    def __getitem__(self, index):
        """As NumPy's; a symbol as the (first) index selects by np.where over the positions."""
        first, *rest = (index or (None,)) if isinstance(index, tuple) else (index,)
        if not isinstance(first, Expr):
            return super().__getitem__(index)
        return choose(first, [self[(k, *rest)] for k in range(len(self))])

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
        return reduced("add", self, axis, **kwargs)

    def prod(self, axis=None, **kwargs):  # type: ignore[override]
        return reduced("mul", self, axis, **kwargs)

    def mean(self, axis=None, **kwargs):  # type: ignore[override]
        return mean(self, axis, **kwargs)

    def var(self, axis=None, ddof=0, **kwargs):  # type: ignore[override]
        return var(self, axis, ddof, **kwargs)

    def std(self, axis=None, ddof=0, **kwargs):  # type: ignore[override]
        return elementwise("sqrt", var(self, axis, ddof, **kwargs))

    def max(self, axis=None, **kwargs):  # type: ignore[override]
        return reduced("maximum", self, axis, **kwargs)

    def min(self, axis=None, **kwargs):  # type: ignore[override]
        return reduced("minimum", self, axis, **kwargs)

    def dot(self, other):  # type: ignore[override]
        return dot(self, other)

    def clip(self, lower=None, upper=None):  # type: ignore[override]
        return clip(self, lower, upper)

    def trace(self):  # type: ignore[override]
        return trace(self)

    def cumsum(self, axis=None):  # type: ignore[override]
        return cumsum(self, axis)


def _unpack_array(table: list, places: list[int], shape: tuple[int, ...]) -> ExprArray:
    nodes = unpack(table)
    return array(array([nodes[i] for i in places]).reshape(shape))


def array(values: Any) -> ExprArray:
    """`values` (nested sequences, arrays, nodes, numbers) as an ExprArray of the same shape."""
    elements = np.asarray(values, dtype=object)
    out = np.empty(elements.shape, dtype=object)
    for index in np.ndindex(elements.shape):
        out[index] = as_expr(elements[index])
    return out.view(ExprArray)


def scalar_or_array(values: Any) -> Expr | ExprArray:
    """A node for zero dimensions, else an ExprArray."""
    if isinstance(values, Expr):
        return values
    result = array(values)
    return result[()] if result.ndim == 0 else result


def elementwise(op: str, *operands: Any) -> Expr | ExprArray:
    """`op` on broadcast operands, element by element."""
    arrays = np.broadcast_arrays(*(plain(o) for o in operands))
    out = np.empty(arrays[0].shape, dtype=object)
    for index in np.ndindex(out.shape):
        out[index] = apply(op, *(a[index] for a in arrays))
    return scalar_or_array(out)


def plain(value: Any) -> np.ndarray:
    """As a plain object array, so that NumPy's structural functions run as they are."""
    if isinstance(value, Expr):
        out = np.empty((), dtype=object)
        out[()] = value
        return out
    return np.asarray(value, dtype=object).view(np.ndarray)


def refuse(what: str, fix: str) -> NoReturn:
    """Raise, at the user's line, that `what` cannot be done with symbols."""
    raise UnsupportedOperation(f"{what} has no meaning on symbols", fix=fix, where=user_location())


# -- NumPy's functions of these names
def choose(index: Any, choices: Sequence[Any] | np.ndarray) -> Any:
    """choices[index], element by element; the last of them where the index is out of range."""
    if len(choices) == 0:
        refuse("a choice from no elements", "give at least one element")
    chosen = scalar_or_array(choices[-1])
    for k in range(len(choices) - 2, -1, -1):
        chosen = elementwise("where", elementwise("eq", index, k), choices[k], chosen)
    return chosen


def reduced(op: str, a: Any, axis: Any = None, keepdims: bool = False, **unused: Any) -> Any:
    """The elements along `axis` (all axes: None) joined by `op`, from the first to the last."""
    a = plain(a)
    axes = range(a.ndim) if axis is None else np.atleast_1d(axis) % max(a.ndim, 1)
    axes = tuple(int(i) for i in axes)
    moved = np.moveaxis(a, axes, range(len(axes)))
    rest = moved.shape[len(axes) :]
    flat = moved.reshape((-1, *rest))
    if len(flat) == 0:
        if op not in ("add", "mul"):
            refuse(f"{op} of no elements", "give at least one element")
        total: Any = np.full(rest, constant(0.0 if op == "add" else 1.0), dtype=object)
    else:
        total = flat[0]
        for part in flat[1:]:
            total = elementwise(op, total, part)
    if keepdims:
        total = plain(total).reshape([1 if i in axes else n for i, n in enumerate(a.shape)])
    return scalar_or_array(total)


def mean(a: Any, axis: Any = None, **kwargs: Any) -> Any:
    total = reduced("add", a, axis, **kwargs)
    return total / (plain(a).size / plain(total).size)


def var(a: Any, axis: Any = None, ddof: int = 0, **kwargs: Any) -> Any:
    a = array(a)
    n = a.size / plain(reduced("add", a, axis)).size
    return reduced("add", (a - mean(a, axis, keepdims=True)) ** 2, axis, **kwargs) / (n - ddof)


def matmul(a: Any, b: Any) -> Any:
    a, b = plain(a), plain(b)
    if a.ndim == 0 or b.ndim == 0:
        refuse("@ with a scalar", "use * for a scalar factor")
    if a.shape[-1] != b.shape[-2 if b.ndim > 1 else 0]:
        refuse(f"@ of shapes {a.shape} and {b.shape}", "make the inner dimensions agree")
    if a.ndim > 2 or b.ndim > 2:  # sum_k a_ik * b_kj through + and *
        return scalar_or_array(np.matmul(a, b))
    rows, columns = np.atleast_2d(a), b.reshape(len(b), -1)
    out = np.empty((len(rows), columns.shape[1]), dtype=object)
    entries = [[(k, e) for k, e in enumerate(c) if not _zero(e)] for c in columns.T]
    for i, row in enumerate(rows):
        full = [not _zero(e) for e in row]
        for j, column in enumerate(entries):
            total: Any = constant(0.0)
            for k, e in column:
                if full[k]:
                    total = total + row[k] * e
            out[i, j] = total
    return scalar_or_array(out.reshape(a.shape[:-1] + b.shape[1:]))


def _zero(e: Any) -> bool:
    """Whether an entry is the number 0: most of a large matrix's are."""
    return isinstance(e, Expr) and e.op == "const" and e.data == 0.0


def dot(a: Any, b: Any) -> Any:
    a, b = plain(a), plain(b)
    return array(a) * array(b) if a.ndim == 0 or b.ndim == 0 else matmul(a, b)


def clip(a: Any, a_min: Any = None, a_max: Any = None, **bounds: Any) -> Any:
    lower, upper = bounds.get("min", a_min), bounds.get("max", a_max)
    a = a if lower is None else elementwise("maximum", a, lower)
    return a if upper is None else elementwise("minimum", a, upper)


def trace(a: Any, **unused: Any) -> Any:
    return reduced("add", np.diagonal(plain(a)))


def cumsum(a: Any, axis: Any = None, **unused: Any) -> Any:
    a = plain(a).reshape(-1) if axis is None else plain(a)
    out = np.moveaxis(a.copy(), axis or 0, 0)
    for i in range(1, len(out)):
        out[i] = plain(elementwise("add", out[i - 1], out[i]))
    return array(np.moveaxis(out, 0, axis or 0))
