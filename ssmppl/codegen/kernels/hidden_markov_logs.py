"""The passes of `hidden_markov.py` by logarithms: exact however unlikely a value has become.

Sources, notation and what is filled are as there, with the logarithms of `move`, `predicted` and
`filtered` in their places.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.hidden_markov import chosen_of


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
