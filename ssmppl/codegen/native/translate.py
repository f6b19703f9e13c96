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
    INTEGER,
    PLANE,
    ROW,
    STREAM,
    Arithmetic,
    Untranslatable,
    Value,
)
from ssmppl.compiling import parse

PLANES = frozenset(
    ["y_data", "seen_data", "u_data", "states", "states_prev", "fits", "out", "trajectory"]
)  # two-dimensional arrays; all others have one axis
FLAGS = frozenset(["free"])  # of truth values
WHOLE = frozenset(["t", "steps"])  # parameters that are whole numbers
STREAMS = frozenset(["rng"])  # of unsigned words, for draws
KINDS = {PLANE: PLANES, STREAM: STREAMS, FLAG_ROW: FLAGS}


@dataclass
class Translated:
    """IR of some functions. calls : (name, arity, draws) of scalar functions that they call."""

    text: str
    names: list[str]
    calls: set[tuple[str, int, bool]] = field(default_factory=set)


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
    parts = []
    for f in functions:
        fast = any(isinstance(d, ast.Name) and d.id == "kernel" for d in f.decorator_list)
        body = _Function(f, fast, known)
        parts.append(body.text())
        calls |= body.calls
    return Translated("\n".join(parts), [f.name for f in functions], calls)


class _Function(Arithmetic):
    """One function: its parameters and statements."""

    def __init__(self, node: ast.FunctionDef, fast: bool, known: Iterable[str]):
        super().__init__(node.name, " ".join(sorted(FAST)) + " " if fast else "")
        self.node, self.known = node, set(known)
        self.block = "entry"

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
        body = "\n".join(f"  {line}" if not line.endswith(":") else line for line in self.lines)
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
            self.names[target.id] = self.value(value)
            return
        if isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Slice):
            self._fill(target, value)
            return
        where = self.element(target)
        self.store(self.float(self.value(value)), where)

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
        if not isinstance(call, ast.Call) or not isinstance(target, ast.Name) or self.in_loop:
            raise self.unknown(node)
        if ast.unparse(call.func) != "range" or len(call.args) != 1 or node.orelse:
            raise self.unknown(node)
        length = self.value(call.args[0])
        index = self._begin_loop(length.text, over_steps=ast.unparse(call.args[0]) == "steps")
        outer = dict(self.names)
        self.names[target.id] = Value(INTEGER, index)
        self._statements(node.body)
        if any(self.names[name] != before for name, before in outer.items()):
            raise self.unknown(node)  # the next iteration would have to know
        self.names = outer
        self._end_loop()

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


__all__ = ["PLANES", "WHOLE", "Translated", "Untranslatable", "translate"]
