"""Numbers as users write them, as float64; and what lies outside a distribution's support."""

from __future__ import annotations

import math
import numbers
import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.language.distributions import (
    Censored,
    Distribution,
    EulerMultinomial,
    Multinomial,
    Truncated,
)
from ssmppl.language.distributions.base import Support

UNIT_ROUNDING = 1e-8  # by which a diagonal of ones may miss 1
Values = Mapping[Expr, np.ndarray]


@dataclass(frozen=True)
class Fault:
    """Something wrong with an array: where in it (None: everywhere), what, and the fix."""

    index: tuple[int, ...] | None
    found: str
    fix: str


def as_numbers(value: Any) -> np.ndarray | Fault:
    """`value` as float64, NaN where it is masked, None, NA or NaT; or what forbids that."""
    if isinstance(value, np.ma.MaskedArray):
        masked = np.ma.getmaskarray(value)
        if value.dtype.kind in "biuf":
            return np.where(masked, np.nan, value.data.astype(np.float64))
        entries = np.array(value.data, dtype=object)
        entries[masked] = None
        return as_numbers(entries)
    if isinstance(value, (dict, set, frozenset, str, bytes)):
        return Fault(None, f"is {short(value)}, which is no array", "give an array of numbers")
    kind = getattr(getattr(value, "dtype", None), "kind", "O")
    if kind in "biuf" and not isinstance(value, (np.ndarray, np.generic)):
        try:  # pandas' nullable columns: pd.NA becomes NaN
            return np.asarray(value.to_numpy(dtype=np.float64, na_value=np.nan))
        except (AttributeError, TypeError, ValueError):
            pass
    try:
        plain = np.asarray(value)
    except (TypeError, ValueError):
        return Fault(
            None,
            f"is no rectangular array: {short(value)}",
            "give every row the same number of entries, NaN where one is missing",
        )
    if plain.dtype.kind in "biuf":
        return plain.astype(np.float64)
    if plain.dtype.kind in "mM":
        return Fault(
            (0,) * plain.ndim if plain.size else None,
            f"holds dates or durations: {plain.ravel()[0] if plain.size else plain.dtype}",
            "convert it to numbers, for example seconds / np.timedelta64(1, 's'); times of the "
            "rows are the index or the coordinate 'time'",
        )
    if plain.dtype.kind == "c":
        return Fault(
            (0,) * plain.ndim if plain.size else None,
            f"is complex: {plain.ravel()[0] if plain.size else plain.dtype}",
            "give real and imaginary parts as two channels, or as a vector of length 2",
        )
    if plain.ndim == 0 and plain.dtype.kind == "O" and not _missing(plain[()]):
        if not isinstance(plain[()], (numbers.Real, Decimal)):
            return Fault(
                None, f"is {short(plain[()])}, which is no array", "give an array of numbers"
            )
    return _objects(plain)


# 1,5 or 1,000,000: numbers of a file that was written elsewhere
_WITH_COMMA = re.compile(r"[+-]?\d+(,\d+)+(\.\d+)?(e[+-]?\d+)?", re.IGNORECASE)


def _objects(plain: np.ndarray) -> np.ndarray | Fault:
    odd = _no_number(plain)
    if odd is not None:
        return odd
    out = np.empty(plain.shape)
    for index in np.ndindex(plain.shape):
        entry = plain[index]
        if _missing(entry):
            out[index] = np.nan
        elif isinstance(entry, (numbers.Real, np.bool_, Decimal)):
            try:
                out[index] = float(entry)
            except OverflowError:
                found = f"{short(entry)} is too large for a floating point number"
                return Fault(index, found, "give it in larger units")
        else:
            text = isinstance(entry, (str, bytes))
            if isinstance(entry, str) and _WITH_COMMA.fullmatch(entry.strip()):
                return Fault(
                    index,
                    f"the text {short(entry)} stands where a number is expected",
                    "write decimal numbers with points, and thousands without a mark; "
                    "pd.read_csv(file, decimal=',') reads decimal commas, and thousands=',' commas "
                    "between thousands",
                )
            # where no entry is a number, errors='coerce' would leave nothing of the column
            some = any(not isinstance(v, str) or _spells_number(v) for v in plain.ravel())
            return Fault(
                index,
                f"{'the text ' if text else ''}{short(entry)} stands where a number is expected",
                "convert the column, for example by pd.to_numeric(column, errors='coerce'), "
                "which writes NaN for what is not a number"
                if text and some
                else "give numbers, NaN where a value is missing",
            )
    return out


def _no_number(plain: np.ndarray) -> Fault | None:
    """The first text that spells no number, in an array that has others which do.

    One such entry makes text of a whole column when a file is read, and is what there is to mend.
    """
    texts = [(i, v) for i, v in np.ndenumerate(plain) if isinstance(v, str)]
    odd = [(index, text) for index, text in texts if not _spells_number(text)]
    if not odd or len(odd) == len(texts):
        return None
    index, text = odd[0]
    others = len(odd) - 1
    more = f", as {'does one other' if others == 1 else f'do {others} others'}" if others else ""
    return Fault(
        index,
        f"the text {short(text)} stands where a number is expected{more}; it makes text of the "
        "whole column",
        "write a number there, or nothing if the value is missing; "
        "pd.to_numeric(column, errors='coerce') makes NaN of all such entries",
    )


def _spells_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _missing(entry: Any) -> bool:
    if isinstance(entry, Decimal) and entry.is_nan():  # a signalling one has no float
        return True
    return entry is None or type(entry).__name__ in ("NAType", "NaTType", "MaskedConstant")


def short(value: Any) -> str:
    """A value's repr, cut to one line; of a NumPy number or text that of Python's own."""
    plain = value.item() if isinstance(value, np.generic) else value
    text = " ".join(repr(plain).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def number(value: float) -> str:
    """A value as the user wrote it, in short."""
    return f"{value:.10g}"


def outside(
    distribution: Distribution, values: np.ndarray, env: Values, support: Support | None = None
) -> Fault | None:
    """The first of `values` (T, *shape) that `distribution` gives no density; NaN pass.

    support : that of `distribution`, where the caller has it.

    Bounds are numbers, or expressions of the symbols in `env` (each (T,) or scalar); bounds that
    depend on anything else are not looked at. The index of the fault starts with the row.
    """
    support = distribution.support() if support is None else support
    if support.kind == "simplex":
        return _outside_simplex(distribution, values)
    if support.kind == "positive definite":
        return _outside_cone(distribution, values)
    if support.kind == "correlation":
        return _outside_unit_diagonal(values) or _outside_cone(distribution, values)
    if support.kind not in ("interval", "integers", "ordered"):
        return None
    lower = _bound(support.lower, env, len(values), -math.inf)
    upper = _bound(support.upper, env, len(values), math.inf)
    closed = support.kind == "integers" or distribution.closed
    with np.errstate(invalid="ignore"):
        bad = (values < lower) | (values > upper)
        bad |= (values == lower) & (not closed)
        bad |= (values == upper) & distribution.open_above
        if support.kind == "integers":
            bad |= np.isfinite(values) & (values != np.floor(values))
    if not bad.any():
        if isinstance(distribution, (EulerMultinomial, Multinomial)):
            return _wrong_total(distribution, values, upper[:, 0])
        return _out_of_order(values) if support.kind == "ordered" else None
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    low, high = lower[index], upper[index]
    if support.kind == "integers":
        first = f" from {number(low)}" if math.isfinite(low) else ""
        last = f" {'to' if first else 'up to'} {number(high)}" if math.isfinite(high) else ""
        bounds = f"the whole numbers{first}{last}"
    else:
        left, right = "[" if closed else "(", ")" if distribution.open_above else "]"
        left, right = left if math.isfinite(low) else "(", right if math.isfinite(high) else ")"
        bounds = f"{left}{number(low)}, {number(high)}{right}"
    return Fault(
        index,
        f"{number(values[index])} is outside the support of {name_of(distribution)}, {bounds}",
        f"one of {bounds}" if support.kind == "integers" else f"a value in {bounds}",
    )


def name_of(distribution: Distribution) -> str:
    """The distribution's name as in the language."""
    if isinstance(distribution, (Censored, Truncated)):
        word = "truncated" if isinstance(distribution, Truncated) else "censored"
        return f"the {word} {name_of(distribution.base)}"
    return type(distribution).__name__


def _bound(bounds: np.ndarray, env: Values, rows: int, none: float) -> np.ndarray:
    """(rows, *shape) of the bounds that can be computed from `env`, `none` elsewhere."""
    out = np.full((rows, *bounds.shape), none)
    for index in np.ndindex(bounds.shape):
        bound: Any = bounds[index]
        if bound.op == "const":
            out[(slice(None), *index)] = none if np.isnan(bound.data) else bound.data
        elif all(s in env for s in symbols_of(bound)):
            value = evaluate(bound, env)
            out[(slice(None), *index)] = np.where(np.isnan(value), none, value)
    return out


def _wrong_total(
    distribution: EulerMultinomial | Multinomial, values: np.ndarray, n: np.ndarray
) -> Fault | None:
    """Counts (T, K) that do not sum to n (T,), or to more than are there where some may stay;
    infinite n are not known."""
    total, all_placed = values.sum(axis=1), isinstance(distribution, Multinomial)
    with np.errstate(invalid="ignore"):
        bad = np.isfinite(n) & ((total > n) | (all_placed & (total < n)))
    if not bad.any():
        return None
    row = int(np.argmax(bad))
    counts = ", ".join(number(v) for v in values[row])
    return Fault(
        (row,),
        f"the counts [{counts}] sum to {number(total[row])}, and n of {name_of(distribution)} is "
        f"{number(n[row])} there",
        "counts that sum to n" if all_placed else "counts that sum to n at most",
    )


def _outside_simplex(distribution: Distribution, values: np.ndarray) -> Fault | None:
    for index in np.ndindex(values.shape[:-1]):  # the row of the data, and of a matrix
        p = values[index]
        if not np.isfinite(p).all():
            continue
        if (p <= 0).any() or (p >= 1).any():
            k = int(np.argmax((p <= 0) | (p >= 1)))
            return Fault(
                (*index, k),
                f"{number(p[k])} is outside the support of {name_of(distribution)}, (0, 1)",
                "shares strictly between 0 and 1",
            )
        if abs(p.sum() - 1.0) > 1e-6:
            return Fault(index, f"the shares {p.tolist()} sum to {number(p.sum())}, not to 1",
                         "shares divided by their sum")  # fmt: skip
    return None


def _out_of_order(values: np.ndarray) -> Fault | None:
    with np.errstate(invalid="ignore"):
        bad = values[..., 1:] <= values[..., :-1]
    if not bad.any():
        return None
    *row, k = (int(i) for i in np.argwhere(bad)[0])
    before, after = values[(*row, k)], values[(*row, k + 1)]
    return Fault(
        (*row, k + 1),
        f"{number(after)} does not lie above the component before it, {number(before)}",
        "values in increasing order",
    )


def without_unit_diagonal(m: np.ndarray, row: int = 0) -> Fault | None:
    """What keeps a matrix, at this row of the data, from having a diagonal of ones."""
    off = np.abs(np.diagonal(m) - 1.0)
    if not (off > UNIT_ROUNDING).any():
        return None
    i = int(np.argmax(off))
    return Fault(
        (row, i, i),
        f"the diagonal of a correlation matrix is 1, entry [{i}, {i}] is {number(m[i, i])}",
        "the correlations: of a covariance C, C / np.sqrt(np.outer(np.diag(C), np.diag(C)))",
    )


def _outside_unit_diagonal(values: np.ndarray) -> Fault | None:
    faults = (without_unit_diagonal(m, row) for row, m in enumerate(values) if np.isfinite(m).all())
    return next(filter(None, faults), None)


def asymmetry(m: np.ndarray, row: int = 0) -> Fault | None:
    """What keeps a matrix, at this row of the data, from being symmetric."""
    gap = np.abs(m - m.T)
    if not (gap > 1e-8 * max(1e-300, float(np.abs(m).max()))).any():
        return None
    i, j = (int(k) for k in np.unravel_index(np.argmax(gap), m.shape))
    return Fault(
        (row, i, j),
        f"the matrix is not symmetric: entry [{i}, {j}] is {number(m[i, j])}, "
        f"[{j}, {i}] is {number(m[j, i])}",
        "a symmetric matrix, for example (m + m.T) / 2",
    )


def _outside_cone(distribution: Distribution, values: np.ndarray) -> Fault | None:
    for row, m in enumerate(values):
        if not np.isfinite(m).all():
            continue
        fault = asymmetry(m, row)
        if fault is not None:
            return fault
        least = float(np.linalg.eigvalsh(m)[0])
        if not least > 0:
            return Fault(
                (row,),
                f"the matrix {m.tolist()} is not positive definite: its least eigenvalue is "
                f"{number(least)}",
                "a positive definite matrix",
            )
    return None
