"""Where an expression has no value whatever its unknown symbols are: an index that no element has,
the root of a negative input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.graph import topological
from ssmppl.expressions.node import BOOLEAN, Expr

Choices = Mapping[Expr, tuple[Expr, int]]  # as `provenance.choosing` keeps them

# How a part has no value, the larger before the less: comparisons with NaN have one.
_FINE, _NAN, _OUTSIDE = 0, 1, 2

# Of finite numbers they are numbers, or infinite.
_ALWAYS = BOOLEAN | {"add", "sub", "mul", "neg", "abs", "sign", "floor", "ceil", "minimum",
                     "maximum", "where", "exp", "sin", "cos", "tanh", "arctan"}  # fmt: skip


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
    root: Expr, choices: Choices, known: Mapping[Expr, np.ndarray], rows: int
) -> Undefined | None:
    """The first row where `root` has no value, whatever the symbols outside `known` are.

    known : symbol -> (rows,) finite numbers.
    """
    nodes = list(topological([root]))
    found: set[Expr] = set()
    for node in nodes:  # made of numbers and the known symbols alone
        if node in known or (
            node.op not in ("symbol", "random") and all(a in found for a in node.args)
        ):
            found.add(node)
    ordered = [n for n in nodes if n in found]
    values = dict(zip(ordered, evaluate(ordered, known), strict=True))
    state: dict[Expr, np.ndarray] = {}
    for node in nodes:
        state[node] = _state(node, state, values, rows)
        if node in choices and choices[node][0] in values:
            index, elements = choices[node]
            k = values[index]
            inside = (k >= 0.0) & (k < elements) & (k == np.floor(k))
            state[node] = np.where(inside, state[node], _OUTSIDE)
    if not state[root].any():
        return None
    return _innermost(root, int(np.argmax(state[root] > _FINE)), state, values, choices)


def _state(
    node: Expr, state: Mapping[Expr, np.ndarray], values: Mapping[Expr, np.ndarray], rows: int
) -> np.ndarray:
    """(rows,) of a node, by those of its parts and, where it has them, its values."""
    parts = [state[a] for a in node.args]
    out = np.max(parts, axis=0) if parts else np.full(rows, _FINE)
    if node.op == "where":
        condition, first, second = node.args
        if condition in values:
            chosen = np.where(values[condition], state[first], state[second])
        else:
            chosen = np.minimum(state[first], state[second])
        return np.maximum(state[condition], chosen)
    if node in values:
        value = np.asarray(values[node], dtype=float)  # matrices in the last two axes
        wrong = np.isnan(value) if value.ndim < 2 else np.isnan(value).any(axis=(-2, -1))
        return np.where(out == _OUTSIDE, _OUTSIDE, np.where(wrong, _NAN, _FINE))
    if node.op in BOOLEAN or node.op == "call":  # these may have a value where a part is NaN
        return np.where(out == _NAN, _FINE, out)
    return out


def _innermost(
    node: Expr, row: int, state: Mapping[Expr, np.ndarray], values: Mapping[Expr, np.ndarray],
    choices: Choices,
) -> Undefined:  # fmt: skip
    """From a part that has no value in this row to the first one below it."""
    while True:
        parts = node.args
        if node.op == "where" and node.args[0] in values:
            condition = values[node.args[0]]
            chosen = condition if np.ndim(condition) == 0 else condition[row]
            parts = (node.args[0], node.args[1 if chosen else 2])
        bad = [a for a in parts if state[a][row]]
        if bad:
            node = bad[0]
            continue
        if node not in choices or choices[node][0] not in values:
            return Undefined(row, node)
        index, elements = choices[node]
        value = values[index]
        return Undefined(
            row, node, index, elements, float(value if np.ndim(value) == 0 else value[row])
        )
