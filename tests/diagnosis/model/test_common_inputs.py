"""What delays all inputs alike: one effect, one strength, in each of them."""

from dataclasses import replace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.effects.effect import effect
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.report.model_file import model_text, to_model
from ssmppl.errors import ModelError
from ssmppl.language.tracing import trace
from tests.diagnosis.harness import scales

ROWS = 40


def two_motors(third=False):
    model = ssm.Model("two motors", inputs=("u1", "u2", "unused") if third else ("u1", "u2"))
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"v": ssm.Normal(0, sd=1), "w": ssm.Normal(0, sd=1)})

    @model.transition
    def transition(v, w, u1, u2, q):
        return {"v": ssm.Normal(0.5 * v + u1, sd=q), "w": ssm.Normal(0.5 * w + 2.0 * u2, sd=q)}

    model.observation(lambda v, w: {"y": ssm.Normal(v + w, sd=1)})
    return model


def found(name, **settings):
    t = trace(two_motors(**settings))
    return t, offers(t, scales(t, ROWS), [name])[0]


@pytest.mark.parametrize("name", ["input delay", "actuator lag"])
def test_it_is_offered_for_each_input_and_for_all_that_are_used(name):
    for third in (False, True):
        _, candidates = found(name, third=third)
        assert {c.place for c in candidates} == {"u1", "u2", "u1 and u2"}
    both = [c for c in candidates if c.alike]
    assert len(both) == len([c for c in candidates if c.place == "u1"])
    assert str(both[0]).startswith(f"{name} in u1 and u2 with ")
    assert len({c.group for c in candidates}) == 3
    assert len({c.strength for c in candidates}) == len(candidates)


def test_what_is_not_common_is_offered_for_each_alone():
    assert {c.place for c in found("backlash")[1]} == {"u1", "u2"}
    with pytest.raises(ModelError, match="common"):

        @effect(on="rate", common=True)
        def drag(v, strength):
            return -strength * v


def test_one_strength_delays_every_input():
    """Simulated with both inputs delayed by hand, and with the effect at strength 1."""
    t, candidates = found("input delay")
    both = next(c for c in candidates if c.alike and dict(c.shape)["delay"] == 2)
    alone = next(c for c in candidates if c.place == "u2" and dict(c.shape)["delay"] == 1)
    both, alone = replace(both, strength="late"), replace(alone, strength="later")
    rng = np.random.default_rng(3)
    given = {n: rng.normal(size=ROWS) for n in ("u1", "u2")}
    late = {n: np.r_[[v[0]] * 2, v[:-2]] for n, v in given.items()}

    def draw(model, inputs, **values):
        made = ssm.simulate(model, {"q": 0.1} | values, steps=ROWS, inputs=inputs, seed=5)
        return made["y"].values[0]

    def of(augmented, **values):
        return draw(to_model(augmented), given, **values)

    expected = draw(two_motors(), late)
    np.testing.assert_allclose(of(augment(t, [both]), late=1.0), expected, rtol=1e-12)
    # beside a further delay of one of them, and added after it
    for augmented in (augment(t, [both, alone]), augment(augment(t, [alone]), [both])):
        np.testing.assert_allclose(of(augmented, late=1.0, later=0.0), expected, rtol=1e-12)
        none = of(augmented, late=0.0, later=0.0)
        np.testing.assert_allclose(none, draw(two_motors(), given), rtol=1e-12)


def test_the_file_names_the_effect_at_each_input():
    t, candidates = found("input delay")
    both = next(c for c in candidates if c.alike)
    text = model_text(augment(t, [both]), added=[both])
    assert text.count(f"# added: {both}") == 2
