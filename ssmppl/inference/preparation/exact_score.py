"""Score and information of exact likelihoods, by differences where there is no closed form.

The sensitivities of the Kalman filter need derivatives of the model's matrices. Where a matrix goes
through a function without one, the exact likelihood itself is differenced, which is smooth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.exact.derivatives import jacobian, observed_information
from ssmppl.inference.preparation.exact_models import ExactModel

STEP = 1e-2  # the largest of the differences, relative to the parameter
KEPT = 8  # informations
LEAST = 0.1  # parameters nearer to zero count as this large


@dataclass(frozen=True)
class ExactScore:
    """The exact log-likelihood of experiments and its derivatives in the free components.

    free : (P,) bool. differences : why the likelihood is differenced; empty where it is not.
    """

    model: ExactModel
    experiments: Sequence[Experiment]
    free: np.ndarray
    differences: str = ""
    _known: dict[bytes, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def score(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """(log p(y | theta), gradient (P,), zero in what is not free); -inf and NaN where none."""
        if not self.differences:
            return self.model.score(self.experiments, theta, self.free)
        value = self.model.log_likelihood(self.experiments, theta)
        if value == -np.inf:
            return value, np.where(self.free, np.nan, 0.0)
        index = np.flatnonzero(self.free)

        def likelihood(part: np.ndarray) -> np.ndarray:
            moved = theta.copy()
            moved[index] = part
            return np.array([self.model.log_likelihood(self.experiments, moved)])

        gradient = np.zeros(len(theta))
        with np.errstate(invalid="ignore"):
            step = STEP * np.maximum(np.abs(theta[index]), LEAST)
            gradient[index] = jacobian(likelihood, theta[index], step)[0][0]
        return value, gradient

    def information(self, theta: np.ndarray) -> np.ndarray:
        """(P, P) the observed information, zero in what is not free; NaN where there is none.

        Kept for the last thetas that were asked for, as a climb and what reports it ask twice."""
        key = np.asarray(theta, dtype=float).tobytes()
        if key not in self._known:
            if isinstance(self.model, Extended):  # all points together
                found = self.model.information(self.experiments, theta, self.free)
            else:
                with np.errstate(invalid="ignore"):
                    found = observed_information(lambda v: self.score(v)[1], theta, self.free)[0]
            if len(self._known) >= KEPT:
                self._known.clear()
            self._known[key] = found
        return self._known[key].copy()


def exact_score(
    model: ExactModel, experiments: Sequence[Experiment], free: np.ndarray, theta: np.ndarray
) -> ExactScore:
    """The score by sensitivities if these exist at theta (P,), else by differences, with the
    reason."""
    try:
        model.score(experiments, theta, free)
    except ArgumentError as reason:
        return ExactScore(model, experiments, free, reason.found)
    return ExactScore(model, experiments, free)
