"""User-defined distributions: `UserDefined`, made by what `@ssm.distribution` declares.

The user's functions are run on symbols where the distribution stands in a model, once for each
pattern of numbers among its arguments; what they gave, in placeholders for the value and the other
arguments, is all that is kept. So the distribution is expressions like any other, and no function
of the user's travels to other processes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.compiling import once
from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, substitute, symbol, topological
from ssmppl.language.distributions.base import INFINITY, Distribution, Support
from ssmppl.language.distributions.draws import Draws

Pattern = tuple[float | None, ...]  # by argument: its number, None for a symbol
Forms = Mapping[str, Expr]  # part -> its expression
VALUE = symbol("value", "value")  # what densities and distribution functions are taken at
MOST_LISTED = 64  # values of a discrete law that are listed, all else following from the density


def placeholder(name: str) -> Expr:
    """What stands for an argument of the distribution in its forms."""
    return symbol("argument", name)


@dataclass(frozen=True)
class Origin:
    """Where a distribution was declared; module and qualified name import it, if anything does."""

    name: str
    location: Location
    module: str
    qualname: str


@dataclass(frozen=True)
class Bounds:
    """Bounds of the support: numbers, or names of arguments; whether they belong to it."""

    lower: float | str = -INFINITY
    upper: float | str = INFINITY
    discrete: bool = False
    closed: bool = False

    @property
    def values(self) -> np.ndarray | None:
        """All values of a discrete distribution between numbers not far apart."""
        if not self.discrete or isinstance(self.lower, str) or isinstance(self.upper, str):
            return None
        few = self.upper - self.lower < MOST_LISTED
        return np.arange(self.lower, self.upper + 0.5) if few else None


class UserDefined(Distribution):
    """A distribution that a user wrote; its class has the name of the user's function.

    patterns : of the distribution's shape, which of `forms` each component has.
    forms : by pattern of numbers among the arguments, the user's functions in `VALUE`,
        placeholders and, for a draw, random nodes.
    """

    guards_range = True
    origin: Origin
    bounds: Bounds
    patterns: np.ndarray
    forms: dict[Pattern, Forms]

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.origin.name, dict(self.__dict__))

    @property
    def drawable(self) -> bool:  # type: ignore[override]
        return self._has("draw") or self._has("quantile") or self.bounds.values is not None

    @property
    def has_cdf(self) -> bool:
        """Whether its distribution function is known."""
        return self._has("cdf") or self.bounds.values is not None

    def _has(self, part: str) -> bool:
        return all(part in forms for forms in self.forms.values())

    def expressions(self):
        own = [e for forms in self.forms.values() for e in forms.values()]
        return [*super().expressions(), *own]

    def with_parameters(self, parameters: Mapping[str, ExprArray]) -> UserDefined:
        """The distribution with other expressions for its arguments; numbers stay what they are."""
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__)
        new._set(**parameters)
        new.location, new.ranges = self.location, self.ranges
        new.patterns = np.empty(new.shape, dtype=object)
        for i in np.ndindex(new.shape):
            new.patterns[i] = self._pattern([new.parameters[n][i] for n in self.parameters])
        return new

    def _pattern(self, arguments: Sequence[Expr]) -> Pattern:
        """Of the forms that there are, the one of most numbers that these arguments have."""

        def fits(pattern: Pattern) -> bool:
            return all(
                v is None or (e.op == "const" and e.data == v)
                for v, e in zip(pattern, arguments, strict=True)
            )

        fitting = [p for p in self.forms if fits(p)]
        if not fitting:
            raise ValueError(f"another number among the arguments of {self!r}")
        return max(fitting, key=lambda p: sum(v is not None for v in p))

    def rebuilt(self, parameters):
        own = {n: array(v) for n, v in parameters.items()}
        return self._at_place(self.with_parameters({**self.parameters, **own}))

    # -- what the user's functions give, component by component
    def _replacement(self, i: tuple[int, ...]) -> dict[Expr, Expr]:
        return {placeholder(n): a[i] for n, a in self.parameters.items()}

    def _part(self, part: str, i: tuple[int, ...], value: Any = None) -> Expr:
        own = self._replacement(i)
        if value is not None:
            own[VALUE] = value
        (found,) = substitute([self.forms[self.patterns[i]][part]], own)
        return found

    def _at(self, part: str, value: Any) -> ExprArray:
        wide = np.broadcast_to(array(value).view(np.ndarray), self.shape)
        return self._each(lambda i: self._part(part, i, wide[i]))

    def log_densities(self, value):
        return self._at("density", value)

    def support(self):
        if self.bounds.discrete:
            kind = "integers"
        else:
            bounded = (self.bounds.lower, self.bounds.upper) != (-INFINITY, INFINITY)
            kind = "interval" if bounded else "real"
        return Support(kind, self._bound(self.bounds.lower), self._bound(self.bounds.upper))

    def _bound(self, bound: float | str) -> ExprArray:
        return self.parameters[bound] if isinstance(bound, str) else self._full(bound)

    def sample(self, draws):
        if self._has("draw"):
            return self._each(lambda i: self._draw(i, draws))
        if self._has("quantile") or self.bounds.values is not None:
            return self.quantile(self._each(lambda i: draws.uniform()))
        raise self.undrawable("something has to be drawn from it here")

    def undrawable(self, why: str) -> ModelError:
        """The error of a distribution without a sampler that needs one."""
        name = self.origin.name
        return ModelError(
            f"{name} has no sampler, and {why}",
            fix=f"write one below the density: @{name}.sampler on the line above a "
            f"`def draw(rng, {', '.join(self.parameters)})` that returns a draw",
            where=self.location,
        )

    def _draw(self, i: tuple[int, ...], draws: Draws) -> Expr:
        """The user's draw, made of new random nodes."""
        root, own = self.forms[self.patterns[i]]["draw"], self._replacement(i)
        for node in topological([root]):
            if node.op == "random":
                own[node] = getattr(draws, node.data[0])(*substitute(list(node.args), own))
        (found,) = substitute([root], own)
        return found

    def mean(self):
        if self._has("mean"):
            return self._each(lambda i: self._part("mean", i))
        if self.bounds.values is None:
            return self._full(math.nan)
        return array(sum(p * k for k, p in self._listed()))

    def variance(self):
        if self._has("variance"):
            return self._each(lambda i: self._part("variance", i))
        if self.bounds.values is None:
            return self._full(math.nan)
        mean = self.mean()
        return array(sum(p * (k - mean) ** 2 for k, p in self._listed()))

    def _listed(self) -> list[tuple[float, ExprArray]]:
        """Values and their probabilities, of a distribution with few values."""
        values = self.bounds.values
        assert values is not None
        return [(k, array(ew("exp", self.log_densities(k)))) for k in values.tolist()]

    def cdf(self, value):
        lower, upper = (self._bound(b) for b in (self.bounds.lower, self.bounds.upper))
        value = array(ew("floor", value)) if self.discrete else array(value)
        if self._has("cdf"):
            found = self._at("cdf", value)
        elif self.bounds.values is not None:
            found = array(sum(p * ew("le", k, value) for k, p in self._listed()))
        else:
            return self._full(math.nan)
        if self.bounds.lower != -INFINITY:
            found = array(ew("where", ew("lt", value, lower), 0.0, found))
        if self.bounds.upper != INFINITY:
            found = array(ew("where", ew("le", upper, value), 1.0, found))
        return found

    def quantile(self, p):
        if self._has("quantile"):
            return self._at("quantile", p)
        if self.bounds.values is None:
            name = self.origin.name
            raise ModelError(
                f"{name} has no quantile function, which is needed here",
                fix=f"write one below the density: @{name}.quantile on the line above a "
                f"`def quantile(p, {', '.join(self.parameters)})`",
                where=self.location,
            )
        below, out = self._full(0.0), self._full(self.bounds.lower)  # type: ignore[arg-type]
        for _, own in self._listed()[:-1]:
            below = below + own
            out = out + ew("lt", below, p) * 1.0
        return array(out)

    def survival_quantile(self, p):
        """By `quantile` of what is below 1, where it may be infinite."""
        return self.quantile(ew("minimum", 1.0 - array(p), 1.0 - 2.0**-53))

    def has_moment(self, power):
        """By its mean and variance where they are declared; else they are taken to exist."""
        if not self._has("mean" if power == 1 else "variance"):
            return self._full(1.0)
        moment = self.mean() if power == 1 else self.variance()
        return array(ew("lt", ew("abs", moment), INFINITY))

    def inverts(self) -> bool:
        """Whether it has a distribution function and that function's inverse."""
        return self.has_cdf and (self._has("quantile") or self.bounds.values is not None)


@once
def user_defined_class(name: str) -> type[UserDefined]:
    """The class of the distributions of this name."""
    return type(name, (UserDefined,), {"__doc__": f"{name}, as its user wrote it."})


def _restored(name: str, content: dict[str, Any]) -> UserDefined:
    law = object.__new__(user_defined_class(name))
    law.__dict__.update(content)
    return law
