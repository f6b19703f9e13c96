"""Fits for simulation: the parameters with which a model predicts many rows ahead best.

The likelihood looks one row ahead. There the noise of the states grows over what a model lacks, and
takes from the other parameters what they would have to explain; a simulation started in the same
state goes astray. With that noise held at a share of what was fitted, and all else fitted anew,
what one row leaves unexplained is carried on to those that follow, as by an output error method
(Ljung 1999, *System Identification*, on the choice of a noise model). The parameters of the means
are taken from there; those of the noises are fitted to them by the likelihood, so that the filter
goes on following the data. Of a few shares each model has the one with which it simulates best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.analysis.structure import component_means
from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.fit import APPROXIMATELY, NUMBERS, Fit, Fitter
from ssmppl.diagnosis.run.checkpoint import Numbers
from ssmppl.diagnosis.selection.horizons import SimulationGain, window_error
from ssmppl.errors import SSMError
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.batched.extended import Extended

SHARES = (0.3, 0.1)  # of the fitted process noise, one after the other
BETTER = 0.98  # of the error of a simulation, which less noise has to come below


@dataclass(frozen=True)
class SimulationFit:
    """A model with the parameters that simulate windows of rows best. share : of the process noise
    that was fitted. squares : of `SimulationGain.mean_squares`, at the share with the largest gain,
    which may be another."""

    fitter: Fitter
    fit: Fit
    share: float
    squares: np.ndarray

    @property
    def model(self) -> tuple[Fitter, Fit]:
        return self.fitter, self.fit

    @property
    def numbers(self) -> Numbers:
        """All that a checkpoint has to keep; see `restored`."""
        kept = {f"simulation_{n}": v for n, v in self.fit.numbers.items()}
        return kept | {"share": np.asarray(self.share), "ahead": self.squares}


def restored(
    fitter: Fitter, fit: Fit, train: Sequence[Experiment], numbers: Numbers
) -> SimulationFit:
    """The one that had these numbers. fit : that of the likelihood."""
    share = float(numbers["share"])
    own = {n: numbers[f"simulation_{n}"] for n in NUMBERS}
    if share < 1.0:
        fitter = _with_means_of(
            fitter, fitter.restored(train, fit.numbers | {"theta": own["theta"]})
        )
    return SimulationFit(fitter, fitter.restored(train, own), share, numbers["ahead"])


def fit_for_simulation(
    fitter: Fitter, fit: Fit, train: Sequence[Experiment], of_base: SimulationGain
) -> SimulationFit:
    """The fit that simulates best. fit : that of the likelihood.

    of_base : horizons and random numbers, and by what gains are measured.
    """
    tried = [SimulationFit(fitter, fit, 1.0, of_base.mean_squares(fitter, fit, train))]
    # Where a simulator is called each fit takes long.
    called = isinstance(fitter.smoother.extended, Extended)
    names, last = [] if called else process_noises(fitter), fit
    for share in SHARES if names else ():
        quiet = fitter.with_fixed({n: share * fit.by_parameter[n] for n in names})
        start = {n: v for n, v in last.by_parameter.items() if n not in names}
        try:
            last = quiet.fit(train, of_base.seed, start, APPROXIMATELY)
            held = _with_means_of(fitter, last)
            own = {n: v for n, v in fit.by_parameter.items() if n not in held.fixed}
            found = held.fit(train, of_base.seed, own, APPROXIMATELY)
        except SSMError:
            break
        squares = of_base.mean_squares(held, found, train)
        tried.append(SimulationFit(held, found, share, squares))
    best = tried[0]
    for other in tried[1:]:
        if window_error(other.squares) < BETTER**2 * window_error(best.squares):
            best = other
    return replace(best, squares=max((t.squares for t in tried), key=of_base.gain))


def gain_of_base(
    fitter: Fitter, fit: Fit, train: Sequence[Experiment], seed: np.random.SeedSequence,
    window: int | None = None,
) -> tuple[SimulationGain, SimulationFit]:  # fmt: skip
    """What others are measured by: the model as it is, with its own parameters for simulation.

    window : rows of a simulation; None: a tenth of the longest record.
    """
    plain = SimulationGain.of(fitter, fit, train, seed, window)
    best = fit_for_simulation(fitter, fit, train, plain)
    return replace(plain, before=best.squares), best


def _with_means_of(fitter: Fitter, fit: Fit) -> Fitter:
    """The fitter with all parameters of the means held at those of a fit."""
    values = fit.by_parameter
    return fitter.with_fixed({n: values[n] for n in _of_means(fitter) - set(fitter.fixed)})


def _of_means(fitter: Fitter) -> set[str]:
    """Parameters that the means of transitions or observations depend on."""
    trace = fitter.problem.trace
    means = component_means([*trace.transition.values(), *trace.observations.values()])
    return {s.data[1] for s in symbols_of([*means.values()]) if s.data[0] == "parameter"}


def process_noises(fitter: Fitter) -> list[str]:
    """Parameters that scale the noise of transitions and do nothing else after the first row."""
    trace = fitter.problem.trace
    laws = [e for s in trace.observations.values() for e in s.distribution.expressions()]
    used = {s.data[1] for s in symbols_of(laws) if s.data[0] == "parameter"}
    if not isinstance(fitter.problem.program.gaussian, GaussianApproximation):
        return []
    return sorted(fitter.process_noise_scales - used - _of_means(fitter) - set(fitter.fixed))
