"""A hundred short series of counts that share three parameters: 2,500 rows."""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

import ssmppl as ssm

from .question import OWN, Answer, Program, Question, Run, distant, posterior, sampled, unmixed

SERIES, ROWS = 100, 25
TRUTH = {"level": 1.0, "phi": 0.8, "sd": 0.4}
CHAINS, DRAWS = 2, 500
NAMES = tuple(TRUTH)


def series() -> np.ndarray:
    """Counts (100, 25) whose log rate is an autoregression about a level."""
    rng = np.random.default_rng(5)
    level, phi, sd = TRUTH.values()
    x, y = sd / np.sqrt(1 - phi**2) * rng.normal(size=SERIES), np.empty((SERIES, ROWS))
    for t in range(ROWS):
        y[:, t] = rng.poisson(np.exp(level + x))
        x = phi * x + sd * rng.normal(size=SERIES)
    return y


def model() -> ssm.Model:
    made = ssm.Model("short counts")

    @made.prior
    def prior():
        return {
            "level": ssm.Normal(0, sd=2), "phi": ssm.Uniform(-1, 1), "sd": ssm.HalfNormal(sd=1)
        }  # fmt: skip

    @made.initial
    def initial(phi, sd):
        return {"x": ssm.Normal(0, variance=sd**2 / (1 - phi**2))}

    @made.transition
    def transition(x, phi, sd):
        return {"x": ssm.Normal(phi * x, sd=sd)}

    @made.observation
    def observation(x, level):
        return {"y": ssm.Poisson(np.exp(level + x))}

    return made


def own() -> Run:
    made, data = model(), [{"y": row} for row in series()]
    return lambda seed: sampled(
        ssm.sample(made, data, chains=CHAINS, draws=DRAWS, seed=seed, progress=False), NAMES
    )


@numba.njit(cache=True)
def laplace(z, y, constant):
    """Log posterior density of z = (level, atanh phi, log sd), the states out by Laplace's
    approximation: Newton's method on each series, its precision tridiagonal."""
    level, phi, sd = z[0], np.tanh(z[1]), np.exp(z[2])
    tau, steps = 1 / sd**2, y.shape[1]
    x, pivot, gain = np.zeros(steps), np.empty(steps), np.empty(steps)
    total = -0.125 * level**2 + np.log1p(-(phi**2)) - 0.5 * sd**2 + z[2] - constant
    for i in range(len(y)):
        for _ in range(50):
            for t in range(steps):
                inner = 0 < t < steps - 1
                diagonal = tau * (1 + phi**2 if inner else 1.0)
                pull = -diagonal * x[t]
                if t:
                    pull += tau * phi * x[t - 1]
                if t < steps - 1:
                    pull += tau * phi * x[t + 1]
                rate = np.exp(level + x[t])
                pivot[t], gain[t] = diagonal + rate, pull + y[i, t] - rate
            for t in range(1, steps):
                share = -tau * phi / pivot[t - 1]
                pivot[t] += share * tau * phi
                gain[t] -= share * gain[t - 1]
            largest, after = 0.0, 0.0
            for t in range(steps - 1, -1, -1):
                after = (gain[t] + tau * phi * after) / pivot[t]
                x[t] += after
                largest = max(largest, abs(after))
            if largest < 1e-8:
                break
        total += 0.5 * np.log1p(-(phi**2)) + 0.5 * steps * np.log(tau)
        total -= 0.5 * tau * (1 - phi**2) * x[0] ** 2
        for t in range(steps):
            if t:
                total -= 0.5 * tau * (x[t] - phi * x[t - 1]) ** 2
            total += y[i, t] * (level + x[t]) - np.exp(level + x[t]) - 0.5 * np.log(pivot[t])
    return total


@numba.njit(cache=True)
def _chain(z, moves, levels, y, constant):
    out, value = np.empty_like(moves), -np.inf
    for i in range(len(moves)):
        new = z + moves[i]
        there = laplace(new, y, constant)
        if levels[i] < there - value:
            z, value = new, there
        out[i] = z
    return out


def by_hand() -> Run:
    """Laplace's approximation by hand and a random walk, its steps by differences at the mode."""
    y = series()
    constant = float(gammaln(y + 1).sum())

    def run(seed: int) -> Answer:
        top = minimize(lambda z: -laplace(z, y, constant), np.zeros(3), method="Nelder-Mead").x
        h, none = 1e-2 * np.eye(3), np.zeros(3)
        at = lambda *moves: laplace(top + sum(moves, none), y, constant)  # noqa: E731
        information = np.array([
            [-(at(a, b) - at(a, -b) - at(-a, b) + at(-a, -b)) / 4e-4 for b in h] for a in h
        ])  # fmt: skip
        root = np.linalg.cholesky(np.linalg.inv(information)) * 2.38 / np.sqrt(3)
        rng, n = np.random.default_rng(seed), 4 * DRAWS
        chains = np.stack([
            _chain(top, rng.normal(size=(n, 3)) @ root.T, np.log(rng.uniform(size=n)), y, constant)
            for _ in range(CHAINS)
        ])  # fmt: skip
        natural = (chains[..., 0], np.tanh(chains[..., 1]), np.exp(chains[..., 2]))
        return posterior(dict(zip(NAMES, natural, strict=True)))

    return run


def faults(found: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where R-hat is above 1.01, or a mean 0.4 standard deviations from that of Laplace's
    approximation, which has an error of its own."""
    out = unmixed(found, 1.01)
    for other in others.values():
        out += distant(found, {name: v for name, (v, _) in other.estimates.items()}, 0.4)
    return out


QUESTIONS = [
    Question(
        "counts", "100 series of 25 counts, three parameters: `sample`, 2 x 500 draws", 15.0,
        (
            Program(OWN, own),
            Program("Laplace and Metropolis by hand, Numba, 2 x 2,000 draws", by_hand),
        ),
        faults,
    )
]  # fmt: skip
