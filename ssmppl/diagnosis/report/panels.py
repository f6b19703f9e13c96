"""The panels of a report: where the gap is, its causes, how far it closes; alone and put together.

Every panel takes the report and Matplotlib axes, draws, and gives the axes back. Labels of bars
stand above them, so that a panel is readable at the width of a phone. `plot` has all of them in one
figure, `pictures` one for each.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.diagnosis.report.findings import Findings
from ssmppl.diagnosis.report.words import class_letters, marked, row_label, rows
from ssmppl.drawing.numerals import is_number, number, percent
from ssmppl.drawing.style import AFTER, BEFORE, DATA, FAINT, INK, SIGNED, bare, look, times
from ssmppl.errors import ArgumentError

if TYPE_CHECKING:
    import pandas as pd

TITLES = {
    "residual_map": "Where the model and the data disagree",
    "ranked_effects": "Effects that were tried, best first",
    "gap_closed": "Share of the reference model's held-out gain",
    "missing_term": "Estimated missing term",
    "free_run": "Open-loop (free-run) simulation",
    "experiment": "The experiment that would tell them apart",
}

MOST_EQUATIONS, MOST_EFFECTS, MOST_CURVES, MOST_RUNS = 12, 8, 4, 6  # that are drawn
STANDS_OUT = 3.0  # |z| of a cell that gets a sign
LONGEST_NAME = 52  # characters above a bar
WIDE = 6.0  # inches, from which curves stand side by side
DESK = 7.4  # inches: what a column of text is wide
DPI = 170
MOST_TURNS = 60  # of a signal that are drawn
OPAQUE = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
SHARES = (-1.0, 2.0)  # what is shown of F at most


def mapped(report: Findings) -> list[str]:
    """Equations of the residual map, in the order of the table; of many, those that stand out."""
    table = report.residual_map
    names = list(dict.fromkeys(table["equation"]))
    if len(names) > MOST_EQUATIONS:
        strength = table["z"].abs().groupby(table["equation"]).max().fillna(0.0)
        first = set(strength.sort_values(ascending=False).index[:MOST_EQUATIONS])
        names = [n for n in names if n in first]
    return names


def residual_map(report: Findings, ax: Any) -> Any:
    """Standardised smoothed score by equation and window of time; a sign where |z| is at least 3.

    Of more than twelve equations, the twelve with the largest |z|.
    """
    names = mapped(report)
    table = report.residual_map[report.residual_map["equation"].isin(names)]
    largest = float(np.nanmax(np.abs(table["z"].to_numpy(float)), initial=0.0))
    limit = max(4.0, min(np.ceil(largest), 10.0))
    first, last = _windows(table, ax)
    mesh = None
    for i, name in enumerate(names):
        mine = np.flatnonzero((table["equation"] == name).to_numpy())
        mine = mine[np.argsort(first[mine], kind="stable")]
        edges = np.append(first[mine], last[mine[-1]])
        z = table["z"].to_numpy(float)[mine]
        mesh = ax.pcolormesh(
            edges, [i - 0.45, i + 0.45], z[None, :], cmap=SIGNED, vmin=-limit, vmax=limit,
            edgecolors="white", linewidth=0.4,
        )  # fmt: skip
        for j in np.flatnonzero(np.abs(z) >= STANDS_OUT):
            ax.text((edges[j] + edges[j + 1]) / 2, i, "+" if z[j] > 0 else "−", ha="center",
                    va="center", color="white" if abs(z[j]) > 0.6 * limit else INK)  # fmt: skip
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("t" if not _several(table) else "experiment, its windows side by side")
    total = report.residual_map["equation"].nunique()
    if total > len(names):
        ax.set_title(f"{len(names)} of {total} equations, those with the largest |z|")
    bare(ax, ["bottom"])
    if mesh is not None:
        bar = ax.figure.colorbar(mesh, ax=ax, pad=0.02, aspect=12, extend="both")
        bar.set_label("z")
        bar.outline.set_visible(False)
    return ax


def _several(table: Any) -> bool:
    return int(table["experiment"].nunique()) > 1


def _windows(table: Any, ax: Any) -> tuple[np.ndarray, np.ndarray]:
    """Where each window begins and ends on the x axis: by its rows' labels, or, where several
    experiments have labels of their own, by its number, with a line between experiments."""
    if not _several(table):
        ends = times(ax, [*table["t_from"], *table["t_to"]])
        return ends[: len(table)], ends[len(table) :]
    number = table.groupby("equation", sort=False).cumcount().to_numpy(float)
    one = table[table["equation"] == table["equation"].iloc[0]]
    ticks, names = [], []
    for name in dict.fromkeys(one["experiment"]):
        inside = np.flatnonzero((one["experiment"] == name).to_numpy())
        if inside[0]:
            ax.axvline(inside[0], color=INK, linewidth=1.2)
        ticks.append(0.5 * (inside[0] + inside[-1] + 1))
        names.append(name)
    ax.set_xticks(ticks, names)
    return number, number + 1.0


def _name(text: str) -> str:
    return text if len(text) <= LONGEST_NAME else text[: LONGEST_NAME - 1] + "…"


def bars(report: Findings) -> list[dict[str, Any]]:
    """The rows of `causes` that `ranked_effects` shows: one for each effect and equation."""
    return [rows(report.causes)[i] for i in _barred(report)]


def _barred(report: Findings) -> list[int]:
    """Their places in `causes`: of several forms the one that the verdict is about, or the best."""
    best: dict[tuple[Any, Any], int] = {}
    chosen = marked(report)
    for i, r in enumerate(rows(report.causes)):
        own = (r["effect"], r["equation"])
        if own not in best or (i in chosen and best[own] not in chosen):
            best[own] = i
    return list(best.values())[:MOST_EFFECTS]


def ranked_effects(report: Findings, ax: Any) -> Any:
    """Gain of the best effects in nats: filled where refitted, hatched where only predicted.

    The chosen ones are coloured; a letter marks effects that the data cannot tell apart.
    """
    letters, shown = class_letters(report), bars(report)
    chosen = [i in marked(report) for i in _barred(report)]
    for i, r in enumerate(shown):
        refit = is_number(r["gain_refit"])
        gain = float(r["gain_refit"] if refit else r["gain_screen"])
        gain = gain if is_number(gain) else 0.0
        colour = AFTER if chosen[i] else FAINT
        ax.barh(
            i, gain, height=0.42, edgecolor=colour, linewidth=0.8,
            color=colour if refit else "none", hatch=None if refit else "////",
        )  # fmt: skip
        letter = letters.get(r["class_id"], "")
        end = f" {number(gain, 2)}" + (f"  {letter}" if letter else "")
        ax.text(max(gain, 0.0), i, end, va="center", weight="bold" if chosen[i] else "normal")
        form = f", {r['form']}" if isinstance(r["form"], str) and r["form"] else ""
        ax.text(0, i - 0.27, _name(row_label(r) + form), va="bottom", ha="left",
                transform=ax.get_yaxis_transform(),
                weight="bold" if chosen[i] else "normal")  # fmt: skip
    low, high = ax.get_xlim()
    ax.set_xlim(min(low, 0.0), max(high, 1.0) * 1.15)
    ax.set_ylim(len(shown) - 0.6, -0.9)
    ax.set_yticks([])
    ax.axvline(0, color=FAINT, linewidth=0.7)
    ax.set_xlabel("log-likelihood gain (nats)")
    bare(ax, ["bottom"])
    return ax


def gap_closed(report: Findings, ax: Any) -> Any:
    """Share of the reference model's held-out gain that each effect has, with its 95% interval.

    An arrow is where the data do not bound the interval, or where it leaves the axis.
    """
    shown = [r for r in rows(report.closed) if is_number(r["F"])][:MOST_EFFECTS]
    ends = [r[c] for r in shown for c in ("F", "F_low", "F_high") if np.isfinite(r[c])]
    low = max(min([-0.1, *(e - 0.1 for e in ends)]), SHARES[0])
    high = min(max([1.1, *(e + 0.1 for e in ends)]), SHARES[1])
    for i, r in enumerate(shown):
        colour = AFTER if i == 0 else FAINT
        if is_number(r["F_low"]) and is_number(r["F_high"]):
            a, b = max(r["F_low"], low), min(r["F_high"], high)
            ax.plot([a, b], [i, i], color=colour, linewidth=2.2, solid_capstyle="butt")
            for end, at, marker in ((r["F_low"], low, "<"), (r["F_high"], high, ">")):
                if end < low or end > high:
                    ax.plot(at, i, marker, color=colour, markersize=6, clip_on=False)
        ax.plot(np.clip(r["F"], low, high), i, "o", color=colour, markersize=7, zorder=3)
        ax.text(low, i - 0.27, _name(f"{r['effect']}: {percent(r['F'])}"), va="bottom", ha="left",
                weight="bold" if i == 0 else "normal", bbox=OPAQUE)  # fmt: skip
    for at in (0.0, 1.0):
        ax.axvline(at, color=FAINT, linewidth=0.8, linestyle=":", zorder=0)
    ax.set_xlim(low, high)
    ax.set_ylim(len(shown) - 0.6, -0.9)
    ax.set_yticks([])
    ax.xaxis.set_major_formatter(lambda x, _: percent(x))
    ax.set_xlabel("share of the reference model's held-out gain, 95% interval")
    bare(ax, ["bottom"])
    return ax


def curves(report: Findings) -> list[tuple[Any, Any]]:
    """(equation, variable) of each estimated curve."""
    if report.missing is None:
        return []
    return list(dict.fromkeys(zip(report.missing["equation"], report.missing["variable"],
                                  strict=True)))  # fmt: skip


def missing_term(report: Findings, ax: Any, equation: Any = None, variable: Any = None) -> Any:
    """Estimated curve of what an equation lacks, over one variable, with its 95% band.

    Without names, the first curve.
    """
    known = curves(report)
    found = [(e, v) for e, v in known if equation in (None, e) and variable in (None, v)]
    if not found or report.missing is None:
        raise ArgumentError(
            f"the report has no curve of {equation!r} over {variable!r}",
            fix=f"it has: {', '.join(f'{e} over {v}' for e, v in known) or 'none'}",
        )
    equation, variable = found[0]
    table = report.missing
    table = table[(table["equation"] == equation) & (table["variable"] == variable)]
    x = times(ax, table["value"])
    order = np.argsort(x, kind="stable")
    low, mid, high = (table[c].to_numpy(float)[order] for c in ("low", "estimate", "high"))
    ax.axhline(0, color=FAINT, linewidth=0.8, linestyle="--")
    ax.fill_between(x[order], low, high, color=AFTER, alpha=0.2, linewidth=0)
    ax.plot(x[order], mid, color=AFTER, linewidth=1.6)
    ax.margins(x=0)
    ax.set_xlabel(str(variable))
    ax.set_ylabel(f"estimated missing term in {equation}")
    bare(ax)
    return ax


def runs(report: Findings) -> list[tuple[Any, Any]]:
    """(experiment, channel) of each free run."""
    table = report.free_run
    return list(dict.fromkeys(zip(table["experiment"], table["channel"], strict=True)))


def _curve(ax: Any, x: np.ndarray, table: pd.DataFrame, name: str, colour: str, style: str,
           text: str) -> None:  # fmt: skip
    y = table[name].to_numpy(float)
    if np.isnan(y).all():
        return
    low, high = table[f"{name}_low"].to_numpy(float), table[f"{name}_high"].to_numpy(float)
    ax.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
    ax.plot(x, y, style, color=colour, linewidth=1.4, label=text)


def _limits(table: pd.DataFrame, drawn: tuple[float, float]) -> tuple[float, float]:
    """What is drawn, but no further from the data than once their range: some models run away."""
    seen = table[["observed", "after"]].to_numpy(float)
    if np.isnan(seen).all():
        return drawn
    low, high = float(np.nanmin(seen)), float(np.nanmax(seen))
    room = high - low or 1.0
    return max(drawn[0], low - room), min(drawn[1], high + room)


def free_run(
    report: Findings, ax: Any, experiment: Any = None, channel: Any = None, last: int = 300
) -> Any:
    """The data of one channel, and both models simulated without seeing them, with 95% bands.

    Without names, the first channel of the first experiment. `last`: how many rows at the end are
    drawn, where errors have had the longest time to add up.
    """
    known = runs(report)
    found = [(e, c) for e, c in known if experiment in (None, e) and channel in (None, c)]
    if not found:
        raise ArgumentError(
            f"the report has no free run of channel {channel!r} in experiment {experiment!r}",
            fix=f"it has: {', '.join(f'{c} in {e}' for e, c in known) or 'none'}",
        )
    experiment, channel = found[0]
    table = report.free_run
    table = table[(table["experiment"] == experiment) & (table["channel"] == channel)]
    total, table = len(table), table.tail(last)
    x = times(ax, table["t"])
    _curve(ax, x, table, "before", BEFORE, "--", "original model")
    _curve(ax, x, table, "after", AFTER, "-", "augmented model")
    ax.plot(x, table["observed"].to_numpy(float), ".", color=DATA, markersize=2.5, label="data")
    notes = [f"experiment {experiment}"] * (len({e for e, _ in known}) > 1)
    notes += [f"last {last:,} of {total:,} rows"] * (total > last)
    ax.set_title(", ".join(notes))
    ax.margins(x=0.01)
    ax.set_ylim(*_limits(table, ax.get_ylim()))
    ax.set_xlabel("t")
    ax.set_ylabel(str(channel))
    bare(ax)
    return ax


def _drawn_rows(values: np.ndarray) -> int:
    """How many rows of a signal (T,) are drawn: as many as it takes to turn round `MOST_TURNS`
    times."""
    steps = np.diff(values)
    moving = np.flatnonzero(steps)
    turns = moving[1:][np.diff(np.sign(steps[moving])) != 0.0]
    return len(values) if len(turns) <= MOST_TURNS else int(turns[MOST_TURNS]) + 1


def separating_signal(report: Findings, ax: Any) -> Any:
    """The signal that would tell the rivals apart, and the recorded one, held over each row.

    Raises
    ------
    ArgumentError : the report has no experiment.
    """
    found = report.separation
    if found is None or found.inputs is None or report.experiment is None:
        raise ArgumentError(
            "the report has no experiment to draw",
            fix="look at report.separation, which says why",
        )
    table = report.experiment
    varied = int(np.argmax(np.any(found.inputs != found.recorded_inputs, axis=0)))
    now, before = found.inputs[:, varied], found.recorded_inputs[:, varied]
    rows = _drawn_rows(now)
    x = times(ax, table["time"] if "time" in table else np.arange(1, found.rows + 1))[:rows]
    ax.step(x, before[:rows], where="post", color=FAINT, linewidth=0.8, label="recorded")
    ax.step(x, now[:rows], where="post", color=AFTER, linewidth=1.4, label="experiment")
    ax.set_title(f"first {rows:,} of {found.rows:,} rows" if rows < found.rows else "")
    ax.margins(x=0.01)
    ax.set_xlabel("t")
    ax.set_ylabel(found.best.input if found.best else "")
    bare(ax)
    return ax


def plot(report: Findings) -> Any:
    """All panels that the report has something for, below each other, as a pyplot figure."""
    from matplotlib import pyplot

    with look():
        width = 8.0
        sizes = {name: height for name in TITLES if (height := _height(report, name, width))}
        figure = pyplot.figure(figsize=(width, sum(sizes.values()) or 1.0), layout="constrained")
        if not sizes:
            figure.text(0.5, 0.5, "Nothing to draw.", ha="center", va="center")
            return figure
        parts = figure.subfigures(len(sizes), 1, height_ratios=list(sizes.values()), squeeze=False)
        for (name, _), part in zip(sizes.items(), parts[:, 0], strict=True):
            part.suptitle(TITLES[name], x=0.01, ha="left", weight="bold", fontsize=10.5)
            _draw(report, name, part, width)
    return figure


def panel_figures(report: Findings, width: float) -> dict[str, Any]:
    """Each panel that the report has something for, as a figure of its own, `width` inches wide.

    The figures belong to no window, and need not be closed.
    """
    from matplotlib.figure import Figure

    found: dict[str, Any] = {}
    with look():
        for name in TITLES:
            with report.failures.guard(f"the panel {name!r}"):
                height = _height(report, name, width)
                if height:
                    figure = Figure(figsize=(width, height), layout="constrained")
                    _draw(report, name, figure, width)
                    found[name] = figure
    return found


def pictures(report: Findings, width: float = DESK) -> dict[str, bytes]:
    """`panel_figures` as PNG files."""
    found = {}
    for name, figure in panel_figures(report, width).items():
        with report.failures.guard(f"the panel {name!r}"):
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=DPI)
            found[name] = buffer.getvalue()
    return found


def _legend(figure: Any, ax: Any) -> None:
    """The legend of the axes, below the figure."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=3, frameon=False,
                  handlelength=1.6, columnspacing=1.2, borderaxespad=0.2)  # fmt: skip


def _height(report: Findings, name: str, width: float) -> float:
    """Height in inches; 0 where there is nothing to draw."""
    if name == "residual_map":
        return 0.7 + 0.3 * max(len(mapped(report)), 3) if len(report.residual_map) else 0.0
    if name == "ranked_effects":
        return 0.75 + 0.42 * len(bars(report)) if len(report.causes) else 0.0
    if name == "gap_closed":
        shown = sum(is_number(f) for f in report.closed["F"])
        return 0.75 + 0.42 * min(shown, MOST_EFFECTS) if shown else 0.0
    if name == "missing_term":
        lines, _ = _grid(len(curves(report)[:MOST_CURVES]), width)
        return 2.4 * lines
    if name == "experiment":
        return 2.3 if report.experiment is not None and report.separation is not None else 0.0
    count = len(runs(report)[:MOST_RUNS])
    return 0.5 + 2.0 * count if count else 0.0


def _grid(count: int, width: float) -> tuple[int, int]:
    across = 1 if width < WIDE or count < 2 else 2
    return -(-count // across), across


def _draw(report: Findings, name: str, figure: Any, width: float) -> None:
    if name == "missing_term":
        known = curves(report)[:MOST_CURVES]
        axes = figure.subplots(*_grid(len(known), width), squeeze=False).ravel()
        for ax, (equation, variable) in zip(axes, known, strict=False):
            missing_term(report, ax, equation, variable)
        for ax in axes[len(known) :]:
            ax.set_axis_off()
    elif name == "free_run":
        known = runs(report)[:MOST_RUNS]
        axes = figure.subplots(len(known), 1, squeeze=False).ravel()
        for ax, (experiment, channel) in zip(axes, known, strict=True):
            free_run(report, ax, experiment, channel)
            if ax is not axes[-1]:
                ax.set_xlabel("")
        _legend(figure, axes[0])
    else:
        panel = {
            "residual_map": residual_map,
            "ranked_effects": ranked_effects,
            "gap_closed": gap_closed,
            "experiment": separating_signal,
        }[name]
        ax = panel(report, figure.subplots())
        if name == "experiment":
            _legend(figure, ax)
