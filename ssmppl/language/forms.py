"""The functions of a law of a user's own, run on place holders: density, draw, moments."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.expr import Expr, as_expr, symbols_of, topological
from ssmppl.language.calling import once, return_location
from ssmppl.language.draws import Draws, Generator
from ssmppl.language.written import VALUE, Pattern, place


def form(
    function: Callable[..., Any], part: str, verb: str, parameters: Sequence[str], pattern: Pattern
) -> Expr:
    """What a function gives, in `VALUE` and the `place`s of the arguments that are no numbers.

    It is called twice, as the laws of a model are (`calling.call`).

    Parameters
    ----------
    part : "density", "draw", "mean", "variance", "cdf" or "quantile".
    verb : its decorator, for messages.
    parameters : names of the law's arguments; pattern: their numbers.

    Raises
    ------
    ModelError : it gives no expression of its arguments; names its line.
    """
    given: dict[str, Any] = {  # NumPy's numbers, which may be divided by 0
        n: place(n) if v is None else np.float64(v)
        for n, v in zip(parameters, pattern, strict=True)
    }
    first = next(iter(inspect.signature(function).parameters), "")
    found: list[Expr] = []
    for _ in range(2):
        own = dict(given)
        if part == "draw":
            own[first] = Generator(Draws("draw"))
        elif part not in ("mean", "variance"):
            own[first] = VALUE
        with np.errstate(all="ignore"):  # of what is no number the user is told below
            value = once(function, verb, own, {})
        found.append(_expression(value, function, verb))
    told = _fault(part, found, parameters, pattern)
    if told:
        raise ModelError(
            f"@{verb} {function.__name__} {told[0]}", fix=told[1], where=return_location(function)
        )
    return found[0]


def _expression(value: Any, function: Callable[..., Any], verb: str) -> Expr:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    try:
        return as_expr(value)
    except TypeError:
        told = "nothing" if value is None else repr(value)
        told = f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else told
        raise ModelError(
            f"@{verb} {function.__name__} returned {told}",
            fix="end it by `return` and one expression of its arguments: the function is that of "
            "one number, and is applied to each component of an array",
            where=return_location(function),
        ) from None


def _fault(
    part: str, found: Sequence[Expr], parameters: Sequence[str], pattern: Pattern
) -> tuple[str, str] | None:
    """What is wrong with an expression, and the fix. found : of two calls."""
    nodes = topological(found[:1])
    if found[0] is not found[1]:
        return (
            "gives something else when it is called again",
            "draw no random numbers but those of a sampler's first argument, and change nothing "
            "inside of it",
        )
    foreign = symbols_of(found[:1]) - {VALUE, *map(place, parameters)}
    if foreign:
        name = min(map(repr, foreign))
        return (
            f"reads {name} of the model from outside of its arguments",
            f"give the law an argument for {name}",
        )
    if part == "draw" and not any(n.op == "random" for n in nodes):
        return (
            f"returned {found[0]!r}, which holds no draw",
            "make it of the random numbers of its first argument, such as rng.uniform() and "
            "rng.normal()",
        )
    if _is_nan(found[0]) or any(_is_nan(a) for n in nodes if n.op != "where" for a in n.args):
        given = [f"{n}={v:g}" for n, v in zip(parameters, pattern, strict=True) if v is not None]
        return (
            "is nan" + (f" at {', '.join(given)}" if given else ""),
            "take no logarithm or root of a negative number; what has to be positive is named in "
            'the declaration, positive=("scale",)',
        )
    return None


def _is_nan(e: Expr) -> bool:
    return e.op == "const" and math.isnan(e.data)
