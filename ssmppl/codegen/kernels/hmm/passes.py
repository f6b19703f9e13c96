"""Forward filtering, backward smoothing and backward sampling over finitely many values of x.

L. Rabiner, *Proceedings of the IEEE* 77 (1989), sections III A, B and V A (scaling); backward
sampling: C. Chib, *Journal of Econometrics* 75 (1996).

Notation: S sequences end to end in R rows, sequence s in rows first[s], ..., first[s + 1] - 1; K
values; log_start (S, K), log_move (R or 1, K, K) with exp(log_move[t, i, j]) = move[t, i, j] =
P(x_t = j | x_{t-1} = i), which is without meaning at the first row of a sequence, and the same for
all where there is one row; log_g (R, K) of y_t given x_t. From a value i that the data rule out the
move need not be defined: its probability 0 is no factor of it.

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
def forward(first, move, log_start, log_move, log_g, increments, predicted, filtered, stopped):
    """Fill increments (R,), log p(y_t | y_{1:t-1}), the laws (R, K) of x_t given y_{1:t-1} and
    given y_{1:t}, and stopped (S,), the row (from 0, of the sequence) at which no value is
    possible, -1 if none is, UNSURE where these laws may lack a value that matters.

    A share below FAINT is faint. It does not matter in the next row where the others come to DIM;
    where they do not, the value there is dim, of a share below about DIM, and it has to be shown
    that the row of data leaves it faint. In the end what is faint does not matter.
    """
    n = log_g.shape[1]
    faint, dim = np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.bool_)
    for s in range(stopped.size):
        begin = first[s]
        stopped[s] = -1
        for t in range(begin, first[s + 1]):
            a = t if move.shape[0] > 1 else 0
            for j in range(n):
                if t == begin:
                    total = math.exp(log_start[s, j])
                    dim[j] = total < DIM and log_start[s, j] > -np.inf
                else:
                    total = 0.0
                    for i in range(n):
                        if filtered[t - 1, i] > 0.0:
                            total += filtered[t - 1, i] * move[a, i, j]
                    dim[j] = False
                    if total < DIM:
                        for i in range(n):
                            if faint[i] or filtered[t - 1, i] > 0.0:
                                dim[j] = dim[j] or log_move[a, i, j] > -np.inf
                predicted[t, j] = total
            top, hidden = -np.inf, -np.inf
            for j in range(n):
                if dim[j] and log_g[t, j] > hidden:
                    hidden = log_g[t, j]
                if not dim[j] and predicted[t, j] > 0.0 and log_g[t, j] > top:
                    top = log_g[t, j]
            if top == np.inf:
                stopped[s] = t - begin
                break
            if not top > -np.inf:
                stopped[s] = UNSURE if hidden > -np.inf else t - begin
                break
            total = 0.0
            for j in range(n):
                filtered[t, j] = 0.0
                if predicted[t, j] > 0.0 and not dim[j]:
                    filtered[t, j] = predicted[t, j] * math.exp(log_g[t, j] - top)
                total += filtered[t, j]
            if not 0.0 < total < np.inf:
                # the likeliest by the data may be too unlikely before them
                stopped[s] = UNSURE if total == 0.0 else t - begin
                break
            increments[t] = math.log(total) + top
            if hidden - increments[t] > LEFT_FAINT:
                stopped[s] = UNSURE
                break
            for j in range(n):
                filtered[t, j] /= total
                possible = dim[j] or predicted[t, j] > 0.0
                faint[j] = possible and filtered[t, j] < FAINT and log_g[t, j] > -np.inf


@exact
def backward(first, move, predicted, filtered, smoothed, pairs):
    """Fill the laws (R, K) of x_t given y_{1:T}, and pairs (R, K, K) of (x_{t-1}, x_t), zero at the
    first rows; pairs of no rows are left out."""
    n = filtered.shape[1]
    ratio = np.empty(n)
    for s in range(first.size - 1):
        begin, last = first[s], first[s + 1] - 1
        for j in range(n):
            smoothed[last, j] = filtered[last, j]
        for t in range(last, begin, -1):
            a = t if move.shape[0] > 1 else 0
            for j in range(n):
                ratio[j] = 0.0
                if predicted[t, j] > 0.0:
                    ratio[j] = smoothed[t, j] / predicted[t, j]
            for i in range(n):
                total = 0.0
                for j in range(n):
                    share = 0.0
                    if filtered[t - 1, i] > 0.0:
                        share = filtered[t - 1, i] * move[a, i, j] * ratio[j]
                    total += share
                    if pairs.shape[0]:
                        pairs[t, i, j] = share
                smoothed[t - 1, i] = total
        if pairs.shape[0]:
            pairs[begin] = 0.0


@exact
def sample_backward(first, move, filtered, which, uniforms, paths):
    """Fill paths with indices of values drawn from p(x_{1:T} | y_{1:T}), path m of sequence
    which[m], end to end, by as many uniforms."""
    n = filtered.shape[1]
    w = np.empty(n)
    at = 0  # the place of the row `first[which[m]]` of path m
    for m in range(which.size):
        begin, end = first[which[m]], first[which[m] + 1]
        for t in range(end - 1, begin - 1, -1):
            k = at + t - begin
            total = 0.0
            for i in range(n):
                w[i] = filtered[t, i]
                if t < end - 1 and w[i] > 0.0:
                    a = t + 1 if move.shape[0] > 1 else 0
                    w[i] *= move[a, i, paths[k + 1]]
                total += w[i]
            paths[k] = chosen_of(w, uniforms[k] * total)
        at += end - begin


@exact
def forward_logs(first, log_start, log_move, log_g, increments, predicted, filtered, stopped):
    """As `forward`; stopped is never UNSURE."""
    n = log_g.shape[1]
    for s in range(stopped.size):
        begin = first[s]
        stopped[s] = -1
        for t in range(begin, first[s + 1]):
            a = t if log_move.shape[0] > 1 else 0
            top = -np.inf
            for j in range(n):
                if t == begin:
                    predicted[t, j] = log_start[s, j]
                else:
                    most, total = -np.inf, 0.0
                    for i in range(n):
                        way = filtered[t - 1, i] + log_move[a, i, j]
                        if filtered[t - 1, i] > -np.inf and way > most:
                            most = way
                    for i in range(n):
                        if most > -np.inf and filtered[t - 1, i] > -np.inf:
                            total += math.exp(filtered[t - 1, i] + log_move[a, i, j] - most)
                    predicted[t, j] = math.log(total) + most if total > 0.0 else -np.inf
                if predicted[t, j] > -np.inf and predicted[t, j] + log_g[t, j] > top:
                    top = predicted[t, j] + log_g[t, j]
            if not top > -np.inf or top == np.inf:
                stopped[s] = t - begin
                break
            total = 0.0
            for j in range(n):
                filtered[t, j] = -np.inf
                if predicted[t, j] > -np.inf:
                    filtered[t, j] = predicted[t, j] + log_g[t, j] - top
                    total += math.exp(filtered[t, j])
            if not 0.0 < total < np.inf:
                stopped[s] = t - begin
                break
            for j in range(n):
                filtered[t, j] -= math.log(total)
            increments[t] = math.log(total) + top


@exact
def backward_logs(first, move, predicted, filtered, smoothed, pairs):
    """As `backward`; smoothed and pairs are probabilities."""
    n = filtered.shape[1]
    ratio, log_law = np.empty(n), np.empty(n)
    for s in range(first.size - 1):
        begin, last = first[s], first[s + 1] - 1
        for j in range(n):
            log_law[j] = filtered[last, j]
            smoothed[last, j] = math.exp(log_law[j])
        for t in range(last, begin, -1):
            a = t if move.shape[0] > 1 else 0
            for j in range(n):
                ratio[j] = -np.inf
                if log_law[j] > -np.inf:
                    ratio[j] = log_law[j] - predicted[t, j]
            for i in range(n):
                own = filtered[t - 1, i]
                most, total = -np.inf, 0.0
                for j in range(n):
                    possible = own > -np.inf and ratio[j] > -np.inf
                    if possible and move[a, i, j] + ratio[j] > most:
                        most = move[a, i, j] + ratio[j]
                for j in range(n):
                    share = -np.inf
                    if own > -np.inf and ratio[j] > -np.inf:
                        share = move[a, i, j] + ratio[j]
                    if most > -np.inf:
                        total += math.exp(share - most)
                    if pairs.shape[0]:
                        pairs[t, i, j] = math.exp(share + own)
                log_law[i] = own + math.log(total) + most if total > 0.0 else -np.inf
                smoothed[t - 1, i] = math.exp(log_law[i])
        if pairs.shape[0]:
            pairs[begin] = 0.0


@exact
def sample_backward_logs(first, move, filtered, which, uniforms, paths):
    """As `sample_backward`."""
    n = filtered.shape[1]
    w = np.empty(n)
    at = 0
    for m in range(which.size):
        begin, end = first[which[m]], first[which[m] + 1]
        for t in range(end - 1, begin - 1, -1):
            k = at + t - begin
            most, total = -np.inf, 0.0
            for i in range(n):
                w[i] = filtered[t, i]
                if t < end - 1 and w[i] > -np.inf:
                    a = t + 1 if move.shape[0] > 1 else 0
                    w[i] += move[a, i, paths[k + 1]]
                if w[i] > most:
                    most = w[i]
            for i in range(n):
                w[i] = math.exp(w[i] - most)
                total += w[i]
            paths[k] = chosen_of(w, uniforms[k] * total)
        at += end - begin


@exact
def viterbi(first, log_start, log_move, log_g, paths, heights):
    """Fill paths (R,) with the indices of the most probable values of each sequence together, and
    heights (S,) with the log probability of path and data."""
    rows, n = log_g.shape
    came_from = np.empty((rows, n), dtype=np.int32)
    best, new = np.empty(n), np.empty(n)
    for s in range(heights.size):
        begin, end = first[s], first[s + 1]
        for j in range(n):
            best[j] = log_start[s, j] + log_g[begin, j]
        for t in range(begin + 1, end):
            a = t if log_move.shape[0] > 1 else 0
            for j in range(n):
                most, way = -np.inf, 0
                for i in range(n):
                    if best[i] + log_move[a, i, j] > most:
                        most, way = best[i] + log_move[a, i, j], i
                new[j], came_from[t, j] = most + log_g[t, j], way
            for j in range(n):
                best[j] = new[j]
        at = 0
        for j in range(n):
            if best[j] > best[at]:
                at = j
        heights[s] = best[at]
        for t in range(end - 1, begin - 1, -1):
            paths[t] = at
            if t > begin:
                at = came_from[t, at]
