"""What integrating parameters out of PGAS (`eliminate`) buys: effective draws per second.

As `bench/interweaving.py`, whose figures of a run these are, on the varves and on a made-up AR(2)
process: the plain chain, the interweaved one, and the one without the parameters that can be
eliminated, each with 20 particles.

    python bench/elimination.py [draws] [seeds] [file.csv] [model ...]
"""

from __future__ import annotations

import csv
import sys
import warnings
from typing import Any

import interweaving
import numpy as np
from interweaving import CASES, CHAINS, WARMUP, run
from table import show

import ssmppl as ssm

DRAWS, SEEDS = 1_500, 3

autoregression = ssm.Model("AR(2) under noise")


@autoregression.prior
def autoregression_prior():
    return {"q": ssm.InverseGamma(2, scale=0.5)}


@autoregression.prior
def autoregression_coefficients(q):
    return {"a": ssm.Normal(0, variance=q), "b": ssm.Normal(0, variance=q)}


@autoregression.initial
def autoregression_initial():
    return {"x": ssm.Normal(0, sd=1), "before": ssm.Normal(0, sd=1)}


@autoregression.transition
def autoregression_transition(x, before, a, b, q):
    return {"x": ssm.Normal(a * x + b * before, variance=q), "before": ssm.Dirac(x)}


@autoregression.observation
def autoregression_observation(x):
    return {"y": ssm.Poisson(np.exp(x))}


truth = {"a": 1.2, "b": -0.4, "q": 0.1}
CASES["autoregression"] = (
    autoregression, interweaving.simulated(autoregression, truth, 200), ssm.PGAS
)  # fmt: skip
SETTINGS: dict[str, dict[str, Any]] = {
    "plain": {},
    "interweaved": {"interweave": True},
    "eliminated": {"eliminate": True},
}
PARTICLES = 20


def main() -> None:
    draws, seeds = (int(v) for v in [*sys.argv[1:3], *[DRAWS, SEEDS][len(sys.argv[1:3]) :]])
    warnings.simplefilter("ignore")
    rows: list[list[str]] = []
    titles = ["model", "chain", "seed", "parameter", "ESS", "ms", "ESS/s", "MCSE off"]
    for case in sys.argv[4:] or ["varves", "autoregression"]:
        model, data, method = CASES[case]
        for settings in SETTINGS.values():  # compile
            own = method(particles=PARTICLES, **settings)
            ssm.sample(model, data, own, draws=2, warmup=2, chains=1, states=False, progress=False,
                       seed=1)  # fmt: skip
        for seed in range(1, seeds + 1):
            for name in SETTINGS:
                found = run(case, draws, seed, particles=PARTICLES, **SETTINGS[name])
                for parameter in [n for n, v in found.items() if isinstance(v, dict)]:
                    figures = found[parameter]
                    off = f"{figures['off']:+.1f}" if "off" in figures else ""
                    rows.append([
                        case, name, str(seed), parameter, f"{figures['ess']:.0f}",
                        f"{found['ms']:.2f}", f"{figures['rate']:.1f}", off,
                    ])  # fmt: skip
                    print(*rows[-1], sep=", ", file=sys.stderr, flush=True)
            if sys.argv[3:]:  # after every seed, so that an interrupt keeps what there is
                with open(sys.argv[3], "w", newline="", encoding="utf-8") as file:
                    csv.writer(file, lineterminator="\n").writerows([titles, *rows])
    print(f"{CHAINS} chains of {draws:,} draws after {WARMUP:,}.\n")
    show(titles, rows)


if __name__ == "__main__":
    main()
