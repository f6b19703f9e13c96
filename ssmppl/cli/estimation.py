"""Commands that estimate parameters: the posterior, its summary, the maximum, the evidence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import ssmppl as ssm
from ssmppl.cli.group import command
from ssmppl.cli.options import (
    CLIMBERS,
    FIXED,
    MODEL,
    NEEDED_DATA,
    POSTERIOR,
    PROGRESS,
    SAMPLERS,
    SEED,
    SETTINGS,
    START,
    MethodName,
    Names,
    drawn_seed,
    method_of,
    option,
    output,
)
from ssmppl.cli.reading import read_data, read_posterior
from ssmppl.cli.rendering import (
    answer,
    fitting_rows,
    heading,
    labelled_matrix,
    new_file,
    say,
    stop_interrupted,
    summary_lines,
    target,
    write,
    wrote,
)
from ssmppl.modelfile import load_model, parse_assignments

__all__ = ["evidence", "maximize", "sample", "summary"]

INTEGRATED = {name: SAMPLERS[name] for name in ("mh", "pmmh", "smc2")}


@command("sample", "Sample the posterior of parameters and states.")
@MODEL
@NEEDED_DATA
@option(
    "--method", type=MethodName(SAMPLERS),
    help="Exact likelihood and states, for linear Gaussian models and finite states: "
    "Metropolis-Hastings (mh) or Gibbs. By particles: Metropolis-Hastings (pmmh), Gibbs (pgas), "
    "SMC^2 (smc2). [default: chosen by the model]",
)  # fmt: skip
@option(
    "--particles", type=int,
    help="Number of particles [default: pmmh tuned; smc2 100; pgas 25, or 200 where ancestors "
    "cannot be sampled].",
)  # fmt: skip
@SETTINGS
@option("--draws", type=int, default=1000, section="Run", help="Kept draws per chain.")
@option("--warmup", type=int, default=1000, section="Run", help="Warmup draws per chain.")
@option("--chains", type=int, default=4, section="Run", help="Number of chains.")
@option("--thin", type=int, default=1, section="Run", help="Keep every thin-th draw.")
@SEED
@FIXED
@START
@option("--states/--no-states", default=True, section="Output", help="Whether to keep the states.")
@PROGRESS
@option(
    "--checkpoint", type=click.Path(path_type=Path), metavar="FILE", section="Run",
    help="Keeps what is done; after a kill, or Ctrl-C, the same command goes on from it.",
)  # fmt: skip
@output("the name of the data file, with .nc", "netCDF file for the draws.")
def sample(
    model: str, data: tuple[Path, ...], method: str | None, particles: int | None,
    settings: tuple[str, ...], seed: int | None, fixed: tuple[str, ...], start: tuple[str, ...],
    checkpoint: Path | None, output: Path | None, draws: int, **run: Any,
) -> None:  # fmt: skip
    """Sample the posterior of MODEL.py given DATA.

    Prints a table of the parameters and writes all draws to a netCDF file, which
    arviz.from_netcdf reads. A column time, or a first column of dates or without a name,
    labels the rows; an empty cell is a missing observation. Several DATA are several experiments
    of one system. Ctrl-C ends sampling early, and what was drawn is kept. With --checkpoint the
    same command goes on from there, as after a crash, and its draws are those of a run that was
    never stopped.

    \b
        ssmppl sample model.py data.csv -o posterior.nc
        ssmppl sample model.py day1.csv day2.csv --method pmmh --fixed mass=1.2 --seed 1
        ssmppl sample model.py data.csv --method pgas --settings particles=50 interweave=auto
        ssmppl sample model.py data.csv --draws 100000 --checkpoint night.npz
    """
    path = target(output, data[0], ".nc", "_posterior", data, table=False)
    chosen = method_of(SAMPLERS, method, settings, particles)
    loaded = load_model(model)
    try:
        idata = ssm.sample(
            loaded, read_data(data), chosen, draws=draws,
            seed=seed if checkpoint else drawn_seed(seed),  # without one, that of the checkpoint
            fixed=parse_assignments(fixed, "--fixed"), start=parse_assignments(start, "--start"),
            checkpoint=checkpoint, **run,
        )  # fmt: skip
    except KeyboardInterrupt:
        if checkpoint is None or not checkpoint.is_file():
            raise
        stop_interrupted(f"before every chain had a draw. {checkpoint} holds how far they came: "
                         "the same command goes on from there.")  # fmt: skip
    write(idata, path)
    posterior = idata["posterior"]
    attrs, kept = posterior.attrs, posterior.sizes["draw"]
    table = ssm.summary(idata)
    particles = attrs.get("particles")
    heading(
        f"{attrs['model']} by {attrs['method']} (chosen {attrs['method_chosen']}): "
        f"{f'{particles} particles, ' if particles else ''}{posterior.sizes['chain']} chains of "
        f"{kept} draws, {attrs['seconds']:.1f} s"
    )
    say(summary_lines(table))
    wrote(path)
    answer(
        model=attrs["model"], method=attrs["method"], method_chosen=attrs["method_chosen"],
        particles=particles, chains=posterior.sizes["chain"], draws=kept,
        parameters=fitting_rows(table), seed=int(attrs["seed"]), seconds=attrs["seconds"],
        interrupted=bool(attrs["interrupted"]), files=[path],
    )  # fmt: skip
    if attrs["interrupted"]:
        further = f" The same command goes on from {checkpoint}." if checkpoint else ""
        stop_interrupted(f"{kept} of {draws} draws of each chain are kept.{further}")


@command("summary", "The parameters of a posterior, and whether the chains converged.")
@POSTERIOR
@option("--var-names", type=Names(), metavar="NAME,NAME...", section="Model and data",
        help="Of these variables [default: all parameters].")  # fmt: skip
@output("none", "File for the table: .csv or .parquet.")
def summary(
    posterior: Path, var_names: tuple[str, ...] | None, output: Path | None
) -> None:  # fmt: skip
    """The parameters of POSTERIOR.nc, a file that `ssmppl sample` wrote.

    Prints mean, standard deviation, their Monte Carlo errors, bulk and tail effective sample size
    and R-hat of each number, and marks those whose chains have not converged. Writes
    the table only where -o says where.

    \b
        ssmppl summary posterior.nc
        ssmppl summary posterior.nc --var-names phi,tau -o parameters.csv
    """
    new_file(output, [posterior], netcdf=False)
    idata = read_posterior(posterior)
    table = ssm.summary(idata, var_names)
    attrs = idata["posterior"].attrs
    say(summary_lines(table))
    files = _table(output, table)
    answer(model=attrs.get("model"), parameters=fitting_rows(table), files=files)


def _table(output: Path | None, table: Any) -> list[Path]:
    """The table written, where it is wanted."""
    if output is None:
        return []
    write(None, output, table.rename_axis("parameter"))
    wrote(output)
    return [output]


@command("maximize", "The parameters that make the data most likely.")
@MODEL
@NEEDED_DATA
@option(
    "--method", type=MethodName(CLIMBERS),
    help="Optimisation method: direct optimisation (do), score ascent, EM, its particle forms, "
    "iterated filtering (if2) [default: chosen by the model].",
)  # fmt: skip
@SETTINGS
@option(
    "--objective", type=click.Choice(["likelihood", "posterior"]), default="likelihood",
    help="What to maximise.",
)  # fmt: skip
@SEED
@FIXED
@START
@PROGRESS
@output("none", "File for the estimate and its standard errors: .csv or .parquet.")
def maximize(
    model: str, data: tuple[Path, ...], method: str | None, settings: tuple[str, ...],
    objective: str, seed: int | None, fixed: tuple[str, ...], start: tuple[str, ...],
    progress: bool, output: Path | None,
) -> None:  # fmt: skip
    """The parameters of MODEL.py that make DATA most likely.

    Prints the estimate with standard errors from the observed information, and where random
    numbers were used the estimate's own Monte Carlo error. Several DATA are several experiments of
    one system. Writes the table only where -o says where. Ctrl-C ends the climb early, and the
    best so far is kept.

    \b
        ssmppl maximize model.py data.csv --seed 1
        ssmppl maximize model.py data.csv --method em --fixed mass=1.2 -o estimate.csv
    """
    new_file(output, data, netcdf=False)
    estimate = ssm.maximize(
        load_model(model), read_data(data), method_of(CLIMBERS, method, settings),
        objective=objective, seed=drawn_seed(seed), fixed=parse_assignments(fixed, "--fixed"),
        start=parse_assignments(start, "--start"), progress=progress,
    )  # fmt: skip
    attrs = estimate.attrs
    say(f"{estimate!r}\n\n{attrs['method']}, chosen {attrs['method_chosen']}; "
        f"{attrs['seconds']:.1f} s")  # fmt: skip
    files = _table(output, estimate.table())
    answer(
        model=attrs["model"], method=attrs["method"], method_chosen=attrs["method_chosen"],
        objective=objective, parameters=estimate.parameters,
        standard_errors=estimate.standard_errors,
        monte_carlo_errors=attrs.get("monte_carlo_errors"),
        covariance=labelled_matrix(estimate.covariance), log_likelihood=estimate.log_likelihood,
        log_likelihood_error=attrs.get("log_likelihood_error"), fixed=attrs["fixed"],
        converged=attrs.get("converged"), notes=estimate.notes, seed=int(attrs["seed"]),
        seconds=attrs["seconds"], interrupted=bool(attrs["interrupted"]), files=files,
    )  # fmt: skip
    if attrs["interrupted"]:
        stop_interrupted("this is the best point so far" +
                         (f", written to {output}." if output else "."))  # fmt: skip


@command("evidence", "The log of p(data), the parameters integrated out.")
@MODEL
@NEEDED_DATA
@option(
    "--method", type=MethodName(INTEGRATED),
    help="Bridge sampling over the exact likelihood (mh) or its particle estimate (pmmh); or SMC^2 "
    "[default: mh where it applies, else pmmh].",
)  # fmt: skip
@option("--particles", type=int, help="Number of particles [default: pmmh tuned; smc2 100].")
@SETTINGS
@option("--draws", type=int, default=2000, section="Run", help="Draws of a chain.")
@option("--warmup", type=int, default=1000, section="Run", help="Warmup draws per chain.")
@option("--chains", type=int, default=4, section="Run", help="Number of chains.")
@SEED
@FIXED
@START
@PROGRESS
def evidence(
    model: str, data: tuple[Path, ...], method: str | None, particles: int | None,
    settings: tuple[str, ...], seed: int | None, fixed: tuple[str, ...], start: tuple[str, ...],
    draws: int, **run: Any,
) -> None:  # fmt: skip
    """The log of p(DATA) under MODEL.py, its parameters integrated out.

    Prints the log evidence with its Monte Carlo standard error, and how it was made. Differences
    between models of the same data are log Bayes factors. Priors must be proper; parameters held by
    --fixed are conditioned on. Nothing is written.

    \b
        ssmppl evidence model.py data.csv --seed 1
        ssmppl evidence model.py data.csv --method smc2 --settings parameters=1000 --json
    """
    seed = drawn_seed(seed)
    loaded = load_model(model)
    found = ssm.evidence(
        loaded, read_data(data), method_of(INTEGRATED, method, settings, particles), seed=seed,
        draws=draws,
        fixed=parse_assignments(fixed, "--fixed"), start=parse_assignments(start, "--start"), **run,
    )  # fmt: skip
    heading(f"{loaded.name}: {found}")
    width = max((len(name) for name in found.report), default=0)
    for name, value in found.report.items():
        say(f"{name.replace('_', ' '):{width}}  {value}")
    interrupted = bool(found.report.get("interrupted"))
    answer(model=loaded.name, log_evidence=found.log_evidence, report=found.report,
           standard_error=found.standard_error, seed=seed, interrupted=interrupted)  # fmt: skip
    if interrupted:
        stop_interrupted(f"this is the estimate from {found.report['draws']} draws of each chain.")
