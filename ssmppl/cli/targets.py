"""Where results are written: names by default, and files that are not written over."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import click

from ssmppl.cli.reading import NETCDF, PARQUET, TABLES, has_posterior, pyarrow

__all__ = ["file_of_model", "new_file", "numbered", "target"]


def target(
    output: Path | None, source: Path, ending: str, mark: str = "", given: Sequence[Path] = (),
    pieces: int = 1, table: bool = True,
) -> Path:  # fmt: skip
    """The file for a result: `output`, or the name of `source` in the working directory.

    Parameters
    ----------
    ending : its suffix, ".nc".
    mark : stands before it where the plain name is taken, by a file that is read or by posterior
        draws; "_states".
    given : the files that the command reads.
    pieces : number of files that are written, `numbered` where there are several.
    table : whether the result can be written as one, too.

    Raises
    ------
    click.UsageError : a file would be written that is read, or in a form that the result has not.
    ArgumentError : a library is missing that writes it.
    """
    read = (*given, source)
    if output is None:
        output = Path(source.stem + ending)
        if _among(read, output) or (mark != "_posterior" and has_posterior(output)):
            output = Path(f"{source.stem}{mark}{ending}")
    for path in numbered(output, pieces):
        new_file(path, read, table)
    return output


def new_file(
    output: Path | None, read: Iterable[Path], table: bool = True, netcdf: bool = True
) -> Path | None:
    """`output`, which is none of the files that are read.

    table, netcdf : whether the result can be written as one.

    Raises
    ------
    click.UsageError : it is one of them, or in a form that the result has not.
    ArgumentError : a library is missing that writes it.
    """
    if output is not None and _among(read, output):
        raise click.UsageError(f"-o {output} is a file that is read: name another.")
    if output is not None and not table and output.suffix.lower() in TABLES:
        raise click.UsageError(
            f"-o {output}: draws of several shapes fit into no table. Name a file .nc."
        )
    if output is not None and not netcdf and output.suffix.lower() in NETCDF:
        raise click.UsageError(f"-o {output}: the result is a table. Name a file .csv or .parquet.")
    if output is not None and output.suffix.lower() in PARQUET:
        pyarrow()  # found out now that it is missing, and not after the work
    return output


def numbered(path: Path, pieces: int) -> list[Path]:
    """The files of a result in pieces: one, or name_1, name_2, ..."""
    if pieces == 1:
        return [path]
    return [path.with_stem(f"{path.stem}_{i}") for i in range(1, pieces + 1)]


def _among(read: Iterable[Path], path: Path) -> bool:
    return path.resolve() in {one.resolve() for one in read}


def file_of_model(model: str) -> Path:
    """The file of `file.py:name`."""
    return Path(f"{model.rpartition('.py')[0]}.py" if ".py" in model else model)
