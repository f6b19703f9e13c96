"""EM over a particle smoother: Monte Carlo expectations by backward simulation.

Wei and Tanner (1990); Schön, Wills and Ninness (2011), "System identification of nonlinear
state-space models"; Schön et al. (2015), section on EM for nonlinear models. Each iteration runs a
filter at theta_k, draws M trajectories from it backwards, and maximises the mean of log p(x, y |
theta) over them: through its statistics where it separates, else by BFGS with the complete-data
score. Deterministic states that depend on a parameter then follow from the noisy ones, which alone
are the missing data.

With M fixed the iterates end in a stationary law round the limit. The estimate is the mean of the
later ones, on the unconstrained scale, over independent chains from dispersed starts; its error is
told from how these differ. The smoother's bias of order 1 / N is not in that error.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.errors import NotApplicable
from ssmppl.inference.ascent import Ascent, Setup
from ssmppl.inference.backward import backward_draws, choose_kernel
from ssmppl.inference.complete_score import complete_scores
from ssmppl.inference.filtering import FilterSettings, check_count, random_state
from ssmppl.inference.m_step import Maximiser, maximiser, run_to_estimate, starts
from ssmppl.inference.methods import ParticleEM
from ssmppl.inference.proposal_choice import choose
from ssmppl.inference.runner import Block


def climb(setup: Setup, method: ParticleEM) -> Ascent:
    """Maximise; see the module.

    Raises
    ------
    ArgumentError : a parameter cuts off the support of a law, so that given the states it cannot
        move; names the line.
    SamplingError : the filter dies out.
    """
    for name, least in (("particles", 2), ("trajectories", 1), ("burn_in", 0), ("chains", 1)):
        check_count(name, getattr(method, name), least)
    check_count("iterations", method.iterations, method.burn_in + 1)
    maximum, problem = maximiser(setup, "ParticleEM"), setup.problem
    theta = setup.space.parameters(setup.start)[0]
    proposal = method.proposal
    if proposal == "auto":
        proposal = choose(problem, theta, kalman=False).name
    problem.proposal(proposal)
    settings = FilterSettings(int(method.particles), proposal)
    kernel, why = choose_kernel(problem, settings, method.trajectories, method.kernel)
    if isinstance(maximum.step, NotApplicable):
        m_step = f"BFGS on the mean over trajectories: {maximum.step.reason}"
        complete_scores(problem, maximum.fixed)  # refuses what has none before anything runs
    else:
        m_step = str(maximum.step)
    states = [
        State(start, random_state(setup.seed(3, chain)))
        for chain, start in enumerate(starts(setup, method.chains))
    ]
    task = partial(em_block, maximum, settings, int(method.trajectories), kernel)
    found = run_to_estimate(
        setup, task, states, method.iterations, method.burn_in, "ParticleEM"
    )  # fmt: skip
    report = {
        **found.report,
        "particles": settings.particles,
        "proposal": settings.proposal,
        "kernel": f"{kernel}: {why}",
        "m_step": m_step,
        "bias": f"of order 1 / {settings.particles}, not in the Monte Carlo errors",
    }
    pooled = found.pooled
    return Ascent(
        pooled.theta, None, found.iterates, report, error=pooled.error,
        interrupted=found.interrupted,
    )  # fmt: skip


@dataclass(frozen=True)
class State:
    """Where a chain stands: theta (P,) and the kernels' random state."""

    theta: np.ndarray
    stream: np.ndarray


def em_block(
    maximum: Maximiser, settings: FilterSettings, trajectories: int, kernel: str, state: State,
    n: int,
) -> tuple[State, Block]:  # fmt: skip
    """n iterations of one chain."""
    stream, theta = state.stream.copy(), state.theta
    thetas, log_z = [], []
    for _ in range(n):
        paths, estimate = backward_draws(
            maximum.problem, theta, settings, trajectories, stream, kernel
        )
        theta = maximum.from_paths(theta, paths)
        thetas.append(theta)
        log_z.append(estimate)
    block = Block({"theta": np.array(thetas)}, {"log_likelihood": np.array(log_z)})
    return State(theta, stream), block
