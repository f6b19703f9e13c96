"""The screen: all candidates, the basis and the detection statistics from one set of simulations.

B data sets are simulated at the fitted parameters and go through the same smoother as the data;
every statistic of the report that is not a refit takes its null law from them (`efficient.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.gap import detect, series
from ssmppl.gap.augment import augment
from ssmppl.gap.basis import Term, basis, lifted
from ssmppl.gap.candidate import Candidate
from ssmppl.gap.candidates import Chosen, Refused, offers
from ssmppl.gap.columns import score_columns
from ssmppl.gap.efficient import Efficient, Null, efficient
from ssmppl.gap.familywise import FamilyWise, familywise
from ssmppl.gap.scales import Scales
from ssmppl.gap.smoothing import Pass, Settings, Smoother, probability_transforms, simulated
from ssmppl.gap.when import bin_edges, binned
from ssmppl.inference.particles.filtering import random_state
from ssmppl.inference.runner import run_tasks
from ssmppl.inference.simulation import feeds_back
from ssmppl.language.distributions import Flat
from ssmppl.language.trace import Site, Trace, symbols

OWN_RUNS = 6  # passes over the data themselves, which tell the smoother's own noise
FEWEST = 60  # simulated sets that must have gone through


@dataclass(frozen=True)
class Statistics:
    """Of one data set: nuisance (P,), columns (K,), basis (D,), detection (S,).

    nuisance_bins (J, P), basis_bins (J, D) : sums over J bins of time.
    """

    nuisance: np.ndarray
    columns: np.ndarray
    basis: np.ndarray
    detection: np.ndarray
    nuisance_bins: np.ndarray
    basis_bins: np.ndarray


class Question:
    """What is asked of a model: candidates, basis, and the code that answers."""

    def __init__(
        self, trace: Trace, scales: Scales, missing: Missing, held: Sequence[str],
        settings: Settings, effects: Chosen = None,
    ):  # fmt: skip
        self.trace, self.settings, self.scales = trace, settings, scales
        offered, self.refused = offers(trace, scales, effects)
        self.terms: list[Term] = basis(trace, scales)
        unique: dict[str, Candidate] = {}
        for c in offered:
            unique.setdefault(c.increment.key, c.increment)
        plain = [*unique.values(), *(t.candidate for t in self.terms)]
        made, self.shapes = lifted(plain)
        superset = with_parameters(augment(trace, made), self.shapes)
        names = [c.strength for c in made]
        self.columns = score_columns(trace, superset, names, held, missing)
        self.smoother = Smoother(self.columns, missing, settings)
        for name, reason in self.columns.refused.items():
            at = next((c for c in plain if c.strength == name), None)
            label = (at.effect.name, at.equation) if at else (name, "")
            self.refused.append(Refused(*label, reason.reason))
        place = {n: len(self.columns.nuisance) + i for i, n in enumerate(self.columns.names)}
        by_key = {key: place.get(c.strength) for key, c in unique.items()}
        self.candidates: list[Candidate] = []
        self.place: list[int] = []
        for c in offered:
            found = by_key[c.increment.key]
            if found is not None:
                self.candidates.append(c)
                self.place.append(found)
        self.terms = [t for t in self.terms if t.candidate.strength in place]
        self.basis_place = [place[t.candidate.strength] for t in self.terms]

    def grid(self, variable: str) -> np.ndarray:
        """Values of a state or input at its quantiles, as the data have them."""
        return np.array(self.scales.scale[variable].quantiles)

    def theta(self, values: np.ndarray) -> np.ndarray:
        """The parameters of the columns: the model's own (P,), then the shapes."""
        symbols_ = self.columns.given.parameter_symbols[len(values) :]
        return np.append(values, [self.shapes[s.data[1]] for s in symbols_])

    @cached_property
    def sided(self) -> np.ndarray:
        """(K,) the sign that each strength must have."""
        return np.array([1 if c.effect.lower == 0.0 else 0 for c in self.candidates])

    @cached_property
    def quadratic(self) -> np.ndarray:
        """(K,) which statistics are quadratic forms."""
        return np.array([not c.first_order for c in self.candidates])

    def statistics(
        self, experiments: Sequence[Experiment], passes: Sequence[Pass], stream: np.ndarray
    ) -> Statistics:
        """Everything that is asked of one data set."""
        rows = np.concatenate([p.rows for p in passes])
        starts = np.cumsum([0, *(e.steps for e in experiments[:-1])]).tolist()
        edges = bin_edges(len(rows), starts)
        p = len(self.columns.nuisance)
        bins = binned(rows, edges)
        pits = np.concatenate(probability_transforms(passes, experiments, stream))
        return Statistics(
            rows[:, :p].sum(axis=0),
            self._of_candidates(rows, starts),
            rows[:, self.basis_place].sum(axis=0),
            self._detection(pits, experiments, starts).values,
            bins[:, :p],
            bins[:, self.basis_place],
        )

    def _of_candidates(self, rows: np.ndarray, starts: list[int]) -> np.ndarray:
        out = np.empty(len(self.candidates))
        lengths = np.diff([*starts, len(rows)])
        for k, (c, at) in enumerate(zip(self.candidates, self.place, strict=True)):
            own = rows[:, at]
            if c.process == "random walk":
                out[k] = series.random_walk(own[:, None], starts)[0]
            elif c.process == "ar1":
                memory = dict(c.shape)["memory"]
                out[k] = series.autoregressive(own[:, None], [memory], starts)[0, 0]
            elif c.effect.profile:
                out[k] = np.concatenate([c.weights(n) for n in lengths]) @ own
            else:
                out[k] = own.sum()
        return out

    def _detection(
        self, pits: np.ndarray, experiments: Sequence[Experiment], starts: list[int]
    ) -> detect.Statistics:
        channels = [repr(s) for s in self.trace.observation_symbols]
        inputs = np.concatenate([e.u for e in experiments])
        names = [repr(s) for s in self.trace.input_symbols]
        return detect.statistics(pits, channels, inputs, names, starts=starts)

    def detection_names(self, experiments: Sequence[Experiment]) -> detect.Statistics:
        """The detection statistics' names, with values of nothing."""
        rows = sum(e.steps for e in experiments)
        starts = np.cumsum([0, *(e.steps for e in experiments[:-1])]).tolist()
        nothing = np.full((rows, len(self.trace.observation_symbols)), 0.5)
        return self._detection(nothing, experiments, starts)


@dataclass(frozen=True)
class Screen:
    """The data's statistics beside those of B simulated sets.

    observed : means over passes. null : the simulated ones. found, family : of the candidates.
    """

    question: Question
    theta: np.ndarray
    observed: Statistics
    null: tuple[Statistics, ...]
    found: Efficient
    family: FamilyWise
    rows: np.ndarray
    experiments: tuple[Experiment, ...]

    def stacked(self, name: str) -> np.ndarray:
        """(B, ...) one statistic of all simulated sets."""
        return np.stack([getattr(s, name) for s in self.null])

    @property
    def information(self) -> np.ndarray:
        """(P, P) of the nuisance parameters, by the simulated sets."""
        s = self.stacked("nuisance")
        return s.T @ s / len(s)


def ask(
    question: Question, experiments: Sequence[Experiment], theta: np.ndarray, sets: int,
    seed: np.random.SeedSequence, executor: Executor | None = None, progress: bool = False,
    title: str = "screening",
) -> Screen:  # fmt: skip
    """Simulate, smooth, and put the data's statistics beside the simulated ones.

    theta : (P,) the fitted parameters.

    Raises
    ------
    ArgumentError : too few simulated sets went through the filter.
    """
    smoother, whole = question.smoother, question.theta(theta)
    feedback = feeds_back(question.trace)
    _ = smoother.program, smoother.module  # generated once, before threads ask for them

    def one(number: int) -> tuple[Statistics, np.ndarray | None] | None:
        stream = random_state(seed, number)
        data = list(experiments)
        if number >= OWN_RUNS:
            carried = whole[: len(question.columns.carried.parameter_symbols)]
            data = simulated(smoother.program, experiments, carried, stream, feedback)
        try:
            passes = smoother.run(data, whole, stream)
        except SamplingError:
            if number < OWN_RUNS:
                raise
            return None
        rows = np.concatenate([p.rows for p in passes])
        if not np.all(np.isfinite(rows)):
            return None
        kept = rows if number < OWN_RUNS else None
        return question.statistics(data, passes, stream), kept

    results = run_tasks(
        one, range(OWN_RUNS + sets), executor=executor, progress=progress, title=title
    )
    own = [r for r in results[:OWN_RUNS] if r is not None]
    null = [r[0] for r in results[OWN_RUNS:] if r is not None]
    if not own or len(null) < min(FEWEST, sets):
        raise ArgumentError(
            f"{len(null)} of {sets} data sets simulated at the fit went through the smoother",
            fix="use more particles, or check the fit: the model may leave its domain",
        )
    fields = Statistics.__dataclass_fields__
    each = {n: np.stack([getattr(s, n) for s, _ in own]) for n in fields}
    observed = Statistics(**{n: v.mean(axis=0) for n, v in each.items()})
    noise = each["columns"].var(axis=0, ddof=1) if len(own) > 1 else 0.0
    law = Null.of(
        np.stack([s.columns for s in null]), np.stack([s.nuisance for s in null]),
        quadratic=question.quadratic, sided=question.sided, noise=noise,
    )  # fmt: skip
    found = efficient(law, observed.columns, observed.nuisance)
    labels = {g: i for i, g in enumerate(dict.fromkeys(c.group for c in question.candidates))}
    groups = np.array([labels[c.group] for c in question.candidates])
    family = familywise(found.statistic, found.null, sided=found.sided, groups=groups)
    rows = np.mean([r for _, r in own if r is not None], axis=0)
    return Screen(question, theta, observed, tuple(null), found, family, rows, tuple(experiments))


def with_parameters(trace: Trace, values: Mapping[str, float]) -> Trace:
    """The trace with shapes as further parameters, which are given."""
    location = next(iter(trace.transition.values())).distribution.location
    parameters = dict(trace.parameters)
    for name in values:
        law = Flat()
        law.location = location
        own = symbols("parameter", name, ())
        parameters[name] = Site(name, "parameter", law, own, location)
    return replace(trace, parameters=parameters)


__all__ = ["Question", "Screen", "Statistics", "ask", "with_parameters"]
