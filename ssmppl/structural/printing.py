"""`source`: a model as a file that a user would have written by hand."""

from __future__ import annotations

import inspect
import textwrap
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from ssmppl.arguments import checked
from ssmppl.errors import ArgumentError
from ssmppl.expressions.expr import user_location
from ssmppl.language.model.closure_digest import outer_values, plain_function
from ssmppl.language.model.model import Model, location_of
from ssmppl.language.written import written

PLAIN = (type(None), bool, int, float, str)
LARGEST = 1000  # numbers of an array that is written out


@checked
def source(model: Any) -> str:
    """The source of a model, runnable as it stands: its components, and the functions of the user.

    Parameters
    ----------
    model : a model, with components or without.

    Returns
    -------
    str
        Of a Python file. The functions stand in the order in which they were declared. Numbers,
        arrays and functions that the user's read from outside stand above them, as they are now.

    Raises
    ------
    ArgumentError : a function has no source of its own, as a lambda, or reads from outside what no
        file can hold; names it and its line.
    """
    if not isinstance(model, Model):
        raise ArgumentError(
            f"ssm.structural.source was given {type(model).__name__}",
            fix="give a model, ssm.structural.source(m)",
            where=user_location(),
        )
    page = _Page()
    bodies = []
    for function, role in _declared(model):
        text = page.function(function)
        bodies.append(f"@model.{role}\n{text}")
    head = [f"model = ssm.Model({_arguments(model)})"]
    parts = ["\n".join([*sorted(page.imports - {page.own}), "", page.own]).lstrip()]
    parts += ["\n".join([*page.values.values(), *head])] if page.values else ["\n".join(head)]
    return "\n\n\n".join(["\n\n".join(parts), *page.helpers.values(), *bodies]) + "\n"


def _declared(model: Model) -> list[tuple[Any, str]]:
    """The functions with their roles, in the order of declaration."""
    roles = {f: role for role, fs in model.functions.items() for f in fs}
    order = {f: k for k, f in enumerate(model._executions)}
    return sorted(roles.items(), key=lambda pair: order.get(pair[0], len(order)))


def _arguments(model: Model) -> str:
    """What stands in `ssm.Model(...)`."""
    out = [_quoted(model.name)]
    inputs, step = dict(model.inputs), model.time_step
    if step is not None:
        del inputs[step[0]]
        out += [f'time_step="{step[0]}", time_unit="{step[1]}"']
    if any(inputs.values()):
        pairs = [f'"{n}": {s[0] if s else None}' for n, s in inputs.items()]
        out.append(f"inputs={{{', '.join(pairs)}}}")
    elif inputs:
        names = ", ".join(f'"{n}"' for n in inputs)
        out.append(f"inputs=({names}{',' if len(inputs) == 1 else ''})")
    if model.experiment is not None:
        out.append(f"experiment={_quoted(model.experiment)}")
    named = model.component_names
    for key in ("dims", "coords"):
        value = getattr(named, key)
        if value:
            plain = {k: [np.asarray(v).tolist() for v in own] for k, own in value.items()}
            out.append(f"{key}={plain!r}")
    return ", ".join(out)


def _quoted(text: str) -> str:
    shown = repr(text)
    return shown if '"' in shown else f'"{shown[1:-1]}"'


class _Page:
    """What the functions of a file need above them."""

    def __init__(self) -> None:
        self.own = "import ssmppl as ssm"
        self.imports = {"import numpy as np", self.own}
        self.values: dict[str, str] = {}
        self.helpers: dict[str, str] = {}
        self.known: dict[str, Any] = {}

    def function(self, function: Any) -> str:
        """The text of a function from its `def` on; what it reads is noted."""
        plain, where = plain_function(function), location_of(function)
        try:
            text = textwrap.dedent(inspect.getsource(plain))
        except (OSError, TypeError):
            text = ""
        lines = text.splitlines()
        start = next((i for i, line in enumerate(lines) if line.startswith("def ")), None)
        if start is None:
            raise ArgumentError(
                f"the function {plain.__name__} has no source of its own",
                fix="declare it by def, in a file or a notebook",
                where=where,
            )
        if written(function) is None:
            for name, value in outer_values(function).items():
                self._note(name, value, function)
        return "\n".join(lines[start:]).rstrip()

    def _note(self, name: str, value: Any, function: Any) -> None:
        if name in self.known and not _same(self.known[name], value):
            raise self._refusal(name, function, "means two things in functions of the model")
        if name in self.known:
            return
        self.known[name] = value
        if isinstance(value, ModuleType):
            line = f"import {value.__name__}"
            self.imports.add(line if name == value.__name__ else f"{line} as {name}")
        elif isinstance(value, PLAIN) or _plain(value):
            self.values[name] = f"{name} = {value!r}"
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size <= LARGEST:
            self.values[name] = f"{name} = np.array({value.tolist()})"
        elif isinstance(value, np.generic):
            self.values[name] = f"{name} = {value.item()!r}"
        elif isinstance(value, FunctionType) and _own(value):
            self.helpers[name] = self.function(value)
        elif (place := _importable(value)) is not None:
            as_ = "" if place[1] == name else f" as {name}"
            self.imports.add(f"from {place[0]} import {place[1]}{as_}")
        else:
            raise self._refusal(name, function, f"is {type(value).__name__}")

    def _refusal(self, name: str, function: Any, what: str) -> ArgumentError:
        plain = plain_function(function)
        return ArgumentError(
            f"the function {plain.__name__} reads {name!r} from outside, which {what}, and no file "
            "can hold that",
            fix="let it read numbers, arrays of at most "
            f"{LARGEST} of them, functions and modules, or make it an input of the model",
            where=location_of(function),
        )


def _plain(value: Any) -> bool:
    if isinstance(value, (tuple, list, set)):
        return all(isinstance(v, PLAIN) or _plain(v) for v in value)
    if isinstance(value, dict):
        return all(isinstance(v, PLAIN) or _plain(v) for pair in value.items() for v in pair)
    return False


def _same(a: Any, b: Any) -> bool:
    if a is b:
        return True
    try:
        return bool(type(a) is type(b) and np.all(np.asarray(a == b)))
    except Exception:
        return False


def _own(function: FunctionType) -> bool:
    """Whether a function is the user's, of the file or notebook that is run."""
    return _importable(function) is None


def _importable(value: Any) -> tuple[str, str] | None:
    """(module, name) by which another file can import it; None of what a script or a notebook
    defines."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not module or not name or module == "__main__" or "." in name:
        return None
    if module.split(".")[0] == "ssmppl":
        return "ssmppl", name
    return module, name
