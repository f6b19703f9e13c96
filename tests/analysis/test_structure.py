"""Which models are linear and Gaussian, however they are spelled; why the others are not."""

import inspect

import numpy as np
import pytest

import ssmppl.language.distributions as D
from ssmppl.analysis.structure import deterministic_memory, linear_gaussian
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace


def model_of(*, mean=None, transition=None, observation=None, initial=None, prior=None, inputs=()):
    """A scalar model whose laws are Normal unless given; `mean` is that of the transition."""
    model = Model("case", inputs=inputs)
    model.prior(prior or (lambda: {"a": D.Uniform(-1, 1), "q": D.Gamma(1, rate=1)}))
    model.initial(initial or (lambda: {"x": D.Normal(0, sd=1)}))
    if transition is None:

        def transition(x, a, q):
            return {"x": D.Normal(mean(x, a), variance=q)}

    model.transition(transition)
    model.observation(observation or (lambda x: {"y": D.Normal(x, sd=1)}))
    return trace(model)


SPELLINGS = {
    "as written": lambda x, a: a * x + 2,
    "the other way": lambda x, a: 2 + x * a,
    "over a common denominator": lambda x, a: (2 * a * x + 4) / 2,
    "less itself": lambda x, a: x - (1 - a) * x + 2,
    "in a loop": lambda x, a: sum(a * x / 4 for _ in range(4)) + 2,
    "by a dot product": lambda x, a: np.dot(np.stack([a, 2.0 + 0 * a]), np.stack([x, 1.0 + 0 * x])),
    "under a square that cancels": lambda x, a: ((x + a) ** 2 - x**2 - a**2) / 2 + 2,
    "with a branch that is not on the state": lambda x, a: np.where(a > 5, -1, 1) * a * x + 2,
    "through log and exp": lambda x, a: np.log(np.exp(a * x)) + 2,
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_spellings(spelling):
    form = linear_gaussian(model_of(mean=SPELLINGS[spelling]))
    assert not isinstance(form, NotApplicable), form
    known = {symbol("parameter", "a"): 0.3, symbol("parameter", "q"): 0.7}
    found = [float(evaluate(getattr(form, n), known).ravel()[0]) for n in "mPAbQCdR"]
    np.testing.assert_allclose(found, [0, 1, 0.3, 2, 0.7, 1, 0, 1], atol=1e-12)


def line_of(function):
    """The function's first line that holds the mark `# here`."""
    lines, first = inspect.getsourcelines(function)
    return first + next(i for i, line in enumerate(lines) if "# here" in line)


def sine(x, a):
    return {"x": D.Normal(np.sin(x), sd=1)}  # here


def product(x, a):
    return {"x": D.Normal(a * x * x, sd=1)}  # here


def saturated(x, a):
    return {"x": D.Normal(np.clip(x, -1, 1), sd=1)}  # here


def branch_on_state(x, a):
    return {"x": D.Normal(np.where(x > 0, x, a * x), sd=1)}  # here


def spread_by_state(x, a):
    return {"x": D.Normal(a * x, sd=1 + abs(x))}  # here


def heavy(x, a):
    return {"x": D.StudentT(5, a * x, scale=1)}  # here


def truncated(x, a):
    return {"x": D.Truncated(D.Normal(a * x, sd=1), lower=0)}  # here


def log_normal(x, a):
    return {"x": D.LogNormal(a * x, sd=1)}  # here


TRANSITIONS = {
    sine: "sin", product: "", saturated: "", branch_on_state: "",
    spread_by_state: "spread of the transition of x depends on the state",
    heavy: "distribution of x is StudentT", truncated: "distribution of x is Truncated",
    log_normal: "distribution of x is LogNormal",
}  # fmt: skip


@pytest.mark.parametrize("transition", TRANSITIONS, ids=lambda f: f.__name__)
def test_transitions_that_miss(transition):
    found = linear_gaussian(model_of(transition=transition))
    assert isinstance(found, NotApplicable)
    assert TRANSITIONS[transition] in found.reason
    assert "transition" in found.reason
    assert found.where.line == line_of(transition)


def exponential(x):
    return {"y": D.Normal(np.exp(x), sd=1)}  # here


def counts(x):
    return {"y": D.Poisson(np.exp(x))}  # here


def volatility(x):
    return {"y": D.Normal(0, sd=np.exp(x / 2))}  # here


def second_channel(x):
    return {
        "y": D.Normal(x, sd=1),
        "z": D.Normal(x**2, sd=1),  # here
    }


def second_spread(x):
    return {
        "y": D.Normal(x, sd=1),
        "z": D.Normal(x, variance=1 + x**2),  # here
    }


OBSERVATIONS = {
    exponential: "exp", counts: "y is Poisson", volatility: "spread of the observation",
    second_channel: "mean of the observation of z", second_spread: "of z depends on the state",
}  # fmt: skip


@pytest.mark.parametrize("observation", OBSERVATIONS, ids=lambda f: f.__name__)
def test_observations_that_miss(observation):
    found = linear_gaussian(model_of(mean=lambda x, a: a * x, observation=observation))
    assert isinstance(found, NotApplicable)
    assert OBSERVATIONS[observation] in found.reason
    assert found.where.line == line_of(observation)


def gamma_start():
    return {"x": D.Gamma(1, rate=1)}  # here


def test_initial_laws_that_miss():
    found = linear_gaussian(model_of(mean=lambda x, a: a * x, initial=gamma_start))
    assert "initial distribution of x is Gamma" in found.reason
    assert found.where.line == line_of(gamma_start)


def test_what_is_free_of_the_state_may_be_anything():
    """Inputs, time, the last observation and parameters enter matrices in any form."""

    def transition(x, y, u, t, a, q):
        mean = np.sin(u) * x + np.exp(-a * t) + y**2
        return {"x": D.Normal(mean, sd=q * np.sqrt(t) * (1 + y**2))}

    form = linear_gaussian(model_of(transition=transition, inputs=("u",)))
    assert not isinstance(form, NotApplicable), form


def test_dirac_components_have_zero_variance():
    model = Model()

    @model.initial
    def initial():
        return {"p": D.Dirac(1.0), "v": D.Normal(np.zeros(2), sd=np.array([1.0, 2.0]))}

    @model.transition
    def transition(p, v):
        return {"v": D.Normal(v, sd=0.5), "p": D.Dirac(p + v[0])}

    @model.observation
    def observation(p):
        return {"y": D.Normal(p, sd=1)}

    form = linear_gaussian(trace(model))
    np.testing.assert_allclose(evaluate(form.P), np.diag([0.0, 1.0, 4.0]))
    np.testing.assert_allclose(evaluate(form.Q), np.diag([0.0, 0.25, 0.25]))
    np.testing.assert_allclose(evaluate(form.A), [[1, 1, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(evaluate(form.m), [1, 0, 0])
    np.testing.assert_allclose(evaluate(form.C), [[1, 0, 0]])


@pytest.mark.parametrize(
    ("laws", "memory"),
    [
        (lambda p, l, v: {}, 0),
        (lambda p, l, v: {"l": D.Dirac(v)}, 1),
        (lambda p, l, v: {"l": D.Dirac(v), "p": D.Dirac(l + 1)}, 2),
        (lambda p, l, v: {"p": D.Dirac(p + v)}, None),
        (lambda p, l, v: {"p": D.Dirac(l), "l": D.Dirac(p)}, None),
        (lambda p, l, v: {"p": D.Dirac(2.0)}, 0),
    ],
)
def test_how_long_deterministic_components_remember(laws, memory):
    model = Model()

    @model.initial
    def initial():
        return {n: D.Normal(0, sd=1) for n in ("p", "l", "v")}

    @model.transition
    def transition(p, l, v):
        return {n: D.Normal(v, sd=1) for n in ("p", "l", "v")} | laws(p, l, v)

    assert deterministic_memory(trace(model)) == memory
