"""NumPy's functions with their keywords: a traced call equals NumPy's on numbers, or is refused."""

import inspect
import itertools

import numpy as np
import pytest

from ssmppl.errors import UnsupportedOperation
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.expressions.numpy_protocols import _COMPOSED, _UFUNCS, FUNCTIONS, STRUCTURAL

RNG = np.random.default_rng(7)
NUMBERS = {
    "x": np.array(0.7), "v": RNG.uniform(0.2, 2, 3), "w": RNG.uniform(0.2, 2, 3),
    "A": RNG.uniform(0.2, 2, (3, 3)), "B": RNG.uniform(0.2, 2, (2, 3)),
    "T": RNG.uniform(0.2, 2, (2, 3, 2)), "S": np.diag([3.0, 2.0, 4.0]) + 0.3,
}  # fmt: skip
AT = {
    symbol("state", n, i): float(a[i]) for n, a in NUMBERS.items() for i in np.ndindex(a.shape)
}  # fmt: skip
# What NumPy says where numbers have no answer, or where the call has no place for what it can only
# mean.
HARMLESS = (
    "No loop matching",  # comparisons with dtype=float
    "out of bounds for array of dimension 0",
    "positive definite",
    "missing 1 required positional argument: 'a_m",
    "unexpected keyword argument 'correction'",  # of the methods
)
OUT = object()  # stands for an array that the result would be written to


def _lifted(name):
    out = np.empty(NUMBERS[name].shape, dtype=object)
    for i in np.ndindex(out.shape):
        out[i] = symbol("state", name, i)
    return array(out) if out.ndim else out[()]


SYMBOLS = {n: _lifted(n) for n in NUMBERS}


def _value(found):
    """What it comes to at the numbers; a list of such where it is one."""
    if isinstance(found, (list, tuple)):
        return [_value(f) for f in found]
    if isinstance(found, (Expr, ExprArray)):
        return evaluate(array(found), AT)
    return found


def _with(names, value):
    if isinstance(value, str) and value in names:
        return names[value]
    return [_with(names, v) for v in value] if isinstance(value, list) else value


def compare(call, label):
    """Whether the traced call was made; it is then NumPy's."""
    try:
        found = call(SYMBOLS)
    except (UnsupportedOperation, TypeError, ValueError, IndexError):
        return False
    try:
        with np.errstate(all="ignore"):
            expected = call(NUMBERS)
    except (ArithmeticError, TypeError, ValueError, IndexError) as error:
        if any(text in str(error) for text in HARMLESS):
            return False
        raise AssertionError(f"{label}: traced, where NumPy has {error!r}") from error
    found = _value(found)
    if not isinstance(expected, (list, tuple)):
        found, expected = [found], [expected]
    assert len(found) == len(expected), label
    for f, e in zip(found, expected, strict=True):
        f, e = np.asarray(f, dtype=float), np.asarray(e, dtype=float)
        assert f.shape == e.shape, (label, f.shape, e.shape)
        np.testing.assert_allclose(f, e, rtol=1e-12, atol=1e-12, err_msg=label)
    return True


KEYWORDS = {
    "axis": [None, 0, 1, -1, 2, 7, (0, 1), (0, 2), ()],
    "dtype": [None, float, int, bool, "f4", np.float64],
    "out": [None, OUT],
    "keepdims": [False, True],
    "initial": [0.0, 5.0, -3.0, "x"],
    "where": [True, False, np.array([True, False, True]), np.array([1.0, 0.0, 1.0]),
              np.array([[True], [False]]), np.array([[True, False, True], [False, True, True]])],
    "ddof": [0, 1, 0.5, 3],
    "correction": [0, 1],
    "mean": [1.0],
    "offset": [0, 1, -1, 5],
    "axis1": [0, 1, 2], "axis2": [1, 0, 2],
    "mode": ["raise", "wrap", "clip"],
    "n": [1, 2, 0],
    "prepend": [0.0, "x"], "append": [1.0, "x"],
    "shape": [None, (2, 2), 4],
    "order": ["C", "F", "K"], "subok": [True, False],
    "ord": [None, 1, 2, np.inf, "fro", "nuc", -1],
    "upper": [False, True],
    "casting": ["same_kind", "unsafe", "no"],
    "optimize": [True, "greedy"],
    "min": [None, 0.5, "x"], "max": [None, 1.0, "x"], "a_min": [None, 0.5], "a_max": [None, 1.0],
    "axes": [None, (1, 0)], "k": [0, 1, -1], "shift": [1],
}  # fmt: skip
REDUCTIONS = ("x", "v", "A", "B", "T")
CALLS = {
    **{f: [(n,) for n in REDUCTIONS] for f in (
        np.sum, np.prod, np.max, np.min, np.mean, np.var, np.std, np.cumsum, np.trace, np.size,
        np.shape, np.ndim, np.diff, np.zeros_like, np.ones_like,
    )},
    np.where: [(np.array([True, False, True]), "v", "w"), (np.array([True]),)],
    np.dot: [*itertools.product("xvABT", "xvAT")],
    np.inner: [*itertools.product("xvABT", "xvABT")],
    np.vdot: [*itertools.product("xvABT", "xvABT")],
    np.outer: [*itertools.product("xvA", "xvA")],
    np.kron: [("A", "v"), ("A", "B"), ("x", "v")],
    np.einsum: [("ij,j->i", "A", "v"), ("ii", "A"), ("A", [0, 1], "v", [1], [0])],
    np.clip: [("v", 0.5, 1.0), ("v",), ("A", None, "v"), ("v", "x")],
    np.take: [("v", [2, 0]), ("A", 1), ("A", [1, 4]), ("v", [-1, 5])],
    np.choose: [(np.array([1, 0, 1]), ["v", "w"]), (np.array([3, 0, 1]), ["v", "w"])],
    np.copyto: [], np.full_like: [("v", 2.0), ("v", "x"), ("A", "v")],
    np.linalg.inv: [("S",)], np.linalg.det: [("S",), ("A",)], np.linalg.slogdet: [("S",)],
    np.linalg.cholesky: [("S",), ("A",)], np.linalg.solve: [("S", "v"), ("S", "A")],
    np.linalg.norm: [(n,) for n in REDUCTIONS],
    np.concatenate: [(["v", "w"],), (["A", "B"],)], np.stack: [(["v", "w"],)],
    np.hstack: [(["v", "w"],)], np.vstack: [(["v", "A"],)], np.column_stack: [(["v", "A"],)],
    np.block: [([["A", "S"], ["S", "A"]],)], np.append: [("v", "w"), ("A", "B")],
    np.reshape: [("A", -1), ("T", (3, 4))], np.ravel: [("A",)], np.transpose: [("A",), ("T",)],
    np.squeeze: [("v",)], np.expand_dims: [("v", 0)], np.moveaxis: [("T", 0, 2)],
    np.swapaxes: [("T", 0, 1)], np.tile: [("v", 2)], np.repeat: [("v", 2)], np.flip: [("T",)],
    np.roll: [("A", 1)], np.split: [("v", 3)], np.array_split: [("v", 2)],
    np.diag: [("v",), ("A",)],
    np.diagonal: [("A",), ("T",)], np.broadcast_to: [("v", (2, 3))],
    np.atleast_1d: [("x",), ("x", "v")], np.atleast_2d: [("v",), ("v", "A")], np.copy: [("v",)],
    np.triu: [("A",)], np.tril: [("A",)], np.delete: [("v", 1)], np.diagflat: [("v",)],
    np.fliplr: [("A",)], np.flipud: [("A",)], np.insert: [("v", 1, "x")],
}  # fmt: skip


def test_every_function_is_tried():
    assert {*FUNCTIONS, *STRUCTURAL} == set(CALLS)
    assert [f for f, calls in CALLS.items() if not calls] == [np.copyto]  # see below


def test_copies():
    """np.full copies, and may be asked to by a mask of numbers."""

    def copied(names, **options):
        out = np.zeros(3, dtype=object)
        np.copyto(out, names["v"], **options)
        return out + 0.0 * names["v"]

    mask = np.array([True, False, True])
    assert compare(lambda names: copied(names), "copyto")
    assert compare(lambda names: copied(names, where=mask, casting="unsafe"), "copyto by a mask")
    assert compare(lambda names: np.full((2, 3), names["v"]) + 0.0 * names["v"], "full")
    with pytest.raises(UnsupportedOperation, match=r"np\.copyto where a symbol decides"):
        copied(SYMBOLS, where=SYMBOLS["v"] > 1.0)


def _takes(function, keyword):
    try:
        return keyword in inspect.signature(function).parameters
    except ValueError:  # no signature before some version of NumPy's
        return True


def _settings(function):
    """No keyword, each alone, each pair."""
    names = [k for k in KEYWORDS if _takes(function, k)]
    yield {}
    for count in (1, 2):
        for chosen in itertools.combinations(names, count):
            for values in itertools.product(*(KEYWORDS[k] for k in chosen)):
                yield dict(zip(chosen, values, strict=True))


@pytest.mark.parametrize("function", [f for f in CALLS if CALLS[f]], ids=lambda f: f.__name__)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_keywords_mean_what_they_mean_to_numpy_or_are_refused(function):
    made = 0
    for arguments in CALLS[function]:
        for options in _settings(function):
            label = f"np.{function.__name__}{arguments} {options}"

            def call(names, arguments=arguments, options=options):
                given = {k: _with(names, v) for k, v in options.items()}
                args = [_with(names, a) for a in arguments]
                if options.get("out") is OUT:
                    given["out"] = np.zeros(np.shape(function(*args)))
                return function(*args, **given)

            made += compare(call, label)
    assert made


METHODS = {
    "sum": np.sum, "prod": np.prod, "mean": np.mean, "var": np.var, "std": np.std, "max": np.max,
    "min": np.min, "trace": np.trace, "cumsum": np.cumsum, "clip": np.clip,
}  # fmt: skip
# Not ours: NumPy's own, of arrays of objects.
OTHER_METHODS = {
    "argmax": [()], "argmin": [()], "argsort": [()], "cumprod": [(), (0,)], "round": [(), (1,)],
    "conj": [()], "any": [()], "all": [()], "repeat": [(2,), (2, 1)], "take": [(1,), ([0, 2], 1)],
    "diagonal": [(), (1,)], "ravel": [()], "flatten": [()], "swapaxes": [(0, 1)], "squeeze": [()],
    "transpose": [()], "reshape": [(9,)], "copy": [()], "nonzero": [()], "astype": [(int,)],
    "searchsorted": [(1.0,)], "compress": [([True, False, True], 0)], "tolist": [()],
    "item": [(2,)], "partition": [(1,)],
}  # fmt: skip


@pytest.mark.parametrize("method", OTHER_METHODS)
def test_methods_of_numpys_own(method):
    for args in OTHER_METHODS[method]:
        try:
            found = getattr(SYMBOLS["A"], method)(*args)
        except (UnsupportedOperation, TypeError, ValueError):
            continue
        expected = getattr(NUMBERS["A"], method)(*args)
        np.testing.assert_allclose(_value(array(found)), expected, rtol=1e-12)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_methods_are_the_functions(method):
    made = 0
    for name in ("v", "A", "T"):
        for options in _settings(METHODS[method]):
            if "out" in options or {"a_min", "a_max"} & set(options):
                continue
            made += compare(
                lambda names, options=options, name=name: getattr(names[name], method)(
                    **{k: _with(names, v) for k, v in options.items()}
                ),
                f"{name}.{method} {options}",
            )
    assert made


@pytest.mark.parametrize(
    "call",
    [
        lambda a: a.var(0, None, None, 1), lambda a: np.var(a, 0, None, None, 1),
        lambda a: a.sum(1, None, None, True), lambda a: np.max(a, 0, None, True, 5.0),
        lambda a: a.max(1, None, True), lambda a: np.diff(a, 2), lambda a: np.trace(a, 1),
        lambda a: a.clip(0.5, 1.0), lambda a: a.clip(max=1.0), lambda a: np.clip(a, max=1.0),
        lambda a: np.add.reduce(a, 1, None, None, True, 5.0), lambda a: a.mean(0, None, None, True),
    ],
)  # fmt: skip
def test_arguments_by_their_place(call):
    assert compare(lambda names: call(names["A"]), "by place")


UFUNCS = sorted({*_UFUNCS, *_COMPOSED, "matmul"})


@pytest.mark.parametrize("name", [n for n in UFUNCS if hasattr(np, n)])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_keywords_of_ufuncs(name):
    ufunc = getattr(np, name)
    bits = name in ("bitwise_and", "bitwise_or", "invert")  # of conditions alone
    places = ("A", "S")[: ufunc.nin]

    def operands(names):
        out = [names[n] for n in places]
        return [a > 1.0 for a in out] if bits else out

    options = [
        {}, {"out": OUT}, {"where": True}, {"where": NUMBERS["A"] > 1}, {"dtype": float},
        {"dtype": "f4"}, {"dtype": int}, {"casting": "no"}, {"order": "F"}, {"axis": 1},
        {"axes": [(1, 0), (0, 1), (0, 1)]}, {"keepdims": True}, {"signature": "f->f"},
    ]  # fmt: skip
    made = 0
    for given in options:

        def call(names, given=given):
            out = {"out": np.zeros((3, 3))} if given.get("out") is OUT else {}
            return ufunc(*operands(names), **{**given, **out})

        made += compare(call, f"{name} {given}")
    assert made
    if ufunc.nin == 2 and ufunc.nout == 1 and ufunc.signature is None:
        for method in ("reduce", "accumulate", "outer"):
            for given in _method_options(method):

                def call(names, method=method, given=given):
                    args = operands(names)[: 2 if method == "outer" else 1]
                    return getattr(ufunc, method)(*args, **given)

                compare(call, f"{name}.{method} {given}")


def _method_options(method):
    if method == "outer":
        return [{}, {"dtype": "f4"}, {"where": NUMBERS["A"] > 1}]
    some = [{}, {"axis": 1}, {"axis": -1}, {"axis": 5}, {"dtype": float}, {"dtype": int}]
    if method == "reduce":
        some += [{"axis": None}, {"axis": (0, 1)}, {"keepdims": True}, {"initial": 5.0},
                 {"initial": 0.0, "where": NUMBERS["A"] > 1},
                 {"where": NUMBERS["A"] > 1}]  # fmt: skip
    return some


def test_masks_may_be_of_symbols():
    for function in (np.sum, np.mean, np.prod, np.var):
        assert compare(lambda n, f=function: f(n["A"], axis=0, where=n["A"] > 1.0), function)
    assert compare(lambda n: np.max(n["A"], initial=0.1, where=n["A"] < 1.0), "max")


def test_refusals_name_the_line_and_the_fix():
    with pytest.raises(UnsupportedOperation, match=r"np\.sum with dtype=int") as caught:
        np.sum(SYMBOLS["v"], dtype=int)
    assert "leave dtype out" in str(caught.value)
    assert "test_keywords.py" in str(caught.value)
    with pytest.raises(UnsupportedOperation, match="mode='wrap'"):
        np.choose(SYMBOLS["x"], [1.0, 2.0], mode="wrap")
    with pytest.raises(UnsupportedOperation, match="axis=5 of an array of 2 dimensions"):
        SYMBOLS["A"].sum(axis=5)
    with pytest.raises(UnsupportedOperation, match="without initial="):
        np.max(SYMBOLS["v"], where=np.array([True, False, True]))
    with pytest.raises(UnsupportedOperation, match=r"np\.add with where="):
        np.add(SYMBOLS["v"], 1.0, where=np.array([True, False, True]))
