"""The command line: `ssmppl demo`, `explain`, `simulate`, `sample`, `smooth` and `maximize`.

Results go to standard output, and what a run shows while it goes on to standard error. Faults of
the user's are printed without a traceback, exit code 1; a wrong command line has exit code 2.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import ssmppl as ssm
from ssmppl import demo as varves_demo
from ssmppl.cli_diagnose import diagnose_command
from ssmppl.errors import DataError, SSMError
from ssmppl.inference.smooth import NAMES as SMOOTHERS
from ssmppl.modelfile import load_model, parse_assignments, read_csv
from ssmppl.results import save, state_table, summary_text, wide_table

if TYPE_CHECKING:
    import pandas as pd

CLIMBERS: dict[str, Any] = {
    "do": ssm.DirectOptimization, "score": ssm.ScoreAscent, "em": ssm.EM,
    "particle-em": ssm.ParticleEM, "psaem": ssm.PSAEM, "if2": ssm.IF2,
}  # fmt: skip
ASSIGNMENTS = ("--parameters", "-p", "--fixed", "--start")


class Commands(click.Group):
    """Turns errors on purpose into messages, and Ctrl-C into a sentence."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except SSMError as error:
            raise click.ClickException(_message(error)) from error
        except KeyboardInterrupt:
            click.echo("Interrupted before there was anything to keep: nothing written.", err=True)
            ctx.exit(130)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)  # as they stand here: in the order of use


class Command(click.Command):
    """A command whose name=value options take all that follow: `--fixed a=1 b=2`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        spread: list[str] = []
        option = ""
        for arg in args:
            if arg in ASSIGNMENTS:
                option = arg
            elif option and spread[-1] != option and re.match(r"[A-Za-z_]\w*\s*=", arg):
                spread.append(option)
            elif option and spread[-1] != option:
                option = ""
            spread.append(arg)
        return super().parse_args(ctx, spread)


def _message(error: SSMError) -> str:
    return "\n".join([f"{type(error).__name__}\n{error}", *getattr(error, "__notes__", ())])


SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
MODEL = click.argument("model", metavar="MODEL.py")
SEED = click.option("--seed", type=int, help="The same seed gives the same numbers.")
CSV = click.Path(exists=True, dir_okay=False, path_type=Path)


def _output(default: str, what: str) -> Callable[..., Any]:
    return click.option(
        "-o",
        "--output",
        type=click.Path(dir_okay=False, writable=True, path_type=Path),
        callback=_folder_exists,
        help=f"{what} [default: {default}]",
    )


def _folder_exists(ctx: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
    """Found out before an hour of sampling, not after."""
    if path is not None and not path.parent.is_dir():
        raise click.BadParameter(f"the folder {path.parent} does not exist.")
    return path


@click.group(cls=Commands, context_settings=SETTINGS)
@click.version_option(ssm.__version__, prog_name="ssmppl")
def main() -> None:
    """Inference in state space models, from four Python functions.

    A model is a Python file that holds one ssmppl.Model, declared by decorated functions; where
    there are several, file.py:name says which one. Data are CSV files with the names of the
    observations and inputs in their first line. For a first look, run

        ssmppl demo

    and for a model of your own

    \b
        ssmppl explain model.py
        ssmppl sample model.py data.csv -o posterior.nc
    """


@main.command(cls=Command)
@click.option(
    "--draws", type=click.IntRange(4), default=1000, show_default=True,
    help="Kept draws of each of the four chains.",
)  # fmt: skip
@click.option("--seed", type=int, default=1, show_default=True, help="Of all random numbers.")
@_output("ice_varves.nc", "File for the draws; those of PMMH go to one beside it.")
def demo(draws: int, seed: int, output: Path | None) -> None:
    """The ice varves: from the model to its posterior, in less than a minute.

    Prints what is derived from the model, samples its posterior by two methods, PGAS and PMMH, and
    compares both with the exact posterior, which quadrature gives for this model. The draws are
    written to netCDF files that ArviZ reads.

    \b
        ssmppl demo --draws 500 --output varves.nc
    """
    varves_demo.run(draws, seed, output or Path("ice_varves.nc"))


@main.command(cls=Command)
@MODEL
@click.argument("data", nargs=-1, type=CSV, metavar="[DATA.csv]...")
@click.option("--source", is_flag=True, help="Print the generated program instead.")
def explain(model: str, data: tuple[Path, ...], source: bool) -> None:
    """What is derived from MODEL.py, and why.

    The structure of the model, how particles are proposed, and one update for each parameter, with
    the reason where something could not be derived. With data, it is checked that they fit, and
    what is missing in them is taken into account.

    \b
        ssmppl explain model.py
        ssmppl explain model.py data.csv
    """
    loaded = load_model(model)
    read = _data(data) if data else None
    click.echo(ssm.compile(loaded, read).source() if source else ssm.explain(loaded, read))


@main.command(cls=Command)
@MODEL
@click.option("--steps", type=int, help="Number of time steps; the inputs, if any, tell it too.")
@click.option(
    "-p", "--parameters", multiple=True, metavar="NAME=VALUE...",
    help="The parameters; without, they are drawn from the prior.",
)  # fmt: skip
@click.option("--inputs", type=CSV, help="CSV file with the inputs of the model.")
@click.option("--draws", type=int, default=1, show_default=True, help="Number of simulations.")
@SEED
@_output("the name of the model file, with .csv", "File for the simulation.")
def simulate(
    model: str,
    steps: int | None,
    parameters: tuple[str, ...],
    inputs: Path | None,
    draws: int,
    seed: int | None,
    output: Path | None,
) -> None:
    """Simulate states and observations of MODEL.py.

    Writes a CSV file with one row for each time step: states, observations, inputs, and the
    parameters if they were drawn from the prior. Vectors take a column for each component: x_0,
    x_1, ... Several simulations stand below each other, numbered by the column draw. The file of a
    single one is what explain and sample take as data.

    \b
        ssmppl simulate model.py --steps 200 --parameters phi=0.9 tau=40 --seed 1 -o series.csv
        ssmppl simulate model.py --inputs torque.csv -p 'beta=[1, 2]' -o series.csv
    """
    loaded = load_model(model)
    given = read_csv(inputs) if inputs else None
    dataset = ssm.simulate(
        loaded,
        parse_assignments(parameters, "--parameters") if parameters else None,
        steps=steps,
        inputs=given,
        draws=draws,
        seed=seed,
    )
    table = wide_table(dataset)
    if given is not None:
        for name in (n for n in given.columns if n not in table.columns):
            table[name] = list(given[name]) * draws
    target = output or Path(_stem(model) + ".csv")
    table.to_csv(target, index=False)
    click.echo(f"Wrote {len(table)} rows to {target}: {', '.join(table.columns)}")


@main.command(cls=Command)
@MODEL
@click.argument("data", nargs=-1, required=True, type=CSV, metavar="DATA.csv...")
@click.option(
    "--method", type=click.Choice(["mh", "gibbs", "pmmh", "pgas", "smc2"], case_sensitive=False),
    help="Exact likelihood and states, for linear Gaussian models: Metropolis-Hastings or Gibbs. "
    "By particles: Metropolis-Hastings (pmmh), Gibbs (pgas), SMC^2 (smc2). "
    "[default: chosen by the model]",
)  # fmt: skip
@click.option("--particles", type=int, help="Number of particles [default: tuned].")
@click.option("--draws", type=int, default=1000, show_default=True, help="Kept draws of a chain.")
@click.option("--warmup", type=int, default=1000, show_default=True, help="Dropped ones before.")
@click.option("--chains", type=int, default=4, show_default=True, help="Number of chains.")
@click.option("--thin", type=int, default=1, show_default=True, help="Keep every thin-th draw.")
@SEED
@click.option("--fixed", multiple=True, metavar="NAME=VALUE...", help="Parameters held fixed.")
@click.option("--start", multiple=True, metavar="NAME=VALUE...", help="Values to start near.")
@click.option("--states/--no-states", default=True, help="Whether to keep the states.")
@_output("the name of the data file, with .nc", "netCDF file for the draws.")
def sample(
    model: str, data: tuple[Path, ...], method: str | None, particles: int | None, draws: int,
    warmup: int, chains: int, thin: int, seed: int | None, fixed: tuple[str, ...],
    start: tuple[str, ...], states: bool, output: Path | None,
) -> None:  # fmt: skip
    """Sample the posterior of MODEL.py given DATA.csv.

    Prints a table of the parameters and writes all draws to a netCDF file, which
    arviz.from_netcdf reads. A column time, or a first column without a name, labels the rows; an
    empty cell is a missing observation. Several CSV files are several experiments of one system.
    Ctrl-C ends sampling early, and what was drawn is kept.

    \b
        ssmppl sample model.py data.csv -o posterior.nc
        ssmppl sample model.py day1.csv day2.csv --method pmmh --fixed mass=1.2 --seed 1
    """
    by_particles: dict[str, Any] = {"pgas": ssm.PGAS, "pmmh": ssm.PMMH, "smc2": ssm.SMC2}
    exact: dict[str, Any] = {"mh": ssm.MetropolisHastings, "gibbs": ssm.Gibbs}
    name = method.lower() if method else ""
    if particles is not None and name not in by_particles:
        raise click.UsageError("--particles needs --method pgas, pmmh or smc2.")
    given = {} if particles is None else {"particles": particles}
    chosen: Any = by_particles[name](**given) if name in by_particles else None
    loaded = load_model(model)
    idata = ssm.sample(
        loaded,
        _data(data),
        exact[name]() if name in exact else chosen,
        draws=draws,
        warmup=warmup,
        chains=chains,
        thin=thin,
        states=states,
        seed=seed,
        fixed=parse_assignments(fixed, "--fixed"),
        start=parse_assignments(start, "--start"),
    )
    target = output or Path(data[0].stem + ".nc")
    save(idata, target)
    posterior = idata["posterior"]
    attrs, kept = posterior.attrs, posterior.sizes["draw"]
    if attrs["interrupted"]:
        click.echo(f"Interrupted: {kept} of {draws} draws of each chain are kept.", err=True)
    click.echo(
        f"{attrs['model']} by {attrs['method']} (chosen {attrs['method_chosen']}): "
        f"{_particles(attrs)}{chains} chains of {kept} draws, {attrs['seconds']:.1f} s\n"
    )
    click.echo(summary_text(ssm.summary(idata)))
    click.echo(f"\nWrote {target}")


@main.command(cls=Command)
@MODEL
@click.argument("data", nargs=-1, required=True, type=CSV, metavar="DATA.csv...")
@click.option("-p", "--parameters", multiple=True, metavar="NAME=VALUE...", help="The parameters.")
@click.option(
    "--method", type=click.Choice([*SMOOTHERS], case_sensitive=False),
    help="How to smooth [default: exact by the Kalman smoother, else ffbsi].",
)  # fmt: skip
@click.option("--particles", type=int, help="Number of particles [default: 1000; pgas: 25].")
@click.option("--trajectories", type=int, help="Draws [default: moments if exact, else 1000].")
@SEED
@_output("the name of the data file, with .nc", "netCDF file for the moments or draws.")
def smooth(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], method: str | None,
    particles: int | None, trajectories: int | None, seed: int | None, output: Path | None,
) -> None:  # fmt: skip
    """The states of MODEL.py given all of DATA.csv, at known parameters.

    Prints means and standard deviations and writes them, or trajectories drawn from the joint
    smoothing distribution, to a netCDF file, which xarray.open_dataset reads. Several CSV files
    are several experiments, and each gets a file of its own, numbered in the order given.

    \b
        ssmppl smooth model.py data.csv -p phi=0.95 tau=47
        ssmppl smooth model.py data.csv -p phi=0.95 tau=47 --method pgas --seed 1 -o states.nc
    """
    read = _data(data)
    given = parse_assignments(parameters, "--parameters")
    found = ssm.smooth(
        load_model(model), read, given, method.lower() if method else None,
        particles=particles, trajectories=trajectories, seed=seed,
    )  # fmt: skip
    datasets = found if isinstance(found, list) else [found]
    target = output or Path(data[0].stem + ".nc")
    for i, dataset in enumerate(datasets, start=1):
        path = target if len(datasets) == 1 else target.with_stem(f"{target.stem}_{i}")
        attrs = dataset.attrs
        click.echo(f"{attrs['model']} by {attrs['method']} (chosen {attrs['method_chosen']}), "
                   f"{attrs['seconds']:.1f} s\n")  # fmt: skip
        click.echo(state_table(dataset).to_string(float_format="{:.4g}".format, max_rows=10))
        click.echo(f"\nWrote {save(dataset, path)}")


@main.command(cls=Command)
@MODEL
@click.argument("data", nargs=-1, required=True, type=CSV, metavar="DATA.csv...")
@click.option(
    "--method", type=click.Choice([*CLIMBERS], case_sensitive=False),
    help="How to climb [default: chosen by the model].",
)  # fmt: skip
@click.option(
    "--objective", type=click.Choice(["likelihood", "posterior"]), default="likelihood",
    show_default=True, help="What to maximise.",
)  # fmt: skip
@SEED
@click.option("--fixed", multiple=True, metavar="NAME=VALUE...", help="Parameters held fixed.")
@click.option("--start", multiple=True, metavar="NAME=VALUE...", help="Values to begin from.")
@_output("none", "CSV file for the estimate and its standard errors.")
def maximize(
    model: str, data: tuple[Path, ...], method: str | None, objective: str, seed: int | None,
    fixed: tuple[str, ...], start: tuple[str, ...], output: Path | None,
) -> None:  # fmt: skip
    """The parameters of MODEL.py that make DATA.csv most likely.

    Prints the estimate with standard errors from the observed information, and where random
    numbers were used the estimate's own Monte Carlo error. Several CSV files are several
    experiments of one system. Ctrl-C ends the climb early, and the best so far is kept.

    \b
        ssmppl maximize model.py data.csv --seed 1
        ssmppl maximize model.py data.csv --method em --fixed mass=1.2 -o estimate.csv
    """
    estimate = ssm.maximize(
        load_model(model), _data(data), CLIMBERS[method.lower()]() if method else None,
        objective=objective, seed=seed, fixed=parse_assignments(fixed, "--fixed"),
        start=parse_assignments(start, "--start"),
    )  # fmt: skip
    attrs = estimate.attrs
    click.echo(f"{estimate!r}\n\n{attrs['method']}, chosen {attrs['method_chosen']}; "
               f"{attrs['seconds']:.1f} s")  # fmt: skip
    if output is not None:
        estimate.table().to_csv(output, index_label="parameter")
        click.echo(f"Wrote {output}")


def _particles(attrs: dict[str, Any]) -> str:
    return f"{attrs['particles']} particles, " if "particles" in attrs else ""


def _data(paths: tuple[Path, ...]) -> pd.DataFrame | list[pd.DataFrame]:
    tables = []
    for path in paths:
        table = read_csv(path)
        if "draw" in table.columns and table["draw"].nunique() > 1:
            raise DataError(
                f"{path} holds {table['draw'].nunique()} simulations, numbered by the column "
                "'draw'",
                fix="give a file with one of them, or one file for each experiment",
            )
        tables.append(table)
    return tables[0] if len(tables) == 1 else tables


def _stem(model: str) -> str:
    return Path(model.rpartition(".py")[0] or model).stem


main.add_command(diagnose_command(Command, _data))
