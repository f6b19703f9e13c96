"""The page of a report: well-formed, self-contained, in the right order, opened in a browser."""

import base64
import dataclasses
import functools
import html
import html.parser
import io
import itertools
import re
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import ssmppl.plots as plots
from ssmppl.diagnosis.report.findings import COLUMNS, tabulate
from ssmppl.diagnosis.report.panels import TITLES
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.report.text import AHEAD
from ssmppl.errors import ArgumentError
from tests.diagnosis.made_up import (
    ALL,
    MODEL_TEXT,
    effect_found,
    fast,
    no_gap,
    separation,
    several,
    with_experiment,
)

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
VOID = {"meta", "img", "source", "br", "hr", "link", "input"}
NAMES = ["effect_found", "no_gap", "several"]
PHONE, DESK = 390, 1200  # CSS pixels


@functools.cache
def page(name):
    return plots.page(ALL[name]())


class Reader(html.parser.HTMLParser):
    """Elements in order: tag, attributes, path of open tags, text; and the faults of nesting."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.faults, self._open, self._texts = [], [], [], []
        self.feed(text)
        self.close()
        self.faults += [f"<{tag}> is not closed" for tag, _ in self._open]

    def handle_starttag(self, tag, attrs):
        path = tuple(t for t, _ in self._open)
        self._texts.append([])
        self.elements.append((tag, dict(attrs), path, self._texts[-1]))
        if tag not in VOID:
            self._open.append((tag, self._texts[-1]))

    def handle_endtag(self, tag):
        if not self._open or self._open[-1][0] != tag:
            self.faults.append(f"</{tag}> closes {[t for t, _ in self._open][-1:]}")
        if any(t == tag for t, _ in self._open):
            while self._open.pop()[0] != tag:
                pass

    def handle_data(self, data):
        for _, text in self._open:
            text.append(data)

    def all(self, tag, **attrs):
        """(attributes, text) of the elements of a tag with these attributes."""
        return [
            (found, "".join(text).replace("\N{NO-BREAK SPACE}", " "))
            for name, found, _, text in self.elements
            if name == tag and all(found.get(k.strip("_")) == v for k, v in attrs.items())
        ]


@pytest.mark.parametrize("name", NAMES)
def test_the_page_is_well_formed_and_says_what_it_is(name):
    reader = Reader(page(name))
    assert reader.faults == []
    assert page(name).startswith("<!DOCTYPE html>")
    assert reader.all("html")[0][0]["lang"] == "en"
    assert "width=device-width" in reader.all("meta", name="viewport")[0][0]["content"]
    assert len(reader.all("h1")) == len(reader.all("main")) == len(reader.all("title")) == 1
    levels = [int(tag[1]) for tag, *_ in reader.elements if re.fullmatch("h[1-6]", tag)]
    assert all(b <= a + 1 for a, b in itertools.pairwise(levels))


@pytest.mark.parametrize("name", NAMES)
def test_the_page_needs_nothing_else(name):
    reader = Reader(page(name))
    assert not {"script", "link", "iframe", "object"} & {tag for tag, *_ in reader.elements}
    for tag, attrs, *_ in reader.elements:
        assert not [k for k in attrs if k.startswith("on")], tag
        for key in ("src", "srcset", "href"):
            assert attrs.get(key, "data:").startswith("data:"), (tag, key)
    assert not re.search(r"url\(|@import|https?:", page(name))


def test_the_answer_comes_first_then_how_sure_then_what_next_and_the_model_last():
    found = [text for _, text in Reader(page("effect_found")).all("h2")]
    assert found == [
        "Where is the misfit?", "Which effect is missing?",
        "How much does it improve predictions?", "Evidence", "Next steps", "Plots", "Tables",
        "Glossary",
        "Augmented model",
    ]  # fmt: skip
    paragraphs = [text for _, text in Reader(page("effect_found")).all("p")]
    assert paragraphs[0].startswith("The model “oscillator” lacks one of these")


@pytest.mark.parametrize("name", NAMES)
def test_every_picture_has_two_widths_and_says_what_it_shows(name):
    reader = Reader(page(name))
    images, wide = reader.all("img"), reader.all("source")
    assert len(images) == len(wide) == len(reader.all("figure")) >= 3
    for (attrs, _), (source, _) in zip(images, wide, strict=True):
        assert len(attrs["alt"]) > 30
        sizes = [picture(text).size for text in (attrs["src"], source["srcset"])]
        assert sizes[0][0] < sizes[1][0]
    spoken = " ".join(attrs["alt"] for attrs, _ in images)
    assert "nan" not in spoken
    if name == "effect_found":
        assert "quadratic drag in v 24" in spoken.replace("\N{NO-BREAK SPACE}", " ")


def picture(uri):
    kind, _, coded = uri.partition(",")
    assert kind == "data:image/png;base64"
    return Image.open(io.BytesIO(base64.b64decode(coded)))


def test_names_and_notes_are_shown_as_they_are_written():
    text = page("several")
    assert "<1>" not in text
    assert "<day 2>" not in text
    reader = Reader(text)
    assert any("z<1>" in cell for _, cell in reader.all("td"))
    assert any("<day 2> hold 31 missing values & were" in item for _, item in reader.all("li"))


def test_the_model_file_can_be_taken_off_the_page():
    reader = Reader(page("effect_found"))
    link, _ = reader.all("a", download="augmented_model.py")[0]
    assert base64.b64decode(link["href"].partition(",")[2]).decode() == MODEL_TEXT
    code = [text for _, text in reader.all("code")]
    assert code == [MODEL_TEXT]
    assert not Reader(page("no_gap")).all("a")


def test_an_experiment_stands_behind_how_sure_with_its_picture_and_its_file():
    report = with_experiment()
    text = page("with_experiment")
    reader = Reader(text)
    assert reader.faults == []
    order = [text.index(words) for words in (
        ">Evidence<", ">Discriminating experiment<", "These records do not distinguish",
        "triangle of u",
        TITLES["experiment"], "Download experiment.csv", ">Next steps<", ">Plots<",
    )]  # fmt: skip
    assert order == sorted(order)
    link, _ = reader.all("a", download="experiment.csv")[0]
    back = pd.read_csv(io.BytesIO(base64.b64decode(link["href"].partition(",")[2])))
    pd.testing.assert_frame_equal(back, report.experiment)
    spoken = [attrs["alt"].replace("\N{NO-BREAK SPACE}", " ") for attrs, _ in reader.all("img")]
    assert "Course of the input: a triangle of u between −1 and 1 with a period of 40 rows." in (
        spoken
    )
    cells = [cell for _, cell in reader.all("td")]
    assert cells[cells.index("as recorded") + 2] == "0.8"
    assert "leaves the recorded range" in cells


def test_without_an_experiment_its_words_alone_stand_there():
    text = plots.page(with_experiment(separation(0.4)))
    assert "None of the 4 signals" in text
    assert TITLES["experiment"] not in text
    assert "experiment.csv" not in text
    assert "Discriminating experiment" not in page("effect_found")


def test_tables_scroll_in_their_boxes_and_hold_the_numbers():
    reader = Reader(page("effect_found"))
    for tag, _, path, _ in reader.elements:
        if tag == "table":
            assert path[-2:] in (("details", "div"), ("section", "div"))  # the first is open
    titles = [text for _, text in reader.all("summary")]
    assert titles == [
        "All effects tried, best first", "Effects not distinguishable by these data",
        "Places of misfit", "Held-out gain", "Tests of the one-step predictions",
        "Parameters, with standard errors", "Settings",
    ]  # fmt: skip
    cells = [text for _, text in reader.all("td")]
    for expected in ("86%", "< 0.001", "9.93 ± 0.15", "1.2 (fixed)", "0.312 ± 0.041"):
        assert expected in cells
    assert not [c for c in cells if re.search(r"\bnan\b|None", c)]


def test_the_page_opens_with_the_answer_a_picture_of_simulations_and_their_errors():
    text = page("effect_found")
    order = [
        text.index(words)
        for words in ("lacks one of these", TITLES["free_run"], AHEAD, "Where is the misfit?",
                      TITLES["ranked_effects"], "Glossary")
    ]  # fmt: skip
    assert order == sorted(order)
    assert text.count(f"<figcaption>{TITLES['free_run']}") == 1
    assert AHEAD not in page("no_gap")
    assert AHEAD not in page("fast")


def test_vectors_among_the_parameters_take_a_line_each():
    report = dataclasses.replace(
        no_gap(), residual_map=tabulate("residual_map"), free_run=tabulate("free_run"),
        estimates={"before": {"beta": (np.array([1.0, 2.0]), np.array([0.1, 0.2]))}},
    )  # fmt: skip
    cells = [text for _, text in Reader(plots.page(report)).all("td")]
    assert cells[cells.index("beta[1]") + 1] == "2.00 ± 0.20"


@pytest.mark.parametrize("verdict", ["effect", "none of these", "no measurable gap"])
def test_an_empty_report_has_a_page(verdict):
    reader = Reader(
        plots.page(
            GapReport(
                verdict,
                **{
                    name: tabulate(name)
                    for name in COLUMNS
                    if name not in ("left_out", "signals", "probabilities")
                },
            )
        )
    )
    assert reader.faults == []


# -- the folder
def test_saving_writes_tables_plots_model_words_and_page(tmp_path):
    report = effect_found()
    found = report.save(tmp_path / "new" / "report")
    folder = found.parent
    assert found == tmp_path / "new" / "report" / "index.html"
    assert found.read_text(encoding="utf-8") == page("effect_found")
    for name, table in report.tables().items():
        back = pd.read_csv(folder / f"{name}.csv")
        assert list(back.columns) == list(COLUMNS[name])
        numbers = table.select_dtypes("number")
        np.testing.assert_allclose(back[numbers.columns].astype(float), numbers, rtol=1e-12)
        assert len(back) == len(table)
    assert not (folder / "experiment.csv").exists()
    assert (folder / "augmented_model.py").read_text(encoding="utf-8") == MODEL_TEXT
    assert (folder / "report.txt").read_text(encoding="utf-8") == f"{report}\n"
    pngs = {p.stem for p in folder.glob("*.png")}
    assert pngs == {"residual_map", "ranked_effects", "gap_closed", "missing_term", "free_run"}


def test_a_later_report_leaves_nothing_of_an_earlier_one_and_foreign_files_alone(tmp_path):
    (tmp_path / "missing.csv").write_text("mine", encoding="utf-8")
    light = {"residual_map": tabulate("residual_map"), "free_run": tabulate("free_run")}
    dataclasses.replace(no_gap(), **light).save(tmp_path)
    assert (tmp_path / "missing.csv").read_text(encoding="utf-8") == "mine"  # of no report
    dataclasses.replace(fast(), model_text="x = 1\n", **light).save(tmp_path)
    assert (tmp_path / "augmented_model.py").exists()
    (tmp_path / "data.csv").write_text("mine", encoding="utf-8")
    dataclasses.replace(no_gap(), **light).save(tmp_path)
    assert not (tmp_path / "augmented_model.py").exists()
    assert not (tmp_path / "missing.csv").exists()
    assert (tmp_path / "data.csv").read_text(encoding="utf-8") == "mine"


def test_an_experiment_is_a_file_until_a_later_report_has_none(tmp_path):
    light = {"residual_map": tabulate("residual_map"), "free_run": tabulate("free_run")}
    report = dataclasses.replace(with_experiment(), **light)
    report.save(tmp_path)
    report.save(tmp_path)  # over what it wrote itself
    back = pd.read_csv(tmp_path / "experiment.csv")
    pd.testing.assert_frame_equal(back, report.experiment, check_exact=True)
    signals = pd.read_csv(tmp_path / "signals.csv")
    np.testing.assert_allclose(signals["nats"][:3], [0.8, 7.2, 3.1])
    assert (tmp_path / "experiment.png").exists()
    dataclasses.replace(no_gap(), **light).save(tmp_path)
    left = {p.name for p in tmp_path.iterdir()}
    assert not left & {"experiment.csv", "signals.csv", "experiment.png"}


def test_a_folder_that_cannot_be_made_is_an_error_with_its_name(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(ArgumentError, match=r"file/report[\s\S]*Fix: name a folder"):
        several().save(tmp_path / "file" / "report")


# -- in a browser
# The page in a frame, since a window cannot be made as narrow as a phone.
FRAME = """<!DOCTYPE html>
<iframe srcdoc="{page}" style="width: {width}px; height: 1600px; border: 0">
</iframe><script>
addEventListener("load", function () {{
  var page = document.querySelector("iframe").contentDocument, root = page.documentElement;
  var images = Array.from(page.images), style = page.defaultView.getComputedStyle;
  var texts = Array.from(page.querySelectorAll("p, li, td, th, dd, summary, code"));
  document.body.dataset.probe = [
    page.defaultView.innerWidth, root.scrollWidth,
    images.filter(function (i) {{ return i.complete && i.naturalWidth > 0; }}).length,
    Math.min.apply(null, texts.map(function (e) {{ return parseFloat(style(e).fontSize); }})),
    images[0].currentSrc.length,
    Math.max.apply(null, images.map(function (i) {{ return i.getBoundingClientRect().right; }})),
    style(page.body).backgroundColor.replace(/,/g, "")
  ].join(",");
}});
</script>"""


@pytest.fixture(scope="module")
def browser():
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    return found


def look(browser, file, width, *what, dark=False):
    """What headless Chromium prints of a page on a window of this width."""
    profile = file.parent / "profile"
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
        f"--user-data-dir={profile}", f"--window-size={width},1600",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}", *what, file.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout


@pytest.mark.parametrize(("width", "dark"), [(PHONE, False), (DESK, True)])
def test_a_browser_shows_the_whole_page_without_scrolling_sideways(browser, tmp_path, width, dark):
    file = tmp_path / "index.html"
    opened = page("several").replace("<details>", "<details open>")
    framed = FRAME.format(page=html.escape(opened), width=width)
    file.write_text(framed, encoding="utf-8")
    probe = re.search(r'data-probe="([^"]*)"', look(browser, file, 1300, "--dump-dom", dark=dark))
    inner, scrolled, loaded, smallest, source, right, colour = probe.group(1).split(",")
    assert int(inner) == width
    assert int(scrolled) <= width
    images = Reader(opened).all("img")
    assert int(loaded) == len(images)
    assert float(smallest) >= 12
    assert float(right) <= width
    narrow = len(images[0][0]["src"])
    assert (int(source) == narrow) == (width == PHONE)
    light = min(map(int, re.findall(r"\d+", colour)[:3])) > 200
    assert light != dark


def test_a_screenshot_of_the_page_is_not_blank(browser, tmp_path):
    file, shot = tmp_path / "index.html", tmp_path / "shot.png"
    file.write_text(page("effect_found"), encoding="utf-8")
    look(browser, file, PHONE, f"--screenshot={shot}")
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    assert pixels.shape == (1600, PHONE, 3)
    dark = (pixels.sum(axis=2) < 200).mean()
    assert 0.005 < dark < 0.2  # text, on a light ground
    lines = (pixels.sum(axis=2) < 400).any(axis=1).mean()
    assert lines > 0.3  # from top to bottom
    accent = np.abs(pixels - [0x00, 0x72, 0xB2]).sum(axis=2) < 12
    assert accent.any()  # the verdict's bar
