"""The "loop" node: x <- f(x, a), so many times, for numbers x_1, ..., x_n and a_1, ..., a_m.

Its arguments are the values of x to begin with, those of a, and the number of times; "item" nodes
take the values of x at the end. What is done (f) stands in its data, a `Loop`, in symbols of its
own, of kind "local": nothing that walks over a graph enters there, so that a loop is one node
whatever its length, and what is substituted for its arguments cannot be mixed up with them.

A loop is made as small as can be seen: what stays what it was leaves it, what is a number
throughout is put in as a number, and numbers that are always the same become one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from typing import Any

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    BOOLEAN,
    Expr,
    as_expr,
    constant,
    pack,
    several,
    substitute,
    symbol,
    symbols_in,
    topological,
    unpack,
)

_numbers: Iterator[int] = count()
SWAPPING = {"add", "mul", "maximum", "minimum", "and", "or", "eq", "ne"}  # the order is no matter


class Loop:
    """What a loop does: data of a "loop" node. Two that do the same are equal.

    Attributes
    ----------
    name : of the function that it was made of, for people.
    states, fixed : how many numbers change, and how many others they depend on.
    update : (states,) the new values, in `moving(i)` and `held(j)`.
    """

    __slots__ = ("_key", "digest", "fixed", "name", "states", "update")

    def __init__(self, name: str, update: Sequence[Expr], fixed: int):
        self.name, self.update, self.fixed = name, tuple(update), fixed
        self.states = len(self.update)
        self._key = (name, fixed, *map(id, self.update))
        self.digest = hashlib.sha256(
            repr(
                [(op, places, _data_text(data)) for op, places, data in pack(self.update)[0]]
            ).encode()
        ).hexdigest()[:8]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Loop) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return f"{self.name}_{self.digest}"

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _unpacked, (self.name, *pack(self.update), self.fixed)

    @property
    def moving(self) -> tuple[Expr, ...]:
        """The symbols of the numbers that change."""
        return tuple(moving(i) for i in range(self.states))

    @property
    def held(self) -> tuple[Expr, ...]:
        """The symbols of those that stay."""
        return tuple(held(j) for j in range(self.fixed))


def _data_text(data: Any) -> str:
    return str(getattr(data, "name", data)) if not isinstance(data, Loop) else repr(data)


def _unpacked(name: str, table: list, places: list[int], fixed: int) -> Loop:
    nodes = unpack(table)
    return Loop(name, [nodes[i] for i in places], fixed)


def moving(i: int) -> Expr:
    """The i-th number that changes, inside of any loop."""
    return symbol("local", "x", (i,))


def held(j: int) -> Expr:
    """The j-th number that stays, inside of any loop."""
    return symbol("local", "a", (j,))


def fresh(size: int) -> list[Expr]:
    """Symbols that nothing else has, for what changes in a loop that is being made."""
    k = next(_numbers)
    return [symbol("local", f"x{k}", (i,)) for i in range(size)]


def parts(node: Expr) -> tuple[tuple[Expr, ...], tuple[Expr, ...], Expr]:
    """Of a loop node: values to begin with, values that stay, number of times."""
    n = node.data.states
    return node.args[:n], node.args[n:-1], node.args[-1]


def repeated(
    name: str, symbols: Sequence[Expr], first: Sequence[Expr], update: Sequence[Expr],
    times: Expr | int,
) -> list[Expr]:  # fmt: skip
    """The values (n,) after so many times.

    symbols : (n,) `fresh` ones, that stand for the values. first : (n,) at the beginning. update :
    (n,) the new ones, in the symbols and whatever else the user wrote.
    """
    outer = _outer(update, symbols)
    change = dict(zip(symbols, map(moving, range(len(symbols))), strict=True))
    change |= {e: held(j) for j, e in enumerate(outer)}
    return closed(name, list(first), outer, substitute(list(update), change), as_expr(times))


def _outer(update: Sequence[Expr], symbols: Sequence[Expr]) -> list[Expr]:
    """What does not change in the loop: as few numbers as can be, either the largest expressions
    without the symbols, so that they are computed once, or the symbols in these."""
    own = frozenset(symbols)
    largest: dict[Expr, None] = {}
    waiting, seen = list(update), set[Expr]()
    while waiting:
        node = waiting.pop()
        if node in seen or node.op == "const" or node in own:
            continue
        seen.add(node)
        # a condition is no number, and a loop or a matrix are several
        if own.isdisjoint(symbols_in(node)) and node.op not in BOOLEAN and not several(node):
            largest[node] = None
        else:
            waiting += node.args
    leaves = [n for n in topological(largest) if not n.args and n.op != "const"]
    return list(largest) if len(largest) <= len(leaves) else leaves


def closed(
    name: str, first: list[Expr], fixed: list[Expr], update: list[Expr], times: Expr
) -> list[Expr]:
    """The values (n,) at the end of a loop whose update is in `moving(i)` and `held(j)`."""
    if times.op == "const" and times.data <= 0.0:
        return first
    known: dict[Expr, Expr] = {held(j): e for j, e in enumerate(fixed) if e.op == "const"}
    update = substitute(update, known) if known else update
    if times.op == "const" and times.data == 1.0:
        change = dict(zip(map(moving, range(len(first))), first, strict=True))
        return substitute(update, change | {held(j): e for j, e in enumerate(fixed)})
    update, numbers = _without_constants(first, update)
    place = _classes(first, update, numbers)
    kept = sorted(set(place.values()))
    unchanged = [i for i in kept if update[i] is moving(i)]
    inside = [i for i in kept if i not in unchanged]
    outer = [*fixed, *(first[i] for i in unchanged)]
    rename = {
        moving(i): moving(inside.index(p)) if p in inside else held(len(fixed) + unchanged.index(p))
        for i, p in place.items()
    }
    made = substitute([update[i] for i in inside], rename)
    used = {s for e in made for s in symbols_in(e)}
    needed = [j for j in range(len(outer)) if held(j) in used]
    made = substitute(made, {held(j): held(k) for k, j in enumerate(needed)})
    values: list[Expr] = list(first)
    if inside:
        loop = Loop(name, made, len(needed))
        args = (*(first[i] for i in inside), *(outer[j] for j in needed), times)
        node = Expr("loop", args, loop)
        ends = [Expr("item", (node,), (k,)) for k in range(len(inside))]
        if all(a.op == "const" for a in args):
            ends = [constant(float(v)) for v in evaluate(ends)]
        for i, p in place.items():
            values[i] = ends[inside.index(p)] if p in inside else first[p]
    return values


def _without_constants(first: list[Expr], update: list[Expr]) -> tuple[list[Expr], set[int]]:
    """The update with numbers for what is the same number throughout, and which these are: all that
    begin as numbers, but for those that are seen to change when the others are numbers."""
    still = {i for i, e in enumerate(first) if e.op == "const"}
    while True:
        new = substitute(update, {moving(i): first[i] for i in still}) if still else update
        gone = {i for i in still if new[i] is not first[i]}
        if not gone:
            return new, still
        still -= gone


def _classes(first: list[Expr], update: list[Expr], numbers: set[int]) -> dict[int, int]:
    """For each number that changes the first one that always equals it: begun alike, and moved
    alike as long as all these are alike (refined until no class falls apart)."""
    begun: dict[Expr, int] = {}
    place = {i: begun.setdefault(e, i) for i, e in enumerate(first) if i not in numbers}
    while True:
        groups: dict[tuple[int, Any], int] = {}
        key = _forms(update, {moving(i): moving(p) for i, p in place.items()})
        new = {i: groups.setdefault((p, key[i]), i) for i, p in place.items()}
        if new == place:
            return place
        place = new


def _forms(update: list[Expr], change: dict[Expr, Expr]) -> list[int]:
    """A number for each expression, the same where they differ in the order of terms and factors
    only, with these symbols changed."""
    known: dict[Any, int] = {}
    form: dict[Expr, int] = {}
    for node in topological(update):
        inner: tuple[Any, ...] = tuple(form[a] for a in node.args)
        if node.op in SWAPPING:
            inner = tuple(sorted(inner))
        what = change.get(node, node) if not node.args else node
        key = (id(what),) if not node.args else (node.op, node.data, inner)
        form[node] = known.setdefault(key, len(known))
    return [form[e] for e in update]
