"""The command `ssmppl diagnose`: a model file and measurements in, the report and its page out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import ssmppl as ssm
from ssmppl.errors import ArgumentError
from ssmppl.gap.report import GapReport
from ssmppl.modelfile import load_model, parse_assignments

__all__ = ["diagnose_command"]

# Beside the report: the stages that are done, from which an interrupted run goes on.
CHECKPOINT = "stages"


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


def diagnose_command(
    kind: type[click.Command], read: Callable[[tuple[Path, ...]], Any]
) -> click.Command:
    """The command, of the class `kind`; `read` gives the data of CSV files."""

    @click.command(name="diagnose", cls=kind)
    @click.argument("model", metavar="MODEL.py")
    @click.argument(
        "data", nargs=-1, required=True, metavar="DATA.csv...",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
    )  # fmt: skip
    @click.option(
        "-o", "--output", type=click.Path(file_okay=False, path_type=Path),
        help="Folder for the report [default: the name of the data file, with _report].",
    )  # fmt: skip
    @click.option("--fast", is_flag=True, help="Stop after the screen: nothing is fitted again.")
    @click.option("--fixed", multiple=True, metavar="NAME=VALUE...", help="Known parameters.")
    @click.option(
        "--effects", metavar="NAME,NAME...",
        help="Try these effects only; names as in ssm.effects.names() [default: all].",
    )  # fmt: skip
    @click.option("--particles", type=click.IntRange(2), help="Number of particles [tuned].")
    @click.option(
        "--alpha", type=click.FloatRange(0, 1, min_open=True, max_open=True), default=0.05,
        show_default=True, help="Chance of a false alarm, over everything that is tried.",
    )  # fmt: skip
    @click.option("--seed", type=int, default=1, show_default=True, help="Of all random numbers.")
    def diagnose(
        model: str, data: tuple[Path, ...], output: Path | None, fast: bool,
        fixed: tuple[str, ...], effects: str | None, particles: int | None, alpha: float,
        seed: int,
    ) -> None:  # fmt: skip
        """Where MODEL.py differs from DATA.csv, which effect is missing, how far the gap closes.

        Prints the three answers in words, and writes a folder with the page index.html, tables
        (CSV), plots (PNG) and the model with what was found added. The page is one file that any
        browser shows, on a phone too. Inputs are columns of the data; several CSV files are
        several experiments of one system. Ctrl-C ends early: the stages that are done are kept,
        and the same command goes on from there.

        \b
            ssmppl diagnose model.py data.csv -o report/
            ssmppl diagnose model.py data.csv --fast --fixed mass=1.2 length=0.4
            ssmppl diagnose model.py data.csv --effects 'coulomb friction,quadratic drag'
        """
        held, names = parse_assignments(fixed, "--fixed"), _names(effects)
        loaded, table = load_model(model), read(data)
        folder = _made(output or Path(f"{data[0].stem}_report"))
        report: GapReport = ssm.diagnose(
            loaded, table, names, mode="fast" if fast else "full", alpha=alpha,
            fixed=held or None, particles=particles, checkpoint=folder / CHECKPOINT, seed=seed,
        )  # fmt: skip
        click.echo(str(report))
        page = report.save(folder)
        if report.interrupted:
            click.echo("Interrupted: this is what the stages done so far tell.", err=True)
        click.echo(f"\nWrote {page}")

    return diagnose
