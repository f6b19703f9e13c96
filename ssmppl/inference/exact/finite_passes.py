"""The passes over finitely many values: in ordinary numbers, or by logarithms where these will not
do.

A value that the data have made 1e-300 times as likely as another is no number any more, and yet it
may be the only one that later rows leave: before a change from which no way leads back. The pass in
ordinary numbers tells where that may have happened, and then everything is done by logarithms, at
several times the cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.exact import exact_entry
from ssmppl.codegen.kernels.hidden_markov import UNSURE


@dataclass(frozen=True)
class Filtered:
    """What the forward pass tells of one experiment (T rows, K values).

    log_increments : (T,) log p(y_t | y_{1:t-1}). predicted, filtered : (T, K) laws of x_t given
    y_{1:t-1} and y_{1:t}, or their logarithms if `logs`. move : (T or 1, K, K), as of the kernels,
    likewise.

    Of S histories at once every array has one axis more, the first.
    """

    log_increments: np.ndarray
    _predicted: np.ndarray
    _filtered: np.ndarray
    _move: np.ndarray
    logs: bool

    @property
    def predicted(self) -> np.ndarray:
        return np.exp(self._predicted) if self.logs else self._predicted

    @property
    def filtered(self) -> np.ndarray:
        return np.exp(self._filtered) if self.logs else self._filtered

    def of(self, s: int) -> Filtered:
        """What it tells of history s."""
        move = self._move[s if len(self._move) > 1 else 0]
        own = self.log_increments[s], self._predicted[s], self._filtered[s]
        return Filtered(*own, move, self.logs)

    def smoothed(self, pairs: bool) -> tuple[np.ndarray, np.ndarray]:
        """Laws (S, T, K) of x_t given all data, and (S, T, K, K) of (x_{t-1}, x_t), row 0 zero;
        without pairs the latter is empty."""
        shape = self._filtered.shape
        law, both = np.empty(shape), np.empty((*shape, shape[-1]) if pairs else (0, 0, 0, 0))
        entry = exact_entry("finite_backward_logs" if self.logs else "finite_backward")
        entry(self._move, self._predicted, self._filtered, law, both)
        return law, both

    def paths(self, which: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
        """(M, T) indices of values drawn given all data, path m of history which[m], by uniforms
        (M, T)."""
        found = np.empty(uniforms.shape, dtype=np.int64)
        entry = exact_entry("finite_draw_logs" if self.logs else "finite_draw")
        entry(self._move, self._filtered, which, uniforms, found)
        return found


def forward(
    log_start: np.ndarray, log_move: np.ndarray, log_g: np.ndarray
) -> tuple[Filtered, np.ndarray]:
    """The forward pass, and (S,) the row at which it came to an end, -1 if at none; arguments as of
    the kernels."""
    shape = log_g.shape
    found = np.empty(shape[:2]), np.empty(shape), np.empty(shape)
    stopped = np.empty(len(log_g), dtype=np.int64)
    move = np.exp(log_move)
    exact_entry("finite_forward")(move, log_start, log_move, log_g, *found, stopped)
    if not np.any(stopped == UNSURE):
        return Filtered(*found, move, logs=False), stopped
    exact_entry("finite_forward_logs")(log_start, log_move, log_g, *found, stopped)
    return Filtered(*found, log_move, logs=True), stopped
