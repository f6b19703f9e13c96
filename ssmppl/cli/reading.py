"""Data read from files: CSV, Parquet and netCDF, told apart by their suffix; and posteriors.

Nothing that is read can run code: Parquet goes through pyarrow alone, netCDF through h5netcdf or
SciPy's reader of its classic form, and none of them unpickles.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssmppl.data.sources import FILE
from ssmppl.errors import ArgumentError, DataError
from ssmppl.modelfile import labelled, read_csv
from ssmppl.results import arviz
from ssmppl.tables import wide_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

__all__ = ["NETCDF", "PARQUET", "TABLES", "as_table", "has_posterior", "pyarrow", "read_data",
           "read_posterior", "read_table"]  # fmt: skip

PARQUET = (".parquet", ".pq")
TABLES = (".csv", *PARQUET)
NETCDF = (".nc", ".nc4", ".netcdf", ".cdf", ".h5")
HDF5, CLASSIC = b"\x89HDF", b"CDF"  # how netCDF files begin
SAFE_ARROW = (15,)  # earlier ones can be made to unpickle by a file (CVE-2023-47248)


def read_data(paths: Sequence[Path]) -> Any:
    """What the verbs take as data: a table, or a list of them where there are several files.

    Raises
    ------
    DataError : a file is no table, or holds several simulations.
    """
    tables = [read_table(path) for path in paths]
    for path, table in zip(paths, tables, strict=True):
        table.attrs[FILE] = str(path)
    return tables[0] if len(tables) == 1 else tables


def read_table(path: Path) -> pd.DataFrame | xr.Dataset:
    """One data set. A column, or coordinate, `time` labels the rows; columns go by their names.

    Raises
    ------
    DataError : the file is no table, or holds several simulations.
    ArgumentError : a library is missing that reads it.
    """
    suffix = path.suffix.lower()
    if suffix in NETCDF:
        return _read_netcdf(path)
    table = _read_parquet(path) if suffix in PARQUET else read_csv(path)
    if "draw" in table.columns and table["draw"].nunique() > 1:
        raise DataError(
            f"{path} holds {table['draw'].nunique()} simulations, numbered by the column 'draw'",
            fix="give a file with one of them, or one file for each experiment",
        )
    return table


def as_table(data: pd.DataFrame | xr.Dataset) -> pd.DataFrame:
    """A data set as columns, vectors as u_0, u_1, ..., as CSV files have them."""
    if not hasattr(data, "data_vars"):
        return data
    return wide_table(data if "draw" in data.dims else data.expand_dims("draw"))


def pyarrow() -> Any:
    """The module that reads and writes Parquet.

    Raises
    ------
    ArgumentError : it is not installed, or too old to be trusted with files of others.
    """
    try:
        import pyarrow
    except ImportError as error:
        raise ArgumentError(
            "Parquet files need pyarrow, which is not installed",
            fix="pip install 'ssmppl[parquet]', or give a CSV or netCDF file",
        ) from error
    if tuple(int(part) for part in pyarrow.__version__.split(".")[:1]) < SAFE_ARROW:
        raise ArgumentError(
            f"pyarrow {pyarrow.__version__} is too old: a Parquet file can make it run code",
            fix="pip install --upgrade 'ssmppl[parquet]'",
        )
    return pyarrow


def _read_parquet(path: Path) -> pd.DataFrame:
    import pandas as pd

    pyarrow()
    try:
        table = pd.read_parquet(path, engine="pyarrow")
    except (ValueError, OSError) as error:  # pyarrow's own derive from these
        raise DataError(
            f"{path} cannot be read as a Parquet file: {_first_line(error)}",
            fix="give a file that pandas.DataFrame.to_parquet wrote, or a CSV file",
        ) from error
    return labelled(table)


def _read_netcdf(path: Path) -> xr.Dataset:
    import xarray as xr

    with path.open("rb") as file:
        begin = file.read(4)
    if not begin.startswith((HDF5, CLASSIC)):
        raise DataError(
            f"{path} is not a netCDF file, as its name says",
            fix="give a netCDF file, or name a CSV file .csv",
        )
    engine = "h5netcdf" if begin.startswith(HDF5) else "scipy"
    try:
        with xr.open_dataset(path, engine=engine) as found:
            dataset: xr.Dataset = found.load()
    except (ValueError, OSError, EOFError, LookupError, TypeError) as error:
        raise DataError(
            f"{path} cannot be read as a netCDF file: {_first_line(error)}",
            fix="give a file that xarray.Dataset.to_netcdf wrote",
        ) from error
    if not dataset.data_vars and engine == "h5netcdf" and (groups := _groups(path)):
        raise DataError(
            f"{path} holds the groups {', '.join(groups)}, and no data of its own",
            fix="give the file of the data; posterior draws are for summary, predict and forecast",
        )
    return dataset


def read_posterior(path: Path) -> Any:
    """What `sample` returned and `ssmppl sample` wrote: InferenceData, or a DataTree.

    Raises
    ------
    DataError : the file is none of these.
    """
    if not has_posterior(path):
        raise DataError(
            f"{path} holds no posterior draws",
            fix="give the netCDF file that `ssmppl sample` wrote, or ssmppl.results.save",
        )
    return arviz().from_netcdf(str(path))


def has_posterior(path: Path) -> bool:
    """Whether it is a netCDF file with the group `posterior`."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        begin = file.read(4)
    return begin == HDF5 and "posterior" in _groups(path)


def _groups(path: Path) -> list[str]:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return [name for name in file if isinstance(file[name], h5py.Group)]
    except OSError:  # cut short, or no HDF5 after all
        return []


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
