"""Models that call what has no derivative: which of them can be diagnosed, told at once."""

import math
import time

import pytest

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.differentiable import check_differentiable
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.errors import ModelError
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import symbol
from ssmppl.language.tracing import trace
from tests.diagnosis.every import MODELS, candidates, traced
from tests.diagnosis.harness import scales


@ssm.primitive
def bent(x):
    return math.tanh(x)


@ssm.primitive
def times(x, k):
    return x * k


@ssm.primitive
def size(a):
    return math.exp(a)


def calling(where):
    """A state x, an input u, a gain k, and a primitive somewhere."""
    model = ssm.Model(where, inputs=("u",))

    @model.prior
    def prior():
        return {"k": ssm.Normal(0, sd=1), "q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial(k):
        mean = {"start": size(k), "start by state": times(2.0, k)}.get(where, 0.0)
        return {"x": ssm.Normal(mean, sd=1), "w": ssm.Dirac(mean)}

    @model.transition
    def transition(x, w, u, k, q):
        mean = {
            "input": lambda: 0.8 * x + k * bent(u),
            "state": lambda: 0.8 * bent(x) + k * u,
            "gain of the input": lambda: 0.8 * x + times(u, k),
            "gain of the state": lambda: times(x, k) + u,
        }.get(where, lambda: 0.8 * x + k * u)()
        other = {
            "what k moves": lambda: bent(w) + k * u,
            "what nothing moves": lambda: bent(w),
            "what u moves": lambda: bent(w + u),
        }.get(where, lambda: 0.5 * w)()
        return {"x": ssm.Normal(mean, sd=size(q) if where == "scale" else q),
                "w": ssm.Dirac(other)}  # fmt: skip

    @model.observation
    def observation(x, w, k, r):
        mean = {
            "sensor": lambda: bent(x),
            "gain of the sensor": lambda: times(x, k),
        }.get(where, lambda: x + w)()
        return {"y": ssm.Normal(mean, sd=r)}

    return model


@pytest.mark.parametrize(
    ("where", "law"),
    [
        ("gain of the input", "the transition of x"),
        ("gain of the state", "the transition of x"),
        ("what k moves", "the transition of w"),
        ("gain of the sensor", "the observation of y"),
    ],
)
def test_a_free_parameter_without_a_derivative_is_named_with_its_line(where, law):
    with pytest.raises(ModelError) as caught:
        check_differentiable(trace(calling(where)))
    told = caught.value
    name = "bent" if where == "what k moves" else "times"
    assert told.found == (
        f"diagnose needs the derivatives of {law} in k, and {name}() is an @ssm.primitive, which "
        "has none"
    )
    assert "NumPy functions" in told.fix
    assert "fixed=" in told.fix
    assert told.where.file == __file__
    assert check_differentiable(trace(calling(where)), fixed={"k": 0.5}) is None


@pytest.mark.parametrize(
    "where",
    ["input", "state", "sensor", "scale", "start", "start by state", "what nothing moves",
     "what u moves"],
)  # fmt: skip
def test_what_needs_no_derivative_of_it_is_let_through(where):
    """And what is asked of the screen has its scores, or the reason why one has none."""
    t = trace(calling(where))
    check_differentiable(t)
    own = list({c.group: c.increment for c in reversed(offers(t, scales(t))[0])}.values())
    superset = augment(t, own)
    found = score_columns(t, superset, [c.strength for c in own], (), Missing())
    assert len(found.names) > 10
    assert {s.data[1] for s in found.nuisance} >= {"r"}


def test_effects_inside_of_a_primitive_are_refused_one_by_one():
    """Those on the input that a primitive is called with; also where a law has no noise."""
    for where in ("input", "what u moves"):
        t = trace(calling(where))
        own = [c for c in candidates("gap", "oscillator")
               if c.equation == "u" and not c.effect.states]  # fmt: skip
        found = score_columns(t, augment(t, own), [c.strength for c in own], (), Missing())
        for c in own:
            reason = found.refused[c.strength].reason
            assert reason == "it would need a derivative of the @ssm.primitive bent"


def test_a_simulator_is_told_at_once_and_in_one_sentence():
    t = traced("case", "pendulum_opaque")
    started = time.perf_counter()
    with pytest.raises(ModelError) as caught:
        check_differentiable(t)
    assert time.perf_counter() - started < 1.0
    told = caught.value.found
    assert told == (
        "diagnose needs the derivatives of the transition of q in k and d, and step_angle() is an "
        "@ssm.primitive, which has none"
    )
    assert len(str(caught.value)) < 600


def test_no_other_model_is_refused():
    for where, name in MODELS:
        if name != "pendulum_opaque":
            check_differentiable(traced(where, name))


def test_expressions_in_errors_of_derivatives_are_short():
    a = symbol("parameter", "a")
    whole = sum((symbol("state", f"state_{i}") for i in range(60)), a)
    with pytest.raises(NotDifferentiable, match=r"^bent\(a \+ state_0") as caught:
        differentiate([bent(whole)], a)
    assert len(str(caught.value)) < 130
