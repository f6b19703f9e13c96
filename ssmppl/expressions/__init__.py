"""Symbols without probability: expressions, their derivatives, algebraic forms and meaning."""

# Those that fill `node.behaviour`: it is complete whichever module of the folder is imported first.
from ssmppl.expressions import expr, numpy_protocols

__all__ = ["expr", "numpy_protocols"]
