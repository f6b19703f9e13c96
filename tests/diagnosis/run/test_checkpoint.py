"""Checkpoints: what is kept, refused, and left out the second time."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.data import bind
from ssmppl.diagnosis.effects.catalogue import effects
from ssmppl.diagnosis.run.checkpoint import Checkpoint, digests
from ssmppl.errors import ArgumentError
from ssmppl.language.tracing import trace
from tests.diagnosis.small import level, levels

MADE_FROM = {"mode": "fast", "model": "m", "data": "d", "settings": "s"}


def test_numbers_come_back_as_they_were(tmp_path):
    file = tmp_path / "deep" / "kept.npz"
    one = Checkpoint(file, MADE_FROM)
    one.put("fit", {"theta": np.array([1.0, np.nan]), "reason": "why not", "done": True})
    one.flush()
    again = Checkpoint(file, MADE_FROM).get("fit")
    np.testing.assert_array_equal(again["theta"], [1.0, np.nan])
    assert str(again["reason"]) == "why not"
    assert bool(again["done"])
    assert [f.name for f in file.parent.iterdir()] == ["kept.npz"]


@pytest.mark.parametrize("made", [True, False])
def test_a_folder_has_a_file_for_each_mode(tmp_path, made):
    folder = tmp_path / "stages"
    if made:
        folder.mkdir()
    for mode in ("fast", "full"):
        one = Checkpoint(folder, {**MADE_FROM, "mode": mode})
        one.put("fit", {"a": 1.0})
        one.flush()
    assert sorted(f.name for f in folder.iterdir()) == ["fast.npz", "full.npz"]


def test_none_keeps_in_memory_only(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = Checkpoint(None, MADE_FROM)
    one.put("fit", {"a": 1.0})
    one.flush()
    assert "fit" in one
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changed", "said"),
    [({"data": "x"}, "other data"), ({"model": "x"}, "another model"),
     ({"settings": "x", "model": "y"}, "another model and other settings")],
)  # fmt: skip
def test_what_was_made_from_something_else_is_refused(tmp_path, changed, said):
    one = Checkpoint(tmp_path / "a.npz", MADE_FROM)
    one.put("fit", {"a": 1.0})
    one.flush()
    with pytest.raises(ArgumentError, match=said) as error:
        Checkpoint(tmp_path / "a.npz", {**MADE_FROM, **changed})
    assert "delete it" in str(error.value)


def test_another_file_is_refused(tmp_path):
    file = tmp_path / "a.npz"
    file.write_text("not numbers")
    with pytest.raises(ArgumentError, match="no checkpoint"):
        Checkpoint(file, MADE_FROM)
    assert file.read_text() == "not numbers"


def test_tasks_that_are_done_are_left_out(tmp_path):
    ran = []

    def task(k):
        if k == 3 and len(ran) < 5:
            ran.append(k)
            raise KeyboardInterrupt
        ran.append(k)
        return {"square": k * k}

    file = tmp_path / "a.npz"
    with pytest.raises(KeyboardInterrupt):
        Checkpoint(file, MADE_FROM).within("outer").map("squares", 6, task)
    before = set(ran) - {3}
    kept = Checkpoint(file, MADE_FROM)
    assert all(f"outer: squares/{k}" in kept for k in before)
    assert before
    ran += [None] * 5
    found = kept.within("outer").map("squares", 6, task)
    assert [int(f["square"]) for f in found] == [0, 1, 4, 9, 16, 25]
    assert not before & set(ran[ran.index(None) :])


def test_digests_are_those_of_content():
    model, other = trace(level()), trace(level(ssm.Normal(0, sd=3)))
    data, catalogue = bind(model, levels()), list(effects)
    settings = {"seed": 1, "fixed": {"q": np.array(0.1)}}

    def made(model=model, data=data, effects=catalogue, mode="fast", **changes):
        return digests(model, data, effects, mode, {**settings, **changes})

    first = made()
    assert made(trace(level())) == first, "the same model, declared again"
    for name, second in {
        "model": made(other), "data": made(data=bind(model, levels(80, 1.0))),
        "set of effects": made(effects=catalogue[:-1]), "settings": made(seed=2),
        "mode": made(mode="full"),
    }.items():  # fmt: skip
        assert [k for k in first if first[k] != second[k]] == [name]


def test_an_effect_is_known_by_its_code():
    def made(power):
        if power == 2:

            @ssm.effect(on="rate", name="own")
            def own(v, strength):
                return -strength * v**2
        else:

            @ssm.effect(on="rate", name="own")
            def own(v, strength):
                return -strength * v**3

        return digests(trace(level()), [], [own], "fast", {})["set of effects"]

    assert made(2) == made(2) != made(3)


def test_an_effect_is_known_by_the_numbers_that_its_code_finds():
    def made(scale, **settings):
        @ssm.effect(on="rate", name="own", **settings)
        def own(v, strength):
            return -strength * np.tanh(v / scale)

        return digests(trace(level()), [], [own], "fast", {})["set of effects"]

    assert made(0.3) == made(0.3) != made(0.5)
    assert made(0.3) != made(0.3, requires="both signs")
