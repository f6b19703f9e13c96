"""Derived proposals, run by the interpreter, against conditional Gaussians and quadrature."""

import itertools
import math

import numpy as np
import pytest
import scipy.stats as st
from scipy.integrate import quad

import ssmppl.language.distributions as D
from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.proposals import DEFENSIVE, bootstrap, derive
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import previous, seen
from ssmppl.language.tracing import trace

DRAWS = 200_000


def model_of(initial, transition, observation, proposal=None, inputs=()):
    model = Model("case", inputs=inputs)
    model.initial(initial)
    model.transition(transition)
    if observation is not None:
        model.observation(observation)
    if proposal is not None:
        model.proposal(proposal)
    return trace(model)


def values(traced, x_prev=(), y=(), mask=None):
    out = {previous(s): v for s, v in zip(traced.state_symbols, x_prev, strict=bool(x_prev))}
    for k, (s, v) in enumerate(zip(traced.observation_symbols, y, strict=True)):
        out[s] = v
        out[seen(s)] = 1.0 if mask is None else float(mask[k])
    return out


def total(weight, known):
    """Log weight: the terms whose guards hold."""
    return sum(np.asarray(v) for v in evaluate([w.guarded() for w in weight], known))


def drawn(draws, traced, known, seed=0, size=DRAWS):
    """(D, size) draws of the states."""
    roots = [draws[s] for s in traced.state_symbols]
    out = evaluate(roots, known, numpy_draws(np.random.default_rng(seed), (size,)))
    return np.array([np.broadcast_to(v, (size,)) for v in out])


def same_moments(sample, mean, covariance):
    """Within five standard errors, each."""
    n = sample.shape[1]
    se = np.sqrt(np.diag(covariance) / n)
    assert np.all(np.abs(sample.mean(axis=1) - mean) <= 5 * se + 1e-12)
    found = np.cov(sample).reshape(covariance.shape)
    spread = np.sqrt((np.outer(np.diag(covariance), np.diag(covariance)) + covariance**2) / n)
    assert np.all(np.abs(found - covariance) <= 5 * spread + 1e-12)


def conditional(mean, q, h, d, r, y, mask):
    """Moments of x given the measured y = h x + d + N(0, r); log p(y)."""
    keep = np.flatnonzero(mask)
    if not len(keep):
        return mean, q, 0.0
    h, d, r, y = h[keep], d[keep], r[np.ix_(keep, keep)], np.asarray(y)[keep]
    s = h @ q @ h.T + r
    gain = q @ h.T @ np.linalg.inv(s)
    log_p = st.multivariate_normal(h @ mean + d, s).logpdf(y)
    return mean + gain @ (y - h @ mean - d), q - gain @ h @ q, log_p


# -- tier 2
Q = np.array([[0.8, 0.3], [0.3, 0.5]])
P = np.array([[2.0, -0.4], [-0.4, 1.0]])
R = np.array([[0.4, 0.1, 0.0], [0.1, 0.6, 0.2], [0.0, 0.2, 0.3]])
H = np.array([[1.0, 0.0], [0.5, -1.0], [0.0, 2.0]])
OFFSET = np.array([0.1, 0.0, -0.3])


def vector_model():
    """Nonlinear drift, correlated noise, a vector channel and a scalar one."""
    return model_of(
        lambda: {"x": D.MvNormal(np.array([0.5, -0.5]), covariance=P)},
        lambda x: {"x": D.MvNormal(np.stack([np.sin(x[0]), x[0] * x[1]]), covariance=Q)},
        lambda x: {"y": D.MvNormal(H @ x + OFFSET, covariance=R), "z": D.Normal(x[0] - 1, sd=0.7)},
    )


@pytest.mark.parametrize("mask", [None, *itertools.product([0, 1], repeat=4)])
def test_locally_optimal(mask):
    traced = vector_model()
    partial = Missing(False, frozenset({"y"})) if mask is not None else Missing(none=True)
    found = derive(traced, partial)
    guided, auxiliary = found["guided"], found["auxiliary"]
    assert guided.explanation.startswith("locally optimal")
    assert auxiliary.exact_look_ahead
    assert guided.look_ahead is None
    y, x_prev = [0.7, -0.2, 1.1, -0.5], [0.4, 0.9]
    known = values(traced, x_prev, y, mask)
    h, d = np.vstack([H, [1.0, 0.0]]), np.append(OFFSET, -1.0)
    r = np.zeros((4, 4))
    r[:3, :3], r[3, 3] = R, 0.49
    full = np.ones(4) if mask is None else np.array(mask)
    f = np.array([np.sin(0.4), 0.36])
    mean, covariance, log_p = conditional(f, Q, h, d, r, y, full)
    size = DRAWS if mask is None or sum(mask) == 2 else 20_000
    same_moments(drawn(guided.draw, traced, known, size=size), mean, covariance)
    # the weight is p(y_t | x_{t-1}), whatever was drawn: no state occurs in it
    assert float(total(guided.weight, known)) == pytest.approx(log_p, abs=1e-10)
    assert float(evaluate(auxiliary.look_ahead, known)) == pytest.approx(log_p, abs=1e-10)
    mean, covariance, log_p = conditional(np.array([0.5, -0.5]), P, h, d, r, y, full)
    same_moments(drawn(guided.initial_draw, traced, known, 1, size), mean, covariance)
    assert float(total(guided.initial_weight, known)) == pytest.approx(log_p, abs=1e-10)


@pytest.mark.parametrize("mask", [None, (0,), (1,)])
def test_locally_optimal_beside_a_deterministic_component(mask):
    """y sees position and speed, the position is a function of the past."""
    traced = model_of(
        lambda: {"v": D.Normal(0.3, sd=0.8), "p": D.Dirac(1.0)},
        lambda p, v: {"p": D.Dirac(p + 0.5 * v), "v": D.Normal(0.9 * v - np.sin(p), sd=0.6)},
        lambda p, v: {"y": D.Normal(np.exp(p) + 2 * v, variance=0.3)},
    )
    found = derive(traced, Missing(none=mask is None))
    p, v = 0.2, -0.4
    known = values(traced, [v, p], [1.9], mask)
    full = np.ones(1) if mask is None else np.array(mask)
    position = p + 0.5 * v
    mean, covariance, log_p = conditional(
        np.array([0.9 * v - np.sin(p)]), np.array([[0.36]]), np.array([[2.0]]),
        np.array([np.exp(position)]), np.array([[0.3]]), [1.9], full,
    )  # fmt: skip
    sample = drawn(found["guided"].draw, traced, known)
    np.testing.assert_allclose(sample[1], position)
    same_moments(sample[:1], mean, covariance)
    after = known | {traced.state_symbols[1]: position}
    assert float(total(found["guided"].weight, after)) == pytest.approx(log_p, abs=1e-10)
    # the look-ahead comes before the move, so it names no x_t at all
    assert float(evaluate(found["auxiliary"].look_ahead, known)) == pytest.approx(log_p, abs=1e-10)


def test_locally_optimal_beside_a_random_component():
    """The other state is drawn first; the weight is given it, and nothing can look ahead."""
    traced = model_of(
        lambda: {"x": D.Normal(0, sd=1), "s": D.Gamma(2, rate=1)},
        lambda x, s: {"x": D.Normal(0.5 * x, sd=1), "s": D.Gamma(1 + s, rate=2)},
        lambda x, s: {"y": D.Normal(x + s, variance=s)},
    )
    found = derive(traced, Missing(none=True))
    known = values(traced, [0.6, 1.5], [2.0])
    sample = drawn(found["guided"].draw, traced, known)
    s = sample[1]
    assert st.kstest(s, st.gamma(2.5, scale=0.5).cdf).pvalue > 1e-4
    gain = 1 / (1 + s)
    z = (sample[0] - 0.3 - gain * (2.0 - 0.3 - s)) / np.sqrt(1 - gain)
    assert st.kstest(z, st.norm.cdf).pvalue > 1e-4
    weight = total(found["guided"].weight, known | {traced.state_symbols[1]: s[:50]})
    np.testing.assert_allclose(weight, st.norm(0.3 + s[:50], np.sqrt(1 + s[:50])).logpdf(2.0))
    assert "stands between" in found["auxiliary"].reason


# -- tier 3
LAPLACE = {
    "poisson": (lambda x: {"y": D.Poisson(np.exp(x))}, 6.0, st.poisson, lambda x: (np.exp(x),)),
    "binomial": (lambda x: {"y": D.Binomial(20, 1 / (1 + np.exp(-x)))}, 13.0, st.binom,
                 lambda x: (20, 1 / (1 + np.exp(-x)))),
    "varves": (lambda x: {"y": D.Gamma(6.25, rate=0.256 * np.exp(-x))}, 40.0, st.gamma,
               lambda x: (6.25, 0, np.exp(x) / 0.256)),
    "volatility": (lambda x: {"y": D.Normal(0, sd=np.exp(x / 2))}, 2.5, st.norm,
                   lambda x: (0, np.exp(x / 2))),
    "cube": (lambda x: {"y": D.Normal(x + 0.05 * x**3, sd=0.5)}, 1.7, st.norm,
             lambda x: (x + 0.05 * x**3, 0.5)),
}  # fmt: skip
DRIFT, SPREAD = 0.8, 0.6


def laplace_case(name):
    observation, y, law, arguments = LAPLACE[name]
    traced = model_of(
        lambda: {"x": D.Normal(0, sd=1)},
        lambda x: {"x": D.Normal(DRIFT * x, sd=SPREAD)},
        observation,
    )
    density = getattr(law, "logpmf", None) or law.logpdf
    return traced, y, lambda x: density(y, *arguments(x))


def log_ratio(proposal):
    """The last term of a Laplace proposal's weight is log (f / q)(x_t | x_{t-1}, y_t)."""
    return proposal.weight[-1].log_density


@pytest.mark.parametrize("x_prev", [-1.0, 0.5, 2.0])
@pytest.mark.parametrize("name", LAPLACE)
def test_laplace(name, x_prev):
    traced, y, log_g = laplace_case(name)
    found = derive(traced, Missing(none=True))
    guided, auxiliary = found["guided"], found["auxiliary"]
    assert guided.explanation.startswith("Laplace")
    known, (x,) = values(traced, [x_prev], [y]), traced.state_symbols
    f = st.norm(DRIFT * x_prev, SPREAD)

    def q(at):
        return np.exp(f.logpdf(at) - evaluate(log_ratio(guided), known | {x: at}))

    assert quad(q, f.mean() - 9, f.mean() + 9, points=[f.mean()], limit=400)[0] == pytest.approx(
        1.0, abs=1e-6
    )
    grid = np.linspace(f.mean() - 2.5, f.mean() + 2.5, 41)
    weight = total(guided.weight, known | {x: grid})
    np.testing.assert_allclose(weight, f.logpdf(grid) + log_g(grid) - np.log(q(grid)), atol=1e-9)
    # the transition's share bounds the weight: f / q <= 1 / share
    assert np.all(weight - log_g(grid) <= -math.log(DEFENSIVE) + 1e-12)
    # what is drawn has density q
    edges = np.linspace(f.mean() - 6, f.mean() + 6, 40_001)
    density = q(edges)
    cdf = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(edges))])
    sample = drawn(guided.draw, traced, known, size=20_000)[0]
    assert st.kstest(sample, lambda v: np.interp(v, edges, cdf)).pvalue > 1e-4
    # the look-ahead is about the log of the exact integral
    exact = math.log(
        quad(lambda v: np.exp(f.logpdf(v) + log_g(v)), f.mean() - 6, f.mean() + 6, limit=400)[0]
    )
    assert float(evaluate(auxiliary.look_ahead, known)) == pytest.approx(exact, abs=0.1)
    # and the proposal is close to the law that it stands for
    p = np.exp(f.logpdf(edges) + log_g(edges) - exact)
    overlap = np.sum(np.minimum(p, density)) * (edges[1] - edges[0])
    assert overlap > 0.85


def test_laplace_where_nothing_was_measured():
    """A missing row: q is the transition and the weight is one."""
    traced, *_ = laplace_case("poisson")
    guided = derive(traced, Missing())["guided"]
    known, (x,) = values(traced, [0.7], [0.0], (0,)), traced.state_symbols
    grid = np.linspace(-1, 2, 9)
    np.testing.assert_allclose(total(guided.weight, known | {x: grid}), 0.0, atol=1e-12)
    same_moments(
        drawn(guided.draw, traced, known), np.array([DRIFT * 0.7]), np.array([[SPREAD**2]])
    )


def test_laplace_of_a_vector():
    """Two states seen through counts; correlated noise; one channel may be missing."""
    traced = model_of(
        lambda: {"x": D.Normal(np.zeros(2), sd=1)},
        lambda x: {"x": D.MvNormal(0.9 * x, covariance=Q)},
        lambda x: {"n": D.Poisson(np.exp(x[0] + 0.5 * x[1])), "m": D.Poisson(np.exp(x[1]))},
    )
    found = derive(traced, Missing())
    for mask in ((1, 1), (1, 0), (0, 0)):
        known = values(traced, [0.3, -0.2], [4.0, 1.0], mask)
        step = 0.04
        axis = np.arange(-4, 4, step)
        grid = dict(zip(traced.state_symbols, np.meshgrid(axis, axis), strict=True))
        a, b = grid.values()
        f = st.multivariate_normal([0.27, -0.18], Q).logpdf(np.stack([a, b], axis=-1))
        log_density = f - evaluate(log_ratio(found["guided"]), known | grid)
        assert np.exp(log_density).sum() * step**2 == pytest.approx(1.0, abs=1e-4)
        g = mask[0] * st.poisson(np.exp(a + b / 2)).logpmf(4) + mask[1] * st.poisson(
            np.exp(b)
        ).logpmf(1)
        np.testing.assert_allclose(
            total(found["guided"].weight, known | grid), f + g - log_density, atol=1e-7
        )
        exact = np.log(np.exp(f + g).sum() * step**2)
        assert float(evaluate(found["auxiliary"].look_ahead, known)) == pytest.approx(
            exact, abs=0.1
        )


def test_laplace_where_the_density_is_not_concave():
    """A precise measurement of x^2 far from its mode: still a density, still the right ratio."""
    traced = model_of(
        lambda: {"x": D.Normal(0, sd=1)},
        lambda x: {"x": D.Normal(x, sd=1)},
        lambda x: {"y": D.Normal(x**2, sd=0.1)},
    )
    guided = derive(traced, Missing(none=True))["guided"]
    (x,) = traced.state_symbols
    for x_prev in (0.0, 0.01, 3.0):
        known = values(traced, [x_prev], [2.0])
        edges = np.linspace(x_prev - 9, x_prev + 9, 100_001)
        log_f = st.norm(x_prev, 1).logpdf(edges)
        density = np.exp(log_f - evaluate(log_ratio(guided), known | {x: edges}))
        assert np.sum(density) * (edges[1] - edges[0]) == pytest.approx(1.0, abs=1e-5)


def test_laplace_far_from_the_transition():
    """An observation a hundred standard deviations away: the weight is right on the log scale."""
    traced = model_of(
        lambda: {"x": D.Normal(0, sd=0.1)},
        lambda x: {"x": D.Normal(x, sd=0.1)},
        lambda x: {"y": D.StudentT(50, x, scale=0.1)},
    )
    guided = derive(traced, Missing(none=True))["guided"]
    (x,) = traced.state_symbols
    known, at = values(traced, [0.0], [10.0]), np.array([4.0, 5.0, 6.0])
    fitted = st.norm(*_fit(guided, known))
    expected = st.norm(0, 0.1).logpdf(at) - fitted.logpdf(at) - math.log(1 - DEFENSIVE)
    np.testing.assert_allclose(evaluate(log_ratio(guided), known | {x: at}), expected, rtol=1e-9)


def _fit(proposal, known):
    """Mean and standard deviation of the Gaussian that a scalar Laplace proposal fits."""
    mode, root = (float(evaluate(e, known)) for e in proposal.fit)
    return mode, 1.0 / root


# -- the user's own
def test_override():
    traced = model_of(
        lambda: {"x": D.Normal(0, sd=1)},
        lambda x: {"x": D.Normal(0.5 * x, sd=1)},
        lambda x: {"y": D.StudentT(4, x, scale=0.3), "z": D.Normal(x, sd=2)},
        proposal=lambda x, y: {"x": D.Normal((x + y) / 2, sd=0.8)},
    )
    (x,), grid = traced.state_symbols, np.linspace(-2, 3, 11)
    f, q = st.norm(0.2, 1.0).logpdf(grid), st.norm(0.85, 0.8).logpdf(grid)
    g_y, g_z = st.t(4, grid, 0.3).logpdf(1.3), st.norm(grid, 2).logpdf(0.9)
    for missing, mask, expected in (
        (Missing(none=True), None, g_y + g_z + f - q),
        (Missing(), (1, 1), g_y + g_z + f - q),
        (Missing(), (1, 0), g_y + f - q),
        (Missing(), (0, 1), g_z),  # y, which it names, is missing: the transition
        (Missing(), (0, 0), 0 * grid),
    ):
        own = derive(traced, missing)["user"]
        known = values(traced, [0.4], [1.3, 0.9], mask)
        np.testing.assert_allclose(total(own.weight, known | {x: grid}), expected, atol=1e-12)
        used = mask is None or mask[0]
        same_moments(
            drawn(own.draw, traced, known),
            np.array([0.85 if used else 0.2]),
            np.array([[0.64 if used else 1.0]]),
        )
        same_moments(drawn(own.initial_draw, traced, known), np.zeros(1), np.eye(1))


# -- the transition itself, and what cannot be derived
def test_bootstrap():
    traced = vector_model()
    p = bootstrap(traced, Missing(False, frozenset({"y"})))
    y, x_prev = [0.7, -0.2, 1.1, -0.5], [0.4, 0.9]
    at = np.array([0.3, -0.8])
    for mask in itertools.product([0, 1], repeat=4):
        known = values(traced, x_prev, y, mask)
        known |= dict(zip(traced.state_symbols, at, strict=True))
        keep = np.flatnonzero(mask[:3])
        expected = mask[3] * st.norm(-0.7, 0.7).logpdf(-0.5)
        if len(keep):
            law = st.multivariate_normal((H @ at + OFFSET)[keep], R[np.ix_(keep, keep)])
            expected += law.logpdf(np.array(y)[keep])
        assert float(total(p.weight, known)) == pytest.approx(expected, abs=1e-10)
    same_moments(drawn(p.draw, traced, known), np.array([np.sin(0.4), 0.36]), Q)


REASONS = {
    "no Gaussian state": (
        lambda x: {"x": D.Laplace(x, scale=1)}, lambda x: {"y": D.Normal(x, sd=1)},
        "no state has a Gaussian transition", "Laplace",
    ),
    "no dependence": (
        lambda x: {"x": D.Normal(x, sd=1)}, lambda x: {"y": D.Normal(0.0 * x, sd=1)},
        "does not depend on the states", "0.0 * x",
    ),
    "no second derivative": (
        lambda x: {"x": D.Normal(x, sd=1)},
        lambda x: {"y": D.Truncated(D.Gamma(np.exp(x), rate=1), lower=1)},
        "not twice differentiable", "Truncated",
    ),
    "no curvature": (
        lambda x: {"x": D.Normal(x, sd=1)}, lambda x: {"y": D.Laplace(x, scale=1)},
        "no curvature", "Laplace(x",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REASONS)
def test_reasons(name):
    transition, observation, words, line = REASONS[name]
    traced = model_of(lambda: {"x": D.Normal(0, sd=1)}, transition, observation)
    found = derive(traced, Missing(none=True))
    for proposal in (found["guided"], found["auxiliary"]):
        assert isinstance(proposal, NotApplicable)
        assert words in proposal.reason
        assert line in proposal.where.text
    assert not isinstance(found["bootstrap"], NotApplicable)


def test_without_observations():
    traced = model_of(lambda: {"x": D.Normal(0, sd=1)}, lambda x: {"x": D.Normal(x, sd=1)}, None)
    assert derive(traced, Missing())["guided"].reason == "there is no observation"
    assert symbol("state", "x") in derive(traced, Missing())["bootstrap"].draw
