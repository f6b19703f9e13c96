"""Opaque functions of numbers that a model may call: `@ssm.primitive`.

A primitive is compiled by Numba and called once per particle. It has no symbolic form: what enters
it is nowhere linear, and is given no conjugate update. Its derivatives are calls of further
functions: of those that the user gives (`derivative=`), else of central differences
(`differences.py`). What it reads from outside is part of what is compiled: a primitive that finds
something else there is refused.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, overload

import numba
import numpy as np

from ssmppl.compiling import once_property, one_at_a_time
from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import ExprArray, array, scalar_or_array
from ssmppl.expressions.expr import Expr, topological
from ssmppl.language.model.closure_digest import fingerprint, outer_values
from ssmppl.language.model.model import location_of
from ssmppl.language.model.pickling import holder_of
from ssmppl.language.user_defined import differences

Function = Callable[..., Any]
Derivative = Function | Sequence[Function | None] | Mapping[str, Function]
REGISTRY: dict[str, Opaque] = {}  # by unique name, as generated code calls it


def outputs_of(name: str) -> int:
    """How many numbers a function gives that generated code calls by this name."""
    return REGISTRY[name].outputs if name in REGISTRY else 1


def primitives_in(roots: Iterable[Expr]) -> list[Primitive]:
    """The user's primitives that expressions call, in loops too, each once."""
    found: dict[Primitive, None] = {}
    waiting = topological(roots)
    while waiting:
        node = waiting.pop(0)
        if node.op == "call" and isinstance(node.data, Opaque):
            found[node.data.root] = None
        elif node.op == "loop":
            waiting += topological(node.data.update)
    return list(found)


class Opaque:
    """A compiled function of floats to a float, or to a tuple of `outputs` of them, as it is called
    in expressions.

    name : of it in generated code, the same in every process. compiled : the function, by Numba.
    numbers : the same as Python calls it, without compiling anything further. plain : what is
    called on numbers. root : the user's primitive that it is, or whose derivative it is.
    spelled : how it is called in a distribution. key : what it and its derivatives are known by.
    """

    name: str
    __name__: str
    arguments: list[str]
    outputs: int
    root: Primitive
    location: Location
    spelled: str
    key: str
    compiled: Any
    numbers: Function
    plain: Function

    def __init__(self) -> None:
        self._differences: dict[tuple[int, ...], Difference] = {}

    def __call__(self, *values: Any) -> Any:
        """Of numbers what the function returns; of symbols an expression for each number of it."""
        if len(values) != len(self.arguments):
            raise ModelError(
                f"the primitive {self.__name__} takes {len(self.arguments)} arguments "
                f"({', '.join(self.arguments)}), {len(values)} given",
                fix="pass each by position",
                where=self.location,
            )
        if not any(_symbolic(v) for v in values):
            return self.plain(*values)
        self.check_as_compiled()
        arrays: Any = np.broadcast_arrays(*(array(v).view(np.ndarray) for v in values))
        out = [np.empty(arrays[0].shape, dtype=object) for _ in range(self.outputs)]
        for i in np.ndindex(arrays[0].shape):
            for own, node in zip(out, self.nodes(tuple(a[i] for a in arrays)), strict=True):
                own[i] = node
        made = tuple(scalar_or_array(o) for o in out)
        return made if self.outputs > 1 else made[0]

    def check_as_compiled(self) -> None:
        """Check that what is compiled is what the user's function is now."""
        raise NotImplementedError

    def nodes(self, args: tuple[Expr, ...]) -> list[Expr]:
        """What a call gives, one expression for each output."""
        node = Expr("call", args, self)
        if self.outputs == 1:
            return [node]
        return [Expr("item", (node,), (i,)) for i in range(self.outputs)]

    def slope(self, args: tuple[Expr, ...], place: int, output: int) -> Expr:
        """The derivative of an output in the argument at `place`."""
        index = tuple(int(j == place) for j in range(len(self.arguments)))
        return self.difference(index).nodes(args)[output]

    def difference(self, index: tuple[int, ...]) -> Difference:
        """The derivative that is taken index[j] times in argument j, by differences."""
        if index not in self._differences:
            self._differences[index] = Difference(self, index)
        return self._differences[index]


class Primitive(Opaque):
    """A function of the user's; calls on symbols become nodes."""

    def __init__(self, function: Function, derivative: Derivative | None = None):
        super().__init__()
        self.function = function
        self.location = location_of(function)
        self.arguments = _arguments(function)
        self.compiled, self.outputs = _compile(function, len(self.arguments))
        self.numbers, self.plain = self.compiled, function
        word = re.sub(r"\W+", "_", function.__name__).strip("_")  # <lambda> is no identifier
        self._compiled_of = fingerprint(function)
        self.name = f"{word}_{self._compiled_of[:8]}"
        self.__wrapped__ = function  # so that a law that calls it reads what the function reads
        self.__name__, self.__doc__ = function.__name__, function.__doc__
        REGISTRY[self.name] = self
        self.derivative = derivative
        self.given: dict[int | None, Primitive] = {}  # by argument; of all under None
        self._origin: tuple[Primitive, int | None] | None = None  # whose derivative it is
        if derivative is not None:
            self.given = _given(self, derivative)

    @property
    def key(self) -> str:  # type: ignore[override]
        return " ".join([self.name, *(f"{j} {p.key}" for j, p in self.given.items())])

    @property
    def root(self) -> Primitive:  # type: ignore[override]
        return self if self._origin is None else self._origin[0].root

    @property
    def spelled(self) -> str:  # type: ignore[override]
        if self._origin is None:
            return self.__name__
        return f"{self._origin[0].spelled}.given[{self._origin[1]}]"

    def slope(self, args: tuple[Expr, ...], place: int, output: int) -> Expr:
        if place in self.given:
            return self.given[place].nodes(args)[output]
        if None in self.given:
            return self.given[None].nodes(args)[output * len(args) + place]
        return super().slope(args, place, output)

    def how_derived(self) -> str:
        """Where its derivatives come from, for people."""
        names = [self.arguments[j] for j in self.given if j is not None]
        if None in self.given or len(names) == len(self.arguments):
            return "as given (derivative=), those of second order by central differences of these"
        told = (
            "central differences of the compiled function, with steps that begin at 1e-7 of an "
            "argument (1e-4 for second derivatives) and adapt to its scale: exact to about 1e-9 "
            "(1e-7) where it is smooth"
        )
        if names:
            told = f"in {', '.join(names)} as given (derivative=), else {told}"
        return told

    def check_as_compiled(self) -> None:
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
        for given in self.given.values():
            given.check_as_compiled()

    def __reduce__(self):  # by name where a module holds it, else by the function
        if self._origin is not None:
            return _derivative_of, self._origin
        if holder_of(self.function) is self:
            return _by_name, (self.function.__module__, self.function.__qualname__)
        return _restored, (self.name, self.function, self.derivative)

    def __repr__(self) -> str:
        return f"<primitive {self.__name__}>"


class Difference(Opaque):
    """A derivative of an opaque function by central differences, index[j] times in argument j.

    It is compiled when compiled code first needs it; its name tells how it is made.
    """

    def __init__(self, base: Opaque, index: tuple[int, ...]):
        super().__init__()
        if sum(index) > differences.LARGEST:
            raise ModelError(
                f"a derivative of order {sum(index)} of the primitive {base.__name__} is asked for",
                fix="give its first derivatives by derivative=",
                where=base.location,
            )
        self.base, self.index = base, index
        self.arguments, self.outputs = base.arguments, base.outputs
        self.root, self.location = base.root, base.location
        self.spelled = f"{base.spelled}.difference({index})"
        self.text = differences.difference_text(index, self.outputs)
        self.name = f"{base.name}_d{''.join(map(str, index))}_{differences.VERSION}"
        below = "".join(f"_{a}" * k for a, k in zip(self.arguments, index, strict=True))
        self.__name__ = f"d{base.__name__}_d{below.strip('_')}"
        self.key = self.name
        REGISTRY[self.name] = self

    @once_property
    def compiled(self) -> Any:  # type: ignore[override]
        return differences.compiled(self._made(False))

    @cached_property
    def numbers(self) -> Function:  # type: ignore[override]
        return self._made(True)

    @property
    def plain(self) -> Function:  # type: ignore[override]
        return self.numbers

    def _made(self, as_python: bool) -> Function:
        names = differences.names_for(self.base.compiled, as_python)
        exec(self.text, names)
        made: Function = names["difference"]
        return made

    def check_as_compiled(self) -> None:
        self.base.check_as_compiled()

    def slope(self, args: tuple[Expr, ...], place: int, output: int) -> Expr:
        index = tuple(k + (j == place) for j, k in enumerate(self.index))
        return self.base.difference(index).nodes(args)[output]

    def __reduce__(self):
        return _difference_of, (self.base, self.index)

    def __repr__(self) -> str:
        return f"<derivative {self.__name__}>"


_made: dict[str, Primitive] = {}


def _by_name(module: str, name: str) -> Primitive:
    found: Primitive = getattr(importlib.import_module(module), name)
    return found


def _difference_of(base: Opaque, index: tuple[int, ...]) -> Difference:
    return base.difference(index)


def _derivative_of(owner: Primitive, place: int | None) -> Primitive:
    return owner.given[place]


@one_at_a_time
def _restored(name: str, function: Function, derivative: Derivative | None = None) -> Primitive:
    """The primitive of this name, compiled once in each process."""
    if name not in _made:
        made = _made[name] = Primitive(function, derivative)
        made.name = name  # generated code has it, whatever else of the function travelled
        REGISTRY[name] = made
    return _made[name]


@overload
def primitive(function: Function) -> Primitive: ...
@overload
def primitive(*, derivative: Derivative | None = None) -> Callable[[Function], Primitive]: ...
def primitive(
    function: Function | None = None, *, derivative: Derivative | None = None
) -> Primitive | Callable[[Function], Primitive]:
    """Make a function of numbers callable inside a model's distributions.

    Its derivatives, which proposals, the Gaussian approximations, scores, `maximize` and `diagnose`
    ask for, are those given, else central differences of the compiled function: two calls for a
    first derivative, four for a mixed second one. The step begins at 1e-7 of the argument (1e-4 for
    second derivatives) and adapts to the function's scale, for relative errors near 1e-9 (1e-8) of
    smooth functions. Beside a jump the derivative is that of the side without it, and at a kink the
    mean of both sides. Functions that are exact to a few digits only (an iteration that stops
    early) have no useful differences: give their `derivative`.

    Parameters
    ----------
    function : takes floats by position and returns a float, or a tuple of floats; Numba must be
        able to compile it.
    derivative : its first derivatives, as a function of the same arguments that returns a tuple of
        one number for each of them (for several outputs a tuple of such tuples, one for each
        output); or a function for each argument, in a sequence (None: by differences) or by the
        argument's name, that returns what `function` does. Numba compiles them too. They are
        compared with differences at a few points when the primitive is made.

    Returns
    -------
    Primitive : takes numbers as the function does, and symbols inside of a distribution, where it
        returns an expression, or a tuple of them.

    Raises
    ------
    ModelError : Numba cannot compile it; names the function, its line and Numba's reason. A given
        derivative that is not one. Also in a distribution, where a variable that the function reads
        has changed since.

    Examples
    --------
    >>> import ssmppl as ssm
    >>> @ssm.primitive
    ... def friction(v):
    ...     return 0.1 if v > 0.0 else -0.1
    >>> @ssm.primitive(derivative=lambda v, c: (2.0 * c * abs(v), v * abs(v)))
    ... def drag(v, c):
    ...     return c * v * abs(v)
    """
    if function is None:
        return lambda own: primitive_of(own, derivative)
    return primitive_of(function, derivative)


def primitive_of(function: Function, derivative: Derivative | None) -> Primitive:
    """The primitive of a function."""
    if not inspect.isfunction(function):
        raise ModelError(
            f"@ssm.primitive decorates {function!r}, which is not a function",
            fix="write @ssm.primitive on the line above a def; what is given of it by name, as in "
            "@ssm.primitive(derivative=...)",
        )
    return Primitive(function, derivative)


def _symbolic(value: Any) -> bool:
    return isinstance(value, (Expr, ExprArray)) or (
        isinstance(value, np.ndarray) and value.dtype == object
    )


def _arguments(function: Function) -> list[str]:
    parameters = inspect.signature(function).parameters.values()
    plain = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    if any(p.kind not in plain for p in parameters):
        raise ModelError(
            f"the primitive {function.__name__} takes *arguments or keywords",
            fix="give it a fixed number of plain arguments",
            where=location_of(function),
        )
    return [p.name for p in parameters]


def _compile(function: Function, n: int) -> tuple[Any, int]:
    """(the compiled function, how many numbers it returns)."""
    made = differences.compiled(function)
    where = location_of(function)
    try:
        made.compile((numba.float64,) * n)
    except numba.core.errors.NumbaError as error:
        reason = str(error).strip().splitlines()
        raise ModelError(
            f"Numba cannot compile the primitive {function.__name__}: "
            + " ".join(line.strip() for line in reason[:6]),
            fix="use plain arithmetic, math.* or np.* on floats inside it, and return a float or a "
            "tuple of floats",
            where=where,
        ) from None
    result = made.overloads[(numba.float64,) * n].signature.return_type
    several = isinstance(result, numba.types.BaseTuple) and len(result) > 0
    parts = tuple(result) if several else (result,)
    numbers = (numba.types.Float, numba.types.Integer, numba.types.Boolean)
    if not all(isinstance(p, numbers) for p in parts) or (several and len(parts) == 1):
        raise ModelError(
            f"the primitive {function.__name__} returns {result}",
            fix="return one number, or a tuple of at least two: (a, b)",
            where=where,
        )
    return made, len(parts)


# -- derivatives that the user gives
def _given(owner: Primitive, derivative: Derivative) -> dict[int | None, Primitive]:
    """The given derivatives as primitives, by argument, or all of them under None.

    Raises
    ------
    ModelError : one is of another form, or is not the derivative.
    """
    n, who = len(owner.arguments), f"derivative= of the primitive {owner.__name__}"
    found: dict[int | None, Primitive] = {}
    if isinstance(derivative, Primitive) or inspect.isfunction(derivative):
        found[None] = _of_all(owner, derivative, who)
    elif isinstance(derivative, Mapping):
        unknown = [a for a in derivative if a not in owner.arguments]
        if unknown:
            raise ModelError(
                f"{who} names {unknown[0]!r}, which is no argument of it",
                fix=f"its arguments are {', '.join(owner.arguments)}",
                where=owner.location,
            )
        for name, f in derivative.items():
            place = owner.arguments.index(name)
            found[place] = _of_one(owner, f, place, who)
    elif isinstance(derivative, Sequence) and len(derivative) == n:
        for place, own in enumerate(derivative):
            if own is not None:
                found[place] = _of_one(owner, own, place, who)
    else:
        raise ModelError(
            f"{who} is {derivative!r}",
            fix=f"give a function that returns the {n} partial derivatives in a tuple, or "
            f"a function for each argument ({', '.join(owner.arguments)}) in a sequence or by name",
            where=owner.location,
        )
    _check(owner, found)
    return found


def _of_one(owner: Primitive, f: Any, place: int, who: str) -> Primitive:
    if not isinstance(f, Primitive) and not inspect.isfunction(f):
        raise ModelError(
            f"{who} in {owner.arguments[place]} is {f!r}, which is no function",
            fix="give a function of the same arguments, or None for differences",
            where=owner.location,
        )
    made = f if isinstance(f, Primitive) else Primitive(f)
    _same_form(owner, made, owner.outputs, who)
    if made is not f:
        made._origin = owner, place
    return made


def _of_all(owner: Primitive, f: Any, who: str) -> Primitive:
    n, m = len(owner.arguments), owner.outputs
    if m > 1:
        f = _flattened(f.function if isinstance(f, Primitive) else f, owner, who)
    made = f if isinstance(f, Primitive) else Primitive(f)
    _same_form(owner, made, n * m, who)
    if made is not f:
        made._origin = owner, None
    return made


def _flattened(f: Function, owner: Primitive, who: str) -> Function:
    """A function that returns the rows of derivatives one after another."""
    n, m = len(owner.arguments), owner.outputs
    inner, names = differences.compiled(f), [f"x{j}" for j in range(len(_arguments(f)))]
    inner.compile((numba.float64,) * len(names))
    result = inner.overloads[(numba.float64,) * len(names)].signature.return_type
    rows: tuple[Any, ...] = tuple(result) if _is_tuple(result) else ()
    tuples = all(_is_tuple(r) and len(r) == n for r in rows)
    if len(rows) != m or not (tuples or (n == 1 and not any(map(_is_tuple, rows)))):
        raise ModelError(
            f"{who} returns {result}",
            fix=f"return a tuple of {m} tuples, one for each output, of {n} numbers each",
            where=location_of(f),
        )
    parts = [f"rows[{i}]" + f"[{j}]" * tuples for i in range(m) for j in range(n)]
    word = re.sub(r"\W", "_", f.__name__)
    text = f"def {word}({', '.join(names)}):\n    rows = inner({', '.join(names)})\n"
    scope: dict[str, Any] = {"inner": inner, "__name__": f.__module__}
    exec(text + f"    return ({', '.join(parts)})\n", scope)
    made: Function = scope[word]
    return made


def _is_tuple(kind: Any) -> bool:
    return isinstance(kind, numba.types.BaseTuple)


def _same_form(owner: Primitive, made: Primitive, outputs: int, who: str) -> None:
    """It takes the same arguments and returns as many numbers as there are derivatives."""
    if len(made.arguments) != len(owner.arguments):
        raise ModelError(
            f"{who} takes {len(made.arguments)} arguments ({', '.join(made.arguments)})",
            fix=f"it takes those of {owner.__name__}: {', '.join(owner.arguments)}",
            where=made.location,
        )
    if made.outputs != outputs:
        raise ModelError(
            f"{who} returns {made.outputs} numbers, where there are {outputs} derivatives",
            fix=f"return a derivative in each of {', '.join(owner.arguments)}",
            where=made.location,
        )


POINTS = 12  # at which given derivatives are compared with differences


def _check(owner: Primitive, found: Mapping[int | None, Primitive]) -> None:
    """Compare given derivatives with differences at random points of both signs."""
    n, m = len(owner.arguments), owner.outputs
    rng = np.random.default_rng(20150)
    points = rng.uniform(0.3, 1.7, (POINTS, n))
    points[POINTS // 2 :] *= rng.choice((-1.0, 1.0), (POINTS - POINTS // 2, n))
    for place in range(n):
        if place not in found and None not in found:
            continue
        index = tuple(int(j == place) for j in range(n))
        with np.errstate(all="ignore"):
            for x in points.tolist():
                by_difference = _tuple(owner.difference(index).numbers(*x))
                value = _tuple(owner.compiled(*x))
                whole = _tuple(found[place if place in found else None].compiled(*x))
                own = whole if place in found else whole[place::n]
                for i in range(m):
                    if differences.close(own[i], by_difference[i], value[i], x[place]):
                        continue
                    at = ", ".join(
                        f"{a} = {v:.4g}" for a, v in zip(owner.arguments, x, strict=True)
                    )
                    part = f" of output {i}" if m > 1 else ""
                    raise ModelError(
                        f"derivative= of the primitive {owner.__name__} gives {own[i]:.6g} for the "
                        f"derivative{part} in {owner.arguments[place]} at {at}, where differences "
                        f"of {owner.__name__} give {by_difference[i]:.6g}",
                        fix="correct it, or leave derivative= out for differences",
                        where=owner.location,
                    )


def _tuple(values: Any) -> tuple[float, ...]:
    return tuple(values) if isinstance(values, tuple) else (values,)
