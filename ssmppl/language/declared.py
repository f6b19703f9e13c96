"""A law of a user's own as it is declared: by its log density, and what else is known of it."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, nearest_first
from ssmppl.expressions.expr import user_location
from ssmppl.language.agreement import Agreement, agreement
from ssmppl.language.constructing import misfit
from ssmppl.language.forms import form
from ssmppl.language.model import location_of
from ssmppl.language.packing import holder_of
from ssmppl.language.reading import Declared, digest_of_code
from ssmppl.language.written import Bounds, Forms, Origin, Pattern, Written, written_class

Function = Callable[..., Any]
_MISSING: Any = None
# Of each function beside the density: its first argument in words, "" where there is none
_FIRST = {"draw": "rng", "cdf": "the value", "quantile": "the probability",
          "mean": "", "variance": ""}  # fmt: skip


class DeclaredDistribution(Declared):
    """A law of a user's own: called with its arguments it is a distribution.

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
            standard_normal of NumPy's `Generator`; the others are arguments of the law, by name.

        Returns
        -------
        function : itself.
        """
        return self._declare("draw", function)

    def mean(self, function: Function = _MISSING) -> Function:
        """Declare its expectation, for predictions: a function of arguments of the law.

        Parameters
        ----------
        function : returns it; its arguments are arguments of the law, by name.

        Returns
        -------
        function : itself.
        """
        return self._declare("mean", function)

    def variance(self, function: Function = _MISSING) -> Function:
        """Declare its variance, for predictions.

        Parameters
        ----------
        function : returns it; its arguments are arguments of the law, by name.

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
            arguments of the law, by name.

        Returns
        -------
        function : itself.
        """
        return self._declare("cdf", function)

    def quantile(self, function: Function = _MISSING) -> Function:
        """Declare the inverse of `cdf`: with both the law can be truncated, and without a sampler
        draws are quantiles of uniform ones.

        The upper tail of a truncated law is one less `cdf`, so that bounds beyond which there is
        less than 1e-10 of the law lose digits, and its moments have none of what lies beyond 1e-16.

        Parameters
        ----------
        function : returns the y with P(Y <= y) = p, of discrete laws the smallest with at least
            that; its first argument is p, the others are arguments of the law, by name.

        Returns
        -------
        function : itself.
        """
        return self._declare("quantile", function)

    def _declare(self, part: str, function: Function) -> Function:
        verb = self._verb(part)
        if not inspect.isfunction(function):
            found = "is called without a function" if function is _MISSING else (
                f"stands on {function!r}, which is no function"
            )  # fmt: skip
            raise ModelError(
                f"@{verb} {found}",
                fix=f"write @{verb} (without parentheses) on the line above a def; to compute "
                "with the law, make one first by giving its arguments",
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
    def __call__(self, *args: Any, **kwargs: Any) -> Written:
        try:
            bound = self.__signature__.bind(*args, **kwargs)
        except TypeError as error:
            raise misfit(self.__name__, error, args, kwargs, list(self.parameters)) from None
        bound.apply_defaults()
        law: Written = object.__new__(written_class(self.__name__))
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

    def _check_bounds(self, law: Written) -> None:
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
        """Hold what was declared of the law against its density, at some arguments.

        The density is integrated over the support, by adaptive Gauss-Legendre quadrature, or
        summed; mean, variance and distribution function that were declared are compared with the
        same integrals; and draws are tested against the integrated density by the exact
        Kolmogorov-Smirnov test, which for discrete laws errs on the safe side.

        Parameters
        ----------
        *args : the law's arguments, numbers; those named as one of the following have to be here.
        draws : number of draws.
        level : of the test; a right sampler fails with at most this probability.
        seed : of the draws.
        **kwargs : the law's arguments by their names.

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
            fix="give it a first argument and then the law's own, each by its name: "
            f"def {function.__name__}(y, shape, scale)",
            where=where,
        )
    return list(given)


def _known(name: str, names: Iterable[str]) -> str:
    listed = ", ".join(nearest_first(name, list(names)))
    return f"its arguments are {listed}" if listed else "it has no arguments"
