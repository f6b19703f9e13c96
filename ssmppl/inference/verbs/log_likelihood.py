"""The verb `log_likelihood`: log p(y | theta), exact or by unbiased particle estimates."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from typing import Any

import numpy as np

from ssmppl.arguments import checked
from ssmppl.counts import check_count
from ssmppl.data import check_parameters
from ssmppl.errors import warn
from ssmppl.inference.gaussian.likelihood import (
    APPROXIMATE,
    approximate_log_likelihood,
    approximation_of,
)
from ssmppl.inference.particles.filtering import FilterSettings, estimates_task
from ssmppl.inference.preparation.exact_models import exact_log_likelihood
from ssmppl.inference.preparation.pilot import why_zero
from ssmppl.inference.preparation.proposal_choice import resolve_settings
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.problem import EXACT, Problem, pose
from ssmppl.inference.run.seeds import seed_sequence
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model.model import Model

BY_EXTENDED = (
    "the model calls a simulator, so that this log-likelihood is an approximation, by the extended "
    'Kalman filter. proposal="extended" asks for it without this warning; proposal="bootstrap" is '
    "unbiased"
)
TASKS = 8  # pieces that repeats are cut into, so that an executor has something to share out


@checked
def log_likelihood(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    *,
    particles: int = 1000,
    repeats: int = 1,
    proposal: str = "auto",
    resampling: str = "systematic",
    ess_threshold: float = 1.0,
    rescue: int = 0,
    seed: int | None = None,
    executor: Executor | None = None,
    device: str = "cpu",
) -> np.ndarray:
    """Estimates of log p(y | parameters).

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model, {} where it has none.
    particles : number N of particles.
    repeats : number of independent estimates.
    proposal : "auto", "kalman", "forward", "deterministic", "bootstrap", "guided", "auxiliary",
        "twisted", "tempered", "laplace", "extended", "unscented", or "user" where the model has a
        @proposal.
        "auto" is exact on linear Gaussian models, on those of finitely many states ("forward", the
        forward algorithm) and on those without noise in their states ("deterministic"), else the
        proposal with the least variance for its cost in a pilot; "twisted", which looks ahead to
        the end of the data, is tried where the others tell log Z to no better than 1.2 at 100
        particles.
        "marginal", "marginal_guided" and "marginal_auxiliary" are Rao-Blackwellised: states that
        are linear and Gaussian given the others are integrated out by a Kalman filter per particle
        (Schön, Gustafsson and Nordlund 2005), and the others move by the transition or the two
        better proposals; "auto" tries them.
        "tempered" takes a sharp likelihood in by degrees: at each row particles are weighed by
        rising powers of the observation's density, resampled, and moved by Metropolis steps between
        them (Herbst and Schorfheide 2019), for continuous states of any distribution and
        observations that no derivative is known of; a pilot of its own random numbers fixes powers
        and steps for each estimate. It costs tens of times what "bootstrap" does, and "auto" tries
        it where no guided proposal is derived and others tell log Z to no better than 1.2.
        "laplace", "extended" and "unscented" are approximations without particles or random
        numbers, for models whose states are driven by Gaussian noise: Laplace's, at the mode of
        all states together (Tierney and Kadane 1986), an extended Kalman filter, whose update is
        the mode of each row, and an unscented one (Julier and Uhlmann 1997), to which observations
        count by their mean and covariance. They are exact where the model is linear and Gaussian,
        and never taken by "auto", but for "extended" where the model calls a simulator.
    resampling : "systematic", "stratified", "residual" or "multinomial".
    ess_threshold : resample when the effective sample size falls below this share of N; 1: always.
    rescue : where all N particles have weight zero, go on drawing, up to `rescue` times N at a row,
        as the alive particle filter (Del Moral, Jasra, Lee, Yau and Zhang 2015): at every row until
        N + 1 have a positive weight, the last of which is left out. 0: no. The estimate stays
        unbiased, whatever the limit; -inf where none is alive at the limit. With it ancestors are
        drawn independently at every row. Exact likelihoods need none.
    seed : the same seed gives the same numbers, whatever the executor; None: a random one.
    executor : any `concurrent.futures.Executor`; None: threads. From 524,288 particles on, a filter
        of "bootstrap", "guided" or "user" also shares its own particles out among all cores.
    device : "cpu", or "cuda": on an NVIDIA GPU, meant for 100,000 particles and more, with
        systematic resampling at every row and proposals that do not look ahead ("bootstrap",
        "guided", "user"; "auto" is the better of them, or exact). Its random numbers, and so its
        estimates, are other ones than the processor's. Needs `pip install 'ssmppl[cuda]'`.

    Returns
    -------
    float64 array (repeats,)
        The exp of each is an unbiased estimate of the likelihood (Del Moral 2004; Schön et al.
        2015, section 5), except of the approximations. -inf at parameters at which nothing is
        finite.

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or call, and the fix.
    SamplingError : weights are NaN for some particles, naming the step and the user's line.

    Warns
    -----
    UserWarning : "auto" took an approximation; or every estimate is -inf, with the row and the
        distribution at fault as far as they are known.
    """
    check_executor(executor)
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters, support=False)
    check_count("repeats", repeats, 1)
    if proposal in APPROXIMATE:
        value = approximate_log_likelihood(
            problem, theta, approximation_of(problem, proposal), proposal
        )
        return np.full(repeats, value)
    settings = resolve_settings(
        problem, theta, particles, proposal, resampling, ess_threshold, rescue, whole=True,
        temper=True, integrate=True, device=device,
    )  # fmt: skip
    if settings.proposal in EXACT:
        if proposal == "auto" and settings.proposal == "extended":
            warn(BY_EXTENDED)
        exact = exact_log_likelihood(problem.trace, problem.experiments, theta)
        if exact == -np.inf:
            _say_why_nothing(problem, theta)
        return np.full(repeats, exact)
    task = estimates_task(problem, theta, settings, seed_sequence(seed))
    tasks = min(TASKS if device == "cpu" else 1, repeats)  # a device has one queue
    pieces = [r for r in np.array_split(np.arange(repeats), tasks) if len(r)]
    ranges = [range(int(p[0]), int(p[-1]) + 1) for p in pieces]
    found = np.concatenate(run_tasks(task, ranges, executor=executor))
    if np.all(found == -np.inf):
        _say_why_nothing(problem, theta, settings)
    return found


def _say_why_nothing(
    problem: Problem, theta: np.ndarray, settings: FilterSettings | None = None
) -> None:
    """Warn of a likelihood of zero, where something is known of its cause."""
    why = why_zero(problem, theta, settings.particles if settings else None)
    if why is not None:
        found, fix, where = why
        warn(f"the likelihood is zero: {found}. Fix: {fix}" + (f" ({where})" if where else ""))
