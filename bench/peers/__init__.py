"""Other programs doing the work of `tasks.py`, one module each, all in double precision.

A module has NAME, PACKAGES (whose versions are reported) and `prepare(task)`: a function that does
one unit of the task and returns the seconds it took, compiled and warmed up; or None where the
program cannot do it.
"""
