"""`plot_predictions`: one-step predictive intervals over the data, and PIT values."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.drawing.style import FAINT, MAIN, bare
from ssmppl.errors import ArgumentError
from ssmppl.inference.verbs.predict import group
from ssmppl.plots.drawing import dots, fan, few, handed, key, only_below, panels, shown_time, styled
from ssmppl.plots.filters import filtered, titles
from ssmppl.plots.reading import (
    Record,
    components,
    drawn_of,
    is_inference_data,
    is_prediction,
    pick,
    quantiles_at_levels,
    wrong_kind,
)

__all__ = ["pit_band", "plot_predictions"]

BINS = 10
PREDICTIVE = ("posterior_predictive", "prior_predictive")
WANTED = (
    "give what ssm.particle_filter, ssm.kalman_filter, ssm.forward_filter or ssm.predict returns"
)


@styled
def plot_predictions(result: Any, *, var_names: Any = None, ax: Any = None) -> Any:
    """One-step predictions with 50% and 90% bands over the observations, and their PIT values.

    Left, the observations and what the filter expected of each row given the rows before it: bands
    between the quantiles ``y_predicted_quantile``. Right, a histogram of P(Y_t <= y_t given
    y_1:t-1) over all rows and experiments: level if the model is right. The grey band is where
    nine in ten bars of as many uniform values lie. A bar too high in the middle: predictions too
    wide; at both ends: too narrow; at one end: biased.

    Of `predict`, the bands are quantiles of the draws, and there is no histogram, as those know the
    rows that they would be compared with.

    Parameters
    ----------
    result : what `particle_filter`, `kalman_filter` or `forward_filter` returns, with the levels of
        quantiles that they have by default (of several repeats the first is drawn), or `predict`.
    var_names : names of the channels that are drawn, or of components; None: all.
    ax : Matplotlib axes, one row of them for each channel; None: a new figure.

    Returns
    -------
    Axes
        Of several panels an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : the result holds no predictions, not at these levels, or no such channel; `ax`
        are not as many.

    References
    ----------
    A. P. Dawid, *Journal of the Royal Statistical Society* A 147 (1984); for counts C. Czado,
    T. Gneiting and L. Held, *Biometrics* 65 (2009).
    """
    found, pits = (_drawn(result), []) if is_inference_data(result) else _of_filter(result)
    channels = pick(found[0].states, var_names, "the channels of the result")
    channels = few(channels, "plot_predictions")
    right = any(pits)
    ratios = [2.6 / len(found)] * len(found) + [1.0] * right
    axes = panels("plot_predictions", len(channels), len(found) + right, ax, height=2.0,
                  share=not right, ratios=ratios, width=8.0 + 2.5 * (len(found) > 2))  # fmt: skip
    for k, (name, row) in enumerate(zip(channels, axes, strict=True)):
        last = k == len(channels) - 1
        for record, one in zip(found, row, strict=False):
            x = shown_time(one, record.time)
            fan(one, x, record.states[name], label="predicted: median, 50% and 90%")
            if name in record.data:
                dots(one, x, record.data[name])
                _limits(one, record, name)
            one.set_ylabel(name if record is found[0] else "")
        if right:
            pit = np.concatenate([p[name] for p in pits])
            _histogram(row[-1], pit[np.isfinite(pit)], last)
        if not last:
            for one in row[: len(found)]:
                one.set_xlabel("")
    for one, title in zip(axes[0], [r.name for r in found], strict=False):
        one.set_title(title)
    only_below(axes)
    key(axes, ax)
    return handed(axes)


def _of_filter(result: Any) -> tuple[list[Record], list[dict[str, np.ndarray]]]:
    """Bands and data, and PIT values, of each experiment."""
    found = filtered(result, "plot_predictions")
    records, pits = [], []
    for one, title in zip(found, titles(result), strict=True):
        own = one.isel(draw=0)
        states: dict[str, np.ndarray] = {}
        data: dict[str, np.ndarray] = {}
        pit: dict[str, np.ndarray] = {}
        for key_ in own.data_vars:
            name = str(key_).removesuffix("_predicted")
            if not is_prediction(own, str(key_)):
                continue
            if f"{key_}_quantile" not in own:
                raise ArgumentError(
                    f"the result of the filter has no quantiles of the predictions of {name!r}",
                    fix="run it again, without quantiles=",
                )
            states |= quantiles_at_levels(one, str(key_), name, "plot_predictions")
            if f"{name}_observed" in own:
                data |= components(name, own[f"{name}_observed"].values, 1, own[f"{name}_observed"])
            pit |= components(name, own[f"{name}_pit"].values, 1, own[f"{name}_pit"])
        if not states:
            raise wrong_kind("plot_predictions", one, WANTED)
        records.append(Record(title, one["time"].values, states, data))
        pits.append(pit)
    return records, pits


def _drawn(idata: Any) -> list[Record]:
    """Bands of predictive draws and the data, of each experiment."""
    names = [n for n in PREDICTIVE if group(idata, n) is not None]
    if not names:
        raise wrong_kind("plot_predictions", idata, WANTED)
    found = drawn_of(idata, group(idata, names[0]))
    if not found[0].states:
        raise ArgumentError(f"the group {names[0]!r} has no variable over time", fix=WANTED)
    return found


def _limits(ax: Any, record: Record, name: str) -> None:
    """Room for the data and the bands, but no more than what lets the data be seen: the first
    predictions of a vague initial distribution are far wider than all others."""
    y, outer = record.data[name], record.states[name][[0, 4]]
    y = y[np.isfinite(y)]
    if not len(y) or not np.isfinite(outer).any():
        return
    low, high = y.min(), y.max()
    room = 0.75 * (high - low) or 1.0
    ends = outer[:, np.isfinite(outer).all(axis=0)]
    if not ends.size:
        return
    low, high = (min(low, max(ends[0].min(), low - room)),
                 max(high, min(ends[1].max(), high + room)))  # fmt: skip
    margin = 0.04 * (high - low) or 0.5
    ax.set_ylim(low - margin, high + margin)


def pit_band(count: int, bins: int = BINS, share: float = 0.9) -> tuple[float, float]:
    """Ends of the band that holds a bar of the histogram of uniform values with this probability.

    A bar is binomial, with `count` trials of probability 1 / bins.
    """
    from scipy.stats import binom

    tail = 0.5 * (1.0 - share)
    low, high = binom.ppf([tail, 1.0 - tail], count, 1.0 / bins)
    return float(low), float(high)


def _histogram(ax: Any, pit: np.ndarray, named: bool) -> None:
    if len(pit):
        ax.axhspan(*pit_band(len(pit)), color=FAINT, alpha=0.3, linewidth=0, zorder=0)
        ax.axhline(len(pit) / BINS, color=FAINT, linewidth=0.8, zorder=0)
        counts, edges = np.histogram(pit, bins=BINS, range=(0.0, 1.0))
        ax.bar(edges[:-1], counts, width=np.diff(edges), align="edge", color=MAIN, alpha=0.6,
               edgecolor="white", linewidth=0.6)  # fmt: skip
        ax.set_ylim(0.0, 1.08 * max(counts.max(), pit_band(len(pit))[1]))
    else:
        ax.text(0.5, 0.5, "no PIT values", ha="center", va="center", transform=ax.transAxes)
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("PIT" if named else "")
    ax.set_ylabel("rows")
    ax.locator_params(axis="y", integer=True)
    bare(ax)
