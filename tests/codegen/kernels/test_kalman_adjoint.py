"""Adjoints of every matrix against complex steps through the textbook filter."""

import numpy as np
import pytest

from ssmppl.codegen.kernels.kalman.adjoint import zeros_like
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.modules.exact import exact_entry
from tests.codegen.kernels.kalman_matrices import random_data, random_model
from tests.statistics.checks import seed_of


def textbook(model, y, seen):
    """log p(y) by covariances and inverses, analytic in every entry."""

    def at(field, t):
        return field[t if len(field) > 1 else 0]

    m, P, A, b, Q, C, d, R = model
    x, cov, total = m, P, 0.0
    for t in range(len(y)):
        if t:
            a = at(A, t)
            x, cov = a @ x + at(b, t), a @ cov @ a.T + at(Q, t)
        s = seen[t] == 1.0
        c, v = at(C, t)[s], (y[t] - at(d, t))[s] - at(C, t)[s] @ x
        spread = c @ cov @ c.T + at(R, t)[np.ix_(s, s)]
        inverse = np.linalg.inv(spread)
        total -= 0.5 * (s.sum() * np.log(2 * np.pi) + np.log(np.linalg.det(spread)))
        total -= 0.5 * v @ inverse @ v
        gain = cov @ c.T @ inverse
        x, cov = x + gain @ v, cov - gain @ c @ cov
    return total


def complex_step(model, y, seen, field, index):
    """The derivative in one entry, together with the entry across the diagonal."""
    h = 1e-30
    moved = getattr(model, field).astype(complex)
    moved[index] += 1j * h
    if field in "PQR" and index[-1] != index[-2]:
        moved[(*index[:-2], index[-1], index[-2])] += 1j * h
    return textbook(model._replace(**{field: moved}), y, seen).imag / h


def varying(rng, model, steps):
    """The model with other matrices at every step."""
    fields = {}
    for name in ("A", "b", "Q", "C", "d", "R"):
        scale = 0.5 + rng.random((steps,) + (1,) * (getattr(model, name).ndim - 1))
        fields[name] = getattr(model, name) * scale
    return model._replace(**fields)


@pytest.mark.parametrize("over_time", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize(
    ("d", "k", "rank"), [(1, 1, None), (2, 1, 0), (3, 2, 1), (4, 4, None), (2, 4, 1)]
)
def test_every_entry_of_every_matrix(d, k, rank, missing, over_time):
    rng = np.random.default_rng(seed_of("adjoint", d, k, rank, missing, over_time))
    model = random_model(rng, d, k, rank, rank)
    steps = 6
    if over_time:
        model = varying(rng, model, steps)
    y, seen = random_data(rng, model, steps, missing)
    adjoint, increments = zeros_like(model), np.empty(steps)
    start = model.m[:, None].copy()
    run, wanted = exact_entry("adjoints"), np.ones(8, np.int64)
    assert run(model, start, y, seen, wanted, increments, adjoint) == (0, steps)
    assert increments.sum() == pytest.approx(textbook(model, y, seen), rel=1e-11)
    for field in Matrices._fields:
        found = getattr(adjoint, field)
        scale = 1 + np.abs(found).max()
        for index in np.ndindex(found.shape):
            exact, got = complex_step(model, y, seen, field, index), found[index]
            if field in "PQR" and index[-1] != index[-2]:
                got = got + found[(*index[:-2], index[-1], index[-2])]
            assert got == pytest.approx(exact, rel=1e-9, abs=1e-10 * scale), (field, index)


def shift_register():
    """A level with a season of four: most entries of A, C and Q are zero."""
    a = np.zeros((4, 4))
    a[0, 0], a[1, 1:], a[2, 1], a[3, 2] = 1.0, -1.0, 1.0, 1.0
    q = np.diag([0.3, 0.1, 0.0, 0.0])
    return Matrices(
        np.array([1.0, 0.5, -0.5, 0.2]), np.eye(4), a[None], np.zeros((1, 4)), q[None],
        np.array([[[1.0, 1.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]]]), np.zeros((1, 2)),
        np.diag([0.4, 0.2])[None],
    )  # fmt: skip


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_zeros_are_passed_over_and_a_filter_that_settles(missing):
    """Derivatives in entries that are zero too, over more rows than the filter needs to settle."""
    rng = np.random.default_rng(seed_of("shift register", missing))
    model, steps = shift_register(), 300
    y, seen = random_data(rng, model, steps, missing)
    adjoint, increments = zeros_like(model), np.empty(steps)
    run, wanted = exact_entry("adjoints"), np.ones(8, np.int64)
    start = model.m[:, None].copy()
    assert run(model, start, y, seen, wanted, increments, adjoint) == (0, steps)
    assert increments.sum() == pytest.approx(textbook(model, y, seen), rel=1e-11)
    for field in Matrices._fields:
        found = getattr(adjoint, field)
        scale = 1 + np.abs(found).max()
        for index in np.ndindex(found.shape):
            exact, got = complex_step(model, y, seen, field, index), found[index]
            if field in "PQR" and index[-1] != index[-2]:
                got = got + found[(*index[:-2], index[-1], index[-2])]
            assert got == pytest.approx(exact, rel=1e-8, abs=1e-9 * scale), (field, index)


@pytest.mark.parametrize("field", range(8))
def test_only_what_is_wanted(field):
    rng = np.random.default_rng(seed_of("wanted", field))
    model = random_model(rng, 3, 2, 1, 1)
    y, seen = random_data(rng, model, 9, 0.3)
    every, one, increments = zeros_like(model), zeros_like(model), np.empty(9)
    start, run = model.m[:, None].copy(), exact_entry("adjoints")
    run(model, start, y, seen, np.ones(8, np.int64), increments, every)
    run(model, start, y, seen, np.eye(8, dtype=np.int64)[field], increments, one)
    for k in range(8):
        expected = every[k] if k == field else np.zeros(every[k].shape)
        np.testing.assert_array_equal(one[k], expected)
