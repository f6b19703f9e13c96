"""Fits for simulation: the parameters with which a model predicts many rows ahead best.

The likelihood looks one row ahead. There the noise of the states grows over what a model lacks, and
takes from the other parameters what they would have to explain; a simulation started in the same
state goes astray. With that noise held at a share of what was fitted, and all else fitted anew,
what one row leaves unexplained is carried on to those that follow, as by an output error method
(Ljung 1999, *System Identification*, on the choice of a noise model). So each model is fitted for a
few shares, and has the parameters with which it simulates best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.analysis.structure import component_means
from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.data import Experiment
from ssmppl.diagnosis.run.checkpoint import Numbers
from ssmppl.diagnosis.selection.fit import APPROXIMATELY, NUMBERS, Fit, Fitter
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
    quiet = _quieter(fitter, fit, share)
    return SimulationFit(quiet, quiet.restored(train, own), share, numbers["ahead"])


def fit_for_simulation(
    fitter: Fitter, fit: Fit, train: Sequence[Experiment], of_base: SimulationGain
) -> SimulationFit:
    """The fit with the share of process noise that simulates best. fit : that of the likelihood.

    of_base : horizons and random numbers, and by what gains are measured.
    """

    def squares(f: Fitter, found: Fit) -> np.ndarray:
        return of_base.mean_squares(f, found, train)

    tried = [SimulationFit(fitter, fit, 1.0, squares(fitter, fit))]
    # Where a simulator is called each fit takes long.
    names = [] if isinstance(fitter.smoother.extended, Extended) else _scales(fitter)
    last = fit
    for share in SHARES if names else ():
        quiet = _quieter(fitter, fit, share)
        start = {n: v for n, v in last.by_parameter.items() if n not in names}
        try:
            last = quiet.fit(train, of_base.seed, start, APPROXIMATELY)
        except SSMError:
            break
        tried.append(SimulationFit(quiet, last, share, squares(quiet, last)))
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


def _quieter(fitter: Fitter, fit: Fit, share: float) -> Fitter:
    """The fitter with the process noise held at a share of a fit's."""
    if share == 1.0:
        return fitter
    values = fit.by_parameter
    return fitter.with_fixed({n: share * values[n] for n in _scales(fitter)})


def _scales(fitter: Fitter) -> list[str]:
    """Parameters that scale the noise of transitions and do nothing else after the first row."""
    gaussian, trace = fitter.problem.program.gaussian, fitter.problem.trace
    if not isinstance(gaussian, GaussianApproximation):
        return []
    sites = trace.observations.values()
    means = component_means(list(trace.transition.values())).values()
    elsewhere = [*means, *(e for site in sites for e in site.distribution.expressions())]
    used = {s.data[1] for s in symbols_of(elsewhere) if s.data[0] == "parameter"}
    return sorted(fitter.process_noise_scales - used - set(fitter.fixed))
