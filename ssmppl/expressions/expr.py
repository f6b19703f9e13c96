"""Scalar expressions, for the rest of the project: the names of `node.py`, and

- `apply`: an operation with constants folded, neutral elements dropped, spellings brought together;
- walks over the graph under expressions: order, tables for pickling, dependence, substitution;
- `to_text`: an expression as a person writes it.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Container, Iterable
from typing import Any

import numpy as np

from ssmppl.expressions import special
from ssmppl.expressions.node import (
    BOOLEAN,
    INDEX_BY_SYMBOL,
    SEVERAL,
    Expr,
    as_expr,
    attributed,
    behaviour,
    constant,
    is_tuple,
    item,
    matrix_op,
    recording,
    symbol,
    user_location,
)
from ssmppl.expressions.operations import (
    MATRIX_OPS,
    OPERATIONS,
    WRITTEN,
    Level,
    Phrase,
    Text,
    call,
    infix,
    within,
)

__all__ = [
    "BOOLEAN",
    "INDEX_BY_SYMBOL",
    "MATRIX_OPS",
    "Expr",
    "as_expr",
    "attributed",
    "constant",
    "is_tuple",
    "item",
    "matrix_op",
    "recording",
    "symbol",
    "user_location",
]


_FACTORS = {"neg", "mul", "div"}


# -- operations, simplified
def apply(op: str, *operands: Any) -> Expr:
    """The node of `op` on nodes or numbers, with constants folded and neutral elements dropped.

    As in the algebra of real numbers, 0 * x and x - x are 0 and log(exp(x)) is x whatever x is,
    also where IEEE arithmetic would overflow or give nan.
    """
    args = tuple(as_expr(a) for a in operands)
    if op not in BOOLEAN and op != "where":  # arithmetic on a condition: 1 where it holds
        args = tuple(_as_number(a) for a in args)
    elif op == "where":
        args = (args[0], _as_number(args[1]), _as_number(args[2]))
    if all(a.op == "const" for a in args) and op in FOLD:
        with np.errstate(all="ignore"):
            return constant(FOLD[op](*(np.float64(a.data) for a in args)))
    for _, applies, result in RULES.get(op, ()):
        if applies(*args):
            return result(*args)
    return Expr(op, args)


behaviour["apply"] = apply


def _as_number(a: Expr) -> Expr:
    return Expr("where", (a, constant(1.0), constant(0.0))) if a.op in BOOLEAN else a


def _gammaln(x: float) -> float:
    if not math.isfinite(x):
        return math.inf if x > 0 else math.nan
    return math.inf if x <= 0 and x == int(x) else math.lgamma(x)


# Constants are folded with NumPy's arithmetic, which is the meaning of these operations.
FOLD: dict[str, Callable[..., Any]] = {
    **{n: o.function for n, o in OPERATIONS.items() if o.numpy.startswith("np.")},
    "gammaln": _gammaln, "gammaln_rise": special.gammaln_rise, "betaln": special.betaln,
}  # fmt: skip


def _is(a: Expr, value: float) -> bool:
    return a.op == "const" and a.data == value


def _number(a: Expr) -> bool:
    return a.op == "const"


def _begins_with_number(a: Expr, op: str) -> bool:
    """c x or c / x, as `op` says; the rules of "mul" put the number first."""
    return a.op == op and a.args[0].op == "const"


def _begins_with_positive(a: Expr, op: str) -> bool:
    return _begins_with_number(a, op) and a.args[0].data > 0


def _holds_above(a: Expr, d: Expr) -> bool:
    """a = max(x, c) with a number c of at least the number d."""
    if not (_number(d) and a.op == "maximum"):
        return False
    return any(_number(c) and d.data <= c.data for c in a.args)


def without_exponentials(a: Expr) -> tuple[Expr, Expr | None]:
    """(b, e) with a = b exp(e), for products and quotients; no e where no factor is an exp."""
    done: dict[Expr, tuple[Expr, Expr | None]] = {}
    waiting = [a]
    while waiting:  # a product may have thousands of factors, and share them
        node = waiting[-1]
        missing = [f for f in node.args if f not in done] if node.op in _FACTORS else []
        waiting += missing
        if not missing:
            done[waiting.pop()] = _gathered(node, done)
    return done[a]


def _gathered(a: Expr, done: dict[Expr, tuple[Expr, Expr | None]]) -> tuple[Expr, Expr | None]:
    """As `without_exponentials`, from what is known of the factors."""
    if a.op == "exp":
        return constant(1.0), a.args[0]
    if a.op == "neg":
        rest, exponent = done[a.args[0]]
        return (-rest, exponent) if exponent is not None else (a, None)
    if a.op not in _FACTORS:
        return a, None
    (left, up), (right, down) = (done[f] for f in a.args)
    if up is None and down is None:
        return a, None
    if down is not None and a.op == "div":
        down = -down
    parts = [e for e in (up, down) if e is not None]
    return apply(a.op, left, right), parts[0] if len(parts) == 1 else parts[0] + parts[1]


def _log_without_exponentials(a: Expr) -> Expr:
    rest, exponent = without_exponentials(a)
    assert exponent is not None
    return apply("log", rest) + exponent


# By operation: the mathematics (c, d are numbers), where the rule applies, what it gives. The first
# that applies is taken. Arguments that are all numbers are folded before.
Rule = tuple[str, Callable[..., bool], Callable[..., Expr]]
RULES: dict[str, tuple[Rule, ...]] = {
    "add": (
        ("0 + b = b", lambda a, b: _is(a, 0.0), lambda a, b: b),
        ("a + 0 = a", lambda a, b: _is(b, 0.0), lambda a, b: a),
        ("a + (-b) = a - b", lambda a, b: b.op == "neg", lambda a, b: a - b.args[0]),
    ),
    "sub": (
        ("a - 0 = a", lambda a, b: _is(b, 0.0), lambda a, b: a),
        ("0 - b = -b", lambda a, b: _is(a, 0.0), lambda a, b: -b),
        ("a - a = 0", lambda a, b: a is b, lambda a, b: constant(0.0)),
        ("a - (-b) = a + b", lambda a, b: b.op == "neg", lambda a, b: a + b.args[0]),
    ),
    "mul": (
        ("0 b = 0", lambda a, b: _is(a, 0.0), lambda a, b: constant(0.0)),
        ("a 0 = 0", lambda a, b: _is(b, 0.0), lambda a, b: constant(0.0)),
        ("a c = c a", lambda a, c: _number(c), lambda a, c: c * a),
        ("(-a) b = -(a b)", lambda a, b: a.op == "neg", lambda a, b: -(a.args[0] * b)),
        ("c (-b) = (-c) b", lambda c, b: _number(c) and b.op == "neg", lambda c, b: -c * b.args[0]),
        ("a (-b) = -(a b)", lambda a, b: b.op == "neg", lambda a, b: -(a * b.args[0])),
        ("c (d x) = (c d) x",
         lambda c, b: _number(c) and _begins_with_number(b, "mul"),
         lambda c, b: (c * b.args[0]) * b.args[1]),
        ("1 b = b", lambda a, b: _is(a, 1.0), lambda a, b: b),
        ("(-1) b = -b", lambda a, b: _is(a, -1.0), lambda a, b: -b),
    ),
    "div": (
        ("a / 1 = a", lambda a, b: _is(b, 1.0), lambda a, b: a),
        ("c / (d / x) = (c / d) x, d not 0",
         lambda c, b: _number(c) and _begins_with_number(b, "div") and b.args[0].data != 0,
         lambda c, b: (c / b.args[0]) * b.args[1]),
        ("0 / b = 0", lambda a, b: _is(a, 0.0), lambda a, b: constant(0.0)),
    ),
    "pow": (
        ("a ** 0 = 1", lambda a, b: _is(b, 0.0), lambda a, b: constant(1.0)),
        ("a ** 1 = a", lambda a, b: _is(b, 1.0), lambda a, b: a),
        ("a ** 0.5 = sqrt(a)", lambda a, b: _is(b, 0.5), lambda a, b: apply("sqrt", a)),
        ("a ** -1 = 1 / a", lambda a, b: _is(b, -1.0), lambda a, b: 1.0 / a),
    ),
    "log": (
        ("log(exp x) = x", lambda a: a.op == "exp", lambda a: a.args[0]),
        ("log(b exp(x)) = log b + x, also where exp(x) under- or overflows",
         lambda a: without_exponentials(a)[1] is not None, _log_without_exponentials),
        ("log(c x) = log c + log x, c > 0",
         lambda a: _begins_with_positive(a, "mul"),
         lambda a: math.log(a.args[0].data) + apply("log", a.args[1])),
        ("log(c / x) = log c - log x, c > 0",
         lambda a: _begins_with_positive(a, "div"),
         lambda a: math.log(a.args[0].data) - apply("log", a.args[1])),
    ),
    "neg": (
        ("-(-x) = x", lambda a: a.op == "neg", lambda a: a.args[0]),
        ("-(c x) = (-c) x",
         lambda a: _begins_with_number(a, "mul"), lambda a: -a.args[0] * a.args[1]),
    ),
    "minimum": (
        ("min(max(a, c), d) = d, d <= c", _holds_above, lambda a, d: d),
    ),
    "where": (
        ("where(c, a, b) = a if c else b",
         lambda c, a, b: _number(c), lambda c, a, b: a if c.data else b),
        ("where(x, a, a) = a", lambda x, a, b: a is b, lambda x, a, b: a),
    ),
}  # fmt: skip


def split_constant(e: Expr) -> tuple[float, Expr]:
    """e = number * core."""
    number, one = 1.0, constant(1.0)
    while True:
        if e.op == "const":
            return number * e.data, one
        if e.op == "neg":
            number, e = -number, e.args[0]
        elif e.op == "mul" and e.args[0].op == "const":
            number, e = number * e.args[0].data, e.args[1]
        elif e.op == "mul" and e.args[1].op == "const":
            number, e = number * e.args[1].data, e.args[0]
        elif e.op == "div" and e.args[1].op == "const":
            number, e = number / e.args[1].data, e.args[0]
        else:
            return number, e


def several(node: Expr) -> bool:
    """Whether the node is several numbers, a matrix, the end of a loop or what a simulator or a
    primitive gives, of which "item" nodes take one."""
    return node.op in ("cholesky", "inverse", *SEVERAL) or is_tuple(node)


# -- walks over the graph
def topological(
    roots: Iterable[Expr], within: Container[Expr] | None = None, until: Container[Expr] = ()
) -> list[Expr]:
    """Every node under `roots`, arguments before users, each once; without recursion.

    within : other nodes are left out, with whatever is reached only through them.
    until : what is reached only through these nodes is left out, themselves not.
    """
    order: list[Expr] = []
    seen: set[Expr] = set()
    stack = [(r, False) for r in reversed(list(roots)) if within is None or r in within]
    while stack:
        node, expanded = stack.pop()
        if expanded:
            order.append(node)
        elif node not in seen:
            seen.add(node)
            stack.append((node, True))
            if node in until:
                continue
            stack.extend(
                (a, False) for a in reversed(node.args)
                if a not in seen and (within is None or a in within)
            )  # fmt: skip
    return order


Table = list[tuple[str, tuple[int, ...], Any]]


def pack(roots: Iterable[Expr]) -> tuple[Table, list[int]]:
    """Every node under `roots` as (operation, places of its arguments in this list, data), and the
    places of the roots."""
    place: dict[Expr, int] = {}
    table: Table = []
    roots = list(roots)
    for node in topological(roots):
        place[node] = len(table)
        table.append((node.op, tuple(place[a] for a in node.args), node.data))
    return table, [place[r] for r in roots]


def unpack(table: Table) -> list[Expr]:
    """The nodes of a table made by `pack`, interned."""
    nodes: list[Expr] = []
    for op, args, data in table:
        nodes.append(Expr(op, tuple(nodes[i] for i in args), data))
    return nodes


def unpack_one(table: Table) -> Expr:
    """The last node of a table: the root it was made for."""
    return unpack(table)[-1]


def _reduced(node: Expr) -> tuple[Callable[..., Expr], tuple[Any, ...]]:
    """For pickling: as a flat table, for graphs deeper than Python's recursion limit."""
    return unpack_one, (pack([node])[0],)


behaviour["pickle"] = _reduced


def symbols_in(node: Expr) -> frozenset[Expr]:
    """The symbols that occur under one node; kept, as large models ask for them again and again."""
    if node._symbols is not None:
        return node._symbols
    stack = [node]
    while stack:
        top = stack[-1]
        unknown = [a for a in top.args if a._symbols is None]
        if unknown:
            stack += unknown
            continue
        stack.pop()
        if top._symbols is None:
            object.__setattr__(top, "_symbols", _united(top))
    assert node._symbols is not None
    return node._symbols


def _united(node: Expr) -> frozenset[Expr]:
    """The union of the arguments' symbols; the largest of them itself where it holds the others, so
    that few sets are made."""
    if node.op == "symbol":
        return frozenset((node,))
    each = [a._symbols for a in node.args if a._symbols]
    if not each:
        return frozenset()
    largest = max(each, key=len)
    return largest if all(s <= largest for s in each) else frozenset().union(*each)


def symbols_of(roots: Expr | Iterable[Expr]) -> frozenset[Expr]:
    """The symbols that occur under `roots`."""
    if isinstance(roots, Expr):
        return symbols_in(roots)
    return frozenset[Expr]().union(*(symbols_in(r) for r in roots))


def dependent(roots: Iterable[Expr], on: Iterable[Expr]) -> set[Expr]:
    """The nodes under `roots` (themselves included) that depend on some node of `on`."""
    found = set(on)
    if all(n.op == "symbol" for n in found):  # only where they occur
        wanted = frozenset(found)
        stack = [r for r in roots if not wanted.isdisjoint(symbols_in(r))]
        while stack:
            node = stack.pop()
            if node in found:
                continue
            found.add(node)
            stack += [a for a in node.args if not wanted.isdisjoint(symbols_in(a))]
        return found
    for node in topological(roots):
        if any(a in found for a in node.args):
            found.add(node)
    return found


def depends_on(expression: Expr, symbols: Iterable[Expr]) -> bool:
    """Whether the expression depends on some symbol of `symbols`."""
    return not symbols_in(expression).isdisjoint(symbols)


def substitute(roots: list[Expr], replacement: dict[Expr, Expr]) -> list[Expr]:
    """`roots` with nodes replaced, simplified again on the way up."""
    done = dict(replacement)
    for node in topological(roots):
        if node in done:
            continue
        done[node] = rebuilt(node, tuple(done[a] for a in node.args))
    return [done[r] for r in roots]


def rebuilt(node: Expr, args: tuple[Expr, ...]) -> Expr:
    """The node with other arguments, simplified."""
    if all(new is old for new, old in zip(args, node.args, strict=True)):
        return node
    return apply(node.op, *args) if node.op in FOLD else Expr(node.op, args, node.data)


# -- text
# As in Python, but -a * b is -(a * b), and what only rounding tells apart has no parentheses.
_PHRASES: dict[str, Phrase] = {
    **{n: call(n, o.operands) for n, o in OPERATIONS.items()},
    **{n: WRITTEN[n] for n in ("lt", "le", "eq", "ne", "sub")},
    "neg": Phrase("-{0}", Level.SUM, (Level.PRODUCT,)),
    "add": infix(" + ", Level.SUM, right=0),
    "mul": infix("*", Level.PRODUCT, right=0),
    "div": infix("/", Level.PRODUCT),
    "mod": infix("%", Level.PRODUCT),
    "pow": infix("**", Level.POWER, 1, 1),
    "gammaln_rise": Phrase("gammaln({0} + {1}) - gammaln({0})", Level.SUM, (Level.CHOICE,) * 2),
    "digamma_rise": Phrase("digamma({0} + {1}) - digamma({0})", Level.SUM, (Level.CHOICE,) * 2),
}
LONGEST = 10_000


def symbol_text(node: Expr) -> str:
    """The name of a symbol as a person writes it: `x`, `x_prev`, `beta[2]`; `measured(y[0])` of
    what is 1 where y[0] is in the data."""
    kind, name, index = node.data
    suffix = "_prev" if kind.endswith("_prev") else ""
    text = name + suffix + (f"[{', '.join(map(str, index))}]" if index else "")
    return f"measured({text})" if kind.startswith("seen") else text


def _matrix_name(node: Expr) -> str | None:
    """The name of the parameter, or the text of the inverse, that a matrix node is made of."""
    n, first = node.data, node.args[0]
    cells = [(i, j) for i in range(n) for j in range(n)]
    if first.op == "symbol":
        kind, name, _ = first.data
        for whole in (cells, [(max(c), min(c)) for c in cells]):  # any matrix; a symmetric one
            if all(
                a.op == "symbol" and a.data == (kind, name, c)
                for a, c in zip(node.args, whole, strict=True)
            ):
                return symbol_text(first).partition("[")[0]
    if first.op == "item" and first.args[0].data == n:
        source = first.args[0]
        if all(
            a.op == "item" and a.args[0] is source and a.data == c
            for a, c in zip(node.args, cells, strict=True)
        ):
            return to_text(source)
    return None


def _bare(a: Expr) -> Expr:
    """a of where(0 <= a, a, nan): what the densities of distributions put in place of their a."""
    if a.op == "where" and a.args[2].op == "const" and math.isnan(a.args[2].data):
        return a.args[1] if a.args[0] is behaviour["apply"]("le", 0.0, a.args[1]) else a
    return a


def to_text(root: Expr, longest: int = LONGEST, done: dict[Expr, Text] | None = None) -> str:
    """The expression as a person writes it.

    Written out, an expression that shares its parts can be exponentially longer than its graph:
    what has more than `longest` characters is cut, with a mark that differs where the rest does.

    done : the texts of expressions that were written so, with the same `longest`; completed.
    """
    if root.op == "symbol":
        return symbol_text(root)
    done = {} if done is None else done
    for node in topological([root], until=done):
        if node in done:
            continue
        args = map(_bare, node.args) if node.op == "gammaln" else node.args
        text, level = done[node] = _written(node, [done[a] for a in args])
        if len(text) > longest:
            mark = hashlib.sha256(text.encode()).hexdigest()[:8]
            done[node] = f"{text[:longest]}...{mark}", level
    return done[root][0]


def _written(node: Expr, parts: list[Text]) -> Text:
    """One node, from the texts of its arguments."""
    op = node.op
    if (phrase := _PHRASES.get(op)) is not None:
        if op == "mul" and node.args[1].op == "mod":  # a * b % c is (a * b) % c
            parts = [parts[0], (within(parts[1], Level.ATOM), Level.ATOM)]
        return phrase.of(parts)
    if op == "const":
        return f"{node.data:.10g}", Level.ATOM if node.data >= 0 else Level.SUM
    if op == "symbol":
        return symbol_text(node), Level.ATOM
    if op == "item":
        return f"{parts[0][0]}[{', '.join(map(str, node.data))}]", Level.ATOM
    if op == "simulator":  # the last argument is the row, for messages
        return f"{node.data!r}({', '.join(text for text, _ in parts[:-1])})", Level.ATOM
    if op == "loop":  # what it depends on, and a mark of how
        whole = f"{node.data!r}({', '.join(text for text, _ in parts)})"
        mark = hashlib.sha256(whole.encode()).hexdigest()[:6]
        known = sorted(symbols_in(node), key=lambda s: (s.data[0] == "parameter", repr(s.data)))
        return f"{node.data.name}_{mark}({', '.join(map(symbol_text, known))})", Level.ATOM
    inside = _matrix_name(node) if op in MATRIX_OPS else None
    if inside is None:
        inside = ", ".join(text for text, _ in parts)
    if op == "call":  # by the name that its user gave it
        return f"{getattr(node.data, '__name__', op)}({inside})", Level.ATOM
    return f"{node.data[0] if op == 'random' else op}({inside})", Level.ATOM


behaviour["text"] = to_text
