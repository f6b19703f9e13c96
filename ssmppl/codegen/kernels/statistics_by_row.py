"""What each row of a trajectory adds to the statistics of parameters that are eliminated."""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.flags import exact


@exact
def statistics_by_row(
    prepare, step, tell_initial, tell, tell_observed, sizes,
    theta, y, seen, u, trajectory, moved, measured,
):  # fmt: skip
    """moved[t] (K,) : of x_t given x_{t-1}, at row 0 of x_1; measured[t] (K,) : of y_t given x_t.

    trajectory : (T, D).
    """
    n_steps, d = trajectory.shape
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x_prev, x, told = np.empty((d, 1)), np.empty((d, 1)), np.empty((moved.shape[1], 1))
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        for i in range(d):
            x_prev[i, 0] = x[i, 0]
            x[i, 0] = trajectory[t, i]
        if t == 0:
            tell_initial(theta, c, s, x, told)
        else:
            tell(theta, c, s, x_prev, x, told)
        moved[t] = told[:, 0]
        tell_observed(theta, c, s, x, told)
        measured[t] = told[:, 0]
