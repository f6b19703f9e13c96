"""The folder of generated modules and of what is compiled of them: written, imported, found again.

One module per model and settings, `<cache>/ssmppl/<model>_<digest>.py`. The digest covers the
text, the kernels' text and the versions of everything that Numba compiles. All is written
atomically, so that several processes may share the folder.

What is compiled is not left to Numba's own files: they hold one index for all signatures of a
function, which two processes that write at once can pair with each other's code, and a full disk or
half a file ends the call. Here each signature has a file of its own with its digest behind it; what
cannot be written is compiled again by the next process, and so is what cannot be read.

Where several processes want the same new code at once, one compiles and the others wait for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import linecache
import os
import pickle
import platform
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import llvmlite
import numba
import numpy as np
from numba.core import event
from numba.core.compiler import CompileResult
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps

from ssmppl.codegen.store import shipped
from ssmppl.compiling import LOCK, once, one_at_a_time, uncollected
from ssmppl.errors import warn

try:
    import fcntl
except ImportError:  # Windows: each process compiles for itself
    fcntl = None  # type: ignore[assignment]

PATIENCE = 120.0  # seconds that a process waits for another that compiles what it needs
on_missing: list[Callable[[], None]] = []
"""Called when something turns out not to be compiled."""


def cache_folder() -> Path:
    """`$SSMPPL_CACHE`, else ssmppl's folder in the user's cache; a temporary one in place of one
    that others can write to.

    What lies there is executed: it has to be the user's own.
    """
    chosen = os.environ.get("SSMPPL_CACHE") or os.environ.get("XDG_CACHE_HOME")
    base = Path(chosen).expanduser() if chosen else Path.home() / ".cache"
    folder = base / "ssmppl"
    return folder if _is_private(folder) else Path(_temporary_folder())


def _is_private(folder: Path) -> bool:
    """Whether nobody else can put anything into a folder, which is made if need be.

    A folder that cannot be made is none that others write to: what is kept there fails later.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = folder.stat()
    except OSError:
        return True
    others_write = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    if not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not others_write):
        return True
    whose = "others can write to it" if others_write else "it belongs to somebody else"
    warn(
        f"compiled models are not kept in {folder}: {whose}, and what lies there would be run. "
        f"Remove the folder, or name one of your own: export SSMPPL_CACHE=..."
    )
    return False


@cache
def kernels_digest() -> str:
    """Of the text of all kernels."""
    digest = hashlib.sha256()
    for file in sorted((Path(__file__).parents[1] / "kernels").rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


@cache
def _environment() -> bytes:
    """Text of the kernels and versions: a change in any makes new modules."""
    python = platform.python_version()
    versions = (numba.__version__, llvmlite.__version__, np.__version__, python)
    return hashlib.sha256(repr((kernels_digest(), versions)).encode()).digest()


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def digest_of(text: str) -> str:
    """Short name of a generated text in this environment."""
    return hashlib.sha256(_environment() + text.encode()).hexdigest()[:16]


def kept(name: str, suffix: str) -> str | None:
    """A text that was kept under this name in this environment, by this user or in the wheel; None
    where there is none."""
    found = kept_bytes(f"{name}_{digest_of('')}", suffix)
    if found is None:
        found = shipped.find(f"{name}{suffix}", kernels_digest())
    return None if found is None else found.decode()


def keep(name: str, suffix: str, text: str) -> None:
    """Keep a text for other processes; where the folder cannot be written it is not kept."""
    keep_bytes(f"{name}_{digest_of('')}", suffix, text.encode())


def kept_bytes(name: str, suffix: str) -> bytes | None:
    """What was kept under a name, whole; None where there is nothing, or half of it."""
    try:
        found = (cache_folder() / f"{name}{suffix}").read_bytes()
    except OSError:
        return None
    body, digest = found[:-32], found[-32:]
    return body if hashlib.sha256(body).digest() == digest else None


def keep_bytes(name: str, suffix: str, content: bytes) -> None:
    """Keep bytes, with their digest behind them."""
    folder = cache_folder()
    with contextlib.suppress(OSError):
        _write_atomically(folder / f"{name}{suffix}", content + hashlib.sha256(content).digest())


@contextlib.contextmanager
def one_process(name: str) -> Iterator[None]:
    """While a process makes what is kept under a name, others that are about to do the same wait.

    Who waited looks again whether it is kept. The system takes the lock from a process that dies;
    who cannot have it, after `PATIENCE` or in a folder without locks, makes the thing too.
    """
    handle = None
    with contextlib.suppress(OSError):
        handle = os.open(cache_folder() / f"{name}.lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        if handle is not None and fcntl is not None:
            _wait_for(handle)
        yield
    finally:
        if handle is not None:
            with contextlib.suppress(OSError):  # another may hold it by now, and then loads
                os.unlink(cache_folder() / f"{name}.lock")
            os.close(handle)


def _wait_for(handle: int) -> None:
    if _locked(handle):
        return
    until = time.monotonic() + PATIENCE
    # It is told of as if we compiled ourselves.
    with event.trigger_event("numba:compile", data={"dispatcher": None}):
        while not _locked(handle) and time.monotonic() < until:
            time.sleep(0.02)


def _locked(handle: int) -> bool:
    """Whether we have the lock, or nobody can have it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def written(file: str, text: str) -> Path | None:
    """Where a text lies that is written if it is not there: in the folder, else in a temporary one;
    None where neither takes it."""
    path = cache_folder() / file
    with contextlib.suppress(OSError):
        if path.read_text() == text:
            return path
    for place in (lambda: path.parent, lambda: Path(_temporary_folder())):
        with contextlib.suppress(OSError):
            _write_atomically(place() / file, text)
            return place() / file
    return None


def _write_atomically(path: Path, content: str | bytes) -> None:
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(content.encode() if isinstance(content, str) else content)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


@once
def _temporary_folder() -> str:
    return tempfile.mkdtemp(prefix="ssmppl_")


@one_at_a_time
def load(name: str, text: str) -> ModuleType:
    """The module of this text, written to the cache folder if it is not there, and imported.

    Where the folder cannot be written, the module is kept in a private temporary folder; where
    that cannot be either, in memory.
    """
    stem = f"{name}_{digest_of(text)}"
    module_name = f"ssmppl_generated.{stem}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    path = written(f"{stem}.py", text)
    module = ModuleType(module_name)
    module.__file__ = str(path or f"<{stem}>")
    if path is None:  # tracebacks and Numba's errors show lines all the same
        lines = text.splitlines(keepends=True)
        linecache.cache[module.__file__] = len(text), None, lines, module.__file__
    sys.modules[module_name] = module  # before it is executed, as Python's own imports are
    try:
        exec(compile(text, module.__file__, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[module_name]
        raise
    for value in vars(module).values():
        if isinstance(value, CPUDispatcher) and value.py_func.__module__ == module_name:
            keeps = Kept(value.py_func, stem, f"{name}_{_digest(text)}")
            cast(Any, value)._cache = keeps
            cast(Any, value).compile = keeps.alone(value.compile)
    return module


def _rebuilt(target: Any, content: bytes) -> Any:
    return CompileResult._rebuild(target, *pickle.loads(content))


class Kept:
    """What a Numba dispatcher asks for compiled code, and tells of what it compiled.

    function : the Python function. stem : of its files' names; names its text and all versions.
    plain : likewise, of its text alone, as a wheel's archive goes by.
    """

    def __init__(self, function: Callable[..., Any], stem: str, plain: str):
        self.cache_path = str(Path(function.__code__.co_filename).parent)
        self._stem = f"{stem}.{function.__qualname__}"
        self._plain = f"{plain}.{function.__qualname__}"
        self._held = contextlib.ExitStack()

    def alone(self, compile: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Numba's `compile(signature)`, which asks here for what is kept, in one process a time."""

        def compile_alone(signature: Any) -> Any:
            with LOCK, uncollected(), contextlib.ExitStack() as self._held:
                return compile(signature)

        return compile_alone

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The compiled function of a signature; None where there is none."""
        target.refresh()
        name = self._name(signature, target.codegen())
        found = kept_bytes(name, ".nbc")
        if found is None:
            from_wheel = shipped.find(self.shipped_name(signature), kernels_digest())
            if from_wheel is not None:
                return _rebuilt(target, from_wheel)
            for call in tuple(on_missing):
                call()
            self._held.enter_context(one_process(name))
            found = kept_bytes(name, ".nbc")
        return None if found is None else _rebuilt(target, found)

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep what was compiled, unless it holds addresses of this process."""
        if compiled.library.has_dynamic_globals or any(not x.can_cache for x in compiled.lifted):
            return
        name = self._name(signature, compiled.library.codegen)
        keep_bytes(name, ".nbc", dumps(compiled._reduce()))

    def shipped_name(self, signature: Any) -> str:
        """What the entry of a signature is called in an archive."""
        return f"{self._plain}_{_digest(repr(signature))}"

    def _name(self, signature: Any, codegen: Any) -> str:
        # types of the arguments; the processor
        return f"{self._stem}_{_digest(repr((signature, codegen.magic_tuple())))}"

    def enable(self) -> None:
        """Of Numba's interface."""

    disable = flush = enable
