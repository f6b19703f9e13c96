"""From where iterated filtering ended to the maximum of the likelihood there.

Ends can share one bias: along a ridge on which the likelihood is almost flat all runs lag, and
steps that have not vanished move all of them alike. So the end is only where the search for the
top begins. Points are scattered round it, the likelihood is estimated at each by filters of its
own, and a quadratic is fitted (`inference/optimisation/quadratic.py`). First in rounds, each of
which moves the centre to the top that the quadratic has and takes on its shape, until both rest;
then once with more points, whose noise is no part of how their centre was chosen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.maximum.ascent import Maximization
from ssmppl.inference.methods.methods import IF2
from ssmppl.inference.optimisation.quadratic import LocalQuadratic, count, fit_quadratic
from ssmppl.inference.particles.filtering import FilterSettings, log_of_mean, repeated_estimates
from ssmppl.inference.preparation.pilot import scale_of
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.tasks import run_tasks

REACH = 0.9  # standard deviations by which points are scattered
EXACT_REACH = 0.1  # where the likelihood has no noise
NOISE = 0.3  # squared relative error of the likelihood at a point that is aimed at
MOST_RUNS, MOST_GROWTH = 16, 4.0  # filters at a point, and how many times more in a round
SCALE_RUNS = 2  # filters at the points that tell how far to scatter those, which is a guess
ROUNDS, FINAL_ROUNDS = 12, 4
APPROACH, POINTS = 6, 24  # points of a round, and of the last one, for each coefficient
FEWEST = 40
FAR = 2.0  # standard deviations that a centre moves at most
NEAR = 1.0  # and from where a centre has come near the top
CENTRED = 0.5  # share of the reach by which the last centre may lie off the top
HOPELESS = (
    4.0  # squared relative error at a point by MOST_RUNS filters with which no top is located
)
PATIENCE = 3  # rounds with such an error
ALIKE = 0.4  # share of the information by which the shape may still change
LEAST, MOST = 1.0 / 9.0, 16.0  # change of the information in a round
SURELY = 3.0  # standard errors that the information of a direction is above zero at a top
FLAT = 0.05  # information of a direction, in that of the round before, without a top
GROUPS = 10  # of the jackknife
TOGETHER = 8  # points of a task


@dataclass(frozen=True)
class LocalMaximum:
    """z : (F,) the top. error : (F, F) its Monte Carlo covariance. information : (F, F) minus the
    second derivatives of the log-likelihood in z there. points, runs : of the last round, and
    filters at each of them. moved : from where the search began, in standard deviations."""

    z: np.ndarray
    error: np.ndarray
    information: np.ndarray
    points: int
    runs: int
    moved: float

    def __str__(self) -> str:
        each = f", by {self.runs} filters each" if self.runs > 1 else ""
        where = f"at {self.points} points round it{each}"
        return f"maximum of a quadratic fitted to the log-likelihood {where}"


@dataclass
class _Search:
    """How far a search has come; settings : of the filters, None where the likelihood is exact."""

    setup: Maximization
    settings: FilterSettings | None
    centre: np.ndarray
    factor: np.ndarray
    runs: int
    done: int = 0
    reach: float = REACH
    misfit: float = 0.0
    hopeless: int = 0
    seen: tuple[np.ndarray, ...] = ()

    def look(self, n: int, skew: bool) -> LocalQuadratic | None:
        """A fit to n points round the centre."""
        self.done += 1
        rng = np.random.default_rng(self.setup.seed(8, self.done))
        half = self.reach * rng.standard_normal(((n + 1) // 2, len(self.centre)))
        u = np.vstack([half, -half])
        log_z = log_densities(
            self.setup, self.settings, self.centre + u @ self.factor.T, self.runs, (8, self.done)
        )
        inside = ~np.isnan(log_z)
        pair = np.tile(np.arange(len(half)), 2)
        self.seen = u[inside], log_z[inside], pair[inside]
        fit = fit_quadratic(u[inside], log_z[inside], skew)
        if fit is not None and self.settings is not None:
            self.misfit = fit.misfit
            self.hopeless += self.runs == MOST_RUNS and fit.misfit > HOPELESS
            wanted = int(np.ceil(self.runs * min(fit.misfit / NOISE, MOST_GROWTH)))
            self.runs = max(self.runs, min(wanted, MOST_RUNS))
        return fit

    def approach(self, n: int) -> bool:
        """One round: moves the centre, takes on the shape; whether both rest."""
        fit = self.look(n, False)
        if fit is None:
            self.factor = 0.5 * self.factor
            return False
        return self.move(fit)

    def move(self, fit: LocalQuadratic) -> bool:
        """Centre and shape to those of a fit, as far as its noise allows; whether they rest."""
        values, errors, vectors = fit.shape()
        surely = 1.0 + np.sign(values - 1.0) * np.maximum(np.abs(values - 1.0) - errors, 0.0)
        usable = np.clip(surely, LEAST, MOST)
        slope = vectors.T @ fit.b
        distance = float(np.sqrt(np.sum(slope**2 / usable)))
        step = vectors @ (slope / usable) * min(1.0, FAR / max(distance, FAR))
        self.centre = self.centre + self.factor @ step
        root = vectors / np.sqrt(usable)
        self.factor = np.linalg.cholesky(self.factor @ root @ root.T @ self.factor.T)
        return bool(distance < NEAR and usable.min() > ALIKE and usable.max() < 1.0 / ALIKE)

    def error(self, fit: LocalQuadratic, u: np.ndarray) -> np.ndarray | None:
        """(F, F) Monte Carlo covariance of the top u: the larger of the delta method's and of the
        jackknife's over groups of pairs, which knows what noise in the curvature does to a top.
        None where the fit without a group has no top."""
        points, log_z, pair = self.seen
        tops = []
        for g in range(GROUPS):
            rest = pair % GROUPS != g
            without = fit_quadratic(points[rest], log_z[rest], True)
            top = None if without is None else self.top(without, surely=0.0)
            if top is None:
                return None
            tops.append(top)
        off = np.array(tops) - np.mean(tops, axis=0)
        jackknife = off.T @ off * (GROUPS - 1) / GROUPS
        delta = fit.error(u)
        return jackknife if np.trace(jackknife) > np.trace(delta) else delta

    def top(self, fit: LocalQuadratic, surely: float = SURELY) -> np.ndarray | None:
        """(F,) where the fit has its top, in its own coordinates; None where it has none near, or
        where its information is not so many standard errors above zero in every direction."""
        u = np.zeros(len(self.centre))
        values, errors, _ = fit.shape()
        if np.any(values < surely * errors):
            return None
        for _ in range(50):
            information = fit.information(u)
            if np.linalg.eigvalsh(information)[0] < FLAT:
                return None
            step = np.linalg.solve(information, fit.slope(u))
            u = u + step
            if not np.linalg.norm(u) < 2.0 * FAR:
                return None
            if np.linalg.norm(step) < 1e-9:
                return u
        return None


def check_points(method: IF2, d: int) -> None:
    """Refuse a number of points that no quadratic in d coordinates can be fitted to.

    Raises
    ------
    ArgumentError : naming the least number.
    """
    if method.points is None:
        return
    least = 2 * count(d, skew=True)
    if 0 < method.points < least:
        raise ArgumentError(
            f"points={method.points}, too few for a quadratic in {d} parameters",
            fix=f"give at least {least}, None for as many as it takes, or 0 for no fit",
        )


def local_maximum(
    setup: Maximization, method: IF2, z: np.ndarray, noise: float
) -> LocalMaximum | NotApplicable:
    """The top near z (F,), where `noise` is the relative error of one estimate of the likelihood.

    Raises
    ------
    ExecutorError : the executor failed.
    """
    settings = None
    if isinstance(setup.exact, NotApplicable):
        theta, _ = setup.space.parameters(z)
        chosen = choose_by_pilot(setup.problem, theta.copy(), exact=False, temper=True).name
        settings = FilterSettings(method.particles, chosen)
    scale = scales(setup, settings, z)
    runs = int(np.clip(np.ceil(noise**2 / NOISE), 2, MOST_RUNS)) if settings else 1
    search = _Search(setup, settings, np.array(z), np.diag(scale), runs)
    few = max(APPROACH * count(len(z), skew=False), FEWEST)
    for _ in range(ROUNDS):
        if search.approach(few) or search.hopeless >= PATIENCE:
            break
    if settings is None:
        search.reach = EXACT_REACH
    points = method.points or max(POINTS * count(len(z), skew=False), 4 * FEWEST)
    for _ in range(FINAL_ROUNDS):
        if search.hopeless >= PATIENCE:
            return NotApplicable(
                "Monte Carlo error too large to locate the maximum of the likelihood: relative "
                f"error {np.sqrt(search.misfit):.1f} by {search.runs} filters of "
                f"{method.particles} particles"
            )
        runs = search.runs
        fit = search.look(points, True)
        u = None if fit is None else search.top(fit)
        if fit is None:
            search.factor = 0.5 * search.factor
            continue
        far = u is None or np.linalg.norm(u) > CENTRED * search.reach
        error = None if far or u is None else search.error(fit, u)
        if u is None or error is None:
            search.move(fit)
            continue
        f, inverse = search.factor, np.linalg.inv(search.factor)
        top = search.centre + f @ u
        information = inverse.T @ fit.information(u) @ inverse
        if setup.with_prior:
            nothing = np.zeros(len(setup.space.theta))
            information = information + setup.transform.curvature(top, nothing).log_prior
        moved = float(np.linalg.norm(np.linalg.solve(f, top - z)))
        return LocalMaximum(top, f @ error @ f.T, information, points, runs, moved)
    return NotApplicable("the likelihood has no maximum within the fitted region")


def log_densities(
    setup: Maximization, settings: FilterSettings | None, points: np.ndarray, runs: int,
    path: tuple[int, ...],
) -> np.ndarray:  # fmt: skip
    """(n,) log of what is to be maximised at points (n, F), from the mean of `runs` estimates.

    -inf where the likelihood is zero, NaN where there is none: off the support, or where the filter
    fails. Each point has a seed of its own, so that the numbers do not depend on who runs them.
    """
    if settings is None:
        log_z = np.array([setup.exact_at(z) for z in points])
    else:
        seeds = [setup.seed(*path, j) for j in range(len(points))]
        pieces = [
            (points[k : k + TOGETHER], seeds[k : k + TOGETHER], runs)
            for k in range(0, len(points), TOGETHER)
        ]
        task = partial(_estimates, setup.space, settings)
        log_z = np.concatenate(run_tasks(task, pieces, executor=setup.executor))
    return log_z + np.array([setup.log_prior(z) for z in points])


def _estimates(
    space: Space, settings: FilterSettings,
    piece: tuple[np.ndarray, list[np.random.SeedSequence], int],
) -> np.ndarray:  # fmt: skip
    out = []
    for z, seed in zip(*piece[:2], strict=True):
        theta, log_prior = space.parameters(z)
        if log_prior == -np.inf:
            out.append(np.nan)
            continue
        try:
            log_z = repeated_estimates(space.problem, theta, settings, seed, range(piece[2]))
            out.append(log_of_mean(log_z)[0])
        except SamplingError:
            out.append(np.nan)
    return np.array(out)


def scales(setup: Maximization, settings: FilterSettings | None, z: np.ndarray) -> np.ndarray:
    """(F,) how far to scatter points in each coordinate, a first guess."""
    if settings is None:
        return scale_of(z, lambda point: float(_finite(setup.exact_at(point))))
    task = partial(_scale, setup.space, settings, setup.seed(8, 0), z)
    return np.array(run_tasks(task, range(len(z)), executor=setup.executor))


def _scale(
    space: Space, settings: FilterSettings, seed: np.random.SeedSequence, z: np.ndarray, i: int
) -> float:
    def along(s: np.ndarray) -> float:
        point = z.copy()
        point[i] += s[0]
        return float(_finite(_estimates(space, settings, (point[None], [seed], SCALE_RUNS))[0]))

    return float(scale_of(np.zeros(1), along)[0])


def _finite(value: float) -> float:
    """-inf for NaN."""
    return -np.inf if np.isnan(value) else value
