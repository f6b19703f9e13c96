"""Expr: one interned, immutable node type for scalar expressions.

Two expressions that are written alike *are* the same object, so shared work is found by identity
and expressions serve as dictionary keys. Vectors and matrices are NumPy object arrays of scalar
nodes (`ssmppl.expressions.arrays.ExprArray`); there is no array-valued node. The factorisations of
small matrices (`MATRIX_OPS`) are nodes over the matrix's entries, whose results are taken apart by
"item" nodes.

What an operation means is defined by `evaluate.py`, how it is spelled in generated code by
`codegen/render.py`, its derivative by `calculus.py`: three tables over the names below.
"""

from __future__ import annotations

import math
import operator
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

_UNARY = """neg exp log log1p expm1 sqrt sin cos tan arcsin arccos arctan sinh cosh tanh arcsinh
    arccosh arctanh abs sign floor ceil gammaln digamma trigamma ndtr log_ndtr ndtri erf erfc not"""
_BINARY = """add sub mul div pow mod maximum minimum arctan2 logaddexp lt le eq ne and or
    gammainc gammaincc gammaincinv gammainccinv poisson_quantile"""
UNARY, BINARY = _UNARY.split(), _BINARY.split()
TERNARY = ["where", "betainc", "betaincinv", "binomial_quantile", "negbinomial_quantile"]
MATRIX_OPS = ("cholesky", "inverse", "logdet", "det")  # args: the n*n entries, row by row
OPS = frozenset(
    [*UNARY, *BINARY, *TERNARY, *MATRIX_OPS, "const", "symbol", "item", "random", "call"]
)
BOOLEAN = frozenset(("lt", "le", "eq", "ne", "and", "or", "not"))

_interned: weakref.WeakValueDictionary[tuple, Expr] = weakref.WeakValueDictionary()
_lock = threading.Lock()
_locations: ContextVar[dict[Expr, Location] | None] = ContextVar("locations", default=None)
# Frames of these folders are never the place "where the user wrote it".
_OWN = tuple(
    os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), d) + os.sep
    for d in ("expressions", "language")
)
_OWN += tuple(  # SciPy lies beside NumPy
    os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(np.__file__))), d) + os.sep
    for d in ("numpy", "scipy")
)


def _method(op: str) -> Callable[[Expr], Expr]:
    def method(self: Expr) -> Expr:
        return apply(op, self)

    return method


class Expr:
    """A scalar expression: operation name, argument nodes, and data that is no node.

    `data` holds the value of a "const", (kind, name, index) of a "symbol", the position of an
    "item", (kind, key) of a "random" draw, the function of a "call", the size of a matrix.
    """

    __slots__ = ("__weakref__", "args", "data", "op")
    op: str
    args: tuple[Expr, ...]
    data: Any

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
                _interned[key] = node
        places = _locations.get()
        if places is not None and args and node not in places:  # symbols are not written there
            places[node] = user_location()
        return node

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError("expressions are immutable")

    def __reduce__(self):  # as a flat table, for graphs deeper than Python's recursion limit
        return unpack_one, (pack([self]),)

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
        return apply("floor", self / other)

    def __rfloordiv__(self, other):
        return apply("floor", other / self)

    def __neg__(self):
        return apply("neg", self)

    def __pos__(self):
        return self

    def __abs__(self):
        return apply("abs", self)

    def __floor__(self):
        return apply("floor", self)

    def __ceil__(self):
        return apply("ceil", self)

    def __lt__(self, other):
        return _binary("lt", self, other)

    def __le__(self, other):
        return _binary("le", self, other)

    def __gt__(self, other):
        return _binary("lt", other, self)

    def __ge__(self, other):
        return _binary("le", other, self)

    def __eq__(self, other):
        return _binary("eq", self, other)

    def __ne__(self, other):
        return _binary("ne", self, other)

    def __and__(self, other):
        return _binary("and", self, other)

    def __rand__(self, other):
        return _binary("and", other, self)

    def __or__(self, other):
        return _binary("or", self, other)

    def __ror__(self, other):
        return _binary("or", other, self)

    def __invert__(self):
        return apply("not", self)

    def __bool__(self) -> bool:
        raise UnsupportedOperation(
            "a Python `if`, `and`, `or`, `min`, `max` or comparison needs the truth of a symbol, "
            "which has no value while the model is traced",
            fix="write np.where(condition, a, b), np.minimum / np.maximum, or & and | for "
            "conditions; build arrays of symbols that are compared by np.stack([...])",
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
            fix="to select from numbers, np.sum(np.where(np.arange(len(table)) == k, table, 0)); "
            "an array of symbols takes a symbol as its first index",
            where=user_location(),
        )

    __int__ = __index__

    # np.exp(np.array([x, y])): on its plain arrays of objects NumPy calls the elements' methods.
    exp, log, log1p, expm1, sqrt = map(_method, ("exp", "log", "log1p", "expm1", "sqrt"))
    sin, cos, tan, arcsin, arccos, arctan = map(
        _method, ("sin", "cos", "tan", "arcsin", "arccos", "arctan")
    )
    sinh, cosh, tanh, arcsinh, arccosh, arctanh = map(
        _method, ("sinh", "cosh", "tanh", "arcsinh", "arccosh", "arctanh")
    )

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        return _protocol().apply_ufunc(ufunc, method, inputs, kwargs)

    def __array_function__(self, func, types, args, kwargs):
        return _protocol().apply_function(func, args, kwargs)

    def __repr__(self) -> str:
        return to_text(self)


def _protocol():
    # arrays.py builds on this module; NumPy's dispatch needs it from here, by its loaded module.
    return sys.modules["ssmppl.expressions.arrays"]


def constant(value: float) -> Expr:
    """The node of a number."""
    return Expr("const", (), float(value))


def symbol(kind: str, name: str, index: tuple[int, ...] = ()) -> Expr:
    """The node of one scalar component of a named quantity, for instance a state's."""
    return Expr("symbol", (), (kind, name, index))


def as_expr(value: Any) -> Expr:
    """`value` as a node: nodes as they are, numbers as constants; TypeError for all else."""
    if isinstance(value, Expr):
        return value
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return as_expr(value.item())
    if isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating)):
        return constant(float(value))
    raise TypeError(f"no expression can be made of {value!r} of type {type(value).__name__}")


def _binary(op: str, a: Any, b: Any) -> Any:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return NotImplemented
    try:
        return apply(op, as_expr(a), as_expr(b))
    except TypeError as error:
        if isinstance(error, UnsupportedOperation):
            raise
        return NotImplemented


def apply(op: str, *operands: Any) -> Expr:
    """The node of `op` on nodes or numbers, with constants folded and neutral elements dropped.

    As in the algebra of real numbers, 0 * x and x - x are 0 and log(exp(x)) is x whatever x is,
    also where IEEE arithmetic would overflow or give nan.
    """
    args = tuple(as_expr(a) for a in operands)
    if op not in BOOLEAN and op != "where":  # arithmetic on a condition: 1 where it holds
        args = tuple(_number(a) for a in args)
    elif op == "where":
        args = (args[0], _number(args[1]), _number(args[2]))
    if all(a.op == "const" for a in args) and op in _FOLD:
        with np.errstate(all="ignore"):
            return constant(_FOLD[op](*(np.float64(a.data) for a in args)))
    simplify = _SIMPLIFY.get(op)
    simple = simplify(*args) if simplify else None
    return Expr(op, args) if simple is None else simple


def _number(a: Expr) -> Expr:
    return Expr("where", (a, constant(1.0), constant(0.0))) if a.op in BOOLEAN else a


def _is(a: Expr, value: float) -> bool:
    return a.op == "const" and a.data == value


def _simplify_add(a, b):
    if _is(a, 0.0):
        return b
    if _is(b, 0.0):
        return a
    return apply("sub", a, b.args[0]) if b.op == "neg" else None


def _simplify_sub(a, b):
    if _is(b, 0.0):
        return a
    if _is(a, 0.0):
        return apply("neg", b)
    if a is b:
        return constant(0.0)
    return apply("add", a, b.args[0]) if b.op == "neg" else None


def _simplify_mul(a, b):
    if _is(a, 0.0) or _is(b, 0.0):
        return constant(0.0)
    if b.op == "const" and a.op != "const":  # the number first, so that spellings meet
        return apply("mul", b, a)
    if a.op == "neg":
        return apply("neg", apply("mul", a.args[0], b))
    if b.op == "neg":
        if a.op == "const":
            return apply("mul", constant(-a.data), b.args[0])
        return apply("neg", apply("mul", a, b.args[0]))
    if a.op == "const" and b.op == "mul" and b.args[0].op == "const":
        return apply("mul", constant(a.data * b.args[0].data), b.args[1])
    if _is(a, 1.0):
        return b
    return apply("neg", b) if _is(a, -1.0) else None


def _simplify_div(a, b):
    if _is(b, 1.0):
        return a
    if a.op == "const" and b.op == "div" and b.args[0].op == "const" and b.args[0].data != 0:
        return apply("mul", a.data / b.args[0].data, b.args[1])  # 1 / (1 / x)
    return constant(0.0) if _is(a, 0.0) and not _is(b, 0.0) else None


def _simplify_pow(a, b):
    if b.op != "const":
        return None
    rules = {0.0: lambda: constant(1.0), 1.0: lambda: a, 0.5: lambda: apply("sqrt", a)}
    rules[-1.0] = lambda: apply("div", 1.0, a)
    return rules[b.data]() if b.data in rules else None


def _simplify_log(a):
    """log(exp x) = x, and positive factors that are numbers come out."""
    if a.op == "exp":
        return a.args[0]
    if a.op == "mul" and a.args[0].op == "const" and a.args[0].data > 0:
        return constant(math.log(a.args[0].data)) + apply("log", a.args[1])
    if a.op == "div" and a.args[0].op == "const" and a.args[0].data > 0:
        return constant(math.log(a.args[0].data)) - apply("log", a.args[1])
    return None


def _simplify_neg(a):
    if a.op == "neg":
        return a.args[0]
    if a.op == "mul" and a.args[0].op == "const":
        return apply("mul", constant(-a.args[0].data), a.args[1])
    return None


def _simplify_where(c, a, b):
    if c.op == "const":
        return a if c.data else b
    return a if a is b else None


_SIMPLIFY: dict[str, Callable[..., Expr | None]] = {
    "add": _simplify_add,
    "sub": _simplify_sub,
    "mul": _simplify_mul,
    "div": _simplify_div,
    "pow": _simplify_pow,
    "log": _simplify_log,
    "neg": _simplify_neg,
    "where": _simplify_where,
}
# Constants are folded with NumPy's arithmetic, which is the meaning of these operations.
_FOLD: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in UNARY if hasattr(np, name)},
    "neg": operator.neg, "abs": abs, "add": operator.add, "sub": operator.sub,
    "mul": operator.mul, "div": np.divide, "pow": np.power, "mod": np.mod,
    "maximum": np.maximum, "minimum": np.minimum, "arctan2": np.arctan2,
    "logaddexp": np.logaddexp, "gammaln": lambda x: _gammaln(x), "where": np.where,
    "lt": operator.lt, "le": operator.le, "eq": operator.eq, "ne": operator.ne,
    "and": np.logical_and, "or": np.logical_or, "not": np.logical_not,
}  # fmt: skip


def _gammaln(x: float) -> float:
    if not math.isfinite(x):
        return math.inf if x > 0 else math.nan
    return math.inf if x <= 0 and x == int(x) else math.lgamma(x)


def matrix_op(op: str, entries: Iterable[Any], n: int) -> Expr:
    """The node of a factorisation of the n x n matrix with these entries, row by row."""
    return Expr(op, tuple(as_expr(e) for e in entries), n)


def item(node: Expr, i: int, j: int) -> Expr:
    """Entry (i, j) of a matrix-valued node ("cholesky" or "inverse")."""
    return Expr("item", (node,), (i, j))


def topological(roots: Iterable[Expr]) -> list[Expr]:
    """Every node under `roots`, arguments before users, each once; without recursion."""
    order: list[Expr] = []
    seen: set[Expr] = set()
    stack = [(r, False) for r in reversed(list(roots))]
    while stack:
        node, expanded = stack.pop()
        if expanded:
            order.append(node)
        elif node not in seen:
            seen.add(node)
            stack.append((node, True))
            stack.extend((a, False) for a in reversed(node.args) if a not in seen)
    return order


def pack(roots: Iterable[Expr]) -> list[tuple[str, tuple[int, ...], Any]]:
    """Every node under `roots` as (operation, places of its arguments in this list, data)."""
    place: dict[Expr, int] = {}
    table: list[tuple[str, tuple[int, ...], Any]] = []
    for node in topological(roots):
        place[node] = len(table)
        table.append((node.op, tuple(place[a] for a in node.args), node.data))
    return table


def unpack(table: list[tuple[str, tuple[int, ...], Any]]) -> list[Expr]:
    """The nodes of a table made by `pack`, interned."""
    nodes: list[Expr] = []
    for op, args, data in table:
        nodes.append(Expr(op, tuple(nodes[i] for i in args), data))
    return nodes


def unpack_one(table: list[tuple[str, tuple[int, ...], Any]]) -> Expr:
    """The last node of a table: the root it was made for."""
    return unpack(table)[-1]


def symbols_of(roots: Expr | Iterable[Expr]) -> frozenset[Expr]:
    """The symbols that occur under `roots`."""
    nodes = topological([roots] if isinstance(roots, Expr) else roots)
    return frozenset(n for n in nodes if n.op == "symbol")


def dependent(roots: Iterable[Expr], on: Iterable[Expr]) -> set[Expr]:
    """The nodes under `roots` (themselves included) that depend on some node of `on`."""
    found = set(on)
    for node in topological(roots):
        if any(a in found for a in node.args):
            found.add(node)
    return found


def depends_on(expression: Expr, symbols: Iterable[Expr]) -> bool:
    """Whether the expression depends on some symbol of `symbols`."""
    return expression in dependent([expression], symbols)


def substitute(roots: list[Expr], replacement: dict[Expr, Expr]) -> list[Expr]:
    """`roots` with nodes replaced, simplified again on the way up."""
    done = dict(replacement)
    for node in topological(roots):
        if node in done:
            continue
        args = tuple(done[a] for a in node.args)
        if all(new is old for new, old in zip(args, node.args, strict=True)):
            done[node] = node
        elif node.op in _SIMPLIFY or node.op in _FOLD:
            done[node] = apply(node.op, *args)
        else:
            done[node] = Expr(node.op, args, node.data)
    return [done[r] for r in roots]


@contextmanager
def recording() -> Iterator[dict[Expr, Location]]:
    """Within the block, the first place where the user wrote each node is kept in the result."""
    places: dict[Expr, Location] = {}
    token = _locations.set(places)
    try:
        yield places
    finally:
        _locations.reset(token)


def user_location() -> Location:
    """The innermost frame that is neither ours nor NumPy's: where the user wrote it."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_OWN):
        frame = frame.f_back
    return Location(frame.f_code.co_filename, frame.f_lineno, frame.f_code.co_name)


_INFIX = {"add": ("+", 1), "sub": ("-", 1), "mul": ("*", 2), "div": ("/", 2), "pow": ("**", 4)}
_INFIX |= {"lt": ("<", 0), "le": ("<=", 0), "eq": ("==", 0), "ne": ("!=", 0), "mod": ("%", 2)}


def symbol_text(node: Expr) -> str:
    """The name of a symbol as a person writes it: `x`, `x_prev`, `beta[2]`."""
    kind, name, index = node.data
    suffix = "_prev" if kind.endswith("_prev") else ""
    return name + suffix + (f"[{', '.join(map(str, index))}]" if index else "")


def to_text(root: Expr) -> str:
    """The expression as a person writes it."""
    done: dict[Expr, tuple[str, int]] = {}
    for node in topological([root]):
        parts = [done[a] for a in node.args]
        if node.op == "const":
            done[node] = (f"{node.data:.10g}", 9 if node.data >= 0 else 1)
        elif node.op == "symbol":
            done[node] = (symbol_text(node), 9)
        elif node.op in _INFIX:
            sign, level = _INFIX[node.op]
            (a, la), (b, lb) = parts
            left = f"({a})" if la < level or (node.op == "pow" and la == level) else a
            tight = sign not in "+*" or node.args[1].op == "mod"
            right = f"({b})" if lb < level or (lb == level and tight) else b
            done[node] = (f"{left}{sign}{right}" if level > 1 else f"{left} {sign} {right}", level)
        elif node.op == "neg":
            a, level = parts[0]
            done[node] = (f"-({a})" if level < 2 else f"-{a}", 1)
        elif node.op == "item":
            done[node] = (f"{parts[0][0]}[{node.data[0]}, {node.data[1]}]", 9)
        else:
            name = node.data[0] if node.op == "random" else node.op
            done[node] = (f"{name}({', '.join(p[0] for p in parts)})", 9)
    return done[root][0]
