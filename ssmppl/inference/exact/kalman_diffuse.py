"""Flat components of x_1 in a linear Gaussian model: the start that smoother and score go from.

See `codegen/kernels/kalman_diffuse.py`. Given the flat part the model is an ordinary one, and given
the data the flat part is Gaussian; so everything but the filter runs on the ordinary model from the
mean of that Gaussian, with its root in further columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from ssmppl.codegen.exact import exact_entry
from ssmppl.codegen.kernels.kalman import LOG_2PI, OK
from ssmppl.codegen.kernels.kalman_steps import Matrices
from ssmppl.data import Experiment
from ssmppl.errors import SamplingError
from ssmppl.inference.exact.kalman_moments import Stopped
from ssmppl.inference.totals import total_of
from ssmppl.language.traced import Trace

AGREEMENT = 1e-6  # of log p(y) by two roads; what is worse was lost to rounding


@dataclass(frozen=True)
class Start:
    """x_1 = columns[:, 0] + columns[:, 1:] n + N(0, P), n ~ N(0, I) given the data.

    columns (D, F). log_likelihood : log p(y), and log_given : log p(y | n = 0) that it entails;
    None where no component is flat.
    """

    columns: np.ndarray
    log_likelihood: float | None = None
    log_given: float | None = None

    def log_density(self, log_given: float) -> float:
        """log p(y) from what the ordinary filter says of column 0."""
        return log_given if self.log_likelihood is None else self.log_likelihood


def diffuse_filter(
    model: Matrices, flat: tuple[int, ...], experiment: Experiment, *outputs: Any
) -> tuple[np.ndarray, np.ndarray]:
    """factor (G, G) and right (G,) of the law of the flat part; outputs as of the kernel.

    Raises
    ------
    Stopped : the laws have no density at theta.
    """
    g = len(flat)
    factor, right = np.empty((g, g)), np.empty(g)
    outputs = outputs if len(outputs) > 1 else (*outputs, *[None] * 6)
    status, t = exact_entry("diffuse_filter")(
        model, np.array(flat), experiment.y, experiment.seen, factor, right, *outputs
    )
    if status != OK:
        raise Stopped(status, t)
    return factor, right


def start_of(trace: Trace, flat: tuple[int, ...], model: Matrices, experiment: Experiment) -> Start:
    """The start of the ordinary model that stands for this one, given the data.

    Raises
    ------
    Stopped : the laws have no density at theta.
    SamplingError : the data do not tell some flat component.
    """
    mean = model.m[:, None]
    if not flat:
        return Start(mean.copy())
    increments = np.empty(experiment.steps)
    factor, right = diffuse_filter(model, flat, experiment, increments)
    for j, i in enumerate(flat):
        if factor[j, j] == 0.0:
            site = trace.initial[trace.state_symbols[i].data[1]]
            raise SamplingError(
                f"the start of {trace.state_symbols[i]!r} is Flat, and the data do not tell it "
                "(together with the components that are Flat before it)",
                fix="give it a proper law in @initial, or data that depend on it",
                where=site.distribution.location,
            )
    total = total_of(increments)
    root = scipy.linalg.solve_triangular(factor, np.eye(len(flat)))
    columns = np.zeros((len(mean), 1 + len(flat)))
    columns[:, :1] = mean
    columns[list(flat), 0] += root @ right
    columns[list(flat), 1:] = root
    spread = float(np.log(abs(np.diag(factor))).sum()) - 0.5 * len(flat) * LOG_2PI
    return Start(columns, total, total + spread)


def check_agreement(trace: Trace, start: Start, log_given: float) -> None:
    """Refuse results of a filter that disagrees with the one that found the start.

    Raises
    ------
    SamplingError : rounding errors have grown until nothing was left.
    """
    expected = start.log_given
    if expected is None or abs(log_given - expected) <= AGREEMENT * (1.0 + abs(expected)):
        return
    site = next(s for s in trace.initial.values() if not s.distribution.proper)
    raise SamplingError(
        f"the start of {site.name!r} is Flat, and its effect grows over time until rounding errors "
        f"hide it: log p(y) is {expected:.8g} or {log_given:.8g}, by where it is computed",
        fix="give it a proper law in @initial, or its transition some noise",
        where=site.distribution.location,
    )
