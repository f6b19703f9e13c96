"""What moving parameters with the states (`interweave`) buys: effective draws per second.

For every model, method and seed: bulk ESS of each parameter by ArviZ over the chains, the processor
time of the draws after warmup (compilation was done before; chains one after the other on one
thread), effective draws per second, and the ratio of the interweaved to the plain chain. Where the
posterior is known, the posterior means less the exact ones in Monte Carlo standard errors.

    python bench/interweaving.py [draws] [seeds] [file.csv] [model ...]

Both chains have 600 sweeps of warmup; the further steps are those that "auto" arrives at.
"""

from __future__ import annotations

import csv
import sys
import time
import warnings
from concurrent.futures import Executor, Future
from typing import Any

import arviz as az
import numpy as np
from table import show

import ssmppl as ssm
from ssmppl.datasets import ice_varves
from ssmppl.demo import varves

DRAWS, WARMUP, CHAINS, SEEDS = 1_500, 600, 2, 3
EXACT = {"varves": {"phi": 0.950254, "tau": 46.1955}}

volatility = ssm.Model("stochastic volatility")


@volatility.prior
def volatility_prior():
    return {
        "mu": ssm.Normal(0, sd=2),
        "phi": ssm.Uniform(0, 1),
        "q": ssm.InverseGamma(2.5, scale=0.05),
    }


@volatility.initial
def volatility_initial(mu, phi, q):
    return {"h": ssm.Normal(mu, variance=q / (1 - phi**2))}


@volatility.transition
def volatility_transition(h, mu, phi, q):
    return {"h": ssm.Normal(mu + phi * (h - mu), variance=q)}


@volatility.observation
def volatility_observation(h):
    return {"y": ssm.Normal(0, sd=np.exp(h / 2))}


level = ssm.Model("level and noise")


@level.prior
def level_prior():
    return {"q": ssm.InverseGamma(1, scale=0.01), "r": ssm.InverseGamma(1, scale=0.1)}


@level.initial
def level_initial():
    return {"x": ssm.Normal(0, sd=1)}


@level.transition
def level_transition(x, q):
    return {"x": ssm.Normal(x, variance=q)}


@level.observation
def level_observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}


def simulated(model: ssm.Model, parameters: dict[str, float], steps: int) -> dict[str, Any]:
    """Made-up data, the same each time."""
    return {"y": ssm.simulate(model, parameters, steps=steps, seed=1)["y"].values[0]}


CASES: dict[str, tuple[ssm.Model, dict[str, Any], type]] = {
    "varves": (varves, {"y": ice_varves()}, ssm.PGAS),
    "volatility": (
        volatility, simulated(volatility, {"mu": -1.0, "phi": 0.97, "q": 0.03}, 600), ssm.PGAS
    ),
    "level": (level, simulated(level, {"q": 0.02, "r": 0.5}, 400), ssm.Gibbs),
    "level by particles": (level, simulated(level, {"q": 0.02, "r": 0.5}, 400), ssm.PGAS),
}  # fmt: skip


class OneThread(Executor):
    """Runs what it is given at once, and keeps the processor time of each block with its length."""

    def __init__(self) -> None:
        self.blocks: list[tuple[int, float]] = []

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future:
        future: Future = Future()
        start = time.process_time()
        out = fn(*args, **kwargs)
        self.blocks.append((args[-1], time.process_time() - start))
        future.set_result(out)
        return future

    def after_warmup(self) -> float:
        """Seconds of the blocks past the warmup of all chains, which take turns."""
        done, seconds = [0] * CHAINS, 0.0
        for k, (n, spent) in enumerate(self.blocks):
            chain = k % CHAINS
            seconds += spent if done[chain] >= WARMUP else 0.0
            done[chain] += n
        return seconds


def run(case: str, draws: int, seed: int, **settings: Any) -> dict[str, Any]:
    """One run's figures; settings : of the method."""
    model, data, method = CASES[case]
    clock = OneThread()
    idata = ssm.sample(
        model, data, method(**settings), draws=draws, warmup=WARMUP, chains=CHAINS,
        states=False, progress=False, seed=seed, executor=clock,
    )  # fmt: skip
    seconds, posterior = clock.after_warmup(), idata["posterior"]
    out: dict[str, Any] = {"seconds": seconds, "ms": 1e3 * seconds / (CHAINS * draws)}
    stats = idata["sample_stats"]
    out["moved"] = float(stats["interweaved"].mean()) if "interweaved" in stats else 0.0
    for name in posterior.data_vars:
        values = posterior[name].values
        ess = float(az.ess(values, method="bulk"))
        out[name] = {"ess": ess, "rate": ess / seconds}
        if name in EXACT.get(case, {}):
            error = values.std(ddof=1) / np.sqrt(float(az.ess(values, method="mean")))
            out[name]["off"] = (values.mean() - EXACT[case][name]) / error
    return out


def main() -> None:
    draws, seeds = (int(v) for v in [*sys.argv[1:3], *[DRAWS, SEEDS][len(sys.argv[1:3]) :]])
    warnings.simplefilter("ignore")
    rows: list[list[str]] = []
    titles = ["model", "method", "seed", "parameter", "ESS plain", "ESS", "ms plain", "ms",
              "ESS/s plain", "ESS/s", "ratio", "accepted",
              "MCSE off, plain", "MCSE off"]  # fmt: skip
    chosen = sys.argv[4:] or list(CASES)
    for case, (model, data, method) in ((c, CASES[c]) for c in chosen):
        for setting in (False, True):  # compile
            ssm.sample(model, data, method(interweave=setting), draws=2, warmup=2, chains=1,
                       states=False, progress=False, seed=1)  # fmt: skip
        for seed in range(1, seeds + 1):
            plain, woven = (run(case, draws, seed, interweave=s) for s in (False, "auto"))
            for name in [n for n, v in woven.items() if isinstance(v, dict)]:
                a, b = plain[name], woven[name]
                off = [f"{v['off']:+.1f}" if "off" in v else "" for v in (a, b)]
                rows.append([
                    case, method.__name__, str(seed), name, f"{a['ess']:.0f}", f"{b['ess']:.0f}",
                    f"{plain['ms']:.2f}", f"{woven['ms']:.2f}", f"{a['rate']:.1f}",
                    f"{b['rate']:.1f}", f"{b['rate'] / a['rate']:.1f}", f"{woven['moved']:.2f}",
                    *off,
                ])  # fmt: skip
                print(*rows[-1], sep=", ", file=sys.stderr, flush=True)
        if sys.argv[3:]:  # after every model, so that an interrupt keeps what there is
            with open(sys.argv[3], "w", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerows([titles, *rows])
    print(f"{CHAINS} chains of {draws:,} draws after {WARMUP:,}.\n")
    show(titles, rows)


if __name__ == "__main__":
    main()
