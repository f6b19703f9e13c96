"""Measles in London, 1950 to 1964, as a susceptible-infected model without seasons.

Data: weekly cases of the Registrar General, with births, as `pypomp` carries them (uk_measles).
Rows are of two weeks, the time from one case to the next. l is the logarithm of the infected in
thousands, s the susceptible of the row before, in thousands; `births` are those of four years
before (the age at which school began to matter), thousands in two weeks; `log_cases` the logarithm
of the cases.

What such a model lacks: transmission is high in school terms and low in the holidays (H. E. Soper,
J. R. Statist. Soc. 92, 1929; P. E. M. Fine, J. A. Clarkson, Int. J. Epidemiology 11, 1982; B. F.
Finkenstadt, B. T. Grenfell, Applied Statistics 49, 2000; D. He, E. L. Ionides, A. A. King, J. R.
Soc. Interface 7, 2010). Right: a periodic forcing with the period of a year, 26 rows, one more or
less. Written down before the first run.
"""

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.real.answers import Named, package_file

LACKS = "the school year in the contact rate: a forcing with a period of 26 rows"
FIRST, LAST, DELAY, ROWS_A_YEAR = 1950, 1964, 4, 26

model = ssm.Model("measles", inputs=("births",))


@model.prior
def prior():
    return {
        "beta": ssm.LogNormal(np.log(0.0075), sd=0.5),  # 1 / (thousand people x two weeks)
        "reported": ssm.LogNormal(np.log(0.5), sd=0.2),
        "q": ssm.LogNormal(np.log(0.2), sd=0.7),
        "r": ssm.LogNormal(np.log(0.1), sd=0.7),
    }


@model.initial
def initial():
    return {"l": ssm.Normal(0.0, sd=1.0), "s": ssm.Normal(130.0, sd=40.0)}


@model.transition
def transition(l, s, births, beta, q):
    left = np.maximum(s + births - np.exp(l), 1.0)
    return {"l": ssm.Normal(np.log(beta * left) + l, sd=q), "s": ssm.Dirac(left)}


@model.observation
def observation(l, reported, r):
    return {"log_cases": ssm.Normal(np.log(1000.0 * reported) + l, sd=r)}


def records() -> pd.DataFrame:
    """(T, 2): log_cases, births; T = 26 rows a year."""
    cases = pd.read_csv(package_file("pypomp", "data", "uk_measles", "measles.csv.gz"))
    people = pd.read_csv(package_file("pypomp", "data", "uk_measles", "demog.csv"))
    cases, people = (t[t["unit"] == "London"] for t in (cases, people))
    years = pd.to_datetime(cases["date"]).dt.year.to_numpy()
    weekly = cases["cases"].to_numpy(dtype=float)[(years >= FIRST) & (years <= LAST)]
    rows = weekly[: len(weekly) // 2 * 2].reshape(-1, 2).sum(1)
    births = people.set_index("year")["births"] / 1000 / ROWS_A_YEAR
    year = np.minimum(FIRST + np.arange(len(rows)) // ROWS_A_YEAR, LAST) - DELAY
    return pd.DataFrame({"log_cases": np.log(rows), "births": births.loc[year].to_numpy()})


def right(n: Named) -> bool:
    return n.among("periodic forcing") and n.near("period", ROWS_A_YEAR - 1, ROWS_A_YEAR + 1)
