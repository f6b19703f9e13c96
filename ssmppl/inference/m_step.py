"""What the methods of the EM family share: the derived M-step of a question, the statistics of
trajectories, and the estimate from the iterates of several chains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType

import numpy as np

from ssmppl.analysis.expectation import unsuited
from ssmppl.analysis.mstep import MStep, counted, derive_m_step
from ssmppl.analysis.sufficient import complete_data
from ssmppl.codegen.statistics import compile_statistics
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.ascent import Setup
from ssmppl.inference.problem import Problem

__all__ = ["Maximiser", "Pooled", "maximiser", "pool"]

DRIFT = 5.0  # standard errors that the halves of the iterates may differ by


@dataclass(frozen=True)
class Maximiser:
    """A problem with its M-step; other processes derive it again.

    fixed : names of the parameters that are held. posterior : whether the prior counts.
    """

    problem: Problem
    fixed: tuple[str, ...]
    posterior: bool

    @cached_property
    def step(self) -> MStep | NotApplicable:
        """The M-step; the reason where the densities do not separate."""
        missing = self.problem.program.missing
        return derive_m_step(self.problem.trace, self.fixed, missing, self.posterior)

    @cached_property
    def module(self) -> ModuleType:
        assert isinstance(self.step, MStep)
        return compile_statistics(self.step)

    def statistics(
        self, theta: np.ndarray, paths: Sequence[np.ndarray], weights: Sequence[np.ndarray]
    ) -> np.ndarray:
        """The C_i averaged over weighted paths, (M, T, D) and (M,) of each experiment."""
        assert isinstance(self.step, MStep)
        total = np.array(self.step.prior(theta.tolist()), dtype=float)
        part = np.empty(len(total))
        run = self.module.weighted_statistics
        for e, some, w in zip(self.problem.experiments, paths, weights, strict=True):
            run(theta, e.y, e.seen, e.u, some, w, None, part, total)
        return total

    def __getstate__(self) -> dict:
        return {k: self.__dict__[k] for k in ("problem", "fixed", "posterior")}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)


def maximiser(setup: Setup) -> Maximiser:
    """The M-step of a question.

    Raises
    ------
    ArgumentError : the states determine a free parameter or cut it off, so that they cannot be the
        missing data; names parameter, line and what to use instead.
    """
    problem = setup.problem
    free = [s for s in problem.trace.parameter_symbols if s.data[1] not in setup.held]
    data = counted(complete_data(problem.trace, problem.program.missing), setup.with_prior)
    reason = unsuited(data, free)
    if reason is not None:
        raise ArgumentError(
            f"EM does not apply: {reason.reason}",
            fix="use ssm.DirectOptimization() or ssm.ScoreAscent(), or hold the parameter by "
            "fixed={...}",
            where=reason.where,
        )
    return Maximiser(problem, tuple(setup.held), setup.with_prior)


@dataclass(frozen=True)
class Pooled:
    """An estimate from the iterates of R chains.

    theta : (P,). error : (P, P) its Monte Carlo covariance, from how the chains differ; None for
    one chain. drift : the largest difference between the later and the earlier half of the
    iterates, in its standard errors; nan for one chain.
    """

    theta: np.ndarray
    error: np.ndarray | None
    drift: float


def pool(setup: Setup, iterates: np.ndarray) -> Pooled:
    """The mean on the unconstrained scale of iterates (R, K, P), over K and over R."""
    z = np.array([[setup.space_at(theta) for theta in chain] for chain in iterates])
    chains = len(z)
    means = z.mean(axis=1)
    point = setup.chart.at(means.mean(axis=0))
    if chains == 1:
        return Pooled(point.theta, None, np.nan)
    spread = np.atleast_2d(np.cov(means.T)) / chains
    half = z.shape[1] // 2
    change = z[:, -half:].mean(axis=1) - z[:, :half].mean(axis=1) if half else 0.0 * means
    error = change.std(axis=0, ddof=1) / np.sqrt(chains)
    with np.errstate(invalid="ignore", divide="ignore"):
        drift = np.nanmax(np.abs(change.mean(axis=0)) / error, initial=0.0)
    return Pooled(point.theta, point.jacobian @ spread @ point.jacobian.T, float(drift))
