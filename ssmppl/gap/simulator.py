"""Data sets drawn from a fitted model, with the lengths, inputs and gaps of the data.

A component of x_1 whose law is Flat cannot be drawn: it starts at its smoothed mean given the data,
as does one whose law stands for a flat one (`started.py`).
What a linear Gaussian model with a flat start says of its disturbances does not depend on where it
starts (P. de Jong, *Annals of Statistics* 19, 1991).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.structure import flat_start
from ssmppl.codegen.program import Program, compile_trace
from ssmppl.data import Experiment
from ssmppl.expressions.expr import Expr
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.inference.simulation import feeds_back
from ssmppl.language.distributions import Dirac, Flat
from ssmppl.language.traced import Site, Trace, symbols


class Simulator:
    """Draws from a model at given parameters.

    program : of the model, which is used as it is where x_1 has a law. kalman : of the model where
    it is linear and Gaussian. held : further states that start at a mean; found : of an experiment
    and theta (P,), the means (D,) of x_1 that these take.
    """

    def __init__(
        self, program: Program, missing: Missing, kalman: object, held: Sequence[str] = (),
        found: Callable[[Experiment, np.ndarray], np.ndarray] | None = None,
    ):  # fmt: skip
        self.trace, self.feedback = program.trace, feeds_back(program.trace)
        self.found = found
        flat = [*flat_start(self.trace), *(self.trace.initial[n] for n in held)]
        self.starts: list[Expr] = [s for site in flat for s in site.components]
        self.kalman = kalman if isinstance(kalman, KalmanModel) else None
        self.program = compile_trace(_started(self.trace, flat), missing) if flat else program

    def sets(
        self, experiments: Sequence[Experiment], theta: np.ndarray, stream: np.ndarray
    ) -> list[Experiment]:
        """The experiments with observations drawn at theta (P,), missing where theirs are.

        Where a transition reads observations, `y` has those that it read, seen or not.
        """
        out = []
        for e in experiments:
            drawn = self.observations(e, theta, stream, 1)[:, :, 0]
            y = drawn if self.feedback else np.where(e.seen == 1.0, drawn, 0.0)
            out.append(replace(e, y=y))
        return out

    def observations(
        self, e: Experiment, theta: np.ndarray, stream: np.ndarray, n: int
    ) -> np.ndarray:
        """(T, K, n) drawn with the experiment's inputs, all rows measured."""
        d, k = len(self.trace.state_symbols), len(self.trace.observation_symbols)
        at = np.append(theta, self._start(e, theta))
        run, width = self.program.entry("simulate"), 1 if self.feedback else n
        drawn = []
        for _ in range(n // width):
            x, out = np.empty((e.steps, d, width)), np.empty((e.steps, k, width))
            run(at, np.zeros_like(e.y), np.ones_like(e.seen), e.u, stream, x, out, self.feedback)
            drawn.append(out)
        return np.concatenate(drawn, axis=2)

    def _start(self, e: Experiment, theta: np.ndarray) -> list[float]:
        if not self.starts:
            return []
        place = {s: i for i, s in enumerate(self.trace.state_symbols)}
        own = theta[: len(self.trace.parameter_symbols)]
        if self.found is not None:
            mean = self.found(e, own)
        elif self.kalman is not None:
            mean = self.kalman.smooth(e, own).mean[0]
        else:
            return []
        return [float(mean[place[s]]) for s in self.starts]


def _started(trace: Trace, flat: Sequence[Site]) -> Trace:
    """The trace with flat starts replaced by further parameters."""
    initial, parameters = dict(trace.initial), dict(trace.parameters)
    for site in flat:
        name = f"{site.name}_start"
        while name in parameters or name in trace.transition:
            name += "_"
        at = symbols("parameter", name, site.shape)
        law, start = Flat(shape=site.shape), Dirac(at)
        law.location = start.location = site.distribution.location
        parameters[name] = Site(name, "parameter", law, at, site.distribution.location)
        initial[site.name] = replace(site, distribution=start)
    return replace(trace, initial=initial, parameters=parameters)
