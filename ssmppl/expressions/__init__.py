"""Symbols without probability: expressions, their derivatives, algebraic forms and meaning."""

# Those that fill `node.behaviour`: it is complete whichever module of the folder is imported first.
from ssmppl.expressions import graph, protocols, simplify, text

__all__ = ["graph", "protocols", "simplify", "text"]
