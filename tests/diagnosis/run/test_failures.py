"""A fault in one part of a diagnosis ends that part and no other, and the report says so."""

import dataclasses
import importlib

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis import diagnose
from ssmppl.diagnosis.heldout import cross_validation
from ssmppl.diagnosis.model import candidates
from ssmppl.diagnosis.report import tables
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.run.failures import FAULT, Failures, Tolerant, reason_of
from ssmppl.diagnosis.screening import screen
from ssmppl.diagnosis.selection import effect_selection, refit
from ssmppl.diagnosis.verdict.verdicts import VERDICTS
from ssmppl.errors import ExecutorError, SSMError
from tests.diagnosis.made_up import effect_found
from tests.diagnosis.small import BREAK, level, levels

FEW, BLOCKS = 60, 5
EFFECTS = ["level break", "sensor drift"]


@pytest.fixture(autouse=True)
def few_sets(monkeypatch):
    monkeypatch.setattr(diagnose, "SETS", {"fast": FEW, "full": FEW})
    monkeypatch.setattr(cross_validation, "SETS", FEW)
    monkeypatch.setattr(cross_validation, "SINGLES", 1)
    for module in (diagnose, cross_validation):
        monkeypatch.setattr(module, "FOLDS", BLOCKS)


def run(**kwargs):
    kwargs = {"mode": "fast", "effects": EFFECTS, "progress": False, "particles": 100, **kwargs}
    return ssm.diagnose(level(), levels(80, BREAK), **kwargs)


def broken(patch, module, name, error, when=lambda *args: True):
    """A function that raises."""
    whole = getattr(module, name)

    def raises(*args, **kwargs):
        if when(*args):
            raise error
        return whole(*args, **kwargs)

    patch.setattr(module, name, raises)


# -- what is kept of an error
@pytest.mark.parametrize(
    ("error", "text"),
    [(KeyError("stribeck_v"), "KeyError: 'stribeck_v' (internal error in ssmppl)"),
     (AssertionError(), "AssertionError (internal error in ssmppl)"),
     (SSMError("the likelihood is zero", fix="start elsewhere"), "the likelihood is zero"),
     (ValueError("one\ntwo"), "ValueError: one (internal error in ssmppl)")],
)  # fmt: skip
def test_a_reason_is_one_line(error, text):
    assert reason_of(error) == text


def test_a_long_reason_is_cut():
    assert len(reason_of(SSMError("x" * 1000))) == 160


def test_an_interrupt_and_a_lost_executor_are_no_failures_of_a_part():
    failures = Failures()
    for error in (KeyboardInterrupt, ExecutorError("a worker died")):
        with pytest.raises((KeyboardInterrupt, ExecutorError)), failures.guard("a table"):
            raise error
    assert not len(failures)


def _halved(k):
    if k == 1:
        raise ZeroDivisionError("by nothing")
    return {"half": np.asarray(k / 2)}


def test_a_task_that_fails_is_not_kept(tmp_path):
    """The others are; another call tries it again."""
    kept = Checkpoint(tmp_path / "stages.npz", {"mode": "full"})
    found = kept.map("halves", 3, _halved)
    assert [float(found[k]["half"]) for k in (0, 2)] == [0.0, 1.0]
    assert kept.failures.record_task("the half of 1", found[1])
    assert list(kept.failures) == [
        ("the half of 1", "ZeroDivisionError: by nothing (internal error in ssmppl)")
    ]
    again = Checkpoint(tmp_path / "stages.npz", {"mode": "full"})
    assert "halves/0" in again
    assert "halves/1" not in again


def test_a_task_raises_what_is_raised_on_purpose():
    def task(k):
        raise SSMError("no")

    with pytest.raises(SSMError):
        Tolerant(task)(0)
    assert FAULT in Tolerant(_halved)(1)


def test_with_debug_a_task_raises_its_fault():
    with pytest.raises(ZeroDivisionError):
        Checkpoint(None, {}, failures=Failures(True)).map("halves", 3, _halved)


# -- in a diagnosis
FAST = [
    (tables, "where_table", "the table 'where'"),
    (tables, "causes_table", "the table 'causes'"),
    (tables, "classes_table", "the table 'classes'"),
    (tables, "map_table", "the table 'residual_map'"),
    (
        importlib.import_module("ssmppl.diagnosis.report.build"),
        "_detection",
        "the table 'detection'",
    ),
    (diagnose, "timed", "the time that is expected"),
    (screen, "basis", "the basis of smooth functions"),
]


@pytest.mark.parametrize(("module", "name", "part"), FAST)
def test_a_table_or_stage_that_fails_is_left_out(monkeypatch, module, name, part):
    """KeyError in `causes_table` lost six runs, some of them after minutes."""
    broken(monkeypatch, module, name, KeyError("stribeck_v"))
    report = run(progress=part.startswith("the time"))
    assert report.left_out["part"].tolist() == [part]
    assert report.left_out["reason"].tolist() == [
        "KeyError: 'stribeck_v' (internal error in ssmppl)"
    ]
    assert report.verdict in VERDICTS
    assert f"- {part[0].upper()}{part[1:]}: KeyError" in str(report)


def test_with_debug_the_fault_is_raised(monkeypatch):
    broken(monkeypatch, tables, "causes_table", KeyError("stribeck_v"))
    with pytest.raises(KeyError):
        run(debug=True)


def test_an_effect_that_cannot_be_bound_leaves_the_others(monkeypatch):
    """AssertionError in `_given` lost two runs."""
    broken(monkeypatch, candidates, "_of_effect", AssertionError(),
           lambda effect, *_: effect.name == "sensor drift")  # fmt: skip
    report = run()
    assert report.left_out["part"].tolist() == ["the effect 'sensor drift'"]
    assert set(report.causes["effect"]) == {"level break"}


def test_a_candidate_without_columns_leaves_the_others(monkeypatch):
    broken(monkeypatch, screen, "score_columns", AssertionError(),
           lambda base, superset, names, *_: any("drift" in n for n in names))  # fmt: skip
    report = run()
    assert [p.split(" in ")[0] for p in report.left_out["part"]] == ["the candidate sensor drift"]
    assert set(report.causes["effect"]) == {"level break"}


def test_simulated_sets_that_fail_leave_the_others(monkeypatch):
    broken(monkeypatch, screen.ScreenDesign, "statistics", ZeroDivisionError(),
           lambda *_: next(counted) % 20 == 19)  # fmt: skip
    counted = iter(range(10**6))
    monkeypatch.setattr(diagnose, "SETS", {"fast": FEW + 10, "full": FEW})
    report = run()
    assert report.left_out["part"].tolist() == ["a data set of screening"]
    assert FEW <= report.settings["simulated sets"] < FEW + 10


def test_without_a_fit_the_error_is_one_of_ours(monkeypatch):
    broken(monkeypatch, diagnose, "proper_initial_law", IndexError("out of range"))
    with pytest.raises(SSMError, match=r"'level' could not be finished: IndexError: out of range"):
        run()
    with pytest.raises(IndexError):
        run(debug=True)


FULL = [
    (effect_selection, "refit_all", "refitting"),
    (effect_selection, "shaped_all", "estimating shapes"),
    (effect_selection.EffectSelection, "_best_pair", "pairs of effects"),
    (effect_selection.EffectSelection, "_forward", "whether a second effect is missing"),
    (effect_selection.EffectSelection, "_by_refit", "the test of what a refit gains"),
    (refit, "refit", "the refit with level break in x with date = 31"),
    (cross_validation.CrossValidation, "gain", "how far the gap closes"),
    (cross_validation.CrossValidation, "_one", "block 1 of 5"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("module", "name", "part"), FULL)
def test_a_stage_of_full_mode_that_fails_is_left_out(monkeypatch, module, name, part):
    broken(monkeypatch, module, name, ZeroDivisionError())
    report = run(mode="full")
    parts = report.left_out["part"].tolist()
    assert any(p.startswith(part.split(" with date")[0]) for p in parts)
    assert report.verdict in VERDICTS
    if name not in ("refit_all", "refit"):
        assert report.chosen == ["level break"]
    assert str(report)


@pytest.mark.slow
def test_an_interrupt_ends_the_run(monkeypatch):
    broken(monkeypatch, effect_selection, "shaped_all", KeyboardInterrupt())
    assert run(mode="full").interrupted


# -- what is drawn and written
def test_a_panel_that_fails_is_left_out(monkeypatch, tmp_path):
    report = dataclasses.replace(effect_found(), failures=Failures())
    figure = importlib.import_module("ssmppl.diagnosis.report.panels")
    broken(monkeypatch, figure, "ranked_effects", ZeroDivisionError())
    page = report.save(tmp_path)
    assert report.left_out["part"].tolist() == ["the panel 'ranked_effects'"]
    assert not (tmp_path / "ranked_effects.png").exists()
    assert (tmp_path / "free_run.png").exists()
    assert "Failed computations" in page.read_text()
    assert "ranked_effects" in (tmp_path / "left_out.csv").read_text()


def test_tables_of_the_page_that_fail_are_left_out(monkeypatch):
    module = importlib.import_module("ssmppl.diagnosis.report.page")
    report = dataclasses.replace(effect_found(), failures=Failures())
    broken(monkeypatch, module, "_cell", ZeroDivisionError())
    text = module.page(report)
    assert report.left_out["part"].tolist() == ["the page's tables"]
    assert ">Plots<" in text
