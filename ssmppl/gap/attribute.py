"""Which effect: the leading candidates refitted, pairs of them, and one step after another.

Effects come together, and one at a time can look wrong: pairs are refitted beside single ones.
After that the screen is asked again around the model with what was chosen, and an effect is added
as long as one stands out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError
from ssmppl.gap.byrefit import quick_enough, refit_p, worth_testing
from ssmppl.gap.candidate import Candidate
from ssmppl.gap.checkpoint import Checkpoint
from ssmppl.gap.familywise import tail_p, threshold
from ssmppl.gap.fit import Fit
from ssmppl.gap.refit import Refit, Workshop, leading, pairs, refit_all
from ssmppl.gap.screen import Question, Screen, ask

MOST_EFFECTS = 3
MOST_WORK = 1.5e6  # rows times particles of a data set, beyond which no second screen is asked
FOLLOWERS = 3  # refits after a second screen
ASKED_AGAIN = 12  # groups in a second screen, those of which the first promises most


@dataclass
class Attribution:
    """What refits say, filled in as they come to an end.

    base : the model's own fit. refits, doubles : with one effect, with two; best first.
    chosen : what is kept, None for the model as it is. p : by the candidate's column, where its
    refit was tested itself. notes : why others were not refitted.
    """

    base: Fit
    refits: list[Refit] = field(default_factory=list)
    doubles: list[Refit] = field(default_factory=list)
    chosen: Refit | None = None
    p: dict[int, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def attribute(
    out: Attribution, workshop: Workshop, screen: Screen, train: Sequence[Experiment],
    seed: np.random.SeedSequence, alpha: float, kept: Checkpoint, *, always: bool = False,
    singles: int | None = None, steps: int = MOST_EFFECTS, quick: bool = False,
) -> None:  # fmt: skip
    """Refit, choose, and step forward; into `out`.

    always : choose the best one even where the screen finds nothing. singles : how many are
    refitted; None: the leading ones and their class mates. steps : effects in all. quick : without
    standard errors.
    """
    heads = leading(screen)[:singles]
    refits, failed = refit_all(
        workshop,
        out.base,
        screen,
        [[k] for k in heads],
        train,
        _seed(seed, 1),
        kept,
        "refitting",
        quick=quick,
    )
    out.notes += [f"not refitted: {reason}" for reason in failed]
    out.refits = refits
    testable = not always and _testable(workshop, screen, train)
    own = alpha / 2 if testable else alpha  # of two tests, each has half
    significant = bool(np.min(screen.family.p, initial=1.0) <= own)
    if not significant and testable:
        significant = _by_refit(out, workshop, screen, _seed(seed, 4), own, kept)
    if not refits or not (significant or always):
        return
    needed = needed_gain(screen, alpha)
    chosen = refits[0]
    if steps > 1:
        out.doubles, failed = refit_all(
            workshop, out.base, screen, pairs(screen, refits), train, _seed(seed, 2), kept,
            "refitting pairs", quick=quick,
        )  # fmt: skip
        out.notes += [f"not refitted: {reason}" for reason in failed]
        if out.doubles and out.doubles[0].gain - chosen.gain >= needed:
            chosen = out.doubles[0]
    out.chosen = chosen
    if significant and steps > 1:
        _forward(out, workshop, screen, train, _seed(seed, 3), alpha, kept, steps)
    if not quick:
        _measure(out, _seed(seed, 5), kept)


def _measure(out: Attribution, seed: np.random.SeedSequence, kept: Checkpoint) -> None:
    """Standard errors of what was chosen, from scores simulated at its fit."""
    old = out.chosen
    assert old is not None
    numbers = kept.of(
        "standard errors",
        lambda: {"information": old.fitter.measured(old.fit, seed).information},
    )
    new = replace(old, fit=replace(old.fit, information=np.array(numbers["information"])))
    out.chosen = new
    out.refits = [new if r is old else r for r in out.refits]


def _testable(workshop: Workshop, screen: Screen, train: Sequence[Experiment]) -> bool:
    """Whether the screen was asked on the rows of the refits, and these are quick."""
    same = [e.steps for e in train] == [e.steps for e in screen.experiments]
    return same and quick_enough(workshop, train)


def _by_refit(
    out: Attribution, workshop: Workshop, screen: Screen, seed: np.random.SeedSequence,
    alpha: float, kept: Checkpoint,
) -> bool:  # fmt: skip
    """Whether the best refit's own gain is more than chance."""
    if not worth_testing(screen, out.refits, alpha):
        return False
    p = refit_p(workshop, out.base, screen, out.refits, alpha, seed, kept)
    out.p[out.refits[0].index[0]] = p
    return p <= alpha


def needed_gain(screen: Screen, alpha: float) -> float:
    """Nats that the best of all candidates gains by chance with probability alpha."""
    return 0.5 * threshold(screen.family.maxima, alpha) ** 2


def _forward(
    out: Attribution, workshop: Workshop, screen: Screen, train: Sequence[Experiment],
    seed: np.random.SeedSequence, alpha: float, kept: Checkpoint, steps: int,
) -> None:  # fmt: skip
    """Ask again around the chosen model, and add what stands out."""
    chosen = out.chosen
    while chosen is not None and len(chosen.candidates) < steps:
        number = len(chosen.candidates)
        rest = _others(screen, chosen)
        work = sum(e.steps for e in train) * workshop.settings.particles
        if not rest:
            return
        if not chosen.fitter.exact and work > MOST_WORK:
            out.notes.append(
                "whether a further effect is missing was not asked: the record is too long"
            )
            return
        own = kept.within(f"with {number + 1} effects")
        try:
            again = _screen_again(chosen, screen, rest, train, workshop, seed, kept)
        except ArgumentError as error:
            out.notes.append(f"whether a further effect is missing is not known: {error.found}")
            return
        largest = float(np.max(again.family.height, initial=0.0))
        if tail_p(largest, screen.family.maxima) > alpha:  # few were asked, out of all
            return
        heads = leading(again)[:FOLLOWERS]
        more, _ = refit_all(
            workshop, chosen.fit, again, [[k] for k in heads], train, _seed(seed, 10 + number),
            own, "refitting", chosen.candidates,
        )  # fmt: skip
        if not more or more[0].gain < needed_gain(screen, alpha):
            return
        best = more[0]
        strengths = {c.key: k for k, c in enumerate(screen.question.candidates)}
        index = (*chosen.index, strengths[best.candidates[-1].key])
        chosen = Refit(index, best.candidates, best.fitter, best.fit, chosen.gain + best.gain)
        out.chosen = chosen


def _others(screen: Screen, chosen: Refit) -> list[Candidate]:
    """The candidates of the groups that promise most beside what was chosen.

    By the quadratic of the first screen: S~_j - V_jC V_CC^-1 S~_C and its variance.
    """
    groups, found = {c.group for c in chosen.candidates}, screen.found
    at = list(chosen.index)
    v, size = found.covariance, np.maximum(found.variance, 1e-300)
    slopes = np.linalg.lstsq(v[np.ix_(at, at)], v[at], rcond=1e-6)[0]  # (C, K)
    left = found.score - slopes.T @ found.score[at]
    variance = size - np.einsum("ck,ck->k", slopes, v[at])
    variance = np.maximum(variance, 0.02 * size)  # next to nothing: as good as the same effect
    best: dict[str, float] = {}
    for k, c in enumerate(screen.question.candidates):
        if c.group in groups or found.status[k]:
            continue
        if found.sided[k] * left[k] >= 0.0:
            best[c.group] = max(best.get(c.group, 0.0), float(left[k] ** 2 / variance[k]))
    kept = sorted(best, key=lambda g: -best[g])[:ASKED_AGAIN]
    return [c for c in screen.question.candidates if c.group in kept]


def _screen_again(
    chosen: Refit, screen: Screen, rest: Sequence[Candidate], train: Sequence[Experiment],
    workshop: Workshop, seed: np.random.SeedSequence, kept: Checkpoint,
) -> Screen:  # fmt: skip
    fitter, number = chosen.fitter, len(chosen.candidates)
    question = Question(
        fitter.problem.trace, screen.question.scales, workshop.missing, tuple(fitter.fixed),
        fitter.settings, candidates=rest,
    )  # fmt: skip
    stage = f"screening for effect {number + 1}"
    return ask(question, train, chosen.fit.theta, screen.sets, _seed(seed, number), kept, stage)


def _seed(seed: np.random.SeedSequence, stage: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, stage))


__all__ = ["Attribution", "attribute", "needed_gain"]
