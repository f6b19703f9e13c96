"""What the command line is given, read: model files, CSV files, values of parameters, settings.

Every fault is one of the user's files or words, and is raised as an error that shows the place.
"""

from __future__ import annotations

import csv
import json
import sys
import traceback
import warnings
from collections.abc import Iterable
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.data.times import as_dates
from ssmppl.errors import ArgumentError, DataError, Location, ModelError, SSMError, listing
from ssmppl.language.model.model import Model

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["labelled", "load_model", "parse_assignments", "parse_settings", "read_csv"]

NOT_IN_TEXT = "\x1f"  # a character that separates nothing in a text: lines are read whole
DATA_SUFFIXES = (".csv", ".tsv", ".txt", ".parquet", ".pq", ".nc")


def load_model(spec: str) -> Model:
    """The model in a Python file, `file.py`, or the one called `name` there, `file.py:name`.

    Raises
    ------
    ModelError : there is no such file, it raises, or it does not hold just one such model.
    """
    path, name = _split(spec)
    models = {key: value for key, value in vars(_execute(path)).items() if isinstance(value, Model)}
    if name:
        if name not in models:
            raise ModelError(
                f"{path} holds no model called {name!r}",
                fix=f"its models are: {listing(name, models)}",
            )
        return models[name]
    distinct = {id(model): (key, model) for key, model in models.items()}
    if not distinct:
        raise ModelError(
            f"{path} holds no model",
            fix='assign one to a variable of the file: model = ssm.Model("my model")',
        )
    if len(distinct) > 1:
        lines = [f"    {path}:{key}    {model!r}" for key, model in distinct.values()]
        raise ModelError(
            "\n".join([f"{path} holds {len(distinct)} models", *lines]),
            fix=f"say which one, as in {path}:{next(iter(models))}",
        )
    return next(iter(distinct.values()))[1]


def _split(spec: str) -> tuple[Path, str]:
    file, colon, name = spec.rpartition(":")
    if colon and name.isidentifier() and not Path(spec).exists():
        path = Path(file)
    else:
        path, name = Path(spec), ""
    if path.is_dir() or not path.exists():
        what = "is a folder" if path.is_dir() else "does not exist"
        near = sorted(str(p) for p in path.parent.glob("*.py")) if path.parent.is_dir() else []
        raise ModelError(
            f"the model file {path} {what}",
            fix=f"Python files there: {listing(str(path), near)}",
        )
    return path, name


def _execute(path: Path) -> ModuleType:
    """The module of a file, whose folder is searched for what it imports, as Python would."""
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    name = f"model_file_{path.stem}"
    loader = SourceFileLoader(name, str(path.resolve()))  # whatever the file's suffix
    module = module_from_spec(ModuleSpec(name, loader, origin=loader.path))
    module.__file__ = loader.path
    sys.modules[name] = module  # so that what it defines can be pickled
    try:
        loader.exec_module(module)
    except SSMError:
        raise
    except (Exception, SystemExit) as error:
        raise ModelError(
            f"{type(error).__name__}: {error}" if str(error) else type(error).__name__,
            fix=_fix(error, path),
            where=_place(error, path),
        ) from error
    return module


def _fix(error: BaseException, path: Path) -> str:
    """What to do about an error that the file raised when it was run."""
    if path.suffix.lower() in DATA_SUFFIXES:
        return f"{path.name} looks like data: the model file, MODEL.py, comes first, then DATA"
    if isinstance(error, SyntaxError):
        return "mend that line, or the one above it: it is not Python as it stands"
    if isinstance(error, ModuleNotFoundError):
        return (
            "install it into the environment that ssmppl runs in, or put its file into the folder "
            "of the model file"
        )
    return (
        "the file has to run from top to end; what shall not run here goes below "
        'if __name__ == "__main__":'
    )


def _place(error: BaseException, path: Path) -> Location:
    """The line of the user's that raised: the innermost one in files of the model's folder."""
    if isinstance(error, SyntaxError) and error.filename:
        return Location(error.filename, error.lineno or 1)
    folder = str(path.resolve().parent)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename.startswith(folder)]
    if not frames:
        return Location(str(path), 1)
    last = frames[-1]
    function = "" if last.name == "<module>" else last.name
    return Location(last.filename, last.lineno or 1, function)


def read_csv(path: Path) -> pd.DataFrame:
    """A CSV file as a table; `time` labels the rows, or else a first column of dates or without a
    name.

    Labels that are dates become dates. An empty cell is a missing value; where there is one column
    so is an empty line, except at the end.

    Raises
    ------
    DataError : the file is no table.
    """
    import pandas as pd

    try:
        names = pd.read_csv(path, skipinitialspace=True, header=None, nrows=1, dtype=str).iloc[0]
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(path, skipinitialspace=True, index_col=False)
            if len(table.columns) == 1:
                table = _with_empty_lines(table, path)
    except pd.errors.ParserWarning as error:  # pandas would leave out what has no name
        _check_first_line(path, names)
        raise DataError(
            f"the rows of {path} have more values than its first line has names, {len(names)}",
            fix="give each column a name, and write decimal numbers with points",
        ) from error
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path} is no text in UTF-8: {error}",
            fix=f"save it as UTF-8; in Python pd.read_csv({str(path)!r}, encoding='latin-1'), or "
            "'utf-16', reads it",
        ) from error
    except Exception as error:  # pandas', and what each form of compression raises
        raise DataError(
            f"{path} cannot be read as a CSV file: {str(error).strip() or type(error).__name__}",
            fix="give a text file with the names of its columns in the first line, values "
            "separated by commas",
        ) from error
    if len(table.columns) == 1:
        _check_first_line(path, names)
    given = names.dropna().str.strip()
    if given.duplicated().any():
        raise DataError(
            f"{path} has more than one column named {given[given.duplicated()].iloc[0]!r}",
            fix="rename or drop one of them",
        )
    return labelled(table)


def _with_empty_lines(table: pd.DataFrame, path: Path) -> pd.DataFrame:
    """A table of one column with its missing rows that are empty lines, which pandas skips.

    An empty line after each line, the first included, comes of line ends written twice, as
    Python's `csv` does on Windows without `newline=""`: it is no row.
    """
    import pandas as pd

    lines = pd.read_csv(
        path, header=None, names=["line"], dtype=str, keep_default_na=False, na_values=[""],
        skip_blank_lines=False, skipinitialspace=True, quoting=csv.QUOTE_NONE, sep=NOT_IN_TEXT,
    )["line"]  # fmt: skip
    filled = lines.notna().to_numpy().nonzero()[0]
    rows = filled[1:] - filled[0] - 1  # counted from the line after the names
    doubled = len(rows) > 1 and (rows == 2 * np.arange(len(rows)) + 1).all()
    if doubled or len(rows) != len(table):  # a cell that holds lines itself
        return table
    return table.set_axis(rows).reindex(range(rows[-1] + 1 if len(rows) else 0))


def _check_first_line(path: Path, names: pd.Series) -> None:
    """Refuse a table whose values are separated by semicolons or tabs, as spreadsheets write it, or
    that begins with a comment."""
    header = ",".join(names.fillna("").astype(str))  # the file itself may be compressed
    if header.startswith("#"):
        raise DataError(
            f"{path} begins with a comment, {header.strip()!r}",
            fix="let the first line be the names of the columns; in Python "
            f"pd.read_csv({str(path)!r}, comment='#') reads it",
        )
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        if mark in header and "," not in header:
            raise DataError(
                f"the values in {path} are separated by {name}: {header.strip()!r}",
                fix="separate them by commas, with points in decimal numbers; in Python "
                f"pd.read_csv({str(path)!r}, sep={mark!r}).to_csv('commas.csv', index=False), with "
                "decimal=',' for numbers such as 3,5",
            )


def labelled(table: pd.DataFrame) -> pd.DataFrame:
    """A table as it was read, with the labels of its rows recognised: `time`, or else a first
    column of dates or without a name. Text becomes dates where it is of such."""
    table.columns = table.columns.map(lambda name: str(name).strip())
    if _numbers_rows(table):  # of a table that was sorted or cut before it was written
        table = table.drop(columns=table.columns[0])
    first = table.columns[0] if len(table.columns) else ""
    label = first if _unnamed(first) else "time"
    if label not in table.columns and len(table.columns):
        # text that is dates can be no observation and no input, whatever its name
        if table[first].dtype.kind not in "biuf" and table[first].notna().any():
            label = first if _dates(table[first]) is not None else label
    if label in table.columns and table[label].dtype.kind not in "iufM":
        dates = _dates(table[label])
        if dates is not None:
            table[label] = dates
    if label != "time" and label in table.columns:
        table = table.set_index(label).rename_axis("time")
    return table


def _unnamed(column: str) -> bool:
    return column.startswith("Unnamed:") or column == ""


def _numbers_rows(table: pd.DataFrame) -> bool:
    """Whether a first column without a name numbers rows that another column labels: `time`, or the
    one that follows, with dates."""
    names = list(table.columns)
    if len(names) < 2 or not _unnamed(names[0]):
        return False
    following = table[names[1]]
    dated = following.dtype.kind not in "biuf" and following.notna().any()
    numbers = table[names[0]].dtype.kind in "iu"
    return "time" in names or (numbers and dated and _dates(following) is not None)


def _dates(labels: pd.Series) -> pd.Series | None:
    """A column's dates, None where it holds something else."""
    if labels.dtype.kind == "M":
        return labels
    dates = as_dates(labels, f"the column {labels.name!r}", f"table[{labels.name!r}]")
    return None if dates is None else dates.set_axis(labels.index)


def parse_assignments(texts: Iterable[str], option: str) -> dict[str, Any]:
    """`name=value` for each of `texts`; a value is a number, or a list of lists of them.

    Raises
    ------
    ArgumentError : one is written otherwise, or a name stands twice.
    """
    return {name: _value(value, name, option) for name, value in _split_all(texts, option)}


def parse_settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """`name=value` for each of `texts`; a value is a number, true, false, none, a list, a mapping
    as JSON writes it, or else text.

    Raises
    ------
    ArgumentError : one is written otherwise, or a name stands twice.
    """
    return {name: _setting(value) for name, value in _split_all(texts, option)}


def _split_all(texts: Iterable[str], option: str) -> list[tuple[str, str]]:
    values: dict[str, str] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name.isidentifier():
            raise ArgumentError(
                f"{option} {text!r} is not of the form name=value",
                fix=f"write {option} phi=0.95, or {option} 'beta=[1, 2]' for a vector",
            )
        if name in values:
            raise ArgumentError(f"{option} gives {name!r} twice", fix="give it once")
        values[name] = value
    return list(values.items())


def _setting(text: str) -> Any:
    words = {"true": True, "false": False, "none": None, "null": None}
    if text.lower() in words:
        return words[text.lower()]
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        return text
    return tuple(value) if isinstance(value, list) else value


def _value(text: str, name: str, option: str) -> Any:
    try:
        return float(text)
    except ValueError:
        pass
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = None
    if not isinstance(value, list):
        raise ArgumentError(
            f"{option} {name}={text}: {text!r} is no number",
            fix=f"write a number, {name}=0.5, or a list of numbers, '{name}=[0.5, 1]'",
        )
    return value
