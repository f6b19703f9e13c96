"""Errors of simulations of what a diagnosis handed back, beside the true model's."""

import numpy as np
import pandas as pd
import pytest

from bench.gap.fresh import arrays, refitted
from bench.gap.run import MODELS
from bench.gap.simulated import simulating, squares, true_model, windows_of
from bench.gap.truth import SYSTEMS
from ssmppl.modelfile import load_model
from tests.statistics.checks import seed_of

SYSTEM = SYSTEMS["thermal"]


@pytest.mark.parametrize(("rows", "width"), [(1000, 50), (200, 15), (13, 1)])
def test_each_of_the_last_rows_is_in_one_window(rows, width):
    windows = windows_of(rows)
    covered = [t for first, last in windows for t in range(first, last)]
    assert covered == list(range(int(0.7 * rows), rows))
    assert {last - first for first, last in windows[:-1]} == {width}


def test_squares_are_of_measured_rows_in_windows():
    data = pd.DataFrame({c: np.arange(100.0) + j for j, c in enumerate(SYSTEM.channels)})
    data[list(SYSTEM.inputs)] = 0.0
    data.loc[80, SYSTEM.channels[0]] = np.nan

    def means(given, windows):
        out = np.full((100, len(SYSTEM.channels)), np.nan)
        for first, last in windows:
            out[first:last] = given[list(SYSTEM.channels)].to_numpy()[first:last] - 2.0
        return out

    total = squares(means, SYSTEM, data, np.full(len(SYSTEM.channels), 4.0))
    assert total == pytest.approx((30 * len(SYSTEM.channels) - 1) * 0.25)


def test_the_true_model_does_not_see_a_window_and_sees_what_is_before():
    answer, data = made()
    means = true_model(SYSTEM, answer, data)
    windows = windows_of(len(data))
    before = means(data, windows)
    first, last = windows[1]
    changed = data.copy()
    changed.loc[first:, list(SYSTEM.channels)] = 1e3
    np.testing.assert_array_equal(means(changed, windows)[:last], before[:last])
    changed.loc[first - 1, list(SYSTEM.channels)] = 1e3
    assert np.all(np.abs(means(changed, windows) - before)[first] > 0.0)


def made():
    """A set of the thermal system without an effect: (answer, data)."""
    rng = np.random.default_rng(seed_of("simulated"))
    p = SYSTEM.drawn_parameters(rng)
    U = SYSTEM.excite(rng, 200)
    _, Y = SYSTEM.simulate(p, SYSTEM.strengths({}), U, rng)
    data = pd.DataFrame(np.hstack([U, Y]), columns=[*SYSTEM.inputs, *SYSTEM.channels])
    return {
        "parameters": dict(zip(SYSTEM.parameters, p.tolist(), strict=True)),
        "effects": [],
    }, data


@pytest.mark.slow
def test_the_right_model_simulates_as_the_true_one_does():
    """By the tool's simulations through the set's own model, beside the exact predictions, at the
    same fit: 60 rows, of 512 draws each, so that 5% is far beyond chance."""
    answer, data = made()
    exact = true_model(SYSTEM, answer, data)
    found = refitted(SYSTEM, answer, *arrays(SYSTEM, data))
    fitted = dict(zip(SYSTEM.parameters, found.p, strict=True))
    model = load_model(str(MODELS / "thermal.py"))
    ours = simulating(model, fitted, SYSTEM.channels)
    scale = np.ones(len(SYSTEM.channels))
    one, other = (squares(m, SYSTEM, data, scale) for m in (ours, exact))
    assert one == pytest.approx(other, rel=0.05)
