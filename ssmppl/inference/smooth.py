"""The verb `smooth`: states given all of the data, at known parameters."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.counts import check_count
from ssmppl.data import Experiment, check_parameters, unpack_states
from ssmppl.errors import ArgumentError, NotApplicable, listing, written_as
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.inference.exact.models import exact_model, kind_of
from ssmppl.inference.filters import LEVELS, quantile_levels
from ssmppl.inference.labels import component_dims, observes, with_data
from ssmppl.inference.method_choice import choose_smoother
from ssmppl.inference.methods import PGAS
from ssmppl.inference.particles.filtering import seed_sequence
from ssmppl.inference.problem import Problem, pose
from ssmppl.inference.settings import check_settings
from ssmppl.inference.smoothers import Call, Found, by_exact_passes, by_ffbsi, by_fixed_lag, by_pgas
from ssmppl.inference.smoothing_methods import (
    FFBSi,
    FixedLag,
    ForwardBackward,
    KalmanSmoother,
    SmoothingMethod,
)
from ssmppl.language.model import Model
from ssmppl.results import to_dataset

if TYPE_CHECKING:
    import xarray as xr


# what a method may be called by
NAMES: dict[str, SmoothingMethod] = {
    "kalman": KalmanSmoother(),
    "forward_backward": ForwardBackward(),
    "ffbsi": FFBSi(),
    "exact": FFBSi(kernel="exact"),
    "rejection": FFBSi(kernel="rejection"),
    "mcmc": FFBSi(kernel="mcmc"),
    "genealogy": FFBSi(kernel="genealogy"),
    "fixed_lag": FixedLag(),
    "pgas": PGAS(),
}


def smooth(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    method: SmoothingMethod | str | None = None,
    *,
    particles: int | None = None,
    trajectories: int | None = None,
    quantiles: tuple[float, ...] = LEVELS,
    seed: int | None = None,
) -> xr.Dataset | list[xr.Dataset]:
    """The states given all of the data, p(x_{1:T} | y_{1:T}, parameters).

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model, {} where it has none.
    method : `ssm.KalmanSmoother()`, exact, for linear Gaussian models; `ssm.ForwardBackward()`,
        exact, where the states take finitely many values; `ssm.FFBSi(...)`, particles
        with backward simulation; `ssm.PGAS(...)`, a Markov chain of conditional particle filters;
        `ssm.FixedLag(...)`, marginal moments from the genealogy. Or one of the names "kalman",
        "forward_backward", "ffbsi", "exact", "rejection", "mcmc", "genealogy", "pgas",
        "fixed_lag". None: the exact one where there is one, else FFBSi; the attribute
        `method_chosen` says why.
    particles : number N; None: 1000, and for PGAS its own. An exact smoother, where `method` is
        left to the model, does without. Moments have a bias of order 1 / N, but
        those of PGAS, whose chain has the right law for every N >= 2.
    trajectories : number M of draws; None: exact moments from an exact smoother, and 1000 draws
        from FFBSi and PGAS.
    quantiles : levels of the quantiles that go with moments.
    seed : the same seed gives the same numbers; None: a random one.

    Returns
    -------
    Dataset, or a list of them for several experiments
        Draws: the states, dims (trajectory, time, ...), and over time `distinct`, how many values
        the draws have at each step, and for FFBSi `ess`, of the filter.
        Moments, dim `draw` of length 1: as of `kalman_filter`, ``x``, ``x_sd``, ``x_quantile`` and
        ``covariance`` of all stacked components, but given all of the data; and
        ``covariance_previous``, that of x_t (`state`) with x_{t-1} (`state_`), NaN in the first
        row. For FixedLag also `distinct`, the ancestors that are left.
        Both: the data, ``y_observed`` of channels y and ``u_input`` of inputs u, (time, ...).
        Attributes name method, settings, seed and the log-likelihood (exact, or the filter's
        estimate).

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or call, and the fix.
    SamplingError : weights vanish or are NaN; names the step, the user's line, the parameters.
    """
    began = time.perf_counter()
    check_settings(method)
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters)
    chosen, why = _choose(problem, method)
    levels = quantile_levels(quantiles)
    root = seed_sequence(seed)
    for name, value, least in (("particles", particles, 1), ("trajectories", trajectories, 1)):
        if value is not None:
            check_count(name, value, least)
    call = Call(problem, theta, particles, trajectories, levels, root)
    if isinstance(chosen, KalmanSmoother | ForwardBackward):
        found = by_exact_passes(call, chosen, method)
    elif isinstance(chosen, FFBSi):
        found = by_ffbsi(call, chosen)
    elif isinstance(chosen, FixedLag):
        found = by_fixed_lag(call, chosen)
    else:
        found = by_pgas(call, chosen)
    attrs = {
        "model": problem.trace.name, "method": type(chosen).__name__, "method_chosen": why,
        "settings": asdict(chosen), "seed": str(root.entropy),
        "seconds": time.perf_counter() - began,
    }  # fmt: skip
    datasets = [
        _dataset(call, e, f, attrs) for e, f in zip(problem.experiments, found, strict=True)
    ]
    return datasets if len(datasets) > 1 else datasets[0]


def _choose(problem: Problem, method: SmoothingMethod | str | None) -> tuple[SmoothingMethod, str]:
    exact = exact_model(problem.trace)
    if method is None:
        kind = exact if isinstance(exact, NotApplicable) else kind_of(exact)
        chosen, why = choose_smoother(kind, problem.trace)
        return chosen, f"automatically: {why}"
    kinds = (KalmanSmoother, ForwardBackward, FFBSi, FixedLag, PGAS)
    if isinstance(method, str):
        if method not in NAMES:
            raise ArgumentError(
                f"method={method!r} is unknown",
                fix=written_as(method, kinds) or f"use one of: {listing(method, NAMES)}",
            )
        method = NAMES[method]
    if not isinstance(method, SmoothingMethod):
        names = ", ".join(f"ssm.{t.__name__}(...)" for t in kinds)
        raise ArgumentError(
            f"method={method!r} is no method of smoothing",
            fix=written_as(method, kinds) or f"use {names}, a name, or None",
        )
    needed: tuple[str, KalmanModel | HiddenMarkov | NotApplicable] | None = None
    if isinstance(method, KalmanSmoother):
        needed = "a linear Gaussian model", kalman_model(problem.trace)
    elif isinstance(method, ForwardBackward):
        needed = "states of finitely many values", hidden_markov(problem.trace)
    if needed is not None and isinstance(needed[1], NotApplicable):
        raise ArgumentError(
            f"{type(method).__name__} needs {needed[0]}: {needed[1].reason}",
            fix="use ssm.FFBSi(...) or ssm.PGAS(...), or None, which picks by structure",
            where=needed[1].where,
        )
    return method, "by the user"


def _dataset(call: Call, experiment: Experiment, found: Found, attrs: dict[str, Any]) -> xr.Dataset:
    trace = call.problem.trace
    dims: dict[str, list[str]] = {}
    coords: dict[str, Any] = {}
    if found.paths is not None:
        variables, sample_dim = dict(unpack_states(trace, found.paths)), "trajectory"
    else:
        assert found.moments is not None
        sample_dim = "draw"
        mean, covariance, cross, spread = (m[None] for m in found.moments)
        cross = cross.copy()
        cross[:, 0] = np.nan
        variables = dict(unpack_states(trace, mean))
        sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=2, axis2=3), 0.0))
        for n, v in unpack_states(trace, sd).items():
            variables[f"{n}_sd"] = v
            dims[f"{n}_sd"] = ["time", *component_dims(n, v, 2)]
        variables |= {"covariance": covariance, "covariance_previous": cross}
        dims |= {n: ["time", "state", "state_"] for n in ("covariance", "covariance_previous")}
        coords["state"] = coords["state_"] = [repr(s) for s in trace.state_symbols]
        if len(call.levels):
            by_level = [unpack_states(trace, spread[:, :, p]) for p in range(len(call.levels))]
            for name in by_level[0]:
                variables[f"{name}_quantile"] = np.stack([q[name] for q in by_level], axis=-1)
                own = component_dims(name, by_level[0][name], 2)
                dims[f"{name}_quantile"] = ["time", *own, "quantile"]
            coords["quantile"] = call.levels
    out = to_dataset(
        variables, sample_dim=sample_dim, time=experiment.time, dims=dims, coords=coords,
        attrs={**attrs, **found.attrs, "observes": observes(trace)},
    )  # fmt: skip
    out = out.assign({k: ("time", v) for k, v in (found.over_time or {}).items()})
    return with_data(out, experiment)
