"""The generated module of a linear Gaussian model's matrices, and that of their derivatives.

Entries that are numbers stand in a template; what depends on theta alone is computed once for each
theta, what depends on inputs, time or y_{t-1} once a row (`codegen/kernels/kalman/assembly.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ssmppl.analysis.structure import LinearGaussian
from ssmppl.codegen.kernels.kalman.assembly import BY_ROW, BY_THETA, FIXED, assemble, contract
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.native.loading import Loaded, load
from ssmppl.codegen.text.module import STEP, Layout, ModuleText, Section, level_of
from ssmppl.codegen.text.render import depends, identifier
from ssmppl.compiling import one_at_a_time
from ssmppl.expressions.evaluate import numbers
from ssmppl.expressions.expr import Expr
from ssmppl.language.model.trace import Trace

KEPT = 64  # numbers of rows whose places are kept


class Slope(NamedTuple):
    """The derivative of one entry of one matrix in one parameter, where it is not zero."""

    parameter: int
    field: str
    entry: int
    expression: Expr


@dataclass
class MatrixProgram:
    """A linear Gaussian model's matrices as compiled functions of theta and the rows.

    shapes : of each field of `Matrices`, without its axis of rows. varying : the fields that are
    not the same in all rows. templates : of one row of each field, the entries that are numbers.
    entries (E, 4): place, slot, field, entry.
    """

    module: Loaded = field(repr=False)
    shapes: tuple[tuple[int, ...], ...]
    varying: frozenset[int]
    templates: tuple[np.ndarray, ...]
    entries: np.ndarray
    _placed: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, repr=False)

    @property
    def by_row(self) -> bool:
        """Whether some entry depends on a row: on inputs, time or y_{t-1}."""
        return bool(np.any(self.entries[:, 0] == BY_ROW))

    def matrices(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray
    ) -> Matrices:
        """The matrices at theta (P,), for these rows: y, seen (T, K), u (T, U)."""
        flat, out = self.room(len(y))
        if len(self.entries):
            _, entries = self._places(len(y))
            self.module.assemble(np.ascontiguousarray(theta), y, seen, u, entries, flat)
        return out

    def room(self, steps: int, filled: bool = True) -> tuple[np.ndarray, Matrices]:
        """One array for the matrices of so many rows, and the matrices in it: with the entries that
        are numbers, or zero altogether."""
        bounds, _ = self._places(steps)
        flat = np.zeros(bounds[-1])
        fields = []
        for k, shape in enumerate(self.shapes):
            rows = flat[bounds[k] : bounds[k + 1]].reshape(-1, self.templates[k].size)
            if filled:
                rows[:] = self.templates[k]
            fields.append(rows.reshape(shape if k < 2 else (-1, *shape)))
        return flat, Matrices(*fields)

    def placed(self, entries: np.ndarray, steps: int) -> np.ndarray:
        """Columns 2 and 3, field and entry, as offset and distance in the array of so many rows."""
        kinds, out = entries[:, 2], entries.copy()
        out[:, 2] = self._bounds(steps)[kinds] + entries[:, 3]
        out[:, 3] = np.where(self._rows(steps) > 1, [t.size for t in self.templates], 0)[kinds]
        return out

    def _rows(self, steps: int) -> np.ndarray:
        """How many each field has."""
        return np.array([steps if k in self.varying else 1 for k in range(len(self.shapes))])

    def _bounds(self, steps: int) -> np.ndarray:
        """Where each field begins, and the end."""
        sizes = self._rows(steps) * [t.size for t in self.templates]
        return np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])

    def _places(self, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Where each field begins, and the entries' places."""
        key = steps if self.varying else 1
        if key not in self._placed:
            if len(self._placed) >= KEPT:
                self._placed.clear()
            self._placed[key] = self._bounds(steps), self.placed(self.entries, steps)
        return self._placed[key]


@dataclass
class SlopeProgram:
    """The derivatives of the matrices as compiled functions.

    entries (E, 6): place, slot, field, entry, the first row that counts, the parameter; values
    (E,): of those that are numbers. wanted (8,): 1 for the fields that have any.
    """

    module: Loaded = field(repr=False)
    program: MatrixProgram
    entries: np.ndarray
    values: np.ndarray
    wanted: np.ndarray
    _placed: dict[int, np.ndarray] = field(default_factory=dict, repr=False)

    def add_gradient(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray,
        adjoint: np.ndarray, out: np.ndarray,
    ) -> None:  # fmt: skip
        """Add the gradient (P,) to out; adjoint : as of `MatrixProgram.room`, of as many rows."""
        key = len(y) if self.program.varying else 1
        if key not in self._placed:
            if len(self._placed) >= KEPT:
                self._placed.clear()
            self._placed[key] = self.program.placed(self.entries, len(y))
        self.module.contract(
            np.ascontiguousarray(theta), y, seen, u, self._placed[key], self.values, adjoint, out
        )


@one_at_a_time
def compile_matrices(trace: Trace, form: LinearGaussian) -> MatrixProgram:
    """Generate, write and import the matrices of a model."""
    section = Section(Layout(trace), "matrices")
    fields = [getattr(form, name) for name in Matrices._fields]
    places, varying, templates = [], set(), []
    for k, f in enumerate(fields):
        found, values = _slots(section, list(f.ravel()))
        places.append(np.column_stack([found, np.full(len(found), k), np.arange(len(found))]))
        templates.append(values)
        if k > 1 and (found[:, 0] == BY_ROW).any():
            varying.add(k)
    entries = np.concatenate(places).astype(np.int64)
    module = _loaded(trace, section, assemble, "matrices", "the matrices")
    return MatrixProgram(
        module, tuple(f.shape for f in fields), frozenset(varying), tuple(templates),
        np.ascontiguousarray(entries[entries[:, 0] != FIXED]),
    )  # fmt: skip


@one_at_a_time
def compile_slopes(
    trace: Trace, program: MatrixProgram, known: Sequence[Slope], later: Iterable[str]
) -> SlopeProgram:
    """Generate, write and import derivatives; later : the fields that do not count in row 0."""
    section = Section(Layout(trace), "slopes")
    found, values = _slots(section, [s.expression for s in known])
    place, first = {name: k for k, name in enumerate(Matrices._fields)}, set(later)
    rest = [(place[s.field], s.entry, s.field in first, s.parameter) for s in known]
    entries = np.hstack([found, np.array(rest, dtype=np.int64).reshape(-1, 4)])
    wanted = np.zeros(len(place), dtype=np.int64)
    wanted[entries[:, 2]] = 1
    module = _loaded(trace, section, contract, "slopes", "derivatives of the matrices")
    return SlopeProgram(module, program, np.ascontiguousarray(entries), values, wanted)


def _slots(section: Section, expressions: list[Expr]) -> tuple[np.ndarray, np.ndarray]:
    """(place, slot) of each expression (E, 2), and the values (E,) of those that are numbers."""
    level = depends(expressions, level_of)
    found, values = np.zeros((len(expressions), 2), dtype=np.int64), np.zeros(len(expressions))
    for k, e in enumerate(expressions):
        if level[e] == 0:
            values[k] = numbers([e])[0]
        elif level[e] == STEP:
            found[k] = BY_ROW, section.s.setdefault(e, len(section.s))
        else:
            found[k] = BY_THETA, section.c.setdefault(e, len(section.c))
    return found, values


def _loaded(trace: Trace, section: Section, kernel: object, name: str, what: str) -> Loaded:
    out = ModuleText(section.layout)
    out.add(f"{what} of the linear Gaussian model", section)
    out.algorithm(kernel, kernel.__name__, section, "entry")  # type: ignore[attr-defined, arg-type]
    lines = [f"Generated by ssmppl: {what} of the model {trace.name!r}."]
    return load(out, f"{identifier(trace.name)}_{name}", lines)
