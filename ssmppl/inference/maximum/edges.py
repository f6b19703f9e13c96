"""Parameters whose maximum is at an edge of their support: a variance at zero, a share at one.

There the score need not vanish, nor is there an interval about the estimate; the other parameters
have their usual distribution given that one (Self and Liang 1987, "Asymptotic properties of maximum
likelihood estimators and likelihood ratio tests under nonstandard conditions", *JASA* 82). An edge
lies at infinity on the unconstrained scale. So an estimate is taken to be there if the objective
nowhere falls on the way out, is not much higher at its end, and falls inwards without rising
before, which tells it from a parameter that is not identified.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ssmppl.data import unpack_parameters
from ssmppl.errors import SamplingError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.inference.maximum.ascent import Edges, Maximization
from ssmppl.language.model.trace import Site
from ssmppl.language.model.transforms import Transform, transforms, unconstrain

OUTWARDS = (1.0, 4.0)  # steps on the unconstrained scale
FARTHEST = (
    30.0,
    15.0,
    8.0,
)  # the last of them: nothing is left inside, nor is it rounded to nothing
INWARDS = tuple(np.arange(2.0, 65.0, 2.0).tolist())  # so close that no hill lies between
WIDER = 6.0  # steps beyond, which begin where the objective is as flat as rounding leaves it
LOGS = 745.0  # of the least number that is not zero: how far out a logarithm may be
ROUNDING = 1e-9  # of the objective, relative
AT_MOST = 0.05  # higher at the edge than at the estimate; from there on a climb is not finished
FALL = 0.5  # of the objective inwards: half a unit, as at one standard error of a normal law
FLAT = 1e-2  # information in z below which an edge may be near: a standard error of 10
INSIDE = 1e-12  # what takes the place of a share of exactly zero
WITHIN_ONE = 1e-8  # by which correlations of -1 and 1 are shrunk: steps outwards still change them


def directions(objective: Callable[[np.ndarray], float], z: np.ndarray) -> np.ndarray:
    """(F,) -1 or 1 where the edge below or above each of z is the place of the maximum, else 0."""
    here, out = objective(z), np.zeros(len(z))

    def moved(j: int, step: float) -> float:
        there = z.copy()
        there[j] += step
        try:
            return objective(there) - here
        except SamplingError:
            return -np.inf

    loss = ROUNDING * (1.0 + abs(here))

    def falls(j: int, sign: float) -> bool:
        """Whether the objective falls on this way, and rises nowhere near; looked for as far as
        the middle, as a spread may have gone to where it counts for nothing."""
        inwards = [moved(j, sign * s) for s in INWARDS]
        if max(inwards) > AT_MOST:
            return False
        beyond = np.arange(INWARDS[-1] + WIDER, min(abs(z[j]), LOGS) + INWARDS[-1], WIDER)
        before = 0.0
        for change in itertools.chain(inwards, (moved(j, sign * s) for s in beyond)):
            if change > AT_MOST:
                return False
            if change <= -FALL:  # no number where nothing fell before is an underflow
                return change > -np.inf or before < -loss
            before = change
        return False

    for j in range(len(z)):
        for sign in (-1.0, 1.0):
            ends = (moved(j, sign * s) for s in FARTHEST)
            last = next((change for change in ends if change > -np.inf), -np.inf)
            outwards = (last, *(moved(j, sign * s) for s in OUTWARDS))
            if all(-loss <= change <= AT_MOST for change in outwards) and falls(j, -sign):
                out[j] = sign
                break
    return out


def edges(
    setup: Maximization, theta: np.ndarray, information: np.ndarray,
    objective: Callable[[np.ndarray], float] | None = None,
) -> Edges | None:  # fmt: skip
    """Which components of theta (P,) are at an edge; None where none is.

    information : (P, P), NaN where it does not exist; where it is plain in all of z, nothing is
    asked of the likelihood. objective : of z (F,), what is maximised; None: the exact one.
    """
    z = _inside(setup, theta)
    jacobian = setup.transform.at(z).jacobian
    with np.errstate(all="ignore"):
        plain = np.einsum("pf,pq,qf->f", jacobian, information, jacobian) > FLAT
    if np.all(plain | setup.space.on_the_line):
        return None
    found = directions(objective or setup.exact_objective, z)
    if not found.any():
        return None
    place = {s: i for i, s in enumerate(setup.problem.trace.parameter_symbols)}
    known = dict(zip(place, theta, strict=True))
    fixed = {s for s in place if s.data[1] in setup.fixed}
    kept, components, moving, first = found == 0.0, {}, set(), 0
    for t in transforms(setup.problem.trace):
        if t.site.name in setup.fixed:
            continue
        own = slice(first, first + len(t.free))
        first += len(t.free)
        support = t.site.distribution.support()
        bounds = [e for end in (support.lower, support.upper) for e in array(end).ravel()]
        for i, edge in reached(t, found[own], kept[own], known):
            components[place[t.components[i]]] = edge
            if symbols_of(bounds) - fixed:
                moving.add(place[t.components[i]])
    return Edges(z, kept, components, frozenset(moving)) if components else None


def held_at(setup: Maximization, found: Edges | None, theta: np.ndarray) -> Edges | None:
    """The same edges at theta (P,), to which the others have gone on; None where an edge may have
    moved with them, or none was found."""
    if found is None or found.moving:
        return None
    return replace(found, z=_inside(setup, theta))


def reached(
    t: Transform, found: np.ndarray, kept: np.ndarray, known: dict[Expr, float]
) -> list[tuple[int, float]]:
    """(component, edge) of one parameter; what is not identified beside it is no longer kept, and
    what has no edge there is."""
    support = t.site.distribution.support()
    if support.kind == "correlation":
        return _singular(t, found, kept)
    if support.tied and support.kind != "simplex":
        kept[:] = True
        return []
    if support.kind == "simplex":
        k, out = t.site.shape[-1], []
        for row in range(len(found) // (k - 1)):
            none = []
            for i in range(k - 1):
                at = row * (k - 1) + i
                if found[at] < 0.0:
                    none.append(i)
                elif found[at] > 0.0:  # nothing of the stick is left
                    none += range(i + 1, k)
                    kept[at + 1 : (row + 1) * (k - 1)] = False
                    break
            out += [(row * k + i, 0.0) for i in none]
            if len(none) == k - 1:
                (whole,) = set(range(k)) - set(none)
                out.append((row * k + whole, 1.0))
        return out
    ends = _ends(t.site, known)
    out = []
    for i in map(int, np.flatnonzero(found)):
        lower, upper = map(float, ends[i])
        if np.isfinite(lower) or np.isfinite(upper):
            out.append((i, _edge(lower, upper, found[i])))
        else:
            kept[i] = True
    return out


def _singular(t: Transform, found: np.ndarray, kept: np.ndarray) -> list[tuple[int, float]]:
    """Of a correlation matrix: the correlations with its first row, which alone have an edge of
    their own, -1 or 1; beside it the others of their row are not identified."""
    place = {s.data[2]: k for k, s in enumerate(t.components)}
    out, at = [], 0
    for i in range(1, t.site.shape[0]):
        if found[at] != 0.0:
            out.append((place[i, 0], float(found[at])))
            kept[at + 1 : at + i] = False
        else:
            kept[at : at + i] = True
        at += i
    return out


def _ends(site: Site, known: dict[Expr, float]) -> np.ndarray:
    """(components, 2) bounds of a site of numbers."""
    support = site.distribution.support()
    return np.array([
        np.broadcast_to(np.array(evaluate(array(e), known), dtype=float), site.shape).ravel()
        for e in (support.lower, support.upper)
    ]).T  # fmt: skip


def _edge(lower: float, upper: float, sign: float) -> float:
    """Where z goes to; with an upper bound only, it is the log of the distance from that."""
    if lower == -np.inf:
        return upper if sign < 0.0 else lower
    return lower if sign < 0.0 else upper


def _inside(setup: Maximization, theta: np.ndarray) -> np.ndarray:
    """(F,) the place of theta; of shares of zero, of shares next to it, and of correlations of 1
    likewise."""
    trace, values = setup.problem.trace, {}
    for name, value in unpack_parameters(trace, theta).items():
        value = np.asarray(value, dtype=float)
        kind = trace.parameters[name].distribution.support().kind
        if kind == "simplex":
            value = np.maximum(value, INSIDE)
            value = value / value.sum(axis=-1, keepdims=True)
        if kind == "correlation":
            value = (1.0 - WITHIN_ONE) * value + WITHIN_ONE * np.eye(len(value))
        values[name] = value
    return unconstrain(trace, theta, values)[setup.space.positions]
