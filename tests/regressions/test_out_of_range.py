"""The density of a law with an argument out of its range: never a number."""

import math

import numpy as np
import pytest

from ssmppl.expressions.evaluate import evaluate
from tests.language.distributions.distribution_table import CASES, JOINT_CASES

# every law once, with arguments in range
LAWS: dict = {}
for _case in (*CASES, *JOINT_CASES):
    LAWS.setdefault(_case.cls.__name__, _case)
OUT = [-0.3, -0.5, -1.5, -2.5, -3.7]


def _settings():
    for name, case in LAWS.items():
        law, _ = case.with_symbols()
        for parameter, (low, high, _) in law.ranges.items():
            plain = parameter.rstrip("_")
            for at in [low + v for v in OUT] + [high - v for v in OUT if high < math.inf]:
                yield pytest.param(case, plain, at, id=f"{name}-{plain}-{at:g}")


def _values_of(case):
    if case in CASES:
        return [float(v) for v in case.points()] + [0.0, 1.0, 2.0]
    return [case.reference.rvs(random_state=1)]


@pytest.mark.parametrize(("case", "parameter", "at"), list(_settings()))
def test_no_law_has_a_finite_density_there(case, parameter, at):
    law, values = case.with_symbols()
    changed = next(s for s in values if s.data[1] == parameter)
    densities = [law.log_density(value) for value in _values_of(case)]
    assert np.isfinite(evaluate(densities, values)).any()
    assert not np.isfinite(evaluate(densities, {**values, changed: at})).any()
