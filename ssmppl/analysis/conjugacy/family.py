"""What a conjugate family is, and the arithmetic that several of them share.

    log p(block | rest) = const + sum_i C_i s_i(block)

A family is a distribution that is spanned by given functions s_i of a block. It holds their
positions among the functions of the block, and computes from the statistics C whatever is asked of
the distribution. C has a 0 at its end, so that position -1 stands for a function that is absent.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy.special as sp

from ssmppl.analysis.bounds import Interval
from ssmppl.analysis.conjugacy.separation import BlockForm
from ssmppl.expressions.expr import Expr, apply, constant
from ssmppl.language.distributions import Draws

if TYPE_CHECKING:
    from ssmppl.analysis.conjugacy.describe import MatrixWording, Wording

Statistics = Sequence[float]
Values = tuple[float, ...]
Limits = Sequence[Interval]
Function = Callable[[float], float]

POSITIVE: Interval = (0.0, math.inf)
UNIT: Interval = (0.0, 1.0)
MARGIN = 1e-9  # share of an interval's width by which a maximum stays inside of it
LEAST_MASS = 1e-280  # of an interval, below which nothing is drawn from it
ZERO = constant(0.0)


class Family(ABC):
    """A distribution of a block, by the positions of its functions.

    kind : of the blocks that it may be the distribution of: "real", "simplex" or "matrix".
    written_out : whether it has a normalising constant and a draw in expressions.
    """

    kind: ClassVar[str] = "real"
    written_out: ClassVar[bool] = True

    # -- which law it is
    @classmethod
    def match(cls, components: Sequence[Expr], form: BlockForm, positive: bool) -> Sequence[Family]:
        """Distributions of the block whose functions its form has; positive : whether its support
        is."""
        raise NotImplementedError

    @property
    @abstractmethod
    def name(self) -> str:
        """The family's name in explanations."""

    @property
    @abstractmethod
    def used(self) -> frozenset[int]:
        """Positions of the functions that the distribution holds."""

    @property
    @abstractmethod
    def support(self) -> list[Interval]:
        """Where each component lives."""

    @property
    def normals(self) -> int:
        """How many numbers are jointly Normal in it."""
        return 0

    @property
    def matrix_size(self) -> int:
        """p, where a symmetric (p, p) matrix stands at the end of the block, else 0."""
        return 0

    # -- in numbers
    @abstractmethod
    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        """The block's values; None where the distribution is improper with these statistics."""

    def draw_within(self, c: Statistics, limits: Limits, rng: np.random.Generator) -> Values | None:
        """A draw within the limits; of a family that cannot aim at them, any draw."""
        return self.draw(c, rng)

    def draw_last(
        self, c: Statistics, values: Statistics, limits: Limits, rng: np.random.Generator
    ) -> float | None:
        """The last component drawn given the others; None where its distribution is not known, or
        improper."""
        return None

    @abstractmethod
    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        """Log density at v, up to a constant."""

    @abstractmethod
    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        """Where sum_i C_i s_i is largest within the limits; None where it has no maximum.

        On the block's own scale: for statistics that hold a prior it is the mode of the
        conditional, not of its logarithm. As supports are open, a maximum beyond a limit lies just
        `inside`.

        Parameters
        ----------
        c : finite statistics. limits : (lower, upper) of each component.
        present : kept along directions in which the sum is flat.
        """

    # -- in expressions, for particles that have statistics of their own
    def log_normaliser(self, c: Sequence[Expr]) -> list[Expr]:
        """Summands of log Z(C), Z the integral of exp(sum_i C_i s_i) over the block; without
        constants that depend on nothing."""
        raise NotImplementedError

    def written_draw(self, c: Sequence[Expr], draws: Draws) -> list[Expr]:
        """A draw of the components from the distribution with density exp(sum_i C_i s_i) / Z(C)."""
        raise NotImplementedError

    # -- in words
    @abstractmethod
    def law(self, words: Wording) -> str:
        """The distribution with its parameters in terms of the statistics."""

    def when_improper(self, known: Callable[[int], float | None]) -> str:
        """What is done where the distribution is improper; "" where it never is.

        known : of a position, the statistic of prior and initial distribution alone, if it is a
            number.
        """
        return ""

    @property
    def as_matrices(self) -> bool:
        """Whether the functions are too many to be listed one by one."""
        return self.matrix_size > 0

    def matrix_statistics(self, words: MatrixWording) -> tuple[str, ...] | None:
        """One line for each matrix that the distribution is made of; None where there is none."""
        return None


class ScaledFamily(Family):
    """A Normal block together with what scales its precision.

    scale : the distribution of the latter by itself.
    """

    scale: ClassVar[type[Family]]

    @classmethod
    @abstractmethod
    def match_scaled(
        cls, thetas: Sequence[Expr], scale: Sequence[Expr], form: BlockForm
    ) -> ScaledFamily | None:
        """The distribution of the block (thetas, scale), if its form has the functions."""


def held(positions: Iterable[int]) -> frozenset[int]:
    """Those positions that are not absent."""
    return frozenset(positions) - {-1}


def place_of_log(form: BlockForm, component: Expr) -> int:
    """Position of log(component), -1 where it is none of the functions."""
    return form.places.get(frozenset({(apply("log", component), 1.0)}), -1)


def inside(value: float, low: float, high: float) -> float:
    """The value, or where it lies outside of (low, high), the nearest one just inside: by the share
    `MARGIN` of the width, or of the bound's size where the width is infinite."""
    width = high - low
    margin = MARGIN * width if math.isfinite(width) else 0.0
    if value <= low:
        return low + (margin or MARGIN * max(abs(low), MARGIN))
    if value >= high:
        return high - (margin or MARGIN * max(abs(high), MARGIN))
    return value


def draw_between(
    cdf: Function, survival: Function, quantile: Function, survival_quantile: Function,
    limits: Interval, rng: np.random.Generator,
) -> float | None:  # fmt: skip
    """A draw by inversion in whichever tail keeps the digits; None where the mass underflows."""
    low, high = limits
    below, above = float(cdf(low)), float(cdf(high))
    if below > 0.5:
        below, above = float(survival(high)), float(survival(low))
        quantile = survival_quantile
    if not above - below > LEAST_MASS:
        return None
    x = float(quantile(below + rng.random() * (above - below)))
    return min(max(x, low), high)


def truncated_normal(
    mean: float, sd: float, limits: Interval, rng: np.random.Generator
) -> float | None:
    """A draw of Normal(mean, sd) between the limits; None where it has no mass there."""
    low, high = limits
    for _ in range(4):  # nearly always inside on the first try
        x = mean + sd * rng.standard_normal()
        if low <= x <= high:
            return x
    a, b = (low - mean) / sd, (high - mean) / sd
    flip = a > 0.0
    if flip:
        a, b = -b, -a
    log_a, log_b = float(sp.log_ndtr(a)), float(sp.log_ndtr(b))
    if not log_b > log_a:
        return None
    u = rng.random()
    # log(Phi(a) + u (Phi(b) - Phi(a)))
    log_p = log_b + math.log(max(u - (u - 1.0) * math.exp(log_a - log_b), 1e-320))
    z = float(sp.ndtri_exp(log_p))
    x = mean + sd * (-z if flip else z)
    return min(max(x, low), high) if math.isfinite(x) else None


def sum_of(values: Iterable[Expr]) -> Expr:
    """The sum of expressions."""
    total = ZERO
    for v in values:
        total = total + v
    return total
