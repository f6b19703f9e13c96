"""`plot_states` and `plot_forecast`: what is drawn are the quantiles, the data and the inputs."""

import warnings

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from matplotlib import pyplot
from matplotlib.dates import date2num

import ssmppl as ssm
from ssmppl.drawing.style import DATA, MAIN, OTHER
from ssmppl.errors import ArgumentError
from ssmppl.inference.run.labels import observes
from ssmppl.inference.verbs.predict import group
from ssmppl.language.tracing import trace
from ssmppl.plots.drawing import styled
from ssmppl.results import to_dataset, to_inference_data
from ssmppl.tables import quantiles_of
from tests.plots.results import DATES, TRUTH, data, filtered, level, sampled, smoothed

mpl.use("Agg")
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


@pytest.fixture(autouse=True)
def _closed():
    yield
    pyplot.close("all")


def fans(ax, x):
    """Of each fan, (5, T): the edges of both bands, and the line between them."""
    bands = [c.get_paths()[0].vertices for c in ax.collections if hasattr(c, "get_datalim")]
    lines = [line for line in ax.lines if line.get_linewidth() == 1.3]
    found = []
    for k, line in enumerate(lines):
        edges = []
        for outline in bands[2 * k : 2 * k + 2]:
            at = [outline[outline[:, 0] == position][:, 1] for position in line.get_xdata()]
            edges.append((np.array([a.min() for a in at]), np.array([a.max() for a in at])))
        (low, high), (inner_low, inner_high) = edges
        found.append((line, np.array([low, inner_low, line.get_ydata(), inner_high, high])))
    return found


def dots(ax):
    return [line for line in ax.lines if line.get_marker() == "." and line.get_color() == DATA]


def test_smoothed_states_have_their_quantiles_over_the_data_at_their_dates():
    axes = ssm.plot_states(smoothed())
    assert [ax.get_ylabel() for ax in axes] == ["x[0]", "x[1]", "z", "push"]
    for k in (0, 1):
        ((line, drawn),) = fans(axes[k], DATES)
        expected = smoothed()["x_quantile"].values[0, :, k]
        np.testing.assert_allclose(drawn, expected.T)
        np.testing.assert_array_equal(line.get_xdata(), date2num(DATES.to_pydatetime()))
    assert axes[-1].get_xlabel() == "time"
    assert [ax.get_xlabel() for ax in axes[:-1]] == ["", "", ""]


def test_data_stand_over_the_state_that_is_their_mean_without_the_missing_ones():
    axes = ssm.plot_states(smoothed())
    y, z = data()["y"], data()["z"]
    (over,) = dots(axes[0])  # y ~ Normal(x[0]); z ~ Normal(x[0] + x[1]) has a panel of its own
    np.testing.assert_array_equal(over.get_ydata(), y.dropna())
    np.testing.assert_array_equal(over.get_xdata(), date2num(y.dropna().index.to_pydatetime()))
    assert dots(axes[1]) == []
    np.testing.assert_array_equal(dots(axes[2])[0].get_ydata(), z)
    np.testing.assert_array_equal(axes[3].lines[0].get_ydata(), data()["push"])
    assert axes[3].lines[0].get_drawstyle() == "steps-post"


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (lambda x, z: ssm.Normal(x, sd=1), {"y": "x"}),
        (lambda x, z: ssm.StudentT(3, x, scale=1), {"y": "x"}),
        (lambda x, z: ssm.Cauchy(x, scale=1), {"y": "x"}),
        (lambda x, z: ssm.Poisson(np.exp(x)), {}),
        (lambda x, z: ssm.Normal(x + 1, sd=1), {}),
        (lambda x, z: ssm.MvNormal(z, covariance=np.eye(2)), {"y[0]": "z[0]", "y[1]": "z[1]"}),
        (lambda x, z: ssm.Normal(z * np.array([1, 2]), sd=1), {"y[0]": "z[0]"}),
    ],
)
def test_an_observation_in_units_of_a_state_is_told(law, expected):
    model = ssm.Model("units")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x, z: {"x": ssm.Normal(x, sd=1), "z": ssm.Normal(z, sd=1)})
    model.observation(lambda x, z: {"y": law(x, z)})
    assert observes(trace(model)) == expected


def test_posterior_states_have_the_quantiles_of_their_draws():
    axes = ssm.plot_states(sampled(), var_names=["x[1]"])
    draws = sampled()["posterior"]["x"].values[..., 1].reshape(-1, 12)
    ((_, drawn),) = fans(axes, DATES)  # of a single panel the axes themselves
    np.testing.assert_allclose(drawn, np.quantile(draws, LEVELS, axis=0))


def test_data_trees_are_read_as_inference_data_is():
    names = ("posterior", "observed_data", "constant_data")
    groups = {n: group(sampled(), n) for n in names}
    axes = ssm.plot_states(xr.DataTree.from_dict(groups))
    expected = ssm.plot_states(sampled())
    assert [ax.get_ylabel() for ax in axes] == ["x[0]", "x[1]", "z", "push"]
    for one, other in zip(axes, expected, strict=True):
        for drawn, line in zip(one.lines, other.lines, strict=True):
            np.testing.assert_array_equal(drawn.get_xydata(), line.get_xydata())


def test_several_experiments_stand_side_by_side_each_on_its_own_time():
    axes = ssm.plot_states(sampled(True), var_names=["x", "y"])
    assert axes.shape == (3, 2)
    assert [ax.get_title(loc="left") for ax in axes[0]] == ["experiment 1", "experiment 2"]
    posterior = sampled(True)["posterior"]
    for k, steps in enumerate((12, 11)):
        draws = posterior["x"].values[:, :, k, :steps, 0].reshape(-1, steps)
        ((line, drawn),) = fans(axes[0, k], None)
        np.testing.assert_allclose(drawn, np.quantile(draws, LEVELS, axis=0))
        np.testing.assert_array_equal(dots(axes[2, k])[0].get_ydata(), data(k)["y"].dropna())
    np.testing.assert_array_equal(line.get_xdata(), np.arange(1, 12))
    assert axes[2, 0].get_xlabel() == "time"
    assert axes[2, 1].get_xlabel() == "t"


def test_lists_of_datasets_and_draws_of_trajectories_do_as_well():
    several = ssm.smooth(level, [data(), data(1)], TRUTH, trajectories=50, seed=1)
    axes = ssm.plot_states(several, var_names="x")
    ((_, drawn),) = fans(axes[1, 1], None)
    expected = np.quantile(several[1]["x"].values[..., 1], LEVELS, axis=0)
    np.testing.assert_allclose(drawn, expected)


def test_a_filter_has_states_too():
    axes = ssm.plot_states(filtered(), var_names="x[0]")
    ((_, drawn),) = fans(axes, DATES)
    np.testing.assert_allclose(drawn, filtered()["x_quantile"].values[0, :, 0].T)


def test_axes_that_are_given_are_drawn_on_and_handed_back():
    figure, given = pyplot.subplots(2, 1)
    before = dict(mpl.rcParams)
    axes = ssm.plot_states(smoothed(), var_names="x", ax=given)
    assert list(axes) == list(given)
    assert figure.legends == []
    assert given[0].get_legend() is not None
    assert dict(mpl.rcParams) == before
    figure.draw_without_rendering()


def test_what_a_backend_sets_when_the_first_figure_loads_it_stays():
    """That of notebooks turns the interactive mode on; without it no figure is shown."""

    @styled
    def plot():
        assert mpl.rcParams["font.size"] == 9.0
        mpl.interactive(True)

    before = mpl.rcParams["font.size"]
    assert not mpl.is_interactive()
    try:
        plot()
        assert mpl.is_interactive()
        assert mpl.rcParams["font.size"] == before != 9.0
    finally:
        mpl.interactive(False)


@pytest.mark.parametrize(
    ("result", "options", "found", "fix"),
    [
        (lambda: 3.0, {}, "int|float", "ssm.smooth"),
        (list, {}, "empty list", "ssm.smooth"),
        (lambda: ssm.simulate(level, TRUTH, inputs=data()[["push"]]), {}, "Dataset of", "smooth"),
        (lambda: sampled(), {"var_names": "w"}, "'w'", "x, "),
        (lambda: sampled(), {"var_names": ["x[7]"]}, "x\\[7\\]", "x\\[0\\]"),
        (lambda: smoothed(), {"ax": pyplot.subplots()[1]}, "4 panels .* 1 axes", "var_names"),
        (lambda: smoothed(), {"ax": "left"}, "holds str", "Matplotlib"),
        (lambda: ssm.smooth(level, data(), TRUTH, quantiles=(0.1,)), {}, "has 0.1", "quantiles="),
        (lambda: ssm.predict(level, data=data(), draws=3, seed=1), {}, "prior_pred", "sample"),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused_with_what_to_give(result, options, found, fix):
    with pytest.raises(ArgumentError, match=f"(?s){found}.*Fix: .*{fix}"):
        ssm.plot_states(result(), **options)


def test_a_posterior_without_states_says_how_to_get_them():
    bare = to_inference_data(posterior={"q": np.ones((2, 3)), "r": np.ones((2, 3))})
    with pytest.raises(ArgumentError, match=r"(?s)no states, only q, r.*states=True"):
        ssm.plot_states(bare)


def test_of_very_many_components_the_first_are_drawn_and_a_warning_says_so():
    wide = to_dataset({"x": np.zeros((4, 3, 30))}, sample_dim="trajectory")
    with pytest.warns(UserWarning, match="first 24 of 30"):
        axes = ssm.plot_states(wide)
    assert len(axes) == 24


# -- forecasts
@pytest.fixture(scope="module")
def ahead():
    return ssm.forecast(level, sampled(), inputs={"push": np.ones(4)}, seed=1)


def test_forecasts_are_fans_after_the_data(ahead):
    axes = ssm.plot_forecast(ahead, sampled())
    assert [ax.get_ylabel() for ax in axes] == ["x[0]", "x[1]", "y", "z"]
    (before, past), (after, fan) = fans(axes[0], None)
    assert before.get_color() == MAIN
    assert after.get_color() == OTHER
    np.testing.assert_allclose(fan, np.quantile(ahead["x"].values[..., 0], LEVELS, axis=0))
    draws = sampled()["posterior"]["x"].values[..., 0].reshape(-1, 12)
    np.testing.assert_allclose(past, np.quantile(draws, LEVELS, axis=0))
    days = date2num(DATES[-1].to_pydatetime())
    np.testing.assert_allclose(after.get_xdata(), days + np.arange(1, 5))
    np.testing.assert_array_equal(dots(axes[2])[0].get_ydata(), data()["y"].dropna())
    ((_line, fan),) = fans(axes[2], None)
    np.testing.assert_allclose(fan, np.quantile(ahead["y"].values, LEVELS, axis=0))
    end = [k for k in axes[2].lines if k.get_linestyle() == ":"]
    np.testing.assert_allclose(end[0].get_xdata(), days + 0.5)


def test_forecasts_show_as_much_of_the_past_as_is_asked_for(ahead):
    axes = ssm.plot_forecast(ahead, sampled(), var_names=["z", "x[0]"], past=5)
    assert len(axes) == 2
    np.testing.assert_array_equal(dots(axes[0])[0].get_ydata(), data()["z"].values[-5:])
    (before, _), _ = fans(axes[1], None)
    assert len(before.get_xdata()) == 5
    alone = ssm.plot_forecast(ahead, var_names="y")
    assert len(alone.lines) == 1


def test_forecasts_that_are_infinite_in_part_are_drawn(ahead):
    last = ahead["y"].copy()
    last[: len(last) // 10, -1] = -np.inf  # of a law at the logarithm of a count, say
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ax = ssm.plot_forecast(ahead.assign(y=last), var_names="y")
    middle = ax.lines[-1].get_ydata()
    ordered = np.sort(last.values[:, -1])
    assert middle[-1] == ordered[int(np.ceil(0.5 * len(ordered))) - 1]
    assert quantiles_of(last.values[:, -1:], LEVELS)[0, 0] == -np.inf


def test_quantiles_of_the_largest_numbers_do_not_overflow():
    draws = np.array([-1.7e308, 1.7e308, 1.0])[:, None]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = quantiles_of(draws, [0.0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(found[:, 0], [-1.7e308, -8.5e307, 1.0, 8.5e307, 1.7e308], rtol=1e-12)


def test_a_forecast_of_one_experiment_is_put_after_that_one():
    second = ssm.forecast(level, sampled(True), inputs={"push": [0.0, 0.0]}, experiment=2, seed=1)
    ax = ssm.plot_forecast(second, sampled(True), var_names="z")
    np.testing.assert_array_equal(dots(ax)[0].get_ydata(), data(1)["z"])
    ((line, _),) = fans(ax, None)
    np.testing.assert_array_equal(line.get_xdata(), [12, 13])


def test_forecasts_refuse_other_things(ahead):
    with pytest.raises(ArgumentError, match=r"(?s)Dataset of.*ssm.forecast"):
        ssm.plot_forecast(smoothed())
    with pytest.raises(ArgumentError, match=r"(?s)9 rows of experiment 1.*of 12 rows.*made from"):
        ssm.plot_forecast(ahead.assign_attrs(after=9), sampled())
    with pytest.raises(ArgumentError, match=r"(?s)second argument"):
        ssm.plot_forecast(ahead, data())
    with pytest.raises(ArgumentError, match="past=-1"):
        ssm.plot_forecast(ahead, past=-1)
