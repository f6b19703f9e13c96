"""Metropolis-Hastings with an exact likelihood.

Schön et al. (2015), algorithm 1 and section 3.2: the Kalman filter (or, where the states
take few values, the forward algorithm) gives the likelihood; the states follow given each kept draw
by backward sampling.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains.coordinates import coordinates
from ssmppl.inference.chains.pmmh import adapts, settings_of, walk_factor
from ssmppl.inference.chains.sampling import Sampler, Setup
from ssmppl.inference.chains.walk import (
    Metropolis,
    Point,
    RandomWalk,
    Run,
    metropolis_block,
    start_chain,
)
from ssmppl.inference.exact.models import ExactModel, exact_model, filter_name, filter_of
from ssmppl.inference.methods import MetropolisHastings
from ssmppl.inference.particles.pilot import dispersed, find_mode
from ssmppl.inference.problem import Problem


def needed_model(problem: Problem, method: str) -> ExactModel:
    """The exact form of the problem's model, for a method that needs one.

    Raises
    ------
    ArgumentError : there is none; gives the reason and the line.
    """
    model = exact_model(problem.trace)
    if isinstance(model, NotApplicable):
        raise ArgumentError(
            f"{method} needs a linear Gaussian model, or one of finitely many states: "
            f"{model.reason}",
            fix="use ssm.PGAS(...) or ssm.PMMH(...), or None, which picks by structure",
            where=model.where,
        )
    return model


@dataclass(frozen=True)
class ExactLikelihood:
    """The exact filter's likelihood; states, if they are wanted, by backward sampling."""

    problem: Problem
    states: bool

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        model = needed_model(self.problem, "MetropolisHastings")
        value = model.log_likelihood(self.problem.experiments, theta)
        return Run(value) if value > -np.inf else None

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        if not self.states:
            return {}
        model = needed_model(self.problem, "MetropolisHastings")
        experiments = self.problem.experiments
        drawn = model.draw_each(experiments, point.theta, [stream] * len(experiments))
        return {f"path_{i}": d[0] for i, d in enumerate(drawn)}


def prepare(setup: Setup, method: MetropolisHastings) -> Sampler:
    """Find the mode and the information there, and start the chains."""
    problem, space = setup.problem, setup.space
    exact = needed_model(problem, "MetropolisHastings")
    kind = filter_of(exact)
    where = coordinates(space, method.scale, method.transform)
    pilot = setup.once("pilot", lambda: find_mode(space, setup.root, kind))
    factor = walk_factor(setup, method, where, pilot, kind)
    d = len(where)
    target = method.target_acceptance or (0.44 if d <= 1 else 0.35 if d == 2 else 0.234)
    kernel = Metropolis(
        where, ExactLikelihood(problem, setup.states), RandomWalk(), setup.warmup,
        setup.warmup if adapts(method) else 0, target, setup.thin,
    )  # fmt: skip
    starts = setup.once("starts", lambda: dispersed(space, pilot, setup.chains, setup.root, kind))
    states = []
    for chain, z in enumerate(starts):
        generator, stream = setup.streams(chain)
        states.append(start_chain(kernel, where.at(z), factor, generator, stream))
    report = {
        "settings": settings_of(method),
        "likelihood": f"exact, by {filter_name(exact)}",
        "pilot_mode": setup.by_name(space.parameters(pilot.z)[0]),
        "walk_covariance": (factor @ factor.T).tolist(),
    }
    return Sampler(partial(metropolis_block, kernel), states, report)
