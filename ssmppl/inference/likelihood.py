"""The verb `log_likelihood`."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np

from ssmppl.codegen.kernels.resampling import SYSTEMATIC
from ssmppl.counts import check_count, check_room
from ssmppl.data import check_parameters
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.exact.models import NEEDED, exact_log_likelihood, form_of
from ssmppl.inference.executors import check_executor
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    estimates_task,
    filter_settings,
    seed_sequence,
)
from ssmppl.inference.particles.on_device import check_device
from ssmppl.inference.particles.proposal_choice import choose
from ssmppl.inference.problem import EXACT, Problem, pose
from ssmppl.inference.tasks import run_tasks
from ssmppl.language.model import Model

TASKS = 8  # pieces that repeats are cut into, so that an executor has something to share out


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
        "twisted", "tempered", or "user" where the model has a @proposal. "auto" is exact on linear
        Gaussian models, on those of finitely many states ("forward", the forward algorithm) and on
        those without noise in their states ("deterministic"), else the proposal with
        the least variance for its cost in a pilot; "twisted", which looks ahead to the end of the
        data, is tried where the others tell log Z to no better than 1.2 at 100 particles.
        "marginal", "marginal_guided" and "marginal_auxiliary" are Rao-Blackwellised: states that
        are linear and Gaussian given the others are integrated out by a Kalman filter per particle
        (Schön, Gustafsson and Nordlund 2005), and the others move by the transition or the two
        better proposals; "auto" tries them.
        "tempered" takes a sharp likelihood in by degrees: at each row particles are weighed by
        rising powers of the observation's density, resampled, and moved by Metropolis steps between
        them (Herbst and Schorfheide 2019), for continuous states of any law and observations that
        no derivative is known of; a pilot of its own random numbers fixes powers and steps for each
        estimate. It costs tens of times what "bootstrap" does, and "auto" tries it where no
        guided proposal is derived and others tell log Z to no better than 1.2.
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
        2015, section 5). -inf at parameters at which nothing is finite.

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or call, and the fix.
    SamplingError : weights are NaN for some particles, naming the step and the user's line.
    """
    check_executor(executor)
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters, support=False)
    check_count("repeats", repeats, 1)
    settings = settle(
        problem, theta, particles, proposal, resampling, ess_threshold, rescue, whole=True,
        integrate=True, device=device,
    )  # fmt: skip
    if settings.proposal in EXACT:
        exact = exact_log_likelihood(problem.trace, problem.experiments, theta)
        return np.full(repeats, exact)
    task = estimates_task(problem, theta, settings, seed_sequence(seed))
    tasks = min(TASKS if device == "cpu" else 1, repeats)  # a device has one queue
    pieces = [r for r in np.array_split(np.arange(repeats), tasks) if len(r)]
    ranges = [range(int(p[0]), int(p[-1]) + 1) for p in pieces]
    return np.concatenate(run_tasks(task, ranges, executor=executor))


def settle(
    problem: Problem,
    theta: np.ndarray,
    particles: Any,
    proposal: str,
    resampling: str = "systematic",
    ess_threshold: float = 1.0,
    rescue: int = 0,
    *,
    whole: bool = False,
    integrate: bool = False,
    device: str = "cpu",
) -> FilterSettings:
    """The settings of a call with "auto" resolved, checked against what could be derived.

    whole, integrate : as in `choose`.
    """
    settings = filter_settings(particles, proposal, resampling, ess_threshold, rescue)
    each = 2 * len(problem.trace.state_symbols) + 2  # of this row and the last; weight and ancestor
    check_room(f"particles={particles}", each * settings.particles, "give fewer particles")
    if device != "cpu":
        return _on_device(problem, theta, settings, resampling, device)
    if proposal == "auto":
        fixed = settings.scheme == SYSTEMATIC and ess_threshold >= 1.0 and not rescue
        flags = {"whole": whole, "integrate": integrate, "temper": whole and fixed}
        chosen = choose(problem, theta, **flags).name
        return replace(settings, proposal=chosen)
    if proposal in EXACT:
        found = form_of(proposal, problem.trace)
        if isinstance(found, NotApplicable):
            raise ArgumentError(
                f'proposal="{proposal}" needs a {NEEDED[proposal]}: {found}',
                fix='use proposal="auto"',
            )
    else:
        problem.proposal(proposal, integrate, EXACT)
    return settings


def _on_device(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, resampling: str, device: str
) -> FilterSettings:
    """The settings for a device other than the processor; exact likelihoods need none."""
    if device != "cuda":
        raise ArgumentError(f"device={device!r} is unknown", fix="use 'cpu' or 'cuda'")
    name = settings.proposal
    if name == "auto":
        name = choose(problem, theta, look_ahead=False).name
    if name not in EXACT:
        check_device(
            problem, name, resampling=(resampling, "systematic"),
            ess_threshold=(settings.ess_threshold, 1.0), rescue=(settings.rescue, 0),
        )  # fmt: skip
    return replace(settings, proposal=name, device=device)
