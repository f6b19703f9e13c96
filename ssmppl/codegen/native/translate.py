"""The text of a generated function -> LLVM IR.

Generated functions are written in a small part of Python: straight-line arithmetic on floats, one
loop over particles or over steps, rows of arrays. All that is here is what `module.py` and
`sums.py` write; anything else is `Untranslatable`, and Numba gets the text instead.

Every function takes one pointer to 64-bit words, two for each of its parameters: an array's address
and the length of its last axis, or a whole number and nothing. Iterations of a loop over particles
touch their own particle only, and the loop says so to the vectoriser, which then needs no checks
for overlapping rows; in a loop over steps one reads what another wrote.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from dataclasses import dataclass, field

from ssmppl.codegen.kernels.math.flags import FAST
from ssmppl.codegen.native.arithmetic import (
    FLAG_ROW,
    FLOAT,
    INTEGER,
    MATRIX,
    PLANE,
    ROW,
    SIMULATED,
    STREAM,
    Arithmetic,
    Untranslatable,
    Value,
)
from ssmppl.codegen.text.callbacks import REQUESTS, Request
from ssmppl.compiling import parse

PLANES = frozenset(
    ["y_data", "seen_data", "u_data", "states", "states_prev", "fits", "out", "trajectory"]
)  # two-dimensional arrays; all others have one axis
FLAGS = frozenset(["free"])  # of truth values
WHOLE = frozenset(["t", "steps"])  # parameters that are whole numbers
STREAMS = frozenset(["rng"])  # of unsigned words, for draws
BLOCK = 64  # particles whose small steps are made together
Rows = tuple[tuple[str, ...], ...]
BLOCK_OF_CALLS = 512  # likewise, where simulators are called
KINDS = {PLANE: PLANES, STREAM: STREAMS, FLAG_ROW: FLAGS}


@dataclass
class Translated:
    """IR of some functions. calls : (name, arity, draws) of scalar functions that they call.
    simulators : symbols of the callbacks."""

    text: str
    names: list[str]
    calls: set[tuple[str, int, bool]] = field(default_factory=set)
    simulators: set[str] = field(default_factory=set)


def translate(text: str) -> Translated:
    """All functions of a generated text, those decorated `@kernel` with loops that may reorder.

    Raises
    ------
    Untranslatable : naming the function and what was found in it.
    """
    tree = parse(text)
    functions = [n for n in tree.body if isinstance(n, ast.FunctionDef)]
    known = {f.name for f in functions}
    calls: set[tuple[str, int, bool]] = set()
    simulators: set[str] = set()
    parts = []
    for f in functions:
        fast = any(isinstance(d, ast.Name) and d.id == "kernel" for d in f.decorator_list)
        body = _Function(f, fast, known)
        parts.append(body.text())
        calls |= body.calls
        simulators |= body.simulators
    return Translated("\n".join(parts), [f.name for f in functions], calls, simulators)


class _Function(Arithmetic):
    """One function: its parameters and statements."""

    def __init__(self, node: ast.FunctionDef, fast: bool, known: Iterable[str]):
        super().__init__(node.name, " ".join(sorted(FAST)) + " " if fast else "")
        self.node, self.known = node, set(known)
        self.block = "entry"
        self.buffers: list[tuple[str, int]] = []  # room on the stack, of so many numbers each
        self.simulators: set[str] = set()
        self.size = BLOCK  # particles of a block

    def text(self) -> str:
        parameters = [a.arg for a in self.node.args.args]
        for k, name in enumerate(parameters):
            words = [self.word(2 * k), self.word(2 * k + 1)]
            if name in WHOLE:
                self.names[name] = Value(INTEGER, words[0])
                continue
            pointer = self.let(f"inttoptr i64 {words[0]} to ptr")
            kind = next((k for k, names in KINDS.items() if name in names), ROW)
            self.names[name] = Value(kind, pointer, words[1])
        self._statements(self.node.body)
        room = [f"{name} = alloca [{n} x double], align 64" for name, n in self.buffers]
        lines = [*room, *self.lines]
        body = "\n".join(f"  {line}" if not line.endswith(":") else line for line in lines)
        head = f"define void @{self.node.name}(ptr %words) nounwind {{"
        return f"{head}\nentry:\n{body}\n  ret void\n}}\n"

    # -- statements
    def _statements(self, body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                continue  # a docstring
            if isinstance(node, ast.Pass):
                continue
            if isinstance(node, ast.Assign) and len(node.targets) == 1:
                self._assign(node.targets[0], node.value)
            elif isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add):
                self._add_to(node.target, node.value)
            elif isinstance(node, ast.For):
                self._loop(node)
            elif isinstance(node, ast.If):
                self._if(node)
            elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
                self._pass_on(node.value)
            else:
                raise self.unknown(node)

    def _assign(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Name):
            if (asked := _simulator(value)) is not None:
                if self.in_loop and not self.over_steps:
                    raise self.unknown(value)
                self._store_arguments(value, given := self._room(asked.arguments), 1)
                self.names[target.id] = self._simulate(asked, given, "1", 1)
                return
            self.names[target.id] = self.value(value)
            return
        if isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Slice):
            self._fill(target, value)
            return
        where = self.element(target)
        self.store(self.float(self.value(value)), where)

    # -- calls of simulators
    def _room(self, numbers: int) -> str:
        """A new buffer on the stack."""
        name = f"%room{len(self.buffers)}"
        self.buffers.append((name, numbers))
        return name

    def _store_arguments(self, call: ast.expr, room: str, width: int) -> None:
        """The arguments of a simulator for one particle, in rows of this width."""
        assert isinstance(call, ast.Call)
        for k, argument in enumerate(call.args):
            number = self.float(self.value(argument))
            at = self.let(f"add i64 {k * width}, {self.here}")
            self.store(number, self.let(f"getelementptr double, ptr {room}, i64 {at}"))

    def _simulate(self, asked: Request, given: str, size: str, width: int) -> Value:
        """The results for so many particles."""
        out = self._room(asked.results * width)
        self.simulators.add(asked.symbol)
        self.lines.append(
            f"call void @{asked.symbol}(ptr {given}, ptr {out}, i64 {size}, i64 {width})"
        )
        return Value(SIMULATED, out, str(width))

    def _add_to(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Name):
            old = self.names[target.id]
            self.names[target.id] = self.binary("fadd", self.float(old), self.value(value))
            return
        added = self.float(self.value(value))
        where = self.element(target)
        self.store(self.binary("fadd", self.load(where), added).text, where)

    def _fill(self, target: ast.Subscript, value: ast.expr) -> None:
        """`row[:] = number`."""
        row = self.value(target.value)
        plain = isinstance(target.slice, ast.Slice) and target.slice.lower is target.slice.upper
        if row.kind != ROW or not plain:
            raise self.unknown(target)
        number = self.float(self.value(value))
        with_index = self._begin_loop(row.length)
        self.store(number, self.let(f"getelementptr double, ptr {row.text}, i64 {with_index}"))
        self._end_loop()

    def _loop(self, node: ast.For) -> None:
        call, target = node.iter, node.target
        if not isinstance(call, ast.Call) or not isinstance(target, ast.Name):
            raise self.unknown(node)
        if ast.unparse(call.func) != "range" or len(call.args) != 1 or node.orelse:
            raise self.unknown(node)
        carried = _carried(node, self.names)
        if carried:
            self._repeat(node, call.args[0], carried)
            return
        if self.in_loop:
            raise self.unknown(node)
        length = self.value(call.args[0])
        over_steps = ast.unparse(call.args[0]) == "steps"
        if not over_steps and _in_blocks(node):
            self.size = min([BLOCK_OF_CALLS if _asks(node) else BLOCK, *_widths(node)])
            self._loop_in_blocks(node, target.id, length.text)
            return
        index = self._begin_loop(length.text, over_steps)
        outer = dict(self.names)
        self.names[target.id] = Value(INTEGER, index)
        self._statements(node.body)
        if any(self.names[name] != before for name, before in outer.items()):
            raise self.unknown(node)  # the next iteration would have to know
        self.names = outer
        self._end_loop()

    def _repeat(self, node: ast.For, times: ast.expr, carried: list[str]) -> None:
        """A loop over small steps, from one of which to the next these numbers are carried."""
        length = self._times(times)
        begun = {name: self.float(self.names[name]) for name in carried}
        self.count += 1
        k = self.count
        before, outer = self.block, dict(self.names)
        self.lines += [f"br label %step{k}", f"step{k}:", ""]
        place = len(self.lines) - 1  # of the values, known when the body is written
        for i, name in enumerate(carried):
            self.names[name] = Value(FLOAT, f"%x{k}_{i}")
        at_head = dict(self.names)
        self.lines += [
            f"%more{k} = icmp slt i64 %i{k}, {length}",
            f"br i1 %more{k}, label %inner{k}, label %done{k}", f"inner{k}:",
        ]  # fmt: skip
        self.block = f"inner{k}"
        self._statements(node.body)
        moved = [self.float(self.names[name]) for name in carried]
        self.lines += [f"%next{k} = add nuw nsw i64 %i{k}, 1", f"br label %step{k}", f"done{k}:"]
        phis = [f"%i{k} = phi i64 [ 0, %{before} ], [ %next{k}, %{self.block} ]"]
        for i, (name, new) in enumerate(zip(carried, moved, strict=True)):
            phis.append(
                f"%x{k}_{i} = phi double [ {begun[name]}, %{before} ], [ {new}, %{self.block} ]"
            )
        self.lines[place : place + 1] = phis
        self.block = f"done{k}"
        self.names = {name: at_head[name] for name in outer}

    def _loop_in_blocks(self, node: ast.For, index: str, length: str) -> None:
        """A loop over particles with small steps inside, as loops over a few particles each: step
        by step all of a block, as only the innermost loop vectorises."""
        self.count += 1
        k, before = self.count, self.block
        self.lines += [
            f"br label %block{k}", f"block{k}:",
            f"%b{k} = phi i64 [ 0, %{before} ], [ %c{k}, %end{k} ]",
            f"%some{k} = icmp slt i64 %b{k}, {length}",
            f"br i1 %some{k}, label %into{k}, label %over{k}", f"into{k}:",
            f"%left{k} = sub i64 {length}, %b{k}", f"%few{k} = icmp slt i64 %left{k}, {self.size}",
            f"%size{k} = select i1 %few{k}, i64 %left{k}, i64 {self.size}",
        ]  # fmt: skip
        self.block, outer = f"into{k}", dict(self.names)
        kept: dict[str, Value] = {}  # name -> the buffer with its values
        parts = _segments(node)
        for place, part in enumerate(parts):
            later = {n for p in parts[place + 1 :] for n in _read(p)}
            if isinstance(part, ast.For):
                self._step_of_block(part, index, k, outer, kept, later | _read(part))
            elif isinstance(part, ast.Assign):
                self._call_of_block(part, index, k, outer, kept)
            else:
                self._pass(part, index, k, outer, kept, later)
        self.lines += [
            f"br label %end{k}", f"end{k}:", f"%c{k} = add i64 %b{k}, {self.size}",
            f"br label %block{k}", f"over{k}:",
        ]  # fmt: skip
        self.block, self.names = f"over{k}", outer

    def _step_of_block(
        self, node: ast.For, index: str, block: int, outer: dict[str, Value],
        kept: dict[str, Value], later: set[str],
    ) -> None:  # fmt: skip
        """The small steps, each of all particles of the block."""
        assert isinstance(node.iter, ast.Call)
        self.names = dict(outer)
        length = self._times(node.iter.args[0])
        self.count += 1
        k, before = self.count, self.block
        self.lines += [f"br label %step{k}", f"step{k}:", ""]
        place = len(self.lines) - 1
        self.lines += [
            f"%more{k} = icmp slt i64 %i{k}, {length}",
            f"br i1 %more{k}, label %inner{k}, label %done{k}", f"inner{k}:",
        ]  # fmt: skip
        self.block = f"inner{k}"
        self._pass(node.body, index, block, outer, kept, later)
        self.lines[place] = f"%i{k} = phi i64 [ 0, %{before} ], [ %next{k}, %{self.block} ]"
        self.lines += [f"%next{k} = add nuw nsw i64 %i{k}, 1", f"br label %step{k}", f"done{k}:"]
        self.block = f"done{k}"

    def _call_of_block(
        self, node: ast.Assign, index: str, block: int, outer: dict[str, Value],
        kept: dict[str, Value],
    ) -> None:  # fmt: skip
        """One call of a simulator for all particles of the block."""
        (target,), asked = node.targets, _simulator(node.value)
        assert isinstance(target, ast.Name)
        assert asked is not None
        room = self._room(asked.arguments * self.size)
        self._pass([], index, block, outer, kept, set(), (node.value, room))
        outer[target.id] = self._simulate(asked, room, f"%size{block}", self.size)

    def _pass(
        self, body: list[ast.stmt], index: str, block: int, outer: dict[str, Value],
        kept: dict[str, Value], later: set[str],
        called: tuple[ast.expr, str] | None = None,
    ) -> None:  # fmt: skip
        """Statements for each particle of the block; what is read later is kept in buffers.

        called : of a simulator, whose arguments go to this room.
        """
        here = self.here = self._begin_loop(f"%size{block}")
        self.names = dict(outer)
        self.names[index] = Value(INTEGER, self.let(f"add i64 %b{block}, {here}"))
        before = {}
        read = _read(body) if called is None else _names_in(called[0])
        for name in sorted(read & set(kept)):
            self.names[name] = before[name] = self._loaded(kept[name], here)
        self._statements(body)
        if called is not None:
            self._store_arguments(*called, self.size)
        for name, value in self.names.items():
            if name == index or name not in later or value is before.get(name):
                continue
            if name in outer and outer[name] == value:
                continue
            if name not in kept:
                kept[name] = self._buffers_for(value)
            for buffer, number in zip(
                _flat(kept[name].entries), _flat(self._numbers(value)), strict=True
            ):
                at = self.let(f"getelementptr double, ptr {buffer}, i64 {here}")
                self.store(number, at)
        self._end_loop()
        self.here = "0"

    def _numbers(self, value: Value) -> Rows:
        """A number, or the entries of a matrix, row by row."""
        return value.entries if value.kind == MATRIX else ((self.float(value),),)

    def _buffers_for(self, value: Value) -> Value:
        """A buffer for each number."""
        rows = []
        for row in self._numbers(value):
            rows.append(tuple(f"%kept{len(self.buffers) + k}" for k in range(len(row))))
            self.buffers += [(name, self.size) for name in rows[-1]]
        return Value(MATRIX if value.kind == MATRIX else FLOAT, "", entries=tuple(rows))

    def _loaded(self, buffers: Value, here: str) -> Value:
        rows = tuple(
            tuple(self.load(self.let(f"getelementptr double, ptr {b}, i64 {here}")) for b in row)
            for row in buffers.entries
        )
        return Value(FLOAT, rows[0][0]) if buffers.kind == FLOAT else Value(MATRIX, "", "", rows)

    def _times(self, node: ast.expr) -> str:
        """How often: a whole number, or `whole(number)`."""
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "whole":
            number = self.float(self.value(node.args[0]))
            some = self.let(f"fcmp ogt double {number}, 0.0")
            number = self.let(f"select i1 {some}, double {number}, double 0.0")
            return self.let(f"fptosi double {number} to i64")
        return self.value(node).text

    def _begin_loop(self, length: str, over_steps: bool = False) -> str:
        self.count += 1
        k = self.count
        self._head = (f"head{k}", f"body{k}", f"exit{k}")
        before, index = self.block, f"%i{k}"
        self.lines += [
            f"br label %{self._head[0]}", f"{self._head[0]}:",
            f"{index} = phi i64 [ 0, %{before} ], [ %next{k}, %last{k} ]",
            f"%more{k} = icmp slt i64 {index}, {length}",
            f"br i1 %more{k}, label %{self._head[1]}, label %{self._head[2]}",
            f"{self._head[1]}:",
        ]  # fmt: skip
        self.block, self.in_loop, self.over_steps = self._head[1], True, over_steps
        self._loop_number = k
        return index

    def _end_loop(self) -> None:
        k = self._loop_number
        self.lines += [
            f"br label %last{k}", f"last{k}:", f"%next{k} = add nuw nsw i64 %i{k}, 1",
            f"br label %{self._head[0]}{'' if self.over_steps else ', !llvm.loop !LOOP'}",
            f"{self._head[2]}:",
        ]  # fmt: skip
        self.block, self.in_loop = self._head[2], False

    def _if(self, node: ast.If) -> None:
        """Only stores inside: no name that is set there is read after it."""
        condition = self.truth(self.value(node.test))
        self.count += 1
        k = self.count
        self.lines += [f"br i1 {condition}, label %then{k}, label %else{k}", f"then{k}:"]
        self.block, outer = f"then{k}", dict(self.names)
        self._statements(node.body)
        self.lines += [f"br label %after{k}", f"else{k}:"]
        self.block, self.names = f"else{k}", dict(outer)
        self._statements(node.orelse)
        self.lines += [f"br label %after{k}", f"after{k}:"]
        self.block, self.names = f"after{k}", outer

    def _pass_on(self, call: ast.Call) -> None:
        """A call of a function with the same parameters."""
        own = [a.arg for a in self.node.args.args]
        given = [a.id for a in call.args if isinstance(a, ast.Name)]
        if not isinstance(call.func, ast.Name) or call.func.id not in self.known or given != own:
            raise self.unknown(call)
        self.lines.append(f"call void @{call.func.id}(ptr %words)")


def _flat(rows: Rows) -> list[str]:
    return [number for row in rows for number in row]


def _segments(node: ast.For) -> list[list[ast.stmt] | ast.For | ast.Assign]:
    """The body, cut at the loops and the calls of simulators in it."""
    parts: list[list[ast.stmt] | ast.For | ast.Assign] = []
    for statement in node.body:
        if isinstance(statement, ast.For) or (
            isinstance(statement, ast.Assign) and _simulator(statement.value) is not None
        ):
            parts.append(statement)
        elif parts and isinstance(parts[-1], list):
            parts[-1].append(statement)
        else:
            parts.append([statement])
    return parts


def _simulator(node: ast.expr) -> Request | None:
    """What is asked of a simulator, where the expression calls one."""
    called = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    return REQUESTS.get(node.func.id) if called else None  # type: ignore[attr-defined]


def _widths(node: ast.For) -> list[int]:
    """The most particles that each of the simulators takes that are called in a loop."""
    called = [_simulator(s.value) for s in node.body if isinstance(s, ast.Assign)]
    return [c.most for c in called if c is not None]


def _asks(node: ast.For) -> bool:
    return bool(_widths(node))


def _read(part: list[ast.stmt] | ast.For | ast.Assign) -> set[str]:
    """The names that it reads."""
    nodes = part if isinstance(part, list) else [part]
    return {n.id for s in nodes for n in ast.walk(s)
            if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}  # fmt: skip


def _in_blocks(node: ast.For) -> bool:
    """Whether particles call simulators, or have small steps of their own, as many for all, and
    draw nothing besides: the draws' order is that of the text."""
    inner = [s for s in node.body if isinstance(s, ast.For)]
    own = {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    alike = all(own.isdisjoint(_names_in(s.iter)) for s in inner)
    if _asks(node):
        return alike
    return bool(inner) and alike and "rng" not in _names_in(node)


def _names_in(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}


def _carried(node: ast.For, known: Iterable[str]) -> list[str]:
    """The names that the loop sets and that had a value before."""
    stores = {
        n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }
    return [name for name in known if name in stores]


__all__ = ["PLANES", "WHOLE", "Translated", "Untranslatable", "translate"]
