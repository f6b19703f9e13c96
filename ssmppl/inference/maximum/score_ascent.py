"""Score ascent: stochastic approximation on particle estimates of the score.

G. Poyiadjis, A. Doucet and S. S. Singh, "Particle approximations of the score and observed
information matrix in state space models", *Biometrika* 98 (2011); Schön et al. (2015), appendix.
The score is estimated by Fisher's identity over backward trajectories, the information by Louis'.

Near the top z* the estimates are g_k = -I (z_k - z*) + noise, so that with averages over all runs
at iterates z_k that are near it

    z* = mean z_k + I^-1 mean g_k,   its Monte Carlo covariance I^-1 Cov(mean g_k) I^-1,

whatever steps led there. The runs are weighted by their estimates of the likelihood, over those of
the quadratic at z_k, which takes away the bias of order 1 / N (see
`inference/particles/scores.py`). The steps are z_{k+1} = z_k + k^-0.6 B^-1 g_k, B an estimate of I,
after D. Ruppert (1988), and B. T. Polyak and A. B. Juditsky, *SIAM J. Control Optim.* 30 (1992).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy

from ssmppl.data import spelled
from ssmppl.errors import SamplingError
from ssmppl.inference.maximum.ascent import Ascent, Maximization
from ssmppl.inference.methods.methods import ScoreAscent
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.particles.backward import choose_kernel
from ssmppl.inference.particles.filtering import log_of_mean
from ssmppl.inference.particles.scores import (
    SmootherRun,
    Smoothing,
    combine,
    complete_scores,
    run_weights,
    several_runs,
)
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot, resolve_settings
from ssmppl.inference.run.progress import Progress
from ssmppl.language.model.transforms import transforms

NEWTON = {"particles": 500, "trajectories": 200, "runs": 8, "iterations": 200}
PAPER = {"particles": 500, "trajectories": 100, "runs": 1, "iterations": 250}
LONGEST = 0.5  # of a step, in each unconstrained number
LEAST_INFORMATION = 0.02  # share of the complete data's information that B has at least
MEMORY = 0.3  # weight of the newest information in B
FALL, HALVINGS = 20.0, 24  # nats that a step may cost; of one that costs more, before it is none
NEAR = 3.0  # squared length of a step, in noise, below which the approach is over
LEAST_APPROACH, LEAST_AVERAGE = 3, 10  # iterations
GAIN = 0.6
Runs = Callable[[np.ndarray, int], list[SmootherRun]]


@dataclass(frozen=True)
class ScoreEstimate:
    """What is estimated at z, in z: gradient (F,), its noise, information and that of the complete
    data (F, F); natural : the information in theta (P, P). each : (R, F) gradients of the runs, and
    their log_z (R,).
    """

    z: np.ndarray
    gradient: np.ndarray
    each: np.ndarray
    log_z: np.ndarray
    noise: np.ndarray
    information: np.ndarray
    complete: np.ndarray
    natural: np.ndarray


@dataclass
class _Iterations:
    """How far a climb has come. least : log p(y | theta) below which the next iterate may not
    fall."""

    iterates: list[np.ndarray] = field(default_factory=list)
    near: list[ScoreEstimate] = field(default_factory=list)
    b: np.ndarray | None = None
    least: float = -np.inf


def climb(setup: Maximization, method: ScoreAscent) -> Ascent:
    """The maximum of the likelihood, or of the posterior density, by score ascent.

    setup : model, data, start and objective. method : its settings. The `Ascent` has the end, the
    iterates and the report.

    Raises
    ------
    ArgumentError : Fisher's identity does not hold in some parameter.
    SamplingError : the particle filter fails where the climb begins.
    """
    paper = method.steps == "paper"
    counts = dict(PAPER if paper else NEWTON)
    counts |= {n: getattr(method, n) for n in counts if getattr(method, n) is not None}
    need_density(setup.problem.trace, "ScoreAscent", "maximize")
    scores = complete_scores(setup.problem, setup.fixed)
    start = setup.start
    theta, _ = setup.space.parameters(start)
    proposal = method.proposal
    if proposal == "auto":
        proposal = choose_by_pilot(setup.problem, theta, exact=False, whole=True, temper=True).name
    settings = resolve_settings(setup.problem, theta, counts["particles"], proposal)
    kernel, why = choose_kernel(
        setup.problem, settings, counts["trajectories"], method.kernel,
        passes=counts["runs"] * counts["iterations"],
    )  # fmt: skip
    smoothing = Smoothing(settings, counts["trajectories"], kernel)

    def runs(z: np.ndarray, k: int) -> list[SmootherRun]:
        theta, log_prior = setup.space.parameters(z)
        if log_prior == -np.inf:
            raise SamplingError("the parameters left their support")
        numbers = range(counts["runs"])
        return several_runs(
            scores, theta.copy(), smoothing, not paper, setup.seed(5, k), numbers, setup.executor
        )

    run = _paper if paper else _newton
    with Progress(counts["iterations"], "ScoreAscent", shown=setup.progress) as bar:
        ascent = run(setup, method, start, runs, counts["iterations"], bar)
    ascent.report.update(counts | {"proposal": proposal, "kernel": f"{kernel}: {why}"})
    if scores.differences:
        ascent.report["central_differences"] = scores.differences
    return ascent


def _newton(
    setup: Maximization, method: ScoreAscent, start: np.ndarray, runs: Runs, most: int,
    bar: Progress,
) -> Ascent:  # fmt: skip
    way = _Iterations()
    z, interrupted, share = np.array(start), False, np.inf
    try:
        for k in range(most):
            z, slope = _safe_slope(setup, way, z, runs, k)
            way.iterates.append(z)
            way.b = _preconditioner(way.b, slope)
            step = np.linalg.solve(way.b, slope.gradient)
            noise = float(np.trace(np.linalg.solve(way.b, slope.noise)))
            if way.near or (k >= LEAST_APPROACH and slope.gradient @ step < NEAR * noise + 1e-12):
                way.near.append(slope)
                step = step * len(way.near) ** -GAIN
            z = z + np.clip(step, -LONGEST, LONGEST)
            bar.advance(1, f"Monte Carlo error {share:.2g} of the standard error")
            if len(way.near) >= LEAST_AVERAGE:
                share = _average(way)[3]
                if share < method.tolerance:
                    break
    except KeyboardInterrupt:
        if not way.iterates:
            raise
        interrupted = True
    return _answer(setup, method, way, share, interrupted)


def _safe_slope(
    setup: Maximization, way: _Iterations, z: np.ndarray, runs: Runs, k: int
) -> tuple[np.ndarray, ScoreEstimate]:
    """(z, slope there); where the filter fails, or the likelihood falls by far more than noise, at
    a point on the way back to the last iterate: the longest step knows no units, and in a parameter
    of 1e-5 it leads to where nothing is left to climb by."""
    for _ in range(HALVINGS):
        try:
            slope = _slope(setup, z, runs(z, k))
        except SamplingError:
            if not way.iterates:
                raise
        else:
            value = log_of_mean(slope.log_z)[0]
            if value >= way.least:
                way.least = value - FALL - 3.0 * float(np.std(slope.log_z))
                return z, slope
        z = 0.5 * (z + way.iterates[-1])
    z = way.iterates[-1]
    return z, _slope(setup, z, runs(z, k))


def _slope(setup: Maximization, z: np.ndarray, runs: list[SmootherRun]) -> ScoreEstimate:
    with np.errstate(over="ignore", invalid="ignore"):
        slope = _combined(setup, z, runs)
    if not all(
        np.all(np.isfinite(m))
        for m in (slope.gradient, slope.noise, slope.information, slope.complete)
    ):
        raise SamplingError(
            "the log joint density has no finite second derivative at "
            f"{spelled(setup.problem.trace, setup.transform.at(z).theta)}",
            fix="give start={name: value} off the edges of the distributions, or use IF2",
        )
    return slope


def _combined(setup: Maximization, z: np.ndarray, runs: list[SmootherRun]) -> ScoreEstimate:
    point, found = setup.transform.at(z), combine(runs)
    j = point.jacobian
    log_z = np.array([r.log_z for r in runs])
    w = run_weights(log_z)
    each = point.pull(np.stack([r.mean for r in runs]))
    hessian = np.tensordot(w, np.stack([r.hessian for r in runs if r.hessian is not None]), axes=1)
    second = setup.transform.curvature(z, found.gradient)
    gradient, prior = point.pull(found.gradient), np.zeros_like(second.theta)
    if setup.with_prior:
        gradient, prior = gradient + point.d_log_prior, second.log_prior
        each = each + point.d_log_prior
    natural = found.information if found.information is not None else np.zeros_like(hessian)
    rest = -second.theta - prior
    return ScoreEstimate(
        z, gradient, each, log_z, j.T @ found.gradient_covariance @ j,
        j.T @ natural @ j + rest, -j.T @ hessian @ j + rest, natural,
    )  # fmt: skip


def _preconditioner(b: np.ndarray | None, slope: ScoreEstimate) -> np.ndarray:
    """B with the newest information in it, positive definite: between a share of the complete
    data's information and the whole of it, in every direction."""
    complete = _positive(slope.complete)
    new = slope.information if b is None else (1.0 - MEMORY) * b + MEMORY * slope.information
    values, vectors = scipy.linalg.eigh(0.5 * (new + new.T), complete)
    values = np.clip(values, LEAST_INFORMATION, 1.0)
    back = complete @ vectors
    return (back * values) @ back.T


def _positive(matrix: np.ndarray) -> np.ndarray:
    """The symmetric matrix with its eigenvalues' absolute values, none next to zero."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    values = np.maximum(np.abs(values), 1e-8 * max(float(np.abs(values).max()), 1e-8))
    return (vectors * values) @ vectors.T


def _average(way: _Iterations) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """(top, Monte Carlo covariance, information, largest error in standard errors), in z."""
    information = np.mean([s.information for s in way.near], axis=0)
    complete = _positive(np.mean([s.complete for s in way.near], axis=0))
    values, vectors = scipy.linalg.eigh(0.5 * (information + information.T), complete)
    back = complete @ vectors
    usable = (back * np.maximum(values, LEAST_INFORMATION)) @ back.T
    inverse = np.linalg.inv(usable)
    z = np.repeat([s.z for s in way.near], [len(s.each) for s in way.near], axis=0)
    g, log_z = (
        np.concatenate([s.each for s in way.near]),
        np.concatenate([s.log_z for s in way.near]),
    )
    tops = z + g @ inverse  # where each run sees the top
    off = z - tops.mean(axis=0)
    w = run_weights(log_z + 0.5 * np.einsum("ki,ij,kj->k", off, usable, off))
    rest = w[:, None] * (tops - w @ tops)
    error = rest.T @ rest * len(w) / (len(w) - 1)
    share = float(np.sqrt(np.max(np.diagonal(error) / np.diagonal(inverse))))
    middle = w @ z
    return middle + np.clip(w @ tops - middle, -LONGEST, LONGEST), error, usable, share


def _answer(
    setup: Maximization, method: ScoreAscent, way: _Iterations, share: float, interrupted: bool
) -> Ascent:
    iterates = np.array([setup.space.parameters(z)[0].copy() for z in way.iterates])
    converged = share < method.tolerance
    report = {
        "converged": converged, "averaged_iterates": len(way.near),
        "monte_carlo_share": share if np.isfinite(share) else None,
        "stopped": "" if converged else "the iterations are used up",
    }  # fmt: skip
    if len(way.near) < 2:
        theta = iterates[-1]
        return Ascent(theta, None, iterates, report, interrupted=interrupted)
    top, error, _, _ = _average(way)
    natural = np.mean([s.natural for s in way.near], axis=0)
    return Ascent(
        setup.transform.at(top).theta, None, iterates, report, natural,
        setup.natural_error(top, error), interrupted,
    )  # fmt: skip


def _paper(
    setup: Maximization, method: ScoreAscent, start: np.ndarray, runs: Runs, most: int,
    bar: Progress,
) -> Ascent:  # fmt: skip
    metric = paper_metric(setup)
    way, z, interrupted = _Iterations([np.array(start)]), np.array(start), False
    try:
        for k in range(1, most + 1):
            point = setup.transform.at(z)
            batch = runs(z, k)
            gradient = point.pull(np.mean([r.mean for r in batch], axis=0))
            if setup.with_prior:
                gradient = gradient + point.d_log_prior
            z = z + method.gamma * k**method.exponent * metric * gradient
            way.iterates.append(z)
            bar.advance(1)
    except KeyboardInterrupt:
        if len(way.iterates) < 2:
            raise
        interrupted = True
    iterates = np.array([setup.space.parameters(z)[0].copy() for z in way.iterates])
    report = {"converged": False, "stopped": "this sequence of steps has no rule to stop"}
    return Ascent(iterates[-1], None, iterates, report, interrupted=interrupted)


def paper_metric(setup: Maximization) -> np.ndarray:
    """(F,) what turns a step in z into one of the paper's parameters: 4 for a logit, else 1.

    A logit is twice the paper's atanh, whose gradient is twice that in the logit.
    """
    out: list[float] = []
    for t, free in zip(transforms(setup.problem.trace), setup.space.free, strict=True):
        if free:
            support = t.site.distribution.support()
            logit = [
                support.kind == "interval" and _finite(a) and _finite(b)
                for a, b in zip(support.lower.ravel(), support.upper.ravel(), strict=True)
            ]
            out += [4.0 if two else 1.0 for two in logit][: len(t.free)] or [1.0] * len(t.free)
            out += [1.0] * (len(t.free) - len(logit))
    return np.array(out)


def _finite(bound: object) -> bool:
    return not (getattr(bound, "op", "") == "const" and np.isinf(getattr(bound, "data", 0.0)))
