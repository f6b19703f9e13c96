"""Whether the chains of the parameters have mixed, and a warning where they have not.

A. Vehtari, A. Gelman, D. Simpson, B. Carpenter and P.-C. Bürkner, "Rank-normalization, folding, and
localization: an improved R-hat for assessing convergence of MCMC", *Bayesian Analysis* 16 (2021):
R-hat of split chains, equations (1) to (4), of the ranks and of those of distances from the median
(section 4.2), and the effective sample size of the ranks (section 4.1 with equations (8) to (11)).
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.special import ndtri

from ssmppl.inference.methods import PMMH, Gibbs, Method, MetropolisHastings

APART = 1.05  # R-hat above which there is a warning: no other number of a run then means anything
FEW = 100.0  # bulk ESS of all chains below which R-hat itself is not to be trusted
LEAST_CHAINS, FEWEST = 2, 100  # chains, and draws of each, from which that can be told


def told(
    labels: list[str], draws: np.ndarray, interrupted: bool, method: Method, warmup: int
) -> dict[str, str]:
    """What goes to the attributes: nothing, or the warning, which is also given.

    labels, draws : of the P free components, (chains, draws, P). Trials of fewer than `FEWEST`
    draws and runs that were interrupted have none: they are known to be short.
    """
    chains, n, _ = draws.shape
    if interrupted or chains < LEAST_CHAINS or n < FEWEST or not labels:
        return {}
    found = np.array([(rank_r_hat(c), bulk_ess(c)) for c in np.moveaxis(draws, 2, 0)])
    r_hat, ess = np.where(np.isnan(found), [1.0, np.inf], found).T  # NaN: a constant
    bad = (r_hat > APART) | (ess < FEW)
    if not bad.any():
        return {}
    apart = bool((r_hat > APART).any())
    worst = int(np.argmax(r_hat) if apart else np.argmin(ess))
    others = int(bad.sum()) - 1
    text = (
        ("the chains have not mixed" if apart else "the chains hold too few independent draws")
        + f": R-hat of {labels[worst]} is {r_hat[worst]:.3g}, its bulk ESS {ess[worst]:.3g}"
        + (f"; {others} other parameters are like it" if others > 1 else "")
        + ("; one other parameter is like it" if others == 1 else "")
        + f". R-hat has to be below {APART:g} and the ESS at least {FEW:g} before means and "
        f"intervals are used. Take more draws (there were {n} of each chain) and warmup ({warmup})"
        + _instead(method)
    )
    warnings.warn(text, stacklevel=3)
    return {"mixing_warning": text}


def _instead(method: Method) -> str:
    """What else can be done."""
    name = type(method).__name__
    if getattr(method, "interweave", "auto") is False:
        return f', or ssm.{name}(interweave="auto")'
    if isinstance(method, (Gibbs, MetropolisHastings)):
        other = "MetropolisHastings" if isinstance(method, Gibbs) else "Gibbs"
        return f", or another method, such as ssm.{other}()"
    other = 'PGAS(interweave="auto")' if isinstance(method, PMMH) else "PMMH()"
    return f", more particles, or another method, such as ssm.{other}"


def rank_r_hat(draws: np.ndarray) -> float:
    """The larger R-hat of ranks and of folded ranks, split chains; draws (chains, n)."""
    halves = _split(draws)
    return max(_r_hat(_ranked(halves)), _r_hat(_ranked(np.abs(halves - np.median(halves)))))


def bulk_ess(draws: np.ndarray) -> float:
    """Effective sample size of the ranks of split chains, draws (chains, n).

    Autocorrelations are summed up to where Geyer's pairs of them turn negative, made to fall
    (Geyer 1992, "Practical Markov chain Monte Carlo").
    """
    z = _ranked(_split(draws))
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
    """Of chains (m, n); NaN where nothing varies."""
    n = z.shape[1]
    within, between = z.var(axis=1, ddof=1).mean(), n * z.mean(axis=1).var(ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt((between / within + n - 1.0) / n))
