"""Elements that states and parameters choose: refused where the law can choose one beyond."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.errors import ModelError
from ssmppl.language.model.pickling import packed, unpacked
from ssmppl.language.tracing import trace


def model_of(law, chosen, first=None):
    """States s under `law` (at first under `first`), and observations that read `chosen`."""
    model = ssm.Model("chosen")

    @model.prior
    def prior():
        return {"mu": ssm.Normal(np.zeros(3), sd=1.0), "k": ssm.Normal(0.0, sd=1.0)}

    @model.initial
    def initial():
        return {"s": first or law, "g": ssm.Bernoulli(0.5)}

    @model.transition
    def transition():
        return {"s": law, "g": ssm.Bernoulli(0.5)}

    @model.observation
    def observation(s, g, mu, k):
        return {"y": ssm.Normal(chosen(s, g, mu, k), sd=1.0)}

    return model


def classes(n):
    return ssm.Categorical(np.full(n, 1.0 / n))


REFUSED = [
    (classes(4), lambda s, g, mu, k: mu[s], "index s can be 3, and there are 3 elements, 0 to 2"),
    (classes(4), lambda s, g, mu, k: mu[s - 1], "index s - 1 can be -1 where s = 0"),
    (classes(3), lambda s, g, mu, k: mu[s / 2], "index s/2 can be 0.5 where s = 1"),
    (classes(2), lambda s, g, mu, k: mu[s + 2 * g], "can be 3 where"),
    (classes(3), lambda s, g, mu, k: np.choose(g + 1, [k, 2.0]), "index g + 1 can be 2"),
    (classes(3), lambda s, g, mu, k: np.exp(k * np.take(mu, s + 1)), "index s + 1 can be 3"),
    (classes(4), lambda s, g, mu, k: np.where(g > 0, mu[s], 0.0), "index s can be 3"),
    (classes(4), lambda s, g, mu, k: np.where(mu[s] > 0, 1.0, 0.0), "index s can be 3"),
    (ssm.Binomial(3, 0.5), lambda s, g, mu, k: mu[s], "index s can be 3"),
    (ssm.Truncated(ssm.Poisson(1.0), upper=3), lambda s, g, mu, k: mu[s], "index s can be 3"),
    (ssm.Poisson(1.0), lambda s, g, mu, k: mu[s], "(?s)s has no bound.*np.minimum(s, 2)"),
    (ssm.Normal(0.0, sd=1.0), lambda s, g, mu, k: mu[s], "(?s)continuum.*np.floor(s)"),
    (classes(2), lambda s, g, mu, k: mu[k], "index k takes a continuum"),
    (classes(3), lambda s, g, mu, k: mu[np.sqrt(s)], "can be 1.4142135623730951 where s = 2"),
]


@pytest.mark.parametrize(("law", "chosen", "words"), REFUSED)
def test_what_may_lie_outside_is_refused(law, chosen, words):
    with pytest.raises(ModelError) as caught:
        trace(model_of(law, chosen))
    text = str(caught.value)
    for part in words.removeprefix("(?s)").split(".*"):
        assert part in text
    assert "test_indexes.py" in text
    assert "lambda s, g, mu, k" in text  # the line itself


ACCEPTED = [
    (classes(3), lambda s, g, mu, k: mu[s]),
    (classes(4), lambda s, g, mu, k: np.where(s > 0, mu[s - 1], 0.0)),
    (classes(4), lambda s, g, mu, k: np.where(s == 3, 0.0, mu[s])),
    (classes(4), lambda s, g, mu, k: mu[np.minimum(s, 2)]),
    (classes(2), lambda s, g, mu, k: mu[s + g]),
    (classes(4), lambda s, g, mu, k: (s > 0) * mu[s - 1]),
    (classes(4), lambda s, g, mu, k: np.where((s > 0) & (mu[s - 1] > 0), 1.0, 0.0)),
    (classes(4), lambda s, g, mu, k: np.where(s > 2, 0.0, np.choose(s, [0.0, 1.0, 1.0]))),
    (ssm.Poisson(1.0), lambda s, g, mu, k: mu[np.minimum(s, 2)]),
    (ssm.Truncated(ssm.Poisson(1.0), upper=2), lambda s, g, mu, k: mu[s]),
    (ssm.Normal(0.0, sd=1.0), lambda s, g, mu, k: mu[np.clip(np.floor(s), 0, 2)]),
]


@pytest.mark.parametrize(("law", "chosen"), ACCEPTED)
def test_what_lies_within_is_taken(law, chosen):
    assert trace(model_of(law, chosen)).choices


def test_tables_that_are_one_expression_have_the_elements_of_the_longer():
    """np.choose(s, [0, 1, 1]) and np.choose(s, [0, 1]), which is kept later, are one node."""

    def chosen(s, g, mu, k):
        return np.choose(s, [0.0, 1.0, 1.0]) + np.where(s < 2, np.choose(s, [0.0, 1.0]), 0.0)

    trace(model_of(classes(3), chosen))


def test_the_initial_law_counts():
    trace(model_of(classes(3), lambda s, g, mu, k: mu[s], first=classes(2)))
    with pytest.raises(ModelError, match="index s can be 3"):
        trace(model_of(classes(3), lambda s, g, mu, k: mu[s], first=classes(4)))


def test_rows_of_a_matrix_in_a_transition():
    def chain(n):
        model = ssm.Model("chain")

        @model.prior
        def prior():
            return {"P": ssm.Dirichlet(np.ones((2, n)))}

        @model.initial
        def initial():
            return {"s": classes(n)}

        @model.transition
        def transition(s, P):
            return {"s": ssm.Categorical(P[s])}

        @model.observation
        def observation(s):
            return {"y": ssm.Normal(s, sd=1.0)}

        return model

    trace(chain(2))
    with pytest.raises(ModelError, match="index s_prev can be 2, and there are 2 elements"):
        trace(chain(3))


def test_columns_that_are_all_alike_are_no_choice():
    """Their node is a number, which may stand elsewhere too."""
    table, first = [[0.9, 0.1, 0.0], [0.1, 0.9, 0.0]], [0.0, 0.0, 1.0]
    model = ssm.Model("columns")

    @model.initial
    def initial():
        return {"s": classes(3)}

    @model.transition
    def transition(s):
        return {"s": ssm.Categorical(np.where(s > 0, np.choose(s - 1, table), first))}

    @model.observation
    def observation(s):
        return {"y": ssm.Normal(s, sd=1.0)}

    trace(model)


def lagged(n, begin=0.0):
    model = ssm.Model("lagged")
    model.prior(lambda: {"mu": ssm.Normal(np.zeros(2), sd=1.0)})
    model.initial(lambda: {"s": classes(n), "a": ssm.Dirac(begin), "b": ssm.Dirac(0.0)})
    model.transition(lambda s, a: {"s": classes(n), "a": ssm.Dirac(s), "b": ssm.Dirac(a)})
    model.observation(lambda b, mu: {"y": ssm.Normal(mu[b], sd=1.0)})
    return model


def test_lags_have_the_values_of_what_they_keep():
    trace(lagged(2))
    with pytest.raises(ModelError, match="index b can be 2"):
        trace(lagged(3))
    with pytest.raises(ModelError, match="index b can be 5"):
        trace(lagged(2, begin=5.0))


def test_bounds_are_asked_for_once_for_each_law(monkeypatch):
    asked = []
    support = ssm.Dirichlet.support
    monkeypatch.setattr(ssm.Dirichlet, "support", lambda law: asked.append(law) or support(law))
    model = ssm.Model("large")
    model.prior(lambda: {"P": ssm.Dirichlet(np.ones((30, 30)))})
    model.initial(lambda: {"s": classes(30)})
    model.transition(lambda s, P: {"s": ssm.Categorical(P[s])})
    model.observation(lambda s: {"y": ssm.Normal(s, sd=1.0)})
    trace(model)
    assert len(asked) < 30


def test_choices_travel_with_the_trace():
    choices = trace(model_of(classes(3), lambda s, g, mu, k: mu[s])).choices
    (again,) = unpacked(packed((choices,)))
    assert {repr(k): (repr(i), n) for k, (i, n) in again.items()} == {
        repr(k): (repr(i), n) for k, (i, n) in choices.items()
    }
    assert set(map(repr, choices)) == {"where(s == 0, mu[0], where(s == 1, mu[1], mu[2]))"}
