"""Refits, the choice among candidates, and what cannot be separated from it."""
