"""A model bound to data and compiled: what every algorithm starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.proposals import Proposal
from ssmppl.analysis.structure import exact_observation, flat_start
from ssmppl.codegen.modules.marginal import NAMES as MARGINAL
from ssmppl.codegen.modules.program import OWN_MODULES, Program, compile_trace
from ssmppl.data import Experiment, bind
from ssmppl.data.notices import warn_of
from ssmppl.data.per_experiment import trace_over
from ssmppl.data.singular_rows import of_data
from ssmppl.errors import ArgumentError, ModelError, NotApplicable, listing
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace

# What filters without particles are called where a proposal is asked for; the last one, of models
# that call a simulator, is an approximation.
EXACT = ("kalman", "forward", "deterministic", "extended")


@dataclass(frozen=True)
class EndToEnd:
    """E data sets end to end in R rows: that of number e has the rows first[e], ...,
    first[e + 1] - 1. y, seen, u : (R, ...), as of `Experiment`."""

    first: np.ndarray
    y: np.ndarray
    seen: np.ndarray
    u: np.ndarray

    @classmethod
    def of(cls, experiments: Sequence[Experiment]) -> EndToEnd:
        first = np.concatenate([[0], np.cumsum([e.steps for e in experiments])])
        return cls(first, *(joined([getattr(e, n) for e in experiments]) for n in _ROWS))

    @property
    def data(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """y, seen, u and first, as kernels over all data sets take them."""
        return self.y, self.seen, self.u, self.first

    def split(self, rows: np.ndarray) -> list[np.ndarray]:
        """The rows (R, ...) of each data set, not copied."""
        first = self.first.tolist()
        return [rows[a:b] for a, b in pairwise(first)]


_ROWS = ("y", "seen", "u")


def joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of all data sets end to end; of a single one its own."""
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


@dataclass(frozen=True)
class Problem:
    """The traced model, its data sets and its generated program."""

    trace: Trace
    experiments: tuple[Experiment, ...]
    program: Program

    @property
    def rows(self) -> int:
        """The number of rows of all data sets together."""
        return sum(e.steps for e in self.experiments)

    @cached_property
    def end_to_end(self) -> EndToEnd:
        """The data sets as passes over all of them take them."""
        return EndToEnd.of(self.experiments)

    @property
    def instead(self) -> str:
        """What to write for a proposal that does not apply."""
        if self.program.missing.noise is None:
            return 'use proposal="auto" or "bootstrap"'
        return (
            'use proposal="auto", which draws states given the observation where it can; or give '
            "the observation some noise"
        )

    def proposal(self, name: str, integrate: bool = False, others: Sequence[str] = ()) -> Proposal:
        """A derived proposal.

        integrate : whether it may integrate states out, so that particles are of the others only,
            or look ahead by a guide.
        others : what else the caller takes under this name, for the error.

        Raises
        ------
        ArgumentError : no proposal has this name, or it could not be derived; gives the reason.
        """
        found = self.program.proposal(name) if isinstance(name, str) else None
        if found is None:
            if name in EXACT:
                raise ArgumentError(
                    f"proposal={name!r} is an exact filter, without particles",
                    fix="leave method= out, or take a method whose likelihood is exact, as "
                    "MetropolisHastings, Gibbs, EM and DirectOptimization do where there is one",
                )
            known = [n for n in self.program.proposals if n not in OWN_MODULES]
            known = ["auto", *known, *(OWN_MODULES if integrate else ()), *others]
            raise ArgumentError(
                f"proposal={name!r} is not known for this model",
                fix=f"use one of: {listing(name, known)}",
            )
        if isinstance(found, NotApplicable):
            fix = self.instead
            if flat_start(self.trace):
                fix = "use an exact method, or give the state a proper distribution in @initial"
            raise ArgumentError(f"proposal={name!r} does not apply: {found}", fix=fix)
        if name in MARGINAL and not integrate:
            raise ArgumentError(
                f"proposal={name!r} integrates states out, and this method needs particles of all "
                "of them",
                fix='use proposal="auto", "bootstrap" or "guided"; log_likelihood, '
                "particle_filter, PMMH and FFBSi know what to do with the others",
            )
        return found


def missing_of(experiments: Sequence[Experiment], known: Trace | None = None) -> Missing:
    """What the data lack, as far as the generated code depends on it.

    known : the trace, as `of_data` gives it; None where densities do not matter.
    """
    none = all(bool(np.all(e.seen == 1.0)) for e in experiments)
    partial: frozenset[str] = frozenset()
    lacking = (None, None) if known is None else (exact_observation(known), known.singular_row)
    return Missing(none, partial.union(*(e.partial for e in experiments)), *lacking)


def pose(model: Model, data: Any, *, noting: bool = False) -> Problem:
    """Trace the model, bind the data and compile.

    noting : whether to warn of what the data seem to lack (`data/notices.py`).

    Raises
    ------
    ModelError, DataError : naming the place, what was found and the fix.
    """
    traced = trace_over(model, data)
    if not traced.observations:
        raise ModelError(
            f"model {traced.name!r} has no @observation function: there is nothing to condition on",
            fix="declare the distribution of y_t with @model.observation",
            where=model.location,
        )
    experiments = tuple(bind(traced, data))
    if noting:
        warn_of(traced, data, experiments)
    known = of_data(traced, experiments)
    program = compile_trace(traced, missing_of(experiments, known))
    return Problem(known, experiments, program)
