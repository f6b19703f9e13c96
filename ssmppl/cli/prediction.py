"""Commands about observations that a model expects: predictive draws, forecasts, their scores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

import ssmppl as ssm
from ssmppl.cli.group import command
from ssmppl.cli.options import (
    DATA,
    FIXED,
    INPUTS,
    MODEL,
    PARAMETERS,
    POSTERIOR_OR_DATA,
    PROGRESS,
    SAMPLERS,
    SEED,
    SERIES,
    SETTINGS,
    START,
    MethodName,
    drawn_seed,
    method_of,
    option,
    output,
)
from ssmppl.cli.reading import has_posterior, read_data, read_posterior, read_table
from ssmppl.cli.rendering import (
    answer,
    file_of_model,
    heading,
    new_file,
    records,
    say,
    spread,
    spread_table,
    table_text,
    target,
    write,
    wrote,
)
from ssmppl.data.experiments import experiments_of
from ssmppl.errors import DataError
from ssmppl.modelfile import load_model, parse_assignments
from ssmppl.tables import joined_tables, wide_table

__all__ = ["forecast", "leave_future_out", "predict"]


@command("predict", "Draws of the observations, from prior or posterior.")
@MODEL
@DATA
@option(
    "--posterior", "--idata", "posterior", metavar="POSTERIOR.nc", section="Model and data",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="File that `ssmppl sample` wrote; without it, draws are from the prior.",
)  # fmt: skip
@option("--steps", type=int, section="Model and data", help="Number of rows where there are no "
        "DATA.")  # fmt: skip
@option("--draws", type=int, default=1000, section="Run",
        help="From the prior; of the posterior all its draws are taken.")  # fmt: skip
@option(
    "--conditional/--free-run", default=None,
    help="Of the posterior, whether the states are those of its trajectories, or simulated anew "
    "from the first on [default: as the trajectories are there or not].",
)  # fmt: skip
@SEED
@output("the name of the posterior, or of the model, with _predictive.nc",
        "netCDF file for the draws.")  # fmt: skip
def predict(
    model: str, data: tuple[Path, ...], posterior: Path | None, steps: int | None, draws: int,
    conditional: bool | None, seed: int | None, output: Path | None,
) -> None:  # fmt: skip
    """Draws of the observations at the rows of DATA, from the prior or the posterior.

    Prints mean, standard deviation and quantiles of what is drawn at each row. Writes the draws to
    a netCDF file, groups posterior_predictive or prior_predictive, which arviz.from_netcdf reads
    and arviz.plot_ppc draws.

    \b
        ssmppl predict model.py data.csv --posterior posterior.nc --seed 1
        ssmppl predict model.py --steps 100 --draws 500 -o prior.nc
    """
    path = target(
        output, posterior or file_of_model(model), "_predictive.nc", "_2", data, table=False
    )
    loaded, seed = load_model(model), drawn_seed(seed)
    idata = read_posterior(posterior) if posterior else None
    read = read_data(data) if data else None
    found = ssm.predict(
        loaded, idata, read, steps=steps, draws=draws, conditional=conditional, seed=seed
    )
    group = "posterior_predictive" if posterior else "prior_predictive"
    drawn = found[group]
    count = drawn.sizes["chain"] * drawn.sizes["draw"]
    heading(f"{loaded.name}: {count} draws from the {group.replace('_', ' ')} distribution")
    experiments = []
    for label, one in experiments_of(drawn):
        time = one["time"].values
        own = {str(n): v for n, v in one.data_vars.items() if "time" in v.dims}
        if label:
            say(f"Experiment {label}")
        spreads = spread(own, ("chain", "draw"))
        say(table_text(spread_table(spreads, time)))
        experiments.append({"time": time, "observations": spreads})
    write(found, path)
    wrote(path)
    answer(
        model=loaded.name, group=group, draws=count, experiments=experiments, seed=seed,
        conditional=bool(drawn.attrs["conditional"]) if "conditional" in drawn.attrs else None,
        files=[path],
    )  # fmt: skip


@command("forecast", "Draws of the rows after the data.")
@MODEL
@POSTERIOR_OR_DATA
@PARAMETERS
@option("--steps", type=int, section="Model and data",
        help="Number of rows [default: number of input rows].")  # fmt: skip
@INPUTS
@option("--experiment", section="Model and data",
        help="Which one is continued, where several were sampled: its label, or its number from 1 "
        "[default: all].")  # fmt: skip
@option("--proposal", metavar="NAME",
        help="With --parameters: laplace, extended or unscented, approximations, or the proposal "
        "of a particle filter [default: exact where the model allows it].")  # fmt: skip
@option("--draws", type=int, section="Run", help="With --parameters [default: 1000].")
@SEED
@output("the name of the posterior, or of the data, with _forecast.nc",
        "File for the draws: .nc, or .csv and .parquet for a row per draw and time.")  # fmt: skip
def forecast(
    model: str, posterior: Path, parameters: tuple[str, ...], steps: int | None,
    inputs: Path | None, experiment: str | None, proposal: str | None, draws: int | None,
    seed: int | None, output: Path | None,
) -> None:  # fmt: skip
    """Draws of states and observations after the last row of the data.

    Each draw of POSTERIOR.nc, which `ssmppl sample` wrote with its states, is continued by the
    distributions of MODEL.py; with --parameters draws of the last state given DATA are. Prints
    mean, standard deviation and quantiles at each row, and writes the draws to a netCDF file, which
    xarray.open_dataset reads.

    \b
        ssmppl forecast model.py posterior.nc --steps 12 --seed 1
        ssmppl forecast model.py posterior.nc --inputs torque_tomorrow.csv -o tomorrow.csv
        ssmppl forecast model.py data.csv -p phi=0.95 tau=47 --steps 12 --seed 1
    """
    given = [posterior, inputs] if inputs else [posterior]
    path = target(output, posterior, "_forecast.nc", "_2", given)
    loaded, seed = load_model(model), drawn_seed(seed)
    known = parse_assignments(parameters, "--parameters") if parameters else None
    if known is None and not has_posterior(posterior):
        raise DataError(
            f"{posterior} holds no posterior draws",
            fix="give the netCDF file that `ssmppl sample` wrote; or, for a forecast from data, "
            "the parameters too: -p NAME=VALUE ...",
        )
    found = ssm.forecast(
        loaded, read_posterior(posterior) if known is None else known, steps,
        read_table(inputs) if inputs else None,
        data=None if known is None else read_data((posterior,)), proposal=proposal, draws=draws,
        experiment=experiment, seed=seed,
    )  # fmt: skip
    every, tables = [], {}
    for label, one in experiments_of(found):
        time, after = one["time"].values, int(one["after"] if label else found.attrs["after"])
        over_time = {str(n): v for n, v in one.data_vars.items() if "time" in v.dims}
        spreads = spread(over_time, ("draw",))
        heading(f"{loaded.name}{f', experiment {label}' if label else ''}: {found.sizes['draw']} "
                f"draws of the {len(time)} rows after row {after}")  # fmt: skip
        say(table_text(spread_table(spreads, time)))
        tables[label] = wide_table(one).set_index("time")
        own = {"after": after, "time": time, "variables": spreads}
        every.append({"experiment": label, **own} if label else own)
    write(found, path, joined_tables(tables))
    wrote(path)
    rest = {"experiments": every} if len(every) > 1 else every[0]
    answer(model=loaded.name, draws=found.sizes["draw"], **rest, seed=seed, files=[path])


@command("leave-future-out", "How well each row is predicted from those before it.")
@MODEL
@SERIES
@option("--first", type=int, section="Model and data",
        help="The first row that is predicted, from 2 [default: after a quarter].")  # fmt: skip
@option("--method", type=MethodName(SAMPLERS), help="Of `ssmppl sample` [default: chosen by the "
        "model].")  # fmt: skip
@SETTINGS
@option("--draws", type=int, default=500, section="Run", help="Kept draws of a chain.")
@option("--warmup", type=int, default=500, section="Run", help="Dropped ones before.")
@option("--chains", type=int, default=4, section="Run", help="Number of chains.")
@option("--threshold", type=float, default=0.7,
        help="Pareto shape beyond which the model is sampled anew.")  # fmt: skip
@option(
    "--particles",
    type=int,
    default=1000,
    help="Of the filters that give predictive densities, where there is no exact one.",
)
@SEED
@FIXED
@START
@PROGRESS
@output("none", "File for the rows: .csv, .parquet or .nc.")
def leave_future_out(
    model: str, data: Path, method: str | None, settings: tuple[str, ...], seed: int | None,
    fixed: tuple[str, ...], start: tuple[str, ...], output: Path | None, **run: Any,
) -> None:  # fmt: skip
    """How well MODEL.py predicts each row of DATA from the rows before it.

    Prints the sum of the log predictive densities, the parameters integrated out, with its standard
    error, and the rows. Models of the same data are compared by their sums over the same rows.
    Writes the rows only where -o says where.

    \b
        ssmppl leave-future-out model.py data.csv --seed 1
        ssmppl leave-future-out model.py data.csv --first 50 -o scores.csv
    """
    path = new_file(output, [data])
    loaded, seed = load_model(model), drawn_seed(seed)
    found = ssm.leave_future_out(
        loaded, read_table(data), method=method_of(SAMPLERS, method, settings), seed=seed,
        fixed=parse_assignments(fixed, "--fixed"), start=parse_assignments(start, "--start"), **run,
    )  # fmt: skip
    attrs, table = found.attrs, found.to_dataframe()
    rows = int(np.isfinite(found["elpd"].values).sum())
    heading(
        f"{loaded.name}: elpd {attrs['elpd']:.4f} (standard error "
        f"{attrs['standard_error']:.3g}) over {rows} rows, sampled {attrs['refits']} times"
    )
    say(table_text(table))
    if path is not None:
        write(found, path, table)
        wrote(path)
    answer(
        model=loaded.name, elpd=attrs["elpd"], standard_error=attrs["standard_error"],
        refits=attrs["refits"], rows=records(table.reset_index()), seed=seed,
        files=[path] if path else [],
    )  # fmt: skip
