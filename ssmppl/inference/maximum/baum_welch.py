"""EM where the states take few values.

L. Baum, T. Petrie, G. Soules and N. Weiss, *Annals of Mathematical Statistics* 41 (1970). The
expectations are sums over the values of x_t and over the pairs of x_{t-1} and x_t; the M-step is
derived (`analysis/mstep.py`), or the expected density is climbed.
"""

from __future__ import annotations

import numpy as np

from ssmppl.analysis.density import terms
from ssmppl.analysis.expectation import IN_TIME
from ssmppl.analysis.mstep import MStep
from ssmppl.errors import NotApplicable
from ssmppl.expressions.calculus import gradient as gradient_of
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.exact.hidden_markov import HiddenMarkov
from ssmppl.inference.exact.histories import Histories
from ssmppl.inference.maximum.ascent import Setup
from ssmppl.inference.maximum.expected_climb import climbed
from ssmppl.inference.maximum.m_step import maximiser


class FiniteSteps:
    """theta -> theta after one E-step and one M-step."""

    def __init__(self, setup: Setup, model: HiddenMarkov):
        self.setup, self.model = setup, model
        self.step: MStep | NotApplicable = maximiser(setup, "EM").step
        self.free = [
            s for s in setup.problem.trace.parameter_symbols if s.data[1] not in setup.held
        ]

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        laws = self.model.laws(self.setup.problem.experiments, theta)
        if not isinstance(self.step, MStep):
            return climbed(self.setup, theta, lambda at: self._density(laws, at), True)
        total = np.array(self.step.prior(theta.tolist()), dtype=float)
        for role, summands in self.step.update.coefficients.items():
            if role in IN_TIME:
                for h, law, pairs in laws:
                    own = pairs if role == "transition" else law
                    total += self.model.expected(h, theta, role, summands, own)
        return self.step.maximise(total, theta)

    def _density(
        self, laws: list[tuple[Histories, np.ndarray, np.ndarray]], at: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """(Q, its derivatives) at theta' of the laws of the states at another theta."""
        trace = self.setup.problem.trace
        place = {s: i for i, s in enumerate(trace.parameter_symbols)}
        total, gradient = 0.0, np.zeros(len(place))
        for h, law, pairs in laws:
            for role in IN_TIME:
                own = pairs if role == "transition" else law
                both = [self.model.density(role, h),
                        *(self.model.density(role, h, s) for s in self.free)]  # fmt: skip
                found = self.model.expected(h, at, role, both, own)
                total += found[0]
                gradient[[place[s] for s in self.free]] += found[1:]
        if self.setup.with_prior:
            here = dict(zip(trace.parameter_symbols, at, strict=True))
            for term in terms(trace, "prior"):
                both = [term.log_density, *gradient_of(term.log_density, self.free)]
                found = np.array([float(v) for v in evaluate(both, here)])
                total += found[0]
                gradient[[place[s] for s in self.free]] += found[1:]
        return total, gradient
