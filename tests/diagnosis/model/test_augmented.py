"""Effects added to a model that has some already: they mean what they mean to the model itself."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.data import bind as bind_data
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.basis import basis
from ssmppl.diagnosis.model.binding import bind
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.equations import Augmented, Equations, as_it_was
from ssmppl.diagnosis.model.initial_law import ProperInitialLaw
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.diagnosis.model.smoothing import Settings, Smoother
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.language.distributions import Normal
from ssmppl.language.tracing import trace
from tests.diagnosis.every import candidates, different, traced
from tests.diagnosis.harness import content, differences, scales
from tests.diagnosis.small import fished, fished_data, level


def named(where, name, effect, equation):
    return next(c for c in candidates(where, name)
                if (c.effect.name, c.equation) == (effect, equation))  # fmt: skip


@pytest.mark.parametrize(
    ("model", "first"),
    [
        (("case", "emps"), ("coulomb friction", "v")),
        (("case", "gusts"), ("coarse discretisation", "p")),
        (("case", "silverbox"), ("heteroscedastic noise", "v")),
        (("bench", "pendulum"), ("coarse discretisation", "th")),
    ],
)
def test_hysteresis_finds_its_position_whatever_is_in(model, first):
    t = traced(*model)
    rate = Equations(t).integral_of[next(iter(Equations(t).integral_of))]
    c, hysteresis = named(*model, *first), named(*model, "bouc-wen hysteresis", rate)
    one = augment(t, [c])
    assert Equations(one).integral_of == Equations(t).integral_of
    both = augment(one, [hysteresis])
    assert not differences(both, augment(t, [c, hysteresis]))


def test_an_input_that_another_effect_changed_is_still_the_input():
    """Friction by the load depends on the input as the model has it, not on what acts in its place:
    as in the model that has both from the beginning."""
    t = traced("gap", "oscillator")
    saturated = named("gap", "oscillator", "input saturation", "u")
    friction = named("gap", "oscillator", "load-dependent friction", "v")
    after = augment(augment(t, [saturated]), [friction])
    assert not different(after, augment(t, [friction, saturated]))
    increments = [c for c in after.added if c.strength == friction.strength]
    assert increments == [friction]


def test_two_changes_of_one_parameter_are_one_after_the_other():
    """Added to each other, the second one was a difference that is zero where a score is taken, and
    the score of its strength was infinite times zero."""
    t = trace(fished())
    names = ["parameter drift", "parameter break"]
    drift, jump = (
        next(c for c in offers(t, scales(t, 64), [n])[0] if c.equation == "K") for n in names
    )
    one = augment(t, [replace(drift, shape=(("rows", 64.0),))])
    both = augment(one, [jump])
    columns = score_columns(one, both, [jump.strength], (), Missing())
    places = {repr(s): i for i, s in enumerate(columns.nuisance)}
    assert (list(places), columns.names) == (
        ["r", "K", "q", "s", drift.strength], (jump.strength,)
    )  # fmt: skip
    data, theta = bind_data(t, fished_data(1)), np.array([0.3, 800.0, 0.1, 0.1, -0.7])
    (found,) = Smoother(columns, Missing(), Settings(200)).run(data, theta, np.ones(4, np.uint64))
    after = np.arange(64) >= dict(jump.shape)["date"]
    expected = np.where(after, 800.0 * found.rows[:, places["K"]], 0.0)
    np.testing.assert_allclose(found.rows[:, -1], expected, rtol=1e-9)


def test_auxiliary_states_keep_their_names_and_places():
    """Those that are in come first, under the names that they had."""
    t = traced("gap", "oscillator")
    every = candidates("gap", "oscillator")
    loads = [c for c in every if c.effect.name == "missing input"]
    delay = named("gap", "oscillator", "input delay", "u")
    one = augment(t, [loads[1]])
    new = augment(one, [loads[0], delay])
    assert list(new.initial)[: len(one.initial)] == list(one.initial)
    assert new.names[loads[1].strength] == one.names[loads[1].strength]
    assert len({n for own in new.names.values() for n in own.values()}) == 3
    assert content(new.transition["load_v"].distribution) == content(
        one.transition["load_v"].distribution
    )


def test_what_was_added_is_no_part_of_the_model():
    """Its strengths and auxiliary states are offered no effects, and have no basis."""
    t = traced("gap", "oscillator")
    one = augment(t, [named("gap", "oscillator", "bouc-wen hysteresis", "v"),
                      named("gap", "oscillator", "constant load", "v")])  # fmt: skip
    s = scales(t)
    assert [c.key for c in offers(one, s)[0]] == [c.key for c in offers(t, s)[0]]
    assert [b.candidate.key for b in basis(one, s)] == [b.candidate.key for b in basis(t, s)]
    assert as_it_was(one) is t
    assert as_it_was(augment(one, [])) is t


def test_a_start_that_was_given_stays_when_more_is_added():
    t = trace(level(ssm.Flat()))
    friction, noise = (
        next(c for c in offers(t, scales(t))[0] if c.effect.name == n)
        for n in ("quadratic drag", "outliers")
    )
    started = ProperInitialLaw({"x": (np.array(0.5), np.array(3.0))}).applied_to(
        augment(t, [friction])
    )
    assert isinstance(started, Augmented)
    for m in (started, augment(started, [noise])):
        law = m.initial["x"].distribution
        assert isinstance(law, Normal)
        assert float(law.mean()[()].data) == 0.5


def test_augmented_traces_cross_process_borders():
    t = traced("gap", "oscillator")
    one = augment(t, [named("gap", "oscillator", "actuator lag", "u")])
    back = pickle.loads(pickle.dumps(one))
    assert isinstance(back, Augmented)
    assert not differences(back, one)
    assert (back.added, back.names) == (one.added, one.names)
    assert not differences(as_it_was(back), t)


def test_what_cannot_be_bound_is_an_error_of_the_effect():
    t = traced("gap", "oscillator")
    c = named("gap", "oscillator", "bouc-wen hysteresis", "v")
    friction = named("gap", "oscillator", "load-dependent friction", "v")
    with pytest.raises(ModelError, match="no state is the integral of x, whose move it asks for"):
        augment(t, [replace(c, equation="x")])
    with pytest.raises(ModelError, match="nothing is bound to 'u', which is to be 'any input'"):
        bind(replace(friction, bound=()), Equations(t), "transition")
    with pytest.raises(ArgumentError, match="has no 'speed'"):
        augment(t, [replace(c, bound=(("x", "speed"),))])
    with pytest.raises(ArgumentError, match="as is the model's parameter"):
        augment(augment(t, [c]), [c])
