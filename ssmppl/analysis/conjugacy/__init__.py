"""Closed-form conditionals of parameters, found by separating the log density, and checked."""
