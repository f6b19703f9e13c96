"""The folder of generated modules, and their import.

One file per model and settings, `<cache>/ssmppl/<model>_<digest>.py`, written atomically and
registered in `sys.modules` before it is executed, so that Numba's disk cache finds the functions
again in another process. The digest covers the text, the kernels' text and the versions of
everything that Numba compiles, because Numba itself looks at the one file only.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import platform
import sys
import tempfile
import threading
from functools import cache
from pathlib import Path
from types import ModuleType

import numba
import numpy as np

from ssmppl.errors import SSMError

_lock = threading.Lock()


def cache_folder() -> Path:
    """`$SSMPPL_CACHE`, else ssmppl's folder in the user's cache."""
    chosen = os.environ.get("SSMPPL_CACHE")
    if chosen:
        return Path(chosen).expanduser() / "ssmppl"
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ssmppl"


@cache
def _environment() -> bytes:
    """Text of the kernels and versions: a change in any makes new modules."""
    digest = hashlib.sha256()
    for file in sorted((Path(__file__).parent / "kernels").glob("*.py")):
        digest.update(file.read_bytes())
    versions = (numba.__version__, np.__version__, platform.python_version())
    digest.update(repr(versions).encode())
    return digest.digest()


def digest_of(text: str) -> str:
    """Short name of a generated text in this environment."""
    return hashlib.sha256(_environment() + text.encode()).hexdigest()[:16]


def load(name: str, text: str) -> ModuleType:
    """The module of this text, written to the cache folder if it is not there, and imported.

    Where the folder cannot be written, the module is kept in a private temporary folder.
    """
    module_name = f"ssmppl_generated.{name}_{digest_of(text)}"
    with _lock:
        if module_name in sys.modules:
            return sys.modules[module_name]
        path = _write(f"{name}_{digest_of(text)}.py", text)
        spec = importlib.util.spec_from_file_location(module_name, path)
        if spec is None or spec.loader is None:
            raise SSMError(f"the generated module {path} cannot be imported")
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[module_name]
            raise
        return module


def _write(file: str, text: str) -> Path:
    folder = cache_folder()
    path = folder / file
    try:
        if path.read_text() == text:
            return path
    except OSError:
        pass
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        _write_atomically(path, text)
    except OSError:
        path = Path(_temporary_folder()) / file
        _write_atomically(path, text)
    return path


def _write_atomically(path: Path, text: str) -> None:
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "w") as out:
            out.write(text)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


@cache
def _temporary_folder() -> str:
    return tempfile.mkdtemp(prefix="ssmppl_")
