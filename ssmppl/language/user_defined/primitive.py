"""Opaque functions of numbers that a model may call: `@ssm.primitive`.

A primitive is compiled by Numba and called once per particle. It has no symbolic form, so nothing
is derived through it: no gradients, no conjugate updates of what enters it, and no proposal that
looks at an observation through it. In the mean of a Gaussian transition guided and auxiliary
proposals are still derived, as they need its value only. What it reads from outside is part of what
is compiled: a primitive that finds something else there is refused.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from ssmppl.compiling import one_at_a_time
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array, scalar_or_array
from ssmppl.expressions.expr import Expr
from ssmppl.language.model.closure_digest import fingerprint, outer_values
from ssmppl.language.model.model import location_of
from ssmppl.language.model.pickling import holder_of

REGISTRY: dict[str, Callable[..., Any]] = {}  # unique name -> compiled function


class Primitive:
    """A compiled function of floats to one float; calls on symbols become nodes."""

    def __init__(self, function: Callable[..., float]):
        self.function = function
        self.location = location_of(function)
        self.arguments = _arguments(function)
        self.compiled = _compile(function, len(self.arguments))
        word = re.sub(r"\W+", "_", function.__name__).strip("_")  # <lambda> is no identifier
        self._compiled_of = fingerprint(function)
        self.name = f"{word}_{self._compiled_of[:8]}"
        self.__wrapped__ = function  # so that a law that calls it reads what the function reads
        self.__name__, self.__doc__ = function.__name__, function.__doc__
        REGISTRY[self.name] = self.compiled

    def __call__(self, *values: Any) -> Any:
        if len(values) != len(self.arguments):
            raise ModelError(
                f"the primitive {self.__name__} takes {len(self.arguments)} arguments "
                f"({', '.join(self.arguments)}), {len(values)} given",
                fix="pass each by position",
                where=self.location,
            )
        if not any(_symbolic(v) for v in values):
            return self.function(*values)
        self._check_as_compiled()
        arrays: Any = np.broadcast_arrays(*(array(v).view(np.ndarray) for v in values))
        out = np.empty(arrays[0].shape, dtype=object)
        for i in np.ndindex(out.shape):
            out[i] = Expr("call", tuple(a[i] for a in arrays), self)
        return scalar_or_array(out)

    def _check_as_compiled(self) -> None:
        """Numba has frozen what the function reads from outside."""
        if fingerprint(self.function) != self._compiled_of:
            read = sorted(outer_values(self.function))
            raise ModelError(
                f"the primitive {self.__name__} was compiled with other values of what it reads "
                f"from outside ({', '.join(read)}), and its compiled form does not see the change",
                fix=f"give what changes as an argument, or make it anew: {self.__name__} = "
                f"ssm.primitive({self.__name__}.function)",
                where=self.location,
            )

    def __reduce__(self):  # by name where a module holds it, else by the function
        if holder_of(self.function) is self:
            return _by_name, (self.function.__module__, self.function.__qualname__)
        return _restored, (self.name, self.function)

    def __repr__(self) -> str:
        return f"<primitive {self.__name__}>"


_made: dict[str, Primitive] = {}


def _by_name(module: str, name: str) -> Primitive:
    found: Primitive = getattr(importlib.import_module(module), name)
    return found


@one_at_a_time
def _restored(name: str, function: Callable[..., float]) -> Primitive:
    """The primitive of this name, compiled once in each process."""
    if name not in _made:
        made = _made[name] = Primitive(function)
        made.name = name  # generated code has it, whatever else of the function travelled
        REGISTRY[name] = made.compiled
    return _made[name]


def primitive(function: Callable[..., float]) -> Primitive:
    """Make a function of numbers callable inside a model's laws.

    Parameters
    ----------
    function : takes floats by position and returns a float; Numba must be able to compile it.

    Returns
    -------
    Primitive : takes numbers as the function does, and symbols inside of a law.

    Raises
    ------
    ModelError : Numba cannot compile it; names the function, its line and Numba's reason. Also in
        a law, where a variable that the function reads has changed since.

    Examples
    --------
    >>> import ssmppl as ssm
    >>> @ssm.primitive
    ... def friction(v):
    ...     return 0.1 if v > 0.0 else -0.1
    """
    if not inspect.isfunction(function):
        raise ModelError(
            f"@ssm.primitive stands on {function!r}, which is no function",
            fix="write @ssm.primitive (without parentheses) on the line above a def",
        )
    return Primitive(function)


def _symbolic(value: Any) -> bool:
    return isinstance(value, (Expr, ExprArray)) or (
        isinstance(value, np.ndarray) and value.dtype == object
    )


def _arguments(function: Callable[..., float]) -> list[str]:
    parameters = inspect.signature(function).parameters.values()
    plain = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    if any(p.kind not in plain for p in parameters):
        raise ModelError(
            f"the primitive {function.__name__} takes *arguments or keywords",
            fix="give it a fixed number of plain arguments",
            where=location_of(function),
        )
    return [p.name for p in parameters]


def _compile(function: Callable[..., float], n: int) -> Callable[..., Any]:
    compiled = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        compiled.compile((numba.float64,) * n)
    except numba.core.errors.NumbaError as error:
        reason = str(error).strip().splitlines()
        raise ModelError(
            f"Numba cannot compile the primitive {function.__name__}: "
            + " ".join(line.strip() for line in reason[:6]),
            fix="use plain arithmetic, math.* or np.* on floats inside it, and return a float",
            where=location_of(function),
        ) from None
    overloads: Any = compiled.overloads
    result = overloads[(numba.float64,) * n].signature.return_type
    if not isinstance(result, (numba.types.Float, numba.types.Integer, numba.types.Boolean)):
        raise ModelError(
            f"the primitive {function.__name__} returns {result}",
            fix="return one number; write a primitive for each component of a vector",
            where=location_of(function),
        )
    return compiled
