"""Compiler flags shared by every kernel.

LLVM's fast-math flags are given one by one.  ``nnan`` and ``ninf`` are never set: with them
a weight of -inf or a NaN from the user's model is undefined behaviour.  With the flags below
NaN and infinities keep their meaning, and only the last digits may depend on the width of
the vector registers.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper, wraps
from typing import Any

import numba
import numpy as np

from ssmppl.compiling import once_property

FAST = frozenset({"reassoc", "contract", "arcp", "nsz", "afn"})
"""For loops over particles: sums may be reordered (so that they vectorise), a*b+c fused."""

PRECISE = frozenset({"contract", "nsz"})
"""For polynomials with an argument reduction: fused multiply-add, but no reordering."""


class Kernel:
    """A compiled function that Python seldom calls: compiled code does.

    The way in from Python, which checks and unboxes every argument, takes Numba longer to compile
    than most functions here themselves. So compiled code calls a variant without it, and the one
    with it is compiled when Python first calls.
    """

    def __init__(self, function: Callable, options: dict[str, Any]):
        update_wrapper(self, function)
        self.py_func = function
        self.options = self.targetoptions = options
        without: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        self.bare = numba.njit(**options, **without)(function)

    @property
    def _numba_type_(self) -> Any:
        return self.bare._numba_type_

    @once_property
    def compiled(self) -> Any:
        """The variant that Python can call."""
        return numba.njit(**self.options)(self.py_func)

    def inspect_asm(self) -> dict[Any, str]:
        """The machine code of each signature that Python called."""
        return self.compiled.inspect_asm()

    def __call__(self, *args: Any) -> Any:
        return self.compiled(*args)


def _decorator(**options: Any) -> Callable[[Callable], Any]:
    options = {"nogil": True, "error_model": "numpy", "boundscheck": False, **options}

    def decorate(function: Callable) -> Any:
        if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
            return interpreted(function)
        return Kernel(function, options)

    return decorate


def interpreted(function: Callable) -> Callable:
    """`function` in plain Python, for debugging, with the arithmetic of the compiled code.

    Unsigned words wrap around and 1/0 is inf: NumPy does that, with a warning, where
    Python's own float would raise.
    """

    @wraps(function)
    def call(*args: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(*(np.float64(a) if isinstance(a, float) else a for a in args))

    return call


kernel = _decorator(fastmath=set(FAST), forceinline=True)
"""Decorator of passes over particles.

Inlining is forced, so that each entry point has its own copy of a pass, in one form. Else a
process that compiles would run the pass compiled by itself, one that finds the entry point in the
disk cache the copy optimised inside of it, and their sums would differ in the last digits.
"""

precise = _decorator(fastmath=set(PRECISE), forceinline=True)
"""Decorator of scalar functions that are to vectorise where they are called.

Inlining is forced, because a loop with a call in it does not vectorise.
"""

exact = _decorator()
"""Decorator of functions in which the order of the operations is part of the method."""

inlined = _decorator(inline="always")
"""Decorator of the steps that algorithms share, as of `exact`; they take a model's functions too.

Numba puts them where they are called before it looks at types: that costs its compiler less than a
function each, and what an algorithm leaves out there is not compiled.
"""
