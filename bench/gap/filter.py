"""Likelihoods of a true system: the divided-difference filter DD2 (Nørgaard, Poulsen, Ravn 2000).

Second-order interpolation instead of derivatives, so that kinks in friction and stops are averaged
over the state's spread; exact for linear Gaussian systems. Channels are taken one after the other
(their errors are independent). Errors contaminated by wide ones make a mixture of two normals,
collapsed to its moments after each update; counts are given a normal law with the Poisson variance
at the predicted mean. Directions without variance (delay lines, bristles at first) cost nothing.
The answers are checked against ssmppl's particle filter in `tests/bench_gap`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numba import njit

from bench.gap.truth.forms import WILD, driven
from bench.gap.truth.system import System

SPREAD = np.sqrt(3.0)  # of the interpolation, in standard deviations: right for a normal law


@njit
def root(P, L):
    """Lower Cholesky factor of a positive semidefinite matrix; columns without variance are 0."""
    n = len(P)
    L[:] = 0
    for j in range(n):
        d = P[j, j]
        for k in range(j):
            d -= L[j, k] * L[j, k]
        if d <= 1e-12 * P[j, j] or d <= 1e-18:
            continue
        L[j, j] = np.sqrt(d)
        for i in range(j + 1, n):
            r = P[i, j]
            for k in range(j):
                r -= L[i, k] * L[j, k]
            L[i, j] = r / L[j, j]


@cache
def compiled(step: Callable, observe: Callable) -> Callable:
    """The filter of one system: run(m, P, V, Y, p, e, counts) -> log density, standardised error,
    half log variance and prediction of each observation, each (T, channels); the prediction of one
    that is missing too, by the rows before it and the channels before it in its row."""

    @njit
    def run(m, P, V, Y, p, e, counts):
        T, channels = Y.shape
        n = len(m)
        m, P = m.copy(), P.copy()
        L = np.zeros((n, n))
        ll, eps, half = np.zeros((T, channels)), np.zeros((T, channels)), np.zeros((T, channels))
        predicted = np.zeros((T, channels))
        sd, scrap = np.zeros(n), np.zeros(n)
        f0, up, down, x = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        before, first, second, C = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        y0, y1, y2 = np.zeros(channels), np.zeros(channels), np.zeros(channels)
        r, r_scrap = np.zeros(channels), np.zeros(channels)
        wild, wild_scrap = np.zeros(channels), np.zeros(channels)
        a = 1 / (2 * SPREAD)
        b = 1 / (2 * SPREAD**2)
        c = np.sqrt(SPREAD**2 - 1) * b
        for t in range(T):
            for j in range(channels):
                root(P, L)
                wild[:] = 0
                observe(m, V[t], t + 1, p, e, y0, r, wild)
                mean, S = y0[j], 0.0
                C[:] = 0
                for k in range(n):
                    if L[k, k] == 0:
                        continue
                    for i in range(n):
                        up[i] = m[i] + SPREAD * L[i, k]
                        down[i] = m[i] - SPREAD * L[i, k]
                    observe(up, V[t], t + 1, p, e, y1, r_scrap, wild_scrap)
                    observe(down, V[t], t + 1, p, e, y2, r_scrap, wild_scrap)
                    d1 = a * (y1[j] - y2[j])
                    d2 = y1[j] + y2[j] - 2 * y0[j]
                    mean += b * d2
                    S += d1 * d1 + c * c * d2 * d2
                    for i in range(n):
                        C[i] += d1 * L[i, k]
                predicted[t, j] = mean
                if np.isnan(Y[t, j]):
                    continue
                R = mean if counts else r[j] * r[j]
                if counts and R < 1e-3:
                    R = 1e-3
                err = Y[t, j] - mean
                S1 = S + R
                l1 = -0.5 * (np.log(2 * np.pi * S1) + err * err / S1)
                if wild[j] <= 0:
                    ll[t, j] = l1
                    inverse, apart = 1 / S1, 0.0
                else:
                    S2 = S + R * WILD**2
                    l2 = -0.5 * (np.log(2 * np.pi * S2) + err * err / S2)
                    l1 += np.log(1 - wild[j])
                    l2 += np.log(wild[j])
                    top = max(l1, l2)
                    ll[t, j] = top + np.log(np.exp(l1 - top) + np.exp(l2 - top))
                    w = np.exp(l2 - ll[t, j])
                    inverse = (1 - w) / S1 + w / S2
                    apart = w * (1 - w) * (err / S1 - err / S2) ** 2
                eps[t, j] = err * np.sqrt(inverse)
                half[t, j] = -0.5 * np.log(inverse)
                for i in range(n):
                    m[i] += C[i] * err * inverse
                    for k in range(n):
                        P[i, k] -= C[i] * C[k] * (inverse - apart)
            if t + 1 == T:
                break
            root(P, L)
            step(m, V[t], t + 1, p, e, f0, sd)
            x[:] = f0
            P[:] = 0
            for k in range(n):
                if L[k, k] == 0:
                    continue
                for i in range(n):
                    before[i] = m[i] + SPREAD * L[i, k]
                step(before, V[t], t + 1, p, e, up, scrap)
                for i in range(n):
                    before[i] = m[i] - SPREAD * L[i, k]
                step(before, V[t], t + 1, p, e, down, scrap)
                for i in range(n):
                    first[i] = a * (up[i] - down[i])
                    second[i] = c * (up[i] + down[i] - 2 * f0[i])
                    x[i] += b / c * second[i]
                for i in range(n):
                    for l in range(n):
                        P[i, l] += first[i] * first[l] + second[i] * second[l]
            m[:] = x
            for i in range(n):
                P[i, i] += sd[i] * sd[i]
        return ll, eps, half, predicted

    return run


def terms(
    system: System, p: np.ndarray, e: np.ndarray, U: np.ndarray, Y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log density, standardised one-step error and half log variance of each Y, (T, channels)."""
    return _filtered(system, p, e, U, Y)[:3]


def predictions(
    system: System, p: np.ndarray, e: np.ndarray, U: np.ndarray, Y: np.ndarray
) -> np.ndarray:
    """(T, channels) means of the observations, missing ones among them, by those before them."""
    return _filtered(system, p, e, U, Y)[3]


def _filtered(
    system: System, p: np.ndarray, e: np.ndarray, U: np.ndarray, Y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    first = np.array(system.start)
    V = np.ascontiguousarray(driven(U, e))
    run = compiled(system.step, system.observe)
    return run(first[:, 0].copy(), np.diag(first[:, 1] ** 2), V, Y, p, e, system.counts)
