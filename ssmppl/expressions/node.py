"""Expr: one interned, immutable node type for scalar expressions.

Two expressions that are written alike *are* the same object, so shared work is found by identity
and expressions serve as dictionary keys. Vectors and matrices are NumPy object arrays of scalar
nodes (`ssmppl.expressions.arrays.ExprArray`); there is no array-valued node. The factorisations of
small matrices (`MATRIX_OPS`) are nodes over the matrix's entries, whose results are taken apart by
"item" nodes.

What there is to say of an operation stands in `operations.py`, its derivative in `calculus.py`.

While a model is traced, `recording` and `choosing` keep where the user wrote each node, and which
nodes are elements of an array that a symbol chose.
"""

from __future__ import annotations

import os
import sys
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from ssmppl.errors import Location, UnsupportedOperation
from ssmppl.expressions.operations import BOOLEAN, OPERATIONS

INDEX_BY_SYMBOL = (
    "np.choose(k, table) is table[k] for a symbol k and an array of numbers: an element of a "
    "vector, a row of a matrix; an array of symbols takes a symbol as its first index, if np.stack "
    "made it of its elements or rows (np.array makes a plain one)"
)

SEVERAL = ("loop", "simulator")  # nodes of several numbers, in one axis

# What Expr does that is defined in modules above this one, which fill it when they are imported
# (all of them by `ssmppl.expressions`):
#   "apply"     (op, *operands): the node of an operation, simplified     expr.py
#   "pickle"    (node): what its __reduce__ gives                         expr.py
#   "text"      (node): how a person writes it                            expr.py
#   "ufunc"     (ufunc, method, inputs, kwargs): NumPy's NEP 13           numpy_protocols.py
#   "function"  (func, args, kwargs): NumPy's NEP 18                      numpy_protocols.py
behaviour: dict[str, Callable[..., Any]] = {}

_interned: weakref.WeakValueDictionary[tuple, Expr] = weakref.WeakValueDictionary()
_lock = threading.Lock()


def _apply(op: str, *operands: Any) -> Expr:
    return behaviour["apply"](op, *operands)


def _method(op: str) -> Callable[[Expr], Expr]:
    def method(self: Expr) -> Expr:
        return _apply(op, self)

    return method


class Expr:
    """A scalar expression: operation name, argument nodes, and data that is no node.

    `data` holds the value of a "const", (kind, name, index) of a "symbol", the position of an
    "item", (kind, key) of a "random" draw, the function of a "call", the size of a matrix.
    `_symbols` holds the symbols under the node once they were asked for: see `expr.symbols_in`.
    """

    __slots__ = ("__weakref__", "_symbols", "args", "data", "op")
    op: str
    args: tuple[Expr, ...]
    data: Any
    _symbols: frozenset[Expr] | None

    def __new__(cls, op: str, args: tuple[Expr, ...] = (), data: Any = None) -> Expr:
        # ids, not the nodes: == on nodes builds an expression. repr keeps 0.0, -0.0 and nan apart.
        key = (op, repr(data) if op == "const" else data, *map(id, args))
        with _lock:
            node = _interned.get(key)
            if node is None:
                node = object.__new__(cls)
                object.__setattr__(node, "op", op)
                object.__setattr__(node, "args", args)
                object.__setattr__(node, "data", data)
                object.__setattr__(node, "_symbols", None)
                _interned[key] = node
        locations = LOCATIONS.get()
        if locations is not None and args:  # symbols are not written there
            note(node, locations)
        return node

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError("expressions are immutable")

    def __reduce__(self):  # as a flat table, for graphs deeper than Python's recursion limit
        return behaviour["pickle"](self)

    def __copy__(self) -> Expr:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Expr:
        return self

    # -- what NumPy and users ask of a scalar
    shape: tuple[int, ...] = ()
    ndim = 0
    size = 1

    @property
    def T(self) -> Expr:
        return self

    __hash__ = object.__hash__

    def __add__(self, other):
        return _binary("add", self, other)

    def __radd__(self, other):
        return _binary("add", other, self)

    def __sub__(self, other):
        return _binary("sub", self, other)

    def __rsub__(self, other):
        return _binary("sub", other, self)

    def __mul__(self, other):
        return _binary("mul", self, other)

    def __rmul__(self, other):
        return _binary("mul", other, self)

    def __truediv__(self, other):
        return _binary("div", self, other)

    def __rtruediv__(self, other):
        return _binary("div", other, self)

    def __pow__(self, other):
        return _binary("pow", self, other)

    def __rpow__(self, other):
        return _binary("pow", other, self)

    def __mod__(self, other):
        return _binary("mod", self, other)

    def __rmod__(self, other):
        return _binary("mod", other, self)

    def __floordiv__(self, other):
        return self.__array_ufunc__(np.floor_divide, "__call__", self, other)

    def __rfloordiv__(self, other):
        return self.__array_ufunc__(np.floor_divide, "__call__", other, self)

    def __neg__(self):
        return _apply("neg", self)

    def __pos__(self):
        return self

    def __abs__(self):
        return _apply("abs", self)

    def __floor__(self):
        return _apply("floor", self)

    def __ceil__(self):
        return _apply("ceil", self)

    def __lt__(self, other):
        return _binary("lt", self, other)

    def __le__(self, other):
        return _binary("le", self, other)

    def __gt__(self, other):
        return _binary("lt", other, self)

    def __ge__(self, other):
        return _binary("le", other, self)

    def __eq__(self, other):
        if isinstance(other, list | tuple):  # else Python would compare what they are
            return self == np.asarray(other)
        return _binary("eq", self, other)

    def __ne__(self, other):
        if isinstance(other, list | tuple):
            return self != np.asarray(other)
        return _binary("ne", self, other)

    def __and__(self, other):
        return _binary("and", *conditions("&", self, other))

    def __rand__(self, other):
        return _binary("and", *conditions("&", other, self))

    def __or__(self, other):
        return _binary("or", *conditions("|", self, other))

    def __ror__(self, other):
        return _binary("or", *conditions("|", other, self))

    def __invert__(self):
        return _apply("not", *conditions("~", self))

    def __bool__(self) -> bool:
        raise UnsupportedOperation(
            "a Python `if`, `and`, `or`, `min`, `max` or comparison needs the truth of a symbol, "
            "which has no value while the model is traced",
            fix="write np.where(condition, a, b), np.minimum / np.maximum, or & and | for "
            "conditions; build arrays of symbols that are compared, or given to np.maximum, by "
            "np.stack([...]) and not by np.array([...])",
            where=user_location(),
        )

    def __float__(self) -> float:
        raise UnsupportedOperation(
            "a number was asked of a symbol (float(), math.* or an array of numbers)",
            fix="use NumPy's function of that name (np.exp, np.sqrt, ...) and build arrays by "
            "np.array([...]) or np.stack([...]) instead of assigning into np.zeros(...)",
            where=user_location(),
        )

    __complex__ = __float__

    def __index__(self) -> int:
        raise UnsupportedOperation(
            "a whole number was asked of a symbol (int(), range(), an index into an array of "
            "numbers)",
            fix=f"write np.floor(x) for int(x) of a positive number; {INDEX_BY_SYMBOL}",
            where=user_location(),
        )

    __int__ = __index__

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        return behaviour["ufunc"](ufunc, method, inputs, kwargs)

    def __array_function__(self, func, types, args, kwargs):
        return behaviour["function"](func, args, kwargs)

    def __repr__(self) -> str:
        return behaviour["text"](self)


# np.exp(np.array([x, y])): on its plain arrays of objects NumPy calls the elements' methods. Not so
# of np.sign, and x.sign() is no method of a number either.
for _name, _operation in OPERATIONS.items():
    _unary = _operation.operands == 1 and hasattr(np, _name) and _name != "sign"
    if _unary and not hasattr(Expr, f"__{_name}__"):
        setattr(Expr, _name, _method(_name))


def _binary(op: str, a: Any, b: Any) -> Any:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return NotImplemented
    try:
        return _apply(op, as_expr(a), as_expr(b))
    except TypeError as error:
        if isinstance(error, UnsupportedOperation):
            raise
        return NotImplemented


def conditions(sign: str, *operands: Any) -> tuple[Any, ...]:
    """The operands of &, | or ~, which of numbers would be bitwise: what holds or does not hold."""
    for operand in operands:
        numbers = not isinstance(operand, Expr | bool | np.bool_ | np.ndarray)
        known = isinstance(operand, Expr) and operand.op not in (*BOOLEAN, "where", "const")
        if numbers or known:
            raise UnsupportedOperation(
                f"{sign} of {operand!r}, a number: it is bitwise in NumPy, and not on symbols",
                fix="compare it first: (k == 1) & (x > 0); the last bit of k is k % 2",
                where=user_location(),
            )
    return operands


def constant(value: float) -> Expr:
    """The node of a number."""
    return Expr("const", (), float(value))


def symbol(kind: str, name: str, index: tuple[int, ...] = ()) -> Expr:
    """The node of one scalar component of a named quantity, for instance a state's."""
    return Expr("symbol", (), (kind, name, index))


def matrix_op(op: str, entries: Iterable[Any], n: int) -> Expr:
    """The node of a factorisation of the n x n matrix with these entries, row by row."""
    return Expr(op, tuple(as_expr(e) for e in entries), n)


def item(node: Expr, i: int, j: int) -> Expr:
    """Entry (i, j) of a matrix-valued node ("cholesky" or "inverse")."""
    return Expr("item", (node,), (i, j))


def is_tuple(node: Expr) -> bool:
    """Whether the node is a call that gives several numbers, which "item" nodes (i,) take apart."""
    return node.op == "call" and getattr(node.data, "outputs", 1) > 1


def as_expr(value: Any) -> Expr:
    """`value` as a node: nodes as they are, numbers as constants; TypeError for all else."""
    if isinstance(value, Expr):
        return value
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return as_expr(value.item())
    if isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating)):
        return constant(float(value))
    raise TypeError(f"no expression can be made of {value!r} of type {type(value).__name__}")


# -- where nodes are from
# Of the block that records; None where none does. And the location that its nodes are given.
LOCATIONS: ContextVar[dict[Expr, Location] | None] = ContextVar("locations", default=None)
CHOICES: ContextVar[dict[Expr, tuple[Expr, int]] | None] = ContextVar("choices", default=None)
_given: ContextVar[Location | None] = ContextVar("given", default=None)
# Frames of these folders are never where the user wrote it.
_OWN = tuple(
    os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), d) + os.sep
    for d in ("expressions", "language", "simulators", "structural")
)
_OWN += (os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), "arguments.py"),)
_OWN += tuple(  # SciPy lies beside NumPy
    os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(np.__file__))), d) + os.sep
    for d in ("numpy", "scipy")
)


@contextmanager
def recording() -> Iterator[dict[Expr, Location]]:
    """Within the block, the first line where the user wrote each node is kept in the result."""
    locations: dict[Expr, Location] = {}
    token = LOCATIONS.set(locations)
    try:
        yield locations
    finally:
        LOCATIONS.reset(token)


@contextmanager
def choosing() -> Iterator[dict[Expr, tuple[Expr, int]]]:
    """Within the block, each element that a symbol chose is kept in the result, with the index and
    the number of elements. Its node alone does not tell: out of range it is the last element."""
    choices: dict[Expr, tuple[Expr, int]] = {}
    token = CHOICES.set(choices)
    try:
        yield choices
    finally:
        CHOICES.reset(token)


@contextmanager
def attributed(locations: dict[Expr, Location], location: Location) -> Iterator[None]:
    """Within the block, nodes that have none in `locations` yet get this location.

    For what is derived from a line of the user's rather than written there.
    """
    tokens = LOCATIONS.set(locations), _given.set(location)
    try:
        yield
    finally:
        LOCATIONS.reset(tokens[0])
        _given.reset(tokens[1])


def note(node: Expr, locations: dict[Expr, Location]) -> None:
    """Keep the location of a node that has none."""
    if node not in locations:
        locations[node] = _given.get() or user_location()


def user_location() -> Location:
    """The innermost frame that is neither ours nor NumPy's: where the user wrote it."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_OWN):
        frame = frame.f_back
    return Location(frame.f_code.co_filename, frame.f_lineno, frame.f_code.co_name)
