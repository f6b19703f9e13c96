"""Arrays of symbols: a NumPy object array of `Expr`, element by element, reduced, multiplied,
factorised.

Diagonal matrices are factorised and inverted entry by entry, matrices of numbers by NumPy; all
others become matrix nodes (`MATRIX_OPS`), which generated code evaluates by one call each.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np
from numpy.lib.array_utils import normalize_axis_tuple

from ssmppl.errors import UnsupportedOperation
from ssmppl.expressions.expr import (
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
from ssmppl.expressions.node import CHOICES, behaviour
from ssmppl.expressions.operations import MATRICES

_IDENTITY = {"add": 0.0, "mul": 1.0}  # what changes nothing


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
        return _unpack_array, (*pack(nodes_of(self)), self.shape)


def _by_function(function: Callable[..., Any]) -> Callable[..., Any]:
    def method(self: ExprArray, *args: Any, **kwargs: Any) -> Any:
        return behaviour["function"](function, (self, *args), kwargs)

    return method


# NumPy's methods, which would bypass the protocols, by the functions of the same name.
for _function in (
    np.sum, np.prod, np.mean, np.var, np.std, np.max, np.min, np.dot, np.clip, np.trace, np.cumsum,
    np.any, np.all, np.cumprod, np.round,
):  # fmt: skip
    setattr(ExprArray, _function.__name__, _by_function(_function))


def nodes_of(a: ExprArray) -> list[Expr]:
    """Its elements in a row."""
    return [as_expr(e) for e in a.view(np.ndarray).ravel()]


def of_nodes(nodes: Sequence[Expr], shape: tuple[int, ...]) -> ExprArray:
    """The array of this shape whose elements in a row are `nodes`."""
    return array(array(nodes).reshape(shape))


def _unpack_array(table: list, places: list[int], shape: tuple[int, ...]) -> ExprArray:
    nodes = unpack(table)
    return of_nodes([nodes[i] for i in places], shape)


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
    """The elements as a plain object array, so that NumPy's structural functions run as they
    are."""
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
    """choices[index], element by element; the last of them where the index is out of range, which
    `choosing` lets a caller refuse where it can tell."""
    if len(choices) == 0:
        refuse("a choice from no elements", "give at least one element")
    chosen = scalar_or_array(choices[-1])
    for k in range(len(choices) - 2, -1, -1):
        chosen = elementwise("where", elementwise("eq", index, k), choices[k], chosen)
    kept = CHOICES.get()
    if kept is not None and len(choices) > 1:
        for node, own in np.broadcast(plain(chosen), plain(index)):
            if node.op == "where":  # elements that are all alike are no choice
                _, before = kept.get(node, (own, 0))
                kept[node] = (as_expr(own), max(len(choices), before))
    return chosen


def reduced(
    op: str, a: Any, axis: Any = None, keepdims: bool = False, initial: Any = None,
    where: Any = True,
) -> Any:  # fmt: skip
    """`initial` (if any) and the elements along `axis` (all axes: None) joined by `op`, from the
    first to the last; of these only those where the mask `where` holds."""
    a = plain(a)
    start = _IDENTITY.get(op, initial)
    if where is not True:
        if start is None:
            refuse(f"{op} of some elements, by where=, without initial=", "give initial= too")
        a = plain(elementwise("where", _mask(where, a.shape), a, start))
    axes = axes_of(axis, a.ndim)
    moved = np.moveaxis(a, axes, range(len(axes))) if a.ndim else a
    rest = moved.shape[len(axes) :]
    flat = moved.reshape((-1, *rest)) if moved.size else np.empty((0, *rest), dtype=object)
    parts = list(flat) if initial is None else [np.full(rest, as_expr(initial), object), *flat]
    if not parts:
        if start is None:
            refuse(f"{op} of no elements", "give at least one element, or initial=")
        parts = [np.full(rest, constant(start), dtype=object)]
    total: Any = parts[0]
    for part in parts[1:]:
        total = elementwise(op, total, part)
    if keepdims:
        total = plain(total).reshape([1 if i in axes else n for i, n in enumerate(a.shape)])
    return scalar_or_array(total)


def axes_of(axis: Any, ndim: int) -> tuple[int, ...]:
    """The axes meant, from 0; all where None."""
    if axis is None:
        return tuple(range(ndim))
    try:
        return normalize_axis_tuple(axis, max(ndim, 1))[:ndim]
    except (ValueError, TypeError) as error:
        refuse(f"axis={axis!r} of an array of {ndim} dimensions", f"give another axis: {error}")


def _mask(where: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A mask, of numbers or of conditions on symbols, in the shape of what it masks."""
    if not isinstance(where, (Expr, ExprArray)) and np.asarray(where).dtype not in (bool, object):
        refuse(f"where={where!r}", "a mask holds True and False: compare, as in mask > 0")
    mask = plain(where)
    if np.broadcast_shapes(mask.shape, shape) != shape:
        refuse(f"where= of shape {mask.shape} on an array of shape {shape}", "make it no larger")
    return np.broadcast_to(mask, shape)


def _count(a: Any, axis: Any, where: Any) -> Any:
    """How many elements a mean is of."""
    if where is not True:
        ones = elementwise("where", _mask(where, plain(a).shape), 1.0, 0.0)
        return reduced("add", ones, axis, keepdims=True)
    shape = plain(a).shape
    return float(np.prod([shape[i] for i in axes_of(axis, len(shape))]))


def _divided(total: Any, n: Any, what: str, keepdims: bool, axis: Any) -> Any:
    """total, of kept dimensions, over n, where n is positive."""
    if any(as_expr(e).op == "const" and as_expr(e).data <= 0.0 for e in plain(n).flat):
        refuse(f"{what} of too few elements", "give more elements, or a smaller ddof")
    out = plain(total / n)
    return scalar_or_array(out if keepdims else np.squeeze(out, axes_of(axis, out.ndim)))


def mean(a: Any, axis: Any = None, keepdims: bool = False, where: Any = True) -> Any:
    total = reduced("add", a, axis, keepdims=True, where=where)
    return _divided(total, _count(a, axis, where), "the mean", keepdims, axis)


def var(
    a: Any, axis: Any = None, ddof: float | None = None, keepdims: bool = False, where: Any = True,
    correction: float | None = None,
) -> Any:  # fmt: skip
    if ddof is not None and correction is not None:
        refuse("var with both ddof and correction", "give one of them")
    less = ddof if ddof is not None else correction if correction is not None else 0
    away = array(a) - mean(a, axis, keepdims=True, where=where)
    total = reduced("add", away**2, axis, keepdims=True, where=where)
    return _divided(total, _count(a, axis, where) - less, "the variance", keepdims, axis)


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
    """Over the last axis of a and the last but one of b, where np.matmul pairs stacks."""
    a, b = plain(a), plain(b)
    if a.ndim == 0 or b.ndim == 0:
        return array(a) * array(b)
    if b.ndim < 3:
        return matmul(a, b)
    columns = np.moveaxis(b, -2, 0)
    return _reshaped(matmul(a, columns.reshape(len(columns), -1)), a.shape[:-1] + columns.shape[1:])


def vdot(a: Any, b: Any) -> Any:
    return dot(plain(a).reshape(-1), plain(b).reshape(-1))


def inner(a: Any, b: Any) -> Any:
    """Over the last axis of both."""
    a, b = plain(a), plain(b)
    if a.ndim == 0 or b.ndim == 0:
        return array(a) * array(b)
    return _reshaped(matmul(a, b.reshape(-1, b.shape[-1]).T), a.shape[:-1] + b.shape[:-1])


def _reshaped(a: Any, shape: tuple[int, ...]) -> Any:
    return scalar_or_array(plain(a).reshape(shape))


def clip(
    a: Any, a_min: Any = None, a_max: Any = None, min: Any = np._NoValue, max: Any = np._NoValue
) -> Any:
    lower, upper = a_min, a_max
    if min is not np._NoValue or max is not np._NoValue:
        if not (a_min is None and a_max is None):
            refuse("np.clip with min= or max= beside a_min and a_max", "give each bound once")
        lower, upper = (None if b is np._NoValue else b for b in (min, max))
    a = scalar_or_array(a) if lower is None else elementwise("maximum", a, lower)
    return a if upper is None else elementwise("minimum", a, upper)


def trace(a: Any, offset: int = 0, axis1: int = 0, axis2: int = 1) -> Any:
    return reduced("add", np.diagonal(plain(a), offset, axis1, axis2), -1)


def cumsum(a: Any, axis: Any = None) -> Any:
    a, axis = (plain(a).reshape(-1), 0) if axis is None else (plain(a), operator.index(axis))
    out = np.moveaxis(a.copy(), axis, 0)
    for i in range(1, len(out)):
        out[i] = plain(elementwise("add", out[i - 1], out[i]))
    return array(np.moveaxis(out, 0, axis))


# -- linear algebra on small matrices
def square_matrix(a: Any, what: str) -> np.ndarray:
    """`a` as a plain object array, refused unless it is a square matrix."""
    a = plain(a)
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        refuse(f"{what} of shape {a.shape}", "pass one square matrix")
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
            return array(MATRICES[op][1](numbers))
        except np.linalg.LinAlgError as error:
            refuse(f"{op} of {numbers.tolist()}: {error}", "check the matrix's entries")
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


def cholesky(a: Any, upper: bool = False) -> ExprArray:
    """Lower Cholesky factor of a symmetric positive definite matrix (its lower half is read).

    upper : the upper factor, of which the upper half is read.
    """
    if upper:
        return array(plain(cholesky(square_matrix(a, "linalg.cholesky").T)).T)
    a = square_matrix(a, "linalg.cholesky")
    if _is_diagonal(a):
        return array(np.diag(array([apply("sqrt", d) for d in np.diagonal(a)])))
    return _matrix("cholesky", a)


def squared(root: Any) -> ExprArray | None:
    """The matrix whose Cholesky factor, made by `cholesky`, this is; None if it is no such."""
    a = plain(root)
    first = as_expr(a.flat[0]) if a.size else constant(0.0)
    if first.op != "item" or first.args[0].op != "cholesky":
        return None
    node, n, zero = first.args[0], len(a), constant(0.0)
    if node.data != n or any(
        as_expr(a[i, j]) is not (item(node, i, j) if j <= i else zero) for i, j in np.ndindex(n, n)
    ):
        return None
    return array(np.array(node.args, dtype=object).reshape(n, n))


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
        return reduced("add", [apply("log", d) for d in np.diagonal(a)])
    numbers = _constants(a)
    if numbers is not None:
        return constant(np.linalg.slogdet(numbers)[1])
    return matrix_op("logdet", a.flat, len(a))


def det(a: Any) -> Expr:
    """Determinant of a square matrix."""
    a = square_matrix(a, "linalg.det")
    if _is_diagonal(a):
        return reduced("mul", list(np.diagonal(a)))
    return matrix_op("det", a.flat, len(a))


class Slogdet(NamedTuple):
    """What np.linalg.slogdet gives."""

    sign: Expr
    logabsdet: Expr


def slogdet(a: Any) -> Slogdet:
    """Sign of det a and log |det a|."""
    a = square_matrix(a, "linalg.slogdet")
    if _is_diagonal(a):
        size = reduced("add", [apply("log", apply("abs", d)) for d in np.diagonal(a)])
    else:
        size = log_determinant(a)
    return Slogdet(apply("sign", det(a)), size)


def norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    """Euclidean norm, of a vector, along an axis, or of all entries."""
    along = axis is None or np.ndim(axis) == 0
    euclidean = ord is None or (isinstance(ord, (int, float)) and ord == 2)
    if not along or not euclidean or (ord == 2 and axis is None and plain(x).ndim != 1):
        refuse("np.linalg.norm other than the Euclidean norm of vectors", "write it out")
    return elementwise("sqrt", reduced("add", elementwise("mul", x, x), axis, keepdims))
