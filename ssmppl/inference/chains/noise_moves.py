"""What a move of the parameters takes along: the trajectory by its noises, or nothing.

`stand` gives the log density of where a chain is, `at` that of where a proposal would lead. Both
are densities of theta on its own scale given what is held fixed, up to one constant:

    NoiseMove   log p(theta, x, y) + log |dx / de|, the noises e held
    Collapsed   log p(theta, y), the states integrated out
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ssmppl.analysis.noises import Noises
from ssmppl.analysis.slices import comparable
from ssmppl.codegen.interweaving import compile_noises
from ssmppl.codegen.loading import Loaded
from ssmppl.codegen.twisted import TwistedFilter, backward_passes
from ssmppl.compiling import once_property
from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.exact.models import ExactModel
from ssmppl.inference.problem import Problem

Paths = list[np.ndarray]


class Move(Protocol):
    """How a proposal of theta is weighed and what it takes along."""

    def stand(self, theta: np.ndarray, paths: Paths) -> tuple[float, Any]:
        """(log density, what is held fixed); nothing can be moved from where it is not finite."""

    def at(self, theta: np.ndarray, held: Any, paths: Paths) -> tuple[float, Paths]:
        """(log density, trajectories) at another theta; -inf where there is none."""


@dataclass(frozen=True)
class NoiseMove:
    """The trajectory follows theta with its noises held fixed.

    found : the model by its noises. steered : whether they are those of the Gaussian approximation
    to the states' posterior, made at each theta along the trajectory that is likeliest at `near`.
    """

    problem: Problem
    found: Noises
    steered: bool
    near: np.ndarray

    def __getstate__(self) -> dict:
        return {f.name: self.__dict__[f.name] for f in fields(self)}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)

    @once_property
    def module(self) -> Loaded:
        return compile_noises(self.problem.trace, self.found, self.steered)

    @cached_property
    def references(self) -> tuple[np.ndarray | None, ...]:
        """For each experiment the trajectory (T, D) to linearise along; None where there is none.
        It depends on no chain, and never changes: see the kernel."""
        filter_ = self.problem.program.twisted if self.steered else None
        if not isinstance(filter_, TwistedFilter):
            return (None,) * len(self.problem.experiments)
        return tuple(filter_.mode(self.near, e.y, e.seen, e.u) for e in self.problem.experiments)

    def stands_near(self) -> bool:
        """Whether every experiment has a guide at `near`; elsewhere it hardly has, if not there."""
        experiments = self.problem.experiments
        return all(self._guide(i, self.near, e) is not None for i, e in enumerate(experiments))

    def stand(self, theta: np.ndarray, paths: Paths) -> tuple[float, Paths]:
        total, held = 0.0, []
        widest = max(len(self.found.initial.noise), len(self.found.transition.noise))
        for i, (e, path) in enumerate(zip(self.problem.experiments, paths, strict=True)):
            guide = self._guide(i, theta, e)
            noise = np.empty((e.steps, widest))
            held.append(noise)
            if guide is None:
                return -np.inf, held
            total += self.module.noise_of(theta, e.y, e.seen, e.u, *guide, path, noise)
            total += self._log_joint(theta, e, path)
        return comparable(float(total)), held

    def at(self, theta: np.ndarray, held: Paths, paths: Paths) -> tuple[float, Paths]:
        total, moved = 0.0, []
        for i, (e, path) in enumerate(zip(self.problem.experiments, paths, strict=True)):
            guide = self._guide(i, theta, e)
            if guide is None:
                return -np.inf, paths
            new = np.empty_like(path)
            given = (theta, e.y, e.seen, e.u, *guide, path, held[i], new)
            total += self.module.path_of(*given)
            if not abs(total) < np.inf:
                return -np.inf, paths
            total += self._log_joint(theta, e, new)
            moved.append(new)
        return comparable(float(total)), moved

    def _log_joint(self, theta: np.ndarray, e: Experiment, path: np.ndarray) -> float:
        """log p(x, y | theta); deterministic components are set on the way."""
        part = np.empty(1)
        self.problem.program.entry("log_joint")(theta, e.y, e.seen, e.u, path, part)
        return float(part[0])

    def _guide(
        self, i: int, theta: np.ndarray, e: Experiment
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """A (T, D, D), g (T, D) and their centre (T, D); None where they come to no number."""
        if not self.steered:
            return _NO_GUIDE
        x = self.references[i]
        if x is None:
            return None
        steps, d = x.shape
        r, r_initial = len(self.found.transition.noise), len(self.found.initial.noise)
        shapes = (steps, d), (steps, d, d), (steps, d, r), (d, r_initial)
        derivatives = [np.zeros(s) for s in shapes]
        looking = i not in self.looks
        g, h = (np.empty((steps, d)), np.empty((steps, d, d))) if looking else self.looks[i]
        given = (theta, e.y, e.seen, e.u, x, looking)
        if not self.module.linearise(*given, *derivatives, g, h):
            return None
        if looking and not self.data_told_by:
            self.looks[i] = g, h
        a, pull = np.empty((steps, d, d)), np.empty((steps, d))
        if d == r == r_initial == 1:
            fine = backward_passes().look_back_scalar(x, *derivatives, g, h, a, pull)
        else:
            widest = max(r, r_initial)
            rest = np.empty((steps, widest)), np.empty((steps, widest, d))
            fine = backward_passes().look_back(x, *derivatives, g, h, 0, a, pull, *rest)
        return (a, pull, x) if fine else None

    @cached_property
    def looks(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """By experiment, what the data say of the reference, where no parameter stands in it."""
        return {}

    @cached_property
    def data_told_by(self) -> bool:
        """Whether a parameter is in the law of an observation."""
        assert not isinstance(self.found.guide, NotApplicable)
        return any(s.data[0] == "parameter" for s in symbols_of(self.found.guide.observed))


_NO_GUIDE = np.empty((0, 0, 0)), np.empty((0, 0)), np.empty((0, 0))


@dataclass(frozen=True)
class Collapsed:
    """The states are integrated out by the exact likelihood, and drawn anew after the move."""

    problem: Problem
    model: ExactModel

    def stand(self, theta: np.ndarray, paths: Paths) -> tuple[float, None]:
        return comparable(self.model.log_likelihood(self.problem.experiments, theta)), None

    def at(self, theta: np.ndarray, held: None, paths: Paths) -> tuple[float, Paths]:
        return self.stand(theta, paths)[0], paths
