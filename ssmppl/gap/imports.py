"""What a model file imports of the user's own: primitives and laws, under their names."""

from __future__ import annotations

import inspect
import sys
import sysconfig
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from keyword import iskeyword
from pathlib import Path

from ssmppl.errors import ArgumentError, Location
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, topological
from ssmppl.gap.laws import bounds_of
from ssmppl.language.distributions import Distribution, Flat, Mixture, Truncated, ZeroInflated
from ssmppl.language.primitive import Primitive
from ssmppl.language.written import Origin, Written

_INSTALLED = [sysconfig.get_path(k) for k in ("stdlib", "purelib", "platlib")]


@dataclass(frozen=True)
class Import:
    """One primitive or distribution. same : equal for what is the same thing. path : its qualified
    name in its module."""

    kind: str
    name: str
    same: object
    location: Location
    module: str
    path: str

    @classmethod
    def of_primitive(cls, p: Primitive) -> Import:
        """What a call of it needs."""
        f = p.function
        return cls("primitive", p.__name__, p.name, p.location, f.__module__, f.__qualname__)

    @classmethod
    def of_law(cls, o: Origin) -> Import:
        """What naming it needs."""
        return cls("distribution", o.name, o, o.location, o.module, o.qualname)


def imports(distributions: Iterable[Distribution], taken: Collection[str]) -> dict[str, Import]:
    """By name, in the order in which they occur.

    Raises
    ------
    ArgumentError : two of one name, or one with a name that is taken in the file.
    """
    out: dict[str, Import] = {}
    for wanted in (w for d in distributions for w in _wanted(d)):
        if wanted.name in taken or out.setdefault(wanted.name, wanted).same != wanted.same:
            kind = "law" if wanted.kind == "distribution" else wanted.kind
            raise ArgumentError(
                f"the model's file would have two things named {wanted.name!r}, one of them a "
                f"{kind}",
                fix=f"rename the {kind}",
                where=wanted.location,
            )
    return out


def _wanted(d: Distribution) -> Iterable[Import]:
    for node in topological(nodes_of(d)):
        if node.op == "call":
            yield Import.of_primitive(node.data)
    for part in _laws(d):
        if isinstance(part, Written):
            yield Import.of_law(part.origin)


def _laws(d: Distribution) -> Iterable[Distribution]:
    """A law and those that it is made of."""
    yield d
    within = d.components if isinstance(d, Mixture) else []
    within = [d.base] if isinstance(d, ZeroInflated | Truncated) else within
    for part in within:
        yield from _laws(part)


def nodes_of(d: Distribution) -> list[Expr]:
    """All expressions of a law, those of what it is made of among them."""
    if isinstance(d, Flat):
        return []
    if isinstance(d, Mixture):
        own = [e for w in d.weights for e in w.ravel()]
        return [*own, *(e for law in d.components for e in nodes_of(law))]
    if isinstance(d, ZeroInflated):
        return [*nodes_of(d.base), *d.p.ravel()]
    if isinstance(d, Truncated):
        return [*nodes_of(d.base), *(e for a in bounds_of(d).values() for e in a.ravel())]
    return [e for a in d.parameters.values() for e in array(a).ravel()]


def import_lines(found: Iterable[Import], before: list[str]) -> list[str]:
    """The imports of a file, those that it has anyway `before`.

    Raises
    ------
    ArgumentError : something cannot be imported.
    """
    lines, own, folders = before, [], []
    for wanted in found:
        module, folder = _home(wanted)
        if all(part.isidentifier() and not iskeyword(part) for part in module.split(".")):
            own.append(f"from {module} import {wanted.name}")
        else:  # dc-motor.py
            own.append(f'{wanted.name} = importlib.import_module("{module}").{wanted.name}')
            lines = lines if "import importlib" in lines else ["import importlib", "", *lines]
        folders += [folder] if folder else []
    if folders:
        lines = ["import sys", *([] if "import importlib" in lines else [""]), *lines]
        own = [*(f"sys.path.append({f!r})" for f in dict.fromkeys(folders)),
               *(f"{line}  # noqa: E402" for line in own)]  # fmt: skip
    return [*lines, *([""] if own else []), *own]


def in_memory(i: Import) -> object | None:
    """The thing itself, where its module is there and has it under its name."""
    held = getattr(sys.modules.get(i.module), i.name, None) if i.path == i.name else None
    return held if getattr(held, "location", None) == i.location else None


def _home(i: Import) -> tuple[str, str]:
    """(module, folder) to import from; the folder is empty where it is not needed.

    Raises
    ------
    ArgumentError : it stands in no file, or inside of a function.
    """
    file = Path(i.location.file)
    held = getattr(sys.modules.get(i.module), i.name, None)
    if i.path == i.name and file.exists() and inspect.isfunction(held):
        raise ArgumentError(
            f"the {i.kind} {i.name!r} does not stand under that name in its file",
            fix="decorate its def, which gives it its name",
            where=i.location,
        )
    if i.path != i.name or not file.exists():
        place = "inside of a function" if file.exists() else f"in {file}, which is no file"
        raise ArgumentError(
            f"the {i.kind} {i.name!r} is defined {place}: a model file cannot import it",
            fix="define it at the top level of a Python file",
            where=i.location,
        )
    file = file.resolve()
    if any(file.is_relative_to(p) for p in _INSTALLED):
        return i.module, ""
    if "." not in i.module or i.module == "__main__":  # a file by itself, whatever it was run as
        if "." in file.stem:
            raise ArgumentError(
                f"the {i.kind} {i.name!r} is defined in {file.name}, which cannot be imported",
                fix="take the dots out of the file's name",
                where=i.location,
            )
        return file.stem, str(file.parent)
    return i.module, str(file.parents[i.module.count(".")])
