"""Mixture: one of several distributions by a hidden choice, which is summed out (McLachlan and Peel
2000, "Finite mixture models"); ZeroInflated: a distribution of counts with more zeros than are its
own (Lambert 1992, "Zero-inflated Poisson regression, with an application to defects in
manufacturing", *Technometrics* 34).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, user_location
from ssmppl.language.distributions.base import INFINITY, Distribution, Support, where
from ssmppl.language.distributions.continuous import Flat
from ssmppl.language.distributions.discrete import Dirac
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.distributions.nested import (
    check_sum,
    cut,
    exists,
    holding,
    log_sum,
    none_below_zero,
    sum_holds,
)


class Mixture(Distribution):
    """Mixture(weights, components): one of the components, chosen with probability weights.

    Independent over the elements of an array: each has a choice of its own.

    Parameters
    ----------
    weights : (K,), not negative, of sum 1: numbers, ``[1 - p, p]``, or a parameter of distribution
        Dirichlet; they may depend on states. (K, ...) gives each element its own.
    components : K distributions of numbers, all continuous or all of whole numbers, of one shape or
        scalars.

    Notes
    -----
    The choice is summed out: its density is ``log(sum_k weights[k] * density_k(x))``. Where each
    choice is wanted, or conjugate draws of the components' parameters, make it a state.
    """

    truncatable = False
    guards_range = True
    components: tuple[Distribution, ...]

    def __init__(self, weights: Any, components: Sequence[Distribution]):
        self.components = _checked(components)
        given = array(_stacked(weights))
        if given.ndim < 1 or len(given) != len(self.components):
            raise ModelError(
                f"Mixture: weights of shape {given.shape} for {len(self.components)} components",
                fix="give one weight for each component, such as [1 - p, p] for two",
                where=user_location(),
            )
        own = {f"weight_{k}": w for k, w in enumerate(given.view(np.ndarray))}
        for k, law in enumerate(self.components):
            own |= {f"of_{k}_{n}": a for n, a in law.parameters.items()}
        self._set(**own)
        self.components = tuple(
            law.rebuilt({n: self.parameters[f"of_{k}_{n}"] for n in law.parameters})
            for k, law in enumerate(self.components)
        )
        self.discrete = self.components[0].discrete
        self.closed = any(law.closed for law in self.components)
        self.open_above = all(law.open_above for law in self.components)
        self.drawable = all(law.drawable for law in self.components)
        for k in range(len(self.components)):
            self._require(f"weight_{k}", 0.0, 1.0, strict=False)
        fix = "divide the weights by their sum"
        check_sum(self.weights, "Mixture", "weights sum", fix, self.location)

    @property
    def weights(self) -> list[ExprArray]:
        """One for each component, of the distribution's shape."""
        return [self.parameters[f"weight_{k}"] for k in range(len(self.components))]

    def inside(self):
        return self.components

    def shares(self):
        return "weights", self.weights

    def inverts(self):
        return False

    def rebuilt(self, parameters):
        values = {**self.parameters, **parameters}
        laws = [
            law.rebuilt({n: values[f"of_{k}_{n}"] for n in law.parameters})
            for k, law in enumerate(self.components)
        ]
        weights = [values[f"weight_{k}"] for k in range(len(laws))]
        return self._at_place(Mixture(weights, laws))

    def __repr__(self) -> str:
        weights = ", ".join(repr(w.ravel()[0]) if w.size else "" for w in self.weights)
        return f"Mixture([{weights}], [{', '.join(map(repr, self.components))}])"

    def support(self):
        parts = [law.support() for law in self.components]
        lower = self._hull("minimum", -INFINITY, [p.lower for p in parts])
        upper = self._hull("maximum", INFINITY, [p.upper for p in parts])
        if self.discrete:
            return Support("integers", lower, upper)
        real = any(p.kind == "real" for p in parts)
        return Support("real" if real else "interval", lower, upper)

    def _hull(self, op: str, end: float, bounds: Iterable[ExprArray]) -> ExprArray:
        """The outermost of some bounds; an infinite one is it, whatever the others are."""
        wide = [array(b).view(np.ndarray) for b in bounds]
        out = np.empty(self.shape, dtype=object)
        for i in np.ndindex(self.shape):
            each: list[Any] = list(dict.fromkeys(b[i] for b in wide))
            endless = [e for e in each if e.op == "const" and e.data == end]
            out[i] = (endless or each)[0]
            for e in [] if endless else each[1:]:
                out[i] = ew(op, out[i], e)
        return array(out)

    def in_range(self) -> ExprArray | None:
        """As of any distribution, for all components at once: what is never chosen has to exist
        too."""
        return holding([super().in_range(), sum_holds(self.weights), *map(exists, self.components)])

    def _parts(self, value: ExprArray) -> list[ExprArray]:
        """Log density of each component, -inf where the mixture has a value and it has none."""
        whole, out = self.support(), []
        for law in self.components:
            own = law.support()
            pairs = [*zip(own.lower.ravel(), whole.lower.ravel(), strict=True),
                     *zip(own.upper.ravel(), whole.upper.ravel(), strict=True)]  # fmt: skip
            ends = law.closed == self.closed and law.open_above == self.open_above
            same = ends and all(a is b for a, b in pairs)
            out.append(array(law.log_densities(value)) if same else cut(law, value))
        return out

    def log_densities(self, value):
        return log_sum(self.weights, self._parts(array(value)))

    def sample(self, draws):
        def draw(i):
            u, shared, out, below = draws.uniform(), _Shared(draws), None, 1.0
            for law, weight in reversed([*zip(self.components, self.weights, strict=True)]):
                drawn = array(law.element(i).sample(shared.again()))[()]
                out = drawn if out is None else ew("where", ew("lt", u, below), drawn, out)
                below = below - weight[i]
            return out

        return self._each(draw)

    def _weighted_sum(self, parts: Iterable[Any]) -> ExprArray:
        total = array(0.0)
        for weight, part in zip(self.weights, parts, strict=True):
            total = total + weight * array(part)
        return array(total)

    def mean(self):
        return self._weighted_sum(law.mean() for law in self.components)

    def variance(self):
        mean = self.mean()
        return self._weighted_sum(
            law.variance() + (law.mean() - mean) ** 2 for law in self.components
        )

    def cdf(self, value):
        return self._weighted_sum(law.cdf(value) for law in self.components)

    def survival(self, value):
        return self._weighted_sum(law.survival(value) for law in self.components)

    def quantile(self, p):
        raise ModelError(
            "Mixture: its quantiles have no formula",
            fix="take those of draws from it",
            where=self.location,
        )


class _Shared(Draws):
    """Draws that every component is made of: only one of them is kept, so they may be the same."""

    def __init__(self, draws: Draws):
        self.draws = draws
        self.made: dict[str, list[Expr]] = {"normal": [], "uniform": []}
        self.used: dict[str, int] = {}

    def again(self) -> _Shared:
        """From the first draw on, for the next component."""
        self.used = dict.fromkeys(self.made, 0)
        return self

    def _node(self, kind: str, *args: Any) -> Expr:
        if kind not in self.made:
            return self.draws._node(kind, *args)
        own, at = self.made[kind], self.used[kind]
        self.used[kind] = at + 1
        if at == len(own):
            own.append(self.draws._node(kind))
        return own[at]


def _checked(components: Any) -> tuple[Distribution, ...]:
    """The components, if they can be mixed."""
    where = user_location()
    known = isinstance(components, (list, tuple)) and all(
        isinstance(c, Distribution) for c in components
    )
    if not known or len(components) < 2:
        raise ModelError(
            f"Mixture: components are {components!r}",
            fix="give a list of at least two distributions: "
            "ssm.Mixture([1 - p, p], [ssm.Normal(x, sd=1), ssm.Normal(x, sd=10)])",
            where=where,
        )
    for law in components:
        name = type(law).__name__
        if law.joint or law.atoms or isinstance(law, (Dirac, Flat)):
            fix = {
                "Categorical": "mix the probabilities: ssm.Categorical(w * p + (1 - w) * q)",
                "Censored": "censor the mixture: ssm.Censored(ssm.Mixture(weights, [...]), lower=)",
                "Dirac": "a distribution with an atom has no density; zeros among counts are "
                "ssm.ZeroInflated(law, p)",
            }.get(name, "make the choice a state, ssm.Bernoulli(p) drawn in every row, and select "
                  "the arguments by np.where")  # fmt: skip
            raise ModelError(f"Mixture: cannot mix {name}", fix=fix, where=where)
    if len({law.discrete for law in components}) > 1:
        kinds = ", ".join(
            f"{type(law).__name__} ({'discrete' if law.discrete else 'continuous'})"
            for law in components
        )
        raise ModelError(
            f"Mixture: components of two kinds: {kinds}",
            fix="mix continuous distributions with each other, distributions of whole numbers with "
            "each other",
            where=where,
        )
    return tuple(components)


def _stacked(weights: Any) -> Any:
    """Weights as one array, scalars of a list widened to the others' shape."""
    if not isinstance(weights, (list, tuple)):
        return weights
    try:
        wide = np.broadcast_arrays(*(array(w).view(np.ndarray) for w in weights))
    except ValueError:
        return weights
    return np.stack(wide) if wide else np.empty(0)


class ZeroInflated(Distribution):
    """ZeroInflated(law, p): 0 with probability p, else a draw of `law`, which may be 0 too.

    Parameters
    ----------
    law : a distribution of counts: Poisson, NegativeBinomial, Binomial, BetaBinomial. Of a
        distribution without zeros, ``Truncated(Poisson(rate), lower=1)``, it makes a hurdle model.
    p : probability of a structural zero, one that is none of the distribution's: the `zi` of brms,
        the `gate` of NumPyro, 1 - `psi` of PyMC.
    """

    discrete = True
    base: Distribution

    def __init__(self, law: Distribution, p: Any):
        name = type(law).__name__
        counts = isinstance(law, Distribution) and law.discrete and not law.joint
        if (
            not counts
            or isinstance(law, ZeroInflated)
            or not all(e.op == "const" and e.data >= 0.0 for e in law.support().lower.ravel())
        ):
            raise ModelError(
                f"ZeroInflated: {name} is no distribution of counts",
                fix="give one of whole numbers from 0 on, such as ssm.Poisson(rate)",
                where=user_location(),
            )
        self._set(p=p, **{f"like_{n}": a for n, a in law.parameters.items()})
        self.base = law.rebuilt({n: self.parameters[f"like_{n}"] for n in law.parameters})
        self.drawable = self.base.drawable
        self._require("p", 0.0, 1.0, strict=False)

    def __repr__(self) -> str:
        return f"ZeroInflated({self.base!r}, p={self.p.ravel()[0]!r})"

    def support(self):
        return Support("integers", self._full(0.0), self.base.support().upper)

    def rebuilt(self, parameters):
        values = {**self.parameters, **parameters}
        law = self.base.rebuilt({n: values[f"like_{n}"] for n in self.base.parameters})
        return self._at_place(ZeroInflated(law, values["p"]))

    def in_range(self) -> ExprArray | None:
        return holding([super().in_range(), exists(self.base)])

    def log_densities(self, value):
        v, p = array(value), self.p
        parts = [self._full(0.0), self._of_base(array(np.zeros(v.shape)))]
        rest = array(ew("log1p", -none_below_zero(p)))
        return where(ew("eq", v, 0.0), log_sum([p, 1.0 - p], parts), rest + self._of_base(v))

    def _of_base(self, value: ExprArray) -> ExprArray:
        """The distribution's own log density from 0 on; -inf at zeros that it does not have."""
        from_zero = all(e.data == 0.0 for e in self.base.support().lower.ravel())
        return array(self.base.log_densities(value) if from_zero else cut(self.base, value))

    def sample(self, draws):
        u = self._each(lambda i: draws.uniform())
        return where(ew("lt", u, self.p), 0.0, self.base.sample(draws))

    def mean(self):
        return (1.0 - self.p) * self.base.mean()

    def variance(self):
        return (1.0 - self.p) * (self.base.variance() + self.p * self.base.mean() ** 2)

    def cdf(self, value):
        inside = self.p + (1.0 - self.p) * self.base.cdf(value)
        return where(ew("lt", value, 0.0), 0.0, inside)

    def survival(self, value):
        inside = (1.0 - self.p) * self.base.survival(value)
        return where(ew("lt", value, 0.0), 1.0, inside)

    def quantile(self, p):
        left = array(p) - self.p
        law = self.base.quantile(array(ew("maximum", left, 0.0)) / (1.0 - self.p))
        return where(ew("le", left, 0.0), 0.0, law)

    def survival_quantile(self, p):
        above = array(p) / (1.0 - self.p)
        law = self.base.survival_quantile(array(ew("minimum", above, 1.0)))
        return where(ew("le", 1.0, above), 0.0, law)

    def sample_above(self, draws, lower):
        above_zero = all(e.op == "const" and e.data >= 1.0 for e in array(lower).ravel())
        return self.base.sample_above(draws, lower) if above_zero else None

    def weighted(self, power):
        found = self.base.weighted(power)
        return None if found is None else ((1.0 - self.p) * found[0], found[1])
