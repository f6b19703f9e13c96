"""Particle Metropolis-Hastings (Andrieu, Doucet and Holenstein 2010, section 2.4.2).

The random walk moves on the unconstrained scale or one of the user's choice, starts from the
inverse information at a mode that a pilot finds, and adapts during warmup by the robust adaptive
Metropolis algorithm (Vihola 2012, algorithm 1).

Particle filters as likelihoods for Metropolis-Hastings.

The covariance of a posterior near its mode, from a quadratic fitted to estimates of its log.

The log likelihood is estimated with common random numbers at points scattered round the mode; a
full quadratic is fitted to log p by weighted least squares, and minus its second derivatives are
the information. A fit over a whole region is not misled by the raggedness of single estimates, as
differences over short steps would be.

Gradient-informed proposals of particle Metropolis-Hastings.

Dahlin, Lindsten and Schön (2015), "Particle Metropolis-Hastings using gradient and Hessian
information", algorithm 2: PMH1 proposes w' ~ N(w + eps^2 M S / 2, eps^2 M) with the score S of the
log posterior and a fixed M, PMH2 with M the inverse of the observed information at w. Both are
estimates from the particles that gave the likelihood; they belong to the chain's state, so that the
ratio of the proposals' densities is that of the stored estimates, and the chain is exact whatever
their errors.

An estimate of the information need not be positive definite. In units of the pilot's covariance its
negative eigenvalues are mirrored, as in section 3.4 there, and all are kept within bounds; the
drift is truncated (Roberts and Tweedie 1996), so that a wild estimate cannot throw the chain far.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from ssmppl.codegen.kernels.math.random import fill_normal, uniform
from ssmppl.codegen.kernels.particle.conditional_smc import ancestral_path, draw_index
from ssmppl.codegen.kernels.particle.weights import NO_POINT, OK
from ssmppl.codegen.modules.filter_variants import (
    NumberedFilter,
    ScoredFilter,
    numbered_filter,
    scored_filter,
)
from ssmppl.compiling import once_property
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains.coordinates import (
    ADAPTATION_POWER,
    Coordinates,
    Likelihood,
    Metropolis,
    Point,
    Proposal,
    RandomWalk,
    Run,
    chart,
    coordinates,
    metropolis_block,
    start_chain,
)
from ssmppl.inference.chains.sampling import Sampler, Setup
from ssmppl.inference.methods.methods import PMMH, MetropolisHastings
from ssmppl.inference.particles.filtering import FilterSettings, failure, run_filter
from ssmppl.inference.particles.marginal import draw_given, is_marginal
from ssmppl.inference.preparation.pilot import (
    SCALE_REPEATS,
    TUNING_REPEATS,
    Pilot,
    Tuning,
    averaged_density,
    dispersed,
    find_mode,
    particles_for,
    tune_particles,
)
from ssmppl.inference.preparation.proposal_choice import choose
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.ranges import total_of
from ssmppl.inference.run.seeds import random_state


@dataclass(frozen=True)
class ParticleLikelihood:
    """An independent run of the particle filter for every point. states : whether draws keep its
    paths."""

    problem: Problem
    settings: FilterSettings
    states: bool = True

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        if self.settings.rescue:
            return self._rescued(theta, stream)
        entry = self.problem.program.entry(f"filtered_path_{self.settings.proposal}")
        carried = len(self.problem.program.carried(self.settings.proposal))
        total, paths, increments = 0.0, [], []
        for e in self.problem.experiments:
            path = np.empty((e.steps, carried))
            increment = np.empty(e.steps)
            status, t, log_z = entry(
                theta, e.y, e.seen, e.u, self.settings.particles, stream, path, increment
            )
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            total += log_z
            paths.append(path)
            increments.append(increment)
        return Run(total, tuple(paths), tuple(increments))

    def _rescued(self, theta: np.ndarray, stream: np.ndarray) -> Run | None:
        """By the alive particle filter; Del Moral et al. (2015), section 4, on its use here."""
        carried = len(self.problem.program.carried(self.settings.proposal))
        total, paths, increments, n = 0.0, [], [], self.settings.particles
        for e in self.problem.experiments:
            path, increment, ess = (
                np.empty((e.steps, carried)),
                np.empty(e.steps),
                np.empty(e.steps),
            )
            particles, weights = np.empty((e.steps, carried, n)), np.empty((e.steps, n))
            kept = particles, weights, np.zeros((e.steps, n), dtype=np.int32)
            status, t = run_filter(
                self.problem, theta, self.settings, e, stream, increment, ess, kept=kept
            )
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            ancestral_path(particles, kept[2], draw_index(weights[-1], uniform(stream)), path)
            total += total_of(increment)
            paths.append(path)
            increments.append(increment)
        return Run(total, tuple(paths), tuple(increments))

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        return kept_of(point, self.states)


@dataclass(frozen=True)
class MarginalLikelihood(ParticleLikelihood):
    """A Rao-Blackwellised filter; what it integrates out is drawn for the kept draws."""

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        found = kept_of(point, self.states)
        for i, e in enumerate(self.problem.experiments):
            path = point.run.paths[i][None]
            # drawn even where it is left out, so that the chain is the same with and without
            drawn = draw_given(self.problem, e, point.theta, path, stream)[0]
            if self.states:
                found[f"path_{i}"] = drawn
        return found


class _WithFilter:
    """Leaves the compiled filter out when it is sent to another process, which makes its own."""

    def __getstate__(self) -> dict:
        return {name: value for name, value in self.__dict__.items() if name != "filter"}


@dataclass(frozen=True)
class ScoredLikelihood(_WithFilter):
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

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        entry, p = self.filter.run, len(self.wanted)
        total, paths, increments = 0.0, [], []
        slope, curvature = np.zeros(p), np.zeros((p, p))
        for e in self.problem.experiments:
            path = np.empty((e.steps, len(self.problem.trace.state_symbols)))
            increment, own_slope, own = np.empty(e.steps), np.empty(p), np.zeros((p, p))
            status, t, log_z = entry(
                theta, e.y, e.seen, e.u, self.settings.particles, stream, path, increment,
                self.lag, own_slope, own,
            )  # fmt: skip
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            total += log_z
            slope += own_slope
            curvature += own
            paths.append(path)
            increments.append(increment)
        score, information = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        score[list(self.wanted)] = slope
        information[np.ix_(self.wanted, self.wanted)] = curvature
        return Run(total, tuple(paths), tuple(increments), score, information)

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        return kept_of(point, self.states)


@dataclass(frozen=True)
class CorrelatedLikelihood(_WithFilter):
    """A particle filter on random numbers that move by v' = rho v + sqrt(1 - rho^2) e.

    The move leaves the normal law of the numbers invariant and is reversible, so that they may be
    part of the chain's state (Deligiannidis, Doucet and Pitt 2018, section 2.2).
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

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        old = None if before is None else before.numbers
        total, paths, increments, numbers = 0.0, [], [], []
        made, n = self.filter, self.settings.particles
        for i, e in enumerate(self.problem.experiments):
            fresh = [(e.steps, made.normals * n), (e.steps, made.uniforms * n), (e.steps + 1,)]
            own = [self._moved(shape, None if old is None else old[i][k], stream)
                   for k, shape in enumerate(fresh)]  # fmt: skip
            path = np.empty((e.steps, len(self.problem.trace.state_symbols)))
            increment = np.empty(e.steps)
            status, t, log_z = made.module.correlated_path(
                theta, e.y, e.seen, e.u, n, *own, path, increment
            )
            if status in NO_POINT:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            total += log_z
            paths.append(path)
            increments.append(increment)
            numbers.append(own)
        return Run(total, tuple(paths), tuple(increments), numbers=numbers)

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

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        return kept_of(point, self.states)


def kept_of(point: Point, states: bool) -> dict[str, np.ndarray]:
    """The increments of the run and, of the states, its path, by the names of the draws."""
    named = {f"path_{i}": path for i, path in enumerate(point.run.paths if states else ())}
    return named | {f"increment_{i}": v for i, v in enumerate(point.run.increments)}


def run_filters(
    space: Space, theta: np.ndarray, settings: FilterSettings, stream: np.ndarray
) -> tuple[float, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """(log Z, paths, increments) of all experiments; -inf where the estimate is zero."""
    run = ParticleLikelihood(space.problem, settings).run(theta, None, stream)
    return (-np.inf, (), ()) if run is None else (run.log_likelihood, run.paths, run.increments)


REACH = 1.5  # standard deviations by which the points are scattered
# How far the fitted information may go from the scales' own.
LEAST_SHARE, MOST_SHARE = 1.0 / 16.0, 4.0


def fitted_covariance(
    log_density: Callable[[np.ndarray], float], w: np.ndarray, scale: np.ndarray,
    rng: np.random.Generator, rounds: int = 2,
) -> np.ndarray:  # fmt: skip
    """Covariance (d, d) of the Gaussian that log_density looks like round w (d,).

    scale : (d,) first guess of its standard deviations. Directions in which the fit finds no fall,
    or one far off the guess, keep a bounded share of the guess.
    """
    d = len(w)
    factor = np.diag(scale)
    for _ in range(rounds if d else 0):
        information = fitted_information(log_density, w, factor, rng)
        values, vectors = np.linalg.eigh(information)
        root = vectors / np.sqrt(np.clip(values, LEAST_SHARE, MOST_SHARE**2))
        # its Cholesky factor but for signs; the product itself need not be positive by rounding
        factor = np.linalg.qr((factor @ root).T)[1].T
    return factor @ factor.T


def fitted_information(
    log_density: Callable[[np.ndarray], float], w: np.ndarray, factor: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Minus the second derivatives in u, where w + factor u is the point; NaN-free.

    The identity where too few points have a finite density to fit it.
    """
    d = len(w)
    pairs = [(i, j) for i in range(d) for j in range(i + 1)]
    n = max(4 * (1 + d + len(pairs)), 30)
    half = REACH * rng.standard_normal((n // 2, d))
    u = np.vstack([half, -half])  # antithetic, so that odd terms do not disturb the even ones
    log_p = np.array([log_density(w + factor @ v) for v in u])
    finite = np.isfinite(log_p)
    if finite.sum() < 1 + d + len(pairs):
        return np.eye(d)
    u, log_p = u[finite], log_p[finite]
    drop = log_p.max() - log_p
    weight = np.exp(-0.25 * np.maximum(drop - d, 0.0))  # the far points are not quadratic
    design = np.column_stack([np.ones(len(u)), u, *(u[:, i] * u[:, j] for i, j in pairs)])
    root = np.sqrt(weight)[:, None]
    found, *_ = np.linalg.lstsq(design * root, log_p * root[:, 0], rcond=None)
    information = np.zeros((d, d))
    for (i, j), value in zip(pairs, found[1 + d :], strict=True):
        information[i, j] = information[j, i] = -value * (2.0 if i == j else 1.0)
    return information


LEAST_EIGENVALUE, MOST_EIGENVALUE = 0.2, 5.0  # of the information, in units of the pilot's
LONGEST = 1.0  # of the drift, in standard deviations of the step


@dataclass(frozen=True)
class Local:
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

    def local(self, w: np.ndarray, run: Run) -> Local:
        d, root = len(w), self.factor
        slope = np.zeros(d)
        if run.score is not None and d:
            sd = np.sqrt(np.sum(self.factor**2, axis=1))
            near = chart(self.coordinates, w, sd, self.newton)
            slope = near.jacobian.T @ run.score + near.slope
            if self.newton and run.information is not None:
                information = near.jacobian.T @ run.information @ near.jacobian - near.curvature
                information -= np.tensordot(run.score, near.second, axes=1)
                root = regular_root(information, self.factor)
        if not np.all(np.isfinite(slope)):
            slope = np.zeros(d)
        inverse = np.linalg.inv(root)
        log_det = float(np.linalg.slogdet(root)[1])
        return Local(root, inverse, log_det, 0.5 * root.T @ slope)

    def propose(
        self, point: Point, tuning: float, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        normals = generator.standard_normal(len(point.w))
        step = np.exp(tuning)
        move = point.local.root @ (_drift(point.local, step) + normals)
        return point.w + step * move, normals

    def log_ratio(self, old: Point, new: Point, tuning: float) -> float:
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


def _drift(local: Local, step: float) -> np.ndarray:
    """eps R' S / 2, cut to its longest."""
    drift = step * local.drift
    length = float(np.linalg.norm(drift))
    return drift if length <= LONGEST else drift * (LONGEST / length)


def _log_density(origin: Point, end: Point, step: float) -> float:
    """log q(end | origin) up to a constant."""
    local = origin.local
    residual = local.inverse @ (end.w - origin.w) / step - _drift(local, step)
    return -local.log_det - 0.5 * float(residual @ residual)


STRETCH = 2.562  # of a random walk's steps, over sqrt(d): Sherlock et al. (2015)


def prepare(setup: Setup, method: PMMH) -> Sampler:
    """Find a mode, choose proposal and number of particles there, and start the chains.

    Raises
    ------
    ArgumentError : a setting does not apply to the model; gives the reason.
    """
    problem, space = setup.problem, setup.space
    where = coordinates(space, method.scale, method.transform)
    if method.covariance is not None:
        given_factor(method.covariance, len(where))  # refused now, not after the pilot
    pilot = setup.once("pilot", lambda: find_mode(space, setup.root, rescue=method.rescue))
    theta, _ = space.parameters(pilot.z)
    plain = method.order == 0 and not method.correlation  # others know no guide
    choice = None
    if method.proposal == "auto":
        temper = plain and not method.rescue
        choice = setup.once(
            "proposal",
            lambda: choose(
                problem, theta, exact=False, whole=plain, integrate=plain, temper=temper
            ),
        )
    proposal = choice.name if choice else method.proposal
    problem.proposal(proposal, integrate=plain)
    particles, tuned = method.particles, None
    if particles is None:
        tuned = setup.once("tuning", lambda: _tuned(setup, method, theta, proposal))
        particles = tuned.particles
    settings = FilterSettings(int(particles), proposal, rescue=int(method.rescue))
    d = len(where)
    factor = walk_factor(setup, method, where, pilot, "bootstrap")
    tuning: Any = factor
    move: Proposal = RandomWalk()
    usual = 0.25 if d <= 1 else 0.2 if d == 2 else 0.15
    if method.order:
        if method.covariance is None:
            factor = factor * np.sqrt(max(d, 1)) / STRETCH  # steps of one standard deviation
        move, tuning, usual = Langevin(where, factor, method.order == 2), 0.0, 0.25
    elif method.correlation:
        usual = 0.3
    kernel = Metropolis(
        where, _likelihood(setup, method, settings), move, setup.warmup,
        setup.warmup if adapts(method) else 0,
        usual if method.target_acceptance is None else method.target_acceptance, setup.thin,
    )  # fmt: skip
    states = []
    starts = setup.once(
        "starts",
        lambda: dispersed(space, pilot, setup.chains, setup.root, "bootstrap", method.rescue),
    )
    for chain, z in enumerate(starts):
        generator, stream = setup.streams(chain)
        states.append(start_chain(kernel, where.at(z), tuning, generator, stream))
    report = {
        "particles": settings.particles,
        "proposal": str(choice or proposal),
        "settings": settings_of(method),
        "pilot_mode": setup.by_name(theta),
        "walk_covariance": (factor @ factor.T).tolist(),
    }
    if tuned is not None:
        report["pilot_sd_of_log_likelihood"] = tuned.sd
    return Sampler(partial(metropolis_block, kernel), states, report)


def _likelihood(setup: Setup, method: PMMH, settings: FilterSettings) -> Likelihood:
    """The particle filter in the form that the method needs, compiled to find out if it applies."""
    problem = setup.problem
    if method.correlation:
        correlated = CorrelatedLikelihood(problem, settings, method.correlation, setup.states)
        _ = correlated.filter
        return correlated
    if method.order:
        held = [n not in setup.held for n, s in problem.trace.parameters.items()
                for _ in s.components]  # fmt: skip
        wanted = tuple(np.flatnonzero(held).tolist())
        second = method.order == 2
        scored = ScoredLikelihood(problem, settings, method.lag, wanted, second, setup.states)
        _ = scored.filter
        return scored
    if is_marginal(settings.proposal):
        return MarginalLikelihood(problem, settings, setup.states)
    return ParticleLikelihood(problem, settings, setup.states)


def _tuned(setup: Setup, method: PMMH, theta: np.ndarray, proposal: str) -> Tuning:
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


def adapts(method: PMMH | MetropolisHastings) -> bool:
    """Whether the walk adapts: as it was asked for, else unless a covariance was given."""
    return method.covariance is None if method.adapt is None else method.adapt


def walk_factor(
    setup: Setup, method: PMMH | MetropolisHastings, where: Coordinates, pilot: Pilot,
    proposal: str,
) -> np.ndarray:  # fmt: skip
    """Cholesky factor (d, d) of the walk's covariance, as given or from the pilot.

    Raises
    ------
    ArgumentError : the given covariance has the wrong shape, or is no covariance.
    """
    if method.covariance is not None:
        return given_factor(method.covariance, len(where))
    rescue = method.rescue if isinstance(method, PMMH) else 0
    covariance = setup.once(
        "covariance", lambda: pilot_covariance(setup, where, pilot, proposal, rescue)
    )
    return np.linalg.cholesky(covariance) * STRETCH / np.sqrt(max(len(where), 1))


def pilot_covariance(
    setup: Setup, where: Coordinates, pilot: Pilot, proposal: str, rescue: int = 0
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
