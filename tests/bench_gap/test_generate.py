"""What is written where: data that hold no answer, sealed answers, and a plan that is fixed."""

import io
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.gap import generate, records, run
from bench.gap.generate import made
from bench.gap.names import ITEMS
from bench.gap.plan import NONE, SPLIT, UNREACHABLE, entries
from bench.gap.records import Record
from bench.gap.sealing import digest, seal, unseal
from bench.gap.truth import SYSTEMS
from ssmppl.expressions.evaluate import evaluate
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model
from tests.bench_gap import made_up

SOLVED = [e for e in entries() if e.system in SYSTEMS]  # all but those of the arm: see test_arm


def guessed():
    """A table of strengths in which every effect has the one where its search starts."""
    return {
        f"{name}/{key}/{level}": {"strength": effect.start, "solved": True}
        for name, system in SYSTEMS.items()
        for key, effect in system.effects.items()
        for level in (20, 50)
    }


def test_the_plan_has_the_cells_of_the_split():
    found = Counter((e.cell, e.half) for e in SOLVED)
    assert found == {
        (cell, half): n for cell, counts in SPLIT["cells"].items() for half, n in counts.items()
    }
    assert len({e.id for e in entries()}) == len(entries()) == 695
    assert len({e.seed for e in entries()}) == 695


def test_every_system_of_the_sealed_half_has_ten_sets_of_a_cell():
    found = Counter(
        (e.system, "none" if e.cell in NONE else e.cell) for e in SOLVED if e.half == "sealed"
    )
    assert found == {
        (system, cell): 20 if cell == "none" else 10
        for system in SPLIT["halves"]["sealed"]["systems"]
        for cell in ("one-20", "one-50", "two-50", "outside-50", "none")
    }


def test_cells_hold_the_effects_they_say_in_the_systems_of_their_half():
    for e in SOLVED:
        system = SYSTEMS[e.system]
        assert e.system in SPLIT["halves"][e.half]["systems"]
        count = {"two-50": 2, **dict.fromkeys(NONE, 0)}.get(e.cell, 1)
        assert len(set(e.effects)) == len(e.effects) == count
        pool = system.outside if e.cell == "outside-50" else system.inside
        assert set(e.effects) <= set(pool)
        if e.level == 50:
            assert not {f"{e.system}/{key}" for key in e.effects} & UNREACHABLE


def test_every_effect_is_met():
    met = {(e.system, k) for e in SOLVED for k in e.effects if e.cell.startswith("one")}
    assert met == {(s.name, k) for s in SYSTEMS.values() for k in s.inside}


def test_the_checks_subset_is_the_one_written_down_and_of_the_tuning_half():
    chosen = [e for e in entries() if e.ci]
    written = (Path(generate.__file__).parent / "ci.txt").read_text().split()
    assert [e.id for e in chosen] == written
    assert len(chosen) == 24
    assert {e.half for e in chosen} == {"tuning"}
    assert Counter(e.cell for e in chosen) == SPLIT["ci"]


def test_a_set_is_the_same_every_time_and_holds_inputs_and_channels_only():
    entry = next(e for e in entries() if e.cell == "one-20" and e.system == "thermal")
    data, model, answer = made(entry, guessed())
    assert (data, model, answer) == made(entry, guessed())
    frame = pd.read_csv(io.StringIO(data))
    system = SYSTEMS["thermal"]
    assert list(frame.columns) == [*system.inputs, *system.channels]
    assert len(frame) == system.steps
    assert entry.effects[0] not in data + model
    effect = answer["effects"][0]
    assert effect["names"] == list(ITEMS[system.effects[entry.effects[0]].item])


def test_counts_are_whole_numbers():
    entry = next(e for e in entries() if e.cell == "none" and e.system == "epidemic")
    frame = pd.read_csv(io.StringIO(made(entry, {})[0]))
    assert frame["y"].dtype.kind == "i"


def test_models_with_wrong_starts_and_noise_scales_differ_in_their_priors_only(tmp_path):
    medians = {}
    for cell in NONE:
        entry = next(e for e in entries() if e.cell == cell and e.system == "pendulum")
        path = tmp_path / f"{cell}.py"
        path.write_text(made(entry, {})[1])
        traced = trace(load_model(str(path)))
        medians[cell] = {
            name: np.exp(float(evaluate(site.distribution.parameters["mean_"])))
            for name, site in traced.parameters.items()
        }
    for name, usual in medians["none"].items():
        scale = name in ("q", "r")
        assert medians["none-start"][name] == pytest.approx(usual * (1 if scale else 3))
        assert medians["none-noise"][name] == pytest.approx(usual * (8 if scale else 1))


def test_a_missing_strength_is_said():
    entry = next(e for e in entries() if e.cell == "one-20")
    with pytest.raises(KeyError, match=r"bench\.gap\.strength"):
        made(entry, {})
    label = f"{entry.system}/{entry.effects[0]}/20"
    with pytest.raises(KeyError, match=label):
        made(entry, {label: {"strength": 1.0, "solved": False}})


def test_sealing_hides_and_gives_back():
    answer = {"effects": [{"names": ["quadratic drag"], "strength": 0.1}], "cell": "one-20"}
    text = seal(answer)
    assert unseal(text) == answer
    assert "drag" not in text
    assert "one" not in text.split("\n", 1)[1]


@pytest.mark.parametrize("spoil", [lambda t: t[1:], lambda t: t[:-9] + "\n", lambda t: ""])
def test_damaged_answers_are_refused(spoil):
    with pytest.raises(ValueError, match="sealed answer"):
        unseal(spoil(seal({"a": list(range(50))})))


def test_digests_tell_pieces_apart():
    assert digest(b"ab", b"c") != digest(b"a", b"bc")


def test_data_and_answers_go_to_separate_folders(tmp_path, monkeypatch):
    monkeypatch.setattr(generate, "SETS", tmp_path / "sets")
    monkeypatch.setattr(generate, "ANSWERS", tmp_path / "answers")
    entry = entries()[0]
    name, data, answer = generate.write(entry, guessed())
    files = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert files == [f"answers/{name}.txt", f"sets/{name}/data.csv", f"sets/{name}/model.py"]
    folder = tmp_path / "sets" / name
    assert data == digest(*((folder / f).read_bytes() for f in ("data.csv", "model.py")))
    assert answer == digest((tmp_path / "answers" / f"{name}.txt").read_bytes())


def test_selecting_sets():
    assert run.selected(subset="ci", cell="two-50") == run.selected(
        half="tuning", subset="ci", cell="two-50"
    )
    assert len(run.selected(half="confirm")) == 160
    assert len(run.selected(half="sealed")) == 375
    assert run.selected(ids=["t003"]) == ["t003"]


@pytest.fixture
def one_set(tmp_path, monkeypatch):
    """The folder of one set, and caches in a scratch folder."""
    monkeypatch.setattr(run, "SETS", tmp_path)
    monkeypatch.setattr(records, "CACHE", tmp_path / "cache")
    entry = next(e for e in entries() if e.cell == "none" and e.system == "thermal")
    data, model, _ = made(entry, {})
    (tmp_path / entry.id).mkdir()
    (tmp_path / entry.id / "data.csv").write_text(data)
    (tmp_path / entry.id / "model.py").write_text(model)
    return entry.id


def test_a_run_is_kept_under_its_digest_and_not_made_twice(one_set):
    calls = []

    def diagnose(model, data, *, mode, progress, seed):
        calls.append((model.name, list(data.columns), mode, seed))
        return made_up.report(causes=[("quadratic drag", "v", 1, 0.01, 9.0)])

    first = run.diagnosed(one_set, method="m1", diagnose=diagnose)
    again = run.diagnosed(one_set, method="m1", diagnose=diagnose)
    assert again.text() == first.text()
    assert calls == [("heater in a casing", ["u", "outside", "y1", "y2"], "full", 1)]
    run.diagnosed(one_set, method="m2", diagnose=diagnose)
    assert len(calls) == 2


def test_the_verb_of_the_package_is_called_unless_another_is_given(one_set):
    # In a fresh interpreter: `ssm.diagnose` is imported when it is first asked for, and whatever
    # ran before this test may have asked.
    script = f"""
from pathlib import Path
from bench.gap import records, run
from ssmppl.diagnosis import diagnose as module
from tests.bench_gap import made_up

run.SETS, records.CACHE = Path({str(run.SETS)!r}), Path({str(records.CACHE)!r})
module.diagnose = lambda model, data, **options: made_up.report(causes=[])
print(run.diagnosed({one_set!r}, mode="fast", method="m").failed)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_a_failed_run_is_recorded_with_its_reason(one_set):
    def diagnose(*args, **kwargs):
        raise RuntimeError("no luck")

    record = run.diagnosed(one_set, method="m", diagnose=diagnose)
    assert isinstance(record, Record)
    assert "no luck" in record.failed
