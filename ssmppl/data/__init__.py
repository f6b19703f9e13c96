"""Arrays in: data sets and parameter values, checked against the traced model.

Whatever the user gives (a mapping, a DataFrame, a Dataset, or a list of them) becomes float64
arrays over the trace's symbols, or an error that names data set, variable, row and column.
"""

from ssmppl.data.binding import Experiment, bind, bind_inputs, unread
from ssmppl.data.defined import check_defined
from ssmppl.data.parameters import (
    check_parameters,
    check_values,
    spelled,
    unpack_observations,
    unpack_parameters,
    unpack_states,
)

__all__ = [
    "Experiment",
    "bind",
    "bind_inputs",
    "check_defined",
    "check_parameters",
    "check_values",
    "spelled",
    "unpack_observations",
    "unpack_parameters",
    "unpack_states",
    "unread",
]
