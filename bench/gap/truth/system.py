"""System: a true system with its withheld effects, and how a data set is drawn from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from bench.gap.truth.forms import SLOTS, WILD, driven

UNCERTAIN = 0.05  # sd of the log of a true parameter from one data set to the next


@dataclass(frozen=True)
class Effect:
    """A withheld effect: where it enters, what counts as naming it, where a search starts.

    slot : of the vector of strengths, by name.
    item : key of names.ITEMS; None where the catalogue has nothing like it.
    equations : of the model that count as right, the first is the one meant.
    start : strength at which the search begins; also the unit in which it is fitted.
    """

    slot: str
    item: str | None
    equations: tuple[str, ...]
    start: float

    @property
    def index(self) -> int:
        return SLOTS.index(self.slot)


@dataclass(frozen=True)
class System:
    """A system of n state components (those of the model first, then the effects' own).

    step(s, u, t, p, e, mean, sd) and observe(s, u, t, p, e, mean, sd, wild) are compiled and fill
    the law of the next state and of the channels: independent normals, a share `wild` of them four
    times wider; with `counts`, Poisson of that mean. p: positive parameters in their order, e:
    strengths (zero: the base model), t: row from 1.

    control : of a closed loop: control(y, reference, memory) gives the row's inputs from what is
        measured in that row, and keeps what it needs in `memory`, zeros at first. `excite` then
        gives references, not inputs, and `observe` does not look at u, which comes after it.
    resolution : of the sensors, whose readings are whole multiples of it; 0 where they are not.
    """

    name: str
    steps: int
    parameters: dict[str, float]
    inputs: tuple[str, ...]
    channels: tuple[str, ...]
    states: tuple[str, ...]
    start: tuple[tuple[float, float], ...]  # mean and sd of each component of the first state
    step: Callable
    observe: Callable
    excite: Callable[[np.random.Generator, int], np.ndarray]  # (T, inputs)
    effects: dict[str, Effect] = field(default_factory=dict)
    counts: bool = False
    control: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None
    memory: int = 0
    resolution: float = 0.0

    @property
    def inside(self) -> dict[str, Effect]:
        """The effects that the catalogue has."""
        return {key: e for key, e in self.effects.items() if e.item is not None}

    @property
    def outside(self) -> dict[str, Effect]:
        return {key: e for key, e in self.effects.items() if e.item is None}

    def strengths(self, given: dict[str, float]) -> np.ndarray:
        """The vector e with the named effects at their strengths."""
        e = np.zeros(len(SLOTS))
        for key, value in given.items():
            e[self.effects[key].index] = value
        return e

    def drawn_parameters(self, rng: np.random.Generator) -> np.ndarray:
        """True parameters of one data set: the nominal ones, each about 5% off."""
        nominal = np.array(list(self.parameters.values()))
        return nominal * np.exp(UNCERTAIN * rng.standard_normal(len(nominal)))

    def simulate(
        self, p: np.ndarray, e: np.ndarray, U: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """States (T, n) and observations (T, channels) of one run driven by U (T, inputs), or of
        a closed loop that follows the references U."""
        return self.recorded(p, e, U, rng)[1:]

    def recorded(
        self, p: np.ndarray, e: np.ndarray, excited: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inputs (T, inputs), states (T, n) and observations (T, channels) of one run; `excited`
        is what `excite` gives."""
        T, n, m = len(excited), len(self.start), len(self.channels)
        U = excited if self.control is None else np.zeros((T, len(self.inputs)))
        V = np.ascontiguousarray(driven(U, e) if self.control is None else U.copy())
        X, Y = np.empty((T, n)), np.empty((T, m))
        mean, sd = np.zeros(n), np.zeros(n)
        level, spread, wild = np.zeros(m), np.zeros(m), np.zeros(m)
        memory = np.zeros(self.memory)
        noise, errors = rng.standard_normal((T, n)), rng.standard_normal((T, m))
        first = np.array(self.start)
        s = first[:, 0] + first[:, 1] * noise[0]
        for t in range(T):
            X[t] = s
            wild[:] = 0
            self.observe(s, V[t], t + 1, p, e, level, spread, wild)
            if self.counts:
                Y[t] = rng.poisson(level)
            else:
                wide = np.where(rng.random(m) < wild, WILD, 1.0)
                Y[t] = level + spread * wide * errors[t]
            if self.resolution:
                Y[t] = np.round(Y[t] / self.resolution) * self.resolution
            if self.control is not None:
                U[t] = self.control(Y[t], excited[t], memory)
                V[t] = driven(U[: t + 1], e)[t]  # effects on the input look back, never ahead
            if t + 1 < T:
                self.step(s, V[t], t + 1, p, e, mean, sd)
                s = mean + sd * noise[t + 1]
        return U, X, Y
