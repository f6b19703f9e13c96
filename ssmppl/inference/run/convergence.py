"""Whether chains have converged, parameters and trajectories, and a warning where they have not.

Parameters: A. Vehtari, A. Gelman, D. Simpson, B. Carpenter and P.-C. Bürkner, "Rank-normalization,
folding, and localization: an improved R-hat for assessing convergence of MCMC", *Bayesian Analysis*
16 (2021): R-hat of split chains, equations (1) to (4), of the ranks and of those of distances from
the median (section 4.2); the effective sample size of the ranks (section 4.1 with equations (8) to
(11)) and the lesser one of the 5% and 95% quantiles (section 4.3). The rule is theirs, and the same
for warnings, for chains that go on by themselves, for the command line and in the docs.

Trajectories: particle Gibbs leaves the right distribution invariant whatever its update rate, but a
row that never changes has not been sampled: paths of a conditional particle filter meet in the
reference, the earlier the row the likelier (Lindsten, Jordan and Schön 2014, section 3). How often
the states change, row by row, is their diagnostic.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtri

from ssmppl.errors import warn
from ssmppl.inference.run.draws import ChainDraws
from ssmppl.inference.run.problem import Problem
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.trace import Site

R_HAT, ESS = 1.01, 400.0  # below, at least: what the first paper recommends, in its section 4
LEAST_CHAINS, FEWEST = 2, 100  # chains, and draws of each, from which that can be estimated
DIFFERENT_PLACES = 1.1  # R-hat from which longer chains are no remedy by themselves
LOW = 0.02  # share of draws at which a row changes, below which there is a warning
STUCK_APART = 1.1  # R-hat from which chains of a discrete state are taken to have stuck apart
Paths = tuple[np.ndarray, ...]
PIECE = 2**25  # bytes of draws that are looked at together
FEWEST_FOR_RATES = 50  # draws of a chain from which rates are worth a warning


_unjudged: ContextVar[bool] = ContextVar("unjudged", default=False)


@contextlib.contextmanager
def unjudged() -> Iterator[None]:
    """Chains are not judged by the rule: what they are for has an error of its own."""
    token = _unjudged.set(True)
    try:
        yield
    finally:
        _unjudged.reset(token)


def convergence_attributes(
    labels: list[str], draws: np.ndarray, interrupted: bool, advice: str, warmup: int
) -> dict[str, str]:
    """What goes to the attributes: nothing, or the warning, which is also given.

    labels, draws : of the P free components, (chains, draws, P). Trials of fewer than `FEWEST`
    draws and runs that were interrupted have none: they are known to be short. advice : what to try
    besides more draws.
    """
    chains, n, _ = draws.shape
    if interrupted or n < FEWEST or not labels or _unjudged.get():
        return {}
    if chains < LEAST_CHAINS:
        text = (
            "one chain has no R-hat: nothing tells whether it has converged. Take several "
            "(chains=4 is the default)"
        )
    else:
        found = np.array([diagnostics(c) for c in np.moveaxis(draws, 2, 0)])
        bad = fall_short(found)
        if not bad.any():
            return {}
        text = _how_far(labels, found, bad) + _remedy(found[bad], n, warmup) + advice
    warn(text)
    return {"convergence_warning": text}


def _how_far(labels: list[str], found: np.ndarray, bad: np.ndarray) -> str:
    """The worst component by its figures, and how many others fall short."""
    worst = int(np.argmax(np.where(bad, _times(found), 0.0)))
    r_hat, bulk, tail = found[worst]
    others = int(bad.sum()) - 1
    more = f"; {others} other parameter{'s fall' if others > 1 else ' falls'} short too"
    return (
        f"the chains have not converged: R-hat of {labels[worst]} is {r_hat:.5g} (below {R_HAT:g} "
        f"is needed), its bulk ESS {bulk:.3g} and its tail ESS {tail:.3g} (at least {ESS:g} of "
        f"each){more if others else ''}. "
    )


def _remedy(found: np.ndarray, n: int, warmup: int) -> str:
    """What to do about components (P, 3) that fall short, of chains of n draws."""
    if found[:, 0].max() > DIFFERENT_PLACES:
        return f"They are in different places: take a longer warmup (it was {warmup})"
    wanted = _times(found).max() * n
    unit = 10 ** max(int(np.log10(wanted)) - 1, 0)
    return (
        f"About draws={unit * int(np.ceil(wanted / unit))} of each chain would do at this rate "
        f"(there were {n})"
    )


def _times(found: np.ndarray) -> np.ndarray:
    """How many times as many draws components (P, 3) need: R-hat of chains in one place is above 1
    by a multiple of 1/n, and effective sample sizes grow with n."""
    with np.errstate(divide="ignore"):
        return np.max([(found[:, 0] - 1.0) / (R_HAT - 1.0), *(ESS / found[:, 1:]).T], axis=0)


def have_converged(chains: Sequence[ChainDraws[Any]], free: np.ndarray) -> bool:
    """Whether the parameters that are free (P,) meet the rule; of what it cannot be told, True."""
    draws = np.stack([c.draws["theta"] for c in chains])[:, :, free]
    if len(chains) < LEAST_CHAINS or draws.shape[1] < FEWEST:
        return True
    return not any(fall_short(diagnostics(c)[None])[0] for c in np.moveaxis(draws, 2, 0))


def fall_short(found: np.ndarray) -> np.ndarray:
    """Which components (P,) miss the rule, by their R-hat, bulk and tail ESS (P, 3)."""
    return (found[:, 0] >= R_HAT) | (found[:, 1:] < ESS).any(axis=1)


def diagnostics(draws: np.ndarray) -> np.ndarray:
    """R-hat, bulk and tail ESS (3,) of draws (chains, n); of a constant 1 and infinite."""
    found = np.array([rank_r_hat(draws), bulk_ess(draws), tail_ess(draws)])
    return np.where(np.isnan(found), [1.0, np.inf, np.inf], found)


def rank_r_hat(draws: np.ndarray) -> float:
    """The larger R-hat of ranks and of folded ranks, split chains; draws (chains, n)."""
    halves = _split(draws)
    return max(_r_hat(_ranked(halves)), _r_hat(_ranked(np.abs(halves - np.median(halves)))))


def bulk_ess(draws: np.ndarray) -> float:
    """Effective sample size of the ranks of split chains, draws (chains, n)."""
    return _ess(_ranked(_split(draws)))


def tail_ess(draws: np.ndarray) -> float:
    """The lesser effective sample size of the 5% and the 95% quantile, draws (chains, n); NaN
    where all draws are equal."""
    quantiles = np.quantile(draws, [0.05, 0.95])
    sizes = [_ess(_split(draws <= q).astype(float)) for q in quantiles]
    return float(np.nanmin(sizes)) if not np.isnan(sizes).all() else np.nan


def _ess(z: np.ndarray) -> float:
    """Effective sample size of chains (m, n) for their mean; NaN where nothing varies.

    Autocorrelations are summed up to where Geyer's pairs of them turn negative, made to fall
    (Geyer 1992, "Practical Markov chain Monte Carlo").
    """
    chains, n = z.shape
    centred = z - z.mean(axis=1, keepdims=True)
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, size, axis=1)) ** 2
    covariance = (np.fft.irfft(power, size, axis=1)[:, :n] / n).mean(axis=0)
    within = covariance[0] * n / (n - 1.0)
    total = covariance[0] + z.mean(axis=1).var(ddof=1)
    if not total > 0.0:
        return np.nan
    rho = 1.0 - (within - covariance) / total
    rho[0] = 1.0
    pairs = rho[: 2 * ((n - 1) // 2)].reshape(-1, 2).sum(axis=1)
    end = int(np.argmax(np.append(pairs[:-1] < 0.0, True)))
    falling = np.minimum.accumulate(pairs[:end])
    tau = -1.0 + 2.0 * float(falling.sum()) + max(float(rho[2 * end]), 0.0)
    return chains * n / max(tau, 1.0 / np.log10(chains * n))


def _split(draws: np.ndarray) -> np.ndarray:
    """Both halves of each chain, (2 chains, n // 2), without the middle draw of an odd number."""
    half = draws.shape[1] // 2
    return np.concatenate([draws[:, :half], draws[:, -half:]])


def _ranked(draws: np.ndarray) -> np.ndarray:
    """Normal scores of the ranks of all draws together, equal ones sharing their mean rank."""
    _, place, counts = np.unique(draws, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(counts) - 0.5 * (counts - 1.0)
    return ndtri((mean_rank[place.reshape(draws.shape)] - 0.375) / (draws.size + 0.25))


def _r_hat(z: np.ndarray) -> float:
    """R-hat of chains (m, n); NaN where nothing varies."""
    n = z.shape[1]
    within, between = z.var(axis=1, ddof=1).mean(), n * z.mean(axis=1).var(ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt((between / within + n - 1.0) / n))


@dataclass(frozen=True)
class PathMovement:
    """How the trajectories of a chain have moved, for one whose draws leave them out.

    waiting : draws of the warmup to come. draws : n since then. Of these for each experiment,
    (T, D): first, last; changed, how often a number was another than in the draw before; mean;
    square, the sum of squared distances from it.
    """

    waiting: int
    draws: int = 0
    first: Paths = ()
    last: Paths = ()
    changed: Paths = ()
    mean: Paths = ()
    square: Paths = ()

    @np.errstate(invalid="ignore", over="ignore")  # as in `movement`
    def after(self, paths: Sequence[np.ndarray]) -> PathMovement:
        """With one more draw (Welford 1962)."""
        if self.waiting:
            return replace(self, waiting=self.waiting - 1)
        new, n = tuple(p.copy() for p in paths), self.draws + 1
        if n == 1:
            none = tuple(np.zeros_like(p) for p in new)
            return PathMovement(0, 1, new, new, none, new, none)
        off = [x - m for x, m in zip(new, self.mean, strict=True)]
        mean = tuple(m + o / n for m, o in zip(self.mean, off, strict=True))
        apart = [x - m for x, m in zip(new, mean, strict=True)]
        square = tuple(s + o * a for s, o, a in zip(self.square, off, apart, strict=True))
        pairs = zip(self.changed, new, self.last, strict=True)
        changed = tuple(c + (x != before) for c, x, before in pairs)
        return PathMovement(0, n, self.first, new, changed, mean, square)


def update_rate_attributes(problem: Problem, result: Sequence[ChainDraws[Any]]) -> dict[str, Any]:
    """What goes to the attributes: the least rate over rows, and the warning, which is also given.

    The rate of a row is the share of successive draws between which some component changed that is
    not deterministic. A discrete state that the data determine need not change: its rows count
    where the chains differ besides. Where draws leave trajectories out, all that the chains have
    made count, which after an interrupt, or in a checkpoint that holds more, may be more draws than
    were asked for.
    """
    least, stuck = 1.0, []
    kept = "path_0" in result[0].draws
    draws = min(len(c.draws["path_0"]) if kept else c.state.path_movement.draws for c in result)
    if draws < 2:
        return {}
    for i, e in enumerate(problem.experiments):
        free, discrete = random_components(problem, e.steps)
        if kept:
            rate, ever, apart = movement([c.draws[f"path_{i}"] for c in result])
        else:
            rate, ever, apart = watched_movement([c.state.path_movement for c in result], i)
        # a continuous one that stands still is never right
        counted = free & (~discrete | (apart > STUCK_APART))
        varied = free & ever
        if (counted | varied).any():
            least = min(least, float(rate[counted | varied].min()))
        if draws >= FEWEST_FOR_RATES:
            rows = np.flatnonzero((counted & (rate < LOW)).any(axis=1))
            stuck += [(i, int(rows[0]) + 1, int(rows[-1]) + 1, len(rows))] if len(rows) else []
    if not stuck:
        return {"trajectory_update_rate": least}
    several = len(problem.experiments) > 1
    where = "; ".join(
        f"{n} rows from {first} to {last}" + (f" of experiment {i + 1}" if several else "")
        for i, first, last, n in stuck
    )
    text = (
        f"path degeneracy: {where} changed in fewer than {LOW:.0%} of the draws; those states, and "
        "parameters that depend on them, have not converged. Take more particles, or ssm.PMMH()"
    )
    warn(text)
    return {"trajectory_update_rate": least, "trajectory_warning": text}


def random_components(problem: Problem, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """(T, D) each: which components have a distribution of their own, and which of them are
    discrete."""
    trace = problem.trace
    place = {s: k for k, s in enumerate(trace.state_symbols)}
    free = np.zeros((steps, len(place)), dtype=bool)
    discrete = np.zeros((steps, len(place)), dtype=bool)
    roles: list[tuple[slice, Sequence[Site]]] = [
        (slice(0, 1), list(trace.initial.values())),
        (slice(1, None), list(trace.transition.values())),
    ]
    for rows, sites in roles:
        for site in sites:
            columns = [place[s] for s in site.components]
            free[rows, columns] = not isinstance(site.distribution, Dirac)
            discrete[rows, columns] = site.distribution.support().kind == "integers"
    return free, discrete


@np.errstate(invalid="ignore", over="ignore")  # of states that overflow, which say nothing here
def movement(paths: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Movement of each chain's draws (draws, T, D), which may lie on disk and are read in pieces:
    the share of successive draws that differ, whether any differ, and R-hat, 1 where draws are not
    finite; (T, D) each."""
    n, shape = len(paths[0]), paths[0].shape[1:]
    size = max(1, PIECE // max(1, len(paths) * paths[0][0].nbytes))
    changed, ever = np.zeros(shape, dtype=int), np.zeros(shape, dtype=bool)
    mean = square = np.zeros((len(paths), *shape))
    first, last = paths[0][:1], None
    for a in range(0, n, size):
        piece = np.stack([p[a : a + size] for p in paths])
        changed += (piece[:, 1:] != piece[:, :-1]).sum(axis=(0, 1))
        if last is not None:
            changed += (piece[:, 0] != last).sum(axis=0)
        last = piece[:, -1]
        ever |= (piece != first).any(axis=(0, 1))
        new = piece.mean(axis=1)
        m, off = piece.shape[1], new - mean  # (Chan, Golub and LeVeque 1983)
        square = square + piece.var(axis=1) * m + off**2 * (a * m / (a + m))
        mean = mean + off * (m / (a + m))
    return changed / (len(paths) * (n - 1)), ever, gelman_rubin(mean, square / (n - 1))


@np.errstate(invalid="ignore", over="ignore")
def watched_movement(
    watches: Sequence[PathMovement], i: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `movement`, of experiment i of chains that were watched."""
    changed = np.stack([w.changed[i] for w in watches])
    start = watches[0].first[i]
    ever = (changed > 0).any(axis=0) | np.any([w.first[i] != start for w in watches], axis=0)
    mean = np.stack([w.mean[i] for w in watches])
    variance = np.stack([w.square[i] / (w.draws - 1) for w in watches])
    pairs = sum(w.draws - 1 for w in watches)
    return changed.sum(axis=0) / pairs, ever, gelman_rubin(mean, variance)


def gelman_rubin(means: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """R-hat (T, D) of chains by their means and variances (chains, T, D) (Gelman and Rubin 1992);
    1 where nothing ever varied, infinite where chains stand still apart, and for one chain 1."""
    if len(means) < 2:
        return np.ones(means.shape[1:])
    within = variances.mean(axis=0)
    between = means.var(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(1.0 + between / within)
    return np.where(between > 0.0, ratio, 1.0)
