"""Errors of a distribution's construction: what was given, and how it is written."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, nearest_first
from ssmppl.expressions.expr import user_location

WIDEST = 30  # characters of an argument that is written again in a fix


def checking_arguments(init: Callable[..., None]) -> Callable[..., None]:
    """`init`, with a ModelError in place of Python's TypeError where the arguments do not fit."""
    signature = inspect.signature(init)
    by_name = [p.name for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY]
    positional = [
        p.name for p in signature.parameters.values() if p.kind is p.POSITIONAL_OR_KEYWORD
    ][1:]

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            signature.bind(self, *args, **kwargs)
        except TypeError as error:
            raise misfit(
                type(self).__name__, error, args, kwargs, positional, by_name, self.by_name
            ) from None
        init(self, *args, **kwargs)

    return checked


def misfit(
    name: str, error: TypeError, args: tuple[Any, ...], kwargs: dict[str, Any],
    positional: Sequence[str], by_name: Sequence[str] = (), called: str = "",
) -> ModelError:  # fmt: skip
    """What a law says whose arguments do not fit: Python's error, and how it is written.

    positional, by_name : its arguments; the latter are called `called`.
    """
    given = f"{len(args)} without a name"
    given += f" and {', '.join(f'{k}=' for k in kwargs)}" if kwargs else ""
    found = f"{name}: {error}; given were {given}"
    known = [f"{k}=" for k in by_name]
    *most, last = known or [""]
    options = f"{', '.join(most)} or {last}" if most else last
    unknown = [k for k in kwargs if k not in (*positional, *by_name)]
    if unknown:
        nearest = ", ".join(nearest_first(unknown[0], [*positional, *by_name])) or "none"
        fix = f"the arguments of {name} are {nearest}"
    elif by_name and len(args) > len(positional):
        found = f"{name} takes its {called} by name: {options}"
        arrays = any(np.ndim(a) for a in args if isinstance(a, np.ndarray))  # print as no Python
        own = [str(a) for a in args] if len(args) == len(positional) + 1 and not arrays else []
        if not own or kwargs or max(map(len, own)) > WIDEST:
            own = [*positional, "..."]
        fix = f"write {name}({', '.join([*own[:-1], f'{by_name[0]}={own[-1]}'])})"
        fix += f", or {' or '.join(known[1:])}" if known[1:] else ""
    else:
        fix = f"write {name}({', '.join([*positional, *known])})"
    return ModelError(found, fix=fix, where=user_location())


def one_of(name: str, options: dict[str, Any], where: Location | None = None) -> tuple[str, Any]:
    """The one spread that was given; an error naming the options where there is none or several."""
    given = {k: v for k, v in options.items() if v is not None}
    if len(given) != 1:
        wanted = ", ".join(f"{k}=" for k in options)
        found = ", ".join(f"{k}=" for k in given) or "none of them"
        raise ModelError(
            f"{name} takes exactly one of {wanted}; found {found}",
            fix=f"name the spread, for example {name}(..., {next(iter(options))}=1.0)",
            where=where or user_location(),
        )
    return next(iter(given.items()))
