"""One thread at a time parses, traces, generates and compiles; any number run what was made.

Threads share what is made of a model: modules in `sys.modules`, files of the cache folder, code
that LLVM holds, Python's own parser. One lock, `LOCK`, is held while any of it is made, and none
while it is looked up or runs. It is the lock under which Numba compiles, also where a compiled
function is first called, by a thread that knows nothing of us: with a lock of our own beside it two
threads could each hold one and wait for the other. It is re-entrant, as making one thing asks for
others.
A function that a thread makes of text for itself (`analysis/lambdify.py`) needs no lock: `exec`
builds none of the trees of `ast`.

Under it nothing may wait for another thread. `functools.cached_property` locks until Python 3.11,
one lock for all objects of a class: what makes something by way of it takes `once_property`, which
asks for this lock first.
"""

from __future__ import annotations

import ast
import contextlib
import gc
import os
from collections.abc import Callable, Iterator
from functools import cached_property, wraps
from typing import Any, ParamSpec, TypeVar, overload

from numba.core.compiler_lock import global_compiler_lock as LOCK

__all__ = ["LOCK", "literal", "once", "once_property", "one_at_a_time", "parse", "uncollected"]

Arguments = ParamSpec("Arguments")
Thing = TypeVar("Thing")
_ATTEMPTS = 1000
_MISMATCH = "recursion depth mismatch"

if hasattr(os, "register_at_fork"):
    # A process that is forked while another thread makes something would have the lock held for
    # ever, and what was being made half made. So forks wait for it.
    os.register_at_fork(
        before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=LOCK.release
    )


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Garbage is collected later: while a compiler makes a million objects, the collector would go
    through all those of the process again and again. Where it is off already it stays so."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def one_at_a_time(make: Callable[Arguments, Thing]) -> Callable[Arguments, Thing]:
    """Decorator of a function that makes something: it holds the lock."""

    @wraps(make)
    def made(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Thing:
        with LOCK, uncollected():
            return make(*args, **kwargs)

    return made


def once(make: Callable[Arguments, Thing]) -> Callable[Arguments, Thing]:
    """`functools.cache` for functions that make something, called by position: two threads that ask
    at once get the same. What is there already is found without the lock."""
    kept: dict[tuple[Any, ...], Thing] = {}

    @wraps(make)
    def made(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Thing:
        key = (*args, *kwargs.items())
        if key not in kept:
            with LOCK, uncollected():
                if key not in kept:
                    kept[key] = make(*args, **kwargs)
        return kept[key]

    return made


class once_property(cached_property[Thing]):
    """`functools.cached_property` for what makes something, under the lock."""

    @overload
    def __get__(self, instance: None, owner: type[Any] | None = None) -> once_property[Thing]: ...
    @overload
    def __get__(self, instance: object, owner: type[Any] | None = None) -> Thing: ...
    def __get__(self, instance: object, owner: type[Any] | None = None) -> Any:
        if instance is None:
            return self
        with LOCK, uncollected():
            return super().__get__(instance, owner)


def parse(text: str, mode: str = "exec") -> Any:
    """`ast.parse`, for which Python 3.11 counts its depth for all threads together.

    Two at once can fail with "AST constructor recursion depth mismatch" (python/cpython issue
    106905), where a collection of garbage in the one lets the other go on. Ours hold the lock; of
    threads that are not ours nothing is known, and the text is parsed again.
    """
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            with LOCK:
                return ast.parse(text, mode=mode)
        except SystemError as error:
            if _MISMATCH not in str(error) or attempt == _ATTEMPTS:
                raise
    raise AssertionError


def literal(text: str) -> Any:
    """`ast.literal_eval`, which parses."""
    return ast.literal_eval(parse(text.strip(), "eval"))
