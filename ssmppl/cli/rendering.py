"""What a command says: words for a reader, or one line of JSON; and the files that it writes.

Words go to standard output, unless JSON is asked for; then nothing else goes there. What is said
of the run itself (interrupted, warnings, progress) goes to standard error. Files that a command
reads are never written over.
"""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click
import numpy as np

from ssmppl.cli.group import AS_JSON, IN_PART, INTERRUPTED
from ssmppl.cli.reading import NETCDF, PARQUET, TABLES, has_posterior, pyarrow
from ssmppl.errors import ArgumentError
from ssmppl.inference.run.convergence import ESS, R_HAT
from ssmppl.results import save
from ssmppl.tables import component_label, quantiles_of, state_table, summary_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

SHOWN_ROWS = 10
LEVELS = (0.05, 0.5, 0.95)  # of the quantiles that are printed


# -- saying
def wants_json() -> bool:
    return bool(click.get_current_context().meta.get(AS_JSON))


def say(text: str = "") -> None:
    """Words of the answer; nothing where it is wanted as JSON."""
    if not wants_json():
        click.echo(text)


def heading(text: str) -> None:
    """The line that an answer begins with, and an empty one."""
    say(f"{click.style(text, bold=True)}\n")


def wrote(path: Path) -> None:
    say(f"\n{click.style('Wrote', fg='green')} {path}")


def note(text: str) -> None:
    """Said of the run, not of its result."""
    click.echo(text, err=True)


def answer(**keys: Any) -> None:
    """The answer as one line of JSON, where it is wanted so. Numbers that are not finite are null.

    The first key, `command`, is the name of the command.
    """
    if wants_json():
        whole = {"command": click.get_current_context().info_name, **keys}
        click.echo(json.dumps(plain(whole), allow_nan=False))


def stop_interrupted(kept: str) -> NoReturn:
    """The end of a command that Ctrl-C stopped, once what it has is written."""
    note(f"{click.style('Interrupted:', fg='yellow')} {kept}")
    raise click.exceptions.Exit(INTERRUPTED)


def stop_in_part(failed: str) -> NoReturn:
    """The end of a command whose answer lacks parts, once what it has is written."""
    note(f"{click.style('Incomplete result:', fg='yellow')} {failed}")
    raise click.exceptions.Exit(IN_PART)


# -- JSON
def plain(value: Any) -> Any:
    """`value` in types that JSON has."""
    if isinstance(value, np.generic) and not isinstance(value, np.datetime64 | np.timedelta64):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        return plain(list(value)) if value.ndim else plain(value[()])
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, datetime.date):
        return value.isoformat()
    return str(value)  # paths, and labels of other kinds


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table, each a mapping of its columns."""
    return [dict(zip(table.columns, row, strict=True)) for row in table.itertuples(index=False)]


def labelled_matrix(matrix: pd.DataFrame) -> dict[str, Any]:
    return {"labels": list(matrix.index), "values": matrix.to_numpy()}


def columns_of(dataset: xr.Dataset) -> dict[str, Any]:
    """Time, and mean and standard deviation over it of each state component, and of what a filter
    predicted of each observation, with the quantiles that it has of that."""
    found: dict[str, Any] = {"time": dataset["time"].values, "states": {}}
    predicted = [
        name
        for name in map(str, dataset.data_vars)
        if name.endswith("_predicted") and f"{name.removesuffix('_predicted')}_pit" in dataset
    ]
    parts = {"states": dataset.drop_vars(predicted)}
    if predicted:
        parts["predicted"] = dataset[[*predicted, *(f"{name}_sd" for name in predicted)]]
    for part, own in parts.items():
        table = state_table(own)
        for column in table.columns:
            name, _, what = str(column).rpartition(" ")
            name = name.replace("_predicted", "", 1) if part == "predicted" else name
            found.setdefault(part, {}).setdefault(name, {})[what] = table[column].to_numpy()
    for name in predicted:
        if f"{name}_quantile" in dataset:
            quantiles = dataset[f"{name}_quantile"].isel(draw=0).transpose("time", ..., "quantile")
            for *index, j in np.ndindex(*quantiles.shape[1:]):
                plain = name.removesuffix("_predicted")
                label = component_label(name, index, own).replace(name, plain, 1)
                level = f"{100 * float(quantiles['quantile'][j]):.6g}"
                found["predicted"][label][f"q{level.zfill(2)}"] = quantiles.values[:, *index, j]
    return found


# -- tables
def table_text(table: pd.DataFrame, rows: int = SHOWN_ROWS) -> str:
    return str(table.to_string(float_format="{:.4g}".format, max_rows=rows))


def spread(variables: Mapping[str, xr.DataArray], over: tuple[str, ...]) -> dict[str, Any]:
    """Mean, standard deviation and quantiles over the dims `over`, of each component by label."""
    found: dict[str, Any] = {}
    for name, variable in variables.items():
        values = variable.stack(sample_=over).transpose("sample_", ...).values
        for index in np.ndindex(*values.shape[2:]):
            label = component_label(name, index, variables)
            own = values[(slice(None), slice(None), *index)]
            with np.errstate(invalid="ignore"):  # of infinite draws
                sd = own.std(axis=0, ddof=1) if len(own) > 1 else np.full(own.shape[1:], np.nan)
                found[label] = {"mean": own.mean(axis=0), "sd": sd}
            quantiles = quantiles_of(own, LEVELS)
            found[label] |= {
                f"q{round(100 * p):02d}": q for p, q in zip(LEVELS, quantiles, strict=True)
            }
    return found


def spread_table(found: Mapping[str, Mapping[str, Any]], time: np.ndarray) -> pd.DataFrame:
    """What `spread` found, time its rows."""
    import pandas as pd

    columns = {f"{label} {what}": v for label, own in found.items() for what, v in own.items()}
    return pd.DataFrame(columns, index=pd.Index(time, name="time"))


def fitting_rows(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """A table by its labels: {"phi": {"mean": ..., ...}}."""
    return {str(label): dict(row) for label, row in table.iterrows()}


def summary_lines(table: pd.DataFrame) -> str:
    """A summary as text, its rows whose chains have not converged marked, with a note on them."""
    head, *lines = summary_text(table).split("\n")
    if table.empty:
        return head
    apart = (table["r_hat"] >= R_HAT).to_numpy()
    few = (table[["ess_bulk", "ess_tail"]].min(axis=1) < ESS).to_numpy()
    shown = [
        click.style(line, fg="red" if a else "yellow") if a or f else line
        for line, a, f in zip(lines, apart, few, strict=True)
    ]
    notes = []
    if apart.any():
        notes.append(f"r_hat not below {R_HAT:g}: the chains have not converged, draw more")
    if few.any():
        notes.append(f"ess below {ESS:g}: Monte Carlo error is large, draw more")
    text = "\n".join([click.style(head, bold=True), *shown])
    return text + "".join(f"\nNote: {one}." for one in notes)


# -- files
def write(result: Any, path: Path, table: pd.DataFrame | None = None) -> Path:
    """A result as a netCDF file; where the suffix asks for CSV or Parquet, `table`.

    result : None where there is the table only, which is written as CSV under any other suffix.

    Raises
    ------
    ArgumentError : the file cannot be written, or holds no table of such a kind.
    """
    suffix = path.suffix.lower()
    try:
        if result is not None and suffix not in TABLES:
            return save(result, path)
        if table is None:
            raise ArgumentError(
                f"{path}: draws of several shapes fit into no table", fix="name a file .nc"
            )
        if suffix in PARQUET:
            pyarrow()
            table.to_parquet(path, engine="pyarrow")
        else:
            table.to_csv(path)
    except OSError as error:
        raise ArgumentError(
            f"{path} cannot be written: {error.strerror or error}", fix="name another with -o"
        ) from error
    return path


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
