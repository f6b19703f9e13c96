"""What the functions of all simulators of files have in common: a call, its sensors, and why a
point has no value."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

Reasons = dict[int, str]


class Engine(ABC):
    """A simulator's function of a batch of states (B, n), inputs (B, m) and parameters (B, p)."""

    def __call__(self, state: np.ndarray, inputs: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """The states (B, n) after one interval; NaN where the engine fails (`reason` says why)."""
        return self._run(state, inputs, parameters, sense=False)[0]

    def output(self, state: np.ndarray, inputs: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """The sensors (B, k) at states, with the forces that act there."""
        return self._run(state, inputs, parameters, sense=True)[0]

    def reason(self, state: np.ndarray, inputs: np.ndarray, parameters: np.ndarray) -> str:
        """Why a call gives NaN at one point, (n,), (m,) and (p,); empty where it does not."""
        x, u, p = (np.atleast_2d(np.asarray(a, dtype=float)) for a in (state, inputs, parameters))
        return self._run(x, u, p, sense=False)[1].get(0, "")

    @abstractmethod
    def _run(
        self, state: np.ndarray, inputs: np.ndarray, parameters: np.ndarray, sense: bool
    ) -> tuple[np.ndarray, Reasons]:
        """The result, NaN in rows without one, and the reason of each of these."""
