"""Derivatives of expressions, by the chain rule over the graph (forward mode).

`PARTIALS` maps an operation to its partial derivatives in its arguments; a statistician can check
it line by line. `None` marks a partial that has no closed form here: it is an error only where
it is needed. Matrix nodes follow Giles (2008), "Collected matrix derivative results for forward
and reverse mode algorithmic differentiation".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ssmppl.errors import SSMError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import BOOLEAN, Expr, apply, constant, dependent, topological
from ssmppl.expressions.linear import inverse

Partial = Callable[..., Sequence[Expr | float | None]]
_ROOT_2PI = math.sqrt(2.0 * math.pi)


def _f(op: str, *args: Expr | float) -> Expr:
    return apply(op, *args)


def _gamma_density(a: Expr, x: Expr) -> Expr:
    return _f("exp", (a - 1.0) * _f("log", x) - x - _f("gammaln", a))


def _over(top: Expr, below: Expr, limit: float) -> Expr:
    """top / below, with its limit where both are 0."""
    at_zero = _f("eq", below, 0.0)
    return _f("where", at_zero, limit, top / _f("where", at_zero, 1.0, below))


def _beta_density(a: Expr, b: Expr, x: Expr) -> Expr:
    return _f("exp", (a - 1.0) * _f("log", x) + (b - 1.0) * _f("log1p", -x) - _f("betaln", a, b))


def _vonmises_density(k: Expr, x: Expr) -> Expr:
    return _f("exp", k * (_f("cos", x) - 1.0)) / (2.0 * math.pi * _f("i0e", k))


PARTIALS: dict[str, Partial] = {
    "neg": lambda d, a: [-1.0],
    "exp": lambda d, a: [d],
    "log": lambda d, a: [1.0 / a],
    "log1p": lambda d, a: [1.0 / (1.0 + a)],
    "expm1": lambda d, a: [_f("exp", a)],
    "sqrt": lambda d, a: [0.5 / d],
    "sin": lambda d, a: [_f("cos", a)],
    "cos": lambda d, a: [-_f("sin", a)],
    "tan": lambda d, a: [1.0 + d**2],
    "arcsin": lambda d, a: [1.0 / _f("sqrt", 1.0 - a**2)],
    "arccos": lambda d, a: [-1.0 / _f("sqrt", 1.0 - a**2)],
    "arctan": lambda d, a: [1.0 / (1.0 + a**2)],
    "sinh": lambda d, a: [_f("cosh", a)],
    "cosh": lambda d, a: [_f("sinh", a)],
    "tanh": lambda d, a: [1.0 - d**2],
    "arcsinh": lambda d, a: [1.0 / _f("sqrt", 1.0 + a**2)],
    "arccosh": lambda d, a: [1.0 / _f("sqrt", a**2 - 1.0)],
    "arctanh": lambda d, a: [1.0 / (1.0 - a**2)],
    "abs": lambda d, a: [_f("sign", a)],
    "gammaln": lambda d, a: [_f("digamma", a)],
    "digamma": lambda d, a: [_f("trigamma", a)],
    "gammaln_rise": lambda d, a, b: [_f("digamma_rise", a, b), _f("digamma", a + b)],
    "digamma_rise": lambda d, a, b: [
        _f("trigamma", a + b) - _f("trigamma", a),
        _f("trigamma", a + b),
    ],
    "betaln": lambda d, a, b: [-_f("digamma_rise", a, b), -_f("digamma_rise", b, a)],
    "ndtr": lambda d, a: [_f("exp", -0.5 * a**2) / _ROOT_2PI],
    "log_ndtr": lambda d, a: [_f("exp", -0.5 * a**2 - d) / _ROOT_2PI],
    "ndtri": lambda d, a: [_ROOT_2PI * _f("exp", 0.5 * d**2)],
    "erf": lambda d, a: [2.0 / math.sqrt(math.pi) * _f("exp", -(a**2))],
    "erfc": lambda d, a: [-2.0 / math.sqrt(math.pi) * _f("exp", -(a**2))],
    "i0e": lambda d, a: [_f("i1e", a) - _f("sign", a) * d],
    # I1' = I0 - I1 / a, and I1(a) / a is 1/2 at 0
    "i1e": lambda d, a: [_f("i0e", a) - _over(d, a, 0.5) - _f("sign", a) * d],
    "add": lambda d, a, b: [1.0, 1.0],
    "sub": lambda d, a, b: [1.0, -1.0],
    "mul": lambda d, a, b: [b, a],
    "div": lambda d, a, b: [1.0 / b, -d / b],
    "pow": lambda d, a, b: [b * a ** (b - 1.0), d * _f("log", a)],
    "mod": lambda d, a, b: [1.0, -_f("floor", a / b)],
    "maximum": lambda d, a, b: [_f("le", b, a) * 1.0, _f("lt", a, b) * 1.0],
    "minimum": lambda d, a, b: [_f("le", a, b) * 1.0, _f("lt", b, a) * 1.0],
    "arctan2": lambda d, a, b: [b / (a**2 + b**2), -a / (a**2 + b**2)],
    "logaddexp": lambda d, a, b: [_f("exp", a - d), _f("exp", b - d)],
    "gammainc": lambda d, a, x: [None, _gamma_density(a, x)],
    "gammaincc": lambda d, a, x: [None, -_gamma_density(a, x)],
    "gammaincinv": lambda d, a, p: [None, 1.0 / _gamma_density(a, d)],
    "gammainccinv": lambda d, a, p: [None, -1.0 / _gamma_density(a, d)],
    "betainc": lambda d, a, b, x: [None, None, _beta_density(a, b, x)],
    "betaincc": lambda d, a, b, x: [None, None, -_beta_density(a, b, x)],
    "vonmises_cdf": lambda d, k, x: [None, _vonmises_density(k, x)],
    "vonmises_quantile": lambda d, k, p: [None, 1.0 / _vonmises_density(k, d)],
    "betaincinv": lambda d, a, b, p: [None, None, 1.0 / _beta_density(a, b, d)],
    "betainccinv": lambda d, a, b, p: [None, None, -1.0 / _beta_density(a, b, d)],
}
# Piecewise constant: derivative zero wherever there is one.
FLAT = BOOLEAN | {"sign", "floor", "ceil"}


class NotDifferentiable(SSMError):
    """The derivative has no closed form in this language."""


def differentiate(expressions: Sequence[Expr], symbol: Expr) -> list[Expr]:
    """Derivatives of `expressions` in `symbol`.

    Raises
    ------
    NotDifferentiable : a partial derivative without closed form is needed (a shape parameter of
        an incomplete gamma or beta function, an opaque primitive, a random draw's parameters).
    """
    involved = dependent(expressions, [symbol])
    tangent: dict[Expr, Expr] = {symbol: constant(1.0)}
    matrix_tangent: dict[Expr, ExprArray] = {}
    for node in topological(expressions, involved):
        if node is symbol:
            continue
        if node.op in ("cholesky", "inverse"):
            matrix_tangent[node] = _matrix_tangent(node, tangent)
        elif node.op == "item":
            tangent[node] = matrix_tangent[node.args[0]][node.data]
        else:
            tangent[node] = _chain(node, tangent)
    zero = constant(0.0)
    return [tangent.get(e, zero) for e in expressions]


def _chain(node: Expr, tangent: dict[Expr, Expr]) -> Expr:
    if node.op in FLAT:
        return constant(0.0)
    if node.op == "where":
        zero = constant(0.0)
        return apply("where", node.args[0], *(tangent.get(a, zero) for a in node.args[1:]))
    if node.op in ("logdet", "det"):
        slope = np.sum(_inverse_of(node).T * _entries(node, tangent))
        return slope * node if node.op == "det" else slope
    if node.op not in PARTIALS:
        raise NotDifferentiable(f"{node!r} has no derivative in closed form")
    total = constant(0.0)
    for argument, partial in zip(node.args, PARTIALS[node.op](node, *node.args), strict=True):
        if argument in tangent and not _is_zero(tangent[argument]):
            if partial is None:
                raise NotDifferentiable(f"{node!r} has no derivative in {argument!r}")
            total = total + partial * tangent[argument]
    return total


def _is_zero(node: Expr) -> bool:
    return node.op == "const" and node.data == 0.0


def _entries(node: Expr, tangent: dict[Expr, Expr]) -> ExprArray:
    zero = constant(0.0)
    flat = array([tangent.get(a, zero) for a in node.args])
    return array(flat.reshape(node.data, node.data))


def _inverse_of(node: Expr) -> ExprArray:
    return inverse(array(node.args).reshape(node.data, node.data))


def _matrix_tangent(node: Expr, tangent: dict[Expr, Expr]) -> ExprArray:
    n, d = node.data, _entries(node, tangent)
    item = np.array([[Expr("item", (node,), (i, j)) for j in range(n)] for i in range(n)])
    if node.op == "inverse":  # d(A^-1) = -A^-1 dA A^-1
        x = array(item)
        return -(x @ d @ x)
    # d L = L Phi(L^-1 dA L^-T), Phi: lower half with halved diagonal; dA symmetric from its lower
    lower = array(np.tril(array(item)))
    symmetric = array(np.tril(d) + np.tril(d, -1).T)
    inv = lower_inverse(lower)
    middle = inv @ symmetric @ inv.T
    return lower @ array(np.tril(middle) * (1.0 - 0.5 * np.eye(n)))


def lower_inverse(lower: ExprArray) -> ExprArray:
    """Inverse of a lower triangular matrix by forward substitution, written out."""
    n = len(lower)
    out = np.full((n, n), constant(0.0), dtype=object)
    for j in range(n):
        out[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, n):
            total = constant(0.0)
            for k in range(j, i):
                total = total + lower[i, k] * out[k, j]
            out[i, j] = -total / lower[i, i]
    return array(out)


def gradient(expression: Expr, symbols: Iterable[Expr]) -> list[Expr]:
    """First derivatives of one expression in each symbol."""
    return [differentiate([expression], s)[0] for s in symbols]


def hessian(expression: Expr, symbols: Sequence[Expr]) -> ExprArray:
    """Second derivatives, (len(symbols), len(symbols)), symmetric by construction."""
    first = gradient(expression, symbols)
    n = len(symbols)
    out = np.full((n, n), constant(0.0), dtype=object)
    for j, s in enumerate(symbols):
        column = differentiate(first[: j + 1], s)
        for i in range(j + 1):
            out[i, j] = out[j, i] = column[i]
    return array(out) if n else out.view(ExprArray)
