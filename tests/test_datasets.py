import numpy as np
import pytest

from ssmppl import datasets
from ssmppl.errors import ArgumentError


def test_names_are_the_loaders():
    assert set(datasets.names()) <= set(datasets.__all__)


@pytest.mark.parametrize(
    ("name", "length", "first"),
    [("ice_varves", 634, 0), ("lgss_appendix", 100, 0), ("lgss_main_text", 100, 0),
     ("nile", 100, 1871)],
)  # fmt: skip
def test_series_are_finite_float_arrays(name, length, first):
    y = getattr(datasets, name)()
    assert y.shape == (length,)
    assert y.dtype == np.float64
    assert np.isfinite(y).all()
    assert datasets.load(name)["y"].tolist() == y.tolist()
    assert datasets.load(name)["time"].tolist() == list(range(first, first + length))


def test_first_and_last_varves():
    y = datasets.ice_varves()
    assert y[:2].tolist() == [26.28, 27.42]
    assert (y > 0).all()


def test_the_nile_is_the_published_series():
    nile = pytest.importorskip("statsmodels.datasets.nile").load_pandas().data
    assert datasets.nile().tolist() == nile["volume"].tolist()
    assert datasets.load("nile")["time"].tolist() == nile["year"].tolist()


def test_the_airline_passengers():
    y, known = datasets.airline(), datasets.load("airline")
    assert (len(y), y[0], y[-1], y.max(), y.sum()) == (144, 112.0, 432.0, 622.0, 40363.0)
    months = 12 * (known["year"] - 1949) + known["month"]
    assert months.tolist() == list(range(1, 145))


def test_the_boys_in_bed():
    y = datasets.boarding_school()
    assert y.tolist() == [3, 8, 28, 75, 221, 291, 255, 235, 190, 125, 70, 28, 12, 5]
    assert datasets.load("boarding_school")["time"].tolist() == list(range(1, 15))


def test_loaded_arrays_belong_to_the_caller():
    datasets.ice_varves()[:] = 0
    assert datasets.ice_varves().min() > 0


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ArgumentError, match=r"'varves'.*\n.*ice_varves, "):
        datasets.load("varves")


def test_linear_gaussian_likelihood_of_the_embedded_series(exact_values):
    """The data and the exact values belong together: a Kalman filter in a few lines says so."""
    for name, slope in (("lgss_main_text", 0.5), ("lgss_appendix", 1.0)):
        y = datasets.load(name)["y"]
        for theta, expected in exact_values[name]["log_likelihood"].items():
            mean, variance, total = 0.0, 1 / (0.51 * float(theta)), 0.0
            for value in y:
                spread = slope**2 * variance + 0.1
                error = value - slope * mean
                total -= 0.5 * (np.log(2 * np.pi * spread) + error**2 / spread)
                gain = variance * slope / spread
                mean, variance = mean + gain * error, variance * (1 - gain * slope)
                mean, variance = 0.7 * mean, 0.49 * variance + 1 / float(theta)
            assert total == pytest.approx(expected, abs=1e-6)
