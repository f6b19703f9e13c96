"""The arm in MuJoCo: its sets are of the model given, with one thing more."""

import io
from collections import Counter

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from bench.gap import arm
from bench.gap.generate import made
from bench.gap.names import ITEMS
from bench.gap.plan import SPLIT, entries
from ssmppl.diagnosis.effects.catalogue import effects
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model

pytest.importorskip("mujoco")
NOMINAL = np.array(list(arm.PARAMETERS.values()))
SETS = [e for e in entries() if e.system == arm.NAME]


def test_the_plan_has_its_sets_and_each_effect_more_than_once():
    assert Counter(e.cell for e in SETS) == {
        cell: SPLIT["arm"][cell] for cell in (arm.CELL, arm.CELL_NONE)
    }
    assert {e.half for e in SETS} == {"sealed"}
    met = Counter(key for e in SETS for key in e.effects)
    assert set(met) == set(arm.EFFECTS)
    assert min(met.values()) > 1


def test_names_and_equations_are_those_of_the_catalogue_and_the_model():
    traced = trace(load_model(str(arm.MODEL)))
    assert list(traced.parameters) == list(arm.PARAMETERS)
    known = {*traced.initial, *traced.inputs, *traced.observations}
    for effect in arm.EFFECTS.values():
        assert set(effect.equations) <= known
        assert set(ITEMS[effect.item]) <= set(effects.names())


def test_without_effects_the_engine_does_what_the_model_says():
    """Still at the start and without noise but the encoders': theirs is all that is apart."""
    asked = arm.torques(np.random.default_rng(1))[:40]
    ours = arm.simulate(NOMINAL, "", 0.0, asked, None)
    text = arm.MODEL.read_text().replace("ssm.Normal(0.0, sd=0.01)", "ssm.Dirac(0.0)")
    space: dict = {"__name__": "still"}
    exec(compile(text, "still", "exec"), space)
    quiet = dict(zip(arm.PARAMETERS, NOMINAL, strict=True)) | {"s1": 1e-9, "s2": 1e-9, "r": 1e-9}
    inputs = {"u1": asked[:, 0], "u2": asked[:, 1]}
    theirs = ssm.simulate(space["model"], quiet, steps=40, inputs=inputs, seed=1)
    for k, name in enumerate(("y1", "y2")):
        np.testing.assert_allclose(theirs[name].values[0], ours[:, k], atol=1e-6)


def test_every_effect_changes_what_is_read():
    asked = arm.torques(np.random.default_rng(1))
    plain = arm.simulate(NOMINAL, "", 0.0, asked, None)
    for key, effect in arm.EFFECTS.items():
        for strength in (effect.weakest, effect.strongest):
            Y = arm.simulate(NOMINAL, key, strength, asked, None)
            assert np.isfinite(Y).all()
            assert np.abs(Y - plain).max() > 5 * arm.PARAMETERS["r"], key


def test_a_set_is_the_same_every_time_and_its_answer_says_what_is_in_it():
    entry = next(e for e in SETS if e.effects)
    data, model, answer = made(entry, {})
    assert (data, model, answer) == made(entry, {})
    frame = pd.read_csv(io.StringIO(data))
    assert list(frame.columns) == ["u1", "u2", "y1", "y2"]
    assert len(frame) == arm.ROWS
    (effect,) = answer["effects"]
    bounds = arm.EFFECTS[effect["key"]]
    assert bounds.weakest <= effect["strength"] <= bounds.strongest
    assert effect["names"] == list(ITEMS[bounds.item])
    assert "frictionloss" not in model + data
