"""Records and scoring, on made-up reports whose marks are known."""

import math

import pytest

from bench.gap import records as kept
from bench.gap.records import Record, from_report, parse
from bench.gap.score import Row, Scored, clopper_pearson, measures, median, rate, table
from tests.bench_gap import made_up

RIGHT = (["quadratic drag"], ["v"])
CAUSES = [
    ("coulomb friction", "v", 1, 0.001, 30.0),
    ("quadratic drag", "v", 1, 0.002, 28.0),
    ("stribeck", "v", 2, 0.01, 12.0),
    ("input delay", "u", 3, 0.5, 1.0),
]


def scored(cell, *effects, **what):
    return Scored(
        from_report("t000", "d" * 12, made_up.report(**what)), made_up.answer(cell, *effects)
    )


def values(*all_scored, fresh=None, simulated=None):
    return {row.measure: row for row in measures("diagnose", all_scored, fresh, simulated)}


def test_the_interval_is_that_of_clopper_and_pearson():
    """Textbook values: 0 of n has the upper end 1 - (a/2)^(1/n); and by inverting the tails."""
    assert clopper_pearson(0, 20) == (0.0, pytest.approx(1 - 0.025 ** (1 / 20)))
    assert clopper_pearson(20, 20) == (pytest.approx(0.025 ** (1 / 20)), 1.0)
    low, high = clopper_pearson(7, 30)
    below = sum(math.comb(30, k) * high**k * (1 - high) ** (30 - k) for k in range(8))
    above = sum(math.comb(30, k) * low**k * (1 - low) ** (30 - k) for k in range(7, 31))
    assert below == pytest.approx(0.025)
    assert above == pytest.approx(0.025)


def test_a_record_survives_its_file():
    record = from_report("t000", "abc", made_up.report(causes=CAUSES, chosen=["stribeck on v"]))
    again = parse(record.text())
    assert again.text() == record.text()
    assert again.chosen == (("stribeck", "v"),)
    assert again.ranked[0].class_id == "1"
    assert again.first_class == (("coulomb friction", "v"), ("quadratic drag", "v"))
    assert math.isnan(parse(Record("t1", "m", "d", "effect").text()).p_detect)


def test_the_gain_of_the_refit_stands_before_that_of_the_screen():
    record = from_report("t000", "abc", made_up.report(causes=CAUSES))
    assert [r.gain for r in record.ranked] == [30.0, 28.0, 12.0, 1.0]


def test_the_class_of_the_first_counts_apart_from_the_first():
    found = values(scored("one-20", RIGHT, causes=CAUSES))
    assert found["right effect first, 20 nats"].value == 0
    assert found["its class first, 20 nats"].value == 1
    assert found["among the first three"].value == 1
    assert found["right equation"].value == 1
    assert found["effect and equation"].value == 0
    assert found["confidence set holds the truth"].value == 1
    assert found["right effect first, 50 nats"].sets == 0


def test_a_member_that_only_the_table_of_classes_lists_counts():
    causes = CAUSES[:1]
    classes = [("1", "quadratic drag", "v", 0.99)]
    found = values(scored("one-50", RIGHT, causes=causes, classes=classes))
    assert found["its class first, 50 nats"].value == 1
    assert found["its size at 50 nats"].value == 2


def test_forms_of_one_effect_are_one_of_the_first_three():
    causes = [("stribeck", "v", k, 0.01, 9.0) for k in range(3)]
    causes += [("dead zone", "u", 4, 0.1, 3.0), ("quadratic drag", "v", 5, 0.1, 2.0)]
    assert values(scored("one-20", RIGHT, causes=causes))["among the first three"].value == 1


def test_alarms_are_any_verdict_but_no_measurable_gap():
    verdicts = ("effect", "none of these", "no measurable gap", "no measurable gap")
    cells = ("none", "none-start", "none-noise")
    sets = [scored(cell, verdict=v) for cell in cells for v in verdicts]
    found = values(*sets)
    assert found["false alarm"].hits == 6
    assert found["false alarm"].sets == 12
    assert found["false alarm, none-start"].value == 0.5


def test_none_of_these_is_right_outside_and_wrong_inside():
    outside = ([], ["v"])
    found = values(
        scored("outside-50", outside, verdict="none of these"),
        scored("outside-50", outside, verdict="effect"),
        scored("one-50", RIGHT, verdict="none of these"),
        scored("two-50", RIGHT, RIGHT, verdict="effect"),
    )
    assert found["none of these found"].value == 0.5
    assert found["none of these falsely said"].value == 0.5


def test_the_arm_has_rows_of_its_own():
    found = values(
        scored("arm", RIGHT, causes=CAUSES[1:]),
        scored("arm", RIGHT, causes=CAUSES),
        scored("arm-none", causes=CAUSES),
    )
    assert found["right effect first, arm"].value == 0.5
    assert found["its class first, arm"].value == 1
    assert found["right equation, arm"].value == 1
    assert found["false alarm, arm-none"].value == 1
    assert found["false alarm"].sets == found["right effect first, 20 nats"].sets == 0


def test_both_of_two_need_both():
    truth = (RIGHT, (["dead zone"], ["u"]))
    found = values(
        scored("two-50", *truth, causes=CAUSES, chosen=["quadratic drag", "dead zone on u"]),
        scored("two-50", *truth, causes=CAUSES, chosen=["quadratic drag", "stribeck"]),
    )
    assert found["both of two found"].value == 0.5


def test_shares_are_those_of_the_truth_and_of_the_best_outside_its_class():
    closed = [("quadratic drag", 0.9, 0.7, 1.1), ("coulomb friction", 0.6, 0.3, 0.8),
              ("stribeck", 0.05, -0.1, 0.2)]  # fmt: skip
    s = scored("one-20", RIGHT, causes=CAUSES, closed=closed)
    assert s.share(True) == 0.9
    assert s.share(False) == 0.05  # not coulomb friction, which is of the truth's class
    unknown = scored("one-20", RIGHT, causes=CAUSES, closed=closed[:2])
    assert math.isnan(unknown.share(False))


def test_coverage_is_of_the_fresh_ratio():
    sets = [scored("one-20", RIGHT, causes=CAUSES, chosen=["quadratic drag"])]
    row = {"F": 0.85, "low": 0.6, "high": 1.0, "F_star": 0.9}
    found = values(*sets, fresh={"t000": row})
    assert found["interval covers F*"].value == 1
    assert found["F of the true effect, 20 nats"].value == 0.85
    assert values(*sets, fresh={"t000": {**row, "F_star": 1.2}})["interval covers F*"].value == 0
    assert values(*sets)["interval covers F*"].sets == 0


def test_simulations_count_where_the_class_is_right():
    right = scored("one-20", RIGHT, causes=CAUSES, chosen=["quadratic drag"])
    wrong = scored("one-20", ("dead zone", "u"), causes=CAUSES, chosen=["quadratic drag"])
    measure = "simulates within 1.2 of the true model, class right"
    for ratio, hits in ((1.2, 1), (1.21, 0)):
        found = values(right, simulated={"t000": {"before": 3.0, "after": ratio}})[measure]
        assert (found.hits, found.sets) == (hits, 1)
    assert values(wrong, simulated={"t000": {"before": 3.0, "after": 1.0}})[measure].sets == 0
    assert values(right)[measure].sets == 0


def test_a_failure_counts_as_wrong():
    failed = Scored(Record("t000", "m", "d", "no measurable gap", failed="Traceback"),
                    made_up.answer("one-20", RIGHT))  # fmt: skip
    found = values(failed)
    assert found["right effect first, 20 nats"].value == 0
    assert found["failed"].value == 1


def test_a_rate_misses_its_target_when_its_interval_excludes_it():
    assert not rate("", "m", [True] * 20 + [False] * 10, ">= 0.75").missed
    assert rate("", "m", [True] * 10 + [False] * 20, ">= 0.75").missed
    assert rate("", "m", [True] * 10 + [False] * 20, "<= 0.07").missed
    assert not rate("", "m", [False] * 30, "<= 0.07").missed
    assert rate("", "m", [True] * 600, "in 0.90-0.98").missed
    assert not Row("", "m", 0.5, 0.4, 0.6, 1, 2, "").missed


def test_the_interval_of_a_median_is_of_order_statistics():
    """Of 1 .. 9: the 2nd and the 8th, which cover with chance 1 - 2 * 10 / 512 = 0.961."""
    row = median("", "m", [float(v) for v in range(1, 10)] + [math.nan], "")
    assert (row.value, row.low, row.high, row.sets) == (5.0, 2.0, 8.0, 9)
    assert math.isinf(median("", "m", [1.0, 2.0], "").high)


def test_the_table_has_a_line_for_each_measure_and_stars_what_misses():
    rows = measures("diagnose", [scored("none", verdict="effect") for _ in range(40)])
    lines = table(rows, ["diagnose"]).splitlines()
    assert len(lines) == len(rows) + 2
    line = next(li for li in lines if li.startswith("| false alarm |"))
    assert "1.00 [0.91, 1.00] n=40*" in line


def test_records_are_kept_by_method_and_digest(tmp_path, monkeypatch):
    monkeypatch.setattr(kept, "CACHE", tmp_path)
    record = from_report("t000", "abcdef0123456789", made_up.report(causes=CAUSES))
    kept.keep(record)
    path = tmp_path / "diagnose" / "abcdef012345" / "t000.json"
    assert parse(path.read_text()) == parse(record.text())
