"""Separable, polynomial, affine and quadratic forms: they reassemble, however they are spelled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from ssmppl.errors import NotApplicable
from ssmppl.expressions import algebra
from ssmppl.expressions.algebra import Separation, affine, polynomial, quadratic, separate
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import apply, constant, symbol, symbols_of
from ssmppl.expressions.zero import cancels

PHI, TAU, V = (symbol("parameter", n) for n in ("phi", "tau", "v"))
X, Y, U = symbol("state_prev", "x"), symbol("state", "y"), symbol("input", "u")
BLOCK = [PHI, TAU]
ALL = [PHI, TAU, V, X, Y, U]


def values(seed, n=5):
    rng = np.random.default_rng(seed)
    return {s: rng.uniform(0.3, 1.7, n) for s in ALL}


def reassembles(expression, form, block, seed=0):
    at = values(seed)
    wanted = evaluate(expression, at)
    found = evaluate(form.assemble(), at)
    size = sum((np.abs(evaluate(f * c, at)) for f, c in form.items()), np.ones(5))
    wanted, found, size = (np.broadcast_to(a, 5) for a in (wanted, found, size))
    good = np.isfinite(wanted) & np.isfinite(found)
    np.testing.assert_array_less(
        np.abs(found - wanted)[good], 1e-9 * np.broadcast_to(size, 5)[good]
    )
    assert np.array_equal(np.isfinite(np.broadcast_to(wanted, 5)),
                          np.isfinite(np.broadcast_to(found, 5)))  # fmt: skip
    block = set(block)
    for function, coefficient in form.items():
        assert symbols_of(function) <= block
        assert not symbols_of(coefficient) & block


# Random expressions out of what log densities are made of, positive where they must be.
leaves = some.sampled_from([PHI, TAU, V, X, Y, U, constant(2.0), constant(0.5)])


def extend(children):
    two = some.tuples(children, children)
    return some.one_of(
        two.map(lambda p: p[0] + p[1]),
        two.map(lambda p: p[0] * p[1]),
        two.map(lambda p: p[0] - p[1]),
        some.tuples(children, leaves).map(lambda p: p[0] / p[1]),
        children.map(lambda e: -e),
        children.map(lambda e: e**2),
        some.tuples(leaves, leaves).map(lambda p: np.sqrt(p[0] * p[1])),
        some.tuples(leaves, leaves).map(lambda p: np.log(p[0] * p[1])),
        some.tuples(leaves, leaves).map(lambda p: np.log(p[0] / p[1])),
        leaves.map(lambda e: np.exp(-e)),
        leaves.map(lambda e: np.log(1.0 + e)),
        some.tuples(leaves, children).map(lambda p: np.where(X > Y, p[0], p[1])),
        leaves.map(lambda e: np.sin(e)),
        leaves.map(lambda e: apply("gammaln", e)),
    )


expressions = some.recursive(leaves, extend, max_leaves=7)


@settings(max_examples=250, deadline=None)
@given(expressions, some.sampled_from([[PHI], [PHI, TAU], [V, PHI, TAU]]), some.integers(0, 99))
def test_separate_reassembles(expression, block, seed):
    form = separate(expression, block)
    if isinstance(form, Separation):
        reassembles(expression, form, block, seed)
    else:
        assert isinstance(form, NotApplicable)
        assert not form
        assert "does not separate in" in form.reason or "terms when multiplied out" in form.reason


@settings(max_examples=150, deadline=None)
@given(expressions, some.integers(0, 99))
def test_polynomials_reassemble(expression, seed):
    block = [PHI, TAU]
    at = values(seed)
    wanted = np.broadcast_to(evaluate(expression, at), 5)
    form = polynomial(expression, block, 3)
    if isinstance(form, NotApplicable):
        assert form.reason
        return
    total, size = np.zeros(5), np.ones(5)
    for key, c in form.items():
        term = evaluate(c, at)
        for s in key:
            term = term * at[s]
        total, size = total + term, size + np.abs(term)
    np.testing.assert_array_less(np.abs(total - wanted), 1e-9 * size)
    if max(map(len, form), default=0) <= 1:
        a, b = affine([expression], block)
        rebuilt = evaluate(a[0, 0], at) * at[PHI] + evaluate(a[0, 1], at) * at[TAU]
        np.testing.assert_array_less(np.abs(rebuilt + evaluate(b[0], at) - wanted), 1e-9 * size)
    if max(map(len, form), default=0) <= 2:
        h, g, c = quadratic(expression, block)
        t = np.array([at[PHI], at[TAU]])
        hessian = np.array([[np.broadcast_to(evaluate(e, at), 5) for e in row] for row in h])
        slope = np.array([np.broadcast_to(evaluate(e, at), 5) for e in g])
        rebuilt = -0.5 * np.einsum("in,ijn,jn->n", t, hessian, t) + (slope * t).sum(0)
        np.testing.assert_array_less(np.abs(rebuilt + evaluate(c, at) - wanted), 1e-9 * size)
        assert h[0, 1] is h[1, 0]


def sum_in_a_loop():
    total = 0.0
    for c in (X, Y, U):
        total = total + PHI * c
    return total


A = array([[PHI, 1.0], [0.0, TAU]])
# Each list: one function of (phi, tau) spelled in several ways.
SPELLINGS = {
    "affine": [PHI * X + Y, Y + X * PHI, (2 * Y + 2 * X * PHI) / 2, Y - (-X) * PHI,
               X * (PHI + Y / X), (PHI + Y / X) / (1 / X), PHI * X + Y + PHI - PHI],
    "half": [X - 0.5 * X * PHI, X * (1 - PHI / 2), X * (2 - PHI) / 2, X - PHI * X / 2],
    "sum": [sum_in_a_loop(), PHI * (X + Y + U), np.sum(PHI * np.stack([X, Y, U])),
            np.dot([PHI, PHI, PHI], np.stack([X, Y, U]))],
    "matrix": [(A @ np.stack([X, Y]))[0], PHI * X + Y, np.dot(A, np.stack([X, Y]))[0],
               np.einsum("ij,j->i", A, np.stack([X, Y]))[0]],
    "square": [TAU * (Y - PHI * X) ** 2, TAU * (Y - PHI * X) * (Y - PHI * X),
               (np.sqrt(TAU) * (Y - PHI * X)) ** 2, TAU * (Y**2 - 2 * PHI * X * Y + (PHI * X) ** 2),
               ((Y - PHI * X) / (1 / np.sqrt(TAU))) ** 2, TAU * np.square(PHI * X - Y)],
    "log scale": [np.log(TAU * X), np.log(TAU) + np.log(X), np.log(X / (1 / TAU)),
                  0.5 * np.log(TAU**2 * X**2), -np.log(1 / (TAU * X)),
                  np.log(np.sqrt(TAU * X)) * 2],
    "stationary": [np.log((1 - PHI**2) * TAU), np.log(1 - PHI**2) + np.log(TAU),
                   2 * np.log(np.sqrt((1 - PHI**2) * TAU)), np.log(TAU - TAU * PHI**2)],
    "exp": [np.exp(np.log(TAU) * 2), TAU**2, TAU * TAU, np.exp(2 * np.log(TAU)),
            np.sqrt(TAU) ** 4],
    "ratio": [X / TAU, X * TAU**-1, X * np.exp(-np.log(TAU)), np.divide(X, TAU),
              (X / TAU**2) * TAU],
}  # fmt: skip


@pytest.mark.parametrize("name", SPELLINGS)
def test_spelling_does_not_matter(name):
    forms = [separate(e, BLOCK) for e in SPELLINGS[name]]
    for e, form in zip(SPELLINGS[name], forms, strict=True):
        assert isinstance(form, Separation), (e, str(form))
        reassembles(e, form, BLOCK)
        assert set(form.terms) == set(forms[0].terms), e
        for monomial, coefficient in form.terms.items():
            at = values(1)
            np.testing.assert_allclose(
                evaluate(coefficient, at), evaluate(forms[0].terms[monomial], at), rtol=1e-10
            )


@pytest.mark.parametrize(
    "expression",
    [
        np.log(1 + PHI * X), np.sin(PHI * X), np.where(PHI > X, 1.0, 2.0), np.exp(PHI * X),
        np.maximum(PHI, X), 1 / (PHI + X), np.sqrt(PHI + X), X**PHI * PHI**X, np.tanh(PHI - X),
        apply("gammaln", PHI + X), np.floor(PHI * X), np.log(PHI * X + TAU * Y), PHI % X,
        apply("ndtr", PHI * X), np.abs(PHI - X), np.linalg.det(array([[PHI, X], [Y, PHI]])) ** 0.5,
        np.linalg.inv(array([[PHI, X], [Y, 2.0]]))[0, 0],
    ],
    ids=str,
)  # fmt: skip
def test_what_does_not_separate_says_so(expression):
    form = separate(expression, [PHI, TAU])
    assert isinstance(form, NotApplicable)
    assert "does not separate in phi" in form.reason
    assert not polynomial(expression, [PHI], 2)
    assert isinstance(affine([expression], [PHI]), NotApplicable)


def test_functions_of_the_block_alone_are_kept_whole():
    e = X * np.log(1 + PHI * TAU) + np.sin(PHI) * Y + np.where(PHI > 0, PHI, TAU)
    form = separate(e, BLOCK)
    assert len(form.terms) == 3
    reassembles(e, form, BLOCK)


def test_free_of_the_block():
    form = separate(np.sin(X) * Y, BLOCK)
    assert list(form.terms) == [frozenset()]
    assert separate(constant(0.0), BLOCK).terms == {}


def test_cancelling_terms_are_dropped():
    assert set(separate((PHI + X) ** 2 - PHI**2 - 2 * PHI * X, [PHI]).terms) == {frozenset()}
    slope, offset = affine([(PHI + X) * (PHI - X) - PHI * PHI + PHI * Y], [PHI])
    at = values(2)
    np.testing.assert_allclose(evaluate(slope[0, 0], at), at[Y])
    np.testing.assert_allclose(evaluate(offset[0], at), -(at[X] ** 2))


def test_reasons_of_polynomials():
    assert "degree 2, above 1" in affine([PHI**2 * X], [PHI]).reason
    assert "is not a polynomial in phi" in affine([np.exp(PHI)], [PHI]).reason
    assert "is not a polynomial in phi" in quadratic(np.sqrt(PHI), [PHI]).reason
    assert quadratic(PHI**3, [PHI]).reason


def test_matrices_up_to_scale():
    m = array([[2.0, 0.3], [0.3, 1.0]])
    log_density = (
        -0.5 * np.stack([X, Y]) @ np.linalg.inv(V * m) @ np.stack([X, Y])
        - 0.5 * np.linalg.slogdet(V * m)[1]
    )
    form = separate(log_density, [V])
    reassembles(log_density, form, [V])
    assert {repr(f) for f, _ in form.items()} == {"1", "log(v)", "1/v"}
    power = separate(np.linalg.det(V * m) * X + np.linalg.cholesky(V * m)[1, 0], [V])
    assert {repr(f) for f, _ in power.items()} == {"v**2", "sqrt(v)"}
    reassembles(np.linalg.det(V * m) * X + np.linalg.cholesky(V * m)[1, 0], power, [V])


def test_precision_matrix_with_a_parameter():
    # functions of the block only: the determinant and the inverse's entries
    m = array([[V, 0.1], [0.1, V]])
    e = np.linalg.inv(m)[0, 1] * X + np.linalg.slogdet(m)[1]
    form = separate(e, [V])
    reassembles(e, form, [V])


def test_many_terms_stop_with_a_reason():
    x = [symbol("parameter", "b", (i,)) for i in range(30)]
    c = [symbol("state", "c", (i,)) for i in range(30)]
    product = 1.0
    for k in range(4):
        product = product * sum(a * b ** (k + 1) for a, b in zip(c, x, strict=True))
    form = separate(product, x)
    assert isinstance(form, NotApplicable)
    assert "terms when multiplied out" in form.reason


@pytest.mark.parametrize("steps", [4, 6, 10, 25])
def test_logistic_maps_in_small_steps_are_refused_soon(steps, monkeypatch):
    """Of 2^steps terms: refused by the first one of too high a degree, or by their size."""
    n, made = X, []
    for _ in range(steps):
        n = n + 0.1 * V * n * (1 - n)
    with monkeypatch.context() as patch:
        patch.setattr(algebra, "cancels", lambda parts: made.append(len(parts)) or cancels(parts))
        form = polynomial(n, [X], 1)
    assert isinstance(form, NotApplicable)
    wanted = "is of degree" if steps < 10 else "when multiplied out"
    assert wanted in form.reason
    assert len(made) <= steps
    assert isinstance(separate(n, [V]), NotApplicable if steps > 6 else Separation)


def test_long_sums_separate():
    total = 0.0
    for k in range(2000):
        total = total + PHI * np.sin(X * (k + 1.0))
    a, b = affine([total], [PHI])
    assert b[0] is constant(0.0)
    k = np.arange(1, 2001)
    assert evaluate(a[0, 0], {X: 0.3}) == pytest.approx(np.sin(0.3 * k).sum(), abs=1e-9)


def test_a_matrix_root_of_a_square_is_no_polynomial():
    """The Cholesky factor of x**2 C is |x| times that of C, and was taken to be x times it."""
    c = np.array([[2.0, 0.5], [0.5, 1.0]])
    form = polynomial(np.linalg.cholesky(X**2 * c)[1, 0], [X], 1)
    assert isinstance(form, NotApplicable)
    assert "whatever the sign of x" in form.reason
    right, _ = affine([np.linalg.cholesky(V**2 * c)[1, 0] * X], [X])
    assert evaluate(right[0, 0], {V: -2.0}) == pytest.approx(2.0 * np.linalg.cholesky(c)[1, 0])


ZERO = X * V - V * X  # found to be 0 when it is multiplied out, not before


@pytest.mark.parametrize(
    "expression",
    [1.0 / ZERO, np.log(ZERO), V / (PHI * ZERO), V * X / constant(0.0), np.log1p(ZERO - 1.0),
     (V * X) ** np.inf, (V * X) ** -np.inf, (V + X) ** np.nan],
)  # fmt: skip
def test_what_is_no_number_does_not_separate(expression):
    """One over nothing, the logarithm of nothing, powers without end: an IndexError was raised."""
    form = separate(expression, [X])
    assert isinstance(form, NotApplicable)
    assert "does not separate in x" in form.reason
    alone = separate(expression, symbols_of(expression))  # one function, as it stands
    assert list(alone.terms.values()) == [constant(1.0)]


def test_roots_of_nothing_are_nothing():
    for root in (np.sqrt(ZERO), ZERO**3, ZERO**1.5):
        assert separate(root + X, [X]).terms == separate(X, [X]).terms
