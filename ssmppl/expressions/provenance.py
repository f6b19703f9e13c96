"""Where the user wrote each node, and which are elements of an array that a symbol chose."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

import numpy as np

from ssmppl.errors import Location

if TYPE_CHECKING:
    from ssmppl.expressions.node import Expr

# Of the block that records; None where none does. And the place that its nodes are given.
PLACES: ContextVar[dict[Expr, Location] | None] = ContextVar("places", default=None)
CHOICES: ContextVar[dict[Expr, tuple[Expr, int]] | None] = ContextVar("choices", default=None)
_given: ContextVar[Location | None] = ContextVar("given", default=None)
# Frames of these folders are never the place "where the user wrote it".
_OWN = tuple(
    os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), d) + os.sep
    for d in ("expressions", "language")
)
_OWN += tuple(  # SciPy lies beside NumPy
    os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(np.__file__))), d) + os.sep
    for d in ("numpy", "scipy")
)


@contextmanager
def recording() -> Iterator[dict[Expr, Location]]:
    """Within the block, the first place where the user wrote each node is kept in the result."""
    places: dict[Expr, Location] = {}
    token = PLACES.set(places)
    try:
        yield places
    finally:
        PLACES.reset(token)


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
def attributed(places: dict[Expr, Location], location: Location) -> Iterator[None]:
    """Within the block, nodes that have no place in `places` yet get this one.

    For what is derived from a line of the user's rather than written there.
    """
    tokens = PLACES.set(places), _given.set(location)
    try:
        yield
    finally:
        PLACES.reset(tokens[0])
        _given.reset(tokens[1])


def note(node: Expr, places: dict[Expr, Location]) -> None:
    """Keep the place of a node that has none."""
    if node not in places:
        places[node] = _given.get() or user_location()


def user_location() -> Location:
    """The innermost frame that is neither ours nor NumPy's: where the user wrote it."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_OWN):
        frame = frame.f_back
    return Location(frame.f_code.co_filename, frame.f_lineno, frame.f_code.co_name)
