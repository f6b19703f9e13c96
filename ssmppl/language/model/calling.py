"""Calling a user's distribution on symbols: what it reads, where it returns, and errors at its own
lines."""

from __future__ import annotations

import dis
import inspect
import itertools
import os
import re
import traceback
from collections.abc import Callable, Mapping
from types import CodeType, TracebackType
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, SSMError, UnsupportedOperation
from ssmppl.expressions.expr import INDEX_BY_SYMBOL, topological
from ssmppl.expressions.numpy_protocols import UNSUPPORTED
from ssmppl.language.distributions import DISTRIBUTIONS, Distribution
from ssmppl.language.distributions.base import DistributionAsNumber
from ssmppl.language.model.closure_digest import INSTALLED, outer_values, plain_function
from ssmppl.language.model.drawn_inside import computed_with
from ssmppl.language.model.lookups import check_lookups, instructions
from ssmppl.language.model.model import location_of
from ssmppl.language.model.name_hints import name_hint

Law = Callable[..., Any]
Roles = Mapping[str, str]  # name of a quantity -> its role
_OWN = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))) + os.sep
# NumPy's messages about object arrays, which np.array makes of symbols
_OBJECT_ARRAY = re.compile(r"has no callable|dtype\('O'\)|not supported for the input types")
_BUILD = (
    "np.array([...]) of symbols is a plain object array to NumPy: build vectors by "
    "np.stack([a, b]) and matrices by np.block([[a, b], [c, d]])"
)
_NO_ELEMENTS = (
    "write the name without brackets and without a loop over it; what has several components is "
    "declared with a vector distribution (MvNormal, or arguments that are arrays)"
)
# Python's messages about a scalar symbol: what was asked of it, and what to write instead
_ASKED_OF_SYMBOLS = tuple(
    (re.compile(pattern), found, fix)
    for pattern, found, fix in (
        (r"^'Expr' object is not subscriptable",
         "takes an element, [...], of a symbol that is one number", _NO_ELEMENTS),
        (r"^'Expr' object does not support item",
         "assigns to an element, [...], of a symbol", "compute a new value under a new name"),
        (r"^'Expr' object is not iterable|cannot unpack non-iterable Expr",
         "goes through a symbol that is one number as through a list (for, in, sum(), max(), "
         "unpacking)", _NO_ELEMENTS),
        (r"^object of type 'Expr' has no len",
         "asks for the len() of a symbol that is one number",
         "write 1, or the count itself: lengths are known when the model is written"),
        (r"doesn't define __round__",
         "rounds a symbol by Python's round()", "write np.floor(x + 0.5)"),
        (r"doesn't define __trunc__|Expr.__trunc__",
         "cuts a symbol to a whole number by Python's trunc()",
         "write np.sign(x) * np.floor(np.abs(x))"),
        (r"format string passed to Expr",
         "formats a symbol as a number (an f-string, format())",
         "take the text out of the distribution: a symbol has no value while the model is traced"),
        (r"^'Expr' object is not callable",
         "calls a symbol as a function", "write x * (...) for a product"),
        (r"for divmod\(\).*'Expr'", "asks for divmod() of a symbol", "write x // n and x % n"),
        (r"for @.*'Expr'", "multiplies numbers by @, which is for vectors and matrices",
         "write * for a product of numbers"),
        (r"unsupported operand type\(s\) for (\S+?):? .*'Expr' and '(\w+)'",
         "has a symbol and a {1} on the two sides of {0}",
         "use numbers, symbols and arrays of them"),
        (r"unsupported operand type\(s\) for (\S+?):? '(\w+)' and 'Expr'",
         "has a {1} and a symbol on the two sides of {0}",
         "use numbers, symbols and arrays of them"),
        (r"^'Expr' object has no attribute '(\w+)'",
         "asks a symbol for {0!r}, which it does not have",
         "use NumPy's functions on it, such as np.exp(x); " + _BUILD),
    )
)  # fmt: skip


def call(function: Law, role: str, arguments: dict[str, Any], known: Roles) -> Any:
    """What the distribution returns for these arguments.

    It is called twice: a distribution that is not the same again draws random numbers or changes
    something, and what was drawn would be frozen into the model.
    """
    check_lookups(function, role, arguments)
    first = call_once(function, role, arguments, known)
    again = call_once(function, role, arguments, known)
    if not _same(first, again):
        raise ModelError(
            f"@{role} {function.__name__} gives another distribution when it is called again",
            fix="draw no random numbers and change nothing inside of it: it runs on symbols, "
            "and randomness belongs into the distributions that it returns",
            where=return_location(function),
        )
    return first


def call_once(function: Law, role: str, arguments: dict[str, Any], known: Roles) -> Any:
    """What the function returns; its errors are raised at the user's line."""
    try:
        signature = inspect.signature(function)
        bound = signature.bind_partial()
        bound.arguments.update({n: arguments[n] for n in signature.parameters if n in arguments})
        return function(*bound.args, **bound.kwargs)
    except DistributionAsNumber as error:
        raise _wrapped(error, function, role, arguments, known) from error
    except SSMError as error:
        moved = _at_users_line(error, function)
        if moved is error and isinstance(error, UnsupportedOperation):
            moved = _of_a_library(error, function)
        if moved is error:  # not its own cause: what packs errors follows causes to their end
            raise
        raise moved from error
    except Exception as error:
        raise _wrapped(error, function, role, arguments, known) from error


def _same(a: Any, b: Any) -> bool:
    if not (isinstance(a, Mapping) and isinstance(b, Mapping)):
        return True  # refused for what it is
    if list(a) != list(b):
        return False
    pairs = [(a[n], b[n]) for n in a if isinstance(a[n], Distribution)]
    return all(type(d) is type(e) and _content(d) == _content(e) for d, e in pairs)


def _content(d: Distribution) -> list[tuple[str, str]]:
    nodes = topological(d.expressions())
    return [(n.op, repr(n.data) if n.op in ("const", "symbol") else "") for n in nodes]


def return_location(function: Law) -> Location:
    """The line of the distribution's only `return`; its `def` where there are several."""
    plain = plain_function(function)
    lines, line = set(), 0
    for instruction in dis.get_instructions(plain.__code__):
        position = instruction.positions
        line = (position.lineno if position else None) or line
        if instruction.opname in ("RETURN_VALUE", "RETURN_CONST"):
            lines.add(line)
    where = location_of(function)
    return Location(where.file, lines.pop(), where.function) if len(lines) == 1 else where


# -- names from outside of the law
def check_outer_names(function: Law, role: str, known: Roles) -> None:
    """Refuse a distribution that reads a variable of Python's named as a quantity of the model,
    itself or in a function of the user's that it calls.

    With `phi = 0.9` at the top of the file, a distribution that forgets `phi` among its arguments
    would quietly use 0.9.
    """
    who = f"@{role} {function.__name__} reads"
    to_read: list[tuple[Callable[..., Any], str]] = [(function, who)]
    met = {id(function)}
    while to_read:
        reader, who = to_read.pop()
        for name, value in outer_values(reader).items():
            if inspect.isfunction(value) and id(value) not in met and _of_the_users(value):
                met.add(id(value))
                to_read.append((value, f"{value.__name__}(), which @{role} calls, reads"))
            if name not in known or callable(value) or inspect.ismodule(value):
                continue
            code = plain_function(reader).__code__
            raise ModelError(
                f"{who} the Python variable {name!r}, while {name!r} is {known[name]} of the model",
                fix=f"add {name!r} to the arguments of {reader.__name__}; if the variable is "
                "meant, rename it",
                where=_line_of_name(code, name, location_of(reader)),
            )


def _of_the_users(function: Callable[..., Any]) -> bool:
    file = plain_function(function).__code__.co_filename
    return not file.startswith((*INSTALLED, _OWN))


def _line_of_name(code: CodeType, name: str, where: Location) -> Location:
    for instruction, line in instructions(code):
        if instruction.opname.startswith("LOAD_") and instruction.argval == name and line:
            return Location(where.file, line, where.function)
    return where


# -- errors inside of the law
def _frames(function: Law, trace: TracebackType | None) -> list[traceback.FrameSummary]:
    file = plain_function(function).__code__.co_filename
    return [f for f in traceback.extract_tb(trace) if f.filename == file]


def _at_users_line(error: SSMError, function: Law) -> SSMError:
    """`error`, moved to the user's line where it arose inside of an installed library."""
    where = error.where
    file = plain_function(function).__code__.co_filename
    if not isinstance(where, Location) or where.file == file:
        return error
    frames = _frames(function, error.__traceback__)
    if not where.file.startswith(INSTALLED) or not frames:
        return error
    last = frames[-1]
    place = Location(file, last.lineno or 0, last.name)
    return type(error)(
        f"{error.found} (inside of {where.function}() of a library)",
        fix="write the computation by NumPy's functions, or wrap it by @ssm.primitive",
        where=place,
    )


def _library_function(function: Law, trace: TracebackType | None) -> str:
    """The name of the function of an installed library that the distribution called and that
    failed; "" where it was none."""
    file, called = plain_function(function).__code__.co_filename, ""
    for frame, after in itertools.pairwise(traceback.extract_tb(trace)):
        if frame.filename == file:
            there = after.filename.startswith(INSTALLED) and not after.filename.startswith(_OWN)
            called = after.name if there else ""
    return called.strip("_<>")


def _of_a_library(error: UnsupportedOperation, function: Law) -> UnsupportedOperation:
    """What a library's function for numbers asked of a symbol, named by the function."""
    name = _library_function(function, error.__traceback__)
    if name not in UNSUPPORTED:
        return error
    return UnsupportedOperation(f"{name}() of a library takes numbers, not symbols",
                                fix=f"write {UNSUPPORTED[name]}", where=error.where)  # fmt: skip


def _wrapped(
    error: Exception, function: Law, role: str, arguments: dict[str, Any], known: Roles
) -> ModelError:
    """An exception inside a user's function, at the user's line."""
    frames = _frames(function, error.__traceback__)
    where = location_of(function)
    if frames:
        where = Location(frames[-1].filename, frames[-1].lineno or 0, frames[-1].name)
    shapes = ", ".join(f"{n} of shape {np.shape(v)}" for n, v in arguments.items())
    fix = (
        "the function runs once on symbols, for one particle and one time step; its "
        f"arguments were {shapes or 'none'}"
    )
    found = f"@{role} {function.__name__} raised {type(error).__name__}: {error}"
    if isinstance(error, NameError) and (role_of := known.get(str(error.name))):
        fix = f"add {error.name!r}, {role_of} of the model, to the arguments of "
        fix += function.__name__
    elif (called := _library_function(function, error.__traceback__)) in UNSUPPORTED:
        found = f"{called}() of a library takes numbers, not symbols"
        fix = f"write {UNSUPPORTED[called]}"
    elif drawn := computed_with(error, function, role):
        found, fix = drawn
    elif asked := _of_a_symbol(error):
        found, fix = f"@{role} {function.__name__} {asked[0]}", asked[1]
    elif _OBJECT_ARRAY.search(str(error)):
        fix = _BUILD
    elif isinstance(error, IndexError) and "only integers, slices" in str(error):
        fix = f"if the index is a symbol: {INDEX_BY_SYMBOL}"
    elif isinstance(error, AttributeError) and (attribute := _ssm_attribute(error)):
        found = f"@{role} {function.__name__} asks for ssm.{error.name}, which does not exist"
        fix = attribute
    return ModelError(found, fix=fix, where=where)


def _of_a_symbol(error: Exception) -> tuple[str, str] | None:
    """What was asked of a scalar symbol that only other objects of Python have, and the fix."""
    if not isinstance(error, (TypeError, AttributeError)):
        return None
    for pattern, found, fix in _ASKED_OF_SYMBOLS:
        if match := pattern.search(str(error)):
            return found.format(*match.groups()), fix.format(*match.groups())
    return None


def _ssm_attribute(error: AttributeError) -> str:
    if inspect.ismodule(error.obj) and error.obj.__name__.startswith("ssmppl"):
        hint = name_hint(str(error.name), DISTRIBUTIONS)
        return f"{hint}{'; ' if hint else ''}the distributions are: {', '.join(DISTRIBUTIONS)}"
    return ""
