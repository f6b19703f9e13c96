"""Scalar states by a point-mass filter: densities on a grid of the state, sums for integrals.

The integrands are smooth and vanish at both ends of the grid, so that the sums converge faster than
any power of the spacing; that they have converged is checked by a second grid, half as fine. Laws
are SciPy's, written down here once more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy import stats

import ssmppl as ssm
from examples.check.rows import (
    Estimate,
    Row,
    check,
    files,
    log_likelihood,
    posterior_mean,
    stated,
)


def point_mass(
    x: np.ndarray,
    initial: np.ndarray,
    move: Callable[[int], np.ndarray],
    log_g: np.ndarray,
) -> float:
    """log p(y) on a grid x (K,): initial density (K,), move(t) density (K, K) of x_t (rows) given
    x_{t-1} (columns), log_g (T, K) log density of y_t, zero where it is missing."""
    h = x[1] - x[0]
    p, total = initial, 0.0
    for t in range(len(log_g)):
        if t:
            p = move(t) @ p * h
        top = log_g[t].max()
        p = p * np.exp(log_g[t] - top)
        mass = p.sum() * h
        total += top + np.log(mass)
        p = p / mass
    return float(total)


def converged(filter_on: Callable[[int], float], points: int) -> Estimate:
    """The value on a grid of so many points, once half as many give it to 1e-6."""
    coarse, fine = filter_on(points // 2), filter_on(points)
    if abs(coarse - fine) > 1e-6 * max(1.0, abs(fine)):
        raise RuntimeError(f"{points} points are too few: {coarse!r} with half of them, {fine!r}")
    return Estimate(fine)


@check("stochastic_volatility")
def stochastic_volatility() -> Iterator[Row]:
    theta = {"drift": 0.05, "alpha": -0.07, "phi": 0.94, "psi": -0.24, "omega": 0.11}
    drift, alpha, phi, psi, omega = theta.values()
    y = files("stochastic_volatility")[1][0]["y"].to_numpy()

    def on(points: int) -> float:
        x = np.linspace(-8.0, 8.0, points)
        scale = np.exp(x / 2)

        def move(t: int) -> np.ndarray:
            mean = alpha + phi * x + psi * (y[t - 1] - drift) / scale
            return stats.norm.pdf(x[:, None], mean[None, :], np.sqrt(omega))

        log_g = stats.norm.logpdf(y[:, None], drift, scale)
        return point_mass(x, stats.norm.pdf(x, 0.0, 2.0), move, log_g)

    yield Row(
        "stochastic_volatility", stated(theta), "particles", "point-mass filter",
        log_likelihood("stochastic_volatility", theta, particles=2000, repeats=40),
        converged(on, 321),
    )  # fmt: skip


@check("ricker")
def ricker() -> Iterator[Row]:
    theta = {"log_r": 3.8, "q": 0.09, "phi": 10.0}
    log_r, q, phi = theta.values()
    y = files("ricker")[1][0]["y"].to_numpy(dtype=float)

    def on(points: int) -> float:
        # below -40 a population takes ten years to recover, and none was unseen for as long
        x = np.linspace(-40.0, 4.6, points)
        move = stats.norm.pdf(x[:, None], x + log_r - np.exp(x), np.sqrt(q))
        seen = stats.poisson.logpmf(np.nan_to_num(y)[:, None], phi * np.exp(x))
        log_g = np.where(np.isnan(y)[:, None], 0.0, seen)
        return point_mass(x, stats.norm.pdf(x, 0.0, 1.0), lambda t: move, log_g)

    yield Row(
        "ricker", stated(theta), "particles", "point-mass filter",
        log_likelihood("ricker", theta, particles=2000, repeats=20), converged(on, 4461),
    )  # fmt: skip


def coal_mines_log_likelihood(q: float, points: int) -> float:
    y = files("coal_mines")[1][0]["y"].to_numpy()
    x = np.linspace(-6.0, 5.0, points)
    move = stats.norm.pdf(x[:, None], x, np.sqrt(q))
    log_g = stats.poisson.logpmf(y[:, None], np.exp(x))
    return point_mass(x, stats.norm.pdf(x, 1.0, 1.0), lambda t: move, log_g)


@check("coal_mines")
def coal_mines() -> Iterator[Row]:
    theta = {"q": 0.05}
    yield Row(
        "coal_mines", stated(theta), "particles", "point-mass filter",
        log_likelihood("coal_mines", theta, particles=2000, repeats=20),
        converged(lambda points: coal_mines_log_likelihood(0.05, points), 401),
    )  # fmt: skip

    # on log q, where the posterior is nearly symmetric: the Jacobian is q
    q = np.exp(np.linspace(np.log(0.003), np.log(1.0), 61))
    log_p = [coal_mines_log_likelihood(v, 401) + stats.invgamma.logpdf(v, 2, scale=0.05) for v in q]
    weight = np.exp(np.array(log_p) + np.log(q) - max(log_p))
    model, data = files("coal_mines")
    idata = ssm.sample(
        model, data, ssm.PGAS(), draws=1000, warmup=300, thin=4, chains=2, states=False, seed=1,
        progress=False,
    )  # fmt: skip
    yield Row(
        "coal_mines", "posterior mean of q", "PGAS", "point-mass filter, quadrature",
        posterior_mean(idata, "q"), Estimate(float(weight @ q / weight.sum())),
    )  # fmt: skip


@check("ice_varves")
def ice_varves() -> Iterator[Row]:
    theta = {"phi": 0.95, "tau": 46.0}
    phi, tau = theta.values()
    y = files("ice_varves")[1][0]["y"].to_numpy()

    def on(points: int) -> float:
        x = np.linspace(-4.0, 4.0, points)
        move = stats.norm.pdf(x[:, None], phi * x, tau**-0.5)
        log_g = stats.gamma.logpdf(y[:, None], 6.25, scale=np.exp(x) / 0.256)
        start = stats.norm.pdf(x, 0.0, ((1 - phi**2) * tau) ** -0.5)
        return point_mass(x, start, lambda t: move, log_g)

    yield Row(
        "ice_varves", stated(theta), "particles", "point-mass filter",
        log_likelihood("ice_varves", theta, particles=1000, repeats=20), converged(on, 401),
    )  # fmt: skip
