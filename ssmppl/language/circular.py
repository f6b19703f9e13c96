"""VonMises: directions, elementwise of arrays.

Mardia and Jupp (2000), "Directional statistics", section 3.5.4.
"""

from __future__ import annotations

import math
from typing import Any

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.signs import never_negative
from ssmppl.language.continuous import _NAN, _each, _where
from ssmppl.language.distribution import Distribution, Support

LOG_TURN = math.log(2.0 * math.pi)


class VonMises(Distribution):
    """VonMises(mean, concentration=): an angle, in radians, on (-pi, pi].

    Its density is ``exp(concentration * cos(x - mean)) / (2 pi I0(concentration))``: nearly
    Normal(mean, precision=concentration) where that is large, and without an edge where the
    circle is cut.

    Parameters
    ----------
    mean : the direction; any number of turns may be added to it.
    concentration : not negative; 0 is uniform on the circle.

    Notes
    -----
    `mean` and `variance`, as in the predictions of a filter, are the circular ones: the direction
    within (-pi, pi], and 1 - I1(concentration) / I0(concentration), which lies in (0, 1].
    A particle filter averages the directions of its particles as numbers: where they lie on both
    sides of the cut, the average says nothing, and the PIT values still do.
    """

    closed = True

    def __init__(self, mean: Any, *, concentration: Any):
        self._set(mean_=mean, concentration=concentration)
        self._require("concentration", 0.0, strict=False)

    def support(self):
        return Support("interval", self._full(-math.pi), self._full(math.pi))

    def _allowed(self) -> ExprArray:
        """The concentration; NaN below 0, where the formulas are those of the opposite mean."""
        k = self.concentration
        return k if all(map(never_negative, k.ravel())) else _where(ew("le", 0.0, k), k, _NAN)

    def log_densities(self, value):
        k = self._allowed()
        away = array(ew("cos", array(value) - self.mean_)) - 1.0
        return k * away - LOG_TURN - ew("log", ew("i0e", k))

    def sample(self, draws):
        drawn = self.mean_ + _each(self, lambda i: draws.vonmises(self.concentration[i]))
        return _within(drawn)

    def mean(self):
        return _within(self.mean_)

    def variance(self):
        k = self._allowed()
        return 1.0 - array(ew("i1e", k)) / ew("i0e", k)

    def _unrolled(self, value: Any) -> ExprArray:
        """The distribution function on the whole line, which grows by 1 with each turn."""
        away = array(value) - self.mean_
        return array(_turns(away) + ew("vonmises_cdf", self._allowed(), _within(away)))

    def _from_cut(self) -> ExprArray:
        """That function where the circle is cut."""
        return self._unrolled(self._full(-math.pi))

    def _clip(self, value: Any) -> ExprArray:
        return array(ew("minimum", math.pi, ew("maximum", -math.pi, value)))

    def cdf(self, value):
        return self._unrolled(self._clip(value)) - self._from_cut()

    def survival(self, value):
        return self._unrolled(self._full(math.pi)) - self._unrolled(self._clip(value))

    def quantile(self, p):
        total = array(p) + self._from_cut()
        turns = array(ew("floor", total))
        away = ew("vonmises_quantile", self._allowed(), total - turns)
        return self._clip(self.mean_ + 2.0 * math.pi * turns + away)


def _turns(angle: Any) -> ExprArray:
    """How many whole turns to take off for an angle within (-pi, pi]."""
    return array(ew("ceil", (array(angle) - math.pi) / (2.0 * math.pi)))


def _within(angle: Any) -> ExprArray:
    return array(array(angle) - 2.0 * math.pi * _turns(angle))
