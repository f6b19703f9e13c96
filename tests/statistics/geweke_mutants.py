"""Samplers made wrong on purpose: what the joint-distribution test has to find.

    python -m tests.statistics.geweke_mutants [repeats]

writes docs/figures/geweke_power.csv: for each mutant, out of how many runs of the length of the
slow tests it was found. Three are beyond the power of this length, as its page says.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ssmppl.inference.chains import elimination, gibbs, gibbs_updates, metropolis_kernel, pgas
from ssmppl.inference.chains.interweaving import NoiseMove
from ssmppl.inference.preparation.space import Space

from .checks import LEVEL
from .geweke import STUDIES, compare, least
from .geweke_kernels import Transitions

TABLE = Path(__file__).parents[2] / "docs" / "figures" / "geweke_power.csv"
LENGTH: dict[str, int] = {"chains": 64, "sweeps": 60, "forward": 3000}  # of the slow tests
ALARM = LEVEL / len(STUDIES)  # of one study, by Bonferroni over its functions


@dataclass(frozen=True)
class Mutant:
    """A sampler made wrong. put : what to replace, as (object, name, function of the original)."""

    name: str
    study: str
    put: tuple[tuple[Any, str, Callable[[Any], Any]], ...]

    @contextmanager
    def at_work(self) -> Iterator[None]:
        saved = [(home, name, getattr(home, name)) for home, name, _ in self.put]
        try:
            for home, name, change in self.put:
                setattr(home, name, change(getattr(home, name)))
            yield
        finally:
            for home, name, value in saved:
                setattr(home, name, value)

    def p(self, seed: int) -> float:
        with self.at_work():
            return least(compare(STUDIES[self.study], **LENGTH, seed=seed))


def row_forgotten(original):
    """The shape of a Gamma or inverse Gamma law counts one row too few."""

    def draw(update, totals, *rest):
        totals = totals.copy()
        for i, f in enumerate(update.functions):
            if f.op == "log":
                totals[i] += 0.5 if "inverse" in update.family_name else -0.5
        return original(update, totals, *rest)

    return draw


def rate_wrong(original):
    """The rate of an inverse Gamma law is 1.5 times too large."""

    def totals(steps, k, theta, paths):
        found = original(steps, k, theta, paths).copy()
        for i, f in enumerate(steps.updates[k].functions):
            if f.op == "div" and steps.updates[k].family_name == "inverse Gamma":
                found[i] *= 1.5
        return found

    return totals


def correction_forgotten(original):
    """What lies outside of the family (here sqrt(1 - phi^2), of the stationary initial law)."""

    def draw(update, *rest):
        return original(replace(update, outside_family=()), *rest)

    return draw


def others_old(original):
    """Each block is drawn given the other blocks as they were before the sweep."""

    def draw_parameters(steps, theta, paths, generator):
        before, infos = theta.copy(), []
        for update in steps.updates:
            own = before.copy()
            alone = gibbs_updates.GibbsUpdates(steps.problem, (update,))
            infos += original(alone, own, paths, generator)
            where = alone.positions[0]
            theta[where] = own[where]
        return infos

    return draw_parameters


def no_jacobian(original):
    """The log density on the unconstrained scale without log |d theta / d z|."""

    def parameters(space, z_free):
        theta, value = original(space, z_free)
        if value == -np.inf:
            return theta, value
        return theta, float(space.problem.program.entry("log_prior")(theta))

    return parameters


def stand_without(original):
    """Where an interweaved move stands, without log |dx / de|."""

    def stand(move, theta, paths):
        _, held = original(move, theta, paths)
        return float(np.sum(move._log_joints(theta, np.concatenate(paths)))), held

    return stand


def at_without(original):
    """Where an interweaved move leads, without log |dx / de|."""

    def at(move, theta, held, paths):
        value, moved = original(move, theta, held, paths)
        if not value > -np.inf:
            return value, moved
        return float(np.sum(move._log_joints(theta, np.concatenate(moved)))), moved

    return at


def states_kept(original):
    """PMMH accepts the parameters, and keeps the states of before."""

    def iterate(kernel, state):
        new, accepted = original(kernel, state)
        run = replace(new.point.run, paths=state.point.run.paths)
        return replace(new, point=replace(new.point, run=run)), accepted

    return iterate


def ratio_without_prior(original):
    """The acceptance ratio of Metropolis-Hastings has the likelihood alone."""

    def iterate(kernel, state):
        flat = replace(state, point=replace(state.point, log_density=0.0))
        coordinates = kernel.coordinates
        return original(replace(kernel, coordinates=_Flat(coordinates)), flat)

    return iterate


@dataclass(frozen=True)
class _Flat:
    """Coordinates whose log density is nought inside of the support."""

    true: Any

    def parameters(self, w):
        theta, value = self.true.parameters(w)
        return theta, 0.0 if value > -np.inf else value

    def __getattr__(self, name):
        return getattr(self.true, name)

    def __len__(self):
        return len(self.true)


def prior_twice(original):
    """Parameters that are eliminated have their prior counted twice when they are drawn."""

    def draw(self, totals, theta, generator):
        return original(self, totals + self.prior(theta), theta, generator)

    return draw


def old_trajectory(original):
    """The parameters of PGAS are drawn given the trajectory of before."""

    def draw_parameters(steps, theta, paths, generator):
        return original(steps, theta, _before.pop() if _before else paths, generator)

    return draw_parameters


def noting_the_old(original):
    def trajectories(sweep, theta, paths, stream):
        _before[:] = [[p.copy() for p in paths]]
        return original(sweep, theta, paths, stream)

    return trajectories


_before: list[list[np.ndarray]] = []

MUTANTS = {
    m.name: m
    for m in (
        Mutant("data never renewed", "counts PGAS",
               ((Transitions, "data", lambda _: lambda made, theta, path: None),)),
        Mutant("one row forgotten", "counts PGAS", ((gibbs_updates, "draw", row_forgotten),)),
        Mutant("one row forgotten, exact states", "delay Gibbs",
               ((gibbs_updates, "draw", row_forgotten),)),
        Mutant("wrong rate", "delay Gibbs", ((gibbs_updates, "_totals", rate_wrong),)),
        Mutant("stationary initial law forgotten", "proper_varves PGAS",
               ((gibbs_updates, "draw", correction_forgotten),)),
        Mutant("prior's factors forgotten", "bounded PGAS",
               ((gibbs_updates, "draw", correction_forgotten),)),
        Mutant("given the other blocks of before", "vector_ar_apart Gibbs",
               ((gibbs, "draw_parameters", others_old),)),
        Mutant("given the trajectory of before", "leverage PGAS",
               ((pgas, "draw_parameters", old_trajectory),
                (pgas, "run_conditional_smc", noting_the_old))),
        Mutant("no Jacobian of the scale", "stationary MetropolisHastings",
               ((Space, "parameters", no_jacobian),)),
        Mutant("no Jacobian of the scale, PMMH", "ricker PMMH",
               ((Space, "parameters", no_jacobian),)),
        Mutant("no Jacobian of the noises", "growth PGAS interweaved",
               ((NoiseMove, "stand", stand_without), (NoiseMove, "at", at_without))),
        Mutant("states of before", "counts PMMH", ((metropolis_kernel, "_iterate", states_kept),)),
        Mutant("no prior in the ratio", "counts PMMH",
               ((metropolis_kernel, "_iterate", ratio_without_prior),)),
        Mutant("prior counted twice", "two_states PGAS eliminated",
               ((elimination.Eliminating, "_draw", prior_twice),)),
    )
}  # fmt: skip


def main(repeats: int, chosen: list[str]) -> None:
    """Run all mutants, or those whose names begin with one of `chosen`, which are only printed."""
    rows = []
    for mutant in MUTANTS.values():
        if chosen and not mutant.name.startswith(tuple(chosen)):
            continue
        p = [mutant.p(seed) for seed in range(100, 100 + repeats)]
        found = sum(value < ALARM for value in p)
        print(f"{mutant.name:36} {mutant.study:32} {found} of {repeats}", np.sort(p), flush=True)
        rows.append((mutant.name, mutant.study, repeats, found, f"{max(p):.2g}"))
    if not chosen:
        with TABLE.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("mutant", "study", "runs", "found", "largest_p"))
            writer.writerows(rows)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 3, sys.argv[2:])
