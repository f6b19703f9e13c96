"""Generated modules: written to the cache folder and imported, what Numba compiles of them kept.

A module is registered in `sys.modules` before it is executed. What is compiled is not left to
Numba's own files: they hold one index for all signatures of a function, which two processes that
write at once can pair with each other's code, and a full disk or half a file ends the call. Here
each signature has a file of its own with its digest behind it; what cannot be written is compiled
again by the next process, and so is what cannot be read.
"""

from __future__ import annotations

import hashlib
import linecache
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from numba.core.compiler import CompileResult
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps

from ssmppl.codegen import folder
from ssmppl.compiling import one_at_a_time


@one_at_a_time
def load(name: str, text: str) -> ModuleType:
    """The module of this text, written to the cache folder if it is not there, and imported.

    Where the folder cannot be written, the module is kept in a private temporary folder; where
    that cannot be either, in memory.
    """
    stem = f"{name}_{folder.digest_of(text)}"
    module_name = f"ssmppl_generated.{stem}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    path = folder.written(f"{stem}.py", text)
    module = ModuleType(module_name)
    module.__file__ = str(path or f"<{stem}>")
    if path is None:  # tracebacks and Numba's errors show lines all the same
        lines = text.splitlines(keepends=True)
        linecache.cache[module.__file__] = len(text), None, lines, module.__file__
    sys.modules[module_name] = module
    try:
        exec(compile(text, module.__file__, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[module_name]
        raise
    for value in vars(module).values():
        if isinstance(value, CPUDispatcher) and value.py_func.__module__ == module_name:
            cast(Any, value)._cache = Kept(value.py_func, stem)
    return module


class Kept:
    """What a Numba dispatcher asks for compiled code, and tells of what it compiled.

    function : the Python function. stem : of its files' names; names its text and all versions.
    """

    def __init__(self, function: Callable[..., Any], stem: str):
        self.cache_path = str(Path(function.__code__.co_filename).parent)
        self._stem = f"{stem}.{function.__qualname__}"

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The compiled function of a signature; None where there is none."""
        target.refresh()
        found = folder.kept_bytes(self._name(signature, target.codegen()), ".nbc")
        return None if found is None else CompileResult._rebuild(target, *pickle.loads(found))

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep what was compiled, unless it holds addresses of this process."""
        if compiled.library.has_dynamic_globals or any(not x.can_cache for x in compiled.lifted):
            return
        name = self._name(signature, compiled.library.codegen)
        folder.keep_bytes(name, ".nbc", dumps(compiled._reduce()))

    def _name(self, signature: Any, codegen: Any) -> str:
        key = repr((signature, codegen.magic_tuple()))  # types of the arguments; the processor
        return f"{self._stem}_{hashlib.sha256(key.encode()).hexdigest()[:16]}"

    def enable(self) -> None:
        """Of Numba's interface."""

    disable = flush = enable
