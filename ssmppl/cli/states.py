"""Commands about the states at known parameters: the filters, and the smoother."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import ssmppl as ssm
from ssmppl.cli.group import command
from ssmppl.cli.options import (
    MODEL,
    NEEDED_DATA,
    PARAMETERS,
    PARTICLE_FILTER,
    QUANTILES,
    SEED,
    MethodName,
    drawn_seed,
    option,
    output,
)
from ssmppl.cli.reading import read_data
from ssmppl.cli.rendering import (
    answer,
    columns_of,
    heading,
    numbered,
    say,
    table_text,
    target,
    write,
    wrote,
)
from ssmppl.inference.gaussian.likelihood import APPROXIMATE
from ssmppl.inference.gaussian.moments import NAMES
from ssmppl.inference.run.labels import as_list
from ssmppl.inference.verbs.smooth import NAMES as SMOOTHERS
from ssmppl.modelfile import load_model, parse_assignments
from ssmppl.tables import state_table

__all__ = ["forward_filter", "kalman_filter", "particle_filter", "smooth"]

LABELS = {k: n if k == "laplace" else f"{n} (approximate)" for k, n in NAMES.items()}

FILE_OF_MOMENTS = output(
    "the name of the data file, with _filter.nc",
    "netCDF file with all results of the filter; named .csv or .parquet, the table.",
)


@command("particle-filter", "States given the data up to each row, by particles.")
@MODEL
@NEEDED_DATA
@PARAMETERS
@PARTICLE_FILTER
@QUANTILES
@option("--history", is_flag=True, show_default=False, section="Output",
        help="Write every particle, too, with its weight and its ancestor.")  # fmt: skip
@SEED
@FILE_OF_MOMENTS
def particle_filter(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], output: Path | None,
    seed: int | None, **settings: Any,
) -> None:  # fmt: skip
    """The states of MODEL.py given the data up to each row, by particles.

    Prints the log-likelihood, and means and standard deviations of the states and of the
    predicted observations; of several repeats the table is that of the first. Writes these,
    covariances, quantiles of both, effective sample sizes, increments of the log-likelihood and PIT
    values to a netCDF file, one for each of several DATA.

    \b
        ssmppl particle-filter model.py data.csv -p phi=0.95 tau=47 --seed 1
        ssmppl particle-filter model.py data.csv -p phi=0.95 tau=47 --proposal bootstrap
    """
    seed = drawn_seed(seed)
    _filtered(model, data, parameters, output, ssm.particle_filter, seed=seed, **settings)


@command("kalman-filter", "Kalman filter (linear Gaussian models).")
@MODEL
@NEEDED_DATA
@PARAMETERS
@option("--proposal", type=click.Choice(["auto", "kalman", *APPROXIMATE]), default="auto",
        help="auto: kalman; extended if the model calls a simulator. kalman is exact, the others "
        "are approximations for states driven by Gaussian noise.")  # fmt: skip
@QUANTILES
@FILE_OF_MOMENTS
def kalman_filter(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], output: Path | None,
    proposal: str, quantiles: tuple[float, ...],
) -> None:  # fmt: skip
    """The states of a linear Gaussian MODEL.py given the data up to each row, exactly; or of one
    whose states are driven by Gaussian noise, by an approximation.

    Prints the log-likelihood, and means and standard deviations of the states and of the
    predicted observations. Writes these, covariances, quantiles, increments of the log-likelihood
    and PIT values to a netCDF file, one for each of several DATA.

    \b
        ssmppl kalman-filter model.py data.csv -p q=0.3
        ssmppl kalman-filter model.py data.csv -p q=0.3 -o filtered.csv
        ssmppl kalman-filter model.py data.csv -p q=0.3 --proposal unscented
    """
    _filtered(model, data, parameters, output, ssm.kalman_filter, proposal=proposal,
              quantiles=quantiles)  # fmt: skip


@command("forward-filter", "Forward algorithm (finite-state models).")
@MODEL
@NEEDED_DATA
@PARAMETERS
@QUANTILES
@SEED
@FILE_OF_MOMENTS
def forward_filter(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], output: Path | None,
    quantiles: tuple[float, ...], seed: int | None,
) -> None:  # fmt: skip
    """The states of MODEL.py given the data up to each row, where they take few values, exactly.

    Prints the log-likelihood, and means and standard deviations of the states and of the
    predicted observations. Writes these, the probability of each value of each state, quantiles,
    increments of the log-likelihood and PIT values to a netCDF file, one for each of several DATA.
    The seed is for the PIT values of discrete observations only.

    \b
        ssmppl forward-filter model.py data.csv -p stay=0.9
        ssmppl forward-filter model.py data.csv -p stay=0.9 --json
    """
    seed = drawn_seed(seed)
    _filtered(model, data, parameters, output, ssm.forward_filter, quantiles=quantiles, seed=seed)


def _filtered(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], output: Path | None,
    verb: Callable[..., Any], **settings: Any,
) -> None:  # fmt: skip
    path = target(output, data[0], "_filter.nc", "_2", data, len(data))
    given = parse_assignments(parameters, "--parameters")
    loaded = load_model(model)
    found = verb(loaded, read_data(data), given, **settings)
    datasets = as_list(found)
    experiments, files, paths = [], [], numbered(path, len(datasets))
    for i, dataset in enumerate(datasets, start=1):
        total = dataset["log_likelihood_increment"].sum("time").values
        attrs = dataset.attrs
        heading(f"{loaded.name}, {_by(attrs)}: {_experiment(i, datasets)}log-likelihood "
                f"{', '.join(f'{one:.6g}' for one in total)}")  # fmt: skip
        table = state_table(dataset)
        say(table_text(table))
        files.append(write(dataset, paths[i - 1], table))
        wrote(files[-1])
        experiments.append({"log_likelihood": total, **columns_of(dataset), **_values(dataset)})
    answer(
        model=loaded.name, proposal=datasets[0].attrs["proposal"], seed=settings.get("seed"),
        log_likelihood=sum(one["log_likelihood"] for one in experiments),
        experiments=experiments, files=files,
    )  # fmt: skip


def _by(attrs: dict[str, Any]) -> str:
    name = str(attrs["proposal"])
    exact = {"kalman": "Kalman filter", "forward": "forward filter"}
    return (exact | LABELS).get(
        name, f"particle filter of {attrs.get('particles')} particles, {name}"
    )


def _values(dataset: Any) -> dict[str, Any]:
    """Effective sample sizes, and probabilities of the values of finite states; first run."""
    found: dict[str, Any] = {}
    if "ess" in dataset:
        found["ess"] = dataset["ess"].values[0]
    for name in map(str, dataset.data_vars):
        state = name.removesuffix("_probability")
        if state != name and f"{state}_value" in dataset.coords:
            values = dataset[f"{state}_value"].values
            found.setdefault("probabilities", {})[state] = {
                "values": values, "probability": dataset[name].values[0],
            }  # fmt: skip
    return found


def _experiment(i: int, datasets: list[Any]) -> str:
    return f"data set {i}, " if len(datasets) > 1 else ""


@command("smooth", "States given all of the data.")
@MODEL
@NEEDED_DATA
@PARAMETERS
@option(
    "--method", type=MethodName(
        {name: type(method) for name, method in SMOOTHERS.items() if name not in APPROXIMATE}
    ),
    help="How to smooth [default: exact where the model allows it, else ffbsi].",
)  # fmt: skip
@option("--proposal", metavar="NAME",
        help=f"In place of a method: {', '.join(APPROXIMATE)}, approximations; or the proposal of "
        "ffbsi's particle filter.")  # fmt: skip
@option("--particles", type=int, help="Number of particles [default: 1000; pgas: 25].")
@option("--trajectories", type=int, help="Draws [default: moments if exact, else 1000].")
@QUANTILES
@SEED
@output("the name of the data file, with .nc",
        "netCDF file for the moments or draws; named .csv or .parquet, the table.")  # fmt: skip
def smooth(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], method: str | None,
    proposal: str | None, particles: int | None, trajectories: int | None,
    quantiles: tuple[float, ...], seed: int | None, output: Path | None,
) -> None:  # fmt: skip
    """The states of MODEL.py given all of the data, at known parameters.

    Prints means and standard deviations and writes them, or trajectories drawn from the joint
    smoothing distribution, to a netCDF file, which xarray.open_dataset reads. Several DATA are
    several experiments, and each gets a file of its own, numbered in the order given. Where a file
    of the default name holds posterior draws, that of the states ends in _states.nc.

    \b
        ssmppl smooth model.py data.csv -p phi=0.95 tau=47
        ssmppl smooth model.py data.csv -p phi=0.95 tau=47 --method pgas --seed 1 -o states.nc
    """
    path = target(output, data[0], ".nc", "_states", data, len(data))
    given, seed = parse_assignments(parameters, "--parameters"), drawn_seed(seed)
    loaded = load_model(model)
    found = ssm.smooth(
        loaded, read_data(data), given, method, particles=particles, trajectories=trajectories,
        proposal=proposal, quantiles=quantiles, seed=seed,
    )  # fmt: skip
    datasets = as_list(found)
    experiments, files, paths = [], [], numbered(path, len(datasets))
    for i, dataset in enumerate(datasets, start=1):
        attrs = dataset.attrs
        by = LABELS.get(str(attrs.get("proposal")), attrs["method"])
        heading(f"{attrs['model']} by {by} (chosen {attrs['method_chosen']}), "
                f"{attrs['seconds']:.1f} s")  # fmt: skip
        table = state_table(dataset)
        say(table_text(table))
        files.append(write(dataset, paths[i - 1], table))
        wrote(files[-1])
        experiments.append({"log_likelihood": attrs.get("log_likelihood"), **columns_of(dataset)})
    attrs = datasets[0].attrs
    answer(
        model=loaded.name, method=attrs["method"], method_chosen=attrs["method_chosen"],
        trajectories=datasets[0].sizes.get("trajectory"), seed=seed, seconds=attrs["seconds"],
        experiments=experiments, files=files,
    )  # fmt: skip
