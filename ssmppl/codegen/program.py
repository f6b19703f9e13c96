"""Program: the generated module of a model, and its entry points.

`compile_trace` writes one readable module per model (and per kind of missing data): for each
proposal the functions of the particle filter, then those of simulation and prediction. Numba
compiles a function when it is first called, so only what is used is compiled.
"""

from __future__ import annotations

import inspect
import os
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals import Proposal, bootstrap, derive
from ssmppl.codegen import cache
from ssmppl.codegen.kernels import particle_filter as kernels
from ssmppl.codegen.kernels.particle_filter import particle_filter
from ssmppl.codegen.kernels.prediction import predict_step
from ssmppl.codegen.kernels.simulation import simulate
from ssmppl.codegen.kits import filter_kit, prediction_kit, simulation_kit
from ssmppl.codegen.module import Layout, Section
from ssmppl.codegen.specialise import specialise
from ssmppl.codegen.render import CALLS, DRAWS, MATRIX_CALLS, identifier
from ssmppl.errors import NotApplicable
from ssmppl.language.trace import Trace

_MODULES = {
    "elementary": "exp log log1p expm1 sqrt sin cos arctan sinh cosh tanh",
    "special": "lgamma digamma trigamma ndtr log_ndtr ndtri erf erfc",
    "incomplete": "gammainc gammaincc gammaincinv gammainccinv betainc betaincinv",
    "random": "normal uniform gamma poisson binomial",
    "scalars": "tan arcsin arccos arctan2 arcsinh arccosh arctanh logaddexp sign floor ceil maximum minimum "
    "power poisson_quantile binomial_quantile negbinomial_quantile cholesky inverse logdet det",
    "flags": "exact kernel",
}


@dataclass
class Program:
    """The generated module of a traced model.

    proposals : by name, what was derived, or the reason why not.
    """

    trace: Trace
    missing: Missing
    proposals: dict[str, Proposal | NotApplicable]
    text: str
    module: ModuleType = field(repr=False)

    def source(self) -> str:
        """The generated Python module, commented with the user's lines."""
        return self.text

    @property
    def path(self) -> Path:
        """The file of the generated module."""
        return Path(str(self.module.__file__))

    def entry(self, name: str) -> Callable[..., Any]:
        """A compiled entry point of the module."""
        return getattr(self.module, name)


def compile_trace(trace: Trace, missing: Missing = Missing()) -> Program:
    """Generate, write and import the module of a traced model."""
    proposals = derive(trace, missing)
    text = _write(trace, missing, proposals)
    return Program(trace, missing, proposals, text, cache.load(identifier(trace.name), text))


def _write(
    trace: Trace, missing: Missing, proposals: dict[str, Proposal | NotApplicable]
) -> str:
    layout = Layout(trace)
    plain = bootstrap(trace, missing)
    out = _Text(layout)
    if trace.observations:
        prediction = prediction_kit(trace, layout, plain)
        out.add("one-step predictions", prediction)
        out.algorithm(predict_step, "predict", prediction, "exact")
    simulation = simulation_kit(trace, layout, plain)
    out.add("simulation", simulation)
    out.algorithm(simulate, "simulate", simulation, "entry")
    for name, proposal in proposals.items():
        if isinstance(proposal, NotApplicable) or not trace.observations:
            continue
        section = filter_kit(layout, proposal)
        out.add(f"particle filter, {name}: {proposal.explanation}", section)
        ahead, bound = "NO_LOOK_AHEAD", {"look_ahead": "no_look_ahead"}
        if proposal.look_ahead is not None:
            ahead, bound = "EXACT" if proposal.exact_look_ahead else "APPROXIMATE", {}
        for role, predict in (("filter", "no_prediction"), ("filter_predict", "predict")):
            own = {**bound, "ahead": ahead, "predict": predict}
            out.algorithm(particle_filter, section.name(role), section, "entry", own)
    return _header(trace, proposals, out) + "\n\n".join(out.parts)


class _Text:
    """The generated module while it is written: its parts and the names these import."""

    def __init__(self, layout: Layout):
        self.n_states = len(layout.trace.state_symbols)
        self.parts: list[str] = []
        self.imports: dict[str, str] = {}

    def add(self, title: str, section: Section) -> None:
        """A section's own functions, under a title."""
        rule = "-" * 96
        wrapped = "\n".join(f"# {line}" for line in textwrap.wrap(title, 94))
        self.parts += [f"# {rule}\n{wrapped}", section.finish()]

    def algorithm(
        self, function: Callable[..., Any], name: str, section: Section, decorator: str,
        bound: dict[str, str] | None = None,
    ) -> None:  # fmt: skip
        """A kernel with the section's functions for its parameters of the same names."""
        counts = (len(section.c), len(section.s), self.n_states, section.normals, section.uniforms)
        parameters = inspect.signature(getattr(function, "py_func", function)).parameters
        roles = [p for p in parameters if f"def {section.name(p)}(" in "\n".join(section.functions)]
        names = {role: section.name(role) for role in ["prepare", "step", *roles]}
        names |= {"sizes": f"({', '.join(map(str, counts))})", **(bound or {})}
        made = specialise(function, name, {k: v for k, v in names.items() if k in parameters})
        self.parts.append(made.text.replace("@exact", f"@{decorator}", 1))
        self.imports |= made.imports
        for value in names.values():
            if value in vars(kernels):
                self.imports[value] = kernels.__name__


def _header(
    trace: Trace, proposals: dict[str, Proposal | NotApplicable], out: _Text
) -> str:
    lines = [f'"""Generated by ssmppl from the model {trace.name!r}; edits here have no effect.', ""]
    for role, places in trace.functions.items():
        for place in places:
            lines.append(f"{role:<12} {os.path.basename(place.file)}:{place.line} {place.function}")
    lines.append("")
    for name, p in proposals.items():
        what = p.explanation if not isinstance(p, NotApplicable) else f"not derived: {p.reason}"
        lines.append(f"{name:<12} {what}")
    rows = [("theta", trace.parameter_symbols), ("states", trace.state_symbols),
            ("y, seen", trace.observation_symbols), ("u", trace.input_symbols)]  # fmt: skip
    lines.append("")
    for label, symbols in rows:
        if symbols:
            lines.append(f"{label:<12} {', '.join(map(repr, symbols))}")
    lines += ['"""', "", "import math", "from math import inf, nan", ""]
    lines += ["import numba", "import numpy as np", ""]
    words = set(re.findall(r"\w+", "\n".join(out.parts)))
    imports = dict(out.imports)
    for file, names in _MODULES.items():
        package = f"ssmppl.codegen.kernels.{file}"
        imports |= {n: package for n in names.split() if n in words and n not in imports}
    for package in sorted(set(imports.values())):
        names = ", ".join(sorted(n for n, home in imports.items() if home == package))
        wrapped = textwrap.fill(names, 92, initial_indent="    ", subsequent_indent="    ")
        lines.append(f"from {package} import (\n{wrapped},\n)")
    lines += ["", 'entry = numba.njit(cache=True, nogil=True, error_model="numpy")', "", ""]
    return "\n".join(lines)


def known_spellings() -> set[str]:
    """Every function that generated text may call, for the test that all have an import."""
    return {*CALLS.values(), *MATRIX_CALLS.values(), *DRAWS.values()} - {"abs"}


