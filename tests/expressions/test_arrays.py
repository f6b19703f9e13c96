"""User-level NumPy code: run on symbols then evaluated = run on numbers."""

import math

import numpy as np
import pytest
import scipy
import scipy.special as sp
from hypothesis import given, settings
from hypothesis import strategies as some

from ssmppl.errors import UnsupportedOperation
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.expressions.numpy_protocols import UNSUPPORTED

NAMES = {"x": (), "y": (), "k": (), "v": (3,), "w": (3,), "A": (3, 3), "S": (3, 3), "B": (2, 3)}
C = np.array([[1.0, 0.5, -1.0], [0.25, 2.0, 0.0], [0.0, 1.0, 3.0]])


def symbols():
    made = {}
    for name, shape in NAMES.items():
        out = np.empty(shape, dtype=object)
        for i in np.ndindex(shape):
            out[i] = symbol("state", name, i)
        made[name] = array(out) if shape else out[()]
    return made


def numbers(seed):
    rng = np.random.default_rng(seed)
    values = {n: rng.uniform(-2.0, 2.0, s) for n, s in NAMES.items()}
    root = values["S"]
    values["S"] = root @ root.T + np.eye(3)
    values["A"] = values["A"] + 3.0 * np.eye(3)
    values["k"] = float(rng.integers(0, 3))
    return values


def _loop(v, x):
    total = 0.0
    for k in range(len(v)):
        total = total + v[k] * x**k
    return total


def _horner(v, x):
    total = v[-1]
    for c in v[-2::-1]:
        total = total * x + c
    return total


def _build(v, w):
    rows = []
    for a in v:
        rows.append([a * b for b in w])
    return np.stack([np.stack(r) for r in rows])


def _gaussian(v, w, S):
    d = v - w
    return -0.5 * d @ np.linalg.solve(S, d) - 0.5 * np.linalg.slogdet(2 * np.pi * S)[1]


def _runge_kutta(v):
    def f(s):
        return np.stack([s[1], -np.sin(s[0]), s[0] * s[2]])

    h = 0.1
    a = f(v)
    b = f(v + 0.5 * h * a)
    c = f(v + 0.5 * h * b)
    return v + h / 6 * (a + 2 * b + 2 * c + f(v + h * c))


CODE = {
    "where": lambda v, w: np.where(v > w, v, -w),
    "where scalar": lambda x, v: np.where(x > 0, v, 0.0),
    "where of a number": lambda x, y: np.where(True, x, y),
    "sum": lambda A: np.sum(A),
    "sum axis": lambda A: np.sum(A, axis=0) + A.sum(1) + A.sum(axis=-1),
    "sum keepdims": lambda A: A / np.sum(A**2, axis=1, keepdims=True),
    "sum of a list": lambda x, y: np.sum([x, y, 1.0]),
    "python sum": lambda v: sum(v) + sum(c * c for c in v),
    "dot": lambda v, w: np.dot(v, w) + v.dot(w) + np.inner(v, w) + np.vdot(v, w),
    "dot with numbers": lambda v: np.dot([1.0, 2.0, 3.0], v) + np.dot(C, v)[1],
    "matmul": lambda A, v: A @ v,
    "matmul number": lambda v: C @ v + v @ C,
    "matmul list": lambda v: [1.0, 2.0, 3.0] @ v,
    "matmul matrices": lambda A, B: B @ A @ B.T,
    "object array": lambda x, y, v: np.array([[x, y, 1.0], [0.0, x, 2.0]]) @ v,
    "object array ufunc": lambda x, y: np.exp(-np.array([x, y])) * np.sin(np.array([x, x * y])),
    "concatenate": lambda v, w: np.concatenate([v, w[:2], [1.0]]),
    "stack": lambda v, w: np.stack([v, w], axis=1),
    "hstack": lambda x, v: np.hstack([x, v, 2.0]),
    "vstack": lambda v, w: np.vstack([v, w]),
    "column_stack": lambda v, w: np.column_stack([v, w]),
    "block": lambda A, S: np.block([[A, S], [S, A]]),
    "append": lambda v, x: np.append(v, x),
    "insert delete": lambda v, x: np.delete(np.insert(v, 1, x), 0),
    "clip": lambda v: np.clip(v, -0.5, 0.5) + v.clip(0.0, None),
    "clip one side": lambda v: np.clip(v, 0.0, None) + np.clip(v, None, 1.0),
    "minimum": lambda v, w: np.minimum(v, w) + np.maximum(v, 0.0) + np.fmax(v, w),
    "max": lambda v, A: np.max(v) + v.min() + np.max(A, axis=0) + A.min(1),
    "outer": lambda v, w: np.outer(v, w) + np.multiply.outer(v, w),
    "trace": lambda A: np.trace(A) + A.trace(),
    "einsum": lambda A, v, w: np.einsum("i,ij,j->", v, A, w) + np.einsum("ij->j", A),
    "einsum optimize": lambda A, v: np.einsum("ij,j->i", A, v, optimize=True),
    "inv": lambda A: np.linalg.inv(A),
    "det": lambda A: np.linalg.det(A),
    "cholesky": lambda S: np.linalg.cholesky(S),
    "solve": lambda A, v: np.linalg.solve(A, v),
    "solve matrix": lambda A, S: np.linalg.solve(A, S),
    "slogdet": lambda A: np.linalg.slogdet(A)[0] + np.linalg.slogdet(A)[1],
    "inv diagonal": lambda v: np.linalg.inv(np.diag(np.exp(v))),
    "cholesky diagonal": lambda v: np.linalg.cholesky(np.diag(np.exp(v))),
    "det diagonal": lambda v: np.linalg.det(np.diag(v)) * np.linalg.slogdet(np.diag(v))[1],
    "norm": lambda v: v / np.linalg.norm(v),
    "slicing": lambda A: A[1:, ::2] - A[:2, [0, 2]] + A[-1, 0] * A[:, 0][1],
    "ellipsis": lambda A: A[..., 0] + A[0, ...] + A[None, 1][0],
    "mask": lambda v: v[np.array([True, False, True])],
    "newaxis": lambda v, w: v[:, None] * w[None, :],
    "index by a symbol": lambda v, k: v[k if isinstance(k, Expr) else int(k)],
    "row by a symbol": lambda A, k: A[k if isinstance(k, Expr) else int(k)],
    "entry by a symbol": lambda A, k: A[(k, 1) if isinstance(k, Expr) else (int(k), 1)],
    "take": lambda v: np.take(v, [2, 0]),
    "take by a symbol": lambda v, k: np.take(v, k if isinstance(k, Expr) else int(k)),
    "take by a symbol along an axis": lambda A, k: np.take(
        A, k if isinstance(k, Expr) else int(k), axis=1
    ),
    "take by a symbol from all": lambda A, k: np.take(A, k if isinstance(k, Expr) else int(k)),
    "choose": lambda k: np.choose(k if isinstance(k, Expr) else int(k), C[0]),
    "choose a row of numbers": lambda k: np.choose(k if isinstance(k, Expr) else int(k), C),
    "choose an entry of numbers": lambda k: np.choose(
        k if isinstance(k, Expr) else int(k), np.choose(k if isinstance(k, Expr) else int(k), C)
    ),
    "choose from a list": lambda x, y, v, k: np.choose(
        k if isinstance(k, Expr) else int(k), [x, 2.0, v]
    ),
    "choose by several": lambda v, w: np.choose(
        (v > 0) if isinstance(v, ExprArray) else (v > 0).astype(int), [w, C[1]]
    ),
    "table of numbers": lambda k: np.sum(np.where(np.arange(3) == k, C[0], 0.0)),
    "cumsum": lambda v, A: np.cumsum(v) + np.cumsum(A, axis=1)[0] + v.cumsum(),
    "kron": lambda A, v: np.kron(A, v[:2]),
    "prod": lambda v, A: np.prod(v) + A.prod(0),
    "mean": lambda A: np.mean(A) + A.mean(axis=1) + np.mean(A, 0),
    "var": lambda v: np.var(v) + np.std(v, ddof=1) + v.std() + v.var(),
    "diff": lambda v: np.diff(v),
    "diag": lambda v, A: np.diag(v) + np.diag(np.diag(A)) + np.diagflat(v),
    "triangles": lambda A: np.tril(A) - np.triu(A, 1),
    "reshape": lambda A: A.reshape(-1)[:4].reshape(2, 2).T + np.ravel(A)[0],
    "moves": lambda v: np.flip(v) + np.roll(v, 1) + v[::-1] + np.repeat(v[:1], 3),
    "tile": lambda x, v: np.tile(x, 3) + np.tile(v, 2)[:3],
    "transpose": lambda B: B.T @ B + np.transpose(B) @ np.swapaxes(B, 0, 1).T,
    "split": lambda v: np.split(v, 3)[1] + np.array_split(v, 2)[0],
    "broadcast": lambda v: np.broadcast_to(v, (2, 3)) + np.expand_dims(v, 0) + np.squeeze(v[None]),
    "full": lambda x, v: np.full(3, x) + np.ones(3) * x + np.zeros_like(v) + np.full_like(v, 2.0),
    "like": lambda v: np.ones_like(v) * 2.0 + v.copy() + np.copy(v),
    "atleast": lambda x, v: np.atleast_1d(x) + np.atleast_2d(v),
    "loop": _loop,
    "horner": _horner,
    "build": _build,
    "gaussian": _gaussian,
    "runge kutta": _runge_kutta,
    "lists": lambda x, y: [1.0, 2.0] * np.stack([x, y]),
    "number types": lambda x: np.float64(2.0) * x + np.int64(3) - np.array(1.0) / (x * x + 1),
    "reflected": lambda x: 2.0 / (3.0 + x * x) - 2.0**x + 1.0 % (x * x + 0.3),
    "comparisons": lambda x, y: 1.0 * (x < y) + 2.0 * (x >= y) + (x != y) + 3.0 * (x > 0.5),
    "conditions": lambda x, y: np.where(((x > 0) & ~(y > 0)) | (x > 1), x, y),
    "logical": lambda v, w: np.where(np.logical_or(v > 0, np.logical_not(w > 0)), v, w),
    "sum of conditions": lambda v: np.sum(v > 0) + np.mean(v < 1),
    "unary": lambda x: +x - abs(x) + np.abs(-x) + np.sign(x) + np.floor(x) + np.ceil(x),
    "floor division": lambda x: x // 0.7 + x % 0.7 + math.floor(x) + math.ceil(x),
    "powers": lambda x: x**2 + x**3 + (x * x) ** 0.5 + (x * x + 1) ** -1 + np.square(x) + x**0,
    "logs": lambda x: np.log2(x * x) + np.log10(x * x + 1) + np.exp2(x) + np.cbrt(x),
    "angles": lambda x, y: np.hypot(x, y) + np.deg2rad(x) + np.degrees(y) + np.radians(x),
    "special": lambda x: sp.expit(x) + sp.logit(sp.expit(x)) + sp.gammaln(x * x + 1) + sp.ndtr(x),
    "xlogy": lambda x: sp.xlogy(0.0, x) + sp.xlogy(x, x * x) + sp.xlog1py(x, x * x),
    "reciprocal": lambda x: np.reciprocal(x * x + 1) + np.heaviside(x, 0.5),
    "logaddexp": lambda x, y: np.logaddexp(x, y) + np.arctan2(x, y),
    "add.reduce": lambda v: np.add.reduce(v) + np.add.accumulate(v),
    "shape": lambda A, v: np.shape(A)[0] * len(v) * A.ndim * v.size + v,
}  # fmt: skip


@pytest.mark.parametrize("name", CODE)
def test_numpy_code_means_the_same_on_symbols(name):
    function = CODE[name]
    wanted = function.__code__.co_varnames[: function.__code__.co_argcount]
    names = symbols()
    made = function(*(names[n] for n in wanted))
    for seed in range(3):
        values = numbers(seed)
        expected = np.asarray(function(*(values[n] for n in wanted)), dtype=float)
        at = {}
        for n in NAMES:
            for i in np.ndindex(NAMES[n]):
                at[symbol("state", n, i)] = np.asarray(values[n])[i]
        found = evaluate(array(made), at)
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


SPECIAL = [-np.inf, -7.3, -1.0, -0.0, 0.0, 0.3, 1.0, 3.0, 6.0, 2.0**52 + 1.0, np.nan]
AT_SPECIAL = {
    "whole divisors": lambda x: x // 2 + x // -3,
    "other divisors": lambda x: x // 0.1 + x // -0.3,
    "a divisor of symbols": lambda x: x // (x * 0.1) + 1.0 // x,
    "an array": lambda x: x // np.array([0.1, 0.2]),
    "of numbers": lambda x: np.array([0.6, 0.7]) // (x * x + 0.1),
    "fmax": lambda x: np.fmax(np.sqrt(x), 0.5) + np.fmax(0.5, np.sqrt(-x)),
    "fmin": lambda x: np.fmin(np.sqrt(x), 0.5) + np.fmin(np.nan, x),
    "steps": lambda x: np.heaviside(x, 0.5),
}


@pytest.mark.parametrize("name", AT_SPECIAL)
@pytest.mark.parametrize("value", SPECIAL)
def test_special_values_are_numpys(name, value):
    function, x = AT_SPECIAL[name], symbol("state", "x")
    with np.errstate(all="ignore"):
        expected = function(np.float64(value))
    found = evaluate(array(function(x)), {x: value})
    np.testing.assert_allclose(found, expected, rtol=1e-15, atol=0.0)


@settings(max_examples=60, deadline=None)
@given(
    some.lists(some.integers(1, 3), min_size=0, max_size=3),
    some.lists(some.booleans(), min_size=3, max_size=3),
    some.sampled_from([np.add, np.multiply, np.subtract, np.maximum]),
    some.integers(0, 1000),
)
def test_broadcasting(shape, ones, operation, seed):
    other = [1 if one else n for n, one in zip(shape, ones, strict=False)]
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-1, 1, shape), rng.uniform(-1, 1, other)
    at = {}

    def lift(name, values):
        out = np.empty(values.shape, dtype=object)
        for i in np.ndindex(values.shape):
            out[i] = symbol("state", name, i)
            at[out[i]] = values[i]
        return array(out)

    made = operation(lift("a", a), lift("b", b))
    np.testing.assert_allclose(evaluate(array(made), at), operation(a, b), rtol=1e-14)
    half_numbers = operation(a, lift("b", b))
    np.testing.assert_allclose(evaluate(array(half_numbers), at), operation(a, b), rtol=1e-14)


def test_types_of_results():
    s = symbols()
    assert isinstance(s["v"][0], Expr)
    assert isinstance(s["v"] + 1, ExprArray)
    assert isinstance(np.sum(s["v"]), Expr)
    assert isinstance(C @ s["v"], ExprArray)
    assert isinstance(np.where(s["x"] > 0, 1.0, 2.0), Expr)
    assert isinstance(np.stack([s["x"], s["y"]]), ExprArray)
    assert s["x"].shape == ()
    assert s["x"].T is s["x"]


def test_an_out_of_range_symbol_takes_the_last():
    v = symbols()["v"]
    at = {symbol("state", "v", (i,)): float(i) for i in range(3)}
    picked = v[symbol("state", "k")]
    assert evaluate(picked, {**at, symbol("state", "k"): 7.0}) == 2.0  # laws refuse it


@pytest.mark.parametrize(
    "bitwise",
    [lambda k: k & 1, lambda k: 1 | k, lambda k: ~k, lambda k: np.bitwise_and(k, 2),
     lambda k: np.stack([k, k]) | 1, lambda k: (k > 2) & k, lambda k: np.invert(np.stack([k]))],
)  # fmt: skip
def test_bits_of_numbers_are_refused(bitwise):
    with pytest.raises(UnsupportedOperation, match="it is bitwise in NumPy") as caught:
        bitwise(symbol("state", "k"))
    assert "k % 2" in caught.value.fix


def test_conditions_may_be_true_and_false_themselves():
    k = symbol("state", "k")
    assert ((k > 2) & True) is ((k > 2) & np.bool_(True))
    assert evaluate(np.where(~(k > 2) | np.where(k > 5, True, False), 1.0, 0.0), {k: 7.0}) == 1.0
    assert evaluate(np.where(np.logical_and(k, 1), 1.0, 0.0), {k: 2.0}) == 1.0


ADVICE = [
    (lambda v, m: v.any(), "np.any", "conditions joined by |"),
    (lambda v, m: v.all(), "np.all", "conditions joined by &"),
    (lambda v, m: v.cumprod(), "np.cumprod", "np.cumsum(np.log(x))"),
    (lambda v, m: v.round(1), "np.round", "np.floor(x + 0.5), which takes halves up"),
    (lambda v, m: np.linalg.outer(v, v), "np.linalg.outer", "write np.outer"),
    (lambda v, m: np.linalg.matrix_power(m, 2), "np.linalg.matrix_power", "@ssm.primitive"),
]


@pytest.mark.parametrize(("call", "name", "fix"), ADVICE)
def test_what_symbols_do_not_have_is_named_as_it_was_written(call, name, fix):
    v = symbols()["v"]
    with pytest.raises(UnsupportedOperation) as caught:
        call(v, np.stack([v, v]))
    assert caught.value.found.startswith(f"{name} has no meaning")
    assert fix in caught.value.fix


@pytest.mark.parametrize("x", [-3.0, 0.5, 27.0, 200.0])
def test_the_advice_for_erfcx_is_erfcx(x):
    found = eval(UNSUPPORTED["erfcx"], {"np": np, "scipy": scipy, "x": x})
    np.testing.assert_allclose(found, sp.erfcx(x), rtol=1e-9)
