"""What a draw from the posterior of the ice varves costs, by method.

For every method: particles, the share of accepted moves, the integrated autocorrelation time (IACT
= draws / ESS, ESS of the mean by ArviZ over all chains) of phi and tau, the processor time of a
draw after warmup, and effective draws of the slower of both per second of it; four chains, one
after the other on one thread. Processor time, so that other work on the machine matters little.
The last columns say that the answers agree: the posterior means less the exact ones (0.950254,
46.1955), in Monte Carlo standard errors.

    python bench/samplers.py [draws]

PMH0 stands three times: with the pilot's walk on the unconstrained scale; as Schön et al. (2015)
have it, on (phi, 1/tau) with steps of covariance 2.562^2 Sigma / 2 and the main text's Sigma, whose
negative correlation agrees with the exact one, without adaptation; and with the correlation of the
random numbers that Deligiannidis, Doucet and Pitt (2018) suggest, at two numbers of particles.
"""

from __future__ import annotations

import sys
import time
from concurrent.futures import Executor, Future
from typing import Any

import arviz as az
import numpy as np
from table import show

import ssmppl as ssm
from ssmppl.datasets import ice_varves
from ssmppl.demo import varves

DRAWS, WARMUP, CHAINS = 2_000, 500, 4
EXACT = {"phi": 0.950254, "tau": 46.1955}
SIGMA = 1e-5 * np.array([[22.51, -4.53], [-4.53, 2.57]])  # of Schön et al. (2015), main text
PAPER = {
    "scale": "natural",
    "transform": {"tau": "reciprocal"},
    "covariance": 2.562**2 / 2 * SIGMA,
}
METHODS: dict[str, Any] = {
    "PMH0": ssm.PMMH(),
    "PMH0 of the paper": ssm.PMMH(particles=1000, proposal="bootstrap", **PAPER),
    "PMH1": ssm.PMMH(order=1),
    "PMH2": ssm.PMMH(order=2),
    "correlated, rho 0.99": ssm.PMMH(particles=100, correlation=0.99, proposal="bootstrap"),
    "correlated, rho 0.9": ssm.PMMH(particles=200, correlation=0.9, proposal="bootstrap"),
    "PGAS, plain": ssm.PGAS(interweave=False),
    "PGAS": ssm.PGAS(),
}


class OneThread(Executor):
    """Runs what it is given at once, and keeps the processor time that it took."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future:
        future: Future = Future()
        start = time.process_time()
        future.set_result(fn(*args, **kwargs))
        self.seconds.append(time.process_time() - start)
        return future


def row(label: str, method: Any, draws: int) -> list[str]:
    """One method's line of the table."""
    executor = OneThread()
    idata = ssm.sample(
        varves, {"y": ice_varves()}, method, draws=draws, warmup=WARMUP, chains=CHAINS,
        states=False, progress=False, seed=1, executor=executor,
    )  # fmt: skip
    seconds = sum(executor.seconds) * draws / (draws + WARMUP)
    posterior, attrs = idata["posterior"], idata["posterior"].attrs
    times, agreement = [], []
    for name, mean in EXACT.items():
        values = posterior[name].values
        ess = float(az.ess(values, method="mean"))
        times.append(values.size / ess)
        agreement.append((values.mean() - mean) / (values.std(ddof=1) / np.sqrt(ess)))
    rate = float(idata["sample_stats"]["acceptance_rate"].mean())
    return [
        label, str(attrs["particles"]), str(attrs["proposal"]).split(" ")[0], f"{rate:.2f}",
        *(f"{t:.0f}" for t in times), f"{1e3 * seconds / (CHAINS * draws):.2f}",
        f"{CHAINS * draws / max(times) / seconds:.2f}", *(f"{z:+.1f}" for z in agreement),
    ]  # fmt: skip


def main() -> None:
    draws = int(sys.argv[1]) if sys.argv[1:] else DRAWS
    for method in METHODS.values():  # compile
        ssm.sample(varves, {"y": ice_varves()[:20]}, method, draws=2, warmup=2, chains=1,
                   states=False, progress=False, seed=1)  # fmt: skip
    print(f"The ice varves, {CHAINS} chains of {draws:,} draws after {WARMUP}.\n")
    rows = []
    for label, method in METHODS.items():
        rows.append(row(label, method, draws))
        print(*rows[-1], sep=", ", file=sys.stderr, flush=True)
    show(["method", "N", "proposal", "accepted", "IACT phi", "IACT tau", "ms a draw",
          "ESS per second", "phi, MCSE off", "tau, MCSE off"], rows)  # fmt: skip


if __name__ == "__main__":
    main()
