"""Methods that need the density of the states' distributions, where a covariance leaves none."""

from __future__ import annotations

from ssmppl.analysis.structure import exact_observation, linear_gaussian, singular_covariance
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.language.model.trace import Trace

WITHOUT = {  # what to use instead: of a linear Gaussian model, and of others
    "sample": ("ssm.MetropolisHastings()", "ssm.PMMH()"),
    "maximize": ("ssm.DirectOptimization()", "ssm.IF2()"),
    "smooth": ("ssm.KalmanSmoother()", 'ssm.FFBSi(kernel="genealogy")'),
    "score": ('proposal="auto"', "ssm.maximize with ssm.IF2()"),
}


def need_density(trace: Trace, method: str, verb: str) -> None:
    """Refuse a method that weighs states by the density of their transition where there is none.

    Raises
    ------
    ArgumentError : a covariance is singular; names the distribution, and what needs no density.
    """
    reason = singular_covariance(trace)
    if reason is None:
        return
    linear = not isinstance(linear_gaussian(trace), NotApplicable)
    exact = reason == exact_observation(trace)
    if exact:
        written = "give the observation some noise"
    elif reason == trace.singular_row:
        written = "leave out the rows in which it is so, or give the states a little noise there"
    else:
        written = (
            "write components that follow without a noise of their own as states of distribution "
            "ssm.Dirac"
        )
    if verb in WITHOUT and not (exact and not linear and verb in ("maximize", "score")):
        written = f"use {WITHOUT[verb][0 if linear else 1]}, which needs none; or {written}"
    raise ArgumentError(
        f"{method} needs {'densities' if exact else 'the density of the states'}: {reason.reason}",
        fix=written,
        where=reason.where,
    )
