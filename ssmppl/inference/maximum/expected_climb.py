"""The M-step of a complete-data density that does not separate: the expected density climbed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from ssmppl.errors import SamplingError
from ssmppl.inference.maximum.ascent import Setup
from ssmppl.inference.maximum.chart import ELSEWHERE


def climbed(
    setup: Setup, theta: np.ndarray, expected: Callable[[np.ndarray], tuple[float, np.ndarray]],
    with_slope: bool,
) -> np.ndarray:  # fmt: skip
    """Where theta' -> (Q, its derivatives (P,)) has its top near theta, by BFGS on the
    unconstrained scale; Nelder and Mead's simplex where the derivatives are not there.

    Raises
    ------
    SamplingError : Q has a value and no slope at theta itself.
    """
    chart = setup.chart

    def at(z: np.ndarray) -> tuple[float, np.ndarray]:
        """-Q and its derivatives in z."""
        point = chart.at(z)
        if not np.all(np.isfinite(point.theta)):
            return np.inf, np.zeros(len(z))
        total, gradient = expected(point.theta)
        if not np.isfinite(total) or not np.all(np.isfinite(gradient)):
            return np.inf, np.zeros(len(z))
        return -total, -point.pull(gradient)

    z = setup.space_at(theta)
    value, gradient = expected(theta)
    if with_slope and (reason := chart.without_slope(value, theta, gradient)):
        raise SamplingError(f"the expected log density cannot be climbed: {reason}", fix=ELSEWHERE)
    before = at(z)[0]
    found = scipy.optimize.minimize(
        at if with_slope else (lambda v: at(v)[0]), z, jac=with_slope or None,
        method="BFGS" if with_slope else "Nelder-Mead",
        options={"gtol": 1e-7} if with_slope else {"xatol": 1e-9, "fatol": 1e-12},
    )  # fmt: skip
    return chart.at(found.x).theta if found.fun <= before else theta
