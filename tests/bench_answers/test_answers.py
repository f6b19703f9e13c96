"""How `bench/answers.py` asks, judges and prints; the questions themselves take minutes."""

import json
import warnings

import pytest

from bench.answers import MARK, QUESTIONS, ask, markdown, rows_of
from bench.questions.discrete import exact_posterior
from bench.questions.question import OWN, Answer, Program, Question, Unavailable, distant


def question(own, others=(), rate=""):
    def right(found, answers):
        return distant(found, {"a": answers["other"].estimates["a"][0]}, 0.5)

    programs = Program(OWN, lambda: own), *others
    return Question("k", "what is a?", 0.0 if rate else 1e9, programs, right, rate=rate)


def other(value=1.0):
    return Program("other", lambda: lambda seed: Answer({"a": (value, 0.1)}, seconds=0.5))


def said_by(capsys, made, repeats):
    ask(made, repeats)
    lines = capsys.readouterr().out.splitlines()
    return [json.loads(line.removeprefix(MARK)) for line in lines if line.startswith(MARK)]


def missing():
    raise Unavailable("it is not installed")


def test_a_right_answer_beside_anothers(capsys):
    seeds = []

    def run(seed):
        seeds.append(seed)
        return Answer({"a": (1.01, 0.1)}, {"R-hat": 1.0}, seconds=0.25)

    made = question(run, (other(), Program("none", missing)))
    rows = rows_of(made, said_by(capsys, made, 2))
    assert seeds == [0, 1, 2]
    assert [row["program"] for row in rows] == [OWN, "other", "none"]
    assert rows[0]["runs"] == "2"
    assert rows[0]["faults"] == ""
    assert float(rows[0]["figure"]) == 0.25
    assert rows[2]["answer"] == "missing: it is not installed"
    lines = markdown(rows).splitlines()
    assert "1000000000 s: met" not in lines[3]
    assert " met" in lines[2]
    assert "| 2 (" in lines[3]  # the other takes twice as long


def test_faults_failures_and_warnings_are_told(capsys):
    def run(seed):
        if seed == 0:
            warnings.warn("look out", stacklevel=1)
        if seed == 2:
            raise ValueError("no more")
        return Answer({"a": (2.0, 0.1)})

    made = question(run, (other(),))
    (own, _) = rows_of(made, said_by(capsys, made, 3))
    assert "a is 2, 10 standard errors from 1 (2 of 3 runs)" in own["faults"]
    assert "warns: look out (1 of 3 runs)" in own["faults"]
    assert "ValueError: no more (1 of 3 runs)" in own["faults"]


def test_rates_are_made_a_second(capsys):
    made = question(lambda seed: Answer({"a": (1.0, 0.1)}, amount=10.0, seconds=2.0), (other(),),
                    rate="draws")  # fmt: skip
    own = rows_of(made, [s for s in said_by(capsys, made, 1) if s["program"] == OWN]
                  + [{"program": "other", "turn": 1, "wall": 1.0, "processor": 1.0, "warned": [],
                      "answer": {"estimates": {"a": (1.0, 0.1)}, "amount": 20.0}}])  # fmt: skip
    assert float(own[0]["figure"]) == 5.0
    assert float(own[1]["figure"]) == 20.0
    assert "| 0.25 (" in markdown(own)


def test_every_question_begins_with_ssmppl():
    assert all(q.programs[0].name == OWN for q in QUESTIONS.values())


def test_the_exact_posterior_of_the_capture_histories():
    """The midpoint rule converges: half as many points move nothing."""
    fine, coarse = exact_posterior(400), exact_posterior(200)
    for name, (mean, sd) in fine.items():
        assert coarse[name] == pytest.approx((mean, sd), rel=1e-5)
