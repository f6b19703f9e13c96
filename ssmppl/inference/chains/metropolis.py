"""Metropolis-Hastings with an exact likelihood.

Schön et al. (2015), algorithm 1 and section 3.2: the Kalman filter (where the states take few
values, the forward algorithm; where they have no noise, one run of them) gives the likelihood; the
states follow given each kept draw by backward sampling.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.chains.metropolis_kernel import (
    WALK_STATES,
    ChainPoint,
    LikelihoodRun,
    coordinates,
)
from ssmppl.inference.chains.pmmh import (
    LocalProposal,
    given_factor,
    settings_of,
    walk,
)
from ssmppl.inference.chains.sampling import PreparedChains, SamplingMethod, SamplingSetup
from ssmppl.inference.methods.methods import MetropolisHastings
from ssmppl.inference.particles.deterministic import Deterministic
from ssmppl.inference.preparation.exact_models import (
    ExactModel,
    exact_model,
    filter_of,
    likelihood_by,
    log_increments,
)
from ssmppl.inference.preparation.exact_score import exact_score
from ssmppl.inference.preparation.pilot import Pilot, find_mode
from ssmppl.inference.preparation.space import free_components
from ssmppl.inference.preparation.vanishing import check_mode
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.updates.independence import Standing, independent_chains

LEAST_SHARE = 0.05  # effective draws of independent proposals, below which chains walk


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
    if method == "Gibbs" and isinstance(model, Extended):
        raise ArgumentError(
            "Gibbs draws the states from their exact distribution, and this model calls a "
            "simulator",
            fix="use ssm.MetropolisHastings(), on the extended Kalman filter's likelihood, or "
            'ssm.PMMH(proposal="bootstrap"), or None, which picks the former',
        )
    if method == "Gibbs" and isinstance(model, Deterministic):
        site = next(iter(problem.trace.transition.values()))
        raise ArgumentError(
            "Gibbs draws the parameters given the states, which have no noise in this model, so "
            "that they determine the parameters",
            fix="use ssm.MetropolisHastings(), whose likelihood is exact, or None, which picks it",
            where=site.distribution.location,
        )
    return model


@dataclass(frozen=True)
class ExactLikelihood:
    """The exact filter's likelihood; states, if they are wanted, by backward sampling.

    scored : (P,) the parameters in which each run tells the gradient too; None: in none.
    by_row : whether the log-likelihood of each row is kept too.
    """

    problem: Problem
    states: bool
    scored: np.ndarray | None = None
    by_row: bool = False

    def run(
        self, theta: np.ndarray, before: LikelihoodRun | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        model = needed_model(self.problem, "MetropolisHastings")
        if self.scored is None:
            value, slope = model.log_likelihood(self.problem.experiments, theta), None
        else:
            value, slope = model.score(self.problem.experiments, theta, self.scored)
        return LikelihoodRun(value, score=slope) if np.isfinite(value) else None

    def kept(self, point: ChainPoint, stream: np.ndarray) -> dict[str, np.ndarray]:
        model = needed_model(self.problem, "MetropolisHastings")
        experiments = self.problem.experiments
        out: dict[str, np.ndarray] = {}
        if self.by_row:
            rows = log_increments(model, experiments, point.theta)
            out |= {f"increment_{i}": r for i, r in enumerate(rows)}
        if self.states:
            drawn = model.draw_each(experiments, point.theta, [stream] * len(experiments))
            out |= {f"path_{i}": d[0] for i, d in enumerate(drawn)}
        return out


def prepare(setup: SamplingSetup, method: MetropolisHastings) -> PreparedChains:
    """Find the mode and the information there, and start the chains.

    Raises
    ------
    ArgumentError : the likelihood is not exact, or a setting does not apply.
    """
    problem, space = setup.problem, setup.space
    exact = needed_model(problem, "MetropolisHastings")
    asked = method.covariance is not None or method.transform is not None
    plain = not asked and replace(method, log_likelihood=False) == MetropolisHastings()
    if isinstance(exact, Extended) and plain and len(space.positions):
        chains = _independent(setup, exact, method)
        if chains is not None:
            return chains
    kind = filter_of(exact)
    where = coordinates(space, method.scale, method.transform)
    if method.covariance is not None:
        given_factor(method.covariance, len(where))  # refused now, not after the pilot
    pilot = setup.once("pilot", lambda: find_mode(space, setup.root, kind))
    check_mode(exact, problem.experiments, space.parameters(pilot.z)[0])
    d, free, order = len(where), free_components(problem.trace, setup.fixed), method.order
    if order is None:
        cheap = isinstance(exact, Deterministic) and d > 2
        order = int(cheap and not _without_gradient(exact, setup, free))
    elif order and (reason := _without_gradient(exact, setup, free)):
        raise ArgumentError(
            f"order=1 does not apply: {reason}", fix="use ssm.MetropolisHastings(order=0)"
        )
    usual = 0.574 if order else 0.44 if d <= 1 else 0.35 if d == 2 else 0.234
    likelihood = ExactLikelihood(
        problem, setup.states, free if order else None, method.log_likelihood
    )
    made = walk(setup, method, likelihood, where, pilot, kind, order, usual)
    chains = made.prepared()
    report = {
        "settings": settings_of(replace(method, order=order)),
        "likelihood": likelihood_by(exact),
        **({"approximate": 1} if isinstance(exact, Extended) else {}),
        **chains.report,
    }
    return replace(chains, report=report)


def _independent(
    setup: SamplingSetup, model: Extended, method: MetropolisHastings
) -> PreparedChains | None:
    """Chains with proposals that do not depend on where they stand; None where no proposal is
    close enough to the posterior, so that a walk is better."""
    rng = np.random.default_rng(np.random.SeedSequence(setup.root.entropy, spawn_key=(19,)))
    kernel, states, report = independent_chains(
        setup.space, model, lambda i: setup.streams(i)[0], setup.chains, rng, setup.warmup,
        setup.thin, setup.states, method.log_likelihood,
    )  # fmt: skip
    if report["proposal_ess_share"] < LEAST_SHARE:
        return None
    report |= {
        "settings": settings_of(method),
        "likelihood": likelihood_by(model), "approximate": 1,
    }  # fmt: skip
    return PreparedChains(kernel.step_block, states, report)


def _without_gradient(exact: ExactModel, setup: SamplingSetup, free: np.ndarray) -> str:
    """Why the likelihood has no gradient in closed form; empty where it has."""
    return exact_score(exact, setup.problem.experiments, free, setup.space.theta).differences


METHOD = SamplingMethod(
    prepare,
    state_classes=(*WALK_STATES, LocalProposal, Pilot, Standing),
    by_row=lambda method: method.log_likelihood,
)
