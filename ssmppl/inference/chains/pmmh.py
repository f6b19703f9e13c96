"""Particle Metropolis-Hastings (Andrieu, Doucet and Holenstein 2010, section 2.4.2).

The random walk moves on the unconstrained scale or one of the user's choice, starts from the
inverse information at a mode that a pilot finds, and adapts during warmup by the robust adaptive
Metropolis algorithm (Vihola 2012, algorithm 1).

Steps along the gradient: Dahlin, Lindsten and Schön (2015), "Particle Metropolis-Hastings using
gradient and Hessian information", algorithm 2. PMH1 proposes w' ~ N(w + eps^2 M S / 2, eps^2 M)
with the score S of the log posterior and a fixed M, PMH2 with M the inverse of the observed
information at w. Both are estimates from the particles that gave the likelihood; they belong to the
chain's state, so that the ratio of the proposals' densities is that of the stored estimates, and
the chain is exact whatever their errors. An estimate of the information need not be positive
definite. In units of the pilot's covariance its negative eigenvalues are mirrored, as in section
3.4 there, and all are kept within bounds; the drift is truncated (Roberts and Tweedie 1996), so
that a wild estimate cannot throw the chain far.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ssmppl.codegen.kernels.math.random import uniform
from ssmppl.codegen.kernels.particle.conditional_smc import ancestral_path, draw_index
from ssmppl.codegen.kernels.particle.weights import NO_POINT, OK
from ssmppl.codegen.modules.filter_variants import (
    NumberedFilter,
    ScoredFilter,
    numbered_filter,
    scored_filter,
)
from ssmppl.codegen.modules.twisted import Guided
from ssmppl.compiling import once_property
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains.metropolis_kernel import (
    ADAPTATION_POWER,
    WALK_STATES,
    ChainPoint,
    Coordinates,
    Likelihood,
    LikelihoodRun,
    Metropolis,
    Proposal,
    RandomWalk,
    WalkAndIndependence,
    WalkState,
    coordinates,
    local_derivatives,
    metropolis_block,
    start_chain,
)
from ssmppl.inference.chains.sampling import PreparedChains, SamplingMethod, SamplingSetup
from ssmppl.inference.gaussian.likelihood import Approximated, ApproximateLikelihood
from ssmppl.inference.methods.methods import PMMH, MetropolisHastings
from ssmppl.inference.optimisation.quadratic import fitted_covariance
from ssmppl.inference.particles.filtering import FilterSettings, failure, run_filter
from ssmppl.inference.particles.marginal import draw_given, is_marginal
from ssmppl.inference.preparation.gaussian_pilot import (
    PRECISE,
    GaussianPilot,
    approximately,
    approximation_kind,
    gaussian_pilot,
    tune_twisted,
)
from ssmppl.inference.preparation.pilot import (
    SCALE_REPEATS,
    TUNING_REPEATS,
    Pilot,
    TunedParticles,
    averaged_density,
    dispersed,
    find_mode,
    particles_for,
    tune_particles,
)
from ssmppl.inference.preparation.proposal_choice import (
    PILOT_PARTICLES,
    Choice,
    choose_by_pilot,
)
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import fill_normal, random_state

# Of counted costs, in nanoseconds a row: the guide with Laplace's mode, and a particle that follows
# it; the spread of log Z that other filters are tuned to, and the fewest particles they take.
GUIDE, TWISTED_COST = 2500.0, 15.0
BEST_SD, FEWEST = 1.2, 10.0
LEAST_ACCEPTANCE = 0.05  # of independence proposals, below which their mode is not to be trusted
USUAL_EXACT = {1: 0.44, 2: 0.35}  # rates of acceptance by the first stage, which has no noise
# Share of independence proposals where many of them are accepted, each worth several steps of a
# walk, and where few are.
MOSTLY, SELDOM = 0.9, 0.2
APPROXIMATE_SHARE = 0.8  # of the warmup, by the first stage alone
NAMED = {
    "laplace": "Laplace's approximation of the likelihood",
    "extended": "the extended Kalman filter's approximation of the likelihood",
}
LEAST_EIGENVALUE, MOST_EIGENVALUE = 0.2, 5.0  # of the information, in units of the pilot's
LONGEST = 1.0  # of the drift, in standard deviations of the step
STRETCH = 2.562  # of a random walk's steps, over sqrt(d): Sherlock et al. (2015)

# (number of an experiment, experiment, path and increments to be written) -> status, the row at
# which the filter stopped, log Z.
Filter = Callable[[int, Experiment, np.ndarray, np.ndarray], tuple[int, int, float]]


def run_each(problem: Problem, theta: np.ndarray, width: int, run: Filter) -> LikelihoodRun | None:
    """One run of a filter over each experiment, its paths of `width` states; None where the
    likelihood is zero, or infinite."""
    total, paths, increments = 0.0, [], []
    for i, e in enumerate(problem.experiments):
        path, increment = np.empty((e.steps, width)), np.empty(e.steps)
        status, t, log_z = run(i, e, path, increment)
        if status in NO_POINT:
            return None
        if status != OK:
            raise failure(problem, theta, status, t, e)
        total += log_z
        paths.append(path)
        increments.append(increment)
    return LikelihoodRun(total, tuple(paths), tuple(increments))


class _KeepsPaths:
    """What is kept of a draw: the increments of the run and, if the states are wanted, its path."""

    states: bool

    def kept(self, point: ChainPoint, stream: np.ndarray) -> dict[str, np.ndarray]:
        named = {f"path_{i}": path for i, path in enumerate(point.run.paths if self.states else ())}
        return named | {f"increment_{i}": v for i, v in enumerate(point.run.increments)}

    def __getstate__(self) -> dict:
        """Without the compiled filter, which another process makes for itself."""
        return {name: value for name, value in self.__dict__.items() if name != "filter"}


@dataclass(frozen=True)
class ParticleLikelihood(_KeepsPaths):
    """An independent run of the particle filter for every point; with `rescue`, of the alive
    particle filter (Del Moral et al. 2015, section 4, on its use here). states : whether draws keep
    its paths."""

    problem: Problem
    settings: FilterSettings
    states: bool = True

    def run(
        self, theta: np.ndarray, before: LikelihoodRun | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        return self.run_given(theta, None, stream)

    def run_given(
        self, theta: np.ndarray, found: Approximated | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        """As `run`; the twisted filter takes its guide from where a first stage has been."""
        n, name = self.settings.particles, self.settings.proposal
        carried = len(self.problem.program.carried(name))
        modes = found.noise if found is not None and name == "twisted" else None

        def by_kernel(
            i: int, e: Experiment, path: np.ndarray, increment: np.ndarray
        ) -> tuple[int, int, float]:
            return entry(theta, e.y, e.seen, e.u, n, stream, path, increment)

        def alive(
            i: int, e: Experiment, path: np.ndarray, increment: np.ndarray
        ) -> tuple[int, int, float]:
            particles, weights = np.empty((e.steps, carried, n)), np.empty((e.steps, n))
            kept = particles, weights, np.zeros((e.steps, n), dtype=np.int32)
            status, t = run_filter(
                self.problem, theta, self.settings, e, stream, increment, np.empty(e.steps),
                kept=kept,
            )  # fmt: skip
            if status == OK:
                ancestral_path(particles, kept[2], draw_index(weights[-1], uniform(stream)), path)
            return status, t, total_of(increment) if status == OK else -np.inf

        if self.settings.rescue:
            return run_each(self.problem, theta, carried, alive)
        entry = self.problem.program.entry(f"filtered_path_{name}")
        if not isinstance(entry, Guided):
            return run_each(self.problem, theta, carried, by_kernel)
        kernel, every = entry.run, self.problem.end_to_end
        noise = None if modes is None else np.concatenate(modes)
        at_mode = found is not None and found.at_mode
        made = entry.gaussian.guides(theta, *every.data, e=noise, at_mode=at_mode)
        guides = every.split(made.rows)

        def guided(
            i: int, e: Experiment, path: np.ndarray, increment: np.ndarray
        ) -> tuple[int, int, float]:
            return kernel(theta, e.y, e.seen, guides[i], n, stream, path, increment)

        return run_each(self.problem, theta, carried, guided)


@dataclass(frozen=True)
class MarginalLikelihood(ParticleLikelihood):
    """A Rao-Blackwellised filter; what it integrates out is drawn for the kept draws."""

    def kept(self, point: ChainPoint, stream: np.ndarray) -> dict[str, np.ndarray]:
        found = super().kept(point, stream)
        for i, e in enumerate(self.problem.experiments):
            path = point.run.paths[i][None]
            # drawn even where it is left out, so that the chain is the same with and without
            drawn = draw_given(self.problem, e, point.theta, path, stream)[0]
            if self.states:
                found[f"path_{i}"] = drawn
        return found


@dataclass(frozen=True)
class ScoredLikelihood(_KeepsPaths):
    """A particle filter that estimates score and information too, zero for fixed parameters.

    wanted : positions in theta of the free parameters. second : whether the information is wanted.
    """

    problem: Problem
    settings: FilterSettings
    lag: int
    wanted: tuple[int, ...]
    second: bool
    states: bool = True

    @once_property
    def filter(self) -> ScoredFilter:
        program, name = self.problem.program, self.settings.proposal
        symbols = [self.problem.trace.parameter_symbols[i] for i in self.wanted]
        made = scored_filter(program, self.problem.proposal(name), symbols, self.second)
        if isinstance(made, NotApplicable):
            raise ArgumentError(
                f"order={2 if self.second else 1} does not apply: {made.reason}",
                fix="use ssm.PMMH(order=0)",
                where=made.where,
            )
        return made

    def run(
        self, theta: np.ndarray, before: LikelihoodRun | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        entry, p = self.filter.run, len(self.wanted)
        slope, curvature = np.zeros(p), np.zeros((p, p))

        def one(
            i: int, e: Experiment, path: np.ndarray, increment: np.ndarray
        ) -> tuple[int, int, float]:
            own_slope, own = np.empty(p), np.zeros((p, p))
            status, t, log_z = entry(
                theta, e.y, e.seen, e.u, self.settings.particles, stream, path, increment,
                self.lag, own_slope, own,
            )  # fmt: skip
            slope[:], curvature[:] = slope + own_slope, curvature + own
            return status, t, log_z

        found = run_each(self.problem, theta, len(self.problem.trace.state_symbols), one)
        if found is None:
            return None
        score, information = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        score[list(self.wanted)] = slope
        information[np.ix_(self.wanted, self.wanted)] = curvature
        return replace(found, score=score, information=information)


@dataclass(frozen=True)
class CorrelatedLikelihood(_KeepsPaths):
    """A particle filter on random numbers that move by v' = rho v + sqrt(1 - rho^2) e.

    The move leaves the normal distribution of the numbers invariant and is reversible, so that they
    may be part of the chain's state (Deligiannidis, Doucet and Pitt 2018, section 2.2).
    """

    problem: Problem
    settings: FilterSettings
    correlation: float
    states: bool = True

    @once_property
    def filter(self) -> NumberedFilter:
        program, name = self.problem.program, self.settings.proposal
        made = numbered_filter(program, self.problem.proposal(name))
        if isinstance(made, NotApplicable):
            raise ArgumentError(
                f"correlation={self.correlation} does not apply: {made.reason}",
                fix="use ssm.PMMH(correlation=0.0)",
                where=made.where,
            )
        return made

    def run(
        self, theta: np.ndarray, before: LikelihoodRun | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        old = None if before is None else before.numbers
        made, n, numbers = self.filter, self.settings.particles, []

        def one(
            i: int, e: Experiment, path: np.ndarray, increment: np.ndarray
        ) -> tuple[int, int, float]:
            fresh = [(e.steps, made.normals * n), (e.steps, made.uniforms * n), (e.steps + 1,)]
            own = [self._moved(shape, None if old is None else old[i][k], stream)
                   for k, shape in enumerate(fresh)]  # fmt: skip
            numbers.append(own)
            return made.module.correlated_path(theta, e.y, e.seen, e.u, n, *own, path, increment)

        found = run_each(self.problem, theta, len(self.problem.trace.state_symbols), one)
        return None if found is None else replace(found, numbers=numbers)

    def _moved(
        self, shape: tuple[int, ...], old: np.ndarray | None, stream: np.ndarray
    ) -> np.ndarray:
        new = np.empty(int(np.prod(shape)))
        if new.size:
            fill_normal(stream, new)
        if old is None:
            return new.reshape(shape)
        rho = self.correlation
        return rho * old + np.sqrt(1.0 - rho * rho) * new.reshape(shape)


@dataclass(frozen=True)
class LocalProposal:
    """What the proposal goes by at a point: M = R R'.

    root, inverse : R (d, d) and its inverse. log_det : log |R|. drift : (d,) R' S / 2.
    """

    root: np.ndarray
    inverse: np.ndarray
    log_det: float
    drift: np.ndarray


@dataclass(frozen=True)
class Langevin:
    """w' = w + eps R (eps R' S / 2 + e). `tuning` is log eps.

    factor : (d, d), Cholesky factor of the pilot's covariance, M of order 1. newton : order 2.
    """

    coordinates: Coordinates
    factor: np.ndarray
    newton: bool

    def local(self, w: np.ndarray, run: LikelihoodRun) -> LocalProposal:
        d, root = len(w), self.factor
        slope = np.zeros(d)
        if run.score is not None and d:
            sd = np.sqrt(np.sum(self.factor**2, axis=1))
            near = local_derivatives(self.coordinates, w, sd, self.newton)
            slope = near.jacobian.T @ run.score + near.slope
            if self.newton and run.information is not None:
                information = near.jacobian.T @ run.information @ near.jacobian - near.curvature
                information -= np.tensordot(run.score, near.second, axes=1)
                root = regular_root(information, self.factor)
        if not np.all(np.isfinite(slope)):
            slope = np.zeros(d)
        inverse = np.linalg.inv(root)
        log_det = float(np.linalg.slogdet(root)[1])
        return LocalProposal(root, inverse, log_det, 0.5 * root.T @ slope)

    def propose(
        self, point: ChainPoint, tuning: float, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        normals = generator.standard_normal(len(point.w))
        step = np.exp(tuning)
        move = point.local.root @ (_drift(point.local, step) + normals)
        return point.w + step * move, normals

    def log_ratio(
        self, old: ChainPoint, new: ChainPoint, tuning: float, normals: np.ndarray | None
    ) -> float:
        step = np.exp(tuning)
        return _log_density(new, old, step) - _log_density(old, new, step)

    def adapt(self, tuning: float, normals: np.ndarray, excess: float, iteration: int) -> float:
        """Robbins and Monro's steps on log eps."""
        return tuning + excess * float((iteration + 1.0) ** -ADAPTATION_POWER)


def regular_root(information: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """R with (R R')^-1 the information (d, d), its eigenvalues in units of the pilot's covariance
    factor factor' mirrored if negative and kept within bounds."""
    white = factor.T @ information @ factor
    white = 0.5 * (white + white.T)
    if not np.all(np.isfinite(white)):
        return factor
    values, vectors = np.linalg.eigh(white)
    return factor @ (vectors / np.sqrt(np.clip(np.abs(values), LEAST_EIGENVALUE, MOST_EIGENVALUE)))


def _drift(local: LocalProposal, step: float) -> np.ndarray:
    """eps R' S / 2, cut to its longest."""
    drift = step * local.drift
    length = float(np.linalg.norm(drift))
    return drift if length <= LONGEST else drift * (LONGEST / length)


def _log_density(origin: ChainPoint, end: ChainPoint, step: float) -> float:
    """log q(end | origin) up to a constant."""
    local = origin.local
    residual = local.inverse @ (end.w - origin.w) / step - _drift(local, step)
    return -local.log_det - 0.5 * float(residual @ residual)


def prepare(setup: SamplingSetup, method: PMMH) -> PreparedChains:
    """Find a mode, choose proposal and number of particles there, and start the chains.

    Raises
    ------
    ArgumentError : a setting does not apply to the model; gives the reason.
    """
    problem = setup.problem
    where = coordinates(setup.space, method.scale, method.transform)
    if method.covariance is not None:
        given_factor(method.covariance, len(where))  # refused now, not after the pilot
    plan = _planned(setup, method)
    settings, gaussian = plan.settings, plan.gaussian
    d, usual = len(where), 0.3 if method.correlation else 0.25
    if plan.plain and d > 1:
        usual = 0.2 if d == 2 else 0.15
    first = None
    if gaussian is not None and plan.delayed:
        first, usual = gaussian.likelihood(problem), USUAL_EXACT.get(d, 0.234)
    likelihood = _likelihood(setup, method, settings)
    chains = walk(
        setup, method, likelihood, where, plan.pilot, "bootstrap", method.order, usual,
        gaussian=gaussian, first=first,
    ).prepared()  # fmt: skip
    report = {
        "particles": settings.particles,
        "proposal": plan.chosen,
        "settings": settings_of(method),
        **chains.report,
    }
    if first is not None:
        report["first_stage"] = NAMED[first.kind]
    if plan.sd is not None:
        report["pilot_sd_of_log_likelihood"] = plan.sd
    return replace(chains, report=report)


@dataclass(frozen=True)
class _Plan:
    """What the pilot has found: the mode; the filter, and in words how it was chosen; the standard
    deviation of its log Z, where that was looked at; the Gaussian approximation at its mode, where
    there is one; whether acceptance is delayed."""

    pilot: Pilot
    settings: FilterSettings
    chosen: str
    sd: float | None
    gaussian: GaussianPilot | None
    delayed: bool
    plain: bool


def _planned(setup: SamplingSetup, method: PMMH) -> _Plan:
    problem, space = setup.problem, setup.space
    plain = method.order == 0 and not method.correlation  # others know no guide
    asked = method.delayed_acceptance
    gaussian = None
    if plain and not method.rescue:
        gaussian = setup.once("gaussian", lambda: _gaussian(setup, method))
    if gaussian is None and asked is True:
        kind = approximation_kind(problem)
        why = kind if isinstance(kind, NotApplicable) else "it is not finite, or has no mode"
        raise ArgumentError(
            f"delayed_acceptance=True does not apply: {why}",
            fix="use ssm.PMMH(delayed_acceptance=False)",
        )
    twisted, target = None, min(method.target_sd, PRECISE)
    if gaussian is not None:
        mode, _ = space.parameters(gaussian.z)
        twisted = setup.once("twisted", lambda: tune_twisted(problem, mode, target))
        if asked is not True and not _trusted(gaussian, twisted):
            gaussian = None
        usable = method.proposal in ("auto", "twisted") and method.particles is None
        if gaussian is None or not usable or twisted is None or twisted.sd > target:
            twisted = None  # by the ways of other filters, then
    pilot = gaussian.pilot if gaussian is not None else setup.once(
        "pilot", lambda: find_mode(space, setup.root, rescue=method.rescue)
    )  # fmt: skip
    theta, _ = space.parameters(pilot.z)
    choice = None
    if method.proposal == "auto":
        temper = plain and not method.rescue
        choice = setup.once(
            "proposal",
            lambda: choose_by_pilot(
                problem, theta, exact=False, whole=plain and twisted is None, integrate=plain,
                temper=temper and twisted is None,
            ),
        )  # fmt: skip
        if twisted is not None and _pays(choice, twisted):
            choice = replace(choice, name="twisted")
        else:
            twisted = None
    proposal = choice.name if choice else method.proposal
    problem.proposal(proposal, integrate=plain)
    tuned = twisted
    if method.particles is None and tuned is None:
        tuned = setup.once("tuning", lambda: _tuned(setup, method, theta, proposal))
    particles = method.particles if tuned is None else tuned.particles
    assert particles is not None
    settings = FilterSettings(int(particles), proposal, rescue=int(method.rescue))
    cheap = proposal == "twisted" and gaussian is not None
    delayed = cheap if asked == "auto" else bool(asked)
    return _Plan(
        pilot, settings, str(choice or proposal), None if tuned is None else tuned.sd, gaussian,
        delayed and len(pilot.z) > 0, plain,
    )  # fmt: skip


def _gaussian(setup: SamplingSetup, method: PMMH) -> GaussianPilot | None:
    """The approximation at its mode, where it may be of use."""
    problem = setup.problem
    if method.proposal not in ("auto", "twisted") and method.delayed_acceptance is not True:
        return None
    if "user" in problem.program.proposals and method.delayed_acceptance is not True:
        return None
    kind = approximation_kind(problem)
    if isinstance(kind, NotApplicable):
        return None
    return gaussian_pilot(setup.space, kind)


def _trusted(gaussian: GaussianPilot, twisted: TunedParticles | None) -> bool:
    """Whether the approximate posterior is near enough to the exact one to begin from: t round its
    mode fits it, and the filter that it guides knows the likelihood there."""
    return gaussian.acceptance > LEAST_ACCEPTANCE and twisted is not None and twisted.sd < BEST_SD


def _pays(choice: Choice, twisted: TunedParticles) -> bool:
    """Whether the twisted filter costs less for an effective draw than the filter of the pilot's
    choice, by counted costs: of N particles a row, and of the guide."""
    sd, cost = choice.figures.get(choice.name, (np.inf, 0.0))
    if not choice.figures:  # without a rival there was no pilot
        return True
    particles = max(sd**2 * PILOT_PARTICLES / BEST_SD**2, FEWEST)
    other = particles * cost * _draws_lost(BEST_SD)
    own = (GUIDE + twisted.particles * TWISTED_COST) * _draws_lost(twisted.sd)
    return not other < own


def _draws_lost(sd: float) -> float:
    """Iterations for each that an exact likelihood would need, by the acceptance at equilibrium of
    independent estimates of log Z with this standard deviation (Sherlock et al. 2015)."""
    return 1.0 / math.erfc(0.5 * sd)


@dataclass(frozen=True)
class Walk:
    """Metropolis-Hastings chains: their kernel, where each starts, and what to report."""

    kernel: Metropolis
    states: list[WalkState]
    report: dict[str, Any]

    def prepared(self) -> PreparedChains:
        """Made ready for `sample`."""
        return PreparedChains(partial(metropolis_block, self.kernel), self.states, self.report)


def walk(
    setup: SamplingSetup, method: PMMH | MetropolisHastings, likelihood: Likelihood,
    where: Coordinates, pilot: Pilot, proposal: str, order: int, usual: float, *,
    gaussian: GaussianPilot | None = None, first: ApproximateLikelihood | None = None,
) -> Walk:  # fmt: skip
    """Chains in the coordinates, started round the pilot's mode.

    proposal : of the filter that looks at the starts. order : of the steps, as in `PMMH`. usual :
    rate of acceptance to adapt to, unless the method names one. gaussian : the approximation, whose
    covariance the walk begins with. first : of delayed acceptance.
    """
    factor = walk_factor(setup, method, where, pilot, proposal, gaussian)
    tuning: Any = factor
    move: Proposal = RandomWalk()
    d = len(where)
    if gaussian is not None and method.covariance is None and d:
        share = MOSTLY if gaussian.well_proposed else SELDOM
        move = WalkAndIndependence(where.at(pilot.z), factor * np.sqrt(d) / STRETCH, share)
    if order:
        if method.covariance is None:
            factor = factor * np.sqrt(max(d, 1)) / STRETCH  # of one standard deviation
        move, tuning = Langevin(where, factor, order == 2), 0.0
    target = usual if method.target_acceptance is None else method.target_acceptance
    adapts = method.covariance is None if method.adapt is None else method.adapt
    adapting = setup.warmup if adapts else 0
    approximate = int(APPROXIMATE_SHARE * setup.warmup) if first is not None else 0
    kernel = Metropolis(
        where, likelihood, move, setup.warmup, adapting, target, setup.thin, first, approximate
    )
    space, rescue = setup.space, getattr(method, "rescue", 0)
    finite = None if gaussian is None else approximately(gaussian.likelihood(setup.problem))
    starts = setup.once(
        "starts",
        lambda: dispersed(space, pilot, setup.chains, setup.root, proposal, rescue, finite),
    )
    states = []
    for chain, z in enumerate(starts):
        generator, stream = setup.streams(chain)
        states.append(start_chain(kernel, where.at(z), tuning, generator, stream))
    report = {
        "pilot_mode": setup.by_name(space.parameters(pilot.z)[0]),
        "walk_covariance": (factor @ factor.T).tolist(),
    }
    return Walk(kernel, states, report)


def _likelihood(setup: SamplingSetup, method: PMMH, settings: FilterSettings) -> Likelihood:
    """The particle filter in the form that the method needs, compiled to find out if it applies."""
    problem = setup.problem
    if method.correlation:
        correlated = CorrelatedLikelihood(problem, settings, method.correlation, setup.states)
        _ = correlated.filter
        return correlated
    if method.order:
        free = [n not in setup.fixed for n, s in problem.trace.parameters.items()
                for _ in s.components]  # fmt: skip
        wanted = tuple(np.flatnonzero(free).tolist())
        second = method.order == 2
        scored = ScoredLikelihood(problem, settings, method.lag, wanted, second, setup.states)
        _ = scored.filter
        return scored
    if is_marginal(settings.proposal):
        return MarginalLikelihood(problem, settings, setup.states)
    return ParticleLikelihood(problem, settings, setup.states)


def _tuned(setup: SamplingSetup, method: PMMH, theta: np.ndarray, proposal: str) -> TunedParticles:
    """The number of particles by the spread of log Z, or of the difference of correlated ones."""
    if not method.correlation:
        return tune_particles(
            setup.problem, theta, proposal, method.target_sd, setup.root, method.rescue
        )

    def spread(particles: int) -> float:
        settings = FilterSettings(particles, proposal)
        likelihood = CorrelatedLikelihood(setup.problem, settings, method.correlation)
        stream, run, log_z = random_state(setup.root, 9), None, []
        for _ in range(TUNING_REPEATS):
            run = likelihood.run(theta, run, stream)
            log_z.append(-np.inf if run is None else run.log_likelihood)
        change = np.diff(log_z)
        return float(np.std(change) / np.sqrt(2.0)) if np.all(np.isfinite(change)) else np.inf

    return particles_for(spread, method.target_sd)


def walk_factor(
    setup: SamplingSetup, method: PMMH | MetropolisHastings, where: Coordinates, pilot: Pilot,
    proposal: str, gaussian: GaussianPilot | None = None,
) -> np.ndarray:  # fmt: skip
    """Cholesky factor (d, d) of the walk's covariance, as given or from the pilot.

    Raises
    ------
    ArgumentError : the given covariance has the wrong shape, or is no covariance.
    """
    if method.covariance is not None:
        return given_factor(method.covariance, len(where))
    if gaussian is not None:
        change = scales(where, pilot) / pilot.scale if len(where) else pilot.scale
        covariance = gaussian.covariance * np.outer(change, change)
        return np.linalg.cholesky(covariance) * STRETCH / np.sqrt(max(len(where), 1))
    rescue = getattr(method, "rescue", 0)
    covariance = setup.once(
        "covariance", lambda: pilot_covariance(setup, where, pilot, proposal, rescue)
    )
    return np.linalg.cholesky(covariance) * STRETCH / np.sqrt(max(len(where), 1))


def pilot_covariance(
    setup: SamplingSetup, where: Coordinates, pilot: Pilot, proposal: str, rescue: int = 0
) -> np.ndarray:
    """The inverse information at the pilot's mode, (d, d) in the coordinates."""
    w = where.at(pilot.z)
    repeats = SCALE_REPEATS if len(w) <= 4 else SCALE_REPEATS // 2
    density = averaged_density(where, setup.root, proposal, repeats, rescue)
    rng = np.random.default_rng(np.random.SeedSequence(setup.root.entropy, spawn_key=(8,)))
    return fitted_covariance(density, w, scales(where, pilot), rng)


def scales(where: Coordinates, pilot: Pilot) -> np.ndarray:
    """The pilot's scales of z carried over to the coordinates, by the change over one scale."""
    out = np.empty(len(where))
    if len(out) != len(pilot.z):
        raise AssertionError("coordinates and unconstrained numbers are one to one")
    for i, step in enumerate(np.diag(pilot.scale)):
        out[i] = 0.5 * np.abs(where.at(pilot.z + step) - where.at(pilot.z - step))[i]
    return out


def given_factor(covariance: Any, d: int) -> np.ndarray:
    """Cholesky factor of a covariance that the user gave."""
    matrix = np.atleast_2d(np.asarray(covariance, dtype=float))
    if matrix.shape != (d, d) or not np.allclose(matrix, matrix.T, rtol=1e-8, atol=0.0):
        raise ArgumentError(
            f"covariance has shape {matrix.shape}" if matrix.shape != (d, d)
            else "covariance is not symmetric",
            fix=f"give a symmetric {d} x {d} matrix, the free parameters in the order declared",
        )  # fmt: skip
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ArgumentError(
            "covariance is not positive definite", fix="give the covariance of the walk's steps"
        ) from None


def settings_of(method: Any) -> dict[str, Any]:
    """The settings as plain values, for the attributes."""
    settings = asdict(method)
    if settings.get("covariance") is not None:
        settings["covariance"] = np.asarray(settings["covariance"], dtype=float).tolist()
    if settings.get("transform") is not None:
        settings["transform"] = dict(settings["transform"])
    return settings


METHOD = SamplingMethod(
    prepare,
    state_classes=(*WALK_STATES, LocalProposal, Pilot, TunedParticles, Choice, GaussianPilot),
    by_row=lambda method: True,
)
