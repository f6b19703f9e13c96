"""The "simulator" node: the values of a function that moves a batch, or a partial derivative of
all of them.

Its arguments are those of the function; "item" nodes take the values. Nodes with the same function
and arguments are computed together, by one call, wherever several of them are needed.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from ssmppl.errors import SSMError
from ssmppl.expressions.batched.differences import HIGHEST, Index, Stencil
from ssmppl.expressions.node import Expr

OP = "simulator"
MOST_KEPT = 64  # points of a call beyond which no values are kept: many seldom come again
MOST_AT_ONCE = 512  # points of a call for what was gathered
_here = threading.local()
Asked = tuple[Any, tuple[Index, ...], np.ndarray]  # the arguments of `computed`


class Batched(Protocol):
    """A function of K numbers to `outputs` numbers, which takes a batch.

    title : for people. name : unique in this process. moving : which of the arguments have
    derivatives. scales : (K,) of the steps of differences.
    """

    title: str
    name: str
    outputs: int
    moving: tuple[bool, ...]
    scales: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """(B, outputs) at points (B, K)."""
        ...


@dataclass(frozen=True)
class Derivative:
    """Data of a node: the function, and the arguments in which it is differentiated."""

    function: Any
    index: Index = ()

    @property
    def name(self) -> str:
        """Unique in this process."""
        return "_".join([self.function.name, *(f"d{j}" for j in self.index)])

    def __repr__(self) -> str:
        return "_".join([self.function.title, *(f"d{j}" for j in self.index)])


def values_of(function: Any, args: Sequence[Expr]) -> list[Expr]:
    """The values of a function, as nodes."""
    return items(Expr(OP, tuple(args), Derivative(function)))


def items(node: Expr) -> list[Expr]:
    """The numbers of a node."""
    return [Expr("item", (node,), (k,)) for k in range(node.data.function.outputs)]


def partial(node: Expr, j: int) -> Expr | None:
    """The node of the derivative in the j-th argument; None where it does not move with it, and
    where derivatives of so high an order are not taken."""
    data = node.data
    if not data.function.moving[j] or node.args[j].op == "const":
        return None
    return Expr(OP, node.args, Derivative(data.function, tuple(sorted((*data.index, j)))))


def too_high(node: Expr) -> bool:
    """Whether its derivatives are of a higher order than differences give."""
    return len(node.data.index) >= HIGHEST


@lru_cache(maxsize=4096)
def stencil_of(wanted: tuple[Index, ...], arguments: int, few: bool = False) -> Stencil:
    return Stencil.of(wanted, arguments, few)


def groups(nodes: Iterable[Expr]) -> dict[Expr, tuple[Expr, ...]]:
    """For each node of this kind those that are computed with it, by one call, itself among them;
    in the order of their derivatives."""
    alike: dict[tuple[Any, ...], list[Expr]] = {}
    for node in nodes:
        if node.op == OP:
            alike.setdefault((node.data.function, *map(id, node.args)), []).append(node)
    out: dict[Expr, tuple[Expr, ...]] = {}
    for group in alike.values():
        ordered = tuple(sorted(group, key=lambda n: (len(n.data.index), n.data.index)))
        out |= dict.fromkeys(group, ordered)
    return out


def computed(function: Any, wanted: tuple[Index, ...], x: np.ndarray) -> np.ndarray:
    """(len(wanted), outputs, B) at x (B, K)."""
    kept: dict[Any, dict[Any, np.ndarray]] | None = getattr(_here, "kept", None)
    if kept is not None and _here.alike and 1 < len(x) <= MOST_KEPT:
        asked: list[Asked] | None = getattr(_here, "asked", None)
        if asked is not None:
            asked.append((function, wanted, np.array(x)))
            return np.zeros((len(wanted), function.outputs, len(x)))
        found = _at_centre(function, wanted, x, kept)
        if np.isfinite(found).all():
            return found
    stencil, known = stencil_of(wanted, x.shape[1], kept is not None), None
    if kept is not None and len(x) <= MOST_KEPT:
        key = function.name, np.ascontiguousarray(x).tobytes()
        known = kept.setdefault(key, {})
    found = stencil.derivatives(function.at, x, function.scales, known)
    if kept is not None and not np.isfinite(found).all():  # the one side may have no value
        return stencil_of(wanted, x.shape[1]).derivatives(function.at, x, function.scales, known)
    return found


def _at_centre(
    function: Any, wanted: tuple[Index, ...], x: np.ndarray, kept: dict[Any, dict[Any, np.ndarray]]
) -> np.ndarray:
    """As `computed`, the derivatives for all points those at their mean. kept : by the points, the
    derivatives that are known, (outputs, B) or (outputs, 1)."""
    known = kept.setdefault((function.name, x.tobytes(), "centre"), {})
    new = [index for index in wanted if index not in known]
    if slopes := tuple(index for index in new if index):
        found = computed(function, slopes, x.mean(axis=0)[None])
        known |= dict(zip(slopes, found, strict=True))
    if () in new:
        known[()] = function.at(np.ascontiguousarray(x)).T
    out = np.empty((len(wanted), function.outputs, len(x)))
    for w, index in enumerate(wanted):
        out[w] = known[index]
    return out


@contextmanager
def gathered() -> Iterator[None]:
    """Within it, inside of `thriftily(alike=True)`, calls are taken down, and come to zeros; at its
    end they are computed together, in few calls, and kept. For what asks for points that do not
    depend on what it is given, row by row: it is run twice, and the second time all is there.

    What raises in a large call is left to the small one, which tells of it.
    """
    asked: list[Asked] = []
    _here.asked = asked
    try:
        yield
    finally:
        _here.asked = None
    kept: dict[Any, dict[Any, np.ndarray]] | None = getattr(_here, "kept", None)
    if kept is not None:
        with suppress(SSMError):
            _compute(asked, kept)


def _compute(asked: Sequence[Asked], kept: dict[Any, dict[Any, np.ndarray]]) -> None:
    """What `_at_centre` would keep of each call; not of those that come to no number."""
    every: dict[Any, tuple[Any, dict[Index, None], np.ndarray]] = {}
    for function, wanted, x in asked:
        key = function.name, x.tobytes(), "centre"
        every.setdefault(key, (function, {}, x))[1].update(dict.fromkeys(wanted))
    alike: dict[Any, list[Any]] = {}
    for key, (function, indices, x) in every.items():
        slopes = tuple(sorted((i for i in indices if i), key=lambda i: (len(i), i)))
        alike.setdefault((function.name, slopes, () in indices, x.shape), []).append(key)
    for (_, slopes, values, shape), keys in alike.items():
        function, points = every[keys[0]][0], np.stack([every[k][2] for k in keys])
        if slopes:
            stencil = stencil_of(slopes, shape[1], True)
            for some in _parts(len(keys), len(stencil.shifts)):
                means = points[some].mean(axis=1)
                found = stencil.derivatives(function.at, means, function.scales)
                for k, own in zip(keys[some], np.moveaxis(found, 2, 0), strict=True):
                    if np.isfinite(own).all():
                        kept.setdefault(k, {}).update(zip(slopes, own[:, :, None], strict=True))
        for some in _parts(len(keys), shape[0]) if values else ():
            found = function.at(points[some].reshape(-1, shape[1]))
            for k, own in zip(keys[some], found.reshape(-1, shape[0], found.shape[1]), strict=True):
                kept.setdefault(k, {})[()] = own.T


def _parts(count: int, points: int) -> Iterator[slice]:
    """Slices of so many calls, each of so many points, for a call of `MOST_AT_ONCE` at most."""
    size = max(1, MOST_AT_ONCE // points)
    for first in range(0, count, size):
        yield slice(first, first + size)


@contextmanager
def thriftily(alike: bool = False) -> Iterator[None]:
    """Within it this thread's derivatives are by few points (`differences.py`), and values are kept
    by their points: parts of a model that are compiled apart ask for the same ones, one after the
    other. Not for longer, as what the user's function reads may be changed between calls.

    alike : the points of each call are draws round one, at whose mean derivatives are taken for
    all of them: an approximation by as much as slopes differ among the draws.
    """
    before = getattr(_here, "kept", None), getattr(_here, "alike", False)
    _here.kept, _here.alike = {}, alike
    try:
        yield
    finally:
        _here.kept, _here.alike = before


def of_group(group: Sequence[Expr], args: Sequence[Any]) -> list[np.ndarray]:
    """The values of each node, its numbers in the last axis, from those of the arguments."""
    shape: tuple[int, ...] = ()
    for a in args:
        own = np.shape(a)
        shape = (
            own if not shape else shape if own in ((), shape) else np.broadcast_shapes(own, shape)
        )
    x = np.empty((*shape, len(args)))
    for j, a in enumerate(args):
        x[..., j] = a
    function = group[0].data.function
    wanted = tuple(n.data.index for n in group)
    found = computed(function, wanted, x.reshape(-1, len(args)))
    return [f.T.reshape(*shape, function.outputs) for f in found]
