"""Weighted means, covariances and quantiles of particles.

A particle without weight counts for nothing, be its values infinite or undefined.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.flags import exact, kernel


@kernel
def weighted_mean(values, w):
    """sum_i w_i values_i, weights normalised."""
    total = 0.0
    for i in range(w.size):
        share, value = w[i], values[i]
        total += share * value if share > 0.0 else 0.0
    return total


@kernel
def weighted_product(a, mean_a, b, mean_b, w):
    """sum_i w_i (a_i - mean_a) (b_i - mean_b)."""
    total = 0.0
    for i in range(w.size):
        share, product = w[i], (a[i] - mean_a) * (b[i] - mean_b)
        total += share * product if share > 0.0 else 0.0
    return total


@exact
def weighted_quantiles(values, w, probabilities, out):
    """The smallest value at which the cumulative weight reaches each probability (increasing)."""
    order = np.argsort(values)
    total, j = 0.0, 0
    for i in range(w.size):
        total += w[order[i]]
        while j < probabilities.size and (total >= probabilities[j] or i == w.size - 1):
            out[j] = values[order[i]]
            j += 1


@exact
def summarise(x, w, probabilities, mean, covariance, quantiles):
    """Moments and quantiles of x : (D, N) under w : (N,) into (D,), (D, D), (P, D)."""
    for k in range(x.shape[0]):
        mean[k] = weighted_mean(x[k], w)
        for m in range(k + 1):
            covariance[k, m] = weighted_product(x[k], mean[k], x[m], mean[m], w)
            covariance[m, k] = covariance[k, m]
        if probabilities.size > 0:
            weighted_quantiles(x[k], w, probabilities, quantiles[:, k])
