"""The update of the varve model against Schön et al. (2015), section on Gibbs sampling, by hand.

    tau ~ Gamma(a + (T - 1)/2, b~),  phi | tau ~ N(., precision tau * sum_{t=2}^{T-1} x_t^2),
    b~ = b + 1/2 sum_{t=1}^T x_t^2 - 1/2 (sum_t x_{t+1} x_t)^2 / sum_{t=2}^{T-1} x_t^2,

phi truncated to (-1, 1), the pair accepted with probability sqrt(1 - phi^2).
"""

import pickle

import numpy as np
import pytest

from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol, to_text
from ssmppl.inference.updates.draw_update import MAX_TRIES, draw, sampler_of
from ssmppl.language.tracing import trace
from tests.analysis.conjugacy.corpus import build
from tests.statistics.checks import some

X, X_PREV = symbol("state", "x"), symbol("state_prev", "x")


@pytest.fixture(scope="module")
def update():
    model, *_ = build("varves")
    (only,) = derive_updates(trace(model))
    return only


def series(steps, seed=0, phi=0.9, tau=40.0):
    rng = np.random.default_rng(seed)
    x = [rng.normal() / np.sqrt(tau * (1 - phi**2))]
    for _ in range(steps - 1):
        x.append(phi * x[-1] + rng.normal() / np.sqrt(tau))
    return np.array(x)


def totals(update, x):
    out = []
    for i in range(len(update.functions)):
        c = {role: e[i] for role, e in update.coefficients.items()}
        moves = evaluate(c["transition"], {X: x[1:], X_PREV: x[:-1]})
        out.append(
            evaluate(c["prior"], {})
            + evaluate(c["initial"], {X: x[0]})
            + np.sum(np.broadcast_to(moves, len(x) - 1))
        )
    return np.array(out)


@pytest.mark.parametrize("steps", [5, 50, 300])
def test_shape_rate_mean_and_precision(update, steps):
    x = series(steps, seed=steps)
    c = [*totals(update, x), 0.0]
    family, normal = update.family, update.family.normal
    a = b = 0.01
    s_xx, s_xy = np.sum(x[1:-1] ** 2), np.sum(x[1:] * x[:-1])
    h, precision = normal.parameters(c)
    assert precision[0, 0] == pytest.approx(s_xx, rel=1e-12)
    assert h[0] / precision[0, 0] == pytest.approx(s_xy / s_xx, rel=1e-12)
    shape = (c[family.log] + 1) - 0.5
    assert shape == pytest.approx(a + (steps - 1) / 2, rel=1e-13)
    rate = -(c[family.pow] + h[0] ** 2 / (2 * precision[0, 0]))
    assert rate == pytest.approx(b + 0.5 * np.sum(x**2) - 0.5 * s_xy**2 / s_xx, rel=1e-10)


def test_correction_and_bounds(update):
    assert [to_text(update.functions[j]) for j in update.outside_family] == ["log(1 - phi**2)"]
    assert update.coefficients["initial"][update.outside_family[0]].data == 0.5
    assert sampler_of(update).limits({}) == [(-1.0, 1.0), (0.0, np.inf)]
    assert sampler_of(update).ceiling([*totals(update, series(50)), 0.0]) == 0.0


def test_explanation_reads_as_the_paper(update):
    text = str(update.explanation)
    for piece in (
        "(phi, tau) jointly",
        "shape = 0.01 + 0.5*(T - 1)",
        "precision = tau*H",
        "H = sum_{t=2}^{T-1} [x**2]",
        "tau: -0.01 - 0.5*sum_{t=1}^T [x**2]",
        "phi to (-1, 1)",
        "sqrt(1 - phi**2): the initial distribution of x",
        "corpus.py",
        "one-at-a-time updates when the joint distribution is improper (H or the rate not "
        "positive)",
    ):
        assert piece in text, text


def quadrature(update, c, phi, tau):
    """Weights on a grid, from the statistics."""
    p, t = np.meshgrid(phi, tau, indexing="ij")
    values = dict(zip(update.components, (p, t), strict=True))
    logs = sum(ci * evaluate(f, values) for ci, f in zip(c, update.functions, strict=True))
    w = np.exp(logs - logs.max()) * t  # tau on a log grid
    return p, t, w / w.sum()


# Statistics of log(tau), phi**2*tau, phi*tau and tau, or the length of a series to take them from.
CASES = {
    "long": (60, "conjugate"),
    "short": (6, "both"),
    "no precision": ([3.0, 0.0, 0.4, -2.0], "slice"),
    "negative precision": ([3.0, 0.3, 0.4, -2.0], "slice"),
    "no rate": ([3.0, -1.0, 3.0, -2.2], "slice"),
    "all outside": ([8.0, -50.0, 140.0, -99.0], "slice"),
    "half outside": ([8.0, -50.0, 100.0, -51.0], "conjugate"),
}


@pytest.mark.parametrize("name", some(CASES, 3))
def test_moments_on_every_route(update, name):
    given, route = CASES[name]
    if isinstance(given, int):
        c = totals(update, series(given, seed=3))
    else:
        c = np.array([0.5, *given])
    rng = np.random.default_rng(1)
    value, draws, infos = np.array([0.5, 20.0]), [], []
    for _ in range(6000):
        for _ in range(1 if route == "conjugate" else 4):
            value, info = draw(update, c, value, {}, rng)
        draws.append(value)
        infos.append(info)
    routes = {i.route for i in infos}
    assert routes == ({"conjugate", "slice"} if route == "both" else {route})
    assert max(i.tries for i in infos) == MAX_TRIES or name != "all outside"
    draws = np.array(draws)
    assert np.all(np.abs(draws[:, 0]) < 1.0)
    low, high = np.log(draws[:, 1].min()) - 4, np.log(draws[:, 1].max()) + 2
    phi = np.tanh(np.linspace(-9, 9, 1501))
    p, t, w = quadrature(update, c, phi, np.exp(np.linspace(low, high, 1000)))
    w = w * (1 - p**2)
    w = w / w.sum()
    for f in (
        lambda p, t: p,
        lambda p, t: np.log(t),
        lambda p, t: p * np.log(t),
        lambda p, t: p**2,
    ):
        exact, sample = np.sum(w * f(p, t)), f(*draws.T)
        error = batch_error(sample)
        assert abs(sample.mean() - exact) < 4.5 * error, (exact, sample.mean(), error)


def batch_error(sample, batches=50):
    """Standard error of the mean of dependent draws, by the means of batches."""
    means = sample.reshape(batches, -1).mean(1)
    return means.std(ddof=1) / np.sqrt(batches)


def test_pickles_and_draws_the_same(update):
    other = pickle.loads(pickle.dumps(update))
    c = totals(update, series(50))
    start = np.array([0.5, 20.0])
    one, _ = draw(update, c, start, {}, np.random.default_rng(5))
    two, _ = draw(other, c, start, {}, np.random.default_rng(5))
    assert np.array_equal(one, two)
