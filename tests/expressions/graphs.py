"""Random expression graphs, each built side by side as symbols and as NumPy numbers.

A program is a list of (operation, positions of its arguments); `run` plays it on a starting list
of operands with any backend. Arguments outside an operation's domain are first squashed into it,
so that both sides take the same, valid path.
"""

from __future__ import annotations

import numpy as np
import scipy.special as sp
from hypothesis import strategies as some

from ssmppl.expressions import special as interpreted
from ssmppl.expressions.expr import Expr, apply, symbol

X, Y, Z = (symbol("state", n) for n in "xyz")

# Smooth operations: the function NumPy or SciPy has for it, and the domain of each argument.
REAL, POSITIVE, UNIT, INNER, ABOVE1 = (-4, 4), (0.2, 4), (0.05, 0.95), (-0.9, 0.9), (1.2, 5)
SMOOTH = {
    "neg": (np.negative, REAL), "exp": (np.exp, (-3, 2)), "log": (np.log, POSITIVE),
    "log1p": (np.log1p, (-0.8, 4)), "expm1": (np.expm1, (-3, 2)), "sqrt": (np.sqrt, POSITIVE),
    "sin": (np.sin, REAL), "cos": (np.cos, REAL), "tan": (np.tan, (-1.2, 1.2)),
    "arcsin": (np.arcsin, INNER), "arccos": (np.arccos, INNER), "arctan": (np.arctan, REAL),
    "sinh": (np.sinh, (-2, 2)), "cosh": (np.cosh, (-2, 2)), "tanh": (np.tanh, REAL),
    "arcsinh": (np.arcsinh, REAL), "arccosh": (np.arccosh, ABOVE1),
    "arctanh": (np.arctanh, INNER), "gammaln": (sp.gammaln, POSITIVE),
    "digamma": (sp.digamma, POSITIVE), "ndtr": (sp.ndtr, REAL), "log_ndtr": (sp.log_ndtr, REAL),
    "ndtri": (sp.ndtri, UNIT), "erf": (sp.erf, (-2, 2)), "erfc": (sp.erfc, (-2, 2)),
    "add": (np.add, REAL, REAL), "sub": (np.subtract, REAL, REAL),
    "mul": (np.multiply, REAL, REAL), "div": (np.divide, REAL, POSITIVE),
    "pow": (np.power, POSITIVE, (-2, 2)), "arctan2": (np.arctan2, REAL, POSITIVE),
    "logaddexp": (np.logaddexp, REAL, REAL), "i0e": (sp.i0e, POSITIVE),
    "i1e": (sp.i1e, POSITIVE), "betaln": (interpreted.betaln, POSITIVE, POSITIVE),
    "gammaln_rise": (lambda a, b: sp.gammaln(a + b) - sp.gammaln(a), POSITIVE, POSITIVE),
    "digamma_rise": (lambda a, b: sp.digamma(a + b) - sp.digamma(a), POSITIVE, POSITIVE),
    "skewnormal_cdf": (interpreted.skewnormal_cdf, REAL, REAL),
    "skewnormal_quantile": (interpreted.skewnormal_quantile, REAL, UNIT),
}  # fmt: skip
# Derivatives in the last argument only.
HALF_SMOOTH = {
    "gammainc": (sp.gammainc, POSITIVE, POSITIVE),
    "gammaincc": (sp.gammaincc, POSITIVE, POSITIVE),
    "gammaincinv": (sp.gammaincinv, POSITIVE, UNIT),
    "gammainccinv": (sp.gammainccinv, POSITIVE, UNIT),
    "betainc": (sp.betainc, POSITIVE, POSITIVE, UNIT),
    "betaincc": (sp.betaincc, POSITIVE, POSITIVE, UNIT),
    "betainccinv": (sp.betainccinv, POSITIVE, POSITIVE, UNIT),
    "betaincinv": (sp.betaincinv, POSITIVE, POSITIVE, UNIT),
    "vonmises_cdf": (interpreted.vonmises_cdf, POSITIVE, (-2, 2)),
    "vonmises_quantile": (interpreted.vonmises_quantile, POSITIVE, UNIT),
    "skellam_log_mass": (interpreted.skellam_log_mass, ABOVE1, POSITIVE, POSITIVE),
    "skellam_cdf": (interpreted.skellam_cdf, REAL, POSITIVE, POSITIVE),
}
KINKED = {
    "abs": (np.abs, REAL), "sign": (np.sign, REAL), "floor": (np.floor, REAL),
    "ceil": (np.ceil, REAL), "maximum": (np.maximum, REAL, REAL),
    "minimum": (np.minimum, REAL, REAL), "mod": (np.mod, REAL, POSITIVE),
    "where": (lambda a, b, c: np.where(a > 0, b, c), REAL, REAL, REAL),
    "lt": (lambda a, b: 1.0 * (a < b), REAL, REAL),
    "le": (lambda a, b: 1.0 * (a <= b), REAL, REAL),
    "and": (lambda a, b: 1.0 * ((a > 0) & (b > 0)), REAL, REAL),
    "or": (lambda a, b: 1.0 * ((a > 0) | (b > 0)), REAL, REAL),
    "not": (lambda a: 1.0 * ~(a > 0), REAL),
    "trigamma": (lambda a: sp.polygamma(1, a), POSITIVE),
}  # fmt: skip
TABLE = {**SMOOTH, **HALF_SMOOTH, **KINKED}


def programs(names=tuple(TABLE), max_size=12):
    """Hypothesis strategy of programs over these operations."""
    index = some.integers(0, 40)
    step = some.tuples(some.sampled_from(list(names)), index, index, index)
    return some.lists(step, min_size=1, max_size=max_size)


def _symbolic(name: str, args: list[Expr]) -> Expr:
    if name == "where":
        return apply("where", args[0] > 0, *args[1:])
    if name in ("and", "or"):
        return apply(name, args[0] > 0, args[1] > 0) * 1.0
    if name == "not":
        return apply("not", args[0] > 0) * 1.0
    if name in ("lt", "le"):
        return apply(name, *args) * 1.0
    return apply(name, *args)


def _near_a_jump(name: str, values: list[np.ndarray]) -> bool:
    """Whether rounding could change the branch taken."""
    if name in ("floor", "ceil", "skellam_cdf"):
        distance = values[0] - np.round(values[0])
    elif name == "mod":
        distance = values[0] / values[1] - np.round(values[0] / values[1])
    elif name in ("lt", "le", "maximum", "minimum"):
        distance = values[0] - values[1]
    elif name in ("abs", "sign", "where", "not"):
        distance = values[0]
    elif name in ("and", "or"):
        distance = np.minimum(np.abs(values[0]), np.abs(values[1]))
    else:
        return False
    return bool(np.any(np.abs(distance) < 1e-6))


def run(program, points):
    """(expression, values at the points) of the last operation that could be taken."""
    nodes = [X, Y, Z, apply("mul", 1.0, 0.7)]
    numbers = [np.asarray(points[s], dtype=float) for s in (X, Y, Z)]
    numbers.append(np.full_like(numbers[0], 0.7))
    for name, *picks in program:
        function, *domains = TABLE[name]
        args, values = [], []
        for pick, (low, high) in zip(picks, domains, strict=False):
            node, value = nodes[pick % len(nodes)], numbers[pick % len(nodes)]
            if np.any(value < low) or np.any(value > high):
                centre, half = 0.5 * (low + high), 0.5 * (high - low)
                node, value = centre + half * np.tanh(node), centre + half * np.tanh(value)
            args.append(node)
            values.append(value)
        if _near_a_jump(name, values):
            continue
        nodes.append(_symbolic(name, args))
        numbers.append(np.asarray(function(*values), dtype=float))
    return nodes[-1], numbers[-1]
