"""Covariances of too low a rank in the laws of states: white-noise acceleration, q G G'.

Held against the joint normal law of all states and data, written out in NumPy.
"""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import ssmppl as ssm
from ssmppl.analysis.structure import singular_covariance
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol, topological
from ssmppl.language.model.covariances import find_root
from ssmppl.language.tracing import trace

DT, ROWS = 0.5, 40
F = np.array([[1.0, DT], [0.0, 1.0]])
G = np.array([DT**2 / 2.0, DT])
START = np.diag([2.0, 1.5])


def acceleration(by_input: bool = False) -> ssm.Model:
    model = ssm.Model("white-noise acceleration", inputs=("dt",) if by_input else ())
    model.prior(lambda: {
        "q": ssm.InverseGamma(2, scale=1), "r": ssm.InverseGamma(2, scale=1)
    })  # fmt: skip
    model.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=START)})
    if by_input:

        def transition(x, q, dt):
            g = np.stack([dt**2 / 2, dt])
            mean = np.stack([x[0] + dt * x[1], x[1]])
            return {"x": ssm.MvNormal(mean, covariance=q * np.outer(g, g))}

        model.transition(transition)
    else:
        model.transition(lambda x, q: {"x": ssm.MvNormal(F @ x, covariance=q * np.outer(G, G))})
    model.observation(lambda x, r: {"y": ssm.Normal(x[0], variance=r)})
    return model


def data(by_input: bool = False) -> dict[str, np.ndarray]:
    y = np.cumsum(np.random.default_rng(1).standard_normal(ROWS))
    return {"y": y} | ({"dt": np.full(ROWS, DT)} if by_input else {})


def joint(q: float, r: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariances of the states (2 ROWS, 2 ROWS), of the data, and between them."""
    noise = np.kron(np.eye(ROWS), q * np.outer(G, G))
    noise[:2, :2] = START
    back = np.linalg.inv(np.eye(2 * ROWS) - np.kron(np.diag(np.ones(ROWS - 1), -1), F))
    x = back @ noise @ back.T
    c = np.kron(np.eye(ROWS), [[1.0, 0.0]])
    return x, c @ x @ c.T + r * np.eye(ROWS), x @ c.T


def log_density(q: float, r: float) -> float:
    cov = joint(q, r)[1]
    return float(scipy.stats.multivariate_normal(np.zeros(ROWS), cov).logpdf(data()["y"]))


BOTH = pytest.mark.parametrize("by_input", [False, True])


@BOTH
def test_likelihoods(by_input: bool):
    theta = {"q": 1.3, "r": 0.4}
    model, known = acceleration(by_input), data(by_input)
    expected = log_density(**theta)
    assert ssm.log_likelihood(model, known, theta) == pytest.approx(expected, rel=1e-10)
    log_z = ssm.log_likelihood(
        model, known, theta, proposal="bootstrap", particles=2000, repeats=100, seed=1
    )
    ratio = np.exp(log_z - expected)
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std(ddof=1) / 10.0


@BOTH
def test_maximize(by_input: bool):
    found = ssm.maximize(acceleration(by_input), data(by_input), seed=1, progress=False)
    best = scipy.optimize.minimize(
        lambda z: -log_density(*np.exp(z)), np.zeros(2), tol=1e-10, method="Nelder-Mead"
    )
    assert found.log_likelihood == pytest.approx(-best.fun, abs=1e-6)
    assert [found.parameters["q"], found.parameters["r"]] == pytest.approx(np.exp(best.x), rel=1e-3)


@BOTH
def test_smooth(by_input: bool):
    theta = {"q": 1.3, "r": 0.4}
    x, y, cross = joint(**theta)
    gain = np.linalg.solve(y, cross.T).T
    found = ssm.smooth(acceleration(by_input), data(by_input), theta)
    assert found["x"].to_numpy()[0] == pytest.approx(
        (gain @ data()["y"]).reshape(ROWS, 2), abs=1e-8
    )
    variance = np.diagonal(x - gain @ cross.T).reshape(ROWS, 2)
    assert found["x_sd"].to_numpy()[0] == pytest.approx(np.sqrt(variance), abs=1e-8)


@BOTH
def test_simulate(by_input: bool):
    theta, n = {"q": 1.3, "r": 0.4}, 4000
    inputs = {"dt": np.full(ROWS, DT)} if by_input else None
    found = ssm.simulate(
        acceleration(by_input), theta, steps=ROWS, inputs=inputs, draws=n, seed=1
    )["x"].to_numpy()  # fmt: skip
    w = found[:, 1:] - found[:, :-1] @ F.T
    assert w[..., 0] == pytest.approx(DT / 2 * w[..., 1], abs=1e-9)
    drawn = w[..., 1] / DT
    assert abs(drawn.var() / 1.3 - 1.0) < 4.0 * np.sqrt(2.0 / drawn.size)


@pytest.mark.slow
def test_sample():
    """Posterior means by MetropolisHastings, and by sums over a grid of log q and log r."""
    axis_q, axis_r = np.linspace(-4, 4, 81), np.linspace(-4, 2, 81)
    prior = scipy.stats.invgamma(2.0, scale=1.0)

    def log_posterior(a: float, b: float) -> float:
        q, r = np.exp(a), np.exp(b)
        return log_density(q, r) + prior.logpdf(q) + prior.logpdf(r) + a + b

    log_p = np.array([[log_posterior(a, b) for b in axis_r] for a in axis_q])
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    expected = np.array([p.sum(axis=1) @ axis_q, p.sum(axis=0) @ axis_r])
    idata = ssm.sample(acceleration(), data(), draws=4000, warmup=1000, seed=1, progress=False)
    assert idata.posterior.attrs["method"] == "MetropolisHastings"
    assert "singular (rank 1 of 2)" in idata.posterior.attrs["method_reason"]
    logs = np.log(np.stack([idata.posterior[n].to_numpy() for n in ("q", "r")]))
    ess = ssm.summary(idata, ["q", "r"])["ess_bulk"].to_numpy()
    error = logs.std(axis=(1, 2)) / np.sqrt(ess)
    assert np.all(np.abs(logs.mean(axis=(1, 2)) - expected) < 4.0 * error)
    x = idata.posterior["x"].to_numpy()
    w = x[:, :, 1:] - x[:, :, :-1] @ F.T
    assert w[..., 0] == pytest.approx(DT / 2 * w[..., 1], abs=1e-6)


@pytest.mark.parametrize(
    ("method", "instead"),
    [(ssm.Gibbs(), "MetropolisHastings"), (ssm.PGAS(), "MetropolisHastings"),
     (ssm.EM(), "DirectOptimization"), (ssm.ParticleEM(), "DirectOptimization"),
     (ssm.PSAEM(), "DirectOptimization"), (ssm.ScoreAscent(), "DirectOptimization"),
     (ssm.FFBSi(), "KalmanSmoother")],
)  # fmt: skip
def test_methods_that_need_a_density_are_refused_at_once(method, instead: str):
    model = acceleration()
    if isinstance(method, (ssm.Gibbs, ssm.PGAS)):
        run = partial(ssm.sample, model, data(), method, progress=False)
    elif isinstance(method, ssm.FFBSi):
        run = partial(ssm.smooth, model, data(), {"q": 1.0, "r": 1.0}, method)
    else:
        run = partial(ssm.maximize, model, data(), method, progress=False)
    with pytest.raises(ssm.ArgumentError, match=r"singular \(rank 1 of 2\)") as error:
        run()
    assert f"use ssm.{instead}()" in str(error.value)
    assert "ssm.Dirac" in str(error.value)


def test_the_methods_chosen_without_one_are_not_refused():
    """Of a model that is not linear: what needs a density is not chosen in the first place."""
    model = ssm.Model("nonlinear")
    model.prior(lambda: {"q": ssm.InverseGamma(2, scale=1)})
    model.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=START)})
    model.transition(lambda x, q: {"x": ssm.MvNormal(F @ x, covariance=q * np.outer(G, G))})
    model.observation(lambda x: {"y": ssm.Poisson(np.exp(x[1]))})
    y = {"y": np.array([1.0, 0.0, 2.0, 1.0])}
    plan = " ".join(str(ssm.explain(model, y)).split())
    reason = "the covariance in the transition of x is singular (rank 1 of 2)"
    for chosen in ("else PMMH", "smooth FFBSi"):
        assert f"{chosen}: {reason}" in plan
    assert "maximize DirectOptimization: the states have a Gaussian approximation" in plan
    smoothed = ssm.smooth(model, y, {"q": 1.0}, seed=1)
    assert smoothed.attrs["method"] == "FFBSi"
    w = smoothed["x"].values[:, 1:] - smoothed["x"].values[:, :-1] @ F.T
    assert w[..., 0] == pytest.approx(DT / 2 * w[..., 1], abs=1e-9)


def test_explain_says_why():
    text = " ".join(str(ssm.explain(acceleration(), data())).split())
    assert (
        "MetropolisHastings: the model is linear Gaussian, and the covariance in the transition"
        in text
    )
    assert "none the covariance in the transition of x is singular (rank 1 of 2)" in text


def test_ranks():
    """Noises that drive several states, in any order; a full rank is none of these."""

    def rank(matrix) -> str:
        model = ssm.Model("rank")
        model.prior(lambda: {"q": ssm.HalfFlat(), "s": ssm.HalfFlat()})
        model.initial(lambda: {"x": ssm.Normal(np.zeros(3), sd=1)})
        model.transition(lambda x, q, s: {"x": ssm.MvNormal(x, covariance=matrix(q, s))})
        model.observation(lambda x: {"y": ssm.Normal(x[0], sd=1)})
        found = singular_covariance(trace(model))
        return "" if found is None else found.reason

    a, b = np.array([0.5, 1.0, 2.0]), np.array([0.0, -1.0, 1.0])
    assert "rank 1 of 3" in rank(lambda q, s: q * np.outer(a, a) + s * np.outer(2 * a, a))
    assert "rank 2 of 3" in rank(lambda q, s: q * np.outer(a, a) + s * np.outer(b, b))
    assert not rank(lambda q, s: q * np.outer(a, a) + s * np.eye(3))
    # a component without noise is a site of its own
    assert "rank 1 of 2" in rank(lambda q, s: (q + s) * np.outer(b, b))
    assert not rank(lambda q, s: q * np.outer(a, a) + s * 1e-6 * np.eye(3))


def test_a_root_of_rank_two():
    rng = np.random.default_rng(2)
    g = rng.standard_normal((4, 2))
    g[1] = 2 * g[0]  # a pivot of zero between two others
    model = ssm.Model("two noises")
    model.prior(lambda: {"q": ssm.HalfFlat()})
    model.initial(lambda: {"x": ssm.Dirac(np.zeros(4))})
    model.transition(lambda x, q: {"x": ssm.MvNormal(np.zeros(4), covariance=q * (g @ g.T))})
    model.observation(lambda x: {"y": ssm.Normal(x[0], sd=1)})
    drawn = ssm.simulate(model, {"q": 2.0}, steps=2, draws=20_000, seed=1)["x"].to_numpy()[:, 1]
    expected = 2.0 * g @ g.T
    d = np.diagonal(expected)
    error = np.sqrt((expected**2 + np.outer(d, d)) / len(drawn))
    assert np.all(np.abs(drawn.T @ drawn / len(drawn) - expected) < 4.5 * error)


# -- another noise beyond the values that most parameters have
H = np.array([1.0, 0.5])
LAST_ALONE = 3  # t up to which there is one noise only


def switched() -> ssm.Model:
    model = ssm.Model("a second noise from the fifth row on")
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})

    def transition(t):
        second = np.where(t > LAST_ALONE, 1.0, 0.0) * np.eye(2)
        return {"x": ssm.MvNormal(np.zeros(2), covariance=0.1 * np.outer(H, H) + second)}

    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Normal(x[1], sd=0.5)})
    return model


def test_a_second_noise_in_later_rows():
    n = 20_000
    x = ssm.simulate(switched(), steps=8, draws=n, seed=1)["x"].to_numpy()
    for t in range(1, 8):  # of the step to row t + 1
        expected = 0.1 * np.outer(H, H) + (t > LAST_ALONE) * np.eye(2)
        d = np.diagonal(expected)
        error = np.sqrt((expected**2 + np.outer(d, d)) / n)
        assert np.all(np.abs(x[:, t].T @ x[:, t] / n - expected) < 4.5 * error)
    y = {"y": np.array([0.1, 0.0, -0.2, 0.1, 1.5, -1.0, 0.8, 2.0])}
    sd = np.sqrt([1.25, *3 * [0.275], *4 * [1.275]])
    exact = scipy.stats.norm(0.0, sd).logpdf(y["y"]).sum()
    assert ssm.log_likelihood(switched(), y, {}) == pytest.approx(exact)
    log_z = ssm.log_likelihood(switched(), y, {}, proposal="bootstrap", particles=2000,
                               repeats=100, seed=1)  # fmt: skip
    ratio = np.exp(log_z - exact)
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std(ddof=1) / 10.0
    assert "singular in some cases" in " ".join(str(ssm.explain(switched(), y)).split())


Q, U, V, T = (symbol("parameter", n) for n in "quvt")
ONE = Q * np.outer(H, H)
L = np.array([1.0, 3.0])
BEYOND = {  # a matrix, and values at which it has to be seen whole
    "a row": (ONE + np.where(T > 3, 1.0, 0.0) * np.eye(2), {T: [3, 4]}),
    "a negative value": (ONE + (np.abs(U) - U) * np.eye(2), {U: [-1e3, -0.1, 0, 2]}),
    "a threshold": (ONE + np.maximum(U - 18, 0) * np.eye(2), {U: [17, 18, 19, 1e4]}),
    "one far away": (ONE + np.maximum(U - 1e7, 0) * np.eye(2), {U: [1, 1e7, 2e7]}),
    "one value": (ONE + np.where(np.equal(U, 7), 1.0, 0.0) * np.eye(2), {U: [6, 7]}),
    "two in a sum": (ONE + np.where(U + V > 1000, 1.0, 0.0) * np.eye(2), {U: [1, 999], V: [0, 2]}),
    "the only noise": (np.where(T > 3, Q, 0.0) * np.outer(H, H), {T: [3, 4]}),
    "one or the other": (
        np.where(T > 3, Q, 0.0) * np.outer(H, H) + np.where(T <= 3, Q, 0.0) * np.outer(L, L),
        {T: [3, 4]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BEYOND)
def test_roots_hold_in_all_cases(name: str):
    matrix, special = BEYOND[name]
    law = ssm.MvNormal(np.zeros(2), covariance=matrix)
    find_root(law)
    assert law.root is not None
    for values in itertools.product([0.1, 3.0], *special.values()):
        at = dict(zip([Q, *special], values, strict=True))
        root, whole = evaluate(law.root, at), evaluate(array(matrix), at)
        assert root @ root.T == pytest.approx(whole, rel=1e-9, abs=1e-12)


def test_no_root_of_what_is_regular_beyond_moderate_values():
    law = ssm.MvNormal(np.zeros(2), covariance=ONE + np.exp(-60.0 - 100.0 * U) * np.eye(2))
    find_root(law)
    assert law.root is None


def test_roots_of_plain_covariances_have_no_cases():
    law = ssm.MvNormal(np.zeros(2), covariance=ONE)
    find_root(law)
    assert not any(e.op == "where" for e in topological(law.root.ravel()))
