"""The exact marginal posteriors of the ice varves, for the curves in the docs.

    python -m tests.statistics.varve_posterior

writes docs/figures/varves_posterior.csv: the densities of phi and tau under the priors of Schön et
al. (2015), by the point-mass filter of `exact.py` on a grid in (atanh phi, log tau), where the
trapezoidal rule converges fast.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ssmppl.datasets import ice_varves

from .exact import varve_log_likelihood

TABLE = Path(__file__).parents[2] / "docs" / "figures" / "varves_posterior.csv"
POINTS = 64
ATANH_PHI, LOG_TAU = (0.7, 4.3), (1.8, 6.4)  # the posterior ends within, see the edge's mass


def marginals(points: int = POINTS) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(phi, density, tau, density), each (points,)."""
    y = ice_varves()
    z = np.linspace(*ATANH_PHI, points)
    v = np.linspace(*LOG_TAU, points)
    phi, tau = np.tanh(z), np.exp(v)
    log_p = np.empty((points, points))
    for i in range(points):
        for j in range(points):
            log_p[i, j] = varve_log_likelihood(y, phi[i], tau[j], points=240)
    log_p += -0.99 * v - 0.01 * tau  # Gamma(0.01, rate 0.01) in tau; phi is uniform
    log_p += np.log1p(-(phi**2))[:, None] + v  # Jacobians
    p = np.exp(log_p - log_p.max())
    edge = max(p[0].max(), p[-1].max(), p[:, 0].max(), p[:, -1].max())
    assert edge < 1e-5, f"the grid cuts the posterior off at {edge:.1e} of its height"
    p /= p.sum() * (z[1] - z[0]) * (v[1] - v[0])
    of_phi = p.sum(axis=1) * (v[1] - v[0]) / (1 - phi**2)
    of_tau = p.sum(axis=0) * (z[1] - z[0]) / tau
    return phi, of_phi, tau, of_tau


def main() -> None:
    phi, of_phi, tau, of_tau = marginals()
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("phi", "density_of_phi", "tau", "density_of_tau"))
        for row in zip(phi, of_phi, tau, of_tau, strict=True):
            writer.writerow(f"{value:.9g}" for value in row)


if __name__ == "__main__":
    main()
