"""Particle stochastic approximation EM: one short sweep of conditional SMC in each iteration.

Lindsten (2013), "An efficient stochastic approximation EM algorithm using conditional particle
filters"; Schön et al. (2015), algorithm of maximum likelihood with PGAS. In iteration k the PGAS
kernel moves the reference path at theta_{k-1}; the statistics of all its N ancestral paths,
averaged by their final weights, enter

    S_k = (1 - gamma_k) S_{k-1} + gamma_k sum_i w_T^i C(x_{1:T}^i),
    theta_k = argmax S_k . s(theta).

gamma_k is 1 for the first k_0 iterations, which forget where they began, then (k / k_0)^-exponent
(Delyon, Lavielle and Moulines 1999 ask for a divergent sum and a convergent sum of squares). It
converges for every N >= 2. The estimate is the mean of the later iterates on the unconstrained
scale (Polyak and Juditsky 1992) over independent chains from dispersed starts; its error is
estimated from how they differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains.pgas import (
    SweepSetup,
    csmc_settings,
    start_chain,
)
from ssmppl.inference.maximum.ascent import Ascent, Maximization
from ssmppl.inference.maximum.m_step import Maximiser, maximiser, run_to_estimate, starts
from ssmppl.inference.methods.methods import PSAEM
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.particles.backward import sweep_failure
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.run.draws import Block
from ssmppl.inference.run.seeds import random_state


def climb(setup: Maximization, method: PSAEM) -> Ascent:
    """The maximum of the likelihood, or of the posterior density, by stochastic approximation EM.

    setup : model, data, start and objective. method : its settings. The `Ascent` has the end, the
    iterates and the report.

    Raises
    ------
    ArgumentError : the densities do not separate in the parameters, or the states cannot be the
        missing data; names the line.
    """
    need_density(setup.problem.trace, "PSAEM", "maximize")
    maximum = _by_statistics(setup)
    settings = csmc_settings(setup.problem, method.particles, method.proposal)
    states = []
    for chain, theta in enumerate(starts(setup, method.chains)):
        seed = setup.seed(2, chain)
        begun = start_chain(
            SweepSetup(setup.problem, (), settings), theta, np.random.default_rng(seed),
            random_state(seed),
        )  # fmt: skip
        states.append(PSAEMState(theta, begun.paths, begun.stream, np.empty(0), 0))
    found = run_to_estimate(
        setup, partial(saem_block, maximum, settings, method), states, method.iterations,
        averaged_from(method), "PSAEM",
    )  # fmt: skip
    report = {
        **found.report,
        "particles": settings.particles,
        "proposal": settings.proposal,
        "m_step": str(maximum.step),
        "update_rate": float(found.stats["update_rate"].mean()),
    }
    pooled = found.pooled
    return Ascent(
        pooled.theta, None, found.iterates, report, error=pooled.error,
        interrupted=found.interrupted,
    )  # fmt: skip


def _by_statistics(setup: Maximization) -> Maximiser:
    maximum = maximiser(setup, "PSAEM")
    if isinstance(maximum.step, NotApplicable):
        raise ArgumentError(
            f"PSAEM needs statistics, and the density does not separate: {maximum.step.reason}",
            fix="use ssm.ParticleEM() or ssm.ScoreAscent()",
            where=maximum.step.where,
        )
    return maximum


def step_size(k: int, method: PSAEM) -> float:
    """gamma_k, k from 1."""
    return 1.0 if k <= method.burn_in else (k / method.burn_in) ** -method.exponent


def averaged_from(method: PSAEM) -> int:
    """The number of iterates that are left out of the mean."""
    return method.burn_in + (method.iterations - method.burn_in) // 4


@dataclass(frozen=True)
class PSAEMState:
    """Where a chain stands: theta (P,), a path (T, D) per experiment, the kernels' random state,
    the statistics S, and the number of iterations made."""

    theta: np.ndarray
    paths: tuple[np.ndarray, ...]
    stream: np.ndarray
    statistics: np.ndarray
    done: int


def saem_block(
    maximum: Maximiser, settings: FilterSettings, method: PSAEM, state: PSAEMState, n: int
) -> tuple[PSAEMState, Block]:
    """n iterations of one chain."""
    stream, theta, paths, total = state.stream.copy(), state.theta, state.paths, state.statistics
    thetas, rates = [], []
    for k in range(state.done + 1, state.done + n + 1):
        fresh, paths, rate = averaged_sweep(maximum, settings, theta, paths, stream)
        gamma = step_size(k, method)
        total = fresh if gamma == 1.0 else (1.0 - gamma) * total + gamma * fresh
        theta = maximum.q.maximise(total, theta)
        thetas.append(theta)
        rates.append(rate)
    block = Block({"theta": np.array(thetas)}, {"update_rate": np.array(rates)})
    return PSAEMState(theta, paths, stream, total, state.done + n), block


def averaged_sweep(
    maximum: Maximiser, settings: FilterSettings, theta: np.ndarray,
    paths: Sequence[np.ndarray], stream: np.ndarray,
) -> tuple[np.ndarray, tuple[np.ndarray, ...], float]:  # fmt: skip
    """One sweep at theta: (statistics averaged over all N paths, new paths, share renewed)."""
    problem, n = maximum.problem, settings.particles
    run = problem.program.entry(f"conditional_smc_{settings.proposal}")
    every, weights, new, rate = [], [], [], 0.0
    for e, path in zip(problem.experiments, paths, strict=True):
        drawn, figures = np.empty_like(path), np.empty(2)
        all_paths, w = np.empty((n, *path.shape)), np.empty(n)
        status, t = run(
            theta, e.y, e.seen, e.u, n, stream, path, drawn, figures, all_paths, w
        )  # fmt: skip
        if status != OK:
            raise sweep_failure(problem, theta, status, t, e)
        every.append(all_paths)
        weights.append(w)
        new.append(drawn)
        rate += figures[0] / len(paths)
    return maximum.statistics(theta, every, weights), tuple(new), rate
