"""Gibbs steps of the parameters given trajectories and data, by their derived updates.

Schön et al. (2015), section 4.2: each block is drawn given the trajectories and the newest values
of the other blocks, from the statistics that one compiled pass over the data sums up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, partial

import numpy as np

from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.analysis.conjugacy.update import Update
from ssmppl.analysis.density import Missing
from ssmppl.analysis.structure import deterministic
from ssmppl.codegen.kernels.data_sets.each import sums_of_each
from ssmppl.codegen.modules.trajectory_sums import compile_updates, statistics_name
from ssmppl.codegen.native.entries import over_data_sets
from ssmppl.codegen.native.loading import Loaded
from ssmppl.compiling import once_property
from ssmppl.errors import SamplingError
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr
from ssmppl.inference.run.invalid_laws import law_without_density_at
from ssmppl.inference.run.problem import Problem, joined
from ssmppl.inference.updates.draw_update import draw
from ssmppl.language.model.trace import Trace, once_per_trace


@dataclass(frozen=True)
class GibbsUpdates:
    """A problem with the updates of its parameters, in the order in which they are made."""

    problem: Problem
    updates: tuple[Update, ...]

    @once_property
    def module(self) -> Loaded:
        return compile_updates(self.problem.trace, self.updates)

    @cached_property
    def index(self) -> dict[Expr, int]:
        return {s: i for i, s in enumerate(self.problem.trace.parameter_symbols)}

    @cached_property
    def positions(self) -> list[np.ndarray]:
        """Positions of each update's components in theta."""
        return [np.array([self.index[c] for c in u.components]) for u in self.updates]

    @cached_property
    def prior_totals(self) -> list[np.ndarray | None]:
        """The prior's part of the statistics where it is constant."""
        out: list[np.ndarray | None] = []
        for u in self.updates:
            summands = u.coefficients.get("prior", ())
            known = all(e.op == "const" for e in summands)
            out.append(np.array([e.data for e in summands]) if known else None)
        return out

    def __getstate__(self) -> dict:
        return {f.name: self.__dict__[f.name] for f in fields(self)}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)


def plan_updates(problem: Problem, fixed: Mapping[str, np.ndarray]) -> tuple[Update, ...]:
    """The updates of the parameters that are not fixed; derived once."""
    kept, key = _plans(problem.trace), (frozenset(fixed), problem.program.missing)
    if key not in kept:
        kept[key] = tuple(derive_updates(problem.trace, tuple(fixed), problem.program.missing))
    return kept[key]


@once_per_trace
def _plans(trace: Trace) -> dict[tuple[frozenset[str], Missing], tuple[Update, ...]]:
    """The updates of a model that were derived, by what is fixed and what may be missing."""
    return {}


class ThetaValues(Mapping[Expr, float]):
    """theta as a mapping from symbols, without copying."""

    def __init__(self, index: dict[Expr, int], theta: np.ndarray):
        self.index, self.theta = index, theta

    def __getitem__(self, key: Expr) -> float:
        return float(self.theta[self.index[key]])

    def __iter__(self) -> Iterator[Expr]:
        return iter(self.index)

    def __len__(self) -> int:
        return len(self.index)


def draw_parameters(
    steps: GibbsUpdates,
    theta: np.ndarray,
    paths: list[np.ndarray],
    generator: np.random.Generator,
) -> list[bool]:
    """One pass over the updates, in place; whether each was accepted.

    Raises
    ------
    SamplingError : the density is zero, or infinite, where the chain stands; names the block's
        values, and the distribution that has no density there, if there is one.
    """
    infos = []
    for k, update in enumerate(steps.updates):
        positions = steps.positions[k]
        rest = ThetaValues(steps.index, theta)
        totals = _totals(steps, k, theta, paths)
        exact = update.needs_log_joint or update.inseparable_terms
        density = partial(_with, steps, theta, positions, paths=paths) if exact else None
        try:
            values, info = draw(update, totals, theta[positions], rest, generator, density)
        except SamplingError as error:
            none = law_without_density_at(steps.problem.trace, theta)
            if none is None:
                raise
            raise SamplingError(f"{error.found}; {none[0]}", fix=none[1], where=none[2]) from None
        theta[positions] = values
        if update.needs_log_joint:
            log_joint(steps, theta, paths)  # sets what is deterministic in the trajectories
        infos.append(info.accepted)
    return infos


def _with(
    steps: GibbsUpdates, theta: np.ndarray, positions: np.ndarray, values: np.ndarray,
    paths: list[np.ndarray],
) -> float:  # fmt: skip
    trial = theta.copy()
    trial[positions] = values
    return log_joint(steps, trial, paths)


def _totals(steps: GibbsUpdates, k: int, theta: np.ndarray, paths: list[np.ndarray]) -> np.ndarray:
    """The statistics C_i of update k: the prior once, the rest summed over experiments."""
    update = steps.updates[k]
    if update.needs_log_joint or not update.functions:
        return np.empty(0)
    each = np.empty((len(paths), len(update.functions)))
    run = over_data_sets(sums_of_each, getattr(steps.module, statistics_name(update)))
    run(theta, *steps.problem.end_to_end.data, joined(paths), each)
    total = np.add.reduce(each)  # one after the other, as they stand
    prior = steps.prior_totals[k]
    if prior is None:
        values = ThetaValues(steps.index, theta)
        prior = np.array(evaluate(update.coefficients["prior"], values), dtype=float)
    return total + prior


def log_joint(steps: GibbsUpdates, theta: np.ndarray, paths: list[np.ndarray]) -> float:
    """log p(theta, x, y), deterministic components of x set on the way; -inf for nan.

    +inf where a density is infinite, which is no point to go to (`inference/updates/slices.py`).
    """
    value = steps.problem.program.entry("log_prior")(theta) if len(theta) else 0.0
    if value == -np.inf:
        return -np.inf
    rows, several = joined(paths), len(paths) > 1
    value = float(value)
    for part in log_joints(steps.problem, theta, rows).tolist():
        value += part  # floats, which add inf and -inf without a warning
    if several and deterministic(list(steps.problem.trace.transition.values())):
        for path, new in zip(paths, steps.problem.end_to_end.split(rows), strict=True):
            path[:] = new
    return -np.inf if np.isnan(value) else value


def log_joints(problem: Problem, theta: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(E,) log p(x, y | theta) of each data set, of trajectories end to end (R, D); deterministic
    components of x are set on the way."""
    each = np.empty((len(problem.experiments), 1))
    run = over_data_sets(sums_of_each, problem.program.entry("log_joint"))
    run(theta, *problem.end_to_end.data, rows, each)
    return each[:, 0]
