"""Draws where a term of the prior or the initial law does not separate, and is left to the log
joint density.

One draw has to leave the exact conditional invariant. The family's own draws, which `test_draws.py`
compares with quadrature, follow it with the weights that the factor left over gives them. After a
draw from each of these points no function of the block has another mean: the weighted differences,
point by point, have mean 0 within the standard error that they have.
"""

from functools import partial

import numpy as np
import pytest
from scipy import stats

from ssmppl.analysis.conjugacy import numerical_check
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.analysis.conjugacy.separation import complete_data
from ssmppl.inference.updates.draw_update import draw, sampler_of
from ssmppl.language.distributions import (
    Beta,
    Binomial,
    Categorical,
    Dirichlet,
    Gamma,
    InverseGamma,
    InverseWishart,
    LogNormal,
    MvNormal,
    Normal,
    Poisson,
    StudentT,
    Truncated,
    Uniform,
    Wishart,
)
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace
from tests.analysis.conjugacy.exact import Conditional
from tests.statistics.checks import LEVEL, seed_of

WIDE = np.zeros(6)  # so many components: the initial law tells as much as the one step
EYE = np.eye(2)


def _free():
    """What the initial law or a prior needs, for the block not to separate there."""
    return {"s": Gamma(2, rate=1)}


def _seen(x):
    return {"y": Normal(x, sd=1)}


def _first(tau, n=1):
    """The precision of the first n components, 1 of the others: less than the initial law tells."""
    return np.append(np.full(n, tau), np.ones(len(WIDE) - n))


def precision(m):
    m.prior(lambda: {**_free(), "tau": Gamma(2, rate=1)})
    m.initial(lambda tau, s: {"x": Normal(WIDE, variance=1 / tau + s)})
    m.transition(lambda x, tau: {"x": Normal(0.5 * x, precision=tau)})
    m.observation(_seen)


def normal(m):
    m.prior(_free)
    m.prior(lambda s: {"phi": StudentT(3, s, scale=0.3)})
    m.initial(lambda: {"x": Normal(WIDE, sd=1)})
    m.transition(lambda x, phi: {"x": Normal(phi * x, sd=1)})
    m.observation(_seen)


def joint_normal(m):
    m.prior(_free)
    m.prior(lambda s: {"phi": StudentT(3, s, scale=0.3), "c": Truncated(Normal(0, sd=1), lower=-1)})
    m.initial(lambda: {"x": Normal(WIDE, sd=1)})
    m.transition(lambda x, phi, c: {"x": Normal(phi * x + c, sd=1)})
    m.observation(_seen)


def scale_in_the_initial_law(m):
    m.prior(lambda: {**_free(), "tau": Gamma(2, rate=1)})
    m.prior(lambda tau: {"phi": Normal(0, precision=tau)})
    m.initial(lambda tau, s: {"x": Normal(WIDE, variance=1 / tau + 0.1 * s)})
    m.transition(
        lambda x, phi, tau: {"x": Normal(np.append(phi * x[0], x[1:]), precision=_first(tau))}
    )
    m.observation(_seen)


def scale_of_two(m):
    m.prior(lambda: {**_free(), "v": InverseGamma(3, scale=1)})
    m.prior(lambda v: {"phi": Normal(0, variance=v), "c": Normal(0, variance=2 * v)})
    m.initial(lambda v, s: {"x": Normal(WIDE, variance=v + 0.1 * s)})
    m.transition(lambda x, phi, c, v: {
        "x": Normal(np.append(phi * x[:2] + c, x[2:]), precision=_first(1 / v, 2))
    })  # fmt: skip
    m.observation(_seen)


def scale_in_a_prior(m):
    m.prior(_free)
    m.prior(lambda: {"v": LogNormal(0, sd=1)})
    m.prior(lambda v, s: {"phi": StudentT(3, s, scale=v)})
    m.initial(lambda v: {"x": Normal(WIDE, variance=v)})
    m.transition(lambda x, phi, v: {"x": Normal(phi * x, variance=v)})
    m.observation(_seen)


def coefficient_in_the_initial_law(m):
    m.prior(lambda: {**_free(), "tau": Gamma(2, rate=1)})
    m.prior(lambda tau: {"phi": Normal(0, precision=tau)})
    m.initial(lambda phi, s: {"x": Normal(WIDE + np.tanh(phi + s), sd=0.4)})
    m.transition(lambda x, phi, tau: {"x": Normal(phi * x, precision=tau)})
    m.observation(_seen)


def within_bounds(m):
    m.prior(lambda: {**_free(), "v": Uniform(0.3, 2), "phi": Uniform(-0.5, 0.8)})
    m.initial(lambda v, s, phi: {"x": Normal(WIDE, variance=v / (1 - phi**2) + s)})
    m.transition(lambda x, phi, v: {"x": Normal(phi * x, variance=v)})
    m.observation(_seen)


def survival(m):
    m.prior(lambda: {**_free(), "p": Uniform(0.1, 0.9)})
    m.initial(lambda p, s: {"x": Binomial(20, p / (p + s))})
    m.transition(lambda x, p: {"x": Binomial(x, p)})
    m.observation(lambda x: {"y": Poisson(x + 1)})


def detection(m):
    m.prior(lambda: {**_free(), "p": Beta(2, 2)})
    m.initial(lambda p, s: {"x": Binomial(20, p / (p + s))})
    m.transition(lambda x: {"x": Binomial(x, 0.8)})
    m.observation(lambda x, p: {"y": Binomial(x, p)})


def shares(m):
    m.prior(lambda: {**_free(), "p": Dirichlet([2.0, 1.0, 2.0])})
    m.initial(lambda p, s: {"x": Normal(np.tanh(p[0] - s * p[1]), sd=0.3)})
    m.transition(lambda x: {"x": Normal(0.5 * x, sd=1)})
    m.observation(lambda p: {"y": Categorical(p)})


def precision_matrix(m):
    m.prior(lambda: {**_free(), "P": Wishart(4, scale=0.4 * EYE)})
    m.initial(lambda P, s: {"x": MvNormal(EYE[0], covariance=np.linalg.inv(P) + s * EYE)})
    m.transition(lambda x, P: {"x": MvNormal(0.5 * x, precision=P)})
    m.observation(_seen)


def covariance_with_an_intercept(m):
    m.prior(lambda: {**_free(), "Q": InverseWishart(5, scale=EYE)})
    m.prior(lambda Q: {"c": MvNormal(np.zeros(2), covariance=Q)})
    m.initial(lambda Q, s: {"x": MvNormal(EYE[0], covariance=Q + s * EYE)})
    m.transition(lambda x, Q, c: {"x": MvNormal(c + 0.5 * x, covariance=Q)})
    m.observation(_seen)


MODELS = {
    precision: (("tau",), "Gamma"),
    normal: (("phi",), "Normal"),
    joint_normal: (("phi", "c"), "joint Normal"),
    scale_in_the_initial_law: (("phi", "tau"), "Normal-Gamma"),
    scale_of_two: (("phi", "c", "v"), "Normal-inverse-Gamma"),
    scale_in_a_prior: (("phi", "v"), "Normal-inverse-Gamma"),
    coefficient_in_the_initial_law: (("phi", "tau"), "Normal-Gamma"),
    within_bounds: (("phi", "v"), "Normal-inverse-Gamma"),
    survival: (("p",), "Beta"),
    detection: (("p",), "Beta"),
    shares: (("p",), "Dirichlet"),
    precision_matrix: (("P",), "Wishart"),
    covariance_with_an_intercept: (("c", "Q"), "matrix Normal-inverse-Wishart"),
}
LONG = (shares, precision_matrix, covariance_with_an_intercept)


@pytest.mark.parametrize(
    "declare",
    [pytest.param(f, marks=[pytest.mark.slow] * (f in LONG), id=f.__name__) for f in MODELS],
)
def test_a_draw_leaves_the_conditional_invariant(declare):
    model = Model(declare.__name__)
    declare(model)
    data = complete_data(trace(model))
    (update,) = [u for u in derive_updates(data.trace) if u.inseparable_terms]
    assert (update.block, update.family_name) == MODELS[declare]
    rng = np.random.default_rng(seed_of(declare.__name__))
    series = numerical_check.random_series(data, rng, steps=2)
    made = (Conditional(data, update, series, k) for k in range(numerical_check.POINTS))
    conditional = next(c for c in made if _near(*_weighted(c, 200, rng)))

    points, w = _weighted(conditional, 1_000 if declare in LONG else 4_000, rng)
    assert _near(points, w)
    step = partial(draw, update, conditional.totals)
    after = [step(v, conditional.rest, rng, conditional.log_joint)[0] for v in points]
    change = _functions(np.array(after)) - _functions(points)
    assert np.mean(np.any(change != 0.0, axis=1)) > 0.9
    mean = w @ change
    z = mean / np.sqrt(w**2 @ (change - mean) ** 2)
    print(np.round(z, 2))
    assert np.abs(z).max() < stats.norm.isf(LEVEL / (2 * len(z) * len(MODELS)))


def _functions(v):
    """Components, squares, sines and a product, (points, functions)."""
    return np.column_stack([v, np.sin(3.0 * v), np.abs(v) ** 0.5, v[:, 0] * v[:, -1]])


def _family_draw(conditional, rng):
    sampler = sampler_of(conditional.update)
    limits = sampler.limits(conditional.rest)
    found = sampler.conjugate([*conditional.totals.tolist(), 0.0], limits, rng)
    if found is None or not all(a <= x <= b for x, (a, b) in zip(found, limits, strict=False)):
        return None
    return np.array(found)


def _near(points, w):
    """Whether the family is near enough to the conditional for the weights to say something."""
    return len(points) > 0 and np.sum(w**2) * len(points) < 5.0


def _weighted(conditional, n, rng):
    """Draws of the family (n, d) inside the bounds, and their weights under the conditional."""
    sampler, c = sampler_of(conditional.update), [*conditional.totals.tolist(), 0.0]
    found = [v for _ in range(n) if (v := _family_draw(conditional, rng)) is not None]
    if not found:
        return np.empty(0), np.empty(0)
    corrections = [c[j] for j in sampler.corrections]
    log_w = np.array([
        conditional.log_joint(v) - sampler.log_density(v.tolist(), c)
        + (sampler.correct(v.tolist(), corrections) if corrections else 0.0)
        for v in found
    ])  # fmt: skip
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    return np.array(found), w
