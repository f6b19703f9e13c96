"""Errors of simulations of what a diagnosis handed back, beside the true model's."""

import numpy as np
import pandas as pd
import pytest

from bench.gap.fresh import arrays, refitted
from bench.gap.run import MODELS
from bench.gap.simulated import squares, through, true_model, windows
from bench.gap.truth import SYSTEMS
from ssmppl.modelfile import load_model
from tests.statistics.checks import seed_of

SYSTEM = SYSTEMS["thermal"]


@pytest.mark.parametrize(("rows", "width"), [(1000, 50), (200, 15), (13, 1)])
def test_each_of_the_last_rows_is_hidden_once_in_windows(rows, width):
    first, second = windows(rows)
    cut = int(0.7 * rows)
    assert not first[:cut].any()
    assert np.array_equal(first[cut:], ~second[cut:])
    assert first[cut : cut + width].all()
    assert not first[cut + width : cut + 2 * width].any()


def test_squares_are_of_hidden_rows_by_what_is_shown():
    data = pd.DataFrame({c: np.arange(100.0) + j for j, c in enumerate(SYSTEM.channels)})
    data.iloc[80, 0] = np.nan
    seen = []

    def means(shown):
        seen.append(shown[list(SYSTEM.channels)].isna().to_numpy().copy())
        return np.nan_to_num(data[list(SYSTEM.channels)].to_numpy()) - 2.0

    scale = np.full(len(SYSTEM.channels), 4.0)
    total = squares(means, SYSTEM, data, scale)
    assert total == pytest.approx((30 * len(SYSTEM.channels) - 1) * 0.25)
    for hidden, mask in zip(seen, windows(100), strict=True):
        hidden[80] = mask[80]
        assert np.array_equal(hidden, np.repeat(mask[:, None], len(SYSTEM.channels), axis=1))


@pytest.mark.slow
def test_the_right_model_simulates_as_the_true_one_does():
    """A particle filter through the set's own model, beside the exact one, at the same fit."""
    rng = np.random.default_rng(seed_of("simulated"))
    p = SYSTEM.drawn_parameters(rng)
    U = SYSTEM.excite(rng, 200)
    _, Y = SYSTEM.simulate(p, SYSTEM.strengths({}), U, rng)
    data = pd.DataFrame(np.hstack([U, Y]), columns=[*SYSTEM.inputs, *SYSTEM.channels])
    answer = {"parameters": dict(zip(SYSTEM.parameters, p.tolist(), strict=True)), "effects": []}
    exact = true_model(SYSTEM, answer, data)
    found = refitted(SYSTEM, answer, *arrays(SYSTEM, data))
    fitted = dict(zip(SYSTEM.parameters, found.p, strict=True))
    ours = through(load_model(str(MODELS / "thermal.py")), fitted, SYSTEM.channels)
    scale = np.ones(len(SYSTEM.channels))
    one, other = (squares(m, SYSTEM, data, scale) for m in (ours, exact))
    assert one == pytest.approx(other, rel=0.05)
