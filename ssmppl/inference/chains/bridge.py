"""Bridge sampling: the normalising constant of a density from draws of it and of another one.

Meng and Wong (1996), with their optimal bridge found by iteration; the relative error is that of
Frühwirth-Schnatter (2004), *Econometrics Journal* 7, equation 16, the autocorrelation of the draws
taken in by their effective sample size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

from ssmppl.errors import SamplingError
from ssmppl.inference.particles.filtering import log_of_mean

TOLERANCE = 1e-10
MOST_ITERATIONS = 1000
DEGREES = 7.0  # of freedom of the law bridged to: tails heavier than a posterior's


@dataclass(frozen=True)
class Bridge:
    """log r, r the normalising constant, and the standard error of log r."""

    log_constant: float
    standard_error: float


def bridge(own: np.ndarray, other: np.ndarray) -> Bridge:
    """log of the constant r of p = p~ / r, from log ratios l = log p~ - log q.

    Parameters
    ----------
    own : (chains, draws) l at draws of p, each row one Markov chain.
    other : (n,) l at independent draws of q; -inf where p~ is zero.
    """
    effective = _effective(own, own)
    n, total = other.size, effective + other.size
    log_s1, log_s2 = np.log(effective / total), np.log(n / total)
    first = own.ravel()
    log_r = float(np.median(first))
    for _ in range(MOST_ITERATIONS):
        top = logsumexp(other - np.logaddexp(log_s1 + other, log_s2 + log_r)) - np.log(n)
        bottom = logsumexp(-np.logaddexp(log_s1 + first, log_s2 + log_r)) - np.log(first.size)
        change = float(top - bottom) - log_r
        log_r += change
        if abs(change) < TOLERANCE:
            break
    of_other = np.exp(other - np.logaddexp(log_s1 + other, log_s2 + log_r))  # p / (s1 p + s2 q)
    of_own = np.exp(log_r - np.logaddexp(log_s1 + own, log_s2 + log_r))  # q / (s1 p + s2 q)
    error = _relative_variance(of_other) / n
    error += _relative_variance(of_own) / _effective(of_own, own)
    return Bridge(log_r, float(np.sqrt(error)))


def importance(other: np.ndarray) -> Bridge:
    """The same constant from the draws of q alone: exp(log_constant) is unbiased for r."""
    return Bridge(*log_of_mean(other))


@dataclass(frozen=True)
class Student:
    """The distribution bridged to, a multivariate t: location (d,), factor (d, d) of its scale
    matrix."""

    location: np.ndarray
    factor: np.ndarray

    @classmethod
    def fitted(cls, points: np.ndarray) -> Student:
        """The one with the mean and covariance of points (n, d), a little wider.

        Raises
        ------
        SamplingError : the points span no volume, as those of chains that did not move.
        """
        n, d = points.shape
        distinct = len(np.unique(points, axis=0))
        if distinct <= d or not np.all(np.ptp(points, axis=0) > 0.0):
            raise SamplingError(
                "the distribution that the draws are compared with cannot be fitted: among the "
                f"first {n} of them, {distinct} differ, in {d} free "
                f"parameter{'s' if d > 1 else ''}",
                fix="give more draws= and warmup=, or more particles; or method=ssm.SMC2(), which "
                "needs no such distribution",
            )
        covariance = np.atleast_2d(np.cov(points.T))
        scale = covariance + 1e-10 * np.diag(np.diag(covariance) + 1e-300)
        return cls(points.mean(axis=0), np.linalg.cholesky(scale))

    def log_density(self, points: np.ndarray) -> np.ndarray:
        d = len(self.location)
        u = np.linalg.solve(self.factor, (points - self.location).reshape(-1, d).T)
        with np.errstate(over="ignore"):  # so far off that the density is zero
            square = np.sum(u**2, axis=0).reshape(points.shape[:-1])
        log_norm = gammaln((DEGREES + d) / 2) - gammaln(DEGREES / 2)
        log_norm -= 0.5 * d * np.log(DEGREES * np.pi) + np.log(np.diag(self.factor)).sum()
        return log_norm - 0.5 * (DEGREES + d) * np.log1p(square / DEGREES)

    def draw(self, generator: np.random.Generator, n: int) -> np.ndarray:
        normal = generator.standard_normal((n, len(self.location)))
        mixing = np.sqrt(DEGREES / generator.chisquare(DEGREES, n))
        return self.location + mixing[:, None] * (normal @ self.factor.T)


def _relative_variance(values: np.ndarray) -> float:
    return float(np.var(values, ddof=1) / np.mean(values) ** 2)


def _effective(values: np.ndarray, chains: np.ndarray) -> float:
    """Effective sample size of the mean of `values`, at most the number of draws."""
    import arviz as az

    found = float(az.ess(np.ascontiguousarray(values), method="mean"))
    return min(found, float(chains.size)) if np.isfinite(found) else float(chains.size)
