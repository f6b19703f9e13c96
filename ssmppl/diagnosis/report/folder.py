"""A report written to a folder: tables, plots, the model file, the words, and the page."""

from __future__ import annotations

import os
from pathlib import Path

from ssmppl.diagnosis.report.findings import COLUMNS, Findings
from ssmppl.diagnosis.report.page import GENERATOR, page
from ssmppl.diagnosis.report.panels import TITLES, pictures
from ssmppl.diagnosis.report.text import report_text
from ssmppl.errors import ArgumentError

PAGE_FILE = "index.html"
MODEL_FILE = "augmented_model.py"
EXPERIMENT_FILE = "experiment.csv"
TEXT_FILE = "report.txt"


def save(report: Findings, folder: str | os.PathLike[str]) -> Path:
    """Write `report` to `folder`, which is made if it is not there; the path of its page.

    Every table as CSV, every panel as PNG, the model file if something was chosen, the inputs of
    the experiment to make if there is one, what `print` shows, and the page. What an earlier report
    left there and this one does not have is removed.

    Raises
    ------
    ArgumentError : the folder cannot be made or written to.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
        before = _of_a_report(target)
        written = {PAGE_FILE, TEXT_FILE}
        drawn = pictures(report)
        text = page(report, drawn)  # what fails in it is a row of a table
        for name, table in report.tables().items():
            table.to_csv(target / f"{name}.csv", index=False)
            written.add(f"{name}.csv")
        for name, picture in drawn.items():
            (target / f"{name}.png").write_bytes(picture)
            written.add(f"{name}.png")
        if report.model_text:
            (target / MODEL_FILE).write_text(report.model_text, encoding="utf-8")
            written.add(MODEL_FILE)
        if report.experiment is not None:
            report.experiment.to_csv(target / EXPERIMENT_FILE, index=False)
            written.add(EXPERIMENT_FILE)
        (target / TEXT_FILE).write_text(f"{report_text(report)}\n", encoding="utf-8")
        (target / PAGE_FILE).write_text(text, encoding="utf-8")
        for name in before - written:
            (target / name).unlink(missing_ok=True)
    except OSError as error:
        raise ArgumentError(
            f"the report cannot be written to {target}: {error.strerror or error}",
            fix="name a folder that can be made or written to",
        ) from error
    return target / PAGE_FILE


def _of_a_report(folder: Path) -> set[str]:
    """Names of files that an earlier report wrote; none if its page is not there."""
    page_file = folder / PAGE_FILE
    if not page_file.is_file() or GENERATOR not in page_file.read_text("utf-8", "replace"):
        return set()
    tables, panels = {f"{n}.csv" for n in COLUMNS}, {f"{n}.png" for n in TITLES}
    return {*tables, *panels, MODEL_FILE, EXPERIMENT_FILE}
