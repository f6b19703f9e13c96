"""The verb `score`: gradient of the log-likelihood, and the observed information."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.arguments import checked
from ssmppl.counts import check_count
from ssmppl.data import check_parameters, check_values
from ssmppl.errors import ArgumentError, NotApplicable, warn
from ssmppl.inference.maximum.estimate import by_name, table
from ssmppl.inference.particles.scores import (
    ParticleScore,
    Smoothing,
    combine,
    complete_scores,
    run_weights,
    several_runs,
)
from ssmppl.inference.preparation.exact_models import exact_model
from ssmppl.inference.preparation.exact_score import ExactScore, exact_score
from ssmppl.inference.preparation.proposal_choice import ENOUGH, resolve_settings
from ssmppl.inference.preparation.space import free_components
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.labels import model_attributes
from ssmppl.inference.run.problem import EXACT, Problem, pose
from ssmppl.inference.run.seeds import seed_sequence
from ssmppl.language.model.model import Model

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Score", "score"]

# What the score of each exact filter is made of.
SCORED = {
    "kalman": "the sensitivities of the Kalman filter",
    "forward": "Fisher's identity over the forward and backward algorithm",
    "deterministic": "the sensitivities of the states",
    "extended": "differences of the extended Kalman filter's likelihood",
}


@dataclass(frozen=True)
class Score:
    """Derivatives of the log-likelihood in the parameters, on their natural scale.

    Parameters
    ----------
    gradient : by name, a number or an array of the prior's shape. An entry of a symmetric matrix
        moves its mirror image along; the entries of a probability vector move one by one.
    information : minus the second derivatives, labelled as `phi`, `A[0, 1]`.
    log_likelihood : at the parameters.
    gradient_errors, information_errors, log_likelihood_error : Monte Carlo standard errors, from
        independent runs; zero where everything is exact. They know nothing of the bias, which is of
        order 1 / (particles * repeats) where the runs can be weighted by their likelihoods, else
        1 / particles (`attrs["weighted"]` says which).
    attrs : how it was computed.
    """

    gradient: dict[str, float | np.ndarray]
    information: pd.DataFrame
    log_likelihood: float
    gradient_errors: dict[str, float | np.ndarray]
    information_errors: pd.DataFrame
    log_likelihood_error: float
    attrs: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        lines = [f"{self.attrs.get('model', '')}: score, {self.attrs.get('method', '')}"]
        error = self.log_likelihood_error
        lines.append(f"log-likelihood {self.log_likelihood:.6f}"
                     + (f" (Monte Carlo error {error:.2g})" if error else ""))  # fmt: skip
        for name, value in self.gradient.items():
            spread = np.asarray(self.gradient_errors[name])
            for index in np.ndindex(np.shape(value)):
                label = name + (f"[{', '.join(map(str, index))}]" if index else "")
                noise = f"  (error {spread[index]:.2g})" if spread[index] else ""
                lines.append(f"  {label}  {np.asarray(value)[index]:.6g}{noise}")
        return "\n".join([*lines, "observed information", str(self.information)])


@checked
def score(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    *,
    fixed: Mapping[str, Any] | None = None,
    particles: int = 1000,
    trajectories: int = 1000,
    repeats: int = 16,
    proposal: str = "auto",
    kernel: str = "auto",
    seed: int | None = None,
    executor: Executor | None = None,
) -> Score:
    """Gradient of log p(y | parameters), and the observed information.

    Exact on linear Gaussian models, by the sensitivities of the Kalman filter, on those of finitely
    many states, and on those without noise in their states, by the sensitivities of these; else by
    Fisher's and Louis' identities over backward trajectories of a particle filter.

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model.
    fixed : values of parameters in which no derivative is wanted.
    particles, trajectories : number N of particles and M of trajectories of each run.
    repeats : number of independent runs, at least 2.
    proposal : as in `log_likelihood`; "auto" is exact on linear Gaussian models, any particle name
        forces particles.
    kernel : of the backward pass, as in `smooth`.
    seed : the same seed gives the same numbers, whatever the executor; None: a random one.
    executor : any `concurrent.futures.Executor`; None: threads.

    Returns
    -------
    Score : `.gradient` by name, `.information` as a table, and their Monte Carlo errors.

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or call, and the fix.
    SamplingError : all weights vanish at some step; names the step, the row and the parameters.

    Warns
    -----
    UserWarning : the runs' log-likelihoods differ so much that few of them count.
    """
    check_executor(executor)
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters, fixed)
    fixed_values = check_values(problem.trace, fixed, argument="fixed")
    free = free_components(problem.trace, fixed_values)
    if not np.any(free):
        raise ArgumentError(
            "there is no parameter in which to differentiate: "
            + ("all of them are fixed" if problem.trace.parameters else "the model has none"),
            fix="leave out fixed=, or use ssm.log_likelihood",
        )
    check_count("repeats", repeats, 2)
    check_count("trajectories", trajectories, 1)
    settings = resolve_settings(problem, theta, particles, proposal, whole=True, temper=True)
    root = seed_sequence(seed)
    attrs: dict[str, Any] = model_attributes(problem.trace) | {"fixed": dict(fixed or {})}
    form = exact_model(problem.trace)
    if settings.proposal in EXACT and not isinstance(form, NotApplicable):
        exact = exact_score(form, problem.experiments, free, theta)
        found = _exact(exact, theta)
        kind = "approximate" if settings.proposal == "extended" else "exact"
        attrs["method"] = f"{kind}, by {SCORED[settings.proposal]}"
        if exact.differences:
            attrs["method"] = "differences of the exact likelihood"
            attrs["central_differences"] = exact.differences
    else:
        scores = complete_scores(problem, fixed_values)
        smoothing = Smoothing(settings, trajectories, kernel)
        runs = several_runs(scores, theta, smoothing, True, root, range(repeats), executor)
        found = combine(runs)
        spread = float(np.std([r.log_z for r in runs], ddof=1))
        if not spread <= ENOUGH:
            warn(
                f"the log-likelihoods of the {repeats} runs have a standard deviation of "
                f"{spread:.3g} (proposal {settings.proposal!r}): the score rests on a few of them, "
                "and its errors are too small. Give more particles, or another proposal="
            )
        attrs |= {
            "method": "Fisher's and Louis' identities over backward trajectories",
            "particles": particles, "trajectories": trajectories, "repeats": repeats,
            "proposal": settings.proposal, "kernel": kernel, "seed": str(root.entropy),
            "weighted": bool(np.ptp(run_weights(np.array([r.log_z for r in runs]))) > 0.0),
        }  # fmt: skip
        if scores.differences:
            attrs["central_differences"] = scores.differences
    return _score(problem, found, fixed_values, attrs)


def _exact(exact: ExactScore, theta: np.ndarray) -> ParticleScore:
    value, gradient = exact.score(theta)
    if not np.isfinite(value):
        raise ArgumentError(
            "the likelihood is zero at these parameters, so that it has no score",
            fix="give parameters under which the data are possible",
        )
    zero = np.zeros((len(theta), len(theta)))
    information = exact.information(theta)
    return ParticleScore(float(value), 0.0, gradient, zero, information, zero)


def _score(
    problem: Problem,
    found: ParticleScore,
    fixed_values: dict[str, np.ndarray],
    attrs: dict[str, Any],
) -> Score:
    trace = problem.trace
    free = free_components(trace, fixed_values)
    labels = [trace.label(s) for s, f in zip(trace.parameter_symbols, free, strict=True) if f]

    def named(values: np.ndarray) -> dict[str, float | np.ndarray]:
        return {n: v for n, v in by_name(trace, values).items() if n not in fixed_values}

    def labelled(matrix: np.ndarray | None) -> pd.DataFrame:
        whole = np.full((len(free), len(free)), np.nan) if matrix is None else matrix
        return table(labels, whole[np.ix_(free, free)])

    slopes = zip(labels, found.gradient[free], strict=True)
    if none := [f"{n} is {g:g}" for n, g in slopes if not np.isfinite(g)]:
        warn(
            "gradient is not finite at these parameters (e.g. sqrt or log at 0): the score in "
            f"{', '.join(none)}"
        )
    return Score(
        named(found.gradient), labelled(found.information), found.log_likelihood,
        named(np.sqrt(np.diagonal(found.gradient_covariance))),
        labelled(found.information_error), found.log_likelihood_error, attrs,
    )  # fmt: skip
