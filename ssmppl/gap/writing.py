"""A traced model as a model file that a person reads, and as a `Model` again.

The file stands by itself: it imports numpy and ssmppl, keeps the user's names, and gives, when it
is traced, the laws it was written from, expression by expression.
"""

from __future__ import annotations

import hashlib
import inspect
import linecache
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.gap.candidate import Candidate
from ssmppl.gap.candidates import slug
from ssmppl.gap.imports import import_lines, imports, in_memory, nodes_of
from ssmppl.gap.laws import bounds_of, infinite
from ssmppl.gap.spelling import Lines
from ssmppl.gap.terms import parts_of, terms_with
from ssmppl.language.distributions import Distribution, Flat, Mixture, Truncated, ZeroInflated
from ssmppl.language.model import Model
from ssmppl.language.traced import Site, Trace, symbols
from ssmppl.language.written import Written

LINE = 96
INDENT = "    "
_TAKEN = ("t", "np", "ssm", "special", "sys", "model", "prior", "initial", "transition",
          "observation", "proposal")  # fmt: skip


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
    """An ordinary `Model` with the laws of a trace: what `model_text` gives, executed.

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
        for role in ("initial", "transition", "observations", "proposal"):
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
        inputs = self.trace.inputs
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

    def _law(self, role: str, sites: list[Site]) -> str:
        roots = [e for s in sites for e in nodes_of(s.distribution)]
        used = symbols_of(roots)
        wanted = {s.data[1] for s in used}
        known = [*self.trace.initial, *self.trace.observations, *self.trace.inputs,
                 *self.trace.parameters, "t"]  # fmt: skip
        arguments = [n for n in known if n in wanted]
        taken = {*self.names, *arguments, *self.imports, "np", "ssm", "special"}
        lines = Lines(roots, self._arrays(used), taken, self._marks(roots), _wishes(role, sites),
                      lambda call: str(call.data.__name__))  # fmt: skip
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
        """Name -> its symbols as this law sees them."""
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
                own = (strength, c.equation.split("[")[0], "t",
                       *(slug(f"{n} {c.equation}") for n in c.effect.states))  # fmt: skip
                nodes = parts_of(roots, symbol, lambda n, own=own: n.startswith(own))  # type: ignore[misc]
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
        if isinstance(d, ZeroInflated):
            law = self._distribution(d.base, lines, room - 20)
            return _call(kind, [law, lines.array(d.p, scalar=_same(d.p))], room)
        if isinstance(d, Truncated):
            bounds = {k: v for k, v in bounds_of(d).items() if not infinite(v)}
            wide = d.base.shape != d.shape
            inside = [self._distribution(d.base, lines, room - 16)]
            for i, (k, v) in enumerate(bounds.items()):
                inside.append(f"{k}={lines.array(v, scalar=not wide or i > 0)}")
            return _call(kind, inside, room)
        if isinstance(d, Written):
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

    def _written(self, d: Written, lines: Lines, room: int) -> str:
        """A law of the user's own, its arguments by name."""
        texts = []
        for i, (argument, values) in enumerate(d.parameters.items()):
            wide = bool(d.shape) and i == 0 and all(map(_same, d.parameters.values()))
            texts.append(f"{argument}={lines.array(values, scalar=not wide)}")
        return _call(d.origin.name, texts, room)


# -- layout
def _wishes(role: str, sites: list[Site]) -> dict[Expr, str]:
    """What means would be called if they needed a name: `x_next`, `y_mean`."""
    out = {}
    for site in sites:
        mean = next(iter(site.distribution.parameters.values()), None)
        if mean is not None and mean.shape == () and role in ("transition", "observation"):
            out[mean[()]] = f"{site.name}_{'next' if role == 'transition' else 'mean'}"
    return out


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
    """With distinct names of the functions: prior, prior_2, ..."""
    out: list[str] = []
    count: dict[str, int] = {}
    for law in laws:
        role = law.split("\n", 1)[0].removeprefix("@model.")
        count[role] = count.get(role, 0) + 1
        if count[role] > 1:
            law = law.replace(f"def {role}(", f"def {role}_{count[role]}(", 1)
        out.append(law)
    return out
