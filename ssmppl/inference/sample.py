"""The verb `sample`: chains from the posterior, as ArviZ InferenceData."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from typing import Any

import numpy as np

from ssmppl.data import check_values, unpack_parameters, unpack_states
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains import gibbs, metropolis, pgas, pmmh, smc2
from ssmppl.inference.chains.parameter_steps import plan_updates
from ssmppl.inference.chains.sampling import Sampler, Setup
from ssmppl.inference.chains.update_rates import told
from ssmppl.inference.exact.models import exact_model, kind_of
from ssmppl.inference.labels import Labels
from ssmppl.inference.method_choice import choose_sampler, why_stuck
from ssmppl.inference.methods import PGAS, PMMH, SMC2, Gibbs, Method, MetropolisHastings
from ssmppl.inference.particles.filtering import check_count, seed_sequence
from ssmppl.inference.particles.pilot import space_of
from ssmppl.inference.problem import Problem, pose
from ssmppl.inference.runner import ChainDraws, run_chains, stack
from ssmppl.language.model import Model
from ssmppl.language.transforms import transforms
from ssmppl.results import to_inference_data

PREPARE: dict[type, Callable[[Setup, Any], Sampler]] = {
    MetropolisHastings: metropolis.prepare,
    Gibbs: gibbs.prepare,
    PMMH: pmmh.prepare,
    PGAS: pgas.prepare,
}


def sample(
    model: Model,
    data: Any,
    method: Method | None = None,
    *,
    draws: int = 1000,
    warmup: int = 1000,
    chains: int = 4,
    start: Mapping[str, Any] | None = None,
    fixed: Mapping[str, Any] | None = None,
    thin: int = 1,
    states: bool = True,
    seed: int | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> Any:
    """Draw from p(theta, x_{1:T} | y_{1:T}).

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    method : `ssm.MetropolisHastings(...)` or `ssm.Gibbs()` for linear Gaussian models and for those
        of finitely many states, `ssm.PMMH(...)`, `ssm.PGAS(...)` or `ssm.SMC2(...)` for all.
        None: for the former Gibbs if every parameter has a closed-form conditional (with
        `interweave="auto"` in linear Gaussian models), else a random walk on the exact likelihood
        while the parameters are few; for the others PGAS, likewise with `interweave="auto"`, or
        PMMH where no ancestors can be sampled, the data are long or the states counts, and the
        parameters are few. `explain` and the attributes say which, and why.
    draws, warmup, chains : kept draws and dropped ones of each chain. Random walks adapt during
        warmup. `SMC2` has independent runs for chains, and neither warmup nor thinning.
    start : parameter values near which to begin; the chains are dispersed round a mode found from
        there.
    fixed : parameters held at these values.
    thin : keep every thin-th draw.
    states : whether to keep the trajectories.
    seed : the same seed gives the same draws, whatever the executor.
    executor : any `concurrent.futures.Executor`; None: a thread for each chain, up to the cores.
    progress : whether to show a progress bar, on stderr.

    Returns
    -------
    InferenceData (ArviZ 0.x) or DataTree (ArviZ 1.x)
        Groups:

        * posterior: parameters (chain, draw, ...) and states (chain, draw, time, ...);
        * sample_stats: lp, acceptance_rate, and log_likelihood (MetropolisHastings: exact; PMMH:
          the estimate at the draw) or update_rate and ess (PGAS: share of the trajectory that a
          sweep changed, ESS / N);
        * log_likelihood (PMMH; PGAS on request): log p(y_t | y_1:t-1, theta), for
          leave-future-out scores; az.loo on it is not valid, as the rows are not exchangeable;
        * observed_data, constant_data (inputs).

        Attributes name method, settings, seed, versions, the plan, and the time taken; after PGAS
        also trajectory_update_rate, the least share of draws between which a row of the trajectory
        changed, and where rows hardly do trajectory_warning, which is given as a warning too.
        Ctrl-C returns what was drawn, with the attribute `interrupted`.

    Raises
    ------
    ModelError, DataError, ArgumentError, SamplingError : what is wrong, where, and the fix.
    """
    began = time.perf_counter()
    for name, value, least in (("draws", draws, 1), ("warmup", warmup, 0), ("chains", chains, 1),
                               ("thin", thin, 1)):  # fmt: skip
        check_count(name, value, least)
    problem = pose(model, data)
    held = check_values(problem.trace, fixed, argument="fixed")
    near = check_values(problem.trace, start, argument="start")
    chosen, reason = (method, "") if method is not None else _chosen(problem, held)
    prepare = PREPARE.get(type(chosen))
    if prepare is None and not isinstance(chosen, SMC2):
        names = ", ".join(f"ssm.{m.__name__}(...)" for m in (*PREPARE, SMC2))
        raise ArgumentError(
            f"method={method!r} is no method of sampling", fix=f"use {names} or None"
        )
    root = seed_sequence(seed)
    space = space_of(problem, held, near)
    setup = Setup(problem, space, held, chains, warmup, thin, root, states)
    report: dict[str, Any]
    if isinstance(chosen, SMC2):  # no chains: independent runs, which need no warmup
        result, report = smc2.drawn(setup, chosen, draws, executor, progress)
        states, warmup, thin = False, 0, 1
    else:
        assert prepare is not None
        sampler = prepare(setup, chosen)
        result = run_chains(
            sampler.step_block, sampler.states, draws, warmup, executor=executor,
            progress=progress, title=type(chosen).__name__,
        )  # fmt: skip
        report = sampler.report
    attrs = {
        "model": problem.trace.name,
        "method": type(chosen).__name__,
        "method_chosen": "by the user" if method is not None else "automatically",
        **({"method_reason": reason} if reason else {}),
        **report,
        "seed": str(root.entropy), "warmup": warmup, "thin": thin, "fixed": dict(fixed or {}),
        "interrupted": any(c.interrupted for c in result),
        "seconds": time.perf_counter() - began,
    }  # fmt: skip
    if isinstance(chosen, PGAS):
        attrs |= told(problem, result)
    return _to_arviz(problem, result, held, states, attrs)


def _chosen(problem: Problem, held: dict[str, np.ndarray]) -> tuple[Method, str]:
    exact = exact_model(problem.trace)
    numbers = sum(len(t.free) for t in transforms(problem.trace) if t.site.name not in held)
    stuck = why_stuck(problem.trace, max(e.steps for e in problem.experiments))
    if isinstance(exact, NotApplicable):
        return choose_sampler(exact, (), numbers, stuck)
    return choose_sampler(kind_of(exact), plan_updates(problem, held), numbers)


def _to_arviz(
    problem: Problem, result: list[ChainDraws[Any]], held: dict[str, np.ndarray], states: bool,
    attrs: dict[str, Any],
) -> Any:  # fmt: skip
    drawn, stats = stack(result)
    trace = problem.trace
    posterior = {n: v for n, v in unpack_parameters(trace, drawn["theta"]).items() if n not in held}
    labels = Labels(problem.experiments)
    over_time: list[str] = []
    observed: dict[str, np.ndarray] = {}
    inputs: dict[str, np.ndarray] = {}
    log_likelihood: dict[str, np.ndarray] = {}
    for i, e in enumerate(problem.experiments):
        if states:
            paths = labels.named(i, unpack_states(trace, drawn[f"path_{i}"]), leading=3)
            posterior |= paths
            over_time += list(paths) if not labels.several else []
        observed |= labels.named(i, e.observed)
        inputs |= labels.named(i, e.inputs)
        if f"increment_{i}" in drawn:
            log_likelihood |= labels.named(i, {"y": drawn[f"increment_{i}"]}, leading=3)
    return to_inference_data(
        posterior=posterior,
        sample_stats=stats,
        observed_data=observed,
        constant_data=inputs or None,
        log_likelihood=log_likelihood or None,
        over_time=over_time,
        time=labels.time,
        dims=labels.dims,
        coords=labels.coords,
        attrs=attrs,
    )
