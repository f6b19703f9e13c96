"""The command `diagnose`: a model file and measurements in, the report and its page out."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import ssmppl as ssm
from ssmppl.analysis.structure import simulators
from ssmppl.cli.group import command
from ssmppl.cli.options import FIXED, MODEL, NEEDED_DATA, PROGRESS, option, output
from ssmppl.cli.reading import read_data
from ssmppl.cli.rendering import answer, records, say, stop_in_part, stop_interrupted, wrote
from ssmppl.errors import ArgumentError
from ssmppl.inference.run.executors import cpu_count, processes
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model, parse_assignments

if TYPE_CHECKING:
    from ssmppl.diagnosis.report.report import GapReport

__all__ = ["diagnose"]

# Beside the report: the stages that are done, from which an interrupted run goes on.
CHECKPOINT = "stages"
MOST_WORKERS = 8  # where none are asked for: each holds the package and its compiled code


def _names(text: str | None) -> list[str] | None:
    """a, b as a list; None where the option is not given."""
    if text is None:
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ArgumentError(
            "--effects names no effect",
            fix="name some, separated by commas: --effects 'coulomb friction,quadratic drag'",
        )
    return names


def _made(folder: Path) -> Path:
    """The folder, made now: found out before minutes of computing, not after."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError(
            f"the folder {folder} cannot be made: {error.strerror or error}",
            fix="name another with -o",
        ) from error
    return folder


@command("diagnose", "Where model and data differ, why, and the gain in held-out prediction.")
@MODEL
@NEEDED_DATA
@option("--mode", type=click.Choice(["full", "fast"]), default="full",
        help="fast stops after the score tests: no refits.")  # fmt: skip
@option("--fast", is_flag=True, show_default=False, help="The same as --mode fast.")
@FIXED
@option(
    "--effects", metavar="NAME,NAME...",
    help="Try these effects only; names as in ssm.effects.names() [default: all].",
)  # fmt: skip
@option(
    "--particles", type=click.IntRange(10),
    help="Number of particles [default: 1000, fast mode 500; 100 with the twisted proposal].",
)  # fmt: skip
@option(
    "--alpha", type=click.FloatRange(0, 0.5, min_open=True, max_open=True), default=0.05,
    help="Chance of naming an effect if the model is right, over all that are tried; of reporting "
    "any finding about 1.4 times this, in fast mode 1.6.",
)  # fmt: skip
@option(
    "--horizon", type=click.IntRange(1), metavar="ROWS",
    help="Rows of the simulations by which the report says how far the gap closes [default: a "
    "tenth of the longest record].",
)  # fmt: skip
@option("--seed", type=int, default=1, section="Run", help="Of all random numbers.")
@option(
    "--checkpoint", type=click.Path(path_type=Path), metavar="PATH", section="Run",
    help="Keeps the stages that are done [default: stages/ in the folder of the report].",
)  # fmt: skip
@option(
    "--workers", type=click.IntRange(1), section="Run",
    help="Processes that share the simulated sets and refits [default: threads of this one; where "
    "the model calls a simulator, as many processes as cores, 8 at most].",
)  # fmt: skip
@option(
    "--debug", is_flag=True, section="Run", show_default=False,
    help="Stop at the first internal error with its traceback, where else its part is left out.",
)  # fmt: skip
@PROGRESS
@output("the name of the data file, with _report", "Folder for the report.", file=False)
def diagnose(
    model: str, data: tuple[Path, ...], output: Path | None, mode: str, fast: bool,
    fixed: tuple[str, ...], effects: str | None, particles: int | None, alpha: float,
    horizon: int | None, seed: int, checkpoint: Path | None, workers: int | None, debug: bool,
    progress: bool,
) -> None:  # fmt: skip
    """Where MODEL.py differs from DATA, which effect is missing, how far the gap closes.

    Prints the four answers in words, and writes a folder with the page index.html, tables
    (CSV), plots (PNG), the augmented model and, where effects are not distinguishable, the inputs
    of an experiment that would distinguish them (experiment.csv). The page is one file that any
    browser shows, on a phone too. Inputs are columns of the data; several DATA are several
    experiments of one system. Ctrl-C ends early: the stages that are done are kept, and the same
    command resumes from there. Where a part fails, the answer is without it and says so, and the
    exit code is 3.

    \b
        ssmppl diagnose model.py data.csv -o report/
        ssmppl diagnose model.py data.csv --fast --fixed mass=1.2 length=0.4
        ssmppl diagnose model.py data.csv --effects 'coulomb friction,quadratic drag'
    """
    held, names = parse_assignments(fixed, "--fixed"), _names(effects)
    loaded, read = load_model(model), read_data(data)
    folder = _made(output or Path(f"{data[0].stem}_report"))
    kept = checkpoint or folder / CHECKPOINT
    if workers is None:  # Python code holds other threads up, compiled code does not
        workers = min(cpu_count(), MOST_WORKERS) if simulators(trace(loaded)) else 1
    try:
        # What the file defines is pickled by name: each process runs it, as it was run here.
        ready = partial(load_model, model)
        with processes(workers, ready) if workers > 1 else nullcontext() as executor:
            report: GapReport = ssm.diagnose(
                loaded, read, names, mode="fast" if fast else mode, alpha=alpha,
                fixed=held or None, particles=particles, checkpoint=kept, progress=progress,
                seed=seed, debug=debug, horizon=horizon, executor=executor,
            )  # fmt: skip
    except KeyboardInterrupt:
        stop_interrupted(f"before there was anything to report. {kept} holds the stages that are "
                         "done: the same command resumes from there.")  # fmt: skip
    say(str(report))
    page = report.save(folder)
    wrote(page)
    answer(model=loaded.name, **_report_values(report), folder=folder, files=[page])
    if report.interrupted:
        stop_interrupted(f"this is what the stages done so far tell. {kept} holds them: the same "
                         "command resumes from there.")  # fmt: skip
    if len(report.left_out):
        failed = "; ".join(report.left_out["part"])
        stop_in_part(f"{failed} failed. {kept} holds what is done: the same command tries the "
                     "rest again, and --debug shows where it fails.")  # fmt: skip


def _report_values(report: GapReport) -> dict[str, Any]:
    """The report by the names of its attributes."""
    tables = {name: records(table) for name, table in report.tables().items()}
    return {
        "verdict": report.verdict, "chosen": report.chosen, "estimates": report.estimates,
        **tables, "missing": tables.get("missing"), "signals": tables.get("signals"),
        "formula": tables.get("formula"), "probabilities": tables.get("probabilities"),
        "experiment": None if report.experiment is None else records(report.experiment),
        "separation": _separation(report), "complete": not len(report.left_out),
        "parts": report.parts, "notes": report.notes,
        "settings": report.settings, "mode": report.mode, "seconds": report.seconds,
        "interrupted": report.interrupted,
    }  # fmt: skip


def _separation(report: GapReport) -> dict[str, Any] | None:
    """The figures of `report.separation`."""
    found = report.separation
    if found is None:
        return None
    best = found.best and {
        "signal": found.best.signal.words, "input": found.best.input, "nats": found.best.nats,
    }  # fmt: skip
    return {
        "effects": [{"effect": effect, "equation": equation} for effect, equation in found.effects],
        "recorded": found.recorded, "needed": found.needed, "best": best, "runs": found.runs,
        "rows": found.rows, "times_as_many": found.times_as_many,
    }  # fmt: skip
