"""What the methods of the EM family share: the derived M-step of a question, or why none."""

from __future__ import annotations

from ssmppl.analysis.expectation import unsuited
from ssmppl.analysis.mstep import MStep, counted, derive_m_step
from ssmppl.analysis.sufficient import complete_data
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.ascent import Setup

__all__ = ["check_missing_data", "m_step"]


def m_step(setup: Setup) -> MStep | NotApplicable:
    """The M-step of the free parameters; the reason where the densities do not separate.

    Raises
    ------
    ArgumentError : the states cannot be the missing data for these parameters.
    """
    check_missing_data(setup)
    problem = setup.problem
    return derive_m_step(
        problem.trace, tuple(setup.held), problem.program.missing, setup.with_prior
    )


def check_missing_data(setup: Setup) -> None:
    """Refuse parameters that the states determine or cut off.

    Raises
    ------
    ArgumentError : naming parameter, line and what to use instead.
    """
    trace = setup.problem.trace
    free = [s for s in trace.parameter_symbols if s.data[1] not in setup.held]
    data = counted(complete_data(trace, setup.problem.program.missing), setup.with_prior)
    reason = unsuited(data, free)
    if reason is not None:
        names = sorted({s.data[1] for s in free})
        raise ArgumentError(
            f"EM does not apply: {reason.reason}",
            fix="use ssm.DirectOptimization() or ssm.ScoreAscent(), or hold the parameter by "
            f"fixed={{...}} (free are: {', '.join(names)})",
            where=reason.where,
        )
