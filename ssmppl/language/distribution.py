"""What every distribution offers: parameters, support, log density, sampler, moments.

All of it as expressions, so that one definition serves the interpreter, the analyses and the
generated code. A sampler is an expression over "random" nodes (standard normal, uniform, gamma,
Poisson, binomial draws).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, UnsupportedOperation
from ssmppl.expressions.arrays import ExprArray, array, elementwise
from ssmppl.expressions.expr import Expr, apply, constant, user_location

INFINITY = math.inf


@dataclass(frozen=True)
class Support:
    """Where a distribution lives.

    kind : "real", "interval" (between lower and upper), "integers" (likewise), "simplex",
        "positive definite", or "point" (Dirac).
    lower, upper : bounds, of the distribution's shape; infinite where there is none.
    """

    kind: str
    lower: ExprArray
    upper: ExprArray


class Draws:
    """Makes the "random" nodes of one sampler; each draw is a node of its own."""

    def __init__(self, owner: str):
        self.owner, self.count = owner, 0

    def _node(self, kind: str, *args: Any) -> Expr:
        self.count += 1
        return Expr("random", tuple(map(_node, args)), (kind, (self.owner, self.count)))

    def normal(self) -> Expr:
        """Standard normal."""
        return self._node("normal")

    def uniform(self) -> Expr:
        """Uniform on the open interval (0, 1)."""
        return self._node("uniform")

    def gamma(self, shape: Any) -> Expr:
        """Gamma with unit rate."""
        return self._node("gamma", shape)

    def poisson(self, rate: Any) -> Expr:
        return self._node("poisson", rate)

    def binomial(self, n: Any, p: Any) -> Expr:
        return self._node("binomial", n, p)


def _node(value: Any) -> Expr:
    return value if isinstance(value, Expr) else constant(value)


class Distribution:
    """Base of all distributions.

    Subclasses set `parameters` (name -> ExprArray) through `_set`, and define the methods below.
    Elementwise distributions (`joint = False`) are independent over their shape; joint ones
    (`joint = True`: MvNormal, Dirichlet, Wishart, ...) have one density for the whole value.
    """

    joint = False
    discrete = False
    proper = True
    parameters: dict[str, ExprArray]
    shape: tuple[int, ...]
    location: Location

    def _set(self, **parameters: Any) -> None:
        """Convert, broadcast (elementwise distributions) and remember the parameters."""
        self.location = user_location()
        arrays = {}
        for name, value in parameters.items():
            try:
                arrays[name] = array(value)
            except (TypeError, ValueError) as error:
                if isinstance(error, UnsupportedOperation):
                    raise
                raise ModelError(
                    f"{type(self).__name__}: {name} is {value!r}, which is no number or symbol",
                    fix="pass numbers, arrays of numbers, or expressions of the function's "
                    "arguments",
                    where=self.location,
                ) from None
        if not self.joint:
            try:
                shape = np.broadcast_shapes(*(a.shape for a in arrays.values()))
            except ValueError:
                shapes = ", ".join(f"{n} {a.shape}" for n, a in arrays.items())
                raise ModelError(
                    f"{type(self).__name__}: shapes do not agree: {shapes}",
                    fix="give parameters of one shape, or scalars",
                    where=self.location,
                ) from None
            arrays = {n: array(np.broadcast_to(a.view(np.ndarray), shape))
                      for n, a in arrays.items()}  # fmt: skip
            self.shape = shape
        self.parameters = arrays

    def _require(self, name: str, low: float, high: float = INFINITY, strict: bool = True) -> None:
        """Refuse numbers out of range; symbols are checked when they have values."""
        for e in self.parameters[name].ravel():
            if e.op != "const":
                continue
            inside = low < e.data < high if strict else low <= e.data <= high
            if not inside:
                brackets = "()" if strict else "[]"
                raise ModelError(
                    f"{type(self).__name__}: {name} = {e.data:g} is outside "
                    f"{brackets[0]}{low:g}, {high:g}{brackets[1]}",
                    fix=f"give a {name} inside that range",
                    where=self.location,
                )

    def __getattr__(self, name: str) -> ExprArray:
        try:
            return self.__dict__["parameters"][name]
        except KeyError:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}") from None

    def __repr__(self) -> str:
        def text(a: ExprArray) -> str:
            flat = list(a.ravel())
            if not flat:
                return "[]"
            same = all(e is flat[0] for e in flat)
            return repr(flat[0]) if same else "[" + ", ".join(map(repr, flat)) + "]"

        inside = ", ".join(f"{n}={text(a)}" for n, a in self.parameters.items())
        return f"{type(self).__name__}({inside})"

    # -- to be defined by each distribution
    def log_densities(self, value: ExprArray) -> ExprArray:
        """Log density on the support: of the distribution's shape, or () for a joint one."""
        raise AttributeError

    def support(self) -> Support:
        """Where the value may lie."""
        return Support("real", self._full(-INFINITY), self._full(INFINITY))

    def sample(self, draws: Draws) -> ExprArray:
        """A draw as an expression over random nodes."""
        raise AttributeError

    def mean(self) -> ExprArray:
        """Expectation; nan where it does not exist."""
        raise AttributeError

    def variance(self) -> ExprArray:
        """Variances of the components; nan where they do not exist."""
        raise AttributeError

    def cdf(self, value: ExprArray) -> ExprArray:
        """Distribution function, element by element (not for joint distributions)."""
        raise AttributeError

    def quantile(self, p: ExprArray) -> ExprArray:
        """Inverse of `cdf`: for discrete distributions the smallest value with cdf >= p."""
        raise AttributeError

    # -- in terms of the above
    def _full(self, value: float) -> ExprArray:
        return array(np.full(self.shape, value))

    def log_mass(self, lower: ExprArray, upper: ExprArray) -> ExprArray:
        """log P(lower <= X <= upper), element by element."""
        below = self.cdf(array(lower) - 1.0 if self.discrete else lower)
        return elementwise("log", self.cdf(upper) - below)

    def guarded_log_densities(self, value: ExprArray) -> ExprArray:
        """`log_densities`, and -inf outside the support."""
        support, inside = self.support(), None
        density = array(self.log_densities(value))
        if support.kind not in ("interval", "integers"):
            return density
        out = np.empty(density.shape, dtype=object)
        lower, upper, v = (
            np.broadcast_to(array(a).view(np.ndarray), density.shape)
            for a in (support.lower, support.upper, value)
        )
        for i in np.ndindex(density.shape):
            inside = constant(1.0)
            if not (lower[i].op == "const" and lower[i].data == -INFINITY):
                closed = self.discrete or isinstance_bound_closed(self)
                inside = apply("le" if closed else "lt", lower[i], v[i])
            if not (upper[i].op == "const" and upper[i].data == INFINITY):
                below = apply("le", v[i], upper[i])
                inside = below if inside.op == "const" else apply("and", inside, below)
            if self.discrete:
                whole = apply("eq", v[i], apply("floor", v[i]))
                inside = whole if inside.op == "const" else apply("and", inside, whole)
            out[i] = apply("where", inside, density[i], -INFINITY)
        return array(out)

    def log_density(self, value: Any, guard: bool = True) -> Expr:
        """Log density of the whole value, one expression; -inf outside the support.

        guard=False leaves the support out, as the analyses need it.
        """
        value = array(value)
        parts = self.guarded_log_densities(value) if guard else self.log_densities(value)
        return array(np.sum(array(parts)))[()]


def isinstance_bound_closed(distribution: Distribution) -> bool:
    """Whether the lower bound itself belongs to the support."""
    return getattr(type(distribution), "closed", False)


def one_of(
    name: str, options: dict[str, Any], where: Location | None = None
) -> tuple[str, Any]:
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
