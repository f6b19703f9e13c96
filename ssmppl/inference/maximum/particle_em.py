"""EM over a particle smoother: Monte Carlo expectations by backward simulation.

Wei and Tanner (1990); Schön, Wills and Ninness (2011), "System identification of nonlinear
state-space models"; Schön et al. (2015), section on EM for nonlinear models. Each iteration runs R
filters at theta_k, draws M trajectories from them backwards, and maximises the mean of log p(x, y |
theta) over them: through its statistics where it separates, else by Newton's method
(`m_step.py`). Deterministic states that depend on a parameter then follow from the noisy ones,
which alone are the missing data.

EM magnifies what is wrong with its expectations as much as it is slow, so that the smoother's bias
of order 1 / N matters. It is that of a ratio: the mean of Z S over independent runs, with Z the
filter's estimate of the likelihood, is unbiased for p(y) E[S | y] (Del Moral 2004). So the runs are
weighed by their Z, and the ratio's own bias is taken off by the jackknife (Quenouille 1956):
weights R / (R - 1) Z_r / sum Z - 1 / (R (R - 1)).

With M fixed the iterates end in a stationary distribution round the limit, which they near by the
slow factors of EM. The estimate is the fixed point of the regression of the later iterates on those
before them, on the unconstrained scale, over independent chains from dispersed starts: no more
than their mean where they have come to rest, and where they have not, corrected for what is left
of the way. Its error is estimated by the jackknife over chains.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.maximum.ascent import Ascent, Maximization
from ssmppl.inference.maximum.m_step import Maximiser, maximiser, run_to_estimate, starts
from ssmppl.inference.methods.methods import ParticleEM
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.particles.backward import choose_kernel, draw_paths, particle_system
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.particles.scores import complete_scores
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.run.draws import Block
from ssmppl.inference.run.seeds import random_state


def climb(setup: Maximization, method: ParticleEM) -> Ascent:
    """The maximum of the likelihood, or of the posterior density, by particle EM.

    setup : model, data, start and objective. method : its settings. The `Ascent` has the end, the
    iterates and the report.

    Raises
    ------
    ArgumentError : a parameter cuts off the support of a distribution, so that given the states it
        cannot move; names the line.
    SamplingError : the filter dies out.
    """
    need_density(setup.problem.trace, "ParticleEM", "maximize")
    maximum, problem = maximiser(setup, "ParticleEM"), setup.problem
    theta = setup.space.parameters(setup.start)[0]
    proposal = method.proposal
    if proposal == "auto":
        proposal = choose_by_pilot(problem, theta, exact=False, temper=True).name
    problem.proposal(proposal)
    settings = FilterSettings(int(method.particles), proposal)
    each = -(-method.trajectories // method.runs)
    passes = int(method.chains * method.iterations * method.runs)
    kernel, why = choose_kernel(problem, settings, each, method.kernel, passes)
    if kernel == "genealogy":
        raise ArgumentError(
            'kernel="genealogy" gives paths that meet in one', fix='use "exact", or "auto"'
        )
    if isinstance(maximum.step, NotApplicable):
        scores = complete_scores(problem, maximum.fixed)  # refuses what has none, before any run
        how = "Newton's method" if scores.twice else "BFGS"
        m_step = f"{how} on the mean over trajectories: {maximum.step.reason}"
    else:
        m_step = str(maximum.step)
    states = [
        ParticleEMState(start, random_state(setup.seed(3, chain)))
        for chain, start in enumerate(starts(setup, method.chains))
    ]
    task = partial(em_block, maximum, settings, int(method.runs), each, kernel)
    found = run_to_estimate(
        setup, task, states, method.iterations, method.burn_in, "ParticleEM", by_regression=True
    )
    report = {
        **found.report,
        "particles": settings.particles,
        "proposal": settings.proposal,
        "kernel": f"{kernel}: {why}",
        "m_step": m_step,
        "runs": int(method.runs),
    }
    pooled = found.pooled
    return Ascent(
        pooled.theta, None, found.iterates, report, error=pooled.error,
        interrupted=found.interrupted,
    )  # fmt: skip


@dataclass(frozen=True)
class ParticleEMState:
    """Where a chain stands: theta (P,) and the kernels' random state."""

    theta: np.ndarray
    stream: np.ndarray


def em_block(
    maximum: Maximiser, settings: FilterSettings, runs: int, each: int, kernel: str,
    state: ParticleEMState, n: int,
) -> tuple[ParticleEMState, Block]:  # fmt: skip
    """n iterations of one chain."""
    stream, theta = state.stream.copy(), state.theta
    thetas, spreads = [], []
    for _ in range(n):
        paths, log_z = smoothed(maximum, theta, settings, runs, each, kernel, stream)
        theta = maximum.from_paths(theta, paths, log_z)
        thetas.append(theta)
        spreads.append(log_z.sum(axis=0).std())
    block = Block({"theta": np.array(thetas)}, {"log_z_sd": np.array(spreads)})
    return ParticleEMState(theta, stream), block


def smoothed(
    maximum: Maximiser, theta: np.ndarray, settings: FilterSettings, runs: int, each: int,
    kernel: str, stream: np.ndarray,
) -> tuple[list[np.ndarray], np.ndarray]:  # fmt: skip
    """Trajectories (R M, T, D) of each experiment, run by run, and log Z (experiments, R)."""
    problem, paths = maximum.problem, []
    log_z = np.empty((len(problem.experiments), runs))
    for i, e in enumerate(problem.experiments):
        drawn = []
        for r in range(runs):
            system = particle_system(problem, theta, settings, e, stream)
            drawn.append(draw_paths(problem, theta, e, system, each, stream, kernel))
            log_z[i, r] = system.log_Z
        paths.append(np.concatenate(drawn))
    return paths, log_z
