"""Algorithms over generated programs, one file per family: settings, loop, result."""
