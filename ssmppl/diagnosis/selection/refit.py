"""Refits: candidates that lead the screen, and pairs of them, fitted with all parameters.

The score is a screen only: noise that has grown shrinks it, and near equivalents swap places. What
ranks is the log-likelihood after refitting, each fit starting where the screen's quadratic
expects its top, with what predictions further ahead than one row gain.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate, is_dated, refine_wave, starts_of
from ssmppl.diagnosis.effects.effect import (
    ASKED,
    CHANGE_IN_TIME,
    MECHANISM,
    NOISE_LAW,
    UNKNOWN_INPUT,
)
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import (
    APPROXIMATELY,
    FROM_START,
    WITHOUT_ERRORS,
    Effort,
    Fit,
    Fitter,
    standard_errors,
)
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.seeds import Stream, Task, child_seed
from ssmppl.diagnosis.screening.efficient_score import Efficient
from ssmppl.diagnosis.screening.screen import Screen, ScreenDesign
from ssmppl.diagnosis.selection.horizons import SimulationGain
from ssmppl.diagnosis.selection.input_delays import PRICE, START, best_delay, is_input_delay
from ssmppl.diagnosis.selection.simulation_fit import SimulationFit, fit_for_simulation, restored
from ssmppl.errors import NotApplicable, SSMError
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.seeds import random_state

# Which candidates are refitted.
SINGLES, CORRELATED, PAIRS = 5, 4, 3  # leading ones, further ones like the best of them, pairs
MOST_OF_A_KIND = {CHANGE_IN_TIME: 2, UNKNOWN_INPUT: 2, NOISE_LAW: 1}  # of the leading ones
MOST_OF_NO_CAUSE = 3  # likewise, of these together
PAIRED = 12  # leading ones of which pairs are made
NOISES = 6  # laws of a noise beside the best one
LEAST_GAIN = 1.0  # nats that the score must promise for a refit
LEAST_PAIR_GAIN = 2.0  # nats that it must promise of a pair beyond the best single one
ALIKE = 0.8  # correlation with the best from which a candidate is refitted beside it
SAME = 0.95  # beyond which two candidates are one to begin with
SAME_IN_PAIR = 0.98  # beyond which they make no pair
NEAR = 25.0  # nats behind the best, up to which other delays and dates are tried
NEIGHBOURS = 6  # dates
ONE_SIGN, BELOW = 0.02, 0.15  # quantile of a variable, and how far noise may take it below 0

TIE = 0.5  # nats that tell no two refits apart
EXPLAINED = 0.5  # of the score of an unknown input, by a mechanism that is named in its place

# How a refit starts, and when it is ranked.
SHARES = (1.0, 0.5, 0.25)  # of the strengths that the score promises, from which a fit may start
OPEN, OPEN_SHARE = 5.0, 0.25  # nats, and share of its gain, that a fit may leave and be ranked
AGAIN = 2  # times that a fit which left more is taken up where it ended
LOST = 2.0  # nats below the model that it contains: a fit that ends there has failed


@dataclass(frozen=True)
class Begin:
    """Where the refit of a single effect begins. shape : of it, where that is another than the
    screen's. parameters : of the model, where those are others than the base fit's."""

    strength: float
    shape: Mapping[str, float]
    parameters: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Refit:
    """A model with effects, fitted.

    index : their places among the screen's candidates. gain : nats over the model without them.
    cost : of these, what the choice of their shapes is worth. ahead : nats that predictions more
    than one row ahead gain (`SimulationGain`). simulating : with the parameters for that. begin :
    where a search had its fit begin; None: where the score said.
    """

    index: tuple[int, ...]
    candidates: tuple[Candidate, ...]
    fitter: Fitter
    fit: Fit
    gain: float
    cost: float = 0.0
    ahead: float = 0.0
    simulating: SimulationFit | None = None
    begin: Begin | None = None

    @property
    def simulator(self) -> tuple[Fitter, Fit]:
        """The model by which it is simulated."""
        return self.simulating.model if self.simulating else (self.fitter, self.fit)

    @property
    def penalised_gain(self) -> float:
        """The gain that is tested: a date chosen among hundreds gains nats by that alone."""
        return self.gain - self.cost

    @property
    def score(self) -> float:
        """What ranks refits: gains at all horizons, of one row and of more."""
        return self.penalised_gain + self.ahead

    @property
    def asked(self) -> int:
        """When its effect is asked, of several the one that is asked last (`ASKED`)."""
        return max((ASKED[c.effect.cause] for c in self.candidates), default=0)

    def simulated(
        self, train: Sequence[Experiment], numbers: Numbers, of_base: SimulationGain | None
    ) -> Refit:
        """The same with what the numbers of its fit for simulation say."""
        if of_base is None:
            return self
        found = restored(self.fitter, self.fit, train, numbers)
        return replace(self, ahead=of_base.gain(found.squares), simulating=found)

    @property
    def strengths(self) -> list[float]:
        """Estimated strengths of the effects."""
        values = self.fit.by_component
        return [values[c.strength] for c in self.candidates]

    @property
    def bounds(self) -> list[str]:
        """Components that ran to a bound of their support."""
        return self.fit.bounds

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors of all free parameters, from the information at the fit."""
        return standard_errors(self.fit, self.fitter.fixed)


@dataclass(frozen=True)
class Start:
    """Where a refit's fit starts, and all of the screen that it needs.

    afresh : from the model's own start, but for `values`. strengths : names of those that may be
    too large. information : (names, matrix) of the parameters, for a fit by particles.
    """

    values: Mapping[str, np.ndarray]
    afresh: bool = False
    strengths: Sequence[str] = ()
    information: tuple[Sequence[str], np.ndarray] | None = None


def start_of(
    base: Fit, screen: Screen, index: Sequence[int], train: Sequence[Experiment],
    candidates: Sequence[Candidate], afresh: bool = False, begin: Begin | None = None,
) -> Start:  # fmt: skip
    """Where the refit with `candidates` starts, of which the last are the screen's at `index`, and
    the others are in `base`.

    begin : where that of a single effect does; None: where the screen's score says.
    afresh : with the strengths that the effects declare for that.
    """
    if afresh:
        return Start({c.strength: np.asarray(c.effect.afresh) for c in candidates}, afresh=True)
    new = candidates[-len(index) :]
    if begin is not None:
        strength = {new[-1].strength: np.asarray(begin.strength)}
        return Start(base.by_parameter | dict(begin.parameters) | strength)
    values = start_at(base, screen.design, screen.efficient, index)
    for k, c in zip(index, new, strict=True):
        if _of_other_length(screen, k, c):
            values[c.strength] = np.asarray(START)
    information = _information(screen, index, train)
    return Start(values, strengths=[c.strength for c in new], information=information)


def refit(
    augmented: AugmentedModels, base: Fit, index: Sequence[int], candidates: Sequence[Candidate],
    train: Sequence[Experiment], seed: np.random.SeedSequence, start: Start,
    approximate: bool = False,
) -> Refit | NotApplicable:  # fmt: skip
    """Fit the model with the effects of `candidates`, of which the last are those at `index`, and
    the others are in `base`. approximate : as of `Effort`."""
    candidates = tuple(candidates)
    effort = effort_for(candidates, approximate)
    try:
        fitter = augmented.fitter(candidates)
        if only_by_particles(augmented, fitter):
            return NotApplicable(
                f"{' and '.join(map(str, candidates))}: only a particle filter gives its "
                "likelihood, and that would call the simulator for each of its particles"
            )
        if start.afresh:
            fit = fitter.fit(train, seed, start.values)
        else:
            values = _backtracked(fitter, dict(start.values), start.strengths, train, seed)
            information = _placed(fitter, start.information)
            fit = fitter.fit(train, seed, values, effort, information=information)
        for _ in range(AGAIN):
            if not open_ended(fit, base):
                break
            more = fitter.fit(train, seed, fit.by_parameter, effort)
            fit = max(fit, more, key=lambda f: f.log_likelihood)
    except SSMError as error:
        return NotApplicable(f"{' and '.join(map(str, candidates))}: {error.found}")
    name = " and ".join(map(str, candidates))
    if not np.isfinite(fit.log_likelihood):
        return NotApplicable(f"{name}: the likelihood is zero")
    gain = fit.log_likelihood - base.log_likelihood
    if open_ended(fit, base):  # what it happened to reach is no rank
        return NotApplicable(
            f"{name}: the optimiser did not converge; gain so far {gain:.0f} nats, estimated "
            f"remaining gain {fit.distance:.0f} nats"
        )
    return Refit(tuple(index), candidates, fitter, fit, gain)


def only_by_particles(augmented: AugmentedModels, fitter: Fitter) -> bool:
    """Whether an effect, as outliers do, takes the Gaussian filter from a model that calls a
    simulator."""
    before, after = augmented.base_fitter.smoother.extended, fitter.smoother.extended
    return isinstance(before, Extended) and not isinstance(after, Extended)


def effort_for(candidates: Sequence[Candidate], approximate: bool = False) -> Effort:
    """The effort of a fit from near its top; several effects have standard errors only once they
    are chosen (`Fitter.with_information`)."""
    if approximate:
        return APPROXIMATELY
    return FROM_START if len(candidates) < 2 else WITHOUT_ERRORS


def open_ended(fit: Fit, base: Fit) -> bool:
    """Whether a fit is so far from its top that what it gains says little."""
    gain = fit.log_likelihood - base.log_likelihood
    return not fit.converged and fit.distance > max(OPEN, OPEN_SHARE * abs(gain))


def _backtracked(
    fitter: Fitter, start: dict[str, np.ndarray], strengths: Sequence[str],
    train: Sequence[Experiment], seed: np.random.SeedSequence,
) -> dict[str, np.ndarray]:  # fmt: skip
    """The start, or one with smaller strengths where that is more likely: the quadratic may promise
    a top beyond the data's cliff."""
    if fitter.exact or not strengths:
        return start
    tried = [start | {n: share * start[n] for n in strengths} for share in SHARES]
    points = np.array([space_of(fitter.problem, fitter.fixed, s).theta for s in tried])
    values = fitter.estimates(train, points, random_state(seed, Stream.START))
    return tried[int(np.argmax(values))]


def _information(
    screen: Screen, index: Sequence[int], train: Sequence[Experiment]
) -> tuple[Sequence[str], np.ndarray] | None:
    """Of the parameters with a score, from the simulated sets of the screen: names and matrix; None
    where a strength scales a process, whose score at zero tells nothing."""
    at, design = list(index), screen.design
    if np.any(design.quadratic[at]):
        return None
    names = [repr(s) for s in design.columns.nuisance]
    names += [design.candidates[k].strength for k in at]
    scores = np.concatenate(
        [screen.simulated.nuisance, screen.simulated.candidate_scores[:, at]], axis=1
    )
    rows = [sum(e.steps for e in es) for es in (train, screen.experiments)]
    return names, scores.T @ scores / len(scores) * rows[0] / rows[1]


def _placed(
    fitter: Fitter, information: tuple[Sequence[str], np.ndarray] | None
) -> np.ndarray | None:
    """The information as (P, P) of the fitter's parameters, where its fits need one."""
    if fitter.exact or information is None:
        return None
    names, found = information
    place = {repr(s): i for i, s in enumerate(fitter.problem.trace.parameter_symbols)}
    own = np.array([place[n] for n in names])
    out = np.zeros((len(place), len(place)))
    out[np.ix_(own, own)] = found
    return out


def start_at(
    base: Fit, design: ScreenDesign, found: Efficient, index: Sequence[int]
) -> dict[str, np.ndarray]:
    """The start of a refit, where the quadratic expects the top: of the strengths jointly, with the
    parameters as they are."""
    at = list(index)
    v = found.covariance[np.ix_(at, at)]
    strengths = np.linalg.lstsq(v, found.score[at], rcond=1e-6)[0]
    out = base.by_parameter
    for k, value in zip(at, strengths, strict=True):
        c = design.candidates[k]
        if design.quadratic[k]:
            value = np.sqrt(max(float(value), 1e-12))
        e = c.effect
        if e.profile == "wave":  # its phase has been chosen so
            value = abs(float(value))
        if np.isfinite(e.upper):  # between two bounds: well inside
            width = e.upper - e.lower
            value = np.clip(value, e.lower + 0.02 * width, e.upper - 0.02 * width)
        elif e.lower == 0.0:
            least = 0.2 / np.sqrt(max(float(found.variance[k]), 1e-12))
            value = max(float(value), least)
        out[c.strength] = np.asarray(float(value))
    return out


def leading(screen: Screen) -> list[int]:
    """The best shape of each of the best groups, the highest first; of those that are almost the
    same as one above them only those that are asked earlier (`ASKED`).

    What fits any misfit stands high at a fit far from the truth: of changes in time, of unknown
    inputs and of laws of the noise there are `MOST_OF_A_KIND` each and `MOST_OF_NO_CAUSE` in all,
    as long as causes promise anything.
    """
    cause = [screen.design.candidates[k].effect.cause for k in range(len(screen.groups))]
    different: list[int] = []
    for k in _promising(screen):
        same = [j for j in different if abs(screen.efficient.rho[k, j]) >= SAME]
        if all(ASKED[cause[k]] < ASKED[cause[j]] for j in same):
            different.append(k)
    counts, first, later = Counter[str](), [], []
    for k in different:
        kind = cause[k]
        if kind != MECHANISM:
            no_cause = sum(n for c, n in counts.items() if c != MECHANISM)
            if counts[kind] >= MOST_OF_A_KIND[kind] or no_cause >= MOST_OF_NO_CAUSE:
                later.append(k)
                continue
        counts[kind] += 1
        first.append(k)
    taken = set((first + later)[:SINGLES])
    return [k for k in different if k in taken]


def correlated_candidates(screen: Screen, refits: Sequence[Refit]) -> list[int]:
    """The columns of candidates that correlate with the best refit, to be refitted beside it."""
    if not refits:
        return []
    best, done = refits[0].index[0], {int(screen.groups[r.index[0]]) for r in refits}
    like = np.abs(screen.efficient.rho[best])
    found = [k for k in _promising(screen)
             if like[k] >= ALIKE and int(screen.groups[k]) not in done]  # fmt: skip
    return sorted(found, key=lambda k: -like[k])[:CORRELATED]


def other_noise_laws(screen: Screen, refits: Sequence[Refit]) -> list[int]:
    """Where a law of a noise gains most: the best form of each other one, in every equation, since
    noises share their scales. What a score promises is far less than what outliers, or a memory,
    gain once they are strong."""
    if not refits or refits[0].candidates[0].effect.cause != NOISE_LAW:
        return []
    candidates, out = screen.design.candidates, dict[tuple[str, str], int]()
    done = {(c.effect.name, c.equation) for r in refits for c in r.candidates}
    for k in _promising(screen):
        c = candidates[k]
        if c.effect.cause == NOISE_LAW and (c.effect.name, c.equation) not in done:
            out.setdefault((c.effect.name, c.equation), k)
    return list(out.values())[:NOISES]


def delays(screen: Screen, refits: Sequence[Refit]) -> list[int]:
    """The other numbers of states, as delays are, of those near the best that have one, and the
    dates next to those that are dated: nothing between two of them can be estimated. Of a model
    that calls a simulator no further dates, as each of its refits takes long."""
    called = bool(simulators(screen.design.trace))
    near = [r.index[0] for r in refits if refits[0].penalised_gain - r.penalised_gain <= NEAR]
    out: list[int] = []
    for best in near:
        c = screen.design.candidates[best]
        every = np.flatnonzero(screen.groups == screen.groups[best]).tolist()
        group = [k for k in every if k != best and not screen.efficient.status[k]]
        if is_input_delay(c):  # every length was tried
            continue
        if any(c.effect.states.values()) and len(out) < CORRELATED:
            out += group
        elif is_dated(c) and len(out) < CORRELATED and not called:
            dates = {k: float(dict(screen.design.candidates[k].shape)["date"]) for k in group}
            own = float(dict(c.shape)["date"])
            out += sorted(group, key=lambda k: abs(dates[k] - own))[:NEIGHBOURS]
    return out


def one_signed_candidates(screen: Screen) -> list[int]:
    """Candidates that the fitted model cannot show, as their variable keeps one sign in the data:
    a model of the speed whose sensor gives |speed| fits best where speeds never change theirs."""
    out = []
    for k in screen.family.leaders:
        c = screen.design.candidates[k]
        if c.effect.afresh is None:
            continue
        scale = screen.design.scales.scale.get(c.equation)  # a parameter has none
        if scale is None or scale.quantile(ONE_SIGN) >= -BELOW * scale.quantile(1.0 - ONE_SIGN):
            out.append(k)
    return out[:CORRELATED]


def best_of_groups(screen: Screen, refits: Sequence[Refit]) -> list[Refit]:
    """The best of refits that differ in their shapes only; best first."""
    out: dict[int, Refit] = {}
    for r in sorted(refits, key=lambda r: -r.score):
        out.setdefault(int(screen.groups[r.index[0]]), r)
    return list(out.values())


def preferred(refits: Sequence[Refit], worth: float) -> list[Refit]:
    """The refits in the order in which they are named: what gains most first, but for what fits any
    misfit, or what happened once: that comes behind a cause which is asked earlier (`ASKED`), gains
    `worth` by itself and has `EXPLAINED` of its score. Of equal ones, as a constant load and an
    offset of the only input are, the one that the catalogue has first."""
    rest, out = sorted(refits, key=lambda r: -r.score), []
    while rest:
        best = min((r for r in rest if r.score >= rest[0].score - TIE), key=lambda r: r.index)
        for r in rest:
            explains = r.penalised_gain >= worth and r.score >= EXPLAINED * rest[0].score
            if r.asked < best.asked and explains:
                best = r
        rest.remove(best)
        out.append(best)
    return out


def _promising(screen: Screen) -> list[int]:
    """The best shapes of the groups that promise anything."""
    found = screen.efficient
    return [k for k in screen.family.leaders if found.gain[k] >= LEAST_GAIN and not found.status[k]]


def pairs(screen: Screen, refits: Sequence[Refit]) -> list[tuple[int, int]]:
    """Pairs of which the quadratic expects more than of the best single one."""
    found, family = screen.efficient, screen.family
    heads = [k for k in family.leaders
             if not found.status[k] and not screen.design.quadratic[k]][:PAIRED]  # fmt: skip
    refitted = [r.index[0] for r in refits[:3] if not found.status[r.index[0]]]
    heads = list(dict.fromkeys([*refitted, *heads]))
    best, out = float(np.max(found.gain, initial=0.0)), []
    for i, a in enumerate(heads):
        for b in heads[i + 1 :]:
            if abs(found.rho[a, b]) > SAME_IN_PAIR:
                continue
            v = found.covariance[np.ix_([a, b], [a, b])]
            s = found.score[[a, b]]
            strength = np.linalg.solve(v, s)
            signs = found.sided[[a, b]]
            if np.any(signs * strength < 0.0):
                continue
            out.append((0.5 * float(s @ strength), (a, b)))
    out.sort(reverse=True)
    return [pair for gain, pair in out if gain > best + LEAST_PAIR_GAIN][:PAIRS]


def refit_all(
    augmented: AugmentedModels, base: Fit, screen: Screen, sets: Sequence[Sequence[int]],
    train: Sequence[Experiment], seed: np.random.SeedSequence, checkpoint: Checkpoint, stage: str,
    given: Sequence[Candidate] = (), *, afresh: bool = False, approximate: bool = False,
    simulation: SimulationGain | None = None, begins: Sequence[Begin] | None = None,
) -> tuple[list[Refit], list[str]]:  # fmt: skip
    """The refits that came to an end, best first, and why the others did not. afresh, approximate :
    as of `refit`. begins : of each set, of one effect. simulation : of the model as it is, for
    `Refit.ahead`; None: that is 0."""
    columns = sorted({k for s in sets for k in s})
    shaped = {k: screen.design.candidates[k] for k in columns}
    if begins is None:  # else the lengths are given
        shaped = _shaped(augmented.fitter(tuple(given)), base, screen, columns, train, seed)
    added = [(*given, *(shaped[k] for k in index)) for index in sets]
    if begins is not None:
        added = [(*a[:-1], a[-1].with_shape(**b.shape)) for a, b in zip(added, begins, strict=True)]

    known: Sequence[Begin | None] = [None] * len(sets) if begins is None else begins
    starts = [
        start_of(base, screen, index, train, candidates, afresh, begin)
        for index, candidates, begin in zip(sets, added, known, strict=True)
    ]
    one = partial(_one, augmented, base, list(sets), tuple(train), seed, added, starts,
                  approximate, simulation)  # fmt: skip
    done, reasons = [], []
    results = checkpoint.map(stage, len(sets), one)
    for i, (index, candidates, numbers) in enumerate(zip(sets, added, results, strict=True)):
        name = " and ".join(map(str, candidates))
        if checkpoint.failures.record_task(f"the refit with {name}", numbers):
            continue
        if "reason" in numbers:
            reasons.append(str(numbers["reason"]))
            continue
        fitter = augmented.fitter(candidates)
        fit = fitter.restored(train, numbers)
        gain = fit.log_likelihood - base.log_likelihood
        if gain < -LOST - 3.0 * np.hypot(fit.error, base.error):
            reasons.append(
                f"{name}: the optimiser failed: log-likelihood {-gain:.3g} nats below the nested "
                "base model"
            )
            continue
        cost = sum(screen.family.cost(int(screen.groups[k])) for k in index)
        cost += PRICE * sum(_of_other_length(screen, k, shaped[k]) for k in index)
        begin = known[i]
        cost += PRICE * bool(begin and begin.shape)
        made = Refit(tuple(index), candidates, fitter, fit, gain, cost, begin=begin)
        done.append(made.simulated(train, numbers, simulation))
    done.sort(key=lambda r: -r.score)
    return done, reasons


def _of_other_length(screen: Screen, k: int, c: Candidate) -> bool:
    """Whether `c`, in place of the column k, is a delay of another length."""
    return is_input_delay(c) and c.shape != screen.design.candidates[k].shape


def _one(
    augmented: AugmentedModels, base: Fit, sets: Sequence[Sequence[int]],
    train: Sequence[Experiment], seed: np.random.SeedSequence,
    added: Sequence[tuple[Candidate, ...]], starts: Sequence[Start], approximate: bool,
    simulation: SimulationGain | None, k: int,
) -> Numbers:  # fmt: skip
    """The numbers of one refit, or the reason why there are none."""
    own = child_seed(seed, Task.REFIT, k)
    found = refit(augmented, base, sets[k], added[k], train, own, starts[k], approximate)
    if isinstance(found, NotApplicable):
        return {"reason": np.array(found.reason)}
    if simulation is None:
        return found.fit.numbers
    found_for = fit_for_simulation(found.fitter, found.fit, train, simulation)
    return {**found.fit.numbers, **found_for.numbers}


def _shaped(
    fitter: Fitter, base: Fit, screen: Screen, index: Sequence[int], train: Sequence[Experiment],
    seed: np.random.SeedSequence,
) -> dict[int, Candidate]:  # fmt: skip
    """The candidates at `index`; delays of inputs among them with the best length beside `base`,
    which is of `fitter`; waves with their period and phase by all rows that the refits see, where
    a frequency that was near enough in the screen would lose its step."""
    design = screen.design
    out = {k: design.candidates[k] for k in index}
    for k, c in out.items():
        if is_input_delay(c):
            out[k] = best_delay(fitter, base.theta, c, train).candidate
    waves = [k for k, c in out.items() if c.effect.profile == "wave" and "period" in dict(c.shape)]
    if not waves:
        return out
    try:
        passes = design.smoother.run(
            train, design.theta(base.theta), random_state(seed, Stream.WAVES), predicted=False
        )
    except SSMError:
        return out
    rows = np.concatenate([p.rows for p in passes])
    starts = starts_of(train)
    longest = max(e.steps for e in screen.experiments)
    for k in waves:
        out[k] = refine_wave(out[k], rows[:, design.column_of[k]], starts, longest)
    return out
