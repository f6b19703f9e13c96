"""A driven pendulum of which the angle is measured: 700 rows, 2 states, 4 parameters, in one step a
row or in ten small ones."""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np
from scipy.optimize import minimize

import ssmppl as ssm

from .question import (
    OWN,
    Answer,
    Program,
    Question,
    Run,
    below,
    distant,
    estimated,
    posterior,
    sampled,
    unmixed,
)

ROWS, SECONDS = 700, 0.05  # seconds a row
TRUTH = {"k": 9.0, "d": 0.5, "s": 0.04, "r": 0.01}
PRIORS = {"k": 20.0, "d": 2.0, "s": 1.0, "r": 1.0}  # scales of half-normal laws
START = np.log([5.0, 0.2, 0.1, 0.05])  # where the filter by hand begins to climb
CHAINS, DRAWS = 2, 1_000


def series() -> dict[str, np.ndarray]:
    """Angles y (700,) in radians of the pendulum in ten steps a row, and torques u (700,)."""
    rng = np.random.default_rng(1)
    k, d, s, r = TRUTH.values()
    u = np.repeat(rng.uniform(-4, 4, ROWS), rng.integers(10, 40, ROWS))[:ROWS]
    y, q, v = np.empty(ROWS), 0.0, 0.0
    for t in range(ROWS):
        y[t] = q + r * rng.normal()
        for _ in range(10):
            q, v = _step(q, v, u[t], k, d, SECONDS / 10)
        v += s * rng.normal()
    return {"y": y, "u": u}


def _step(q, v, u, k, d, h):
    """One step of length h, angle and rate."""
    a = u - k * np.sin(q) - d * v
    return q + h * v + 0.5 * h * h * a, v + h * a


def model(steps: int) -> ssm.Model:
    """The pendulum in so many steps a row, written as a loop."""
    made, h = ssm.Model(f"pendulum in {steps} steps", inputs=("u",)), SECONDS / steps

    @made.prior
    def prior():
        return {name: ssm.HalfNormal(sd=sd) for name, sd in PRIORS.items()}

    @made.initial
    def initial():
        return {"q": ssm.Normal(0, sd=0.2), "v": ssm.Normal(0, sd=0.2)}

    @made.transition
    def transition(q, v, u, k, d, s):
        for _ in range(steps):
            q, v = _step(q, v, u, k, d, h)
        return {"q": ssm.Dirac(q), "v": ssm.Normal(v, sd=s)}

    @made.observation
    def observation(q, r):
        return {"y": ssm.Normal(q, sd=r)}

    return made


@numba.njit(cache=True)
def extended(log_theta: np.ndarray, y: np.ndarray, u: np.ndarray, steps: int) -> float:
    """Log-likelihood by an extended Kalman filter, as one would write it for this model by hand."""
    k, d, s, r = np.exp(log_theta)
    h, total = SECONDS / steps, 0.0
    q, v, pqq, pqv, pvv = 0.0, 0.0, 0.04, 0.0, 0.04
    for t in range(len(y)):
        f, e = pqq + r * r, y[t] - q
        total -= 0.5 * (np.log(2 * np.pi * f) + e * e / f)
        q, v = q + pqq / f * e, v + pqv / f * e
        pqq, pqv, pvv = pqq - pqq * pqq / f, pqv - pqq * pqv / f, pvv - pqv * pqv / f
        for _ in range(steps):
            a, aq = u[t] - k * np.sin(q) - d * v, -k * np.cos(q)
            fqq, fqv = 1 + 0.5 * h * h * aq, h - 0.5 * h * h * d
            fvq, fvv = h * aq, 1 - h * d
            q, v = q + h * v + 0.5 * h * h * a, v + h * a
            aqq, aqv = fqq * pqq + fqv * pqv, fqq * pqv + fqv * pvv
            avq, avv = fvq * pqq + fvv * pqv, fvq * pqv + fvv * pvv
            pqq, pqv, pvv = aqq * fqq + aqv * fqv, aqq * fvq + aqv * fvv, avq * fvq + avv * fvv
        pvv += s * s
    return total


def own_maximum(steps: int) -> Run:
    made, data = model(steps), series()
    return lambda seed: estimated(ssm.maximize(made, data, seed=seed, progress=False))


def maximum_by_hand(steps: int) -> Run:
    """The filter by hand, Nelder and Mead's method on the logarithms, and differences for the
    information."""
    data = series()
    y, u = data["y"], data["u"]

    def run(seed: int) -> Answer:
        settings = {"xatol": 1e-5, "fatol": 1e-7, "maxiter": 4_000, "maxfev": 4_000}
        found = minimize(
            lambda z: -extended(z, y, u, steps), START, method="Nelder-Mead", options=settings
        )
        theta = np.exp(found.x)
        errors = np.sqrt(np.diag(_covariance(found.x, y, u, steps))) * theta
        return Answer(
            {name: (float(a), float(b)) for name, a, b in zip(TRUTH, theta, errors, strict=True)},
            {"log-likelihood": -float(found.fun)},
        )

    return run


def _covariance(z: np.ndarray, y: np.ndarray, u: np.ndarray, steps: int) -> np.ndarray:
    """The inverse of the observed information of log theta, by central differences (4, 4)."""
    n, h = len(z), 1e-3 * np.eye(len(z))
    at = lambda *moves: extended(z + sum(moves, np.zeros(n)), y, u, steps)  # noqa: E731
    information = np.array([
        [-(at(a, b) - at(a, -b) - at(-a, b) + at(-a, -b)) / 4e-6 for b in h] for a in h
    ])  # fmt: skip
    return np.linalg.inv(information)


def maximum_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where it is a quarter of a standard error from the filter by hand, which is an approximation
    too, but a close one: the noise of a row is too small for the sine to bend."""
    out: list[str] = []
    for other in others.values():
        out += below(own, float(other.remarks["log-likelihood"]), 0.2)
        out += distant(own, {name: v for name, (v, _) in other.estimates.items()}, 0.25)
        for name, (_, error) in other.estimates.items():
            if not abs(own.estimates[name][1] / error - 1) <= 0.15:
                out.append(f"the standard error of {name} is {own.estimates[name][1]:.3g}, "
                           f"by hand {error:.3g}")  # fmt: skip
    return out


def own_posterior() -> Run:
    made, data = model(1), series()
    return lambda seed: sampled(
        ssm.sample(made, data, chains=CHAINS, draws=DRAWS, seed=seed, progress=False), list(TRUTH)
    )


@numba.njit(cache=True)
def _chain(z, moves, levels, y, u, steps):
    """Random walk Metropolis on log theta (4,) from z, by moves (draws, 4) and the logarithms
    (draws,) of uniform numbers: log theta (draws, 4)."""
    scales = np.array([20.0, 2.0, 1.0, 1.0])  # of the priors
    out, value = np.empty_like(moves), -np.inf
    for i in range(len(moves)):
        new = z + moves[i]
        there = extended(new, y, u, steps) + new.sum()
        there -= 0.5 * ((np.exp(new) / scales) ** 2).sum()
        if levels[i] < there - value:
            z, value = new, there
        out[i] = z
    return out


def posterior_by_hand() -> Run:
    """The filter by hand in a random walk, its steps by the information at the maximum."""
    maximum, data = maximum_by_hand(1), series()
    y, u = data["y"], data["u"]

    def run(seed: int) -> Answer:
        top = np.log([value for value, _ in maximum(seed).estimates.values()])
        covariance = _covariance(top, y, u, 1)
        root, rng = np.linalg.cholesky(covariance) * 2.38 / 2.0, np.random.default_rng(seed)
        chains = np.stack([
            _chain(top, rng.normal(size=(10 * DRAWS, 4)) @ root.T,
                   np.log(rng.uniform(size=10 * DRAWS)), y, u, 1)
            for _ in range(CHAINS)
        ])  # fmt: skip
        return posterior({n: np.exp(chains[..., i]) for i, n in enumerate(TRUTH)})

    return run


def posterior_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where R-hat is above 1.01, or a mean a quarter of a standard deviation from that by hand."""
    out = unmixed(own, 1.01)
    for other in others.values():
        out += distant(own, {name: v for name, (v, _) in other.estimates.items()}, 0.25)
    return out


def _maximum(key: str, steps: int, words: str, goal: float) -> Question:
    return Question(
        key, f"pendulum, 2 states, 4 parameters, 700 rows, {words} a row: maximum likelihood", goal,
        (
            Program(OWN, lambda: own_maximum(steps)),
            Program("extended filter and Nelder-Mead by hand, Numba",
                    lambda: maximum_by_hand(steps)),
        ),
        maximum_faults,
    )  # fmt: skip


QUESTIONS = [
    _maximum("pendulum-one-step", 1, "one step", 0.5),
    _maximum("pendulum-ten-steps", 10, "ten small steps", 1.0),
    Question(
        "pendulum-posterior", "pendulum, one step a row: `sample`, 2 x 1,000 draws", 20.0,
        (
            Program(OWN, own_posterior),
            Program("extended filter and Metropolis by hand, Numba, 2 x 10,000 draws",
                    posterior_by_hand),
        ),
        posterior_faults,
    ),
]  # fmt: skip
