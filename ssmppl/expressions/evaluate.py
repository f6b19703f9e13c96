"""The NumPy interpreter: what an `Expr` means.

Everything else that computes expressions (generated code above all) is tested against this table.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import scipy.special as sp

from ssmppl.expressions import special
from ssmppl.expressions.expr import BINARY, MATRIX_OPS, TERNARY, UNARY, Expr, constant, topological

Draw = Callable[[str, tuple[np.ndarray, ...]], np.ndarray]

_NUMPY = """exp log log1p expm1 sqrt sin cos tan sinh cosh tanh arcsin arccos arctan arcsinh arccosh
    arctanh abs sign floor ceil maximum minimum arctan2 logaddexp"""
_SCIPY = """gammaln digamma ndtr log_ndtr ndtri erf erfc gammainc gammaincc gammaincinv gammainccinv
    betainc betaincc betaincinv betainccinv i0e i1e"""
_OWN = """gammaln_rise digamma_rise betaln betabinomial_cdf betabinomial_quantile vonmises_cdf
    vonmises_quantile"""
MEANING: dict[str, Callable[..., Any]] = {
    **{n: getattr(np, n) for n in UNARY + BINARY if n in _NUMPY.split()},
    **{n: getattr(sp, n) for n in UNARY + BINARY + TERNARY if n in _SCIPY.split()},
    **{n: getattr(special, n) for n in _OWN.split()},
    "trigamma": lambda a: sp.polygamma(1, a),
    # smallest k with cdf(k) >= q; scipy's inverses are continuous in k
    "poisson_quantile": lambda rate, q: _round_up(
        sp.pdtrik(q, rate), lambda k: sp.pdtr(k, rate), q
    ),
    "binomial_quantile": lambda n, p, q: _round_up(
        sp.bdtrik(q, n, p), lambda k: _binomial_cdf(k, n, p), q
    ),
    "negbinomial_quantile": lambda r, mean, q: np.where(
        np.asarray(q) == 1.0,
        np.inf,
        special.smallest_above(lambda k: special.negbinomial_tail(k, r, mean, "lower"), q),
    ),
    # smallest k with P(X > k) <= q
    "poisson_survival_quantile": lambda rate, q: special.smallest_below(
        lambda k: sp.gammainc(k + 1.0, rate), q
    ),
    "negbinomial_survival_quantile": lambda r, mean, q: special.smallest_below(
        lambda k: special.negbinomial_tail(k, r, mean, "upper"), q
    ),
    "neg": np.negative,
    "not": np.logical_not,
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "pow": lambda a, b: np.power(np.asarray(a, dtype=float), b),
    "mod": np.mod,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "where": np.where,
}


def _binomial_cdf(k: Any, n: Any, p: Any) -> Any:
    return np.where(k >= n, 1.0, sp.betainc(np.maximum(n - k, 0.5), k + 1.0, 1.0 - p))


def _round_up(k: Any, cdf: Callable[[Any], Any], q: Any) -> Any:
    k = np.maximum(np.ceil(k), 0.0)
    below = np.maximum(k - 1.0, 0.0)
    return np.where(np.asarray(q) == 1.0, np.inf, np.where(cdf(below) >= q, below, k))


def evaluate(
    expressions: Any,
    values: Mapping[Expr, Any] | None = None,
    draw: Draw | None = None,
) -> Any:
    """Values of one `Expr`, or of an array or sequence of them.

    Parameters
    ----------
    expressions : Expr, ExprArray or iterable of Expr.
    values : symbol -> number or array; arrays broadcast against each other.
    draw : (kind, parameter values) -> array, for expressions with "random" nodes.

    Returns
    -------
    For an Expr its value; for an ExprArray an array whose leading axes are those of the
    ExprArray and whose trailing axes are the broadcast shape; else a list of values.
    """
    if isinstance(expressions, Expr):
        return _run([expressions], values or {}, draw)[0]
    if isinstance(expressions, np.ndarray):
        flat = _run(list(expressions.ravel()), values or {}, draw)
        stacked = np.array(np.broadcast_arrays(*flat)) if flat else np.zeros(0)
        return stacked.reshape(expressions.shape + stacked.shape[1:])
    return _run(list(expressions), values or {}, draw)


def _run(roots: list[Expr], values: Mapping[Expr, Any], draw: Draw | None) -> list[Any]:
    done: dict[Expr, Any] = {}
    with np.errstate(all="ignore"):
        for node in topological(roots):
            args = [done[a] for a in node.args]
            if node in values:
                done[node] = np.asarray(values[node], dtype=float)
            elif node.op == "const":
                done[node] = np.float64(node.data)
            elif node.op == "symbol":
                raise KeyError(f"no value given for {node!r}")
            elif node.op == "item":
                done[node] = args[0][(..., *node.data)]
            elif node.op in MATRIX_OPS:
                done[node] = _matrix(node.op, node.data, args)
            elif node.op == "random":
                if draw is None:
                    raise KeyError(f"no random draws given for {node!r}")
                done[node] = draw(node.data[0], tuple(args))
            elif node.op == "call":
                # compiled it has no errors of Python's: log(-1) is NaN, as in the kernels
                function = getattr(node.data, "compiled", node.data)
                done[node] = np.vectorize(function, otypes=[float])(*args)
            else:
                done[node] = MEANING[node.op](*args)
    return [done[r] for r in roots]


def _matrix(op: str, n: int, entries: list[Any]) -> np.ndarray:
    stacked = np.stack(np.broadcast_arrays(*entries), axis=-1).astype(float)
    matrices = stacked.reshape(stacked.shape[:-1] + (n, n))
    if op == "det":
        return np.linalg.det(matrices)
    if op == "logdet":
        return np.linalg.slogdet(matrices)[1]
    function = np.linalg.inv if op == "inverse" else np.linalg.cholesky
    with contextlib.suppress(np.linalg.LinAlgError):
        return function(matrices)
    result = np.full(matrices.shape, np.nan)  # nan where there is no such factor
    for index in np.ndindex(matrices.shape[:-2]):
        with contextlib.suppress(np.linalg.LinAlgError):
            result[index] = function(matrices[index])
    return result


def numpy_draws(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> Draw:
    """The interpreter's source of random numbers: independent draws of the given shape."""

    def draw(kind: str, args: tuple[np.ndarray, ...]) -> np.ndarray:
        if kind == "normal":
            return rng.standard_normal(shape)
        if kind == "uniform":  # in the open interval, as in the compiled kernels
            return (rng.integers(0, 2**52, shape) + 0.5) / 2.0**52
        size = np.broadcast_shapes(shape, *(np.shape(a) for a in args))
        bad = np.zeros(size, dtype=bool)
        for a in args:
            bad |= ~(np.asarray(a) >= 0)
        safe = [np.where(bad, 0.5, a) for a in args]
        if kind == "gamma":
            out = rng.standard_gamma(safe[0], size)
        elif kind == "poisson":
            out = rng.poisson(safe[0], size).astype(float)
        elif kind == "binomial":
            out = rng.binomial(np.asarray(safe[0], dtype=np.int64), safe[1], size).astype(float)
        elif kind == "vonmises":
            out = rng.vonmises(0.0, safe[0], size)
        else:
            raise KeyError(f"unknown source of randomness {kind!r}")
        return np.where(bad, np.nan, out)

    return draw


def is_number(node: Expr) -> bool:
    """Whether the expression is a constant."""
    return node.op == "const"


def numbers(nodes: Iterable[Expr]) -> np.ndarray:
    """Values of expressions that hold no symbols."""
    return np.array([float(v) for v in _run(list(nodes), {}, None)])


__all__ = ["MEANING", "constant", "evaluate", "is_number", "numbers", "numpy_draws"]
