"""What `diagnose` returns, and what `print` says of it to a reader without statistics."""

import dataclasses
import math
import pickle
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmppl.diagnosis.experiment.design import ALIKE
from ssmppl.diagnosis.report.findings import COLUMNS, MODES, tabulate
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.report.words import (
    alternatives,
    class_letters,
    headline,
    how_far,
    how_sure,
    label,
    leaders,
    listed,
    next_steps,
    sentence,
    simulated,
    to_decide,
    undecided,
    where,
    which,
)
from ssmppl.diagnosis.verdict.verdicts import CURVES, VERDICTS
from ssmppl.drawing.numerals import DASH, interval, number, p_text, percent, span, with_error
from ssmppl.errors import ArgumentError
from tests.diagnosis.made_up import (
    ALL,
    NAN,
    effect_found,
    fast,
    no_gap,
    none_of_these,
    recovered,
    separation,
    several,
    with_experiment,
)

OPTIONAL = ("missing", "formula", "probabilities", "signals", "left_out")  # tables


def empty(verdict="no measurable gap", **fields):
    """A report that holds nothing."""
    tables = {name: tabulate(name) for name in COLUMNS if name not in OPTIONAL}
    return GapReport(verdict=verdict, **tables, **fields)


# -- numbers
@pytest.mark.parametrize(
    ("text", "found"),
    [
        (number(0.012345), "0.0123"), (number(12345.6), "12,300"), (number(-0.5), "−0.5"),
        (number(0), "0"), (number(NAN), DASH), (number(None), DASH), (number("x"), DASH),
        (number(1.23e-7), "1.23e-07"), (number(9.996), "10"), (number(-math.inf), "−∞"),
        (number(24.3, 2), "24"), (number(4e9), "4.00e+09"),
        (with_error(0.31243, 0.0413), "0.312 ± 0.041"), (with_error(-247.8, 28.1), "−248 ± 28"),
        (with_error(1.2, 0.0), "1.2"), (with_error(1.2, NAN), "1.2"),
        (with_error(0.0021, 0.003), "0.0021 ± 0.0030"), (with_error(12345, 1500), "12,300 ± 1,500"),
        (percent(0.861), "86%"), (percent(-0.12), "−12%"), (percent(NAN), DASH),
        (percent(-0.001), "0%"), (percent(1.08), "108%"),
        (p_text(0.0004), "p < 0.001"), (p_text(0.0123), "p = 0.012"), (p_text(0.43), "p = 0.43"),
        (p_text(NAN), "p unknown"),
        (interval(0.71, 0.99), "95% interval 71% to 99%"),
        (interval(0.4, math.inf), "95% interval: at least 40%"),
        (interval(-math.inf, 0.9), "95% interval: at most 90%"),
        (interval(-math.inf, math.inf), "95% interval: unbounded"),
        (interval(NAN, 1), "no comparison: the reference is this model itself"),
        (span(1, 400), "t = 1 to 400"), (span(1899.0, 1899), "t = 1899"), (span(NAN, 3), ""),
        (span(np.datetime64("2024-01-01").astype(object), "2024-02-01 00:00:00"),
         "t = 2024-01-01 to 2024-02-01"),
        (span(np.datetime64("2024-01-01", "us"), np.datetime64("2024-02-01T06", "us")),
         "t = 2024-01-01 to 2024-02-01T06:00:00"),
    ],
)  # fmt: skip
def test_numbers_are_written_for_readers(text, found):
    assert text == found


@given(st.floats(min_value=1e-30, max_value=1e30), st.booleans())
def test_a_number_keeps_three_digits(size, negative):
    value = -size if negative else size
    back = float(number(value).replace("−", "-").replace(",", ""))
    assert abs(back - value) <= 0.00501 * abs(value)


@given(st.floats(-1e6, 1e6), st.floats(1e-4, 1e5))
def test_a_value_is_rounded_by_less_than_a_tenth_of_its_error(value, error):
    first, _, second = with_error(value, error).replace("−", "-").replace(",", "").partition(" ± ")
    assert abs(float(first) - value) <= 0.0501 * error
    assert abs(float(second) - error) <= 0.0501 * error


# -- names
def test_effects_are_named_in_equations_and_of_inputs():
    assert label("quadratic drag", "v") == "quadratic drag in v"
    assert label("Sensor bias", "y") == "Sensor bias of y"
    assert label("parameter break", "level") == "parameter break of level"
    assert label("the estimated curve", "") == "the estimated curve"
    assert listed(["a", "b", "c"], "or") == "a, b or c"
    assert listed([]) == ""
    assert sentence("x[0] moves.") == "X[0] moves."


def test_leaders_are_the_chosen_causes_each_on_its_equation():
    report = several()
    assert [(r["effect"], r["equation"]) for r in leaders(report)] == [
        ("coulomb friction", "speed[0]"),
        ("coulomb friction", "speed[1]"),
    ]
    same_name = dataclasses.replace(report, chosen=["coulomb friction"] * 2)
    assert [(r["effect"], r["equation"]) for r in leaders(same_name)] == [
        (r["effect"], r["equation"]) for r in leaders(report)
    ]
    # one that is not among the causes is named all the same
    other = dataclasses.replace(report, chosen=["my effect"])
    assert "my effect" in headline(other)
    assert leaders(no_gap()) == []


def test_letters_go_to_classes_with_several_members_best_first():
    assert class_letters(several()) == {2: "A", 3: "B"}
    assert class_letters(effect_found()) == {1: "A"}
    assert class_letters(none_of_these()) == {}


def test_of_many_rivals_some_are_named_and_the_rest_counted():
    report = dataclasses.replace(several(), chosen=["input saturation"])
    assert alternatives(report, leaders(report)[0]) == [
        "input saturation of u1",
        "dead zone of u1",
        "cubic stiffness in speed[0]",
        "2 more",
    ]


def test_what_makes_effects_alike_is_told_by_the_gains_of_their_refits_or_by_their_scores():
    """A rival whose score has little in common with the best one's can gain as much."""
    report = effect_found()
    assert "state-dependent damping in v (refitted, it gains 23 nats)." in " ".join(which(report))
    report = dataclasses.replace(report, causes=report.causes.assign(gain_refit=NAN))
    rho = float(report.classes["rho"].iloc[1])
    assert f"(efficient scores correlated up to |rho| = {rho:.2f})." in " ".join(which(report))


# -- the first line
@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("effect_found", ["lacks one of these", "not distinguishable", "quadratic drag in v or "
                          "state-dependent damping in v", "simulations over 100 rows by 56%",
                          "48% to 63%"]),
        ("none_of_these", ["is misspecified in the mean of v", "none of the 87 effects tried",
                           "62%", "41% to 83%", "p < 0.001"]),
        ("no_gap", ["No measurable gap", "none of the 87 effects", "p = 0.43"]),
        ("fast", ["The score tests indicate", "p < 0.001", "not distinguishable",
                  "not been measured yet"]),
        ("several", ["2 effects", "(1) coulomb friction in speed[0];", "(2) coulomb friction in "
                     "speed[1] or stribeck in speed[1]", "at least 40%"]),
        ("break_of_level", ["“Nile” lacks parameter break of level", "86%", "at most 99%"]),
    ],
)  # fmt: skip
def test_the_first_sentence_is_the_verdict_with_number_and_uncertainty(name, parts):
    report = ALL[name]()
    text = headline(report)
    assert [p for p in parts if p not in text] == []
    assert " ".join(str(report).split()).startswith(text)
    assert text.endswith(".")


def test_the_first_sentence_has_the_p_of_the_gap():
    """The first of a class may have a p of its own that is no evidence: it said "(p = 1.00)"."""
    report = effect_found()
    lost = report.closed.dropna(subset=["F"]).assign(F=NAN, F_low=NAN, F_high=NAN)
    p = np.where(np.arange(len(report.causes)) == 0, 1.0, 0.02)
    told = dataclasses.replace(report, closed=lost, causes=report.causes.assign(p=p))
    assert "(p = 0.020)" in headline(told)
    assert "p = 1.00" not in headline(told)


def test_an_effect_that_gains_nothing_on_data_kept_back_is_said_so():
    report = effect_found()
    lost = report.closed.dropna(subset=["F"]).assign(F=NAN, F_low=NAN, F_high=NAN)
    assert "too uncertain for a share" in headline(dataclasses.replace(report, closed=lost))
    stood_out = dataclasses.replace(no_gap(), causes=report.causes)
    assert "was significant (p < 0.001), but on held-out data" in headline(stood_out)


# -- the whole text
@pytest.mark.parametrize("name", ALL)
def test_the_text_fits_the_page_and_holds_no_leftovers(name):
    text = str(ALL[name]())
    assert max(map(len, text.splitlines())) <= 100
    assert not re.search(r"\bnan\b|\binf\b|None(?! of)|  \.|\.\.|\( |,,", text)
    assert "\N{NO-BREAK SPACE}" not in text
    assert not re.search(r" [a-z] =$| [a-z] <$", text, re.MULTILINE)


@pytest.mark.parametrize("name", ALL)
def test_nats_are_explained_once(name):
    assert " ".join(str(ALL[name]()).split()).count("1 nat is a likelihood ratio of 2.7") == 1


@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("mode", MODES)
def test_an_empty_report_can_be_printed(verdict, mode):
    text = str(empty(verdict, mode=mode))
    assert "Where" in text
    assert not re.search(r"\bnan\b|None(?! of)", text)


def test_the_table_marks_what_was_chosen_predicted_and_alike():
    lines = str(effect_found()).splitlines()
    row = {line.split("  ")[0 if line.startswith("→") else 1]: line for line in lines if " ± " in
           line and "  " in line and line[:2] in ("→ ", "  ")}  # fmt: skip
    assert row["→ quadratic drag in v"].endswith(" A")
    assert any("coulomb friction" in line and "7.2 *" in line for line in lines)
    assert not any("input saturation" in line and "*" in line for line in lines)


def test_where_names_the_places_that_stand_out_and_no_others():
    found = where(effect_found())
    assert found == ["In the mean of v, strongest at t = 412 to 563 and where |v| > 1.2 "
                     "(z = 6.1, p < 0.001)."]  # fmt: skip
    assert len(where(several())) == 2
    assert "the noise variance of z<1>" in where(several())[1]
    assert where(no_gap()) == [
        "No equation shows misfit that is significant after correction for multiple testing."
    ]


def test_what_stands_for_any_cause_does_not_lead_alone_in_fast_mode():
    """A latent process takes any misfit of a mean: its score says nothing against mechanisms."""
    found = fast()
    table = found.causes.copy()
    table.loc[0, ["effect", "form", "kind"]] = ["missing input", "ar1", "unknown input"]
    classes = found.classes.replace({"effect": {"quadratic drag": "missing input"}})
    classes = classes[classes["class_id"] > 1]
    told = dataclasses.replace(found, causes=table, classes=classes)
    for text in (headline(told), " ".join(which(told))):
        assert "state-dependent damping in v promises most (17 nats)" in text
        assert "every other effect" not in text
    weak = table.assign(p=[0.001] + [0.9] * (len(table) - 1))
    for quiet in (found, dataclasses.replace(told, causes=weak)):
        assert "promises" not in headline(quiet) + " ".join(which(quiet))


def test_how_far_says_what_moved_and_which_way():
    good = " ".join(how_far(effect_found()))
    assert f"a density ratio of {number(math.exp(0.0812))}" in good
    found = effect_found()
    far = dataclasses.replace(found, closed=found.closed.assign(nats_per_sample=-73.9))
    assert "density ratio" not in " ".join(how_far(far))
    assert "decreases from 0.213 to 0.094" in good
    assert "t = 711 to 1000" in good
    assert "increases from 0.2 to 0.22" in " ".join(how_far(several()))
    assert "fast mode" in how_far(fast())[0]
    report = effect_found()
    worse = dataclasses.replace(report, closed=report.closed.assign(F=-0.12, F_low=-0.4))
    assert "made the predictions worse" in " ".join(how_far(worse))
    assert how_far(no_gap()) == ["On held-out data (t = 711 to 1000), log predictive density did "
                                 "not improve measurably."]  # fmt: skip


@pytest.mark.parametrize(
    ("share", "low", "high", "words"),
    [
        (0.4, 0.1, 0.6, "reduces the error of simulations over 100 rows by 40% (95% interval 10%"),
        (-0.4, -0.6, -0.1, "increases the error of simulations over 100 rows by 40% (95% interval"),
        (0.1, -0.1, 0.3, "does not measurably reduce the error of simulations over 100 rows (10%"),
        (NAN, NAN, NAN, ""),
    ],
)
def test_what_an_effect_does_to_simulations_is_told_with_its_uncertainty(share, low, high, words):
    report = effect_found()
    window = report.closed["horizon"] == "1 to 100"
    closed = report.closed.copy()
    closed.loc[window, ["share", "low", "high"]] = share, low, high
    text = simulated(dataclasses.replace(report, closed=closed))
    assert text.startswith(words)
    assert bool(text) == bool(words)


def test_nothing_is_told_of_simulations_where_no_gap_is_measurable():
    report = dataclasses.replace(no_gap(), closed=effect_found().closed)
    assert "simulations" not in " ".join(how_far(report))


def test_errors_by_horizon_are_printed_and_none_where_nothing_is_missing():
    text = str(effect_found())
    assert re.search(r"10 +39% \(30% to 46%\) +0\.101 +0\.062 +0\.31", text)
    assert re.search(r"free run +0\.213 +0\.094", text) is None  # of these runs no share is given
    assert "rows ahead" not in str(no_gap())


def test_the_curve_of_none_of_these_is_told_where_its_band_leaves_zero():
    text = " ".join(which(none_of_these()))
    assert re.search(r"largest in magnitude at x = −?0\.5: −?0\.399 \(95% band", text)
    flat = none_of_these()
    flat = dataclasses.replace(flat, missing=flat.missing.assign(low=-1.0, high=1.0))
    assert "largest" not in " ".join(which(flat))


def test_a_ripple_is_told_with_where_the_input_is():
    found = none_of_these()
    over = found.missing["variable"] == "x"
    found.missing.loc[over, "variable"] = "x where u = 2.37"
    text = " ".join(which(found))
    assert re.search(r"largest in magnitude at x = −?0\.5, u = 2\.37: −?0\.399 \(95% band", text)


def test_curves_that_predict_no_other_rows_measure_nothing():
    """The model as it is stands for them then: a reduction by 0% would be no finding."""
    found = none_of_these()
    assert "Not measured" not in " ".join(how_far(found))
    closed = effect_found().closed.assign(effect=CURVES)
    closed["rmse_after"] = closed["rmse_before"]
    found = dataclasses.replace(found, closed=closed)
    (text,) = how_far(found)
    assert text.startswith("Not measured: smooth functions of states and inputs, fitted to the")
    moved = found.closed.assign(rmse_after=0.9 * closed["rmse_before"])
    assert "Not measured" not in how_far(dataclasses.replace(found, closed=moved))[0]


def test_what_to_do_next():
    unknown = dataclasses.replace(several(), chosen=["input saturation"])
    assert "distinguish input saturation of u1, dead zone of u1, cubic stiffness in speed[0] " \
           "from 2 more, add a sensor" in " ".join(next_steps(unknown))  # fmt: skip
    assert "full mode" in " ".join(next_steps(fast()))
    assert "distinguish" not in " ".join(next_steps(fast()))
    stopped = dataclasses.replace(effect_found(), interrupted=True)
    assert "resumes from the completed stages" in next_steps(stopped)[0]


# -- what would tell rivals apart
RIVALS = "These records do not distinguish quadratic drag in v from state-dependent damping in v."


def test_an_experiment_is_told_in_words_with_its_figures():
    found = with_experiment()
    assert to_decide(found) == [
        RIVALS,
        "A triangle of u between −1 and 1 with a period of 40 rows would distinguish them "
        "(expected log-likelihood ratio 7.2 nats between the two, "
        "5.4 are enough; with the recorded inputs: "
        "0.8). The inputs are in experiment.csv.",
        "The signal keeps u within its recorded range, and the models predict that the outputs "
        "stay near theirs.",
        "Without this experiment more than 5 times as many rows with the recorded inputs as the "
        "400 of this record would be needed.",
    ]
    text = " ".join(str(found).split())
    assert "Experiment These records do not distinguish quadratic drag" in text
    places = [text.index(s) for s in ("Evidence", "Experiment These", "effect form strength")]
    assert places == sorted(places)
    steps = " ".join(next_steps(found))
    assert "run experiment.csv (report.experiment in Python) on the system" in steps


def test_an_experiment_to_be_run_several_times():
    """2.2 nats a run are enough in three, which is no more than were recorded; not so in two."""
    told = " ".join(to_decide(with_experiment(separation(2.2, records=3))))
    assert "40 rows would distinguish them, run 3 times (expected log-likelihood ratio 2.2 nats " \
           "between the two in each run, 5.4" in told  # fmt: skip
    assert "as the 400 of the longest record" in told
    told = " ".join(to_decide(with_experiment(separation(2.2, recorded=1.35, records=2))))
    assert "None of the 4 signals of u that were tried would distinguish them; the best, a " \
           "triangle of u between −1 and 1 with a period of 40 rows, " \
           "has an expected log-likelihood ratio " \
           "of 2.2 nats between the two, and 5.4 are needed (with the recorded inputs: 1.4). For " \
           "1 of them the fitted models predict nearly the same and for 1 of them the outputs " \
           "leave their recorded range. About 1,600 rows with the recorded inputs, 4 times as " \
           "many as the 400 of the longest record would be needed" in told  # fmt: skip


def test_where_nothing_separates_it_is_said_and_no_file_named():
    nothing = with_experiment(separation(0.4))
    told = " ".join(to_decide(nothing))
    assert "None of the 4 signals" in told
    assert "the best" not in told  # than nothing
    assert "little difference" not in told
    alike = tuple(dataclasses.replace(t, note=ALIKE, nats=NAN) for t in separation().tried)
    told = to_decide(with_experiment(separation(tried=alike)))
    assert "In the recorded range it makes little difference which of them is used." in told
    for report in (nothing, with_experiment(separation(tried=alike))):
        assert "experiment.csv" not in str(report)
        assert "add a sensor" in " ".join(next_steps(report))


def test_where_the_recorded_inputs_do_nothing_else_is_needed():
    found = with_experiment(separation(recorded=6.0, tried=()))
    assert to_decide(found) == [
        RIVALS,
        "Another 400 rows with the recorded inputs are expected to distinguish them (expected "
        "log-likelihood ratio 6 nats between the two, 5.4 are enough): no other experiment is "
        "needed.",
    ]
    assert "record as much data again" in " ".join(next_steps(found))


def test_without_an_input_to_vary_more_rows_are_the_answer():
    nothing = np.empty((400, 0))
    found = with_experiment(separation(recorded=2.7, tried=(), recorded_inputs=nothing))
    assert to_decide(found)[1:] == [
        "There is no input to vary: about 800 rows of this kind, 2 times as many as the 400 of "
        "this record would be needed (expected log-likelihood ratio "
        "of this record: 2.7 nats between "
        "the two; 5.4 are needed)."
    ]


def test_of_many_rivals_the_hardest_pair_is_meant():
    three = (("stribeck", "v"), *separation().effects)
    told = to_decide(with_experiment(separation(7.2, effects=three, members=5)))
    assert told[0] == "These records do not distinguish stribeck in v, quadratic drag in v and " \
                      "state-dependent damping in v (the first 3 of 5)."  # fmt: skip
    assert "7.2 nats between the two that are hardest to distinguish, 5.4" in told[1]
    assert to_decide(effect_found()) == []
    assert "do not distinguish" not in str(effect_found())


def test_what_does_not_apply_is_told_with_its_reason():
    told = undecided(several())
    assert "Input delay for u2: u2 is constant in these data." in told
    assert any("@ssm.primitive" in line for line in told)


def test_what_does_not_apply_for_one_reason_is_told_once():
    cells = [("drag", "x"), ("stop", "x"), ("stop", "x"), ("drag", "w"), ("outliers", "")]
    why = "it is only the integral of v"
    found = [{"part": p, "equation": e, "reason": why} for p, e in cells]
    report = dataclasses.replace(several(), not_applicable=tabulate("not_applicable", found))
    assert undecided(report)[-3:] == [
        "Drag and stop for x: it is only the integral of v.",
        "Drag for w: it is only the integral of v.",
        "Outliers: it is only the integral of v.",
    ]


# -- the object
def test_a_table_takes_its_columns_and_no_others():
    table = tabulate("where", [{"equation": "v", "z": 2.0}])
    assert tuple(table.columns) == COLUMNS["where"]
    assert table["p"].isna().all()
    with pytest.raises(ArgumentError, match=r"no column 'zz'[\s\S]*equation"):
        tabulate("where", [{"zz": 1}])


def test_a_report_refuses_what_it_does_not_know():
    with pytest.raises(ArgumentError, match="'perfect'"):
        empty("perfect")
    with pytest.raises(ArgumentError, match="'slow'"):
        empty(mode="slow")
    with pytest.raises(ArgumentError, match="'causes' of a report lacks z, p"):
        dataclasses.replace(effect_found(), causes=effect_found().causes.drop(columns=["z", "p"]))


def test_a_report_crosses_processes():
    report = effect_found()
    assert str(pickle.loads(pickle.dumps(report))) == str(report)


def test_a_formula_is_told_as_a_suggestion():
    found = dataclasses.replace(none_of_these(), formula=tabulate("formula", [
        {"equation": "v", "term": "x**2", "coefficient": -0.31, "se": 0.02, "share": 0.86},
        {"equation": "v", "term": "x*u", "coefficient": 0.1234, "se": 0.02, "share": 0.86},
    ]))  # fmt: skip
    text = " ".join(which(found))
    assert "Suggested formula" in text
    assert "add - 0.31*x**2 + 0.123*x*u to v in each step" in text
    assert "86% of the gain of the curves" in text
    assert "formula" not in " ".join(which(none_of_these()))
    assert list(found.tables()["formula"]["term"]) == ["x**2", "x*u"]


# -- who is taken for whom
def test_how_often_the_first_effect_is_recognised_is_told():
    text = " ".join(how_sure(recovered()))
    assert (
        "In data sets simulated with quadratic drag in v and the same inputs, and fitted in the "
        "same way, it came first of 2 effects in 70% of the sets, "
        "state-dependent damping in v in 30%." in text
    )
    report = recovered()
    sure = report.probabilities.assign(probability=[1.0, 0.0, 0.0, 1.0])
    text = " ".join(how_sure(dataclasses.replace(report, probabilities=sure)))
    assert "it came first of 2 effects in 100% of the sets." in text
    assert "came first" not in " ".join(how_sure(effect_found()))
    none = dataclasses.replace(report, verdict="none of these")
    assert "came first" not in " ".join(how_sure(none))
    # forms of one effect count together, and are no rivals of each other
    alike = {"state-dependent damping": "quadratic drag"}
    forms = report.probabilities.replace({"effect": alike, "named": alike})
    assert "came first" not in " ".join(how_sure(dataclasses.replace(report, probabilities=forms)))


def test_forms_of_one_effect_are_named_once():
    report = recovered()
    alike = {"state-dependent damping": "quadratic drag"}
    classes = report.classes.replace({"effect": alike})
    report = dataclasses.replace(report, classes=classes, causes=report.causes.replace(
        {"effect": alike}))  # fmt: skip
    first = leaders(report)[0]
    assert alternatives(report, first) == ["quadratic drag in v"]
    found = separation(7.2, 3.1)
    found = dataclasses.replace(found, effects=(found.effects[0],) * 2)
    told = to_decide(with_experiment(found))
    assert told[0] == "These records do not distinguish the forms of quadratic drag in v."
