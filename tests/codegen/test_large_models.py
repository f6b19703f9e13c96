"""What is done for a model grows as the model does: counted, not timed.

A factor model with twice the series has twice the loadings; each part of an expression is written
into a comment once, and each draw of random numbers that updates are checked at is for all of them.
"""

from __future__ import annotations

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.conjugacy import numerical_check, search
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.analysis.conjugacy.separation import complete_data
from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.proposals import derive
from ssmppl.errors import NotApplicable
from ssmppl.expressions import expr
from ssmppl.language.tracing import trace


def factors(states: int, series: int) -> ssm.Model:
    model = ssm.Model(f"factors {states} {series}")
    model.prior(lambda: {
        "C": ssm.Normal(np.zeros((series, states)), sd=1),
        "r": ssm.InverseGamma(np.full(series, 2.0), scale=1),
    })  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(np.zeros(states), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.8 * x, sd=0.5)})
    model.observation(lambda x, C, r: {"y": ssm.Normal(C @ x, variance=r)})
    return model


def called(monkeypatch, module, name, run) -> list:
    """The first argument of each call of a function."""
    calls, original = [], getattr(module, name)

    def noting(*args, **kwargs):
        calls.append(args[0])
        return original(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(module, name, noting)
        run()
    return calls


def test_comments(monkeypatch):
    """Of every section's functions: no part of them is written twice."""
    model = factors(3, 12)
    calls = called(monkeypatch, expr, "_written", lambda: ssm.compile(model))
    assert len(calls) > 1000
    assert len(calls) < 1.5 * len(set(calls))


def test_updates(monkeypatch):
    points, tried = {}, {}
    for k in (5, 10):
        data = trace(factors(2, k))
        drawn = called(
            monkeypatch, numerical_check, "random_series", lambda data=data: derive_updates(data)
        )
        points[k] = len(drawn)
        tried[k] = len(
            called(monkeypatch, search, "separate_block", lambda data=data: derive_updates(data))
        )
        terms = complete_data(data).terms
        assert sum(t.role == "observation" for t in terms) == k  # of each channel
    assert points[5] == points[10]
    assert tried[10] <= 2.2 * tried[5]


@pytest.mark.parametrize(("states", "series", "written"), [(2, 20, True), (2, 100, False)])
def test_proposals_of_many_channels_are_not_written_out(states, series, written):
    found = derive(trace(factors(states, series)), Missing(none=True))
    assert isinstance(found["guided"], NotApplicable) is not written
    if not written:
        assert "100 observed components and 2 states" in found["guided"].reason


@pytest.mark.parametrize("law", ["counts", "levels"])
def test_many_channels_with_a_state_each_are_written_out(law):
    """What counts is what there is to write: here each channel has one state."""
    n = 60
    model = ssm.Model(f"sixty {law}")
    model.initial(lambda: {"x": ssm.Normal(np.zeros(n), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(np.sin(x), sd=0.3)})
    if law == "counts":
        model.observation(lambda x: {"y": ssm.Poisson(np.exp(x))})
    else:
        model.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    assert not isinstance(derive(trace(model), Missing(none=True))["guided"], NotApplicable)


def test_counts_of_many_factors_are_not_written_out():
    model = ssm.Model("counts of factors")
    loadings = np.random.default_rng(1).normal(size=(60, 20))
    model.initial(lambda: {"x": ssm.Normal(np.zeros(20), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.8 * x, sd=0.5)})
    model.observation(lambda x: {"y": ssm.Poisson(np.exp(loadings @ x))})
    found = derive(trace(model), Missing(none=True))["guided"]
    assert isinstance(found, NotApplicable)
    assert "60 observed components and 20 states" in found.reason
