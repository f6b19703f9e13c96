"""The documentation as far as can be told without building it; the check of what was built."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest

import ssmppl as ssm

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def script(path):
    """A script as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


check_built = script(DOCS / "check_built.py")


def test_every_public_name_is_in_the_reference():
    named = set(re.findall(r"(?m)^ {3}([\w.]+)$", (DOCS / "api.md").read_text(encoding="utf-8")))
    # the catalogue stands there under its class, modules under their functions
    assert set(ssm.__all__) - named == {"effects", "plots", "simulators", "structural"}


def test_every_page_is_in_the_navigation():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"(?m)^tutorials/(\w+)$", index))
    assert listed == {page.stem for page in (DOCS / "tutorials").glob("*.md")}


def test_the_glossary_and_the_readme_name_folders_that_exist():
    page = (DOCS / "explanations" / "glossary.md").read_text(encoding="utf-8")
    last = [line.split("|")[-2] for line in page.splitlines() if line.startswith("| ")]
    named = re.findall(r"`([\w/.]+)`", " ".join(last))
    assert len(named) > 40
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = text.partition("## Structure of the code")[2].partition("Imports point one way")[0]
    outer = ""
    for indent, name in re.findall(r"(?m)^( {6}| {8})([\w.]+/?)(?: |$)", text):
        named.append(name if len(indent) == 6 else outer + name)
        outer = name if len(indent) == 6 else outer
    assert [n for n in named if not (ROOT / "ssmppl" / n).exists()] == []


@pytest.mark.parametrize(
    "name",
    ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "bench/README.md", "examples/README.md"],
)
def test_links_of_files_lead_to_files(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    links = re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", text)
    assert [link for link in links if not (ROOT / name).parent.joinpath(link).exists()] == []


SITE = {
    "index.html": '<a href="a.html#here">a</a><img src="a.png"><a href="https://example.org/x#y">b</a>',
    "a.html": '<p id="here">text<br></p><a href="index.html">home</a>'
    '<div class="cell_output docutils"><pre>fine: 100 iterations</pre></div>',
    "a.png": "",
    "search.html": '<a href="index.html">home</a>',
}


def build(folder, **changed):
    for name, text in {**SITE, **changed}.items():
        (folder / name).write_text(text, encoding="utf-8")
    return list(check_built.faults(folder))


def test_a_site_in_order(tmp_path, capsys):
    assert build(tmp_path) == []
    assert check_built.main(str(tmp_path)) == 0
    assert "in order" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('<a href="b.html">b</a>', "'b.html' leads nowhere"),
        ('<img src="b.png">', "'b.png' leads nowhere"),
        ('<a href="index.html#there">b</a>', "'index.html#there' names an anchor"),
        ('<a href="#there">b</a>', "'#there' names an anchor"),
    ],
)
def test_broken_links_are_found(tmp_path, text, fault):
    (found,) = build(tmp_path, **{"a.html": SITE["a.html"] + text})
    assert found.startswith("a.html: ")
    assert fault in found


def test_a_page_that_nothing_leads_to_is_found(tmp_path):
    found = build(
        tmp_path, **{"b.html": '<a href="c.html">c</a>', "c.html": '<a href="b.html">b</a>'}
    )
    assert found == ["b.html: no link leads to it", "c.html: no link leads to it"]


@pytest.mark.parametrize(
    ("output", "what"),
    [
        ("/tmp/ipykernel_12/3.py:4: it", "a path of the machine"),
        ("UserWarning: chains", "a warning"),
        ("arviz - WARNING - shape", "a warning"),
        ("Traceback (most recent call last)", "a traceback"),
        (" 40%|####   | 12.3it/s", "a progress bar"),
        ("prior 3131051740.py:9", "a cell's file"),
    ],
)
def test_leftovers_are_found_in_outputs_only(tmp_path, output, what):
    page = f'<div class="cell_output"><div><pre>first line\n{output}</pre></div></div>'
    found = build(tmp_path, **{"a.html": SITE["a.html"] + page})
    assert found
    assert all(line.startswith("a.html: ") and repr(output.strip()) in line for line in found)
    assert any(what in line for line in found)
    prose = f"<pre>{output}</pre>"
    assert (
        build(tmp_path, **{"a.html": SITE["a.html"] + page.split("<div>")[0] + "</div>" + prose})
        == []
    )
