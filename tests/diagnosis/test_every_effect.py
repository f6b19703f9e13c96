"""Every effect of the catalogue on every model there is, alone and after every other one.

An effect that applies to a model applies to it also when another one is in, and means the same. All
of it is bound, augmented, traced and analysed; nothing is compiled, and nothing is fitted.
"""

import functools
import inspect

import pytest

from ssmppl.diagnosis.model import binding
from ssmppl.diagnosis.model.augment import augment
from tests.diagnosis.every import (
    MODELS,
    analysed,
    candidates,
    different,
    laws,
    pairs_of,
    scored,
    traced,
    triples,
)

# In every run after every other effect: a position whose step holds the force, a semi-implicit one,
# a model without noise in its states.
WHOLE = [("case", "emps"), ("case", "silverbox"), ("gap", "simulator")]
# What takes longest; models of single features of the language, of which those above have most.
HEAVY = [("example", "seir"), ("example", "vehicle"), ("case", "pendulum_steps"),
         ("bench", "motor_belt"), *(m for m in MODELS if m[0] == "features")]  # fmt: skip
RARER = [m for i, m in enumerate(m for m in MODELS if m[0] == "corpus") if i % 3]  # much alike
THIRD = 3  # of the effects of a model, one in so many is put in before the others
SOME, MORE = 4000, 400  # of the pairs of all models, one in so many by itself


def marked(models, rest):
    """The models as parameters, those of `rest` for the slow stage."""
    return [pytest.param(*m, marks=[pytest.mark.slow] if m in rest else [], id="-".join(m))
            for m in models]  # fmt: skip


@functools.cache
def arguments_of(function):
    return tuple(inspect.signature(function).parameters)


def as_it_is(function, role, arguments, known):
    """What a function returns, without the checks of how it is written."""
    own = arguments_of(function)
    return function(**{n: arguments[n] for n in own if n in arguments})


@pytest.mark.parametrize(("where", "name"), marked(MODELS, HEAVY + RARER))
def test_every_effect_by_itself(where, name):
    """Added and analysed one by one; and scored, all at once as a screen does it."""
    t = traced(where, name)
    for c in candidates(where, name):
        analysed(augment(t, [c]))
    scored(t, candidates(where, name))


AFTER = [
    *marked(MODELS, [m for m in MODELS if m not in WHOLE]),
    *[pytest.param(*m, id=f"{'-'.join(m)}-rest", marks=pytest.mark.exhaustive) for m in MODELS
      if m not in WHOLE],
]  # fmt: skip


@pytest.mark.parametrize(("where", "name"), AFTER)
def test_every_effect_after_every_other_means_what_it_means_with_it(
    request, where, name, monkeypatch
):
    """With each effect in, all others are added: the laws are those of all added at once, at random
    values of everything, strengths and auxiliary states included.

    Of most models every third effect, others of the next model; the rest in the exhaustive stage.
    """
    # The checks of the functions themselves are done where an effect is offered.
    monkeypatch.setattr(binding, "call", as_it_is)
    t, every = traced(where, name), candidates(where, name)
    at_once = laws(augment(t, every))
    first, rest = MODELS.index((where, name)) % THIRD, request.node.callspec.id.endswith("-rest")
    for k, c in enumerate(every):
        if (where, name) not in WHOLE and (k % THIRD == first) is rest:
            continue
        after = augment(augment(t, [c]), [other for other in every if other is not c])
        assert not different(after, at_once), str(c)


@pytest.mark.parametrize(("where", "name", "share"), [
    *[pytest.param(*m, SOME, id="-".join(m)) for m in MODELS if m not in HEAVY],
    *[pytest.param(*m, MORE, id=f"{'-'.join(m)}-more", marks=pytest.mark.slow) for m in MODELS],
])  # fmt: skip
def test_pairs_by_themselves(where, name, share):
    """A pair by itself: one after the other is both at once, in either order; the model with both
    can be analysed, and the second one has a score around the model with the first."""
    t = traced(where, name)
    for a, b in pairs_of(where, name, share):
        one = augment(t, [a])
        both = augment(one, [b])
        at_once = laws(augment(t, [a, b]))
        assert not different(both, at_once), f"{a} and {b}"
        assert not different(augment(t, [b, a]), at_once), f"{a} and {b}"
        analysed(both)
        scored(one, [b])


def test_so_many_are_gone_through():
    """What the other tests of this file are worth."""
    every = sum(triples(m) for m in MODELS)
    print(sum(map(triples, WHOLE)), "in every run, a third of", every, "in the slow stage")
    assert sum(map(triples, WHOLE)) > 12_000
    assert every > 800_000
