"""The verb `leave_future_out`: how well a model predicts the next row, its parameters known from
the rows before it only.

P.-C. Bürkner, J. Gabry and A. Vehtari (2020), "Approximate leave-future-out cross-validation for
Bayesian time series models", *J. Statistical Computation and Simulation* 90, in its forward form:
draws of p(theta | y_{1:L}) serve the rows after L too, weighted by

    w_t(theta) = p(y_{L+1:t} | y_{1:L}, theta),

smoothed by a generalised Pareto distribution (Vehtari, Simpson, Gelman, Yao and Gabry 2024); where
its shape says that the weights can no longer be trusted, the model is sampled anew given the rows
so far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import logsumexp

from ssmppl.arguments import checked
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, OK
from ssmppl.counts import check_count, check_number
from ssmppl.data import Experiment
from ssmppl.data.experiments import EXPERIMENT
from ssmppl.data.notices import noticed
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.methods.methods import Method
from ssmppl.inference.particles.filtering import FilterSettings, failure
from ssmppl.inference.preparation.exact_models import exact_model
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.labels import Labels, model_attributes
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.inference.verbs.predict import all_draws, parameters_of, posterior_of
from ssmppl.inference.verbs.sample import sample
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace
from ssmppl.results import arviz, to_dataset

if TYPE_CHECKING:
    import xarray as xr

TASKS = 16  # pieces that the draws are cut into
TIED = 1e-9  # difference of log weights that is rounding
THRESHOLD = 0.7  # of the Pareto shape: beyond it the weights' errors are no longer known


@checked
def leave_future_out(
    model: Model,
    data: Any,
    *,
    first: int | None = None,
    method: Method | None = None,
    draws: int = 500,
    warmup: int = 500,
    chains: int = 4,
    threshold: float = THRESHOLD,
    particles: int = 1000,
    start: Mapping[str, Any] | None = None,
    fixed: Mapping[str, Any] | None = None,
    seed: int | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Log predictive densities log p(y_t | y_{1:t-1}) with the parameters integrated out.

    Models of the same data are compared by their sums over the same rows. Unlike leave-one-out
    scores of the rows (`az.loo`), nothing after a row tells of it.

    Parameters
    ----------
    model : the model, as declared.
    data : as of `sample`. Several experiments go on together, by the labels of their rows where all
        have dates, or all numbers, else row by row: a row is predicted from all rows of all of them
        with an earlier label.
    first : the first row that is predicted, from 2, of several experiments among all their labels;
        None: a quarter of them after the first.
    method, draws, warmup, chains : of `sample`, each time that it is called.
    threshold : Pareto shape beyond which the model is sampled anew.
    particles : of the filters that give the predictive densities of each draw, where there is no
        exact one.
    start, fixed : as in `sample`.
    seed : the same seed gives the same numbers, whatever the executor.
    executor : any `concurrent.futures.Executor`; None: threads.
    progress : whether `sample` shows its progress, on stderr.

    Returns
    -------
    Dataset over `time` (the predicted rows), of several experiments over `experiment` and `time`
        `elpd`: log p(y_t | y_{1:t-1}), of each experiment's row by itself, NaN where nothing was
        measured; `mc_error`: its Monte Carlo standard error, by the spread of the weighted draws
        and the effective number of those of the parameter that mixes worst; `pareto_shape`;
        `sampled_anew`: whether the draws for this row are new ones. Attributes: `elpd`, the sum;
        `standard_error`, of the sum, from its spread over the rows; `refits`, how often `sample`
        was called.

    Raises
    ------
    ModelError, DataError, ArgumentError, SamplingError : what is wrong, where, and the fix.
    KeyboardInterrupt : Ctrl-C, while it samples too; nothing is kept.
    """
    check_executor(executor)
    check_number("threshold", threshold, lambda v: True, "give a number, as 0.7", infinite=True)
    problem = pose(model, data, noting=True)
    check_count("particles", particles, 1)
    if set(problem.trace.parameters) <= set(fixed or {}):
        raise ArgumentError(
            "no parameter is free, so that there is nothing to integrate out",
            fix="take the log-likelihood increments of ssm.particle_filter, or of "
            "ssm.kalman_filter or ssm.forward_filter where they are exact",
        )
    experiments, together = problem.experiments, _together(problem.experiments)
    steps = len(together.labels)
    begin = max(2, steps // 4 + 1) if first is None else first
    check_count("first", begin, 2)
    if begin > steps:
        raise ArgumentError(
            f"first={begin}, and the data have {steps} rows",
            fix="give a row of the data that leaves enough before it to learn from",
        )
    root = seed_sequence(seed)
    seeds = np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, 1))
    settings: dict[str, Any] = {
        "draws": draws, "warmup": warmup, "chains": chains, "method": method, "start": start,
        "fixed": fixed, "executor": executor, "progress": progress, "states": False,
    }  # fmt: skip
    elpd, error = (np.full((len(experiments), steps), np.nan) for _ in range(2))
    shapes, anew = np.empty(steps), np.zeros(steps, dtype=bool)
    refits, increments, efficiency = 0, list[np.ndarray](), 1.0
    since = begin - 1  # the rows that the draws know
    for t in range(begin - 1, steps):
        fresh = refits == 0
        if not fresh:
            passed = [
                own[:, before[since] : before[t]].sum(axis=1)
                for own, before in zip(increments, together.before, strict=True)
            ]
            log_w, shape = _smoothed(np.sum(passed, axis=0))
            fresh = not shape <= threshold  # NaN is none to trust
        if fresh:
            with noticed():  # of the rows before t a channel may have none
                known = _known(problem.trace, experiments, [int(b[t]) for b in together.before])
                idata = sample(model, known, seed=_number(seeds, refits), **settings)
            posterior = posterior_of(idata)
            if posterior.attrs["interrupted"]:  # a part of its draws, where nobody asked for it
                raise KeyboardInterrupt
            theta, efficiency = parameters_of(problem.trace, posterior), _efficiency(posterior)
            stream = np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, 2, refits))
            increments = _increments(problem, theta, particles, stream, executor)
            since, refits, shape = t, refits + 1, -np.inf
            log_w = np.zeros(theta.shape[0] * theta.shape[1])
        shapes[t], anew[t] = float(shape), fresh
        for i, (e, before) in enumerate(zip(experiments, together.before, strict=True)):
            row = before[t]
            if before[t + 1] > row and e.seen[row].any():
                elpd[i, t], error[i, t] = _density(log_w, increments[i][:, row], efficiency)
    elpd, error, shapes, anew = (v[..., begin - 1 :] for v in (elpd, error, shapes, anew))
    measured = np.isfinite(elpd) | np.isneginf(elpd)
    n = int(measured.sum())
    with np.errstate(invalid="ignore"):  # NaN where a row was impossible to every draw
        spread = float(np.sqrt(n * np.var(elpd[measured], ddof=1))) if n > 1 else float("nan")
    labels = Labels(problem.trace, experiments)
    several = {n: [EXPERIMENT, "time"] for n in ("elpd", "mc_error")} if labels.several else {}
    return to_dataset(
        {
            "elpd": elpd if labels.several else elpd[0],
            "mc_error": error if labels.several else error[0],
            "pareto_shape": shapes,
            "sampled_anew": anew,
        },
        sample_dim=None,
        dims=several,
        coords=labels.coords,
        time=together.labels[begin - 1 :],
        attrs={
            **model_attributes(problem.trace), "elpd": float(elpd[measured].sum()),
            "standard_error": spread, "refits": refits, "threshold": threshold,
            "seed": str(root.entropy),
        },
    )  # fmt: skip


@dataclass(frozen=True)
class _Together:
    """Experiments side by side. labels : (L,) of all their rows, in order. before : of each, how
    many of its rows have an earlier label, (L + 1,)."""

    labels: np.ndarray
    before: list[np.ndarray]


def _together(experiments: Sequence[Experiment]) -> _Together:
    times = [e.time for e in experiments]
    kinds = {"" if t is None else "M" if t.dtype.kind == "M" else t.dtype.kind for t in times}
    kinds = {"number" if k and k in "iuf" else k for k in kinds}
    if len(experiments) > 1 and (len(kinds) > 1 or not kinds <= {"number", "M", "m"}):
        times = [None] * len(experiments)
    own = [
        np.arange(1, e.steps + 1) if t is None else t
        for e, t in zip(experiments, times, strict=True)
    ]
    if len(experiments) == 1:
        return _Together(own[0], [np.arange(len(own[0]) + 1)])
    labels = np.unique(np.concatenate(own))
    return _Together(labels, [np.append(np.searchsorted(t, labels), len(t)) for t in own])


def _density(log_w: np.ndarray, increment: np.ndarray, efficiency: float) -> tuple[float, float]:
    """Log of the weighted mean of p(y_t | y_{1:t-1}, theta), and its Monte Carlo error."""
    top = increment.max()
    if top == -np.inf:
        return -np.inf, np.nan
    w, p = np.exp(log_w - log_w.max()), np.exp(increment - top)
    w /= w.sum()
    mean = float(w @ p)
    error = float(np.sqrt(np.sum(w**2 * (p - mean) ** 2) / efficiency)) / mean
    return float(np.log(mean) + top), error


def _smoothed(log_w: np.ndarray) -> tuple[np.ndarray, float]:
    """Normalised log weights, their tail smoothed, and the shape of the Pareto distribution that
    did it."""
    top, n = log_w.max(), len(log_w)
    if not np.isfinite(top):
        return log_w, np.inf
    tail = min(int(np.ceil(min(n / 5.0, 3.0 * np.sqrt(n)))), n - 1)  # draws, as of psislw
    if np.partition(log_w, n - 1 - tail)[n - 1 - tail] > top - TIED:
        # As after rows without data: so many have the greatest weight that there is no tail, and
        # psislw, with none beyond its cut, would say that nothing can be trusted.
        return log_w - logsumexp(log_w), -np.inf
    if hasattr(arviz(), "psislw"):
        smoothed, shape = arviz().psislw(log_w)
    else:  # ArviZ 1.x
        smoothed, shape = import_module("arviz_stats.base").array_stats.psislw(log_w)
    return np.asarray(smoothed), float(shape)


def _efficiency(posterior: Any) -> float:
    """Effective draws of the parameter that mixes worst, as a share of the draws; 1 at most."""
    total = posterior.sizes["chain"] * posterior.sizes["draw"]
    found = arviz().ess(posterior, method="mean")
    least = min((float(found[n].min()) for n in found.data_vars), default=float(total))
    return min(1.0, least / total) if np.isfinite(least) else 1.0


def _known(trace: Trace, experiments: Sequence[Experiment], rows: Sequence[int]) -> Any:
    """So many first rows of each as `sample` takes them: those that have any, by label."""
    own = bool(trace.experiments)
    parts = [(e.label, _until(e, n)) for e, n in zip(experiments, rows, strict=True) if n or own]
    labelled = all(label is not None for label, _ in parts)
    return dict(parts) if labelled else [part for _, part in parts]


def _until(whole: Experiment, rows: int) -> dict[str, np.ndarray]:
    """The first rows as `sample` takes them; of an experiment that has none yet, but parameters of
    its own, the first one without what was measured."""
    if not rows:
        nothing = {n: np.full_like(v[:1], np.nan) for n, v in whole.observed.items()}
        return nothing | {n: v[:1] for n, v in whole.inputs.items()}
    return {n: v[:rows] for n, v in (whole.observed | whole.inputs).items()}


def _number(seeds: np.random.SeedSequence, refit: int) -> int:
    own = np.random.SeedSequence(seeds.entropy, spawn_key=(*seeds.spawn_key, refit))
    return int(own.generate_state(1, np.uint64)[0])


def _increments(
    problem: Problem, theta: np.ndarray, particles: int, root: np.random.SeedSequence,
    executor: Executor | None,
) -> list[np.ndarray]:  # fmt: skip
    """(S, T) log p(y_t | y_{1:t-1}, theta) of each draw, chains one after the other, of each
    experiment."""
    flat = all_draws(theta)
    settings = None
    if isinstance(exact_model(problem.trace), NotApplicable):
        middle = np.median(flat, axis=0)
        chosen = choose_by_pilot(problem, middle, exact=False, integrate=True, temper=True).name
        settings = FilterSettings(particles, chosen)
    pieces = [p for p in np.array_split(np.arange(len(flat)), TASKS) if len(p)]
    task = partial(_some_increments, problem, flat, settings, root)
    found = run_tasks(task, pieces, executor=executor)
    return [np.concatenate(own) for own in zip(*found, strict=True)]


def _some_increments(
    problem: Problem, theta: np.ndarray, settings: FilterSettings | None,
    root: np.random.SeedSequence, which: np.ndarray,
) -> list[np.ndarray]:  # fmt: skip
    """Increments of some of the draws; a function that another process can be sent."""
    return [
        _of_experiment(problem, i, theta, settings, root, which)
        for i in range(len(problem.experiments))
    ]


def _of_experiment(
    problem: Problem, i: int, theta: np.ndarray, settings: FilterSettings | None,
    root: np.random.SeedSequence, which: np.ndarray,
) -> np.ndarray:  # fmt: skip
    e = problem.experiments[i]
    out = np.full((len(which), e.steps), -np.inf)
    model = exact_model(problem.trace)
    for row, s in zip(out, which, strict=True):
        if settings is None:
            assert not isinstance(model, NotApplicable)
            try:
                row[:] = model.filter(e, theta[s]).log_increments
            except SamplingError:
                continue
            continue
        ess = np.empty(e.steps)
        status, t = problem.program.entry(f"filter_{settings.proposal}")(
            theta[s], e.y, e.seen, e.u, settings.particles, None, 1.0,
            random_state(root, int(s), *((i,) if i else ())), row, ess, None,
        )  # fmt: skip
        if status not in (OK, ALL_ZERO):
            raise failure(problem, theta[s], status, t, e)
    return out
