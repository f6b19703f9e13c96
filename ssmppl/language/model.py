"""Model: what a user declares, held and not yet looked at.

The decorators only remember the functions; `trace.py` runs them on symbols when a verb first
needs the model, and raises there what is wrong with them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.expr import user_location

Law = TypeVar("Law", bound=Callable[..., Mapping[str, Any]])
ROLES = ("prior", "initial", "transition", "observation", "proposal")


class Model:
    """A state space model, declared by decorated functions.

    Parameters
    ----------
    name : shown in results and messages.
    inputs : names of the measured inputs u_t; a mapping name -> length for vector inputs.

    The decorators `prior`, `initial`, `transition` and `observation` each take a function that
    returns ``{name: distribution}`` and whose arguments name what it depends on: parameters,
    states (their value at t), inputs, and ``t``. All but `initial` may be used several times.

    Examples
    --------
    >>> import ssmppl as ssm
    >>> walk = ssm.Model("random walk")
    >>> @walk.prior
    ... def prior():
    ...     return {"q": ssm.InverseGamma(2, scale=1)}
    >>> @walk.initial
    ... def initial():
    ...     return {"x": ssm.Normal(0, sd=10)}
    >>> @walk.transition
    ... def transition(x, q):
    ...     return {"x": ssm.Normal(x, variance=q)}
    >>> @walk.observation
    ... def observation(x):
    ...     return {"y": ssm.Normal(x, sd=1)}
    """

    def __init__(self, name: str = "model", *, inputs: Iterable[str] | Mapping[str, int] = ()):
        self.location = user_location()
        if not isinstance(name, str):
            raise ModelError(
                f"the name of a model is {name!r}",
                fix='give a string, ssm.Model("ice varves")',
                where=self.location,
            )
        if isinstance(inputs, str):
            raise ModelError(
                f"inputs is the string {inputs!r}",
                fix=f"give a tuple of names, inputs=({inputs!r},)",
                where=self.location,
            )
        lengths = dict(inputs) if isinstance(inputs, Mapping) else dict.fromkeys(inputs)
        for key, length in lengths.items():
            whole = length is None or (isinstance(length, int) and length > 0)
            if not (isinstance(key, str) and key.isidentifier()) or not whole:
                raise ModelError(
                    f"input {key!r} of length {length!r}",
                    fix="input names are Python identifiers; the length of a vector input is a "
                    "positive whole number",
                    where=self.location,
                )
        self.name = name
        self.inputs: dict[str, tuple[int, ...]] = {
            key: () if length is None else (length,) for key, length in lengths.items()
        }
        self.functions: dict[str, list[Callable[..., Any]]] = {role: [] for role in ROLES}

    def prior(self, function: Law) -> Law:
        """Declare priors of parameters; arguments are parameters declared earlier."""
        return self._declare("prior", function)

    def initial(self, function: Law) -> Law:
        """Declare the law of x_1; arguments are parameters, inputs and ``t``."""
        return self._declare("initial", function)

    def transition(self, function: Law) -> Law:
        """Declare the law of x_{t+1} given x_t (and u_t, t, y_t where the arguments name them)."""
        return self._declare("transition", function)

    def observation(self, function: Law) -> Law:
        """Declare the law of y_t given x_t (and u_t, t)."""
        return self._declare("observation", function)

    def proposal(self, function: Law) -> Law:
        """Override the derived proposal of x_{t+1}: arguments as in a transition, and
        observation channels, which mean y_{t+1} here."""
        return self._declare("proposal", function)

    def _declare(self, role: str, function: Law) -> Law:
        if not inspect.isfunction(function):
            raise ModelError(
                f"@{self.name}.{role} stands on {function!r}, which is no function",
                fix=f"write @model.{role} (without parentheses) on the line above a def",
                where=user_location(),
            )
        if role in ("initial", "proposal") and self.functions[role]:
            first = location_of(self.functions[role][0])
            raise ModelError(
                f"a second @{role} function; the first is at {first}",
                fix=f"return all states from one @{role} function",
                where=location_of(function),
            )
        self.functions[role].append(function)
        return function

    @property
    def signature(self) -> tuple:
        """Changes when a function is declared: what traces of this model are cached by."""
        return (self.name, tuple(self.inputs.items()), *map(tuple, self.functions.values()))

    def __repr__(self) -> str:
        declared = ", ".join(
            f.__name__ for role in ROLES for f in self.functions[role]
        )  # no tracing in a repr
        inputs = f", inputs={tuple(self.inputs)}" if self.inputs else ""
        return f"<Model {self.name!r}{inputs}: {declared or 'nothing declared'}>"


def location_of(function: Callable[..., Any]) -> Location:
    """Where a function is defined."""
    code = function.__code__
    return Location(code.co_filename, code.co_firstlineno, function.__name__)
