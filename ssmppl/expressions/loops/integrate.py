"""What users write: `integrate` for differential equations, `repeat` for maps, `expm`.

The state may be one number, a vector, or a dict of these by name; what comes back is of the same
form. The methods: E. Hairer, S. P. Nørsett and G. Wanner, *Solving Ordinary Differential Equations
I* (1993), section II.1, and for "semi-implicit" E. Hairer, C. Lubich and G. Wanner, *Geometric
Numerical Integration* (2006), section I.1.2; "implicit" is the method ROS2 of J. G. Verwer, E. J.
Spee, J. G. Blom and W. Hundsdorfer, "A second-order Rosenbrock method applied to photochemical
dispersion problems", *SIAM Journal on Scientific Computing* 20 (1999), equation (3.1).
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.errors import ModelError, listing
from ssmppl.expressions.arrays import array, inverse
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    BOOLEAN,
    Expr,
    as_expr,
    constant,
    depends_on,
    substitute,
    symbols_in,
    user_location,
)
from ssmppl.expressions.loops.affine import (
    affine_form,
    applied,
    array_of,
    exponential,
    numbers_of,
    power_and_sum,
)
from ssmppl.expressions.loops.loop import fresh, repeated

Rates = Callable[[Sequence[Expr]], list[Expr]]  # of the state's numbers, their derivatives
Step = Callable[[Rates, Sequence[Expr], Expr], list[Expr]]


def integrate(
    rhs: Callable[..., Any], state: Any, dt: Any, *, method: str = "rk4", steps: int = 1,
    linear: bool = True,
) -> Any:  # fmt: skip
    """The state after a time `dt` of the differential equation d state / dt = rhs(state).

    Parameters
    ----------
    rhs : function of the state, written as the distributions of a model are, that gives its
        derivative by time; of a dict it may take the values by name (`def swing(angle, speed)`) or
        the dict. What else it depends on (parameters, inputs) it reads from where it is written;
        all that stays what it is over the time.
    state : number or symbol, vector, or dict of these by name, at the beginning.
    dt : the time, in the unit of the derivative's; a number, or a symbol such as the time step.
    method : "euler", "semi-implicit" (velocities first, then positions with the new ones, which
        keeps the energy of a mechanical system), "midpoint", "heun", "rk4" (orders 1, 1, 2, 2 and
        4), or "implicit" (linearly implicit, of order 2, for stiff systems).
    steps : of length dt / steps each. The model's text and the time of its compilation do not grow
        with them.
    linear : whether an equation that is linear in the state (with what else there is to add) is
        recognised. Then it is solved exactly, whatever the method, and stays linear in the state,
        as Kalman filters need it.

    Returns
    -------
    number or symbol, vector, or dict
        The state at the end, of the form of `state`: numbers where all that it depends on are.

    Raises
    ------
    ModelError : an unknown method, a number of steps that is none, a derivative that is not of the
        form of the state.

    Examples
    --------
    >>> import numpy as np
    >>> import ssmppl as ssm
    >>> def swing(angle, speed):
    ...     return {"angle": speed, "speed": -9.81 * np.sin(angle)}
    >>> after = ssm.integrate(swing, {"angle": 0.3, "speed": 0.0}, 0.1, steps=10)
    >>> round(float(after["angle"]), 6)
    0.255779
    """
    where = user_location()
    if method not in STEPS:
        raise ModelError(
            f"integrate has no method {method!r}",
            fix=f"use one of: {listing(str(method), STEPS)}",
            where=where,
        )
    _check_whole("steps", steps, 1, where)
    form = _Form.of(state)
    symbols = fresh(len(form.values))
    rates = form.call(rhs, symbols, "derivative")
    time = _number(dt, "dt", where)
    found = affine_form(rates, symbols) if linear else None
    if found is not None:
        return form.like(_solved(*found, form.values, time))

    def by(values: Sequence[Expr]) -> list[Expr]:
        return substitute(rates, dict(zip(symbols, values, strict=True)))

    step = STEPS[method](by, symbols, time / float(steps))
    name = f"{_name(rhs)}_{method.replace('-', '_')}"
    return form.like(repeated(name, symbols, form.values, step, constant(float(steps))))


def repeat(step: Callable[..., Any], state: Any, times: Any, *, linear: bool = True) -> Any:
    """The state after so many times of state = step(state).

    Parameters
    ----------
    step : function of the state, written as the distributions of a model are, that gives the next
        one; of a dict as in `integrate`.
    state : number or symbol, vector, or dict of these by name, at the beginning.
    times : how often, from 0; a symbol counts as its whole part, and as 0 where it is none. The
        model's text and the time of its compilation do not grow with it.
    linear : whether a step that is linear in the state is recognised: then so is the whole.

    Returns
    -------
    number or symbol, vector, or dict
        The state at the end, of the form of `state`: numbers where all that it depends on are.

    Raises
    ------
    ModelError : as `integrate`.
    """
    where = user_location()
    if not isinstance(times, Expr):
        _check_whole("times", times, 0, where)
    form = _Form.of(state)
    symbols = fresh(len(form.values))
    update = form.call(step, symbols, "state")
    name = _name(step)
    count = as_expr(times)
    found = affine_form(update, symbols) if linear else None
    if found is None:
        return form.like(repeated(name, symbols, form.values, update, count))
    rows, rest = found
    columns = [i for i, e in enumerate(rest) if e is not constant(0.0)]
    power, total = power_and_sum(name, rows, count, columns)
    return form.like(applied(power, form.values, total, [rest[i] for i in columns]))


def expm(matrix: Any) -> np.ndarray:
    """The exponential of a square matrix (n, n), of numbers or symbols.

    Parameters
    ----------
    matrix : made by np.array([[...], ...]), np.block or the like.

    Returns
    -------
    array
        The exponential (n, n), of numbers where the matrix is.

    Raises
    ------
    ModelError : what is given is no square matrix.
    """
    values = array(matrix)
    if values.ndim != 2 or values.shape[0] != values.shape[1]:
        raise ModelError(
            f"expm of what has the shape {values.shape}",
            fix="give a square matrix, made by np.array([[...], ...]) or np.block",
            where=user_location(),
        )
    found = exponential(values.view(np.ndarray))
    numbers = numbers_of(found)
    return array(found) if numbers is None else numbers


def _solved(rows: np.ndarray, rest: list[Expr], state: Sequence[Expr], time: Expr) -> list[Expr]:
    """The exact solution of x' = rows x + rest, from exp of [[rows, 1], [0, 0]] times the time, of
    whose second columns those that `rest` needs (Van Loan 1978, "Computing integrals involving the
    matrix exponential", theorem 1)."""
    n = len(rows)
    columns = [i for i, e in enumerate(rest) if e is not constant(0.0)]
    size = n + len(columns)
    block = np.full((size, size), constant(0.0), dtype=object)
    block[:n, :n] = rows
    for k, i in enumerate(columns):
        block[i, n + k] = constant(1.0)
    whole = exponential(block * time)
    return applied(whole[:n, :n], state, whole[:n, n:], [rest[i] for i in columns])


# -- one step
def _along(x: Sequence[Expr], *terms: tuple[Any, Sequence[Expr]]) -> list[Expr]:
    """x + sum of factor * slope."""
    out = list(x)
    for factor, slopes in terms:
        out = [a + factor * b for a, b in zip(out, slopes, strict=True)]
    return out


def _euler(f: Rates, x: Sequence[Expr], h: Expr) -> list[Expr]:
    return _along(x, (h, f(x)))


def _midpoint(f: Rates, x: Sequence[Expr], h: Expr) -> list[Expr]:
    return _along(x, (h, f(_along(x, (0.5 * h, f(x))))))


def _heun(f: Rates, x: Sequence[Expr], h: Expr) -> list[Expr]:
    first = f(x)
    return _along(x, (0.5 * h, first), (0.5 * h, f(_along(x, (h, first)))))


def _rk4(f: Rates, x: Sequence[Expr], h: Expr) -> list[Expr]:
    k1 = f(x)
    k2 = f(_along(x, (0.5 * h, k1)))
    k3 = f(_along(x, (0.5 * h, k2)))
    k4 = f(_along(x, (h, k3)))
    total = [a + 2.0 * (b + c) + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
    return _along(x, (h / 6.0, total))


def _semi_implicit(f: Rates, x: Sequence[Expr], h: Expr) -> list[Expr]:
    """First what moves by itself, then the positions, whose derivatives do not depend on positions,
    by the new values of the others."""
    rates, positions = f(x), list[int]()
    for i, rate in enumerate(rates):
        if not depends_on(rate, [x[k] for k in [*positions, i]]):
            positions.append(i)
    new = [v if i in positions else v + h * rates[i] for i, v in enumerate(x)]
    moved = f(new)
    return [v + h * moved[i] if i in positions else v for i, v in enumerate(new)]


def _implicit(f: Rates, x: Sequence[Expr], h: Expr) -> list[Expr]:
    gamma = 1.0 + 1.0 / math.sqrt(2.0)
    rates, n = f(x), len(x)
    try:
        slopes = np.array([differentiate(rates, s) for s in x], dtype=object).T
    except NotDifferentiable as error:
        raise ModelError(
            f'integrate(method="implicit") needs the derivatives of the right-hand side: {error}',
            fix='use method="rk4", with more steps',
            where=user_location(),
        ) from None
    solve = inverse(array(np.eye(n)) - gamma * h * array(slopes))
    first = list(array(solve @ array(rates)).ravel())
    there = f(_along(x, (h, first)))
    right = [a - 2.0 * b for a, b in zip(there, first, strict=True)]
    second = list(array(solve @ array(right)).ravel())
    return _along(x, (1.5 * h, first), (0.5 * h, second))


STEPS: dict[str, Step] = {
    "euler": _euler,
    "semi-implicit": _semi_implicit,
    "midpoint": _midpoint,
    "heun": _heun,
    "rk4": _rk4,
    "implicit": _implicit,
}


# -- the form of a state
@dataclass(frozen=True)
class _Form:
    """What a user's state looks like, and its numbers in order."""

    values: list[Expr]
    names: tuple[str, ...] | None
    shapes: tuple[tuple[int, ...], ...]
    plain: bool  # numbers, which come back as numbers where nothing else is symbolic

    @classmethod
    def of(cls, state: Any) -> _Form:
        if isinstance(state, Mapping):
            parts = {name: array(value) for name, value in state.items()}
            values = [e for part in parts.values() for e in part.ravel()]
            plain = _known(values)
            return cls(values, tuple(parts), tuple(p.shape for p in parts.values()), plain)
        whole = array(state)
        values = list(whole.ravel())
        return cls(values, None, (whole.shape,), _known(values))

    def like(self, values: Sequence[Expr]) -> Any:
        """The numbers in the form of the state."""
        parts: list[Any] = []
        at, numbers = 0, self.plain and _known(values)
        found = evaluate(list(values)) if numbers else []
        for shape in self.shapes:
            size = math.prod(shape)
            whole: Any = array(array_of(list(values[at : at + size]), shape))
            if numbers:
                whole = np.array(found[at : at + size], dtype=float).reshape(shape)
            parts.append(whole[()] if not shape else whole)
            at += size
        if self.names is None:
            return parts[0]
        return dict(zip(self.names, parts, strict=True))

    def call(self, function: Callable[..., Any], symbols: Sequence[Expr], what: str) -> list[Expr]:
        """The numbers that a user's function gives of these symbols."""
        given = self.like(symbols)
        where = user_location()
        name = getattr(function, "__name__", repr(function))
        if self.names is not None and _by_name(function, self.names):
            found = function(**given)
        else:
            found = function(given)
        if self.names is None:
            parts = [found]
        elif isinstance(found, Mapping):
            if set(found) != set(self.names):
                raise ModelError(
                    f"{name}() gives {', '.join(map(str, found))} of a state with "
                    f"{', '.join(self.names)}",
                    fix=f"return the {what} of each, by these names",
                    where=where,
                )
            parts = [found[n] for n in self.names]
        else:
            parts = list(found) if isinstance(found, tuple | list) else [found]
        shapes = tuple(np.shape(array(p)) for p in parts)
        if shapes != self.shapes:
            raise ModelError(
                f"{name}() gives numbers of the shapes {shapes} of a state of the shapes "
                f"{self.shapes}",
                fix=f"return the {what} of each number of the state, in the form of the state",
                where=where,
            )
        return [_number(e, f"{name}()", where) for p in parts for e in array(p).ravel()]


def _known(values: Sequence[Expr]) -> bool:
    """Whether these are numbers, without symbols."""
    return not any(symbols_in(e) for e in values)


def _name(function: Callable[..., Any]) -> str:
    """For people; without the number that tells two of one name apart in a file that is written."""
    return re.sub(r"_\d+$", "", getattr(function, "__name__", "step").strip("<>"))


def _by_name(function: Callable[..., Any], names: Sequence[str]) -> bool:
    """Whether the function takes the values by name, and not the dict."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return False
    required = {p.name for p in parameters if p.default is p.empty}
    return required == set(names) or any(p.kind == p.VAR_KEYWORD for p in parameters)


def _number(value: Any, what: str, where: Any) -> Expr:
    node = as_expr(value[()] if isinstance(value, np.ndarray) and not value.shape else value)
    if node.op in BOOLEAN:
        raise ModelError(
            f"{what} is the condition {node!r} and no number",
            fix="write np.where(condition, 1.0, 0.0)",
            where=where,
        )
    return node


def _check_whole(name: str, value: Any, least: int, where: Any) -> None:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least:
        raise ModelError(
            f"{name}={value!r}",
            fix=f"give a whole number from {least}, known when the model is written",
            where=where,
        )
