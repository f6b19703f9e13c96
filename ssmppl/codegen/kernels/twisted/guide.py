"""The guides of a twisted particle filter over data sets end to end, in one compiled call.

For each data set a trajectory to linearise along is searched for, forward and backward by turns
(`lookahead.py`, `lookahead_backward.py`), and the guide along it written. Of short series the
passes take less time than calling each of them from Python would.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.twisted.lookahead_backward import look_back, write_guide

SHARES = (1.0, 0.5, 0.2, 0.05)  # of a step that are tried
SEARCHED, BEGUN, AT_MODE = 0, 1, 2  # where the search begins
NO_NUMBER, REFERENCE, GUIDE = 0, 1, 2  # what was found


@exact
def guide_each(
    filter_pass, gains_pass, sizes, theta, y, seen, u, first, begun, most_steps, close, noises,
    horizon, x, e, out, found,
):  # fmt: skip
    """About the likeliest trajectory of each of E data sets, and the guide along it.

    Data set i has the rows first[i], ..., first[i + 1] - 1 of R. begun : the search begins from the
    extended Kalman filter (`SEARCHED`) or from the noise e (`BEGUN`), or ends with that
    (`AT_MODE`). most_steps : forward passes that improve the trajectory; close : nats of
    improvement with which they end. noises : those of the transition and of the initial
    distribution, R' the larger. horizon : as of `look_back`.
    x (R, D), e (R, R') : the trajectory and its noise, written, as are out (R, U + G), as by
    `write_guide` where there is a guide (without columns: none is wanted), and found (E,):
    `NO_NUMBER` where the extended Kalman filter comes to none, `GUIDE` where there is a guide, else
    `REFERENCE`.
    """
    d, widest = x.shape[1], e.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    for i in range(first.size - 1):
        begin, end = first[i], first[i + 1]
        n = end - begin
        given, told, inputs = y[begin:end], seen[begin:end], u[begin:end]
        # The best trajectory with the model's derivatives along it, and one that is tried.
        x_best, e_best = np.zeros((n, d)), np.zeros((n, widest))
        rest_best, jacobian_best = np.zeros((n, d)), np.zeros((n, d, d))
        spread_best, initial_best = np.zeros((n, d, noises[0])), np.zeros((d, noises[1]))
        g_best, h_best = np.zeros((n, d)), np.zeros((n, d, d))
        x_new, e_new = np.zeros((n, d)), np.zeros((n, widest))
        rest_new, jacobian_new = np.zeros((n, d)), np.zeros((n, d, d))
        spread_new, initial_new = np.zeros((n, d, noises[0])), np.zeros((d, noises[1]))
        g_new, h_new = np.zeros((n, d)), np.zeros((n, d, d))
        a, pull, increments = np.zeros((n, d, d)), np.zeros((n, d)), np.empty(n)
        aim, gain = np.zeros((n, widest)), np.zeros((n, widest, d))
        found[i] = NO_NUMBER
        value, steps, ended, starting = -np.inf, 0, False, begun != SEARCHED
        # Each pass is called at one place, and arrays are filled by entries: every further call,
        # and what Numba writes for slices, adds seconds to the compilation.
        e_old = e[begin:end]
        while True:
            if not starting:
                if found[i] == NO_NUMBER:
                    if not filter_pass(
                        theta, given, told, inputs, c, s, x_best, a, increments, rest_best,
                        jacobian_best, spread_best, initial_best, g_best, h_best,
                    ) > -np.inf:  # fmt: skip
                        break
                    found[i] = REFERENCE
                if ended and out.shape[1] == 0:  # no guide is wanted
                    break
                fine = look_back(
                    x_best, rest_best, jacobian_best, spread_best, initial_best, g_best, h_best,
                    horizon if ended else 0, a, pull, aim, gain,
                )  # fmt: skip
                if ended:
                    rows = out[begin:end]
                    if fine and write_guide(a, pull, x_best, inputs, aim[0], initial_best, rows):
                        total = 0.0
                        for t in range(n):
                            for j in range(rows.shape[1]):
                                total += 0.0 * rows[t, j]
                        found[i] = GUIDE if total == 0.0 else REFERENCE
                    break
                if not fine:
                    ended = True
                    continue
            now = -np.inf
            for m in range(1 if starting else len(SHARES)):
                now = gains_pass(
                    theta, given, told, inputs, c, s, 0.0 if starting else SHARES[m], x_best,
                    e_old if starting else e_best, aim, gain, x_new, e_new, rest_new,
                    jacobian_new, spread_new, initial_new, g_new, h_new,
                )  # fmt: skip
                if now > value:
                    break
            if now > value:
                ended = now - value < close or (starting and begun == AT_MODE)
                found[i], value, steps = REFERENCE, now, steps + 1
                x_best, x_new, e_best, e_new = x_new, x_best, e_new, e_best
                rest_best, rest_new = rest_new, rest_best
                jacobian_best, jacobian_new = jacobian_new, jacobian_best
                spread_best, spread_new = spread_new, spread_best
                initial_best, initial_new = initial_new, initial_best
                g_best, g_new, h_best, h_new = g_new, g_best, h_new, h_best
            else:
                ended = not starting
            ended, starting = ended or steps >= most_steps, False
        if found[i] != NO_NUMBER:
            for t in range(n):
                for j in range(d):
                    x[begin + t, j] = x_best[t, j]
                for j in range(widest):
                    e[begin + t, j] = e_best[t, j]
