"""Statistics of many trajectories: each one's own, and their weighted means."""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.flags import exact


@exact
def weighted_statistics(
    statistics, theta, y, seen, u, paths, weights, each, part, total
):  # fmt: skip
    """Add sum_m weights[m] * statistics(paths[m]) to total (S,); part (S,) is room to work in.

    paths : (M, T, D). weights : (M,). each : (M, S), written with the statistics of each path, or
    None.
    """
    for m in range(paths.shape[0]):
        some = weights[m] != 0.0  # else it adds nothing, be it undefined; weights may be negative
        if each is None and not some:
            continue
        statistics(theta, y, seen, u, paths[m], part)
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
        sums(theta, y, seen, u, wide, part)
        for i in range(each.shape[1]):
            each[m, i] += part[i]
