"""Rows of the report's tables that need care."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.data import bind, bind_inputs
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue_motion import (
    level_break,
    periodic_forcing,
    quadratic_drag,
    random_walk_load,
)
from ssmppl.diagnosis.effects.catalogue_sensor import sensor_rectification
from ssmppl.diagnosis.experiment.design import ALIKE, BEHIND, OUTSIDE
from ssmppl.diagnosis.experiment.recovery import Recovery
from ssmppl.diagnosis.report.tables import (
    _experiments,
    _strength_row,
    _when,
    bonferroni,
    causes_table,
    classes_table,
    estimated_strength,
    experiment_table,
    probabilities_table,
    signals_table,
    where_table,
)
from ssmppl.diagnosis.report.words import _by_time
from ssmppl.diagnosis.screening.location import localise
from ssmppl.diagnosis.selection.equivalence import Classes
from ssmppl.drawing.numerals import label, span
from ssmppl.language.tracing import trace
from ssmppl.modelfile import read_csv
from tests.diagnosis.made_up import separation
from tests.statistics.checks import seed_of

DRAG = Candidate(quadratic_drag, "v", strength="drag")
LOAD = Candidate(random_walk_load, "v", strength="load")
WAVE = Candidate(periodic_forcing, "v", (("period", 10.0), ("phase", 0.0)), strength="wave")
BREAK = Candidate(level_break, "v", (("date", 2.0),), strength="break")


def table(candidate, strength, variance, refits=(), *, sided=False, quadratic=False):
    screen = SimpleNamespace(
        design=SimpleNamespace(
            candidates=[candidate], sided=np.array([int(sided)]), quadratic=np.array([quadratic]),
            trace=SimpleNamespace(time_step=None),
        ),
        efficient=SimpleNamespace(
            strength=np.array([strength]), variance=np.array([variance]), z=np.array([2.0]),
            gain=np.array([2.0]),
        ),
        candidate_p=np.array([0.2]), experiments=[SimpleNamespace(time=None)],
    )  # fmt: skip
    classes = SimpleNamespace(class_id=np.array([1]))
    return causes_table(screen, refits, classes, [0], {}).iloc[0]


def refitted(candidate, strength, error):
    return SimpleNamespace(
        index=(0,), candidates=(candidate,), strengths=[strength], gain=0.0,
        errors={candidate.strength: error}, bounds=[],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "steps", "rate"),
    [("dt", [0.02, 0.02, 0.02], 15.0), ("dt", [0.02, 0.03, 0.02], np.nan), ("", [], np.nan)],
)
def test_an_increment_of_each_step_is_told_by_time(name, steps, rate):
    """Where the model declares its time step, and all are alike."""
    one = SimpleNamespace(steps=len(steps), inputs={name: np.array(steps)}, time=None)
    declared = (name, "s") if name else None
    found = _strength_row(
        SimpleNamespace(design=SimpleNamespace(trace=SimpleNamespace(time_step=declared)),
                        experiments=[one]), DRAG, 0.3, 0.1,
    )  # fmt: skip
    assert found["rate"] == pytest.approx(rate, nan_ok=True)
    told = _by_time({**found, "estimate": 0.3, "se": 0.1})
    assert told == ("" if np.isnan(rate) else " per row, 15.0 ± 5.0 per unit of time")


def test_what_is_no_increment_has_no_rate():
    screen = SimpleNamespace(design=None, experiments=[])
    for c in (LOAD, replace(DRAG, force="torque")):
        assert np.isnan(_strength_row(screen, c, 0.3, 0.1)["rate"])


def test_a_refit_at_its_bound_is_none():
    row = table(DRAG, 0.5, 4.0, [refitted(DRAG, 1e-14, 1e-28)], sided=True)
    assert row["estimate"] == 0.0
    assert np.isnan(row["se"])
    row = table(DRAG, 0.5, 4.0, [refitted(DRAG, 0.3, 0.1)], sided=True)
    assert (row["estimate"], row["se"]) == (0.3, 0.1)


def test_of_a_process_the_square_is_told():
    """Strength sqrt(s) with error se(s) / (2 sqrt(s)); at s = 0 what one error of s would be."""
    row = table(LOAD, 0.25, 100.0, sided=True, quadratic=True)
    assert row["estimate"] == pytest.approx(0.5)
    assert row["se"] == pytest.approx(0.1)
    row = table(LOAD, 0.0, 100.0, sided=True, quadratic=True)
    assert row["se"] == pytest.approx(np.sqrt(0.1))


def test_shapes_are_those_of_the_refit():
    found = refitted(WAVE.with_shape(period=9.5, phase=1.0), 0.2, 0.1)
    assert table(WAVE, 0.2, 4.0, [found])["form"] == "period = 9.5, phase = 1"
    assert table(WAVE, 0.2, 4.0)["form"] == "period = 10, phase = 0"


@pytest.mark.parametrize(
    ("times", "text"),
    [([None], ""), ([None, [7, 8, 9]], ""), ([np.arange(3) + 1.7e9 + 0.5], " (1700000001.5)"),
     ([[1950, 1951, 1952]], " (1951)"), ([[1950, 1951], [1950]], " (1951)"),
     ([[1950, 1951], [1960, 1961]], ""),
     ([np.array(["2024-03-01", "2024-03-02"], dtype="M8[ns]")], " (2024-03-02)")],
)  # fmt: skip
def test_a_date_is_told_by_the_calendar_of_its_row(times, text):
    """Of row 2; where experiments have other calendars there is none to tell it by."""
    assert _when(BREAK, "date", 2.0, times) == text
    assert _when(BREAK, "other", 2.0, times) == ""
    assert _when(BREAK, "date", 9.0, times) == ""


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.7e9 + 2.5, "1700000002.5"), (12345.678, "12345.678"), (0.1 + 0.2, "0.3"), (1999.0, "1999"),
     (1 / 3, "0.333333"), (-2.5, "-2.5"), (float("nan"), "")],
)  # fmt: skip
def test_labels_keep_the_digits_that_tell_rows_apart(value, text):
    assert label(value) == text


def test_the_p_of_where_counts_both_looks():
    """Each group is looked at alone and beside the others: the smaller of both is no p."""
    rng = np.random.default_rng(seed_of("where"))
    keys = [(f"eq{i}", "mean") for i in range(3)]
    basis, nuisance = rng.standard_normal((101, 6)), rng.standard_normal((101, 2))
    basis[-1] += 2.0
    null = {"basis": basis[:-1], "nuisance": nuisance[:-1]}
    null |= {"basis_bins": np.zeros((100, 1, 6)), "nuisance_bins": np.zeros((100, 1, 2))}
    terms = [SimpleNamespace(equation=e, moment=m, series="") for e, m in keys for _ in range(2)]
    screen = SimpleNamespace(
        observed=SimpleNamespace(basis=basis[-1], nuisance=nuisance[-1]),
        simulated=SimpleNamespace(**null),
        design=SimpleNamespace(terms=terms), experiments=[SimpleNamespace(steps=1, time=None)],
        edges=np.array([0, 1]),
    )  # fmt: skip
    table, _ = where_table(screen, alpha=0.0)
    groups = {k: (basis[:-1, 2 * i : 2 * i + 2], basis[-1, 2 * i : 2 * i + 2])
              for i, k in enumerate(keys)}  # fmt: skip
    wanted = localise(groups, nuisance[:-1], nuisance[-1])[0]
    np.testing.assert_allclose(sorted(table["p"]), sorted(bonferroni(wanted["p_either"])))


@pytest.mark.parametrize(
    ("starts", "rows", "text"),
    [([0], (3, 9), ""), ([0, 20, 50], (0, 20), "1"), ([0, 20, 50], (20, 21), "2"),
     ([0, 20, 50], (19, 21), "1 to 2"), ([0, 20, 50], (0, 80), "1 to 3")],
)  # fmt: skip
def test_a_stretch_of_rows_is_told_by_its_experiments(starts, rows, text):
    assert _experiments(starts, *rows) == text


def test_a_stretch_over_experiments_is_said_with_both_ends():
    assert span(3, 9) == "t = 3 to 9"
    assert span(3, 9, "2") == "t = 3 to 9 of experiment 2"
    assert span(3, 9, "1 to 2") == "t = 3 of experiment 1 to t = 9 of experiment 2"


@pytest.mark.parametrize(("strength", "shown"), [(1.0, 1.0), (0.98, 0.98), (1e-9, 0.0)])
def test_a_strength_at_its_upper_bound_is_not_shown_as_none(strength, shown):
    """The sensor of a belt's speed gives its size whole: the estimate runs to 1, and stood as 0."""
    c = Candidate(sensor_rectification, "y", role="channel", strength="fold")
    fit = SimpleNamespace(
        candidates=(c,), strengths=[strength], bounds=["fold"], errors={"fold": np.nan}
    )
    row = estimated_strength(SimpleNamespace(experiments=[]), fit, c)
    assert row["estimate"] == shown


# -- the experiment
def model_with(inputs, **options):
    """A walk that a sum of inputs drives."""
    model = ssm.Model("driven", inputs=inputs, **options)
    names = list(inputs)
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})

    def transition(x, u):
        return {"x": ssm.Normal(x + np.sum(u), sd=1)}

    if "dt" in names:

        def transition(x, u, dt):
            return {"x": ssm.Normal(x + dt * np.sum(u), sd=1)}

    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return model


def experiments_of(model, *data):
    traced = trace(model)
    return traced, [e for d in data for e in bind(traced, d)]


def made(traced, experiments, inputs):
    return experiment_table(traced, experiments, separation(7.0, inputs=inputs))


def test_an_experiment_has_a_row_for_each_of_the_longest_record():
    y = {n: np.zeros(n) for n in (5, 8)}
    given = [{"y": v, "u": np.ones(n)} for n, v in y.items()]
    traced, found = experiments_of(model_with(("u",)), *given)
    table = made(traced, found, np.arange(8.0)[:, None])
    assert list(table.columns) == ["u"]
    np.testing.assert_array_equal(table["u"], np.arange(8.0))
    labelled = [d | {"time": 10.0 * np.arange(len(d["y"]))} for d in given]
    table = made(traced, experiments_of(model_with(("u",)), *labelled)[1], np.ones((8, 1)))
    np.testing.assert_array_equal(table["time"], 10.0 * np.arange(8))
    assert experiment_table(traced, found, separation(7.0, inputs=None)) is None


def test_components_and_labels_of_rows_are_read_back_as_inputs(tmp_path):
    """A vector takes two columns; the labels come back, and the values to the last digit."""
    model = model_with({"u": 2})
    data = pd.DataFrame({"y": np.zeros(6), "u_0": 1.0, "u_1": np.arange(6.0)},
                        index=pd.Index(0.5 * np.arange(6), name="time"))  # fmt: skip
    traced, found = experiments_of(model, data)
    wanted = np.random.default_rng(3).standard_normal((6, 2))
    table = made(traced, found, wanted)
    assert list(table.columns) == ["time", "u_0", "u_1"]
    table.to_csv(tmp_path / "experiment.csv", index=False)
    u, rows, source = bind_inputs(traced, read_csv(tmp_path / "experiment.csv"), None)
    np.testing.assert_array_equal(u, wanted)
    np.testing.assert_array_equal(source.time, data.index)
    assert rows == 6


@pytest.mark.parametrize("own", [False, True])
def test_the_length_of_a_step_is_left_to_the_labels_where_it_follows_from_them(own):
    times = np.array([0.0, 1.0, 3.0, 4.0])
    given = {"y": np.zeros(4), "u": np.arange(4.0), "time": times}
    if own:
        given["dt"] = np.full(4, 0.1)
    traced, found = experiments_of(model_with(("u", "dt"), time_step="dt"), given)
    table = made(traced, found, found[0].u)
    assert list(table.columns) == ["time", "u", *["dt"] * own]
    u, *_ = bind_inputs(traced, table, None)
    np.testing.assert_array_equal(u, found[0].u)


def test_probabilities_are_of_each_pair():
    sets = np.zeros((2, 4, 2))
    sets[0, :, 1] = [-1.0, -2.0, 0.5, -3.0]
    sets[1, :, 0] = -1.0
    found = Recovery((5, 2), np.array([10.0, 8.5]), sets)
    offered = [SimpleNamespace(effect=SimpleNamespace(name=f"e{k}"), place=f"q{k}", form=f"f{k}")
               for k in range(6)]  # fmt: skip
    table = probabilities_table(SimpleNamespace(design=SimpleNamespace(candidates=offered)), found)
    assert table[["effect", "equation", "named", "named_equation"]].values.tolist() == [
        ["e5", "q5", "e5", "q5"], ["e5", "q5", "e2", "q2"],
        ["e2", "q2", "e5", "q5"], ["e2", "q2", "e2", "q2"],
    ]  # fmt: skip
    np.testing.assert_allclose(table["probability"], [0.75, 0.25, 0.0, 1.0])
    assert table["form"].tolist() == ["f5", "f5", "f2", "f2"]
    assert table["named_form"].tolist() == ["f5", "f2", "f5", "f2"]
    np.testing.assert_allclose(table["behind"], [0.0, 0.0, 1.5, 1.5])
    np.testing.assert_allclose(table["cut"], [0.5, 0.5, 0.0, 0.0])


def test_signals_stand_behind_the_recorded_inputs():
    table = signals_table(separation(7.2, 3.1))
    assert list(table["signal"][:2]) == [
        "as recorded", "a triangle of u between −1 and 1 with a period of 40 rows"
    ]  # fmt: skip
    np.testing.assert_allclose(table["nats"][:3], [0.8, 7.2, 3.1])
    assert list(table["note"][-3:]) == [OUTSIDE, ALIKE, BEHIND]
    assert signals_table(separation(tried=())) is None


def test_the_first_class_has_the_signal_that_separates_it():
    names = [DRAG, LOAD, WAVE, BREAK]
    screen = SimpleNamespace(design=SimpleNamespace(candidates=names))
    found = Classes(np.array([1, 1, 2, 2]), np.array([0, 0, 2, 2]), np.array([1, 0.9, 1, 0.9]))
    for separated, words in ((separation(7.2), "a triangle of u"), (separation(0.3), ""),
                             (None, "")):  # fmt: skip
        table = classes_table(screen, found, range(4), separated)
        first, second = (table[table["class_id"] == k]["separating_input"] for k in (1, 2))
        assert all(s.startswith(words) and bool(s) == bool(words) for s in first)
        assert list(second) == ["", ""]
