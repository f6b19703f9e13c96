"""Densities of draws and of priors, as curves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.run.prior import draw_prior
from ssmppl.language.model.trace import Site, Trace
from ssmppl.plots.reading import components

__all__ = ["Prior", "estimated", "prior_draws", "priors_of", "supports", "window"]

POINTS = 300  # of a curve
CELLS = 1500  # that draws are counted in before they are smoothed
PRIOR_DRAWS = 4000


@dataclass(frozen=True)
class Prior:
    """The prior of one scalar.

    site : its distribution, where that has a density that does not depend on other parameters; or
        draws,
    (n,), from it; neither where it is improper. lower, upper : ends of the support.
    """

    site: Site | None = None
    index: tuple[int, ...] = ()
    draws: np.ndarray | None = None
    lower: float = -np.inf
    upper: float = np.inf

    @property
    def known(self) -> bool:
        """Whether there is a density to draw."""
        return self.site is not None or self.draws is not None

    def density(self, x: np.ndarray) -> np.ndarray:
        """The density at x, increasing and evenly spaced."""
        if self.site is None:
            assert self.draws is not None
            return estimated(self.draws, x, self.lower, self.upper)
        d, value = self.site.distribution, self.site.value
        logs = _filled(d.guarded_log_densities(value), self.site.shape)
        with np.errstate(all="ignore"):
            found = evaluate(logs[self.index], {value.view(np.ndarray)[self.index]: x})
            return np.broadcast_to(np.exp(np.asarray(found, dtype=float)), x.shape)


def supports(traced: Trace) -> dict[str, tuple[float, float]]:
    """Ends of the support of each component, infinite where they depend on other parameters."""
    found: dict[str, tuple[float, float]] = {}
    for site in traced.parameters.values():
        support = site.distribution.support()
        bounds = [_filled(b, site.shape) for b in (support.lower, support.upper)]
        for label, _, low, high in _each(traced, site, *bounds):
            ends = [
                float(e.data) if getattr(e, "op", "") == "const" else without
                for e, without in ((low, -np.inf), (high, np.inf))
            ]
            found.setdefault(label, (ends[0], ends[1]))
    return found


def priors_of(traced: Trace) -> dict[str, Prior]:
    """The prior of each component of the parameters: exactly, or by draws where it depends on
    others or is the margin of a joint distribution."""
    ends = supports(traced)
    draws: np.ndarray | None = None
    laws = [s.distribution for s in traced.parameters.values()]
    if all(d.proper and d.drawable for d in laws):
        draws = draw_prior(traced, np.random.default_rng(0), PRIOR_DRAWS)
    place = {s: k for k, s in enumerate(traced.parameter_symbols)}
    found: dict[str, Prior] = {}
    for site in traced.parameters.values():
        d = site.distribution
        others = symbols_of([e for p in d.parameters.values() for e in np.ravel(p)])
        exact = not d.joint and not others and d.proper
        for index, (label, symbol) in zip(np.ndindex(site.shape), _each(traced, site), strict=True):
            own = None if draws is None or exact else draws[:, place[symbol]]
            found[label] = Prior(site if exact else None, index, own, *ends[label])
    return found


def _each(traced: Trace, site: Site, *more: np.ndarray) -> list[tuple[Any, ...]]:
    """(label, symbol, of each further array its entry) of the components of a parameter."""
    symbols = site.value.view(np.ndarray)
    found = []
    for index in np.ndindex(site.shape):
        label = traced.component_names.label(site.name, index)
        found.append((label, symbols[index], *(m[index] for m in more)))
    return found


def _filled(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An array of expressions of this shape, which can be indexed without becoming one."""
    return np.broadcast_to(array(values).view(np.ndarray), shape)


def estimated(
    draws: np.ndarray, x: np.ndarray, lower: float = -np.inf, upper: float = np.inf
) -> np.ndarray:
    """Kernel estimate of the density of draws (n,) at x, increasing and evenly spaced.

    Gaussian kernels with Silverman's (1986) bandwidth, reflected at the ends of the support, beyond
    which it is zero. Draws far outside of the range of x count as draws, but not for the bandwidth.
    """
    span = x[-1] - x[0]
    inside = draws[(draws >= x[0] - span) & (draws <= x[-1] + span)]
    if len(inside) < 2 or span <= 0.0:
        return np.zeros(len(x))
    quartiles = np.quantile(inside, [0.25, 0.75])
    spreads = [s for s in (inside.std(), (quartiles[1] - quartiles[0]) / 1.34) if s > 0.0]
    width = max(0.9 * min(spreads, default=span) * len(inside) ** -0.2, 1e-3 * span)
    edges = np.linspace(x[0] - span, x[-1] + span, 3 * CELLS + 1)
    counts, _ = np.histogram(inside, bins=edges)
    filled = counts > 0
    centres, weights = 0.5 * (edges[:-1] + edges[1:])[filled], counts[filled] / len(draws)
    found = _kernels(x, centres, weights, width)
    for end in (lower, upper):
        if np.isfinite(end):
            found += _kernels(x, 2.0 * end - centres, weights, width)
    return np.where((x >= lower) & (x <= upper), found, 0.0)


def _kernels(x: np.ndarray, centres: np.ndarray, weights: np.ndarray, width: float) -> np.ndarray:
    away = (x[:, None] - centres[None, :]) / width
    total: np.ndarray = np.exp(-0.5 * away**2) @ weights
    return total / (width * np.sqrt(2.0 * np.pi))


def window(draws: np.ndarray, lower: float = -np.inf, upper: float = np.inf) -> np.ndarray:
    """Points over the range of draws and a fifth more on both sides, inside of the support."""
    low, high = np.quantile(draws, [0.001, 0.999])
    room = 0.2 * (high - low) or 0.1 * abs(low) or 1.0
    return np.linspace(max(low - room, lower), min(high + room, upper), POINTS)


def prior_draws(dataset: Any) -> dict[str, Prior]:
    """The priors of a group of draws from them."""
    found: dict[str, Prior] = {}
    for name, variable in dataset.data_vars.items():
        if "time" not in variable.dims:
            values = variable.transpose("chain", "draw", ...).values
            flat = values.reshape(-1, *values.shape[2:])
            found |= {k: Prior(draws=v) for k, v in components(str(name), flat, 1, variable)}
    return found
