"""The verb `sample`: chains from the posterior, as ArviZ InferenceData."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from ssmppl.analysis.structure import singular_covariance
from ssmppl.arguments import checked_with
from ssmppl.codegen.store.beforehand import beforehand
from ssmppl.counts import check_count, check_room
from ssmppl.data import check_values, unpack_parameters, unpack_states
from ssmppl.errors import ArgumentError, NotApplicable, written_as
from ssmppl.inference.batched.reckoning import reckon
from ssmppl.inference.chains import gibbs, ismcmc, metropolis, pgas, pmmh, smc2
from ssmppl.inference.chains.gibbs_updates import plan_updates
from ssmppl.inference.chains.sampling import GO_ON, SamplingMethod, SamplingSetup
from ssmppl.inference.checkpoints.chains import CheckpointFile
from ssmppl.inference.checkpoints.codec import Codec
from ssmppl.inference.checkpoints.origin import Origin, data_digest, model_digest, text_of, versions
from ssmppl.inference.gaussian.likelihood import use_mode
from ssmppl.inference.methods.methods import (
    ISMCMC,
    PGAS,
    PMMH,
    SMC2,
    Gibbs,
    Method,
    MetropolisHastings,
)
from ssmppl.inference.methods.settings import check_settings
from ssmppl.inference.preparation.exact_models import exact_kind, exact_model
from ssmppl.inference.preparation.gaussian_pilot import approximation_kind, precise_twisted
from ssmppl.inference.preparation.method_choice import (
    choose_sampler,
    only_counts,
    what_else,
    why_stuck,
)
from ssmppl.inference.preparation.space import Space, free_components, space_of
from ssmppl.inference.run.convergence import ESS, convergence_attributes, have_converged
from ssmppl.inference.run.draws import stack
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.labels import (
    Labels,
    check_names,
    measured_rows,
    model_attributes,
    observes,
)
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.inference.run.seeds import seed_sequence
from ssmppl.inference.updates.independence import AHEAD, PREPARING
from ssmppl.language.model.model import Model
from ssmppl.language.model.transforms import transforms
from ssmppl.results import to_inference_data
from ssmppl.status import LOG

# Draws of all chains without which these do not go on: what is left of them when they are thinned
# has an ESS of 400 for certain only if there is room.
LEAST_TO_GO_ON = 2 * ESS
TRIED_OUT = 4  # draws, and as many before them
# The name of the log-likelihoods of rows. Not a channel's: with that, ArviZ would weigh the draws
# of `predict` at a row, which know the whole record, by densities of one-step predictions.
ONE_STEP = "one_step"
FEW_SETS = 2  # what passes over several data sets need is compiled for two as for any number
# The methods, under the classes of their settings.
METHODS: dict[type, SamplingMethod] = {
    MetropolisHastings: metropolis.METHOD,
    Gibbs: gibbs.METHOD,
    PMMH: pmmh.METHOD,
    ISMCMC: ismcmc.METHOD,
    PGAS: pgas.METHOD,
    SMC2: smc2.METHOD,
}


@checked_with(METHODS)
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
    checkpoint: str | os.PathLike[str] | None = None,
) -> Any:
    """Draw from p(theta, x_{1:T} | y_{1:T}).

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame or xarray Dataset; of several experiments a
        dictionary of those by label, a list, or a long table with the model's column `experiment`.
    method : `ssm.MetropolisHastings(...)` or `ssm.Gibbs()` for linear Gaussian models and for those
        of finitely many states, `ssm.MetropolisHastings(...)` where states have no noise too,
        `ssm.PMMH(...)`, `ssm.PGAS(...)` or `ssm.SMC2(...)` for all.
        `ssm.ISMCMC(...)` for those whose states have a Gaussian approximation.
        None: for the former `ssm.Gibbs()` if every parameter has a closed-form conditional, else a
        random walk on the exact likelihood while the parameters are few; for the others PMMH where
        a pilot finds that twisted particle filters of at most 64 particles estimate the likelihood
        precisely (sd of log Z at most 0.3), with up to 12 free numbers; else
        `ssm.PGAS(interweave="auto")`, or PMMH where no ancestors can be sampled, the data are long
        or the states counts, and the parameters are few. `explain` and the attributes say which,
        and why. Chains of a method that was chosen like this, 800 draws of all or more, go on until
        they have converged (see the attributes below): to at most nine times the draws. The first
        then count as warmup, and the others are thinned to as many as were asked for; the attribute
        `further_draws` says how many were made.
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
    checkpoint : a file that keeps where the chains stand and what they drew, written every half
        minute, at Ctrl-C, at an error and at the end. After a kill or a power cut the same call
        goes on from it and returns the draws that it would have returned, bit for bit; without a
        seed it takes up that of the file. Once all is drawn, it returns that at once. The same call
        with more `draws` (of `SMC2`: up to its `parameters`) goes on to those of one longer run;
        with fewer it returns the first of them (of `ISMCMC`: those of a shorter run). All else has
        to be as it was: model, data, method and settings, versions of this package, Python, NumPy,
        SciPy and Numba. Draws that exceed
        128 MB go to a folder beside it, `<checkpoint>.draws`, and variables of the result that do
        are read from there when they are looked at. Reading a checkpoint executes nothing.

    Returns
    -------
    InferenceData (ArviZ 0.x) or DataTree (ArviZ 1.x)
        Groups:

        * posterior: parameters (chain, draw, ...) and states (chain, draw, time, ...);
        * sample_stats (not of SMC2): lp, acceptance_rate, and log_marginal_likelihood
          (log p(y | theta), one number of a draw; MetropolisHastings: exact; PMMH: the estimate at
          the draw; ISMCMC: likewise, with the approximation's, and the weight by which the draw was
          resampled in place of acceptance_rate) or update_rate and
          ess (PGAS: share of the trajectory that a sweep changed, ESS / N);
        * log_likelihood (`one_step`; PMMH; ISMCMC; Gibbs, MetropolisHastings and PGAS by their
          setting `log_likelihood=True`): log p(y_t | y_1:t-1, theta) of the rows that were
          measured, along `time`, of several experiments with different rows along `row`. `az.loo`
          and `az.compare` take each row's for that of an observation given all others, which it is
          not: what they print is the score of one-step predictions with parameters that know the
          row itself, less a correction for that, and says little of rows to come.
          `ssm.leave_future_out` does;
        * observed_data, constant_data (inputs).

        Attributes name method, settings, seed, versions, the plan, and the time taken; after PGAS
        also trajectory_update_rate, the least share of draws between which a row of the trajectory
        changed, and where rows hardly do trajectory_warning, which is given as a warning too. So is
        convergence_warning, unless R-hat of every parameter is below 1.01 and its bulk and tail ESS
        over all chains at least 400 (of one chain: that it has no R-hat); never of fewer than 100
        draws of each chain, of SMC2 or of an interrupted run.
        Ctrl-C returns what was drawn, with the attribute `interrupted`.

    Raises
    ------
    ModelError, DataError, ArgumentError, SamplingError : what is wrong, where, and the fix. A
        checkpoint that is damaged or of another call is refused, and left as it is. One that cannot
        be written (a disk that is full) is an error before anything is drawn; later it is a
        warning, and sampling goes on.
    """
    began = time.perf_counter()
    for name, value, least in (("draws", draws, 1), ("warmup", warmup, 0), ("chains", chains, 1),
                               ("thin", thin, 1)):  # fmt: skip
        check_count(name, value, least)
    check_executor(executor)
    check_settings(method)
    problem = pose(model, data, noting=True)
    fixed_values = check_values(problem.trace, fixed, argument="fixed")
    near = check_values(problem.trace, start, argument="start")
    space = space_of(problem, fixed_values, near)
    if method is None:
        passes = PREPARING + chains * (draws * thin / AHEAD) * (1 + states)
        reckon("sample", problem, space.theta, passes, progress)
    chosen, reason = (method, "") if method is not None else _chosen(space, fixed_values)
    if method is None:
        LOG.info("sample of model %r: %s, as %s", problem.trace.name, type(chosen).__name__, reason)
    sampling_method = METHODS.get(type(chosen))
    if sampling_method is None:
        names = ", ".join(f"ssm.{m.__name__}(...)" for m in METHODS)
        raise ArgumentError(
            f"method={method!r} is not a sampling method",
            fix=written_as(method, METHODS) or f"use {names} or None",
        )
    if not sampling_method.markov:
        states, warmup, thin = False, 0, 1
    chosen = sampling_method.complete(chosen, draws)
    if not states and all(name in fixed_values for name in problem.trace.parameters):
        what = (
            "states=False"
            if sampling_method.markov
            else f"{type(chosen).__name__} draws parameters only"
        )
        raise ArgumentError(
            f"there is nothing to draw: no parameter is free, and {what}",
            fix="draw the states, by another method than SMC2 and without states=False, or leave a "
            "parameter out of fixed=",
        )
    check_names(problem.trace, problem.experiments)
    if checkpoint is None:
        _check_room(problem, sampling_method.by_row(chosen), chains, draws, states)
    root, checkpoint_file = seed_sequence(seed), None
    if checkpoint is not None:
        origin = _origin(problem, chosen, fixed_values, near, chains, warmup, thin, states)
        checkpoint_file = CheckpointFile(checkpoint, origin, seed, root, _codec(), draws)
        root = checkpoint_file.root
    setup = SamplingSetup(
        problem, space, fixed_values, chains, warmup, thin, root, states, checkpoint_file
    )
    free = free_components(problem.trace, fixed_values)
    by_row = sampling_method.by_row(chosen)
    go_on = [k for k in GO_ON if _room_for(problem, by_row, chains, k * draws, states)]
    enough = method is None and chains * draws >= LEAST_TO_GO_ON
    converged = partial(have_converged, free=free) if enough else None
    drawn = sampling_method.draw(setup, chosen, draws, executor, progress, converged, go_on)
    result, report = drawn
    attrs = {
        **model_attributes(problem.trace),
        "method": type(chosen).__name__,
        "method_chosen": "by the user" if method is not None else "automatically",
        **({"method_reason": reason} if reason else {}),
        **report,
        "seed": str(root.entropy), "warmup": warmup, "thin": thin, "fixed": dict(fixed or {}),
        "observes": observes(problem.trace),
        "interrupted": any(c.interrupted for c in result),
        "seconds": checkpoint_file.seconds if checkpoint_file else time.perf_counter() - began,
    }  # fmt: skip
    attrs |= sampling_method.attributes(problem, result)
    if checkpoint_file is None or sampling_method.independent or "further_draws" in report:
        whole = stack(result)
    else:
        whole = checkpoint_file.stack(result)
    if sampling_method.markov:
        symbols = problem.trace.parameter_symbols
        labels = [problem.trace.label(s) for s, f in zip(symbols, free, strict=True) if f]
        theta, interrupted = whole[0]["theta"][:, :, free], bool(attrs["interrupted"])
        advice = what_else(chosen, problem, fixed_values, warmup * thin)
        attrs |= convergence_attributes(labels, theta, interrupted, advice, warmup)
    return _to_arviz(problem, whole, fixed_values, states, attrs)


def _codec() -> Codec:
    """The codec of what checkpoints hold: the states of chains, and what is found before them."""
    return Codec([c for method in METHODS.values() for c in method.state_classes])


def _check_room(problem: Problem, by_row: bool, chains: int, draws: int, states: bool) -> None:
    """That memory holds what the draws have of each row, twice: of each chain, and put together."""
    each = {
        "states": len(problem.trace.state_symbols) if states else 0,
        "log-likelihoods": int(by_row),
    }
    fix = "thin= with fewer draws keeps fewer, checkpoint= keeps them on disk"
    check_room(
        f"{chains} chains of {draws} draws of the {' and '.join(n for n, v in each.items() if v)} "
        f"of {problem.rows} rows, twice while they are put together",
        2 * chains * draws * problem.rows * sum(each.values()),
        f"states=False leaves them out, {fix}" if states else fix,
    )


def _room_for(problem: Problem, by_row: bool, chains: int, draws: int, states: bool) -> bool:
    """Whether memory holds the draws of chains that go on so far."""
    try:
        _check_room(problem, by_row, chains, draws, states)
    except ArgumentError:
        return False
    return True


def _origin(
    problem: Problem, method: Method, fixed_values: Mapping[str, np.ndarray],
    near: Mapping[str, np.ndarray], chains: int, warmup: int, thin: int, states: bool,
) -> Origin:  # fmt: skip
    """All that the draws depend on, but for the seed and their number."""
    own = ", ".join(f"{f.name}={text_of(getattr(method, f.name))}" for f in fields(method))
    plain = {
        "method": f"{type(method).__name__}({own})", "chains=": str(chains),
        "warmup=": str(warmup), "thin=": str(thin), "states=": str(states),
        "fixed=": f"{{{text_of(fixed_values)}}}", "start=": f"{{{text_of(near)}}}",
    }  # fmt: skip
    digests = {"model": model_digest(problem.trace), "data": data_digest(problem.experiments)}
    return Origin(digests, plain | versions())


def _chosen(space: Space, fixed_values: dict[str, np.ndarray]) -> tuple[Method, str]:
    problem = space.problem
    exact, singular = exact_model(problem.trace), singular_covariance(problem.trace)
    numbers = sum(len(t.free) for t in transforms(problem.trace) if t.site.name not in fixed_values)
    stuck = why_stuck(problem.trace, max(e.steps for e in problem.experiments))
    drawn = not isinstance(exact, NotApplicable) and singular is None
    updates = plan_updates(problem, fixed_values) if drawn else ()
    choose = partial(
        choose_sampler, exact_kind(exact), updates, numbers, stuck, singular,
        counted=only_counts(problem.trace),
    )  # fmt: skip
    if not isinstance(exact, NotApplicable):
        return choose()
    other = choose()[0]
    tried: list[Method] = [other]
    if isinstance(other, PGAS) and other.interweave == "auto":
        tried.insert(0, replace(other, interweave=True))
    calls = [partial(_try_out, space, fixed_values, m) for m in tried]
    if approximation_kind(problem) == "laplace":
        calls.insert(0, partial(use_mode, problem, space.theta))
    with beforehand(*calls):
        return choose(twisted=precise_twisted(space))


def _try_out(space: Space, fixed_values: dict[str, np.ndarray], chosen: Method) -> None:
    """A few draws by a method given a few data sets, so that what it needs is compiled."""
    problem = replace(space.problem, experiments=space.problem.experiments[:FEW_SETS])
    space, root = replace(space, problem=problem), np.random.SeedSequence(0)
    setup = SamplingSetup(problem, space, fixed_values, 1, TRIED_OUT, 1, root)
    METHODS[type(chosen)].draw(setup, chosen, TRIED_OUT, None, False, None)


def _to_arviz(
    problem: Problem, whole: tuple[dict[str, np.ndarray], dict[str, np.ndarray]],
    fixed_values: dict[str, np.ndarray], states: bool, attrs: dict[str, Any],
) -> Any:  # fmt: skip
    drawn, stats = whole
    trace = problem.trace
    posterior = {
        n: v for n, v in unpack_parameters(trace, drawn["theta"]).items() if n not in fixed_values
    }
    labels = Labels(trace, problem.experiments)
    numbers, paths = range(len(problem.experiments)), dict[str, np.ndarray]()
    if states:
        each = [unpack_states(trace, drawn[f"path_{i}"]) for i in numbers]
        paths = labels.together(each, leading=3)
    found = None
    if "increment_0" in drawn:
        increments = [drawn[f"increment_{i}"] for i in numbers]
        found = measured_rows(labels, problem.experiments, increments)
    return to_inference_data(
        posterior=posterior | paths,
        sample_stats=stats,
        observed_data=labels.together([e.observed for e in problem.experiments]),
        constant_data=labels.together([e.inputs for e in problem.experiments]) or None,
        log_likelihood={ONE_STEP: found[0]} if found else None,
        rows=found[1] if found else None,
        over_time=paths,
        **labels.arguments,
        attrs=attrs | labels.attrs,
    )
