"""Calls from compiled code back into Python: simulators, with all particles of a pass at once.

A `Request` is a simulator's function with the derivatives that some generated function wants of it.
Generated text calls it by its name; machine code calls the C function of that name, which takes the
addresses of the arguments and of the results, by rows of so many numbers. What is raised there
cannot pass through compiled code: it is kept, the results are NaN, and whoever called the compiled
code raises it afterwards.
"""

from __future__ import annotations

import ctypes
import hashlib
import threading
from collections.abc import Callable, Sequence
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import types

from ssmppl.compiling import one_at_a_time
from ssmppl.expressions.batched.call import computed
from ssmppl.expressions.batched.differences import Index

Callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
REQUESTS: dict[str, Request] = {}  # by name
PENDING: dict[int, BaseException] = {}  # by thread: the first one that a callback kept
BUFFER = 1 << 15  # numbers on the stack for arguments and results
MOST = 512  # particles in one call


class Request:
    """A function and what is wanted of it.

    name : unique in this process. arguments, results : how many numbers go in and come out. most :
    points of one call from machine code.
    """

    def __init__(self, name: str, function: Any, wanted: tuple[Index, ...]):
        self.name, self.function, self.wanted = name, function, wanted
        self.arguments = len(function.arguments) + 1
        self.results = len(wanted) * function.outputs
        self.most = max(1, min(MOST, BUFFER // (self.arguments + self.results)))
        self.symbol = f"ssmppl_{name}"
        self._kept = Callback(self._from_compiled)  # as long as code may call it
        address = ctypes.cast(self._kept, ctypes.c_void_p).value
        llvm.add_symbol(self.symbol, address)

    def at(self, x: np.ndarray) -> np.ndarray:
        """(results, B) at x (B, arguments)."""
        return computed(self.function, self.wanted, x).reshape(self.results, len(x))

    def single(self, *args: float) -> np.ndarray:
        """(results,) at one point, for text that Python runs."""
        return self.at(np.array([args], dtype=float))[:, 0]

    def _from_compiled(self, given: int, out: int, size: int, width: int) -> None:
        results = _view(out, self.results * width).reshape(self.results, width)[:, :size]
        if PENDING and threading.get_ident() in PENDING:
            results[:] = np.nan
            return
        try:
            x = _view(given, self.arguments * width).reshape(self.arguments, width)[:, :size]
            results[:] = self.at(x.T)
        except BaseException as error:  # Ctrl-C, too
            PENDING[threading.get_ident()] = error
            results[:] = np.nan


def _view(address: int, size: int) -> np.ndarray:
    buffer: Any = (ctypes.c_double * size).from_address(address)
    return np.frombuffer(buffer)


@one_at_a_time
def request(function: Any, wanted: Sequence[Index]) -> Request:
    """The request for these derivatives of a function, in this order."""
    mark = hashlib.sha256(repr(tuple(wanted)).encode()).hexdigest()[:6]
    name = f"{function.name}_{function.outputs}_{len(function.arguments)}_{mark}"
    if name not in REQUESTS:
        REQUESTS[name] = Request(name, function, tuple(wanted))
    return REQUESTS[name]


def raise_pending() -> None:
    """Raise what a callback of this thread kept, once."""
    error = PENDING.pop(threading.get_ident(), None)
    if error is not None:
        raise error


def watched(run: Callable[..., Any]) -> Callable[..., Any]:
    """A compiled function that raises what callbacks kept while it ran."""

    def call(*args: Any) -> Any:
        found = run(*args)
        if PENDING:
            raise_pending()
        return found

    return call


@one_at_a_time
def simulated(name: str) -> Callable[..., Any]:
    """The function of this name that Numba, or Python where it is switched off, calls."""
    own = REQUESTS[name]
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return own.single
    pointer = types.CPointer(types.float64)
    called = types.ExternalFunction(
        own.symbol, types.void(pointer, pointer, types.int64, types.int64)
    )
    args = ", ".join(f"x{k}" for k in range(own.arguments))
    text = (
        f"def {name}({args}):\n"
        f"    given = np.array([{args}])\n"
        f"    out = np.empty({own.results})\n"
        "    called(given.ctypes, out.ctypes, 1, 1)\n"
        "    return out\n"
    )
    home: dict[str, Any] = {"np": np, "called": called}
    exec(text, home)
    made: Callable[..., Any] = numba.njit(nogil=True, error_model="numpy")(home[name])
    return made
