"""Expressions as a person writes them."""

from __future__ import annotations

import hashlib
import math

from ssmppl.expressions.graph import topological
from ssmppl.expressions.node import MATRIX_OPS, Expr, behaviour

_INFIX = {"add": ("+", 1), "sub": ("-", 1), "mul": ("*", 2), "div": ("/", 2), "pow": ("**", 4)}
_INFIX |= {"lt": ("<", 0), "le": ("<=", 0), "eq": ("==", 0), "ne": ("!=", 0), "mod": ("%", 2)}
LONGEST = 10_000


def symbol_text(node: Expr) -> str:
    """The name of a symbol as a person writes it: `x`, `x_prev`, `beta[2]`; `measured(y[0])` of
    what is 1 where y[0] is in the data."""
    kind, name, index = node.data
    suffix = "_prev" if kind.endswith("_prev") else ""
    text = name + suffix + (f"[{', '.join(map(str, index))}]" if index else "")
    return f"measured({text})" if kind.startswith("seen") else text


def _matrix_name(node: Expr) -> str | None:
    """The name of the parameter, or the text of the inverse, that a matrix node is made of."""
    n, first = node.data, node.args[0]
    cells = [(i, j) for i in range(n) for j in range(n)]
    if first.op == "symbol":
        kind, name, _ = first.data
        for whole in (cells, [(max(c), min(c)) for c in cells]):  # any matrix; a symmetric one
            if all(
                a.op == "symbol" and a.data == (kind, name, c)
                for a, c in zip(node.args, whole, strict=True)
            ):
                return symbol_text(first).partition("[")[0]
    if first.op == "item" and first.args[0].data == n:
        source = first.args[0]
        if all(
            a.op == "item" and a.args[0] is source and a.data == c
            for a, c in zip(node.args, cells, strict=True)
        ):
            return to_text(source)
    return None


def _bare(a: Expr) -> Expr:
    """a of where(0 <= a, a, nan): what the densities of laws put in place of their a."""
    if a.op == "where" and a.args[2].op == "const" and math.isnan(a.args[2].data):
        return a.args[1] if a.args[0] is behaviour["apply"]("le", 0.0, a.args[1]) else a
    return a


def to_text(root: Expr, longest: int = LONGEST) -> str:
    """The expression as a person writes it.

    Written out, an expression that shares its parts can be exponentially longer than its graph:
    what has more than `longest` characters is cut, with a mark that differs where the rest does.
    """
    if root.op == "symbol":
        return symbol_text(root)
    done: dict[Expr, tuple[str, int]] = {}
    for node in topological([root]):
        parts = [done[a] for a in node.args]
        if node.op == "const":
            done[node] = (f"{node.data:.10g}", 9 if node.data >= 0 else 1)
        elif node.op == "symbol":
            done[node] = (symbol_text(node), 9)
        elif node.op in _INFIX:
            sign, level = _INFIX[node.op]
            (a, la), (b, lb) = parts
            chained = node.op == "pow" or level == 0  # in Python a < b == c is another thing
            left = f"({a})" if la < level or (chained and la == level) else a
            tight = sign not in "+*" or node.args[1].op == "mod"
            right = f"({b})" if lb < level or (lb == level and tight) else b
            done[node] = (f"{left}{sign}{right}" if level > 1 else f"{left} {sign} {right}", level)
        elif node.op == "neg":
            a, level = parts[0]
            done[node] = (f"-({a})" if level < 2 else f"-{a}", 1)
        elif node.op in MATRIX_OPS:
            name = _matrix_name(node)
            inside = ", ".join(p[0] for p in parts) if name is None else name
            done[node] = (f"{node.op}({inside})", 9)
        elif node.op == "item":
            done[node] = (f"{parts[0][0]}[{node.data[0]}, {node.data[1]}]", 9)
        elif node.op == "gammaln":
            done[node] = (f"gammaln({done[_bare(node.args[0])][0]})", 9)
        elif node.op in ("gammaln_rise", "digamma_rise"):
            name, (a, b) = node.op.removesuffix("_rise"), (p[0] for p in parts)
            done[node] = (f"{name}({a} + {b}) - {name}({a})", 1)
        else:
            name = node.data[0] if node.op == "random" else node.op
            done[node] = (f"{name}({', '.join(p[0] for p in parts)})", 9)
        text, level = done[node]
        if len(text) > longest:
            mark = hashlib.sha256(text.encode()).hexdigest()[:8]
            done[node] = (f"{text[:longest]}...{mark}", level)
    return done[root][0]


behaviour["text"] = to_text
