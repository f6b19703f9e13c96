"""Commands to begin with: the demonstration, a model file of one's own with data beside it, and
what a shell needs to complete commands, options and files.
"""

from __future__ import annotations

import re
from pathlib import Path

import click
from click.shell_completion import get_completion_class

import ssmppl as ssm
from ssmppl import demo as varves_demo
from ssmppl.cli.group import Argument, command
from ssmppl.cli.options import option, output
from ssmppl.cli.rendering import answer, fitting_rows, note, say, stop_interrupted, wants_json
from ssmppl.cli.templates import TEMPLATES, skeleton
from ssmppl.errors import ArgumentError
from ssmppl.tables import wide_table


@command("demo", "The ice varves: from the model to its posterior.")
@option("--draws", type=click.IntRange(4), default=1000, section="Run",
        help="Kept draws of each of the four chains.")  # fmt: skip
@option("--seed", type=int, default=1, section="Run", help="Of all random numbers.")
@output("ice_varves.nc", "File for the draws; those of PMMH go to one beside it.")
def demo(draws: int, seed: int, output: Path | None) -> None:
    """The ice varves: from the model to its posterior, in less than a minute.

    Prints what is derived from the model, samples its posterior by two methods, PGAS and PMMH, and
    compares both with the exact posterior, which quadrature gives for this model. The draws are
    written to netCDF files that ArviZ reads.

    \b
        ssmppl demo --draws 500 --output varves.nc
    """
    path = output or Path("ice_varves.nc")
    found = varves_demo.run(draws, seed, path, note if wants_json() else click.echo)
    exact = {name: {"mean": mean, "sd": sd} for name, (mean, sd) in varves_demo.EXACT.items()}
    answer(
        model=varves_demo.varves.name, exact=exact,
        methods={name: {"parameters": fitting_rows(ssm.summary(idata)), "file": file}
                 for name, (idata, file) in found.items()},
        seed=seed, files=[file for _, file in found.values()],
    )  # fmt: skip
    if any(idata["posterior"].attrs["interrupted"] for idata, _ in found.values()):
        stop_interrupted("what was drawn until then is written.")


@command("new", "A model file to begin with, and data for it.")
@click.argument(
    "name", metavar="NAME", cls=Argument, about="Of the model and of both files; may have a folder."
)
@option("--template", type=click.Choice([*TEMPLATES]), default="scalar",
        help="What the model begins as: one state; a vector of states; counts; or a state that is "
        "driven by an input.")  # fmt: skip
def new(name: str, template: str) -> None:
    """A model file to begin with, and data for it.

    Writes NAME.py, a model that runs as it stands and says where to change it, and NAME.csv, a
    series that was simulated from it. Files that are there are never written over.

    \b
        ssmppl new flow
        ssmppl new motor --template inputs
        ssmppl explain motor.py motor.csv
        ssmppl sample motor.py motor.csv --seed 1
    """
    path = Path(name.removesuffix(".py"))
    if not re.fullmatch(r"\w[\w-]*", path.name):
        raise ArgumentError(
            f"{path.name!r} makes no good name for a model file",
            fix="use letters, digits, _ and -, as in ssmppl new flow",
        )
    if not path.parent.is_dir():
        raise ArgumentError(
            f"the folder {path.parent} does not exist", fix="make it first, or name another"
        )
    model, data = (path.with_name(f"{path.name}{suffix}") for suffix in (".py", ".csv"))
    for file in (model, data):
        if file.exists():
            raise ArgumentError(
                f"{file} is there already, and is not written over", fix="choose another name"
            )
    kind = TEMPLATES[template]
    dataset = ssm.simulate(
        kind.model, kind.parameters, steps=None if kind.inputs else kind.steps,
        inputs=kind.inputs or None, seed=kind.seed,
    )  # fmt: skip
    table = wide_table(dataset)
    for column, values in kind.inputs.items():
        table[column] = values
    try:
        with model.open("x", encoding="utf-8") as text:
            text.write(skeleton(template, path.name))
        try:
            with data.open("x", encoding="utf-8", newline="") as rows:
                table.to_csv(rows, index=False)
        except OSError:
            model.unlink()  # both or none
            raise
    except OSError as error:
        raise ArgumentError(
            f"{error.filename} cannot be written: {error.strerror or error}",
            fix="name another place",
        ) from error
    say(f"Wrote {model} and {data}, {len(table)} rows simulated from it. Next:\n")
    say(f"    ssmppl explain {model} {data}\n    ssmppl sample {model} {data} --seed 1")
    answer(model=path.name, template=template, parameters=kind.parameters, rows=len(table),
           columns=list(table.columns), seed=kind.seed, files=[model, data])  # fmt: skip


PROGRAM, VARIABLE = "ssmppl", "_SSMPPL_COMPLETE"  # click's names, for a program of this name


@command("completion", "The script that completes commands in bash, zsh, fish.", prints_json=False)
@click.argument(
    "shell", type=click.Choice(["bash", "zsh", "fish"]), metavar="bash|zsh|fish", cls=Argument,
    about="The shell.",
)  # fmt: skip
def completion(shell: str) -> None:
    """The script that completes commands, options and files in a shell.

    Prints it. A line in the start-up file of the shell reads it; the file is ~/.bashrc, ~/.zshrc,
    or for fish the script itself is kept where fish looks for it. Nothing is written.

    \b
        eval "$(ssmppl completion bash)"        # a line for ~/.bashrc
        eval "$(ssmppl completion zsh)"         # a line for ~/.zshrc, after compinit
        ssmppl completion fish > ~/.config/fish/completions/ssmppl.fish
    """
    kind = get_completion_class(shell)
    assert kind is not None  # click has these three
    root = click.get_current_context().find_root().command
    click.echo(kind(root, {}, PROGRAM, VARIABLE).source())
