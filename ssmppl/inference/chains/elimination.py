"""Sweeps of PGAS without the parameters that are integrated out.

Wigren, Risuleo, Murray and Lindsten (2019), "Parameter elimination in particle Gibbs sampling".
With B the eliminated parameters and R the others, one sweep is

1. for each experiment j, x_j by conditional SMC for p(x_j | x of the others, y, R), B integrated
   out (`analysis/elimination/elimination.py`): a step that leaves this distribution invariant;
2. B from p(B | x, y, R), its conjugate family, whatever it was before;
3. the other updates as ever.

1 and 2 together leave p(x, B | y, R) invariant. Between them nothing may look at B.

The targets on the way, those of x_{1:t}, are free as long as the last is the right one. Under a
vague prior the right one of a short stretch says nothing of B, and particles that are drawn given
it go anywhere. So the base B_t that statistics are added to holds some rows' worth of what the
warmup found on average, the fewer the later the row, and none at the last. These numbers are fixed
after the warmup, and none of them depends on where a chain is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssmppl.analysis.conjugacy.describe import joined
from ssmppl.analysis.elimination.eliminable import Eliminable, eliminable
from ssmppl.analysis.elimination.elimination import Elimination
from ssmppl.analysis.structure import deterministic_memory
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.modules.elimination import compile_elimination
from ssmppl.codegen.native.loading import Loaded
from ssmppl.compiling import once_property
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError, listing
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.chains.gibbs_updates import GibbsUpdates, ThetaValues
from ssmppl.inference.chains.sampling import PlanRows, reason_and_line
from ssmppl.inference.particles.backward import sweep_failure
from ssmppl.inference.run.problem import Problem

WORTH = 20.0  # rows of what the warmup found, in the base of the first row
FORGETTING = 0.6  # the warmup's mean takes in sweep k with weight k^-FORGETTING


@dataclass(frozen=True)
class EliminationState:
    """sweep : how many were made. rate : (K,) mean increment of a row."""

    sweep: int
    rate: np.ndarray


@dataclass(frozen=True)
class Rows:
    """Increments (T, K) of an experiment's rows: of the states, of the measurements."""

    moved: np.ndarray
    measured: np.ndarray

    @property
    def total(self) -> np.ndarray:
        return self.moved.sum(axis=0) + self.measured.sum(axis=0)


@dataclass(frozen=True)
class Eliminating(GibbsUpdates):
    """Sweeps without the parameters of `updates`. adapting : sweeps of the warmup."""

    particles: int
    adapting: int
    worth: float = WORTH

    @once_property
    def made(self) -> tuple[Elimination, Loaded]:
        found = compile_elimination(
            self.problem.trace, self.problem.program.missing, Eliminable(self.updates, {})
        )
        if isinstance(found, NotApplicable):
            raise ArgumentError(
                f"eliminate does not apply: {found.reason}", fix="use eliminate=False",
                where=found.where,
            )  # fmt: skip
        return found

    @cached_property
    def horizon(self) -> int:
        return deterministic_memory(self.problem.trace) or 0

    def begin(self, theta: np.ndarray, paths: tuple[np.ndarray, ...]) -> EliminationState:
        """What a new chain begins with."""
        return EliminationState(0, self._mean_increment(self._totals(theta, list(paths))))

    def sweep(
        self, state: EliminationState, theta: np.ndarray, paths: list[np.ndarray],
        stream: np.ndarray, generator: np.random.Generator,
    ) -> tuple[EliminationState, tuple[float, float]]:  # fmt: skip
        """New trajectories and eliminated parameters, in place; (share of steps that changed,
        ESS / N)."""
        experiments, figures = self.problem.experiments, np.zeros(2)
        prior = self.prior(theta)
        alone = len(experiments) == 1  # then there are no others whose statistics count
        totals = [np.zeros_like(prior)] if alone else self._totals(theta, paths)
        for j, e in enumerate(experiments):
            base = prior + sum(c for i, c in enumerate(totals) if i != j)
            rows = self.rows(e, theta, paths[j])
            paths[j], totals[j], own = self.trajectory(
                base, state.rate, rows, e, theta, paths[j], stream
            )
            figures += own / len(paths)
        self._draw(prior + sum(totals), theta, generator)
        if state.sweep < self.adapting:
            gain = (state.sweep + 1.0) ** -FORGETTING
            rate = state.rate + gain * (self._mean_increment(totals) - state.rate)
            state = replace(state, rate=rate)
        return replace(state, sweep=state.sweep + 1), (float(figures[0]), float(figures[1]))

    def trajectory(
        self, base: np.ndarray, rate: np.ndarray, rows: Rows, e: Experiment, theta: np.ndarray,
        path: np.ndarray, stream: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """A new trajectory of one experiment (T, D), its statistics (K,), the sweep's figures.

        base : statistics of the prior and the other experiments. rate : of `EliminationState`.
        rows : of the old trajectory `path`.
        """
        found, module = self.made
        steps, d = path.shape
        carried = list(found.carried)
        reference = np.zeros((steps, d + len(carried)))
        reference[:, :d] = path
        reference[0, d:] = (rows.moved[0] + rows.measured[0])[carried]
        u = np.hstack([e.u, self.columns(base, rate, rows)])
        new, own = np.empty_like(reference), np.empty(2)
        run = module.conditional_smc_eliminated
        status, t = run(theta, e.y, e.seen, u, self.particles, stream, reference, new, own)
        if status != OK:
            raise sweep_failure(self.problem, theta, status, t, e)
        out, total = np.ascontiguousarray(new[:, :d]), rows.total
        total[carried] = new[-1, d:]
        own[0] = np.mean(np.any(out != path, axis=1))
        return out, total, own

    def columns(self, base: np.ndarray, rate: np.ndarray, rows: Rows) -> np.ndarray:
        """The base (T, 4 K) that particles' statistics are added to; see `Elimination.columns`."""
        found, _ = self.made
        steps, size = rows.moved.shape
        sure = np.ones(size, dtype=bool)
        sure[list(found.carried)] = False
        left = self.worth * (1.0 - np.arange(steps + 1) / steps)[:, None] * rate
        both = rows.moved + rows.measured
        until = np.vstack([np.zeros(size), np.cumsum(both, axis=0)])  # of the rows before t
        known = np.where(sure, until, 0.0)
        before = base + left[:-1] + known[:-1]
        moved = before + np.where(sure, rows.moved, 0.0)
        now = base + left[1:] + known[1:]
        later = np.minimum(np.arange(steps) + self.horizon + 1, steps)
        whole = base + np.where(sure, until[-1], until[-1] - until[later])
        return np.hstack([before, moved, now, whole])

    def rows(self, e: Experiment, theta: np.ndarray, path: np.ndarray) -> Rows:
        """What the rows of a trajectory add to the statistics."""
        size = sum(len(u.functions) for u in self.updates)
        moved, measured = np.empty((len(path), size)), np.empty((len(path), size))
        self.made[1].statistics_by_row(theta, e.y, e.seen, e.u, path, moved, measured)
        return Rows(moved, measured)

    def _totals(self, theta: np.ndarray, paths: list[np.ndarray]) -> list[np.ndarray]:
        pairs = zip(self.problem.experiments, paths, strict=True)
        return [self.rows(e, theta, path).total for e, path in pairs]

    def _mean_increment(self, totals: list[np.ndarray]) -> np.ndarray:
        return np.sum(totals, axis=0) / self.problem.rows

    def prior(self, theta: np.ndarray) -> np.ndarray:
        """The prior's part of the statistics, given the other parameters."""
        values, out = ThetaValues(self.index, theta), []
        for update, known in zip(self.updates, self.prior_totals, strict=True):
            own = evaluate(update.coefficients["prior"], values) if known is None else known
            out.append(np.array(own, dtype=float))
        return np.concatenate(out)

    def _draw(self, totals: np.ndarray, theta: np.ndarray, generator: np.random.Generator) -> None:
        """The eliminated parameters from their distribution given the trajectories, in place."""
        at = 0
        for update, positions in zip(self.updates, self.positions, strict=True):
            own = totals[at : at + len(update.functions)].tolist()
            at += len(update.functions)
            assert update.family is not None
            values = update.family.draw([*own, 0.0], generator)
            if values is None or not np.all(np.isfinite(values)):
                raise SamplingError(
                    f"the {update.family_name} distribution of {', '.join(update.block)} given the "
                    "trajectory is improper, and cannot be integrated out",
                    fix="give a proper prior, or use eliminate=False",
                    where=update.where,
                )
            theta[positions] = values


def requested_elimination(
    problem: Problem, setting: bool | str | tuple[str, ...], fixed: Mapping[str, np.ndarray],
    proposal: str,
) -> Eliminable | NotApplicable:  # fmt: skip
    """What is to be eliminated; NotApplicable where nothing is.

    proposal : that PGAS has without.

    Raises
    ------
    ArgumentError : the setting is none, or what it asks for cannot be; gives the reason.
    """
    if setting is False:
        return NotApplicable("eliminate=False")
    trace, names = problem.trace, None
    if not (setting is True or setting == "auto"):
        names = _named(problem, setting, fixed)
    if proposal != "bootstrap":
        if setting == "auto":
            return NotApplicable(f"particles move by the proposal {proposal!r}")
        raise ArgumentError(
            f"eliminate={setting!r} moves particles by the transition, and proposal={proposal!r} "
            "does not",
            fix='use proposal="auto" or "bootstrap" with it',
        )
    found = eliminable(trace, tuple(fixed), problem.program.missing, names)
    missed = [r for c, r in found.refused.items() if names is not None]
    if missed or not found.updates:
        reason = next(iter(found.refused.values()), NotApplicable("no parameter is free"))
        if setting == "auto":
            return reason
        who = next(iter(found.refused), None)
        which = f" to {who!r}" if who is not None else ""
        raise ArgumentError(
            f"eliminate={setting!r} does not apply{which}: {reason.reason}",
            fix='use eliminate="auto", which takes what can be, or False',
            where=reason.where,
        )
    return found


def _named(problem: Problem, setting: object, fixed: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    free = [n for n in problem.trace.parameters if n not in fixed]
    assert isinstance(setting, (tuple, list))
    for name in setting:
        if name not in free:
            raise ArgumentError(
                f"eliminate={setting!r}: {name!r} is no free parameter",
                fix=f"the free parameters are {listing(name, free)}",
            )
    return tuple(setting)


def describe_elimination(found: Eliminable | NotApplicable) -> str:
    """What is eliminated, in words."""
    if isinstance(found, NotApplicable):
        return f"none: {found.reason}"
    return "; ".join(
        f"{', '.join(map(repr, u.components))} ({u.family_name})" for u in found.updates
    )


def explain_elimination(found: Eliminable) -> PlanRows:
    """What `explain` says: what can be eliminated, and why others cannot."""
    rows = [
        (joined(u.components), "marginalised in the trajectory update, each particle carrying "
         f"sufficient statistics: {u.family_name}")
        for u in found.updates
    ]  # fmt: skip
    refused = found.refused.items()
    return [
        *rows,
        *((repr(c), f"not marginalised: {reason_and_line(reason)}") for c, reason in refused),
    ]
