"""The conjugate families: functions of a block on the left, its distribution on the right.

    log p(block | rest) = const + sum_i C_i s_i(block)

=================================================  =============================================
functions s_i in the span                          distribution
=================================================  =============================================
log v, v**k                                        v**k ~ Gamma   (k = 1: precisions, rates;
                                                   k = -1: variances; k = -2: sds)
theta, theta**2; theta_i, theta_i theta_j          Normal, joint Normal
log v, v**k, v**k theta_i, v**k theta_i theta_j    Normal-Gamma: v**k ~ Gamma, theta | v Normal
log p, log(1 - p)                                  Beta
log p_1, ..., log p_K                              Dirichlet
log det P, P_ij                                    Wishart
log det C, (C^-1)_ij                               inverse Wishart
log det W, W_ij, W_ij theta_jk, W_ij theta_ik      matrix Normal-Wishart (W = P) or
theta_jl                                           matrix Normal-inverse-Wishart (W = C^-1)
=================================================  =============================================

(Bernardo and Smith (1994), "Bayesian theory", appendix A.) A distribution is determined by the
functions alone, never by a distribution's name. All that is known of one is in its class, by the
protocol of `family.py`; the last lines below are the list that is searched. Matrices:
`matrix_families.py`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
import scipy.special as sp

from ssmppl.analysis.bounds import WHOLE, Interval
from ssmppl.analysis.conjugacy.family import (
    POSITIVE,
    UNIT,
    ZERO,
    Family,
    Limits,
    ScaledFamily,
    Statistics,
    Values,
    draw_between,
    held,
    inside,
    place_of_log,
    sum_of,
    truncated_normal,
)
from ssmppl.analysis.conjugacy.matrix_families import MatrixNormalWishart, Wishart
from ssmppl.analysis.conjugacy.separation import BlockForm, shorten
from ssmppl.expressions.algebra import Monomial, Separation, separate
from ssmppl.expressions.expr import Expr, apply, constant
from ssmppl.language.distributions import Draws

if TYPE_CHECKING:
    from collections.abc import Callable

    from ssmppl.analysis.conjugacy.describe import MatrixWording, Wording

FLAT = 1e-12  # curvature relative to the largest, below which a direction counts as flat
LEAST_SHARE = 1e-12  # of a Dirichlet's mode
FEW = 3  # Normal numbers whose functions are listed one by one


@dataclass(frozen=True)
class Gamma(Family):
    """v**power ~ Gamma(shape, rate)."""

    power: float
    log: int
    pow: int

    @classmethod
    def match(cls, components: Sequence[Expr], form: BlockForm, positive: bool) -> list[Gamma]:
        """One for each power of a positive number, the largest first."""
        (v,) = components
        powers = _powers(form, v) if positive else {}
        log = place_of_log(form, v)
        return [cls(k, log, place) for k, place in sorted(powers.items(), reverse=True)]

    @property
    def name(self) -> str:
        law = "Gamma" if self.power > 0 else "inverse Gamma"
        size = abs(self.power)
        suffix = {1.0: "", 2.0: " of the square"}.get(size, f" of the power {size:g}")
        return law + suffix

    @cached_property
    def used(self) -> frozenset[int]:
        return held({self.log, self.pow})

    @property
    def support(self) -> list[Interval]:
        return [POSITIVE]

    def parameters(self, c: Sequence[Any]) -> tuple[Any, Any]:
        """(shape, rate) of v**power: its density carries the Jacobian of the power."""
        return (c[self.log] + 1.0) / self.power, -c[self.pow]

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        shape, rate = self.parameters(c)
        if not (shape > 0.0 and rate > 0.0):
            return None
        g = rng.standard_gamma(shape) / rate
        return (root_of(g, self.power),)

    def draw_within(self, c: Statistics, limits: Limits, rng: np.random.Generator) -> Values | None:
        shape, rate = self.parameters(c)
        if not (shape > 0.0 and rate > 0.0):
            return None
        (low, high), k = limits[0], self.power
        if low <= 0.0 and high == math.inf:
            g: float | None = rng.standard_gamma(shape) / rate
        else:
            first, last = sorted((_to_power(max(low, 0.0), k), _to_power(high, k)))
            g = draw_between(
                lambda x: sp.gammainc(shape, rate * x), lambda x: sp.gammaincc(shape, rate * x),
                lambda p: sp.gammaincinv(shape, p) / rate,
                lambda p: sp.gammainccinv(shape, p) / rate, (first, last), rng,
            )  # fmt: skip
        if g is None or not 0.0 < g < math.inf:
            return None
        value = root_of(g, k)
        return (value,) if 0.0 < value < math.inf else None

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        shape, rate = self.parameters(c)
        log_v = math.log(v[0])
        return (shape * self.power - 1.0) * log_v - rate * math.exp(self.power * log_v)

    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        v = mode_of_power(c[self.log], c[self.pow], self.power, limits[0])
        return None if v is None else np.array([v])

    def log_normaliser(self, c: Sequence[Expr]) -> list[Expr]:
        return _log_gamma_integral(*self.parameters(c))

    def written_draw(self, c: Sequence[Expr], draws: Draws) -> list[Expr]:
        shape, rate = self.parameters(c)
        return [_written_root(draws.gamma(shape, buffered=True) / rate, self.power)]

    def law(self, words: Wording) -> str:
        shape = words.linear(self.log, 1.0 / self.power, 1.0 / self.power)
        rate = words.statistic(self.pow)
        return f"{_variate(words.names[0], self.power)}(shape = {shape}, rate = -{rate})"

    def when_improper(self, known: Callable[[int], float | None]) -> str:
        c = known(self.log)
        proper = c is None or (c + 1.0) / self.power > 0.0
        improper = "the Gamma distribution is improper (shape or rate not positive)"
        return "" if proper else f"slice sampling when {improper}"


@dataclass(frozen=True)
class Normal(Family):
    """theta ~ Normal(H^-1 h, H^-1), h = C[linear], H = -C[quadratic] (twice on the diagonal)."""

    linear: tuple[int, ...]
    quadratic: tuple[tuple[int, ...], ...]

    @classmethod
    def match(cls, components: Sequence[Expr], form: BlockForm, positive: bool) -> list[Normal]:
        """A Normal of all components jointly, where each has a square among the functions."""
        found = cls.of(components, form.places)
        return [] if found is None else [found]

    @classmethod
    def of(cls, thetas: Sequence[Expr], places: dict[Monomial, int]) -> Normal | None:
        """The Normal with these components, by the positions of its functions."""
        linear = tuple(places.get(frozenset({(a, 1.0)}), -1) for a in thetas)
        quadratic = tuple(
            tuple(
                places.get(frozenset({(a, 2.0)} if a is b else {(a, 1.0), (b, 1.0)}), -1)
                for b in thetas
            )
            for a in thetas
        )
        if any(quadratic[i][i] < 0 for i in range(len(thetas))):
            return None
        return cls(linear, quadratic)

    @property
    def name(self) -> str:
        return "Normal" if len(self.linear) == 1 else "joint Normal"

    @cached_property
    def used(self) -> frozenset[int]:
        return held({*self.linear, *(i for row in self.quadratic for i in row)})

    @property
    def support(self) -> list[Interval]:
        return [WHOLE] * len(self.linear)

    @property
    def normals(self) -> int:
        return len(self.linear)

    def parameters(self, c: Statistics) -> tuple[np.ndarray, np.ndarray]:
        """The parameters (h, H)."""
        values = np.asarray(c)
        precision = -values[np.array(self.quadratic)]
        precision[np.diag_indices(len(self.linear))] *= 2.0
        return values[np.array(self.linear)], precision

    def parameters_of_one(self, c: Statistics) -> tuple[float, float]:
        """(h, H) of a single number."""
        return c[self.linear[0]], -2.0 * c[self.quadratic[0][0]]

    def draw(self, c: Statistics, rng: np.random.Generator, scale: float = 1.0) -> Values | None:
        if len(self.linear) == 1:
            h, precision = self.parameters_of_one(c)
            if not precision > 0.0:
                return None
            return (h / precision + rng.standard_normal() / math.sqrt(scale * precision),)
        solved = self.solve(c)
        return None if solved is None else self.draw_solved(solved, rng, scale)

    def draw_within(self, c: Statistics, limits: Limits, rng: np.random.Generator) -> Values | None:
        if len(self.linear) > 1:
            return self.draw(c, rng)
        h, precision = self.parameters_of_one(c)
        if not precision > 0.0:
            return None
        value = truncated_normal(h / precision, 1.0 / math.sqrt(precision), limits[0], rng)
        return None if value is None else (value,)

    def solve(self, c: Statistics) -> tuple[np.ndarray, np.ndarray, float] | None:
        """(mean, K^-T, h' H^-1 h) for H = K K'; None where H is not positive definite."""
        h, precision = self.parameters(c)
        try:
            root = np.linalg.inv(np.linalg.cholesky(precision))
        except np.linalg.LinAlgError:
            return None
        z = root @ h
        if not np.all(np.isfinite(root)) or not np.all(np.isfinite(z)):
            return None
        return root.T @ z, root.T, float(z @ z)

    @staticmethod
    def draw_solved(
        solved: tuple[np.ndarray, np.ndarray, float], rng: np.random.Generator, scale: float
    ) -> Values:
        """A draw from what `solve` found, its precision times `scale`."""
        mean, root, _ = solved
        z = rng.standard_normal(len(mean))
        return tuple((mean + root @ z / math.sqrt(scale)).tolist())

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        h, precision = self.parameters(c)
        return float(h @ v - 0.5 * v @ precision @ v)

    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        """The theta within the limits that maximises h' theta - theta' H theta / 2.

        Where the limits bind it is a least-squares problem with bounds, solved exactly by the
        active sets of Stark and Parker (1995), "Bounded-variable least-squares".
        """
        h, precision = self.parameters(c)
        values, vectors = np.linalg.eigh(precision)
        largest = float(np.abs(values).max())
        curved = values > FLAT * largest
        if not largest > 0.0 or values.min() < -FLAT * largest:
            return None
        slope = h - precision @ present
        along = vectors.T @ slope
        if np.any(np.abs(along[~curved]) > 1e-9 * (np.abs(h).max() + largest)):
            return None  # rises for ever in a direction without curvature
        root = vectors[:, curved] * np.sqrt(values[curved])
        target = along[curved] / np.sqrt(values[curved])
        theta = present + vectors[:, curved] @ (target / np.sqrt(values[curved]))
        if all(low < x < high for x, (low, high) in zip(theta, limits, strict=True)):
            return theta
        low, high = (np.array(b) for b in zip(*limits, strict=True))
        found = scipy.optimize.lsq_linear(
            root.T, target, bounds=(low - present, high - present), method="bvls"
        )
        moved = present + found.x
        return np.array([inside(x, *b) for x, b in zip(moved, limits, strict=True)])

    def log_normaliser(self, c: Sequence[Expr]) -> list[Expr]:
        solved = _WrittenNormal(self, c)
        return [0.5 * solved.square, -solved.log_root_det]

    def written_draw(self, c: Sequence[Expr], draws: Draws) -> list[Expr]:
        return _WrittenNormal(self, c).draw(draws, constant(1.0))

    def law(self, words: Wording) -> str:
        if len(words.names) == 1:
            h, precision = words.statistic(self.linear[0]), words.linear(self.quadratic[0][0], -2.0)
            return f"{words.names[0]} ~ Normal({h} / H, precision = H), H = {precision}"
        return f"{words.name} ~ Normal(H^-1 h, precision = H), {len(words.names)} numbers"

    def when_improper(self, known: Callable[[int], float | None]) -> str:
        return "slice sampling when the Normal distribution is improper (H not positive definite)"

    @property
    def as_matrices(self) -> bool:
        return len(self.linear) > FEW

    def matrix_statistics(self, words: MatrixWording) -> tuple[str, ...] | None:
        return words.normal()


@dataclass(frozen=True)
class NormalGamma(ScaledFamily):
    """v**power = g ~ Gamma(shape, rate), theta | g ~ Normal(H^-1 h, (g H)^-1).

    With n = len(theta): shape = (C[log] + 1) / power - n / 2, rate = -(C[pow] + h' H^-1 h / 2).
    The block is (theta, v).
    """

    power: float
    log: int
    pow: int
    normal: Normal
    scale = Gamma

    @classmethod
    def match_scaled(
        cls, thetas: Sequence[Expr], scale: Sequence[Expr], form: BlockForm
    ) -> NormalGamma | None:
        """A Normal vector whose linear and quadratic functions all carry the factor v**k."""
        (v,) = scale
        members = set(thetas)
        powers = {
            exponent
            for m in form.monomials
            for atom, exponent in m
            if atom is v and any(other in members for other, _ in m)
        }
        for k in sorted(powers):
            factor = (v, k)
            scaled = {m - {factor}: place for m, place in form.places.items() if factor in m}
            normal = Normal.of(thetas, scaled)
            if normal is not None:
                return cls(k, place_of_log(form, v), scaled.get(frozenset(), -1), normal)
        return None

    @property
    def name(self) -> str:
        inverse = "inverse-" if self.power < 0 else ""
        return f"Normal-{inverse}Gamma"

    @cached_property
    def used(self) -> frozenset[int]:
        return self.normal.used | held({self.log, self.pow})

    @property
    def support(self) -> list[Interval]:
        return [*self.normal.support, POSITIVE]

    @property
    def normals(self) -> int:
        return self.normal.normals

    def parameters(self, c: Sequence[Any], square: Any) -> tuple[Any, Any]:
        """(shape, rate) of v**power, theta integrated out; square : h' H^-1 h."""
        shape = (c[self.log] + 1.0) / self.power - 0.5 * self.normals
        return shape, -(c[self.pow] + 0.5 * square)

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        normal = self.normal
        n = len(normal.linear)
        solved = normal.solve(c) if n > 1 else None
        if n == 1:
            h, precision = normal.parameters_of_one(c)
            if not precision > 0.0:
                return None
            square = h * h / precision
        elif solved is None:
            return None
        else:
            square = solved[2]
        shape, rate = self.parameters(c, square)
        if not (shape > 0.0 and rate > 0.0):
            return None
        g = rng.standard_gamma(shape) / rate
        if g <= 0.0:
            return (math.nan,) * (n + 1)
        if solved is None:
            theta = h / precision + rng.standard_normal() / math.sqrt(g * precision)
            return theta, root_of(g, self.power)
        return (*normal.draw_solved(solved, rng, g), root_of(g, self.power))

    def draw_last(
        self, c: Statistics, values: Statistics, limits: Limits, rng: np.random.Generator
    ) -> float | None:
        """v given theta."""
        theta = np.array(values[:-1])
        level = c[self.pow] + self.normal.log_q(c, theta)
        shape = (c[self.log] + 1.0) / self.power
        given = [shape * self.power - 1.0, level]
        drawn = Gamma(self.power, 0, 1).draw_within(given, limits[-1:], rng)
        return None if drawn is None else drawn[0]

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        theta, n = v[:-1], self.normals
        h, precision = self.normal.parameters(c)
        mean = np.linalg.solve(precision, h)
        log_g = self.power * math.log(v[-1])
        shape, rate = self.parameters(c, float(h @ mean))
        d = theta - mean
        gamma = (shape - 1.0) * log_g - rate * math.exp(log_g)
        jacobian = log_g - math.log(v[-1])
        return gamma + jacobian + 0.5 * n * log_g - 0.5 * math.exp(log_g) * float(d @ precision @ d)

    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        """v > 0 only scales the quadratic form in theta, so theta is found first."""
        theta = self.normal.mode(c, limits[:-1], present[:-1])
        if theta is None:
            return None
        level = c[self.pow] + self.normal.log_q(c, theta)
        v = mode_of_power(c[self.log], level, self.power, limits[-1])
        return None if v is None else np.array([*theta, v])

    def log_normaliser(self, c: Sequence[Expr]) -> list[Expr]:
        solved = _WrittenNormal(self.normal, c)
        return [*_log_gamma_integral(*self.parameters(c, solved.square)), -solved.log_root_det]

    def written_draw(self, c: Sequence[Expr], draws: Draws) -> list[Expr]:
        solved = _WrittenNormal(self.normal, c)
        shape, rate = self.parameters(c, solved.square)
        g = draws.gamma(shape, buffered=True) / rate
        return [*solved.draw(draws, apply("sqrt", g)), _written_root(g, self.power)]

    def law(self, words: Wording) -> str:
        *thetas, v = words.names
        normal, rate = self.normal, words.statistic(self.pow)
        shape = words.linear(self.log, 1.0 / self.power, 1.0 / self.power - 0.5 * self.normals)
        scale = v if self.power == 1.0 else f"{v}**{self.power:g}"
        if self.normals == 1:
            precision, h = (
                words.linear(normal.quadratic[0][0], -2.0),
                words.statistic(normal.linear[0]),
            )
            square = f" - {h}**2 / (2*H)" if normal.linear[0] >= 0 else ""
            return (
                f"{_variate(v, self.power)}(shape = {shape}, rate = -{rate}{square}); {thetas[0]} "
                f"| {v} ~ Normal({h} / H, precision = {scale}*H), H = {precision}"
            )
        return (
            f"{_variate(v, self.power)}(shape = {shape}, rate = -{rate} - h' H^-1 h / 2); "
            f"({', '.join(thetas)}) | {v} ~ Normal(H^-1 h, precision = {scale}*H), h and H from "
            "the linear and quadratic statistics"
        )

    def when_improper(self, known: Callable[[int], float | None]) -> str:
        return (
            "one-at-a-time updates when the joint distribution is improper (H or the rate not "
            "positive)"
        )


@dataclass(frozen=True)
class Beta(Family):
    """p ~ Beta(C[log p] + 1, C[log(1 - p)] + 1)."""

    first: int
    second: int
    name = "Beta"

    @classmethod
    def match(cls, components: Sequence[Expr], form: BlockForm, positive: bool) -> list[Beta]:
        (p,) = components
        log, complement = place_of_log(form, p), form.places.get(_log_complement(p), -1)
        enough = complement >= 0 or (log >= 0 and not _powers(form, p))
        return [cls(log, complement)] if enough else []

    @cached_property
    def used(self) -> frozenset[int]:
        return held({self.first, self.second})

    @property
    def support(self) -> list[Interval]:
        return [UNIT]

    def parameters(self, c: Sequence[Any]) -> tuple[Any, Any]:
        """Both shapes."""
        return c[self.first] + 1.0, c[self.second] + 1.0

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        a, b = self.parameters(c)
        return (rng.beta(a, b),) if a > 0.0 and b > 0.0 else None

    def draw_within(self, c: Statistics, limits: Limits, rng: np.random.Generator) -> Values | None:
        a, b = self.parameters(c)
        if not (a > 0.0 and b > 0.0):
            return None
        low, high = limits[0]
        value = draw_between(
            lambda x: sp.betainc(a, b, x), lambda x: sp.betaincc(a, b, x),
            lambda p: sp.betaincinv(a, b, p), lambda p: sp.betainccinv(a, b, p),
            (max(low, 0.0), min(high, 1.0)), rng,
        )  # fmt: skip
        return None if value is None else (value,)

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        a, b = self.parameters(c)
        return (a - 1.0) * math.log(v[0]) + (b - 1.0) * math.log1p(-v[0])

    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        a, b = c[self.first], c[self.second]
        low, high = max(limits[0][0], 0.0), min(limits[0][1], 1.0)
        if a >= 0.0 and b >= 0.0 and a + b > 0.0:
            return np.array([inside(a / (a + b), low, high)])
        return None

    def log_normaliser(self, c: Sequence[Expr]) -> list[Expr]:
        a, b = self.parameters(c)
        return [_lgamma(a), _lgamma(b), -_lgamma(a + b)]

    def written_draw(self, c: Sequence[Expr], draws: Draws) -> list[Expr]:
        return _shares(self.parameters(c), draws)[:1]

    def law(self, words: Wording) -> str:
        a, b = (words.linear(i, 1.0, 1.0) for i in (self.first, self.second))
        return f"{words.names[0]} ~ Beta({a}, {b})"


@dataclass(frozen=True)
class Dirichlet(Family):
    """p ~ Dirichlet(C[log p_k] + 1)."""

    logs: tuple[int, ...]
    name = "Dirichlet"
    kind = "simplex"

    @classmethod
    def match(cls, components: Sequence[Expr], form: BlockForm, positive: bool) -> list[Dirichlet]:
        return [cls(tuple(place_of_log(form, p) for p in components))]

    @cached_property
    def used(self) -> frozenset[int]:
        return held(self.logs)

    @property
    def support(self) -> list[Interval]:
        return [UNIT] * len(self.logs)

    def parameters(self, c: Statistics) -> np.ndarray:
        """The concentrations."""
        return np.asarray(c)[np.array(self.logs)] + 1.0

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        a = self.parameters(c)
        return tuple(rng.dirichlet(a).tolist()) if np.all(a > 0.0) else None

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        return float((self.parameters(c) - 1.0) @ np.log(v))

    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        counts = np.asarray(c)[np.array(self.logs)]
        if np.any(counts < 0.0) or not counts.sum() > 0.0:
            return None
        p = np.maximum(counts / counts.sum(), LEAST_SHARE)
        return p / p.sum()

    def log_normaliser(self, c: Sequence[Expr]) -> list[Expr]:
        shapes = [c[k] + 1.0 for k in self.logs]
        return [*map(_lgamma, shapes), -_lgamma(sum_of(shapes))]

    def written_draw(self, c: Sequence[Expr], draws: Draws) -> list[Expr]:
        return _shares([c[k] + 1.0 for k in self.logs], draws)

    def law(self, words: Wording) -> str:
        shapes = ", ".join(words.linear(i, 1.0, 1.0) for i in self.logs)
        return f"{words.block} ~ Dirichlet({shorten(shapes)})"


# -- what they are matched by
def _powers(form: BlockForm, v: Expr) -> dict[float, int]:
    """Exponent -> position of the powers of v among the functions."""
    found = {}
    for monomial, place in form.places.items():
        if len(monomial) == 1:
            ((atom, exponent),) = monomial
            if atom is v:
                found[exponent] = place
    return found


def _log_complement(p: Expr) -> Monomial:
    """log(1 - p), as `separate` writes it."""
    form = separate(apply("log", 1.0 - p), [p])
    return next(iter(form.terms)) if isinstance(form, Separation) else frozenset()


# -- powers of a Gamma variate
def root_of(g: float, power: float) -> float:
    """v for v**power = g >= 0; 0 or inf where it leaves what floating point holds."""
    if power == 1.0:
        return g
    if power == -1.0:
        return 1.0 / g if g > 0.0 else math.inf
    try:
        return g ** (1.0 / power) if g > 0.0 else (0.0 if power > 0 else math.inf)
    except OverflowError:
        return math.inf


def _to_power(x: float, k: float) -> float:
    if x == 0.0:
        return 0.0 if k > 0 else math.inf
    return x**k if x < math.inf else (math.inf if k > 0 else 0.0)


def mode_of_power(a: float, b: float, k: float, limits: Interval) -> float | None:
    """The v > 0 that maximises a log v + b v**k."""
    low, high = max(limits[0], 0.0), limits[1]
    if b > 0.0 or (a == 0.0 and b == 0.0):
        return None
    if b < 0.0 and a / k > 0.0:
        return inside(math.exp(math.log(-a / (k * b)) / k), low, high)
    rising = a > 0.0 or (a == 0.0 and k < 0.0)  # monotone in v
    if rising:
        return inside(math.inf, low, high) if high < math.inf else None
    return inside(-math.inf, low, high) if low > 0.0 else None


def _variate(name: str, power: float) -> str:
    base = name if abs(power) == 1.0 else f"{name}**{abs(power):g}"
    return f"{base} ~ Gamma" if power > 0.0 else f"{base} ~ inverse Gamma"


# -- in expressions
class _WrittenNormal:
    """theta ~ Normal(H^-1 h, H^-1) for H = K K': z = K^-1 h, and what follows from it.

    square : h' H^-1 h. log_root_det : log det K.
    """

    def __init__(self, family: Normal, c: Sequence[Expr]):
        self.n = n = len(family.linear)
        h = [c[k] for k in family.linear]
        self.k: list[list[Expr]] = []
        for i in range(n):
            row: list[Expr] = []
            for j in range(i + 1):
                twice = 2.0 if i == j else 1.0
                left = -twice * c[family.quadratic[i][j]]
                other = row if i == j else self.k[j]
                left = left - sum_of(row[m] * other[m] for m in range(j))
                row.append(apply("sqrt", left) if i == j else left / self.k[j][j])
            self.k.append(row)
        self.z: list[Expr] = []
        for i in range(n):
            left = h[i] - sum_of(self.k[i][m] * self.z[m] for m in range(i))
            self.z.append(left / self.k[i][i])
        self.square = sum_of(z * z for z in self.z)
        self.log_root_det = sum_of(apply("log", self.k[i][i]) for i in range(n))

    def draw(self, draws: Draws, root: Expr) -> list[Expr]:
        """K'^-1 (z + e / root): root is that of the precision that scales H."""
        aim = [z + draws.normal() / root for z in self.z]
        theta: list[Expr] = [ZERO] * self.n
        for i in range(self.n - 1, -1, -1):
            left = aim[i] - sum_of(self.k[m][i] * theta[m] for m in range(i + 1, self.n))
            theta[i] = left / self.k[i][i]
        return theta


def _log_gamma_integral(shape: Expr, rate: Expr) -> list[Expr]:
    return [_lgamma(shape), -(shape * apply("log", rate))]


def _lgamma(shape: Expr) -> Expr:
    return apply("gammaln", shape)


def _written_root(g: Expr, power: float) -> Expr:
    if power == 1.0:
        return g
    return 1.0 / g if power == -1.0 else apply("pow", g, constant(1.0 / power))


def _shares(shapes: Sequence[Expr], draws: Draws) -> list[Expr]:
    parts = [draws.gamma(shape, buffered=True) for shape in shapes]
    return [p / sum_of(parts) for p in parts]


# -- what is searched, in this order: laws of one unit, and of a Normal block with its scale
SINGLE: tuple[type[Family], ...] = (Gamma, Beta, Normal, Dirichlet, Wishart)
SCALED: tuple[type[ScaledFamily], ...] = (NormalGamma, MatrixNormalWishart)
