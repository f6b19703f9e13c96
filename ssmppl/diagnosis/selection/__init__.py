"""Fits and refits, the choice among candidates, and what cannot be separated from it."""
