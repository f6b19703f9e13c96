"""Symbols without probability: expressions, their derivatives, algebraic forms and meaning."""
