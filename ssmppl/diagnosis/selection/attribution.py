"""Which effect: the leading candidates refitted, pairs of them, and one step after another.

Effects come together, and one at a time can look wrong: pairs are refitted beside single ones, and
the screen is asked again around the model with the best of these, for one more effect. From the
better of the two pairs it goes on, as long as an effect stands out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ssmppl.data import Experiment, unpack_parameters
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.familywise import threshold
from ssmppl.diagnosis.screening.screen import Question, Screen, ask
from ssmppl.diagnosis.selection.augmented_models import Workshop
from ssmppl.diagnosis.selection.fit import Fit
from ssmppl.diagnosis.selection.refit import (
    Refit,
    asleep,
    best_of_groups,
    delays,
    leading,
    mates,
    pairs,
    refit_all,
)
from ssmppl.diagnosis.selection.refit_test import LAX, gain_p, quick_enough, refit_p
from ssmppl.diagnosis.selection.shapes import shaped_all
from ssmppl.errors import SSMError

AFRESH = "fitting anew"
MOST_EFFECTS = 3
MOST_WORK = 1.5e6  # rows times particles of a data set, beyond which no second screen is asked
FOLLOWERS, AGAIN = 3, 100  # refits after a second screen, and the simulated sets of that


@dataclass
class Attribution:
    """What refits say, filled in as they come to an end.

    base : the model's own fit. refits, doubles : with one effect, with two; best first.
    chosen : what is kept, None for the model as it is. fewer : what it grew from, the fewest
    effects first. p : by the candidate's column, where its refit was tested itself. notes : why
    others were not refitted. unfitted : the column of what stands out most, where it could not be
    refitted and nothing that could be gains as much. rebased : whether `base` is not what the
    screen was asked at. left_out : whether fewer were chosen in the end, by the held-out rows.
    """

    base: Fit
    refits: list[Refit] = field(default_factory=list)
    doubles: list[Refit] = field(default_factory=list)
    chosen: Refit | None = None
    fewer: list[Refit] = field(default_factory=list)
    p: dict[int, float] = field(default_factory=dict)
    unfitted: int | None = None
    rebased: bool = False
    left_out: bool = False
    notes: list[str] = field(default_factory=list)


def attribute(
    out: Attribution, workshop: Workshop, screen: Screen, train: Sequence[Experiment],
    seed: np.random.SeedSequence, alpha: float, kept: Checkpoint, *, always: bool = False,
    singles: int | None = None, steps: int = MOST_EFFECTS, quick: bool = False,
) -> None:  # fmt: skip
    """Refit, choose, and step forward; into `out`.

    always : choose the best one even where the screen finds nothing. singles : how many are
    refitted; None: the leading ones and their class mates. steps : effects in all. quick : by rough
    fits (`Fitter.fit`), without standard errors.
    """
    refits: list[Refit] = []
    stages: dict[str, Callable[[], list[int]]] = {"refitting": lambda: leading(screen)[:singles]}
    if singles is None:
        stages["refitting what is like it"] = lambda: mates(screen, refits)
        stages["refitting other delays"] = lambda: delays(screen, refits)
        stages[AFRESH] = lambda: asleep(screen)
    for stage, which in stages.items():
        with kept.failures.part(stage):
            heads = which()
            more, failed = refit_all(
                workshop, out.base, screen, [[k] for k in heads], train, _seed(seed, 1), kept,
                stage, afresh=stage == AFRESH, rough=quick,
            )  # fmt: skip
            refits = best_of_groups(screen, refits + more)
            out.notes += [f"not refitted: {reason}" for reason in failed]
    out.refits = refits
    significant = False
    if not always:
        own = alpha / 2  # of two tests, each has half
        with kept.failures.part("the model fitted from the best refit"):
            _rebase(out, workshop, train, _seed(seed, 6), kept, needed_gain(screen, alpha))
        if out.rebased:  # the screen was asked at the wrong place
            out.p |= {r.index[0]: gain_p(screen, r) for r in out.refits}
        else:
            significant = bool(np.min(screen.family.p, initial=1.0) <= own)
            out.unfitted = _unfitted(screen, refits, own)
        with kept.failures.part("the test of what a refit gains"):
            significant |= _by_refit(out, workshop, screen, train, _seed(seed, 4), own, kept)
    if not out.refits or not (significant or always) or out.unfitted is not None:
        return
    scales = screen.question.scales
    if not quick:
        with kept.failures.part("estimating shapes"):
            out.refits = shaped_all(
                workshop, out.base, scales, out.refits, train, _seed(seed, 7), kept,
                "estimating shapes",
            )  # fmt: skip
    out.chosen = out.refits[0]
    single, pair = out.chosen, None
    if steps > 1:
        rival = None
        with kept.failures.part("pairs of effects"):
            rival = _best_pair(
                out, workshop, screen, train, _seed(seed, 2), alpha, kept, rough=quick
            )
        # a step from the best one, against the best pair
        with kept.failures.part("whether a second effect is missing"):
            _forward(out, workshop, screen, train, _seed(seed, 3), alpha, kept, 2, rough=quick)
        if rival is not None and rival.merit > out.chosen.merit:
            out.chosen = rival
        if len(out.chosen.candidates) == 2:
            pair = out.chosen
            with kept.failures.part("whether a third effect is missing"):
                _forward(
                    out, workshop, screen, train, _seed(seed, 3), alpha, kept, steps, rough=quick
                )
    out.fewer = [r for r in (single, pair) if r is not None and r is not out.chosen]
    if not quick and len(out.chosen.candidates) > 1:
        with kept.failures.part("the shapes of all that was chosen"):
            (out.chosen,) = shaped_all(
                workshop, out.base, scales, [out.chosen], train, _seed(seed, 8), kept,
                "estimating the shapes of all that was chosen",
            )  # fmt: skip
    if not quick:
        measure(out, _seed(seed, 5), kept)


def _unfitted(screen: Screen, refits: Sequence[Refit], alpha: float) -> int | None:
    """The leading candidate, if it is significant, was not refitted, and promises more than the
    best refit gains: another one in its place would be the wrong answer."""
    for k in leading(screen)[:1]:
        done = {int(screen.groups[r.index[0]]) for r in refits}
        best = max((r.merit for r in refits), default=0.0)
        found = int(screen.groups[k]) not in done and screen.found.gain[k] > best
        return k if found and float(screen.significant[k]) <= alpha else None
    return None


def _best_pair(
    out: Attribution, workshop: Workshop, screen: Screen, train: Sequence[Experiment],
    seed: np.random.SeedSequence, alpha: float, kept: Checkpoint, *, rough: bool = False,
) -> Refit | None:  # fmt: skip
    """The best of the pairs of which the screen promises most, where it is clearly better than the
    best one."""
    out.doubles, failed = refit_all(
        workshop, out.base, screen, pairs(screen, out.refits), train, seed, kept,
        "refitting pairs", rough=rough,
    )  # fmt: skip
    out.notes += [f"not refitted: {reason}" for reason in failed]
    if not out.doubles or out.doubles[0].merit - out.refits[0].merit < needed_gain(screen, alpha):
        return None
    return out.doubles[0]


def measure(out: Attribution, seed: np.random.SeedSequence, kept: Checkpoint) -> None:
    """Standard errors of what was chosen, from scores simulated at its fit."""
    old = out.chosen
    assert old is not None
    number = len(old.candidates)
    what = "standard errors" if number == 1 else f"standard errors of {number} effects"
    with kept.failures.part(what):
        numbers = kept.of(
            what, lambda: {"information": old.fitter.measured(old.fit, seed).information}
        )
        new = replace(old, fit=replace(old.fit, information=np.array(numbers["information"])))
        out.chosen = new
        out.refits = [new if r is old else r for r in out.refits]


def _rebase(
    out: Attribution, workshop: Workshop, train: Sequence[Experiment],
    seed: np.random.SeedSequence, kept: Checkpoint, worth: float,
) -> None:  # fmt: skip
    """Fit the model itself from where the best refit ended, too: a refit that found a better place
    for the parameters gains by that, and not by its effect. Only where the gain is `worth` it."""
    if not out.refits or out.refits[0].merit < worth:
        return
    fitter, best = workshop.fitter(()), out.refits[0].fit
    values = unpack_parameters(best.problem.trace, best.theta)
    start = {n: v for n, v in values.items() if n in workshop.trace.parameters}
    numbers = kept.of(
        "fitting from the best refit",
        lambda: fitter.fit(train, seed, start, searched=True).numbers,
    )
    found = fitter.restored(train, numbers)
    better = found.log_likelihood - out.base.log_likelihood
    if better > 2.0 * np.hypot(found.error, out.base.error) + 0.1:
        out.base, out.rebased = found, True
        out.notes.append(
            f"starting from the best refit the model itself fits better by {better:.1f} nats: p of "
            "the effects are of their refits, what was not refitted has none, and `where` and the "
            "checks of the predictions are of the fit before"
        )
        out.refits = [replace(r, gain=r.gain - better) for r in out.refits]


def _by_refit(
    out: Attribution, workshop: Workshop, screen: Screen, train: Sequence[Experiment],
    seed: np.random.SeedSequence, alpha: float, kept: Checkpoint,
) -> bool:  # fmt: skip
    """Whether the gain of a refit is more than chance: by its own law where fits are quick, else
    by that of the scores, which is the same to first order (likelihood ratio and score tests)."""
    found = {r.index[0]: gain_p(screen, r) for r in out.refits}
    if not found or min(found.values()) > LAX * alpha:
        return False
    if quick_enough(workshop, train):
        anew = asleep(screen)  # whose fits to simulated data would take too long
        rest = {k: p for k, p in found.items() if k not in anew}
        found = {k: p for k, p in found.items() if k in anew}
        if min(rest.values(), default=1.0) <= LAX * alpha:
            best = min(rest, key=lambda k: rest[k])
            found[best] = refit_p(workshop, out.base, screen, alpha, seed, kept)
    if not found:
        return False
    out.p |= found
    return min(found.values()) <= alpha


def needed_gain(screen: Screen, alpha: float) -> float:
    """Nats, less the cost, that the best of all candidates gains by chance with probability
    alpha."""
    return 0.5 * threshold(screen.family.maxima, alpha) ** 2


def _forward(
    out: Attribution, workshop: Workshop, screen: Screen, train: Sequence[Experiment],
    seed: np.random.SeedSequence, alpha: float, kept: Checkpoint, steps: int, *,
    rough: bool = False,
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
        except SSMError as error:
            out.notes.append(f"whether a further effect is missing is not known: {error.found}")
            return
        if float(np.min(again.family.p, initial=1.0)) > LAX * alpha:
            return
        heads = leading(again)[:FOLLOWERS]
        more, _ = refit_all(
            workshop, chosen.fit, again, [[k] for k in heads], train, _seed(seed, 10 + number),
            own, "refitting", chosen.candidates, rough=rough,
        )  # fmt: skip
        if not more or more[0].merit < needed_gain(again, alpha):
            return
        best = more[0]
        places = {c.key: k for k, c in enumerate(screen.question.candidates)}
        asked = again.question.candidates[best.index[0]]
        index = (*chosen.index, places[asked.key])
        chosen = Refit(
            index, best.candidates, best.fitter, best.fit, chosen.gain + best.gain,
            chosen.cost + best.cost,
        )  # fmt: skip
        out.chosen = chosen


def _others(screen: Screen, chosen: Refit) -> list[Candidate]:
    """The candidates of all other groups of which the screen can tell anything. What it said of
    them is no guide: with an effect added noise shrinks, and others come to light."""
    groups = {c.group for c in chosen.candidates}
    return [
        c for c, status in zip(screen.question.candidates, screen.found.status, strict=True)
        if c.group not in groups and not status
    ]  # fmt: skip


def _screen_again(
    chosen: Refit, screen: Screen, rest: Sequence[Candidate], train: Sequence[Experiment],
    workshop: Workshop, seed: np.random.SeedSequence, kept: Checkpoint,
) -> Screen:  # fmt: skip
    fitter, number = chosen.fitter, len(chosen.candidates)
    question = Question(
        fitter.problem.trace, screen.question.scales, workshop.missing,
        (*fitter.fixed, *chosen.fit.bounds),
        fitter.settings, candidates=rest, simulator=fitter.simulator if fitter.start else None,
        failures=kept.failures,
    )  # fmt: skip
    stage = f"screening for effect {number + 1}"
    sets = min(screen.sets, AGAIN)
    return ask(
        question, train, chosen.fit.theta, sets, _seed(seed, number), kept, stage, checks=False
    )


def _seed(seed: np.random.SeedSequence, stage: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, stage))


__all__ = ["Attribution", "attribute", "measure", "needed_gain"]
