"""The package `pypomp`: bootstrap filter and PMMH."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pypomp
from jax import random
from pypomp.types import (
    CovarDict,
    InitialTimeFloat,
    ObservationDict,
    ParamDict,
    RNGKey,
    StateDict,
    StepSizeFloat,
    TimeFloat,
)  # fmt: skip

from ssmppl.datasets import ice_varves

from .tasks import PHI, TAU, Task, Work, stopwatch

NAME, PACKAGES = "pypomp", ("pypomp",)
ITERATIONS = 10

jax.config.update("jax_enable_x64", True)


def rinit(theta_: ParamDict, key: RNGKey, covars: CovarDict, t0: InitialTimeFloat):
    phi, tau = theta_["phi"], theta_["tau"]
    return {"x": random.normal(key) / jnp.sqrt((1 - phi**2) * tau)}


def rproc(
    X_: StateDict,
    theta_: ParamDict,
    key: RNGKey,
    covars: CovarDict,
    t: TimeFloat,
    dt: StepSizeFloat,
):
    return {"x": theta_["phi"] * X_["x"] + random.normal(key) / jnp.sqrt(theta_["tau"])}


def dmeas(Y_: ObservationDict, X_: StateDict, theta_: ParamDict, covars: CovarDict, t: TimeFloat):
    x, y = X_["x"], Y_["y"]
    return (
        6.25 * (np.log(0.256) - x) - jax.scipy.special.gammaln(6.25) + 5.25 * jnp.log(y)
        - 0.256 * y * jnp.exp(-x)
    )  # fmt: skip


def dprior(theta_: ParamDict):
    inside = (jnp.abs(theta_["phi"]) < 1) & (theta_["tau"] > 0)
    tau = jnp.abs(theta_["tau"])
    return jnp.where(inside, (0.01 - 1) * jnp.log(tau) - 0.01 * tau, -jnp.inf)


def prepare(task: Task) -> Work | None:
    if task.kind not in ("bootstrap", "pmmh"):
        return None
    y = ice_varves()
    model = pypomp.Pomp(
        ys=pd.DataFrame({"y": y}, index=np.arange(1.0, len(y) + 1)), t0=0.0, statenames=["x"],
        theta=pypomp.PompParameters({"phi": PHI, "tau": TAU}), rinit=rinit, rproc=rproc,
        dmeas=dmeas, dprior=dprior, nstep=1,
    )  # fmt: skip
    if task.kind == "bootstrap":
        timed = stopwatch(lambda: model.pfilter(J=task.n, key=random.key(1)))
        timed()
        return timed
    walk = pypomp.proposals.MVNDiagRW({"phi": 0.01, "tau": 3.0})
    timed = stopwatch(lambda: model.pmcmc(J=task.n, M=ITERATIONS, proposal=walk, key=random.key(1)))
    timed()
    return lambda: timed() / (ITERATIONS + 1)
