"""Inputs that are matrices, such as the covariance that a receiver reports with each fix."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import ssmppl as ssm

ROWS = 5
_ROOT = np.random.default_rng(1).normal(size=(ROWS, 2, 2))
R = _ROOT @ _ROOT.transpose(0, 2, 1) + np.eye(2)
Y = np.random.default_rng(2).normal(size=(ROWS, 2))


def fixes() -> ssm.Model:
    model = ssm.Model("fixes", inputs={"R": (2, 2), "pull": None})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x, pull: {"x": ssm.Normal(x + pull, sd=0.3)})
    model.observation(lambda x, R: {"y": ssm.MvNormal(x, covariance=(R + R.T) / 2)})
    return model


def expected() -> float:
    whole = np.zeros((2 * ROWS, 2 * ROWS))
    for s, t in np.ndindex(ROWS, ROWS):
        shared = 1.0 + 0.09 * min(s, t)
        own = R[t] if s == t else 0.0
        whole[2 * s : 2 * s + 2, 2 * t : 2 * t + 2] = shared * np.eye(2) + own
    return float(scipy.stats.multivariate_normal(np.zeros(2 * ROWS), whole).logpdf(Y.ravel()))


def test_arrays():
    data = {"y": Y, "R": R, "pull": np.zeros(ROWS)}
    assert ssm.log_likelihood(fixes(), data, {})[0] == pytest.approx(expected(), abs=1e-9)
    drawn = ssm.simulate(fixes(), {}, inputs={"R": R, "pull": np.zeros(ROWS)}, draws=4000, seed=1)
    away = drawn["y"].to_numpy() - drawn["x"].to_numpy()
    for t in range(ROWS):
        error = np.sqrt(2.0 / 4000) * R[t].max()
        assert np.cov(away[:, t].T) == pytest.approx(R[t], abs=5.0 * error)


@pytest.mark.parametrize("written", ["R[{}, {}]", "R[{},{}]", "R_{}_{}"])
def test_columns_of_a_table(written):
    columns = {written.format(i, j): R[:, i, j] for i, j in np.ndindex(2, 2)}
    table = pd.DataFrame({**columns, "pull": 0.0, "y_0": Y[:, 0], "y_1": Y[:, 1]})
    assert ssm.log_likelihood(fixes(), table, {})[0] == pytest.approx(expected(), abs=1e-9)


def test_other_shapes_are_refused():
    for wrong in (R[:, :1], R.reshape(ROWS, 4), R[:, 0, 0]):
        with pytest.raises(ssm.DataError, match="R"):
            ssm.log_likelihood(fixes(), {"y": Y, "R": wrong, "pull": np.zeros(ROWS)}, {})
    for length in ((2, 0), (2, 1.5), -1):
        with pytest.raises(ssm.ModelError, match="a tuple of two"):
            ssm.Model("wrong", inputs={"R": length})


def test_one_that_is_not_symmetric_is_told_how_to_be_made_so():
    model = ssm.Model("as it is", inputs={"R": (2, 2)})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=0.3)})
    model.observation(lambda x, R: {"y": ssm.MvNormal(x, covariance=R)})
    with pytest.raises(ssm.ModelError, match=r"\(M \+ M.T\) / 2"):
        ssm.log_likelihood(model, {"y": Y, "R": R}, {})
