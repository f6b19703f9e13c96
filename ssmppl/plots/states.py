"""`plot_states` and `plot_forecast`: states, data and what comes after them, over time."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.drawing.style import FAINT, OTHER
from ssmppl.errors import ArgumentError
from ssmppl.inference.verbs.predict import group
from ssmppl.plots.drawing import (
    dots,
    fan,
    few,
    handed,
    key,
    line,
    multiples,
    only_below,
    panels,
    shown_time,
    styled,
)
from ssmppl.plots.reading import (
    Record,
    bands,
    components,
    experiment_name,
    is_dataset,
    is_inference_data,
    pick,
    records,
    wrong_kind,
)

__all__ = ["plot_forecast", "plot_states"]

LEAST_PAST = 30  # rows of the data before a forecast, at least


@styled
def plot_states(result: Any, *, var_names: Any = None, ax: Any = None) -> Any:
    """States over time with their 50% and 90% bands, over the data.

    Data are drawn over a state where that state is their mean, as in ``Normal(x, sd=...)``, and so
    in the same units; other channels, and the inputs, have panels of their own below. Components of
    vectors are small multiples, several experiments stand side by side. Missing values are left
    out.

    Parameters
    ----------
    result : what `sample` returns, with states; or `smooth`, or a filter (whose bands know the past
        only).
    var_names : names of the states, channels and inputs that are drawn, or of components ("x[1]");
        None: all.
    ax : Matplotlib axes, as many as there are panels; None: a new figure.

    Returns
    -------
    Axes
        Of several panels an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : the result holds no states, has no such variable, or `ax` are not as many.
    """
    found = records(result, "plot_states")
    kinds = _kinds(found[0])
    rows = pick(kinds, var_names, "the states, channels and inputs of the result")
    if var_names is None:  # channels over a state need no panel of their own
        rows = [r for r in rows if kinds[r] != "data" or r not in found[0].observes]
    rows = few(rows, "plot_states")
    if len(found) == 1:
        axes = multiples("plot_states", len(rows), ax)
        columns = [axes]
    else:
        axes = panels("plot_states", len(rows), len(found), ax, width=max(8.0, 3.0 * len(found)))
        columns = list(axes.T)
    for record, column in zip(found, columns, strict=True):
        for name, one in zip(rows, column, strict=True):
            _draw(record, kinds[name], name, one)
        column[0].set_title(record.name)
    only_below(axes)
    key(axes, ax)
    return handed(axes)


def _kinds(record: Record) -> dict[str, str]:
    """What each name of an experiment is; where a name is two things, the first."""
    found = dict.fromkeys(record.states, "state")
    for kind, names in (("data", record.data), ("input", record.inputs)):
        for name in names:
            found.setdefault(name, kind)
    return found


def _draw(record: Record, kind: str, name: str, ax: Any) -> None:
    """One panel of one experiment."""
    x = shown_time(ax, record.time)
    if kind == "state":
        fan(ax, x, record.states[name])
        for channel, state in record.observes.items():
            if state == name and channel in record.data:
                dots(ax, x, record.data[channel])
    elif kind == "data":
        dots(ax, x, record.data[name])
    else:
        line(ax, x, record.inputs[name], steps=len(x) < 400)
    ax.set_ylabel(name)


@styled
def plot_forecast(
    result: Any, idata: Any = None, *, var_names: Any = None, past: int | None = None,
    ax: Any = None,
) -> Any:  # fmt: skip
    """Draws of the rows after the data, as a fan of 50% and 90% bands, next to what was before.

    Parameters
    ----------
    result : what `forecast` returns.
    idata : what `sample` returned, from which it was made: its data, and the bands of its states,
        are drawn before the fan; None: the fan alone.
    var_names : names of states and channels that are drawn, or of components; None: all.
    past : how many rows of the data are drawn; None: four times those of the forecast, but at least
        30.
    ax : Matplotlib axes, as many as there are panels; None: a new figure.

    Returns
    -------
    Axes
        Of several panels an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : the result is no forecast, or is of other data than `idata`; an unknown name.
    """
    wanted = "give what ssm.forecast returns, and as the second argument the posterior"
    if not is_dataset(result) or not {"draw", "time"} <= set(map(str, result.dims)) \
            or not ("after" in result.attrs or "after" in result.coords):  # fmt: skip
        raise wrong_kind("plot_forecast", result, wanted)
    if any({"experiment", "time"} <= set(v.dims) for v in result.data_vars.values()):
        label = result["experiment"].values.tolist()[0]
        raise ArgumentError(
            f"plot_forecast draws one experiment, and the forecast is of "
            f"{result.sizes['experiment']}",
            fix=f"give ssm.forecast(..., experiment={label!r})",
        )
    ahead: dict[str, np.ndarray] = {}
    for name, variable in result.data_vars.items():
        if variable.dims[:2] == ("draw", "time"):
            ahead |= {k: bands(v) for k, v in components(str(name), variable.values, 2, variable)}
    before = None if idata is None else _before(idata, result)
    rows = few(pick(ahead, var_names, "the states and channels of the forecast"), "plot_forecast")
    past = max(4 * result.sizes["time"], LEAST_PAST) if past is None else past
    if past < 0:
        raise ArgumentError(f"past={past}", fix="give how many rows of the data are drawn, or None")
    axes = multiples("plot_forecast", len(rows), ax)
    for name, one in zip(rows, axes, strict=True):
        time = result["time"].values
        if before is not None:
            joined = _joined(before.time, time)
            x = shown_time(one, joined)
            shown = slice(max(len(before.time) - past, 0), len(before.time))
            seen, x = x[shown], x[len(before.time) :]
            if name in before.states:
                fan(one, seen, before.states[name][:, shown], label="given the data")
                for channel, state in before.observes.items():
                    if state == name and channel in before.data:
                        dots(one, seen, before.data[channel][shown])
            elif name in before.data:
                dots(one, seen, before.data[name][shown])
            if len(seen):
                one.axvline(0.5 * (seen[-1] + x[0]), color=FAINT, linewidth=0.8, linestyle=":")
        else:
            x = shown_time(one, time)
        fan(one, x, ahead[name], OTHER, "--", "forecast: median, 50% and 90%")
        one.set_ylabel(name)
    only_below(axes)
    key(axes, ax)
    return handed(axes)


def _before(idata: Any, result: Any) -> Record:
    """The experiment that was continued."""
    if not is_inference_data(idata) or group(idata, "posterior") is None:
        raise wrong_kind("plot_forecast", idata, "as the second argument give what ssm.sample "
                         "returned, or leave it out")  # fmt: skip
    which = experiment_name(str(result.attrs.get("experiment", 1)))
    found = [r for r in records(idata, "plot_forecast") if r.name in ("", which)]
    if not found or len(found[0].time) != int(result.attrs["after"]):
        rows = ", ".join(str(len(r.time)) for r in records(idata, "plot_forecast"))
        raise ArgumentError(
            f"the forecast follows {int(result.attrs['after'])} rows of {which}, and "
            f"the posterior is of {rows} rows",
            fix="give the posterior that the forecast was made from",
        )
    return found[0]


def _joined(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Labels of both, one after the other; row numbers where they are of different kinds."""
    ordered = "iufM"
    dates = [a.dtype.kind == "M" for a in (before, after)]
    if before.dtype.kind in ordered and after.dtype.kind in ordered and dates[0] == dates[1]:
        joined = np.concatenate([before, after])
        if np.all(joined[1:] > joined[:-1]):
            return joined
    return np.arange(1, len(before) + len(after) + 1)
