"""ssmppl itself."""

from __future__ import annotations

import time
from concurrent.futures import Executor, Future
from functools import cache
from itertools import count
from typing import Any

import numpy as np

import ssmppl as ssm
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.modules.exact import exact_entry
from ssmppl.datasets import ice_varves
from ssmppl.demo import varves
from ssmppl.inference.particles.filtering import FilterSettings, log_likelihood_estimate
from ssmppl.inference.run.problem import pose

from .chains import COLUMNS, Chains
from .tasks import (
    FFBSI_DRAWS,
    KALMAN_STEPS,
    LGSS,
    PHI,
    TAU,
    Task,
    Work,
    lgss_series,
    linear_model,
    pendulum_series,
    stopwatch,
    walk_series,
)  # fmt: skip

NAME, PACKAGES = "ssmppl", ("numba", "llvmlite", "numpy")
ITERATIONS, SWEEPS = 40, 100
DRAWS = {"pgas": 10_000, "interweaved": 2_000}

lgss = ssm.Model("LGSS")
lgss.initial(lambda: {"x": ssm.Normal(0, variance=1.0)})
lgss.transition(lambda x: {"x": ssm.Normal(LGSS["phi"] * x, variance=LGSS["q"])})
lgss.observation(lambda x: {"y": ssm.Normal(x, variance=LGSS["r"])})


pendulum = ssm.Model("pendulum")
pendulum.initial(lambda: {"angle": ssm.Normal(0.5, sd=0.1), "rate": ssm.Normal(0, sd=0.1)})
pendulum.transition(
    lambda angle, rate: {
        "angle": ssm.Dirac(angle + 0.05 * rate),
        "rate": ssm.Normal(rate + 0.05 * (-9.81 * np.sin(angle) - 0.2 * rate), sd=0.1),
    }
)
pendulum.observation(lambda angle: {"y": ssm.Normal(angle, sd=0.1)})


def walk(d: int) -> ssm.Model:
    """States in a ring, each pulling at the next one."""
    model = ssm.Model(f"walk of {d}")
    model.initial(lambda: {"x": ssm.Normal(np.zeros(d), sd=1.0)})
    model.transition(lambda x: {"x": ssm.Normal(0.8 * x + 0.1 * np.roll(x, -1), sd=0.3)})
    model.observation(lambda x: {"y": ssm.Normal(np.sum(x), sd=1.0)})
    return model


class Stopwatch(Executor):
    """Runs what it is given at once, and keeps the seconds that it took."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future:
        future: Future = Future()
        start = time.perf_counter()
        future.set_result(fn(*args, **kwargs))
        self.seconds += time.perf_counter() - start
        return future


def prepare(task: Task) -> Work | None:
    if task.kind in ("bootstrap", "guided", "pendulum") or task.kind.startswith("walk"):
        return _filter(task)
    if task.kind == "pmmh":
        return _pmmh(task)
    if task.kind == "csmc":
        return _csmc(task)
    if task.kind.startswith(("pgas", "interweaved")):
        kind, parameter = task.kind.split("-")
        return _pgas(kind, task.n).work(parameter)
    if task.kind.startswith("ffbsi"):
        return _ffbsi(task)
    return _kalman(task) if task.kind == "kalman" else None


def _filter(task: Task) -> Work:
    if task.kind.startswith("walk"):
        d = int(task.kind.removeprefix("walk"))
        model, y = walk(d), walk_series(d)
    else:
        model, y = {"bootstrap": (varves, ice_varves()), "guided": (lgss, lgss_series()),
                    "pendulum": (pendulum, pendulum_series())}[task.kind]  # fmt: skip
    problem, theta = pose(model, {"y": y}), np.array([PHI, TAU] if model is varves else [])
    proposal = "guided" if task.kind == "guided" else "bootstrap"
    settings, rng = FilterSettings(task.n, proposal), new_state(np.random.SeedSequence(1))
    run = stopwatch(lambda: log_likelihood_estimate(problem, theta, settings, rng))
    run()
    return run


def _pmmh(task: Task) -> Work:
    method = ssm.PMMH(particles=task.n, proposal="bootstrap")

    def run() -> float:
        watch = Stopwatch()
        ssm.sample(
            varves, {"y": ice_varves()}, method, draws=ITERATIONS, warmup=1, chains=1,
            states=False, start={"phi": PHI, "tau": TAU}, progress=False, seed=1, executor=watch,
        )  # fmt: skip
        return watch.seconds / (ITERATIONS + 1)

    run()
    return run


def _csmc(task: Task) -> Work:
    problem, theta = pose(varves, {"y": ice_varves()}), np.array([PHI, TAU])
    e, rng = problem.experiments[0], new_state(np.random.SeedSequence(2))
    sweep = problem.program.entry("conditional_smc_bootstrap")
    paths, figures = [np.log(0.256 / 6.25 * e.y), np.empty((e.steps, 1))], np.empty(2)

    def sweeps() -> None:
        for _ in range(SWEEPS):
            sweep(theta, e.y, e.seen, e.u, task.n, rng, paths[0], paths[1], figures)
            paths.reverse()

    sweeps()
    timed = stopwatch(sweeps)
    return lambda: timed() / SWEEPS


@cache
def _pgas(kind: str, particles: int) -> Chains:
    """Chains by `sample`: the plain Gibbs step, or interweaved as where no method is named."""
    interweave = {} if kind == "pgas" else {"interweave": "auto"}
    method, seeds = ssm.PGAS(particles=particles, proposal="bootstrap", **interweave), count()

    def run() -> tuple[float, np.ndarray]:
        watch = Stopwatch()
        idata = ssm.sample(
            varves, {"y": ice_varves()}, method, draws=DRAWS[kind], warmup=100, chains=1,
            states=False, start={"phi": PHI, "tau": TAU}, progress=False, seed=next(seeds),
            executor=watch,
        )  # fmt: skip
        draws = [idata.posterior[name].values[0] for name in COLUMNS]
        return watch.seconds, np.stack(draws, axis=1)

    ssm.sample(
        varves, {"y": ice_varves()}, method, draws=10, warmup=1, chains=1, progress=False, seed=1
    )  # compiles it
    return Chains(run)


def _ffbsi(task: Task) -> Work:
    names = {"ffbsi": "exact", "ffbsi-rejection": "rejection", "ffbsi-mcmc": "mcmc"}
    method = ssm.FFBSi(kernel=names[task.kind], proposal="bootstrap")

    def smooth() -> None:
        ssm.smooth(
            varves, {"y": ice_varves()}, {"phi": PHI, "tau": TAU}, method, particles=task.n,
            trajectories=FFBSI_DRAWS, seed=1,
        )  # fmt: skip

    smooth()
    return stopwatch(smooth)


def _kalman(task: Task) -> Work:
    m, y = linear_model(task.n)
    d, k = task.n, y.shape[1]
    made = Matrices(
        m["m"], m["p"], m["a"][None], np.zeros((1, d)), m["q"][None], m["c"][None],
        np.zeros((1, k)), m["r"][None],
    )  # fmt: skip
    out = np.empty(KALMAN_STEPS)
    none = [np.empty((0, *s)) for s in ((d,), (d, d), (d,), (d, d), (k,), (k, k))]
    run = stopwatch(lambda: exact_entry("kalman_filter")(*made, y, np.ones_like(y), out, *none))
    run()
    return run
