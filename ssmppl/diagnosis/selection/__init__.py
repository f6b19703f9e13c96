"""Fits and refits, and the choice among candidates."""
