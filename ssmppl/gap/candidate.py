"""A candidate: an effect bound to one equation of one model."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssmppl.errors import ModelError, listing
from ssmppl.expressions.expr import Expr
from ssmppl.gap.declared import PROFILES
from ssmppl.gap.effect import Effect

# What a state, a channel, ... has changed by an effect of kind "state".
OF_ROLE = {"state": "transition", "channel": "observation", "input": "input",
           "parameter": "parameter"}  # fmt: skip


@dataclass(frozen=True)
class Candidate:
    """An effect bound to one equation of one model, its shape parameters in numbers.

    equation : label of what is changed: "v", "x[0]", "y", an input, a parameter.
    shape : (name, number) of each shape parameter; a symbol may stand for a number that is no
        length of an auxiliary state.
    bound : (argument, label) of each argument that is another state, an input, a position.
    strength : name of its parameter; 0 gives the model back.
    role : what the equation is: "state", "channel", "input" or "parameter".
    held : its process is held at 1: see `increment`.
    reaction : (label, factor) of each equation that moves with its own, by so many times as much
        (`flows`). carried : likewise of what integrates its new value.
    shares : candidates of the same text here have the same shapes, which then are one parameter.
    """

    effect: Effect
    equation: str
    shape: tuple[tuple[str, Any], ...] = ()
    bound: tuple[tuple[str, str], ...] = ()
    role: str = "state"
    strength: str = "strength"
    held: bool = False
    shares: str = ""
    reaction: tuple[tuple[str, Expr], ...] = ()
    carried: tuple[tuple[str, Expr], ...] = ()

    @property
    def kind(self) -> str:
        """The kind of its effect; "state" effects keep it."""
        return self.effect.kind

    @property
    def form(self) -> str:
        """The form of its effect, with what else it is bound to."""
        free = [a for a, role in self.effect.given.items() if role in ("other state", "any input")]
        others = [label for a, label in self.bound if a in free]
        parts = [self.effect.form, *(f"by {label}" for label in others)]
        if self.reaction:
            parts.append(f"with {' and '.join(label for label, _ in self.reaction)}")
        return ", ".join(filter(None, parts))

    @property
    def group(self) -> str:
        """The same for candidates that differ in their shape only."""
        own = [self.effect.name, self.form]
        if self.held:
            own = [self.effect.constant, ""] if self.effect.constant else [*own, "held"]
        return " | ".join([*own, self.change, self.equation])

    @property
    def key(self) -> str:
        """One text for each candidate; the same for increments that are the same."""
        profile = PROFILES.get(self.effect.profile)
        time = inspect.signature(profile).parameters if profile and self.held else {}
        hidden = {s for s, _ in self.shape} if self.held and self.effect.process else {*time}
        shape = ", ".join(f"{n}={v if isinstance(v, Expr) else f'{v:.14g}'}"
                          for n, v in self.shape if n not in hidden)  # fmt: skip
        return f"{self.group} | {shape}" if shape else self.group

    @property
    def change(self) -> str:
        """What it does to its equation, as a kind other than "state"."""
        return OF_ROLE[self.role] if self.kind == "state" else self.kind

    @property
    def sided(self) -> int:
        """The sign that its strength must have, 0 for both."""
        return int(self.effect.lower >= 0.0) - int(self.effect.upper <= 0.0)

    def variable(self, argument: str) -> str:
        """The label of what an argument stands for; "" is the first."""
        own = {"": self.equation, self.effect.arguments[0]: self.equation}
        return {**own, **dict(self.bound)}.get(argument, argument)

    @property
    def first_order(self) -> bool:
        """False where the strength scales a process of mean zero, so that its score is zero."""
        return self.held or not self.effect.process

    @property
    def process(self) -> str:
        """ "random walk", "ar1" (shape "memory"), or ""."""
        return "" if self.held else self.effect.process

    @property
    def increment(self) -> Candidate:
        """With its process (or function of time) held at 1: the column that a quadratic form in
        the process's covariance, or the weights of `weights`, turn into its statistic."""
        return replace(self, held=True) if self.effect.process or self.effect.profile else self

    def weights(self, n: int) -> np.ndarray:
        """Its function of time at the rows 1, ..., n; ones where it has none. (n,)

        The score of the step into a row stands in that row, while its t is that of the row before.
        """
        if not self.effect.profile:
            return np.ones(n)
        t = np.arange(1.0, n + 1.0) - (self.change == "transition")
        function = PROFILES[self.effect.profile]
        shape = {k: v for k, v in self.shape if k in inspect.signature(function).parameters}
        return np.asarray(function(t, **shape), dtype=float)

    def with_shape(self, **shape: float) -> Candidate:
        """The same candidate with other values of its shape parameters."""
        known = dict(self.shape)
        if unknown := [n for n in shape if n not in known]:
            raise ModelError(
                f"{self.effect.name!r} has no shape parameter {unknown[0]!r}",
                fix=f"its shape parameters are: {listing(unknown[0], known)}",
                where=self.effect.where,
            )
        values = {**known, **{n: float(v) for n, v in shape.items()}}
        return replace(self, shape=tuple(values.items()))

    def __str__(self) -> str:
        form = f" ({self.form})" if self.form else ""
        shape = ", ".join(f"{n} = {shape_text(v)}" for n, v in self.shape)
        return f"{self.effect.name}{form} in {self.equation}" + (f" with {shape}" if shape else "")


def shape_text(value: float | Expr) -> str:
    """The value of a shape parameter, a round one in full; or the symbol that stands for it."""
    if isinstance(value, Expr):
        return repr(value)
    whole = f"{value:.14g}"
    return whole if float(whole) == value else f"{value:g}"
