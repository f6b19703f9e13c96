"""The package `cuthbert`."""

from __future__ import annotations

import cuthbert
import jax
import jax.numpy as jnp
import numpy as np
from cuthbert.smc import backward_sampler, particle_filter
from cuthbertlib.resampling import multinomial, systematic
from cuthbertlib.smc.smoothing import exact_sampling, mcmc
from jax import random

from ssmppl.datasets import ice_varves

from .tasks import FFBSI_DRAWS, LGSS, PHI, TAU, Task, Work, lgss_series, stopwatch

NAME, PACKAGES = "cuthbert", ("cuthbert",)

jax.config.update("jax_enable_x64", True)
SD = 1 / np.sqrt(TAU)


def _weigh(x, y):
    return (
        6.25 * (np.log(0.256) - x) - jax.scipy.special.gammaln(6.25) + 5.25 * jnp.log(y)
        - 0.256 * y * jnp.exp(-x)
    )  # fmt: skip


def _varves(n):
    """Its first state stands before the first row, from the stationary law: so does x_1."""
    return particle_filter.build_filter(
        init_sample=lambda key: SD / np.sqrt(1 - PHI**2) * random.normal(key),
        propagate_sample=lambda key, x, y: PHI * x + SD * random.normal(key),
        log_potential=lambda before, x, y: _weigh(x, y),
        n_filter_particles=n,
        resampling_fn=systematic.resampling,
    )


def _guided(n):
    q, r, phi = LGSS["q"], LGSS["r"], LGSS["phi"]
    gain, s = q / (q + r), q + r

    def propagate(key, x, y):
        return phi * x + gain * (y - phi * x) + np.sqrt(gain * r) * random.normal(key)

    def potential(before, x, y):
        return -0.5 * (np.log(2 * np.pi * s) + (y - phi * before) ** 2 / s)

    return particle_filter.build_filter(
        init_sample=lambda key: random.normal(key), propagate_sample=propagate,
        log_potential=potential, n_filter_particles=n, resampling_fn=systematic.resampling,
    )  # fmt: skip


def prepare(task: Task) -> Work | None:
    y, key = jnp.asarray(ice_varves()), random.key(1)
    if task.kind in ("bootstrap", "guided"):
        made = _varves(task.n) if task.kind == "bootstrap" else _guided(task.n)
        y = y if task.kind == "bootstrap" else jnp.asarray(lgss_series())

        def run(key, y):
            begin = made.init_prepare(key=key)
            return cuthbert.filter(made, y, begin, key=key).log_normalizing_constant[-1]

    elif task.kind in ("ffbsi", "ffbsi-mcmc"):
        made = _varves(task.n)
        how = exact_sampling.simulate
        if task.kind == "ffbsi-mcmc":
            how = lambda *a, **k: mcmc.simulate(*a, **k, n_steps=5)  # noqa: E731
        back = backward_sampler.build_smoother(
            log_potential=lambda before, x, y: -0.5 * TAU * (x - PHI * before) ** 2,
            backward_sampling_fn=how, resampling_fn=multinomial.resampling,
            n_smoother_particles=FFBSI_DRAWS,
        )  # fmt: skip

        def run(key, y):
            begin = made.init_prepare(key=key)
            states = cuthbert.filter(made, y, begin, key=key)
            return cuthbert.smoother(back, states, y, key=key).particles

    else:
        return None
    compiled = jax.jit(run)
    timed = stopwatch(lambda: jax.block_until_ready(compiled(key, y)))
    timed()
    return timed
