"""The panels of a report: what they draw is what the tables hold, and all of it can be read."""

import dataclasses

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.text import Text

import ssmppl.plots as plots
from ssmppl.diagnosis.report.findings import COLUMNS, tabulate
from ssmppl.diagnosis.report.panels import TITLES
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.drawing.style import AFTER, BEFORE, times
from ssmppl.errors import ArgumentError
from tests.diagnosis.made_up import (
    ALL,
    NAN,
    break_of_level,
    effect_found,
    fast,
    no_gap,
    none_of_these,
    separation,
    several,
    with_experiment,
)

mpl.use("Agg")


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def labels(ax):
    return [t.get_text() for t in ax.texts]


def lines(ax):
    """Drawn curves by label."""
    return {line.get_label(): line for line in ax.lines}


# -- residual map
def test_the_map_draws_z_of_each_equation_and_signs_what_stands_out(ax):
    report = several()
    plots.residual_map(report, ax)
    table = report.residual_map
    names = list(dict.fromkeys(table["equation"]))
    meshes = [c for c in ax.collections if isinstance(c, QuadMesh)]
    drawn = dict(zip([t.get_text() for t in ax.get_yticklabels()], meshes, strict=True))
    assert list(drawn) == names
    for name in names:
        np.testing.assert_array_equal(
            np.ravel(drawn[name].get_array()), table["z"][table["equation"] == name]
        )
    assert len(labels(ax)) == (table["z"].abs() >= 3).sum()
    low, high = meshes[0].get_clim()
    assert low == -high  # no colour for zero
    assert high >= min(table["z"].abs().max(), 10)


def test_of_many_equations_the_map_shows_those_that_stand_out(ax):
    names = [f"x[{i}]" for i in range(30)]
    rows = [{"equation": n, "t_from": 1, "t_to": 9, "z": i / 10} for i, n in enumerate(names)]
    report = dataclasses.replace(no_gap(), residual_map=tabulate("residual_map", rows))
    plots.residual_map(report, ax)
    assert [t.get_text() for t in ax.get_yticklabels()] == names[18:]
    assert ax.get_title(loc="left").startswith("12 of 30") or "12 of 30" in ax.get_title()


@pytest.mark.parametrize("z", [NAN, 0.0, 300.0])
def test_the_map_bears_any_z(ax, z):
    report = no_gap()
    changed = dataclasses.replace(report, residual_map=report.residual_map.assign(z=z))
    plots.residual_map(changed, ax)
    ax.figure.draw_without_rendering()


# -- ranked effects
def test_bars_are_the_gains_refitted_ones_filled_the_chosen_coloured(ax):
    plots.ranked_effects(effect_found(), ax)
    # one bar for each effect and equation: of the two forms of friction the better one
    assert [round(bar.get_width(), 6) for bar in ax.patches] == [24.3, 22.9, 10.1, 3.9, 1.6, 0.2,
                                                                0.0, 0.0]  # fmt: skip
    hatched = [bar.get_hatch() is not None for bar in ax.patches]
    assert hatched == [False, False, False, False, True, True, True, True]
    coloured = [bar.get_edgecolor()[:3] == to_rgba(AFTER)[:3] for bar in ax.patches]
    assert coloured == [True] + [False] * 7
    assert " 24  A" in labels(ax)
    assert "coulomb friction in v, v0 = 0.2" in labels(ax)


def test_two_chosen_effects_are_both_coloured(ax):
    plots.ranked_effects(several(), ax)
    coloured = [bar.get_edgecolor()[:3] == to_rgba(AFTER)[:3] for bar in ax.patches]
    assert coloured == [True, True] + [False] * 6


def test_ranked_effects_bear_missing_and_negative_gains(ax):
    report = fast()
    causes = report.causes.assign(gain_screen=[NAN, -3.0, *[0.0] * 7])
    plots.ranked_effects(dataclasses.replace(report, causes=causes), ax)
    ax.figure.draw_without_rendering()
    assert ax.get_xlim()[0] <= -3.0


# -- gap closed
def test_shares_stand_at_f_with_their_intervals(ax):
    report = effect_found()
    plots.gap_closed(report, ax)
    dots = [line for line in ax.lines if line.get_marker() == "o"]
    bars = [line for line in ax.lines if len(line.get_xdata()) == 2 and line.get_lw() > 2]
    np.testing.assert_allclose([d.get_xdata()[0] for d in dots], report.closed["F"].dropna())
    np.testing.assert_allclose([b.get_xdata()[0] for b in bars], report.closed["F_low"].dropna())
    np.testing.assert_allclose([b.get_xdata()[1] for b in bars], report.closed["F_high"].dropna())
    assert not [line for line in ax.lines if line.get_marker() in "<>"]


@pytest.mark.parametrize(
    ("low", "high", "arrows"),
    [(0.4, np.inf, ">"), (-np.inf, 0.9, "<"), (-np.inf, np.inf, "<>"), (0.4, 7.0, ">"),
     (NAN, NAN, "")],
)  # fmt: skip
def test_an_arrow_stands_where_an_interval_is_not_bounded(ax, low, high, arrows):
    report = break_of_level()
    closed = report.closed.assign(F_low=low, F_high=high)
    plots.gap_closed(dataclasses.replace(report, closed=closed), ax)
    marks = [line.get_marker() for line in ax.lines if line.get_marker() in ("<", ">")]
    assert "".join(marks) == arrows
    assert np.isfinite(ax.get_xlim()).all()


# -- missing term
def test_the_missing_term_is_the_curve_and_its_band(ax):
    report = none_of_these()
    plots.missing_term(report, ax, variable="u")
    table = report.missing[report.missing["variable"] == "u"]
    curve = ax.lines[-1]
    np.testing.assert_array_equal(curve.get_xdata(), table["value"])
    np.testing.assert_array_equal(curve.get_ydata(), table["estimate"])
    corners = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert corners.min() == pytest.approx(table["low"].min())
    assert corners.max() == pytest.approx(table["high"].max())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("u", "estimated missing term in v")
    with pytest.raises(ArgumentError, match="v over x, v over u"):
        plots.missing_term(report, ax, variable="w")
    with pytest.raises(ArgumentError, match="none"):
        plots.missing_term(no_gap(), ax)


# -- free run
def test_the_free_run_draws_the_last_rows_of_data_and_both_models(ax):
    report = effect_found()
    plots.free_run(report, ax, last=120)
    tail = report.free_run.tail(120)
    found = lines(ax)
    for label, column in (("data", "observed"), ("original model", "before"),
                          ("augmented model", "after")):  # fmt: skip
        np.testing.assert_array_equal(found[label].get_xdata(), tail["t"])
        np.testing.assert_array_equal(found[label].get_ydata(), tail[column])
    # told apart without colours, too
    styles = {found[n].get_linestyle() for n in ("original model", "augmented model")}
    assert len(styles) == 2
    assert found["original model"].get_color() == BEFORE
    assert "last 120 of 1,000 rows" in ax.get_title(loc="left") + ax.get_title()


def test_the_free_run_of_one_experiment_and_channel(ax):
    report = several()
    plots.free_run(report, ax, "day 2", "z2")
    rows = report.free_run.query("experiment == 'day 2' and channel == 'z2'")
    np.testing.assert_array_equal(lines(ax)["data"].get_ydata(), rows["observed"].tail(300))
    with pytest.raises(ArgumentError, match="z<1> in day 1"):
        plots.free_run(report, ax, "day 3")


def test_without_a_model_after_there_is_no_line_for_it(ax):
    plots.free_run(no_gap(), ax)
    assert "augmented model" not in lines(ax)


def test_a_model_that_runs_away_does_not_hide_the_data(ax):
    report = effect_found()
    runs = report.free_run
    runs = runs.assign(before=runs["before"] + np.exp(np.arange(len(runs)) / 20.0))
    plots.free_run(dataclasses.replace(report, free_run=runs), ax)
    seen = runs[["observed", "after"]].tail(300).to_numpy()
    low, high = ax.get_ylim()
    assert high - low <= 3.01 * np.ptp(seen)
    assert low <= seen.min()
    assert high >= seen.max()


@pytest.mark.parametrize(
    "time",
    [pd.date_range("2024-01-01", periods=1000, freq="h"), [f"row {i}" for i in range(1000)]],
    ids=["dates", "text"],
)
def test_rows_may_be_labelled_by_dates_and_by_text(ax, time):
    report = effect_found()
    changed = dataclasses.replace(report, free_run=report.free_run.assign(t=time))
    plots.free_run(changed, ax)
    ax.figure.draw_without_rendering()
    x = lines(ax)["data"].get_xdata()
    assert (np.diff(x) > 0).all()
    shown = "".join(t.get_text() for t in ax.get_xticklabels())
    assert ("row" in shown) if isinstance(time, list) else ("Feb" in shown)


@pytest.mark.parametrize("days", [1.5, 40, 500, 800, 1090, 1100, 20000])
def test_dates_of_any_span_get_a_few_ticks_without_a_warning(ax, recwarn, days):
    dates = pd.date_range("2021-01-04", periods=156, freq=pd.Timedelta(days=days / 155))
    ax.plot(times(ax, dates), np.zeros(156))
    ax.figure.draw_without_rendering()
    assert 2 <= len(ax.get_xticks()) <= 9
    assert not [w for w in recwarn if "Locator" in str(w.message)]


# -- put together
def unreadable(figure, monkeypatch):
    """Texts that are drawn and do not lie inside of the figure, or are smaller than 8 points."""
    drawn, draw = [], Text.draw
    figure.draw_without_rendering()  # lays out
    with monkeypatch.context() as patched:
        patched.setattr(Text, "draw", lambda self, *a: (drawn.append(self), draw(self, *a))[1])
        FigureCanvasAgg(figure).draw()
    box, out = figure.bbox, []
    assert drawn
    for text in (t for t in drawn if t.get_visible() and t.get_text().strip()):
        extent = text.get_window_extent()
        inside = (extent.x0 >= box.x0 - 1 and extent.x1 <= box.x1 + 1
                  and extent.y0 >= box.y0 - 1 and extent.y1 <= box.y1 + 1)  # fmt: skip
        if not inside or text.get_fontsize() < 8:
            out.append(text.get_text())
    return out


@pytest.mark.parametrize("name", ["effect_found", "several", "break_of_level"])
def test_all_text_fits_on_a_phone(name, monkeypatch):
    for figure in plots.panel_figures(ALL[name](), 4.1).values():
        assert unreadable(figure, monkeypatch) == []


# -- the experiment
def test_the_experiment_is_drawn_over_the_recorded_input(ax):
    report = with_experiment()
    plots.separating_signal(report, ax)
    found = lines(ax)
    np.testing.assert_array_equal(found["experiment"].get_ydata(), report.experiment["u"])
    recorded = report.separation.recorded_inputs[:, 0]
    np.testing.assert_array_equal(found["recorded"].get_ydata(), recorded)
    np.testing.assert_array_equal(found["experiment"].get_xdata(), np.arange(1, 401))
    assert found["experiment"].get_drawstyle() == "steps-post"
    assert ax.get_ylabel() == "u"
    assert ax.get_title() == ""


def test_the_input_that_is_varied_is_drawn_by_the_labels_of_its_rows(ax):
    """The second of two, whose other stays."""
    report = with_experiment()
    found = report.separation
    swapped = dataclasses.replace(
        found, inputs=found.inputs[:, ::-1], recorded_inputs=found.recorded_inputs[:, ::-1]
    )
    table = report.experiment.assign(time=0.5 * np.arange(400))
    plots.separating_signal(dataclasses.replace(report, separation=swapped, experiment=table), ax)
    np.testing.assert_array_equal(lines(ax)["experiment"].get_ydata(), report.experiment["u"])
    assert lines(ax)["experiment"].get_xdata()[-1] == 199.5


def test_of_a_fast_signal_the_first_turns_are_drawn(ax):
    report = with_experiment()
    fast_one = np.arange(400) % 2 - 0.5
    found = dataclasses.replace(
        report.separation,
        inputs=np.column_stack([fast_one, report.separation.inputs[:, 1]]),
    )
    plots.separating_signal(dataclasses.replace(report, separation=found), ax)
    rows = len(lines(ax)["experiment"].get_ydata())
    assert 55 < rows < 65
    assert ax.get_title() == f"first {rows} of 400 rows"


def test_without_an_experiment_there_is_nothing_to_draw(ax):
    for report in (effect_found(), with_experiment(separation(0.4))):
        with pytest.raises(ArgumentError, match=r"no experiment[\s\S]*report\.separation"):
            plots.separating_signal(report, ax)
        assert "experiment" not in plots.pictures(report)


def test_one_figure_of_all_panels(monkeypatch):
    figure = with_experiment().plot()
    try:
        titles = [part.get_suptitle() for part in figure.subfigs]
        assert titles == list(TITLES.values())
        assert unreadable(figure, monkeypatch) == []
    finally:
        pyplot.close(figure)


def test_panels_without_content_are_left_out():
    assert list(plots.panel_figures(fast(), 4.1)) == ["residual_map", "ranked_effects",
                                                     "missing_term", "free_run"]  # fmt: skip
    assert "gap_closed" not in plots.panel_figures(no_gap(), 4.1)
    nothing = GapReport("no measurable gap", **{n: tabulate(n) for n in COLUMNS if n != "left_out"})
    assert plots.panel_figures(nothing, 4.1) == {}
    pyplot.close(nothing.plot())


def test_drawing_leaves_no_trace():
    before, settings = pyplot.get_fignums(), dict(mpl.rcParams)
    plots.panel_figures(break_of_level(), 4.1)
    assert pyplot.get_fignums() == before
    assert dict(mpl.rcParams) == settings
