"""`@ssm.distribution`: a decorator that makes a distribution of a log density, and of what else is
declared: sampler, moments, distribution function. The functions are run on placeholders where the
distribution stands in a model.
"""

from __future__ import annotations

import importlib
import inspect
import math
import numbers
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, nearest_first
from ssmppl.expressions.expr import Expr, as_expr, symbols_of, topological, user_location
from ssmppl.language.checks.agreement import Agreement, agreement
from ssmppl.language.distributions.base import INFINITY, misfit
from ssmppl.language.distributions.draws import Draws, Generator
from ssmppl.language.distributions.from_density import (
    VALUE,
    Bounds,
    Forms,
    Origin,
    Pattern,
    UserDefined,
    placeholder,
    user_defined_class,
)
from ssmppl.language.model.calling import call_once, return_location
from ssmppl.language.model.closure_digest import Declared, digest_of_code
from ssmppl.language.model.model import location_of
from ssmppl.language.model.pickling import holder_of

Function = Callable[..., Any]
_MISSING: Any = None
# Of each function beside the density: its first argument in words, "" where there is none
_FIRST = {"draw": "rng", "cdf": "the value", "quantile": "the probability",
          "mean": "", "variance": ""}  # fmt: skip


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
    function : log density, of discrete distributions log probability, at its first argument, in
        plain NumPy for one number; its further arguments are those of the distribution. Outside of
        the support it is not asked. It should be normalised: what is left out of it is missing in
        every likelihood.
    lower, upper : bounds of the support, numbers or names of the distribution's arguments; None:
        there is none.
    discrete : whether the values are whole numbers; the bounds are among them.
    closed : whether the bounds of a continuous distribution belong to its support.
    positive : names of arguments that have to be positive: numbers that are not are refused, and
        where expressions leave that range the density is nan, as that of other distributions.

    Returns
    -------
    DeclaredDistribution : called with its arguments a distribution like any other; with the
        decorators `sampler`, `mean`, `variance`, `cdf` and `quantile`, and `check`.

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
                f"@ssm.distribution decorates {function!r}, which is not a function",
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


class DeclaredDistribution(Declared):
    """A user's own distribution, made by calling it with its arguments.

    Attributes
    ----------
    parameters : names of its arguments, those of the density's function behind the value.
    """

    def __init__(self, density: Function, bounds: Bounds, positive: tuple[str, ...]):
        self.functions = {"density": density}
        self.__name__, self.__doc__ = density.__name__, density.__doc__
        self.__qualname__, self.__module__ = density.__qualname__, density.__module__
        self.location = location_of(density)
        _, *rest = _arguments(density, self.location, "distribution")
        self.parameters = tuple(rest)
        own = inspect.signature(density)
        self.__signature__ = own.replace(parameters=list(own.parameters.values())[1:])
        self.bounds, self.positive = bounds, positive
        self._known: tuple[tuple, dict[Pattern, Forms]] = ((), {})
        self._check_names(("lower", bounds.lower), ("upper", bounds.upper))
        self._check_names(*(("positive", name) for name in positive))

    def _check_names(self, *given: tuple[str, Any]) -> None:
        for keyword, name in given:
            if isinstance(name, str) and name not in self.parameters:
                raise ModelError(
                    f"{keyword}={name!r} of @distribution {self.__name__} is no argument of it",
                    fix=_known(name, self.parameters),
                    where=self.location,
                )

    @property
    def signature(self) -> tuple:
        """Changes with the functions, and with what they read from outside."""
        outer = digest_of_code(self.functions.values())
        return (*((p, id(f)) for p, f in self.functions.items()), outer)

    # -- what else is known of the law
    def sampler(self, function: Function = _MISSING) -> Function:
        """Declare how it is drawn from.

        Parameters
        ----------
        function : returns one draw; its first argument is the source of random numbers, with the
            methods uniform, normal, exponential, gamma, poisson, binomial, random and
            standard_normal of NumPy's `Generator`; the others are arguments of the distribution, by
            name.

        Returns
        -------
        function : itself.
        """
        return self._declare("draw", function)

    def mean(self, function: Function = _MISSING) -> Function:
        """Declare its expectation, for predictions: a function of arguments of the distribution.

        Parameters
        ----------
        function : returns it; its arguments are arguments of the distribution, by name.

        Returns
        -------
        function : itself.
        """
        return self._declare("mean", function)

    def variance(self, function: Function = _MISSING) -> Function:
        """Declare its variance, for predictions.

        Parameters
        ----------
        function : returns it; its arguments are arguments of the distribution, by name.

        Returns
        -------
        function : itself.
        """
        return self._declare("variance", function)

    def cdf(self, function: Function = _MISSING) -> Function:
        """Declare its distribution function, for PIT values.

        Parameters
        ----------
        function : returns P(Y <= y) for y in the support; its first argument is y, the others are
            arguments of the distribution, by name.

        Returns
        -------
        function : itself.
        """
        return self._declare("cdf", function)

    def quantile(self, function: Function = _MISSING) -> Function:
        """Declare the inverse of `cdf`: with both the distribution can be truncated, and without a
        sampler draws are quantiles of uniform ones.

        The upper tail of a truncated distribution is one less `cdf`, so that bounds beyond which
        there is less than 1e-10 of the distribution lose digits, and its moments have none of what
        lies beyond 1e-16.

        Parameters
        ----------
        function : returns the y with P(Y <= y) = p, of discrete distributions the smallest with at
            least that; its first argument is p, the others are arguments of the distribution, by
            name.

        Returns
        -------
        function : itself.
        """
        return self._declare("quantile", function)

    def _declare(self, part: str, function: Function) -> Function:
        verb = self._verb(part)
        if not inspect.isfunction(function):
            found = "is called without a function" if function is _MISSING else (
                f"decorates {function!r}, which is not a function"
            )  # fmt: skip
            raise ModelError(
                f"@{verb} {found}",
                fix=f"write @{verb} (without parentheses) on the line above a def; to compute "
                "with the distribution, make one first by giving its arguments",
                where=user_location(),
            )
        where = location_of(function)
        names = _arguments(function, where, verb, least=1 if _FIRST[part] else 0)
        for name in names[1:] if _FIRST[part] else names:
            if name not in self.parameters:
                first = f"behind {_FIRST[part]}, " if _FIRST[part] else ""
                raise ModelError(
                    f"@{verb} {function.__name__} asks for {name!r}, which is no argument of "
                    f"{self.__name__}",
                    fix=first + _known(name, self.parameters),
                    where=where,
                )
        self.functions[part] = function
        return function

    def _verb(self, part: str) -> str:
        """The decorator that declares this part."""
        if part == "density":
            return "distribution"
        return f"{self.__name__}.{'sampler' if part == 'draw' else part}"

    # -- the law
    def __call__(self, *args: Any, **kwargs: Any) -> UserDefined:
        try:
            bound = self.__signature__.bind(*args, **kwargs)
        except TypeError as error:
            raise misfit(self.__name__, error, args, kwargs, list(self.parameters)) from None
        bound.apply_defaults()
        law: UserDefined = object.__new__(user_defined_class(self.__name__))
        law._set(**bound.arguments)
        law.discrete, law.closed, law.bounds = self.bounds.discrete, self.bounds.closed, self.bounds
        law.open_above = not (law.discrete or law.closed)
        law.origin = Origin(self.__name__, self.location, self.__module__, self.__qualname__)
        for name in self.positive:
            law._require(name, 0.0)
        self._check_bounds(law)
        law.patterns, law.forms = np.empty(law.shape, dtype=object), {}
        for i in np.ndindex(law.shape):
            own = [law.parameters[n][i] for n in self.parameters]
            pattern = tuple(e.data if e.op == "const" else None for e in own)
            law.patterns[i] = pattern
            if pattern not in law.forms:
                law.forms[pattern] = self._forms(pattern)
        return law

    def _forms(self, pattern: Pattern) -> Forms:
        """What the functions give, run anew only where one of them, or what it reads, changed."""
        signature = self.signature
        if self._known[0] != signature:
            self._known = signature, {}
        known = self._known[1]
        if pattern not in known:
            known[pattern] = {
                part: form(function, part, self._verb(part), self.parameters, pattern)
                for part, function in self.functions.items()
            }
        return known[pattern]

    def _check_bounds(self, law: UserDefined) -> None:
        support = law.support()
        for a, b in zip(support.lower.ravel(), support.upper.ravel(), strict=True):
            if a.op == b.op == "const" and not (
                a.data < b.data or (law.discrete and a.data == b.data)
            ):
                raise ModelError(
                    f"{law!r}: its lower bound {a.data:g} is not below its upper bound {b.data:g}",
                    fix="give arguments with lower < upper",
                    where=law.location,
                )

    def check(
        self, *args: Any, draws: int = 10_000, level: float = 1e-4, seed: int = 0, **kwargs: Any
    ) -> Agreement:
        """Hold what was declared of the distribution against its density, at some arguments.

        The density is integrated over the support, by adaptive Gauss-Legendre quadrature, or
        summed; mean, variance and distribution function that were declared are compared with the
        same integrals; and draws are tested against the integrated density by the exact
        Kolmogorov-Smirnov test, which for discrete distributions errs on the safe side.

        Parameters
        ----------
        *args : the distribution's arguments, numbers; those named as one of the following have to
            be here.
        draws : number of draws.
        level : of the test; a right sampler fails with at most this probability.
        seed : of the draws.
        **kwargs : the distribution's arguments by their names.

        Returns
        -------
        Agreement : what was found; it prints as a line for each part.

        Raises
        ------
        ModelError : something does not agree, with what was found.
        """
        law = self(*args, **kwargs)
        symbolic = [n for n, a in law.parameters.items() for e in a.ravel() if e.op != "const"]
        if symbolic or law.shape:
            raise ModelError(
                f"{self.__name__}.check takes one number for each argument; found {law!r}"
                + (f" of shape {law.shape}" if law.shape else ""),
                fix="call it outside of a model, with numbers",
                where=law.location,
            )
        return agreement(law, {n: location_of(f) for n, f in self.functions.items()},
                         draws, level, seed)  # fmt: skip

    def __reduce__(self):  # by name where a module holds it, else by its functions
        if holder_of(self.functions["density"]) is self:
            return _by_name, (self.__module__, self.__qualname__)
        return _restored, (self.functions, self.bounds, self.positive)

    def __repr__(self) -> str:
        return f"<distribution {self.__name__}{self.__signature__}>"


def _by_name(module: str, name: str) -> DeclaredDistribution:
    found: DeclaredDistribution = getattr(importlib.import_module(module), name)
    return found


def _restored(
    functions: dict[str, Function], bounds: Bounds, positive: tuple[str, ...]
) -> DeclaredDistribution:
    made = DeclaredDistribution(functions["density"], bounds, positive)
    made.functions.update(functions)
    return made


def _arguments(function: Function, where: Location, verb: str, least: int = 1) -> list[str]:
    """Names of a function's arguments."""
    given = inspect.signature(function).parameters
    plain = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    bad = [n for n, p in given.items() if p.kind not in plain or n == "self"]
    if bad or len(given) < least:
        found = f"takes {bad[0]!r}" if bad else "takes no argument"
        raise ModelError(
            f"@{verb} {function.__name__} {found}: arguments are bound by name",
            fix="give it a first argument and then the distribution's own, each by its name: "
            f"def {function.__name__}(y, shape, scale)",
            where=where,
        )
    return list(given)


def _known(name: str, names: Iterable[str]) -> str:
    listed = ", ".join(nearest_first(name, list(names)))
    return f"its arguments are {listed}" if listed else "it has no arguments"


# -- the functions, run on placeholders
def form(
    function: Callable[..., Any], part: str, verb: str, parameters: Sequence[str], pattern: Pattern
) -> Expr:
    """What a function gives, in `VALUE` and placeholders for the arguments that are no numbers.

    It is called twice, as the distributions of a model are (`calling.call`).

    Parameters
    ----------
    part : "density", "draw", "mean", "variance", "cdf" or "quantile".
    verb : its decorator, for messages.
    parameters : names of the distribution's arguments; pattern: their numbers.

    Raises
    ------
    ModelError : it gives no expression of its arguments; names its line.
    """
    given: dict[str, Any] = {  # NumPy's numbers, which may be divided by 0
        n: placeholder(n) if v is None else np.float64(v)
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
        with np.errstate(all="ignore"):  # what is no number is refused below
            value = call_once(function, verb, own, {})
        found.append(_expression(value, function, verb))
    fault = _fault(part, found, parameters, pattern)
    if fault:
        raise ModelError(
            f"@{verb} {function.__name__} {fault[0]}", fix=fault[1], where=return_location(function)
        )
    return found[0]


def _expression(value: Any, function: Callable[..., Any], verb: str) -> Expr:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    try:
        return as_expr(value)
    except TypeError:
        given = "nothing" if value is None else repr(value)
        given = f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else given
        raise ModelError(
            f"@{verb} {function.__name__} returned {given}",
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
    foreign = symbols_of(found[:1]) - {VALUE, *map(placeholder, parameters)}
    if foreign:
        name = min(map(repr, foreign))
        return (
            f"reads {name} of the model from outside of its arguments",
            f"give the distribution an argument for {name}",
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
