"""The NumPy interpreter: what an `Expr` means.

Everything else that computes expressions (generated code above all) is tested against it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from ssmppl.expressions.batched.call import groups, of_group
from ssmppl.expressions.expr import MATRIX_OPS, Expr, topological
from ssmppl.expressions.operations import MATRICES, OPERATIONS

Draw = Callable[[str, tuple[np.ndarray, ...]], np.ndarray]

MEANING = {name: operation.function for name, operation in OPERATIONS.items()}


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
    if all(r.op == "const" for r in roots):  # most bounds, which are asked for again and again
        return [np.float64(r.data) for r in roots]
    done: dict[Expr, Any] = {}
    with np.errstate(all="ignore"):
        order, together = _order(tuple(roots))
        for node in order:
            if node in done:
                continue
            args = [done[a] for a in node.args]
            if node in values:
                done[node] = np.asarray(values[node], dtype=float)
            elif node.op == "const":
                done[node] = np.float64(node.data)
            elif node.op == "symbol":
                raise KeyError(f"no value given for {node!r}")
            elif node.op == "item":
                done[node] = args[0][(..., *node.data)]
            elif node.op == "loop":
                done[node] = _repeated(node, args)
            elif node in together:
                done |= zip(together[node], of_group(together[node], args), strict=True)
            elif node.op in MATRIX_OPS:
                done[node] = _matrix(node.op, node.data, args)
            elif node.op == "random":
                if draw is None:
                    raise KeyError(f"no random draws given for {node!r}")
                done[node] = draw(node.data[0], tuple(args))
            elif node.op == "call":
                # compiled it has no errors of Python's: log(-1) is NaN, as in the kernels
                function = getattr(node.data, "numbers", node.data)
                outputs = getattr(node.data, "outputs", 1)
                found = np.vectorize(function, otypes=[float] * outputs)(*args)
                done[node] = found if outputs == 1 else np.stack(found, axis=-1)
            else:
                done[node] = MEANING[node.op](*args)
    return [done[r] for r in roots]


def _repeated(node: Expr, args: list[Any]) -> np.ndarray:
    """The values of a loop at the end, in the last axis. Where the number of times is an array,
    each of its elements stops at its own."""
    loop = node.data
    x, fixed, times = args[: loop.states], args[loop.states : -1], args[-1]
    each = np.ndim(times) > 0
    times = np.where(times > 0.0, times, 0.0)
    held = dict(zip(loop.held, fixed, strict=True))
    for k in range(int(np.max(times, initial=0.0))):
        new = _run(list(loop.update), held | dict(zip(loop.moving, x, strict=True)), None)
        x = [np.where(k < times, b, a) for a, b in zip(x, new, strict=True)] if each else new
    whole = np.broadcast_arrays(*x, times)[: loop.states]
    return np.stack(whole, axis=-1).astype(float)


@lru_cache(maxsize=256)
def _order(roots: tuple[Expr, ...]) -> tuple[list[Expr], dict[Expr, tuple[Expr, ...]]]:
    """The nodes in order, and what of simulators is computed together.

    Kept, as the same expressions are evaluated at point after point, of which the walk over a
    large graph takes longer than its few numbers."""
    order = topological(roots)
    return order, groups(order)


def _matrix(op: str, n: int, entries: list[Any]) -> np.ndarray:
    stacked = np.stack(np.broadcast_arrays(*entries), axis=-1).astype(float)
    matrices = stacked.reshape(stacked.shape[:-1] + (n, n))
    _, function = MATRICES[op]
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


def numbers(nodes: Iterable[Expr]) -> np.ndarray:
    """Values of expressions that hold no symbols."""
    return np.array([float(v) for v in _run(list(nodes), {}, None)])
