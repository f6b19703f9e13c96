"""Draws from the prior, and what must hold for them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ssmppl.analysis.proposals.proposals import drawn
from ssmppl.errors import ArgumentError
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import Expr
from ssmppl.language.model.trace import Trace


def draw_prior(
    trace: Trace, rng: np.random.Generator, draws: int,
    fixed: Mapping[str, np.ndarray] | None = None, alternative: str = "or its value by parameters=",
) -> np.ndarray:  # fmt: skip
    """(draws, P) independent draws of theta, parents before children; the fixed keep their value.

    alternative : what else the caller's user can give, for the message.

    Raises
    ------
    ArgumentError : some prior is improper.
    """
    values: dict[Expr, np.ndarray] = {}
    source = numpy_draws(rng, (draws,))
    for site in trace.parameters.values():
        d = site.distribution
        if fixed is not None and site.name in fixed:
            for s, v in zip(site.value.ravel(), fixed[site.name].ravel(), strict=True):
                values.setdefault(s, np.full(draws, v))
            continue
        if not d.proper:
            raise ArgumentError(
                f"the prior of {site.name!r} is {type(d).__name__}, which is improper: nothing "
                "can be drawn from it",
                fix=f"give {site.name!r} a proper prior, {alternative}",
            )
        if not d.drawable:
            raise d.undrawable(f"the prior of {site.name!r} has to be drawn from here")
        sample = evaluate(drawn(site), values, source)
        flat = np.broadcast_to(
            sample.reshape(site.value.size, -1), (site.value.size, draws)
        )  # a sampler without randomness has no axis of draws
        for i, s in enumerate(site.value.ravel()):
            values.setdefault(s, flat[i])
    symbols = trace.parameter_symbols
    return np.stack([values[s] for s in symbols], axis=-1) if symbols else np.empty((draws, 0))
