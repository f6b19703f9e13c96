"""The screen: all candidates, the basis and the detection statistics from one set of simulations.

B data sets are simulated at the fitted parameters and go through the same smoother as the data;
every statistic of the report that is not a refit takes its null distribution from them
(`efficient_score.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate, Profiles, starts_of, with_all_dates
from ssmppl.diagnosis.model.augment import augment, with_given_parameters
from ssmppl.diagnosis.model.basis import BasisTerm, basis, symbolic_shapes
from ssmppl.diagnosis.model.candidates import Chosen, Refused, offers
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.score_columns import ScoreExpressions, score_columns
from ssmppl.diagnosis.model.simulated_records import REACHES, Simulator, middle_and_range
from ssmppl.diagnosis.model.smoothing import (
    Pass,
    Settings,
    Smoother,
    mean_scores,
    probability_transforms,
)
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.failures import FAULT, Failures
from ssmppl.diagnosis.screening import detection, statistics
from ssmppl.diagnosis.screening.efficient_score import Efficient, Null, efficient
from ssmppl.diagnosis.screening.familywise import FamilyWise, familywise
from ssmppl.diagnosis.screening.location import BasisGroupScore, bin_edges, binned, group_score
from ssmppl.diagnosis.screening.statistics import information_scale, typical_squares
from ssmppl.errors import ArgumentError, ModelError, SamplingError
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.model.trace import Trace

OWN_RUNS = 6  # passes over the data themselves, which show the smoother's own noise
FEWEST = 60  # simulated sets that must have gone through


@dataclass(frozen=True)
class ScreenStatistics:
    """Statistics of one data set: nuisance (P,), candidate_scores (K,), basis (D,), detection (S,).

    squares (K,) : of the rows of each score, summed; NaN where it is no plain sum of rows.
    nuisance_bins (J, P), basis_bins (J, D) : sums over J bins of time.
    """

    nuisance: np.ndarray
    candidate_scores: np.ndarray
    squares: np.ndarray
    basis: np.ndarray
    detection: np.ndarray
    nuisance_bins: np.ndarray
    basis_bins: np.ndarray


class ScreenDesign:
    """The candidate effects of a model, the basis, and their compiled score columns."""

    def __init__(
        self, trace: Trace, scales: Scales, missing: Missing, held: Sequence[str],
        settings: Settings, effects: Chosen = None, *,
        candidates: Sequence[Candidate] | None = None, simulator: Simulator | None = None,
        failures: Failures | None = None,
    ):  # fmt: skip
        """candidates : these instead of what the catalogue offers, and no basis. simulator : of the
        model, where it is not the plain one. failures : takes the candidates that a fault ends."""
        failures = Failures() if failures is None else failures
        self._simulator = simulator
        self.trace, self.settings, self.scales = trace, settings, scales
        self.refused: list[Refused] = []
        self.terms: list[BasisTerm] = []
        if candidates is None:
            offered, self.refused = offers(trace, scales, effects, failures)
            offered = with_all_dates(offered, scales.rows)
            with failures.guard("the basis of smooth functions"):
                self.terms = basis(trace, scales)
        else:
            offered = list(candidates)
        unique: dict[str, Candidate] = {}
        for c in offered:
            unique.setdefault(c.increment.key, c.increment)
        plain = [*unique.values(), *(t.candidate for t in self.terms)]
        try:
            self.columns, self.shapes = _columns(trace, plain, held, missing)
        except ModelError:  # of the user's own effect
            raise
        except Exception:
            if failures.raised:
                raise
            plain = _compilable(trace, plain, held, missing, failures)
            self.columns, self.shapes = _columns(trace, plain, held, missing)
        self.smoother = Smoother(self.columns, missing, settings)
        for name, reason in self.columns.refused.items():
            at = next((c for c in plain if c.strength == name), None)
            label = (at.effect.name, at.equation) if at else (name, "")
            self.refused.append(Refused(*label, reason.reason))
        place = {n: len(self.columns.nuisance) + i for i, n in enumerate(self.columns.names)}
        by_key = {key: place.get(c.strength) for key, c in unique.items()}
        self.candidates: list[Candidate] = []
        self.column_of: list[int] = []
        for c in offered:
            found = by_key[c.increment.key]
            if found is not None:
                self.candidates.append(c)
                self.column_of.append(found)
        self.terms = [t for t in self.terms if t.candidate.strength in place]
        self.basis_columns = [place[t.candidate.strength] for t in self.terms]
        self._profiled = [k for k, c in enumerate(self.candidates)
                       if c.effect.profile and not c.process]  # fmt: skip
        self._profiles = Profiles(
            tuple(self.candidates[k] for k in self._profiled),
            tuple(self.column_of[k] for k in self._profiled),
        )

    @cached_property
    def simulator(self) -> Simulator:
        """Draws data sets from the model."""
        s = self.smoother
        if self._simulator is not None:
            return self._simulator
        return Simulator(s.program, s.missing, s.kalman)

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
        return np.array([c.sided for c in self.candidates], dtype=int)

    @cached_property
    def _plain_sums(self) -> np.ndarray:
        """(K,) which statistics are sums of one column's rows, all with the same weight."""
        return np.array([not (c.process or c.effect.profile) for c in self.candidates])

    @cached_property
    def quadratic(self) -> np.ndarray:
        """(K,) which statistics are quadratic forms."""
        return np.array([not c.first_order for c in self.candidates])

    def statistics(
        self, experiments: Sequence[Experiment], passes: Sequence[Pass], stream: np.ndarray,
        checks: bool = True,
    ) -> ScreenStatistics:  # fmt: skip
        """The statistics of one data set; without `checks` none of its predictions."""
        rows = np.concatenate([p.rows for p in passes])
        starts = starts_of(experiments)
        edges = bin_edges(len(rows), starts)
        p = len(self.columns.nuisance)
        bins = binned(rows, edges)
        found = np.empty(0)
        if checks:
            pits = np.concatenate(probability_transforms(passes, experiments, stream))
            # Predictions that leave the domain are as wrong as can be: how far says nothing.
            most = REACHES[-1] * middle_and_range(experiments)[1]
            ahead = [np.clip(p.ahead, -most, most) for p in passes if p.ahead is not None]
            found = self._detection(pits, experiments, starts, ahead).values
        return ScreenStatistics(
            rows[:, :p].sum(axis=0),
            self._candidate_statistics(rows, starts),
            np.where(self._plain_sums, np.sum(rows**2, axis=0)[self.column_of], np.nan),
            rows[:, self.basis_columns].sum(axis=0),
            found,
            bins[:, :p],
            bins[:, self.basis_columns],
        )

    def _candidate_statistics(self, rows: np.ndarray, starts: list[int]) -> np.ndarray:
        out = np.empty(len(self.candidates))
        for k, (c, at) in enumerate(zip(self.candidates, self.column_of, strict=True)):
            own = rows[:, at, None]
            if c.process == "random walk":
                out[k] = statistics.random_walk(own, starts)[0]
            elif c.process == "ar1":
                out[k] = statistics.autoregressive(own, [dict(c.shape)["memory"]], starts)[0, 0]
            elif not c.effect.profile:
                out[k] = own.sum()
        out[np.array(self._profiled, dtype=int)] = self._profiles.statistics(rows, starts)
        return out

    def _detection(
        self, pits: np.ndarray, experiments: Sequence[Experiment], starts: list[int],
        ahead: Sequence[np.ndarray],
    ) -> detection.PredictionChecks:  # fmt: skip
        channels = [repr(s) for s in self.trace.observation_symbols]
        inputs = np.concatenate([e.u for e in experiments])
        names = [repr(s) for s in self.trace.input_symbols]
        found = detection.statistics(pits, channels, inputs, names, starts=starts)
        for channel, values in mean_scores(ahead, channels).items():
            found = found.with_values(channel, values)
        return found

    def detection_names(self, experiments: Sequence[Experiment]) -> detection.PredictionChecks:
        """The detection statistics' names, with values of nothing."""
        rows = sum(e.steps for e in experiments)
        starts = starts_of(experiments)
        nothing = np.full((rows, len(self.trace.observation_symbols)), 0.5)
        return self._detection(nothing, experiments, starts, ())


@dataclass(frozen=True)
class Screen:
    """The data's statistics beside those of B simulated sets.

    observed : means over passes. simulated : (B, ...) of the simulated sets. efficient, family : of
    the candidates, as compared with `null`. typical_squares : (K,) of the columns, of one set.
    left : share of the records drawn from the fit that left its domain (`Simulator.counted_sets`).
    """

    design: ScreenDesign
    theta: np.ndarray
    observed: ScreenStatistics
    simulated: ScreenStatistics
    efficient: Efficient
    family: FamilyWise
    null: Null
    typical_squares: np.ndarray
    experiments: tuple[Experiment, ...]
    left: float = 0.0

    def columns_of(self, chosen: Sequence[Candidate]) -> tuple[np.ndarray, np.ndarray]:
        """(B, K), (K,) scores of these candidates, simulated and observed; of those among them
        whose statistic is a sum of scores. A shape that the screen has not (a period that was
        refined) stands for the best one of its group."""
        known, best = self._places
        found = (known.get(c.key, best.get(c.group)) for c in chosen if c.first_order)
        own = sorted({k for k in found if k is not None})
        return self.simulated.candidate_scores[:, own], self.observed.candidate_scores[own]

    @cached_property
    def _places(self) -> tuple[dict[str, int], dict[str, int]]:
        """Columns of the candidates by their keys, and the best ones of the groups by theirs."""
        candidates = self.design.candidates
        best = {candidates[k].group: int(k) for k in self.family.best}
        return {c.key: k for k, c in enumerate(candidates)}, best

    def basis_group(
        self, columns: Sequence[int], others: Sequence[Candidate] = ()
    ) -> BasisGroupScore:
        """The statistic of these columns of the basis with the scores of others projected out."""
        own = list(columns)
        return group_score(
            self.simulated.basis[:, own], self.observed.basis[own], self.simulated.nuisance,
            self.observed.nuisance, *self.columns_of(others),
        )  # fmt: skip

    @cached_property
    def edges(self) -> np.ndarray:
        """(J + 1,) first rows of the bins of time."""
        rows = sum(e.steps for e in self.experiments)
        return bin_edges(rows, starts_of(self.experiments))

    @property
    def sets(self) -> int:
        """B, the simulated sets that went through."""
        return len(self.simulated.nuisance)

    @property
    def candidate_p(self) -> np.ndarray:
        """(K,) family-wise p of the group of each candidate."""
        return self.family.of_columns(self.groups)

    @cached_property
    def groups(self) -> np.ndarray:
        """(K,) labels of the candidates' groups."""
        return groups_of(self.design.candidates)


def _columns(
    trace: Trace, candidates: Sequence[Candidate], held: Sequence[str], missing: Missing
) -> tuple[ScoreExpressions, dict[str, float]]:
    """The score columns of the model with all candidates, and the values of their shapes."""
    made, shapes = symbolic_shapes(candidates)
    superset = with_given_parameters(augment(trace, made, first_order=True), shapes)
    names = [c.strength for c in made]
    return score_columns(trace, superset, names, held, missing), dict(shapes)


def _compilable(
    trace: Trace, candidates: Sequence[Candidate], held: Sequence[str], missing: Missing,
    failures: Failures,
) -> list[Candidate]:  # fmt: skip
    """The candidates that have columns by themselves; the others are recorded as failures."""
    out = []
    for c in candidates:
        with failures.guard(f"the candidate {c}"):
            _columns(trace, [c], held, missing)
            out.append(c)
    return out


def groups_of(candidates: Sequence[Candidate]) -> np.ndarray:
    """(K,) a number for each group: candidates that differ in their shape only."""
    labels = {g: i for i, g in enumerate(dict.fromkeys(c.group for c in candidates))}
    return np.array([labels[c.group] for c in candidates], dtype=int)


def run_screen(
    design: ScreenDesign, experiments: Sequence[Experiment], theta: np.ndarray, sets: int,
    seed: np.random.SeedSequence, checkpoint: Checkpoint, stage: str = "screening", *,
    checks: bool = True,
) -> Screen:  # fmt: skip
    """The screen: data sets simulated at the fit, smoothed, and the data compared with them.

    theta : (P,) the fitted parameters. checkpoint : takes every set as soon as it is done, as
    `stage`. checks : whether those of the predictions are wanted, which cost something.

    Raises
    ------
    ArgumentError : too few simulated sets went through the filter.
    """
    smoother, whole = design.smoother, design.theta(theta)
    _ = smoother.program, smoother.module, design.simulator  # before threads ask for them
    one = partial(_one_set, design, tuple(experiments), whole, seed, checks)
    results = checkpoint.map(stage, OWN_RUNS + sets, one)
    faults = [r for r in results if checkpoint.failures.record_task(f"a data set of {stage}", r)]
    own = [r for r in results[:OWN_RUNS] if r and FAULT not in r]
    drawn = [r for r in results[OWN_RUNS:] if r and FAULT not in r]
    if not own or len(drawn) < min(FEWEST, sets):
        why = f": {faults[0][FAULT]}" if faults else ""
        raise ArgumentError(
            f"the smoother succeeded on only {len(drawn)} of {sets} parametric-bootstrap data "
            f"sets{why}",
            fix="use more particles, or check the fit: the model may leave its domain",
        )
    names = ScreenStatistics.__dataclass_fields__
    each = {n: np.stack([s[n] for s in own]) for n in names}
    observed = ScreenStatistics(**{n: v.mean(axis=0) for n, v in each.items()})
    simulated = ScreenStatistics(**{n: np.stack([s[n] for s in drawn]) for n in names})
    typical = typical_squares(simulated.squares)
    noise = each["candidate_scores"] / information_scale(each["squares"], typical)
    null = Null.of(
        simulated.candidate_scores / information_scale(simulated.squares, typical),
        simulated.nuisance,
        quadratic=design.quadratic, sided=design.sided,
        noise=noise.var(axis=0, ddof=min(1, len(own) - 1)),
    )  # fmt: skip
    found = compare_with_null(null, typical, observed)
    family = familywise(
        found.statistic, found.null, sided=found.sided, groups=groups_of(design.candidates)
    )
    left = 1.0 - len(drawn) / sum(int(s["draws"]) for s in drawn)
    return Screen(
        design, theta, observed, simulated, found, family, null, typical, tuple(experiments), left
    )


def screen_part(
    whole: Screen, experiments: Sequence[Experiment], theta: np.ndarray,
    seed: np.random.SeedSequence,
) -> Screen:  # fmt: skip
    """The screen of a part of the data by the distribution of the sets that were simulated for all
    of them.

    theta : (P,) fitted to the part. The scale is that of the information which the part holds
    (`compare_with_null`), so that little changes where a tenth is missing, and nothing is
    simulated.
    """
    design, at = whole.design, whole.design.theta(theta)
    one = partial(_one_set, design, tuple(experiments), at, seed, False)
    own = [r for r in map(one, range(OWN_RUNS)) if r]
    if not own:
        raise SamplingError(
            "the rows without the block did not go through the smoother", fix="use more particles"
        )
    empty = np.empty(0)
    observed = ScreenStatistics(**{
        n: np.mean([s[n] for s in own], axis=0) if n != "detection" else empty
        for n in ScreenStatistics.__dataclass_fields__
    })  # fmt: skip
    found = compare_with_null(whole.null, whole.typical_squares, observed)
    family = familywise(found.statistic, found.null, sided=found.sided, groups=whole.groups)
    return replace(
        whole, theta=theta, observed=observed, efficient=found, family=family,
        experiments=tuple(experiments),
    )  # fmt: skip


def _one_set(
    design: ScreenDesign, experiments: Sequence[Experiment], theta: np.ndarray,
    seed: np.random.SeedSequence, checks: bool, number: int,
) -> Numbers:  # fmt: skip
    """The statistics of the data (the first `OWN_RUNS`) or of a simulated set; empty where it did
    not go through. theta : of the columns."""
    smoother, stream = design.smoother, random_state(seed, number)
    data, draws = list(experiments), 1
    try:
        if number >= OWN_RUNS:
            own = theta[: len(design.columns.base.parameter_symbols)]
            data, draws = design.simulator.counted_sets(experiments, own, stream)
        passes = smoother.run(data, theta, stream, predicted=checks, ahead=checks)
    except SamplingError:
        if number < OWN_RUNS:
            raise
        return {}
    if not all(np.all(np.isfinite(p.rows)) for p in passes):
        return {}
    with np.errstate(over="ignore", invalid="ignore"):
        found = design.statistics(data, passes, stream, checks)
    if not np.all(np.isfinite(found.candidate_scores)) or np.any(np.isinf(found.squares)):
        return {}  # rows whose squares are beyond what a number can be
    return dict(vars(found)) | {"draws": np.asarray(draws)}


def compare_with_null(null: Null, typical: np.ndarray, seen: ScreenStatistics) -> Efficient:
    """Efficient statistics of the candidates in one data set, each on the scale of the information
    that these data hold."""
    by = information_scale(seen.squares, typical)
    found = efficient(null, seen.candidate_scores / by, seen.nuisance)
    return replace(
        found, score=found.score * by, variance=found.variance * by**2,
        strength=found.strength / by,
    )  # fmt: skip
