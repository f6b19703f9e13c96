"""A vector of states whose covariance has rows of zeros: what has noise keeps its closed forms.

Held against the same model with every component a state of its own, those without noise Dirac: by
every verb, to the last digit, as both draw the same random numbers.
"""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.analysis.structure import deterministic_memory, linear_gaussian
from ssmppl.diagnosis.report.model_file import to_model
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.expressions.arrays import ExprArray
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol, symbols_of
from ssmppl.language.model.covariances import together
from ssmppl.language.model.trace import Trace
from ssmppl.language.tracing import trace

THETA = {"phi": np.array([0.5, 0.3]), "q": 0.4, "r": 0.2}
Y = np.random.default_rng(2).normal(size=30).cumsum() * 0.3
Y[[4, 5, 17]] = np.nan
DATA = {"y": Y}


def prior() -> dict[str, Any]:
    return {
        "phi": ssm.Normal(np.zeros(2), sd=0.5),
        "q": ssm.InverseGamma(3, scale=1),
        "r": ssm.InverseGamma(3, scale=0.5),
    }


def companion() -> ssm.Model:
    """An autoregression of order 2 as one vector: its value, and that of the row before."""
    model = ssm.Model("companion")
    model.prior(prior)
    model.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=np.diag([2.0, 1.0]))})

    def transition(x, phi, q):
        mean = np.stack([phi @ x, x[0]])
        return {"x": ssm.MvNormal(mean, covariance=q * np.outer([1.0, 0.0], [1.0, 0.0]))}

    model.transition(transition)
    model.observation(lambda x, r: {"y": ssm.Normal(x[0], variance=r)})
    return model


def by_components() -> ssm.Model:
    model = ssm.Model("components")
    model.prior(prior)
    model.initial(lambda: {"now": ssm.Normal(0, variance=2), "before": ssm.Normal(0, variance=1)})

    def transition(now, before, phi, q):
        ahead = phi[0] * now + phi[1] * before
        return {"now": ssm.Normal(ahead, variance=q), "before": ssm.Dirac(now)}

    model.transition(transition)
    model.observation(lambda now, r: {"y": ssm.Normal(now, variance=r)})
    return model


VALUES: dict[str, Callable[[ssm.Model], Any]] = {
    "kalman": lambda m: ssm.log_likelihood(m, DATA, THETA),
    "bootstrap": lambda m: ssm.log_likelihood(m, DATA, THETA, proposal="bootstrap", seed=1),
    "guided": lambda m: ssm.log_likelihood(m, DATA, THETA, proposal="guided", seed=1),
    "twisted": lambda m: ssm.log_likelihood(m, DATA, THETA, proposal="twisted", seed=1),
    "score": lambda m: ssm.score(m, DATA, THETA).gradient["q"],
    "maximize": lambda m: ssm.maximize(m, DATA, seed=1, progress=False).log_likelihood,
    "EM": lambda m: ssm.maximize(m, DATA, ssm.EM(), seed=1, progress=False).log_likelihood,
    "Gibbs": lambda m: _drawn(m, ssm.Gibbs()),
    "PGAS": lambda m: _drawn(m, ssm.PGAS(particles=10)),
    "MetropolisHastings": lambda m: _drawn(m, ssm.MetropolisHastings()),
}


def _drawn(model: ssm.Model, method: Any) -> np.ndarray:
    few = {"draws": 20, "warmup": 10, "chains": 2, "seed": 1, "progress": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # so few have not converged
        return ssm.sample(model, DATA, method, **few).posterior["q"].to_numpy()


@pytest.mark.parametrize("verb", VALUES)
def test_every_verb(verb: str):
    one, other = (VALUES[verb](make()) for make in (companion, by_components))
    np.testing.assert_allclose(one, other, rtol=1e-8)


def test_states_have_their_names_and_places():
    found, parts = (
        ssm.smooth(m(), DATA, THETA, trajectories=3, seed=1) for m in (companion, by_components)
    )
    for suffix in ("", "_sd", "_draw"):
        if "x" + suffix not in found:
            continue
        own = found["x" + suffix].to_numpy()
        for k, name in enumerate(("now", "before")):
            np.testing.assert_allclose(own[..., k], parts[name + suffix].to_numpy(), rtol=1e-8)


def numbers(matrix: ExprArray) -> np.ndarray:
    return np.array([evaluate(e, {}) for e in matrix.ravel()]).reshape(matrix.shape)


@pytest.mark.parametrize("noisy", [0, 1, 2])
def test_wherever_the_noise_stands(noisy: int):
    """The matrices of the model are those that were written, whichever rows are zero."""
    a = np.arange(9.0).reshape(3, 3) / 10.0
    q = np.zeros((3, 3))
    q[noisy, noisy] = 0.7
    start = np.diag([1.0, 0.0, 2.0])
    model = ssm.Model("any order")
    model.initial(lambda: {"x": ssm.MvNormal(np.ones(3), covariance=start)})
    model.transition(lambda x: {"x": ssm.MvNormal(a @ x, covariance=q)})
    model.observation(lambda x: {"y": ssm.Normal(x[2] - x[1], sd=1)})
    form = linear_gaussian(trace(model))
    for expected, found in ((start, form.P), (q, form.Q), (a, form.A)):
        np.testing.assert_array_equal(numbers(found), expected)
    drawn = ssm.simulate(model, {}, steps=3, draws=5, seed=1)["x"].to_numpy()
    assert np.all(drawn[:, 0, 1] == 1.0)
    still = [i for i in range(3) if i != noisy]
    np.testing.assert_allclose(drawn[:, 1:][..., still], (drawn[:, :-1] @ a.T)[..., still])


def test_two_noises_that_go_together():
    """What is left of a covariance without its zeros is a covariance of its own."""
    both = np.array([[2.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.5, 0.0, 1.0]])
    model = ssm.Model("two of three")
    model.prior(lambda: {"V": ssm.InverseWishart(5, scale=np.eye(2))})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(3), sd=1)})

    def transition(x, V):
        wide = np.zeros((3, 2))
        wide[0, 0] = wide[2, 1] = 1.0
        return {"x": ssm.MvNormal(0.5 * x, covariance=wide @ V @ wide.T)}

    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Normal(np.sum(x), sd=0.3)})
    (update,) = derive_updates(trace(model))
    assert update.family_name == "inverse Wishart"
    x = ssm.simulate(model, {"V": both[::2, ::2]}, steps=2, draws=20_000, seed=1)["x"].to_numpy()
    w = x[:, 1] - 0.5 * x[:, 0]
    d = np.diagonal(both)
    error = np.sqrt((both**2 + np.outer(d, d)) / len(w)) + 1e-12
    assert np.all(np.abs(w.T @ w / len(w) - both) < 4.5 * error)


def test_closed_forms_of_a_seasonal_vector():
    """13 states in one vector, more than a root is written out of: every variance is conjugate."""
    a = np.zeros((13, 13))
    a[0, 0] = a[0, 1] = a[1, 1] = 1.0
    a[2, 2:] = -1.0
    a[range(3, 13), range(2, 12)] = 1.0
    model = ssm.Model("basic structural model")
    names = ("ql", "qs", "qw", "r")
    model.prior(lambda: {n: ssm.InverseGamma(2, scale=1) for n in names})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(13), sd=1)})

    def transition(x, ql, qs, qw):
        variances = np.array([ql, qs, qw, *[0.0] * 10])
        return {"x": ssm.MvNormal(a @ x, covariance=np.diag(variances))}

    model.transition(transition)
    model.observation(lambda x, r: {"y": ssm.Normal(x[0] + x[2], variance=r)})
    traced = trace(model)
    assert [u.family_name for u in derive_updates(traced)] == ["inverse Gamma"] * 4
    assert deterministic_memory(traced) == 10
    assert "sample    Gibbs" in str(ssm.explain(model))


def test_new_values_of_what_has_no_noise():
    """`x_next` is the value itself there, so that what reads it may be filtered exactly."""
    model = ssm.Model("lagged")
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1), "z": ssm.Normal(0, sd=1)})

    def first(x):
        mean = np.stack([0.5 * x[0], x[0]])
        return {"x": ssm.MvNormal(mean, covariance=np.diag([1.0, 0.0]))}

    model.transition(first)
    model.transition(lambda z, x_next: {"z": ssm.Normal(z + x_next[0] + 2 * x_next[1], sd=1)})
    model.observation(lambda z: {"y": ssm.Normal(z, sd=1)})
    read = symbols_of(trace(model).transition["z"].distribution.arguments())
    assert symbol("state", "x", (0,)) in read
    assert symbol("state", "x", (1,)) not in read
    form = linear_gaussian(trace(model))
    assert numbers(form.A)[2].tolist() == [2.5, 0.0, 1.0]
    assert numbers(form.Q).tolist() == [[1, 0, 1], [0, 0, 0], [1, 0, 2]]


@pytest.mark.parametrize("role", ["observation", "prior", "proposal"])
def test_only_states_may_be_without_noise(role: str):
    model, singular = ssm.Model("refused"), np.diag([1.0, 0.0])
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x: {"x": ssm.MvNormal(x, covariance=singular)})
    model.observation(lambda x: {"z": ssm.Normal(x, sd=1)})
    name = {"observation": "y", "prior": "theta", "proposal": "x"}[role]
    getattr(model, role)(lambda: {name: ssm.MvNormal(np.zeros(2), covariance=singular)})
    with pytest.raises(ModelError, match=f"'{name}' in @{role} has a row of zeros") as caught:
        trace(model)
    assert caught.value.where.file == __file__


def test_parts_are_put_together_again():
    traced = trace(companion())
    assert list(traced.transition) == ["x[0]", "x[1]"]
    whole: Trace = together(traced)
    assert list(whole.transition) == ["x"]
    assert whole.transition["x"].shape == (2,)
    assert together(whole) is whole
    again = pickle.loads(pickle.dumps(traced))
    assert again.state_symbols == traced.state_symbols


def test_forecast_and_predict():
    few = {"draws": 30, "warmup": 20, "chains": 2, "seed": 1, "progress": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        idata = ssm.sample(companion(), DATA, **few)
    ahead = ssm.forecast(companion(), idata, steps=3, seed=1)
    assert ahead["y"].shape[-1] == 3
    assert np.all(np.isfinite(ahead["y"]))


@pytest.mark.slow
def test_the_diagnosis():
    """An autoregression of order 2 is diagnosed as one whose past is a state of its own."""
    found = [
        ssm.diagnose(m(), DATA, mode="fast", seed=1, progress=False)
        for m in (companion, by_components)
    ]
    assert found[0].verdict == found[1].verdict


def test_the_diagnosis_asks_for_states_of_their_own():
    model = ssm.Model("acceleration")
    model.prior(lambda: {"q": ssm.InverseGamma(3, scale=1)})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})

    def transition(x, q):
        return {"x": ssm.MvNormal(x, covariance=q * np.outer([0.5, 1.0], [0.5, 1.0]))}

    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Normal(x[0], sd=1)})
    with pytest.raises(ArgumentError, match=r"singular \(rank 1 of 2\)") as caught:
        ssm.diagnose(model, DATA, mode="fast", seed=1, progress=False)
    assert "ssm.Dirac" in caught.value.fix
    assert caught.value.where.file == __file__


def test_what_the_diagnosis_writes_is_the_model():
    """The file of a model has its vector as it was declared."""
    traced = trace(companion())
    again = trace(to_model(traced))
    assert [str(s.distribution) for s in again.transition.values()] == [
        str(s.distribution) for s in traced.transition.values()
    ]
