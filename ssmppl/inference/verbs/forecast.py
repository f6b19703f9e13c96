"""The verb `forecast`: what comes after the data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.arguments import checked
from ssmppl.codegen.modules.program import Program, compile_trace
from ssmppl.counts import check_room
from ssmppl.data import (
    bind_inputs,
    check_defined,
    check_parameters,
    unpack_observations,
    unpack_parameters,
    unpack_states,
)
from ssmppl.data.experiments import EXPERIMENT, TIMES, experiments_of
from ssmppl.data.parameters import pack, pack_states
from ssmppl.data.per_experiment import number_of, trace_of_results, trace_over
from ssmppl.data.time_steps import lengths
from ssmppl.data.times import label_text, spacing, trading_days
from ssmppl.errors import ArgumentError, listing, warn
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.inference.maximum.estimate import Estimate
from ssmppl.inference.run.labels import TIME_ZONES, as_list, model_attributes, observes, zone_of
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.verbs.predict import all_draws, group, parameters_of, posterior_of, states_of
from ssmppl.inference.verbs.simulate import check_finite, check_samplers, feeds_back
from ssmppl.inference.verbs.smooth import smooth
from ssmppl.language.distributions import MvNormal
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import EXPERIMENT_NUMBER, Trace
from ssmppl.results import to_dataset

if TYPE_CHECKING:
    import xarray as xr


KNOWN = (
    "give what ssm.sample returns; or, at known parameters, these and the data: "
    "ssm.forecast(model, estimate.parameters, steps, data=data)"
)
DRAWS = 1000


@checked
def forecast(
    model: Model,
    idata: Any,
    steps: int | None = None,
    inputs: Any = None,
    *,
    data: Any = None,
    proposal: str | None = None,
    draws: int | None = None,
    experiment: Any = None,
    seed: int | None = None,
) -> xr.Dataset:
    """Draws of the states and observations after the last row of the data.

    Each posterior draw of the parameters and of x_T is continued by the model's distributions: one
    draw of p(x_{T+1:T+H}, y_{T+1:T+H} | y_{1:T}) each. At known parameters x_T is drawn by
    `smooth`.

    Parameters
    ----------
    model : the model that was sampled.
    idata : what `sample` returned, with its states; or, beside `data`, values of the parameters: a
        mapping, or what `maximize` returned.
    steps : number H of rows; may be left out where `inputs` tell it.
    inputs : the inputs of the rows T+1, ..., T+H: mapping of arrays, DataFrame or Dataset. The step
        into the first of them is driven by the data's last input.
    data : what the forecast goes on from, at known parameters: as of `smooth`.
    proposal, draws : at known parameters, how x_T is drawn, as of `smooth`, where "laplace",
        "extended" and "unscented" are approximations, then told by the attribute `approximate`
        (None: exactly where that can be, else by particles); and how often (None: 1000).
    experiment : which one is continued, where several were sampled: its label, or its number from 1
        where it has none. None: all, and `inputs` may be a dictionary by their labels.
    seed : the same seed gives the same draws.

    Returns
    -------
    Dataset
        States and observations (draw, time, ...) and parameters (draw, ...); all chains one after
        the other; of several experiments (draw, experiment, time, ...), with the coordinate `after`
        (experiment), the rows that were before, and `times` where their labels differ. Its time
        goes on from the data's where that is evenly spaced; where the data's dates had a time zone,
        days and months are those of that zone. All dates are in UTC.

    Raises
    ------
    ModelError, DataError, ArgumentError, SamplingError : what is wrong, where, and the fix; inputs
        with labels of the data's rows among them.
    """
    if data is None and (proposal is not None or draws is not None):
        raise ArgumentError(
            "proposal= and draws= are of a forecast at known parameters, which needs the data",
            fix="give data=, and values of the parameters in place of the posterior",
        )
    if data is None:
        traced = trace_of_results(model, posterior_of(idata, KNOWN))
    else:
        traced = trace_over(model, data)
    check_samplers(traced)
    if data is None:
        labels, one = _sampled(traced, idata)
    else:
        labels, one = _at_known(model, idata, data, proposal, draws, seed)
    root = seed_sequence(seed)
    if experiment is not None or not labels:
        which = _one_of(labels, experiment, "posterior is" if data is None else "data are")
        return _ahead(
            traced, one(which), inputs, steps, root, 1 if experiment is None else experiment
        )
    found = []
    for i, own in enumerate(_inputs_of_each(inputs, labels)):
        stream = np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, i))
        found.append(_ahead(traced, one(i), own, steps, stream, labels[i]))
    return _side_by_side(found, labels, str(root.entropy))


def _ahead(
    traced: Trace, past: _Past, inputs: Any, steps: int | None, root: np.random.SeedSequence,
    experiment: Any,
) -> xr.Dataset:  # fmt: skip
    """The rows after those of one experiment."""
    if inputs is None and steps and _needs_times_only(traced):
        inputs = _times_after(past, steps)
    future, steps, source = bind_inputs(traced, inputs, steps, _number(traced, past.u))
    labels = source.time
    theta, paths, zone = past.theta, past.paths, past.zone
    rows = paths.shape[1]
    d, k = paths.shape[2], len(traced.observation_symbols)
    check_room(
        f"{len(paths)} draws of {steps} rows", len(paths) * steps * (d + k), "ask for fewer rows"
    )
    u = np.concatenate([past.u, future])
    _check_after(past.time, labels)  # before a time step between them is made of it
    if labels is not None and traced.time_step is None:
        _say_gap(past, labels)
    _set_step_between(traced, u, past.time, labels)
    check_defined(traced, source, u, after=rows)
    feedback = feeds_back(traced)
    y = np.concatenate([past.y if feedback else np.zeros((rows, k)), np.zeros((steps, k))])
    program = compile_trace(traced, Missing(none=True))
    states, observed = _continued(program, theta, paths, y, u, feedback, root)
    check_finite(traced, states, observed)
    if labels is None:
        labels = after(past.time, steps, zone)
    over_time = unpack_states(traced, states, started=False) | unpack_observations(traced, observed)
    return to_dataset(
        over_time | unpack_parameters(traced, theta),
        over_time=set(over_time),
        time=labels,
        coords=traced.component_names.coords,
        renamed=traced.component_names.renamed,
        attrs={
            **model_attributes(traced),
            "seed": str(root.entropy),
            "after": int(rows),
            "experiment": experiment,
            "observes": observes(traced),
        }
        | ({TIME_ZONES: {"1": zone}} if zone else {})
        | past.attrs,
    )


def _inputs_of_each(inputs: Any, labels: Sequence[Any]) -> list[Any]:
    """The inputs of each experiment: by label, in their order, or the same for all.

    Raises
    ------
    ArgumentError : some experiment has none.
    """
    if isinstance(inputs, (list, tuple)):
        if len(inputs) != len(labels):
            raise ArgumentError(
                f"inputs are {len(inputs)} data sets, and the experiments are {len(labels)}",
                fix="give one for each, in their order, or a dictionary by label",
            )
        return list(inputs)
    if isinstance(inputs, Mapping) and set(inputs) & set(labels):
        missing = [k for k in labels if k not in inputs]
        if missing:
            raise ArgumentError(
                f"inputs has none for the experiment {missing[0]!r}",
                fix=f"give those of each of {listing('', map(str, labels))}; or one data set, "
                "for all",
            )
        return [inputs[k] for k in labels]
    return [inputs] * len(labels)


def _side_by_side(found: list[xr.Dataset], labels: Sequence[Any], seed: str) -> xr.Dataset:
    """Forecasts of all experiments: states and observations (draw, experiment, time)."""
    import xarray as xr

    times = [one["time"].values for one in found]
    alike = all(np.array_equal(t, times[0]) for t in times)
    own = [str(n) for n, v in found[0].data_vars.items() if "time" in v.dims]
    rows = np.arange(1, len(times[0]) + 1)
    parts = [one[own] if alike else one[own].assign_coords(time=rows) for one in found]
    for one in parts:
        one.attrs = {}
    out = xr.concat(parts, dim=EXPERIMENT).transpose("draw", EXPERIMENT, "time", ...)
    out = out.assign_coords({EXPERIMENT: list(labels)}).assign(found[0].drop_vars([*own, "time"]))
    if not alike:
        kinds = {t.dtype.kind for t in times}
        texts = times if len(kinds) == 1 else [t.astype(str) for t in times]
        out = out.assign_coords({TIMES: ((EXPERIMENT, "time"), np.stack(texts))})
    before = [int(one.attrs["after"]) for one in found]
    out = out.assign_coords({"after": (EXPERIMENT, before)})
    shared = {
        k: v for k, v in found[0].attrs.items() if k not in ("after", "experiment", TIME_ZONES)
    }
    return out.assign_attrs(shared | {"seed": seed})


@dataclass(frozen=True)
class _Past:
    """What a forecast goes on from: T rows, n draws.

    theta (n, P), paths (n, T, D); u (T, U), y (T, K), NaN where missing: of the data. time : labels
    of the rows; zone : that they were given in. attrs : of the result, what the draws are.
    """

    theta: np.ndarray
    paths: np.ndarray
    u: np.ndarray
    y: np.ndarray
    time: np.ndarray
    zone: str
    attrs: dict[str, Any] = field(default_factory=dict)


Continued = tuple[list[Any], Callable[[int], _Past]]  # labels of several, and each of them


def _sampled(traced: Trace, idata: Any) -> Continued:
    """The draws of a posterior, and the data that it holds."""
    posterior = posterior_of(idata, KNOWN)
    labels = posterior[EXPERIMENT].values.tolist() if EXPERIMENT in posterior.dims else []
    every, theta = experiments_of(posterior), parameters_of(traced, posterior)

    def one(i: int) -> _Past:
        own = every[i][1]
        paths = states_of(traced, own)
        if paths is None:
            raise ArgumentError(
                "the posterior holds no trajectories: a forecast starts from the last state",
                fix="sample with states=True",
            )
        paths = all_draws(paths)
        rows = paths.shape[1]
        given = _past(idata, "constant_data", traced.given_inputs, i)
        if traced.experiments:
            number = number_of(traced, labels[i] if labels else traced.experiments[0])
            given[EXPERIMENT_NUMBER] = np.full(rows, float(number))
        columns = [given[n].reshape(rows, -1) for n in traced.inputs]
        y = np.zeros((rows, len(traced.observation_symbols)))
        if feeds_back(traced):
            seen = _past(idata, "observed_data", traced.observations, i)
            y[:] = pack(traced.observations.values(), seen)
        u = np.concatenate([np.zeros((rows, 0)), *columns], axis=1)
        zone = zone_of(posterior.attrs, i)
        return _Past(all_draws(theta), paths, u, y, own["time"].values, zone)

    return labels, one


def _at_known(
    model: Model, parameters: Any, data: Any, proposal: str | None, draws: int | None,
    seed: int | None,
) -> Continued:  # fmt: skip
    """Draws of the states at known parameters, by `smooth`."""
    if isinstance(parameters, Estimate):
        parameters = parameters.parameters
    if not isinstance(parameters, Mapping):
        raise ArgumentError(
            f"data= beside {type(parameters).__name__}, which is no parameters",
            fix="leave data out where a posterior is given; else give {name: value}, or what "
            "ssm.maximize returned",
        )
    problem = pose(model, data)
    several = problem.experiments if len(problem.experiments) > 1 else ()
    labels = [k if e.label is None else e.label for k, e in enumerate(several, start=1)]
    n = DRAWS if draws is None else draws
    found = as_list(
        smooth(model, data, parameters, proposal=proposal, trajectories=n, quantiles=(), seed=seed)
    )

    def one(i: int) -> _Past:
        e, own, trace = problem.experiments[i], found[i], problem.trace
        paths = pack_states(trace, {name: own[name].values for name in trace.states})
        theta = np.tile(check_parameters(trace, parameters), (n, 1))
        time = np.arange(1, e.steps + 1) if e.time is None else e.time
        told = {
            k: own.attrs[k] for k in ("approximate", "method", "method_chosen") if k in own.attrs
        }
        y = np.where(e.seen > 0.0, e.y, np.nan)
        return _Past(theta, paths, e.u, y, time, e.zone, told)

    return labels, one


def _number(traced: Trace, u: np.ndarray) -> float:
    """That of the experiment whose inputs (T, U) these are."""
    names = [s.data[1] for s in traced.input_symbols]
    return float(u[-1, names.index(EXPERIMENT_NUMBER)]) if EXPERIMENT_NUMBER in names else 0.0


def _needs_times_only(traced: Trace) -> bool:
    """Whether the time step is the only input."""
    return traced.time_step is not None and list(traced.given_inputs) == [traced.time_step[0]]


def _times_after(past: _Past, steps: int) -> dict[str, np.ndarray] | None:
    """The times of the rows to come, where those of the data are evenly spaced."""
    if past.time.dtype.kind not in "iufM" or len(past.time) < 2 or spacing(past.time):
        return None
    return {"time": after(past.time, steps, past.zone)}


def _set_step_between(
    traced: Trace, u: np.ndarray, time: np.ndarray, labels: np.ndarray | None
) -> None:
    """The time step of the last row of the data, u (T + H, U): up to the first row to come."""
    if traced.time_step is None or labels is None:
        return
    if time.dtype.kind not in "iufM" or (time.dtype.kind == "M") != (labels.dtype.kind == "M"):
        return
    name, unit = traced.time_step
    column = [s.data[1] for s in traced.input_symbols].index(name)
    u[len(time) - 1, column] = lengths(np.array([time[-1], labels[0]]), unit)[0]


def _check_after(time: np.ndarray, labels: np.ndarray | None) -> None:
    """Labels of the inputs follow those of the data, where both have an order."""
    if labels is None or time.dtype.kind not in "iufM" or labels.dtype.kind not in "iufM":
        return
    if (time.dtype.kind == "M") != (labels.dtype.kind == "M"):
        return
    early = int(np.sum(labels <= time[-1]))
    if early:
        last, first = label_text(time[-1]), label_text(labels[0])
        raise ArgumentError(
            f"inputs begin at {first}, and the data end at {last}: {early} of their {len(labels)} "
            "rows are not after the data",
            fix=f"give the inputs of the rows after {last} only, or without labels",
        )


def _say_gap(past: _Past, labels: np.ndarray) -> None:
    """Warn where the inputs are labelled otherwise than the rows that follow evenly spaced ones: a
    row is a step of the model, whatever it is called."""
    if len(past.time) < 2 or past.time.dtype.kind != labels.dtype.kind or spacing(past.time):
        return
    due = after(past.time, len(labels), past.zone)
    if past.time.dtype.kind == "M":
        same = np.array_equal(due.astype("datetime64[s]"), labels.astype("datetime64[s]"))
    else:
        same = past.time.dtype.kind not in "iuf" or np.allclose(due, labels)
    if not same:
        given, wanted = (f"{label_text(v[0])} to {label_text(v[-1])}" for v in (labels, due))
        warn(
            f"inputs are of {given}, and the rows after the data are {wanted}: they are taken for "
            "these, one row for each step of the model. Give the inputs of all rows after the "
            "data, or the rows in between in the data, with NaN for what was not measured"
        )


def after(time: np.ndarray, steps: int, zone: str = "") -> np.ndarray:
    """Labels of the rows that follow `time`: numbers and dates go on where they are evenly spaced
    (dates also by months and the like), else there are row numbers.

    Days of a market go on without weekends; which holidays are to come is not known.

    zone : that dates, which are in UTC, were given in: steps of whole days and longer are those of
        its calendar.
    """
    count = np.arange(1, steps + 1)
    if np.issubdtype(time.dtype, np.datetime64):
        import pandas as pd

        if zone and len(time) > 2 and (found := _by_calendar(time, steps, zone)) is not None:
            return found
        regular = pd.DatetimeIndex(time, freq="infer").freq if len(time) > 2 else None
        if regular is not None:
            return np.asarray(pd.date_range(time[-1], periods=steps + 1, freq=regular)[1:])
        if trading_days(time):
            days = time.astype("datetime64[D]")
            following = np.busday_offset(days[-1], count, roll="forward")
            return np.asarray(following + (time[-1] - days[-1]))
        if len(time) > 2:
            warn(
                "the dates of the data are not evenly spaced, so that the rows of the forecast are "
                f"numbered on from {len(time) + 1}. Where a row is absent from the data, give it, "
                "with NaN for what was not measured: each row is one step of the model"
            )
    elif np.issubdtype(time.dtype, np.timedelta64):  # NumPy takes these for numbers too
        gaps = np.diff(time)
        if len(gaps) and np.all(gaps == gaps[0]):
            return np.asarray(time[-1] + gaps[0] * count)
    elif np.issubdtype(time.dtype, np.number) and len(time):
        gaps = np.diff(time) if len(time) > 1 else np.ones(1, time.dtype)
        rounding = 4.0 * np.spacing(np.abs(np.asarray(time, dtype=float)).max())
        if np.allclose(gaps, gaps[0], rtol=1e-6, atol=rounding):
            return np.asarray(time[-1] + gaps[0] * count)
    return len(time) + count


def _by_calendar(time: np.ndarray, steps: int, zone: str) -> np.ndarray | None:
    """The dates (UTC) that follow by whole days, weeks, months, ... of a zone's calendar, on the
    clock of its days; None where the steps are others, or the zone is not known."""
    import pandas as pd

    try:
        local = pd.DatetimeIndex(time).tz_localize("UTC").tz_convert(zone).tz_localize(None)
    except (KeyError, ValueError):  # no such zone on this computer
        return None
    step = pd.DatetimeIndex(local, freq="infer").freq
    if step is None or (local[-1] + step - local[-1]) % pd.Timedelta(days=1):
        return None
    dates = pd.date_range(local[-1], periods=steps + 1, freq=step)[1:]
    # an hour that the clock leaves out is the next one, of one that comes twice it is the first
    there = dates.tz_localize(zone, nonexistent="shift_forward", ambiguous=np.full(steps, True))
    return np.asarray(there.tz_convert(None))


def _continued(
    program: Program, theta: np.ndarray, paths: np.ndarray, y: np.ndarray, u: np.ndarray,
    feedback: bool, root: np.random.SeedSequence,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """States (n, H, D) and observations (n, H, K) of the rows of u that follow those of paths."""
    n, rows, d = paths.shape
    steps, k = len(u) - rows, y.shape[1]
    states, observed = np.empty((n, steps, d)), np.empty((n, steps, k))
    simulate, observe = program.entry("simulate_on"), program.entry("observe_states")
    seen = np.ones_like(y)
    missing = np.isnan(y[rows - 1])
    unknown = feedback and bool(missing.any())
    gain = _gain(program.trace, theta, paths[:, -1], u[rows - 1], rows, missing) if unknown else ()
    for r in range(n):
        stream, own = random_state(root, r), y
        if feedback:  # what is drawn is written there, for the transition to read
            own = np.nan_to_num(y)
        if unknown:
            drawn = np.empty((rows, k, 1))
            x = np.ascontiguousarray(paths[r][:, :, None])
            observe(theta[r], own[:rows], seen[:rows], u[:rows], stream, x, drawn)
            own[rows - 1] = np.where(missing, drawn[-1, :, 0], y[rows - 1])
            for left, given, k_given in gain:  # Matheron's rule: a joint draw, corrected
                own[rows - 1, left] += k_given[r] @ (y[rows - 1] - drawn[-1, :, 0])[given]
        x, out = np.empty((steps, d, 1)), np.empty((steps, k, 1))
        last = np.ascontiguousarray(paths[r, -1][:, None])
        simulate(theta[r], own, seen, u, rows, last, stream, x, out, feedback)
        states[r], observed[r] = x[:, :, 0], out[:, :, 0]
    return states, observed


def _gain(
    trace: Trace, theta: np.ndarray, x: np.ndarray, u: np.ndarray, t: int, missing: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each channel jointly Gaussian and measured in part at row t: the missing components (m,),
    the measured ones (s,), and C_ms C_ss^-1 (n, m, s) for each row of theta (n, P) and x (n, D).
    Other joint distributions are measured as a whole or not at all."""
    values: dict[Expr, np.ndarray] = {symbol("time", "t"): np.array(float(t))}
    values |= zip(trace.parameter_symbols, theta.T, strict=True)
    values |= zip(trace.state_symbols, x.T, strict=True)
    values |= zip(trace.input_symbols, u, strict=True)
    place = {s: i for i, s in enumerate(trace.observation_symbols)}
    out = []
    for site in trace.observations.values():
        own = np.array([place[s] for s in site.components])
        law, gone = site.distribution, missing[own]
        if isinstance(law, MvNormal) and gone.any() and not gone.all():
            found = evaluate(array(law.covariance_matrix()), values)
            found = np.broadcast_to(found.T, (len(theta), len(own), len(own)))  # symmetric
            cross, spread = found[:, ~gone][:, :, gone], found[:, ~gone][:, :, ~gone]
            out.append((own[gone], own[~gone], np.linalg.solve(spread, cross).transpose(0, 2, 1)))
    return out


def _one_of(known: list[Any], experiment: Any, what: str) -> int:
    """The place of the experiment asked for; known : labels, none where there is a single one.

    Raises
    ------
    ArgumentError : there are several, and none or an unknown one was asked for.
    """
    if not known and experiment in (None, 1):
        return 0
    texts = [str(k) for k in known]
    if str(experiment) in texts:  # a number may be given as a text, as on the command line
        return texts.index(str(experiment))
    raise ArgumentError(
        f"experiment={experiment!r}, and the {what} of "
        + (f"the experiments {listing('', texts)}" if known else "a single experiment"),
        fix=f"give experiment={known[0]!r}, or another of them"
        if known
        else "leave experiment out",
    )


def _past(idata: Any, name: str, names: Iterable[str], i: int) -> dict[str, np.ndarray]:
    """Values (T, ...) by name, of a group of the data that were sampled, of experiment i.

    Raises
    ------
    ArgumentError : they are not there.
    """
    found, out = group(idata, name), {}
    own = None if found is None else experiments_of(found)[i][1]
    for n in names:
        if own is None or n not in own:
            raise ArgumentError(
                f"the group {name!r} has no {n!r}, which the last step of the data needs",
                fix="give what ssm.sample returned, with all its groups",
            )
        out[n] = np.asarray(own[n].values, dtype=np.float64)
    return out
