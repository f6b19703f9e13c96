"""Forward filtering, backward smoothing and backward sampling over finitely many values of x.

L. Rabiner, *Proceedings of the IEEE* 77 (1989), sections III A, B and V A (scaling); backward
sampling: C. Chib, *Journal of Econometrics* 75 (1996).

Notation: K values, T rows; `start` (K,), `move` (T or 1, K, K) with move[t, i, j] = P(x_t = j |
x_{t-1} = i) (row 0 without meaning where there are T), log_g (T, K) of y_t given x_t.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.flags import exact


@exact
def forward(start, move, log_g, increments, predicted, filtered):
    """Fill increments (T,), log p(y_t | y_{1:t-1}), and the laws (T, K) of x_t given y_{1:t-1} and
    given y_{1:t}; returns the row (from 0) at which no value is possible, -1 if none is."""
    n_steps, n = log_g.shape
    for t in range(n_steps):
        a = t if move.shape[0] > 1 else 0
        for j in range(n):
            if t == 0:
                predicted[0, j] = start[j]
            else:
                total = 0.0
                for i in range(n):
                    total += filtered[t - 1, i] * move[a, i, j]
                predicted[t, j] = total
        top = -np.inf
        for j in range(n):
            if predicted[t, j] > 0.0 and log_g[t, j] > top:
                top = log_g[t, j]
        if not top > -np.inf or top == np.inf:
            return t
        total = 0.0
        for j in range(n):
            filtered[t, j] = 0.0
            if predicted[t, j] > 0.0:
                filtered[t, j] = predicted[t, j] * math.exp(log_g[t, j] - top)
            total += filtered[t, j]
        if not 0.0 < total < np.inf:
            return t
        for j in range(n):
            filtered[t, j] /= total
        increments[t] = math.log(total) + top
    return -1


@exact
def backward(move, predicted, filtered, smoothed, pairs):
    """Fill the laws (T, K) of x_t given y_{1:T}, and pairs (T, K, K) of (x_{t-1}, x_t), row 0 zero;
    pairs of no rows are left out."""
    n_steps, n = filtered.shape
    last = n_steps - 1
    for j in range(n):
        smoothed[last, j] = filtered[last, j]
    ratio = np.empty(n)
    for t in range(last, 0, -1):
        a = t if move.shape[0] > 1 else 0
        for j in range(n):
            ratio[j] = smoothed[t, j] / predicted[t, j] if predicted[t, j] > 0.0 else 0.0
        for i in range(n):
            total = 0.0
            for j in range(n):
                share = filtered[t - 1, i] * move[a, i, j] * ratio[j]
                total += share
                if pairs.shape[0]:
                    pairs[t, i, j] = share
            smoothed[t - 1, i] = total
    if pairs.shape[0]:
        pairs[0] = 0.0


@exact
def sample_backward(move, filtered, uniforms, paths):
    """Fill paths (M, T) with indices of values drawn from p(x_{1:T} | y_{1:T}), by uniforms of the
    same shape."""
    n_steps, n = filtered.shape
    w = np.empty(n)
    for m in range(paths.shape[0]):
        for t in range(n_steps - 1, -1, -1):
            total = 0.0
            for i in range(n):
                w[i] = filtered[t, i]
                if t < n_steps - 1:
                    a = t + 1 if move.shape[0] > 1 else 0
                    w[i] *= move[a, i, paths[m, t + 1]]
                total += w[i]
            level, chosen = uniforms[m, t] * total, -1
            for i in range(n):
                if w[i] > 0.0:
                    chosen = i
                    level -= w[i]
                    if level < 0.0:
                        break
            paths[m, t] = chosen
