"""States with several components by the package `particles` (N. Chopin): a bootstrap filter.

Its models are classes of laws in another notation, and its filter shares no code with ssmppl's.
Both numbers have a Monte Carlo error.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from examples.check.rows import (
    Estimate,
    Row,
    check,
    files,
    log_likelihood,
    mean_likelihood,
    stated,
)

SEED = 20150306


def bootstrap(model: Any, y: Any, particles: int, repeats: int) -> Estimate:
    """The likelihood by `repeats` bootstrap filters of the package `particles`."""
    from particles import SMC
    from particles.state_space_models import Bootstrap

    log_z = []
    np.random.seed(SEED)  # noqa: NPY002, the package draws from the global state
    for _ in range(repeats):
        run = SMC(fk=Bootstrap(ssm=model, data=y), N=particles, ESSrmin=1.0)
        run.run()
        log_z.append(run.logLt)
    return mean_likelihood(np.array(log_z))


class Seen:
    """A Normal reading that may be missing, as a law of the package `particles`."""

    def __init__(self, mean: np.ndarray, sd: float):
        self.mean, self.sd = mean, sd

    def logpdf(self, y: Any) -> np.ndarray:
        if np.isnan(y):
            return np.zeros(len(self.mean))
        return -0.5 * ((y - self.mean) / self.sd) ** 2 - np.log(self.sd * np.sqrt(2 * np.pi))


@check("seir", "particles")
def seir() -> Iterator[Row]:
    from particles import distributions, state_space_models
    from scipy import stats

    theta = {"beta": 0.5, "fall_ill": 0.33, "recover": 0.25, "rho": 0.4}
    beta, fall_ill, recover, rho = theta.values()
    y = files("seir")[1][0]["reported"].to_numpy(dtype=float)

    class Flows(distributions.ProbDist):
        """S, E, I and the three flows of the day, as columns (N, 6)."""

        dim = 6

        def __init__(self, before: np.ndarray | None):
            self.before = before

        def rvs(self, size: int = 1) -> np.ndarray:
            rng = np.random
            if self.before is None:
                return np.tile([795.0, 5.0, 0.0, 0.0, 0.0, 0.0], (size, 1))
            S, E, I, infected, onsets, recovered = self.before.T
            s, e, i = S - infected, E + infected - onsets, I + onsets - recovered
            new = [
                rng.binomial(s.astype(int), 1 - np.exp(-beta * i / 800)),
                rng.binomial(e.astype(int), fall_ill),
                rng.binomial(i.astype(int), recover),
            ]
            return np.column_stack([s, e, i, *new]).astype(float)

    class Reports(distributions.ProbDist):
        def __init__(self, onsets: np.ndarray):
            self.onsets = onsets

        def logpdf(self, x: Any) -> np.ndarray:
            if np.isnan(x):
                return np.zeros(len(self.onsets))
            return stats.binom.logpmf(x, self.onsets, rho)

    class Epidemic(state_space_models.StateSpaceModel):
        def PX0(self) -> Any:
            return Flows(None)

        def PX(self, t: int, xp: np.ndarray) -> Any:
            return Flows(xp)

        def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> Any:
            return Reports(x[:, 4])

    yield Row(
        "seir", stated(theta), "particles", "particles: bootstrap filter",
        log_likelihood("seir", theta, particles=2000, repeats=20),
        bootstrap(Epidemic(), y, particles=2000, repeats=20),
    )  # fmt: skip


@check("pendulum", "particles")
def pendulum() -> Iterator[Row]:
    from particles import distributions, state_space_models

    theta = {"k": 15.0, "c": 0.4, "b": 8.0, "q": 0.2}
    k, c, b, q = theta.values()
    dt, sd = 0.05, 2 * np.pi / 256 / np.sqrt(12)
    table = files("pendulum")[1][0]
    y, torque = table["angle"].to_numpy(), table["torque"].to_numpy()
    spread = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])

    class Pendulum(state_space_models.StateSpaceModel):
        def PX0(self) -> Any:
            return distributions.MvNormal(loc=np.zeros(2), scale=0.1, cov=np.eye(2))

        def PX(self, t: int, xp: np.ndarray) -> Any:
            angle, speed = xp.T
            pull = b * torque[t - 1] - k * np.sin(angle) - c * speed
            new = np.column_stack([angle + dt * speed + dt**2 / 2 * pull, speed + dt * pull])
            return distributions.MvNormal(loc=new, cov=spread)

        def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> Any:
            return Seen(x[:, 0], sd)

    yield Row(
        "pendulum", stated(theta), "particles", "particles: bootstrap filter",
        log_likelihood("pendulum", theta, particles=1000, repeats=20),
        bootstrap(Pendulum(), y, particles=5000, repeats=20),
    )  # fmt: skip


@check("bearings", "particles")
def bearings() -> Iterator[Row]:
    from particles import distributions, state_space_models

    theta = {"q": 5e-4, "r": 1e-4}
    q, r = theta.values()
    table = files("bearings")[1][0]
    y, east, north = (table[name].to_numpy() for name in ("bearing", "east", "north"))
    two = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])  # of one direction: position, velocity
    spread = q * np.kron(two, np.eye(2))

    class Target(state_space_models.StateSpaceModel):
        def PX0(self) -> Any:
            sds = np.array([2.0, 2.0, 0.2, 0.2])
            return distributions.MvNormal(loc=np.array([5.0, 12.0, 0.2, 0.0]), cov=np.diag(sds**2))

        def PX(self, t: int, xp: np.ndarray) -> Any:
            new = np.column_stack([xp[:, :2] + xp[:, 2:], xp[:, 2:]])
            return distributions.MvNormal(loc=new, cov=spread)

        def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> Any:
            return Seen(np.angle((x[:, 1] - north[t]) + 1j * (x[:, 0] - east[t])), np.sqrt(r))

    yield Row(
        "bearings", stated(theta), "particles", "particles: bootstrap filter",
        log_likelihood("bearings", theta, particles=1000, repeats=10, proposal="twisted"),
        bootstrap(Target(), y, particles=10_000, repeats=20),
    )  # fmt: skip
