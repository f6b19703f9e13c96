"""The ice varves: the maximum of the likelihood, and the posterior."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import ssmppl as ssm
from ssmppl.datasets import ice_varves
from ssmppl.demo import varves

from ..peers.tasks import Task
from .question import (
    OWN,
    Answer,
    Program,
    Question,
    Run,
    Unavailable,
    distant,
    estimated,
    sampled,
    unmixed,
)

BENCH = Path(__file__).parents[1]
SERIES = BENCH.parent / "ssmppl" / "datasets" / "ice_varves.csv"
# By a point-mass filter of 600 points (tests/reference): the maximum and its standard errors; mean
# and standard deviation of the posterior.
MAXIMUM, ERRORS = {"phi": 0.953814, "tau": 47.0670}, {"phi": 0.01601, "tau": 12.38}
MEAN, DEVIATION = {"phi": 0.950254, "tau": 46.1955}, {"phi": 0.016627, "tau": 12.129}


def own_maximum() -> Run:
    data = {"y": ice_varves()}
    return lambda seed: estimated(ssm.maximize(varves, data, seed=seed, progress=False))


def tmb() -> Run:
    """Laplace's approximation by R's package TMB (Kristensen et al. 2016), timed within R."""
    script = shutil.which("Rscript")
    if script is None:
        raise Unavailable("there is no Rscript (Debian: r-cran-tmb)")
    has = subprocess.run([script, "-e", "library(TMB)"], capture_output=True)
    if has.returncode:
        raise Unavailable("R has no package TMB (Debian: r-cran-tmb)")
    folder = BENCH / "build"
    folder.mkdir(exist_ok=True)
    command = [
        script, BENCH / "questions" / "varves_tmb.R", BENCH / "c" / "varves_tmb.cpp", folder, SERIES
    ]  # fmt: skip
    one = {**os.environ, "OMP_NUM_THREADS": "1"}

    def run(seed: int) -> Answer:
        done = subprocess.run(command, capture_output=True, text=True, env=one)
        if done.returncode:
            raise RuntimeError(done.stderr[-2000:])
        seconds, phi, phi_error, tau, tau_error, value = map(float, done.stdout.split()[-6:])
        return Answer(
            {"phi": (phi, phi_error), "tau": (tau, tau_error)}, {"log-likelihood": value},
            seconds=seconds,
        )  # fmt: skip

    return run


def maximum_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where it is more than a tenth of a standard error from the exact maximum, or the standard
    errors more than a tenth from the exact ones."""
    out = distant(own, MAXIMUM, 0.1, ERRORS)
    for name, error in ERRORS.items():
        if not abs(own.estimates[name][1] / error - 1) <= 0.1:
            out.append(f"the standard error of {name} is {own.estimates[name][1]:.4g}")
    return out


def own_posterior() -> Run:
    data = {"y": ice_varves()}

    def run(seed: int) -> Answer:
        idata = ssm.sample(varves, data, chains=2, seed=seed, progress=False)
        import arviz as az  # here, as `sample` does

        of_tau = float(az.ess(idata.posterior["tau"].to_numpy()))
        return replace(sampled(idata, ["phi", "tau"]), amount=of_tau)

    return run


def by_peer(module: str) -> Run:
    """Particle Gibbs as in `bench/against.py`: seconds for one effective sample of tau."""
    work = import_module(f"bench.peers.{module}").prepare(Task("pgas-tau", 20, "", "", 1.0, 1))
    return lambda seed: Answer(amount=1.0, seconds=work())


def posterior_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where a mean is further than four Monte Carlo standard errors from the exact one."""
    ess = float(own.remarks["ESS"])
    return [*distant(own, MEAN, 4 / ess**0.5, DEVIATION), *unmixed(own, 1.01)]


QUESTIONS = [
    Question(
        "varves-maximum", "ice varves (634 rows): maximum likelihood with standard errors", 0.3,
        (Program(OWN, own_maximum), Program("TMB", tmb)), maximum_faults,
    ),
    Question(
        "varves-posterior", "ice varves: `sample`, 2 x 1,000 draws", 500.0,
        (
            Program(OWN, own_posterior),
            Program("particles, PGAS", lambda: by_peer("particles_"), ("particles",)),
            Program("JAX by hand, PGAS", lambda: by_peer("jax_by_hand"), ("jax",)),
        ),
        posterior_faults, rate="effective samples of tau",
    ),
]  # fmt: skip
