"""The verb `predict`: observations that the model expects, from the prior or from the posterior,
whose draws, parameters and trajectories, are read back from an InferenceData.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.arguments import checked
from ssmppl.codegen.modules.program import Program, compile_trace
from ssmppl.counts import check_count, check_room
from ssmppl.data import (
    Experiment,
    bind,
    check_values,
    unpack_observations,
    unpack_parameters,
    unpack_states,
)
from ssmppl.data.experiments import experiments_of
from ssmppl.data.parameters import pack, pack_states
from ssmppl.data.per_experiment import trace_of_results, trace_over
from ssmppl.errors import ArgumentError, ModelError, listing
from ssmppl.inference.run.labels import Labels, check_names, model_attributes, observes
from ssmppl.inference.run.prior import draw_prior
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.verbs.simulate import check_drawable, check_finite, check_samplers, feeds_back
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace
from ssmppl.results import to_inference_data

# Of one experiment: states (n, T, D) and observations (n, T, K) of n draws.
Drawn = tuple[np.ndarray, np.ndarray]


def group(idata: Any, name: str) -> Any:
    """A group of an InferenceData or DataTree as a Dataset; None where it has none of this name."""
    names = idata.groups() if callable(getattr(idata, "groups", None)) else idata.children
    if name not in names and f"/{name}" not in names:
        return None
    found = idata[name]
    return found.to_dataset() if hasattr(found, "to_dataset") else found


def posterior_of(idata: Any, fix: str = "give what ssm.sample returns") -> Any:
    """The posterior group of a result.

    Raises
    ------
    ArgumentError : it has none.
    """
    known = hasattr(idata, "groups") or hasattr(idata, "children")
    found = group(idata, "posterior") if known else None
    if found is None:
        if isinstance(getattr(idata, "parameters", None), Mapping):  # an Estimate
            fix = (
                "ssm.simulate(model, estimate, inputs=...) draws at an estimate; for predictions "
                f"of a posterior {fix}"
            )
        raise ArgumentError(
            f"idata is {type(idata).__name__} without a group `posterior`",
            fix=fix,
        )
    return found


def parameters_of(trace: Trace, posterior: Any) -> np.ndarray:
    """(chain, draw, P) theta of each draw; parameters that were held are among the attributes.

    Raises
    ------
    ArgumentError : a parameter is neither drawn nor held.
    """
    fixed = posterior.attrs.get("fixed", "{}")
    fixed_values = check_values(trace, json.loads(fixed) if isinstance(fixed, str) else fixed)
    shape = (posterior.sizes["chain"], posterior.sizes["draw"])
    values: dict[str, np.ndarray] = {}
    for name, site in trace.parameters.items():
        if name in posterior:
            values[name] = _drawn(posterior, name, site.shape, ())
        elif name in fixed_values:
            values[name] = np.broadcast_to(fixed_values[name], (*shape, *site.shape))
        else:
            raise ArgumentError(
                f"the posterior has no parameter {name!r}",
                fix=f"use the model that was sampled; the posterior holds "
                f"{listing(name, map(str, posterior.data_vars))}",
            )
    if not values:
        return np.empty((*shape, 0))
    return pack(trace.parameters.values(), values)


def all_draws(values: np.ndarray) -> np.ndarray:
    """(chain, draw, ...) as (chain * draw, ...); said by numbers, as the rest may be empty."""
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])


def states_of(trace: Trace, posterior: Any) -> np.ndarray | None:
    """(chain, draw, T, D) trajectories of a single experiment (`experiments_of`); None where they
    were not kept."""
    values: Mapping[str, Any] = {
        name: _drawn(posterior, name, value.shape, ("time",))
        for name, value in trace.states.items()
        if name in posterior and "time" in posterior[name].dims
    }
    if len(values) < len(trace.states):
        return None
    return pack_states(trace, values)


def _drawn(posterior: Any, name: str, shape: tuple[int, ...], over: tuple[str, ...]) -> np.ndarray:
    own = posterior[name].transpose("chain", "draw", *over, ...)
    values = np.asarray(own.values, dtype=np.float64)
    rest = values.shape[2 + len(over) :]
    if rest != shape:
        raise ArgumentError(
            f"{name!r} of the posterior has shape {rest}, that of the model {shape}",
            fix="use the model that was sampled",
        )
    return values


@checked
def predict(
    model: Model,
    idata: Any = None,
    data: Any = None,
    *,
    steps: int | None = None,
    draws: int = 1000,
    conditional: bool | None = None,
    seed: int | None = None,
) -> Any:
    """Draws of the observations at the rows of `data`, from the prior or from the posterior.

    Parameters
    ----------
    model : the model, as declared.
    idata : what `sample` returned; None draws parameters, states and observations from the prior.
    data : the data set (or the list of them) whose rows and inputs are meant; observations may be
        left out of it, and are compared with by ArviZ where they are there.
    steps : number of rows where there are no data.
    draws : from the prior; of the posterior all its draws are taken.
    conditional : of the posterior, whether the states are those of its trajectories, so that a
        draw is of p(y'_t | x_t, theta) at x_t | y_{1:T}, or are simulated anew from x_1 on, a free
        run. None: as the trajectories are there or not.
    seed : the same seed gives the same draws.

    Returns
    -------
    InferenceData (ArviZ 0.x) or DataTree (ArviZ 1.x)
        Groups prior (parameters and states) and prior_predictive, or posterior_predictive; with
        them observed_data and constant_data, so that `az.plot_ppc` draws them. Every row has a
        draw, missing ones too.

    Raises
    ------
    ModelError, DataError, ArgumentError, SamplingError : what is wrong, where, and the fix.
    """
    traced = trace_over(model, data)
    if not traced.observations:
        raise ModelError(
            f"model {traced.name!r} has no @observation function: there is nothing to predict",
            fix="declare the distribution of y_t with @model.observation",
            where=model.location,
        )
    posterior = None
    if idata is not None:
        posterior = posterior_of(
            idata,
            "give what ssm.sample returns, or None to draw from the prior; data come third, "
            "ssm.predict(model, None, data)",
        )
        traced = trace_of_results(model, posterior, data)
    if data is None and steps is None:
        raise ArgumentError(
            "neither data nor steps tell how many rows to predict",
            fix="give data, or steps=100",
        )
    experiments = bind(traced, data, need_observations=False, steps=steps)
    program, root = compile_trace(traced, Missing(none=True)), seed_sequence(seed)
    labels = Labels(traced, experiments)
    attrs: dict[str, Any] = {
        **model_attributes(traced), "seed": str(root.entropy), "observes": observes(traced),
    }  # fmt: skip
    if posterior is None:
        return _from_prior(traced, program, experiments, labels, draws, root, attrs)
    theta = parameters_of(traced, posterior)
    lead = theta.shape[:2]
    predicted: list[dict[str, np.ndarray]] = []
    sampled = experiments_of(posterior)
    for i, e in enumerate(experiments):
        paths = None
        if conditional is not False:
            paths = states_of(traced, sampled[min(i, len(sampled) - 1)][1])
            if paths is not None and i == 0:
                _check_count(len(sampled), len(experiments))
            _check_paths(paths, e, conditional)
        flat = all_draws(theta)
        if paths is not None:
            check_samplers(traced)
            drawn = _observed(program, e, flat, all_draws(paths), root, i)
        else:
            check_drawable(traced)
            drawn = _simulated(program, e, flat, root, i)
        check_finite(traced, *drawn)
        y = drawn[1].reshape(*lead, *drawn[1].shape[1:])
        predicted.append(unpack_observations(traced, y))
        attrs["conditional"] = paths is not None
    together = labels.together(predicted, leading=3)
    return _container(experiments, labels, attrs, posterior_predictive=together)


def _check_paths(paths: np.ndarray | None, e: Experiment, conditional: bool | None) -> None:
    if paths is None and conditional:
        raise ArgumentError(
            "conditional=True, and the posterior holds no trajectories of this data set",
            fix="sample with states=True, give the data sets that were sampled, or leave "
            "conditional out",
        )
    if paths is not None and paths.shape[2] != e.steps:
        raise ArgumentError(
            f"the trajectories of the posterior have {paths.shape[2]} rows, the data {e.steps}",
            fix="give the data that were sampled, conditional=False for other data, or "
            "ssm.forecast for the rows after them",
        )


def _check_count(sampled: int, given: int) -> None:
    """Trajectories belong to data sets by their place in the list, so that all have to be there."""
    if sampled != given:
        raise ArgumentError(
            f"the posterior holds trajectories of {sampled} data sets, the data are {given}",
            fix="give all the data sets that were sampled, in their order, or conditional=False",
        )


def _from_prior(
    traced: Trace, program: Program, experiments: list[Experiment], labels: Labels, draws: int,
    root: np.random.SeedSequence, attrs: dict[str, Any],
) -> Any:  # fmt: skip
    check_count("draws", draws, 1)
    check_drawable(traced)
    check_names(traced, experiments)
    theta = draw_prior(
        traced, np.random.default_rng(root), draws, alternative="or posterior draws by idata="
    )
    prior = {n: v[None] for n, v in unpack_parameters(traced, theta).items()}
    paths: list[dict[str, np.ndarray]] = []
    predicted: list[dict[str, np.ndarray]] = []
    for i, e in enumerate(experiments):
        x, y = _simulated(program, e, theta, root, i)
        check_finite(traced, x, y)
        paths.append(unpack_states(traced, x[None]))
        predicted.append(unpack_observations(traced, y[None]))
    states = labels.together(paths, leading=3)
    return _container(
        experiments, labels, attrs, prior=prior | states, over_time=states,
        prior_predictive=labels.together(predicted, leading=3),
    )  # fmt: skip


def _simulated(
    program: Program, e: Experiment, theta: np.ndarray, root: np.random.SeedSequence, i: int
) -> Drawn:
    """x_1 on, with the experiment's inputs."""
    simulate, feedback = program.entry("simulate"), feeds_back(program.trace)

    def one(r: int, x: np.ndarray, y: np.ndarray) -> None:
        own = np.zeros_like(e.y)
        simulate(theta[r], own, np.ones_like(e.y), e.u, random_state(root, i, r), x, y, feedback)

    return _each(program, e, len(theta), one)


def _observed(
    program: Program, e: Experiment, theta: np.ndarray, paths: np.ndarray,
    root: np.random.SeedSequence, i: int,
) -> Drawn:  # fmt: skip
    """Observations given trajectories (n, T, D)."""
    observe = program.entry("observe_states")

    def one(r: int, x: np.ndarray, y: np.ndarray) -> None:
        x[:, :, 0] = paths[r]
        observe(theta[r], e.y, np.ones_like(e.y), e.u, random_state(root, i, r), x, y)

    return _each(program, e, len(theta), one)


def _each(
    program: Program, e: Experiment, n: int, one: Callable[[int, np.ndarray, np.ndarray], None]
) -> Drawn:
    d, k = len(program.trace.state_symbols), len(program.trace.observation_symbols)
    check_room(f"{n} draws of {e.steps} rows", n * e.steps * (d + k), "ask for fewer of them")
    states, observations = np.empty((n, e.steps, d)), np.empty((n, e.steps, k))
    for r in range(n):
        x, y = np.empty((e.steps, d, 1)), np.empty((e.steps, k, 1))
        one(r, x, y)
        states[r], observations[r] = x[:, :, 0], y[:, :, 0]
    return states, observations


def _container(
    experiments: list[Experiment], labels: Labels, attrs: dict[str, Any], **groups: Any
) -> Any:
    seen = any(e.seen.any() for e in experiments)
    return to_inference_data(
        observed_data=labels.together([e.observed for e in experiments]) if seen else None,
        constant_data=labels.together([e.inputs for e in experiments]),
        **labels.arguments, attrs=attrs, **groups,
    )  # fmt: skip
