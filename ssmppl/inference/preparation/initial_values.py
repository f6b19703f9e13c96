"""Values of parameters to begin at where nobody gave any: ordinary ones, inside their supports."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ssmppl.data.values import number
from ssmppl.errors import ArgumentError, SSMError, listing
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.model.trace import Site, Trace

__all__ = ["ordinary_values"]

Values = dict[str, np.ndarray]
# From here on a centre tells of the scale only if the spread is not much wider: that of a law that
# is to say nothing does not.
LARGE, WIDE = 1e6, 10.0
DOUBLINGS = 40  # of the distance from an ordinary value that is looked at


def ordinary_values(
    trace: Trace, fixed: Mapping[str, np.ndarray], start: Mapping[str, np.ndarray]
) -> Values:
    """Each parameter's value, float64 of its shape: given, or the prior's mean, or median where it
    has no mean, or else such that what was given is within bounds that depend on it.

    Raises
    ------
    ArgumentError : no value was found for that.
    """
    given = {**start, **fixed}
    values = _filled(trace, given)
    site = _misplaced(trace, values, given)
    if site is None:
        return values
    bounds = _bounds(site)
    owners = {s.data[1] for s in symbols_of([e for end in bounds for e in end.ravel()])}
    plain = [
        s.name for s in trace.parameters.values() if s.distribution.support().kind == "interval"
    ]
    for tried in _moved(values, [n for n in plain if n in owners and n not in given]):
        values = _filled(trace, {**given, **tried})
        if _misplaced(trace, values, {**given, **tried}) is None:
            return values
    values = _filled(trace, given)
    lower, upper = (_at(end, trace, values, site.shape).min() for end in bounds)
    argument = "fixed" if site.name in fixed else "start"
    raise ArgumentError(
        f"{argument}: parameter {site.name!r} is {np.array2string(given[site.name])}, outside "
        f"({number(lower)}, {number(upper)}) where {listing('', sorted(owners))} "
        f"{'is' if len(owners) == 1 else 'are'} "
        f"{', '.join(np.array2string(values[n], precision=6) for n in sorted(owners))}",
        fix=f"give values of {listing('', sorted(owners))} and of {site.name!r} that agree",
    )


def _filled(trace: Trace, given: Mapping[str, np.ndarray]) -> Values:
    """The given values, and ordinary ones of the others, in the order of the declarations."""
    values: Values = {}
    known: dict[Expr, float] = {}
    for site in trace.parameters.values():
        value = given.get(site.name)
        values[site.name] = np.asarray(_moderate(site, known) if value is None else value, float)
        known.update(zip(site.value.ravel(), values[site.name].ravel(), strict=True))
    return values


def _misplaced(trace: Trace, values: Values, given: Mapping[str, np.ndarray]) -> Site | None:
    """The first parameter whose given value is not within its bounds."""
    for name in given:
        site = trace.parameters[name]
        if site.distribution.support().kind == "interval":
            lower, upper = (_at(end, trace, values, site.shape) for end in _bounds(site))
            if np.any(values[name] < lower) or np.any(values[name] > upper):
                return site
    return None


def _bounds(site: Site) -> tuple[np.ndarray, np.ndarray]:
    support = site.distribution.support()
    return array(support.lower).view(np.ndarray), array(support.upper).view(np.ndarray)


def _at(bound: np.ndarray, trace: Trace, values: Values, shape: tuple[int, ...]) -> np.ndarray:
    env = {s: values[s.data[1]][s.data[2]] for s in trace.parameter_symbols}
    found = np.array(evaluate(bound.ravel(), env), dtype=float).reshape(bound.shape)
    return np.broadcast_to(found, shape)


def _moved(values: Values, names: list[str]) -> Iterator[Values]:
    """Other values of the named parameters, nearer ones first: of all together, then of each."""
    groups = [names, *([n] for n in names if len(names) > 1)]
    for k in range(DOUBLINGS):
        for group in groups:
            for step in (1.0, -1.0):
                yield {n: values[n] * 2.0 ** (step * k) for n in group}
                yield {n: values[n] + step * 2.0**k for n in group}


def _moderate(site: Site, known: dict[Expr, float]) -> np.ndarray:
    """A value inside the support: the prior's mean where it has one, else an ordinary number."""
    d = site.distribution
    mean = np.broadcast_to(evaluate(array(d.mean()), known), site.shape).astype(float)
    support = d.support()
    if support.kind in ("positive definite", "correlation"):
        usable = bool(np.all(np.isfinite(mean))) and bool(np.all(np.linalg.eigvalsh(mean) > 0))
        return mean if usable else np.eye(site.shape[0])
    lower = np.broadcast_to(evaluate(array(support.lower), known), site.shape)
    upper = np.broadcast_to(evaluate(array(support.upper), known), site.shape)
    if support.kind == "ordered":
        return _in_order(d, lower, upper, known)
    half_way = np.array([_between(a, b) for a, b in zip(lower.flat, upper.flat, strict=True)])
    half_way = half_way.reshape(site.shape)
    for centre, spread in _centres(d, mean, known):
        tells = (np.abs(centre) < LARGE) | (spread <= WIDE * np.abs(centre))
        inside = np.isfinite(centre) & (centre > lower) & (centre < upper) & tells
        half_way = np.where(inside, centre, half_way)
    return half_way


def _in_order(
    d: Distribution, lower: np.ndarray, upper: np.ndarray, known: dict[Expr, float]
) -> np.ndarray:
    """Increasing values: quantiles at equal steps of probability, else at equal distances."""
    k = lower.shape[-1]
    (law,) = d.inside()
    steps = np.broadcast_to(np.arange(1.0, k + 1.0) / (k + 1.0), lower.shape)
    with np.errstate(all="ignore"), contextlib.suppress(AttributeError, SSMError):
        found = np.broadcast_to(evaluate(law.quantile(array(steps)), known), lower.shape)
        inside = np.isfinite(found) & (found > lower) & (found < upper)
        if np.all(inside) and np.all(np.diff(found) > 0.0):
            return found.astype(float)
    first = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - k - 1.0, 0.0))
    both = np.isfinite(lower) & np.isfinite(upper)
    with np.errstate(invalid="ignore"):
        return first + np.where(both, upper - lower, k + 1.0) * steps


def _centres(
    d: Distribution, mean: np.ndarray, known: dict[Expr, float]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Centre and spread of a distribution, each of the mean's shape: by quartiles, then by
    moments."""

    def numbers(values: Any) -> np.ndarray:
        return np.broadcast_to(evaluate(array(values), known), mean.shape).astype(float)

    with np.errstate(all="ignore"):
        with contextlib.suppress(AttributeError, SSMError):  # has no quantiles
            low, median, high = (numbers(d.quantile(array(p))) for p in (0.25, 0.5, 0.75))
            yield median, high - low
        spread = np.full(mean.shape, np.inf)
        with contextlib.suppress(AttributeError, SSMError):  # has no variance
            spread = np.sqrt(numbers(d.variance()))
        yield mean, spread


def _between(lower: float, upper: float) -> float:
    if np.isfinite(lower):
        return 0.5 * (lower + upper) if np.isfinite(upper) else lower + 1.0
    return upper - 1.0 if np.isfinite(upper) else 0.0
