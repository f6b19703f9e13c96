"""Names, dims and coordinates of what belongs to an experiment.

Of a single one `y` over `time`; of several `y_1` over `time_1`, `y_2` over `time_2`, as their
lengths differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ssmppl.data import Experiment


class Labels:
    """dims, coords : of the variables named so far, for `to_inference_data`."""

    def __init__(self, experiments: Sequence[Experiment]):
        self.several = len(experiments) > 1
        self.time = None if self.several else experiments[0].time
        self.dims: dict[str, list[str]] = {}
        self.coords: dict[str, Any] = {}
        if self.several:
            self.coords = {
                self.axis(i): np.arange(1, e.steps + 1) if e.time is None else e.time
                for i, e in enumerate(experiments)
            }

    def mark(self, i: int) -> str:
        """What follows the names of experiment i's variables."""
        return f"_{i + 1}" if self.several else ""

    def axis(self, i: int) -> str:
        """Its dim over time."""
        return f"time{self.mark(i)}"

    def named(self, i: int, values: Mapping[str, Any], leading: int = 1) -> dict[str, np.ndarray]:
        """Variables of experiment i under their names; time is the last of `leading` axes."""
        named = {f"{n}{self.mark(i)}": v for n, v in values.items()}
        if self.several:
            for n, v in named.items():
                rest = [f"{n}_dim_{k}" for k in range(v.ndim - leading)]
                # the log likelihood has none but time
                self.dims.setdefault(n, [self.axis(i), *rest])
        return named
