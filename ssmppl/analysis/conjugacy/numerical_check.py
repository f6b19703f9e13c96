"""The compile-time check of a derived update against the model's own density.

At moderate random points inside the supports, over short random series, for two values theta and
theta' of the block with all else fixed:

    log joint(theta') - log joint(theta) = log q(theta') - log q(theta)

where the joint is the sum of the densities as they were written, not as they were separated, and q
is the distribution that the family's formulas give for the summed statistics, times the correction.
An error of the algebra, of a family's formulas or of the bookkeeping shows here and demotes the
update.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ssmppl.analysis.conjugacy.matrix_families import lower_half
from ssmppl.analysis.conjugacy.separation import ROLES, CompleteData, JointTerm
from ssmppl.analysis.conjugacy.update import Update
from ssmppl.errors import Location, NotApplicable
from ssmppl.expressions.algebra import Separation, separate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.language.model.trace import EXPERIMENT_NUMBER, Site, previous, seen, symbols

POINTS = 24
NEEDED = 5
STEPS = 4
TOLERANCE = 1e-8
_ATTEMPTS = 4
# What a term does far out must be seen, too, as a hinge of an input bends where the input is; but
# at most points a density should be a number.
_LATE = (0.0, 0.0, 0.0, 30.0, 1000.0)  # steps before the first
_SIZES = (1.0, 1.0, 1.0, -1.0, 30.0, -30.0, 1e3)
_HINT = ": roots and logarithms of products are split as if each factor were positive"
Point = dict[Expr, np.ndarray]


class Attempts:
    """Random rows and other parameters that updates are checked at, drawn once for all of them."""

    def __init__(self, data: CompleteData, seed: int = 1):
        self.data = data
        self._rng = np.random.default_rng(seed)
        self._drawn: list[tuple[list[Point], Point]] = []

    def __iter__(self) -> Iterator[tuple[list[Point], Point]]:
        for k in range(_ATTEMPTS):
            if k == len(self._drawn):
                series = random_series(self.data, self._rng, wide=True)
                self._drawn.append((series, random_parameters(self.data, self._rng, wide=True)))
            yield self._drawn[k]


def verify(
    data: CompleteData, update: Update, attempts: Attempts | None = None
) -> NotApplicable | None:
    """None where the update agrees with the model at every point tried, else the reason.

    attempts : those of other updates of the model.
    """
    compared = 0
    names = ", ".join(update.block)
    for series, other in attempts or Attempts(data):
        changed = {c: other[c] for c in update.components}
        first = joint(data, update, series)
        second = joint(data, update, [{**values, **changed} for values in series])
        totals = summed_statistics(update, series)
        here = np.array([series[0][c] for c in update.components])
        there = np.array([changed[c] for c in update.components])
        with np.errstate(invalid="ignore"):  # an infinite density at both is no comparison
            change = second.sum(axis=0) - first.sum(axis=0)
        for k, expected in enumerate(change):
            if not np.isfinite(expected) or not np.all(np.isfinite(totals[:, k])):
                continue
            q1, size1 = log_q(update, totals[:, k], here[:, k])
            q2, size2 = log_q(update, totals[:, k], there[:, k])
            if not np.isfinite(q1 - q2):
                return NotApplicable(
                    f"the {update.family_name} update of {names} has no density where the model "
                    f"has one{_HINT}",
                    _culprit(data, update, series, changed) or update.where,
                )
            size = np.abs(first[:, k]).sum() + np.abs(second[:, k]).sum()
            error = abs((q2 - q1) - expected)
            if error > TOLERANCE * (1.0 + size + size1 + size2):
                return NotApplicable(
                    f"the {update.family_name} update of {names} disagrees with the model's log "
                    f"density by {error:.3g} at a random point{_HINT}",
                    _culprit(data, update, series, changed) or update.where,
                )
            compared += 1
        if compared >= NEEDED:
            return None
    return NotApplicable(
        f"the {update.family_name} update of {names} could not be checked: the density is finite "
        f"at {compared} of {_ATTEMPTS * POINTS} random points",
        update.where,
    )


def joint(data: CompleteData, update: Update, series: list[Point]) -> np.ndarray:
    """Summands of the log joint that hold the block, (terms, points), as they were written."""
    rows = [
        np.broadcast_to(evaluate(term.density, values), POINTS)
        for term in _checked(data, update)
        for t, values in enumerate(series)
        if _counts(term.role, t)
    ]
    return np.array(rows).reshape(-1, POINTS)


def _checked(data: CompleteData, update: Update) -> list[JointTerm]:
    """The terms that hold the block, but for those that the update leaves to the log joint."""
    return [
        f
        for f in data.holding(update.components)
        if not any(f is g for g in update.inseparable_terms)
    ]


def _culprit(
    data: CompleteData, update: Update, series: list[Point], changed: Point
) -> Location | None:
    """Where the first term stands that differs from its own separated form."""
    for term in _checked(data, update):
        form = separate(term.density, update.components)
        if not isinstance(form, Separation):
            return term.where
        pair = [term.density, form.assemble()]
        for values in series[1:]:
            (a, b), (c, d) = evaluate(pair, values), evaluate(pair, {**values, **changed})
            with np.errstate(invalid="ignore"):  # an infinite density at both tells nothing
                one, two = a - c, b - d
                wrong = np.abs(one - two) > TOLERANCE * (1.0 + np.abs(a) + np.abs(c))
            missing = np.isfinite(one) & ~np.isfinite(two)
            if np.any(wrong | missing):
                return term.where
    return None


def _counts(role: str, t: int) -> bool:
    """Whether a term of this role enters at step t (from 0)."""
    return t == 0 if role in ("prior", "initial") else role == "observation" or t > 0


def summed_statistics(update: Update, series: list[Point]) -> np.ndarray:
    """The C_i, (len(functions), points)."""
    total = np.zeros((len(update.functions), POINTS))
    for role in ROLES:
        for t, values in enumerate(series):
            if _counts(role, t):
                for i, c in enumerate(update.coefficients[role]):
                    with np.errstate(invalid="ignore"):  # inf - inf: a point that is not compared
                        total[i] += evaluate(c, values)
    return total


def log_q(update: Update, totals: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """Log of the derived conditional up to a constant, and the size of its summands."""
    values = dict(zip(update.components, value, strict=True))
    c = [*totals.tolist(), 0.0]
    terms = np.array([float(evaluate(f, values)) for f in update.functions]) * totals
    family = update.family
    if family is None:
        return float(terms.sum()), float(np.abs(terms).sum())
    out = sum(terms[j] for j in update.outside_family)
    with np.errstate(all="ignore"):
        try:
            out += family.log_q(c, value)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            return np.nan, 0.0
    return float(out), float(np.abs(terms).sum())


# -- moderate random points
def random_parameters(data: CompleteData, rng: np.random.Generator, wide: bool = False) -> Point:
    """Parameters inside their supports, near 1 on whatever scale they have.

    wide : also near the bounds of their supports, and on both sides of 0.
    """
    values: Point = {}
    for site in data.trace.parameters.values():
        _fill(site, values, rng, np.ones(POINTS) if wide else None)
    return values


def random_series(
    data: CompleteData, rng: np.random.Generator, steps: int = STEPS, wide: bool = False
) -> list[Point]:
    """Rows of symbol -> values, each of shape (POINTS,), consistent with the supports.

    wide : at some points the states, the inputs and the time are far from moderate.
    """
    trace = data.trace
    parameters = random_parameters(data, rng, wide)
    rows: list[Point] = []
    late, spread, sizes = np.zeros(POINTS), None, {}
    if wide:
        late, spread = rng.choice(_LATE, POINTS), np.abs(rng.choice(_SIZES, POINTS))
        sizes = {s: rng.choice(_SIZES, POINTS) for s in trace.input_symbols}
    number = rng.integers(0, len(trace.experiments), POINTS) if trace.experiments else None
    for t in range(steps):
        values = dict(parameters)
        values[symbol("time", "t")] = late + t + 1.0
        values[symbol("time_prev", "t")] = late + t
        for name, shape in trace.inputs.items():
            for s in symbols("input", name, shape).ravel():
                values[s] = rng.uniform(0.3, 2.0, POINTS) * sizes.get(s, 1.0)
        if number is not None:
            values[symbol("input", EXPERIMENT_NUMBER)] = number.astype(float)
        if t > 0:
            last = rows[-1]
            for s in [*trace.state_symbols, *trace.observation_symbols, *trace.input_symbols]:
                values[previous(s)] = last[s]
        for site in (trace.transition if t else trace.initial).values():
            _fill(site, values, rng, spread)
        for site in trace.observations.values():
            _fill(site, values, rng, spread)
            for s in site.components:
                values[seen(s)] = (rng.random(POINTS) < 0.8).astype(float)
        rows.append(values)
    return rows


def _fill(
    site: Site, values: Point, rng: np.random.Generator, spread: np.ndarray | None = None
) -> None:
    """Values of a site's components, inside the support that its distribution has at these values.

    spread : (POINTS,) the size of those that can be any number; others are near their bounds, too.
    """
    support = site.distribution.support()
    components = site.components
    if support.kind == "simplex":
        for row in site.value.reshape(-1, site.shape[-1]).view(np.ndarray):
            draws = rng.dirichlet(np.full(len(row), 3.0), POINTS).T
            values.update(zip(row, draws, strict=True))
        return
    if support.kind in ("positive definite", "correlation"):
        p = site.shape[0]
        a = rng.standard_normal((POINTS, p, p))
        m = 0.3 * a @ a.transpose(0, 2, 1) + np.eye(p) * rng.uniform(0.7, 1.5, (POINTS, 1, 1))
        if support.kind == "correlation":
            scale = np.sqrt(np.diagonal(m, axis1=1, axis2=2))
            m = m / (scale[:, :, None] * scale[:, None, :])
        half = lower_half(p)
        values.update((c, m[:, i, j]) for c, (i, j) in zip(components, half, strict=True))
        return
    lower, upper = (
        [np.broadcast_to(evaluate(e, values), POINTS) for e in np.broadcast_to(
            b.view(np.ndarray), site.shape).ravel()]
        for b in (support.lower, support.upper)
    )  # fmt: skip
    maker = _MAKERS[support.kind]
    for c, low, high in zip(site.value.ravel(), lower, upper, strict=True):
        drawn = maker(low, high, rng)
        if spread is not None and support.kind != "integers":
            drawn = _edged(drawn, low, high, rng)
            drawn = np.where(np.isfinite(low) | np.isfinite(high), drawn, spread * drawn)
        values[c] = drawn
    if support.kind == "ordered":
        for row in site.value.reshape(-1, site.shape[-1]).view(np.ndarray):
            values.update(zip(row, np.sort([values[c] for c in row], axis=0), strict=True))


def _interval(low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    positive = np.exp(0.5 * rng.standard_normal(POINTS))
    inside = rng.uniform(0.1, 0.9, POINTS)
    with np.errstate(all="ignore"):
        return np.where(
            np.isfinite(low),
            np.where(np.isfinite(high), low + (high - low) * inside, low + positive),
            np.where(np.isfinite(high), high - positive, rng.standard_normal(POINTS)),
        )


def _edged(
    drawn: np.ndarray, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Some of the numbers moved towards a bound, or between it and 0 where 0 lies inside."""
    which, share = rng.integers(0, 4, POINTS), rng.uniform(0.001, 0.999, POINTS)
    with np.errstate(all="ignore"):
        for k, bound in enumerate((low, high)):
            across = np.where(
                (low < 0.0) & (high > 0.0), bound * share, bound + share**4 * (drawn - bound)
            )
            drawn = np.where((which == k) & np.isfinite(bound), across, drawn)
    return drawn


def _integers(low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    endless = np.where(np.isfinite(high), np.floor(high) - 5.0, -2.0)
    low = np.where(np.isfinite(low), np.ceil(low), endless)
    high = np.floor(np.minimum(high, low + 5.0))
    return low + np.floor(rng.random(POINTS) * (high - low + 1.0))


_MAKERS: dict[str, Callable[..., np.ndarray]] = {
    "real": _interval,
    "interval": _interval,
    "ordered": _interval,
    "integers": _integers,
    "point": lambda low, high, rng: low,
}
