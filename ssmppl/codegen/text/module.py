"""A generated module while it is written: each algorithm's functions, and the module of them all.

Three binding times (`CONSTANT < THETA < STEP < PARTICLE`): what depends on theta alone is computed
once per call and kept in the array `c`, on theta and time once per step, kept in `s`, the rest in
the loop over particles. A `Section` is one algorithm's functions over one pair of such arrays, a
`ModuleText` the sections with the kernels that call them, what they import and the header.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ssmppl.codegen.kernels.particle import particle_filter as kernels
from ssmppl.codegen.text.callbacks import REQUESTS
from ssmppl.codegen.text.render import (
    Comments,
    Names,
    Writer,
    depends,
    symbol_name,
)
from ssmppl.codegen.text.specialise import specialise
from ssmppl.expressions.expr import Expr, several, topological
from ssmppl.expressions.operations import KERNELS
from ssmppl.language.model.trace import Trace
from ssmppl.language.user_defined.primitive import REGISTRY

CONSTANT, THETA, STEP, PARTICLE = 0, 1, 2, 3
LEVELS = {
    "parameter": THETA, "time": STEP, "time_prev": STEP, "input": STEP, "input_prev": STEP,
    "observation": STEP, "observation_prev": STEP, "seen": STEP, "seen_prev": STEP,
    "guide": STEP, "state": PARTICLE, "state_prev": PARTICLE, "noise": PARTICLE,
}  # fmt: skip
# What every section has, and the arguments; and what some lack, and then do not call.
OUTER = {"prepare": "theta, c", "step": "theta, c, y_data, seen_data, u_data, t, s"}
OPTIONAL = (
    "fit", "look_ahead", "weigh_future", "linear_initial", "linear", "hessian_initial", "hessian",
)  # fmt: skip
# Where the functions stand that generated text calls, and its decorators.
HOMES = {n: f"ssmppl.codegen.kernels.math.{file}" for n, file in KERNELS.items()}
HOMES |= dict.fromkeys(("exact", "kernel"), "ssmppl.codegen.kernels.math.flags")


def level_of(node: Expr) -> int:
    """Binding time of a symbol or a random draw."""
    return PARTICLE if node.op == "random" else LEVELS[node.data[0]]


@dataclass(frozen=True)
class Target:
    """target = expression, where guard (an expression of the step) holds; else 0 is added."""

    text: str
    expression: Expr
    guard: Expr | None = None


def listed(values: Iterable[Expr]) -> list[Target]:
    """Rows of `out`, which begins at 0: of large matrices most entries are, and stay so."""
    found = [Target(f"out[{k}, i]", e) for k, e in enumerate(values)]
    return [t for t in found if not (t.expression.op == "const" and t.expression.data == 0.0)]


class Layout:
    """Where each symbol of a trace stands in the arrays that the kernels pass round.

    guide : symbols of the twisted proposal's guide, which stand behind the inputs of a row.
    """

    def __init__(self, trace: Trace, guide: Sequence[Expr] = ()):
        self.trace, self.comments = trace, Comments()
        self.place: dict[tuple[str, Expr], int] = {}
        order = {
            "parameter": trace.parameter_symbols,
            "state": trace.state_symbols,
            "observation": trace.observation_symbols,
            "input": (*trace.input_symbols, *guide),
        }
        self.index: dict[tuple[str, tuple], int] = {
            (kind, s.data[1:]): i for kind, symbols in order.items() for i, s in enumerate(symbols)
        }

    def element(self, node: Expr, row: str = "t") -> str:
        """Text of the array element that holds a symbol of theta or of a step."""
        kind, name, index = node.data
        if kind == "time":
            return f"{row} + 1.0"
        if kind == "time_prev":
            return f"{row} + 0.0"
        base = kind.removesuffix("_prev")
        base = {"guide": "input"}.get(base, base)
        column = self.index[("observation" if base == "seen" else base, (name, index))]
        if base == "parameter":
            return f"theta[{column}]"
        array = {"observation": "y_data", "seen": "seen_data", "input": "u_data"}.get(
            base, "trajectory"
        )
        at = f"max({row} - 1, 0)" if kind.endswith("_prev") else row
        return f"{array}[{at}, {column}]"

    def read(
        self, roots: Iterable[Expr], names: dict[Expr, str], reserved: Names, indent: str = "    ",
        sources: Mapping[Expr, str] | None = None,
    ) -> list[str]:  # fmt: skip
        """Lines that name the symbols under `roots` that have no name in `names` yet.

        sources : where these symbols stand, instead of in theta or in a row.
        """
        lines = []
        for node in topological(roots, until=names):
            if node.op == "symbol" and node not in names:
                names[node] = reserved.fresh(symbol_name(node))
                source = (sources or {}).get(node) or self.element(node)
                lines.append(f"{indent}{names[node]} = {source}")
        return lines

    def column(self, node: Expr) -> int:
        """Index of a state's component."""
        return self.index[("state", node.data[1:])]


@dataclass
class Section:
    """One algorithm's generated functions, over its own arrays `c` and `s`.

    suffix : ends the name of each function.
    fits : what is computed once per particle and kept in the rows of `fits`.
    roles : the functions, and the arguments of each.
    further : numbers that its kernel reads behind those that all have, see `ModuleText.algorithm`.
    per_step : whether it has `prepare` and `step`, which fill `c` and `s`.
    """

    layout: Layout
    suffix: str
    c: dict[Expr, int] = field(default_factory=dict)
    s: dict[Expr, int] = field(default_factory=dict)
    fits: dict[Expr, int] = field(default_factory=dict)
    functions: list[str] = field(default_factory=list)
    roles: dict[str, str] = field(default_factory=dict)
    normals: int = 0
    uniforms: int = 0
    further: tuple[int, ...] = ()
    per_step: bool = True

    def __post_init__(self) -> None:
        if self.per_step:
            self.roles = OUTER | self.roles

    def name(self, role: str) -> str:
        """Name of the function of this role."""
        return f"{role}_{self.suffix}"

    def particle_pass(
        self, role: str, doc: str, arguments: str, targets: Sequence[Target], *,
        accumulate: str | None = None, scalars: dict[Expr, str] | None = None,
    ) -> None:  # fmt: skip
        """A function that loops over particles and writes `targets` for each.

        accumulate : name of the array that targets with guards add up in; it starts at 0.
        scalars : symbols bound to array elements instead of to the particles' rows.
        """
        scalars = scalars or {}
        self.roles[role] = arguments
        if accumulate:
            targets = [_summed(group) for group in _grouped(targets)]
        roots = [t.expression for t in targets] + [t.guard for t in targets if t.guard is not None]
        level = depends(roots, level_of)
        for node in scalars:
            level[node] = PARTICLE
        reserved = Names()
        head: list[str] = []
        fits = self.fits if "fits" in arguments and role != "fit" else {}
        names = self._load_outer(roots, level, fits, reserved, head)
        for node in topological(roots, until={**names, **fits}):
            if node in fits:
                row = reserved.fresh(f"fit_{fits[node]}")
                head.append(f"    {row} = fits[{fits[node]}]")
                names[node] = f"{row}[i]"
        self._load_rows(roots, scalars, reserved, head, names)
        self._load_noise(roots, reserved, head, names)
        body: list[str] = []
        for group in _grouped(targets):
            body += self._loop(group, names, reserved, accumulate, first=not body)
        lines = [f"@kernel\ndef {self.name(role)}({arguments}):", f'    """{doc}"""']
        size = "states_prev.shape[1]" if role == "fit" else "states.shape[1]"
        if "log_w" in arguments:
            size = "log_w.shape[0]"
        lines.append(f"    n = {size}")
        self.functions.append("\n".join([*lines, *head, *body]) + "\n")

    def _load_outer(
        self, roots: list[Expr], level: dict[Expr, int], fits: dict[Expr, int], reserved: Names,
        head: list[str],
    ) -> dict[Expr, str]:  # fmt: skip
        """Load what was computed once per call and once per step into local names."""
        names: dict[Expr, str] = {}
        for node in self._frontier(roots, level, fits):
            if node.op == "symbol" and level[node] == THETA:
                source, wanted = self.layout.element(node), symbol_name(node)
            elif level[node] == THETA:
                k = self.c.setdefault(node, len(self.c))
                source, wanted = f"c[{k}]", f"c{k}"
            else:
                k = self.s.setdefault(node, len(self.s))
                source = f"s[{k}]"
                wanted = symbol_name(node) if node.op == "symbol" else f"s{k}"
            names[node] = reserved.fresh(wanted)
            note = "" if node.op == "symbol" else f"  # {self.layout.comments.of(node)}"
            head.append(f"    {names[node]} = {source}{note}")
        return names

    def _frontier(
        self, roots: list[Expr], level: dict[Expr, int], fits: dict[Expr, int]
    ) -> list[Expr]:
        """The largest subexpressions that are known before the loop over particles."""
        outer = {n: True for n, lv in level.items() if lv in (THETA, STEP) and not several(n)}
        used = topological(roots, until={**outer, **fits})
        inside = [n for n in used if n not in outer and n not in fits]
        needed = {a for n in inside for a in n.args} | set(roots)
        return [n for n in used if n in outer and n in needed]

    def _load_rows(
        self, roots: list[Expr], scalars: dict[Expr, str], reserved: Names, head: list[str],
        names: dict[Expr, str],
    ) -> None:  # fmt: skip
        """Name the rows of the particles' arrays that the loop reads."""
        for node in topological(roots, until=names):
            if node.op != "symbol" or level_of(node) != PARTICLE or node in names:
                continue
            if node in scalars:
                names[node] = reserved.fresh(symbol_name(node))
                head.append(f"    {names[node]} = {scalars[node]}")
                continue
            array = "states_prev" if node.data[0] == "state_prev" else "states"
            row = reserved.fresh(symbol_name(node) + "s")
            head.append(f"    {row} = {array}[{self.layout.column(node)}]")
            names[node] = f"{row}[i]"

    def _load_noise(
        self, roots: list[Expr], reserved: Names, head: list[str], names: dict[Expr, str]
    ) -> None:
        """Name the buffers of normals and uniforms, one per draw of a particle."""
        counts = {"normal": 0, "uniform": 0}
        for node in topological(roots, until=names):
            if node.op == "random" and node.data[0] in counts:
                kind = node.data[0]
                k = counts[kind]
                counts[kind] += 1
                row = reserved.fresh(f"{kind}_{k}")
                head.append(f"    {row} = {kind}s[{k} * n:{k + 1} * n]")
                names[node] = f"{row}[i]"
        self.normals = max(self.normals, counts["normal"])
        self.uniforms = max(self.uniforms, counts["uniform"])

    def _loop(
        self, group: list[Target], names: dict[Expr, str], reserved: Names,
        accumulate: str | None, first: bool,
    ) -> list[str]:  # fmt: skip
        guard = group[0].guard
        indent = "    " if guard is None else "        "
        inner = Names(reserved.taken)
        writer = Writer(dict(names), inner, self.layout.trace.locations, indent + "    ")
        operator = "+=" if accumulate and not first else "="
        writer.assign([(t.text, t.expression) for t in group], operator)
        lines = [] if guard is None else [f"    if {names[guard]} != 0.0:"]
        lines += [f"{indent}for i in range(n):", *writer.lines]
        if guard is not None and first and accumulate:
            lines += ["    else:", f"        {accumulate}[:] = 0.0"]
        return lines

    def finish(self) -> str:
        """The functions with `prepare` and `step`, which compute `c` and `s`."""
        if not self.per_step:
            return "\n\n".join(self.functions)
        step = self._straight("step", OUTER["step"], "What depends on theta and time.", self.s, "s")
        prepare = self._straight(
            "prepare", OUTER["prepare"], "What depends on theta alone.", self.c, "c"
        )
        return "\n\n".join([prepare, step, *self.functions])

    def _straight(
        self, role: str, arguments: str, doc: str, slots: dict[Expr, int], array: str
    ) -> str:
        head: list[str] = []
        reserved = Names()
        names: dict[Expr, str] = {}
        roots = list(slots)
        level = depends(roots, level_of)
        if array == "s":
            outer = {n: True for n, lv in level.items() if lv == THETA and not several(n)}
            used = topological(roots, until=outer)
            inside = {a for n in used if n not in outer for a in n.args}
            for node in used:
                if node in outer and node in inside and node.op != "symbol":
                    k = self.c.setdefault(node, len(self.c))
                    names[node] = reserved.fresh(f"c{k}")
                    head.append(f"    {names[node]} = c[{k}]  # {self.layout.comments.of(node)}")
        head += self.layout.read(roots, names, reserved)
        writer = Writer(names, reserved, self.layout.trace.locations)
        writer.assign([(f"{array}[{k}]", node) for node, k in slots.items()])
        text = [f"@exact\ndef {self.name(role)}({arguments}):", f'    """{doc}"""']
        return "\n".join([*text, *head, *writer.lines]) + "\n"


def _grouped(targets: Sequence[Target]) -> list[list[Target]]:
    """Targets with the same guard share one loop; unguarded ones come first."""
    groups: dict[Expr | None, list[Target]] = {}
    for t in targets:
        groups.setdefault(t.guard, []).append(t)
    return sorted(groups.values(), key=lambda g: g[0].guard is not None)


def _summed(group: Sequence[Target]) -> Target:
    """Targets that add up in one place, as one."""
    total = group[0].expression
    for t in group[1:]:
        total = total + t.expression
    return Target(group[0].text, total, group[0].guard)


@dataclass(frozen=True)
class Algorithm:
    """A kernel over a section's functions. sizes : what its parameter of that name stands for.
    decorator : "entry" where Python calls it."""

    function: Callable[..., Any]
    section: Section
    decorator: str
    sizes: tuple[int, ...]
    bound: dict[str, str]


class ModuleText:
    """The parts of a generated module, in order, and the names that they import.

    algorithms : by name. texts : of each section's own functions.
    """

    def __init__(self, layout: Layout):
        self.layout, self.n_states = layout, len(layout.trace.state_symbols)
        self.parts: list[str] = []
        self.algorithms: dict[str, Algorithm] = {}
        self.texts: dict[int, str] = {}
        self.imports: dict[str, str] = {}

    def add(self, title: str, section: Section) -> None:
        """A section's own functions, under a title."""
        self.texts[id(section)] = section.finish()
        self.parts += [heading(title), self.texts[id(section)]]

    def algorithm(
        self, function: Callable[..., Any], name: str, section: Section, decorator: str,
        bound: dict[str, str] | None = None,
    ) -> None:  # fmt: skip
        """A kernel with the section's functions for its parameters of the same names."""
        counts = (
            len(section.c), len(section.s), self.n_states, section.normals, section.uniforms,
            len(section.fits), *section.further,
        )  # fmt: skip
        self.algorithms[name] = Algorithm(function, section, decorator, counts, bound or {})
        parameters = inspect.signature(getattr(function, "py_func", function)).parameters
        roles = [p for p in parameters if f"def {section.name(p)}(" in "\n".join(section.functions)]
        names = dict.fromkeys(OPTIONAL, "absent")
        names |= {role: section.name(role) for role in ["prepare", "step", *roles]}
        names |= {"sizes": f"({', '.join(map(str, counts))})", **(bound or {})}
        made = specialise(function, name, {k: v for k, v in names.items() if k in parameters})
        self.parts.append(made.text.replace("@exact", f"@{decorator}", 1))
        self.imports |= made.imports
        for value in names.values():
            if value in vars(kernels):
                self.imports[value] = kernels.__name__

    def finish(self, introduction: list[str]) -> str:
        """The whole module, with these lines for its docstring."""
        lines = ['"""' + introduction[0], *introduction[1:], '"""', ""]
        lines += ["import math", "from math import inf, nan", "", "import numba"]
        lines += ["import numpy as np", ""]
        words = set(re.findall(r"\w+", "\n".join(self.parts)))
        imports = {n: home for n, home in HOMES.items() if n in words} | self.imports
        for package in sorted(set(imports.values())):
            names = ", ".join(sorted(n for n, home in imports.items() if home == package))
            wrapped = textwrap.fill(names, 92, initial_indent="    ", subsequent_indent="    ")
            lines.append(f"from {package} import (\n{wrapped},\n)")
        called = sorted(words & set(REGISTRY))  # the user's primitives
        if called:
            lines += ["from ssmppl.language.user_defined.primitive import REGISTRY", ""]
            lines += [f'{name} = REGISTRY["{name}"].compiled' for name in called]
        simulators = sorted(words & set(REQUESTS))
        if simulators:
            lines += ["from ssmppl.codegen.text.callbacks import simulated", ""]
            lines += [f'{name} = simulated("{name}")' for name in simulators]
        lines += ["", 'entry = numba.njit(nogil=True, error_model="numpy")', "", ""]
        return "\n".join(lines) + "\n\n".join(self.parts)


def heading(title: str) -> str:
    """A comment line across the page, and the title under it."""
    wrapped = "\n".join(f"# {line}" for line in textwrap.wrap(title, 94))
    return f"# {'-' * 96}\n{wrapped}"
