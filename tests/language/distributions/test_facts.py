"""What a law says of itself for analyses and the diagnosis, held against its own density."""

import numpy as np
import pytest

from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbols_of
from tests.language.distributions.distribution_table import CASES

LEVELS = (0.2, 0.5, 0.9)
BY = 0.3  # how far a mean or the log of a variance is moved


def of(case, fact):
    return getattr(case.build(), fact) not in (None, {})


def number(form, values=None):
    return float(evaluate(array(form)[()], values or {}))


def with_parameter(law, name, value):
    return law.rebuilt({name: array(value)})


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.id)
def test_location_and_scale_leave_a_law_without_them(case):
    law, values = case.with_symbols()
    if law.location_and_scale() is None:
        return
    location, scale = (array(a)[()] for a in law.location_and_scale())
    value = float(case.reference.ppf(0.7))
    z = (value - number(location, values)) / number(scale, values)

    def moves(symbol):  # the shape of a Gamma law cancels
        at = values | {symbol: 1.3 * values[symbol] + 0.1}
        return any(abs(number(f, at) - number(f, values)) > 1e-6 for f in (location, scale))

    own, standard = set(filter(moves, symbols_of([location, scale]))), []
    for factor in (1.0, 1.3):
        at = {s: v * factor if s in own else v for s, v in values.items()}
        m, s = number(location, at), number(scale, at)
        standard.append(number(law.log_density(m + s * z), at) + np.log(s))
    assert standard[0] == pytest.approx(standard[1], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("case", [c for c in CASES if of(c, "maximisers")], ids=lambda c: c.id)
def test_maximisers_are_the_most_likely_values(case):
    law = case.build()
    for name, most_likely in law.maximisers.items():
        if name not in law.parameters:  # one by which the spread was not given
            continue
        for level in LEVELS:
            value = float(case.reference.ppf(level))
            best = number(most_likely(law, array(value)))
            top = number(with_parameter(law, name, best).log_density(value))
            for away in (0.9, 1.1):
                other = min(best * away, 1.0) if name == "p" else best * away
                assert number(with_parameter(law, name, other).log_density(value)) <= top + 1e-9


@pytest.mark.parametrize("case", [c for c in CASES if of(c, "mean_link")], ids=lambda c: c.id)
def test_mean_links_move_the_mean(case):
    law = case.build()
    link, before = law.mean_link, number(law.noise_free())
    value = number(law.parameters[link.parameter])
    sign = -1.0 if link.inverse else 1.0
    odds = value / (1.0 - value) * np.exp(BY) if link.scale == "logit" else np.nan
    moved = {"log": value * np.exp(sign * BY), "logit": odds / (1.0 + odds)}.get(
        link.scale, value + BY
    )
    after = number(with_parameter(law, link.parameter, moved).noise_free())
    trials = number(law.parameters[law.trials]) if law.trials else 1.0
    expected = {
        "identity": before + BY, "log": before * np.exp(BY), "logit": trials * moved,
        "mean of the log": before * np.exp(BY),
    }[link.scale]  # fmt: skip
    assert after == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("case", [c for c in CASES if of(c, "variance_link")], ids=lambda c: c.id)
def test_variance_links_scale_the_variance(case):
    law = case.build()
    link, before = law.variance_link, number(law.variance())
    value = number(law.parameters[link.parameter]) * np.exp(link.power * BY)
    if law.support().kind == "real" and np.isfinite(before):  # else of the log, or nearly so
        after = number(with_parameter(law, link.parameter, value).variance())
        assert after == pytest.approx(before * np.exp(BY), rel=1e-9)


@pytest.mark.parametrize("case", [c for c in CASES if of(c, "highest")], ids=lambda c: c.id)
def test_no_density_is_above_the_highest(case):
    law = case.build()
    for level in LEVELS:
        assert number(law.log_density(float(case.reference.ppf(level)))) <= law.highest
