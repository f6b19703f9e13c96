"""One draw of a derived update, given its statistics.

The draw leaves the exact conditional invariant, whatever path it takes:

- conjugate part, kept if it lies within the bounds and passes the correction: accept-reject, an
  independent draw from the conditional itself;
- after `MAX_TRIES` refusals a sweep of slice steps instead, or after `LOOK` of them that had next
  to no chance, as where many data sets share a parameter of their initial distribution. How many
  refusals there were, and what was refused, does not depend on the current value, so this mixes two
  kernels that both leave the conditional invariant;
- a correction without a known upper bound, or one that does not separate and is taken from the log
  joint density: a Metropolis-Hastings step that proposes from the conjugate part, then always a
  sweep of slice steps, so that no value is held for long;
- statistics under which the conjugate part is improper: slice steps. A Normal-Gamma block is then
  updated separately, v by its Gamma given theta (where nothing outside the family holds v) and
  theta by slices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple
from weakref import WeakKeyDictionary, ref

import numpy as np

from ssmppl.analysis.bounds import Interval
from ssmppl.analysis.conjugacy.family import Limits, Values
from ssmppl.analysis.conjugacy.matrix_families import size_of_matrix
from ssmppl.analysis.conjugacy.update import (
    Update,
    correction_ranges,
    natural_bounds,
    update_bounds,
)
from ssmppl.analysis.lambdify import DOMAIN, python_function, python_sum
from ssmppl.errors import SamplingError
from ssmppl.expressions.expr import Expr, symbols_of, to_text
from ssmppl.inference.updates.slices import (
    Density,
    comparable,
    sweep_correlations,
    sweep_matrix,
    sweep_real,
    sweep_simplex,
)

MAX_TRIES = 100
LOOK = 10  # tries, after which
HOPELESS = 1e-3  # is the mean chance of acceptance with which no more are made
LogJoint = Callable[[np.ndarray], float]


class DrawInfo(NamedTuple):
    """How a draw came about.

    route : "conjugate", "metropolis" or "slice"; tries : proposals of the conjugate part;
    accepted : whether the Metropolis step was (always true for the others).
    """

    route: str
    tries: int
    accepted: bool


class UpdateSampler:
    """An update made ready to draw from: nothing symbolic is left to do but in open bounds."""

    def __init__(self, update: Update):
        self._update = ref(update)  # which keeps its sampler; the other way round both would stay
        functions, components = update.functions, update.components
        self.log_density = _guarded(python_sum(functions, components))
        self.corrections = update.outside_family
        self.correct = _guarded(
            python_sum([functions[j] for j in update.outside_family], components)
        )
        self.bounds = update_bounds(update)
        self.open_bounds = [
            (i, *_open_bounds(b))
            for i, (b, fixed) in enumerate(zip(update.bounds, self.bounds, strict=True))
            if fixed is None
        ]
        self.natural = natural_bounds(update)
        self.truncated = bool(self.open_bounds) or any(
            b is not None and (b[0] > n[0] or b[1] < n[1])
            for b, n in zip(self.bounds, self.natural, strict=True)
        )
        self.ranges = correction_ranges(update)
        beside = [
            *(functions[j] for j in update.outside_family),
            *(f.density for f in update.inseparable_terms),
        ]
        self.last_is_held = any(components[-1] in symbols_of(e) for e in beside)
        self.matrix_size = size_of_matrix(len(components)) if update.kind == "matrix" else 0
        if update.family is not None:
            self.matrix_size = update.family.matrix_size or self.matrix_size

    @property
    def update(self) -> Update:
        """What is drawn; whoever draws holds it."""
        found = self._update()
        assert found is not None
        return found

    # -- the pieces of one draw
    def limits(self, rest: Mapping[Expr, float]) -> list[Interval]:
        """Bounds of the components, those that depend on other parameters evaluated."""
        if not self.open_bounds:
            return self.bounds  # type: ignore[return-value]
        out = list(self.bounds)
        for i, symbols, function in self.open_bounds:
            out[i] = function([rest[s] for s in symbols])
        return out  # type: ignore[return-value]

    def ceiling(self, c: Sequence[float]) -> float:
        """An upper bound of the correction's logarithm; inf where none is known."""
        total = 0.0
        for j, (low, high) in zip(self.corrections, self.ranges, strict=True):
            factor = c[j]
            if factor != 0.0:
                total += factor * (high if factor > 0.0 else low)
        return total

    def conjugate(
        self, c: Sequence[float], limits: list[Interval], rng: np.random.Generator
    ) -> Values | None:
        """A draw of the conjugate part; None where it is improper."""
        family = self.update.family
        assert family is not None
        return family.draw_within(c, limits, rng) if self.truncated else family.draw(c, rng)

    def possible(self, v: Sequence[float]) -> bool:
        """Whether a draw of the conjugate part is inside of the family's support: a scale of zero,
        or a share, is a number that underflowed, and has no density."""
        return all(low < x < high for x, (low, high) in zip(v, self.natural, strict=True))

    def draw(
        self, totals: np.ndarray, current: np.ndarray, rest: Mapping[Expr, float],
        rng: np.random.Generator, log_joint: LogJoint | None = None,
    ) -> tuple[np.ndarray, DrawInfo]:  # fmt: skip
        """See `draw` below."""
        update, truncated = self.update, self.truncated
        limits = self.limits(rest)
        c = totals.tolist()
        c.append(0.0)
        if update.family is None:
            return self.slices(c, current, limits, rng, log_joint, 0)
        weights = [c[j] for j in self.corrections]
        ceiling = self.ceiling(c) if weights else 0.0
        if update.inseparable_terms or not ceiling < math.inf:
            return self.metropolis(c, current, limits, rng, log_joint)
        refused, chances = 0, 0.0
        for tries in range(1, MAX_TRIES + 1):
            v = self.conjugate(c, limits, rng)
            if v is None:
                return self.slices(c, current, limits, rng, None, tries - 1)
            if not self.possible(v) or (truncated and not _inside(v, limits)):
                continue
            if weights:
                excess = self.correct(v, weights) - ceiling
                if not (excess >= 0.0 or rng.standard_exponential() >= -excess):
                    refused, chances = refused + 1, chances + math.exp(excess)
                    if refused == LOOK and chances < LOOK * HOPELESS:
                        break
                    continue
            return np.array(v), DrawInfo("conjugate", tries, True)
        return self.slices(c, current, limits, rng, None, tries)

    def metropolis(
        self, c: list[float], current: np.ndarray, limits: list[Interval],
        rng: np.random.Generator, log_joint: LogJoint | None,
    ) -> tuple[np.ndarray, DrawInfo]:  # fmt: skip
        """A step that proposes from the conjugate part, then a sweep of slice steps."""
        weights = [c[j] for j in self.corrections]

        def excess(v: Sequence[float]) -> float:
            """Log of the conditional over the conjugate part's density."""
            correction = self.correct(v, weights) if weights else 0.0
            if not self.update.inseparable_terms:
                return correction
            return self.exactly(log_joint)(v) - self.log_density(v, c) + correction

        accepted, tries = False, 0
        while tries < MAX_TRIES:
            tries += 1
            v = self.conjugate(c, limits, rng)
            if v is None:
                break
            if not self.possible(v) or (self.truncated and not _inside(v, limits)):
                continue
            change = excess(v) - excess(current.tolist())
            accepted = change >= 0.0 or rng.standard_exponential() > -change
            current = np.array(v) if accepted else current
            break
        value, _ = self.slices(c, current, limits, rng, log_joint, tries)
        return value, DrawInfo("metropolis", tries, accepted)

    def exactly(self, log_joint: LogJoint | None) -> Density:
        """The log joint density as a function of the block's values."""
        if log_joint is None:
            raise SamplingError(
                f"the update of {', '.join(self.update.block)} needs the log joint density",
                fix="pass log_joint=, a function of the block's values",
                where=self.update.where,
            )
        return lambda v: comparable(float(log_joint(np.array(v))))

    def slices(
        self, c: list[float], current: np.ndarray, limits: list[Interval],
        rng: np.random.Generator, log_joint: LogJoint | None, tries: int,
    ) -> tuple[np.ndarray, DrawInfo]:  # fmt: skip
        """A sweep of slice steps over the exact conditional."""
        update, values = self.update, current.tolist()
        exact = update.needs_log_joint or bool(update.inseparable_terms)
        at: Density = self.exactly(log_joint) if exact else partial(self._separated, c)
        if not at(values) > -math.inf:
            raise self._impossible(values, log_joint)
        if update.kind == "simplex":
            new = sweep_simplex(at, values, rng)
        elif update.kind == "correlation":
            new = sweep_correlations(at, values, size_of_matrix(len(values)), rng)
        elif p := self.matrix_size:  # the numbers given the matrix, then the matrix
            n = len(values) - p * (p + 1) // 2
            matrix = values[n:]
            new = sweep_real(lambda v: at([*v, *matrix]), values[:n], limits[:n], rng)
            new += sweep_matrix(lambda v: at([*new[:n], *v]), matrix, p, rng)
        else:
            natural = [
                (max(a, n[0]), min(b, n[1])) for (a, b), n in zip(limits, self.natural, strict=True)
            ]
            if update.family is not None and not self.last_is_held:
                last = update.family.draw_last(c, values, limits, rng)
                values[-1] = values[-1] if last is None else last
            new = sweep_real(at, values, natural, rng)
        return np.array(new), DrawInfo("slice", tries, True)

    def _separated(self, c: list[float], v: Sequence[float]) -> float:
        return self.log_density(v, c)

    def _impossible(self, values: list[float], log_joint: LogJoint | None) -> SamplingError:
        """The density is zero, or infinite, where the chain stands."""
        infinite = log_joint is not None and log_joint(np.array(values)) == math.inf
        pairs = zip(self.update.components, values, strict=True)
        named = ", ".join(f"{to_text(s)} = {x:.6g}" for s, x in pairs)
        return SamplingError(
            f"the conditional density is {'infinite' if infinite else 'zero'} at the current "
            f"value: {named}",
            fix="start inside the support; given these states no value near is possible. Where "
            "a covariance is singular no density exists: give components that follow without "
            "a noise of their own the distribution Dirac",
            where=self.update.where,
        )


_samplers: WeakKeyDictionary[Update, UpdateSampler] = WeakKeyDictionary()


def sampler_of(update: Update) -> UpdateSampler:
    """The update's sampler, made when it is first asked for; it lives as long as the update."""
    found = _samplers.get(update)
    if found is None:
        _samplers[update] = found = UpdateSampler(update)
    return found


def draw(
    update: Update,
    totals: np.ndarray,
    current: np.ndarray,
    rest: Mapping[Expr, float],
    rng: np.random.Generator,
    log_joint: LogJoint | None = None,
) -> tuple[np.ndarray, DrawInfo]:
    """New values of the block's components, given the statistics.

    Parameters
    ----------
    totals : the C_i, (len(functions),).
    current : values of the components.
    rest : values of the other parameters, read where bounds depend on them.
    log_joint : log joint density as a function of the components' values; needed (and used) only
        where update.needs_log_joint or update.inseparable_terms.
    """
    return sampler_of(update).draw(totals, current, rest, rng, log_joint)


def _guarded(function: Callable[..., float]) -> Callable[..., float]:
    """The function as `comparable` has it, and -inf where it is not defined."""

    def run(*args: Sequence[float]) -> float:
        try:
            value = function(*args)
        except DOMAIN:
            return -math.inf
        return comparable(value)

    return run


def _inside(v: Sequence[float], limits: Limits) -> bool:
    return all(low <= x <= high for x, (low, high) in zip(v, limits, strict=True))


def _open_bounds(bounds: tuple[Expr, Expr]) -> tuple[list[Expr], Callable]:
    symbols = list(symbols_of(bounds))
    return symbols, python_function(bounds, symbols)
