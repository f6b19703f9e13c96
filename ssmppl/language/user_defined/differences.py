"""Derivatives of compiled functions by central differences, as functions that Numba compiles.

A step of `STEPS` times the argument's size is taken first. What the difference shows then decides,
at every point: where it is lost in rounding the step grows, as long as the value stays within the
rounding of the one before (flat functions, arguments near zero of functions on a large scale);
where the function changes by a large share within the step it shrinks, until the value stays
(arguments on a small scale, a step out of the function's domain). A jump that lies inside of every
step is left out, as it is in the derivative of `np.where`: the first derivative is then that of the
side that moves less, higher ones are 0. The error of a central difference with a step h is that of
rounding, eps / h**r, and that of the next term of Taylor's series, of order h**2 (Press, Teukolsky,
Vetterling and Flannery, "Numerical Recipes", section 5.7).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba

EPS = 2.0**-52
LARGEST = 4  # order of a derivative
# By order: the first step, relative to the argument; how much larger the next (its square, fourth
# and sixth power those after it); how many roundings the difference must be to be taken; the
# share of the values from which the step is in doubt.
STEPS = {1: 2.0**-23, 2: 2.0**-13, 3: 2.0**-10, 4: 2.0**-8}
GROWTH = {1: 64.0, 2: 16.0, 3: 16.0, 4: 16.0}
DIGITS = {1: 1e6, 2: 1e4, 3: 1e3, 4: 1e3}
SUSPECT = {1: 1e-2, 2: 1e-4, 3: 1e-6, 4: 1e-8}
NEAREST = 2.0**-7  # arguments nearer to zero count as this large
GROWN, SHRUNK = 4, 7  # times
SAME = 1e-3  # of two values, relative, of which the smaller step is no better
# Weights of a central difference, by its order: place (in steps) -> weight, over step**order.
CENTRAL = {
    0: {0: 1.0},
    1: {1: 0.5, -1: -0.5},
    2: {1: 1.0, 0: -2.0, -1: 1.0},
    3: {2: 0.5, 1: -1.0, -1: 1.0, -2: -0.5},
    4: {2: 1.0, 1: -4.0, 0: 6.0, -1: -4.0, -2: 1.0},
}
FINE, NOISY, IN_DOUBT = 0, 1, 2
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
VERSION = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:4]


def compiled(function: Callable[..., Any], **further: Any) -> Any:
    """The function as Numba compiles it when it is first called."""
    return numba.njit(**OPTIONS, **further)(function)


_INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def _judged(
    attempt: int, total: float, largest: float, below: float, value: float, noise: float,
    state: int, digits: float, suspect: float,
) -> tuple[float, float, int]:  # fmt: skip
    """What is known of a derivative after one more step: (value, its rounding, what is wrong).

    total, largest : the weighted sum of the function's values, and the largest of them.
    below : the product of the steps. value, noise, state : as before it.
    """
    new, own = total / below, 64.0 * EPS * largest / abs(below)
    if attempt == 0:
        if not abs(total) <= suspect * largest:  # or no number
            return new, own, IN_DOUBT
        return new, own, NOISY if abs(total) < digits * EPS * largest else FINE
    if state == NOISY:
        if attempt > GROWN or not abs(new - value) <= noise:
            return value, noise, FINE
        if attempt == GROWN and abs(total) <= 8.0 * EPS * largest:
            return 0.0, own, FINE
        return new, own, NOISY if abs(total) < digits * EPS * largest else FINE
    if state == IN_DOUBT and attempt > GROWN:
        if abs(new - value) <= max(SAME * abs(value), own):
            return new, own, FINE
        return new, own, IN_DOUBT
    return value, noise, state


def _following(attempt: int, noisy: bool, doubtful: bool) -> int:
    """The number of the next attempt; negative where all is known."""
    if noisy and attempt < GROWN:
        return attempt + 1
    if doubtful and attempt < GROWN + SHRUNK:
        return max(attempt, GROWN) + 1
    return -1


def _scaled(attempt: int, growth: float) -> float:
    """How much longer its step is than the first."""
    if attempt > GROWN:
        return 0.25 ** (attempt - GROWN)
    k = 1.0
    for _ in range(attempt if attempt < 3 else 2 * attempt - 2):
        k *= growth
    return k


def _smaller(low: float, high: float) -> float:
    """Of the slopes to the two sides that of the side that moves less, or is in the domain."""
    if abs(low) <= abs(high) or high != high:
        return low
    return high


HELPERS = {f.__name__: f for f in (_judged, _following, _scaled, _smaller)}
_compiled_helpers: dict[str, Any] = {}


def names_for(base: Any, as_python: bool) -> dict[str, Any]:
    """What the text of `difference_text` refers to; `base` is the function that is differenced."""
    if as_python:
        return {"base": base, **HELPERS}
    if not _compiled_helpers:
        _compiled_helpers.update({n: compiled(f, **_INNER) for n, f in HELPERS.items()})
    return {"base": base, **_compiled_helpers}


def difference_text(index: Sequence[int], outputs: int) -> str:
    """The text of a function `difference(x0, ...)`, the derivative of `base(x0, ...)` that is taken
    index[j] times in argument j: a number, or a tuple of those of several `outputs`."""
    order, moved = sum(index), [j for j, times in enumerate(index) if times]
    names = [f"x{j}" for j in range(len(index))]
    lines = [f"def difference({', '.join(names)}):"]
    for j in moved:
        lines.append(f"    e{j} = {STEPS[order]!r} * max(abs(x{j}), {NEAREST!r})")
    each = range(outputs)
    lines += [f"    v{i}, n{i}, s{i} = 0.0, 0.0, {FINE}" for i in each]
    lines += ["    attempt = 0", "    while attempt >= 0:"]
    lines.append(f"        k = _scaled(attempt, {GROWTH[order]!r})")
    for j in moved:  # what x + h is, rounded
        lines.append(f"        h{j} = (x{j} + e{j} * k) - x{j}")
    places: list[tuple[dict[int, int], float]] = [({}, 1.0)]
    for j in moved:
        weights = CENTRAL[index[j]].items()
        places = [({**at, j: p}, w * more) for at, w in places for p, more in weights]
    for number, (at, _) in enumerate(places):
        given = [_moved(j, at.get(j, 0)) for j in range(len(index))]
        lines.append(f"        f{number} = base({', '.join(given)})")
    below = " * ".join(f"h{j}" for j in moved for _ in range(index[j]))
    for i in each:
        part = f"[{i}]" if outputs > 1 else ""
        values = [f"(0.0 + f{number}{part})" for number in range(len(places))]  # whole ones too
        total = " + ".join(f"{w!r} * {v}" for v, (_, w) in zip(values, places, strict=True))
        largest = f"abs({values[0]})"
        for v in values[1:]:
            largest = f"max({largest}, abs({v}))"
        lines.append(
            f"        v{i}, n{i}, s{i} = _judged(attempt, {total}, {largest}, {below}, v{i}, n{i}, "
            f"s{i}, {DIGITS[order]!r}, {SUSPECT[order]!r})"
        )
    noisy, doubtful = (" or ".join(f"s{i} == {state}" for i in each) for state in (NOISY, IN_DOUBT))
    lines.append(f"        attempt = _following(attempt, {noisy}, {doubtful})")
    outside = " or ".join(f"v{i} != v{i}" for i in each)
    lines.append(f"        if attempt == {GROWN + 1} and ({outside}):")
    lines += [f"            e{j} = min(e{j}, abs(x{j})) if x{j} != 0.0 else e{j}" for j in moved]
    lines.append(f"    if {doubtful}:")
    if order == 1:
        (j,) = moved
        lines.append(f"        h{j} = (x{j} + e{j}) - x{j}")
        for name, place in (("low", -1), ("here", 0), ("high", 1)):
            given = [_moved(a, place if a == j else 0) for a in range(len(index))]
            lines.append(f"        {name} = base({', '.join(given)})")
    for i in each:
        part = f"[{i}]" if outputs > 1 else ""
        lines.append(f"        if s{i} == {IN_DOUBT}:")
        if order == 1:
            lines.append(
                f"            v{i} = _smaller((here{part} - low{part}) / h{j}, "
                f"(high{part} - here{part}) / h{j})"
            )
        else:
            lines.append(f"            v{i} = 0.0 * v{i}")  # NaN stays
    found = ", ".join(f"v{i}" for i in each)
    return "\n".join([*lines, f"    return {found if outputs == 1 else f'({found})'}"]) + "\n"


def _moved(j: int, place: int) -> str:
    if place == 0:
        return f"x{j}"
    return f"x{j} {'+' if place > 0 else '-'} {'' if abs(place) == 1 else f'{abs(place)}.0 * '}h{j}"


def close(given: float, found: float, value: float, size: float) -> bool:
    """Whether a derivative agrees with what differences found, within their error.

    value : of the function there. size : of the argument.
    """
    if not (math.isfinite(given) and math.isfinite(found)):
        return True
    rounding = math.sqrt(EPS) * max(1.0, abs(value)) / max(abs(size), NEAREST)
    return abs(given - found) <= 1e-3 * max(abs(given), abs(found)) + 10.0 * rounding
