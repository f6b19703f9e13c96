"""Records drawn from a fitted model, with the lengths, inputs and gaps of the data.

A component of x_1 whose distribution is Flat cannot be drawn: it starts at its smoothed mean given
the data, as does one whose distribution stands for a flat one (`initial_law.py`). What a linear
Gaussian model with a flat start says of its disturbances does not depend on where it starts (P. de
Jong, *Annals of Statistics* 19, 1991).

A nonlinear model may leave its domain by chance, as a stock does that is fished to nothing. Such
records say nothing of one that did not, and a few of them are the whole of any mean square. So they
are drawn again: what is compared with the others is compared on the condition that the system
stayed where it can be, which the measured one did.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.structure import flat_start, simulators
from ssmppl.codegen.modules.program import Program, compile_trace
from ssmppl.data import Experiment
from ssmppl.expressions.expr import Expr
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.verbs.simulate import feeds_back
from ssmppl.language.distributions import Dirac, Flat
from ssmppl.language.model.trace import Site, Trace, symbols

# How far from the middle of the data a record may go, in units of their range. What drifts is not
# to be cut off, as a record in closed loop moves far less than one simulated with its inputs; what
# leaves the domain passes all of these within a row or two.
REACHES = (3.0, 10.0, 30.0, 100.0)
KEPT = 0.9  # share of the records within the widest reach, that a narrower one has to keep
LEAST_SEEN = 10  # values that make a range
PILOTS = 256  # records from which the reach is chosen
MOST_DRAWN, MOST_DRAWN_CALLED = 100, 3  # times that a set is drawn; where a simulator is called


class Simulator:
    """Draws from a model at given parameters.

    program : of the model, which is used as it is where x_1 has a distribution. kalman : of the
    model where it is linear and Gaussian. held : further states that start at a mean.
    initial_means : of an experiment and theta (P,), the means (D,) of x_1 that these take.
    """

    def __init__(
        self, program: Program, missing: Missing, kalman: object, held: Sequence[str] = (),
        initial_means: Callable[[Experiment, np.ndarray], np.ndarray] | None = None,
    ):  # fmt: skip
        self.trace, self.feedback = program.trace, feeds_back(program.trace)
        self.initial_means = initial_means
        flat = [*flat_start(self.trace), *(self.trace.initial[n] for n in held)]
        self.starts: list[Expr] = [s for site in flat for s in site.components]
        self.kalman = kalman if isinstance(kalman, KalmanModel) else None
        self.program = (
            compile_trace(_with_initial_parameters(self.trace, flat), missing) if flat else program
        )
        self.called = bool(simulators(self.trace))
        self._known: tuple[Sequence[Experiment], np.ndarray, float] | None = None

    def sets(
        self, experiments: Sequence[Experiment], theta: np.ndarray, stream: np.ndarray
    ) -> list[Experiment]:
        """The experiments with observations drawn at theta (P,), missing where theirs are.

        Where a transition reads observations, `y` has those that it read, seen or not. Of a
        nonlinear model those that stay in its domain, as far as a few draws find them.
        """
        return self.counted_sets(experiments, theta, stream)[0]

    def counted_sets(
        self, experiments: Sequence[Experiment], theta: np.ndarray, stream: np.ndarray
    ) -> tuple[list[Experiment], int]:
        """The same, and how many times they were drawn."""
        reach = self._reach(experiments, theta)
        most = 1 if reach == np.inf else MOST_DRAWN_CALLED if self.called else MOST_DRAWN
        bounds, number = middle_and_range(experiments), 0
        while True:
            number += 1
            out = []
            for e in experiments:
                drawn = self.observations(e, theta, stream, 1)[:, :, 0]
                y = drawn if self.feedback else np.where(e.seen == 1.0, drawn, 0.0)
                out.append(replace(e, y=y))
            if (
                number == most
                or _reached(experiments, [e.y[..., None] for e in out], bounds) <= reach
            ):
                return out, number

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
        if self.initial_means is not None:
            mean = self.initial_means(e, own)
        elif self.kalman is not None:
            mean = self.kalman.smooth(e, own).mean[0]
        else:
            return []
        return [float(mean[place[s]]) for s in self.starts]

    def _reach(self, experiments: Sequence[Experiment], theta: np.ndarray) -> float:
        """How far a record that is kept may go: the least of `REACHES` that keeps almost all of
        those that the widest keeps, where some leave that; infinite where there is no choice."""
        if self.kalman is not None:
            return np.inf
        if self.called:
            return REACHES[-1]
        bounds = middle_and_range(experiments)
        if not np.any(np.isfinite(bounds[1])):  # inputs of an experiment that is to be made
            return REACHES[-1]
        known = self._known
        if known and np.array_equal(known[1], theta) and _alike(known[0], experiments):
            return known[2]
        stream = random_state(np.random.SeedSequence(PILOTS))
        drawn = [self.observations(e, theta, stream, PILOTS) for e in experiments]
        reached = _reached(experiments, drawn, bounds)
        kept = [float(np.mean(reached <= reach)) for reach in REACHES]
        found = REACHES[-1]
        if kept[-1] == 0.0:
            found = np.inf
        elif kept[-1] < 1.0:
            found = next(r for r, k in zip(REACHES, kept, strict=True) if k >= KEPT * kept[-1])
        self._known = tuple(experiments), theta.copy(), found
        return found


def _alike(one: Sequence[Experiment], other: Sequence[Experiment]) -> bool:
    """Whether these are the same data, in another process or list perhaps."""
    return len(one) == len(other) and all(
        a is b or all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("y", "seen", "u"))
        for a, b in zip(one, other, strict=True)
    )


def middle_and_range(experiments: Sequence[Experiment]) -> np.ndarray:
    """(2, K) the middle and the range of each channel; 0 and infinite where it has none."""
    out = np.tile([[0.0], [np.inf]], experiments[0].y.shape[1])
    for k in range(out.shape[1]):
        y = np.concatenate([e.y[e.seen[:, k] == 1.0, k] for e in experiments])
        if len(y) >= LEAST_SEEN and np.ptp(y) > 0.0:
            out[:, k] = 0.5 * (y.min() + y.max()), np.ptp(y)
    return out


def _reached(
    experiments: Sequence[Experiment], drawn: Sequence[np.ndarray], bounds: np.ndarray
) -> np.ndarray:
    """(n,) how far each of n draws (T, K, n) of all experiments goes from the middle, in units of
    the range; infinite where it is not finite."""
    middle, width = bounds[:, :, None]
    out = np.zeros(drawn[0].shape[2])
    for e, y in zip(experiments, drawn, strict=True):
        far = np.where(np.isfinite(y), np.abs(y - middle) / width, np.inf)
        out = np.maximum(out, np.max(np.where(e.seen[..., None] == 1.0, far, 0.0), axis=(0, 1)))
    return out


def _with_initial_parameters(trace: Trace, flat: Sequence[Site]) -> Trace:
    """The trace with flat initial distributions replaced by further parameters."""
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
