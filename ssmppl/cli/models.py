"""Commands about a model by itself: what is derived from it, its program, and simulations."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

import ssmppl as ssm
from ssmppl.cli.group import command
from ssmppl.cli.options import DATA, INPUTS, MODEL, PARAMETERS, SEED, drawn_seed, option, output
from ssmppl.cli.reading import as_table, read_data, read_table
from ssmppl.cli.rendering import answer, file_of_model, say, target, write
from ssmppl.data.channels import column_names
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model, parse_assignments
from ssmppl.tables import wide_table

__all__ = ["compile", "explain", "simulate"]


@command("explain", "What is derived from a model, and why.")
@MODEL
@DATA
@option("--source", is_flag=True, section="Output", show_default=False,
        help="Print the generated program instead: `ssmppl compile`.")  # fmt: skip
def explain(model: str, data: tuple[Path, ...], source: bool) -> None:
    """What is derived from MODEL.py, and why.

    Prints the structure of the model, how particles are proposed, the methods that are chosen, and
    one update for each parameter, with the reason where something could not be derived. With DATA,
    it is checked that they fit, and what is missing in them is taken into account. Nothing is
    written.

    \b
        ssmppl explain model.py
        ssmppl explain model.py data.csv
    """
    loaded = load_model(model)
    read = read_data(data) if data else None
    if source:
        text = ssm.compile(loaded, read).source()
        say(text)
        answer(model=loaded.name, source=text)
        return
    plan = ssm.explain(loaded, read)
    say(_bold_titles(str(plan)))
    sections = [
        {"title": title, "rows": [{"what": what, "how": how} for what, how in rows]}
        for title, rows in plan.sections()
    ]
    answer(model=loaded.name, data=plan.data or None, sections=sections)


def _bold_titles(text: str) -> str:
    lines = text.split("\n")
    for i, below in enumerate(lines[1:]):
        if below and len(set(below)) == 1 and below[0] in "-=":
            lines[i] = click.style(lines[i], bold=True)
    return "\n".join(lines)


@command("compile", "The program that is generated for a model.")
@MODEL
@DATA
@option("--path", is_flag=True, section="Output", show_default=False,
        help="Print where the program's file is instead.")  # fmt: skip
def compile(model: str, data: tuple[Path, ...], path: bool) -> None:
    """The program that is generated for MODEL.py.

    Prints the Python module that runs, each line with the line of the model that it stems from.
    With DATA it is the variant that deals with what is missing in them. The module lies in the
    cache of compiled models, whose place --path prints. Nothing is written elsewhere.

    \b
        ssmppl compile model.py
        ssmppl compile model.py data.csv --path
    """
    loaded = load_model(model)
    program = ssm.compile(loaded, read_data(data) if data else None)
    say(str(program.path) if path else program.source())
    answer(model=loaded.name, path=program.path, source=program.source())


@command("simulate", "Simulate states and observations.")
@MODEL
@option("--steps", type=int, section="Model and data",
        help="Number of time steps [default: number of input rows].")  # fmt: skip
@PARAMETERS
@INPUTS
@option("--draws", type=int, default=1, section="Run", help="Number of simulations.")
@SEED
@output("the name of the model file, with _simulated.csv",
        "File for the simulation: .csv, .parquet or .nc.")  # fmt: skip
def simulate(
    model: str, steps: int | None, parameters: tuple[str, ...], inputs: Path | None, draws: int,
    seed: int | None, output: Path | None,
) -> None:  # fmt: skip
    """Simulate states and observations of MODEL.py.

    Writes a CSV file with one row for each time step: states, observations, inputs, and the
    parameters, which are drawn from the prior unless they are given. Vectors take a column for
    each component: x_0, x_1, ... Several simulations stand below each other, numbered by the column
    draw. The file of a single one is what explain and sample take as data.

    \b
        ssmppl simulate model.py --steps 200 --parameters phi=0.9 tau=40 --seed 1 -o series.csv
        ssmppl simulate model.py --inputs torque.csv -p 'beta=[1, 2]' -o series.csv
    """
    path = target(output, file_of_model(model), "_simulated.csv", "_2", [inputs] if inputs else [])
    loaded, seed = load_model(model), drawn_seed(seed)
    given = read_table(inputs) if inputs else None
    values = parse_assignments(parameters, "--parameters") if parameters else None
    dataset = ssm.simulate(loaded, values, steps=steps, inputs=given, draws=draws, seed=seed)
    table = wide_table(dataset)
    if given is not None:
        driving, own = as_table(given), set[str]()  # the file may have columns of other things
        for n, shape in trace(loaded).inputs.items():
            own |= {c for index in np.ndindex(*shape) for c in (n, *column_names(n, index))}
        for name in (n for n in driving.columns if n in own and n not in table.columns):
            table[name] = list(driving[name]) * draws
            dataset[name] = ("time", driving[name].to_numpy())
    write(dataset, path, table.set_index(str(table.columns[0])))
    say(f"Wrote {len(table)} rows to {path}: {', '.join(table.columns)}")
    answer(model=loaded.name, rows=len(table), columns=list(table.columns), draws=draws, seed=seed,
           files=[path])  # fmt: skip
