"""Expr -> Python text: the only table of spellings.

`Writer` turns expressions into straight-line statements as a person would write them: a
subexpression that is used more than once gets a name, one that is used once stands where it is
used, and each statement ends in the user's file and line.
"""

from __future__ import annotations

import builtins
import keyword
import os
from collections.abc import Callable, Iterable, Mapping

from ssmppl.errors import Location
from ssmppl.expressions.expr import MATRIX_OPS, Expr, symbol_text, to_text, topological

# Precedence of Python's operators, to set parentheses only where they are needed.
_TERNARY, _OR, _AND, _NOT, _COMPARE, _SUM, _PRODUCT, _SIGN, _ATOM = range(9)
INFIX = {
    "add": ("+", _SUM), "sub": ("-", _SUM), "mul": ("*", _PRODUCT), "div": ("/", _PRODUCT),
    "mod": ("%", _PRODUCT), "lt": ("<", _COMPARE), "le": ("<=", _COMPARE),
    "eq": ("==", _COMPARE), "ne": ("!=", _COMPARE), "and": ("and", _AND), "or": ("or", _OR),
}  # fmt: skip
# Operation -> function of the kernels' modules (see `program.HEADER` for the imports).
CALLS = {
    "exp": "exp", "log": "log", "log1p": "log1p", "expm1": "expm1", "sqrt": "sqrt", "sin": "sin",
    "cos": "cos", "tan": "tan", "arcsin": "arcsin", "arccos": "arccos", "arctan": "arctan",
    "sinh": "sinh", "cosh": "cosh", "tanh": "tanh", "arcsinh": "arcsinh", "arccosh": "arccosh",
    "arctanh": "arctanh", "abs": "abs", "sign": "sign", "floor": "floor", "ceil": "ceil",
    "gammaln": "lgamma", "digamma": "digamma", "trigamma": "trigamma", "ndtr": "ndtr",
    "gammaln_rise": "gammaln_rise", "digamma_rise": "digamma_rise", "betaln": "betaln",
    "log_ndtr": "log_ndtr", "ndtri": "ndtri", "erf": "erf", "erfc": "erfc",
    "i0e": "i0e", "i1e": "i1e", "vonmises_cdf": "vonmises_cdf",
    "vonmises_quantile": "vonmises_quantile", "betabinomial_cdf": "betabinomial_cdf",
    "betabinomial_quantile": "betabinomial_quantile",
    "maximum": "maximum", "minimum": "minimum", "arctan2": "arctan2", "logaddexp": "logaddexp",
    "gammainc": "gammainc", "gammaincinv": "gammaincinv", "betainc": "betainc",
    "gammaincc": "gammaincc", "gammainccinv": "gammainccinv",
    "betaincc": "betaincc", "betainccinv": "betainccinv",
    "betaincinv": "betaincinv", "poisson_quantile": "poisson_quantile",
    "binomial_quantile": "binomial_quantile", "negbinomial_quantile": "negbinomial_quantile",
    "poisson_survival_quantile": "poisson_survival_quantile",
    "negbinomial_survival_quantile": "negbinomial_survival_quantile", "pow": "power",
}  # fmt: skip
MATRIX_CALLS = {"cholesky": "cholesky", "inverse": "inverse", "logdet": "logdet", "det": "det"}
# Scalar sources of randomness; normals and uniforms come from buffers filled in bulk.
DRAWS = {"normal": "normal", "uniform": "uniform", "gamma": "gamma", "poisson": "poisson",
         "binomial": "binomial", "vonmises": "vonmises", "gamma_by": "gamma_by"}  # fmt: skip
_OWN_NAMES = """theta c s i n t y_data seen_data u_data states states_prev normals uniforms rng
    log_w out inf nan reference look trajectory total entry kernel np prev noise kept"""
RESERVED = frozenset([
    *CALLS.values(), *MATRIX_CALLS.values(), *DRAWS.values(), *keyword.kwlist, *dir(builtins),
    *_OWN_NAMES.split(),
])  # fmt: skip
MAX_INLINE = 60  # characters; a longer single-use subexpression gets a line of its own


class Names:
    """Local names of one function: the user's where they are free, else with an underscore."""

    def __init__(self, taken: Iterable[str] = ()):
        self.taken = set(RESERVED) | set(taken)

    def fresh(self, wanted: str) -> str:
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
        self.text: dict[Expr, tuple[str, int]] = {n: (t, _ATOM) for n, t in names.items()}
        self.fresh, self.locations, self.indent = fresh, locations, indent
        self.lines: list[str] = []
        self.counter = 0

    def assign(self, targets: list[tuple[str, Expr]], operator: str = "=") -> None:
        """Append the statements `target = expression` for all targets."""
        roots = [e for _, e in targets]
        uses, finals = _uses(roots, self.text), set(roots)
        for node in topological_until(roots, self.text):
            if node in self.text or node.op == "const":
                continue
            if node.op == "symbol":
                raise KeyError(f"symbol {node!r} of kind {node.data[0]} has no name here")
            spelled = self._spell(node)
            named = uses.get(node, 0) > 1 or len(spelled[0]) > MAX_INLINE
            if _must_be_named(node) or (named and node not in finals):
                name = self._name(node)
                self._line(f"{name} = {spelled[0]}", node)
                spelled = (name, _ATOM)
            self.text[node] = spelled
        for target, root in targets:
            self._line(f"{target} {operator} {self.get(root)}", root)

    def get(self, node: Expr) -> str:
        """Text of a node that has been written."""
        return self._part(node, -1)

    def _name(self, node: Expr) -> str:
        if node.op == "random":
            kind, (owner, count) = node.data
            return self.fresh.fresh(f"{kind}_{owner}_{count}")
        if node.op in MATRIX_OPS:
            return self.fresh.fresh(node.op + "_")
        self.counter += 1
        return self.fresh.fresh(f"v{self.counter}")

    def _line(self, statement: str, node: Expr) -> None:
        where = self.locations.get(node)
        line = f"{self.indent}{statement}"
        if where is not None:
            line = f"{line:<72}  # {os.path.basename(where.file)}:{where.line}"
        self.lines.append(line)

    def _part(self, node: Expr, level: int) -> str:
        if node.op == "const":
            text, own = number_text(node.data), _SIGN if node.data < 0 else _ATOM
        else:
            text, own = self.text[node]
        return f"({text})" if own < level else text

    def _spell(self, node: Expr) -> tuple[str, int]:
        op, args = node.op, node.args
        if op in INFIX:
            sign, level = INFIX[op]
            left = self._part(args[0], level if level != _COMPARE else level + 1)
            # a + (b - c) keeps its parentheses: without them it rounds otherwise
            right = self._part(args[1], level + (level not in (_AND, _OR)))
            return f"{left} {sign} {right}", level
        if op == "neg":
            return f"-{self._part(args[0], _SIGN)}", _SIGN
        if op == "not":
            return f"not {self._part(args[0], _NOT)}", _NOT
        if op == "where":
            c, a, b = (self._part(x, _TERNARY + 1) for x in args)
            return f"{a} if {c} else {b}", _TERNARY
        if op == "pow" and is_small_power(node):
            power = int(node.args[1].data)
            product = " * ".join([self._part(args[0], _ATOM)] * abs(power))
            return (product, _PRODUCT) if power > 0 else (f"1.0 / ({product})", _PRODUCT)
        if op == "item":
            matrix = self._part(args[0], _ATOM)
            return f"{matrix}[{node.data[0]}, {node.data[1]}]", _ATOM
        parts = ", ".join(self._part(a, _TERNARY) for a in args)
        if op in MATRIX_OPS:
            return f"{MATRIX_CALLS[op]}(({parts},), {node.data})", _ATOM
        if op == "random":
            kind = DRAWS[node.data[0]]
            return f"{kind}(rng{', ' if parts else ''}{parts})", _ATOM
        if op == "call":
            return f"{node.data.name}({parts})", _ATOM
        return f"{CALLS[op]}({parts})", _ATOM


def is_small_power(node: Expr) -> bool:
    """Whether a power is written as a product."""
    e = node.args[1]
    return e.op == "const" and e.data.is_integer() and 1 <= abs(e.data) <= 4


def _must_be_named(node: Expr) -> bool:
    """Draws happen once; a matrix is factorised once."""
    return node.op == "random" or node.op in ("cholesky", "inverse")


def _uses(roots: list[Expr], named: Mapping[Expr, object]) -> dict[Expr, int]:
    """How often each unnamed node stands in the text; the base of a small power counts twice."""
    uses: dict[Expr, int] = {}
    for r in roots:
        uses[r] = uses.get(r, 0) + 1
    for node in topological_until(roots, named):
        if node in named:
            continue
        for a in node.args:
            uses[a] = uses.get(a, 0) + 1
        if node.op == "pow" and is_small_power(node):
            uses[node.args[0]] += 1
    return uses


def topological_until(roots: Iterable[Expr], named: Mapping[Expr, object]) -> list[Expr]:
    """Nodes under `roots`, arguments first, not looking below nodes that have a name already."""
    order: list[Expr] = []
    seen: set[Expr] = set()
    stack = [(r, False) for r in reversed(list(roots))]
    while stack:
        node, expanded = stack.pop()
        if expanded:
            order.append(node)
        elif node not in seen:
            seen.add(node)
            stack.append((node, True))
            if node not in named:
                stack.extend((a, False) for a in reversed(node.args) if a not in seen)
    return order


def number_text(value: float) -> str:
    """A number as Python text that reads back to the same bits."""
    if value != value:
        return "nan"
    if value in (float("inf"), float("-inf")):
        return "inf" if value > 0 else "-inf"
    return repr(float(value))


def comment(node: Expr, width: int = 60) -> str:
    """The expression in the user's words, cut to a margin comment."""
    text = to_text(node, longest=4 * width)
    return text if len(text) <= width else text[: width - 3] + "..."


def depends(nodes: Iterable[Expr], level_of: Callable[[Expr], int]) -> dict[Expr, int]:
    """Binding time of every node: the latest among its symbols (see `program.LEVELS`)."""
    level: dict[Expr, int] = {}
    for node in topological(nodes):
        if node.args:
            level[node] = max(level[a] for a in node.args)
        else:
            level[node] = 0
        if node.op in ("symbol", "random"):
            level[node] = max(level[node], level_of(node))
    return level


__all__ = ["Names", "Writer", "comment", "depends", "identifier", "symbol_name"]
