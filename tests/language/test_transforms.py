"""Values on the unconstrained scale, bounds among them."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.language.trace import trace
from ssmppl.language.transforms import transforms, unconstrain


def bounded():
    model = ssm.Model("bounded")
    model.prior(lambda: {
        "a": ssm.Uniform(-1.0, 2.0), "b": ssm.HalfNormal(sd=1), "c": ssm.Normal(0, sd=1),
    })  # fmt: skip
    model.initial(lambda c: {"x": ssm.Normal(c, sd=1)})
    model.transition(lambda x, a, b: {"x": ssm.Normal(a * x, sd=b)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return trace(model)


@pytest.mark.parametrize(
    "values", [(0.3, 0.7, -1.2), (-1.0, 0.7, 0.0), (2.0, 0.7, 0.0), (0.5, 0.0, 0.0)]
)
def test_there_and_back(values):
    """A search that runs towards a bound ends on it by rounding: it has a finite place there."""
    t = bounded()
    theta = np.array(values)
    z = unconstrain(t, theta, dict(zip("abc", map(np.asarray, values), strict=True)))
    assert np.all(np.isfinite(z))
    made = transforms(t)
    known = dict(zip([s for m in made for s in m.free], z, strict=True))
    back = np.concatenate([evaluate(array(list(m.values)), known) for m in made])
    np.testing.assert_allclose(back, theta, atol=1e-12)
