"""Shapes of effects relative to where the variables lie: no number of digits hides the spread."""

import numpy as np
import pytest

from ssmppl.diagnosis.effects.catalogue import effects
from ssmppl.diagnosis.effects.effect import firsts, means, quantiles, sds, sizes
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.scales import DIGITS, LEVELS, Scales, VariableScale, value_of
from ssmppl.language.tracing import trace
from tests.diagnosis.small import level
from tests.statistics.checks import seed_of

DRAWN = np.random.default_rng(seed_of("scales")).standard_normal(2000)


@pytest.mark.parametrize("offset", [0.0, 3.0, 293.15, -101325.0, 1e9])
@pytest.mark.parametrize("unit", [1.0, 10.0, 1e-6, 1e6])
def test_values_are_as_fine_as_the_spread(offset, unit):
    """Within 1e-3 of a standard deviation of what is meant, whatever zero and unit are."""
    v = unit * (offset + DRAWN)
    scale = VariableScale.of(v)
    for level_ in LEVELS:
        wanted = np.quantile(v, level_), np.quantile(np.abs(v), level_)
        for grid, exact in zip((quantiles(level_), sizes(level_)), wanted, strict=True):
            found = value_of(grid, level_, scale, 100)
            assert abs(found - exact) <= 0.501 * 10.0 ** (1 - DIGITS) * scale.sd
    assert abs(value_of(means(1.0), 1.0, scale, 100) - v.mean()) <= 1e-3 * scale.sd
    assert value_of(sds(0.5), 0.5, scale, 100) == pytest.approx(0.5 * unit, rel=0.1)


@pytest.mark.parametrize("value", [0.0, 5.0, 101325.25, -1e-300])
def test_without_spread_a_value_is_rounded_by_itself(value):
    scale = VariableScale.of(np.full(4, value))
    assert value_of(quantiles(0.5), 0.5, scale, 100) == pytest.approx(value, rel=1e-3)
    assert value_of(sds(1.0), 1.0, scale, 100) == 0.0


def test_thresholds_far_from_zero_are_different_effects():
    """Of pressures about 101325: each quantile another threshold, with its own text and key."""
    v = 101325.0 + 0.01 * DRAWN[:, None]
    t = trace(level())
    scales = Scales.of(t, v, v, np.zeros((len(v), 0)), len(v))
    found, _ = offers(t, scales, ["hard stop", "sensor clipping"])
    near, _ = offers(t, Scales.of(t, v - 101325.0, v - 101325.0, np.zeros((len(v), 0)), len(v)),
                     ["hard stop", "sensor clipping"])  # fmt: skip
    assert len(found) == len(near) > 4
    assert len({c.shape for c in found}) == len({c.shape for c in near})
    assert len({c.key for c in found}) == len({str(c) for c in found}) == len(found)


def test_a_lag_begins_where_the_sensor_does():
    """At the mean of a record that rises, its strength came out as a fraction of what it is."""
    readings = np.r_[np.nan, 23.8, np.linspace(24.0, 60.0, 50)]
    scale = VariableScale.of(readings)
    assert scale.first == 23.8
    assert value_of(firsts(1.0), 1.0, scale, 100) == 23.8
    for name in ("sensor lag", "sensor delay"):
        (effect,) = effects.get(name)
        assert effect.shapes["start"].unit == "first"
