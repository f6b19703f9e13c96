"""The pilot by the Gaussian approximation: the mode of an approximate posterior, the covariance
there, and how well the twisted filter knows the likelihood at it.

The log posterior with Laplace's likelihood in place of the exact one (with the extended Kalman
filter's, where Laplace's does not apply) has no noise, so that Newton's method climbs it in a few
dozen evaluations. Its inverse Hessian at the mode is the covariance that random walks and
independence proposals begin with. The result only starts and scales chains; nothing depends on its
accuracy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.codegen.modules.twisted import TwistedFilter
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.gaussian.likelihood import (
    ApproximateLikelihood,
    laplace_approximation,
)
from ssmppl.inference.optimisation.newton import GOOD, climb, information_at
from ssmppl.inference.particles.filtering import FilterSettings, repeated_estimates
from ssmppl.inference.preparation.pilot import Pilot, TunedParticles, finite_point, scale_of
from ssmppl.inference.preparation.proposal_choice import digest_of
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.problem import Problem

# Of the twisted filter: whole vectors of a processor, as N = 8 costs no more than 5.
NUMBERS = (8, 16, 32, 64, 128, 256)
# sd of log Z beyond which more particles pay: a run costs about the same from 8 to 32 of them, as
# most of it is the guide, and at 0.3 the noise costs about a sixth of the draws.
PRECISE = 0.3
REPEATS, SEED = 40, 20150  # of the filters that tell the sd
LEAST_EIGENVALUE = 1e-3  # of the information as correlations
DEGREES = 5.0  # of freedom of independence proposals: heavier tails than most posteriors have
GOOD_ACCEPTANCE = 0.3  # of them
AS_GOOD = 0.05  # sd in nats, far below that of the twisted filter's log Z
TRIED = 100  # of them, to know how many are accepted
STARTS = 3  # climbs at most, until one comes to a top


@dataclass(frozen=True)
class GaussianPilot:
    """kind : "laplace" or "extended". z (F,) : the mode. covariance (F, F) : inverse information
    there. log_density : there, approximate. noise : (T, R') of each experiment's likeliest
    trajectory there; None of the extended filter. acceptance : of independence proposals from
    Student's t round the mode, of `DEGREES`, on the approximate posterior. fast : "extended" where
    the extended filter's likelihood is as good as Laplace's over the posterior, as it is where
    models are nearly linear; else `kind`."""

    kind: str
    z: np.ndarray
    covariance: np.ndarray
    log_density: float
    noise: tuple[np.ndarray, ...] | None
    acceptance: float
    fast: str

    @property
    def pilot(self) -> Pilot:
        """The pilot in the form that the starts of chains use."""
        return Pilot(self.z, np.sqrt(np.diagonal(self.covariance)), self.log_density)

    @property
    def well_proposed(self) -> bool:
        """Whether independence proposals are worth more than steps of a walk."""
        return self.acceptance > GOOD_ACCEPTANCE

    def likelihood(self, problem: Problem, kind: str = "") -> ApproximateLikelihood:
        """The approximation, as a function of the parameters: of a kind, or the fast one."""
        return ApproximateLikelihood(problem, kind or self.fast, self.noise)


def approximation_kind(problem: Problem, asked: str = "auto") -> str | NotApplicable:
    """ "laplace" where it applies, else "extended"; or why there is neither.

    asked : the only one that will do.
    """
    laplace = laplace_approximation(problem)
    if asked != "auto":
        found = laplace if asked == "laplace" else problem.program.gaussian
        return found if isinstance(found, NotApplicable) else asked
    if not isinstance(laplace, NotApplicable):
        return "laplace"
    found = problem.program.gaussian
    return found if isinstance(found, NotApplicable) else "extended"


def approximately(
    likelihood: ApproximateLikelihood,
) -> Callable[[np.ndarray, np.random.SeedSequence], float]:
    """The approximation in the place of an estimate with random numbers, which it needs none of."""
    return lambda theta, _: likelihood.at(theta).log_likelihood


REMEMBERED = 16  # pilots, whose noise has a number for each row
_pilots: dict[tuple, GaussianPilot | None] = {}
_tuned: dict[tuple, TunedParticles | None] = {}


def gaussian_pilot(space: Space, kind: str) -> GaussianPilot | None:
    """The mode of the approximate posterior; None where the approximation is not finite, or
    its posterior to no mode. It has random numbers of its own, the same for every call, and is
    remembered for each program, data and start, as `sample` asks for it twice."""
    where = space.theta.tobytes(), space.z.tobytes(), space.free.tobytes()
    key = (space.problem.program.path, digest_of(space.problem), kind, *where)
    if key not in _pilots:
        while len(_pilots) >= REMEMBERED:
            del _pilots[next(iter(_pilots))]
        _pilots[key] = _climbed(space, kind)
    return _pilots[key]


def _climbed(space: Space, kind: str) -> GaussianPilot | None:
    problem = space.problem
    start = ApproximateLikelihood(problem, kind)
    noise: list[tuple[np.ndarray, ...] | None] = [None]  # of the last point: where to begin

    def log_density(z: np.ndarray) -> float:
        theta, log_prior = space.parameters(z)
        if log_prior == -np.inf:
            return -np.inf
        found = ApproximateLikelihood(problem, kind, noise[0]).at(theta)
        if found.noise is not None:
            noise[0] = found.noise
        return found.log_likelihood + log_prior

    z = space.z[space.positions]
    rng = np.random.default_rng(np.random.SeedSequence(SEED, spawn_key=(8, 1)))
    best = None
    for _ in range(STARTS if len(z) else 1):
        try:
            top = climb(log_density, finite_point(z, log_density, rng))
        except ArgumentError:
            return None
        if top is not None and (best is None or top.value > best.value):
            best = top
        if best is not None and best.distance < GOOD:
            break
        z, noise[0] = z + rng.standard_normal(len(z)), None
    if best is None:
        return None
    covariance = _covariance(space, log_density, best.z)
    if covariance is None:
        return None
    theta, log_prior = space.parameters(best.z)
    found = start.at(theta)
    fixed = ApproximateLikelihood(problem, kind, found.noise)
    acceptance, apart = _tried(space, fixed, best.z, covariance, rng)
    value = found.log_likelihood + log_prior
    fast = "extended" if apart < AS_GOOD else kind
    return GaussianPilot(kind, best.z, covariance, value, found.noise, acceptance, fast)


def _tried(
    space: Space, likelihood: ApproximateLikelihood, z: np.ndarray, covariance: np.ndarray,
    rng: np.random.Generator,
) -> tuple[float, float]:  # fmt: skip
    """Acceptance of independence Metropolis from t round z at equilibrium: the mean of min(1, w' /
    w) over w' by the proposal and w by the posterior, which is the proposal weighed by w. And the
    standard deviation over the posterior of Laplace's log-likelihood less the extended filter's."""
    if not len(z):
        return 1.0, np.inf
    factor, d = np.linalg.cholesky(covariance), len(z)
    log_w, lacking = np.full(TRIED, -np.inf), np.zeros(TRIED)
    other = replace(likelihood, kind="extended")
    for i in range(TRIED):
        white = np.sqrt(DEGREES / rng.chisquare(DEGREES)) * rng.standard_normal(d)
        theta, log_prior = space.parameters(z + factor @ white)
        if log_prior > -np.inf:
            log_t = -0.5 * (DEGREES + d) * np.log1p(white @ white / DEGREES)
            value = likelihood.at(theta).log_likelihood
            log_w[i] = value + log_prior - log_t
            if value > -np.inf:
                lacking[i] = value - other.at(theta).log_likelihood
    if not np.max(log_w) > -np.inf:
        return 0.0, np.inf
    w = np.exp(log_w - np.max(log_w))
    acceptance = float(np.minimum(w[:, None], w).sum() / (TRIED * w.sum()))
    if not np.all(np.isfinite(lacking)):
        return acceptance, np.inf
    w /= w.sum()
    return acceptance, float(np.sqrt(w @ (lacking - w @ lacking) ** 2))


def _covariance(
    space: Space, log_density: Callable[[np.ndarray], float], z: np.ndarray
) -> np.ndarray | None:
    """(F, F) the inverse information at z, positive definite whatever the differences are."""
    if not len(z):
        return np.zeros((0, 0))
    information = information_at(log_density, z)
    diagonal = np.diagonal(information)
    if not np.all(diagonal > 0.0):  # no mode, or one at an edge: the scale at least
        scale = scale_of(z, log_density, space.on_the_line)
        return np.diag(scale**2) if np.all(scale > 0.0) else None
    scale = 1.0 / np.sqrt(diagonal)
    if not np.all(np.isfinite(information)):
        return np.diag(scale**2)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    root = scale[:, None] * vectors / np.sqrt(np.maximum(values, LEAST_EIGENVALUE))
    return root @ root.T


def tune_twisted(problem: Problem, theta: np.ndarray, target: float) -> TunedParticles | None:
    """The fewest particles of the twisted filter by which log Z has at most the target's standard
    deviation at theta; the best of those tried where none has; None where there is no filter, or
    it is not finite. Remembered, as the pilot."""
    key = (problem.program.path, digest_of(problem), theta.tobytes(), target)
    if key not in _tuned:
        _tuned[key] = _tried_numbers(problem, theta, target)
    return _tuned[key]


def _tried_numbers(problem: Problem, theta: np.ndarray, target: float) -> TunedParticles | None:
    if not isinstance(problem.program.twisted, TwistedFilter):
        return None
    best, seed = None, np.random.SeedSequence(SEED)
    for particles in NUMBERS:
        settings = FilterSettings(particles, "twisted")
        try:
            log_z = repeated_estimates(problem, theta, settings, seed, range(REPEATS))
        except SamplingError:
            continue
        if not np.all(np.isfinite(log_z)):
            continue
        sd = float(np.std(log_z, ddof=1))
        if best is None or sd < best.sd:
            best = TunedParticles(particles, sd)
        if sd <= target:
            break
    return best


MOST_PARTICLES = 64  # of the twisted filter, where PMMH over it is the default
MOST_NUMBERS = 12  # free ones, that independence proposals move at once


def precise_twisted(space: Space) -> TunedParticles | None:
    """How well the twisted filter knows the likelihood at the mode of the approximate posterior,
    where it knows it well enough for Metropolis-Hastings over it to be the best of all methods;
    else None."""
    problem = space.problem
    if "user" in problem.program.proposals or not 0 < len(space.positions) <= MOST_NUMBERS:
        return None
    if approximation_kind(problem) != "laplace":
        return None
    found = gaussian_pilot(space, "laplace")
    if found is None or not found.well_proposed:
        return None
    theta, _ = space.parameters(found.z)
    tuned = tune_twisted(problem, theta, PRECISE)
    enough = tuned is not None and tuned.sd <= PRECISE and tuned.particles <= MOST_PARTICLES
    return tuned if enough else None
