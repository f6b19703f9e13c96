"""Rows in which the data leave the states, or an observation, without a density: a step of no
length, an input that switches a noise off, so that a variance is zero, or a covariance singular."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ssmppl.data.binding import Experiment
from ssmppl.data.values import number
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol, symbols_of, to_text
from ssmppl.expressions.properties import may_vanish_by_data
from ssmppl.expressions.special import PIVOT
from ssmppl.expressions.test_points import PLAIN
from ssmppl.language.distributions import LogNormal, MvNormal, Normal
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.model.trace import Site, Trace, previous

CHUNK = 1 << 16  # rows that are looked at together
OF_A_SCALE = ("sd", "scale")  # of other distributions: zero where all of their draws are the same


def of_data(trace: Trace, experiments: Sequence[Experiment]) -> Trace:
    """The trace, with the first rows of these data in which states or observations have no density
    whatever parameters and states are, as far as the data tell."""
    singular = next(_of_states(trace, experiments), None)
    noiseless = next(_of_observations(trace, experiments), None)
    if singular is None and noiseless is None:
        return trace
    # one object for all data with these rows, as what is derived of a trace is kept by it
    kept: dict[tuple, Trace] = trace.__dict__.setdefault("_of_data", {})
    key = singular, noiseless
    if key not in kept:
        kept[key] = replace(trace, singular_row=singular, noiseless_row=noiseless)
    return kept[key]


def _of_states(trace: Trace, experiments: Sequence[Experiment]) -> Iterator[NotApplicable]:
    for e in experiments:
        now = _known(trace, e)
        before = {previous(s): v[:-1] for s, v in now.items()} | {
            previous(s): v[:-1] for s, v in zip(trace.observation_symbols, e.y.T, strict=True)
        }
        first = {s: v[:1] for s, v in now.items()}
        for site in trace.initial.values():
            yield from _of_site(
                f"the initial distribution of {site.name}", site, first, e, "states"
            )
        for site in trace.transition.values():
            yield from _of_site(f"the transition of {site.name}", site, before, e, "states")


def _of_observations(trace: Trace, experiments: Sequence[Experiment]) -> Iterator[NotApplicable]:
    order = {s: k for k, s in enumerate(trace.observation_symbols)}
    for e in experiments:
        for site in trace.observations.values():
            measured = e.seen[:, [order[s] for s in site.components]].any(axis=1)
            known = {s: v[measured] for s, v in _known(trace, e).items()}
            rows = np.flatnonzero(measured)
            whose = f"the distribution of {site.name}"
            yield from _of_site(whose, site, known, e, "observation", rows)


def _known(trace: Trace, e: Experiment) -> dict[Expr, np.ndarray]:
    known = dict(zip(trace.input_symbols, e.u.T, strict=True))
    return known | {symbol("time", "t"): np.arange(1.0, e.steps + 1.0)}


def _of_site(
    whose: str, site: Site, known: dict[Expr, np.ndarray], e: Experiment, of: str,
    rows: np.ndarray | None = None,
) -> Iterator[NotApplicable]:  # fmt: skip
    """known : what the data tell, at rows of these numbers; None: 0, 1, ..."""
    law = site.distribution
    for n, entries in _spreads(law):
        read = [s for s in symbols_of(entries) if s in known]
        if not read or not may_vanish_by_data(entries) or not len(known[read[0]]):
            continue
        k = _first_singular(n, entries, {s: known[s] for s in read})
        if k is not None:
            here = ", ".join(f"{_column(s)} = {number(float(known[s][k]))}" for s in read)
            row = k if rows is None else int(rows[k])
            where = f"row {row + 1}" + ("" if e.label is None else f" of {e.label!r}")
            how = "covariance in {} is singular" if n > 1 else "variance in {} is zero"
            yield NotApplicable(
                f"the {how.format(whose)} in {where} ({here}), so that the {of} "
                f"{'have' if of == 'states' else 'has'} no density there",
                law.location,
            )


def _column(s: Expr) -> str:
    """What the user calls it: a transition reads it of the row before."""
    kind, name, index = s.data
    return to_text(symbol(kind.removesuffix("_prev"), name, index))


def _spreads(law: Distribution) -> Iterator[tuple[int, list[Expr]]]:
    """(n, the n x n entries of a covariance, or variances and scales, each alone)."""
    if isinstance(law, MvNormal):
        yield len(law.mean_), list(law.covariance_matrix().ravel())
    elif isinstance(law, Normal):
        yield from ((1, [v]) for v in array(law.variance()).ravel())
    else:
        named = OF_A_SCALE if not isinstance(law, LogNormal) else ("sd",)
        for name in named:
            values = law.parameters.get(name)
            if values is not None and values.shape in ((), law.shape):
                yield from ((1, [v]) for v in values.ravel())


def _first_singular(n: int, entries: list[Expr], values: dict[Expr, np.ndarray]) -> int | None:
    """The first of the rows of `values` in which the matrix is singular; None where none is."""
    rows = len(next(iter(values.values())))
    for first in range(0, rows, CHUNK):
        some = {s: v[first : first + CHUNK] for s, v in values.items()}
        suspect = np.flatnonzero(_singular(n, entries, some, 1))
        sure = suspect[_singular(n, entries, {s: v[suspect] for s, v in some.items()}, PLAIN)]
        if len(sure):
            return first + int(sure[0])
    return None


def _singular(
    n: int, entries: list[Expr], values: dict[Expr, np.ndarray], points: int
) -> np.ndarray:
    """Whether the matrix is singular, for each of the values of what data tell, at each of so many
    points of all else at which it is a covariance."""
    rng = np.random.default_rng(20)
    rows = len(next(iter(values.values())))
    others = sorted(symbols_of(entries) - set(values), key=to_text)
    at = {s: v[:, None] for s, v in values.items()}
    at |= {s: rng.uniform(0.2, 0.9, (1, points)) for s in others}
    with np.errstate(all="ignore"):
        found = np.stack(
            [np.broadcast_to(v, (rows, points)) for v in evaluate(entries, at)], axis=-1
        ).reshape(rows, points, n, n)
    with contextlib.suppress(np.linalg.LinAlgError):
        own = np.diagonal(np.linalg.cholesky(found), axis1=-2, axis2=-1) ** 2
        if np.all(own > PIVOT * np.diagonal(found, axis1=-2, axis2=-1)):
            return np.zeros(rows, dtype=bool)
    finite = np.isfinite(found).all(axis=(-2, -1))
    found = np.where(finite[..., None, None], found, np.eye(n))
    diagonal = np.diagonal(found, axis1=-2, axis2=-1)
    unit = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    least = np.linalg.eigvalsh(found / unit[..., :, None] / unit[..., None, :])[..., 0]
    covariance = finite & (diagonal >= 0.0).all(axis=-1) & (least >= -n * PIVOT)
    gone = (diagonal == 0.0).any(axis=-1) | (least <= n * PIVOT)
    told: np.ndarray = covariance.any(axis=1) & (gone | ~covariance).all(axis=1)
    return told
