"""What every distribution offers: parameters, support, log density, sampler, moments, and the facts
about a distribution that analyses and the diagnosis ask for.

All of it as expressions, so that one definition serves the interpreter, the analyses and the
generated code. A sampler is an expression over the "random" nodes of `draws.py`.
"""

from __future__ import annotations

import functools
import inspect
import itertools
import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ssmppl.arguments import distribution_hint
from ssmppl.errors import Location, ModelError, UnsupportedOperation
from ssmppl.expressions.arrays import ExprArray, array, elementwise
from ssmppl.expressions.expr import Expr, apply, constant, user_location
from ssmppl.expressions.properties import never_negative
from ssmppl.language.distributions.draws import Draws

INFINITY = math.inf
LOG_2 = math.log(2.0)
LOG_2PI = math.log(2.0 * math.pi)
ROUNDING = 1e-9
REPEATED = 4  # equal entries in a row from which they are said once
TIED = {
    "simplex": "a probability vector", "positive definite": "a positive definite matrix",
    "correlation": "a correlation matrix", "ordered": "in increasing order",
}  # fmt: skip
WIDEST = 30  # characters of an argument that is written again in a fix


@dataclass(frozen=True)
class Support:
    """Where a distribution lives.

    kind : "real", "interval" (between lower and upper), "integers" (likewise), "simplex",
        "positive definite", "correlation" (such matrices of unit diagonal), "ordered" (increasing
        along the last axis, between lower and upper), or "point" (Dirac).
    lower, upper : bounds, of the distribution's shape; infinite where there is none.
    """

    kind: str
    lower: ExprArray
    upper: ExprArray

    @property
    def tied(self) -> str:
        """What the components are together where no one of them moves freely within numbers; empty
        where each does."""
        return TIED.get(self.kind, "")


@dataclass(frozen=True)
class MeanLink:
    """How the mean of a distribution is moved: by increments of one parameter, on a scale.

    scale : "identity", "log", "logit", or "mean of the log".
    inverse : whether the parameter is a reciprocal, as a rate is, which falls where the mean grows.
    """

    parameter: str
    scale: str
    inverse: bool = False


@dataclass(frozen=True)
class VarianceLink:
    """How the variance of a distribution is scaled: the parameter is in proportion to
    variance^power."""

    parameter: str
    power: float


class DistributionAsNumber(ModelError):
    """A distribution stands where a number does, as if it had been drawn from."""

    distribution: Distribution | None = None

    @classmethod
    def of(cls, what: str, distribution: Distribution) -> DistributionAsNumber:
        """what : where it stands: "one side of == is"."""
        error = cls(
            f"{what} {distribution!r}, a distribution and not a number",
            fix="pass numbers, or expressions of the function's arguments: a distribution has no "
            "value here; returned under a name, its draw is an argument of another function",
            where=user_location(),
        )
        error.distribution = distribution
        return error


# (law, value) -> where a parameter of the law makes the density of the value highest
Maximiser = Callable[[Any, ExprArray], Any]


def array_text(values: ExprArray) -> str:
    """An array in words: one number for equal ones, `diag([...])` for a diagonal matrix, and what
    is repeated with how often."""
    flat = list(values.ravel())
    if not flat:
        return "[]"
    if all(e is flat[0] for e in flat):
        return repr(flat[0])
    if values.ndim < 2:
        return _row_text(flat)
    if values.ndim == 2:
        rows = values.view(np.ndarray)
        n = len(rows)
        off = [rows[i, j] for i in range(n) for j in range(rows.shape[1]) if i != j]
        if rows.shape == (n, n) and all(e.op == "const" and e.data == 0.0 for e in off):
            return f"diag({_row_text([rows[i, i] for i in range(n)])})"
    inner = [array_text(a) if a.ndim > 1 else _row_text(list(a)) for a in map(array, values)]
    return f"[{', '.join(inner)}]"


def _row_text(row: Sequence[Expr]) -> str:
    parts: list[str] = []
    for _, same in itertools.groupby(row, key=id):
        run = [repr(e) for e in same]
        parts += [f"{run[0]} ({len(run)} times)"] if len(run) >= REPEATED else run
    return f"[{', '.join(parts)}]"


class Distribution:
    """Base of all distributions.

    Subclasses set `parameters` (name -> ExprArray) through `_set`, and define the methods below.
    Elementwise distributions (`joint = False`) are independent over their shape; joint ones
    (`joint = True`: MvNormal, Dirichlet, Wishart, ...) have one density for the whole value.
    """

    joint = False
    discrete = False
    proper = True
    closed = False  # whether the lower bound itself belongs to the support
    open_above = False  # whether the upper one does not
    drawable = True  # whether it has a sampler
    measured = True  # whether it is of a value that data have; a potential is not
    guards_range = False  # whether its density has to know where a parameter is out of range
    symmetric = False  # whether values are symmetric matrices, whose two halves share symbols
    unit_diagonal = False  # whether they have a diagonal of ones
    by_name = "spread"  # what the keyword-only arguments are called in messages
    trials = ""  # the parameter that is a number of trials
    approximation = ""  # what it stands for and how, where it is no exact law of that
    # What analyses make use of where it is known.
    truncatable = True  # whether `Truncated` takes it
    prior_only = False  # whether it is one of parameters alone
    atoms = False  # whether single values of a continuous one have probability (observations only)
    gaussian_noise = False  # whether draws are made of normal ones alone; then it has `standard`
    maximisers: ClassVar[Mapping[str, Maximiser]] = {}  # by parameter, the others given
    highest: float | None = None  # what no log density is above, 0 of probabilities
    mean_link: MeanLink | None = None
    variance_link: VarianceLink | None = None
    parameters: dict[str, ExprArray]
    ranges: dict[str, tuple[float, float, bool]]  # by parameter: low, high, without the ends
    shape: tuple[int, ...]
    location: Location

    def __init_subclass__(cls) -> None:
        if "__init__" in cls.__dict__:
            cls.__init__ = checking_arguments(cls.__init__)  # type: ignore[method-assign]

    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        if isinstance(other, (numbers.Number, np.ndarray, Expr)):
            raise DistributionAsNumber.of("one side of == is", self)
        return self is other

    def _set(self, **parameters: Any) -> None:
        """Convert, broadcast (elementwise distributions) and remember the parameters.

        Where a name is also that of a method (mean, shape), it is kept with an underscore.
        """
        self.location = user_location()
        arrays = {}
        for name, value in parameters.items():
            if isinstance(value, Distribution):
                raise DistributionAsNumber.of(
                    f"{type(self).__name__}: {_plain_name(name)} is", value
                )
            try:
                arrays[name] = array(value)
            except (TypeError, ValueError) as error:
                if isinstance(error, UnsupportedOperation):
                    raise
                raise ModelError(
                    f"{type(self).__name__}: {_plain_name(name)} is {value!r}, which is no "
                    "number or symbol",
                    fix="pass numbers, arrays of numbers, or expressions of the function's "
                    "arguments",
                    where=self.location,
                ) from None
            if any(e.op == "const" and math.isnan(e.data) for e in arrays[name].ravel()):
                raise ModelError(
                    f"{type(self).__name__}: {_plain_name(name)} is nan",
                    fix="pass numbers, or expressions of the function's arguments",
                    where=self.location,
                )
        if not self.joint:
            try:
                shape = np.broadcast_shapes(*(a.shape for a in arrays.values()))
            except ValueError:
                shapes = ", ".join(f"{_plain_name(n)} {a.shape}" for n, a in arrays.items())
                raise ModelError(
                    f"{type(self).__name__}: shapes do not agree: {shapes}",
                    fix="give parameters of one shape, or scalars",
                    where=self.location,
                ) from None
            arrays = {n: array(np.broadcast_to(a.view(np.ndarray), shape))
                      for n, a in arrays.items()}  # fmt: skip
            self.shape = shape
        self.parameters, self.ranges = arrays, {}

    def _require(self, name: str, low: float, high: float = INFINITY, strict: bool = True) -> None:
        """Refuse numbers out of range; symbols are checked where they have values (`in_range`)."""
        self.ranges[name] = low, high, strict
        for e in self.parameters[name].ravel():
            if e.op != "const":
                continue
            inside = low < e.data < high if strict else low <= e.data <= high
            if not inside:
                brackets = "()" if strict else "[]"
                raise ModelError(
                    f"{type(self).__name__}: {_plain_name(name)} = {e.data:g} is outside "
                    f"{brackets[0]}{low:g}, {high:g}{brackets[1]}",
                    fix=f"give a {_plain_name(name)} inside that range",
                    where=self.location,
                )

    def in_range(self) -> ExprArray | None:
        """Whether the parameters that are no numbers allow a draw: element by element, or () for a
        joint distribution; None where nothing has to be asked.

        Ends of the range are let through: a spread of zero is a distribution at one point, and sums
        of probabilities miss 0 and 1 by rounding.
        """
        inside: ExprArray | None = None
        for name, (low, high, strict) in self.ranges.items():
            values = self.parameters[name]
            if all(e.op == "const" for e in values.ravel()):
                continue
            slack, own = 0.0 if strict else ROUNDING, []
            if low != 0.0 or not all(map(never_negative, values.ravel())):
                own.append(elementwise("le", low - slack, values))
            if high < INFINITY:
                own.append(elementwise("le", values, high + slack))
            for condition in own:
                each = list(array(condition).ravel()) if self.joint else [array(condition)]
                for c in each:
                    inside = array(c) if inside is None else array(elementwise("and", inside, c))
        return inside

    def __getattr__(self, name: str) -> ExprArray:
        try:
            return self.__dict__["parameters"][name]
        except KeyError:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}") from None

    def __repr__(self) -> str:
        inside = ", ".join(f"{_plain_name(n)}={array_text(a)}" for n, a in self.parameters.items())
        return f"{type(self).__name__}({inside})"

    def inside(self) -> tuple[Distribution, ...]:
        """The distributions that this one is made of."""
        base = self.__dict__.get("base")
        return () if base is None else (base,)

    def undrawable(self, why: str) -> ModelError:
        """The error of a distribution that is not `drawable` where it has to be."""
        return next(law for law in self.inside() if not law.drawable).undrawable(why)

    def expressions(self) -> list[Expr]:
        """All that the distribution is made of: its parameters, and what else it holds."""
        own = [e for p in self.parameters.values() for e in p.ravel()]
        return [*own, *(e for law in self.inside() for e in law.expressions())]

    def arguments(self) -> list[Expr]:
        """What the user gave for the parameters of the distribution and of those inside of it."""
        own = [e for p in self.parameters.values() for e in p.ravel()]
        return [*own, *(e for law in self.inside() for e in law.arguments())]

    def rebuilt(self, parameters: Mapping[str, Any]) -> Distribution:
        """The distribution of this family with these for its own `parameters`, at its place in the
        file."""
        values = {**self.parameters, **parameters}
        return self._at_place(type(self)(**{n.rstrip("_"): array(v) for n, v in values.items()}))  # type: ignore[call-arg]

    def _at_place(self, new: Distribution) -> Distribution:
        new.location = self.location
        return new

    def element(self, index: tuple[int, ...]) -> Distribution:
        """The distribution of one element of an elementwise distribution."""
        return self.rebuilt({n: a[index] for n, a in self.parameters.items()})

    def repeated(self, n: int) -> Distribution:
        """n independent ones along a new first axis, of an elementwise distribution."""
        whole = {k: np.broadcast_to(a.view(np.ndarray), (n, *a.shape))
                 for k, a in self.parameters.items()}  # fmt: skip
        return self.rebuilt(whole)

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

    def cdf_below(self, value: ExprArray) -> ExprArray:
        """P(X < value), element by element."""
        return self.cdf(array(value) - 1.0 if self.discrete else value)

    def quantile(self, p: ExprArray) -> ExprArray:
        """Inverse of `cdf`: for discrete distributions the smallest value with cdf >= p."""
        raise AttributeError

    # -- the upper tail, each to full relative accuracy where the distribution says how
    def survival(self, value: ExprArray) -> ExprArray:
        """P(X > value), element by element."""
        return 1.0 - self.cdf(value)

    def survival_quantile(self, p: ExprArray) -> ExprArray:
        """Inverse of `survival`."""
        return self.quantile(1.0 - array(p))

    def log_cdf(self, value: ExprArray) -> ExprArray:
        """Log of `cdf`, where the distribution says how beyond the range of floating point."""
        return array(elementwise("log", self.cdf(value)))

    def log_survival(self, value: ExprArray) -> ExprArray:
        """Log of `survival`, likewise."""
        return array(elementwise("log", self.survival(value)))

    def weighted(self, power: int) -> tuple[ExprArray, Distribution] | None:
        """(E[X^k], the distribution with density proportional to x^k times this one's), k = power.

        For counts x (x-1) ... (x-k+1) takes the place of x^k, and the distribution is that of
        X - k. None where it is no distribution of the language.
        """
        return None

    # -- what analyses make use of where it is known
    def location_and_scale(self) -> tuple[ExprArray, ExprArray] | None:
        """(m, s) with X = m + s Z, the distribution of Z free of what is in m and s."""
        return None

    def noise_free(self) -> ExprArray:
        """Where the value would be without noise, which `mean_link` moves: mean or centre."""
        return self.mean()

    def kink(self) -> ExprArray | None:
        """Where the density is not smooth inside of the support."""
        return None

    def truncated_moments(
        self, lower: ExprArray, upper: ExprArray
    ) -> tuple[ExprArray, ExprArray] | None:
        """Mean and variance between bounds, in a form of the distribution's own."""
        return None

    def rounded_inside(self, drawn: ExprArray) -> ExprArray:
        """A draw that was rounded to an open end of the support, moved inside."""
        return drawn

    def inverts(self) -> bool:
        """Whether its quantiles, and those of the distributions inside, have a formula."""
        return all(law.inverts() for law in self.inside())

    def shares(self) -> tuple[str, list[Any]] | None:
        """Parameters that sum to 1, and what they are called; None where there are none."""
        return None

    def has_moment(self, power: int) -> ExprArray:
        """Whether the tails are light enough for E|X|^power, as a condition."""
        return self._full(1.0)

    # -- in terms of the above
    @property
    def multivariate(self) -> bool:
        """Whether there is one density for several components."""
        return self.joint and self.shape != ()

    def _each(self, draw: Callable[[tuple[int, ...]], Any]) -> ExprArray:
        """An array of the distribution's shape, made index by index."""
        out = np.empty(self.shape, dtype=object)
        for i in np.ndindex(self.shape):
            out[i] = draw(i)
        return array(out)

    def _full(self, value: float) -> ExprArray:
        return array(np.full(self.shape, value))

    def open_sides(self, lower: ExprArray, upper: ExprArray) -> tuple[bool, bool]:
        """Whether lower (upper) bounds nothing: never inside the support."""
        support = self.support()
        return (
            all(map(_never_above, array(lower).ravel(), support.lower.ravel())),
            all(map(_never_above, support.upper.ravel(), array(upper).ravel())),
        )

    def log_mass(self, lower: ExprArray, upper: ExprArray) -> ExprArray:
        """log P(lower <= X <= upper), element by element.

        From the tail that the interval lies in, so that a far one is not lost to rounding.
        """
        lower, upper = array(lower), array(upper)
        whole_left, whole_right = self.open_sides(lower, upper)
        if whole_left:
            return self.log_cdf(upper)
        below = lower - 1.0 if self.discrete else lower
        if whole_right:
            return self.log_survival(below)
        cdf_below = self.log_cdf(below)
        left = log_difference(self.log_cdf(upper), cdf_below)
        right = log_difference(self.log_survival(below), self.log_survival(upper))
        return array(elementwise("where", elementwise("lt", cdf_below, -LOG_2), left, right))

    def quantile_between(
        self, p: ExprArray, q: ExprArray, lower: ExprArray, upper: ExprArray
    ) -> ExprArray:
        """Quantile of the distribution restricted to [lower, upper] at p, q = 1 - p."""
        whole_left, whole_right = self.open_sides(lower, upper)
        if whole_left:
            return self.quantile(p * self.cdf(upper))
        below = lower - 1.0 if self.discrete else lower
        if whole_right and not self.discrete:
            return self.survival_quantile(q * self.survival(below))
        low = self.cdf(below)
        left = self.quantile(q * low + p * (1.0 if whole_right else self.cdf(upper)))
        rest = 0.0 if whole_right else p * self.survival(upper)
        right = self.survival_quantile(q * self.survival(below) + rest)
        return array(elementwise("where", elementwise("lt", low, 0.5), left, right))

    def sample_above(self, draws: Draws, lower: ExprArray) -> ExprArray | None:
        """A draw given X >= lower, for those that do not invert their upper tail; else None."""
        return None

    def guarded_log_densities(self, value: ExprArray) -> ExprArray:
        """`log_densities`, and -inf outside the support.

        Of a discrete distribution, and of others with `guards_range`, NaN where a parameter is out
        of its range: a count of 0 takes no logarithm of it. The formulas of most continuous
        distributions are NaN there by themselves.
        """
        density = self._guarded_support(array(self.log_densities(value)), value)
        allowed = self.in_range() if self.discrete or self.guards_range else None
        return density if allowed is None else where(allowed, density, math.nan)

    def _guarded_support(self, density: ExprArray, value: ExprArray) -> ExprArray:
        support = self.support()
        if support.kind not in ("interval", "integers"):
            return density
        out = np.empty(density.shape, dtype=object)
        wide: list[Any] = [
            np.broadcast_to(array(a).view(np.ndarray), density.shape)
            for a in (support.lower, support.upper, value)
        ]
        lower, upper, v = wide
        for i in np.ndindex(density.shape):
            inside = constant(1.0)
            if not (lower[i].op == "const" and lower[i].data == -INFINITY):
                closed = self.discrete or self.closed
                inside = apply("le" if closed else "lt", lower[i], v[i])
            if not (upper[i].op == "const" and upper[i].data == INFINITY):
                below = apply("lt" if self.open_above else "le", v[i], upper[i])
                inside = below if inside is constant(1.0) else apply("and", inside, below)
            if self.discrete:
                whole = apply("eq", v[i], apply("floor", v[i]))
                inside = whole if inside is constant(1.0) else apply("and", inside, whole)
            out[i] = apply("where", inside, density[i], -INFINITY)
        return array(out)

    def log_density(self, value: Any, guard: bool = True) -> Expr:
        """Log density of the whole value, one expression; -inf outside the support.

        guard=False leaves the support out, as the analyses need it.
        """
        value = array(value)
        parts = self.guarded_log_densities(value) if guard else self.log_densities(value)
        return array(np.sum(array(parts)))[()]


def where(condition: Any, a: Any, b: Any) -> ExprArray:
    """a where the condition holds, else b, element by element."""
    return array(elementwise("where", condition, a, b))


def log_difference(a: Any, b: Any) -> ExprArray:
    """log(exp(a) - exp(b)) for a > b."""
    return array(a + elementwise("log1p", -array(elementwise("exp", array(b) - a))))


def is_infinite(bound: Any) -> bool:
    """Whether a bound bounds nothing."""
    return all(e.op == "const" and math.isinf(e.data) for e in array(bound).ravel())


def in_order(op: str, lower: ExprArray, upper: ExprArray) -> ExprArray | None:
    """Whether lower op upper, "lt" or "le", element by element; None where it surely is so."""
    for pair in zip(lower.ravel(), upper.ravel(), strict=True):
        numbers = [e.data for e in pair if e.op == "const"]
        if len(numbers) < 2 and not any(map(math.isinf, numbers)):
            return array(elementwise(op, lower, upper))
    return None


def _never_above(a: Expr, b: Expr) -> bool:
    """Whether a <= b is known without values for symbols."""
    return a is b or (a.op == b.op == "const" and a.data <= b.data)


def _plain_name(name: str) -> str:
    """A parameter as the user knows it."""
    return name.removeprefix("like_").rstrip("_")


# -- errors of a distribution's construction: what was given, and how it is written
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
    """What a distribution says whose arguments do not fit: Python's error, and how it is written.

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
        found = f"{name} has no argument {unknown[0]!r}; given were {given}"
        fix = distribution_hint(unknown[0], [*positional, *by_name], name)
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
