"""Seconds to the default posterior of a seasonal model, and of panels of short series.

A trend with a season of twelve months (13 states) over 156 months of carbon dioxide; one series of
135 rows beside six of 20 to 25, and a hundred of 22, of a noisy autoregression and of counts. Each
is sampled by `ssm.sample` as it comes, which goes on until its rule of convergence is met; the
kernels are in the cache after the first. The ratio is that of six series to one of as many rows.

    python -m bench.panels [seeds]
"""

from __future__ import annotations

import sys
import time
import warnings

import numpy as np

import ssmppl as ssm

from .questions.linear import carbon_dioxide, trend_and_season
from .table import machine, show, versions

MONTHS, SIX, HUNDRED = 156, (20, 21, 22, 23, 24, 25), (22,) * 100


def noisy(counts: bool) -> ssm.Model:
    """A stationary autoregression behind noise, or behind counts."""
    made = ssm.Model("counts" if counts else "noise")
    made.prior(
        lambda: {"phi": ssm.Uniform(-1, 1), "q": ssm.HalfNormal(sd=1), "c": ssm.HalfNormal(sd=1)}
    )
    made.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    made.transition(lambda x, phi, q: {"x": ssm.Normal(phi * x, sd=q)})
    if counts:
        made.observation(lambda x, c: {"y": ssm.Poisson(np.exp(c + x))})
    else:
        made.observation(lambda x, c: {"y": ssm.Normal(x, sd=c)})
    return made


def series(rows: int, counts: bool, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """One of the series, at phi = 0.8."""
    x, states = rng.normal(), []
    for _ in range(rows):
        x = 0.8 * x + 0.5 * rng.normal()
        states.append(x)
    level = np.array(states)
    y = rng.poisson(np.exp(1.0 + level)) if counts else level + 0.5 * rng.normal(size=rows)
    return {"y": y.astype(float)}


def seconds(model: ssm.Model, data: object, seed: int) -> tuple[float, str, float]:
    """Of the default posterior; the method it took, and the least bulk or tail ESS."""
    begun = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        idata = ssm.sample(model, data, seed=seed, progress=False)
    took, found = time.perf_counter() - begun, ssm.summary(idata)
    least = float(min(found["ess_bulk"].min(), found["ess_tail"].min()))
    return took, str(idata.posterior.attrs["method"]), least


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    rng, cases = np.random.default_rng(0), []
    cases.append(("13 states, 156 months", trend_and_season(), {"y": carbon_dioxide()[:MONTHS]}))
    for counts in (False, True):
        name, model = "counts" if counts else "noise", noisy(counts)
        cases.append((f"{name}: one of {sum(SIX)} rows", model, series(sum(SIX), counts, rng)))
        cases.append((f"{name}: six", model, [series(n, counts, rng) for n in SIX]))
        cases.append((f"{name}: a hundred", model, [series(n, counts, rng) for n in HUNDRED]))
    rows, before = [], 0.0
    for label, model, data in cases:
        seconds(model, data, 0)  # compiles
        found = [seconds(model, data, seed) for seed in range(1, seeds + 1)]
        took = float(np.median([f[0] for f in found]))
        ratio = f"{took / before:.2f}" if label.endswith("six") else ""
        before, least = took, min(f[2] for f in found)
        each = ", ".join(f"{f[0]:.1f}" for f in found)
        rows.append((label, found[0][1], f"{took:.1f}", each, f"{least:.0f}", ratio))
    print(machine(), versions(("numpy", "numba")), sep="\n")
    show(("posterior", "method", "seconds", "by seed", "least ESS", "to one"), rows)


if __name__ == "__main__":
    main()
