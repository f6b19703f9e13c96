"""Whether what a user declared of a distribution agrees with its density, by quadrature and by a
test.

A continuous support is mapped to the line (x = sinh s; lower + e^s; a logistic function of s
between two bounds), where densities with the heavy tails and the integrable singularities of the
usual distributions fall off exponentially, and cut at the mode, at steps from it that double, and
at the draws. On each piece Gauss-Legendre rules of 10 and of 20 nodes are compared, and pieces
halved until they agree.
The test of the draws is Kolmogorov's, with the exact distribution of its statistic for their number
(Simard and L'Ecuyer 2011, *J. Statist. Software* 39(11)).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.distributions.from_density import VALUE, UserDefined

Function = Callable[[np.ndarray], np.ndarray]
TOLERANCE = 1e-6  # of what is integrated and compared
EXACT = 1e-11  # of a piece, where it is halved no more
HALVINGS = 50
FARTHEST = 700.0  # of s: e^700 is the end of floating point
FAR = 1e100
LEVELS = (0.001, 0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 0.999)  # at which quantiles are compared
NEAR = np.linspace(-12.0, 12.0, 2401)  # fine enough for a second, narrower peak
REFINEMENTS = 12  # of the place of the mode, each by a factor of about 20
FIRST, MOST_TERMS = 1 << 10, 1 << 21  # terms of a sum over whole numbers
_RULES = [np.polynomial.legendre.leggauss(n) for n in (10, 20)]


@dataclass(frozen=True)
class Agreement:
    """What was found of a distribution; all of it within its tolerance.

    Attributes
    ----------
    total : integral, or sum, of the density over the support.
    p_value : of the draws; None where the distribution has no sampler.
    mean, variance : by integration; without a meaning where the distribution has none.
    lines : what was compared, in words.
    """

    total: float
    p_value: float | None
    mean: float
    variance: float
    lines: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join(self.lines)

    __repr__ = __str__


def agreement(
    law: UserDefined, locations: Mapping[str, Location], draws: int, level: float, seed: int
) -> Agreement:
    """Compare; see `DeclaredDistribution.check`.

    locations : of the functions that were declared, by part.
    """
    support = law.support()
    lower, upper = (float(evaluate(array(b)[()])) for b in (support.lower, support.upper))
    drawn = np.sort(_draws(law, draws, seed)) if law.drawable else np.empty(0)
    by_draw = locations.get("draw", locations["density"])
    _check_inside(law, drawn, lower, upper, by_draw)
    found = (_summed if law.discrete else _integrated)(law, lower, upper, drawn, locations)
    lines = [_check_total(law, found, locations["density"])]
    for part, own in (("mean", found.mean), ("variance", found.variance)):
        if part in locations:
            lines += _check_moment(law, part, own, locations[part])
    if "cdf" in locations:
        lines.append(_check_cdf(law, found, locations["cdf"]))
        if "quantile" in locations:
            lines.append(_check_quantile(law, locations["quantile"]))
    p_value = None
    if drawn.size:
        p_value = _check_draws(law, found, len(drawn), level, by_draw)
        lines.append(f"{drawn.size} draws follow it: Kolmogorov-Smirnov, p = {p_value:.3f}")
    return Agreement(found.total, p_value, found.mean, found.variance, tuple(lines))


@dataclass(frozen=True)
class _Found:
    """Integrals; below : of the density up to each of the values `at`. distance : Kolmogorov's, of
    the draws. error : what the sum may lack."""

    total: float
    mean: float
    variance: float
    at: np.ndarray
    below: np.ndarray
    distance: float
    error: float = 0.0


def _check_inside(
    law: UserDefined, drawn: np.ndarray, lower: float, upper: float, where: Location
) -> None:
    outside = drawn[~((drawn >= lower) & (drawn <= upper))]
    if outside.size:
        raise ModelError(
            f"the sampler of {law!r} drew {outside[0]:.6g}, which is outside of its support, "
            f"{lower:g} to {upper:g}",
            fix="correct the sampler or the bounds",
            where=where,
        )
    between = drawn[drawn != np.floor(drawn)]
    if law.discrete and between.size:
        raise ModelError(
            f"the sampler of {law!r} drew {between[0]:.6g}, which is no whole number",
            fix="correct the sampler, or leave out discrete=True",
            where=where,
        )


def _check_total(law: UserDefined, found: _Found, where: Location) -> str:
    text = f"{'sums' if law.discrete else 'integrates'} to {found.total:.9g}"
    if not abs(found.total - 1.0) <= TOLERANCE + found.error:
        fix = "correct the density or the bounds"
        if 0.0 < found.total < math.inf:
            fix = f"add {-math.log(found.total):.9g} to the log density there, or {fix}"
        raise ModelError(f"the density of {law!r} {text}, not to 1", fix=fix, where=where)
    return f"{law!r}: the density {text}"


def _check_moment(law: UserDefined, part: str, own: float, where: Location) -> list[str]:
    declared = float(evaluate(array(getattr(law, part)())[()]))
    if not math.isfinite(declared):  # what the integral tends to is not seen
        return []
    if not abs(declared - own) <= 1e-5 * (1.0 + abs(own)):
        raise _differs(law, f"the {part}", declared, own, where)
    return [f"the {part} is {own:.6g}, as declared"]


def _check_cdf(law: UserDefined, found: _Found, where: Location) -> str:
    at, below = found.at, found.below
    declared = np.broadcast_to(evaluate(array(law.cdf(VALUE))[()], {VALUE: at}), at.shape)
    gap = np.where(np.isnan(declared), np.inf, np.abs(declared - below))
    k = int(gap.argmax())
    if gap[k] > TOLERANCE + found.error:
        raise _differs(
            law, f"the distribution function at {at[k]:.6g}", declared[k], below[k], where
        )
    return f"the distribution function agrees at {at.size} values"


def _check_quantile(law: UserDefined, where: Location) -> str:
    for p in LEVELS:
        at = array(law.quantile(array(p)))
        low, high = (float(evaluate(array(law.cdf(v))[()])) for v in (at - 1.0, at))
        right = low < p + TOLERANCE and high > p - TOLERANCE if law.discrete else (
            abs(high - p) <= TOLERANCE
        )  # fmt: skip
        if not right:
            raise ModelError(
                f"the quantile of {law!r} at {p:g} is {float(evaluate(at[()])):.9g}, where its "
                f"distribution function is {high:.9g}",
                fix="correct the one or the other",
                where=where,
            )
    return f"its inverse agrees at {len(LEVELS)} levels"


def _check_draws(law: UserDefined, found: _Found, n: int, level: float, where: Location) -> float:
    from scipy.stats import kstwo  # slow to import

    p_value = float(kstwo.sf(found.distance, n))
    if p_value < level:
        raise ModelError(
            f"{n} draws of {law!r} do not follow its density: Kolmogorov-Smirnov, "
            f"p = {p_value:.2g}, below the level {level:g}",
            fix="correct the sampler or the density",
            where=where,
        )
    return p_value


def _differs(
    law: UserDefined, what: str, declared: float, own: float, where: Location
) -> ModelError:
    return ModelError(f"{what} of {law!r} is {declared:.9g}, by its density {own:.9g}",
                      fix="correct the one or the other", where=where)  # fmt: skip


def _draws(law: UserDefined, draws: int, seed: int) -> np.ndarray:
    source = numpy_draws(np.random.default_rng(seed), (draws,))
    drawn = evaluate(array(law.sample(Draws("check")))[()], {}, source)
    return np.array(np.broadcast_to(drawn, (draws,)), dtype=float)


def _log_density(law: UserDefined, locations: Mapping[str, Location]) -> Function:
    form = array(law.log_densities(VALUE))[()]

    def at(x: np.ndarray) -> np.ndarray:
        found = np.array(np.broadcast_to(evaluate(form, {VALUE: x}), x.shape), dtype=float)
        far = np.abs(x) > FAR  # where squares are infinite, and differences of them nan
        found[np.isnan(found) & far] = -np.inf
        bad = np.isnan(found) | (found == np.inf)
        if bad.any():
            raise ModelError(
                f"the log density of {law!r} is {found[bad][0]:g} at {x[bad][0]:.9g}, which is "
                "inside of the support",
                fix="correct the density or the bounds",
                where=locations["density"],
            )
        return found

    return at


# -- continuous laws
def _integrated(
    law: UserDefined,
    lower: float,
    upper: float,
    drawn: np.ndarray,
    locations: Mapping[str, Location],
) -> _Found:
    log_density = _log_density(law, locations)
    to_x, log_slope, to_s = _line(lower, upper)

    def log_g(s: np.ndarray) -> np.ndarray:
        x = to_x(s)
        inside = (x > lower) & (x < upper)
        out = np.full(s.shape, -np.inf)
        out[inside] = log_density(x[inside]) + log_slope(s[inside])
        return out

    mode, width = _mode(log_g, to_s(drawn))
    centre = float(to_x(np.array(mode)))
    steps = width * 2.0 ** np.arange(-6.0, 64.0)
    cuts = np.concatenate(
        [mode - steps, [mode], mode + steps, np.arange(-FARTHEST, FARTHEST), NEAR]
    )
    values = np.clip(to_s(drawn), -FARTHEST, FARTHEST)
    cuts = np.unique(np.concatenate([np.clip(cuts, -FARTHEST, FARTHEST), values]))

    def moments(s: np.ndarray) -> np.ndarray:
        g, x = np.exp(log_g(s)), to_x(s)
        with np.errstate(all="ignore"):
            own = np.where(g > 0.0, x - centre, 0.0)
            return np.nan_to_num(np.stack([g, g * own, g * own**2]), posinf=0.0, neginf=0.0)

    pieces = _pieces(moments, cuts)
    total, first, second = pieces.sum(axis=1)
    below = np.concatenate([[0.0], np.cumsum(pieces[0])])
    ranks, n = np.arange(len(values) + 1.0), max(len(values), 1)
    own = below[np.searchsorted(cuts, values)]
    distance = float(np.max([ranks[1:] / n - own, own - ranks[:-1] / n], initial=0.0))
    body = (below > EXACT) & (below < total - EXACT)
    return _Found(float(total), centre + float(first), float(second - first**2), to_x(cuts[body]),
                  below[body], distance)  # fmt: skip


def _line(lower: float, upper: float) -> tuple[Function, Function, Function]:
    """x(s), log dx / ds and s(x) of a map of the line to the support."""
    if math.isfinite(lower) and math.isfinite(upper):
        span = upper - lower

        def inside(s: np.ndarray) -> np.ndarray:  # from the nearer bound, so that neither is lost
            share = 1.0 / (1.0 + np.exp(np.abs(s)))
            return np.where(s < 0.0, lower + span * share, upper - span * share)

        return (
            inside,
            lambda s: math.log(span) - np.abs(s) - 2.0 * np.log1p(np.exp(-np.abs(s))),
            lambda x: _log(x - lower) - _log(upper - x),
        )
    if math.isfinite(lower):
        return lambda s: lower + np.exp(s), lambda s: s, lambda x: _log(x - lower)
    if math.isfinite(upper):
        return lambda s: upper - np.exp(-s), lambda s: -s, lambda x: -_log(upper - x)
    return np.sinh, lambda s: np.log(np.cosh(s)), np.arcsinh


def _log(x: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log(x)


def _mode(log_g: Function, drawn: np.ndarray) -> tuple[float, float]:
    """Where the density on the line is largest, and how far from there it falls by a factor e."""
    tried = np.unique(np.concatenate([np.linspace(-FARTHEST, FARTHEST, 4801),
                                      np.clip(drawn, -FARTHEST, FARTHEST)]))  # fmt: skip
    for _ in range(REFINEMENTS):
        values = log_g(tried)
        k = int(np.argmax(values))
        mode, top = float(tried[k]), values[k]
        tried = np.append(np.linspace(tried[max(k - 1, 0)], tried[min(k + 1, len(tried) - 1)], 40),
                          mode)  # fmt: skip
        tried.sort()
    steps = 2.0 ** np.arange(-40.0, 10.0)
    fallen = (log_g(mode + steps) < top - 1.0) | (log_g(mode - steps) < top - 1.0)
    return mode, float(steps[np.argmax(fallen)]) if fallen.any() else 1.0


def _pieces(f: Callable[[np.ndarray], np.ndarray], cuts: np.ndarray) -> np.ndarray:
    """(3, len(cuts) - 1): integrals of the three functions between the cuts."""
    out = np.zeros((3, len(cuts) - 1))
    index, low, high = np.arange(len(cuts) - 1), cuts[:-1], cuts[1:]
    for halving in range(HALVINGS + 1):
        half, middle = 0.5 * (high - low), 0.5 * (high + low)
        rules = [
            half * (f(middle[:, None] + half[:, None] * nodes) @ weights)
            for nodes, weights in _RULES
        ]
        bound = EXACT * np.maximum(np.abs(rules[1]), 2.0**-halving)
        done = (np.abs(rules[1] - rules[0]) <= bound)[:2].all(axis=0) | (halving == HALVINGS)
        for sums, found in zip(out, rules[1], strict=True):
            np.add.at(sums, index[done], found[done])
        left = ~done
        if not left.any():
            break
        index = np.repeat(index[left], 2)
        low, high = (np.stack(pair, axis=1).ravel() for pair in
                     ((low[left], middle[left]), (middle[left], high[left])))  # fmt: skip
    return out


# -- discrete laws
def _summed(
    law: UserDefined,
    lower: float,
    upper: float,
    drawn: np.ndarray,
    locations: Mapping[str, Location],
) -> _Found:
    log_density = _log_density(law, locations)
    start = lower if math.isfinite(lower) else upper if math.isfinite(upper) else 0.0
    if not (math.isfinite(lower) or math.isfinite(upper)) and drawn.size:
        start = float(np.median(drawn))
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    error = 0.0
    for sign, end in ((1.0, upper), (-1.0, lower)):
        first, size, mass = (0 if sign > 0 else 1), FIRST, 0.0
        while first < MOST_TERMS:
            k = start + sign * np.arange(first, first + size)
            k = k[(k >= lower) & (k <= upper)]
            if not k.size:
                break
            p = np.exp(log_density(k))
            parts.append((k, p))
            before, mass = mass, float(p.sum())
            enough = mass < EXACT and sum(float(q.sum()) for _, q in parts) > 0.5
            first, size = first + size, size * 2
            if enough or k[-1] == end:
                break
        else:
            # twice what a tail like a power of k has beyond, of which blocks fall by one factor
            error += 2.0 * mass**2 / max(before - mass, EXACT)
    k, p = (np.concatenate(one) for one in zip(*parts, strict=True))
    order = np.argsort(k)
    k, p = k[order], p[order]
    mean = float(p @ k)
    below = np.cumsum(p)
    share = np.searchsorted(drawn, k, side="right") / max(len(drawn), 1)
    distance = float(np.max(np.abs(share - below))) if drawn.size else 0.0
    return _Found(float(p.sum()), mean, float(p @ (k - mean) ** 2), k, below, distance, error)
