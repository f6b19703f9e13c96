"""Commands about the likelihood at known parameters: its value, and its derivatives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

import ssmppl as ssm
from ssmppl.cli.group import command
from ssmppl.cli.options import (
    FIXED,
    MODEL,
    NEEDED_DATA,
    PARAMETERS,
    PARTICLE_FILTER,
    PROPOSAL,
    SEED,
    drawn_seed,
    option,
)
from ssmppl.cli.reading import read_data
from ssmppl.cli.rendering import answer, labelled_matrix, say
from ssmppl.inference.particles.filtering import log_of_mean
from ssmppl.modelfile import load_model, parse_assignments

__all__ = ["log_likelihood", "score"]


@command("log-likelihood", "Its value, exact or estimated.")
@MODEL
@NEEDED_DATA
@PARAMETERS
@PARTICLE_FILTER
@SEED
@option("--device", type=click.Choice(["cpu", "cuda"]), default="cpu", section="Run",
        help="Where particles move; cuda needs ssmppl[cuda] and an NVIDIA GPU.")  # fmt: skip
def log_likelihood(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], seed: int | None,
    **settings: Any,
) -> None:  # fmt: skip
    """The log-likelihood of parameters of MODEL.py.

    Prints one estimate for each repeat, whose exponentials are unbiased for the likelihood; exact
    where the model is linear and Gaussian, or its states take few values. Of several repeats it
    also prints the log of their mean, with its standard error. Nothing is written.

    \b
        ssmppl log-likelihood model.py data.csv -p phi=0.95 tau=47
        ssmppl log-likelihood model.py data.csv -p phi=0.95 tau=47 --repeats 20 --seed 1 --json
    """
    given, seed = parse_assignments(parameters, "--parameters"), drawn_seed(seed)
    loaded = load_model(model)
    found = ssm.log_likelihood(loaded, read_data(data), given, seed=seed, **settings)
    for one in found:
        say(f"{one:.10g}")
    mean, error = log_of_mean(found)
    if np.isfinite(error):
        say(f"\nlog of the mean {mean:.6f} (standard error {error:.2g})")
    answer(model=loaded.name, log_likelihood=found, log_mean=mean, standard_error=error, seed=seed)


@command("score", "Its gradient, and the observed information.")
@MODEL
@NEEDED_DATA
@PARAMETERS
@FIXED
@option("--particles", type=int, default=1000, help="Number of particles of each run.")
@option("--trajectories", type=int, default=1000, help="Number of trajectories of each run.")
@option("--repeats", type=int, default=16, help="Number of independent runs, at least 2.")
@PROPOSAL
@option("--kernel", default="auto", metavar="NAME",
        help="Of the backward pass: auto, exact, rejection or mcmc.")  # fmt: skip
@SEED
def score(
    model: str, data: tuple[Path, ...], parameters: tuple[str, ...], fixed: tuple[str, ...],
    seed: int | None, **settings: Any,
) -> None:  # fmt: skip
    """The gradient of the log-likelihood at parameters of MODEL.py, and the observed information.

    Prints both, exact where the likelihood is, else with Monte Carlo errors. Those held by --fixed
    are left out. Nothing is written.

    \b
        ssmppl score model.py data.csv -p phi=0.95 tau=47
        ssmppl score model.py data.csv -p phi=0.95 tau=47 --fixed tau=47 --seed 1
    """
    given, seed = parse_assignments(parameters, "--parameters"), drawn_seed(seed)
    held = parse_assignments(fixed, "--fixed")
    loaded = load_model(model)
    found = ssm.score(loaded, read_data(data), given, fixed=held, seed=seed, **settings)
    say(repr(found))
    answer(
        model=loaded.name, method=found.attrs["method"], log_likelihood=found.log_likelihood,
        log_likelihood_error=found.log_likelihood_error, gradient=found.gradient,
        gradient_errors=found.gradient_errors, information=labelled_matrix(found.information),
        information_errors=labelled_matrix(found.information_errors), fixed=held, seed=seed,
    )  # fmt: skip
