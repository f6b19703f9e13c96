"""An MvNormal whose covariance has zeros off its diagonal is a Normal law of each component."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.language.distributions import MvNormal, Normal
from ssmppl.language.tracing import trace

SPELLINGS: dict[str, Callable] = {
    "np.diag": lambda m, v: ssm.MvNormal(m, covariance=np.diag(v)),
    "np.eye": lambda m, v: ssm.MvNormal(m, covariance=np.eye(2) * v),
    "block": lambda m, v: ssm.MvNormal(m, covariance=np.block([[v[0], 0.0], [0.0, v[1]]])),
    "precision": lambda m, v: ssm.MvNormal(m, precision=np.diag(1 / v)),
    "cholesky": lambda m, v: ssm.MvNormal(m, cholesky=np.diag(np.sqrt(v))),
    "cholesky of it": lambda m, v: ssm.MvNormal(m, cholesky=np.linalg.cholesky(np.diag(v))),
}


def model(law: Callable) -> ssm.Model:
    out = ssm.Model("two sensors")
    vague = ssm.InverseGamma(np.full(2, 2.0), scale=1.0)
    out.prior(lambda: {"q": vague, "r": vague})
    out.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1.0)})
    out.transition(lambda x, q: {"x": law(0.5 * x, q)})
    out.observation(lambda x, r: {"y": law(x, r)})
    return out


def data() -> dict[str, np.ndarray]:
    y = np.random.default_rng(0).standard_normal((30, 2))
    y[3, 0] = y[7, 1] = np.nan
    return {"y": y}


def scalar(m, v):
    return ssm.Normal(m, variance=v)


@pytest.mark.parametrize("spelling", list(SPELLINGS))
def test_components_are_independent(spelling: str):
    law = SPELLINGS[spelling]
    found, expected = (ssm.explain(model(which), data()) for which in (law, scalar))
    sites = [found.trace.transition["x"], found.trace.observations["y"]]
    assert all(isinstance(s.distribution, Normal) for s in sites)
    assert {s.distribution.location.line for s in sites} == {law.__code__.co_firstlineno}
    assert [u.family_name for u in found.updates] == ["inverse Gamma"] * 4
    if spelling not in ("precision", "cholesky", "cholesky of it"):  # these square a root
        assert [str(u.explanation) for u in found.updates] == [
            str(u.explanation) for u in expected.updates
        ]
    theta = {"q": [1.0, 2.0], "r": [0.5, 0.7]}
    for proposal in ("auto", "bootstrap", "guided"):
        values = [
            ssm.log_likelihood(model(which), data(), theta, proposal=proposal, seed=1)
            for which in (law, scalar)
        ]
        assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_the_same_draws():
    settings = {"draws": 20, "warmup": 20, "seed": 1, "progress": False}
    draws = [
        ssm.sample(model(law), data(), **settings).posterior
        for law in (SPELLINGS["np.diag"], scalar)
    ]
    for name in ("q", "r", "x"):
        assert np.array_equal(draws[0][name], draws[1][name])


def test_what_stays_joint():
    """A covariance between components, and a prior; of a variance of zero there is no Normal, and
    the component is Dirac."""
    out = ssm.Model("joint")
    out.prior(lambda: {"b": ssm.MvNormal(np.zeros(2), covariance=np.eye(2)), "q": ssm.HalfFlat()})
    out.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=[[1.0, 0.5], [0.5, 1.0]])})
    out.transition(lambda x, q: {"x": ssm.MvNormal(x, covariance=np.diag([1.0, 0.0]) * q)})
    out.observation(lambda x, b: {"y": ssm.Normal(x[0] + b[0], sd=1.0)})
    found = trace(out)
    for site in (found.parameters["b"], found.initial["x"]):
        assert isinstance(site.distribution, MvNormal)
    kinds = {n: type(s.distribution).__name__ for n, s in found.transition.items()}
    assert kinds == {"x[0]": "Normal", "x[1]": "Dirac"}
    theta = {"b": [0.0, 0.0], "q": 2.0}
    x = ssm.simulate(out, theta, steps=5, draws=3, seed=1)["x"].to_numpy()
    assert np.all(x[:, 1:, 1] == x[:, :-1, 1])
