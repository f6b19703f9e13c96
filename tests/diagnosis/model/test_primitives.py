"""Score columns of models that call opaque functions: those of the functions written out."""

import math

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol, symbols_of
from ssmppl.language.tracing import trace
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


OPAQUE = {"bent": bent, "times": times, "size": size}
WRITTEN = {"bent": np.tanh, "times": lambda x, k: x * k, "size": np.exp}


def calling(f):
    """A noisy and a deterministic state, an input, and functions of all of them everywhere."""
    model = ssm.Model("calling", inputs=("u",))
    bent, times, size = f["bent"], f["times"], f["size"]
    model.prior(lambda: {"k": ssm.Normal(0, sd=1), "q": ssm.HalfNormal(sd=1)})
    model.initial(lambda k: {"x": ssm.Normal(size(k), sd=1), "w": ssm.Dirac(times(2.0, k))})

    @model.transition
    def transition(x, w, u, k, q):
        mean = 0.8 * bent(x) + times(u, k) + k * bent(u)
        return {"x": ssm.Normal(mean, sd=size(q)), "w": ssm.Dirac(bent(w) + times(u, k))}

    model.observation(lambda x, w, k: {"y": ssm.Normal(bent(x) + times(w, k), sd=0.3)})
    return model


def columns(t):
    own = list({c.group: c.increment for c in reversed(offers(t, scales(t))[0])}.values())
    return score_columns(t, augment(t, own), [c.strength for c in own], (), Missing())


def test_score_columns_are_those_of_the_functions_written_out():
    """Of all effects and parameters, within the error of differences."""
    found, exact = (columns(trace(calling(f))) for f in (OPAQUE, WRITTEN))
    assert not any("primitive" in r.reason for r in found.refused.values())
    assert found.nuisance == exact.nuisance
    alike = [n for n in found.names if n in exact.names]
    assert len(alike) > 20
    rng = np.random.default_rng(4)
    free = sorted(symbols_of([*found.later, *exact.later]), key=repr)
    at = {s: rng.uniform(0.2, 0.9, 20) for s in free}
    for names, forms in ((found, found.later), (exact, exact.later)):
        order = [*map(repr, names.nuisance), *names.names]
        assert len(order) == len(forms)
    where_found = dict(zip([*map(repr, found.nuisance), *found.names], found.later, strict=True))
    where_exact = dict(zip([*map(repr, exact.nuisance), *exact.names], exact.later, strict=True))
    wanted = [*map(repr, found.nuisance), *alike]
    a = np.array([np.broadcast_to(v, 20) for v in evaluate([where_found[n] for n in wanted], at)])
    b = np.array([np.broadcast_to(v, 20) for v in evaluate([where_exact[n] for n in wanted], at)])
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_expressions_in_errors_of_derivatives_are_short():
    a = symbol("parameter", "a")
    whole = sum((symbol("state", f"state_{i}") for i in range(60)), a)
    with pytest.raises(NotDifferentiable, match=r"^abs\(a \+ state_0") as caught:
        differentiate([Expr("call", (whole,), abs)], a)
    assert len(str(caught.value)) < 130
