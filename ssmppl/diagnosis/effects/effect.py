"""What an unmodelled effect is: a change of one equation of a model, with a strength; 0 = none.

An effect is a Python function in the model's language. Its first argument is the value of what it
is bound to; the others are bound by name: ``strength``, the row number ``t``, the effect's own
shape parameters and auxiliary states, the names given by `given`, and the model's quantities.

=============  =================  ================================================================
kind           bound to           what the function returns
=============  =================  ================================================================
"transition"   state              increment of the transition's mean; or, by argument, of several
                                  states: ``{"x": -over, "other": over}``
"observation"  channel            increment of the observation's mean; first argument: that mean,
                                  on the scale on which increments act
"input"        input              the input that acts in its place (itself at strength 0)
"noise"        state or channel   increment of the log variance of its distribution
"tail"         state or channel   1 / df of Student's t in place of the normal distribution
"parameter"    parameter          its value at row t (itself at strength 0)
"initial"      state              shift of the mean of x_1
"state"        any but "initial"  an `Auxiliary`: what the kind of its equation returns (a state:
                                  "transition", a channel: "observation", ...), with the
                                  distributions of further states
=============  =================  ================================================================

Increments act on the mean of Normal, MvNormal, StudentT, Laplace, Cauchy and Dirac distributions,
on the mean of the log of LogNormal, on the log of the mean of Poisson, NegativeBinomial, Gamma,
Exponential and Weibull and on the logit of that of Bernoulli and Binomial distributions; of the
distribution inside Truncated and ZeroInflated. Other distributions have no mean that an effect
could move.

==================  ===========================================================================
`on`                which equations it is offered for
==================  ===========================================================================
"any"               all that its kind can be bound to
"rate"              states, unless they are only the integral or a copy of another quantity
"state"             states, unless they are so without noise: a position that integrates a velocity
"channel", "input"  observation channels; inputs
"parameter"         parameters; also "positive parameter" and "other parameter"
a name or label     that one: "v", "x[0]"
==================  ===========================================================================

==================  ===========================================================================
`given`             what the argument is
==================  ===========================================================================
"position"          the state that integrates the one it is bound to; where none does, that itself
"integral"          likewise; not offered where none does
"ahead"             "position"; in a simulator's step, where that ends without the effect
"moved"             how far that one moves in the step
"next"              the mean of the step, without the effect and with all others; not offered
                    where a simulator's force acts on the state
"other state"       another state: one candidate for each
"any input"         an input: one candidate for each
"second order"      what a second-order step would add to an Euler step: F'F / 2, F the increment
"profile"           the function of time that `profile` names (`PROFILES`)
==================  ===========================================================================
"""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, listing
from ssmppl.language.distributions import Distribution
from ssmppl.language.model.model import location_of
from ssmppl.language.model.pickling import holder_of

_MISSING: Any = None
Bounds = tuple[float, float] | None

# The most strength of an effect that is whole at 1. Beyond, a delay extrapolates, so that one of 2
# rows at twice the strength passes for one of 4, and a limit folds what exceeds it back: pulses in
# the few highest rows. What is over leaves an estimate near 1 its error.
MOST_STRENGTH = 1.25

# The words of a declaration: see the tables above.
KINDS = ("transition", "observation", "input", "noise", "tail", "parameter", "initial", "state")
GIVEN = (
    "position",
    "integral",
    "ahead",
    "moved",
    "next",
    "other state",
    "any input",
    "second order",
    "profile",
)
ON = ("any", "rate", "state", "channel", "input", "parameter", "positive parameter",
      "other parameter")  # fmt: skip
REQUIRES = ("positive", "both signs", "additive")
PROCESSES = ("random walk", "ar1")  # of zero mean: their score in `strength` is zero

# What naming an effect says: a function of states, inputs and their past, with few numbers; a
# function of time, which cannot carry to another record; a latent process, which fits any misfit of
# a mean for as long as it remembers; a law of the noise.
MECHANISM, CHANGE_IN_TIME = "mechanism", "change in time"
UNKNOWN_INPUT, NOISE_LAW = "unknown input", "noise law"
CAUSES = (MECHANISM, CHANGE_IN_TIME, UNKNOWN_INPUT, NOISE_LAW)
ASKED = {MECHANISM: 0, CHANGE_IN_TIME: 1, UNKNOWN_INPUT: 1, NOISE_LAW: 2}  # the lowest first

# Functions of time by name: of t and of shape parameters.
PROFILES: dict[str, Callable[..., Any]] = {
    "drift": lambda t, rows: t / rows - 0.5,
    "step": lambda t, date: np.where(t >= date, 1.0, 0.0),
    "pulse": lambda t, date: np.where(t == date, 1.0, 0.0),
    "wave": lambda t, period, phase: np.cos(2.0 * math.pi / period * t - phase),
}


@dataclass(frozen=True)
class Grid:
    """The values of a shape parameter, relative to a scale that binding turns into numbers.

    unit : "number"; "sd", "mean" or "first" (multiples of them; the first value that was measured),
        "quantile" (levels) or "size" (levels of absolute values) of the variable; "rows" (shares of
        the number of rows, rounded).
    of : the argument whose variable is meant; "" is the first.
    between : bounds in the same unit, between which refits estimate the parameter; None: it stays
        at a value of the grid.
    """

    unit: str
    values: tuple[float, ...]
    of: str = ""
    between: tuple[float, float] | None = None


def numbers(*values: float, between: Bounds = None) -> Grid:
    """Values of a shape parameter, as they are.

    Parameters
    ----------
    *values : the values that are tried.
    between : as of `sds`.

    Returns
    -------
    Grid : of values, for `shapes`.
    """
    return Grid("number", values, between=between)


def _relative(name: str, unit: str, what: str) -> Callable[..., Grid]:
    """The public function `name`, which makes a grid in this unit of the variable."""

    def grid(*values: float, of: str = "", between: Bounds = None) -> Grid:
        return Grid(unit, values, of, between)

    grid.__name__ = grid.__qualname__ = name
    grid.__doc__ = f"""{what}.

    Parameters
    ----------
    *values : those that are tried.
    of : the argument of the effect whose variable is meant; "" is the first.
    between : bounds in the same unit, between which refits estimate the parameter; None: it stays
        at a value of the grid.

    Returns
    -------
    Grid : of values, for `shapes`.
    """
    return grid


sds = _relative("sds", "sd", "Multiples of the variable's standard deviation")
means = _relative("means", "mean", "Multiples of the variable's mean")
firsts = _relative("firsts", "first", "Multiples of the variable's first value")
quantiles = _relative("quantiles", "quantile", "Quantiles of the variable, by their levels")
sizes = _relative("sizes", "size", "Quantiles of the variable's absolute value, by their levels")


def rows(*shares: float) -> Grid:
    """Shares of the number of rows, rounded to whole rows.

    Parameters
    ----------
    *shares : from 0 to 1.

    Returns
    -------
    Grid : of values, for `shapes`.
    """
    return Grid("rows", shares)


@dataclass(frozen=True)
class Auxiliary:
    """Returned by an effect of kind "state".

    change : what the effect does to its equation, from the auxiliary states among the arguments.
    transition, initial : by auxiliary state, its distribution given the step before, and of x_1;
        the latter may depend on parameters and inputs only.
    """

    change: Any
    transition: Mapping[str, Distribution]
    initial: Mapping[str, Distribution]


@dataclass(frozen=True, eq=False)
class Effect:
    """An unmodelled effect as declared; see the tables of this module.

    lower, upper : of the strength.
    shapes : name -> `Grid` or numbers: parameters that exist only when the strength is not 0.
    given : argument -> what it is (the table of `given`).
    states : auxiliary state -> the shape parameter that is its length, or None for a scalar.
    profile : name of the function of time in the argument that is given as "profile".
    process : "random walk" or "ar1" where the auxiliary state is such a process of mean zero, so
        that the score in the strength itself is zero.
    constant : what it is called with its process or profile held at 1; effects that share this
        name are then the same.
    requires : "positive" where it makes sense for a variable above 0 only, "both signs" where it
        is a constant for one that never changes its sign, "additive" where increments of the mean
        are no such on another scale (see above).
    afresh : the strength with which the model is fitted anew from its own start where the variable
        keeps one sign, None for no such fit: its fit may lie where the effect is nothing.
    common : whether it is offered for all inputs at once, too, with one strength: what delays the
        way from a computer delays every input.
    note : the formula or what it stands for, in words.
    """

    name: str
    kind: str
    function: Callable[..., Any]
    on: str = "any"
    form: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    shapes: Mapping[str, Grid] = field(default_factory=dict)
    given: Mapping[str, str] = field(default_factory=dict)
    states: Mapping[str, str | None] = field(default_factory=dict)
    profile: str = ""
    process: str = ""
    constant: str = ""
    requires: str = ""
    afresh: float | None = None
    common: bool = False
    note: str = ""

    def __post_init__(self) -> None:
        shapes = {k: g if isinstance(g, Grid) else numbers(*g) for k, g in self.shapes.items()}
        object.__setattr__(self, "shapes", shapes)
        check(self)

    @property
    def cause(self) -> str:
        """What naming it says, one of `CAUSES`."""
        if self.kind in ("noise", "tail") or (self.process and self.on == "channel"):
            return NOISE_LAW  # of a sensor: nothing enters the system by it
        if self.process:
            return UNKNOWN_INPUT
        return CHANGE_IN_TIME if self.profile or self.kind == "initial" else MECHANISM

    @property
    def where(self) -> Location:
        """Where its function is written."""
        return location_of(self.function)

    @property
    def arguments(self) -> list[str]:
        """Names of the function's arguments."""
        return list(inspect.signature(self.function).parameters)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.function(*args, **kwargs)

    def __repr__(self) -> str:
        form = f" ({self.form})" if self.form else ""
        return f"<effect {self.name!r}{form}: {self.kind} on {self.on}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """By name where a module holds it in place of its function, as decorated ones are."""
        fields = {k: getattr(self, k) for k in self.__dataclass_fields__}
        module, name = self.function.__module__, self.function.__qualname__
        holder = holder_of(self.function)
        if holder is self:
            return _by_name, (module, name)
        if isinstance(holder, Effect) and holder.function is self.function:  # renamed
            del fields["function"]
            return _by_name, (module, name, fields)
        return _made, (fields,)


def _by_name(module: str, name: str, changed: dict[str, Any] | None = None) -> Effect:
    found: Effect = getattr(importlib.import_module(module), name)
    return replace(found, **changed) if changed else found


def _made(fields: dict[str, Any]) -> Effect:
    return Effect(**fields)


def effect(
    function: Callable[..., Any] = _MISSING,
    *,
    on: str = "any",
    name: str = "",
    kind: str = "transition",
    form: str = "",
    lower: float | None = None,
    upper: float | None = None,
    shapes: Mapping[str, Grid | Iterable[float]] | None = None,
    given: Mapping[str, str] | None = None,
    states: Mapping[str, str | None] | Iterable[str] = (),
    profile: str = "",
    process: str = "",
    constant: str = "",
    requires: str = "",
    afresh: float | None = None,
    common: bool = False,
    note: str = "",
) -> Any:
    """Declare an unmodelled effect that `diagnose` shall look for.

    Parameters
    ----------
    function : what it does; its arguments name what it depends on, `strength` among them.
    on : which equations it is offered for: "rate", "any", or the name of one, ...
    name : what the report calls it; by default the function's name with spaces.
    kind : what the function changes; see the tables of this module.
    form : tells this effect from others of the same name.
    lower, upper : bounds of the strength. `lower` alone must be 0.
    shapes, given, states, profile, process, constant, requires, afresh, common, note : see
        `Effect`.

    Returns
    -------
    Effect : for the list of effects that `diagnose` takes.

    Raises
    ------
    ModelError : the declaration does not fit the function; names file and line.

    Examples
    --------
    >>> import numpy as np
    >>> import ssmppl as ssm
    >>> from ssmppl import effect
    >>> @effect(on="rate", name="quadratic drag", lower=0)
    ... def quadratic_drag(v, strength):
    ...     return -strength * v * np.abs(v)
    >>> quadratic_drag
    <effect 'quadratic drag': transition on rate>
    """

    def declare(function: Callable[..., Any]) -> Effect:
        if not inspect.isfunction(function):
            raise ModelError(
                f"@effect decorates {function!r}, which is not a function",
                fix='write @ssm.effect(on="rate") on the line above a def',
            )
        doc = " ".join((function.__doc__ or "").split())
        return Effect(
            name=name or function.__name__.replace("_", " "),
            kind=kind,
            function=function,
            on=on,
            form=form,
            lower=-math.inf if lower is None else float(lower),
            upper=math.inf if upper is None else float(upper),
            shapes=dict(shapes or {}),  # type: ignore[arg-type]
            given=dict(given or {}),
            states=dict(states if isinstance(states, Mapping) else dict.fromkeys(states)),
            profile=profile,
            process=process,
            constant=constant,
            requires=requires,
            afresh=afresh,
            common=common,
            note=note or doc,
        )

    return declare if function is _MISSING else declare(function)


def declared(module: Mapping[str, Any]) -> tuple[Effect, ...]:
    """The effects among the global names of a module, in the order in which they stand there."""
    return tuple(e for e in module.values() if isinstance(e, Effect))


def check(e: Effect) -> None:
    """Check that the declaration fits the function.

    Raises
    ------
    ModelError : naming the function's line.
    """
    for found, fix in _faults(e):
        raise ModelError(f"the effect {e.name!r}: {found}", fix=fix, where=e.where)


def _faults(e: Effect) -> Iterator[tuple[str, str]]:
    """Faults of a declaration, and their fixes; each assumes that none came before."""
    parameters = inspect.signature(e.function).parameters
    if e.afresh is not None and not (e.lower < e.afresh < e.upper and e.afresh != 0.0):
        yield (
            f"afresh={e.afresh!r} is no strength between {e.lower:g} and {e.upper:g} other than 0",
            "give the strength at which the model shall be fitted anew, or leave it out",
        )
    if e.kind not in KINDS:
        yield (f"its kind is {e.kind!r}", f"use one of: {listing(str(e.kind), KINDS)}")
    if e.common and e.on != "input":
        yield (
            f"common={e.common!r}, and it is offered on {e.on!r}",
            'give on="input", or leave common out',
        )
    if any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters.values()):
        yield ("it takes *arguments", "name each argument: they are bound by name")
    if not isinstance(e.on, str) or not e.on:
        yield (f"on is {e.on!r}", f"use one of {', '.join(ON)}, or the name of a quantity")
    if "strength" not in parameters:
        yield (
            f"{e.function.__name__}({', '.join(parameters)}) has no argument `strength`",
            "add it: the number that is estimated, 0 where there is no such effect",
        )
    if next(iter(parameters)) == "strength":
        yield (
            "its first argument is `strength`",
            "let the first be the value of what it is bound to, for example the state v",
        )
    for what, names in (("shapes", e.shapes), ("given", e.given), ("states", e.states)):
        for name in names:
            needed_by_profile = what == "shapes" and e.profile
            if name not in list(parameters)[1:] and not needed_by_profile:
                yield (
                    f"{what} names {name!r}, which is no further argument of the function",
                    f"its arguments are: {listing(name, parameters)}",
                )
    for argument, role in e.given.items():
        if role not in GIVEN:
            yield (
                f"given says that {argument!r} is {role!r}",
                f"use one of: {listing(role, GIVEN)}",
            )
    for name, grid in e.shapes.items():
        if not grid.values or not all(map(math.isfinite, grid.values)):
            yield (f"the shape {name!r} has the values {grid.values}", "give finite numbers")
        if grid.between is not None:
            low, high = grid.between
            if not low <= min(grid.values) <= max(grid.values) <= high or low == high:
                yield (
                    f"the shape {name!r} is estimated between {low} and {high}, and its values are "
                    f"{grid.values}",
                    "give bounds that hold them",
                )
            if name in e.states.values():
                yield (
                    f"the shape {name!r} is a number of states, which cannot be estimated",
                    "leave out between=",
                )
        if grid.of and grid.of not in parameters:
            yield (
                f"the shape {name!r} is relative to {grid.of!r}, which is no argument",
                f"its arguments are: {listing(grid.of, parameters)}",
            )
    if not e.lower < e.upper or e.lower > 0 or e.upper < 0:
        yield (
            f"the strength lies between {e.lower:g} and {e.upper:g}, which must hold 0",
            "give lower=0 for an effect that has one direction only",
        )
    half = [b for b in (e.lower, e.upper) if math.isfinite(b)]
    if len(half) == 1 and e.lower != 0:
        yield (
            f"the strength has the one bound {half[0]:g}",
            "give lower=0, or both lower and upper",
        )
    if (e.kind == "state") != bool(e.states):
        yield (
            f"its kind is {e.kind!r} and its auxiliary states are {list(e.states)}",
            'give kind="state" and states=("name",) together',
        )
    if e.kind == "state" and e.on == "any":
        yield ('it is on "any"', f"say what it is bound to: {', '.join(ON[1:])}, or a name")
    for name, length in e.states.items():
        if length is not None and length not in e.shapes:
            yield (
                f"the length of {name!r} is {length!r}, which is none of its shapes",
                f"its shapes are: {listing(length, e.shapes)}",
            )
    if e.process and (e.process not in PROCESSES or not e.states):
        yield (
            f"its process is {e.process!r}",
            f'use one of {", ".join(PROCESSES)}, with kind="state" and its auxiliary state',
        )
    if e.requires not in ("", *REQUIRES):
        yield (
            f"it requires {e.requires!r}",
            f"use one of: {listing(e.requires, REQUIRES)}, or none",
        )
    if bool(e.profile) != ("profile" in e.given.values()):
        yield (
            f"its profile is {e.profile!r} and given is {dict(e.given)}",
            'name both: profile="step", given={"w": "profile"}',
        )
    if e.profile:
        known = PROFILES.get(e.profile)
        if known is None:
            yield (f"its profile is {e.profile!r}", f"use one of: {listing(e.profile, PROFILES)}")
        elif missing := set(inspect.signature(known).parameters) - {"t", *e.shapes}:
            yield (
                f"the profile {e.profile!r} needs the shapes {', '.join(sorted(missing))}",
                "give their values in shapes",
            )
