"""The M-step, done: where the expected complete-data log density Q is largest.

Q and its groups of parameters are derived in `analysis/conjugacy/m_step.py`. A group is maximised

- in closed form, where one block is all of it and inside a family: the mode is the maximum;
- by several such blocks in turn (a Normal vector and a precision matrix), each given the others,
  until nothing moves (conditional maximisation, Meng and Rubin 1993, "Maximum likelihood estimation
  via the ECM algorithm");
- else by Newton's method on the unconstrained scale (`symbolic_newton.py`), from the present value
  or from the closed form that leaves out the functions outside of the family, whichever has the
  larger Q (Schön et al. 2015, appendix, do so for their log(1 - phi**2)).

No M-step lowers Q by more than rounding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ssmppl.analysis.conjugacy.m_step import ClosedForm, Group, MStep
from ssmppl.analysis.lambdify import DOMAIN, python_function
from ssmppl.expressions.expr import Expr, constant
from ssmppl.inference.updates.symbolic_newton import SymbolicNewton

SWEEPS = 50  # of conditional maximisations in one M-step
SETTLED = 1e-13  # relative change at which they stop
ROUNDING = 1e-12  # of the summed sizes of the terms of Q


class QFunction:
    """Q of a derived M-step as a function of numbers: S (functions,) and theta (P,)."""

    def __init__(self, step: MStep):
        self._groups = [_GroupQ(step, group) for group in step.groups]
        self._prior = python_function(
            step.update.coefficients["prior"], step.trace.parameter_symbols
        )

    def prior(self, theta: np.ndarray) -> np.ndarray:
        """The prior's part of the statistics."""
        return np.array(self._prior(theta.tolist()), dtype=float)

    def value(self, s: np.ndarray, theta: np.ndarray) -> float:
        """Q(theta), up to what does not depend on the free parameters."""
        totals = np.asarray(s, dtype=float).tolist()
        return sum(g.value(totals, theta)[0] for g in self._groups)

    def maximise(self, s: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """theta with the free parameters where Q with the statistics S is largest."""
        totals = np.asarray(s, dtype=float).tolist()
        for group in self._groups:
            theta = group.maximise(totals, theta)
        return theta


class _GroupQ:
    """The part of Q that holds one group of parameters."""

    def __init__(self, step: MStep, group: Group):
        self.step, self.group = step, group
        arguments = [*step.statistics, *step.trace.parameter_symbols]
        self.where = _positions(step, group.components)
        self.functions = python_function(group.functions, arguments)
        self.blocks = [_Mode(step, block, arguments) for block in group.blocks]

    @cached_property
    def newton(self) -> SymbolicNewton:
        step, group, total = self.step, self.group, constant(0.0)
        for i, function in zip(group.indices, group.functions, strict=True):
            total = total + step.statistics[i] * function
        return SymbolicNewton(step.trace, group.components, total, step.statistics)

    def value(self, s: Sequence[float], theta: np.ndarray) -> tuple[float, float]:
        """(Q's part, the sum of its terms' sizes); -inf outside of its domain."""
        try:
            functions = self.functions([*s, *theta.tolist()])
        except DOMAIN:
            return -math.inf, 0.0
        pairs = zip(self.group.indices, functions, strict=True)
        terms = [s[i] * f for i, f in pairs if s[i] != 0.0]
        total = math.fsum(terms) if all(map(math.isfinite, terms)) else -math.inf
        return total, math.fsum(map(abs, terms)) if total > -math.inf else 0.0

    def maximise(self, s: Sequence[float], theta: np.ndarray) -> np.ndarray:
        """theta with the group's parameters where Q is largest, or at least as large as it was."""
        before, size = self.value(s, theta)
        trial, settled = self.closed_forms(s, theta)
        if not (self.group.closed and settled):
            start = trial if self.value(s, trial)[0] > before else theta
            trial = self.newton.maximise(s, start)
        after = self.value(s, trial)[0]
        return trial if after >= before - ROUNDING * size else theta

    def closed_forms(self, s: Sequence[float], theta: np.ndarray) -> tuple[np.ndarray, bool]:
        """(theta after the closed forms in turn, whether that is the maximum if all are exact)."""
        theta = theta.copy()
        for _ in range(SWEEPS if self.group.closed else 1):
            old = theta[self.where]
            for block in self.blocks:
                values = block(s, theta)
                if values is None:
                    return theta, False
                theta[block.where] = values
            if len(self.blocks) == 1:
                return theta, True
            if np.all(np.abs(theta[self.where] - old) <= SETTLED * np.abs(old)):
                return theta, True
        return theta, False


class _Mode:
    """(S, theta) -> a block's values where Q, without what lies outside of the family, is largest;
    None where it has no maximum."""

    def __init__(self, step: MStep, block: ClosedForm, arguments: Sequence[Expr]):
        self.family, self.where = block.family, _positions(step, block.components)
        self.statistics = python_function(block.statistics, arguments)
        self.bounds = python_function([e for pair in block.bounds for e in pair], arguments)

    def __call__(self, s: Sequence[float], theta: np.ndarray) -> np.ndarray | None:
        v = [*s, *theta.tolist()]
        try:
            c = [*self.statistics(v), 0.0]
            bounds = self.bounds(v)
        except DOMAIN:
            return None
        limits = list(zip(bounds[::2], bounds[1::2], strict=True))
        if not np.all(np.isfinite(c)):
            return None
        return self.family.mode(c, limits, theta[self.where])


def _positions(step: MStep, components: Sequence[Expr]) -> np.ndarray:
    """Positions of components in theta."""
    place = {s: i for i, s in enumerate(step.trace.parameter_symbols)}
    return np.array([place[c] for c in components])
