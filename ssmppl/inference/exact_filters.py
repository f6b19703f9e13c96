"""The verbs `kalman_filter` and `forward_filter`: filters that are exact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtr, ndtri

from ssmppl.data import Experiment, check_parameters
from ssmppl.inference.exact import kalman
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.filters import LEVELS, filter_dataset, quantile_levels
from ssmppl.inference.particles.filtering import FilterRun, seed_sequence
from ssmppl.inference.particles.proposal_choice import resolve_settings
from ssmppl.inference.problem import pose
from ssmppl.language.model import Model

if TYPE_CHECKING:
    import xarray as xr


def kalman_filter(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    *,
    quantiles: tuple[float, ...] = LEVELS,
) -> xr.Dataset | list[xr.Dataset]:
    """Run the exact filter of a linear Gaussian model (Kalman 1960).

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model, {} where it has none.
    quantiles : levels of the quantiles of states and predictions.

    Returns
    -------
    Dataset, or a list of them for several experiments
        As of `particle_filter`, with one `draw` and without `ess`; everything is exact.

    Raises
    ------
    ArgumentError : the model is not linear and Gaussian; gives the reason and the user's line.
    """
    problem = pose(model, data)
    theta = check_parameters(problem.trace, parameters)
    resolve_settings(problem, theta, 1, "kalman")
    levels = quantile_levels(quantiles)
    attrs = {"model": problem.trace.name, "proposal": "kalman"}
    root = np.random.SeedSequence(0)  # no channel is discrete, so nothing is randomised
    datasets = []
    for e in problem.experiments:
        run = _as_run(kalman.kalman_filter(problem.trace, e, theta), e, levels)
        datasets.append(filter_dataset(problem, e, [run], levels, attrs, root).drop_vars("ess"))
    return datasets if len(datasets) > 1 else datasets[0]


def _as_run(exact: kalman.KalmanMoments, e: Experiment, levels: np.ndarray) -> FilterRun:
    """Exact moments in the form of a particle filter's."""
    variance = np.diagonal(exact.observation_covariance, axis1=1, axis2=2)
    quantiles = [
        _normal_quantiles(mean, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), levels)
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


def _normal_quantiles(mean: np.ndarray, sd: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """(T, P, ...) at the levels (P,), by means and standard deviations (T, ...)."""
    with np.errstate(invalid="ignore"):  # nothing is known yet of a flat component
        found: np.ndarray = mean[:, None, :] + ndtri(levels)[None, :, None] * sd[:, None, :]
    return found


def forward_filter(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    *,
    quantiles: tuple[float, ...] = LEVELS,
    seed: int | None = None,
) -> xr.Dataset | list[xr.Dataset]:
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
    Dataset, or a list of them for several experiments
        As of `particle_filter`, with one `draw` and without `ess`, everything exact; and for each
        state x ``x_probability``: P(x_t = value given y_1:t), last dim `x_value`, whose coordinate
        holds the values. ``y_predicted_quantile`` inverts the distribution function of the mixture;
        it is NaN for Wishart laws, whose components have none in closed form, and for laws of your
        own without `@law.quantile`.

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
    attrs = {"model": problem.trace.name, "proposal": "forward", "seed": str(root.entropy)}
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
        datasets.append(dataset.assign(_probabilities(exact, law, dataset)))
    return datasets if len(datasets) > 1 else datasets[0]


def _probabilities(
    exact: HiddenMarkov, law: np.ndarray, dataset: xr.Dataset
) -> dict[str, xr.DataArray]:
    """Of each state's values, from the laws (T, K) of their combinations."""
    import xarray as xr

    out = {}
    for name, site in exact.trace.transition.items():
        own = [k for k, s in enumerate(exact.trace.state_symbols) if s.data[1] == name]
        columns = exact.values[:, own]
        values, index = np.unique(columns, return_inverse=True)
        shares = np.eye(len(values))[index.reshape(columns.shape)]  # (K, size, values)
        chances = np.einsum("tk,kdv->tdv", law, shares).reshape(-1, *site.shape, len(values))
        out[f"{name}_probability"] = xr.DataArray(
            chances[None], dims=(*dataset[name].dims, f"{name}_value"),
            coords={**dataset[name].coords, f"{name}_value": values},
        )  # fmt: skip
    return out
