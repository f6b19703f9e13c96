"""`@ssm.distribution`: a decorator that makes a law of a log density."""

from __future__ import annotations

import inspect
import math
import numbers
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from ssmppl.errors import ModelError
from ssmppl.expressions.expr import user_location
from ssmppl.language.declared import DeclaredDistribution
from ssmppl.language.distribution import INFINITY
from ssmppl.language.model import location_of
from ssmppl.language.written import Bounds

Function = Callable[..., Any]
_MISSING: Any = None


def distribution(
    function: Function = _MISSING,
    *,
    lower: float | str | None = None,
    upper: float | str | None = None,
    discrete: bool = False,
    closed: bool = False,
    positive: Iterable[str] = (),
) -> Any:
    """Declare a distribution of your own by its log density.

    Parameters
    ----------
    function : log density, of discrete laws log probability, at its first argument, in plain NumPy
        for one number; its further arguments are those of the law. Outside of the support it is
        not asked. It should be normalised: what is left out of it is missing in every likelihood.
    lower, upper : bounds of the support, numbers or names of the law's arguments; None: there is
        none.
    discrete : whether the values are whole numbers; the bounds are among them.
    closed : whether the bounds of a continuous law belong to its support.
    positive : names of arguments that have to be positive: numbers that are not are refused, and
        where expressions leave that range the density is nan, as that of other laws.

    Returns
    -------
    DeclaredDistribution : called with its arguments a law like any other; with the decorators
        `sampler`, `mean`, `variance`, `cdf` and `quantile`, and `check`.

    Raises
    ------
    ModelError : the declaration does not fit the function; names file and line.

    Examples
    --------
    >>> import numpy as np
    >>> import ssmppl as ssm
    >>> @ssm.distribution(lower=0, positive=("shape", "scale"))
    ... def Lomax(y, shape, scale):
    ...     return np.log(shape / scale) - (shape + 1) * np.log1p(y / scale)
    >>> @Lomax.sampler
    ... def draw(rng, shape, scale):
    ...     return scale * (rng.uniform() ** (-1 / shape) - 1)
    >>> Lomax(2.5, scale=3)
    Lomax(shape=2.5, scale=3)
    """

    def declare(function: Function) -> DeclaredDistribution:
        if not inspect.isfunction(function):
            raise ModelError(
                f"@ssm.distribution stands on {function!r}, which is no function",
                fix="write @ssm.distribution(lower=0) on the line above a def",
                where=user_location(),
            )
        where, bounds = location_of(function), Bounds(discrete=discrete, closed=closed)
        for name, given in (("lower", lower), ("upper", upper)):
            if given is not None:
                own: Any = {name: _bound(name, given, function, discrete)}
                bounds = replace(bounds, **own)
        if not (isinstance(bounds.lower, str) or isinstance(bounds.upper, str)) and not (
            bounds.lower < bounds.upper or (discrete and bounds.lower == bounds.upper)
        ):
            raise ModelError(
                f"lower={bounds.lower:g} of @distribution {function.__name__} is not below "
                f"upper={bounds.upper:g}",
                fix="give lower < upper",
                where=where,
            )
        names = (positive,) if isinstance(positive, str) else tuple(positive)
        return DeclaredDistribution(function, bounds, names)

    return declare if function is _MISSING else declare(function)


def _bound(keyword: str, value: Any, function: Function, discrete: bool) -> float | str:
    if isinstance(value, str):
        return value
    number = isinstance(value, numbers.Real) and not math.isnan(float(value))
    infinite = -INFINITY if keyword == "lower" else INFINITY
    if number and float(value) == -infinite:
        number = False
    if not number or (discrete and math.isfinite(value) and value != math.floor(value)):
        raise ModelError(
            f"{keyword}={value!r} of @distribution {function.__name__} is no "
            f"{'whole number' if discrete else 'number'} and no name of an argument",
            fix=f'give a number, or the name of an argument, {keyword}="loc"',
            where=location_of(function),
        )
    return float(value)
