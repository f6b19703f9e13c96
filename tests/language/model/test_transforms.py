"""Values on the unconstrained scale, bounds among them."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from ssmppl.language.model.transforms import transforms, unconstrain
from ssmppl.language.tracing import trace


def bounded():
    model = ssm.Model("bounded")
    model.prior(lambda: {
        "a": ssm.Uniform(-1.0, 2.0), "b": ssm.HalfNormal(sd=1), "c": ssm.Normal(0, sd=1),
    })  # fmt: skip
    model.initial(lambda c: {"x": ssm.Normal(c, sd=1)})
    model.transition(lambda x, a, b: {"x": ssm.Normal(a * x, sd=b)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return trace(model)


@pytest.mark.parametrize(
    "values", [(0.3, 0.7, -1.2), (-1.0, 0.7, 0.0), (2.0, 0.7, 0.0), (0.5, 0.0, 0.0)]
)
def test_there_and_back(values):
    """A search that runs towards a bound ends on it by rounding: it has a finite place there."""
    t = bounded()
    theta = np.array(values)
    z = unconstrain(t, theta, dict(zip("abc", map(np.asarray, values), strict=True)))
    assert np.all(np.isfinite(z))
    made = transforms(t)
    known = dict(zip([s for m in made for s in m.free], z, strict=True))
    back = np.concatenate([evaluate(array(list(m.values)), known) for m in made])
    np.testing.assert_allclose(back, theta, atol=1e-12)


def test_rows_of_shares_there_and_back_with_their_volume():
    """Each row breaks a stick of its own; the Jacobian is that of differences, without the last
    column, which follows."""
    model = ssm.Model("rows")
    model.prior(lambda: {"P": ssm.Dirichlet(np.ones((2, 3)))})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, P: {"x": ssm.Normal(P[0, 1] * x, sd=P[1, 0])})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    (made,) = transforms(trace(model))
    shares = np.array([[0.2, 0.5, 0.3], [0.05, 0.15, 0.8]])
    z = made.inverse(shares, {})
    assert len(z) == len(made.free) == 4

    def back(z):
        known = dict(zip(made.free, z, strict=True))
        return np.array(evaluate(array(list(made.values)), known)).reshape(2, 3)

    np.testing.assert_allclose(back(z), shares, rtol=1e-12)
    columns = [(back(z + e) - back(z - e))[:, :2].ravel() / 2e-6 for e in 1e-6 * np.eye(4)]
    found = evaluate(made.log_jacobian, dict(zip(made.free, z, strict=True)))
    assert found == pytest.approx(np.linalg.slogdet(np.array(columns))[1], abs=1e-7)


def test_rows_of_shares_have_the_density_of_independent_ones():
    concentration = np.array([[2.0, 1.0, 3.0], [0.5, 4.0, 1.5]])
    shares = np.array([[0.2, 0.5, 0.3], [0.05, 0.15, 0.8]])
    law = ssm.Dirichlet(concentration)
    expected = sum(stats.dirichlet.logpdf(p, a) for p, a in zip(shares, concentration, strict=True))
    assert float(evaluate(law.log_density(array(shares)), {})) == pytest.approx(expected)
    each = [stats.dirichlet(a) for a in concentration]
    np.testing.assert_allclose(evaluate(law.mean(), {}), [d.mean() for d in each])
    np.testing.assert_allclose(evaluate(law.variance(), {}), [d.var() for d in each])


def shares_of(law):
    model = ssm.Model("shares")
    model.prior(lambda: {"p": law})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, p: {"x": ssm.Normal(p[0] * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    (made,) = transforms(trace(model))
    return made


@pytest.mark.parametrize("far", [30.0, 37.0, 300.0])
def test_what_is_left_of_a_stick_keeps_its_digits(far):
    """1 - share is 0 in floating point from 37 on."""
    made = shares_of(ssm.Dirichlet(np.full(3, 0.2)))
    known = dict(zip(made.free, [far, 0.5], strict=True))
    first, second, last = evaluate(array(list(made.values)), known)
    left = 1.0 / (1.0 + np.exp(far - np.log(2.0)))
    assert first == pytest.approx(1.0 - left)
    assert second == pytest.approx(left / (1.0 + np.exp(-0.5)), rel=1e-12, abs=0.0)
    assert last == pytest.approx(left / (1.0 + np.exp(0.5)), rel=1e-12, abs=0.0)


def test_a_share_of_zero_has_no_infinite_density():
    """Nor is one of a concentration of 1 or more lost, where the density is a number."""
    p = array([symbol("parameter", "p", (i,)) for i in range(3)])
    nothing = dict(zip(p, [0.4, 0.6, 0.0], strict=True))
    for concentration, expected in [([2, 1, 0.5], -np.inf), ([2, 3, 1], np.log(60 * 0.4 * 0.36))]:
        density = ssm.Dirichlet(np.array(concentration, float)).log_density(p)
        assert float(evaluate(density, nothing)) == pytest.approx(expected)


@pytest.mark.parametrize(
    "shares",
    [
        [0.5, 0.5, 1e-17, 1e-18],
        [1.0 - 1e-16, 1e-17, 1e-300],
        [1e-300, 1e-300, 1.0],
        [0.7, 0.1, 0.1, 0.1],
        [0.5, 0.0, 0.5],
        [0.0, 0.0, 1.0],
        [0.5, 0.5, 0.0],
        [1.0, 0.0, 0.0],
    ],
)
def test_shares_near_zero_there_and_back(shares):
    """As far as the least number of full accuracy, which takes the place of zero."""
    made = shares_of(ssm.Dirichlet(np.ones(len(shares))))
    z = made.inverse(np.array(shares), {})
    known = dict(zip(made.free, z, strict=True))
    back = evaluate(array(list(made.values)), known)
    least = np.maximum(shares, np.finfo(float).tiny)
    np.testing.assert_allclose(back, least, rtol=1e-9, atol=0.0)
