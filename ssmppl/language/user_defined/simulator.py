"""Simulators that a model may call: `@ssm.simulator`, on functions of Python that move a batch.

Such a function is of any origin: NumPy, SciPy, a physics engine, a program that is asked over a
pipe. Its values and its derivatives, by central differences, come from one call for all points of a
row.
"""

from __future__ import annotations

import importlib
import inspect
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, nearest_first
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.batched.call import values_of
from ssmppl.expressions.expr import Expr, constant, symbol, symbols_in, user_location
from ssmppl.language.model.model import location_of
from ssmppl.language.model.pickling import holder_of
from ssmppl.language.user_defined.batched_function import BatchedFunction, Call

Names = str | Sequence[str]


class Values(Mapping[str, Any]):
    """What a simulator gives, by name: `new["v"]` or `new.v`; `new.vector` all of it, in order."""

    def __init__(self, values: Mapping[str, Any], title: str):
        self._values, self._title = dict(values), title

    def __getitem__(self, name: str) -> Any:
        if name not in self._values:
            raise ModelError(
                f"the simulator {self._title} gives no {name!r}",
                fix=f"use one of: {', '.join(nearest_first(name, self._values))}",
                where=user_location(),
            )
        return self._values[name]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return self[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"{self._title}: " + ", ".join(f"{k} = {v}" for k, v in self._values.items())

    @property
    def vector(self) -> Any:
        """(n,) all values, in the order in which their names were declared."""
        values = list(self._values.values())
        return array(values) if any(isinstance(v, Expr) for v in values) else np.array(values)


class Simulator:
    """A function of Python that moves a batch of states; called in a distribution it becomes a
    node.

    Made by `ssm.simulator`.

    Parameters
    ----------
    step : the user's function.
    state, inputs, parameters : names of the columns of what `step` takes.
    output : the user's function of what sensors show; None where there is none.
    outputs : names of the columns of what `output` gives.
    forces : those of the inputs that are generalised forces -> the state whose rate of change each
        acts on, "" where that is not said; 0 where a call leaves them out.
    name : shown in messages.
    scales : by name, of what moves by amounts far from 1.
    where : it was written.
    token : by which copies in other processes know each other.
    """

    def __init__(
        self, step: Call, *, state: Sequence[str], inputs: Sequence[str],
        parameters: Sequence[str], output: Call | None, outputs: Sequence[str],
        forces: Mapping[str, str], name: str, scales: Mapping[str, float], where: Location | None,
        token: str = "",
    ):  # fmt: skip
        self.step, self.output, self.name = step, output, name
        self.state, self.inputs, self.parameters = tuple(state), tuple(inputs), tuple(parameters)
        self.outputs, self.forces, self.scales = tuple(outputs), dict(forces), dict(scales)
        self.location, self._token = where, token or uuid.uuid4().hex
        self.__name__ = name
        self.__doc__ = getattr(step, "__doc__", None)
        sizes = len(self.state), len(self.inputs), len(self.parameters)
        own = np.array([float(self.scales.get(n, 1.0)) for n in self.arguments])
        given = sizes, self.arguments
        self.moves = BatchedFunction(name, step, *given, self.state, own, where)
        self.senses = None
        if output is not None:
            title = f"{name}.sense"
            self.senses = BatchedFunction(title, output, *given, self.outputs, own, where)
        for function in self.functions:
            function.simulator = self
        _made[self._token] = self

    @property
    def arguments(self) -> tuple[str, ...]:
        """Names of all that it takes, in order."""
        return (*self.state, *self.inputs, *self.parameters)

    @property
    def functions(self) -> list[BatchedFunction]:
        """`step`, and `output` where there is one, as they are called."""
        return [self.moves] if self.senses is None else [self.moves, self.senses]

    def __call__(self, *vectors: Any, **named: Any) -> Values:
        """The states after one step.

        vectors : states, inputs and parameters, each a sequence in the declared order, or a
            mapping by name; or all of them by keyword. Symbols in a distribution, elsewhere numbers
            or arrays, which broadcast.
        """
        return self._run(self.moves, self.state, vectors, named)

    def sense(self, *vectors: Any, **named: Any) -> Values:
        """The outputs at a state.

        Parameters
        ----------
        *vectors : states, inputs and parameters, as of a call.
        **named : all of them by name, instead.

        Returns
        -------
        Values
            The outputs by name: `found["y"]` or `found.y`.
        """
        if self.senses is None:
            raise ModelError(
                f"the simulator {self.name} has no outputs",
                fix="give output=function and outputs=[names] to ssm.simulator",
                where=user_location(),
            )
        return self._run(self.senses, self.outputs, vectors, named)

    def _run(
        self, function: BatchedFunction, results: tuple[str, ...], vectors: Sequence[Any],
        named: Mapping[str, Any],
    ) -> Values:  # fmt: skip
        given = self._given(vectors, named)
        if not any(isinstance(v, Expr) for v in given):
            whole = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in given))
            shape = whole[0].shape if whole else ()
            points = np.stack([w.ravel() for w in (*whole, np.zeros(shape))], axis=-1)
            found = function.at(points).T.reshape(len(results), *shape)
            return Values({n: v[()] for n, v in zip(results, found, strict=True)}, self.name)
        nodes = values_of(function, [*map(_node, given), _row(given)])
        return Values(dict(zip(results, nodes, strict=True)), self.name)

    def _given(self, vectors: Sequence[Any], named: Mapping[str, Any]) -> list[Any]:
        """The arguments in order: a node, a number or an array each."""
        parts = (("state", self.state), ("inputs", self.inputs), ("parameters", self.parameters))
        found: dict[str, Any] = {}
        if len(vectors) > len(parts):
            raise self._wrong(
                f"{len(vectors)} arguments by position", "give states, inputs and parameters, or "
                f"all of them by name: {', '.join(self.arguments)}",
            )  # fmt: skip
        for value, (what, names) in zip(vectors, parts, strict=False):
            found |= self._by_name(value, what, names)
        for name, value in named.items():
            if name in found:
                raise self._wrong(f"{name!r} twice", "give it by position or by name")
            found[name] = value
        for name in found:
            if name not in self.arguments:
                known = ", ".join(nearest_first(name, self.arguments))
                raise self._wrong(f"an unknown {name!r}", f"use: {known}")
        found = dict.fromkeys(self.forces, 0.0) | found
        missing = [n for n in self.arguments if n not in found]
        if missing:
            raise self._wrong(
                f"no value for {', '.join(missing)}",
                f"give {', '.join(f'{n}=...' for n in missing)}; it takes "
                f"{', '.join(self.arguments)}",
            )
        return [self._number(name, found[name]) for name in self.arguments]

    def _by_name(self, value: Any, what: str, names: tuple[str, ...]) -> dict[str, Any]:
        if isinstance(value, Mapping):
            return dict(value)
        single = isinstance(value, Expr) or np.ndim(value) == 0
        values = [value] if single else list(value)
        if len(values) != len(names):
            raise self._wrong(
                f"{len(values)} numbers for its {what}",
                f"give {len(names)}: {', '.join(names) or 'it has none'}",
            )
        return dict(zip(names, values, strict=True))

    def _number(self, name: str, value: Any) -> Any:
        if isinstance(value, Expr):
            return value
        if isinstance(value, ExprArray) or (
            isinstance(value, np.ndarray) and value.dtype == object
        ):
            if value.shape == ():
                return value[()]
            raise self._wrong(
                f"an array of shape {value.shape} for {name!r}", "give one number for each name"
            )
        try:
            return np.asarray(value, dtype=float)[()]
        except (TypeError, ValueError):
            raise self._wrong(f"{value!r} for {name!r}", "give a number") from None

    def _wrong(self, what: str, fix: str) -> ModelError:
        return ModelError(
            f"the simulator {self.name} is given {what}", fix=fix, where=user_location()
        )

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        if getattr(self.step, "__qualname__", None) and holder_of(self.step) is self:
            return _by_name, (self.step.__module__, self.step.__qualname__)
        options = {
            "state": self.state, "inputs": self.inputs, "parameters": self.parameters,
            "output": self.output, "outputs": self.outputs, "forces": self.forces,
            "name": self.name, "scales": self.scales, "where": self.location,
        }  # fmt: skip
        return _restored, (self._token, self.step, options)

    def __repr__(self) -> str:
        return f"<simulator {self.name}({', '.join(self.arguments)})>"


_made: dict[str, Simulator] = {}


def _by_name(module: str, name: str) -> Simulator:
    found: Simulator = getattr(importlib.import_module(module), name)
    return found


def _restored(token: str, step: Call, options: dict[str, Any]) -> Simulator:
    """The simulator of this token, once in each process."""
    return _made[token] if token in _made else Simulator(step, token=token, **options)


def _node(value: Any) -> Expr:
    return value if isinstance(value, Expr) else constant(float(value))


def _row(given: Sequence[Any]) -> Expr:
    """The row that a call belongs to, for messages: of the step that begins there, or of its
    observation; 0 where it is of none."""
    kinds = {s.data[0] for v in given if isinstance(v, Expr) for s in symbols_in(v)}
    if any(kind.endswith("_prev") for kind in kinds):
        return symbol("time_prev", "t")
    return symbol("time", "t") if kinds - {"parameter"} else constant(0.0)


def simulator(
    *, state: Names, inputs: Names = (), parameters: Names = (), output: Call | None = None,
    outputs: Names = (), forces: Names | Mapping[str, str] = (), name: str | None = None,
    scales: Mapping[str, float] | None = None,
) -> Callable[[Call], Simulator]:  # fmt: skip
    """Make a function of Python that moves a batch callable inside a model's distributions.

    `@ssm.simulator(state=["q", "v"], inputs=["u"], parameters=["k", "d"])` stands above
    `step(state (B, n), inputs (B, m), parameters (B, p)) -> (B, n)`: float64 arrays with a row for
    each of B points and a column for each name. The same rows in must give the same rows out,
    whatever else is in the batch; this is checked at the first call. In a distribution it is called
    by name, `new = step(q=q, v=v, u=u, k=k, d=d)`, and gives the new states by name, `new.v` or
    `new["v"]`, as mean of a transition or value of an `ssm.Dirac`.

    Parameters
    ----------
    state, inputs, parameters : names of the columns.
    output, outputs : `output(state, inputs, parameters) -> (B, k)`, sensors at a state, and the
        names of its columns; `step.sense(...)` calls it, in the mean of an observation.
    forces : names among the inputs that are generalised forces, or a mapping of these to the
        velocity among the states that each accelerates, `{"push": "v"}`; a call may leave them
        out, as 0. `ssm.diagnose` lets what is missing in that velocity act through the force, in
        its unit, so that it moves all that the force does.
    name : for messages; by default the function's.
    scales : name -> the size at which an argument matters, 1 by default. Central differences take
        steps of 6e-6 (first derivatives) and 1.2e-4 (second) of it or of the argument's absolute
        value, whichever is larger: give it where 1 is far larger than an argument.

    Returns
    -------
    decorator : of the function; gives a `Simulator`.

    Raises
    ------
    ModelError : a name stands twice, or is none; outputs without a function for them.
    SimulatorError : later, where the function is called: it raised (with row, arguments and its
        traceback), gave another shape or type, or keeps something between calls.

    Examples
    --------
    >>> import numpy as np
    >>> import ssmppl as ssm
    >>> @ssm.simulator(state=["q", "v"], inputs=["u"], parameters=["k"])
    ... def pendulum(state, inputs, parameters):
    ...     q, v = state.T
    ...     for _ in range(10):
    ...         v = v + 0.005 * (inputs[:, 0] - parameters[:, 0] * np.sin(q))
    ...         q = q + 0.005 * v
    ...     return np.stack([q, v], axis=1)
    >>> new = pendulum(q=0.1, v=0.0, u=0.0, k=9.81)
    """
    columns = {
        "state": _names(state, "state"), "inputs": _names(inputs, "inputs"),
        "parameters": _names(parameters, "parameters"), "outputs": _names(outputs, "outputs"),
        "forces": _names(tuple(forces) if isinstance(forces, Mapping) else forces, "forces"),
    }  # fmt: skip
    acting = dict(forces) if isinstance(forces, Mapping) else dict.fromkeys(columns["forces"], "")
    _check(columns, output, scales or {}, acting)

    def decorate(step: Call) -> Simulator:
        if not callable(step):
            raise ModelError(
                f"ssm.simulator is given {step!r}, which cannot be called",
                fix="give a function step(state, inputs, parameters)",
                where=user_location(),
            )
        where = location_of(step) if inspect.isfunction(step) else user_location()
        title = str(name or getattr(step, "__name__", type(step).__name__))
        return Simulator(
            step, state=columns["state"], inputs=columns["inputs"],
            parameters=columns["parameters"], output=output, outputs=columns["outputs"],
            forces=acting, name=title, scales=dict(scales or {}), where=where,
        )  # fmt: skip

    return decorate


def _names(given: Names, what: str) -> tuple[str, ...]:
    names = (given,) if isinstance(given, str) else tuple(given)
    for n in names:
        if not isinstance(n, str) or not n:
            raise ModelError(
                f"ssm.simulator: {what} has {n!r}", fix="give names", where=user_location()
            )
    return names


def _check(
    columns: Mapping[str, tuple[str, ...]], output: Call | None, scales: Mapping[str, float],
    acting: Mapping[str, str],
) -> None:  # fmt: skip
    def wrong(found: str, fix: str) -> ModelError:
        return ModelError(f"ssm.simulator: {found}", fix=fix, where=user_location())

    arguments = (*columns["state"], *columns["inputs"], *columns["parameters"])
    for names in (arguments, columns["outputs"]):
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise wrong(f"{twice[0]!r} stands twice", "give each column a name of its own")
    if not columns["state"]:
        raise wrong("it has no state", 'name the columns of its state: state=["q", "v"]')
    if bool(columns["outputs"]) != (output is not None):
        raise wrong(
            "output= and outputs= belong together", "give a function, and names of its columns"
        )
    for n in columns["forces"]:
        if n not in columns["inputs"]:
            known = ", ".join(columns["inputs"]) or "none"
            raise wrong(f"the force {n!r} is no input", f"its inputs are: {known}")
        if acting[n] and acting[n] not in columns["state"]:
            known = ", ".join(nearest_first(acting[n], columns["state"]))
            raise wrong(f"the force {n!r} acts on {acting[n]!r}", f"its states are: {known}")
    for n, size in scales.items():
        if n not in arguments:
            raise wrong(f"scales has {n!r}", f"use: {', '.join(nearest_first(n, arguments))}")
        if not (np.isreal(size) and 0.0 < float(size) < np.inf):
            raise wrong(f"the scale of {n!r} is {size!r}", "give a positive number")
