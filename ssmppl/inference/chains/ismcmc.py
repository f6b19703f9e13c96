"""Importance sampling correction of approximate MCMC (Vihola, Helske and Franks 2020, "Importance
sampling type estimators based on approximate marginal Markov chain Monte Carlo", *Scandinavian
Journal of Statistics* 47; their R package bssm).

Phase 1 (their algorithm 1): a Markov chain on the approximate posterior, prior times an
approximation L_a of the likelihood, which costs no particles. Its jump chain is kept: the distinct
draws theta_k, thinned, with their holding times h_k. Phase 2 (their algorithm 2): at each of them a
twisted particle filter gives an unbiased Z_k and a trajectory, and the draw the weight
h_k Z_k / L_a(theta_k). Weighted averages converge to those of the exact posterior, of parameters
and trajectories together, whatever the number of particles.

The draws of phase 2 know nothing of each other. They go to an executor in lanes, every lane the
draws i, i + `LANES`, i + 2 `LANES`, ... of a chain, and each has random numbers of its own place,
so that the result is the same whatever ran where. After an interrupt the first draws of each chain
are there.

The posterior that is returned has as many draws as were corrected, resampled systematically by
their weights in the order of the chain. Copies of a draw stand side by side, so that estimates of
the effective sample size from autocorrelations count them for what they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError, NotApplicable, SamplingError, warn
from ssmppl.inference.chains.metropolis_kernel import (
    WALK_STATES,
    ChainPoint,
    LikelihoodRun,
    coordinates,
    jump_block,
    no_run,
)
from ssmppl.inference.chains.pmmh import NAMED, USUAL_EXACT, ParticleLikelihood, walk
from ssmppl.inference.chains.sampling import Drawn, SamplingMethod, SamplingSetup
from ssmppl.inference.gaussian.likelihood import ApproximateLikelihood
from ssmppl.inference.methods.methods import ISMCMC, MetropolisHastings
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.preparation.gaussian_pilot import (
    NUMBERS,
    PRECISE,
    GaussianPilot,
    approximation_kind,
    gaussian_pilot,
    tune_twisted,
)
from ssmppl.inference.preparation.pilot import Pilot, TunedParticles
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import Block, ChainDraws
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.progress import announced
from ssmppl.inference.run.seeds import random_state

EXACT, APPROXIMATE = "log_marginal_likelihood", "approximate_log_marginal_likelihood"
LANES = 16  # of a chain, which may be corrected side by side
# Steps between the draws that are kept: where most steps are independence proposals that are
# accepted two make them nearly independent; of a walk it takes more, which cost less than filters.
FEW_STEPS, MANY_STEPS = 2, 6
POOR = 0.2  # share of the draws that the weights are worth, below which there is a warning


@dataclass(frozen=True)
class ApproximateRuns:
    """The approximation in the place of a likelihood."""

    approximation: ApproximateLikelihood

    def run(
        self, theta: np.ndarray, before: LikelihoodRun | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        value = self.approximation.at(theta).log_likelihood
        return LikelihoodRun(value) if value > -np.inf else None

    def kept(self, point: ChainPoint, stream: np.ndarray) -> dict[str, np.ndarray]:
        return {}


@dataclass(frozen=True)
class JumpChains:
    """Phase 1, of C chains of M distinct draws: theta (C, M, P), holding (C, M) in thinned steps,
    lp (C, M) of the approximate posterior, rate of acceptance."""

    theta: np.ndarray
    holding: np.ndarray
    lp: np.ndarray
    acceptance: float


@dataclass(frozen=True)
class Correction:
    """Phase 2. theta (C, M, P) : the draws. root : of the random numbers of all of them."""

    likelihood: ParticleLikelihood
    approximation: ApproximateLikelihood
    theta: np.ndarray
    root: np.random.SeedSequence

    def corrected(self, chain: int, i: int) -> tuple[dict[str, np.ndarray], float, float]:
        """What is kept of a draw's filter; log Z, and the approximation's."""
        theta, stream = self.theta[chain, i], random_state(self.root, 11, chain, i)
        found = self.approximation.at(theta)
        run = self.likelihood.run_given(theta, found, stream) or no_run(self.likelihood.problem)
        point = ChainPoint(np.empty(0), theta, 0.0, run)
        return self.likelihood.kept(point, stream), run.log_likelihood, found.log_likelihood


@dataclass(frozen=True)
class Lane:
    """Where a lane stands: its chain, its number, the draws that it has corrected."""

    chain: int
    number: int
    done: int = 0


def correct_block(correction: Correction, lane: Lane, n: int) -> tuple[Lane, Block]:
    """The next n draws of a lane."""
    draws: dict[str, list[np.ndarray]] = {}
    stats: dict[str, list[float]] = {EXACT: [], APPROXIMATE: []}
    for j in range(lane.done, lane.done + n):
        kept, *values = correction.corrected(lane.chain, j * LANES + lane.number)
        for name, value in kept.items():
            draws.setdefault(name, []).append(value)
        for name, number in zip(stats, values, strict=True):
            stats[name].append(number)
    return replace(lane, done=lane.done + n), Block.of(draws, stats)


def drawn(
    setup: SamplingSetup, method: ISMCMC, draws: int, executor: Executor | None, progress: bool
) -> Drawn:
    """The resampled chains, and what to report.

    Raises
    ------
    ArgumentError : the model has no such approximation.
    SamplingError : no draw of a chain has a positive weight.
    KeyboardInterrupt : by Ctrl-C before every chain had a corrected draw.
    """
    problem = setup.problem
    with announced("ISMCMC", "preparing", shown=progress):
        gaussian = setup.once("gaussian", lambda: _approximation(setup, method))
        mode, _ = setup.space.parameters(gaussian.z)
        tuned = None
        if method.particles is None:
            tuned = setup.once("twisted", lambda: tune_twisted(problem, mode, PRECISE))
    particles = method.particles or (NUMBERS[-1] if tuned is None else tuned.particles)
    approximation = _likelihood(problem, method, gaussian)
    each = -(-draws // LANES)
    chains = setup.once(
        f"approximate chains of {each * LANES}",
        lambda: _jump_chains(setup, method, gaussian, each * LANES, executor, progress),
    )
    settings = FilterSettings(int(particles), "twisted")
    likelihood = ParticleLikelihood(problem, settings, setup.states)
    correction = Correction(likelihood, approximation, chains.theta, setup.root)
    lanes: Sequence[ChainDraws[Lane]] = run_chains(
        partial(correct_block, correction),
        [Lane(c, k) for c in range(setup.chains) for k in range(LANES)], each, executor=executor,
        progress=progress, title="ISMCMC, correction", checkpoint=setup.checkpoint,
    )  # fmt: skip
    own = [lanes[c * LANES : (c + 1) * LANES] for c in range(setup.chains)]
    weighted = [_weighted(chains, c, joined_lanes(of, draws)) for c, of in enumerate(own)]
    report = {
        "particles": int(particles), "approximation": NAMED[approximation.kind],
        "settings": asdict(method), "pilot_mode": setup.by_name(mode),
        "acceptance_of_approximate_chains": chains.acceptance,
        **_quality(weighted, interrupted=lanes[0].interrupted),
    }  # fmt: skip
    if tuned is not None:
        report["pilot_sd_of_log_likelihood"] = tuned.sd
    resampled = [w.resampled(setup, c) for c, w in enumerate(weighted)]
    return [replace(r, interrupted=lanes[0].interrupted, lost=lanes[0].lost) for r in resampled], (
        report
    )


def _approximation(setup: SamplingSetup, method: ISMCMC) -> GaussianPilot:
    kind = approximation_kind(setup.problem, method.approximation)
    if isinstance(kind, NotApplicable):
        raise ArgumentError(
            f"ISMCMC(approximation={method.approximation!r}) needs a Gaussian approximation of the "
            f"states: {kind.reason}",
            fix="use ssm.PGAS(...) or ssm.PMMH(...), or None, which picks by structure",
            where=kind.where,
        )
    found = gaussian_pilot(setup.space, kind)
    if found is None:
        raise ArgumentError(
            f"{NAMED[kind]} is not finite near the start, or its posterior has no mode",
            fix="give start={name: value} near plausible values, or use ssm.PGAS(...)",
        )
    return found


def _likelihood(problem: Problem, method: ISMCMC, gaussian: GaussianPilot) -> ApproximateLikelihood:
    return gaussian.likelihood(problem, gaussian.kind if method.approximation != "auto" else "")


def _jump_chains(
    setup: SamplingSetup, method: ISMCMC, gaussian: GaussianPilot, length: int,
    executor: Executor | None, progress: bool,
) -> JumpChains:  # fmt: skip
    """The jump chains of phase 1."""
    where = coordinates(setup.space, "unconstrained", None)
    runs = ApproximateRuns(_likelihood(setup.problem, method, gaussian))
    like = MetropolisHastings(target_acceptance=method.target_acceptance)
    usual = USUAL_EXACT.get(len(where), 0.234)
    made = walk(setup, like, runs, where, gaussian.pilot, "bootstrap", 0, usual, gaussian=gaussian)
    steps = method.steps or (FEW_STEPS if gaussian.well_proposed else MANY_STEPS)
    kernel = replace(made.kernel, thin=steps * setup.thin)
    found: Sequence[ChainDraws[Any]] = run_chains(
        partial(jump_block, kernel), made.states, length, setup.warmup, executor=executor,
        progress=progress, title="ISMCMC, approximate chain",
    )  # fmt: skip
    if any(c.interrupted for c in found):
        raise found[0].lost or KeyboardInterrupt("interrupted before any draw was corrected")
    return JumpChains(
        np.stack([c.draws["theta"] for c in found]),
        np.stack([c.stats["holding"] for c in found]),
        np.stack([c.stats["lp"] for c in found]),
        float(np.mean([c.stats["acceptance_rate"] for c in found])),
    )


def joined_lanes(
    lanes: Sequence[ChainDraws[Lane]], most: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics (n, ...) of a chain in its order, at most so many, from its lanes."""
    parts = [c.draws for c in lanes], [c.stats for c in lanes]
    out = []
    for own in parts:
        stacked = {name: np.stack([c[name] for c in own], axis=1) for name in own[0]}
        out.append({n: v.reshape(-1, *v.shape[2:])[:most] for n, v in stacked.items()})
    return out[0], out[1]


@dataclass(frozen=True)
class Weighted:
    """The corrected draws of one chain, n of them. correction (n,) : log Z less the approximation's
    log-likelihood. holding (n,) : times that the approximate chain stood there."""

    theta: np.ndarray
    holding: np.ndarray
    correction: np.ndarray
    draws: dict[str, np.ndarray]
    stats: dict[str, np.ndarray]

    @property
    def weights(self) -> np.ndarray:
        """(n,) with mean 1.

        Raises
        ------
        SamplingError : all are zero.
        """
        top = np.max(self.correction)
        if not top > -np.inf:
            raise SamplingError(
                "no particle filter at any draw of an approximate chain has a positive likelihood",
                fix="the approximation is off here: use ssm.PGAS(...) or ssm.PMMH(...)",
            )
        w = self.holding * np.exp(self.correction - top)
        return w / w.mean()

    def resampled(self, setup: SamplingSetup, chain: int) -> ChainDraws[Any]:
        """As many draws of equal weight, systematically, in the order of the chain."""
        w = self.weights
        n = len(w)
        seed = np.random.SeedSequence(
            setup.root.entropy, spawn_key=(*setup.root.spawn_key, 12, chain)
        )
        points = (np.random.default_rng(seed).uniform() + np.arange(n)) * (w.sum() / n)
        chosen = np.minimum(np.searchsorted(np.cumsum(w), points, side="right"), n - 1)
        own = {name: values[chosen] for name, values in self.draws.items()}
        stats = {name: values[chosen] for name, values in self.stats.items()}
        return ChainDraws(
            {"theta": self.theta[chosen], **own}, stats | {"weight": w[chosen]}, {}, None
        )


def _weighted(
    chains: JumpChains, c: int, found: tuple[dict[str, np.ndarray], dict[str, np.ndarray]]
) -> Weighted:
    draws, stats = found
    n = len(stats[EXACT])
    correction = stats[EXACT] - stats[APPROXIMATE]
    stats = {**stats, "lp": chains.lp[c, :n] + correction}
    return Weighted(chains.theta[c, :n], chains.holding[c, :n], correction, draws, stats)


def _quality(chains: Sequence[Weighted], interrupted: bool) -> dict[str, Any]:
    """How well the approximate posterior does for the exact one, and the warning, which is given.

    The effective sample size of the weights Z / L_a, each draw counted as often as it was held
    (Kong, Liu and Wong 1994), of each chain by itself, as each is resampled by itself.
    """
    ess, total, largest = 0.0, 0.0, 0.0
    for chain in chains:
        w, h = chain.weights / chain.holding, chain.holding
        ess += float((h @ w) ** 2 / (h @ w**2))
        total += float(h.sum())
        largest = max(largest, float(chain.weights.max() / chain.weights.sum()))
    share = ess / total
    found: dict[str, Any] = {
        "weights_ess": share * sum(len(c.holding) for c in chains),
        "weights_ess_share": share, "largest_weight_share": largest,
    }  # fmt: skip
    if share < POOR and not interrupted:
        text = (
            "the approximation is poor: the importance weights of the draws have relative ESS "
            f"{share:.1%}; largest normalised weight {largest:.0%}. The posterior that is "
            "returned rests on few distinct draws. Use ssm.PGAS(...) or "
            "ssm.PMMH(...), or more draws and particles"
        )
        warn(text)
        found["weights_warning"] = text
    return found


METHOD = SamplingMethod(
    None, drawn, state_classes=(*WALK_STATES, JumpChains, Lane, GaussianPilot, Pilot,
                                TunedParticles),
    by_row=lambda method: True, trajectories=True,
)  # fmt: skip
