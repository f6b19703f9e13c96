"""`plot_likelihood`: contours of the log-likelihood over two parameters, with draws and
iterates."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from typing import Any

import numpy as np

from ssmppl.counts import check_count
from ssmppl.data import check_values
from ssmppl.drawing.style import DATA, OTHER, bare
from ssmppl.errors import ArgumentError, SamplingError, listing
from ssmppl.inference.maximum.estimate import Estimate
from ssmppl.inference.particles.filtering import FilterSettings, log_of_mean, repeated_estimates
from ssmppl.inference.preparation.exact_models import EXACT, exact_log_likelihood
from ssmppl.inference.preparation.proposal_choice import resolve_settings
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.inference.run.seeds import seed_sequence
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model.model import Model
from ssmppl.plots.density import supports
from ssmppl.plots.drawing import key, panels, styled
from ssmppl.plots.parameters import iterates_of, parameter_draws
from ssmppl.plots.reading import components, is_inference_data, pick, wrong_kind

__all__ = ["plot_likelihood", "surface"]

REGIONS = (0.5, 0.9, 0.99)  # of the normal law that the likelihood tends to: what lines enclose
DEEPEST = 12.0  # below the top, where the colours end
MOST_DRAWS = 2000
MOST_ROOM = 2.0  # widths of the range of later iterates, which all of them may take
LARGEST = 1e300  # number that Matplotlib's ticks can be counted at
PIECES = 32  # that the grid is cut into, for an executor


@styled
def plot_likelihood(
    model: Model, data: Any, result: Any = None, var_names: Any = None, *,
    parameters: Mapping[str, Any] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    points: int = 25, particles: int = 500, repeats: int = 4, proposal: str = "auto",
    seed: int | None = 0, executor: Executor | None = None, ax: Any = None,
) -> Any:  # fmt: skip
    """The log-likelihood over two parameters, with draws or with the iterates of `maximize`.

    Colours are the log-likelihood below its highest value on the grid. Lines are 0.69, 2.3 and 4.6
    below it: a likelihood of normal shape holds 50%, 90% and 99% of its mass within them. Long,
    tilted regions are two parameters that the data tell apart badly. All others are held.

    Parameters
    ----------
    model, data : as of `log_likelihood`.
    result : what `sample` returns, whose draws are drawn as dots; or `maximize`, whose iterates are
        drawn as a path, with the estimate at its end; None: neither.
    var_names : the two parameters, or components; None: the first two.
    parameters : values of the others; what is not given is the median of the draws, or the
        estimate. Draws differ in the others, too, so that they can lie off the surface's top.
    limits : lowest and highest value by name; None: those of the draws, or of the later iterates
        and three standard errors round the estimate.
    points : of the grid, along each axis.
    particles, repeats, proposal, seed, executor : where the likelihood is not exact, each point of
        the grid is the log of the mean of so many estimates, as of `log_likelihood`, with the same
        random numbers at each. What is left of the noise makes the lines ragged.
    ax : Matplotlib axes; None: a new figure.

    Returns
    -------
    Axes : those drawn on.

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or call, and the fix.
    """
    for name, value, least in (("points", points, 2), ("particles", particles, 1),
                               ("repeats", repeats, 1)):  # fmt: skip
        check_count(name, value, least)
    check_executor(executor)
    problem = pose(model, data)
    walked, centre = _given(result)
    pair = _pair(problem, walked, var_names)
    for name in limits or {}:
        if name not in pair:
            raise ArgumentError(
                f"limits= names {name!r}, and the surface is over {' and '.join(pair)}",
                fix="give the limits of these, or choose other parameters by var_names=",
            )
    theta = _centre(problem, centre, parameters, pair, limits or {})
    where = [_place(problem, name) for name in pair]
    inside = supports(problem.trace)
    ends = [_limits(name, walked, result, limits or {}, theta[k], inside[name])
            for name, k in zip(pair, where, strict=True)]  # fmt: skip
    for name, (low, high) in zip(pair, ends, strict=True):
        if not max(abs(low), abs(high)) < LARGEST:
            raise ArgumentError(
                f"the surface would reach from {low:g} to {high:g} in {name!r}, which no axis "
                "holds",
                fix=f"give limits={{{name!r}: (low, high)}} near plausible values",
            )
    x, y = (np.linspace(low, high, points) for low, high in ends)
    theta[where] = [x[points // 2], y[points // 2]]
    settings = resolve_settings(problem, theta, particles, proposal, whole=True, integrate=True)
    root = seed_sequence(seed)
    heights = surface(problem, theta, where, x, y, settings, repeats, root, executor)
    for values, name, axis in ((x, pair[0], 1), (y, pair[1], 0)):  # beyond it there is no model
        beyond = (values < inside[name][0]) | (values > inside[name][1])
        heights = np.where(np.expand_dims(beyond, 1 - axis), np.nan, heights)
    if not np.isfinite(heights).any():
        raise ArgumentError(
            "the log-likelihood is finite nowhere on the grid",
            fix="give limits= near plausible values, or more particles",
        )
    one = panels("plot_likelihood", 1, 1, ax, width=6.0, height=3.6)[0, 0]
    _surface(one, x, y, heights)
    _walk(one, walked, result, pair, ends)
    one.set(xlim=ends[0], ylim=ends[1], xlabel=pair[0], ylabel=pair[1])
    if settings.proposal not in EXACT:
        one.set_title(f"{repeats} particle estimates a point, {particles:,} particles, "
                      f"{settings.proposal}")  # fmt: skip
    key(np.array([[one]], dtype=object), ax)
    return one


def _given(result: Any) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """(start or chain, iteration or draw) of each component, and the values of all."""
    if result is None:
        return {}, {}
    if isinstance(result, Estimate):
        paths, _ = iterates_of(result)
        values: dict[str, float] = {}
        for name, value in result.parameters.items():
            like = result.iterates.get(name)
            values |= {k: float(v) for k, v in components(name, np.asarray(value), 0, like)}
        return paths, values
    if is_inference_data(result):
        draws = parameter_draws(result, "plot_likelihood")
        return draws, {k: float(np.median(v)) for k, v in draws.items()}
    raise wrong_kind("plot_likelihood", result, "as result= give what ssm.sample or ssm.maximize "
                     "returns, or None")  # fmt: skip


def _labels(problem: Problem) -> list[str]:
    return [problem.trace.label(s) for s in problem.trace.parameter_symbols]


def _place(problem: Problem, label: str) -> int:
    return _labels(problem).index(label)


def _pair(problem: Problem, walked: dict[str, np.ndarray], var_names: Any) -> list[str]:
    """The two components that span the surface."""
    known = _labels(problem)
    found = pick(known, var_names, "the parameters of the model")
    if var_names is None:
        parameters = problem.trace.parameters.values()
        ones = {problem.trace.label(s) for site in parameters if site.distribution.unit_diagonal
                for s in np.diagonal(site.value.view(np.ndarray))}  # fmt: skip
        found = [k for k in found if k not in ones and (not walked or k in walked)][:2]
    if len(known) < 2:
        raise ArgumentError(
            f"a surface is over two parameters, and the model has {len(known)}",
            fix="draw the curve of the values of ssm.log_likelihood over a grid of it",
        )
    if len(found) != 2:
        raise ArgumentError(
            f"a surface is over two parameters, and {len(found)} "
            f"{'is' if len(found) == 1 else 'are'} chosen: {', '.join(found) or 'none'}",
            fix=f"give two of {listing('', known)} by var_names=",
        )
    return found


def _centre(
    problem: Problem, centre: dict[str, float], parameters: Mapping[str, Any] | None,
    pair: list[str], limits: Mapping[str, tuple[float, float]],
) -> np.ndarray:  # fmt: skip
    """(P,) values of all parameters.

    Raises
    ------
    ArgumentError : one of those that are held has no value.
    """
    given = check_values(problem.trace, parameters, argument="parameters")
    theta = np.full(len(problem.trace.parameter_symbols), np.nan)
    for k, symbol in enumerate(problem.trace.parameter_symbols):
        label, (name, index) = repr(symbol), symbol.data[1:3]
        if name in given:
            theta[k] = given[name][index]
        elif label in centre:
            theta[k] = centre[label]
        elif label in pair and label in limits:
            theta[k] = 0.5 * sum(map(float, limits[label]))
        elif label in pair:
            raise ArgumentError(
                f"nothing tells between which values of {label!r} the surface is to be drawn",
                fix=f"give limits={{{label!r}: (low, high)}}, or a result of ssm.sample or "
                "ssm.maximize",
            )
        else:
            raise ArgumentError(
                f"parameter {label!r} has no value", fix=f"give parameters={{{name!r}: ...}}"
            )
    return theta


def _limits(
    name: str, walked: dict[str, np.ndarray], result: Any,
    limits: Mapping[str, tuple[float, float]], value: float, inside: tuple[float, float],
) -> tuple[float, float]:  # fmt: skip
    if name in limits:
        low, high = map(float, limits[name])
        if not low < high:
            raise ArgumentError(
                f"limits of {name!r} are {low:g} and {high:g}", fix="give (low, high), low < high"
            )
        return low, high
    own = walked.get(name, np.array([[value]]))
    if isinstance(result, Estimate):
        error = float(result.table().loc[name, "standard_error"])
        error = error if np.isfinite(error) else 0.0
        late = own[:, own.shape[1] // 10 :]
        low = min(float(np.nanmin(late)), value - 3.0 * error)
        high = max(float(np.nanmax(late)), value + 3.0 * error)
        if np.ptp(own) <= MOST_ROOM * (high - low):  # the start is not too far away to be shown
            low, high = min(low, float(np.nanmin(own))), max(high, float(np.nanmax(own)))
    else:
        low, high = (float(v) for v in np.quantile(own, [0.001, 0.999]))
    room = 0.12 * (high - low) or 0.25 * abs(value) or 1.0
    low, high = max(low - room, inside[0]), min(high + room, inside[1])
    step = 0.004 * (high - low)  # the ends of a support itself have no density
    return low + step * (low == inside[0]), high - step * (high == inside[1])


def surface(
    problem: Problem, theta: np.ndarray, where: list[int], x: np.ndarray, y: np.ndarray,
    settings: FilterSettings, repeats: int, root: np.random.SeedSequence,
    executor: Executor | None = None,
) -> np.ndarray:  # fmt: skip
    """(len(y), len(x)) log-likelihoods; NaN where there is none."""
    grid = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=-1)
    task = partial(_heights, problem, theta, tuple(where), settings, repeats, root)
    pieces = [p for p in np.array_split(grid, PIECES) if len(p)]
    found = np.concatenate(run_tasks(task, pieces, executor=executor))
    return found.reshape(len(y), len(x))


def _heights(
    problem: Problem, theta: np.ndarray, where: tuple[int, ...], settings: FilterSettings,
    repeats: int, root: np.random.SeedSequence, points: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The log-likelihood at points (n, 2); a function that another process can be sent."""
    found = np.full(len(points), np.nan)
    for k, point in enumerate(points):
        here = theta.copy()
        here[list(where)] = point
        try:
            if settings.proposal in EXACT:
                found[k] = exact_log_likelihood(problem.trace, problem.experiments, here)
            else:
                estimates = repeated_estimates(problem, here, settings, root, range(repeats))
                found[k] = log_of_mean(estimates)[0]
        except SamplingError:  # outside of what the parameters can be
            continue
    return np.where(np.isfinite(found), found, np.nan)


def _surface(ax: Any, x: np.ndarray, y: np.ndarray, heights: np.ndarray) -> None:
    top = np.nanmax(heights)
    below = np.maximum(heights - top, -DEEPEST)
    below = np.ma.masked_invalid(below)
    filled = ax.contourf(x, y, below, levels=np.linspace(-DEEPEST, 0.0, 25), cmap="Blues",
                         vmin=-DEEPEST, vmax=0.5 * DEEPEST)  # fmt: skip
    lines = sorted(float(np.log1p(-share)) for share in REGIONS)
    drawn = ax.contour(x, y, below, levels=lines, colors=DATA, linewidths=0.8, linestyles="-")
    texts = {at: f"{share:.0%}" for at, share in zip(lines, sorted(REGIONS, reverse=True),
                                                      strict=True)}  # fmt: skip
    ax.clabel(drawn, fmt=texts, fontsize=7.5)
    bar = ax.figure.colorbar(filled, ax=ax, pad=0.02, aspect=25, ticks=np.arange(-DEEPEST, 1, 3))
    bar.set_label(f"log-likelihood below its top, {top:.1f}".replace(" -", " −"))
    bar.outline.set_visible(False)
    bare(ax)


def _walk(
    ax: Any, walked: dict[str, np.ndarray], result: Any, pair: list[str],
    ends: list[tuple[float, float]],
) -> None:  # fmt: skip
    """Dots of draws; or paths, their start and the estimate."""
    if any(name not in walked for name in pair):
        return
    a, b = (walked[name] for name in pair)
    if not isinstance(result, Estimate):
        every = max(a.size // MOST_DRAWS, 1)
        ax.plot(a.ravel()[::every], b.ravel()[::every], ".", color=OTHER, markersize=2.2, alpha=0.6,
                label="draws")  # fmt: skip
        return
    started = False
    for k, (u, v) in enumerate(zip(a, b, strict=True)):
        ax.plot(u, v, "-", color=OTHER, linewidth=1.0, marker="." if len(u) <= 60 else None,
                markersize=4, label="iterates" if k == 0 else None)  # fmt: skip
        first = (u[0], v[0])
        if all(low <= c <= high for c, (low, high) in zip(first, ends, strict=True)):
            ax.plot(*first, "o", color="white", markeredgecolor=OTHER, markersize=6,
                    label=None if started else "start")  # fmt: skip
            started = True
    end = [float(result.table().loc[name, "estimate"]) for name in pair]
    ax.plot(*end, "*", color=OTHER, markeredgecolor="white", markersize=12, label="estimate",
            zorder=5)  # fmt: skip
