"""Ready components of structural time series models, written into an `ssm.Model` as ordinary
functions.

    component.py  what a component is, and how it is written into a model
    trends.py     level, trend
    periodic.py   seasonal, cycle; rotation
    effects.py    regression, intervention, autoregression; ar_coefficients, ar_covariance
    observing.py  observe
    printing.py   source
"""

from ssmppl.structural.component import Component
from ssmppl.structural.effects import (
    ar_coefficients,
    ar_covariance,
    autoregression,
    intervention,
    regression,
)
from ssmppl.structural.observing import observe
from ssmppl.structural.periodic import cycle, rotation, seasonal
from ssmppl.structural.printing import source
from ssmppl.structural.trends import level, trend

__all__ = [
    "Component",
    "ar_coefficients",
    "ar_covariance",
    "autoregression",
    "cycle",
    "intervention",
    "level",
    "observe",
    "regression",
    "rotation",
    "seasonal",
    "source",
    "trend",
]
