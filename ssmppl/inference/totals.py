"""Sums of log densities."""

from __future__ import annotations

import numpy as np

__all__ = ["total_of"]


def total_of(increments: np.ndarray) -> float:
    """The log density of all rows; -inf where it is below what floating point holds."""
    with np.errstate(over="ignore"):
        return float(np.sum(increments))
