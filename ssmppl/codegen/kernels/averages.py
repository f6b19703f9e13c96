"""Weighted means of statistics over trajectories."""

from __future__ import annotations

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
        if each is None and weights[m] == 0.0:
            continue
        statistics(theta, y, seen, u, paths[m], part)
        for i in range(total.shape[0]):
            total[i] += weights[m] * part[i]
            if each is not None:
                each[m, i] = part[i]
