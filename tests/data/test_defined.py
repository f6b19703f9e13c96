"""Laws that the data leave without a value: told by row before anything runs."""

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.data import defined
from ssmppl.errors import DataError

Y = np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.2])


def model_of(
    mean=lambda x, mu, u, t: x, sd=lambda u: 1.0, move=lambda x, u: x, start=lambda u: 0.0
):
    model = ssm.Model("groups", inputs=("u",))

    @model.prior
    def prior():
        return {"mu": ssm.Normal(np.zeros(3), sd=1.0)}

    @model.initial
    def initial(u):
        return {"x": ssm.Normal(start(u), sd=1.0)}

    @model.transition
    def transition(x, u):
        return {"x": ssm.Normal(move(x, u), sd=1.0)}

    @model.observation
    def observation(x, mu, u, t):
        return {"y": ssm.Normal(mean(x, mu, u, t), sd=sd(u))}

    return model


def evidence(model, u, y=Y):
    frame = pd.DataFrame({"y": y, "u": np.asarray(u, float)})
    found = ssm.log_likelihood(model, frame, {"mu": [0.0, 1.0, 2.0]})
    return float(np.asarray(found).ravel()[0])


def by_group(x, mu, u, t):
    return x + mu[u]


def test_an_index_of_the_data_beyond_the_elements():
    with pytest.raises(DataError) as caught:
        evidence(model_of(by_group), [1, 2, 3, 1, 2, 3])
    text = str(caught.value)
    assert "'u', row 3" in text
    assert "the index u is 3, and there are 3 elements, 0 to 2, in the mean of Normal" in text
    assert "the distribution of 'y'" in text
    assert "test_defined.py" in text
    assert "index - 1" in text


@pytest.mark.parametrize("bad", [-1.0, 0.5, 3.0, 1e300])
def test_negative_fractional_and_large_indices(bad):
    with pytest.raises(DataError, match="'u', row 5"):
        evidence(model_of(by_group), [0, 1, 2, 1, bad, 0])


def test_codes_from_one_less_one_are_those_from_zero():
    shifted = model_of(lambda x, mu, u, t: x + mu[u - 1])
    assert evidence(shifted, [1, 2, 3, 1, 2, 3]) == evidence(model_of(by_group), [0, 1, 2] * 2)


def test_an_index_is_not_asked_for_where_a_condition_rules_it_out():
    guarded = model_of(lambda x, mu, u, t: x + np.where(u >= 0, mu[u], 0.0))
    first = model_of(lambda x, mu, u, t: x + np.where(u == 0, 0.0, mu[u]))
    assert evidence(guarded, [0, -1, -1, -1, -1, 0]) == evidence(first, np.zeros(6))
    with pytest.raises(DataError, match="'u', row 2"):
        evidence(guarded, [0, 3, 0, 0, 0, 0])


def test_rows_without_an_observation_do_not_ask_for_it():
    gaps = np.where(np.arange(6) == 2, np.nan, Y)
    found = evidence(model_of(by_group), [0, 1, 99, 1, 2, 0], gaps)
    assert found == evidence(model_of(by_group), [0, 1, 0, 1, 2, 0], gaps)


def test_an_index_by_the_row_number():
    season = model_of(lambda x, mu, u, t: x + mu[(t - 1) % 3])
    assert evidence(season, np.zeros(6)) == evidence(model_of(by_group), [0, 1, 2] * 2)
    with pytest.raises(DataError, match=r"(?s)row 3.*the index t is 3"):
        evidence(model_of(lambda x, mu, u, t: x + mu[t]), np.zeros(6))


def test_laws_of_states_are_looked_at_in_the_rows_that_they_read():
    moved = model_of(move=lambda x, u: x + np.choose(u, [0.5, 1.0]))
    with pytest.raises(DataError, match=r"(?s)'u', row 5.*the distribution of 'x'"):
        evidence(moved, [0, 0, 0, 0, 2, 0])
    evidence(moved, [0, 0, 0, 0, 0, 2])  # nothing follows the last row
    begun = model_of(start=lambda u: np.choose(u, [0.5, 1.0]))
    with pytest.raises(DataError, match=r"(?s)'u', row 1.*the distribution of 'x'"):
        evidence(begun, [2, 0, 0, 0, 0, 0])
    evidence(begun, [0, 2, 2, 2, 2, 2])


def test_roots_and_logarithms_of_the_data():
    with pytest.raises(DataError) as caught:
        evidence(model_of(sd=lambda u: 1.0 + np.sqrt(u)), [1, 4, -9, 1, 1, 1])
    assert "'u', row 3" in str(caught.value)
    assert "the sd of Normal" in str(caught.value)
    assert "is not a number: sqrt(u) at u = -9" in str(caught.value)
    with pytest.raises(DataError, match=r"(?s)row 2.*log\(u\) at u = -1"):
        evidence(model_of(lambda x, mu, u, t: mu[0] * np.log(u) + x), [1, -1, 1, 1, 1, 1])
    guarded = model_of(lambda x, mu, u, t: x + np.where(u > 0, np.log(u), 0.0))
    assert np.isfinite(evidence(guarded, [1, -1, 0, 1, 1, 1]))


def observed_by(law):
    """A random walk x, and y under `law(x, u)`."""
    model = ssm.Model("observed", inputs=("u",))
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1.0)})
    model.observation(lambda x, u: {"y": law(x, u)})
    return model


def test_laws_inside_of_laws():
    def law(x, u):
        inner = [ssm.Normal(x + np.choose(u, [0.0, 1.0]), sd=1.0), ssm.Normal(x, sd=9.0)]
        return ssm.Mixture([0.9, 0.1], inner)

    with pytest.raises(
        DataError, match=r"(?s)'u', row 4.*the mean of Normal, the distribution of 'y'"
    ):
        ssm.log_likelihood(observed_by(law), {"y": Y, "u": [0, 1, 1, 2, 0, 0]}, {})


PAIRS = np.column_stack([Y, np.where(np.arange(6) == 2, np.nan, Y)])  # one missing in row 3
ROOM = [0.0, 1.0]


@pytest.mark.parametrize(
    "law",
    [
        lambda x, u: ssm.Normal(np.stack([x, x + np.choose(u, ROOM)]), sd=1.0),
        lambda x, u: ssm.MvNormal(
            np.stack([x, x + np.choose(u, ROOM)]), covariance=[[1.0, 0.2], [0.2, 1.0]]
        ),
        lambda x, u: ssm.MvNormal(
            np.stack([x, x]),
            covariance=np.block([[1.0, 0.1 * np.choose(u, ROOM)], [0.1 * np.choose(u, ROOM), 1.0]]),
        ),
    ],
    ids=["independent", "mean", "covariance"],
)
def test_entries_of_a_vector_ask_where_they_are_measured(law):
    model = observed_by(law)
    found = ssm.log_likelihood(model, {"y": PAIRS, "u": [0, 1, 9, 1, 0, 0]}, {}, seed=1)
    assert found == ssm.log_likelihood(model, {"y": PAIRS, "u": [0, 1, 0, 1, 0, 0]}, {}, seed=1)
    with pytest.raises(DataError, match="'u', row 4"):
        ssm.log_likelihood(model, {"y": PAIRS, "u": [0, 1, 0, 9, 0, 0]}, {})


def test_what_has_a_value_all_the_same_is_taken():
    power = model_of(lambda x, mu, u, t: x + np.log(u) ** (0.0 * u))  # NaN**0 is 1
    assert evidence(power, -np.ones(6)) == evidence(model_of(lambda x, mu, u, t: x + 1.0), [1] * 6)


def test_masks_rule_out_too():
    masked = model_of(lambda x, mu, u, t: x + (u >= 0) * mu[u])
    guarded = model_of(lambda x, mu, u, t: x + np.where(u >= 0, mu[u], 0.0))
    assert evidence(masked, [0, -1, 2, -1, 1, 0]) == evidence(guarded, [0, -1, 2, -1, 1, 0])
    with pytest.raises(DataError, match="'u', row 4"):
        evidence(masked, [0, -1, 2, 3, 1, 0])


def test_an_index_that_is_not_whole_is_told_in_full():
    model = model_of(lambda x, mu, u, t: x + np.choose(100 * u, np.arange(60.0)))
    with pytest.raises(DataError, match=r"(?s)28\.999999999999996, which is not whole.*floor"):
        evidence(model, [0.0, 0.01, 0.29, 0.5, 0.5, 0.5])


def fed_back(centre):
    model = ssm.Model("fed back")
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x, y: {"x": ssm.Normal(0.5 * x + centre(y), sd=1.0)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1.0)})
    return model


def test_earlier_observations_are_asked_where_there_are_some():
    root = fed_back(lambda y: np.sqrt(y))
    with pytest.raises(DataError, match=r"(?s)'y', row 2.*sqrt\(y_prev\) at y_prev = -0.2"):
        ssm.log_likelihood(root, {"y": Y}, {})
    taken = fed_back(lambda y: np.log(1.0 + y**2))
    ssm.predict(taken, None, steps=5, draws=10, seed=1)  # y is drawn there
    gap = np.where(np.arange(6) == 2, np.nan, Y)
    ssm.predict(taken, None, {"y": gap}, draws=10, seed=1)


def test_what_is_drawn_asks_in_every_row():
    model = model_of(by_group)
    with pytest.raises(DataError, match="'u', row 2"):
        ssm.simulate(model, {"mu": [0.0, 1.0, 2.0]}, inputs={"u": [0, 3, 0]}, seed=1)
    with pytest.raises(DataError, match="'u', row 3"):
        ssm.predict(model, None, {"u": [0, 1, 9]}, draws=10, seed=1)


def forecast_of(model, u, ahead):
    data = {"y": Y, "u": np.asarray(u, float)}
    drawn = ssm.sample(model, data, draws=20, warmup=20, chains=1, seed=1, progress=False)
    return ssm.forecast(model, drawn, inputs={"u": np.asarray(ahead, float)}, seed=1)


@pytest.mark.filterwarnings("ignore:the chains")
def test_forecasts_ask_in_the_rows_that_they_draw():
    with pytest.raises(DataError, match=r"(?s)In inputs, 'u', row 2.*the index u is 3"):
        forecast_of(model_of(by_group), [0, 1, 2, 0, 1, 2], [0, 3])
    moved = model_of(move=lambda x, u: x + np.choose(u, [0.5, 1.0]))
    with pytest.raises(
        DataError, match=r"(?s)the last row of the data, 'u'.*the index u_prev is 7"
    ):
        forecast_of(moved, [0, 0, 0, 0, 0, 7], [0, 0])
    forecast_of(moved, np.zeros(6), [0, 7])  # nothing follows the last row
    begun = model_of(start=lambda u: np.choose(u, [0.5, 1.0]))
    forecast_of(begun, [1, 6, 6, 6, 6, 6], [6, 6])
    table = model_of(lambda x, mu, u, t: x + np.choose(t - 1, np.arange(8.0)))
    forecast_of(table, np.zeros(6), np.zeros(2))
    with pytest.raises(DataError, match=r"(?s)In inputs, row 3.*the index t - 1 is 8"):
        forecast_of(table, np.zeros(6), np.zeros(4))


def test_rows_are_looked_at_in_parts(monkeypatch):
    monkeypatch.setattr(defined, "CHUNK", 4)
    with pytest.raises(DataError, match="'u', row 6"):
        evidence(model_of(by_group), [0, 1, 2, 0, 1, 3])
    moved = model_of(move=lambda x, u: x + np.choose(u, [0.5, 1.0]))
    with pytest.raises(DataError, match="'u', row 5"):
        evidence(moved, [0, 0, 0, 0, 2, 0])


def test_each_data_set_is_named():
    good, bad = ({"y": Y, "u": np.full(6, u)} for u in (0.0, 7.0))
    with pytest.raises(DataError, match=r"(?s)data set 2.*'u', row 1.*is 7"):
        ssm.log_likelihood(model_of(by_group), [good, bad], {"mu": [0.0, 1.0, 2.0]})
