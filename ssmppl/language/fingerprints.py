"""What a function is known by: a digest of its code and of all that it takes from outside.

It is the same in every process, and wherever the function stands: there is no address and no line
in it. What other installed packages give goes by its name, as their versions are noted elsewhere.
"""

from __future__ import annotations

import hashlib
import inspect
import pickle
import re
import sys
import types
from collections.abc import Mapping
from typing import Any

import numpy as np

from ssmppl.errors import Location
from ssmppl.language.reading import PLAIN, attribute, names_in, outer_values

CALLED = ("__init__", "__call__")  # the methods of a class that act without being named
PACKAGE = "ssmppl"


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
