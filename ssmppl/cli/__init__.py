"""The command line: one command for each verb of the package, and what helps to begin.

`group` has the group and the errors, `options` what commands share, `reading` the files that are
read, `rendering` words, JSON and the files that are written; the commands stand in one module for
each family.
"""

from __future__ import annotations

import click

import ssmppl as ssm
from ssmppl.cli.diagnosis import diagnose
from ssmppl.cli.estimation import evidence, maximize, sample, summary
from ssmppl.cli.group import Commands, plain_option
from ssmppl.cli.likelihood import log_likelihood, score
from ssmppl.cli.models import compile, explain, simulate
from ssmppl.cli.prediction import forecast, leave_future_out, predict
from ssmppl.cli.starting import completion, demo, new
from ssmppl.cli.states import forward_filter, kalman_filter, particle_filter, smooth

__all__ = ["main"]

CONTEXT = {
    "help_option_names": ["-h", "--help"],
    "max_content_width": 100,
    # log_likelihood is found, and forward-backward, as in Python or as on the command line
    "token_normalize_func": lambda token: token.replace("_", "-"),
}


@click.group(cls=Commands, context_settings=CONTEXT)
@plain_option
@click.version_option(ssm.__version__, prog_name="ssmppl")
def main() -> None:
    """Inference in state space models, from four Python functions.

    A model is a Python file that holds one ssmppl.Model, declared by decorated functions; where
    there are several, file.py:name says which one. DATA are files with the names of the
    observations and inputs in their first line: CSV, or by their suffix Parquet (.parquet) and
    netCDF (.nc). Answers go to standard output, progress to standard error; --json makes an answer
    one line of JSON. Exit codes: 0 done, 1 a fault of model or data, 2 a wrong command line, 130
    interrupted. For a first look, run

        ssmppl demo

    and for a model of your own

    \b
        ssmppl new mymodel
        ssmppl explain mymodel.py mymodel.csv
        ssmppl sample mymodel.py mymodel.csv -o posterior.nc
    """


main.add_family("First steps", demo, new)
main.add_family("The model", explain, compile, simulate)
main.add_family("Parameters", sample, summary, maximize, evidence)
main.add_family("States, at known parameters", smooth, particle_filter, kalman_filter,
                forward_filter)  # fmt: skip
main.add_family("Likelihood, at known parameters", log_likelihood, score)
main.add_family("Prediction", predict, forecast, leave_future_out)
main.add_family("When the model is wrong", diagnose)
main.add_family("The shell", completion)
