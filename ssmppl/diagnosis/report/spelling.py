"""Expressions as lines of a model file: `Lines` turns nodes into text and local variables.

What it writes gives the same nodes when it is traced: operands keep their order and grouping.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from keyword import iskeyword
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import BOOLEAN, MATRIX_OPS, Expr, topological
from ssmppl.expressions.operations import (
    MATRICES,
    OPERATIONS,
    WRITTEN,
    Level,
    Phrase,
    Text,
    call,
    within,
)

WIDTH = 73  # of one expression, which may stand behind `concentration=` of a law in a law

_OF_SUMS = (Level.SUM, Level.SUM)  # and of what binds more tightly
PHRASES: dict[str, Phrase] = {
    **{n: call(o.numpy, o.operands) for n, o in OPERATIONS.items() if o.numpy},
    **{n: WRITTEN[n] for n in ("add", "sub", "mul", "div", "mod", "pow")},
    **{n: WRITTEN[n]._replace(operands=_OF_SUMS) for n in ("lt", "le", "eq", "ne")},
    "and": Phrase("{0} & {1}", Level.BIT_AND, _OF_SUMS),
    "or": Phrase("{0} | {1}", Level.BIT_OR, _OF_SUMS),
    "not": call("~", 1),
    "neg": Phrase("-{0}", Level.SIGN, (Level.POWER,)),
}


def number(value: float) -> str:
    """A number as Python reads it back, whole ones without a point."""
    if not math.isfinite(value):
        return {"inf": "np.inf", "-inf": "-np.inf"}.get(str(value), "np.nan")
    whole = value.is_integer() and abs(value) < 1e15 and not (value == 0 and str(value)[0] == "-")
    return str(int(value)) if whole else repr(value)


def constant_array(values: np.ndarray) -> str:
    """An array of numbers."""
    if not np.any(values):
        return f"np.zeros({_shape(values.shape)})"
    if values.ndim == 2 and np.array_equal(values, np.eye(len(values))):
        return f"np.eye({len(values)})"
    if values.size > 1 and np.all(values == values.flat[0]):
        return f"np.full({_shape(values.shape)}, {_real(values.flat[0])})"
    return f"np.array({_nested(values)})"


def _shape(shape: tuple[int, ...]) -> str:
    return str(shape[0]) if len(shape) == 1 else str(shape)


def _real(value: float) -> str:
    text = number(float(value))
    return text + ".0" if text.lstrip("-").isdigit() else text


def _nested(values: np.ndarray) -> str:
    if values.ndim == 0:
        return _real(float(values))
    return "[" + ", ".join(_nested(v) for v in values) + "]"


class Lines:
    """The body of one distribution: statements, and texts of expressions that refer to them.

    Parameters
    ----------
    roots : all expressions of the distribution; what occurs several times under them is written
        once.
    quantities : name -> its symbols, of its shape, for arrays that are a whole quantity.
    taken : names that local variables must not have.
    marks : node -> (name of a local variable, comment), for what stands on a line of its own.
    wishes : node -> the name of its local variable, where it needs one.
    primitive : (node of a call) -> the name it is called by.
    """

    def __init__(
        self,
        roots: Iterable[Expr],
        quantities: dict[str, Any],
        taken: Iterable[str],
        marks: dict[Expr, tuple[str, str]] | None = None,
        wishes: dict[Expr, str] | None = None,
        primitive: Callable[[Expr], str] | None = None,
    ):
        self.statements: list[str] = []
        self.special = False  # whether scipy.special is needed
        self._texts: dict[Expr, Text] = {}
        self._taken = set(taken)
        self._whole = {_key(np.shape(v), np.asarray(v, dtype=object).ravel()): n
                       for n, v in quantities.items() if np.shape(v)}  # fmt: skip
        self._primitive = primitive
        roots = list(roots)
        order = topological(roots)
        uses = Counter(a for n in order for a in n.args)
        self._apart, self._wishes = marks or {}, wishes or {}
        self._shared = {n for n in order if uses[n] + sum(r is n for r in roots) > 1 and _worth(n)}
        self._shared -= {r for r in roots if not uses[r] and self._is_short(r)}

    @staticmethod
    def _is_short(node: Expr) -> bool:
        return len(topological([node])) <= 4

    # -- scalars
    def text(self, root: Expr) -> str:
        """The text of an expression."""
        for node in topological([root]):
            if node not in self._texts:
                self._texts[node] = self._write(node)
        return self._texts[root][0]

    def _write(self, node: Expr) -> Text:
        if node.op == "symbol":
            _, name, index = node.data
            return f"{name}[{', '.join(map(str, index))}]" if index else name, Level.ATOM
        if node.op == "const":
            negative = node.data < 0 or str(node.data)[0] == "-"
            return number(node.data), Level.SIGN if negative else Level.ATOM
        if node.op == "loop":
            return self._loop(node)
        made = self._combined(node)
        while len(made[0]) > WIDTH and self._split(node):
            made = self._combined(node)
        if node in self._apart:
            return self._local(node, made[0], *self._apart[node])
        if node in self._shared or node.op in ("cholesky", "inverse", "simulator"):
            return self._local(node, made[0])
        return made

    def _combined(self, node: Expr) -> Text:
        parts = [self._texts[a] for a in node.args]
        if node.op == "neg" and parts[0][1] == Level.PRODUCT and _product(node.args[0], self):
            return f"-{parts[0][0]}", Level.SIGN
        if node.op in PHRASES:
            return self._phrase(node, parts)
        if node.op == "item" and node.args[0].op == "simulator":
            name = node.args[0].data.function.results[node.data[0]]
            return f"{parts[0][0]}[{name!r}]".replace("'", '"'), Level.ATOM
        if node.op == "simulator" and self._primitive is not None:
            return f"{self._primitive(node)}({_vectors(node, parts)})", Level.ATOM
        if node.op == "item":
            return f"{parts[0][0]}[{', '.join(map(str, node.data))}]", Level.ATOM
        if node.op in MATRIX_OPS:
            matrix = np.array(node.args, dtype=object).reshape(node.data, node.data)
            return MATRICES[node.op][0].format(self.array(matrix)), Level.ATOM
        if node.op == "call" and self._primitive is not None:
            return f"{self._primitive(node)}({', '.join(text for text, _ in parts)})", Level.ATOM
        raise ArgumentError(
            f"the model holds {node!r}, whose operation {node.op!r} has no spelling in Python",
            fix="use what NumPy and scipy.special offer in the model's distributions",
        )

    def _loop(self, node: Expr) -> Text:
        """A function of what moves, in the distribution's body, and its repetition."""
        loop = node.data
        first, held = node.args[: loop.states], node.args[loop.states : -1]
        for a in held:  # numbers of the law, which the function reads
            if a.args and not self._texts[a][0].isidentifier():
                self._texts[a] = self._local(a, self._texts[a][0])
        word = "".join(c if c.isalnum() else "_" for c in loop.name)
        usable = word.isidentifier() and not iskeyword(word)
        function, moving = self.name(word if usable else "step"), self.name("z")
        inner = Lines(loop.update, {}, self._taken, primitive=self._primitive)
        inner._texts = {s: (f"{moving}[{k}]", Level.ATOM) for k, s in enumerate(loop.moving)}
        inner._texts |= {s: self._texts[a] for s, a in zip(loop.held, held, strict=True)}
        new = _listed("np.stack", [inner.text(e) for e in loop.update])
        self.special |= inner.special
        body = "\n".join([*inner.statements, f"return {new}"])
        indented = body.replace("\n", "\n    ")
        self.statements.append(f"def {function}({moving}):\n    {indented}")
        begin = _listed("np.stack", [self.text(e) for e in first])
        times = self.text(node.args[-1])
        return self._local(
            node, f"ssm.repeat({function}, {begin}, {times}, linear=False)", f"{word}_end"
            if usable else "end",
        )  # fmt: skip

    def _phrase(self, node: Expr, parts: list[Text]) -> Text:
        phrase, first = PHRASES[node.op], node.args[0]
        if node.op in ("eq", "ne") and first.op == "const":  # Python would turn it round
            phrase = call(OPERATIONS[node.op].numpy, 2)
        if phrase.level == Level.PRODUCT and first.op == "neg":  # -a * b is traced as -(a * b)
            phrase = phrase._replace(operands=(Level.POWER, phrase.operands[1]))
        self.special |= phrase.template.startswith("special.")
        return phrase.of(parts)

    # -- local variables
    def _split(self, node: Expr) -> bool:
        """Make a local variable of the longest argument; whether there was one to make."""
        able = [a for a in node.args if a.args and not self._texts[a][0].isidentifier()]
        able = [a for a in able if len(self._texts[a][0]) > 12]
        if not able:
            return False
        longest = max(able, key=lambda a: len(self._texts[a][0]))
        self._texts[longest] = self._local(longest, self._texts[longest][0])
        return True

    def _local(self, node: Expr, text: str, name: str = "", comment: str = "") -> Text:
        name = self.name(name or self._wishes.get(node) or _name(node))
        self.statements += [f"# {comment}"] if comment else []
        line = f"{name} = {text}"
        self.statements.append(line if len(line) <= WIDTH + 14 else f"{name} = (\n    {text}\n)")
        return name, Level.ATOM

    def name(self, wish: str) -> str:
        """A name for a local variable that nothing else has."""
        name, k = wish, 1
        while name in self._taken:
            k += 1
            name = f"{wish}_{k}"
        self._taken.add(name)
        return name

    # -- arrays
    def array(self, values: Any, scalar: bool = False) -> str:
        """The text of an array of nodes; scalar: one node will do where all are the same."""
        values = array(values)
        nodes = list(values.ravel())
        whole = self._whole.get(_key(values.shape, nodes))
        if values.ndim == 0 or (scalar and all(n is nodes[0] for n in nodes)):
            return self.text(nodes[0])
        if whole is not None:
            return whole
        if all(n.op == "const" for n in nodes):
            numbers = np.array([n.data for n in nodes]).reshape(values.shape)
            text = constant_array(numbers)
            if values.ndim == 2 and len(text) > WIDTH:
                rows = [f"[{', '.join(map(number, row))}]" for row in numbers.tolist()]
                return _listed("np.array", rows)
            return text
        alike = all(n is nodes[0] for n in nodes)  # whose text would be that of a scalar
        vectorised = None if alike else self._elementwise(values)
        if vectorised is not None and len(vectorised[0]) <= WIDTH:
            return vectorised[0]
        if values.ndim == 2:
            rows = ["[" + ", ".join(self._short(row)) + "]" for row in values]
            return _listed("np.block", rows)
        return _listed("np.stack", [self.array(v) for v in values])

    def _short(self, nodes: Any) -> list[str]:
        """Texts of the entries of a row, with local variables until they fit on a line."""
        texts = [self.text(n) for n in nodes]
        while sum(map(len, texts)) + 2 * len(texts) > WIDTH - 4:
            node = max((n for n in nodes if n.args), key=lambda n: len(self._texts[n][0]))
            if self._texts[node][0].isidentifier():
                break
            self._texts[node] = self._local(node, self._texts[node][0])
            texts = [self._texts[n][0] for n in nodes]
        return texts

    def _elementwise(self, values: Any) -> Text | None:
        """The text of an array whose elements are made alike: `A @ x + b * u`; None where not."""
        flat = list(values.ravel())
        if any(n in self._apart for n in flat):
            return None
        if all(n is flat[0] for n in flat):
            self.text(flat[0])
            return self._texts[flat[0]]
        whole = self._whole.get(_key(values.shape, flat))
        if whole is not None:
            return whole, Level.ATOM
        product = self._product(values)
        if product is not None:
            return product, Level.PRODUCT
        first = flat[0]
        alike = all(n.op == first.op for n in flat) and first.op in PHRASES
        if not alike or first.op in ("eq", "ne", "not"):
            return None
        parts = []
        for k in range(len(first.args)):
            part = self._elementwise(_reshaped([n.args[k] for n in flat], values.shape))
            if part is None:
                return None
            parts.append(part)
        if first.op == "neg":
            return f"-{within(parts[0], Level.ATOM)}", Level.SIGN
        return self._phrase(first, parts)

    def _product(self, values: Any) -> str | None:
        """A @ x, for a matrix and a vector that are quantities of the model."""
        if values.ndim != 1:
            return None
        columns: list[list[tuple[Expr, Expr]]] = []
        for node in values:
            terms = []
            while node.op == "add":
                terms.append(node.args[1])
                node = node.args[0]
            terms.append(node)
            if any(t.op != "mul" for t in terms):
                return None
            columns.append([(t.args[0], t.args[1]) for t in reversed(terms)])
        vector = [b for _, b in columns[0]]
        if len(vector) < 2 or any(
            list(map(id, (b for _, b in row))) != list(map(id, vector)) for row in columns
        ):
            return None
        factors = [a for row in columns for a, _ in row]
        matrix = self._whole.get(_key((len(columns), len(vector)), factors))
        right = self._whole.get(_key((len(vector),), vector))
        return f"{matrix} @ {right}" if matrix and right else None


def _key(shape: tuple[int, ...], nodes: Iterable[Expr]) -> tuple:
    """What an array is known by: a vector of the same nodes is no matrix."""
    return shape, *map(id, nodes)


def _reshaped(nodes: Sequence[Expr], shape: tuple[int, ...]) -> Any:
    out = np.empty(len(nodes), dtype=object)
    out[:] = nodes
    return array(out.reshape(shape))


def _listed(function: str, texts: Sequence[str]) -> str:
    """function([...]), on one line, which may stand behind the name of an argument, or with a line
    for each element."""
    line = f"{function}([{', '.join(texts)}])"
    if len(line) <= WIDTH - 8 and "\n" not in line:
        return line
    inside = "".join(f"        {t},\n".replace("\n", "\n" + " " * 8, t.count("\n")) for t in texts)
    return f"{function}(\n    [\n{inside}    ]\n)"


def _product(node: Expr, lines: Lines) -> bool:
    """Whether -a * b, for this product a * b, is traced as -(a * b) again."""
    while node.op == "mul" and lines._texts[node][1] == Level.PRODUCT:
        node = node.args[0]
    return node.op not in ("div", "mod", "const") or lines._texts[node][1] == Level.ATOM


def _worth(node: Expr) -> bool:
    """Whether a node that is used again is worth a name."""
    if node.op in ("const", "symbol", "item", "neg"):
        return False
    inner = [a for a in node.args if a.args]
    plain = node.op in ("add", "sub", "mul", "div", "pow", "lt", "le", "eq", "ne")
    return bool(inner) or not plain


def _name(node: Expr) -> str:
    """What a node might be called: `sqrt_h1`, `term`."""
    if node.op in ("cholesky", "inverse"):
        return {"cholesky": "root", "inverse": "inverse"}[node.op]
    if len(node.args) == 1 and node.args[0].op == "symbol":
        _, name, index = node.args[0].data
        return "_".join([node.op, name, *map(str, index)])
    if node.op in BOOLEAN:
        return "holds"
    return {"where": "chosen", "add": "total", "sub": "total", "mul": "product",
            "div": "ratio"}.get(node.op, "term")  # fmt: skip


def _vectors(node: Expr, parts: list[Text]) -> str:
    """The arguments of a simulator: states, inputs and parameters, each a list."""
    texts, out, at = [text for text, _ in parts], [], 0
    for size in node.data.function.sizes:
        out.append(f"[{', '.join(texts[at : at + size])}]")
        at += size
    return ", ".join(out)
