"""Results as tables: a summary of posterior draws, states over time, simulations."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.arguments import checked
from ssmppl.errors import ArgumentError, listing
from ssmppl.results import arviz

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

__all__ = [
    "component_label",
    "joined_tables",
    "quantiles_of",
    "state_table",
    "summary",
    "summary_text",
    "wide_table",
]

SUMMARY_COLUMNS = ["mean", "sd", "mcse_mean", "mcse_sd", "ess_bulk", "ess_tail", "r_hat"]


@checked
def summary(idata: Any, var_names: str | Iterable[str] | None = None) -> pd.DataFrame:
    """Mean, sd, their Monte Carlo errors, bulk and tail ESS, and R-hat; one row per scalar.

    Parameters
    ----------
    idata : what `sample` returned.
    var_names : names of variables, or one name; None: all of the posterior that have no time, the
        parameters.

    Returns
    -------
    DataFrame : not rounded. R-hat is NaN for a single chain.

    Raises
    ------
    ArgumentError : there are no posterior draws in `idata`, or no variable of a name in them.
    """
    import pandas as pd

    posterior = _posterior(idata)
    if var_names is None:
        names = [name for name, v in posterior.data_vars.items() if "time" not in v.dims]
    else:
        names = [var_names] if isinstance(var_names, str) else list(var_names)
        unknown = [name for name in names if name not in posterior.data_vars]
        if unknown:
            known = listing(str(unknown[0]), map(str, posterior.data_vars))
            raise ArgumentError(
                f"the posterior has no variable {unknown[0]!r}.", fix=f"it has {known}"
            )
    if not names:
        return pd.DataFrame(columns=SUMMARY_COLUMNS, dtype=float)
    with _unlogged():
        table = arviz().summary(idata, var_names=names, round_to="none", kind="all")
    return pd.DataFrame(table)[SUMMARY_COLUMNS].astype(float)


@contextlib.contextmanager
def _unlogged() -> Iterator[None]:
    """Without what ArviZ logs of R-hat where there is one chain; it is NaN then."""
    loggers = [logging.getLogger(name) for name in ("arviz", "arviz_stats")]
    levels = [one.level for one in loggers]
    for one in loggers:
        one.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for one, level in zip(loggers, levels, strict=True):
            one.setLevel(level)


def quantiles_of(draws: np.ndarray, levels: Sequence[float]) -> np.ndarray:
    """Quantiles along the first axis, (levels, ...): between draws where all are finite, else a
    draw itself, as nothing lies between infinities."""
    between: Any = "linear" if np.isfinite(draws).all() else "inverted_cdf"
    if between == "linear" and np.abs(draws).max(initial=0.0) > np.finfo(float).max / 4.0:
        return 4.0 * quantiles_of(0.25 * draws, levels)  # whose differences are finite
    found: np.ndarray = np.quantile(draws, levels, axis=0, method=between)
    return found


def component_label(name: str, index: Sequence[int], others: Container[Any]) -> str:
    """`x_0`, as data files call it too, or `x[0]` where another quantity has that name."""
    plain = "_".join(map(str, (name, *index)))
    return f"{name}[{','.join(map(str, index))}]" if index and plain in others else plain


def state_table(dataset: xr.Dataset) -> pd.DataFrame:
    """Mean and standard deviation of each state over time, of a result of `smooth`; time its rows.

    From moments, dim `draw` of length 1, or over the dim `trajectory`.
    """
    import pandas as pd

    columns: dict[str, np.ndarray] = {}
    for name, variable in dataset.data_vars.items():
        if variable.dims[:2] == ("trajectory", "time"):
            mean, sd = variable.mean("trajectory").values, variable.std("trajectory", ddof=1).values
        elif f"{name}_sd" in dataset:
            mean, sd = variable.values[0], dataset[f"{name}_sd"].values[0]
        else:
            continue
        named = [d for d in variable.dims[2:] if not str(d).startswith(f"{name}_dim_")]
        for index in np.ndindex(*mean.shape[1:]):
            label = component_label(str(name), index, dataset)
            if named:
                own = (dataset[d].values[i] for d, i in zip(variable.dims[2:], index, strict=True))
                label = f"{name}[{', '.join(map(str, own))}]"
            columns[f"{label} mean"] = mean[(slice(None), *index)]
            columns[f"{label} sd"] = sd[(slice(None), *index)]
    return pd.DataFrame(columns, index=pd.Index(dataset["time"].values, name="time"))


def wide_table(dataset: xr.Dataset) -> pd.DataFrame:
    """A Dataset of simulations as a table, (draw, time) its rows and scalars its columns."""
    import pandas as pd

    draws, steps = dataset.sizes["draw"], dataset.sizes["time"]
    columns: dict[str, Any] = {}
    if draws > 1:
        columns["draw"] = np.repeat(np.arange(1, draws + 1), steps)
    columns["time"] = np.tile(dataset["time"].values, draws)
    for name, variable in dataset.data_vars.items():
        values = variable.values
        if "time" not in variable.dims:
            values = np.repeat(values[:, None], steps, axis=1)
        values = values.reshape(draws * steps, *values.shape[2:])
        for index in np.ndindex(*values.shape[1:]):
            columns[component_label(str(name), index, dataset)] = values[(slice(None), *index)]
    return pd.DataFrame(columns)


def summary_text(table: pd.DataFrame) -> str:
    """The summary with four digits, effective sample sizes whole."""
    if table.empty:
        return "There are no parameters to summarise: all are fixed, or the model has none."
    whole = {name: "{:.0f}".format for name in table.columns if name.startswith("ess")}
    others = {name: "{:.4g}".format for name in table.columns if name not in whole}
    return table.to_string(formatters={**whole, **others, "r_hat": "{:.3f}".format})


def _posterior(idata: Any) -> Any:
    """The group of posterior draws."""
    try:
        return idata["posterior"]
    except (KeyError, TypeError, IndexError):
        raise ArgumentError(
            f"summary of a {type(idata).__name__}, which holds no posterior draws",
            fix="give what ssm.sample returned; a result of a filter or smoother is an xarray "
            "Dataset, whose states ssm.plot_states shows and .to_dataframe() lists",
        ) from None


def joined_tables(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Tables of several experiments below one another, with a column of their labels; a single one,
    labelled "", as it is."""
    import pandas as pd

    if list(tables) == [""]:
        return tables[""]
    return pd.concat(dict(tables), names=["experiment"]).reset_index("experiment")
