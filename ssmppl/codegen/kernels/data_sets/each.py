"""Passes over the data sets of a problem, end to end in R rows, one compiled call for all.

Data set e of E has the rows first[e], ..., first[e + 1] - 1. `run` is an algorithm for one, and
`constants` what it takes before theta (`native/entries.py`). What a run draws it draws from the one
stream, one data set after the other.
"""

from __future__ import annotations

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.particle.weights import OK


@exact
def sums_of_each(run, constants, theta, y, seen, u, first, paths, each):
    """Fill each (E, F) with the sums over a data set and its path (`math/sums.py`, `sum_of_path`),
    of paths (R, D)."""
    for e in range(each.shape[0]):
        a, b = first[e], first[e + 1]
        run(*constants, theta, y[a:b], seen[a:b], u[a:b], paths[a:b], each[e])


@exact
def filter_each(
    run, constants, theta, y, seen, u, first, particles, scheme, ess_threshold, rng,
    log_increment, ess,
):  # fmt: skip
    """Run `particle_filter` over each; (status, t, e), of the first data set whose status is other
    than OK. log_increment, ess : (R,), written."""
    for e in range(first.size - 1):
        a, b = first[e], first[e + 1]
        status, t = run(
            *constants, theta, y[a:b], seen[a:b], u[a:b], particles, scheme, ess_threshold, rng,
            log_increment[a:b], ess[a:b], None,
        )  # fmt: skip
        if status != OK:
            return status, t, e
    return OK, 0, 0


@exact
def conditional_smc_each(
    run, constants, theta, y, seen, u, first, particles, rng, reference, trajectory, statistics
):
    """One sweep of `conditional_smc` for each; (status, t, e), likewise.

    reference, trajectory : (R, D). statistics : (E, 2), written.
    """
    for e in range(first.size - 1):
        a, b = first[e], first[e + 1]
        status, t = run(
            *constants, theta, y[a:b], seen[a:b], u[a:b], particles, rng, reference[a:b],
            trajectory[a:b], statistics[e],
        )  # fmt: skip
        if status != OK:
            return status, t, e
    return OK, 0, 0


@exact
def linearise_each(
    run, constants, theta, y, seen, u, first, x, looking, rest, jacobian, spread, spread_initial,
    g, h,
):  # fmt: skip
    """`linearise` (`twisted/interweaving.py`) for each; False where one is no number.

    x, rest, g : (R, D). jacobian, h : (R, D, D). spread : (R, D, N). spread_initial : (E, D, N_1).
    """
    for e in range(first.size - 1):
        a, b = first[e], first[e + 1]
        if not run(
            *constants, theta, y[a:b], seen[a:b], u[a:b], x[a:b], looking, rest[a:b],
            jacobian[a:b], spread[a:b], spread_initial[e], g[a:b], h[a:b],
        ):  # fmt: skip
            return False
    return True


@exact
def noise_of_each(
    run, constants, theta, y, seen, u, first, a, pull, centre, x, noise, log_volume
):  # fmt: skip
    """`noise_of` (`twisted/interweaving.py`) for each; log_volume (E,) and noise (R, N'),
    written."""
    for e in range(first.size - 1):
        i, j = first[e], first[e + 1]
        log_volume[e] = run(
            *constants, theta, y[i:j], seen[i:j], u[i:j], a[i:j], pull[i:j], centre[i:j], x[i:j],
            noise[i:j],
        )  # fmt: skip


@exact
def path_of_each(
    run, constants, theta, y, seen, u, first, a, pull, centre, kept, noise, x, log_volume
):  # fmt: skip
    """`path_of` (`twisted/interweaving.py`) for each; log_volume (E,) and x (R, D), written. False
    where one is no number."""
    for e in range(first.size - 1):
        i, j = first[e], first[e + 1]
        log_volume[e] = run(
            *constants, theta, y[i:j], seen[i:j], u[i:j], a[i:j], pull[i:j], centre[i:j],
            kept[i:j], noise[i:j], x[i:j],
        )  # fmt: skip
        if not abs(log_volume[e]) < float("inf"):
            return False
    return True
