"""Arguments and options that several commands share, and methods by their short names.

Options have the names that the arguments of the verbs have, with dashes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
import numpy as np
from click.shell_completion import CompletionItem

import ssmppl as ssm
from ssmppl.cli.group import Argument, Option
from ssmppl.errors import ArgumentError, listing
from ssmppl.inference.gaussian.likelihood import APPROXIMATE
from ssmppl.inference.particles.filtering import SCHEMES
from ssmppl.inference.verbs.filters import LEVELS
from ssmppl.inference.verbs.sample import METHODS
from ssmppl.modelfile import parse_settings

Decorator = Callable[..., Any]
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
PROPOSALS = (
    "auto", "kalman", "forward", "deterministic", "bootstrap", "guided", "auxiliary", "twisted",
    "tempered",
    "marginal", "marginal_guided", "marginal_auxiliary", "user", *APPROXIMATE,
)  # fmt: skip


def option(*names: str, section: str = "Method", **settings: Any) -> Decorator:
    """An option that stands under `section` in the help; its default is shown, if there is one."""
    settings.setdefault("show_default", True)
    return click.option(*names, cls=Option, section=section, **settings)


def apply(*decorators: Decorator) -> Decorator:
    """Several options in one decorator, in this order."""

    def decorate(function: Any) -> Any:
        for one in reversed(decorators):
            function = one(function)
        return function

    return decorate


class Listed(click.ParamType):
    """Values separated by commas."""

    name = "list"
    what = "names"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        if not isinstance(value, str):
            return tuple(value)
        parts = [part.strip() for part in value.split(",") if part.strip()]
        if not parts:
            self.fail(f"{value!r} holds no {self.what}: separate them by commas.", param, ctx)
        try:
            return tuple(self.one(part) for part in parts)
        except ValueError:
            self.fail(f"{value!r} is no list of {self.what}, such as {self.example}.", param, ctx)

    example = "a,b"

    @staticmethod
    def one(text: str) -> Any:
        return text


class Numbers(Listed):
    """Numbers separated by commas."""

    what, example = "numbers", "0.05,0.5,0.95"

    @staticmethod
    def one(text: str) -> Any:
        return float(text)


class Names(Listed):
    """Names separated by commas."""


class MethodName(click.Choice):
    """One of some methods by its short name, `do`, or that of its class, DirectOptimization."""

    def __init__(self, kinds: Mapping[str, type]):
        super().__init__(list(kinds), case_sensitive=False)
        self.short: dict[str, str] = {}  # name of a class: the first of its names here
        for name, kind in kinds.items():
            self.short.setdefault(kind.__name__, name)
        self._full = {_bare(kind): name for kind, name in self.short.items()}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return super().convert(self._full.get(_bare(str(value)), value), param, ctx)


def _bare(name: str) -> str:
    return name.replace("-", "").replace("_", "").lower()


def output(default: str, what: str, *, file: bool = True) -> Decorator:
    """The option `-o`: a file, or a folder."""
    kind = click.Path(dir_okay=not file, file_okay=file, writable=True, path_type=Path)
    return option(
        "-o", "--output", type=kind, section="Output", callback=_folder_exists if file else None,
        help=f"{what} [default: {default}]",
    )  # fmt: skip


def _folder_exists(ctx: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
    """Found out before an hour of sampling, not after."""
    if path is not None and not path.parent.is_dir():
        raise click.BadParameter(f"the folder {path.parent} does not exist.")
    return path


def drawn_seed(seed: int | None) -> int:
    """The seed, or one that is drawn now: an answer says which, so that it can be had again."""
    return int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed


def _files(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(incomplete, type="file")]


def _proposals(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in PROPOSALS if name.startswith(incomplete)]


MODEL = click.argument(
    "model", metavar="MODEL.py", shell_complete=_files, cls=Argument,
    about="A Python file with one ssmppl.Model; or MODEL.py:name, one of several.",
)  # fmt: skip
DATA = click.argument(
    "data", nargs=-1, type=FILE, metavar="[DATA]...", cls=Argument,
    about="Files with observations and inputs: .csv, .parquet or .nc; several are experiments.",
)  # fmt: skip
NEEDED_DATA = click.argument(
    "data", nargs=-1, required=True, type=FILE, metavar="DATA...", cls=Argument,
    about="Files with observations and inputs: .csv, .parquet or .nc; several are experiments.",
)  # fmt: skip
SERIES = click.argument(
    "data", type=FILE, metavar="DATA", cls=Argument,
    about="One file with observations and inputs: .csv, .parquet or .nc.",
)  # fmt: skip
POSTERIOR = click.argument(
    "posterior", type=FILE, metavar="POSTERIOR.nc", cls=Argument,
    about="The file that `ssmppl sample` wrote.",
)  # fmt: skip

POSTERIOR_OR_DATA = click.argument(
    "posterior", type=FILE, metavar="POSTERIOR.nc|DATA", cls=Argument,
    about="The file that `ssmppl sample` wrote; or, with --parameters, the data.",
)  # fmt: skip

PARAMETERS = option(
    "-p", "--parameters", multiple=True, metavar="NAME=VALUE...", section="Model and data",
    help="The parameters of the model.",
)  # fmt: skip
FIXED = option(
    "--fixed", multiple=True, metavar="NAME=VALUE...", section="Model and data",
    help="Parameters held at these values.",
)  # fmt: skip
START = option(
    "--start", multiple=True, metavar="NAME=VALUE...", section="Model and data",
    help="Values to begin from, or near.",
)  # fmt: skip
INPUTS = option(
    "--inputs", type=FILE, metavar="FILE", section="Model and data",
    help="File with the inputs of the model: CSV, Parquet or netCDF.",
)  # fmt: skip
SETTINGS = option(
    "--settings", multiple=True, metavar="NAME=VALUE...",
    help="Further settings of the method that is named, as its class in Python has them.",
)  # fmt: skip
QUANTILES = option(
    "--quantiles", type=Numbers(), metavar="P,P...", default=LEVELS,
    help="Levels of the quantiles that are written.",
)  # fmt: skip
SEED = option(
    "--seed", type=int, section="Run",
    help="The same seed gives the same numbers [default: drawn; shown with --json].",
)  # fmt: skip
PROGRESS = option(
    "--progress/--no-progress", default=True, section="Run",
    help="Whether to show how far it is, on standard error.",
)  # fmt: skip
PROPOSAL = option(
    "--proposal", default="auto", metavar="NAME", shell_complete=_proposals,
    help=f"How particles move: {', '.join(PROPOSALS)}; those available are listed by "
    f"`ssmppl explain`. The last {len(APPROXIMATE)} are approximations of the likelihood, without "
    "particles.",
)  # fmt: skip
PARTICLE_FILTER = apply(
    option("--particles", type=int, default=1000, help="Number of particles."),
    option("--repeats", type=int, default=1, help="Number of independent runs."),
    PROPOSAL,
    option("--resampling", type=click.Choice([*SCHEMES]), default="systematic",
           help="How particles are resampled."),
    option("--ess-threshold", type=float, default=1.0,
           help="Resample when the effective sample size is below this share; 1: always."),
    option("--rescue", type=int, default=0,
           help="Where all weights vanish, draw up to so many times the particles at a row."),
)  # fmt: skip


SAMPLERS: dict[str, type] = {
    "mh" if kind is ssm.MetropolisHastings else kind.__name__.lower(): kind for kind in METHODS
}
CLIMBERS: dict[str, type] = {
    "do": ssm.DirectOptimization, "score": ssm.ScoreAscent, "em": ssm.EM,
    "particle-em": ssm.ParticleEM, "psaem": ssm.PSAEM, "if2": ssm.IF2,
}  # fmt: skip


def method_of(
    kinds: Mapping[str, type], name: str | None, settings: Sequence[str] = (),
    particles: int | None = None,
) -> Any:  # fmt: skip
    """The method of this name with its settings; None where none is named.

    Raises
    ------
    click.UsageError : settings without a method, or particles for one without particles.
    ArgumentError : the method has no such setting.
    """
    given = parse_settings(settings, "--settings")
    if particles is not None:
        with_particles = [n for n, k in kinds.items() if "particles" in _names(k)]
        if name not in with_particles:
            *most, last = with_particles
            raise click.UsageError(f"--particles needs --method {', '.join(most)} or {last}.")
        given["particles"] = particles
    if name is None:
        if given:
            raise click.UsageError("--settings needs --method: they are settings of it.")
        return None
    kind = kinds[name]
    for setting in given:
        if setting not in _names(kind):
            raise ArgumentError(
                f"--settings: {kind.__name__} has no setting {setting!r}",
                fix=f"it has: {listing(setting, _names(kind))}",
            )
    return kind(**given)


def _names(kind: type) -> list[str]:
    return [field.name for field in fields(kind)]
