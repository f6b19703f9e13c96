"""The words of a declaration of an effect, and that a declaration fits its function."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.errors import ModelError, listing

if TYPE_CHECKING:
    from ssmppl.gap.effect import Effect

KINDS = ("transition", "observation", "input", "noise", "tail", "parameter", "initial", "state")
GIVEN = ("position", "integral", "moved", "other state", "any input", "second order", "profile")
ON = ("any", "rate", "state", "channel", "input", "parameter", "positive parameter",
      "other parameter")  # fmt: skip
REQUIRES = ("positive", "both signs")
PROCESSES = ("random walk", "ar1")  # of zero mean: their score in `strength` is zero

# Functions of time by name: of t and of shape parameters.
PROFILES: dict[str, Callable[..., Any]] = {
    "drift": lambda t, rows: t / rows - 0.5,
    "step": lambda t, date: np.where(t >= date, 1.0, 0.0),
    "pulse": lambda t, date: np.where(t == date, 1.0, 0.0),
    "wave": lambda t, period, phase: np.cos(2.0 * math.pi / period * t - phase),
}


def check(e: Effect) -> None:
    """That the declaration fits the function.

    Raises
    ------
    ModelError : naming the function's line.
    """

    def refuse(found: str, fix: str) -> ModelError:
        return ModelError(f"the effect {e.name!r}: {found}", fix=fix, where=e.where)

    parameters = inspect.signature(e.function).parameters
    if e.afresh is not None and not (e.lower < e.afresh < e.upper and e.afresh != 0.0):
        raise refuse(
            f"afresh={e.afresh!r} is no strength between {e.lower:g} and {e.upper:g} other than 0",
            "give the strength at which the model shall be fitted anew, or leave it out",
        )
    if e.kind not in KINDS:
        raise refuse(f"its kind is {e.kind!r}", f"use one of: {listing(str(e.kind), KINDS)}")
    if any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters.values()):
        raise refuse("it takes *arguments", "name each argument: they are bound by name")
    if not isinstance(e.on, str) or not e.on:
        raise refuse(f"on is {e.on!r}", f"use one of {', '.join(ON)}, or the name of a quantity")
    if "strength" not in parameters:
        raise refuse(
            f"{e.function.__name__}({', '.join(parameters)}) has no argument `strength`",
            "add it: the number that is estimated, 0 where there is no such effect",
        )
    if next(iter(parameters)) == "strength":
        raise refuse(
            "its first argument is `strength`",
            "let the first be the value of what it is bound to, for example the state v",
        )
    for what, names in (("shapes", e.shapes), ("given", e.given), ("states", e.states)):
        for name in names:
            needed_by_profile = what == "shapes" and e.profile
            if name not in list(parameters)[1:] and not needed_by_profile:
                raise refuse(
                    f"{what} names {name!r}, which is no further argument of the function",
                    f"its arguments are: {listing(name, parameters)}",
                )
    for argument, role in e.given.items():
        if role not in GIVEN:
            raise refuse(
                f"given says that {argument!r} is {role!r}", f"use one of: {listing(role, GIVEN)}"
            )
    for name, grid in e.shapes.items():
        if not grid.values or not all(map(math.isfinite, grid.values)):
            raise refuse(f"the shape {name!r} has the values {grid.values}", "give finite numbers")
        if grid.between is not None:
            low, high = grid.between
            if not low <= min(grid.values) <= max(grid.values) <= high or low == high:
                raise refuse(
                    f"the shape {name!r} is estimated between {low} and {high}, and its values are "
                    f"{grid.values}",
                    "give bounds that hold them",
                )
            if name in e.states.values():
                raise refuse(
                    f"the shape {name!r} is a number of states, which cannot be estimated",
                    "leave out between=",
                )
        if grid.of and grid.of not in parameters:
            raise refuse(
                f"the shape {name!r} is relative to {grid.of!r}, which is no argument",
                f"its arguments are: {listing(grid.of, parameters)}",
            )
    _check_parts(e, refuse)


def _check_parts(e: Effect, refuse: Callable[[str, str], ModelError]) -> None:
    if not e.lower < e.upper or e.lower > 0 or e.upper < 0:
        raise refuse(
            f"the strength lies between {e.lower:g} and {e.upper:g}, which must hold 0",
            "give lower=0 for an effect that has one direction only",
        )
    half = [b for b in (e.lower, e.upper) if math.isfinite(b)]
    if len(half) == 1 and e.lower != 0:
        raise refuse(
            f"the strength has the one bound {half[0]:g}", "give lower=0, or both lower and upper"
        )
    if (e.kind == "state") != bool(e.states):
        raise refuse(
            f"its kind is {e.kind!r} and its auxiliary states are {list(e.states)}",
            'give kind="state" and states=("name",) together',
        )
    if e.kind == "state" and e.on == "any":
        raise refuse('it is on "any"', f"say what it is bound to: {', '.join(ON[1:])}, or a name")
    for name, length in e.states.items():
        if length is not None and length not in e.shapes:
            raise refuse(
                f"the length of {name!r} is {length!r}, which is none of its shapes",
                f"its shapes are: {listing(length, e.shapes)}",
            )
    if e.process and (e.process not in PROCESSES or not e.states):
        raise refuse(
            f"its process is {e.process!r}",
            f'use one of {", ".join(PROCESSES)}, with kind="state" and its auxiliary state',
        )
    if e.requires not in ("", *REQUIRES):
        raise refuse(
            f"it requires {e.requires!r}", f"use one of: {listing(e.requires, REQUIRES)}, or none"
        )
    if bool(e.profile) != ("profile" in e.given.values()):
        raise refuse(
            f"its profile is {e.profile!r} and given is {dict(e.given)}",
            'name both: profile="step", given={"w": "profile"}',
        )
    if e.profile:
        known = PROFILES.get(e.profile)
        if known is None:
            raise refuse(
                f"its profile is {e.profile!r}", f"use one of: {listing(e.profile, PROFILES)}"
            )
        missing = set(inspect.signature(known).parameters) - {"t", *e.shapes}
        if missing:
            raise refuse(
                f"the profile {e.profile!r} needs the shapes {', '.join(sorted(missing))}",
                "give their values in shapes",
            )
