"""Units for coordinates that may be of any size, from how far a function changes along them.

A climb in steps of one does well along a coordinate if the function changes by some nats within
some tenths of one to some ones. Parameters of the whole line have the unit of the data, which may
be metres that are hundred-thousandths of one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Function = Callable[[np.ndarray], float]

CHANGE = 8.0  # of a log density: four standard deviations of a Gaussian one
# The steps that are tried are STEP TIMES^k of a unit, which fits if the function changes over none
# of less than k = 1, and over one of k up to FITTING.
STEP, TIMES, FITTING = 0.04, 4.0, 4
# Farther out the numbers that others are added to round them away.
NEAREST, FARTHEST = -18, 20


def units_at(function: Function, z: np.ndarray, unit: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(F,) units that fit the function round z (F,): those that were (F,), times a power of
    `TIMES` where they do not fit, so that a number in units has the same digits.

    function : of z; -inf where there is none. where : (F,) bool, the coordinates that are looked
    at. A unit stays as it is where the function does not change along its coordinate.
    """
    out = np.array(unit)
    if not np.any(where) or not np.isfinite(top := function(z)):
        return out
    for i in np.flatnonzero(where).tolist():

        def changes(k: int, i: int = i) -> bool:
            """Whether it does over a step, in the mean of both sides: slopes count for nothing."""
            step = STEP * TIMES**k * unit[i]
            ends = np.array([function(_moved(z, i, s * step)) for s in (1.0, -1.0)])
            within = ends > -np.inf  # at an edge of the support the one side has to tell
            return not (within.any() and abs(top - float(ends[within].mean())) < CHANGE)

        k = _first(changes)
        if k is not None and not 1 <= k <= FITTING:
            out[i] *= TIMES ** (k - 1)
    return out


def _first(changes: Callable[[int], bool]) -> int | None:
    """The least k over whose step the function changes; any from 1 to `FITTING` where that is one
    of these; None where there is none.

    Inwards come before outwards: from afar a function may look flat, as it does where one state of
    several explains no row at all.
    """
    inner: int | None = 0
    if not changes(0):
        fitting = next((k for k in range(FITTING, 0, -1) if changes(k)), None)
        if fitting is not None:
            return fitting
        inner = next((k for k in range(-1, NEAREST, -1) if changes(k)), None)
    if inner is None:
        return next((k for k in range(FITTING + 1, FARTHEST + 1) if changes(k)), None)
    return next((k + 1 for k in range(inner - 1, NEAREST, -1) if not changes(k)), None)


def _moved(z: np.ndarray, i: int, by: float) -> np.ndarray:
    out = z.copy()
    out[i] += by
    return out
