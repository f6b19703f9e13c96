"""A traced model as a model file that a person reads, and as a `Model` again.

The file stands by itself: it imports numpy, ssmppl and the user's own primitives and distributions,
keeps the user's names, and gives, when it is traced, the distributions it was written from,
expression by expression.
"""

from __future__ import annotations

import hashlib
import inspect
import linecache
import sys
import sysconfig
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from keyword import iskeyword
from pathlib import Path
from typing import Any

import numpy as np

from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.model.candidates import slug
from ssmppl.diagnosis.model.changed_laws import substituted
from ssmppl.diagnosis.report.spelling import Lines
from ssmppl.errors import ArgumentError, Location
from ssmppl.expressions.arrays import array
from ssmppl.expressions.batched.call import OP
from ssmppl.expressions.expr import Expr, dependent, depends_on, symbols_of, topological
from ssmppl.language.checks.new_values import SUFFIX
from ssmppl.language.distributions import (
    Censored,
    Distribution,
    Flat,
    Mixture,
    Ordered,
    Truncated,
    ZeroInflated,
)
from ssmppl.language.distributions.base import is_infinite
from ssmppl.language.distributions.from_density import Origin, UserDefined
from ssmppl.language.model.covariances import together
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Site, Trace, symbols
from ssmppl.language.user_defined.primitive import Primitive, primitives_in
from ssmppl.language.user_defined.simulator import Simulator

LINE = 96
INDENT = "    "
_TAKEN = ("t", "np", "ssm", "special", "sys", "model", "prior", "initial", "transition",
          "observation", "proposal")  # fmt: skip
_ADDITIVE = ("add", "sub", "neg")
_INSTALLED = [sysconfig.get_path(k) for k in ("stdlib", "purelib", "platlib")]


def model_text(
    trace: Trace,
    title: str | None = None,
    notes: Sequence[str] = (),
    added: Iterable[Candidate] = (),
) -> str:
    """The text of a model file.

    Parameters
    ----------
    title : first line of its docstring; by default the model's name.
    notes : further lines of it.
    added : effects whose terms stand on lines of their own, with a comment that names the effect.

    Raises
    ------
    ArgumentError : the model has a @ssm.primitive or a @ssm.distribution that no file can import,
        or an operation that NumPy and scipy.special do not offer.
    """
    return _Writer(trace, {c.strength: c for c in added}).file(title or trace.name, notes)


def to_model(trace: Trace) -> Model:
    """An ordinary `Model` with the distributions of a trace: what `model_text` gives, executed.

    Errors and explanations show the lines of that text. What the user's own modules define is
    taken from them, as they may be scripts that would run again if they were imported.
    """
    writer = _Writer(trace, {})
    found = {n: o for n, i in writer.imports.items() if (o := in_memory(i)) is not None}
    text = writer.file(trace.name, (), known=found)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    file = f"<{slug(trace.name)} {digest}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    names: dict[str, Any] = {"__name__": f"{slug(trace.name)}_{digest}", **found}
    exec(compile(text, file, "exec"), names)
    model: Model = names["model"]
    return model


class _Writer:
    def __init__(self, trace: Trace, added: dict[str, Candidate]):
        trace = together(trace)
        self.trace, self.added = trace, added
        self.special = False
        sites = [*trace.initial.items(), *trace.parameters.items(), *trace.observations.items()]
        self.quantities: dict[str, Any] = {n: s.value for n, s in sites}
        self.names = {*self.quantities, *trace.inputs}
        for reserved in ("np", "ssm", "special", "model"):
            if reserved in self.names:
                raise ArgumentError(
                    f"the model has a quantity named {reserved!r}, which its file would need "
                    "for a module",
                    fix="rename it",
                )
        roles = ("parameters", "initial", "transition", "observations", "proposal")
        laws = [s.distribution for role in roles for s in getattr(trace, role).values()]
        self.imports = imports(laws, {*self.names, *_TAKEN})

    def file(self, title: str, notes: Sequence[str], known: Collection[str] = ()) -> str:
        """known : names of what needs no import."""
        laws = [self._law("prior", group) for group in self._priors()]
        initial = [s for s in self.trace.initial.values() if s.name not in self.trace.auxiliary]
        laws.append(self._law("initial", initial))
        laws += [self._law("transition", group) for group in self._steps()]
        for role in ("observations", "proposal"):
            if group := list(getattr(self.trace, role).values()):
                laws.append(self._law(role.rstrip("s"), group))
        body = "\n\n\n".join(_numbered(laws))
        doc = "\n".join([title, *(["", *notes] if notes else [])])
        doc = doc.replace("\\", "\\\\")
        stem, quote = doc.rstrip('"'), '\\"'
        doc = stem.replace('"""', 3 * quote) + (len(doc) - len(stem)) * quote
        close = "\n" if notes else ""
        before = ["import numpy as np"]
        before += ["from scipy import special"] if self.special else []
        before += ["", "import ssmppl as ssm"]
        own = [i for n, i in self.imports.items() if n not in known]
        lines = [f'"""{doc}{close}"""', "", *import_lines(own, before), ""]
        return "\n".join([*lines, f"model = ssm.Model({self._arguments()})", "", "", body, ""])

    def _arguments(self) -> str:
        name = repr(self.trace.name).replace("'", '"') if "'" in repr(self.trace.name) else ""
        out = name if name.count('"') == 2 else repr(self.trace.name)
        inputs, step = dict(self.trace.inputs), self.trace.time_step
        if step is not None:  # an input that is declared so
            del inputs[step[0]]
            out += f', time_step="{step[0]}", time_unit="{step[1]}"'
        if any(inputs.values()):
            pairs = [f'"{n}": {s[0] if s else None}' for n, s in inputs.items()]
            out += f", inputs={{{', '.join(pairs)}}}"
        elif inputs:
            names = ", ".join(f'"{n}"' for n in inputs)
            out += f", inputs=({names}{',' if len(inputs) == 1 else ''})"
        return out

    # -- laws
    def _priors(self) -> list[list[Site]]:
        """Parameters in the order of declaration, cut where one depends on one of its group."""
        groups: list[list[Site]] = []
        current: set[str] = set()
        for site in self.trace.parameters.values():
            needs = {s.data[1] for s in symbols_of(nodes_of(site.distribution))}
            if not groups or needs & current:
                groups.append([])
                current = set()
            groups[-1].append(site)
            current.add(site.name)
        return groups

    def _steps(self) -> list[list[Site]]:
        """The transitions, cut where one reads the new value of one of its group, with new values
        under the names that a transition gives them."""
        new = {
            s: Expr("symbol", (), ("state", s.data[1] + SUFFIX, s.data[2]))
            for s in self.trace.state_symbols
        }
        groups: list[list[Site]] = []
        current: set[Expr] = set()
        for site in self.trace.transition.values():
            read = {s for s in symbols_of(nodes_of(site.distribution)) if s in new}
            if not groups or read & current:
                groups.append([])
                current = set()
            for s in read:
                self.quantities[s.data[1] + SUFFIX] = self.quantities[s.data[1]]
            law = substituted(site.distribution, new) if read else site.distribution
            groups[-1].append(replace(site, distribution=law))
            current |= set(site.components)
        return groups

    def _law(self, role: str, sites: list[Site]) -> str:
        roots = [e for s in sites for e in nodes_of(s.distribution)]
        used = _read(roots)
        wanted = {s.data[1] for s in used}
        new = [n + SUFFIX for n in self.trace.initial if role == "transition"]
        known = [*self.trace.initial, *new, *self.trace.observations, *self.trace.inputs,
                 *self.trace.parameters, "t"]  # fmt: skip
        arguments = list(dict.fromkeys(n for n in known if n in wanted))
        taken = {*self.names, *arguments, *self.imports, "np", "ssm", "special"}
        lines = Lines(roots, self._arrays(used), taken, self._marks(roots), _wishes(role, sites),
                      _called)  # fmt: skip
        entries = []
        for s in sites:
            key = f'"{s.name}": '
            entries.append(key + self._distribution(s.distribution, lines, LINE - 8 - len(key)))
        self.special |= lines.special
        head = [f"@model.{role}", _signature(role, arguments)]
        head += [INDENT + s.replace("\n", "\n" + INDENT) for s in lines.statements]
        one = f"{INDENT}return {{{', '.join(entries)}}}"
        if len(entries) == 1 and len(one) <= LINE and "\n" not in one:
            return "\n".join([*head, one])
        inside = [f"{INDENT * 2}{e},".replace("\n", "\n" + INDENT * 2) for e in entries]
        return "\n".join([*head, f"{INDENT}return {{", *inside, f"{INDENT}}}"])

    def _arrays(self, used: Iterable[Expr]) -> dict[str, Any]:
        """Name -> its symbols as this distribution sees them."""
        out = {}
        for kind, name in {s.data[:2]: None for s in sorted(used, key=repr)}:
            value = self.quantities.get(name)
            if value is None:
                shape = self.trace.inputs.get(name, ())
                value = symbols("input", name, shape)
            if np.shape(value):
                here = [Expr("symbol", (), (kind, *s.data[1:])) for s in array(value).ravel()]
                out[name] = np.array(here, dtype=object).reshape(np.shape(value))
        return out

    def _marks(self, roots: list[Expr]) -> dict[Expr, tuple[str, str]]:
        """The terms of the effects that were added, each with its name and a comment."""
        out: dict[Expr, tuple[str, str]] = {}
        for strength, c in self.added.items():
            symbol = Expr("symbol", (), ("parameter", strength, ()))
            if c.change in ("input", "parameter"):
                nodes = []
                for one in c.each:
                    own = (strength, one.equation.split("[")[0], "t",
                           *(slug(f"{n} {one.equation}") for n in c.effect.states))  # fmt: skip
                    nodes += parts_of(roots, symbol, lambda n, own=own: n.startswith(own))  # type: ignore[misc]
            else:
                nodes = terms_with(roots, symbol)
            for node in nodes:
                out.setdefault(node, (slug(c.effect.function.__name__), f"added: {c}"))
        return out

    # -- distributions
    def _distribution(self, d: Distribution, lines: Lines, room: int) -> str:
        kind = f"ssm.{type(d).__name__}"
        if isinstance(d, Flat):
            return f"{kind}({d.shape})" if d.shape else f"{kind}()"
        if isinstance(d, Mixture):
            weights = [lines.array(w, scalar=_same(w)) for w in d.weights]
            inside = [self._distribution(law, lines, room - 16) for law in d.components]
            parts = [f"[{', '.join(weights)}]", f"[{', '.join(inside)}]"]
            return _call(kind, parts, room)
        if isinstance(d, Ordered):
            return _call(kind, [self._distribution(d.base, lines, room - 12)], room)
        if isinstance(d, ZeroInflated):
            law = self._distribution(d.base, lines, room - 20)
            return _call(kind, [law, lines.array(d.p, scalar=_same(d.p))], room)
        if isinstance(d, (Censored, Truncated)):
            bounds = {k: v for k, v in d.given_bounds().items() if not is_infinite(v)}
            wide = d.base.shape != d.shape
            inside = [self._distribution(d.base, lines, room - 16)]
            for i, (k, v) in enumerate(bounds.items()):
                inside.append(f"{k}={lines.array(v, scalar=not wide or i > 0)}")
            return _call(kind, inside, room)
        if isinstance(d, UserDefined):
            return self._written(d, lines, room)
        by_name = {p.name for p in inspect.signature(type(d).__init__).parameters.values()
                   if p.kind is p.KEYWORD_ONLY}  # fmt: skip
        texts = []
        shown = False  # whether some parameter has the shape of the whole
        spread_first = [n for n, a in d.parameters.items() if not _same(a)]
        for name, values in d.parameters.items():
            must = not d.joint and d.shape and not shown and not spread_first
            text = lines.array(values, scalar=not d.joint and not must)
            shown = shown or bool(must)
            plain = name.rstrip("_")
            named = plain in by_name or kind == "ssm.Exponential"
            texts.append(f"{plain}={text}" if named else text)
        return _call(kind, texts, room)

    def _written(self, d: UserDefined, lines: Lines, room: int) -> str:
        """A distribution of the user's own, its arguments by name."""
        texts = []
        for i, (argument, values) in enumerate(d.parameters.items()):
            wide = bool(d.shape) and i == 0 and all(map(_same, d.parameters.values()))
            texts.append(f"{argument}={lines.array(values, scalar=not wide)}")
        return _call(d.origin.name, texts, room)


# -- layout
def _wishes(role: str, sites: list[Site]) -> dict[Expr, str]:
    """Names of means, if they should need one: `x_next`, `y_mean`."""
    out = {}
    for site in sites:
        mean = next(iter(site.distribution.parameters.values()), None)
        if mean is not None and mean.shape == () and role in ("transition", "observation"):
            out[mean[()]] = f"{site.name}_{'next' if role == 'transition' else 'mean'}"
    return out


def _read(roots: Sequence[Expr]) -> frozenset[Expr]:
    """The symbols that a distribution reads. Simulators are told the row, which is not written."""
    nodes = topological(roots)
    rows = {n.args[-1] for n in nodes if n.op == OP}
    read = {a for n in nodes for a in (n.args[:-1] if n.op == OP else n.args)}
    return symbols_of(roots) - (rows - read - set(roots))


def _same(values: Any) -> bool:
    flat = list(array(values).ravel())
    return all(e is flat[0] for e in flat)


def _call(function: str, texts: Sequence[str], room: int) -> str:
    line = f"{function}({', '.join(texts)})"
    if "\n" not in line and len(line) <= min(room, LINE - 24):
        return line
    inside = "".join(f"{INDENT}{t},\n".replace("\n", "\n" + INDENT, t.count("\n")) for t in texts)
    return f"{function}(\n{inside})"


def _signature(role: str, arguments: Sequence[str]) -> str:
    line = f"def {role}({', '.join(arguments)}):"
    if len(line) <= LINE:
        return line
    return f"def {role}(\n" + "".join(f"{INDENT}{a},\n" for a in arguments) + "):"


def _numbered(laws: list[str]) -> list[str]:
    """The distributions with distinct names of their functions: prior, prior_2, ..."""
    out: list[str] = []
    count: dict[str, int] = {}
    for law in laws:
        role = law.split("\n", 1)[0].removeprefix("@model.")
        count[role] = count.get(role, 0) + 1
        if count[role] > 1:
            law = law.replace(f"def {role}(", f"def {role}_{count[role]}(", 1)
        out.append(law)
    return out


# -- the terms of an effect
def terms_with(roots: Iterable[Expr], parameter: Expr) -> list[Expr]:
    """The largest parts of sums that hold the parameter, those in what a simulator is given too."""
    out: list[Expr] = []
    stack = [r for r in roots if depends_on(r, [parameter])]
    while stack:
        node = stack.pop(0)
        if node.op in _ADDITIVE or node.op == OP or (node.op == "item" and node.args[0].op == OP):
            stack += [a for a in node.args if depends_on(a, [parameter])]
        elif node.args and all(node is not n for n in out):
            out.append(node)
    return out


def parts_of(roots: Iterable[Expr], parameter: Expr, own: Callable[[str], bool]) -> list[Expr]:
    """The largest expressions that hold the parameter and else only quantities that are `own`."""
    order = topological(roots)
    inside = {n: n.op != "symbol" or n is parameter or own(n.data[1]) for n in order}
    for n in order:
        inside[n] &= all(inside[a] for a in n.args)
    holds = dependent(order, [parameter])
    used = {a for n in order if not inside[n] for a in n.args} | set(roots)
    return [n for n in order if n.args and n in holds and inside[n] and n in used]


# -- imports
@dataclass(frozen=True)
class Import:
    """One primitive, simulator or distribution. same : equal for what is the same thing. path : its
    qualified name in its module. thing : it itself, where no module has it under a name."""

    kind: str
    name: str
    same: object
    location: Location
    module: str
    path: str
    thing: object = None

    @classmethod
    def of_primitive(cls, p: Primitive) -> Import:
        """The import that a call of it needs."""
        f = p.function
        return cls("primitive", p.__name__, p.name, p.location, f.__module__, f.__qualname__)

    @classmethod
    def of_simulator(cls, s: Simulator) -> Import:
        """The import that a call of it needs: by the name under which a module has it."""
        (module, name), at = holding(s), s.location or Location("", 0)
        thing = None if getattr(sys.modules.get(module), name, None) is s else s
        return cls("simulator", name, id(s), at, module, name, thing)

    @classmethod
    def of_law(cls, o: Origin) -> Import:
        """The import that naming it needs."""
        return cls("distribution", o.name, o, o.location, o.module, o.qualname)


def _called(call: Expr) -> str:
    """The name by which a primitive or a simulator is called."""
    if call.op == "simulator":
        function = call.data.function
        sense = "" if function is function.simulator.moves else ".sense"
        return holding(function.simulator)[1] + sense
    return str(call.data.spelled)


def holding(simulator: Simulator) -> tuple[str, str]:
    """(module, name) under which a module has a simulator; where none has, as one made inside of a
    function, its own name and the module in whose file it was made."""
    home = getattr(simulator.step, "__module__", "__main__")
    for name in (home, "__main__", *list(sys.modules)):
        for key, value in list(getattr(sys.modules.get(name), "__dict__", {}).items()):
            if value is simulator:
                return name, key
    file = simulator.location.file if simulator.location else ""
    made = (n for n, m in list(sys.modules.items()) if getattr(m, "__file__", None) == file)
    return next(made, "__main__"), simulator.name


def imports(distributions: Iterable[Distribution], taken: Collection[str]) -> dict[str, Import]:
    """The imports by name, in the order in which they occur.

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
    yield from map(Import.of_primitive, primitives_in(nodes_of(d)))
    for node in topological(nodes_of(d)):
        if node.op == "simulator":
            yield Import.of_simulator(node.data.function.simulator)
    for part in _laws(d):
        if isinstance(part, UserDefined):
            yield Import.of_law(part.origin)


def _laws(d: Distribution) -> Iterable[Distribution]:
    """A distribution and those that it is made of."""
    yield d
    for part in d.inside():
        yield from _laws(part)


def nodes_of(d: Distribution) -> list[Expr]:
    """All expressions of a distribution, those of what it is made of among them."""
    if isinstance(d, Flat):
        return []
    if isinstance(d, Mixture):
        own = [e for w in d.weights for e in w.ravel()]
        return [*own, *(e for law in d.components for e in nodes_of(law))]
    if isinstance(d, Ordered):
        return nodes_of(d.base)
    if isinstance(d, ZeroInflated):
        return [*nodes_of(d.base), *d.p.ravel()]
    if isinstance(d, (Censored, Truncated)):
        return [*nodes_of(d.base), *(e for a in d.given_bounds().values() for e in a.ravel())]
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
        if wanted.thing is not None:
            place = wanted.location.place
            own.append(
                f"# {wanted.name}, made in {place}, needs a name at the top level of that file"
            )
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
    if i.thing is not None:
        return i.thing
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
