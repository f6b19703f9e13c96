"""What functions are known by: their code, and all that they read from outside.

`digest_of_code` is taken at every call of a verb, and holds within this process: a trace keeps the
numbers that its distributions read, and is made anew where the digest differs. Of a module or an
object those attributes count that the code names, anywhere in the functions that are reached, and
what the special methods of its class read; all of them where the code has one of the words that
read all (`WHOLE`). Of a function counts what it reads in its turn; of an object of a library, such
as a Series of pandas, its pickle. What has no other form goes by which object it is, and libraries
by their names.

`fingerprint` spells out more, and is the same in every process and wherever the function stands:
there is no address and no line in it. What other installed packages give goes by its name, as their
versions are noted by whoever keeps a fingerprint.
"""

from __future__ import annotations

import dis
import functools
import hashlib
import inspect
import pickle
import re
import sys
import sysconfig
import types
from collections.abc import Callable, Iterable, Mapping
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

from ssmppl.errors import Location

PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented), range)
CALLED = ("__init__", "__call__")  # the methods of a class that act without being named
PACKAGE = "ssmppl"
_CORE = ("numpy", "numba", "ssmppl", "scipy")
# Words of code that reads attributes without naming them.
WHOLE = frozenset((
    "vars", "getattr", "attrgetter", "asdict", "astuple", "fields", "replace", "deepcopy",
    "__dict__", "__slots__",
))  # fmt: skip
# Special methods that do not run where an object is read.
_NOT_READ = frozenset((
    "__init__", "__new__", "__init_subclass__", "__set_name__", "__class_getitem__", "__repr__",
    "__str__", "__del__", "__setattr__", "__delattr__", "__setitem__", "__delitem__",
    "__getstate__", "__setstate__", "__reduce__", "__reduce_ex__", "__eq__", "__hash__",
))  # fmt: skip
# Library modules of mappings that are read as dictionaries are.
_MAPPINGS = ("builtins", "collections", "os")
_STDLIB = sysconfig.get_path("stdlib")
INSTALLED = tuple(
    path for key in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_path(key))
)  # fmt: skip


class Declared:
    """What distributions may read under a name and that can change without being another object.

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


def attribute(thing: Any, name: str, otherwise: Any = None) -> Any:
    """An object's attribute; `otherwise` where it has none, whatever its `__getattr__` raises."""
    try:
        return getattr(thing, name, otherwise)
    except Exception:
        return otherwise


def digest_of_code(functions: Iterable[Callable[..., Any]]) -> str:
    """Changes, within this process, with functions and with what they take from outside."""
    digest = _Digest()
    for function in functions:
        digest.value(function)
    digest.named()
    return digest.text.hexdigest()


class _Digest:
    """One walk over functions and what they read; each thing is entered once."""

    def __init__(self) -> None:
        self.text = hashlib.sha256()
        self.met: dict[int, tuple[int, Any]] = {}  # the thing itself: its id stays in use
        self.names: set[str] = set()  # that the code looks up
        self.having: dict[int, tuple[Any, dict[str, Any]]] = {}  # attributes, with their class's
        self.read: dict[int, set[str]] = {}  # of these, the names that were looked up

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

    def value(self, v: Any) -> None:
        if type(v) in PLAIN:
            self.put(type(v).__name__, repr(v))
        elif isinstance(v, CodeType):
            self.code(v)
        elif isinstance(v, (np.ndarray, np.generic)):
            self.array(v)
        elif isinstance(v, np.dtype):
            self.put("dtype", v.str, v.descr)
        elif isinstance(v, Enum):
            self.put("member", type(v).__module__, type(v).__qualname__, v.name)
            self.value(v.value)
        elif isinstance(v, (list, tuple, dict)):
            self.container(v)
        elif isinstance(v, (set, frozenset)):
            self.put(type(v).__name__, *sorted(map(repr, v)))
        elif isinstance(v, ModuleType):
            self.module(v)
        elif (home := self.library_name(v)) is not None:
            self.put("library", *home)
        elif isinstance(v, FunctionType):
            self.function(v)
        else:
            self.thing(v)

    def array(self, v: Any) -> None:
        self.put(type(v).__name__, v.dtype.str, v.dtype.descr, v.shape)
        if v.dtype.hasobject:
            for entry in np.asarray(v).ravel().tolist():
                self.value(entry)
        else:
            self.put(np.ascontiguousarray(v).tobytes())
        if isinstance(v, np.ma.MaskedArray):
            self.put(np.ma.getmaskarray(v).tobytes())

    def container(self, v: Any) -> None:
        self.put(type(v).__name__, getattr(type(v), "_fields", ()), len(v))
        if not self.again(v):
            for entry in dict.items(v) if isinstance(v, dict) else v:
                self.value(entry)
            if type(v) not in (list, tuple, dict):
                self.having[id(v)] = v, self.shared(v)

    def code(self, code: CodeType) -> None:
        self.put("code", code.co_code, code.co_exceptiontable, code.co_flags, code.co_names)
        self.put(code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
        self.put(code.co_freevars, code.co_cellvars, len(code.co_consts))
        for constant in code.co_consts:
            self.value(constant)

    def function(self, f: FunctionType) -> None:
        self.put(id(f))
        if self.again(f):
            return
        self.code(f.__code__)
        self.names |= names_in(f.__code__)
        self.value(f.__defaults__)
        self.value(f.__kwdefaults__)
        for name, outer in sorted(outer_values(f).items()):
            self.put(name)
            self.value(outer)
        if f.__dict__:
            self.having[id(f)] = f, {}

    def module(self, module: ModuleType) -> None:
        self.put("module", module.__name__)
        if self.is_library(module.__name__):
            return
        self.having.setdefault(id(module), (module, {}))

    def named(self) -> None:
        """What modules and objects have under the names that the code looks up, or under any."""
        while True:
            before = len(self.names), len(self.having)
            whole = not self.names.isdisjoint(WHOLE)
            for number, (thing, shared) in enumerate([*self.having.values()]):
                self.attributes(number, thing, shared, whole)
            if (len(self.names), len(self.having)) == before:
                return

    def attributes(self, number: int, thing: Any, shared: dict[str, Any], whole: bool) -> None:
        """shared : what the object has from its class. whole : all that it has of its own."""
        read = self.read.setdefault(id(thing), set())
        own = attribute(thing, "__dict__", {})
        unread = frozenset() if isinstance(thing, type) else _NOT_READ  # a class may be called
        wanted = self.names | {n for n in shared if n.startswith("__") and n not in unread}
        if whole and not isinstance(thing, (ModuleType, type)):
            slots = {n for n, v in shared.items() if isinstance(v, MemberDescriptorType)}
            wanted |= own.keys() | slots
        for name in sorted((wanted & (own.keys() | shared.keys())) - read):
            read.add(name)
            found = own[name] if name in own else shared[name]
            if name in shared and isinstance(found, MemberDescriptorType):
                found = attribute(thing, name)
            elif name.startswith("__") and not callable(found):
                continue
            self.put(number, name)
            found = attribute(found, "fget") or attribute(found, "__func__", found)
            self.value(found)

    def thing(self, v: Any) -> None:
        """An object: what is behind it if it is a function's wrapper, else what is read of it."""
        kind = type(v).__name__
        self.put(kind)
        if type(v).__module__.startswith("numba."):
            compiled = attribute(v, "py_func", attribute(v, "__wrapped__"))
            if inspect.isfunction(compiled):  # by njit, vectorize, cfunc
                options = getattr(v, "targetoptions", {})
                self.put(sorted(map(repr, options.items())), getattr(v, "_sig", ""))
                self.value(compiled)
                return
            if ".types" in type(v).__module__:
                self.put(str(v))
                return
        if isinstance(v, MethodType):
            self.value(v.__func__)
            self.value(v.__self__)
            return
        if isinstance(v, functools.partial):
            for part in (v.func, v.args, v.keywords):
                self.value(part)
            return
        if isinstance(v, BuiltinFunctionType):
            self.put(v.__name__)
            self.value(v.__self__)
            return
        if isinstance(v, type) and issubclass(v, Enum):
            self.put(v.__module__, v.__qualname__)
            for member in v:
                self.value(member)
            return
        if isinstance(v, type) and issubclass(v, BaseException):
            self.put(v.__module__, v.__qualname__)
            return
        self.put(id(v))
        if self.again(v):
            return
        if isinstance(v, Declared):
            self.container(v.functions)
        else:
            for name in ("__wrapped__", "pyfunc"):  # functools.wraps, np.vectorize
                if inspect.isfunction(wrapped := attribute(v, name)):
                    self.function(wrapped)
            self.having[id(v)] = v, self.shared(v)
            if not isinstance(v, type) and self.is_library(type(v).__module__):
                self.content(v)

    def content(self, v: Any) -> None:
        """What is in an object of a library's class."""
        if type(v).__module__.partition(".")[0] == "ssmppl":
            return
        try:
            if isinstance(v, memoryview):
                self.put(v.tobytes())
            elif isinstance(v, Mapping) and type(v).__module__ in _MAPPINGS:
                self.value(dict(v))
            else:
                self.put(pickle.dumps(v, pickle.HIGHEST_PROTOCOL))
        except Exception:  # whatever a class may raise that cannot be pickled
            return

    def shared(self, v: Any) -> dict[str, Any]:
        """What an object has from its class, where a user wrote that."""
        classes = v.__mro__ if isinstance(v, type) else type(v).__mro__
        own = [c for c in classes if not self.is_library(c.__module__)]
        return {name: found for c in reversed(own) for name, found in vars(c).items()}

    # -- libraries
    def library_name(self, v: Any) -> tuple[str, ...] | None:
        """Module and name of what a library has."""
        name = attribute(v, "__qualname__") or attribute(v, "__name__")
        if not isinstance(name, str):
            return None
        module = attribute(v, "__module__")
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


# -- the same in every process
def fingerprint(value: Any) -> str:
    """Changes with the value, and with what the functions in it do: their code, defaults, and the
    numbers and functions that they find in closures, globals and modules of the user's."""
    module = getattr(getattr(value, "function", value), "__module__", "")
    content = _Content(_root(module)).of(value, frozenset())
    return hashlib.sha256(repr(content).encode()).hexdigest()


class _Content:
    """Values as nested tuples of texts. What may lead back to itself is spelled out once.

    home : the package of the user's that all is spelled out of, installed or not.
    """

    def __init__(self, home: str) -> None:
        self.home = home
        self.met: dict[int, tuple[int, Any]] = {}  # by id: its number, and the value, kept alive

    def of(self, value: Any, names: frozenset[str]) -> Any:
        """names : that the code which finds the value mentions."""
        if isinstance(value, PLAIN):
            return repr(value)
        if isinstance(value, types.ModuleType):
            return self._module(value, names)
        if isinstance(value, types.CodeType):
            return self._code(value)
        if isinstance(value, Location):
            return "place"
        named = attribute(value, "__qualname__") is not None
        if named and self._foreign(attribute(value, "__module__")):
            return f"{value.__module__}.{value.__qualname__}"
        if not isinstance(value, tuple | frozenset | np.ndarray | np.generic):
            if id(value) in self.met:
                return f"number {self.met[id(value)][0]}"
            self.met[id(value)] = len(self.met), value
        return type(value).__qualname__, self._inside(value, names)

    def _inside(self, value: Any, names: frozenset[str]) -> Any:
        if inspect.isfunction(value):
            return self._function(value)
        if inspect.isclass(value):
            return value.__qualname__, self._class(value, names)
        if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
            return value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()
        if isinstance(value, np.ndarray):
            return self.of(value.tolist(), names)
        if isinstance(value, Mapping):
            return sorted((repr(self.of(k, names)), self.of(v, names)) for k, v in value.items())
        if isinstance(value, tuple | list):
            return [self.of(v, names) for v in value]
        if isinstance(value, set | frozenset):
            return sorted(repr(self.of(v, names)) for v in value)
        for wrapped in ("py_func", "__wrapped__", "__func__", "fget", "func"):
            inner = attribute(value, wrapped)
            if callable(inner):  # Numba's, a cache, a method, a property, a partial
                own = ("__self__", "args", "keywords", "targetoptions")  # fastmath changes digits
                rest = [attribute(value, n) for n in own]
                return self.of(inner, names), self.of(rest, names)
        return self._object(value, names)

    def _foreign(self, module: str | None) -> bool:
        """Whether a module is Python's, this package's or of another installed one."""
        root = _root(module)
        if root in sys.stdlib_module_names or root == PACKAGE:
            return True
        file = getattr(sys.modules.get(root), "__file__", None) or ""
        return root != self.home and ("site-packages" in file or "dist-packages" in file)

    def _function(self, function: types.FunctionType) -> Any:
        code = function.__code__
        names = names_in(code)
        found = [(n, self.of(v, names)) for n, v in sorted(outer_values(function).items())]
        defaults = function.__defaults__, function.__kwdefaults__
        return self._code(code), found, self.of(defaults, names)

    def _code(self, code: types.CodeType) -> Any:
        arguments = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        constants = [self.of(c, frozenset()) for c in code.co_consts]
        return code.co_code.hex(), constants, code.co_names, arguments, code.co_freevars

    def _module(self, module: types.ModuleType, names: frozenset[str]) -> Any:
        if self._foreign(module.__name__):
            return module.__name__
        own = vars(module)
        return module.__name__, [(n, self.of(own[n], names)) for n in sorted(names & own.keys())]

    def _class(self, kind: type, names: frozenset[str]) -> Any:
        own = {n: v for n, v in vars(kind).items() if n in CALLED or not n.startswith("__")}
        bases = [self.of(base, names) for base in kind.__bases__]
        return bases, [(n, self.of(own[n], names)) for n in sorted(own)]

    def _object(self, value: Any, names: frozenset[str]) -> Any:
        kind = type(value)
        ours = _root(kind.__module__) == PACKAGE or kind is types.SimpleNamespace
        if self._foreign(kind.__module__) and not ours:
            try:
                return hashlib.sha256(pickle.dumps(value, 5)).hexdigest()
            except Exception:  # whatever a class may raise that cannot be pickled
                return re.sub(r" at 0x[0-9a-f]+", "", repr(value))
        own = attribute(value, "__dict__")
        if own is None:
            slots = [n for c in kind.__mro__ for n in vars(c).get("__slots__", ())]
            own = {n: attribute(value, n) for n in slots}
        return self.of(kind, names), [(n, self.of(own[n], names)) for n in sorted(own)]


def _root(module: str | None) -> str:
    return (module or "").partition(".")[0]
