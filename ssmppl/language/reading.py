"""What laws read from outside while they are traced, as one digest within this process.

A trace keeps the numbers that its laws read, and is made anew where the digest differs. Of a module
or an object those attributes count that the code names, of a function what it reads in its turn;
what has no other form goes by which object it is, and libraries by their names. It is taken at
every call of a verb: `fingerprints`, which are the same in every process, spell out more.
"""

from __future__ import annotations

import dis
import functools
import hashlib
import inspect
import sys
import sysconfig
from collections.abc import Callable, Iterable
from enum import Enum
from types import (
    BuiltinFunctionType,
    CodeType,
    FunctionType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any

import numpy as np

__all__ = [
    "INSTALLED",
    "PLAIN",
    "Declared",
    "digest_of_code",
    "names_in",
    "outer_values",
    "plain_function",
]

PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented), range)
_CORE = ("numpy", "numba", "ssmppl", "scipy")
_STDLIB = sysconfig.get_path("stdlib")
INSTALLED = tuple(
    path for key in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_path(key))
)  # fmt: skip


class Declared:
    """What laws may read under a name and that can change without being another object.

    functions : what it was declared by.
    """

    functions: dict[str, Callable[..., Any]]


def plain_function(function: Any) -> FunctionType:
    """The function of a bound method; functions as they are."""
    plain: FunctionType = getattr(function, "__func__", function)
    return plain


def outer_values(function: Callable[..., Any]) -> dict[str, Any]:
    """The variables that a function reads from its module or from enclosing functions."""
    plain = plain_function(function)
    found = {}
    for name, cell in zip(plain.__code__.co_freevars, plain.__closure__ or (), strict=True):
        try:
            found[name] = cell.cell_contents
        except ValueError:  # assigned later
            continue
    for name in _outer_names(plain.__code__):
        if name in plain.__globals__:
            found[name] = plain.__globals__[name]
    return found


def digest_of_code(functions: Iterable[Callable[..., Any]]) -> str:
    """Changes, within this process, with functions and with what they take from outside."""
    reading = _Reading()
    for function in functions:
        reading.value(function, frozenset())
    return reading.text.hexdigest()


class _Reading:
    """One walk over functions and what they read; each thing is entered once."""

    def __init__(self) -> None:
        self.text = hashlib.sha256()
        self.met: dict[int, tuple[int, Any]] = {}  # the thing itself: its id stays in use
        self.read: dict[int, set[str]] = {}  # of modules and objects, names that were looked up

    def put(self, *words: Any) -> None:
        for word in words:
            content = word if isinstance(word, bytes) else str(word).encode()
            self.text.update(b"%d:" % len(content) + content)

    def again(self, thing: Any) -> bool:
        """Whether it was entered before: then its number stands for it."""
        known = id(thing) in self.met
        number, _ = self.met.setdefault(id(thing), (len(self.met), thing))
        self.put("again" if known else "first", number)
        return known

    def value(self, v: Any, names: frozenset[str]) -> None:
        """names : that the code around it looks up."""
        if type(v) in PLAIN:
            self.put(type(v).__name__, repr(v))
        elif isinstance(v, CodeType):
            self.code(v)
        elif isinstance(v, (np.ndarray, np.generic)):
            self.array(v, names)
        elif isinstance(v, np.dtype):
            self.put("dtype", v.str, v.descr)
        elif isinstance(v, Enum):
            self.put("member", type(v).__module__, type(v).__qualname__, v.name)
            self.value(v.value, names)
        elif isinstance(v, (list, tuple, dict)):
            self.container(v, names)
        elif isinstance(v, (set, frozenset)):
            self.put(type(v).__name__, *sorted(map(repr, v)))
        elif isinstance(v, ModuleType):
            self.module(v, names)
        elif (home := self.library_name(v)) is not None:
            self.put("library", *home)
        elif isinstance(v, FunctionType):
            self.function(v)
        else:
            self.thing(v, names)

    def array(self, v: Any, names: frozenset[str]) -> None:
        self.put(type(v).__name__, v.dtype.str, v.dtype.descr, v.shape)
        if v.dtype.hasobject:
            for entry in np.asarray(v).ravel().tolist():
                self.value(entry, names)
        else:
            self.put(np.ascontiguousarray(v).tobytes())
        if isinstance(v, np.ma.MaskedArray):
            self.put(np.ma.getmaskarray(v).tobytes())

    def container(self, v: Any, names: frozenset[str]) -> None:
        self.put(type(v).__name__, getattr(v, "_fields", ()), len(v))
        if not self.again(v):
            for entry in v.items() if isinstance(v, dict) else v:
                self.value(entry, names)

    def code(self, code: CodeType) -> None:
        self.put("code", code.co_code, code.co_exceptiontable, code.co_flags, code.co_names)
        self.put(code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
        self.put(code.co_freevars, code.co_cellvars, len(code.co_consts))
        for constant in code.co_consts:
            self.value(constant, frozenset())

    def function(self, f: FunctionType) -> None:
        self.put(id(f))
        if self.again(f):
            return
        self.code(f.__code__)
        names = names_in(f.__code__)
        self.value(f.__defaults__, names)
        self.value(f.__kwdefaults__, names)
        for name, outer in sorted(outer_values(f).items()):
            self.put(name)
            self.value(outer, names)

    def module(self, module: ModuleType, names: frozenset[str]) -> None:
        self.put("module", module.__name__)
        if self.is_library(module.__name__):
            return
        self.attributes(module, names, {})

    def attributes(self, thing: Any, names: Iterable[str], shared: dict[str, Any]) -> None:
        """What a module or an object has under these names. shared : what its class has."""
        read = self.read.setdefault(id(thing), set())
        for name in sorted(set(names) - read):
            read.add(name)
            own = getattr(thing, "__dict__", {})
            found = own.get(name, shared.get(name, own))
            if found is own:  # there is none
                continue
            self.put(name)
            if isinstance(found, MemberDescriptorType):  # of __slots__
                found = getattr(thing, name, None)
            found = getattr(found, "fget", None) or getattr(found, "__func__", found)
            self.value(found, frozenset(names))
            if name in shared and isinstance(found, FunctionType):  # reads the object in its turn
                self.attributes(thing, names_in(found.__code__), shared)

    def thing(self, v: Any, names: frozenset[str]) -> None:
        """An object: what is behind it if it is a function's wrapper, else what is read of it."""
        kind = type(v).__name__
        self.put(kind)
        if type(v).__module__.startswith("numba."):
            compiled = getattr(v, "py_func", getattr(v, "__wrapped__", None))
            if inspect.isfunction(compiled):  # by njit, vectorize, cfunc
                options = getattr(v, "targetoptions", {})
                self.put(sorted(map(repr, options.items())), getattr(v, "_sig", ""))
                self.value(compiled, names)
                return
            if ".types" in type(v).__module__:
                self.put(str(v))
                return
        if isinstance(v, MethodType):
            self.value(v.__func__, names)
            code = getattr(v.__func__, "__code__", None)
            self.value(v.__self__, names | (names_in(code) if code else frozenset()))
            return
        if isinstance(v, functools.partial):
            for part in (v.func, v.args, v.keywords):
                self.value(part, names)
            return
        if isinstance(v, BuiltinFunctionType):
            self.put(v.__name__)
            self.value(v.__self__, names)
            return
        if isinstance(v, type) and issubclass(v, Enum):
            self.put(v.__module__, v.__qualname__)
            for member in v:
                self.value(member, names)
            return
        if isinstance(v, type) and issubclass(v, BaseException):
            self.put(v.__module__, v.__qualname__)
            return
        self.put(id(v))
        if self.again(v):
            pass  # under other names there may be more to read
        elif isinstance(v, Declared):
            self.container(v.functions, names)
        else:
            for name in ("__wrapped__", "pyfunc"):  # functools.wraps, np.vectorize
                if inspect.isfunction(wrapped := getattr(v, name, None)):
                    self.function(wrapped)
        if not isinstance(v, Declared):
            self.attributes(v, names | {"__call__"}, self.shared(v))

    def shared(self, v: Any) -> dict[str, Any]:
        """What an object has from its class, where a user wrote that."""
        classes = v.__mro__ if isinstance(v, type) else type(v).__mro__
        own = [c for c in classes if not self.is_library(c.__module__)]
        return {name: found for c in reversed(own) for name, found in vars(c).items()}

    # -- libraries
    def library_name(self, v: Any) -> tuple[str, ...] | None:
        """Module and name of what a library has."""
        name = getattr(v, "__qualname__", None) or getattr(v, "__name__", None)
        if not isinstance(name, str):
            return None
        module = getattr(v, "__module__", None)
        homes = ["numpy", "scipy.special"] if isinstance(v, np.ufunc) else [module]
        for home in homes:
            if not isinstance(home, str) or not self.is_library(home):
                continue
            found: Any = sys.modules.get(home)
            for part in name.split("."):
                found = getattr(found, part, None)
            inner = isinstance(v, FunctionType) and not v.__closure__
            if found is v or (inner and v.__globals__.get("__name__") == home):
                return home, name
        return None

    def is_library(self, module: str) -> bool:
        top = module.partition(".")[0]
        if top in _CORE:
            return True
        file = getattr(sys.modules.get(module), "__file__", None)
        if top in sys.stdlib_module_names and (file is None or file.startswith(_STDLIB)):
            return True
        return file is not None and file.startswith(INSTALLED)


@functools.lru_cache(4096)
def names_in(code: CodeType) -> frozenset[str]:
    """All that a code looks up by name, nested code included, and texts that may be names."""
    found = {*code.co_names, *(c for c in code.co_consts if isinstance(c, str))}
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            found |= names_in(inner)
    return frozenset(found)


@functools.lru_cache(4096)
def _outer_names(code: CodeType) -> frozenset[str]:
    loads = ("LOAD_GLOBAL", "LOAD_NAME")
    names = {i.argval for i in dis.get_instructions(code) if i.opname in loads}
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            names |= _outer_names(inner)
    return frozenset(names)
