"""Draws of every derived update against quadrature of the exact conditional.

The exact conditional is the sum of the guarded densities as written, by the interpreter. Each
component, and the product of the first two, is compared by a Kolmogorov-Smirnov test at 1e-3
divided by the number of comparisons in this file (about 300).
"""

import gc
import weakref

import numpy as np
import pytest
from scipy import stats

from ssmppl.analysis.conjugacy import numerical_check
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.analysis.conjugacy.matrix_families import MatrixNormalWishart
from ssmppl.analysis.conjugacy.separation import complete_data
from ssmppl.inference.updates.draw_update import sampler_of
from ssmppl.language.tracing import trace
from tests.analysis.conjugacy.corpus import CORPUS, build
from tests.analysis.conjugacy.exact import Conditional, kolmogorov_smirnov, matrices

LEVEL = 1e-3 / 300


def test_a_sampler_goes_with_its_update():
    """Each call of `sample` derives updates of its own: what they need must not stay."""
    model, *_ = build(next(iter(CORPUS)))
    updates = list(derive_updates(trace(model)))
    samplers = [weakref.ref(sampler_of(u)) for u in updates]
    assert all(s() is sampler_of(u) for s, u in zip(samplers, updates, strict=True))
    updates.clear()
    gc.collect()
    assert samplers
    assert not any(s() for s in samplers)


def conditionals(model, seed=0):
    """One random data set and parameter point for each update of a model."""
    t = trace(model)
    data = complete_data(t)
    rng = np.random.default_rng(seed)
    series = numerical_check.random_series(data, rng, steps=8)
    for update in derive_updates(t):
        yield next(
            c
            for k in range(numerical_check.POINTS)
            if np.isfinite((c := Conditional(data, update, series, k)).log_joint(c.current))
        )


def compare(conditional, n=1500, thin=None, seed=1):
    """Assert that draws follow the exact conditional; returns how they came about."""
    rng = np.random.default_rng(seed)
    if thin is None:
        thin = 1 if conditional.update.family else 8
    draws, infos = conditional.draws(n, rng, thin)
    if thin == 1 and any(info.route == "metropolis" for info in infos):  # they depend on another
        draws, infos = conditional.draws(500, rng, 6)
    assert np.all(np.isfinite(draws))
    update = conditional.update
    inside = not (update.outside_family or update.inseparable_terms or sampler_of(update).truncated)
    if update.family_name == "joint Normal" and inside:
        _compare_normal(conditional, draws)
        return infos
    if isinstance(update.family, MatrixNormalWishart):
        assert inside
        more, _ = conditional.draws(10_000, rng)
        _compare_matrix_normal(conditional, np.concatenate([draws, more]))
        return infos
    values, weights = conditional.grid(draws)
    tested = [(x, v) for x, v in zip(draws.T, values, strict=True)]
    if len(values) > 1:
        tested.append((draws[:, 0] * draws[:, 1], values[0] * values[1]))
    for sample, points in tested:
        p = kolmogorov_smirnov(sample, points, weights)
        assert p > LEVEL, (conditional.update.explanation.title, p, draws.mean(0))
    return infos


def _compare_normal(conditional, draws):
    """A Normal of many components, whitened by mean and precision from its own log density."""
    d = draws.shape[1]
    zero = conditional.log_joint(np.zeros(d))
    e = np.eye(d)

    def f(v):
        return conditional.log_joint(v) - zero

    # exact for a quadratic: f(v) = g'v - v'Hv/2
    h = np.array([[f(e[i]) + f(e[j]) - f(e[i] + e[j]) for j in range(d)] for i in range(d)])
    g = np.array([0.5 * (f(e[i]) - f(-e[i])) for i in range(d)])
    z = (draws - np.linalg.solve(h, g)) @ np.linalg.cholesky(h)
    assert_standard_normal(z)


def assert_standard_normal(z):
    """Each column, the sum of their squares, and the second moments of pairs."""
    n, d = z.shape
    for column in z.T:
        assert stats.kstest(column, "norm").pvalue > LEVEL
    assert stats.kstest((z**2).sum(1), stats.chi2(d).cdf).pvalue > LEVEL
    moments = z.T @ z / n - np.eye(d)
    errors = np.sqrt((1.0 + np.eye(d)) / n)
    assert np.all(np.abs(moments) < stats.norm.isf(LEVEL / (d * (d + 1))) * errors), moments


def _compare_matrix_normal(conditional, draws):
    """The numbers given the matrix whitened as above; the matrix by what is left without them.

    Integrated over the numbers, the density as it was written is that of a Wishart law: their
    ratio is the same for all draws, and these are compared with draws by SciPy.
    """
    family = conditional.update.family
    theta, matrix = draws[:, : family.thetas].T, draws[:, family.thetas :].T
    d, e = family.thetas, np.eye(family.thetas)

    def f(v):
        points = [np.full(draws.shape[0], x) for x in v]
        return conditional.log_density_at([*points, *matrix])

    zero = f(np.zeros(d))
    one = [f(v) - zero for v in e]
    h = np.array([[one[i] + one[j] - f(e[i] + e[j]) + zero for j in range(d)] for i in range(d)])
    g = np.array([0.5 * (one[i] - f(-e[i]) + zero) for i in range(d)])
    h, g = h.transpose(2, 0, 1), g.T
    mean = np.linalg.solve(h, g[..., None])[..., 0]
    roots = np.linalg.cholesky(h)
    z = np.einsum("nji,nj->ni", roots, theta.T - mean)
    assert_standard_normal(z)

    c = [*conditional.totals.tolist(), 0.0]
    df, scale, _, _ = family.solve(c)
    inverse = family.wishart.inverse
    law = stats.invwishart(df, scale) if inverse else stats.wishart(df, np.linalg.inv(scale))
    values = matrices(matrix.T, family.wishart.size)
    marginal = zero + 0.5 * (g * mean).sum(1) - np.linalg.slogdet(h)[1] / 2
    ratio = marginal - np.array([law.logpdf(v) for v in values])
    assert np.ptp(ratio) < 1e-8 * (1.0 + np.abs(zero).max()), np.ptp(ratio)
    others = law.rvs(4 * len(values), random_state=2)
    for measure in (lambda v: v[..., 0, 0], lambda v: v[..., 1, 0], np.linalg.det):
        assert stats.ks_2samp(measure(values), measure(others)).pvalue > LEVEL


# Tens of thousands of draws each; one case of a matrix with its coefficients stays.
LONG = (
    "conjugate_columns", "flat_coefficients", "conjugate_precision", "negative_binomial",
    "noise_through_a_matrix",
)  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in CORPUS]
)
def test_draws_follow_the_exact_conditional(name):
    model, *_ = build(name)
    for conditional in conditionals(model):
        compare(conditional)
