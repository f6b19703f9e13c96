"""Fits of a true or base system by Fisher scoring on the filter's likelihood.

The parameters' logarithms have a weak normal prior (sd 1) about the nominal values; strengths have
none. Scoring uses the information of a normal one-step law, from forward differences of
standardised errors and log variances, damped as Levenberg and Marquardt do; the gradient is that
of the log density itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.gap.filter import terms
from bench.gap.truth.system import System

STEP = 1e-5
ENOUGH = 0.03  # predicted gain in nats at which a fit ends
ROUNDS = 40


@dataclass(frozen=True)
class Fitted:
    """Parameters p and strengths e of the mode, and its log posterior."""

    p: np.ndarray
    e: np.ndarray
    value: float
    rounds: int


def fit(
    system: System,
    U: np.ndarray,
    Y: np.ndarray,
    keys: tuple[str, ...],
    p: np.ndarray,
    e: np.ndarray,
    rows: int,
) -> Fitted:
    """Mode given the first `rows` rows: all parameters, and the strengths of the effects `keys`.

    p, e : where the search starts; strengths not in `keys` keep their value of e.
    """
    nominal = np.log(list(system.parameters.values()))
    slots = [system.effects[key].index for key in keys]
    units = np.array([abs(system.effects[key].start) for key in keys])
    count = len(p)
    U, Y = U[:rows], Y[:rows]

    def at(theta):
        strengths = e.copy()
        strengths[slots] = theta[count:] * units
        return np.exp(theta[:count]), strengths

    def evaluate(theta):
        with np.errstate(over="ignore", invalid="ignore"):
            q, strengths = at(theta)
            ll, eps, half = (a.ravel() for a in terms(system, q, strengths, U, Y))
        prior = -0.5 * np.sum((theta[:count] - nominal) ** 2)
        total = ll.sum() + prior
        return (total if np.isfinite(total) else -np.inf), ll, eps, half

    theta = np.concatenate([np.log(p), e[slots] / units])
    value, ll, eps, half = evaluate(theta)
    damping, rounds = 1e-3, 0
    for rounds in range(1, ROUNDS + 1):  # noqa: B007
        moved = [evaluate(theta + STEP * unit) for unit in np.eye(len(theta))]
        d_ll = np.stack([(m[1] - ll) / STEP for m in moved])
        d_eps = np.stack([(m[2] - eps) / STEP for m in moved])
        d_half = np.stack([(m[3] - half) / STEP for m in moved])
        gradient = d_ll.sum(1)
        gradient[:count] -= theta[:count] - nominal
        information = d_eps @ d_eps.T + d_half @ d_half.T
        information[range(count), range(count)] += 1
        information[np.diag_indices(len(theta))] += 1e-9
        better = False
        for _ in range(12):
            damped = information + damping * np.diag(np.diag(information))
            move = np.clip(np.linalg.solve(damped, gradient), -1.0, 1.0)
            trial = evaluate(theta + move)
            if trial[0] > value:
                better = True
                break
            damping = max(damping, 1e-3) * 5
        if not better:
            break
        gained = trial[0] - value
        theta, (value, ll, eps, half) = theta + move, trial
        damping /= 10
        if gained < ENOUGH and 0.5 * gradient @ move < ENOUGH:
            break
    q, strengths = at(theta)
    return Fitted(q, strengths, value, rounds)
