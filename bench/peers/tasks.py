"""What is timed, and the data it is timed on."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssmppl.datasets import ice_varves

PHI, TAU = 0.95, 50.0  # of the ice varves, where nothing else is said
LGSS = {"phi": 0.9, "q": 0.1, "r": 0.1}  # x' ~ N(phi x, q), y ~ N(x, r), x_1 ~ N(0, 1)
LGSS_STEPS, KALMAN_STEPS, SHORT_STEPS = 10_000, 2_000, 500
WALKS = (2, 4, 10)  # states
FFBSI_DRAWS = 100
Work = Callable[[], float]


@dataclass(frozen=True)
class Task:
    """kind : what is done. n : particles, or states of a Kalman filter. rounds : how often it is
    timed. rate : whether units per second are reported, else `unit` of time, `scale` to a second.
    """

    kind: str
    n: int
    label: str
    unit: str
    scale: float
    rounds: int
    rate: bool = False

    def figure(self, seconds: float) -> float:
        """What is reported of the seconds of one unit of work."""
        return self.scale / seconds if self.rate else self.scale * seconds


def lgss_series() -> np.ndarray:
    """A series of the linear Gaussian model, (LGSS_STEPS,)."""
    rng = np.random.default_rng(1)
    x, out = rng.normal(), np.empty(LGSS_STEPS)
    for t in range(LGSS_STEPS):
        if t:
            x = LGSS["phi"] * x + np.sqrt(LGSS["q"]) * rng.normal()
        out[t] = x + np.sqrt(LGSS["r"]) * rng.normal()
    return out


def pendulum_series() -> np.ndarray:
    """Angles of a pendulum with noise, (SHORT_STEPS,): the model of `c/filters.c`."""
    rng, out = np.random.default_rng(2), np.empty(SHORT_STEPS)
    angle, rate = 0.5, 0.0
    for t in range(SHORT_STEPS):
        out[t] = angle + 0.1 * rng.normal()
        push = 0.05 * (-9.81 * np.sin(angle) - 0.2 * rate) + 0.1 * rng.normal()
        angle, rate = angle + 0.05 * rate, rate + push
    return out


def walk_series(d: int) -> np.ndarray:
    """Sums of d states in a ring with noise, (SHORT_STEPS,): the model of `c/filters.c`."""
    rng = np.random.default_rng(d)
    x, out = rng.normal(size=d), np.empty(SHORT_STEPS)
    for t in range(SHORT_STEPS):
        out[t] = x.sum() + rng.normal()
        x = 0.8 * x + 0.1 * np.roll(x, -1) + 0.3 * rng.normal(size=d)
    return out


def linear_model(d: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """A stable model of d states and d / 2 channels with full matrices, and data."""
    rng = np.random.default_rng(d)
    a, half, k = rng.normal(size=(d, d)), rng.normal(size=(d, d)), d // 2
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    made = {
        "m": np.zeros(d), "p": np.eye(d), "a": a, "q": half @ half.T / d + 0.1 * np.eye(d),
        "c": rng.normal(size=(k, d)), "r": np.eye(k),
    }  # fmt: skip
    return made, rng.normal(size=(KALMAN_STEPS, k))


def stopwatch(work: Callable[[], object]) -> Work:
    """`work`, once, in seconds on the clock."""

    def run() -> float:
        start = time.perf_counter()
        work()
        return time.perf_counter() - start

    return run


def _tasks() -> list[Task]:
    steps = len(ice_varves())
    found = [
        Task("bootstrap", n, f"bootstrap filter, varves, N = {n:,}", "ns per particle step",
             1e9 / (n * steps), rounds)
        for n, rounds in ((100, 15), (1_000, 15), (10_000, 7), (100_000, 3))
    ]  # fmt: skip
    found.append(
        Task("guided", 1_000, "guided filter, LGSS, T = 10,000, N = 1,000", "ns per particle step",
             1e9 / (1_000 * LGSS_STEPS), 5)
    )  # fmt: skip
    short = 1e9 / (1_000 * SHORT_STEPS)
    found.append(
        Task("pendulum", 1_000, "bootstrap filter, pendulum, T = 500, N = 1,000",
             "ns per particle step", short, 7)
    )  # fmt: skip
    found += [
        Task(f"walk{d}", 1_000, f"bootstrap filter, {d} states, T = 500, N = 1,000",
             "ns per particle step and state", short / d, 7)
        for d in WALKS
    ]  # fmt: skip
    found.append(
        Task("pmmh", 1_000, "PMMH, varves, N = 1,000", "iterations per second", 1.0, 3, True)
    )
    found += [
        Task("csmc", n, f"conditional SMC, ancestors sampled, varves, N = {n}", "sweeps per second",
             1.0, 5, True)
        for n in (20, 100)
    ]  # fmt: skip
    found += [
        Task(f"{kind}-{name}", 20, f"{label}, varves, N = 20: {name}",
             "effective samples per second", 1.0, 3, True)
        for kind, label in (("pgas", "PGAS"), ("interweaved", "PGAS as `sample` chooses it"))
        for name in ("phi", "tau")
    ]  # fmt: skip
    found += [
        Task(kind, 500, f"FFBSi, {what}, varves, N = 500, M = 100", "ms", 1e3, 3)
        for kind, what in (("ffbsi", "exact"), ("ffbsi-rejection", "rejection"),
                           ("ffbsi-mcmc", "MCMC"))
    ]  # fmt: skip
    found += [
        Task("kalman", d, f"Kalman log-likelihood, {d} states, {d // 2} channels",
             "µs per step", 1e6 / KALMAN_STEPS, 5)
        for d in (4, 20)
    ]  # fmt: skip
    found += [
        Task(f"start-{how}", 1_000, f"new process to first log-likelihood, {how}", "s", 1.0, 5)
        for how in ("cold", "warm")
    ]  # fmt: skip
    return found


TASKS = _tasks()
