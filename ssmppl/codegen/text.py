"""A generated module while it is written: its parts, the names they import, the header."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ssmppl.codegen.kernels import particle_filter as kernels
from ssmppl.codegen.module import Layout, Section
from ssmppl.codegen.render import CALLS, DRAWS, MATRIX_CALLS
from ssmppl.codegen.specialise import specialise
from ssmppl.language.primitive import REGISTRY

MODULES = {
    "elementary": "exp log log1p expm1 sqrt sin cos arctan sinh cosh tanh",
    "special": "lgamma digamma trigamma gammaln_rise digamma_rise betaln ndtr log_ndtr ndtri erf "
    "erfc i0e i1e",
    "laws": "betabinomial_cdf betabinomial_quantile vonmises_cdf vonmises_quantile",
    "incomplete": "gammainc gammaincc gammaincinv gammainccinv betainc betaincc betaincinv "
    "betainccinv",
    "random": "normal uniform gamma gamma_by poisson binomial vonmises",
    "scalars": "tan arcsin arccos arctan2 arcsinh arccosh arctanh logaddexp sign floor ceil "
    "maximum minimum power poisson_quantile binomial_quantile negbinomial_quantile "
    "poisson_survival_quantile negbinomial_survival_quantile cholesky inverse logdet det",
    "flags": "exact kernel",
}

# Functions that some sections lack, and then are not called.
OPTIONAL = ("fit", "look_ahead", "weigh_future")


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
        self.n_states = len(layout.trace.state_symbols)
        self.parts: list[str] = []
        self.algorithms: dict[str, Algorithm] = {}
        self.texts: dict[int, str] = {}
        self.imports: dict[str, str] = {}

    def add(self, title: str, section: Section) -> None:
        """A section's own functions, under a title."""
        self.texts[id(section)] = section.finish()
        self.parts += [heading(title), self.texts[id(section)]]

    def add_function(self, title: str, text: str) -> None:
        """A single entry point."""
        self.parts += [heading(title), text.replace("@exact", "@entry", 1)]

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
        names = {role: section.name(role) for role in [*OPTIONAL, "prepare", "step", *roles]}
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
        imports = dict(self.imports)
        for file, names in MODULES.items():
            package = f"ssmppl.codegen.kernels.{file}"
            imports |= {n: package for n in names.split() if n in words and n not in imports}
        for package in sorted(set(imports.values())):
            names = ", ".join(sorted(n for n, home in imports.items() if home == package))
            wrapped = textwrap.fill(names, 92, initial_indent="    ", subsequent_indent="    ")
            lines.append(f"from {package} import (\n{wrapped},\n)")
        called = sorted(words & set(REGISTRY))  # the user's primitives
        if called:
            lines += ["from ssmppl.language.primitive import REGISTRY", ""]
            lines += [f'{name} = REGISTRY["{name}"]' for name in called]
        lines += ["", 'entry = numba.njit(nogil=True, error_model="numpy")', "", ""]
        return "\n".join(lines) + "\n\n".join(self.parts)


def heading(title: str) -> str:
    """A comment line across the page, and the title under it."""
    wrapped = "\n".join(f"# {line}" for line in textwrap.wrap(title, 94))
    return f"# {'-' * 96}\n{wrapped}"


def known_spellings() -> set[str]:
    """Every function that generated text may call, for the test that all have an import."""
    return {*CALLS.values(), *MATRIX_CALLS.values(), *DRAWS.values()} - {"abs"}
