"""The algorithms in JAX, written by hand and compiled whole; no package for particle filters."""

from __future__ import annotations

import time
from functools import cache
from itertools import count

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jax.scipy.special import gammaln, logsumexp

from ssmppl.datasets import ice_varves

from .chains import Chains
from .tasks import (
    FFBSI_DRAWS,
    LGSS,
    PHI,
    TAU,
    Task,
    Work,
    lgss_series,
    linear_model,
    stopwatch,
)  # fmt: skip

NAME, PACKAGES = "JAX by hand", ("jax", "jaxlib")
ITERATIONS, SWEEPS, DRAWS = 10, 20, 4_000

jax.config.update("jax_enable_x64", True)


def _weigh(x, y):
    return 6.25 * (np.log(0.256) - x) - gammaln(6.25) + 5.25 * jnp.log(y) - 0.256 * y * jnp.exp(-x)


def _ancestors(key, w, n):
    """Systematic resampling by weights that sum to one."""
    points = (jnp.arange(n) + random.uniform(key)) / n
    return jnp.clip(jnp.searchsorted(jnp.cumsum(w), points), 0, n - 1)


def _log_z(key, y, phi, tau, n, keep=False):
    """The bootstrap filter on the varves: log Z; where kept, particles and log weights too."""
    sd = 1 / jnp.sqrt(tau)

    def step(carry, now):
        x, w, total = carry
        key, y_t = now
        first, second = random.split(key)
        x = phi * x[_ancestors(first, w, n)] + sd * random.normal(second, (n,))
        log_w = _weigh(x, y_t)
        top = logsumexp(log_w)
        return (x, jnp.exp(log_w - top), total + top - np.log(n)), (x, log_w) if keep else None

    keys = random.split(key, len(y))
    x = sd / jnp.sqrt(1 - phi**2) * random.normal(keys[0], (n,))
    log_w = _weigh(x, y[0])
    top = logsumexp(log_w)
    begin = x, jnp.exp(log_w - top), top - np.log(n)
    (_, _, total), kept = lax.scan(step, begin, (keys[1:], y[1:]))
    if not keep:
        return total
    xs, log_ws = kept
    return jnp.vstack([x, xs]), jnp.vstack([log_w, log_ws])


def _guided_log_z(key, y, n):
    phi, q, r = LGSS["phi"], LGSS["q"], LGSS["r"]

    def move(key, mean, variance, y_t):
        gain, s = variance / (variance + r), variance + r
        x = mean + gain * (y_t - mean) + np.sqrt(gain * r) * random.normal(key, (n,))
        return x, -0.5 * (np.log(2 * np.pi * s) + (y_t - mean) ** 2 / s)

    def step(carry, now):
        x, w, total = carry
        key, y_t = now
        first, second = random.split(key)
        x, log_w = move(second, phi * x[_ancestors(first, w, n)], q, y_t)
        top = logsumexp(log_w)
        return (x, jnp.exp(log_w - top), total + top - np.log(n)), None

    keys = random.split(key, len(y))
    x, log_w = move(keys[0], jnp.zeros(n), 1.0, y[0])
    top = logsumexp(log_w)
    begin = x, jnp.exp(log_w - top), top - np.log(n)
    return lax.scan(step, begin, (keys[1:], y[1:]))[0][2]


def _pmmh(key, y, n):
    """A chain of random-walk steps on (phi, tau), priors as in the demonstration."""

    def log_prior(theta):
        phi, tau = theta
        inside = (jnp.abs(phi) < 1) & (tau > 0)
        return jnp.where(inside, (0.01 - 1) * jnp.log(jnp.abs(tau)) - 0.01 * tau, -jnp.inf)

    def step(carry, key):
        theta, log_p = carry
        a, b, c = random.split(key, 3)
        new = theta + jnp.array([0.01, 3.0]) * random.normal(a, (2,))
        value = log_prior(new)
        safe = jnp.where(value > -jnp.inf, new, theta)
        value = value + _log_z(b, y, safe[0], safe[1], n)
        accept = jnp.log(random.uniform(c)) < value - log_p
        return (jnp.where(accept, new, theta), jnp.where(accept, value, log_p)), theta

    start = jnp.array([PHI, TAU])
    log_p = log_prior(start) + _log_z(key, y, PHI, TAU, n)
    return lax.scan(step, (start, log_p), random.split(key, ITERATIONS))[1]


def _conditional_ancestors(key, w, keep, n):
    """Conditional systematic resampling (Chopin and Singh 2015): the last slot's is `keep`."""
    sums = n * jnp.cumsum(w)
    point = sums[keep] - random.uniform(key) * n * w[keep]
    points = jnp.mod(point + jnp.arange(1, n + 1), n)
    found = jnp.clip(jnp.searchsorted(sums, points), 0, n - 1).astype(jnp.int32)
    return found.at[n - 1].set(keep)


def _csmc(key, y, path, n, phi=PHI, tau=TAU):
    """One sweep of conditional SMC with ancestor sampling on the varves."""
    sd = 1 / jnp.sqrt(tau)

    def step(carry, now):
        x, w = carry
        key, y_t, x_ref = now
        a, b, c = random.split(key, 3)
        backward = jnp.log(w) - 0.5 * tau * (x_ref - phi * x) ** 2
        keep = random.categorical(a, backward).astype(jnp.int32)
        ancestors = _conditional_ancestors(b, w, keep, n)
        x = (phi * x[ancestors] + sd * random.normal(c, (n,))).at[n - 1].set(x_ref)
        return (x, jax.nn.softmax(_weigh(x, y_t))), (x, ancestors)

    keys = random.split(key, len(y) + 1)
    x = (sd / jnp.sqrt(1 - phi**2) * random.normal(keys[0], (n,))).at[n - 1].set(path[0])
    begin = x, jax.nn.softmax(_weigh(x, y[0]))
    (_, w), (xs, ancestry) = lax.scan(step, begin, (keys[1:-1], y[1:], path[1:]))

    def back(k, now):
        x, ancestors = now
        return ancestors[k], x[k]

    last = random.choice(keys[-1], n, p=w).astype(jnp.int32)
    k, tail = lax.scan(back, last, (xs, ancestry), reverse=True)
    return jnp.concatenate([x[k][None], tail])


def _gibbs(key, y, n):
    """DRAWS steps of PGAS: (phi, tau) after each; the Gibbs step is that of `draw_parameters`."""

    def step(carry, key):
        path, phi, tau = carry
        a, b, c, d = random.split(key, 4)
        path = _csmc(a, y, path, n, phi, tau)
        squares = (1 - phi**2) * path[0] ** 2 + ((path[1:] - phi * path[:-1]) ** 2).sum()
        tau = random.gamma(b, 0.01 + 0.5 * len(y)) / (0.01 + 0.5 * squares)
        inner = (path[1:-1] ** 2).sum()
        mean, sd = (path[1:] * path[:-1]).sum() / inner, 1 / jnp.sqrt(tau * inner)
        new = mean + sd * random.normal(c)
        accept = random.uniform(d) ** 2 < (1 - new**2) / (1 - phi**2)
        phi = jnp.where((jnp.abs(new) < 1) & accept, new, phi)
        return (path, phi, tau), jnp.stack([phi, tau])

    begin = jnp.log(0.256 / 6.25 * y), PHI, TAU
    return lax.scan(step, begin, random.split(key, DRAWS))[1]


@cache
def _pgas(n):
    y, seeds = jnp.asarray(ice_varves()), count()
    compiled = jax.jit(lambda key: _gibbs(key, y, n))

    def run():
        start = time.perf_counter()
        draws = np.asarray(compiled(random.key(next(seeds))))
        return time.perf_counter() - start, draws

    run()
    return Chains(run)


def _ffbsi(key, y, n):
    first, second = random.split(key)
    xs, log_ws = _log_z(first, y, PHI, TAU, n, keep=True)

    def back(after, now):
        x, log_w, key = now
        log_v = log_w - 0.5 * TAU * (after[:, None] - PHI * x) ** 2
        chosen = x[random.categorical(key, log_v)]
        return chosen, chosen

    keys = random.split(second, len(y))
    last = xs[-1][random.categorical(keys[-1], log_ws[-1], shape=(FFBSI_DRAWS,))]
    return lax.scan(back, last, (xs[:-1], log_ws[:-1], keys[:-1]), reverse=True)[1]


def _kalman(m, y):
    a, c, q, r = (jnp.asarray(m[k]) for k in "acqr")

    def step(carry, now):
        mean, cov, total = carry
        s = c @ cov @ c.T + r
        root = jnp.linalg.cholesky(s)
        off = now - c @ mean
        white = jax.scipy.linalg.solve_triangular(root, off, lower=True)
        gain = jax.scipy.linalg.cho_solve((root, True), c @ cov).T
        total += -0.5 * white @ white - jnp.log(jnp.diag(root)).sum()
        total += -0.5 * len(now) * np.log(2 * np.pi)
        mean, cov = mean + gain @ off, cov - gain @ c @ cov
        return (a @ mean, a @ cov @ a.T + q, total), None

    begin = jnp.asarray(m["m"]), jnp.asarray(m["p"]), 0.0
    return lax.scan(step, begin, y)[0][2]


def prepare(task: Task) -> Work | None:
    y, n = jnp.asarray(ice_varves()), task.n
    key, units = random.key(1), 1
    if task.kind == "bootstrap":
        function, given = jax.jit(lambda key, y: _log_z(key, y, PHI, TAU, n)), (key, y)
    elif task.kind == "guided":
        function, given = jax.jit(lambda key, y: _guided_log_z(key, y, n)), (key, lgss_series())
    elif task.kind == "pmmh":
        function, given, units = jax.jit(lambda key, y: _pmmh(key, y, n)), (key, y), ITERATIONS + 1
    elif task.kind == "csmc":

        def sweeps(key, y):
            begin = jnp.log(0.256 / 6.25 * y)
            sweep = lambda path, key: (_csmc(key, y, path, n), None)  # noqa: E731
            return lax.scan(sweep, begin, random.split(key, SWEEPS))[0]

        function, given, units = jax.jit(sweeps), (key, y), SWEEPS
    elif task.kind.startswith("pgas-"):
        return _pgas(n).work(task.kind.removeprefix("pgas-"))
    elif task.kind == "ffbsi":
        function, given = jax.jit(lambda key, y: _ffbsi(key, y, n)), (key, y)
    elif task.kind == "kalman":
        m, data = linear_model(n)
        function, given = jax.jit(lambda y: _kalman(m, y)), (jnp.asarray(data),)
    else:
        return None
    timed = stopwatch(lambda: jax.block_until_ready(function(*given)))
    timed()
    return lambda: timed() / units
