"""What the form of an expression says: whether it can be negative, which conditions it asks, and
where it has no value whatever its unknown symbols are (an index that no element has, the root of a
negative input).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, is_tuple, symbols_of, topological
from ssmppl.expressions.node import BOOLEAN, SEVERAL

# Kinds of symbols whose values the data tell, of the row and of the one before.
DATA, DATA_PREV = {"input", "time"}, {"input_prev", "time_prev", "observation_prev"}

_OF_ANY = {"exp", "abs", "sqrt"}  # none below 0, of whatever number
_OF_SUCH = {"add", "mul", "div", "maximum", "minimum"}  # of such numbers such a number

Choices = Mapping[Expr, tuple[Expr, int]]  # as `node.choosing` keeps them

# How a part has no value, the larger before the less: comparisons with NaN have one.
_FINE, _NAN, _OUTSIDE = np.int8(0), np.int8(1), np.int8(2)
_NOTHING_WRONG = np.zeros((), dtype=np.int8)

# Of finite numbers they are numbers, or infinite.
_ALWAYS = BOOLEAN | {"add", "sub", "mul", "neg", "abs", "sign", "floor", "ceil", "minimum",
                     "maximum", "where", "exp", "sin", "cos", "tanh", "arctan"}  # fmt: skip


def never_negative(e: Expr) -> bool:
    """Whether an expression can have no value below 0; one that is no number may be NaN."""
    if e.op == "const":
        return bool(e.data >= 0.0)
    if e.op in _OF_ANY:
        return True
    if e.op == "maximum" and any(map(never_negative, e.args)):
        return True
    if e.op == "where":
        return all(map(never_negative, e.args[1:]))
    return e.op in _OF_SUCH and all(map(never_negative, e.args))


def may_vanish_by_data(spread: Iterable[Expr]) -> bool:
    """Whether data enter a variance or a covariance, which may then be singular in some rows: a
    step of no length, an input that switches a noise off."""
    return any(s.data[0] in DATA | DATA_PREV for s in symbols_of(spread))


def conditions_of(forms: Iterable[Expr]) -> list[Expr]:
    """What `where` asks, without the words between: comparisons, and numbers that are 0 or not."""
    found: dict[Expr, None] = {}
    waiting = [n.args[0] for n in topological(list(forms)) if n.op == "where"]
    while waiting:
        node = waiting.pop()
        if node.op in ("and", "or", "not"):
            waiting += node.args
        elif node.op != "const":
            found[node] = None
    return list(found)


def affirmed(condition: Expr) -> tuple[Expr, bool]:
    """(the condition that this one is, or is the opposite of; whether it is the opposite)."""
    if condition.op == "le":  # a <= b is not b < a
        return Expr("lt", condition.args[::-1]), True
    return (Expr("eq", condition.args), True) if condition.op == "ne" else (condition, False)


@dataclass(frozen=True)
class Undefined:
    """The first place where an expression has no value.

    row : position in the arrays of the known symbols.
    node : the innermost part without a value there, all of whose own parts have one.
    index, elements : where `node` is an element of an array that does not exist.
    value : of the index.
    """

    row: int
    node: Expr
    index: Expr | None = None
    elements: int = 0
    value: float = np.nan


def may_be_undefined(root: Expr, choices: Choices, known: set[str]) -> bool:
    """Whether some part may have no value, as far as symbols of the `known` kinds decide."""
    computed: set[Expr] = set()
    for node in topological([root]):
        if node in choices and choices[node][0] in computed:
            return True
        if node.op == "symbol":
            if node.data[0] in known:
                computed.add(node)
        elif node.op != "random" and all(a in computed for a in node.args):
            if node.op not in _ALWAYS and node.op != "const":
                return True
            computed.add(node)
    return False


def first_undefined(
    roots: Sequence[Expr],
    choices: Choices,
    known: Mapping[Expr, np.ndarray],
    rows: int,
    asked: Sequence[np.ndarray] | None = None,
) -> tuple[int, Undefined] | None:
    """Which of `roots` has no value in some row, whatever the symbols outside `known` are, and the
    first row where.

    known : symbol -> (rows,) finite numbers, or NaN in rows that are not asked for.
    asked : for each root, (rows,) where it matters; None: everywhere.
    """
    nodes = list(topological(list(roots)))
    computed: set[Expr] = set()
    for node in nodes:  # made of numbers and the known symbols alone
        if node in known or (
            node.op not in ("symbol", "random") and all(a in computed for a in node.args)
        ):
            computed.add(node)
    ordered = [n for n in nodes if n in computed]
    values = dict(zip(ordered, evaluate(ordered, known), strict=True))
    state: dict[Expr, np.ndarray] = {}
    for node in nodes:
        state[node] = _state(node, state, values)
        if node in choices and choices[node][0] in values:
            index, elements = choices[node]
            k = values[index]
            inside = (k >= 0.0) & (k < elements) & (k == np.floor(k))
            state[node] = np.where(inside, state[node], _OUTSIDE)
    for place, root in enumerate(roots):
        bad = np.broadcast_to(state[root] > _FINE, rows)
        if asked is not None:
            bad = bad & asked[place]
        if bad.any():
            return place, _innermost(root, int(np.argmax(bad)), state, values, choices)
    return None


def _state(
    node: Expr, state: Mapping[Expr, np.ndarray], values: Mapping[Expr, np.ndarray]
) -> np.ndarray:
    """() or (rows,) of a node, by those of its parts and, where it has them, its values."""
    parts = [state[a] for a in node.args]
    if node.op in ("mul", "and"):  # a mask: what is times 0 is not asked for
        parts = [_unless(node.args[1 - k], parts[k], values) for k in (0, 1)]
    out = functools.reduce(np.maximum, parts) if parts else _NOTHING_WRONG
    if node.op == "where":
        condition, first, second = node.args
        if condition in values:
            chosen = np.where(values[condition], state[first], state[second])
        else:
            chosen = np.minimum(state[first], state[second])
        return np.maximum(state[condition], chosen)
    if node in values:
        value = np.asarray(values[node], dtype=float)  # matrices in the last two axes
        wrong = np.isnan(value)
        if node.op in SEVERAL or is_tuple(node):  # its numbers in the last axis
            wrong = wrong.any(axis=-1)
        elif value.ndim >= 2:
            wrong = wrong.any(axis=(-2, -1))
        if not wrong.any() and not out.any():
            return _NOTHING_WRONG
        return np.where(out == _OUTSIDE, _OUTSIDE, np.where(wrong, _NAN, _FINE))
    if node.op in BOOLEAN or node.op == "call":  # these may have a value where a part is NaN
        return np.where(out == _NAN, _FINE, out)
    return out


def _unless(mask: Expr, state: np.ndarray, values: Mapping[Expr, np.ndarray]) -> np.ndarray:
    """The state of a factor: fine where the other one is 0, unless it is NaN."""
    if mask not in values or not (state == _OUTSIDE).any():
        return state
    return np.where((values[mask] == 0) & (state == _OUTSIDE), _FINE, state)


def _innermost(
    node: Expr, row: int, state: Mapping[Expr, np.ndarray], values: Mapping[Expr, np.ndarray],
    choices: Choices,
) -> Undefined:  # fmt: skip
    """From a part that has no value in this row to the first one below it."""
    while True:
        parts = node.args
        if node.op == "where" and node.args[0] in values:
            parts = (node.args[0], node.args[1 if _at(values[node.args[0]], row) else 2])
        bad = [a for a in parts if _at(state[a], row)]
        if bad:
            node = bad[0]
            continue
        if node not in choices or choices[node][0] not in values:
            return Undefined(row, node)
        index, elements = choices[node]
        return Undefined(row, node, index, elements, float(_at(values[index], row)))


def _at(values: np.ndarray, row: int) -> Any:
    return values if np.ndim(values) == 0 else values[row]
