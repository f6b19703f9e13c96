"""A rival: the loop that a practitioner goes round with a model that does not match.

Fit the model, look which of the catalogue's effects the smoothed disturbances have the largest
correlation with (`disturbances.py`), add that one, refit, and again, until Schwarz's criterion
(1978, "Estimating the dimension of a model", *Annals of Statistics* 6) does not fall any more, at
most three times.

All rows are fitted: the criterion needs none kept back. Fits are those of the diagnosis (`Fitter`):
exact for linear Gaussian models, else up the extended Kalman filter's likelihood from several
noise levels, and on by the particle filter's, whose estimate counts. An effect is added as the
diagnosis adds it (`AugmentedModels`), its strength free, its shape that of the column. It costs
half of log T nats for its strength and for each shape that was chosen among several.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import ssmppl as ssm
from bench.gap.disturbances import Disturbances
from bench.gap.records import Ranked
from ssmppl.diagnosis.effects.candidate import Candidate, with_all_dates
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels, proposal_of
from ssmppl.diagnosis.fitting.fit import FROM_START, Effort, Fit, Fitter
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.initial_law import proper_initial_law
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.errors import SSMError
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose
from ssmppl.modelfile import load_model, read_csv

EFFECTS = 3  # at most
PARTICLES = {"twisted": 100}  # of the filters, as the diagnosis has them; 1000 of the others
SHARES = (1.0, 0.5, 0.25)  # of the strength that the disturbances tell, where a refit may start
AGAIN = 2  # times that a fit which is not at its top is taken up where it ended
INSIDE = 0.05  # of a strength's range, from its bounds, where a refit may start
FAILED = 5  # refits that may fail before the loop ends


Told = tuple[str, tuple[Ranked, ...], int]  # verdict, ranking, how many of it were added


def of_folder(folder: Path) -> Told:
    """The loop on one set's folder."""
    return Loop(load_model(str(folder / "model.py")), read_csv(folder / "data.csv")).run()


class Loop:
    """The loop on one model and its data, one experiment."""

    def __init__(self, model: ssm.Model, data: object, seed: int = 1):
        problem = pose(model, data)
        (self.e,) = self.experiments = problem.experiments
        proposal = proposal_of(problem.program)
        settings = Settings(PARTICLES.get(proposal, 1000), proposal)
        self.augmented = AugmentedModels(problem.trace, problem.program.missing, {}, settings)
        self.seed = np.random.SeedSequence(seed)

    def run(self) -> Told:
        """Round and round."""
        fitter = self.augmented.base_fitter
        fit = self._climbed(fitter, {}, Effort())
        candidates = self._offered(fitter, fit)
        shapes = searched_shapes(candidates)
        order: list[Candidate] = []
        chosen: list[tuple[Candidate, float]] = []
        while len(chosen) < EFFECTS:
            try:
                seen = Disturbances(fitter, fit, self.e)
            except (SSMError, ValueError):
                if not chosen:
                    raise
                break  # of this model no states are known: what was added stands
            leading = self._leading(seen, candidates)
            order = order or [c for c, _ in leading]
            found = self._refitted([c for c, _ in chosen], seen, leading)
            if found is None:
                break
            c, fitter, new = found
            cost = 0.5 * (1 + shapes[c.group]) * math.log(self.e.steps)
            gain = new.log_likelihood - fit.log_likelihood - cost
            if not gain > 0.0:
                break
            fit = new
            chosen.append((c, gain))
            candidates = [other for other in candidates if other.group != c.group]
        return told(chosen, order)

    def _offered(self, fitter: Fitter, fit: Fit) -> list[Candidate]:
        """What the catalogue has for the model, with every date and period."""
        x = Disturbances(fitter, fit, self.e).x
        trace, e = fitter.problem.trace, self.e
        self.augmented.initial_law = proper_initial_law(trace, [x[0]], [x])
        y = np.where(e.seen == 1.0, e.y, np.nan)
        found, _ = offers(trace, Scales.of(trace, x, y, e.u, e.steps))
        return with_all_dates(found, e.steps)

    def _leading(
        self, seen: Disturbances, candidates: Sequence[Candidate]
    ) -> list[tuple[Candidate, np.ndarray]]:
        """The best shape of each candidate with its column, the largest correlation first."""
        columns: dict[str, np.ndarray | None] = {}
        best: dict[str, tuple[float, Candidate]] = {}
        for c in candidates:
            key = c.increment.key
            if key not in columns:
                columns[key] = seen.column(c)
            column = columns[key]
            if column is None:
                continue
            z = abs(seen.statistic(c, column))
            if z > best.get(c.group, (0.0, c))[0]:
                best[c.group] = z, c
        order = sorted(best.values(), key=lambda pair: -pair[0])
        pairs = ((c, columns[c.increment.key]) for _, c in order)
        return [(c, column) for c, column in pairs if column is not None]

    def _refitted(
        self, added: list[Candidate], seen: Disturbances,
        leading: Sequence[tuple[Candidate, np.ndarray]],
    ) -> tuple[Candidate, Fitter, Fit] | None:  # fmt: skip
        """The model with the leading effect; with the next one where that cannot be fitted."""
        for c, column in leading[:FAILED]:
            c = seen.refined(c, column)
            start = seen.fit.by_parameter
            strength = seen.strength(c, column)
            try:
                fitter = self.augmented.fitter([*added, c])
                starts = [start | {c.strength: np.asarray(_inside(c, s * strength))}
                          for s in SHARES]  # fmt: skip
                best = max(starts, key=lambda at: self._value(fitter, at))
                return c, fitter, self._climbed(fitter, best, FROM_START)
            except SSMError:
                continue
        return None

    def _climbed(self, fitter: Fitter, start: dict[str, np.ndarray], effort: Effort) -> Fit:
        fit = fitter.fit(self.experiments, self.seed, _of_model(fitter, start), effort)
        for _ in range(AGAIN):
            if fit.converged:
                break
            more = fitter.fit(self.experiments, self.seed, fit.by_parameter, FROM_START)
            fit = max(fit, more, key=lambda f: f.log_likelihood)
        return fit

    def _value(self, fitter: Fitter, start: dict[str, np.ndarray]) -> float:
        problem = replace(fitter.problem, experiments=self.experiments)
        theta = space_of(problem, fitter.fixed, _of_model(fitter, start)).theta
        return fitter.value(self.experiments, theta)


def _of_model(fitter: Fitter, start: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What of a start is a parameter of the model."""
    return {n: v for n, v in start.items() if n in fitter.problem.trace.parameters}


def _inside(c: Candidate, strength: float) -> float:
    """A strength inside its bounds."""
    low, high = c.effect.lower, c.effect.upper
    if math.isfinite(high):
        return float(np.clip(strength, low + INSIDE * (high - low), high - INSIDE * (high - low)))
    return max(strength, 1e-12) if low == 0.0 else strength


def searched_shapes(candidates: Sequence[Candidate]) -> dict[str, int]:
    """By group, how many shapes there were several values of."""
    values: dict[str, dict[str, set[float]]] = defaultdict(lambda: defaultdict(set))
    for c in candidates:
        for name, value in c.shape:
            values[c.group][name].add(value)
    counts = {group: sum(len(v) > 1 for v in own.values()) for group, own in values.items()}
    return defaultdict(int, counts)


def told(chosen: Sequence[tuple[Candidate, float]], order: Sequence[Candidate]) -> Told:
    """The effects that were added, with the nats that each gained beyond its cost, and the others
    by the first correlations."""
    gains: dict[tuple[str, str], float] = {}
    for c, gain in chosen:
        gains.setdefault((c.effect.name, c.equation), gain)
    labels = [*gains, *((c.effect.name, c.equation) for c in order)]
    ranked = tuple(
        Ranked(*label, str(k), gain=gains.get(label, math.nan))
        for k, label in enumerate(dict.fromkeys(labels))
    )
    return ("effect" if gains else "no measurable gap"), ranked, len(gains)
