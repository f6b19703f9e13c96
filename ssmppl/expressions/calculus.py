"""Derivatives of expressions, by the chain rule over the graph (forward mode).

`PARTIALS` maps an operation to its partial derivatives in its arguments; a statistician can check
it line by line. `None` marks a partial that has no closed form here: it is an error only where
it is needed. Matrix nodes follow Giles (2008), "Collected matrix derivative results for forward
and reverse mode algorithmic differentiation".

A product of a partial and a slope is 0 times infinity, which is no number, where a function is
steep of what does not move (the root of max(u - c, 0) for u below c) or flat of what moves without
bound (1 / (1 + exp(a)) for a above 709.8). So a slope goes with the condition outside of which it
is zero, whatever it is multiplied by, and exponentials are divided by each other in exponents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ssmppl.errors import SSMError
from ssmppl.expressions.arrays import ExprArray, array, inverse
from ssmppl.expressions.batched import call as batched
from ssmppl.expressions.expr import (
    BOOLEAN,
    Expr,
    apply,
    as_expr,
    constant,
    dependent,
    depends_on,
    is_tuple,
    topological,
    without_exponentials,
)
from ssmppl.expressions.loops.slopes import loop_slopes
from ssmppl.expressions.properties import may_vanish_by_data, never_negative

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


def _skewnormal_density(a: Expr, z: Expr) -> Expr:
    return math.sqrt(2.0 / math.pi) * _f("exp", -0.5 * z**2) * _f("ndtr", a * z)


def _skewnormal_by_shape(a: Expr, z: Expr) -> Expr:
    return -_f("exp", -0.5 * z**2 * (1.0 + a**2)) / (math.pi * (1.0 + a**2))


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
    "skewnormal_cdf": lambda d, a, z: [_skewnormal_by_shape(a, z), _skewnormal_density(a, z)],
    "skewnormal_quantile": lambda d, a, p: [
        -_skewnormal_by_shape(a, d) / _skewnormal_density(a, d),
        1.0 / _skewnormal_density(a, d),
    ],
    # of P(k) = P(N1 - N2 = k): dP / da = P(k - 1) - P(k), dP / db = P(k + 1) - P(k)
    "skellam_log_mass": lambda d, k, a, b: [
        None,
        _f("expm1", _f("skellam_log_mass", k - 1.0, a, b) - d),
        _f("expm1", _f("skellam_log_mass", k + 1.0, a, b) - d),
    ],
    "skellam_cdf": lambda d, k, a, b: [
        None,
        -_f("exp", _f("skellam_log_mass", _f("floor", k), a, b)),
        _f("exp", _f("skellam_log_mass", _f("floor", k) + 1.0, a, b)),
    ],
    "betaincinv": lambda d, a, b, p: [None, None, 1.0 / _beta_density(a, b, d)],
    "betainccinv": lambda d, a, b, p: [None, None, -1.0 / _beta_density(a, b, d)],
}
# What is one of its two arguments: where it is the first.
CHOICES: dict[str, Callable[[Expr, Expr], Expr]] = {
    "maximum": lambda a, b: _f("le", b, a),
    "minimum": lambda a, b: _f("le", a, b),
}
# Partials that fall to zero as fast as exponentials grow.
_VANISHING = {"exp", "ndtr", "erf", "erfc"}
# Piecewise constant: derivative zero wherever there is one.
FLAT = BOOLEAN | {"sign", "floor", "ceil"}
JUMPING = FLAT | {"mod"}  # not continuous
BENT = JUMPING | {"where", "maximum", "minimum", "abs"}  # or without a derivative somewhere
LONGEST = 80  # characters of an expression in an error


def jumps(node: Expr) -> bool:
    """Whether an operation is not continuous, or a loop makes one that is not."""
    if node.op == "loop":
        return any(map(jumps, topological(node.data.update)))
    return node.op in JUMPING


def bends(node: Expr) -> bool:
    """Whether an operation has corners or is not continuous, or a loop makes one that does."""
    if node.op == "loop":
        return any(map(bends, topological(node.data.update)))
    return node.op in BENT


class NotDifferentiable(SSMError):
    """The derivative has no closed form in this language."""


def differentiate(expressions: Sequence[Expr], symbol: Expr) -> list[Expr]:
    """Derivatives of `expressions` in `symbol`.

    Raises
    ------
    NotDifferentiable : a partial derivative without closed form is needed (a shape parameter of
        an incomplete gamma or beta function, a random draw's parameters).
    """
    involved = dependent(expressions, [symbol])
    tangent: dict[Expr, _Slope] = {symbol: _Slope(constant(1.0))}
    matrix_tangent: dict[Expr, ExprArray] = {}
    for node in topological(expressions, involved):
        if node is symbol:
            continue
        if node.op in ("cholesky", "inverse"):
            matrix_tangent[node] = _matrix_tangent(node, tangent)
        elif node.op == "loop":
            matrix_tangent[node] = array(loop_slopes(node, symbol, differentiate))
        elif node.op == "item" and node.args[0].op == "call":
            tangent[node] = _chain_of_call(node.args[0], node.data[0], tangent)
        elif node.op == batched.OP:
            matrix_tangent[node] = array(_simulated_slopes(node, tangent))
        elif node.op == "item":
            tangent[node] = _Slope(matrix_tangent[node.args[0]][node.data])
        elif not is_tuple(node):
            tangent[node] = _chain(node, tangent)
    return [tangent.get(e, _NONE).whole() for e in expressions]


def _simulated_slopes(node: Expr, tangent: dict[Expr, _Slope]) -> list[Expr]:
    """Slopes of the values of a simulator."""
    total = [constant(0.0)] * node.data.function.outputs
    for j, argument in enumerate(node.args):
        if argument in tangent and not _is_zero(tangent[argument].value):
            own = _partial(node, j)
            if own is not None:
                slope = tangent[argument].whole()
                total = [t + e * slope for t, e in zip(total, batched.items(own), strict=True)]
    return total


def _partial(node: Expr, j: int) -> Expr | None:
    """The derivative of a simulator in its j-th argument."""
    own = batched.partial(node, j)
    if own is not None and batched.too_high(node):
        raise NotDifferentiable(
            f"the simulator {node.data.function.title} has derivatives by differences, of which "
            "third ones would be too rough"
        )
    return own


class _Slope(NamedTuple):
    """A slope, and the condition outside of which it is zero, whatever `value` is there."""

    value: Expr
    moves: Expr | None = None

    def whole(self) -> Expr:
        """The slope as one expression."""
        return self.value if self.moves is None else apply("where", self.moves, self.value, 0.0)

    def only(self, condition: Expr) -> _Slope:
        """This slope where the condition holds, else zero."""
        if self.moves is None or self.moves is condition:
            return _Slope(self.value, condition)
        return _Slope(self.value, apply("and", condition, self.moves))

    def plus(self, other: _Slope) -> _Slope:
        if _is_zero(self.value) or _is_zero(other.value):
            return self if _is_zero(other.value) else other
        if self.moves is other.moves:
            return _Slope(self.value + other.value, self.moves)
        total = self.whole() + other.whole()
        if self.moves is None or other.moves is None:
            return _Slope(total)
        return _Slope(total, apply("or", self.moves, other.moves))


_NONE = _Slope(constant(0.0))


def _chain(node: Expr, tangent: dict[Expr, _Slope]) -> _Slope:
    if node.op in FLAT:
        return _NONE
    if node.op == "where":
        return _either(node.args[0], *(tangent.get(a, _NONE) for a in node.args[1:]))
    if node.op in CHOICES:
        return _either(CHOICES[node.op](*node.args), *(tangent.get(a, _NONE) for a in node.args))
    if node.op in ("logdet", "det"):
        slope = np.sum(_inverse_of(node).T * _entries(node, tangent))
        return _Slope(slope * node if node.op == "det" else slope)
    if node.op == "call":
        return _chain_of_call(node, 0, tangent)
    if node.op not in PARTIALS:
        raise NotDifferentiable(f"{_short_text(node)} has no derivative in closed form")
    total = _NONE
    partials = PARTIALS[node.op](node, *node.args)
    for place, (argument, partial) in enumerate(zip(node.args, partials, strict=True)):
        if argument in tangent and not _is_zero(tangent[argument].value):
            if partial is None:
                raise NotDifferentiable(
                    f"{_short_text(node)} has no derivative in {_short_text(argument)}"
                )
            total = total.plus(_summand(node, place, partial, tangent))
    return total


def _chain_of_call(node: Expr, output: int, tangent: dict[Expr, _Slope]) -> _Slope:
    """The slope of one of the numbers that an opaque function gives."""
    total = _NONE
    for place, argument in enumerate(node.args):
        if argument in tangent and not _is_zero(tangent[argument].value):
            value, moves = tangent[argument]
            total = total.plus(_Slope(_partial_of_call(node, place, output) * value, moves))
    return total


def _partial_of_call(node: Expr, place: int, output: int) -> Expr:
    """The derivative of an opaque function in one argument: a call of another one."""
    slope = getattr(node.data, "slope", None)
    if slope is None:
        raise NotDifferentiable(f"{_short_text(node)} has no derivative in closed form")
    found: Expr = slope(node.args, place, output)
    return found


def _short_text(node: Expr) -> str:
    """The expression in a message, of which nobody reads more than a line."""
    text = repr(node)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _either(condition: Expr, first: _Slope, second: _Slope) -> _Slope:
    """The slope of where(condition, a, b), from those of a and b."""
    if _is_zero(second.value):
        return first if _is_zero(first.value) else first.only(condition)
    if _is_zero(first.value):
        return second.only(apply("not", condition))
    whole = apply("where", condition, first.whole(), second.whole())
    if first.moves is None and second.moves is None:
        return _Slope(whole)
    ways = [
        case if slope.moves is None else apply("and", case, slope.moves)
        for case, slope in ((condition, first), (apply("not", condition), second))
    ]
    return _Slope(whole, apply("or", *ways))


def _summand(node: Expr, place: int, partial: Expr | float, tangent: dict[Expr, _Slope]) -> _Slope:
    """Partial times slope for one of the node's arguments."""
    argument, op = node.args[place], node.op
    value, moves = slope = tangent[argument]
    if op in _VANISHING:
        (down, falls), (up, grows) = map(without_exponentials, (as_expr(partial), value))
        if falls is not None and grows is not None:
            return _Slope(down * up * apply("exp", falls + grows), moves)
    if (op, place) == ("div", 1) or ((op, place) == ("pow", 0) and never_negative(argument)):
        relative = _relative(argument, tangent)
        if relative is not None:
            by = -1.0 if op == "div" else node.args[1]
            return _Slope(by * node * relative, moves)
    zeros = []  # where any of these is 0, so is the slope
    if (op, place) == ("pow", 1):
        zeros = [node.args[0]]  # 0 ** b is 0 for every b above 0
    elif op == "sqrt" or (op == "pow" and not _at_least_one(node.args[1])):
        zeros = _fixed_factors(argument, tangent)
    elif op == "exp" and _divides(value):
        # exp(-k / u) at u = 0 is 0 sooner than the slope of k / u is infinite
        slope = slope.only(apply("ne", node, 0.0))
    for zero in zeros:
        if not _never_zero(zero):
            slope = slope.only(apply("ne", zero, 0.0))
    return _Slope(partial * value, slope.moves)


def _relative(node: Expr, tangent: dict[Expr, _Slope]) -> Expr | None:
    """The slope of a growing exponential relative to it, which is finite also where it is not."""
    if node.op == "exp":
        return tangent[node.args[0]].value
    if node.op == "cosh":
        return _f("tanh", node.args[0]) * tangent[node.args[0]].value
    if node.op == "neg":
        return _relative(node.args[0], tangent)
    if node.op not in ("add", "sub", "mul", "div"):
        return None
    moving = [a for a in node.args if a in tangent]
    if len(moving) != 1 or (node.op == "div" and moving[0] is node.args[1]):
        return None
    relative = _relative(moving[0], tangent)
    if relative is None or node.op in ("mul", "div"):
        return relative
    fixed = node.args[0] if moving[0] is node.args[1] else node.args[1]
    core, exponent = without_exponentials(moving[0])
    share = fixed / core if exponent is None else fixed / core * apply("exp", -exponent)
    return relative / (1.0 + share if node.op == "add" else 1.0 - share)


def _fixed_factors(node: Expr, tangent: dict[Expr, _Slope]) -> list[Expr]:
    """The factors of a product that do not move."""
    if node not in tangent:
        return [node]
    if node.op == "mul":
        return [f for a in node.args for f in _fixed_factors(a, tangent)]
    return _fixed_factors(node.args[0], tangent) if node.op in ("neg", "div") else []


def _divides(node: Expr) -> bool:
    """Whether it has a denominator that is no number."""
    return any(
        (n.op == "div" and n.args[1].op != "const")
        or (n.op == "pow" and n.args[1].op == "const" and n.args[1].data < 0.0)
        for n in topological([node])
    )


def _never_zero(node: Expr) -> bool:
    return node.op == "exp" or (node.op == "const" and node.data != 0.0)


def _at_least_one(node: Expr) -> bool:
    return bool(node.op == "const" and node.data >= 1.0)


def _is_zero(node: Expr) -> bool:
    return node.op == "const" and node.data == 0.0


def _entries(node: Expr, tangent: dict[Expr, _Slope]) -> ExprArray:
    flat = array([tangent.get(a, _NONE).whole() for a in node.args])
    return array(flat.reshape(node.data, node.data))


def _inverse_of(node: Expr) -> ExprArray:
    return inverse(array(node.args).reshape(node.data, node.data))


def _matrix_tangent(node: Expr, tangent: dict[Expr, _Slope]) -> ExprArray:
    n, d = node.data, _entries(node, tangent)
    item = np.array([[Expr("item", (node,), (i, j)) for j in range(n)] for i in range(n)])
    if node.op == "inverse":  # d(A^-1) = -A^-1 dA A^-1
        x = array(item)
        return -(x @ d @ x)
    # d L = L Phi(L^-1 dA L^-T), Phi: lower half with halved diagonal; dA symmetric from its lower
    lower = array(np.tril(array(item)))
    symmetric = array(np.tril(d) + np.tril(d, -1).T)
    inv = lower_inverse(lower, may_vanish_by_data(node.args))
    middle = inv @ symmetric @ inv.T
    return lower @ array(np.tril(middle) * (1.0 - 0.5 * np.eye(n)))


def lower_inverse(lower: ExprArray, singular: bool = False) -> ExprArray:
    """Inverse of a lower triangular matrix by forward substitution, written out.

    singular : whether columns may be zero, as those of a factor of a singular covariance are; their
        rows of the inverse are zero then. The inverse times L z is z but for what L leaves out.
    """
    n = len(lower)
    out = np.full((n, n), constant(0.0), dtype=object)
    for i in range(n):
        pivot = lower[i, i]
        if singular and pivot is constant(0.0):
            continue
        row = []
        for j in range(i):
            total = constant(0.0)
            for k in range(j, i):
                total = total + lower[i, k] * out[k, j]
            row.append(-total / pivot)
        row.append(1.0 / pivot)
        if singular:
            row = [apply("where", apply("lt", 0.0, pivot), value, 0.0) for value in row]
        out[i, : i + 1] = row
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


def reverse_gradient(expression: Expr, symbols: Sequence[Expr]) -> list[Expr]:
    """First derivatives of one expression in each symbol, by reverse accumulation over the graph.

    It costs a few times the expression, however many the symbols, where `gradient` costs that for
    each of them (Griewank and Walther 2008, chapter 3). It does without the care that is taken
    above of products of zero and infinity, except for what a condition leaves out: where it comes
    to no number, the caller has to do without.

    Raises
    ------
    NotDifferentiable : as `calculus.differentiate`.
    """
    order = topological([expression], dependent([expression], symbols))
    involved = set(symbols)  # what moves with them
    for node in order:
        moving = node.args[1:] if node.op == "where" else node.args
        if node.op not in FLAT and not involved.isdisjoint(moving):
            involved.add(node)
    slopes: dict[Expr, _Slope] = {expression: _Slope(constant(1.0))}
    entries: dict[Expr, ExprArray] = {}  # slopes in the entries of matrix nodes

    def add(node: Expr, slope: _Slope) -> None:
        if node in involved:
            slopes[node] = slopes[node].plus(slope) if node in slopes else slope

    for node in reversed(order):
        if node not in involved:
            continue
        if is_tuple(node):
            for place, argument in enumerate(node.args):
                for i, value in enumerate(entries.get(node, ())):
                    if argument in involved and not _is_zero(value):
                        add(argument, _Slope(value * _partial_of_call(node, place, i)))
            continue
        if node.op in ("cholesky", "inverse"):
            if node in entries:
                for argument, value in zip(node.args, _of_matrix(node, entries[node]), strict=True):
                    add(argument, _Slope(value))
            continue
        if node.op == batched.OP or node not in slopes or _is_zero(slopes[node].value):
            continue
        if node.op == "item" and node.args[0].op == "loop":
            for s in symbols:  # at once: the slopes in the arguments between would be many more
                if s in involved and depends_on(node, [s]):
                    value = loop_slopes(node.args[0], s, differentiate)[node.data[0]]
                    add(s, _Slope(slopes[node].whole() * value))
        elif node.op == "item" and node.args[0].op == batched.OP:
            for j, argument in enumerate(node.args[0].args):
                own = _partial(node.args[0], j) if argument in involved else None
                if own is not None:
                    value = batched.items(own)[node.data[0]]
                    add(argument, _Slope(slopes[node].whole() * value))
        elif node.op == "item":
            matrix = node.args[0]
            shape = (matrix.data.outputs,) if is_tuple(matrix) else (matrix.data, matrix.data)
            here = entries.setdefault(matrix, array(np.full(shape, constant(0.0), dtype=object)))
            here[node.data] = here[node.data] + slopes[node].whole()
        else:
            for argument, slope in _of_arguments(node, slopes[node], involved):
                add(argument, slope)
    return [slopes[s].whole() if s in slopes else constant(0.0) for s in symbols]


def _of_arguments(node: Expr, slope: _Slope, involved: set[Expr]) -> list[tuple[Expr, _Slope]]:
    """What a node's slope makes in its arguments."""
    if node.op == "symbol":
        return []
    if node.op == "where" or node.op in CHOICES:
        first, second = node.args[-2:]
        condition = node.args[0] if node.op == "where" else CHOICES[node.op](*node.args)
        return [(first, slope.only(condition)), (second, slope.only(apply("not", condition)))]
    if node.op in ("logdet", "det"):
        n = node.data
        value = inverse(array(node.args).reshape(n, n)).T * slope.whole()
        value = value * node if node.op == "det" else value
        return list(zip(node.args, map(_Slope, array(value).ravel()), strict=True))
    if node.op == "call":
        partials = [_partial_of_call(node, k, 0) for k, a in enumerate(node.args) if a in involved]
        moving = [a for a in node.args if a in involved]
        slopes = [_Slope(slope.value * p, slope.moves) for p in partials]
        return list(zip(moving, slopes, strict=True))
    if node.op not in PARTIALS:
        raise NotDifferentiable(f"{_short_text(node)} has no derivative in closed form")
    out = []
    for argument, partial in zip(node.args, PARTIALS[node.op](node, *node.args), strict=True):
        if argument not in involved:
            continue
        if partial is None:
            raise NotDifferentiable(
                f"{_short_text(node)} has no derivative in {_short_text(argument)}"
            )
        out.append((argument, _Slope(slope.value * as_expr(partial), slope.moves)))
    return out


def _of_matrix(node: Expr, slope: ExprArray) -> list[Expr]:
    """The slopes in the entries of A, row by row, from those in the entries of A^-1 or of its
    lower Cholesky factor, which reads the lower half of A only."""
    n = node.data
    item = np.array([[Expr("item", (node,), (i, j)) for j in range(n)] for i in range(n)])
    if node.op == "inverse":
        x = array(item)
        return list(array(-(x.T @ slope @ x.T)).ravel())
    lower = array(np.tril(array(item)))
    middle = array(np.tril(lower.T @ array(np.tril(slope))) * (1.0 - 0.5 * np.eye(n)))
    inv = lower_inverse(lower, may_vanish_by_data(node.args))
    whole = inv.T @ middle @ inv
    # d A symmetric from its lower half: both entries off the diagonal count for the lower one
    return list(array(np.tril(whole) + np.tril(whole.T, -1)).ravel())
