"""Sums at many points at once, part by part: what their slopes tell of second derivatives.

Of a log-likelihood whose increments are known row by row the outer products of their slopes come
near minus its second derivatives (Berndt, Hall, Hall and Hausman, *Annals of Economic and Social
Measurement* 3, 1974), and far from the top they can be many times too large. Where increments are
log densities of Gaussian predictions there is better: the expected information that these carry,
by the slopes of their means and covariances (N. Gupta and R. Mehra, *IEEE Transactions on Automatic
Control* 19, 1974), which is as good there as at the top.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.inference.optimisation.newton import NO_VALUE


@dataclass(frozen=True)
class Predictions:
    """Gaussian predictions of R rows of K channels at B points: error (B, R, K), measured less
    predicted, and covariance (B, R, K, K); 0 and of the identity in what was not measured."""

    error: np.ndarray
    covariance: np.ndarray

    def __getitem__(self, index: slice | np.ndarray) -> Predictions:
        return Predictions(self.error[index], self.covariance[index])


@dataclass(frozen=True)
class Parts:
    """The parts of a sum at B points.

    rows : (B, R + 1) the R increments of a log-likelihood, and the log prior density, which is no
    increment; -inf in all of them where there is no value. predictions : whose log densities the
    increments are, at least about; None: they are no Gaussian ones.
    """

    rows: np.ndarray
    predictions: Predictions | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: slice) -> Parts:
        own = self.predictions
        return Parts(self.rows[index], None if own is None else own[index])

    def information(self, h: np.ndarray, bent: np.ndarray) -> np.ndarray:
        """(F, F) about minus the second derivatives of the sum, of parts at a point and beside it
        (1 + F), or at both sides of it (1 + 2 F), steps `h` (F,) away. bent : (F,) those of the
        last part. What has no value tells nothing."""
        none = summed(self) == -np.inf
        slopes = None if self.predictions is None else _whitened_slopes(self.predictions, h, none)
        if slopes is None:
            slopes = _slopes(self.rows, h, none)[:, :-1]
        found: np.ndarray = slopes @ slopes.T
        return found + np.diag(bent)

    def bent(self, h: np.ndarray) -> np.ndarray:
        """(F,) minus the second differences of the last part, of parts (1 + 2 F) at a point and at
        both sides of it; 0 where they are not positive."""
        n, last = len(h), self.rows[:, -1]
        with np.errstate(invalid="ignore"):
            found = (2.0 * last[0] - last[1 : n + 1] - last[n + 1 :]) / h**2
        return np.where(found > 0.0, found, 0.0)


# (B, P) parameter vectors -> (B, R) increments of the log-likelihood, or these and the predictions.
Increments = Callable[[np.ndarray], np.ndarray | tuple[np.ndarray, Predictions | None]]


def summed(values: np.ndarray | Parts) -> np.ndarray:
    """(B,) of values, or of sums by their parts; -inf where a part is none, or the sum is next to
    overflow."""
    with np.errstate(all="ignore"):
        total = values.rows.sum(axis=1) if isinstance(values, Parts) else values
        return np.where(np.abs(total) < NO_VALUE, total, -np.inf)


def parts_of(increments: Increments, theta: np.ndarray, log_prior: np.ndarray) -> Parts:
    """Those at theta (B, P), with the log prior density (B,); no values where that is -inf."""
    inside = log_prior > -np.inf
    if not inside.any():
        return Parts(np.full((len(theta), 1), -np.inf))
    found = increments(theta[inside])
    rows, predictions = found if isinstance(found, tuple) else (found, None)
    out = np.full((len(theta), rows.shape[1] + 1), -np.inf)
    out[inside] = np.column_stack([rows, log_prior[inside]])
    if predictions is not None and not inside.all():
        known = np.cumsum(inside) - 1  # where there are none: those of another, never looked at
        predictions = predictions[np.maximum(known, 0)]
    return Parts(out, predictions)


def _slopes(values: np.ndarray, h: np.ndarray, none: np.ndarray) -> np.ndarray:
    """(F, ...) of values (1 + F, ...) or (1 + 2 F, ...), on one side where the other has none; 0
    where neither has. none : (B,) bool, where there is none whatever it is."""
    n = len(h)
    if none.any():
        values = np.where(none.reshape(-1, *(1 for _ in values.shape[1:])), np.nan, values)
    middle, up, down = values[0], values[1 : n + 1], values[n + 1 :]
    step = h.reshape(-1, *(1 for _ in middle.shape))
    with np.errstate(invalid="ignore"):
        slopes = (up - middle) / step
        if len(down):
            one_sided = np.where(np.isfinite(slopes), slopes, (middle - down) / step)
            slopes = (up - down) / (2.0 * step)
            slopes = np.where(np.isfinite(slopes), slopes, one_sided)
    return np.where(np.isfinite(slopes), slopes, 0.0)


def _whitened_slopes(p: Predictions, h: np.ndarray, none: np.ndarray) -> np.ndarray | None:
    """(F, R (K + K^2)) whose products are the expected information; None where a covariance has no
    root. Of a row it is de' S^-1 de + tr(S^-1 dS S^-1 dS) / 2."""
    try:
        root = np.linalg.inv(np.linalg.cholesky(p.covariance[0]))
    except np.linalg.LinAlgError:
        return None
    mean = np.einsum("rij,frj->fri", root, _slopes(p.error, h, none))
    spread = root @ _slopes(p.covariance, h, none) @ root.transpose(0, 2, 1) / np.sqrt(2.0)
    n, rows, channels = mean.shape
    out = np.concatenate(
        [mean.reshape(n, rows * channels), spread.reshape(n, rows * channels**2)], axis=1
    )
    return out if np.all(np.isfinite(out)) else None


def split(values: np.ndarray | Parts, sizes: Sequence[int]) -> list[np.ndarray | Parts]:
    """The values of each of some sets of points, which follow each other."""
    ends = np.cumsum(sizes)
    return [values[end - size : end] for end, size in zip(ends, sizes, strict=True)]
