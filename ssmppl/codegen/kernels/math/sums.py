"""Ways in to a model's functions without particles: of one point, and sums over trajectories.

The functions are parameters here, as in every kernel; what they give is added to an array. T steps,
D states, M trajectories, S sums.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact


@exact
def log_prior(density, theta):
    """Log prior density of theta (P,); -inf outside the support."""
    total = np.empty(1)
    density(theta, total)
    return total[0]


@exact
def constrain(transform, theta, z, free):
    """Write the free parameters into theta from the unconstrained z; log Jacobian.

    free : by parameter, whether it is.
    """
    total = np.empty(1)
    transform(theta, z, free, total)
    return total[0]


@exact
def sum_of_path(sums, theta, y, seen, u, path, total):
    """The sums of one trajectory (T, D) in total (S,)."""
    sums(theta, y, seen, u, y.shape[0], path, total)


@exact
def weighted_statistics(sums, theta, y, seen, u, paths, weights, each, part, total):
    """Add sum_m weights[m] * sums(paths[m]) to total (S,); part (S,) is room to work in.

    paths : (M, T, D). weights : (M,). each : (M, S), written with the sums of each path, or None.
    """
    for m in range(paths.shape[0]):
        some = weights[m] != 0.0  # else it adds nothing, be it undefined; weights may be negative
        if each is None and not some:
            continue
        sums(theta, y, seen, u, y.shape[0], paths[m], part)
        for i in range(total.shape[0]):
            if some:
                total[i] += weights[m] * part[i]
            if each is not None:
                each[m, i] = part[i]


@exact
def sums_of_paths(sums, theta, y, seen, u, paths, wide, each):
    """Add sums(paths[m]) to each[m].

    paths : (M, T, D). wide : (T, D + sensitivities), room to work in. each : (M, S).
    """
    part = np.empty(each.shape[1])
    for m in range(paths.shape[0]):
        for t in range(paths.shape[1]):
            for d in range(paths.shape[2]):
                wide[t, d] = paths[m, t, d]
        sums(theta, y, seen, u, y.shape[0], wide, part)
        for i in range(each.shape[1]):
            each[m, i] += part[i]
