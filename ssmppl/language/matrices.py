"""What is asked of a matrix that is a parameter of a law, where the law is written."""

from __future__ import annotations

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import constant, topological
from ssmppl.language.distribution import Distribution
from ssmppl.language.places import moderate, with_cases

# By which share two entries that are meant to be one may differ: of themselves, and of variances.
UNEQUAL, ROUNDING = 1e-6, 1e-10


def checked_matrix(law: Distribution, name: str) -> ExprArray:
    """A parameter that must be a square, symmetric, positive definite matrix, or of the name
    "cholesky" the lower factor of one; of symbols as far as can be told.

    Raises
    ------
    ModelError : it is none.
    """
    m, kind = law.parameters[name], type(law).__name__
    if m.ndim != 2 or m.shape[0] != m.shape[1]:
        raise ModelError(
            f"{kind}: {name} has shape {m.shape}", fix="give a square matrix", where=law.location
        )
    above = [m[i, j] for i in range(len(m)) for j in range(i + 1, len(m))]
    if name == "cholesky" and any(e is not constant(0.0) for e in above):
        raise ModelError(
            f"{kind}: cholesky is not lower triangular",
            fix="give the lower factor L with L L' = covariance, as np.linalg.cholesky does",
            where=law.location,
        )
    if all(e.op == "const" for e in m.ravel()):
        _check_numbers(law, name, m)
    elif name != "cholesky":
        _check_symmetry(law, name, m)
    return m


def _check_numbers(law: Distribution, name: str, m: ExprArray) -> None:
    numbers = np.array([e.data for e in m.ravel()]).reshape(m.shape)
    lower = name == "cholesky"
    symmetric = lower or np.allclose(numbers, numbers.T, rtol=1e-10, atol=0)
    positive = (
        bool(np.all(np.diagonal(numbers) > 0))
        if lower
        else symmetric and bool(np.all(np.linalg.eigvalsh(numbers) > 0))
    )
    if not symmetric or not positive:
        what = "positive definite" if symmetric else "symmetric"
        raise ModelError(
            f"{type(law).__name__}: {name} is not {what}: {numbers.tolist()}",
            fix="check its entries; a noise that is exactly zero is ssm.Dirac",
            where=law.location,
        )


def _check_symmetry(law: Distribution, name: str, m: ExprArray) -> None:
    """Of symbols: for what reads one half only, and for what reads both, it would be two laws."""
    pairs = [(i, j) for i in range(len(m)) for j in range(i) if m[i, j] is not m[j, i]]
    if not pairs:
        return
    entries = [m[i, j] for i, j in pairs] + [m[j, i] for i, j in pairs] + list(np.diagonal(m))
    if any(n.op == "call" for n in topological(entries)):
        return  # a primitive may have no value at numbers that no model gives it
    forms = with_cases(entries)
    with np.errstate(all="ignore"):
        found = [np.asarray(v, float) for v in evaluate(forms, moderate(forms))]
    diagonal = found[2 * len(pairs) :]
    for (i, j), a, b in zip(pairs, found, found[len(pairs) :], strict=False):
        # at every point: where it is no number nothing is known, and rounding may part some
        rounding = ROUNDING * np.sqrt(np.abs(diagonal[i] * diagonal[j]))
        if np.all(np.abs(a - b) > UNEQUAL * (np.abs(a) + np.abs(b)) + rounding):
            raise ModelError(
                f"{type(law).__name__}: {name} is not symmetric: its entry [{i}, {j}] is "
                f"{m[i, j]}, and [{j}, {i}] is {m[j, i]}",
                fix="give both the same value",
                where=law.location,
            )
