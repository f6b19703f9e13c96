"""Multinomial and EulerMultinomial: how many of a number go where, all at once.

Johnson, Kotz and Balakrishnan (1997), "Discrete multivariate distributions", chapter 35. Both are
drawn as binomials, one place after the other out of those that are left.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, apply, constant
from ssmppl.language.distributions.base import INFINITY, Support, where
from ssmppl.language.distributions.discrete import TINY, log_of_count, require_whole, whole
from ssmppl.language.distributions.multivariate import Joint
from ssmppl.language.distributions.nested import check_sum, holding, sum_holds


class _Allocation(Joint):
    """Counts (K,) out of n, each with its chance; the rest of n, if any, stays where it is."""

    discrete = True
    truncatable = False
    highest = 0.0
    trials = "n"

    def _set_trials(self, n: Any, **places: Any) -> None:
        """n and, first of the others, one number for each place."""
        self._set(n=n, **places)
        kind, (name, each) = type(self).__name__, next(iter(places.items()))
        each = self.parameters[name]
        if self.n.ndim:
            raise ModelError(
                f"{kind}: n has shape {self.n.shape}",
                fix=f"give one number, and a {kind} under a name of its own for each",
                where=self.location,
            )
        if each.ndim != 1 or not len(each):
            raise ModelError(
                f"{kind}: {name} has shape {each.shape}",
                fix=f"give a vector, as {name}=[...], of one number for each place",
                where=self.location,
            )
        self.shape = each.shape
        self._require("n", 0.0, strict=False)
        require_whole(self, "n")

    def chances(self) -> list[Expr]:
        """Of each place, of one of n."""
        raise AttributeError

    def log_chances(self) -> list[Expr]:
        """Their logarithms."""
        return [apply("log", p) for p in self.chances()]

    def log_rest(self) -> Expr | None:
        """The logarithm of the chance to stay; None where nothing stays."""
        return None

    def in_range(self) -> ExprArray | None:
        return holding([super().in_range(), whole(self.n)])

    def support(self):
        most = np.full(self.shape, self.n[()], dtype=object)
        return Support("integers", self._full(0.0), array(most))

    def _rest(self, value: ExprArray) -> Expr:
        return self.n[()] - array(np.sum(value))[()]

    def log_densities(self, value):
        v, rest = array(value), self._rest(array(value))
        out = ew("gammaln", self.n[()] + 1.0)
        for count, log in zip(v, self.log_chances(), strict=True):
            out = out + log_of_count(count, log)[()] - ew("gammaln", count + 1.0)
        stay = self.log_rest()
        if stay is not None:
            out = out + log_of_count(rest, stay)[()] - ew("gammaln", rest + 1.0)
        return array(out)

    def guarded_log_densities(self, value):
        value = array(value)
        rest = self._rest(value)
        inside = ew("eq" if self.log_rest() is None else "le", 0.0, rest)
        for count in value:
            inside = ew("and", inside, ew("le", 0.0, count))
            inside = ew("and", inside, ew("eq", count, ew("floor", count)))
        density = where(inside, self.log_densities(value), -INFINITY)
        allowed = self.in_range()
        return density if allowed is None else where(allowed, density, float("nan"))

    def sample(self, draws):
        left, share, out = self.n[()], constant(1.0), []
        chances = self.chances()
        for k, p in enumerate(chances):
            if k + 1 == len(chances) and self.log_rest() is None:
                out.append(left)
                break
            # of those that are left; rounding may leave a share next to nothing
            own = ew("minimum", p / ew("maximum", share, TINY), 1.0)
            count = draws.binomial(left, own)
            out.append(count)
            left, share = left - count, share - p
        return array(out)

    def mean(self):
        return array([self.n[()] * p for p in self.chances()])

    def variance(self):
        return array([self.n[()] * p * (1.0 - p) for p in self.chances()])


class Multinomial(_Allocation):
    """Multinomial(n, p): how many of n fall into each of K categories, counts (K,) of sum n.

    Parameters
    ----------
    n : number of trials, one whole number; it may depend on states.
    p : probabilities, shape (K,), of sum 1, K of at least 2.

    Raises
    ------
    ModelError : n is no whole number from 0 on, or p no such probabilities.

    See Also
    --------
    Categorical : one trial, its category as a number. EulerMultinomial : competing exits at rates.
    """

    def __init__(self, n: Any, p: Any):
        self._set_trials(n, p=p)
        if len(self.p) < 2:
            raise ModelError(
                "Multinomial: p has one probability",
                fix="give one for each category, of sum 1",
                where=self.location,
            )
        self._require("p", 0.0, 1.0, strict=False)
        check_sum(self.p, "Multinomial", "p sums", "divide p by its sum", self.location)

    def in_range(self):
        return holding([super().in_range(), sum_holds(self.p)])

    def shares(self):
        return "probabilities", list(self.p)

    def chances(self):
        return list(self.p)


class EulerMultinomial(_Allocation):
    """EulerMultinomial(n, rates, dt): how many of n leave by each of K exits within dt, (K,).

    Each of n leaves at the sum of the rates, by the exit k with probability rates[k] over that sum:
    ``n_k`` are multinomial with ``(1 - exp(-sum(rates) dt)) rates[k] / sum(rates)``, and the others
    stay. Whatever the rates, never more leave than are there. Under a name in one transition
    function, which another one for the compartments reads as NAME_next::

        return {"left": ssm.EulerMultinomial(S, [beta * I / N, mu], dt)}

    Parameters
    ----------
    n : in the compartment, one whole number; it may depend on states.
    rates : shape (K,), not negative, per unit of time.
    dt : length of the step, positive, in that unit.

    Raises
    ------
    ModelError : n is no whole number from 0 on, rates is no vector, or a number is out of range.

    Notes
    -----
    pomp's `reulermultinom` and `deulermultinom`: Bretó and Ionides (2011), "Compound Markov
    counting processes and their applications to modeling infinitesimally over-dispersed systems",
    *Stochastic Processes and their Applications* 121.
    """

    def __init__(self, n: Any, rates: Any, dt: Any):
        self._set_trials(n, rates=rates, dt=dt)
        if self.dt.ndim:
            raise ModelError(
                f"EulerMultinomial: dt has shape {self.dt.shape}",
                fix="give one length of the step",
                where=self.location,
            )
        self._require("rates", 0.0, strict=False)
        self._require("dt", 0.0)

    def _exposure(self) -> tuple[Expr, Expr]:
        """The sum of the rates, and that times dt."""
        total = array(np.sum(self.rates))[()]
        return total, total * self.dt[()]

    def chances(self):
        total, exposure = self._exposure()
        # where nothing leaves the quotient is 0 / 0
        share = -ew("expm1", -exposure) / ew("where", ew("lt", 0.0, total), total, 1.0)
        return [rate * share for rate in self.rates]

    def log_rest(self):
        return -self._exposure()[1]
