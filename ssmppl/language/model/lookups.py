"""Symbols that a distribution looks up in a set or a dictionary, which does not have them and says
nothing.

`u in {1, 2}` and `TABLE.get(u, 0.0)` ask for the symbol itself, by its hash: there is no operation
of it that could tell. They are found in the distribution's own instructions, where an argument goes
there by its name: not in functions that the distribution calls, nor under another name.
"""

from __future__ import annotations

import dis
from collections.abc import Callable, Iterator, Mapping
from types import CodeType
from typing import Any

from ssmppl.errors import Location, ModelError
from ssmppl.language.model.closure_digest import outer_values, plain_function
from ssmppl.language.model.model import location_of


def instructions(code: CodeType) -> Iterator[tuple[dis.Instruction, int | None]]:
    """Those of a function and of the functions inside of it, each with its line."""
    for instruction in dis.get_instructions(code):
        yield instruction, instruction.positions.lineno if instruction.positions else None
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from instructions(inner)


def check_lookups(function: Callable[..., Any], role: str, arguments: Mapping[str, Any]) -> None:
    """Refuse a lookup of one of the arguments; one that went through a call before may be a
    number, and is let pass."""
    found = [i for i, _ in instructions(plain_function(function).__code__)]
    outer, rebound = outer_values(function), _rebound(plain_function(function).__code__, found)
    for k, instruction in enumerate(found):
        if instruction.opname == "CONTAINS_OP":
            whole = _value(found[k - 1], outer)
            named = _tested(found[: k - 1], instruction)
        elif instruction.argval == "get" and k + 1 < len(found):
            whole = _value(found[k - 1], outer)
            after = [i for i in found[k + 1 : k + 4] if i.opname not in ("PUSH_NULL", "CACHE")]
            named = _loaded(after[0])[:1] if after else []
            if len(after) > 1 and _may_be_number(after[1]):
                named = []
        else:
            continue
        named = [n for n in named if n in arguments and n not in rebound]
        if named and _by_hash(whole):
            where = location_of(function)
            line = instruction.positions.lineno if instruction.positions else None
            raise ModelError(
                f"@{role} {function.__name__} looks {named[0]!r}, a symbol, up in a "
                f"{type(whole).__name__}, which never has it",
                fix=f"compare it: np.where(({named[0]} == 1) | ({named[0]} == 2), a, b); of a "
                "table, np.choose(k, values) is values[k] for a symbol k from 0",
                where=Location(where.file, line or where.line, function.__name__),
            )


def _rebound(code: CodeType, found: list[dis.Instruction]) -> set[str]:
    """Names that may stand for other things than the distribution's arguments: assigned anew, or
    local to a function inside."""
    names = {n for i in found if i.opname.startswith("STORE_") for n in _names(i)}
    inner = [c for c in code.co_consts if isinstance(c, CodeType)]
    for c in inner:
        names.update(c.co_varnames)
        inner += [d for d in c.co_consts if isinstance(d, CodeType)]
    return names


def _by_hash(whole: Any) -> bool:
    return isinstance(whole, (set, frozenset, Mapping)) or (
        type(whole).__module__.partition(".")[0] == "pandas" and hasattr(whole, "__contains__")
    )


def _value(instruction: dis.Instruction, outer: Mapping[str, Any]) -> Any:
    """What a constant or a name from outside is; None of others."""
    if instruction.opname == "LOAD_CONST":
        return instruction.argval
    return outer.get(str(instruction.argval)) if instruction.opname.startswith("LOAD_") else None


def _tested(before: list[dis.Instruction], contains: dis.Instruction) -> list[str]:
    """The local names on the left of `in`, from the last; none where it calls something."""
    names: list[str] = []
    begun = False  # where the source of the left side begins
    for instruction in reversed(before):
        if not _within(instruction, contains):
            # Python 3.13 loads two at once, and says where the first one was read
            return names if begun else names + _loaded(instruction)[1:]
        begun = _start(instruction) == _start(contains)
        if _may_be_number(instruction):
            return []
        names += reversed(_loaded(instruction))
    return names


def _may_be_number(instruction: dis.Instruction) -> bool:
    return "CALL" in instruction.opname or "ATTR" in instruction.opname


def _loaded(instruction: dis.Instruction) -> list[str]:
    return _names(instruction) if instruction.opname.startswith("LOAD_FAST") else []


def _names(instruction: dis.Instruction) -> list[str]:
    """One, or two where Python 3.13 does two things at once."""
    names = instruction.argval
    return list(names) if isinstance(names, tuple) else [names]


def _start(instruction: dis.Instruction) -> tuple[int | None, int | None]:
    at = instruction.positions
    return (at.lineno, at.col_offset) if at else (None, None)


def _within(a: dis.Instruction, b: dis.Instruction) -> bool:
    """Whether the source of a lies in that of b."""
    if a.positions is None or b.positions is None or None in (*a.positions, *b.positions):
        return False
    (first, last, start, end), (top, bottom, left, right) = a.positions, b.positions
    return (top, left) <= (first, start) and (last, end) <= (bottom, right)  # type: ignore[operator]
