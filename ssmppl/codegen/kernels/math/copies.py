"""Copies of arrays, number by number.

A slice that is assigned an array checks the shapes, and the message of that check drags Numba's
string functions in: seconds of compiling for each kernel that has one.
"""

from __future__ import annotations

from ssmppl.codegen.kernels.math.flags import exact


@exact
def copy_row(source, target):
    """target = source, as far as target goes."""
    for i in range(target.size):
        target[i] = source[i]


@exact
def copy_rows(source, target):
    """target = source, both of two axes, as far as target goes."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]
