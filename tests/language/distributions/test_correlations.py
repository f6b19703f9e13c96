"""LKJ: its density against quadrature and published constants, its sampler against the density, its
transform, and what it says of values that are no correlation matrices."""

import math

import numpy as np
import pytest
from scipy import integrate, stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol, symbols_of
from ssmppl.inference.maximum.edges import reached
from ssmppl.inference.updates.slices import correlations_at, sweep_correlations
from ssmppl.language.distributions import Draws
from ssmppl.language.model.transforms import free_correlations, transforms
from ssmppl.language.tracing import trace

LEVEL = 1e-6 / 40


def density(law, matrix):
    return float(evaluate(law.log_density(array(np.asarray(matrix, float))), {}))


def two(r):
    return np.array([[1.0, r], [r, 1.0]])


@pytest.mark.parametrize("eta", [0.4, 1.0, 1.5, 7.0])
def test_one_correlation_is_a_beta_on_minus_one_to_one(eta):
    for r in (-0.999, -0.3, 0.0, 0.8):
        expected = stats.beta(eta, eta, loc=-1, scale=2).logpdf(r)
        assert density(ssm.LKJ(2, eta), two(r)) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("eta", [1.0, 1.5, 4.0])
def test_the_density_of_three_integrates_to_one(eta):
    """By partial correlations sin(pi v / 2), of which the integrand is analytic to its ends."""
    at, weights = np.polynomial.legendre.leggauss(16)
    r, w = np.sin(0.5 * np.pi * at), 0.5 * np.pi * weights * np.cos(0.5 * np.pi * at)
    a, b, partial = (v.ravel() for v in np.meshgrid(r, r, r))
    volume = np.sqrt((1 - a**2) * (1 - b**2))
    symbols = [symbol("parameter", "r", (k,)) for k in range(3)]
    x, y, z = symbols
    form = ssm.LKJ(3, eta).log_density(array([[1.0, x, y], [x, 1.0, z], [y, z, 1.0]]))
    values = dict(zip(symbols, (a, b, a * b + partial * volume), strict=True))
    each = volume * np.exp(evaluate(form, values))
    weight = np.prod([v.ravel() for v in np.meshgrid(w, w, w)], axis=0)
    assert weight @ each == pytest.approx(1.0, rel=1e-9)


def test_volumes_of_all_correlation_matrices_are_those_published():
    """Joe (2006), "Generating random correlation matrices based on partial correlations", *Journal
    of Multivariate Analysis* 97: 2, pi^2 / 2, 32 pi^2 / 27."""
    for dim, volume in ((2, 2.0), (3, math.pi**2 / 2), (4, 32 * math.pi**2 / 27)):
        assert density(ssm.LKJ(dim, 1), np.eye(dim)) == pytest.approx(-math.log(volume), rel=1e-12)


def test_the_density_with_symbols_is_that_of_numbers_and_none_is_where_no_matrix_is():
    eta, r = symbol("parameter", "eta"), symbol("parameter", "r")
    found = evaluate(
        ssm.LKJ(2, eta).log_density(array([[1.0, r], [r, 1.0]])),
        {eta: 2.5, r: np.array([0.4, -0.9, 1.0, 1.2, -3.0])},
    )
    expected = [density(ssm.LKJ(2, 2.5), two(v)) for v in (0.4, -0.9)]
    assert found[:2] == pytest.approx(expected)
    assert np.all(found[2:] == -np.inf)
    # every pair may be a correlation where the three are none
    form = ssm.LKJ(3, 1).log_density(array([[1.0, r, -r], [r, 1.0, r], [-r, r, 1.0]]))
    assert evaluate(form, {r: np.array([0.4, 0.9])})[1] == -np.inf


@pytest.mark.parametrize(("dim", "eta"), [(2, 0.3), (2, 3.0), (3, 1.0), (4, 0.6), (6, 2.0)])
def test_draws_have_the_margins_of_the_law(dim, eta):
    n = 20_000
    sample = array(ssm.LKJ(dim, eta).sample(Draws("x")))
    x = evaluate(sample, {}, numpy_draws(np.random.default_rng(7), (n,)))
    x = np.stack([np.broadcast_to(v, n) for v in x.reshape(dim * dim, -1)]).reshape(dim, dim, n)
    assert np.all(x == np.swapaxes(x, 0, 1))
    assert np.all(x[np.diag_indices(dim)] == 1.0)
    b = eta + dim / 2 - 1
    law = stats.beta(b, b, loc=-1, scale=2)
    for i in range(dim):
        for j in range(i):
            assert stats.kstest(x[i, j], law.cdf).pvalue > LEVEL
    assert evaluate(ssm.LKJ(dim, eta).variance(), {})[0, 1] == pytest.approx(law.var())
    # 1 - R^2 of the last row given the others is a product of independent betas
    if dim > 2:
        matrices = np.moveaxis(x, -1, 0)
        left = np.linalg.det(matrices) / np.linalg.det(matrices[:, :-1, :-1])
        rng = np.random.default_rng(8)
        shapes = [eta + 0.5 * (dim - 2 - j) for j in range(dim - 1)]
        expected = np.prod([1 - (2 * rng.beta(s, s, n) - 1) ** 2 for s in shapes], axis=0)
        assert stats.ks_2samp(left, expected).pvalue > LEVEL


def test_draws_of_nearly_singular_matrices_have_a_density():
    law = ssm.LKJ(2, 0.02)
    x = evaluate(array(law.sample(Draws("x"))), {}, numpy_draws(np.random.default_rng(7), (2000,)))
    r = symbol("parameter", "r")
    found = evaluate(law.log_density(array([[1.0, r], [r, 1.0]])), {r: x.reshape(4, -1)[1]})
    assert np.all(np.isfinite(found))


def correlated(law=None, dim=3):
    """States whose noises are correlated."""
    model = ssm.Model("correlated")

    @model.prior
    def prior():
        return {"R": law or ssm.LKJ(dim, 2), "sd": ssm.HalfNormal(sd=np.ones(dim))}

    @model.initial
    def initial():
        return {"x": ssm.Normal(np.zeros(dim), sd=1)}

    @model.transition
    def transition(x, R, sd):
        return {"x": ssm.MvNormal(0.5 * x, covariance=sd[:, None] * R * sd[None, :])}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.2)}

    return model


def some_matrix(dim, seed=3):
    a = np.random.default_rng(seed).standard_normal((dim, dim + 1))
    c = a @ a.T
    return c / np.sqrt(np.outer(np.diag(c), np.diag(c)))


def test_a_model_reads_ones_on_the_diagonal():
    law = trace(correlated()).transition["x"].distribution
    read = {s.data[2] for s in symbols_of(law.expressions()) if s.data[1] == "R"}
    assert read == {(1, 0), (2, 0), (2, 1)}


@pytest.mark.parametrize("dim", [2, 3, 5])
def test_there_and_back_with_the_volume_of_numerical_differences(dim):
    made = transforms(trace(correlated(dim=dim)))[0]
    matrix = some_matrix(dim)
    z = made.inverse(matrix, {})
    assert len(z) == len(made.free) == dim * (dim - 1) // 2
    names = [s.data[2] for s in made.components]

    def back(z):
        return np.array(evaluate(array(list(made.values)), dict(zip(made.free, z, strict=True))))

    np.testing.assert_allclose(back(z), [matrix[n] for n in names], rtol=0, atol=1e-12)
    off = [k for k, n in enumerate(names) if n[0] != n[1]]
    columns = [(back(z + e) - back(z - e))[off] / 2e-6 for e in 1e-6 * np.eye(len(z))]
    found = evaluate(made.log_jacobian, dict(zip(made.free, z, strict=True)))
    assert found == pytest.approx(np.linalg.slogdet(np.array(columns))[1], abs=1e-7)
    root, log_jacobian = correlations_at(z, dim)  # what slice steps move on
    np.testing.assert_allclose(root @ root.T, matrix, rtol=0, atol=1e-12)
    assert log_jacobian == pytest.approx(found, abs=1e-12)


@pytest.mark.parametrize("r", [1.0 - 1e-15, 1.0, -1.0, 0.999999])
def test_correlations_at_the_edge_have_a_finite_place(r):
    z = free_correlations(two(r))
    assert np.all(np.isfinite(z))
    assert np.tanh(z[0]) == pytest.approx(r, abs=1e-12)


def test_slice_steps_leave_the_law_as_it_is():
    """Sweeps over draws of the law, one each: the ranks of what comes out are as of the law."""
    eta, dim, n = 1.3, 3, 500
    law, rng = ssm.LKJ(dim, eta), np.random.default_rng(4)
    drawn = evaluate(array(law.sample(Draws("x"))), {}, numpy_draws(rng, (n,)))
    cells = [(0, 0), (1, 0), (2, 0), (1, 1), (2, 1), (2, 2)]

    def at(v):
        m = np.eye(dim)
        for (i, j), x in zip(cells, v, strict=True):
            m[i, j] = m[j, i] = x
        sign, log_det = np.linalg.slogdet(m)
        return (eta - 1.0) * log_det if sign > 0 else -math.inf

    flat = np.stack([np.broadcast_to(v, n) for v in drawn.reshape(dim * dim, -1)])
    moved = np.array([
        sweep_correlations(at, [flat[dim * i + j, k] for i, j in cells], dim, rng)
        for k in range(n)
    ])  # fmt: skip
    margin = stats.beta(eta + 0.5, eta + 0.5, loc=-1, scale=2)
    for k in (1, 2, 4):
        assert stats.kstest(moved[:, k], margin.cdf).pvalue > LEVEL
    assert np.mean(moved[:, 4] != flat[dim * 2 + 1]) > 0.99


@pytest.mark.parametrize(
    ("call", "found", "fix"),
    [
        (lambda: ssm.LKJ(1, 2), "dim is 1", "at least 2"),
        (lambda: ssm.LKJ(2.5, 2), "dim is 2.5", "whole number"),
        (lambda: ssm.LKJ(3, -1), "eta = -1 is outside", "eta inside"),
        (lambda: ssm.LKJ(3, [1, 2]), "eta has shape (2,)", "one number"),
        (lambda: ssm.LKJ(3), "missing a required argument: 'eta'", "LKJ(dim, eta)"),
    ],
)
def test_what_is_no_law_is_refused(call, found, fix):
    with pytest.raises(ModelError) as caught:
        call()
    assert found in str(caught.value)
    assert fix in str(caught.value)
    assert "test_correlations.py" in str(caught.value)


def test_it_is_a_prior_only():
    model = correlated()
    model.observation(lambda x: {"c": ssm.LKJ(2, 1)})
    with pytest.raises(ModelError, match="'c' is LKJ, a prior of parameters only"):
        ssm.explain(model)


SD, DATA = np.ones(3), {"y": np.zeros((5, 3))}


@pytest.mark.parametrize(
    ("matrix", "found"),
    [
        (np.diag([1.0, 4.0, 1.0]), "R'[1, 1]: the diagonal of a correlation matrix is 1, entry"),
        (np.eye(3) + np.diag([0.5], 2), "is not symmetric"),
        (np.eye(2), "has shape (2, 2)"),
    ],
)
def test_values_that_are_no_correlations(matrix, found):
    """Everywhere: the model reads neither the diagonal nor one of the halves."""
    for verb in (
        lambda: ssm.log_likelihood(correlated(), DATA, {"R": matrix, "sd": SD}),
        lambda: ssm.maximize(correlated(), DATA, fixed={"R": matrix}),
        lambda: ssm.simulate(correlated(), {"R": matrix, "sd": SD}, steps=3, seed=1),
    ):
        with pytest.raises(ArgumentError) as caught:
            verb()
        assert found in str(caught.value)


def test_a_start_that_is_not_positive_definite():
    matrix = [[1, 0.9, -0.9], [0.9, 1, 0.9], [-0.9, 0.9, 1]]
    with pytest.raises(ArgumentError, match="not positive definite"):
        ssm.maximize(correlated(), DATA, start={"R": matrix})


def test_the_estimate_is_that_of_the_covariance():
    """The same likelihood, once by correlations and scales, once by the covariance itself; the
    standard errors of correlations by the delta method."""
    truth = {"R": some_matrix(3), "sd": np.array([0.5, 1.0, 2.0])}
    y = ssm.simulate(correlated(), truth, steps=120, seed=5)["y"].values[0].copy()
    y[7], y[20, 1] = np.nan, np.nan
    whole = ssm.Model("whole")
    whole.prior(lambda: {"Q": ssm.InverseWishart(5, scale=np.eye(3))})
    whole.initial(lambda: {"x": ssm.Normal(np.zeros(3), sd=1)})
    whole.transition(lambda x, Q: {"x": ssm.MvNormal(0.5 * x, covariance=Q)})
    whole.observation(lambda x: {"y": ssm.Normal(x, sd=0.2)})
    by_parts = ssm.maximize(correlated(), {"y": y}, seed=1)
    at_once = ssm.maximize(whole, {"y": y}, seed=1)
    assert by_parts.log_likelihood == pytest.approx(at_once.log_likelihood, abs=1e-6)
    q = at_once.parameters["Q"]
    sd = np.sqrt(np.diag(q))
    np.testing.assert_allclose(by_parts.parameters["R"], q / np.outer(sd, sd), atol=1e-4)
    np.testing.assert_allclose(by_parts.parameters["sd"], sd, rtol=1e-4)
    order = ["Q[0, 0]", "Q[1, 0]", "Q[1, 1]"]
    cov = at_once.covariance.loc[order, order].values
    v, c, w = q[0, 0], q[0, 1], q[1, 1]
    r = c / math.sqrt(v * w)
    slope = np.array([-r / (2 * v), 1 / math.sqrt(v * w), -r / (2 * w)])
    expected = math.sqrt(slope @ cov @ slope)
    errors = by_parts.standard_errors["R"]
    assert errors[0, 1] == errors[1, 0] == pytest.approx(expected, rel=1e-3)
    assert np.all(np.diag(errors) == 0.0)


def test_a_correlation_whose_maximum_is_at_one_is_held_there():
    """Two sensors of one noise: without noises of their own they differ by nothing."""
    model = ssm.Model("one noise")

    @model.prior
    def prior():
        return {"R": ssm.LKJ(2, 1), "m": ssm.Normal(0, sd=10)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(0.5 * x, sd=0.1)}

    @model.observation
    def observation(x, R, m):
        return {"y": ssm.MvNormal(np.stack([x + m, x + m]), covariance=R + 0.01 * np.eye(2))}

    noise = np.random.default_rng(1).standard_normal((80, 1))
    found = ssm.maximize(model, {"y": 1.0 + np.hstack([noise, noise])}, seed=1)
    assert found.attrs["held_at_edge"] == {"R[1, 0]": 1.0}
    assert found.parameters["R"][0, 1] == pytest.approx(1.0, abs=1e-3)
    assert np.isnan(found.standard_errors["R"][0, 1])
    assert found.standard_errors["m"] > 0.0


def test_beside_a_correlation_of_one_the_others_of_its_row_are_not_identified():
    """R[2, 0] at 1: R[2, 1] follows from R[1, 0], whatever its partial correlation is."""
    made = transforms(trace(correlated()))[0]
    names = [s.data[2] for s in made.components]
    found, kept = np.array([0.0, 1.0, 0.0]), np.array([True, False, True])
    assert reached(made, found, kept, {}) == [(names.index((2, 0)), 1.0)]
    assert kept.tolist() == [True, False, False]
    # an edge of a partial correlation is none of the correlation itself
    found, kept = np.array([0.0, 0.0, -1.0]), np.array([True, True, False])
    assert reached(made, found, kept, {}) == []
    assert kept.all()


def test_the_integral_over_a_posterior_by_evidence_draws():
    """The evidence of one pair of values by quadrature over its correlation."""
    model = ssm.Model("pair")

    @model.prior
    def prior():
        return {"R": ssm.LKJ(2, 1.5)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(0.0 * x, sd=1)}

    @model.observation
    def observation(x, R):
        return {"y": ssm.MvNormal(np.zeros(2) + 0.0 * x, covariance=R)}

    y = np.array([[0.3, 0.9], [1.2, 1.0], [-0.5, 0.1], [2.0, 1.4]])

    def whole(r):
        like = stats.multivariate_normal(np.zeros(2), two(r)).logpdf(y).sum()
        return math.exp(like + stats.beta(1.5, 1.5, loc=-1, scale=2).logpdf(r))

    exact = math.log(integrate.quad(whole, -1, 1)[0])
    found = ssm.evidence(model, {"y": y}, seed=2, progress=False)
    assert found.log_evidence == pytest.approx(exact, abs=5 * found.standard_error + 1e-9)
