"""What notebooks show of a model, a plan, an estimate and a report: tables, escaped, uncoloured."""

import dataclasses
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl import markup
from tests.diagnosis.made_up import ALL, effect_found
from tests.plots.results import data, level, maximised


class Read(HTMLParser):
    """Cells of the tables and all text; fails where tags do not match."""

    def __init__(self, text):
        super().__init__()
        self.open, self.rows, self.words, self.tags = [], [], "", []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.words += text
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += text


SHOWN = {
    "model": lambda: level,
    "plan": lambda: ssm.explain(level, data()),
    "estimate": maximised,
    **{f"report {name}": make for name, make in ALL.items()},
}


@pytest.mark.parametrize("name", SHOWN)
def test_tables_bring_no_colours_and_ask_for_nothing(name):
    found = SHOWN[name]()._repr_html_()
    found = re.sub(r"<svg.*?</svg>", "", found, flags=re.DOTALL)  # has a white ground of its own
    read = Read(found)
    assert read.rows
    for tag, attrs in read.tags:
        assert tag not in ("script", "link", "img", "style", "iframe")
        assert set(attrs) <= {"style"}
        assert not any(w in attrs.get("style", "") for w in ("color", "background", "url", "font"))
    assert len(found) < 20_000


def test_a_model_shows_its_functions_and_where_they_stand():
    read = Read(level._repr_html_())
    assert ["function", "depends on", "declared at"] in read.rows
    assert ["inputs", "push", ""] in read.rows
    (row,) = [r for r in read.rows if r[0] == "transition"]
    assert row[1] == "x, q, push"
    assert row[2].startswith("results.py:")
    assert "level <1>" in read.words
    assert "<1>" not in level._repr_html_()
    assert "ssm.Normal(x + np.array([push, 0.0]), sd=q)" in read.words


def test_cells_of_a_notebook_go_by_their_number(monkeypatch):
    def named(file):
        return ("Cell", "In[3]") if file == __file__ else None

    compiler = SimpleNamespace(format_code_name=named)
    shell = SimpleNamespace(get_ipython=lambda: SimpleNamespace(compile=compiler))
    model, file = steps_of(1), Path(__file__).name
    line = model.functions["transition"][0].__code__.co_firstlineno + 1  # below its decorator
    outside = model._repr_html_(), ssm.compile(model).source()
    assert all(f"{file}:{line}" in text for text in outside)
    monkeypatch.setitem(sys.modules, "IPython", shell)
    inside = model._repr_html_(), ssm.compile(model).source()
    assert all(f"In[3]:{line}" in text and f"{file}:" not in text for text in inside)


def test_models_without_functions_or_text_are_shown_too():
    assert "Nothing is declared yet" in ssm.Model("empty")._repr_html_()
    typed = ssm.Model("typed")
    space = {"ssm": ssm}
    exec("def initial():\n    return {'x': ssm.Normal(0, sd=1)}", space)
    typed.initial(space["initial"])
    assert "initial" in Read(typed._repr_html_()).words


def test_a_plan_shows_its_sections():
    plan = ssm.explain(level, data())
    read = Read(plan._repr_html_())
    rows = [row for _, rows in plan.sections() for row in rows]
    assert [tuple(r) for r in read.rows] == rows
    assert all(title in read.words for title, _ in plan.sections())


def steps_of(count):
    """A model whose transition is a loop of so many small steps."""
    model = ssm.Model("small steps")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})

    @model.transition
    def transition(x):
        mean = x
        for _ in range(count):
            mean = mean + 0.01 * np.sin(mean)
        return {"x": ssm.Normal(mean, sd=1)}

    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return model


def test_a_law_that_would_fill_pages_is_cut():
    laws = {n: dict(ssm.explain(steps_of(n)).sections())["Transition, x_prev to x"] for n in (2, 8)}
    ((_, short),) = laws[2]
    ((_, long),) = laws[8]
    assert short.startswith("~ Normal(mean=x_prev + 0.01*sin(x_prev) + 0.01*sin(")
    assert short.endswith("sd=1)")
    assert long.startswith("~ Normal(mean=x_prev + 0.01*sin(x_prev) + 0.01*sin(")
    assert long.endswith("ssm.compile(model).source() has all of it, in steps)")
    assert len(long) < 700


def test_an_estimate_shows_its_table():
    estimate = maximised()
    read = Read(estimate._repr_html_())
    assert read.rows[0] == ["", "estimate", "standard error"]
    assert read.rows[1][:2] == ["q", f"{estimate.parameters['q']:.6g}"]
    assert f"log-likelihood {estimate.log_likelihood:.6f}" in read.words
    noted = dataclasses.replace(estimate, attrs={**estimate.attrs, "covariance": "none: <b>"})
    assert "Note: no standard errors: <b>" in Read(noted._repr_html_()).words


def test_a_report_says_what_it_prints():
    report = effect_found()
    read = Read(report._repr_html_())
    printed = " ".join(str(report).split())
    for name in ("Where", "Which", "Gain", "Evidence"):
        (row,) = [r for r in read.rows if r[0] == name]
        assert " ".join(row[1].split())[:60] in printed
    assert [r[0] for r in read.rows if r[0].startswith("→")] == ["→ quadratic drag in v"]


def test_values_are_escaped():
    assert markup.table([(markup.text("<a & b>"),)], ["<h>"]).count("<a") == 0
    assert Read(markup.table([(markup.text("<a & b>"),)], ["<h>"])).rows == [["<h>"], ["<a & b>"]]
    assert Read(markup.folded("<t>", markup.paragraph("<p>"))).words == "<t><p>"
