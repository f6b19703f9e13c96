"""Moves of the twisted filter where the noises are many: matrices in loops, not written out.

What `analysis/proposals/twisted.py` derives, for R noises and D states, at the cost of R^2 + D^2
operations a particle; it compiles in seconds, whatever R and D are. Notation as there: x_t =
F(x_{t-1}, e), f = F(., 0), L = dF / de at 0; the guide's A, g, m; C C' = I + L' A L. First in `s`
stand R and the guide: A's lower half, g, m, then mean and lower factor of the noise of x_1.

Matrices of particles are kept by entry, (entries, N), or (entries, 1) where they are the same for
all particles. `varies` : whether L depends on the particle; stands for text.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.elementary import exp, log1p
from ssmppl.codegen.kernels.math.flags import exact, kernel
from ssmppl.codegen.kernels.twisted.lookahead_backward import factorise

DEFENSIVE = 0.02  # share of the transition in the proposal's mixture; as in the analysis

# In this order each one's text may name those before it.
SPECIALISED = (
    "spread_of", "kept_factors", "twisted_fit", "twisted_look_ahead", "twisted_draw",
    "twisted_weigh", "twisted_draw_initial", "twisted_weigh_initial",
)  # fmt: skip


@kernel
def add_scaled(factor, source, sign, target):
    """target += sign * factor * source, each (N,), or factor (1,)."""
    if factor.size == 1:
        value = sign * factor[0]
        for i in range(target.size):
            target[i] += value * source[i]
    else:
        for i in range(target.size):
            target[i] += sign * factor[i] * source[i]


@kernel
def divide_row(target, divisor):
    """target /= divisor, each (N,), or divisor (1,)."""
    if divisor.size == 1:
        value = 1.0 / divisor[0]
        for i in range(target.size):
            target[i] *= value
    else:
        for i in range(target.size):
            target[i] /= divisor[i]


@kernel
def set_row(target, value):
    """target = value."""
    for i in range(target.size):
        target[i] = value


@exact
def spread_of(spread, varies, theta, c, s, x):
    """L (D R, N) by entry, or (D R, 1), at the particles x (D, N)."""
    d, r = x.shape[0], int(s[0])
    at = x
    if not varies:
        at = np.empty((d, 1))
        for j in range(d):
            at[j, 0] = x[j, 0]
    out = np.zeros((d * r, at.shape[1]))
    spread(theta, c, s, at, np.empty_like(at), out)
    return out


@exact
def factors(s, spread, d, r):
    """C by the entries of its lower half, for each L of `spread`; I where that is no number."""
    la, root = np.empty((r, d)), np.empty((r, r))
    out = np.empty((r * (r + 1) // 2, spread.shape[1]))
    for i in range(spread.shape[1]):
        for k in range(r):
            for m in range(d):
                la[k, m] = 0.0
            for n in range(r):
                root[k, n] = 1.0 if k == n else 0.0
        for j in range(d):
            for k in range(r):
                value = spread[j * r + k, i]
                if value != 0.0:
                    for m in range(d):
                        la[k, m] += value * s[1 + max(j, m) * (max(j, m) + 1) // 2 + min(j, m)]
        for j in range(d):
            for n in range(r):
                value = spread[j * r + n, i]
                if value != 0.0:
                    for k in range(r):
                        root[k, n] += la[k, j] * value
        fine = factorise(root)
        for k in range(r):
            for n in range(k + 1):
                usual = 1.0 if k == n else 0.0
                out[k * (k + 1) // 2 + n, i] = root[k, n] if fine else usual
    return out


@exact
def solve_lower(c, h):
    """h (R, N) <- C^-1 h."""
    for i in range(h.shape[0]):
        row = i * (i + 1) // 2
        for k in range(i):
            add_scaled(c[row + k], h[k], -1.0, h[i])
        divide_row(h[i], c[row + i])


@exact
def solve_upper(c, h):
    """h (R, N) <- C'^-1 h."""
    for i in range(h.shape[0] - 1, -1, -1):
        for k in range(i + 1, h.shape[0]):
            add_scaled(c[k * (k + 1) // 2 + i], h[k], -1.0, h[i])
        divide_row(h[i], c[i * (i + 1) // 2 + i])


@exact
def twisted_fit(rest, spread_of, varies, theta, c, s, states_prev, fits):
    """fits (R + 1 ..., N) <- the noise's mean under the guide, the log of what psi_t can be
    expected to be, and C where it varies."""
    d, n, r = states_prev.shape[0], states_prev.shape[1], int(s[0])
    pull, centre = 1 + d * (d + 1) // 2, 1 + d * (d + 1) // 2 + d
    away, slope = np.empty((d, n)), np.empty((d, n))
    mean, ahead = fits[:r], fits[r]
    rest(theta, c, s, states_prev, away)
    for i in range(d):
        for k in range(n):
            away[i, k] -= s[centre + i]
    for i in range(d):
        set_row(slope[i], s[pull + i])
        for j in range(d):
            k = 1 + max(i, j) * (max(i, j) + 1) // 2 + min(i, j)
            if s[k] != 0.0:
                add_scaled(s[k : k + 1], away[j], -1.0, slope[i])
    set_row(ahead, 0.0)
    for i in range(d):  # g' v - v' A v / 2, with v the way from the centre
        add_scaled(slope[i], away[i], 0.5, ahead)
        add_scaled(s[pull + i : pull + i + 1], away[i], 0.5, ahead)
    ls = spread_of(theta, c, s, states_prev)
    root = factors(s, ls, d, r)
    for k in range(r):
        set_row(mean[k], 0.0)
        for j in range(d):
            if ls.shape[1] > 1 or ls[j * r + k, 0] != 0.0:
                add_scaled(ls[j * r + k], slope[j], 1.0, mean[k])
    solve_lower(root, mean)
    for k in range(r):
        add_scaled(mean[k], mean[k], 0.5, ahead)
        row = root[k * (k + 1) // 2 + k]
        for i in range(n):
            ahead[i] -= math.log(row[min(i, row.size - 1)])
    solve_upper(root, mean)
    if varies:
        for k in range(root.shape[0]):
            for i in range(n):
                fits[r + 1 + k, i] = root[k, i]
    for i in range(n):
        total = ahead[i]
        for k in range(r):
            total += mean[k, i]
        if not abs(total) < np.inf:  # by the transition, then
            ahead[i] = -np.inf
            for k in range(r):
                mean[k, i] = 0.0


@exact
def twisted_look_ahead(theta, c, s, states_prev, fits, log_w):
    """log_w <- log of what psi_t can be expected to be, given x_{t-1}."""
    for i in range(log_w.size):
        log_w[i] = fits[int(s[0]), i]


@exact
def kept_factors(spread_of, varies, theta, c, s, x, fits):
    """C by entry, as the fit kept it, or worked out where it is the same for all."""
    if varies:
        return fits[int(s[0]) + 1 :]
    return factors(s, spread_of(theta, c, s, x), x.shape[0], int(s[0]))


@exact
def twisted_noise(mean, root, normals, uniforms, n):
    """Noise (R, N) under the guide, or for a share of the particles under the transition."""
    r = mean.shape[0]
    out = np.empty((r, n))
    for k in range(r):
        for i in range(n):
            out[k, i] = normals[k * n + i]
    solve_upper(root, out)
    for k in range(r):
        for i in range(n):
            by_guide = out[k, i] + mean[k, min(i, mean.shape[1] - 1)]
            out[k, i] = normals[k * n + i] if uniforms[i] < DEFENSIVE else by_guide
    return out


@exact
def twisted_ratio(e, mean, root, log_w):
    """log_w -= log (q / f) of the noise e (R, N)."""
    r, n = e.shape
    distance, volume = np.zeros(n), np.zeros(n)
    inward, gone = np.empty(n), np.empty((r, n))
    for k in range(r):
        add_scaled(e[k], e[k], 0.5, distance)
        for i in range(n):
            gone[k, i] = e[k, i] - mean[k, min(i, mean.shape[1] - 1)]
        row = root[k * (k + 1) // 2 + k]
        for i in range(n):
            volume[i] += math.log(row[min(i, row.size - 1)])
    for k in range(r):
        set_row(inward, 0.0)
        for j in range(k, r):
            add_scaled(root[j * (j + 1) // 2 + k], gone[j], 1.0, inward)
        add_scaled(inward, inward, -0.5, distance)
    least, odds = math.log(DEFENSIVE), math.log((1.0 - DEFENSIVE) / DEFENSIVE)
    for i in range(n):
        above = odds + volume[i] + distance[i]
        log_w[i] -= least + max(above, 0.0) + log1p(exp(-abs(above)))


@exact
def twisted_draw(
    kept_factors, follow,
    theta, c, s, states_prev, fits, states, normals, uniforms, rng,
):  # fmt: skip
    """Draw x_t given x_{t-1} under the guide."""
    root = kept_factors(theta, c, s, states_prev, fits)
    e = twisted_noise(fits[: int(s[0])], root, normals, uniforms, states.shape[1])
    follow(theta, c, s, states_prev, e, states)


@exact
def twisted_weigh(
    kept_factors, recover, weigh_observed,
    theta, c, s, states_prev, fits, states, log_w,
):  # fmt: skip
    """Log weight of x_t: log f + log g - log q."""
    root = kept_factors(theta, c, s, states_prev, fits)
    e = np.zeros((int(s[0]), states.shape[1]))
    recover(theta, c, s, states_prev, states, e)
    weigh_observed(theta, c, s, states, log_w)
    twisted_ratio(e, fits[: int(s[0])], root, log_w)


@exact
def start_of(s, d):
    """Mean (R, 1) of the noise of x_1 under the guide, and C (R (R + 1) / 2, 1)."""
    r, at = int(s[0]), 1 + d * (d + 1) // 2 + 2 * d
    mean, root = np.empty((r, 1)), np.empty((r * (r + 1) // 2, 1))
    for k in range(r):
        mean[k, 0] = s[at + k]
    for k in range(root.shape[0]):
        root[k, 0] = s[at + r + k]
    return mean, root


@exact
def twisted_draw_initial(begin, theta, c, s, states, normals, uniforms, rng):
    """Draw x_1 under the guide."""
    mean, root = start_of(s, states.shape[0])
    begin(theta, c, s, twisted_noise(mean, root, normals, uniforms, states.shape[1]), states)


@exact
def twisted_weigh_initial(
    recover_initial, weigh_observed, theta, c, s, states, log_w
):  # fmt: skip
    """Log weight of x_1."""
    mean, root = start_of(s, states.shape[0])
    e = np.zeros((int(s[0]), states.shape[1]))
    recover_initial(theta, c, s, states, e)
    weigh_observed(theta, c, s, states, log_w)
    twisted_ratio(e, mean, root, log_w)
