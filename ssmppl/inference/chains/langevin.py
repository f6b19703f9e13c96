"""Gradient-informed proposals of particle Metropolis-Hastings.

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

from dataclasses import dataclass

import numpy as np

from ssmppl.inference.chains.coordinates import Coordinates, chart
from ssmppl.inference.chains.walk import ADAPTATION_POWER, Point, Run

LEAST, MOST = 0.2, 5.0  # eigenvalues of the information, in units of the pilot's
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
    return factor @ (vectors / np.sqrt(np.clip(np.abs(values), LEAST, MOST)))


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
