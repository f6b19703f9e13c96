"""The verbs `particle_filter`, `kalman_filter` and `forward_filter`, and the form of what a filter
tells.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtr, ndtri

from ssmppl.analysis.structure import simulators
from ssmppl.arguments import checked
from ssmppl.counts import check_count, check_room
from ssmppl.data import Experiment, check_parameters, unpack_observations, unpack_states
from ssmppl.data.times import label_text
from ssmppl.errors import ArgumentError, NotApplicable, warn
from ssmppl.inference.exact import kalman
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.exact.state_values import probabilities
from ssmppl.inference.gaussian.likelihood import APPROXIMATE, approximation_of
from ssmppl.inference.gaussian.moments import ApproximateKalman
from ssmppl.inference.particles.filtering import FilterRun, FilterSettings, full_run
from ssmppl.inference.particles.marginal import is_marginal, marginal_run
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot, resolve_settings, tempers
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.labels import (
    by_experiment,
    component_dims,
    model_attributes,
    observes,
    with_data,
)
from ssmppl.inference.run.problem import EXACT, Problem, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model.model import Model
from ssmppl.results import to_dataset

if TYPE_CHECKING:
    import xarray as xr

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
FEW, MANY = 3.0, 20  # effective sample size that is no sample, where there are so many particles


@checked
def particle_filter(
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
    quantiles: tuple[float, ...] = LEVELS,
    history: bool = False,
    seed: int | None = None,
    executor: Executor | None = None,
) -> xr.Dataset | list[xr.Dataset] | dict[Any, xr.Dataset]:
    """Filter means, quantiles, log-likelihood and ESS at given parameters, as a Dataset.

    With proposal="twisted" the particles know what comes later: their sum of log-likelihood
    increments is worth most, while few of them tell the moments at single rows. "auto" leaves it
    out here. With a Rao-Blackwellised one ("marginal", ...) means and covariances of the states
    that are integrated out are exact given the particles of the others.

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model, {} where it has none.
    particles : number N of particles.
    repeats : number of independent filters.
    proposal, resampling, ess_threshold, rescue : as in `log_likelihood`.
    quantiles : levels of the quantiles of states and predictions.
    history : whether the result holds every particle with its weight and its ancestor, which
        `plot_ancestry` draws: T N (D + 2) numbers for each of the repeats. "auto" then leaves the
        Rao-Blackwellised proposals out.
    seed : the same seed gives the same numbers, whatever the executor; None: a random one.
    executor : any `concurrent.futures.Executor`; None: threads.

    Returns
    -------
    Dataset; of several experiments a list of them, or a dictionary by their labels
        Dims `draw` (one per repeat) and `time`. Variables, for states x and channels y:

        * ``x``, ``x_sd``: filter means E[x_t given y_1:t] and standard deviations,
          (draw, time, ...);
        * ``x_quantile``: filter quantiles, last dim `quantile`;
        * ``covariance``: of the stacked state components, ``(draw, time, state, state_)``;
        * ``y_predicted``, ``y_predicted_sd``: moments of y_t given y_1:t-1;
        * ``y_predicted_quantile``: quantiles of the same, last dim `quantile`, from one y_t drawn
          of each particle that is predicted: of counts whole numbers, of few particles as rough as
          any quantiles of so many draws; NaN where a distribution is not defined;
        * ``y_pit``: P(Y_t <= y_t given y_1:t-1), randomised for discrete channels; NaN where
          missing or undefined;
        * ``ess``: effective sample size (Kong, Liu and Wong 1994);
        * ``log_likelihood_increment``: log p(y_t given y_1:t-1);
        * ``y_observed``, and ``u_input`` of inputs u: the data, (time, ...);
        * with `history`: ``x_particles`` (draw, time, ..., particle), ``particle_weight`` and
          ``particle_ancestor`` (draw, time, particle), the index from 0 of the particle of the row
          before that each one comes from; of the first row its own.

    Raises
    ------
    SamplingError : all weights vanish at some step, with `rescue` those of all that were drawn;
        names the step, the row and the parameters.

    A row at which the effective sample size is below 3 is warned of.
    """
    check_executor(executor)
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters)
    check_count("repeats", repeats, 1)
    chosen = proposal == "auto"
    if chosen:
        temper = not history and tempers(resampling, ess_threshold, rescue)
        proposal = choose_by_pilot(
            problem, theta, exact=False, integrate=not history, temper=temper
        ).name
    if history and is_marginal(proposal):
        raise ArgumentError(
            f'history=True with proposal="{proposal}", whose particles are of some states only',
            fix='use proposal="auto", which then takes one with particles of all states',
        )
    settings = resolve_settings(
        problem, theta, particles, proposal, resampling, ess_threshold, rescue, integrate=True
    )
    if settings.proposal in EXACT:
        exact = {"kalman": "call ssm.kalman_filter", "forward": "call ssm.forward_filter"}
        # every particle has the same states; quantiles of predictions are of draws from each
        otherwise = 'use proposal="bootstrap"'
        raise ArgumentError(
            f'particle_filter with proposal="{settings.proposal}"',
            fix=f"{exact.get(settings.proposal, otherwise)} instead",
        )
    if history:
        rows, d = problem.rows, len(problem.trace.state_symbols)
        check_room(
            f"history=True of {rows} rows with particles={particles}, repeats={repeats}",
            rows * particles * repeats * (d + 2), "give fewer particles, or history=False",
        )  # fmt: skip
    levels = quantile_levels(quantiles)
    root = seed_sequence(seed)

    task = partial(_one_run, problem, theta, settings, levels, root, history)
    runs = run_tasks(task, list(range(repeats)), executor=executor)
    warned = _degeneracy(problem, runs, particles, chosen)
    attrs = warned | {
        **model_attributes(problem.trace), "particles": particles, "proposal": settings.proposal,
        "resampling": "multinomial" if rescue else resampling, "ess_threshold": ess_threshold,
        "rescue": rescue, "seed": str(root.entropy),
    }  # fmt: skip
    datasets = [
        filter_dataset(problem, e, [run[i] for run in runs], levels, attrs, root)
        for i, e in enumerate(problem.experiments)
    ]
    return by_experiment(problem.experiments, datasets)


def _one_run(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, levels: np.ndarray,
    root: np.random.SeedSequence, history: bool, repeat: int,
) -> list[FilterRun]:  # fmt: skip
    """One run over every experiment; a function that another process can be sent."""
    run = marginal_run if is_marginal(settings.proposal) else partial(full_run, history=history)
    streams = [(random_state(root, repeat, i), random_state(root, repeat, i, 0))
               for i in range(len(problem.experiments))]  # fmt: skip
    return [
        run(problem, e, theta, settings, rng, levels, apart)
        for e, (rng, apart) in zip(problem.experiments, streams, strict=True)
    ]


def _degeneracy(
    problem: Problem, runs: list[list[FilterRun]], particles: int, chosen: bool
) -> dict[str, Any]:
    """What goes to the attributes: nothing, or the warning of a row that next to no particle
    reaches, which is also given.

    chosen : whether the proposal was chosen for the model.
    """
    ess = [np.concatenate([run[i].ess for i in range(len(problem.experiments))]) for run in runs]
    least = np.min(ess, axis=0)
    bad = np.flatnonzero(least < FEW)
    if particles < MANY or not len(bad):
        return {}
    worst, which = int(bad[np.argmin(least[bad])]), 0
    row = worst
    while row >= problem.experiments[which].steps:
        row, which = row - problem.experiments[which].steps, which + 1
    e = problem.experiments[which]
    label = "" if e.time is None else f" (time {label_text(e.time[row])})"
    where = f" of experiment {which + 1}" if len(problem.experiments) > 1 else ""
    others = f", and below {FEW:.0f} at {len(bad) - 1} other rows" if len(bad) > 1 else ""
    fix = "Use more particles" if chosen else 'Use more particles, or proposal="auto"'
    text = (
        f"particle degeneracy at t={row + 1}{label}{where}: an effective sample size of "
        f"{least[worst]:.1f} of {particles} particles{others}; the moments and quantiles there are "
        f"those of next to no particles, and the log-likelihood varies much. {fix}"
    )
    warn(text)
    return {"filter_warning": text}


def filter_dataset(
    problem: Problem, experiment: Experiment, runs: list[FilterRun], levels: np.ndarray,
    attrs: dict[str, Any], root: np.random.SeedSequence,
) -> xr.Dataset:  # fmt: skip
    """The results of the runs (one per draw) for one experiment: the variables of
    `particle_filter`.

    root : of the random numbers by which PIT values of discrete channels are spread.
    """
    trace = problem.trace
    mean = np.stack([r.mean for r in runs])
    covariance = np.stack([r.covariance for r in runs])
    variables: dict[str, np.ndarray] = dict(unpack_states(trace, mean))
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=2, axis2=3), 0.0))
    dims = {"covariance": ["time", "state", "state_"]}
    for name, values in unpack_states(trace, sd).items():
        variables[f"{name}_sd"] = values
        dims[f"{name}_sd"] = ["time", *component_dims(name, values, 2)]
    variables["covariance"] = covariance
    coords: dict[str, Any] = {"state": [trace.label(s) for s in trace.state_symbols]}
    coords["state_"] = coords["state"]
    if len(levels):
        coords["quantile"] = levels
        for suffix, named, arrays in (
            ("quantile", unpack_states, [r.quantiles for r in runs]),
            ("predicted_quantile", unpack_observations, [r.predicted_quantiles for r in runs]),
        ):
            by_level = [named(trace, q) for q in np.moveaxis(np.stack(arrays), 2, 0)]
            for name, values in by_level[0].items():
                variables[f"{name}_{suffix}"] = np.stack([q[name] for q in by_level], axis=-1)
                own = component_dims(name, values, 2)
                dims[f"{name}_{suffix}"] = ["time", *own, "quantile"]
    prediction = np.stack([r.prediction for r in runs])
    for (name, what), values in _predictions(problem, experiment, prediction, root).items():
        variables[f"{name}_{what}"] = values
        dims[f"{name}_{what}"] = ["time", *component_dims(name, values, 2)]
    variables["ess"] = np.stack([r.ess for r in runs])
    variables["log_likelihood_increment"] = np.stack([r.log_increments for r in runs])
    histories = [r.history for r in runs if r.history is not None]
    if histories:
        particles, weights, ancestors = (np.stack(h) for h in zip(*histories, strict=True))
        for name, values in unpack_states(trace, np.moveaxis(particles, 3, 0)).items():
            variables[f"{name}_particles"] = np.moveaxis(values, 0, -1)
            own = component_dims(name, values, 3)
            dims[f"{name}_particles"] = ["time", *own, "particle"]
        variables |= {"particle_weight": weights, "particle_ancestor": ancestors}
        dims |= {n: ["time", "particle"] for n in ("particle_weight", "particle_ancestor")}
    attrs = {**attrs, "observes": observes(trace)}
    out = to_dataset(
        variables, time=experiment.time, dims=dims,
        coords={**trace.component_names.coords, **coords},
        renamed=trace.component_names.renamed, attrs=attrs,
    )  # fmt: skip
    return with_data(out, trace, experiment)


def _predictions(
    problem: Problem, experiment: Experiment, prediction: np.ndarray, root: np.random.SeedSequence
) -> dict[tuple[str, str], np.ndarray]:
    """Predictive moments and PIT values by channel and by what they are, from (draw, T, 4, K)."""
    trace = problem.trace
    rng = np.random.default_rng(
        np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, 2**31))
    )
    below, strictly = prediction[:, :, 2], prediction[:, :, 3]
    # randomised PIT (Czado, Gneiting and Held 2009): uniform between P(Y < y) and P(Y <= y)
    pit = strictly + rng.uniform(size=below.shape) * (below - strictly)
    pit = np.where(experiment.seen > 0, pit, np.nan)
    variance = np.maximum(prediction[:, :, 1], 0.0)  # rounding can leave it below
    parts = {"predicted": prediction[:, :, 0], "predicted_sd": np.sqrt(variance), "pit": pit}
    return {
        (name, what): values
        for what, array in parts.items()
        for name, values in unpack_observations(trace, array).items()
    }


def quantile_levels(quantiles: Iterable[float] | float) -> np.ndarray:
    """Levels in increasing order, checked; a number is one level.

    Raises
    ------
    ArgumentError : some level is not between 0 and 1.
    """
    given: Any = [quantiles] if isinstance(quantiles, numbers.Real) else quantiles
    try:
        entries: list[Any] = list(given)
    except TypeError:
        entries = [given]
    if isinstance(given, str) or not all(isinstance(v, numbers.Real) for v in entries) or not all(
        0 < v < 1 for v in entries
    ):  # fmt: skip
        raise ArgumentError(
            f"quantiles={quantiles!r}", fix="give levels between 0 and 1: quantiles=(0.05, 0.95)"
        )
    return np.array(sorted(map(float, entries)))


@checked
def kalman_filter(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    *,
    proposal: str = "auto",
    quantiles: tuple[float, ...] = LEVELS,
) -> xr.Dataset | list[xr.Dataset] | dict[Any, xr.Dataset]:
    """Run the exact filter of a linear Gaussian model (Kalman 1960), or an approximate one.

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model, {} where it has none.
    proposal : "kalman", exact, for linear Gaussian models, which "auto" takes unless the model
        calls a simulator: then "extended". Or, where states are driven by Gaussian
        noise, one of the approximations "extended" (the update is the mode of each row),
        "unscented" (Julier and Uhlmann 1997) and "laplace" (the distribution round the mode of all
        states given the data up to each row, whose cost grows with the square of the rows).
    quantiles : levels of the quantiles of states and predictions.

    Returns
    -------
    Dataset; of several experiments a list of them, or a dictionary by their labels
        As of `particle_filter`, with one `draw` and without `ess`. Everything is exact with
        "kalman"; else all distributions are Gaussian approximations, and the attribute
        `approximate` is 1.

    Raises
    ------
    ArgumentError : the model is not linear and Gaussian, or has no such approximation; gives the
        reason and the user's line.
    SamplingError : an approximation is not finite.
    """
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters)
    levels = quantile_levels(quantiles)
    if proposal == "auto":
        proposal = "extended" if simulators(problem.trace) else "kalman"
    attrs: dict[str, Any] = model_attributes(problem.trace) | {"proposal": proposal}
    if proposal in APPROXIMATE:
        attrs["approximate"] = 1
        run_filter = ApproximateKalman(
            problem, approximation_of(problem, proposal, "use ssm.particle_filter"), proposal
        ).filter
    else:
        if proposal != "kalman":
            raise ArgumentError(
                f"kalman_filter with proposal={proposal!r}",
                fix="use one of: "
                + ", ".join(("kalman", *APPROXIMATE))
                + "; the others are of ssm.particle_filter",
            )
        found = kalman.kalman_model(problem.trace)
        if isinstance(found, NotApplicable):
            others = ", ".join(APPROXIMATE)
            raise ArgumentError(
                f'proposal="kalman" needs a linear Gaussian model: {found.reason}',
                fix=f"use one of the approximations, {others}, or ssm.particle_filter",
                where=found.where,
            )
        run_filter = partial(kalman.kalman_filter, problem.trace)
    root = np.random.SeedSequence(0)  # no channel is discrete, so nothing is randomised
    datasets = []
    for e in problem.experiments:
        run = _as_run(run_filter(e, theta), e, levels)
        datasets.append(filter_dataset(problem, e, [run], levels, attrs, root).drop_vars("ess"))
    return by_experiment(problem.experiments, datasets)


def _as_run(exact: kalman.KalmanMoments, e: Experiment, levels: np.ndarray) -> FilterRun:
    """Exact moments in the form of a particle filter's."""
    variance = np.diagonal(exact.observation_covariance, axis1=1, axis2=2)
    quantiles = [
        normal_quantiles(mean, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), levels)
        for mean, covariance in (
            (exact.mean, exact.covariance),
            (exact.observation_mean, exact.observation_covariance),
        )
    ]
    with np.errstate(divide="ignore", invalid="ignore"):  # predicted exactly, or not seen
        below = ndtr((e.y - exact.observation_mean) / np.sqrt(variance))
    prediction = np.stack([exact.observation_mean, variance, below, below], axis=1)
    return FilterRun(
        exact.log_increments, np.full(e.steps, np.nan), exact.mean, exact.covariance,
        quantiles[0], prediction, quantiles[1],
    )  # fmt: skip


def normal_quantiles(mean: np.ndarray, sd: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """(T, P, ...) at the levels (P,), by means and standard deviations (T, ...)."""
    with np.errstate(invalid="ignore"):  # nothing is known yet of a flat component
        found: np.ndarray = mean[:, None, :] + ndtri(levels)[None, :, None] * sd[:, None, :]
    return found


@checked
def forward_filter(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    *,
    quantiles: tuple[float, ...] = LEVELS,
    seed: int | None = None,
) -> xr.Dataset | list[xr.Dataset] | dict[Any, xr.Dataset]:
    """Run the exact filter of a model whose states take finitely many values.

    The forward algorithm (Rabiner 1989, section III.A), scaled at every step.

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model, {} where it has none.
    quantiles : levels of the quantiles of states and predictions.
    seed : for the PIT values of discrete channels, which are spread uniformly over their jump.

    Returns
    -------
    Dataset; of several experiments a list of them, or a dictionary by their labels
        As of `particle_filter`, with one `draw` and without `ess`, everything exact; and for each
        state x ``x_probability``: P(x_t = value given y_1:t), last dim `x_value`, whose coordinate
        holds the values. ``y_predicted_quantile`` inverts the distribution function of the mixture;
        it is NaN for Wishart distributions, whose components have none in closed form, and for
        distributions of your own without `@distribution.quantile`.

    Raises
    ------
    ArgumentError : some state takes more values; gives the reason and the user's line.
    SamplingError : no value is possible at some row; names the row and the parameters.
    """
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters)
    resolve_settings(problem, theta, 1, "forward")
    exact = hidden_markov(problem.trace)
    assert isinstance(exact, HiddenMarkov)
    levels, root = quantile_levels(quantiles), seed_sequence(seed)
    attrs = model_attributes(problem.trace) | {"proposal": "forward", "seed": str(root.entropy)}
    datasets = []
    each = exact.filter_each(problem.experiments, theta)
    laws = [f.predicted for f in each]
    predictions = exact.predicted_observations(problem.experiments, theta, laws)
    inverted = exact.predicted_quantiles(problem.experiments, theta, laws, levels)
    for e, found, prediction, q in zip(
        problem.experiments, each, predictions, inverted, strict=True
    ):
        law = found.filtered
        mean, covariance, _ = exact.moments(law)
        run = FilterRun(
            found.log_increments, np.full(e.steps, np.nan), mean, covariance,
            exact.quantiles(law, levels), prediction, q,
        )  # fmt: skip
        dataset = filter_dataset(problem, e, [run], levels, attrs, root).drop_vars("ess")
        datasets.append(dataset.assign(probabilities(exact, law, dataset)))
    return by_experiment(problem.experiments, datasets)
