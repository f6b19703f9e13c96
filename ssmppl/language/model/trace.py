"""What a traced model is: its quantities, each a site with its distribution in terms of symbols.

A `Trace` holds, for every parameter, state and observation, its distribution(s) in terms of
symbols, and where each expression was written. Kinds of symbols:

================  ============================================================
parameter         theta
state             x_t where it is drawn, weighed and observed
state_prev        x_{t-1}, the arguments of a transition
observation       y_t;  seen: 1 where that component of y_t was measured
observation_prev  y_{t-1}, where a transition names a channel
input, input_prev u_t and u_{t-1};  time, time_prev: the row number, from 1
================  ============================================================

The distribution of a transition may read new values too, `NAME_next` in the user's function: those
of the noisy components that stand before it in `Trace.transition`, by their symbols of kind
"state"; of a deterministic state it holds the value's own expression. So p(x_t | x_{t-1}) is the
product of the distributions in that order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, wraps
from typing import Any, TypeVar

import numpy as np

from ssmppl.compiling import LOCK
from ssmppl.errors import Location, NotApplicable
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.language.distributions import Distribution
from ssmppl.language.model.component_names import ComponentNames
from ssmppl.language.model.pickling import UnpackedCache, digest_of, packed, unpacked

EXPERIMENT_NUMBER = "experiment_number"


@dataclass(frozen=True)
class Site:
    """One named quantity under one distribution.

    value : the symbols of the quantity, of the distribution's shape (symmetric matrices share
        the symbols of their lower half). Components of a vector of states with noise and without
        are two sites, `x[0:2]` and `x[2:5]`, in the initial distribution and in the transition.
    """

    name: str
    role: str
    distribution: Distribution
    value: ExprArray
    where: Location

    @property
    def shape(self) -> tuple[int, ...]:
        return self.value.shape

    @property
    def quantity(self) -> str:
        """The name of what the site is of: its own, unless it holds some components only."""
        name: str = self.value.ravel()[0].data[1]
        return name

    def index_of(self, s: Expr) -> tuple[int, ...]:
        """Where a component is in `value`."""
        index: tuple[int, ...] = s.data[2]
        return index if self.name == s.data[1] else (self.components.index(s),)

    @cached_property
    def components(self) -> list[Expr]:
        """The distinct symbols of the value, row by row."""
        return list(dict.fromkeys(self.value.ravel()))


@dataclass(frozen=True)
class Trace:
    """The traced model; see the module's docstring for its symbols.

    transition : in an order in which each distribution reads new values of earlier ones only.
    choices : element of an array that a symbol chose -> (the index, the number of elements).
    auxiliary : names of the states that are draws of a step: read by later distributions of the
        same step only. At the first row, where no step has led to, they are 0.
    time_step : the input that is the time to the next row, and its unit where times are dates.
    experiment : the column of long tables that tells experiments apart.
    component_names : of vectors and matrices, in results.
    per_experiment : names of the parameters of which each experiment has its own.
    experiments : labels of the experiments that these have values for, along their first axis; ()
        where there is a single one, and then they are parameters as others. The input
        `EXPERIMENT_NUMBER`, from 0, tells which one a row is of.
    singular_row, noiseless_row : of a trace bound to data, the first row of these in which the
        states have no density, and in which an observation has none.
    """

    name: str
    parameters: dict[str, Site]
    initial: dict[str, Site]
    transition: dict[str, Site]
    observations: dict[str, Site]
    proposal: dict[str, Site]
    inputs: dict[str, tuple[int, ...]]
    locations: dict[Expr, Location]
    functions: dict[str, list[Location]] = field(default_factory=dict)
    choices: dict[Expr, tuple[Expr, int]] = field(default_factory=dict)
    auxiliary: frozenset[str] = frozenset()
    time_step: tuple[str, str] | None = None
    experiment: str | None = None
    component_names: ComponentNames = field(default_factory=ComponentNames)
    per_experiment: tuple[str, ...] = ()
    experiments: tuple[Any, ...] = ()
    singular_row: NotApplicable | None = None
    noiseless_row: NotApplicable | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Packed once, and one object in each process that gets it: what was generated for it is
        found again by its identity."""
        content = self.__dict__.get("_packed")
        if content is None:
            content = packed((type(self), *(getattr(self, f.name) for f in fields(self))))
            object.__setattr__(self, "_packed", content)
        _received.put(digest_of(content), self)
        return _receive, (content,)

    @cached_property
    def parameter_symbols(self) -> list[Expr]:
        return [s for site in self.parameters.values() for s in site.components]

    @cached_property
    def states(self) -> dict[str, ExprArray]:
        """The symbols of every state by its name, of its shape, in whatever sites they are."""
        groups: dict[str, list[Site]] = {}
        for site in self.initial.values():
            groups.setdefault(site.quantity, []).append(site)
        return {
            name: own[0].value
            if len(own) == 1
            else symbols(own[0].role, name, (sum(len(s.value) for s in own),))
            for name, own in groups.items()
        }

    @cached_property
    def state_symbols(self) -> list[Expr]:
        return [s for value in self.states.values() for s in dict.fromkeys(value.ravel())]

    def law_of(self, s: Expr, role: str = "transition") -> Site:
        """The site that holds a component of a state. role : "transition" or "initial"."""
        sites: dict[str, Site] = getattr(self, role)
        return next(site for site in sites.values() if s in set(site.components))

    @cached_property
    def state_prev_symbols(self) -> list[Expr]:
        return [previous(s) for s in self.state_symbols]

    def label(self, s: Expr) -> str:
        """A component as results call it: `effect[winter]`; by its numbers where it has no name."""
        _, name, index = s.data
        return self.component_names.label(name, index)

    @property
    def approximations(self) -> dict[str, str]:
        """What a distribution stands for where it is an approximation, by the name of its
        quantity."""
        return {
            s.name: text for s in self.transition.values() if (text := s.distribution.approximation)
        }

    @cached_property
    def observation_symbols(self) -> list[Expr]:
        return [s for site in self.observations.values() for s in site.components]

    @property
    def given_inputs(self) -> dict[str, tuple[int, ...]]:
        """The inputs that the user gives."""
        return {n: shape for n, shape in self.inputs.items() if n != EXPERIMENT_NUMBER}

    @cached_property
    def input_symbols(self) -> list[Expr]:
        return [s for n, shape in self.inputs.items() for s in symbols("input", n, shape).ravel()]


_received: UnpackedCache[Trace] = UnpackedCache(most=64)


def _receive(content: bytes) -> Trace | None:
    def made() -> Trace:
        kind, *values = unpacked(content)
        trace: Trace = kind(*values)
        return trace

    return _received.get(digest_of(content), made)


def previous(s: Expr) -> Expr:
    """The symbol of the same quantity one step earlier."""
    kind, name, index = s.data
    return symbol(kind + "_prev", name, index)


def seen(s: Expr) -> Expr:
    """The symbol that is 1 where this component of an observation was measured, else 0."""
    return symbol("seen", *s.data[1:])


def symbols(kind: str, name: str, shape: tuple[int, ...], symmetric: bool = False) -> ExprArray:
    """The symbols of a named quantity, of the given shape."""
    out = np.empty(shape, dtype=object)
    for i in np.ndindex(*shape):
        index = (max(i), min(i)) if symmetric else i
        out[i] = symbol(kind, name, index)
    return array(out)


Derived = TypeVar("Derived")


def once_per_trace(derive: Callable[[Trace], Derived]) -> Callable[[Trace], Derived]:
    """What is derived from a trace alone: derived once, and kept for as long as the trace lives.

    It is kept by the trace itself, as it may know the trace: both go together.
    """

    @wraps(derive)
    def derived(trace: Trace) -> Derived:
        kept: dict[Callable, Any] = trace.__dict__.setdefault("_derived", {})
        if derive not in kept:
            with LOCK:
                if derive not in kept:
                    kept[derive] = derive(trace)
        found: Derived = kept[derive]
        return found

    return derived
