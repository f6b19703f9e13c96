"""Expressions and algorithms as the text of Python functions."""
