"""Derivatives of densities that are cut off, against central differences of the same."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol

M, S, LOWER, UPPER = (symbol("parameter", n) for n in ("m", "s", "lower", "upper"))
AT = {M: 0.7, S: 1.3, LOWER: 0.4, UPPER: 2.5}
STEP = 1e-4
LAWS = {
    "Normal sd": lambda: ssm.Normal(M, sd=S),
    "Normal variance": lambda: ssm.Normal(M, variance=S),
    "Normal precision": lambda: ssm.Normal(M, precision=S),
    "LogNormal": lambda: ssm.LogNormal(M, sd=S),
    "Exponential rate": lambda: ssm.Exponential(rate=S),
    "Exponential scale": lambda: ssm.Exponential(scale=S),
    "Weibull": lambda: ssm.Weibull(M, scale=S),
    "Laplace": lambda: ssm.Laplace(M, scale=S),
    "Cauchy": lambda: ssm.Cauchy(M, scale=S),
    "HalfNormal": lambda: ssm.HalfNormal(sd=S),
    "HalfCauchy": lambda: ssm.HalfCauchy(scale=S),
    "Uniform": lambda: ssm.Uniform(M - 1.0, M + S),
}
SIDES = {
    "below": {"lower": LOWER},
    "above": {"upper": UPPER},
    "both": {"lower": LOWER, "upper": UPPER},
    "below by a number": {"lower": 0.4},
    "above by a number": {"upper": 2.5},
}


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("law", LAWS)
def test_first_and_second_slopes_in_what_the_law_depends_on(law, side):
    """A side that is left open has none; it is no infinity that would turn them into NaN."""
    log_p = np.ravel(ssm.Truncated(LAWS[law](), **SIDES[side]).log_densities(1.1))[0]
    for s in (M, S, *(b for b in SIDES[side].values() if not isinstance(b, float))):
        (slope,) = differentiate([log_p], s)
        (curvature,) = differentiate([slope], s)

        def moved(e, by, s=s):
            return float(evaluate([e], {**AT, s: AT[s] + by})[0])

        for of, derivative in ((log_p, slope), (slope, curvature)):
            expected = (moved(of, STEP) - moved(of, -STEP)) / (2.0 * STEP)
            found = float(evaluate([derivative], AT)[0])
            assert found == pytest.approx(expected, rel=1e-6, abs=1e-6), (s, of is slope)
