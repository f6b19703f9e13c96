"""Series embedded in the package, for examples and tests.

Every loader returns plain NumPy arrays, and reads the file afresh: what it returns may be changed.
"""

import csv
from importlib import resources

import numpy as np

from ssmppl.errors import ArgumentError, listing

__all__ = [
    "airline",
    "boarding_school",
    "ice_varves",
    "lgss_appendix",
    "lgss_main_text",
    "load",
    "names",
    "nile",
]


def names() -> tuple[str, ...]:
    """Names of the embedded data sets.

    Returns
    -------
    tuple of str
        What `load` knows.
    """
    files = (entry.name for entry in resources.files(__name__).iterdir())
    return tuple(sorted(name.removesuffix(".csv") for name in files if name.endswith(".csv")))


def load(name: str) -> dict[str, np.ndarray]:
    """Columns of an embedded data set.

    Parameters
    ----------
    name : one of `names()`.

    Returns
    -------
    dict of float64 arrays (T,)
        By their names in the file.

    Raises
    ------
    ArgumentError : there is no such data set; lists the names.
    """
    known = names()
    if name not in known:
        raise ArgumentError(
            f"no embedded data set is called {name!r}.", fix=f"there are {listing(name, known)}"
        )
    text = resources.files(__name__).joinpath(f"{name}.csv").read_text(encoding="utf-8")
    header, *rows = csv.reader(text.splitlines())
    columns = np.array(rows, dtype=np.float64).T
    return {column: values.copy() for column, values in zip(header, columns, strict=True)}


def airline() -> np.ndarray:
    """Passengers of international airlines in each month from January 1949 to December 1960.

    Series G of Box and Jenkins, *Time Series Analysis: Forecasting and Control* (1970). The months
    are the columns `year` and `month` of `load("airline")`.

    Returns
    -------
    float64 array (144,)
        Thousands of passengers.
    """
    return load("airline")["passengers"]


def boarding_school() -> np.ndarray:
    """Boys in bed with influenza in an English boarding school of 763 boys, on 14 days in a row.

    "Influenza in a boarding school", *British Medical Journal* 1978; 1:587.

    Returns
    -------
    float64 array (14,)
        How many were in bed, day by day.
    """
    return load("boarding_school")["in_bed"]


def ice_varves() -> np.ndarray:
    """Thickness of 634 yearly layers of glacial sediment (varves) in Massachusetts.

    One layer for each year from 9883 to 9250 BC; changes of thickness indicate changes of
    temperature. The series is that of Shumway and Stoffer, *Time Series Analysis and Its
    Applications* (3rd edition, Springer 2011). Langrock, *Journal of Applied Statistics* 38 (2011),
    gave it the Gamma observation model that Schön et al., "Sequential Monte Carlo methods for
    system identification" (2015), and the examples here use.

    Returns
    -------
    float64 array (634,)
        Thickness, in the order of years.
    """
    return load("ice_varves")["y"]


def lgss_main_text() -> np.ndarray:
    """A simulated linear Gaussian series.

    x_1 ~ N(0, 1/(0.51 theta)), x_{t+1} = 0.7 x_t + N(0, 1/theta), y_t = 0.5 x_t + N(0, 0.1) with
    variances as second arguments and theta = 1: the example in the main text of Schön et al.
    (2015). Simulated anew from these distributions; it is not the series plotted there.

    Returns
    -------
    float64 array (100,)
        The observations y.
    """
    return load("lgss_main_text")["y"]


def lgss_appendix() -> np.ndarray:
    """A simulated linear Gaussian series.

    As `lgss_main_text`, with y_t = x_t + N(0, 0.1), as in the appendix of Schön et al. (2015).

    Returns
    -------
    float64 array (100,)
        The observations y.
    """
    return load("lgss_appendix")["y"]


def nile() -> np.ndarray:
    """Annual flow of the Nile at Aswan from 1871 to 1970.

    Cobb, *Biometrika* 65 (1978); the local level model of Durbin and Koopman, *Time Series Analysis
    by State Space Methods*, chapter 2. The first dam at Aswan was begun in 1898. The years are the
    column `time` of `load("nile")`.

    Returns
    -------
    float64 array (100,)
        Flow, in 10^8 m^3 a year.
    """
    return load("nile")["y"]
