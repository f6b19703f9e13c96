"""Trajectories as the noises behind them, and back: what moves theta with its noises held fixed.

Without a guide the noise is that of the model's own laws, x_t = F(x_{t-1}, e_t). With one
(`steered`) it is that of a Gaussian approximation to p(x_{1:T} | y_{1:T}, theta), written forward
in time: given x_{t-1} it takes e_t for Normal with precision M = I + L' A L = C C' and mean
M^-1 L' (g - A (f - m)), and z_t = C' (e_t - mean). The guide A, g about m is that of
`guide_back.look_back` along a reference trajectory which is fixed for good, so that it is a
function of theta alone, and z <-> x is one to one for every theta.

Notation as in `lookahead.py`; R' the larger number of noises of both laws.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.twisted.lookahead import spread_out
from ssmppl.codegen.kernels.twisted.lookahead_backward import factorise


@exact
def linearise(
    prepare, step, linear_initial, linear, look_at, sizes,
    theta, y, seen, u, x, looking, rest, jacobian, spread, spread_initial, g, h,
):  # fmt: skip
    """The model's derivatives at theta along a given trajectory x (T, D); False if no number.

    looking : whether to write g and h too, which may be known from another theta.
    """
    n_steps, d = x.shape
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    before, now = np.empty((d, 1)), np.empty((d, 1))
    values = np.zeros((d + d * d + d * spread.shape[2], 1))
    told_initial = np.zeros((d + d * spread_initial.shape[1], 1))
    seen_so = np.zeros((1 + d + d * (d + 1) // 2, 1))
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        for i in range(d):
            now[i, 0] = x[t, i]
        if t == 0:
            linear_initial(theta, c, s, now, told_initial)
            spread_out(told_initial, rest[0], jacobian[0], spread_initial)
        else:
            linear(theta, c, s, before, now, values)
            spread_out(values, rest[t], jacobian[t], spread[t])
        if looking and not abs(look_at(theta, c, s, now, seen_so, g[t], h[t])) < np.inf:
            return False
        for i in range(d):
            before[i, 0] = now[i, 0]
    return True


@exact
def noise_law(a, pull, centre, rest, spread, r, factor, mean):
    """C (R, R) and the mean (R,) of the noise given x_{t-1}; sum log C_kk, nan where there is none.

    rest (D,), spread (D, R') : at x_{t-1}, of which the first r columns count.
    """
    d = rest.size
    if d == 1 and r == 1:
        size = spread[0, 0]
        precision = 1.0 + size * a[0, 0] * size
        if not precision > 0.0:
            return np.nan
        factor[0, 0] = math.sqrt(precision)
        mean[0] = size * (pull[0] - a[0, 0] * (rest[0] - centre[0])) / precision
        return 0.5 * math.log(precision)
    for k in range(r):
        mean[k] = 0.0
        for n in range(r):
            factor[k, n] = 1.0 if k == n else 0.0
    for i in range(d):
        steered = pull[i]
        for j in range(d):
            steered -= a[i, j] * (rest[j] - centre[j])
        for k in range(r):
            mean[k] += spread[i, k] * steered
            for j in range(d):
                for n in range(k + 1):
                    factor[k, n] += spread[i, k] * a[i, j] * spread[j, n]
    if not factorise(factor[:r, :r]):
        return np.nan
    total = 0.0
    for k in range(r):
        for n in range(k):
            mean[k] -= factor[k, n] * mean[n]
        mean[k] /= factor[k, k]
        total += math.log(factor[k, k])
    for k in range(r - 1, -1, -1):
        for n in range(k + 1, r):
            mean[k] -= factor[n, k] * mean[n]
        mean[k] /= factor[k, k]
    return total


@exact
def noise_of(
    prepare, step, recover_initial, recover, linear_initial, linear, sizes, steered, noises,
    theta, y, seen, u, a, pull, centre, x, e,
):  # fmt: skip
    """e (T, R'), or z where steered, of a trajectory x (T, D); returns log |dx / de|.

    noises : how many each law has. a (T, D, D), pull (T, D), centre (T, D) : the guide, not read
    unless steered. Noises that a law lacks are 0.
    """
    n_steps, d = x.shape
    widest = e.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    before, now = np.empty((d, 1)), np.empty((d, 1))
    values = np.empty((widest + 1, 1))
    line, line_initial = np.zeros((d + d * d + d * noises[1], 1)), np.zeros((d + d * noises[0], 1))
    rest, jacobian = np.empty(d), np.empty((d, d))
    spread, spread_initial = np.empty((d, noises[1])), np.empty((d, noises[0]))
    factor, mean = np.empty((widest, widest)), np.empty(widest)
    total = 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        for i in range(d):
            now[i, 0] = x[t, i]
        r = noises[0] if t == 0 else noises[1]
        if t == 0:
            recover_initial(theta, c, s, now, values)
        else:
            recover(theta, c, s, before, now, values)
        total += values[r, 0]
        for k in range(widest):
            e[t, k] = values[k, 0] if k < r else 0.0
        if steered:
            if t == 0:
                linear_initial(theta, c, s, now, line_initial)
                spread_out(line_initial, rest, jacobian, spread_initial)
                total -= noise_law(a[t], pull[t], centre[t], rest, spread_initial, r, factor, mean)
            else:
                linear(theta, c, s, before, now, line)
                spread_out(line, rest, jacobian, spread)
                total -= noise_law(a[t], pull[t], centre[t], rest, spread, r, factor, mean)
            for k in range(r):
                away = 0.0
                for n in range(k, r):
                    away += factor[n, k] * (e[t, n] - mean[n])
                e[t, k] = away
        for i in range(d):
            before[i, 0] = now[i, 0]
    return total


@exact
def path_of(
    prepare, step, begin, follow, recover_initial, recover, linear_initial, linear, sizes, steered,
    noises, theta, y, seen, u, a, pull, centre, kept, e, x,
):  # fmt: skip
    """The trajectory x (T, D) of noises e (T, R'), the inverse of `noise_of`; log |dx / de|.

    kept (T, D) : the trajectory that theta moves away from; states without noise stay there.
    """
    n_steps, d = x.shape
    widest = e.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    before, now = np.empty((d, 1)), np.empty((d, 1))
    values = np.empty((widest + 1, 1))
    line, line_initial = np.zeros((d + d * d + d * noises[1], 1)), np.zeros((d + d * noises[0], 1))
    rest, jacobian = np.empty(d), np.empty((d, d))
    spread, spread_initial = np.empty((d, noises[1])), np.empty((d, noises[0]))
    factor, mean, noise = np.empty((widest, widest)), np.empty(widest), np.empty(widest)
    total = 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        r = noises[0] if t == 0 else noises[1]
        for k in range(r):
            noise[k] = e[t, k]
        if steered:
            if t == 0:
                linear_initial(theta, c, s, now, line_initial)
                spread_out(line_initial, rest, jacobian, spread_initial)
                total -= noise_law(a[t], pull[t], centre[t], rest, spread_initial, r, factor, mean)
            else:
                linear(theta, c, s, before, now, line)
                spread_out(line, rest, jacobian, spread)
                total -= noise_law(a[t], pull[t], centre[t], rest, spread, r, factor, mean)
            for k in range(r - 1, -1, -1):
                for n in range(k + 1, r):
                    noise[k] -= factor[n, k] * noise[n]
                noise[k] /= factor[k, k]
            for k in range(r):
                noise[k] += mean[k]
        if t == 0:
            begin(theta, c, s, noise, kept[t], now)
            recover_initial(theta, c, s, now, values)
        else:
            follow(theta, c, s, before, noise, kept[t], now)
            recover(theta, c, s, before, now, values)
        total += values[r, 0]
        if not abs(total) < np.inf:
            return np.nan
        for i in range(d):
            x[t, i] = now[i, 0]
            before[i, 0] = now[i, 0]
    return total
