"""Which method a verb takes where it is left to choose, and why."""

from __future__ import annotations

from collections.abc import Sequence

from ssmppl.analysis.smooth import smooth_filter_applies
from ssmppl.analysis.update import Update
from ssmppl.errors import NotApplicable
from ssmppl.inference.methods import (
    PGAS,
    DirectOptimization,
    FFBSi,
    ForwardBackward,
    Gibbs,
    KalmanSmoother,
    MetropolisHastings,
    ScoreAscent,
)
from ssmppl.language.trace import Trace

FEW = 6  # numbers that a random walk moves at once without trouble


def choose_sampler(
    kind: str | NotApplicable, updates: Sequence[Update]
) -> tuple[MetropolisHastings | Gibbs | PGAS, str]:
    """The method for a model of this kind with these updates, and the reason.

    kind : "linear Gaussian" or "of finitely many states", whose states are drawn exactly, or why it
    is neither. Gibbs then needs no tuning where every
    parameter has a closed-form conditional; where some have none, slices given the states mix
    slowly and cost a pass over the data each, and a random walk on the exact likelihood, which
    integrates the states out, is better as long as the parameters are few.
    """
    if isinstance(kind, NotApplicable):
        return PGAS(), "the model is not linear Gaussian: trajectories by conditional SMC"
    open_ = [c for u in updates if u.conditional is None for c in u.block]
    if not open_:
        return Gibbs(), (
            f"{kind}, and every parameter has a closed-form conditional: exact trajectories by "
            "backward sampling"
            if updates
            else f"{kind}, without free parameters: exact trajectories by backward sampling"
        )
    named = ", ".join(dict.fromkeys(open_))
    numbers = sum(len(u.components) for u in updates)
    if numbers <= FEW:
        return MetropolisHastings(), (
            f"{kind}, but {named} has no closed-form conditional: a random walk on the "
            "exact likelihood"
        )
    return Gibbs(), (
        f"{kind}, with {numbers} numbers to move, too many for a random walk: exact "
        f"trajectories, and slices for {named}"
    )


def choose_maximiser(
    kind: str | NotApplicable, trace: Trace
) -> tuple[DirectOptimization | ScoreAscent, str]:
    """The method of `maximize` for a model of this kind, and the reason."""
    if not isinstance(kind, NotApplicable):
        return DirectOptimization(), (
            f"the model is {kind}, so that its likelihood and score are exact"
        )
    obstacle = smooth_filter_applies(trace)
    if obstacle is None:
        return DirectOptimization(), (
            "for one scalar state a particle filter's likelihood can be made continuous in the "
            "parameters"
        )
    return ScoreAscent(), (
        "Fisher's identity gives the score by particle smoothing; direct optimisation does not "
        f"apply: {obstacle.reason}"
    )


def choose_smoother(
    kind: str | NotApplicable,
) -> tuple[KalmanSmoother | ForwardBackward | FFBSi, str]:
    """The method of `smooth` for a model of this kind, and the reason."""
    if isinstance(kind, NotApplicable):
        return FFBSi(), f"the model is not linear and Gaussian: {kind.reason}"
    chosen = KalmanSmoother() if kind == "linear Gaussian" else ForwardBackward()
    return chosen, f"the model is {kind}"
