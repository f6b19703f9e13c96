"""Forward filtering, backward smoothing and backward sampling over finitely many values of x.

L. Rabiner, *Proceedings of the IEEE* 77 (1989), sections III A, B and V A (scaling); backward
sampling: C. Chib, *Journal of Econometrics* 75 (1996).

Notation: S sequences of T rows, K values; log_start (S or 1, K), log_move (S or 1, T or 1, K, K)
with exp(log_move[s, t, i, j]) = move[s, t, i, j] = P(x_t = j | x_{t-1} = i) (row 0 without meaning
where there are T), log_g (S, T, K) of y_t given x_t. What has one row where there are S or T is the
same for all. From a value i that the data rule out the move need not be defined: its probability 0
is no factor of it.

Each pass stands here twice: by probabilities, and (`..._logs`) by logarithms, exact however
unlikely a value has become, with the logarithms of `move`, `predicted` and `filtered` in their
places.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact

UNSURE = -2  # stopped where ordinary numbers do not tell
FAINT, DIM = 1e-180, 1e-160  # shares; see `forward`
LEFT_FAINT = math.log(FAINT / DIM)  # log densities of a row, less log p(y_t), that leave dim faint


@exact
def chosen_of(w, level):
    """The index of the weight within which a level between 0 and their sum lies."""
    chosen = -1
    for i in range(w.size):
        if w[i] > 0.0:
            chosen = i
            level -= w[i]
            if level < 0.0:
                break
    return chosen


@exact
def forward(move, log_start, log_move, log_g, increments, predicted, filtered, stopped):
    """Fill increments (S, T), log p(y_t | y_{1:t-1}), the laws (S, T, K) of x_t given y_{1:t-1} and
    given y_{1:t}, and stopped (S,), the row (from 0) at which no value is possible, -1 if none
    is, UNSURE where these laws may lack a value that matters.

    A share below FAINT is faint. It does not matter in the next row where the others come to DIM;
    where they do not, the value there is dim, of a share below about DIM, and it has to be shown
    that the row of data leaves it faint. In the end what is faint does not matter.
    """
    n_sequences, n_steps, n = log_g.shape
    faint, dim = np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.bool_)
    for s in range(n_sequences):
        first = s if log_start.shape[0] > 1 else 0
        b = s if move.shape[0] > 1 else 0
        stopped[s] = -1
        for t in range(n_steps):
            a = t if move.shape[1] > 1 else 0
            for j in range(n):
                if t == 0:
                    total = math.exp(log_start[first, j])
                    dim[j] = total < DIM and log_start[first, j] > -np.inf
                else:
                    total = 0.0
                    for i in range(n):
                        if filtered[s, t - 1, i] > 0.0:
                            total += filtered[s, t - 1, i] * move[b, a, i, j]
                    dim[j] = False
                    if total < DIM:
                        for i in range(n):
                            if faint[i] or filtered[s, t - 1, i] > 0.0:
                                dim[j] = dim[j] or log_move[b, a, i, j] > -np.inf
                predicted[s, t, j] = total
            top, hidden = -np.inf, -np.inf
            for j in range(n):
                if dim[j] and log_g[s, t, j] > hidden:
                    hidden = log_g[s, t, j]
                if not dim[j] and predicted[s, t, j] > 0.0 and log_g[s, t, j] > top:
                    top = log_g[s, t, j]
            if top == np.inf:
                stopped[s] = t
                break
            if not top > -np.inf:
                stopped[s] = UNSURE if hidden > -np.inf else t
                break
            total = 0.0
            for j in range(n):
                filtered[s, t, j] = 0.0
                if predicted[s, t, j] > 0.0 and not dim[j]:
                    filtered[s, t, j] = predicted[s, t, j] * math.exp(log_g[s, t, j] - top)
                total += filtered[s, t, j]
            if not 0.0 < total < np.inf:
                # the likeliest by the data may be too unlikely before them
                stopped[s] = UNSURE if total == 0.0 else t
                break
            increments[s, t] = math.log(total) + top
            if hidden - increments[s, t] > LEFT_FAINT:
                stopped[s] = UNSURE
                break
            for j in range(n):
                filtered[s, t, j] /= total
                possible = dim[j] or predicted[s, t, j] > 0.0
                faint[j] = possible and filtered[s, t, j] < FAINT and log_g[s, t, j] > -np.inf


@exact
def backward(move, predicted, filtered, smoothed, pairs):
    """Fill the laws (S, T, K) of x_t given y_{1:T}, and pairs (S, T, K, K) of (x_{t-1}, x_t), row 0
    zero; pairs of no sequences are left out."""
    n_sequences, n_steps, n = filtered.shape
    last = n_steps - 1
    ratio = np.empty(n)
    for s in range(n_sequences):
        b = s if move.shape[0] > 1 else 0
        for j in range(n):
            smoothed[s, last, j] = filtered[s, last, j]
        for t in range(last, 0, -1):
            a = t if move.shape[1] > 1 else 0
            for j in range(n):
                ratio[j] = 0.0
                if predicted[s, t, j] > 0.0:
                    ratio[j] = smoothed[s, t, j] / predicted[s, t, j]
            for i in range(n):
                total = 0.0
                for j in range(n):
                    share = 0.0
                    if filtered[s, t - 1, i] > 0.0:
                        share = filtered[s, t - 1, i] * move[b, a, i, j] * ratio[j]
                    total += share
                    if pairs.shape[0]:
                        pairs[s, t, i, j] = share
                smoothed[s, t - 1, i] = total
        if pairs.shape[0]:
            pairs[s, 0] = 0.0


@exact
def sample_backward(move, filtered, which, uniforms, paths):
    """Fill paths (M, T) with indices of values drawn from p(x_{1:T} | y_{1:T}), path m of sequence
    which[m], by uniforms of the same shape."""
    n_steps, n = filtered.shape[1:]
    w = np.empty(n)
    for m in range(paths.shape[0]):
        s = which[m]
        b = s if move.shape[0] > 1 else 0
        for t in range(n_steps - 1, -1, -1):
            total = 0.0
            for i in range(n):
                w[i] = filtered[s, t, i]
                if t < n_steps - 1 and w[i] > 0.0:
                    a = t + 1 if move.shape[1] > 1 else 0
                    w[i] *= move[b, a, i, paths[m, t + 1]]
                total += w[i]
            paths[m, t] = chosen_of(w, uniforms[m, t] * total)


@exact
def forward_logs(log_start, log_move, log_g, increments, predicted, filtered, stopped):
    """As `forward`; stopped is never UNSURE."""
    n_sequences, n_steps, n = log_g.shape
    for s in range(n_sequences):
        first = s if log_start.shape[0] > 1 else 0
        b = s if log_move.shape[0] > 1 else 0
        stopped[s] = -1
        for t in range(n_steps):
            a = t if log_move.shape[1] > 1 else 0
            top = -np.inf
            for j in range(n):
                if t == 0:
                    predicted[s, 0, j] = log_start[first, j]
                else:
                    most, total = -np.inf, 0.0
                    for i in range(n):
                        way = filtered[s, t - 1, i] + log_move[b, a, i, j]
                        if filtered[s, t - 1, i] > -np.inf and way > most:
                            most = way
                    for i in range(n):
                        if most > -np.inf and filtered[s, t - 1, i] > -np.inf:
                            total += math.exp(filtered[s, t - 1, i] + log_move[b, a, i, j] - most)
                    predicted[s, t, j] = math.log(total) + most if total > 0.0 else -np.inf
                if predicted[s, t, j] > -np.inf and predicted[s, t, j] + log_g[s, t, j] > top:
                    top = predicted[s, t, j] + log_g[s, t, j]
            if not top > -np.inf or top == np.inf:
                stopped[s] = t
                break
            total = 0.0
            for j in range(n):
                filtered[s, t, j] = -np.inf
                if predicted[s, t, j] > -np.inf:
                    filtered[s, t, j] = predicted[s, t, j] + log_g[s, t, j] - top
                    total += math.exp(filtered[s, t, j])
            if not 0.0 < total < np.inf:
                stopped[s] = t
                break
            for j in range(n):
                filtered[s, t, j] -= math.log(total)
            increments[s, t] = math.log(total) + top


@exact
def backward_logs(move, predicted, filtered, smoothed, pairs):
    """As `backward`; smoothed and pairs are probabilities."""
    n_sequences, n_steps, n = filtered.shape
    last = n_steps - 1
    ratio, log_law = np.empty(n), np.empty(n)
    for s in range(n_sequences):
        b = s if move.shape[0] > 1 else 0
        for j in range(n):
            log_law[j] = filtered[s, last, j]
            smoothed[s, last, j] = math.exp(log_law[j])
        for t in range(last, 0, -1):
            a = t if move.shape[1] > 1 else 0
            for j in range(n):
                ratio[j] = -np.inf
                if log_law[j] > -np.inf:
                    ratio[j] = log_law[j] - predicted[s, t, j]
            for i in range(n):
                own = filtered[s, t - 1, i]
                most, total = -np.inf, 0.0
                for j in range(n):
                    possible = own > -np.inf and ratio[j] > -np.inf
                    if possible and move[b, a, i, j] + ratio[j] > most:
                        most = move[b, a, i, j] + ratio[j]
                for j in range(n):
                    share = -np.inf
                    if own > -np.inf and ratio[j] > -np.inf:
                        share = move[b, a, i, j] + ratio[j]
                    if most > -np.inf:
                        total += math.exp(share - most)
                    if pairs.shape[0]:
                        pairs[s, t, i, j] = math.exp(share + own)
                log_law[i] = own + math.log(total) + most if total > 0.0 else -np.inf
                smoothed[s, t - 1, i] = math.exp(log_law[i])
        if pairs.shape[0]:
            pairs[s, 0] = 0.0


@exact
def sample_backward_logs(move, filtered, which, uniforms, paths):
    """As `sample_backward`."""
    n_steps, n = filtered.shape[1:]
    w = np.empty(n)
    for m in range(paths.shape[0]):
        s = which[m]
        b = s if move.shape[0] > 1 else 0
        for t in range(n_steps - 1, -1, -1):
            most, total = -np.inf, 0.0
            for i in range(n):
                w[i] = filtered[s, t, i]
                if t < n_steps - 1 and w[i] > -np.inf:
                    a = t + 1 if move.shape[1] > 1 else 0
                    w[i] += move[b, a, i, paths[m, t + 1]]
                if w[i] > most:
                    most = w[i]
            for i in range(n):
                w[i] = math.exp(w[i] - most)
                total += w[i]
            paths[m, t] = chosen_of(w, uniforms[m, t] * total)
