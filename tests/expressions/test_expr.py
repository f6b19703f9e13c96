"""Interning, immutability, depth, text, and what is refused with the user's line."""

import copy
import gc
import linecache
import math
import operator
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.special

from ssmppl.errors import UnsupportedOperation
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import gradient
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    Expr,
    apply,
    constant,
    dependent,
    depends_on,
    recording,
    substitute,
    symbol,
    symbols_of,
    to_text,
    topological,
)

X, Y = symbol("state", "x"), symbol("state", "y")
V = array([X, Y, 3.0])


def make():
    return np.exp(-X / 2) * np.where(X > Y, Y**2, np.sin(Y)) + np.sum(V * [1.0, 2.0, 3.0])


def test_the_same_writing_is_the_same_object():
    assert make() is make()
    assert X + Y is X + Y
    assert X + 1 is X + 1.0
    assert X + 0.0 is X
    assert symbol("state", "x") is X
    assert symbol("parameter", "x") is not X
    assert constant(0.0) is not constant(-0.0)
    assert constant(math.nan) is constant(math.nan)


def test_interning_in_threads():
    def build(_):
        return [np.tanh(X * float(k)) + Y / (k + 1.0) for k in range(300)]

    with ThreadPoolExecutor(8) as pool:
        first, *rest = pool.map(build, range(16))
    for other in rest:
        assert all(a is b for a, b in zip(first, other, strict=True))


def test_pickling_and_copying_intern_again():
    e = make()
    assert pickle.loads(pickle.dumps(e)) is e
    assert copy.deepcopy(e) is e
    assert copy.copy(e) is e
    back = pickle.loads(pickle.dumps(V))
    assert all(a is b for a, b in zip(back, V, strict=True))
    node = np.linalg.inv(array([[X, 1.0], [0.5, Y]]))[0, 1]
    assert pickle.loads(pickle.dumps(node)) is node


def test_nodes_are_freed():
    from ssmppl.expressions.node import _interned

    gc.collect()
    before = len(_interned)
    junk = [X * float(k) + 0.123 for k in range(1000)]
    assert len(_interned) > before + 1000
    del junk
    gc.collect()
    assert len(_interned) <= before + 5


def test_immutability():
    for name in ("op", "args", "data", "new"):
        with pytest.raises(AttributeError, match="immutable"):
            setattr(X, name, 1)


def test_hashing_is_by_identity():
    table = {X: 1, Y: 2}
    assert table[X] == 1
    assert table[symbol("state", "y")] == 2
    assert len({X + Y, X + Y, Y + X}) == 2


def test_no_recursion_limit():
    total = X
    for k in range(5000):
        total = total + np.sin(X * (k + 1.0)) / 7.0
    assert sys.getrecursionlimit() < 5000
    found = evaluate(total, {X: 0.3})
    assert found == pytest.approx(0.3 + np.sin(0.3 * np.arange(1, 5001)).sum() / 7.0)
    slope = evaluate(gradient(total, [X])[0], {X: 0.3})
    k = np.arange(1, 5001)
    assert slope == pytest.approx(1 + (k * np.cos(0.3 * k)).sum() / 7.0)
    assert len(repr(total)) > 5000
    assert substitute([total], {X: Y})[0] is not total
    assert symbols_of(total) == {X}


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_deep_graphs_can_be_pickled(clone):
    total = X
    for k in range(5000):
        total = total + Y * (k + 1.0)
    assert clone(total) is total


def test_topological_order():
    e = make()
    order = topological([e])
    place = {n: i for i, n in enumerate(order)}
    assert len(place) == len(order)
    assert all(place[a] < place[n] for n in order for a in n.args)
    assert dependent([e], [Y]) >= {e, Y}
    assert X not in dependent([e], [Y])


def test_dependence_is_what_the_graph_says():
    """By symbols, whose sets are kept at the nodes, and by other nodes; against reaching back."""
    w = symbol("parameter", "w", ())
    inner = np.exp(X) * Y
    total = inner + w * np.sin(inner) + np.cos(w)
    order = topological([total])
    reach: dict = {}
    for n in order:
        reach[n] = {n}.union(*(reach[a] for a in n.args))
    for on in ([X], [w], [X, w], [inner], [inner, w]):
        expected = {n for n in order if reach[n] & set(on)} | set(on)
        assert dependent([total], on) == expected
    for n in order:
        assert symbols_of(n) == {m for m in reach[n] if m.op == "symbol"}
        assert depends_on(n, [w]) == (w in reach[n])
    assert symbols_of([inner, w]) == {X, Y, w}
    assert dependent([total], [symbol("parameter", "elsewhere", ())]) == {
        symbol("parameter", "elsewhere", ())
    }


def test_order_within():
    """The rest keeps its order."""
    e = make()
    inside = dependent([e], [Y])
    assert topological([e], inside) == [n for n in topological([e]) if n in inside]
    assert topological([X], inside) == []


def test_substitution_simplifies():
    assert substitute([X * Y + 1.0], {X: constant(0.0)})[0].data == 1.0
    assert substitute([make()], {X: X})[0] is make()
    inverse = np.linalg.inv(array([[X, 1.0], [0.5, Y]]))
    changed = substitute([inverse[0, 0]], {X: constant(3.0)})[0]
    assert evaluate(changed, {Y: 2.0}) == pytest.approx(2.0 / 5.5)


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (X + Y * 2, "x + 2*y"), ((X + Y) * 2, "2*(x + y)"), (X - (Y - 1), "x - (y - 1)"),
        (X / (Y / 3), "x/(y/3)"), ((-X) ** 2, "(-x)**2"), (-(X**2), "-x**2"),
        ((X**2) ** Y, "(x**2)**y"), (np.exp(-X), "exp(-x)"), (X % 2, "x%2"),
        (symbol("state_prev", "x", (1,)), "x_prev[1]"), (-(X + Y), "-(x + y)"),
        ((X + 1) ** -2.0, "(x + 1)**(-2)"), ((X > 0) == (Y > 0), "(0 < x) == (0 < y)"),
    ],
)  # fmt: skip
def test_text(expression, text):
    assert repr(expression) == text


def test_places_are_recorded():
    with recording() as places:
        e = np.tanh(X * 12345.0)
    where = places[e]
    assert where.file == __file__
    assert "np.tanh(X * 12345.0)" in where.text


# -- refusals


def _if():
    return 1 if X > 0 else 2


def _and():
    return (X > 0) and (Y > 0)


def _chain():
    return 0 < X < 1


def _float():
    return float(X)


def _math():
    return math.exp(X)


def _fft():
    return np.fft.fft(V)


def _in_place():
    total = np.zeros(3)
    total += V
    return total


def _assign():
    total = np.zeros(3)
    total[0] = X
    return total


def _out():
    return np.exp(X, out=np.zeros(()))


def _where_keyword():
    return np.add(V, 1.0, where=[True, False, True])


def _min():
    return min(X, Y)


def _range():
    return [k for k in range(X)]  # noqa: C416


def _int():
    return int(X)


def _as_floats():
    return np.asarray(V, dtype=float)


def _astype():
    return V.astype(float)


def _one_argument_where():
    return np.where(V > 0)


def _sort():
    return np.sort(V)


def _slice():
    return V[:X]


def _take_from_numbers():
    return np.take(np.arange(3.0), X)


def _compare_object_array():
    return np.array([X, Y]) > 0


def _maximum_of_an_object_array():
    return np.maximum(np.array([X, Y]), 0.0)


def _choose_from_nothing():
    return np.choose(X, [])


def _wrong_shapes():
    return V @ array(np.eye(2))


def _not_square():
    return np.linalg.inv(array([[X, Y]]))


def _unknown_ufunc():
    return np.spacing(X)


def _scipy_function():
    return scipy.special.logsumexp(V)


def _while():
    k = 0
    while k < X:
        k += 1
    return k


REFUSED = {
    _if: "np.where", _and: "&", _chain: "&", _float: "np.exp", _math: "np.exp",
    _fft: "@ssm.primitive", _in_place: "a + b", _assign: "np.stack", _out: "a + b",
    _where_keyword: "np.where(", _min: "np.minimum", _range: "np.choose", _int: "np.floor(x)",
    _as_floats: "np.stack", _astype: "np.stack", _one_argument_where: "both branches",
    _sort: "np.minimum and np.maximum", _slice: "np.choose", _take_from_numbers: "np.choose",
    _compare_object_array: "np.stack",
    _maximum_of_an_object_array: "np.stack", _choose_from_nothing: "one element",
    _wrong_shapes: "dimensions agree",
    _not_square: "one square matrix", _unknown_ufunc: "@ssm.primitive",
    _scipy_function: "NumPy's function", _while: "np.where",
}  # fmt: skip


@pytest.mark.parametrize("function", REFUSED, ids=lambda f: f.__name__)
def test_refusals_name_the_users_line_and_the_fix(function):
    with pytest.raises(UnsupportedOperation) as caught:
        function()
    error = caught.value
    assert error.where.file == __file__
    first = function.__code__.co_firstlineno
    lines = range(first, first + 8)
    assert error.where.line in lines
    assert error.where.function in (function.__name__, "<listcomp>")
    assert error.where.text == linecache.getline(__file__, error.where.line).strip()
    assert REFUSED[function] in error.fix
    assert str(error.where) in str(error)
    assert "Fix: " in str(error)


@pytest.mark.parametrize("other", ["a", None, 1j, object()])
@pytest.mark.parametrize("op", [operator.add, operator.mul, operator.lt])
def test_operands_without_meaning(op, other):
    with pytest.raises(TypeError):
        op(X, other)


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_a_number_is_compared_with_each_of_a_list(kind):
    numbers = kind([0, 1, 2])
    # a list has no comparison of its own with a symbol: this is the symbol's
    assert [repr(e) for e in numbers == X] == ["0 == x", "1 == x", "2 == x"]
    assert [repr(e) for e in numbers != X] == ["0 != x", "1 != x", "2 != x"]


def test_errors_survive_pickling():
    with pytest.raises(UnsupportedOperation) as caught:
        bool(X > 0)
    back = pickle.loads(pickle.dumps(caught.value))
    assert type(back) is UnsupportedOperation
    assert str(back) == str(caught.value)


def test_nodes_have_no_attributes_to_set_or_find():
    assert isinstance(X, Expr)
    with pytest.raises(AttributeError):
        X.nothing  # noqa: B018


def test_text_of_an_expression_that_shares_its_parts_is_cut():
    """Written out, these would have some 2^80 characters."""

    def nested(inmost, deep):
        e = inmost
        for _ in range(deep):
            e = apply("sin", e) + apply("cos", e)
        return e

    x, y = symbol("state", "x"), symbol("state", "y")
    assert to_text(nested(x, 1)) == "sin(x) + cos(x)"
    texts = [to_text(nested(start, deep)) for start in (x, y) for deep in (79, 80)]
    assert len(set(texts)) == 4
    tails = [to_text(nested(x, 80) * apply("tanh", end)) for end in (x, y)]
    assert tails[0] != tails[1], "though they begin alike as far as they are written"
    assert max(map(len, texts)) < 11_000
    assert to_text(nested(x, 80), longest=50).startswith("sin(sin(sin(")


def test_what_was_measured_is_told_from_the_measurement():
    """`1 - y[0]` stood in reasons for what is 1 where y[0] is missing."""
    assert to_text(symbol("seen", "y", (0,))) == "measured(y[0])"
    assert to_text(symbol("observation", "y", (0,))) == "y[0]"
