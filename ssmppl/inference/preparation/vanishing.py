"""Noises that vanish against the data: where a likelihood grows without bound.

A linear Gaussian model that can follow the data exactly, as any level does a constant series, has
no maximum of the likelihood: it grows with every step of the variances towards zero, until what
the filter predicts differs from the data by rounding only. Likewise one without noise in its
states. One of finitely many states has none where a value of the states tells some rows exactly, as
a component of a mixture does that has shrunk to a point (Day 1969, "Estimating the components of a
mixture of normal distributions", *Biometrika* 56).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ssmppl.codegen.text.kernel_functions import predictive
from ssmppl.data import Experiment, spelled
from ssmppl.errors import NotApplicable, SamplingError
from ssmppl.expressions.expr import Expr
from ssmppl.inference.exact.hidden_markov import HiddenMarkov
from ssmppl.inference.particles.deterministic import Deterministic
from ssmppl.inference.preparation.exact_models import ExactModel

VANISHED = 1e-12  # standard deviation of a prediction against the data's size, near rounding
LEAST = 1e-100  # and where the data are all zero


def without_maximum(
    model: ExactModel, experiments: Iterable[Experiment], theta: np.ndarray, rows: int = 1
) -> NotApplicable | None:
    """Why the likelihood has no maximum, if that is where a search ran to theta (P,): the model
    predicts a channel to within rounding there. None where it does not.

    rows : how many a value of finitely many states has to tell exactly.
    """
    laws = {n: site.distribution for n, site in model.trace.observations.items()}
    if all(law.discrete for law in laws.values()):
        return None
    forms = [v for site in model.trace.observations.values() for _, v, *_ in predictive(site)]
    for e in experiments:
        try:
            predicted = _variances(model, e, theta, forms)
        except SamplingError:
            continue
        for k, symbol in enumerate(model.trace.observation_symbols):
            seen = e.seen[:, k] > 0.0
            if not seen.any() or laws[symbol.data[1]].discrete:
                continue
            y, variance = e.y[seen, k], predicted[seen, k]
            least = max(VANISHED * float(np.max(np.abs(y))), LEAST)
            exact = np.sqrt(variance) < least
            some = isinstance(model, HiddenMarkov) and np.sum(exact) >= rows
            if not (some or np.sqrt(np.median(variance)) < least):
                continue
            if np.ptp(y) == 0.0:
                how = f"are constant ({y[0]:.6g} in every row)"
            elif some and not exact.all():
                how = f"determine the states exactly in {np.sum(exact)} rows"
            else:
                how = "are fitted exactly"
            return NotApplicable(
                f"the likelihood has no maximum: the data of {symbol!r} {how}, so that it grows "
                "without bound as the variances of the noises go to zero",
                laws[symbol.data[1]].location,
            )
    return None


def _variances(
    model: ExactModel, e: Experiment, theta: np.ndarray, forms: Sequence[Expr]
) -> np.ndarray:
    """(T, K) of the one-step predictions of each component; of finitely many states, given the
    value that is likeliest by all data, by the forms that the variances have then."""
    if isinstance(model, Deterministic):
        return model.observation_variances(e, theta)
    if isinstance(model, HiddenMarkov):
        ((h, law, _),) = model.laws([e], theta)
        likeliest = np.argmax(law, axis=1)
        found = []
        for variance in forms:
            each = np.broadcast_to(model.over_values(variance, h, theta, "observation"), law.shape)
            found.append(each[np.arange(e.steps), likeliest])
        return np.stack(found, axis=1)
    return np.diagonal(model.filter(e, theta).observation_covariance, axis1=1, axis2=2)


def check_mode(model: ExactModel, experiments: Iterable[Experiment], theta: np.ndarray) -> None:
    """Refuse to sample from a mode (P,) that is none.

    Raises
    ------
    SamplingError : the likelihood has no maximum, and the prior sets no bound either; names the
        channel, and says whether its values are all the same.
    """
    # about a single row the posterior may have little mass: a free mean has to meet it
    reason = without_maximum(model, experiments, theta, rows=2)
    if reason is not None:
        raise SamplingError(
            f"{reason.reason}, and the prior does not bound them away from zero; parameters: "
            f"{spelled(model.trace, theta)}",
            fix="check this column; else hold a variance by fixed={...}, or give it a prior that "
            "keeps it off zero, as ssm.InverseGamma does",
            where=reason.where,
        )
