"""An expression of parameters maximised on the unconstrained scale, from given values on.

Newton's method with the symbolic gradient and Hessian. In directions of wrong or no curvature steps
go uphill by the size of the curvature (Nocedal and Wright 2006, "Numerical optimization", section
3.4); they are shortened and halved until the expression rises. Many parameters: BFGS with the
gradient. Where there is no derivative in closed form: the simplex of Nelder and Mead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import compress

import numpy as np
import scipy

from ssmppl.analysis.lambdify import DOMAIN, Function, python_function
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import NotDifferentiable, gradient, hessian
from ssmppl.expressions.expr import Expr, apply, substitute
from ssmppl.language.model.trace import Trace
from ssmppl.language.model.transforms import Transform, transforms

NEWTON_SIZE = 8  # the number of unconstrained parameters up to which a Hessian is derived
STEPS, HALVINGS = 100, 40
LONGEST_STEP = 3.0  # on the unconstrained scale: logarithms, logits
LEAST_CURVATURE = 1e-10  # relative to the largest
ENOUGH = 1e-14  # what a step may still promise, relative to the size of the function
SMALL_STEP = 1e-12


class Unconstrained:
    """theta -> the unconstrained numbers z of some of its components, compiled.

    Of a simplex, a matrix or an ordered vector all components are members. z, transforms : in the
    trace's order.
    """

    def __init__(self, trace: Trace, components: Sequence[Expr]):
        self.trace, self.members = trace, frozenset(components)
        self.transforms = [t for t in transforms(trace) if self.members & set(t.components)]
        self.z: list[Expr] = []
        for t in self.transforms:
            inside = [c in self.members for c in t.components]
            # a simplex or a matrix has numbers of z that are not those of its components
            self.z += t.free if all(inside) else list(compress(t.free, inside))
        self.inverses = [self._inverse(t) for t in self.transforms]

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        """z; one of the errors `DOMAIN` on the edge of a support."""
        z = np.array([x for inverse in self.inverses for x in inverse(theta.tolist())])
        if not np.all(np.isfinite(z)):
            raise ValueError("a parameter lies on the edge of its support")
        return z

    def _inverse(self, t: Transform) -> Callable[[list[float]], Sequence[float]]:
        """The members of one parameter."""
        support, symbols = t.site.distribution.support(), self.trace.parameter_symbols
        if support.tied:
            return partial(_whole, t, symbols)
        lower, upper = (array(b).ravel() for b in (support.lower, support.upper))
        limits = zip(t.components, lower, upper, strict=True)
        return python_function([_free(*b) for b in limits if b[0] in self.members], symbols)


class SymbolicNewton:
    """A function of some components of theta, of the other parameters and of given numbers.

    value : the function; statistics : the symbols of the given numbers.
    """

    def __init__(
        self, trace: Trace, components: Sequence[Expr], value: Expr, statistics: Sequence[Expr]
    ):
        place = {s: i for i, s in enumerate(trace.parameter_symbols)}
        self.where = np.array([place[c] for c in components])
        self.unconstrained = Unconstrained(trace, components)
        self.z = self.unconstrained.z
        members, mapping = self.unconstrained.members, dict[Expr, Expr]()
        for t in self.unconstrained.transforms:
            values = substitute(list(t.values), mapping)
            pairs = zip(t.components, values, strict=True)
            mapping |= {c: value for c, value in pairs if c in members}
        self.arguments = [*self.z, *statistics, *trace.parameter_symbols]
        self.back = python_function([mapping[c] for c in components], self.arguments)
        self.value_of, self.order = self._derivatives(substitute([value], mapping)[0])

    def _derivatives(self, value: Expr) -> tuple[Function, int]:
        """((z, S, theta) -> value, gradient, Hessian), as far as there are derivatives."""
        try:
            slopes = gradient(value, self.z)
            order = 1
            curvatures: list[Expr] = []
            if len(self.z) <= NEWTON_SIZE:
                second = hessian(value, self.z)
                curvatures = [second[i, j] for i in range(len(self.z)) for j in range(i + 1)]
                order = 2
            return python_function([value, *slopes, *curvatures], self.arguments), order
        except NotDifferentiable:
            return python_function([value], self.arguments), 0

    def maximise(self, s: Sequence[float], theta: np.ndarray) -> np.ndarray:
        """theta with the members moved to where the function is largest, going up from here."""
        try:
            z = self.unconstrained(theta)
        except DOMAIN:
            return theta
        rest = [*s, *theta.tolist()]
        if not math.isfinite(self._at(z, rest)[0]):
            return theta
        if self.order == 2:
            z = self._newton(z, rest)
        else:
            z = self._minimised(z, rest)
        out = theta.copy()
        try:
            out[self.where] = self.back([*z.tolist(), *rest])
        except DOMAIN:
            return theta
        return out if np.all(np.isfinite(out)) else theta

    def _at(self, z: np.ndarray, rest: list[float]) -> tuple[float, ...]:
        """(value, gradient..., Hessian...); -inf for the value outside of the domain."""
        try:
            out = self.value_of([*z.tolist(), *rest])
        except DOMAIN:
            return (-math.inf,)
        return out if all(map(math.isfinite, out)) else (-math.inf,)

    def _newton(self, z: np.ndarray, rest: list[float]) -> np.ndarray:
        n, here = len(z), self._at(z, rest)
        lower = np.tril_indices(n)
        for _ in range(STEPS):
            slope = np.array(here[1 : n + 1])
            curvature = np.zeros((n, n))
            curvature[lower] = here[n + 1 :]
            step = uphill(slope, curvature)
            promised = float(slope @ step)
            length = float(np.linalg.norm(step))
            if not math.isfinite(length) or length == 0.0:
                break
            if promised <= ENOUGH * abs(here[0]) or length < SMALL_STEP:
                # below what the function's own rounding can tell: Newton's last step
                last = self._at(z + step, rest)
                flatter = len(last) > 1 and np.linalg.norm(last[1 : n + 1]) < np.linalg.norm(slope)
                return z + step if flatter and length < 1e-3 else z
            step *= min(1.0, LONGEST_STEP / length)
            for _ in range(HALVINGS):
                there = self._at(z + step, rest)
                if there[0] > here[0]:
                    break
                step *= 0.5
            else:
                break
            z, here = z + step, there
        return z

    def _minimised(self, z: np.ndarray, rest: list[float]) -> np.ndarray:
        n = len(z)

        def negative(v: np.ndarray) -> float | tuple[float, np.ndarray]:
            out = self._at(v, rest)
            if self.order == 0:
                return -out[0]
            slope = np.array(out[1 : n + 1]) if len(out) > 1 else np.zeros(n)
            return (-out[0] if len(out) > 1 else 1e300), -slope

        if self.order == 1:
            found = scipy.optimize.minimize(
                negative, z, jac=True, method="BFGS", options={"gtol": 1e-9}
            )
        else:
            options = {"maxfev": 400 * n, "xatol": 1e-9, "fatol": 1e-12}
            found = scipy.optimize.minimize(negative, z, method="Nelder-Mead", options=options)
        return found.x if -found.fun >= self._at(z, rest)[0] else z


def uphill(slope: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Newton's step from a gradient (F,) and a Hessian (F, F), its lower half; see the module."""
    values, vectors = np.linalg.eigh(curvature, UPLO="L")
    size = np.abs(values)
    floor = max(LEAST_CURVATURE * size.max(), 1e-300)
    return vectors @ ((vectors.T @ slope) / np.maximum(size, floor))


def _free(value: Expr, lower: Expr, upper: Expr) -> Expr:
    """The unconstrained number of a bounded one: the inverse of `language/model/transforms.py`."""
    low, high = (b.op == "const" and math.isinf(b.data) for b in (lower, upper))
    if low and high:
        return value
    if high:
        return apply("log", value - lower)
    if low:
        return apply("log", upper - value)
    return apply("log", value - lower) - apply("log", upper - value)


def _whole(t: Transform, symbols: Sequence[Expr], theta: list[float]) -> list[float]:
    """The unconstrained numbers of a parameter whose components are tied, as those of a simplex."""
    known = dict(zip(symbols, theta, strict=True))
    value = np.array([known[s] for s in t.site.value.ravel()]).reshape(t.site.shape)
    return t.inverse(value, known).tolist()
