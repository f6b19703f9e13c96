"""What follows from an exact score, whichever algorithm gives it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.data import Experiment, spelled
from ssmppl.errors import SamplingError
from ssmppl.inference.exact.differences import observed_information
from ssmppl.language.traced import Trace


@dataclass(frozen=True)
class Scored(ABC):
    """An exact model with the gradient of its log-likelihood."""

    trace: Trace

    @abstractmethod
    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """Independent draws of x_{1:T} given y_{1:T}, (draws, T, D)."""

    def draw_each(
        self, experiments: Sequence[Experiment], theta: np.ndarray, streams: Sequence[np.ndarray],
        draws: int = 1,
    ) -> list[np.ndarray]:  # fmt: skip
        """As `draw`, of each experiment with its own stream, or one and the same."""
        pairs = zip(experiments, streams, strict=True)
        return [self.draw(e, theta, stream, draws) for e, stream in pairs]

    @abstractmethod
    def score(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(y | theta) and its gradient (P,), summed over experiments, exact.

        free : (P,) bool, the parameters that matter; the gradient is 0 in the others. None: all.
        Where the density does not exist at theta: -inf, and NaN for the gradient.
        """

    def information(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> np.ndarray:
        """The observed information -d^2 log p(y | theta), (P, P), by differences of the score.

        Extrapolated to zero step (`differences.py`): errors of about 1e-9 of
        sqrt(I_ii I_jj). free : as in `score`; rows and columns of the others are zero.

        Raises
        ------
        ArgumentError : as of `score`.
        SamplingError : theta lies at the edge of where the density exists.
        """
        data = list(experiments)
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        matrix, _ = observed_information(lambda v: self.score(data, v, wanted)[1], theta, wanted)
        if not np.isfinite(matrix).all():
            raise SamplingError(
                f"the log-likelihood has no second derivative at {spelled(self.trace, theta)}",
                fix="the parameters lie at the edge of where the model has a density: fix the one "
                "that is at its bound by fixed={...}",
            )
        return matrix
