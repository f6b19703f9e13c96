"""Expressions of a generated text -> LLVM IR: numbers, comparisons, elements of arrays, calls."""

from __future__ import annotations

import ast
import struct
from dataclasses import dataclass

from ssmppl.codegen.native import matrices
from ssmppl.compiling import literal
from ssmppl.errors import SSMError
from ssmppl.expressions.operations import MATRIX_OPS
from ssmppl.language.user_defined.primitive import outputs_of

FLOAT, BOOLEAN, INTEGER, ROW, PLANE, STREAM = "float", "boolean", "integer", "row", "plane", "rng"
FLAG_ROW, MATRIX, SIMULATED = "row of flags", "matrix", "results of a simulator"
COMPARISONS = {ast.Lt: "olt", ast.LtE: "ole", ast.Gt: "ogt", ast.GtE: "oge", ast.Eq: "oeq",
               ast.NotEq: "une"}  # fmt: skip
ARITHMETIC = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
WHOLE_ARITHMETIC = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul"}


class Untranslatable(SSMError):
    """The text holds something that only Numba compiles."""


@dataclass(frozen=True)
class Value:
    """A typed value: its kind and the text of the operand; the length where it is an array, the
    entries where it is a matrix."""

    kind: str
    text: str
    length: str = ""
    entries: tuple[tuple[str, ...], ...] = ()


class Arithmetic:
    """A function while it is written: its lines, its names, the values of its expressions.

    name : of the function. flags : of its floating-point operations. calls : (name, arity, draws)
    of the scalar functions that it calls. in_loop : whether the line is one of a particle's, or of
    a step's where over_steps.
    """

    def __init__(self, name: str, flags: str):
        self.name, self.flags = name, flags
        self.lines: list[str] = []
        self.names: dict[str, Value] = {"inf": number(float("inf")), "nan": number(float("nan"))}
        self.count = 0
        self.calls: set[tuple[str, int, bool]] = set()
        self.in_loop = self.over_steps = False
        self.here = "0"  # the place of a particle among those that a simulator moves together

    def value(self, node: ast.expr) -> Value:
        """The value of an expression, after the lines that compute it."""
        if isinstance(node, ast.Constant):
            if isinstance(node.value, int):
                return Value(INTEGER, str(node.value))
            if isinstance(node.value, float):
                return number(node.value)
        if isinstance(node, ast.Name):
            if node.id not in self.names:
                raise self.unknown(node)
            return self.names[node.id]
        if isinstance(node, ast.BinOp):
            return self._operation(node)
        if isinstance(node, ast.UnaryOp):
            return self._unary(node)
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            sides = [self.float(self.value(n)) for n in (node.left, node.comparators[0])]
            how = COMPARISONS[type(node.ops[0])]
            return Value(BOOLEAN, self.let(f"fcmp {how} double {sides[0]}, {sides[1]}"))
        if isinstance(node, ast.BoolOp):
            how = "and" if isinstance(node.op, ast.And) else "or"
            total = self.truth(self.value(node.values[0]))
            for other in node.values[1:]:
                total = self.let(f"{how} i1 {total}, {self.truth(self.value(other))}")
            return Value(BOOLEAN, total)
        if isinstance(node, ast.IfExp):
            test = self.truth(self.value(node.test))
            yes, no = self.float(self.value(node.body)), self.float(self.value(node.orelse))
            return Value(FLOAT, self.let(f"select i1 {test}, double {yes}, double {no}"))
        if isinstance(node, ast.Subscript):
            return self._subscript(node)
        if isinstance(node, ast.Attribute):
            raise self.unknown(node)
        if isinstance(node, ast.Call):
            return self._call(node)
        raise self.unknown(node)

    def _operation(self, node: ast.BinOp) -> Value:
        a, b = self.value(node.left), self.value(node.right)
        if a.kind == INTEGER and b.kind == INTEGER:
            if type(node.op) not in WHOLE_ARITHMETIC:
                raise self.unknown(node)
            how = WHOLE_ARITHMETIC[type(node.op)]
            return Value(INTEGER, self.let(f"{how} i64 {a.text}, {b.text}"))
        if isinstance(node.op, ast.Mod):
            return self._remainder(self.float(a), self.float(b))
        if type(node.op) not in ARITHMETIC:
            raise self.unknown(node)
        return self.binary(ARITHMETIC[type(node.op)], a, b)

    def binary(self, how: str, a: Value | str, b: Value | str) -> Value:
        """`how`, an instruction such as fadd, on two numbers."""
        left, right = (x if isinstance(x, str) else self.float(x) for x in (a, b))
        return Value(FLOAT, self.let(f"{how} {self.flags}double {left}, {right}"))

    def _remainder(self, a: str, b: str) -> Value:
        """Of the division that rounds down: the sign of b."""
        rest = self.let(f"frem double {a}, {b}")
        other = self.let(f"fcmp one double {rest}, 0.0")
        signs = [self.let(f"fcmp olt double {x}, 0.0") for x in (rest, b)]
        differ = self.let(f"xor i1 {signs[0]}, {signs[1]}")
        both = self.let(f"and i1 {other}, {differ}")
        moved = self.let(f"fadd double {rest}, {b}")
        return Value(FLOAT, self.let(f"select i1 {both}, double {moved}, double {rest}"))

    def _unary(self, node: ast.UnaryOp) -> Value:
        a = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            return Value(BOOLEAN, self.let(f"xor i1 {self.truth(a)}, true"))
        if isinstance(node.op, ast.USub):
            if a.kind == INTEGER:
                return Value(INTEGER, self.let(f"sub i64 0, {a.text}"))
            return Value(FLOAT, self.let(f"fneg {self.flags}double {self.float(a)}"))
        raise self.unknown(node)

    def _subscript(self, node: ast.Subscript) -> Value:
        base = node.value
        if isinstance(base, ast.Attribute) and base.attr == "shape":
            array = self.value(base.value)
            last = 1 if array.kind == PLANE else 0
            if isinstance(node.slice, ast.Constant) and node.slice.value == last:
                return Value(INTEGER, array.length)
            raise self.unknown(node)
        array = self.value(base)
        if isinstance(node.slice, ast.Slice):
            if array.kind != ROW or node.slice.lower is None or node.slice.step is not None:
                raise self.unknown(node)
            first = self.value(node.slice.lower)
            at = self.let(f"getelementptr double, ptr {array.text}, i64 {first.text}")
            return Value(ROW, at)
        if array.kind == MATRIX:
            at = literal(ast.unparse(node.slice))
            i, j = at if isinstance(at, tuple) else (0, at)
            return Value(FLOAT, array.entries[i][j])
        if array.kind == SIMULATED:
            row = int(literal(ast.unparse(node.slice))) * int(array.length)
            at = self.let(f"add i64 {row}, {self.here}")
            where = self.let(f"getelementptr double, ptr {array.text}, i64 {at}")
            return Value(FLOAT, self.load(where))
        if array.kind == PLANE and not isinstance(node.slice, ast.Tuple):
            first = self.value(node.slice)
            offset = self.let(f"mul i64 {first.text}, {array.length}")
            at = self.let(f"getelementptr double, ptr {array.text}, i64 {offset}")
            return Value(ROW, at, array.length)
        if array.kind == FLAG_ROW:
            at = self.let(f"getelementptr i8, ptr {array.text}, i64 {self.value(node.slice).text}")
            return Value(BOOLEAN, self.let(f"icmp ne i8 {self.let(f'load i8, ptr {at}')}, 0"))
        return Value(FLOAT, self.load(self.element(node)))

    def element(self, node: ast.expr) -> str:
        """Address of an element."""
        if not isinstance(node, ast.Subscript):
            raise self.unknown(node)
        array = self.value(node.value)
        if isinstance(node.slice, ast.Tuple) and array.kind == PLANE:
            first, second = (self.value(e) for e in node.slice.elts)
            offset = self.let(f"mul i64 {first.text}, {array.length}")
            index = self.let(f"add i64 {offset}, {second.text}")
        elif array.kind == ROW:
            index = self.value(node.slice).text
        else:
            raise self.unknown(node)
        return self.let(f"getelementptr double, ptr {array.text}, i64 {index}")

    def _call(self, node: ast.Call) -> Value:
        if not isinstance(node.func, ast.Name) or node.keywords:
            raise self.unknown(node)
        name = node.func.id
        if name in MATRIX_OPS:
            return self._matrix(name, node)
        values = [self.value(a) for a in node.args]
        if name in ("max", "min") and all(v.kind == INTEGER for v in values):
            a, b = values
            test = self.let(f"icmp {'sgt' if name == 'max' else 'slt'} i64 {a.text}, {b.text}")
            return Value(INTEGER, self.let(f"select i1 {test}, i64 {a.text}, i64 {b.text}"))
        if name == "abs":
            return Value(
                FLOAT, self.let(f"call double @llvm.fabs.f64(double {self.float(values[0])})")
            )
        stream = values and values[0].kind == STREAM
        numbers = [f"double {self.float(v)}" for v in (values[1:] if stream else values)]
        self.calls.add((name, len(numbers), bool(stream)))
        if stream:
            numbers = [f"ptr {values[0].text}", f"i64 {values[0].length}", *numbers]
        given, several = ", ".join(numbers), outputs_of(name)
        if several == 1:
            return Value(FLOAT, self.let(f"call double @lib_{name}({given})"))
        kind = f"[{several} x double]"
        made = self.let(f"call {kind} @lib_{name}({given})")
        parts = [self.let(f"extractvalue {kind} {made}, {k}") for k in range(several)]
        return Value(MATRIX, "", entries=(tuple(parts),))

    def _matrix(self, name: str, node: ast.Call) -> Value:
        """An operation on a matrix, whose entries stand in a tuple, row by row."""
        given, size = node.args
        if not isinstance(given, ast.Tuple) or not isinstance(size, ast.Constant):
            raise self.unknown(node)
        n = int(str(size.value))
        if n > matrices.LARGEST[name]:
            raise self.unknown(node)
        numbers = [self.float(self.value(e)) for e in given.elts]
        rows = [numbers[n * i : n * (i + 1)] for i in range(n)]
        if name == "logdet":
            return Value(FLOAT, matrices.logdet(self.let, rows, self._log))
        if name == "det":
            return Value(FLOAT, matrices.det(self.let, rows))
        made = {"cholesky": matrices.cholesky, "inverse": matrices.inverse}[name](self.let, rows)
        return Value(MATRIX, "", entries=tuple(map(tuple, made)))

    def _log(self, number: str) -> str:
        self.calls.add(("log", 1, False))
        return self.let(f"call double @lib_log(double {number})")

    # -- small things
    def float(self, v: Value) -> str:
        """A number, whole or a condition as a double."""
        if v.kind == FLOAT:
            return v.text
        if v.kind == INTEGER:
            return self.let(f"sitofp i64 {v.text} to double")
        if v.kind == BOOLEAN:
            return self.let(f"uitofp i1 {v.text} to double")
        raise Untranslatable(f"{self.name}: an array where a number belongs", fix="")

    def truth(self, v: Value) -> str:
        """A number as a condition: whether it is not 0."""
        if v.kind == BOOLEAN:
            return v.text
        return self.let(f"fcmp une double {self.float(v)}, 0.0")

    def word(self, k: int) -> str:
        """The k-th word that the function is given."""
        at = self.let(f"getelementptr i64, ptr %words, i64 {k}")
        return self.let(f"load i64, ptr {at}")

    def load(self, where: str) -> str:
        return self.let(f"load double, ptr {where}{self._group}")

    def store(self, value: str, where: str) -> None:
        self.lines.append(f"store double {value}, ptr {where}{self._group}")

    @property
    def _group(self) -> str:
        return ", !llvm.access.group !GROUP" if self.in_loop and not self.over_steps else ""

    def let(self, text: str) -> str:
        """A new name for what an instruction gives."""
        self.count += 1
        self.lines.append(f"%v{self.count} = {text}")
        return f"%v{self.count}"

    def unknown(self, node: ast.AST) -> Untranslatable:
        return Untranslatable(f"{self.name}: {ast.unparse(node)[:80]}", fix="")


def number(value: float) -> Value:
    """A double by its bits, which every LLVM reads the same."""
    (bits,) = struct.unpack("<Q", struct.pack("<d", value))
    return Value(FLOAT, f"0x{bits:016X}")
