"""What notebooks show of a model, a plan, an estimate and a report: tables, escaped, uncoloured."""

import dataclasses
from html.parser import HTMLParser

import pytest

import ssmppl as ssm
from ssmppl import markup
from tests.gap.made_up import ALL, effect_found
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
    read = Read(found)
    assert read.rows
    for tag, attrs in read.tags:
        assert tag not in ("script", "link", "img", "style", "iframe")
        assert set(attrs) <= {"style"}
        assert not any(w in attrs.get("style", "") for w in ("color", "background", "url", "font"))
    assert len(found) < 20_000


def test_a_model_shows_its_laws_and_where_they_stand():
    read = Read(level._repr_html_())
    assert ["law", "depends on", "declared at"] in read.rows
    assert ["inputs", "push", ""] in read.rows
    (row,) = [r for r in read.rows if r[0] == "transition"]
    assert row[1] == "x, q, push"
    assert row[2].startswith("results.py:")
    assert "level <1>" in read.words
    assert "<1>" not in level._repr_html_()
    assert "ssm.Normal(x + np.array([push, 0.0]), sd=q)" in read.words


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


def test_an_estimate_shows_its_table():
    estimate = maximised()
    read = Read(estimate._repr_html_())
    assert read.rows[0] == ["", "estimate", "standard error"]
    assert read.rows[1][:2] == ["q", f"{estimate.parameters['q']:.6g}"]
    assert f"log-likelihood {estimate.log_likelihood:.6f}" in read.words
    noted = dataclasses.replace(estimate, attrs={**estimate.attrs, "covariance": "none: <b>"})
    assert "Note: none: <b>" in Read(noted._repr_html_()).words


def test_a_report_says_what_it_prints():
    report = effect_found()
    read = Read(report._repr_html_())
    printed = " ".join(str(report).split())
    for name in ("Where", "Which", "How far", "How sure"):
        (row,) = [r for r in read.rows if r[0] == name]
        assert " ".join(row[1].split())[:60] in printed
    assert [r[0] for r in read.rows if r[0].startswith("→")] == ["→ quadratic drag in v"]


def test_values_are_escaped():
    assert markup.table([(markup.text("<a & b>"),)], ["<h>"]).count("<a") == 0
    assert Read(markup.table([(markup.text("<a & b>"),)], ["<h>"])).rows == [["<h>"], ["<a & b>"]]
    assert Read(markup.folded("<t>", markup.paragraph("<p>"))).words == "<t><p>"
