"""The package `dynamax`: exact filters, no particle filters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from dynamax.linear_gaussian_ssm import lgssm_filter
from dynamax.linear_gaussian_ssm.inference import make_lgssm_params

from .tasks import Task, Work, linear_model, stopwatch

NAME, PACKAGES = "dynamax", ("dynamax",)

jax.config.update("jax_enable_x64", True)


def prepare(task: Task) -> Work | None:
    if task.kind != "kalman":
        return None
    m, y = linear_model(task.n)
    made = make_lgssm_params(
        initial_mean=jnp.asarray(m["m"]), initial_cov=jnp.asarray(m["p"]),
        dynamics_weights=jnp.asarray(m["a"]), dynamics_cov=jnp.asarray(m["q"]),
        emissions_weights=jnp.asarray(m["c"]), emissions_cov=jnp.asarray(m["r"]),
    )  # fmt: skip
    run = jax.jit(lambda y: lgssm_filter(made, y).marginal_loglik)
    timed = stopwatch(lambda: jax.block_until_ready(run(jnp.asarray(y))))
    timed()
    return timed
