"""Expressions -> the statements of generated code.

`Writer` turns expressions into straight-line statements as a person would write them: a
subexpression that is used more than once gets a name, one that is used once stands where it is
used, and each statement ends in the user's file and line.
"""

from __future__ import annotations

import builtins
import keyword
import os
from collections.abc import Callable, Iterable, Mapping

from ssmppl.codegen.text.callbacks import request
from ssmppl.errors import Location
from ssmppl.expressions.batched.call import OP, groups
from ssmppl.expressions.expr import MATRIX_OPS, Expr, is_tuple, symbol_text, to_text, topological
from ssmppl.expressions.operations import KERNELS, OPERATIONS, WRITTEN, Level, Text, call, within

PHRASES = WRITTEN | {
    n: call(o.kernel.split(".")[-1], o.operands) for n, o in OPERATIONS.items() if o.kernel
}
_OWN_NAMES = """theta c s i n t y_data seen_data u_data states states_prev normals uniforms rng
    log_w out inf nan steps free z reference look trajectory total entry kernel np prev noise
    kept"""
RESERVED = frozenset([*KERNELS, *keyword.kwlist, *dir(builtins), *_OWN_NAMES.split()])
MAX_INLINE = 60  # characters; a longer single-use subexpression gets a line of its own


class Names:
    """Local names of one function: the user's where they are free, else with an underscore."""

    def __init__(self, taken: Iterable[str] = ()):
        self.taken = set(RESERVED) | set(taken)

    def fresh(self, wanted: str) -> str:
        """A name that is not taken yet, as wanted but for underscores; taken from now on."""
        name = identifier(wanted)
        while name in self.taken:
            name += "_"
        self.taken.add(name)
        return name


def identifier(text: str) -> str:
    """`beta[0, 1]` -> `beta_0_1`."""
    return "".join(ch if ch.isalnum() or ch == "_" else "_" for ch in text).strip("_") or "v"


def symbol_name(node: Expr) -> str:
    """The local name that a symbol would like to have."""
    kind, name, index = node.data
    text = symbol_text(node)
    return identifier(f"seen_{name}" + "".join(f"_{i}" for i in index) if kind == "seen" else text)


class Writer:
    """Writes the statements that compute expressions from already named nodes.

    names : node -> the text that stands for it (a local name, an array element).
    fresh : makes unused local names.
    locations : node -> where the user wrote it.
    """

    def __init__(
        self,
        names: Mapping[Expr, str],
        fresh: Names,
        locations: Mapping[Expr, Location],
        indent: str = "    ",
    ):
        self.text: dict[Expr, Text] = {n: (t, Level.ATOM) for n, t in names.items()}
        self.fresh, self.locations, self.indent = fresh, locations, indent
        self.lines: list[str] = []
        self.counter = self.loops = 0

    def assign(self, targets: list[tuple[str, Expr]], operator: str = "=") -> None:
        """Append the statements `target = expression` for all targets."""
        roots = [e for _, e in targets]
        uses, finals = _uses(roots, self.text), set(roots)
        order = topological(roots, until=self.text)
        together = groups(n for n in order if n not in self.text)
        for node in order:
            if node in self.text or node.op == "const":
                continue
            if node.op == "symbol":
                raise KeyError(f"symbol {node!r} of kind {node.data[0]} has no name here")
            if node.op == "loop":
                self._loop(node)
                continue
            if node.op == OP:
                self._simulated(together[node])
                continue
            written = self._written(node)
            named = uses.get(node, 0) > 1 or len(written[0]) > MAX_INLINE
            if _must_be_named(node) or (named and node not in finals):
                name = self._name(node)
                self._line(f"{name} = {written[0]}", node)
                written = name, Level.ATOM
            self.text[node] = written
        for target, root in targets:
            self._line(f"{target} {operator} {self.get(root)}", root)

    def get(self, node: Expr) -> str:
        """Text of a node that has been written."""
        return self._part(node)[0]

    def _loop(self, node: Expr) -> None:
        """The statements of a loop; what is taken from it are the names of its numbers."""
        loop, name = node.data, self.fresh.fresh(f"{identifier(node.data.name)}_{self.loops}")
        self.loops += 1
        moving = [self.fresh.fresh(f"{name}_{i}") for i in range(loop.states)]
        for own, first in zip(moving, node.args, strict=False):
            begin = within(self._part(first), Level.PRODUCT)
            self._line(f"{own} = 0.0 + {begin}", node)  # a float, whatever it was
        names = dict(zip(loop.moving, moving, strict=True))
        for symbol, outer in zip(loop.held, node.args[loop.states : -1], strict=True):
            text, level = self._part(outer)
            if level != Level.ATOM:
                text, own = self.fresh.fresh(f"{name}_a{symbol.data[2][0]}"), text
                self._line(f"{text} = {own}", outer)
            names[symbol] = text
        inner = Writer(names, self.fresh, self.locations, self.indent + "    ")
        inner.loops = self.loops
        new = [self.fresh.fresh(f"{own}n") for own in moving]
        inner.assign(list(zip(new, loop.update, strict=True)))
        self.loops = inner.loops
        self._line(f"for {self.fresh.fresh('k')} in range({self._times(node)}):", node)
        self.lines += inner.lines
        for own, other in zip(moving, new, strict=True):
            self.lines.append(f"{self.indent}    {own} = {other}")
        for i, own in enumerate(moving):
            self.text[Expr("item", (node,), (i,))] = own, Level.ATOM

    def _simulated(self, group: tuple[Expr, ...]) -> None:
        """The call of a simulator, for all that is wanted of it at the same arguments."""
        function, args = group[0].data.function, group[0].args
        own = request(function, [n.data.index for n in group])
        name = self.fresh.fresh(f"{identifier(function.title)}_{self.loops}")
        self.loops += 1
        given = ", ".join(self._part(a)[0] for a in args)
        self._line(f"{name} = {own.name}({given})", group[0])
        for k, node in enumerate(group):
            self.text[node] = name, Level.ATOM
            for i in range(function.outputs):
                place = k * function.outputs + i
                self.text[Expr("item", (node,), (i,))] = f"{name}[{place}]", Level.ATOM

    def _times(self, node: Expr) -> str:
        """How often, as a whole number."""
        times = node.args[-1]
        if times.op == "const":
            return str(int(times.data))
        return f"whole({self._part(times)[0]})"

    def _name(self, node: Expr) -> str:
        if node.op == "random":
            kind, (owner, count) = node.data
            return self.fresh.fresh(f"{kind}_{owner}_{count}")
        if node.op in MATRIX_OPS:
            return self.fresh.fresh(node.op + "_")
        if is_tuple(node):
            return self.fresh.fresh(f"{identifier(node.data.__name__)}_")
        self.counter += 1
        return self.fresh.fresh(f"v{self.counter}")

    def _line(self, statement: str, node: Expr) -> None:
        where = self.locations.get(node)
        line = f"{self.indent}{statement}"
        if where is not None:
            line = f"{line:<72}  # {os.path.basename(where.file)}:{where.line}"
        self.lines.append(line)

    def _part(self, node: Expr) -> Text:
        if node.op == "const":
            return number_text(node.data), Level.SIGN if node.data < 0 else Level.ATOM
        return self.text[node]

    def _written(self, node: Expr) -> Text:
        op, parts = node.op, [self._part(a) for a in node.args]
        if op == "pow" and is_small_power(node):
            power = int(node.args[1].data)
            product = " * ".join([within(parts[0], Level.ATOM)] * abs(power))
            return product if power > 0 else f"1.0 / ({product})", Level.PRODUCT
        if op in PHRASES:
            return PHRASES[op].of(parts)
        inside = ", ".join(text for text, _ in parts)
        if op == "item":
            return f"{inside}[{', '.join(map(str, node.data))}]", Level.ATOM
        if op in MATRIX_OPS:
            return f"{op}(({inside},), {node.data})", Level.ATOM
        if op == "random":
            return f"{node.data[0]}(rng{', ' if parts else ''}{inside})", Level.ATOM
        return f"{node.data.name}({inside})", Level.ATOM  # a primitive


def is_small_power(node: Expr) -> bool:
    """Whether a power is written as a product."""
    e = node.args[1]
    return e.op == "const" and e.data.is_integer() and 1 <= abs(e.data) <= 4


def _must_be_named(node: Expr) -> bool:
    """Draws happen once; a matrix is factorised once, several numbers are computed at once."""
    return node.op == "random" or node.op in ("cholesky", "inverse") or is_tuple(node)


def _uses(roots: list[Expr], named: Mapping[Expr, object]) -> dict[Expr, int]:
    """How often each unnamed node stands in the text; the base of a small power counts twice."""
    uses: dict[Expr, int] = {}
    for r in roots:
        uses[r] = uses.get(r, 0) + 1
    for node in topological(roots, until=named):
        if node in named:
            continue
        for a in node.args:
            uses[a] = uses.get(a, 0) + 1
        if node.op == "pow" and is_small_power(node):
            uses[node.args[0]] += 1
    return uses


def number_text(value: float) -> str:
    """A number as Python text that reads back to the same bits."""
    if value != value:
        return "nan"
    if value in (float("inf"), float("-inf")):
        return "inf" if value > 0 else "-inf"
    return repr(float(value))


class Comments:
    """Expressions in the user's words, cut to margin comments; what many share is written once."""

    def __init__(self, width: int = 60):
        self.width = width
        self._done: dict[Expr, Text] = {}

    def of(self, node: Expr) -> str:
        text = to_text(node, 4 * self.width, self._done)
        return text if len(text) <= self.width else text[: self.width - 3] + "..."


def depends(nodes: Iterable[Expr], level_of: Callable[[Expr], int]) -> dict[Expr, int]:
    """Binding time of every node: the latest among its symbols (see `module.LEVELS`)."""
    level: dict[Expr, int] = {}
    for node in topological(nodes):
        if node.args:
            level[node] = max(level[a] for a in node.args)
        else:
            level[node] = 0
        if node.op in ("symbol", "random"):
            level[node] = max(level[node], level_of(node))
    return level
