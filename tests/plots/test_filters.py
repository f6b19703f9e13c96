"""`plot_filter`, `plot_ancestry` and `plot_predictions`: lines, marks, edges and bars."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_rgba
from scipy.stats import binom, norm

import ssmppl as ssm
from ssmppl.drawing.style import MAIN, OTHER
from ssmppl.errors import ArgumentError
from ssmppl.plots.filters import resampled, survivors
from ssmppl.plots.predictions import pit_band
from tests.plots.results import (
    TRUTH,
    data,
    filtered,
    level,
    particles,
    sampled,
    smoothed,
)
from tests.plots.test_states import dots, fans

mpl.use("Agg")


@pytest.fixture(autouse=True)
def _closed():
    yield
    pyplot.close("all")


def marks(ax):
    return [line for line in ax.lines if line.get_marker() == "|"]


# -- what a filter keeps on request
def test_keeping_the_particles_changes_no_number_and_they_agree_with_the_moments():
    kept, plain = particles(), particles(history=False)
    assert not {"particle_ancestor", "x_particles"} & set(plain)
    for name in plain:
        np.testing.assert_array_equal(kept[name], plain[name])
    x, w = kept["x_particles"].values, kept["particle_weight"].values
    np.testing.assert_allclose((x * w).sum(-1), kept["x"].values, rtol=1e-10)
    np.testing.assert_allclose(1 / (w**2).sum(-1), kept["ess"].values)
    a = kept["particle_ancestor"].values
    assert a.min() == 0
    assert a.max() == 7
    np.testing.assert_array_equal(a[0, 0], np.arange(8))
    # resampled systematically at each row: as many children as N w, rounded up or down
    for t in range(1, 10):
        children = np.bincount(a[0, t], minlength=8)
        assert np.all(np.abs(children - 8 * w[0, t - 1]) < 1)


def test_results_of_filters_carry_the_data():
    np.testing.assert_array_equal(filtered()["y_observed"], data()["y"])
    np.testing.assert_array_equal(filtered()["push_input"], data()["push"])
    assert filtered().attrs["observes"] == '{"y": "x[0]"}'


def test_particles_of_some_states_only_are_not_kept():
    with pytest.raises(ArgumentError, match=r'(?s)history=True with proposal="marginal".*auto'):
        ssm.particle_filter(MIXED, {"y": [0.0, 1.0]}, {}, proposal="marginal", history=True)
    kept = ssm.particle_filter(MIXED, {"y": [0.0, 1.0]}, {}, particles=5, history=True, seed=1)
    assert {"s_particles", "z_particles"} <= set(kept)


MIXED = ssm.Model("mixed")
MIXED.initial(lambda: {"s": ssm.Normal(0, sd=1), "z": ssm.Normal(0, sd=1)})
MIXED.transition(lambda s, z: {"s": ssm.Normal(np.sin(s), sd=1), "z": ssm.Normal(z + s**2, sd=1)})
MIXED.observation(lambda z: {"y": ssm.Normal(z, sd=1)})


# -- plot_filter
def test_sizes_and_increments_are_those_of_the_result():
    result = particles(threshold=0.6)
    above, below = ssm.plot_filter(result)
    np.testing.assert_array_equal(above.lines[0].get_ydata(), result["ess"].values[0])
    np.testing.assert_array_equal(above.lines[0].get_xdata(), np.arange(1, 11))
    np.testing.assert_array_equal(
        below.lines[0].get_ydata(), result["log_likelihood_increment"].values[0]
    )
    assert [line.get_ydata()[0] for line in above.lines[1:3]] == [8, 0.6 * 8]
    total = float(result["log_likelihood_increment"].sum())
    assert below.get_title(loc="left") == f"log-likelihood −{-total:.6g}"


@pytest.mark.parametrize("proposal", ["bootstrap", "guided"])
def test_marks_stand_where_the_particles_were_resampled(proposal):
    result = particles(threshold=0.6, proposal=proposal)
    ancestors = result["particle_ancestor"].values[0]
    (drawn,) = marks(ssm.plot_filter(result)[0])
    moved = np.flatnonzero((ancestors[1:] != np.arange(8)).any(axis=1)) + 1  # row labels from 1
    assert 0 < len(moved) < 9
    np.testing.assert_array_equal(drawn.get_xdata(), moved)


def test_where_particles_look_ahead_the_times_need_the_history():
    known = particles(threshold=0.6, proposal="auxiliary")
    (drawn,) = marks(ssm.plot_filter(known)[0])
    a = known["particle_ancestor"].values[0]
    np.testing.assert_array_equal(
        drawn.get_xdata(), np.flatnonzero((a[1:] != np.arange(8)).any(axis=1)) + 1
    )
    unknown = particles(threshold=0.6, proposal="auxiliary", history=False)
    assert resampled(unknown) is None
    ax = ssm.plot_filter(unknown)[0]
    assert marks(ax) == []
    assert "history=True" in ax.get_title(loc="left")


def test_where_each_row_is_resampled_there_are_no_marks():
    ax = ssm.plot_filter(particles())[0]
    assert marks(ax) == []
    assert ax.get_title(loc="left") == "N = 8, resampled each row"


def test_exact_filters_have_increments_only_and_rows_without_data_none():
    frame = data().assign(z=np.where(data()["y"].isna(), np.nan, data()["z"]))
    ax = ssm.plot_filter(ssm.kalman_filter(level, frame, TRUTH))
    drawn = ax.lines[0].get_ydata()
    np.testing.assert_array_equal(np.isnan(drawn), data()["y"].isna())


def test_experiments_and_repeats():
    several = ssm.particle_filter(level, [data(), data(1)], TRUTH, particles=20, repeats=3, seed=1,
                                  proposal="bootstrap")  # fmt: skip
    axes = ssm.plot_filter(several)
    assert axes.shape == (2, 2)
    assert axes[0, 1].get_title(loc="left").startswith("experiment 2")
    np.testing.assert_array_equal(axes[0, 1].lines[2].get_ydata(), several[1]["ess"].values[2])


# -- plot_ancestry
def edges(ax, colour):
    return next(
        np.array(c.get_segments()) for c in ax.collections
        if to_rgba(colour)[:3] == tuple(c.get_edgecolor()[0][:3])
    )  # fmt: skip


def test_survivors_are_who_is_reached_backwards():
    ancestors = np.array([[0, 1, 2], [1, 1, 2], [0, 0, 1]])
    expected = [[False, True, False], [True, True, False], [True, True, True]]
    np.testing.assert_array_equal(survivors(ancestors), expected)
    only_last = [[False, True, False], [True, False, False], [True, False, False]]
    np.testing.assert_array_equal(survivors(ancestors, every=3), only_last)


def test_lines_go_from_each_particle_to_its_ancestor():
    result = particles()
    x, a = result["x_particles"].values[0], result["particle_ancestor"].values[0]
    ax = ssm.plot_ancestry(result)
    assert ax.get_ylabel() == "x"
    alive = survivors(a)
    expected = sorted(
        (t, x[t - 1, a[t, i]], t + 1, x[t, i])
        for t in range(1, 10) for i in range(8) if alive[t, i]
    )  # fmt: skip
    drawn = edges(ax, MAIN)
    np.testing.assert_allclose(sorted(map(tuple, drawn.reshape(-1, 4))), expected)
    assert len(drawn) + len(ax.collections[0].get_segments()) == 9 * 8


def test_the_title_says_since_when_there_is_one_ancestor():
    title = ssm.plot_ancestry(particles(4)).get_title(loc="left")
    alive = survivors(particles(4)["particle_ancestor"].values[0])
    last = np.flatnonzero(alive.sum(axis=1) == 1)
    assert len(last) > 0
    assert title == f"4 particles, with one common ancestor at {last[-1] + 1}"


def test_many_particles_are_thinned():
    ax = ssm.plot_ancestry(particles(1000))
    last = edges(ax, MAIN)
    assert (last[:, 1, 0] == 10).sum() == 40
    assert len(ax.collections[0].get_segments()) <= 9 * 40


def test_ancestry_says_what_to_ask_for():
    with pytest.raises(ArgumentError, match=r"(?s)ancestors.*history=True"):
        ssm.plot_ancestry(particles(history=False))
    with pytest.raises(ArgumentError, match=r"(?s)exact filters have none.*history=True"):
        ssm.plot_ancestry(filtered())
    with pytest.raises(ArgumentError, match="draw=1, and the filter ran 1 times"):
        ssm.plot_ancestry(particles(), draw=1)
    with pytest.raises(ArgumentError, match="experiment=2, and the result is of 1"):
        ssm.plot_ancestry(particles(), experiment=2)
    with pytest.raises(ArgumentError, match=r"(?s)'z'.*x"):
        ssm.plot_ancestry(particles(), var_names="z")


# -- plot_predictions
def test_bands_of_predictions_are_those_of_the_exact_law():
    axes = ssm.plot_predictions(filtered())
    assert axes.shape == (2, 2)
    ((_, drawn),) = fans(axes[0, 0], None)
    mean, sd = (filtered()[n].values[0] for n in ("y_predicted", "y_predicted_sd"))
    expected = [norm.ppf(p, mean, sd) for p in (0.05, 0.25, 0.5, 0.75, 0.95)]
    np.testing.assert_allclose(drawn, expected)
    np.testing.assert_array_equal(dots(axes[0, 0])[0].get_ydata(), data()["y"].dropna())
    assert [axes[k, 0].get_ylabel() for k in (0, 1)] == ["y", "z"]
    assert [axes[k, 0].get_xlabel() for k in (0, 1)] == ["", "time"]
    assert axes[1, 1].get_xlabel() == "PIT"


def test_bands_of_counts_are_counts():
    counts = ssm.Model("counts")
    counts.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    counts.transition(lambda x: {"x": ssm.Normal(0.9 * x, sd=0.5)})
    counts.observation(lambda x: {"n": ssm.Poisson(np.exp(x))})
    rows = {"n": np.array([0.0, 2.0, np.nan, 1.0])}
    found = ssm.particle_filter(counts, rows, {}, particles=200, repeats=2, seed=1)
    left, _ = ssm.plot_predictions(found)
    ((_, drawn),) = fans(left, None)
    np.testing.assert_array_equal(drawn, found["n_predicted_quantile"].values[0].T)
    assert drawn.min() == 0.0
    assert np.all(drawn == np.floor(drawn))
    states = np.ravel(ssm.plot_states(found))  # n has a panel of its data, but no bands there
    assert [one.get_ylabel() for one in states] == ["x", "n"]


def test_bands_need_their_levels():
    others = ssm.kalman_filter(level, data(), TRUTH, quantiles=(0.1, 0.9))
    with pytest.raises(ArgumentError, match=r"(?s)draws the quantiles 0\.05.*leave quantiles= out"):
        ssm.plot_predictions(others)
    none = ssm.kalman_filter(level, data(), TRUTH, quantiles=())
    with pytest.raises(ArgumentError, match=r"(?s)no quantiles of the predictions of 'y'"):
        ssm.plot_predictions(none)


def test_the_histogram_counts_the_pit_values_and_its_band_is_binomial():
    _, right = ssm.plot_predictions(filtered(), var_names="y")
    pit = filtered()["y_pit"].values.ravel()
    pit = pit[np.isfinite(pit)]
    assert len(pit) == 10
    bars = [p for p in right.patches if p.get_alpha() == 0.6]
    expected, _ = np.histogram(pit, bins=10, range=(0, 1))
    np.testing.assert_array_equal([b.get_height() for b in bars], expected)
    (band,) = [p for p in right.patches if p.get_alpha() == 0.3]
    low, high = band.get_extents().transformed(right.transData.inverted()).intervaly
    np.testing.assert_allclose([low, high], binom.ppf([0.05, 0.95], 10, 0.1), atol=1e-9)


def test_the_band_holds_nine_in_ten_bars_of_uniform_values():
    low, high = pit_band(500)
    bars = np.random.default_rng(1).multinomial(500, np.full(10, 0.1), size=4000)
    assert 0.88 < np.mean((bars >= low) & (bars <= high)) < 0.94


def test_experiments_share_one_histogram():
    several = ssm.kalman_filter(level, [data(), data(1)], TRUTH)
    axes = ssm.plot_predictions(several, var_names="z")
    assert len(axes) == 3
    assert axes[1].get_title(loc="left") == "experiment 2"
    assert sum(p.get_height() for p in axes[2].patches if p.get_alpha() == 0.6) == 12 + 11


def test_predictive_draws_have_quantiles_and_no_histogram():
    drawn = ssm.predict(level, sampled(), data(), seed=1)
    axes = ssm.plot_predictions(drawn)
    assert len(axes) == 2
    y = drawn["posterior_predictive"]["y"].values.reshape(-1, 12)
    ((_, bands),) = fans(axes[0], None)
    np.testing.assert_allclose(bands, np.quantile(y, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0))
    np.testing.assert_array_equal(dots(axes[0])[0].get_ydata(), data()["y"].dropna())


def test_predictions_refuse_other_things():
    for wrong in (sampled(), smoothed(), 1):
        with pytest.raises(ArgumentError, match=r"(?s)cannot draw.*ssm\.(predict|particle_filter)"):
            ssm.plot_predictions(wrong)
    with pytest.raises(ArgumentError, match=r"(?s)'w'.*y, z|z, y"):
        ssm.plot_predictions(filtered(), var_names="w")
    with pytest.raises(ArgumentError, match=r"(?s)Dataset of.*particle_filter"):
        ssm.plot_filter(smoothed())


def test_the_marks_of_a_filter_stay_within_its_panel():
    ax = ssm.plot_filter(particles(threshold=0.6))[0]
    assert ax.get_ylim()[0] == 0.0
    assert all(line.get_color() == OTHER for line in marks(ax))
