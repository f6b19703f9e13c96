"""Kernels of the twisted particle filter: what the data to come say, and moves that follow it."""
