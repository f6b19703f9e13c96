"""Scalar expressions, for the rest of the project: every name of the modules below.

    provenance.py  where the user wrote a node
    node.py        Expr: one interned, immutable node type
    simplify.py    apply: an operation, simplified
    graph.py       walking the nodes under an expression: order, dependence, substitution
    text.py        how a person writes it

Import from here; the five modules are how it is made.
"""

from ssmppl.expressions.graph import (
    dependent,
    depends_on,
    pack,
    rebuilt,
    substitute,
    symbols_of,
    topological,
    unpack,
    unpack_one,
)
from ssmppl.expressions.node import (
    BINARY,
    BOOLEAN,
    INDEX_BY_SYMBOL,
    MATRIX_OPS,
    OPS,
    QUATERNARY,
    TERNARY,
    UNARY,
    Expr,
    as_expr,
    constant,
    item,
    matrix_op,
    symbol,
)
from ssmppl.expressions.provenance import attributed, recording, user_location
from ssmppl.expressions.simplify import apply, split_constant, without_exponentials
from ssmppl.expressions.text import symbol_text, to_text

__all__ = [
    "BINARY",
    "BOOLEAN",
    "INDEX_BY_SYMBOL",
    "MATRIX_OPS",
    "OPS",
    "QUATERNARY",
    "TERNARY",
    "UNARY",
    "Expr",
    "apply",
    "as_expr",
    "attributed",
    "constant",
    "dependent",
    "depends_on",
    "item",
    "matrix_op",
    "pack",
    "rebuilt",
    "recording",
    "split_constant",
    "substitute",
    "symbol",
    "symbol_text",
    "symbols_of",
    "to_text",
    "topological",
    "unpack",
    "unpack_one",
    "user_location",
    "without_exponentials",
]
