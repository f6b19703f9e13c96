"""Exact inference where no state has noise: given the parameters, the states are known.

Output-error models, that is simulators with noisy sensors (Ljung 1999, "System identification",
section 4.3), and observation-driven models, whose states follow from the observations before them
(Cox 1981, "Statistical analysis of time series: some recent developments"), such as GARCH. All
initial distributions and transitions are Dirac, and the likelihood is the product of the densities
of the observations along the one trajectory. Its gradient goes along with it, by the sensitivities
of `analysis/score.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ssmppl.analysis.structure import without_noise
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.codegen.text.kernel_functions import predictive
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.exact.derivatives import Scored
from ssmppl.inference.exact.histories import histories
from ssmppl.inference.exact.kalman_matrices import SmoothedMoments
from ssmppl.inference.particles.filtering import FilterSettings, failure, run_filter
from ssmppl.inference.particles.scores import CompleteScores, complete_scores
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.inference.run.problem import Problem, missing_of
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.model.trace import Trace, once_per_trace


@dataclass(frozen=True)
class NoiselessRun:
    """log_increments : (T,) log p(y_t | y_{1:t-1}). path : (T, D), the states."""

    log_increments: np.ndarray
    path: np.ndarray


@dataclass(frozen=True)
class Deterministic(Scored):
    """A traced model whose states follow from parameters, inputs and earlier observations."""

    _scores: dict[tuple, CompleteScores] = field(default_factory=dict, repr=False, compare=False)

    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it does not exist at theta."""
        data = tuple(experiments)
        problem = self._problem(data)
        total = 0.0
        for e in data:
            total += self._run(problem, e, theta)[0]
        return total if np.isfinite(total) else -np.inf

    def path(self, experiment: Experiment, theta: np.ndarray) -> np.ndarray:
        """(T, D) the states."""
        return self._run(self._problem([experiment]), experiment, theta)[1]

    def filter(self, experiment: Experiment, theta: np.ndarray) -> NoiselessRun:
        """The states, and the log density of each row given those before it.

        Raises
        ------
        SamplingError : a row is impossible or its density does not exist; names it, the user's
            line and the parameters.
        """
        problem = self._problem([experiment])
        increments, ess = np.empty(experiment.steps), np.empty(experiment.steps)
        one = FilterSettings(1, "bootstrap")
        status, t = run_filter(
            problem, theta, one, experiment, random_state(np.random.SeedSequence(0)),
            increments, ess,
        )  # fmt: skip
        if status != OK:
            raise failure(problem, theta, status, t, experiment)
        return NoiselessRun(increments, self._run(problem, experiment, theta)[1])

    def smooth(self, experiment: Experiment, theta: np.ndarray) -> SmoothedMoments:
        """The states, as moments without spread.

        Raises
        ------
        SamplingError : as of `filter`.
        """
        run = self.filter(experiment, theta)
        none = np.zeros((experiment.steps, run.path.shape[1], run.path.shape[1]))
        return SmoothedMoments(run.path, none, none.copy(), total_of(run.log_increments))

    def observation_variances(self, experiment: Experiment, theta: np.ndarray) -> np.ndarray:
        """(T, K) of each component of y_t given the states; NaN where there is none."""
        (h,) = histories(self.trace, [experiment], experiment.steps)
        given = dict(h.rows)
        given |= dict(zip(self.trace.parameter_symbols, theta, strict=True))
        states = self.path(experiment, theta).T
        given |= dict(zip(self.trace.state_symbols, states, strict=True))
        wanted = [v for site in self.trace.observations.values() for _, v, *_ in predictive(site)]
        with np.errstate(all="ignore"):
            found = evaluate(wanted, given)
        return np.stack([np.broadcast_to(v, experiment.steps) for v in found], axis=1)

    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """The states, (draws, T, D), the same in each draw; `stream` is not used."""
        return np.repeat(self.path(experiment, theta)[None], draws, axis=0)

    def score(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(y | theta) and its gradient (P,), summed over experiments, exact.

        free : (P,) bool, the parameters that matter; the gradient is 0 in the others. None: all.
        Where the density does not exist at theta: -inf, and NaN for the gradient.

        Raises
        ------
        ArgumentError : the states go through a function without a derivative, or a distribution's
            support, or the distribution by steps, depends on a free parameter.
        """
        data = tuple(experiments)
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        value = self.log_likelihood(data, theta)
        if value == -np.inf:
            return value, np.where(wanted, np.nan, 0.0)
        d = len(self.trace.state_symbols)
        paths = [np.zeros((1, e.steps, d)) for e in data]  # set on the way
        gradient = self._complete(data, wanted).gradient(theta, paths)[0]
        return value, np.where(wanted, gradient, 0.0)

    # -- the pieces
    def _problem(self, data: Sequence[Experiment]) -> Problem:
        return Problem(self.trace, tuple(data), compile_trace(self.trace, missing_of(data)))

    def _run(self, problem: Problem, e: Experiment, theta: np.ndarray) -> tuple[float, np.ndarray]:
        path, total = np.zeros((e.steps, len(self.trace.state_symbols))), np.empty(1)
        theta = np.ascontiguousarray(theta, dtype=float)
        problem.program.entry("log_joint")(theta, e.y, e.seen, e.u, path, total)
        return float(total[0]), path

    def _complete(self, data: tuple[Experiment, ...], wanted: np.ndarray) -> CompleteScores:
        symbols = self.trace.parameter_symbols
        free = {s.data[1] for s, w in zip(symbols, wanted, strict=True) if w}
        fixed = frozenset(self.trace.parameters) - free
        problem = self._problem(data)
        key = fixed, problem.program.missing
        if key not in self._scores:
            found = complete_scores(problem, fixed)
            if "score" in found.differences:
                raise ArgumentError(
                    f"the states have no derivatives in closed form: {found.differences['score']}",
                    fix="write the distribution by functions that have derivatives, or use a "
                    "method without scores",
                )
            self._scores[key] = found
        return self._scores[key].of(problem)


@once_per_trace
def _form(trace: Trace) -> tuple[NotApplicable | None, dict[tuple, CompleteScores]]:
    """Which state has noise, and where the scores are kept."""
    return without_noise(trace), {}


def deterministic_model(trace: Trace) -> Deterministic | NotApplicable:
    """The traced model as one without noise in its states; or the reason why it has some."""
    reason, scores = _form(trace)
    return Deterministic(trace, scores) if reason is None else reason
