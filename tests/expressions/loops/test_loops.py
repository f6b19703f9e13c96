"""Loops against the same steps written out: values, derivatives, text, enclosures."""

import pickle

import numpy as np
import pytest
from scipy import linalg

import ssmppl as ssm
from ssmppl.analysis.bounds import interval
from ssmppl.analysis.lambdify import python_function
from ssmppl.errors import NotApplicable
from ssmppl.expressions.algebra import separate
from ssmppl.expressions.calculus import (
    differentiate,
    gradient,
    hessian,
    jumps,
    reverse_gradient,
)
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    Expr,
    as_expr,
    constant,
    substitute,
    symbol,
    symbols_of,
    topological,
)
from ssmppl.expressions.loops.affine import affine_form, exponential, scaling_of_exponentials
from ssmppl.expressions.loops.loop import fresh, repeated
from ssmppl.expressions.zero import cancels

X, V = symbol("state_prev", "x"), symbol("state_prev", "v")
A, B = symbol("parameter", "a"), symbol("parameter", "b")
SYMBOLS = [X, V, A, B]
AT = {X: 0.4, V: -0.3, A: 1.3, B: 0.2}


def step(x, v):
    force = -A * np.sin(x) - B * v * np.abs(v) + np.where(x > 0.2, 0.3, 0.1 * x)
    return {"x": x + 0.1 * v, "v": v + 0.1 * force}


def written_out(times):
    x, v = X, V
    for _ in range(times):
        new = step(x, v)
        x, v = new["x"], new["v"]
    return [x, v]


def as_loop(times):
    new = ssm.repeat(step, {"x": X, "v": V}, times)
    return [new["x"], new["v"]]


def loops(roots):
    return [n for n in topological(list(roots)) if n.op == "loop"]


@pytest.mark.parametrize("times", [0, 1, 2, 9])
def test_values_and_derivatives_are_those_of_the_steps_written_out(times):
    here, there = as_loop(times), written_out(times)
    assert len(loops(here)) == (times > 1)
    values = {s: np.array([v, 1.2 * v, -v]) for s, v in AT.items()}
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(evaluate(a, values), evaluate(b, values), rtol=1e-13)
        total = [e * e + np.exp(e) for e in (a, b)]
        first, expected = (np.array(evaluate(gradient(e, SYMBOLS), AT)) for e in total)
        np.testing.assert_allclose(first, expected, rtol=1e-11, atol=1e-13)
        back = evaluate(reverse_gradient(total[0], SYMBOLS), AT)
        np.testing.assert_allclose(back, expected, rtol=1e-11, atol=1e-13)
        second, expected = (evaluate(hessian(e, SYMBOLS), AT) for e in total)
        np.testing.assert_allclose(second, expected, rtol=1e-10, atol=1e-12)


def test_third_derivatives():
    total = [sum(es) ** 2 for es in (as_loop(4), written_out(4))]
    found = []
    for e in total:
        (one,) = differentiate(gradient(e, [X]), A)
        found.append(np.array(evaluate(reverse_gradient(one, SYMBOLS), AT)))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-12)


def test_the_graph_does_not_grow_with_the_steps():
    sizes = set()
    for times in (2, 50, 1000):
        roots = [*as_loop(times), *gradient(as_loop(times)[0], SYMBOLS)]
        sizes.add((len(topological(roots)), *(n.data.states for n in loops(roots))))
    assert len(sizes) == 1


def test_what_does_not_change_leaves_the_loop_and_what_is_alike_is_one():
    s = fresh(5)
    update = [s[0] + A * s[1], s[1], s[2] + s[1] * A, 0.0 * s[0] + 2.0, s[4] * s[3]]
    first = [X, V, X, constant(2.0), V]
    values = repeated("made", s, first, update, 6)
    (node,) = loops(values)
    assert node.data.states == 2  # the first and the third are one, and the last
    assert values[1] is V
    assert values[3] is constant(2.0)
    assert values[0] is values[2]
    found = evaluate(values, AT)
    np.testing.assert_allclose(
        found, [0.4 - 6 * 1.3 * 0.3, -0.3, 0.4 - 6 * 1.3 * 0.3, 2.0, -0.3 * 64]
    )


def test_what_begins_alike_and_parts_later_is_two():
    s = fresh(3)
    values = repeated("made", s, [X, X, constant(0.0)], [s[0] + s[2], s[1], s[2] + 1.0], 4)
    np.testing.assert_allclose(evaluate(values, AT), [0.4 + 0 + 1 + 2 + 3, 0.4, 4.0])


def test_loops_of_numbers_are_numbers_and_substitution_reaches_the_arguments():
    number = ssm.repeat(lambda x: 0.5 * x * x + 1.0, 0.3, 5)
    x = 0.3
    for _ in range(5):
        x = 0.5 * x * x + 1.0
    assert isinstance(number, float)
    assert number == pytest.approx(x, rel=1e-15)
    moved = substitute(as_loop(5), {X: 2.0 * V})
    np.testing.assert_allclose(
        evaluate(moved, AT), evaluate(written_out(5), AT | {X: -0.6}), rtol=1e-13
    )
    assert X not in symbols_of(moved)


def test_loops_within_loops():
    def outer(x):
        return ssm.repeat(lambda y: y - 0.1 * np.sin(A * y) + 0.01 * x, 0.5 * x, 3)

    found = ssm.repeat(outer, X, 4)
    x = X
    for _ in range(4):
        y = 0.5 * x
        for _ in range(3):
            y = y - 0.1 * np.sin(A * y) + 0.01 * x
        x = y
    for e, expected in [(found, x), (gradient(found, [A])[0], gradient(x, [A])[0])]:
        np.testing.assert_allclose(evaluate(e, AT), evaluate(expected, AT), rtol=1e-12)
    found, expected = (hessian(e, [X, A]) for e in (found, x))
    np.testing.assert_allclose(evaluate(found, AT), evaluate(expected, AT), rtol=1e-10)


def test_equal_loops_are_one_node_and_survive_pickling():
    assert as_loop(7)[0] is as_loop(7)[0]
    assert as_loop(7)[0] is not as_loop(8)[0]
    node = as_loop(7)[1]
    assert pickle.loads(pickle.dumps(node)) is node
    assert repr(as_loop(7)[0]) != repr(as_loop(8)[0])
    assert "step_" in repr(node)


def test_plain_python_and_enclosures():
    for times in (3, 20):
        run = python_function(as_loop(times), SYMBOLS)
        expected = evaluate(as_loop(times), AT)
        np.testing.assert_allclose(run([AT[s] for s in SYMBOLS]), expected, rtol=1e-13)
    rng = np.random.default_rng(1)
    box = {X: (0.1, 0.3), V: (-0.2, 0.2), A: (1.0, 1.1), B: (0.0, 0.1)}
    values = {s: rng.uniform(*ends, 200) for s, ends in box.items()}
    for e in as_loop(5):
        low, high = interval(e, box)
        found = evaluate(e, values)
        assert low <= found.min()
        assert found.max() <= high
        assert high - low < 2.0
    assert interval(as_loop(100)[0], box) == (-np.inf, np.inf)


def test_sums_of_loops_are_zero_only_where_they_are():
    x, v = as_loop(5)
    assert cancels([x, v, -x, -v])
    assert not cancels([x, -v])
    assert not cancels([x, -as_loop(6)[0]])


# -- linear ones
def test_linear_steps_are_linear_in_state_and_added():
    def one(x, v):
        return {"x": 0.9 * x + 0.1 * v + B, "v": A * v - 0.2 * x}

    new = ssm.repeat(one, {"x": X, "v": V}, 12)
    x, v = X, V
    for _ in range(12):
        x, v = one(x, v).values()
    for found, expected in ((new["x"], x), (new["v"], v)):
        assert affine_form([found], [X, V, B]) is not None
        assert affine_form([found], [X, A]) is None
        np.testing.assert_allclose(evaluate(found, AT), evaluate(expected, AT), rtol=1e-13)
        here, there = (evaluate(gradient(e, SYMBOLS), AT) for e in (found, expected))
        np.testing.assert_allclose(here, there, rtol=1e-11)


def test_steps_that_jump_are_not_linear():
    x = ssm.repeat(lambda x: x + np.where(x > 0.0, 0.1, -0.1), X, 4)
    assert affine_form([x], [X]) is None
    np.testing.assert_allclose(evaluate(x, {X: np.array([-0.2, 0.3])}), [-0.6, 0.7])


@pytest.mark.parametrize("size", [1, 2, 4])
@pytest.mark.parametrize("scale", [1e-8, 0.3, 5.0, 80.0])
def test_the_exponential_of_a_matrix(size, scale):
    numbers = scale * np.random.default_rng(size).normal(size=(size, size)) / size
    entries = np.array(
        [[symbol("parameter", "m", (i, j)) for j in range(size)] for i in range(size)]
    )
    values = dict(zip(entries.ravel(), numbers.ravel(), strict=True))
    found = evaluate(ssm.expm(entries), values)
    expected = linalg.expm(numbers)
    size_of = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * size_of * (1 + scale))
    np.testing.assert_allclose(ssm.expm(numbers), expected, rtol=1e-15)
    direction = np.zeros((size, size))
    direction[0, size - 1] = 1.0
    slope = differentiate(list(ssm.expm(entries).ravel()), entries[0, size - 1])
    exact = linalg.expm_frechet(numbers, direction, compute_expm=False)
    size_of = np.abs(exact).max()
    np.testing.assert_allclose(
        np.array(evaluate(slope, values)).reshape(size, size), exact, rtol=0,
        atol=1e-11 * size_of * (1 + scale),
    )  # fmt: skip


def test_the_number_of_times_may_be_a_symbol():
    (x,) = fresh(1)
    k = symbol("input", "k")
    (found,) = repeated("made", [x], [X], [x * A + 1.0], as_expr(k))
    values = AT | {k: np.array([0.0, 3.0, -1.0, np.nan, 1.0])}
    expected = [0.4]
    for _ in range(3):
        expected.append(1.3 * expected[-1] + 1.0)
    np.testing.assert_allclose(
        evaluate(found, values), [0.4, expected[3], 0.4, 0.4, expected[1]], rtol=1e-14
    )
    assert isinstance(found, Expr)


def test_two_functions_of_one_name_are_two():
    def made(factor):
        @ssm.primitive
        def push(x):
            return factor * x

        return push

    first, second = made(2.0), made(3.0)
    s = fresh(2)
    values = repeated("made", s, [X, X], [first(s[0]), second(s[1])], 3)
    np.testing.assert_allclose(evaluate(values, AT), [0.4 * 8, 0.4 * 27])


def test_a_loop_of_the_block_alone_is_one_of_its_functions():
    end = ssm.integrate(lambda x: -(x**3), X, 0.5, steps=3)
    found = separate(A * end + B, [X])
    assert not isinstance(found, NotApplicable)
    assert evaluate(found.assemble(), AT) == pytest.approx(evaluate(A * end + B, AT), rel=1e-15)
    mixed = ssm.integrate(lambda x: -A * x**3, X, 0.5, steps=3)
    assert isinstance(separate(mixed, [X]), NotApplicable)


def test_what_scales_an_exponential_is_told_from_other_steps():
    """Halvings jump in the matrix; the exponential does not, and a floor beside it does."""
    a = symbol("parameter", "a")
    matrix = np.array([[-a, 1.0], [a, -2.0]], dtype=object)
    ends = list(exponential(matrix).ravel())
    smooth = scaling_of_exponentials(ends)
    jumping = [n for n in topological(ends) if jumps(n)]
    assert jumping
    assert set(jumping) <= smooth
    other = np.floor(3.0 * a)
    assert other not in scaling_of_exponentials([ends[0] + other])
