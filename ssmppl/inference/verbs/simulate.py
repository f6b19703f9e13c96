"""The verb `simulate`: draws of states and observations at given parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.structure import flat_start
from ssmppl.arguments import checked
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.counts import check_count, check_room
from ssmppl.data import (
    bind_inputs,
    check_defined,
    check_parameters,
    unpack_observations,
    unpack_parameters,
    unpack_states,
)
from ssmppl.errors import ModelError, SamplingError
from ssmppl.expressions.expr import topological
from ssmppl.inference.run.invalid_laws import out_of_range
from ssmppl.inference.run.labels import model_attributes
from ssmppl.inference.run.prior import draw_prior
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace
from ssmppl.language.tracing import trace
from ssmppl.results import to_dataset

if TYPE_CHECKING:
    import xarray as xr


@checked
def simulate(
    model: Model,
    parameters: Mapping[str, Any] | None = None,
    *,
    steps: int | None = None,
    inputs: Any = None,
    draws: int = 1,
    seed: int | None = None,
) -> xr.Dataset:
    """Simulate states and observations.

    Parameters
    ----------
    model : the model, as declared.
    parameters : value of each parameter; None draws them from the prior, anew for each draw.
    steps : number T of time steps; may be left out where `inputs` tell it.
    inputs : mapping of arrays, DataFrame or Dataset with the model's inputs.
    draws : number of independent simulations.
    seed : the same seed gives the same numbers.

    Returns
    -------
    Dataset
        The states and observations, dims (draw, time, ...), and, where they were drawn from the
        prior, the parameters, dims (draw, ...).

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, inputs or call, and the fix.
    """
    traced = trace(model)
    check_drawable(traced)
    u, steps, source = bind_inputs(traced, inputs, steps)
    check_defined(traced, source, u)
    check_count("draws", draws, 1)
    d, k = len(traced.state_symbols), len(traced.observation_symbols)
    check_room(f"{draws} draws of {steps} rows", draws * steps * (d + k), "give fewer of them")
    root = seed_sequence(seed)
    program = compile_trace(traced, Missing(none=True))
    rng = random_state(root)
    if parameters is not None:
        theta = check_parameters(traced, parameters)[None]
    elif traced.parameters:
        theta = draw_prior(traced, np.random.default_rng(root), draws)
    else:
        theta = np.empty((1, 0))
    states, observations = np.empty((draws, steps, d)), np.empty((draws, steps, k))
    feedback = feeds_back(traced)
    side_by_side = draws if len(theta) == 1 and not feedback else 1
    y, seen = np.zeros((steps, k)), np.ones((steps, k))
    for first in range(0, draws, side_by_side):
        x, out = np.empty((steps, d, side_by_side)), np.empty((steps, k, side_by_side))
        row = theta[min(first, len(theta) - 1)]
        program.entry("simulate")(row, y, seen, u, rng, x, out, feedback)
        states[first : first + side_by_side] = np.moveaxis(x, 2, 0)
        observations[first : first + side_by_side] = np.moveaxis(out, 2, 0)
    check_finite(traced, states, observations)
    variables = {**unpack_states(traced, states), **unpack_observations(traced, observations)}
    over_time = set(variables)
    if parameters is None and traced.parameters:
        variables |= unpack_parameters(traced, theta)
    return to_dataset(
        variables,
        over_time=over_time,
        time=source.time,
        coords=traced.component_names.coords,
        renamed=traced.component_names.renamed,
        attrs=model_attributes(traced) | {"seed": str(root.entropy)},
    )


def check_drawable(traced: Trace) -> None:
    """Refuse a model whose x_1 has no proper distribution, or an observation no sampler.

    Raises
    ------
    ModelError : naming the state or channel and its line.
    """
    check_samplers(traced)
    for site in flat_start(traced):
        raise ModelError(
            f"the initial distribution of {site.name!r} is Flat, and cannot be drawn from",
            fix="give it a proper distribution in @initial to simulate",
            where=site.distribution.location,
        )


def check_samplers(traced: Trace) -> None:
    """Refuse a model of which an observation cannot be drawn.

    Raises
    ------
    ModelError : naming the distribution and its line.
    """
    for site in traced.observations.values():
        if not site.distribution.drawable:
            raise site.distribution.undrawable(f"{site.name!r} has to be drawn here")


def check_finite(traced: Trace, states: np.ndarray, observations: np.ndarray) -> None:
    """Refuse draws that are nan: some distribution left its domain.

    Raises
    ------
    SamplingError : naming the first such step, the quantity and its distribution's line.
    """
    parts = ((states, traced.state_symbols, traced.transition),
             (observations, traced.observation_symbols, traced.observations))  # fmt: skip
    for values, symbols, sites in parts:
        bad = np.argwhere(np.isnan(values))
        if len(bad):
            draw, t, k = bad[np.argmin(bad[:, 1])]
            if t and sites is traced.transition:  # what others read in the step comes before them
                order = [c for site in sites.values() for c in site.components]
                place = {c: i for i, c in enumerate(order)}
                at_fault = np.flatnonzero(np.isnan(values[draw, t]))
                k = min(at_fault, key=lambda i: place[symbols[i]])
            if sites is traced.transition:
                site = traced.law_of(symbols[k], "transition" if t else "initial")
            else:
                site = sites[symbols[k].data[1]]
            now = traced.state_symbols if t or sites is traced.observations else []
            before = traced.state_prev_symbols if t else []
            known = dict(zip(now, states[draw, t], strict=False))
            known |= dict(zip(before, states[draw, t - 1], strict=False))
            why, fix = out_of_range(site.distribution, known) or (
                "",
                "a distribution parameter is outside its valid range there (a negative spread, the "
                "log of a negative number, ...): check the values, or bound them by np.maximum",
            )
            raise SamplingError(
                f"{symbols[k]!r} is nan at t={t + 1} of draw {draw + 1}" + (why and f": {why}"),
                fix=fix,
                where=site.distribution.location,
            )


def feeds_back(traced: Trace) -> bool:
    """Whether some transition names an observation."""
    laws = [
        p
        for site in traced.transition.values()
        for a in site.distribution.parameters.values()
        for p in a.ravel()
    ]
    return any(n.op == "symbol" and n.data[0] == "observation_prev" for n in topological(laws))
