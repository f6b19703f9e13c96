"""Compiled matrices of linear Gaussian models, and their derivatives, against the interpreter."""

import numpy as np
import pytest

from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.exact.kalman import LAWS, _ordered, _slopes, kalman_model
from ssmppl.inference.exact.kalman_matrices import values_of
from tests.inference.exact.test_kalman_score import matrix_valued, singular
from tests.models.kalman import MODELS, posed
from tests.statistics.checks import seed_of

BUILDERS = [*MODELS, singular, matrix_valued]


def rows_of(expression, values, steps):
    """The value in every row (T,)."""
    return np.broadcast_to(evaluate(expression, values), (steps,))


@pytest.mark.parametrize("steps", [1, 2, 7])
@pytest.mark.parametrize("build", BUILDERS)
def test_matrices(build, steps):
    traced, theta, e, _ = posed(build, 0.3 if steps > 2 else 0.0, steps=steps)
    model, values = kalman_model(traced), values_of(traced, e, theta)
    found = model.matrices(e, theta)
    for name in Matrices._fields:
        field, form = getattr(found, name), getattr(model.form, name)
        for index in np.ndindex(form.shape):
            exact = rows_of(form[index], values, steps)
            if LAWS[name] == "initial":
                got, exact = field[index], exact[0]
            else:
                assert len(field) in (1, steps)
                got, exact = field[(slice(None), *index)], exact[: len(field)]
            np.testing.assert_allclose(got, exact, rtol=1e-14, atol=1e-300, err_msg=name)


def test_what_does_not_depend_on_the_row_stands_there_once():
    traced, theta, e, _ = posed(MODELS[0], 0.0)
    assert all(len(f) == 1 for f in kalman_model(traced).matrices(e, theta)[2:])


@pytest.mark.parametrize("steps", [1, 2, 7])
@pytest.mark.parametrize("build", BUILDERS)
def test_gradient_by_adjoints(build, steps):
    """The chain rule, with adjoints drawn at random; row 0 of the transition does not count."""
    traced, theta, e, _ = posed(build, 0.0, steps=steps)
    if not len(theta):
        return
    known, slope = _slopes(traced)
    (_, program), values = _ordered(traced), values_of(traced, e, theta)
    flat, adjoint = program.room(steps, filled=False)
    rng = np.random.default_rng(seed_of("contract", build.__name__, steps))
    flat[:] = rng.normal(size=flat.size)
    expected, found = np.zeros(len(theta)), np.zeros(len(theta))
    for s in known.known:
        weight, value = getattr(adjoint, s.field), rows_of(s.expression, values, steps)
        if LAWS[s.field] == "initial":
            expected[s.parameter] += weight.ravel()[s.entry] * value[0]
            continue
        first = 1 if LAWS[s.field] == "transition" else 0
        if first >= steps:
            continue
        own = weight.reshape(len(weight), -1)[:, s.entry]
        rows = slice(first, None) if len(own) > 1 else slice(None)
        expected[s.parameter] += own[rows] @ value[rows] if len(own) > 1 else own[0] * value[-1]
    slope.add_gradient(theta, e.y, e.seen, e.u, flat, found)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
