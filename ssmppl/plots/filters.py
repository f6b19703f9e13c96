"""`plot_filter`: effective sample size, and increments of the log-likelihood;
`plot_ancestry`: the genealogy of the particles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ssmppl.drawing.style import DATA, FAINT, MAIN, OTHER, bare
from ssmppl.errors import ArgumentError, listing
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.plots.drawing import few, handed, key, only_below, panels, shown_time, styled
from ssmppl.plots.reading import components, experiment_name, is_dataset, pick, wrong_kind

__all__ = ["plot_ancestry", "plot_filter"]

# Proposals that resample by the weights alone, whose effective sample size is what is reported.
BY_WEIGHT = ("bootstrap", "guided", "user", "marginal", "marginal_guided")
FILTERED = "give what ssm.particle_filter, ssm.kalman_filter or ssm.forward_filter returns"
MOST_DOTS = 4000  # particles times rows up to which all of them are drawn
THINNED = 40  # particles of a row that are drawn otherwise


def filtered(result: Any, verb: str) -> list[Any]:
    """The Datasets of a filter's result, one for each experiment.

    Raises
    ------
    ArgumentError : some of it is no result of a filter.
    """
    if isinstance(result, Mapping) and not is_dataset(result):
        found = list(result.values())
    else:
        found = list(result) if isinstance(result, (list, tuple)) else [result]
    for one in found:
        if not is_dataset(one) or "log_likelihood_increment" not in one:
            raise wrong_kind(verb, one, FILTERED)
    if not found:
        raise ArgumentError(f"{verb} was given an empty list", fix=FILTERED)
    return found


def titles(result: Any) -> list[str]:
    """Names of the experiments of a filter's result; empty where there is only one."""
    if isinstance(result, Mapping) and not is_dataset(result):
        return [experiment_name(str(k)) for k in result]
    count = len(result) if isinstance(result, (list, tuple)) else 1
    return [f"experiment {k}" for k in range(1, count + 1)] if count > 1 else [""]


@styled
def plot_filter(result: Any, *, ax: Any = None) -> Any:
    """Effective sample size of a filter with times of resampling, and the increment of each row.

    Above, the effective sample size after each row, between 0 and N; the marks at the bottom stand
    at the rows after which the particles were resampled, if that was not at all of them. Below,
    log p(y_t given y_1:t-1): a row far below the others surprised the model. Repeats are one line
    each, the marks are of the first.

    Where particles are resampled by more than their weights ("auxiliary", "twisted",
    ``ess_threshold`` below 1), the times are known of a filter that ran with ``history=True``.

    Parameters
    ----------
    result : what `particle_filter` returns; of `kalman_filter` and `forward_filter`, which have no
        particles, the lower panel.
    ax : Matplotlib axes, as many as there are panels, experiments side by side; None: a new figure.

    Returns
    -------
    Axes
        Of several panels an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : the result is that of no filter, or `ax` are not as many.
    """
    found = filtered(result, "plot_filter")
    sizes = "ess" in found[0]
    axes = panels("plot_filter", 1 + sizes, len(found), ax, height=1.8,
                  width=max(8.0, 3.0 * len(found)))  # fmt: skip
    for one, column, title in zip(found, axes.T, titles(result), strict=True):
        notes = [title] * bool(title)
        if sizes:
            notes.append(_sizes(one, column[0]))
        x = shown_time(column[-1], one["time"].values)
        increments = one["log_likelihood_increment"].transpose("draw", "time").values
        seen = _seen(one)
        for row in increments:
            shown = np.where(seen, row, np.nan)
            column[-1].plot(x, shown, color=MAIN, linewidth=1.0, alpha=_fading(len(increments)),
                            marker="." if len(x) <= 60 else None, markersize=3)  # fmt: skip
        column[-1].set_ylabel("log-likelihood\nincrement")
        total = np.mean([total_of(row) for row in increments])
        what = "log-likelihood" if len(increments) == 1 else "mean log-likelihood"
        sign = "−" if total < 0 else ""
        title = f"{what} {sign}{abs(total):.6g}"
        column[-1].set_title(title if sizes else "\n".join([*notes, title]))
        bare(column[-1])
        if sizes:
            column[0].set_title("\n".join(notes))
    only_below(axes)
    key(axes, ax)
    return handed(axes)


def _seen(one: Any) -> np.ndarray:
    """(T,) rows of which something was measured; the others add nothing to the likelihood."""
    found = np.zeros(one.sizes["time"], dtype=bool)
    for name, variable in one.data_vars.items():
        if str(name).endswith("_observed"):
            values = variable.transpose("time", ...).values.reshape(len(found), -1)
            found |= np.isfinite(values).any(axis=1)
    return found if found.any() else np.ones(len(found), dtype=bool)


def _fading(count: int) -> float:
    return max(1.0 / count**0.5, 0.1)


def _sizes(one: Any, ax: Any) -> str:
    """The effective sample sizes of one experiment; what is to be said about resampling."""
    x = shown_time(ax, one["time"].values)
    ess, n = one["ess"].transpose("draw", "time").values, int(one.attrs["particles"])
    for row in ess:
        ax.plot(x, row, color=MAIN, linewidth=1.0, alpha=_fading(len(ess)))
    ax.axhline(n, color=FAINT, linewidth=0.8, linestyle=":")
    ax.set_ylim(0.0, 1.04 * n)
    ax.set_ylabel("effective\nsample size")
    bare(ax)
    threshold = float(one.attrs["ess_threshold"])
    if threshold < 1.0:
        ax.axhline(threshold * n, color=OTHER, linewidth=0.9, linestyle="--", label="threshold")
    when = resampled(one)
    if when is None:
        return f"N = {n:,}; history=True tells when resampled"
    if when[:-1].all():
        return f"N = {n:,}, resampled each row"
    at = x[when]
    ax.plot(at, np.full(len(at), 0.02 * n), "|", color=OTHER, markersize=7, label="resampled")
    return f"N = {n:,}, resampled {len(at)} times"


def resampled(one: Any, draw: int = 0) -> np.ndarray | None:
    """(T,) whether the particles were resampled between each row and the next; None: not known."""
    steps = one.sizes["time"]
    found = np.zeros(steps, dtype=bool)
    threshold, proposal = float(one.attrs["ess_threshold"]), str(one.attrs["proposal"])
    if threshold >= 1.0 or one.attrs.get("rescue") or proposal == "tempered":
        found[:-1] = True
    elif proposal in BY_WEIGHT:
        ess = one["ess"].isel(draw=draw).values
        found[:-1] = ess[:-1] < threshold * int(one.attrs["particles"])
    elif "particle_ancestor" in one:
        ancestors = one["particle_ancestor"].isel(draw=draw).transpose("time", "particle").values
        found[:-1] = np.any(ancestors[1:] != np.arange(ancestors.shape[1]), axis=1)
    else:
        return None
    return found


@styled
def plot_ancestry(
    result: Any, *, var_names: Any = None, draw: int = 0, experiment: Any = None,
    ax: Any = None,
) -> Any:  # fmt: skip
    """The genealogy of the particles: lines from each to its ancestor, survivors drawn strongly.

    Every particle of the last row is followed back to the first row, in colour; grey are those that
    left nobody. Where the coloured lines join, the filter's paths have degenerated: earlier states
    are known from one particle only, and `smooth` should be asked for them. Where particles times
    rows are more than 4,000, about 40 particles of each row are drawn, and 40 of the last row are
    followed back; the title counts all of them.

    Parameters
    ----------
    result : what ``ssm.particle_filter(..., history=True)`` returns; without `history` a result
        does not hold the particles.
    var_names : states that are drawn, or components; None: all.
    draw : which of the repeats, from 0.
    experiment : which one, where there are several: its label, or its number from 1.
    ax : Matplotlib axes, as many as there are states; None: a new figure.

    Returns
    -------
    Axes
        Of several states an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : the result does not hold the particles; an unknown state, repeat or experiment.
    """
    one = _chosen(result, filtered(result, "plot_ancestry"), experiment)
    if "particle_ancestor" not in one:
        raise ArgumentError(
            "the result of the filter does not hold its particles and their ancestors",
            fix="run it with ssm.particle_filter(..., history=True)"
            if "ess" in one
            else "exact filters have none: use ssm.particle_filter(..., history=True)",
        )
    if not 0 <= draw < one.sizes["draw"]:
        raise ArgumentError(
            f"draw={draw}, and the filter ran {one.sizes['draw']} times",
            fix=f"give a number from 0 to {one.sizes['draw'] - 1}",
        )
    own = one.isel(draw=draw)
    values: dict[str, np.ndarray] = {}
    for key_, variable in own.data_vars.items():
        name = str(key_)
        if name.endswith("_particles") and "particle" in variable.dims:
            array = variable.transpose("time", "particle", ...).values
            values |= components(
                name.removesuffix("_particles"), array, 2, variable.isel(particle=0)
            )
    states = few(pick(values, var_names, "the states of the filter"), "plot_ancestry")
    ancestors = own["particle_ancestor"].transpose("time", "particle").values
    alive = survivors(ancestors)
    axes = panels("plot_ancestry", len(states), 1, ax, height=2.4)[:, 0]
    for name, panel in zip(states, axes, strict=True):
        _tree(panel, one["time"].values, values[name], ancestors)
        panel.set_ylabel(name)
    axes[0].set_title(_ancestry_title(one["time"].values, alive))
    only_below(axes)
    key(axes, ax)
    return handed(axes)


def _chosen(result: Any, found: list[Any], experiment: Any) -> Any:
    if isinstance(result, Mapping) and not is_dataset(result):
        if experiment in result:
            return result[experiment]
        raise ArgumentError(
            f"experiment={experiment!r}, and the result is of "
            f"{listing(str(experiment), map(str, result))}",
            fix="give the label of one of them",
        )
    if experiment is None and len(found) == 1:
        return found[0]
    if experiment is None or not 1 <= experiment <= len(found):
        raise ArgumentError(
            f"experiment={experiment}, and the result is of {len(found)}",
            fix=f"give a number from 1 to {len(found)}",
        )
    return found[experiment - 1]


def survivors(ancestors: np.ndarray, every: int = 1) -> np.ndarray:
    """(T, N) whether a particle is an ancestor of one in the last row; ancestors (T, N).

    every : of the last row, only every so many are followed.
    """
    alive = np.zeros(ancestors.shape, dtype=bool)
    alive[-1, ::every] = True
    for t in range(len(ancestors) - 1, 0, -1):
        alive[t - 1, ancestors[t, alive[t]]] = True
    return alive


def _ancestry_title(time: np.ndarray, alive: np.ndarray) -> str:
    """How many particles, and since when they have one ancestor in common."""
    n = alive.shape[1]
    common = np.flatnonzero(alive.sum(axis=1) == 1)
    if n > 1 and len(common):
        label = str(time[common[-1]])
        if time.dtype.kind == "M":
            label = str(np.datetime_as_string(time[common[-1]], unit="D"))
        return f"{n:,} particles, with one common ancestor at {label}"
    return f"{n:,} particles, with {int(alive[0].sum()):,} ancestors in the first row"


def _tree(ax: Any, time: np.ndarray, values: np.ndarray, ancestors: np.ndarray) -> None:
    """Edges (t-1, ancestor) to (t, particle), the dead ones first; values (T, N)."""
    from matplotlib.collections import LineCollection

    x = shown_time(ax, time)
    steps, n = values.shape
    every = 1 if steps * n <= MOST_DOTS else max(n // THINNED, 1)
    alive = survivors(ancestors, every)
    dead = ~survivors(ancestors)
    dead[:, np.arange(n) % every > 0] = False
    for chosen, colour, width, strength, label in (
        (dead, FAINT, 0.5, 0.5, "others"), (alive, MAIN, 0.9, 0.8, "ancestors of the last row"),
    ):  # fmt: skip
        t, i = np.nonzero(chosen[1:])
        parent = ancestors[1:][t, i]
        start = np.stack([x[t], values[t, parent]], axis=-1)
        end = np.stack([x[t + 1], values[t + 1, i]], axis=-1)
        edges = list(np.stack([start, end], axis=1))
        lines = LineCollection(
            edges, colors=colour, linewidths=width, alpha=strength, label=label
        )  # fmt: skip
        ax.add_collection(lines, autolim=True)
        if every == 1:
            t, i = np.nonzero(chosen)
            dot = FAINT if colour == FAINT else DATA
            ax.plot(x[t], values[t, i], ".", color=dot, markersize=2.2, alpha=strength)
    ax.autoscale_view()
    bare(ax)
