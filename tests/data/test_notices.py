"""What is noticed of data where something is estimated from them."""

import warnings

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm

DATES = pd.date_range("2020-01-01", periods=12, freq="MS")
Y = np.cumsum(np.random.default_rng(1).normal(size=12))


def level(**options):
    model = ssm.Model("level", **options)

    @model.prior
    def prior():
        return {"q": ssm.InverseGamma(3, scale=1)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, q):
        return {"x": ssm.Normal(x, variance=q)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1), "z": ssm.Normal(x, sd=2)}

    return model


def table(**columns):
    return pd.DataFrame({"y": Y, "z": Y} | columns)


def said(model, data, verb=ssm.maximize):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        verb(model, data, progress=False)
    for w in caught:
        assert w.filename == __file__  # the user's own line
    return [str(w.message) for w in caught]


CASES = {
    "all is well": (table(time=DATES), []),
    "numbered rows": (table(), []),
    "a month is absent": (
        table(time=DATES).drop(index=4),
        ["the steps of the data are from 29 days to 61 days long"],
    ),
    "rows were dropped": (table().drop(index=4), ["the steps of the data are from 1 to 2 long"]),
    "a market's days": (table(time=pd.bdate_range("2024-03-01", periods=12)), []),
    "a day is absent": (
        table(time=pd.date_range("2024-03-01", periods=12)).drop(index=4),
        ["the steps of the data are from 1 day to 2 days long"],
    ),
    "nothing in a column": (table(z=np.nan), ["z: missing in every row"]),
    "dates that nobody reads": (table(date=DATES), ["the column 'date' is not used"]),
    "dates under another name": (table(Datum=DATES), ["the column 'Datum' is not used"]),
    "dates as text": (table(when=DATES.astype(str)), ["the column 'when' is not used"]),
    "the day first": (table(when=DATES.strftime("%d.%m.%Y")), ["the column 'when' is not used"]),
    "dates of Python": (table(when=DATES.date), ["the column 'when' is not used"]),
    "a mapping": ({"y": Y, "z": Y, "when": DATES.values}, ["the column 'when' is not used"]),
    "names": (table(station="Potsdam", ward=np.arange(12).astype(str)), []),
    "dates beside others": (table(time=DATES, month=DATES), []),
    "another column": (table(updates=1.0), []),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_noticed(case):
    data, expected = CASES[case]
    found = said(level(), data)
    assert len(found) == len(expected)
    assert all(a.startswith(b) for a, b in zip(found, expected, strict=True))


def test_steps_that_the_model_reads_are_no_surprise():
    assert said(level(time_step="dt", time_unit="D"), table(time=DATES).drop(index=4)) == []


def test_sampling_notices_too():
    def short(model, data, progress):
        return ssm.sample(model, data, draws=4, warmup=4, chains=1, seed=1, progress=progress)

    assert len(said(level(), table(date=DATES), short)) == 1


def test_a_verb_that_samples_from_parts_of_the_data_notices_once():
    """A channel that begins late is missing in all rows of the first part."""

    def shortly(model, data, progress):
        ssm.leave_future_out(
            model, data, first=6, draws=20, warmup=20, chains=2, seed=1, progress=progress
        )

    def evidence(model, data, progress):
        ssm.evidence(model, data, draws=100, warmup=50, chains=2, seed=1, progress=progress)

    late = table(z=np.where(np.arange(12) < 8, np.nan, Y))
    assert [s for s in said(level(), late, shortly) if "missing in every row" in s] == []
    found = said(level(), table(date=DATES), evidence)
    assert len([s for s in found if "the column 'date'" in s]) == 1


def test_days_of_a_market_are_called_so_by_explain():
    days = pd.bdate_range("2024-03-25", periods=14).delete([4, 5])
    model = ssm.Model("returns")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.9 * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    text = str(ssm.explain(model, pd.DataFrame({"y": np.zeros(12)}, index=days)))
    assert "days without weekends, one row is one step" in text
    every = pd.date_range("2024-03-25", periods=12)
    assert "weekends" not in str(ssm.explain(model, pd.DataFrame({"y": np.zeros(12)}, index=every)))
