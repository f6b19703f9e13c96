"""A generated module with its algorithms: by native code where the text can be translated.

Numba's type inference takes most of the time that a new model costs, and the algorithms are the
same for all models: so a model's own functions are translated to LLVM directly, and the algorithms
call them by address. What cannot be translated (matrices, the user's primitives) is compiled by
Numba from the very same text.

Who waits for the compiler is told so (`status.py`), as Numba tells when it compiles
(`numba.core.event`): the first model of its kind on a machine takes half a minute or more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

from numba import config
from numba.core import event

from ssmppl.codegen.kernels.gaussian import mode, unscented
from ssmppl.codegen.kernels.particle import backward
from ssmppl.codegen.kernels.twisted import lookahead, twisting
from ssmppl.codegen.native.build import addresses
from ssmppl.codegen.native.entries import Aside, entry
from ssmppl.codegen.native.translate import Untranslatable
from ssmppl.codegen.store import folder
from ssmppl.codegen.text.callbacks import watched
from ssmppl.codegen.text.module import ModuleText, Section
from ssmppl.compiling import LOCK, one_at_a_time
from ssmppl.status import Compilations

# Specialised functions that kernels call, some of them in place of a model's own.
HELPERS: dict[str, Any] = {
    name: vars(home)[name]
    for home, names in (
        (lookahead, ("look_at", "most_likely", "filter_pass", "gains_pass")),
        (mode, ("follow_step", "eliminate_all")),
        (unscented, ("predicted_row",)),
        (twisting, twisting.SPECIALISED),
        (backward, ("backward_weights", "continuation")),
    )
    for name in names
}


class Listener(event.Listener):
    """Hears of every compilation by Numba, of any thread."""

    def __init__(self) -> None:
        self.compilations = Compilations()

    def on_start(self, event: event.Event) -> None:
        dispatcher = (event.data or {}).get("dispatcher")
        self.compilations.began(getattr(getattr(dispatcher, "py_func", None), "__name__", ""))

    def on_end(self, event: event.Event) -> None:
        self.compilations.ended()


event.register("numba:compile", Listener())


class Loaded:
    """A generated module; its algorithms are looked up by name.

    module : the text, imported. why : by algorithm, why Numba compiles it.
    """

    def __init__(self, out: ModuleText, name: str, module: ModuleType):
        self.module, self.why = module, dict[str, str]()
        self._out, self._name = out, name
        self._simulates = hasattr(module, "simulated")
        self._made: dict[str, Callable[..., Any]] = {}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if (made := self._made.get(name)) is not None:  # without the lock: others may compile long
            return made
        algorithm = self._out.algorithms.get(name)
        if algorithm is None or algorithm.decorator != "entry":
            return getattr(self.module, name)
        with LOCK:
            if name not in self._made:
                self._made[name] = self._algorithm(name)
            return self._made[name]

    def __contains__(self, name: str) -> bool:
        return name in self._out.algorithms

    def sizes(self, name: str) -> tuple[int, ...]:
        """An algorithm's sizes, as of the kernel `particle_filter`."""
        return self._out.algorithms[name].sizes

    def _algorithm(self, name: str) -> Callable[..., Any]:
        algorithm, numba_made = self._out.algorithms[name], getattr(self.module, name)
        if self._simulates:
            numba_made = watched(numba_made)
        if config.DISABLE_JIT:  # type: ignore[attr-defined]
            return numba_made
        helpers = tuple((HELPERS[n], n) for n in algorithm.bound.values() if n in HELPERS)
        aside = None
        if "predict" in algorithm.bound:
            predicted = self._out.algorithms["predict"]
            aside = Aside(predicted, partial(self._places, predicted.section), numba_made)
        try:
            return entry(algorithm, self._places(algorithm.section), helpers, aside)
        except Untranslatable as reason:
            self.why[name] = reason.found
            return numba_made

    def _places(self, section: Section) -> dict[str, int]:
        """Addresses of a section's functions, by role."""
        found = addresses(f"{self._name}_{section.suffix}", self._out.texts[id(section)])
        return {r: found[section.name(r)] for r in section.roles}


@one_at_a_time
def load(out: ModuleText, name: str, lines: list[str]) -> Loaded:
    """Write and import a generated module; `lines` is its docstring."""
    return Loaded(out, name, folder.load(name, out.finish(lines)))
