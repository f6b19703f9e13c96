"""The reference that the gain ratio is measured against: a regularised superset of the model.

The base model with the chosen effects and with smooth functions of the states and inputs wherever
the screen says that there is something, shrunk by normal priors whose width is an empirical Bayes
estimate: E z^2 = 1 + tau^2 V of a group of basis functions with strengths of variance tau^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ssmppl.data import Experiment, unpack_parameters
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import APPROXIMATELY, FROM_NEARBY, Fit, Fitter
from ssmppl.diagnosis.heldout.predictions import predicted_later
from ssmppl.diagnosis.heldout.row_split import RowSplit
from ssmppl.diagnosis.model.augment import augment, with_given_parameters
from ssmppl.diagnosis.model.basis import BasisTerm, symbolic_shapes
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.screening.efficient_score import Null, efficient
from ssmppl.diagnosis.screening.familywise import familywise
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.errors import SSMError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import symbol
from ssmppl.language.distributions import Normal

GROUPS = 3  # of basis functions that are taken in, at most
CHANCE = 0.1  # family-wise p up to which a group is taken in: others would only add noise
ASTRAY = 1.0  # nats below the model without the groups, beyond Monte Carlo noise

Values = dict[str, np.ndarray]


Group = tuple[list[BasisTerm], float]  # terms of one equation, moment and variable; tau


def significant_groups(screen: Screen, chosen: Sequence[Candidate]) -> list[Group]:
    """Where the basis has signal beyond what was chosen, best first; none where chance explains
    it."""
    design = screen.design
    if not design.terms:
        return []
    own, own_seen = screen.columns_of(chosen)
    taken = np.concatenate([screen.simulated.nuisance, own], axis=1)
    seen = np.concatenate([screen.observed.nuisance, own_seen])
    found = efficient(Null.of(screen.simulated.basis, taken), screen.observed.basis, seen)
    groups: dict[tuple[str, str, str], list[int]] = {}
    for i, t in enumerate(design.terms):
        if not found.status[i]:
            groups.setdefault((t.equation, t.moment, t.variable), []).append(i)
    out, residual = [], residual_groups(screen, chosen)
    for key, places in groups.items():
        size = float(np.mean(found.z[places] ** 2))
        if residual[key].p <= CHANCE and size > 1.0:
            variance = float(np.mean(found.variance[places]))
            tau = float(np.sqrt((size - 1.0) / variance))
            out.append((residual[key].z, [design.terms[i] for i in places], tau))
    out.sort(key=lambda g: -g[0])
    return [(terms, tau) for _, terms, tau in out[:GROUPS]]


def fit_reference(
    augmented: AugmentedModels, chosen: Sequence[Candidate], start: Fit, screen: Screen,
    train: Sequence[Experiment], seed: np.random.SeedSequence, checkpoint: Checkpoint,
    split: RowSplit | None = None,
) -> tuple[Fitter, Fit]:  # fmt: skip
    """The superset, fitted from the fit of the model with the chosen effects.

    A fit that comes out below where it started has gone astray (a feedback of what is past that
    makes the model unstable): then with the best group alone, and at last with none. Where there
    is a `split`, a group of curves has to predict the rows of the second part, fitted to the first
    rows, better than the model without it does: what only bends through the noise is left out.

    Raises
    ------
    SSMError : it cannot be fitted.
    """
    groups = significant_groups(screen, chosen)
    if groups and split is not None:
        groups = _worth(augmented, chosen, start, groups, split, seed, checkpoint)
    for count in dict.fromkeys((len(groups), 1)) if groups else ():
        fitter, begin = superset(augmented, chosen, start, groups[:count])

        def numbers(fitter: Fitter = fitter, begin: Values = begin) -> Numbers:
            effort = APPROXIMATELY if split is None else FROM_NEARBY
            return fitter.fit(train, seed, begin, effort).numbers

        stage = "reference" if count == len(groups) else "reference with one group"
        fit = fitter.restored(train, checkpoint.computed(stage, numbers))
        noise = 3.0 * np.hypot(fit.error, start.error)
        if fit.log_likelihood >= start.log_likelihood - ASTRAY - noise:
            return fitter, fit
    return augmented.fitter(chosen), start


def _worth(
    augmented: AugmentedModels, chosen: Sequence[Candidate], start: Fit, groups: Sequence[Group],
    split: RowSplit, seed: np.random.SeedSequence, checkpoint: Checkpoint,
) -> list[Group]:  # fmt: skip
    """The groups that, one after the other, predict the second part better than those before; none
    where the model without them predicts nothing."""

    def values(wanted: Sequence[tuple[int, ...]], stage: str) -> list[float]:
        sets = [[groups[k] for k in each] for each in wanted]
        one = partial(_predicted, augmented, tuple(chosen), start, sets, split, seed)
        if len(sets) == 1:  # runs of its filter go over the executor, not itself
            with checkpoint.failures.guard(stage):
                made = checkpoint.computed(stage, partial(one, 0, checkpoint.executor))
                return [float(made["value"])]
            return [-np.inf]
        found = checkpoint.map(stage, len(sets), one)
        failed = [checkpoint.failures.record_task(stage, numbers) for numbers in found]
        return [
            -np.inf if lost else float(numbers["value"])
            for lost, numbers in zip(failed, found, strict=True)
        ]

    # Each by itself at once; most are of no use, and then that is all.
    alone = [(k,) for k in range(len(groups))]
    best, *singly = values([(), *alone], "reference on other rows")
    kept: tuple[int, ...] = ()
    for k, value in enumerate(singly if np.isfinite(best) else []):
        if kept:
            (value,) = values([(*kept, k)], f"reference on other rows with {(*kept, k)}")
        if value > best:
            kept, best = (*kept, k), value
    return [groups[k] for k in kept]


def _predicted(
    augmented: AugmentedModels, chosen: Sequence[Candidate], start: Fit,
    sets: Sequence[Sequence[Group]], split: RowSplit, seed: np.random.SeedSequence, k: int,
    executor: Executor | None = None,
) -> Numbers:  # fmt: skip
    """What the superset with the groups `sets[k]` predicts of the second part, fitted to the first;
    -inf where it cannot."""
    fitter, begin = superset(augmented, chosen, start, sets[k])
    try:
        return {"value": np.array(predicted_later(fitter, begin, split, seed, executor))}
    except SSMError:
        return {"value": np.array(-np.inf)}


def gain_of_curves(
    augmented: AugmentedModels, base: Fit, chosen: Sequence[Candidate], screen: Screen,
    train: Sequence[Experiment], seed: np.random.SeedSequence, checkpoint: Checkpoint,
) -> float:  # fmt: skip
    """Nats that curves gain by themselves, in place of the chosen effects, on the rows of the fit,
    less one for each function; of the mean where most stands out beside these effects, 0 where
    nothing does. The expected gain on other rows of the same kind (H. Akaike, *IEEE Transactions on
    Automatic Control* 19, 1974), of which functions that are shrunk lose less than one each.

    Raises
    ------
    SSMError : they cannot be fitted.
    """
    groups = significant_groups(screen, chosen)
    if not groups or groups[0][0][0].moment != "mean":
        return 0.0
    fitter, begin = superset(augmented, (), base, groups[:1])
    numbers = checkpoint.computed(
        "curves alone", lambda: fitter.fit(train, seed, begin, FROM_NEARBY).numbers
    )
    gain = fitter.restored(train, numbers).log_likelihood - base.log_likelihood
    return float(gain) - len(groups[0][0])


def superset(
    augmented: AugmentedModels, chosen: Sequence[Candidate], start: Fit,
    groups: Sequence[Group],
) -> tuple[Fitter, Values]:  # fmt: skip
    """The fitter of the superset, and where it starts."""
    candidates = [t.candidate for terms, _ in groups for t in terms]
    made, shapes = symbolic_shapes([*chosen, *candidates], of_time=True)
    widths = {f"tau_{i}": tau for i, (_, tau) in enumerate(groups)}
    trace = with_given_parameters(augment(augmented.trace, made), {**shapes, **widths})
    parameters = dict(trace.parameters)
    # A prior may depend on parameters declared before: the widths come first.
    ordered = {n: parameters.pop(n) for n in widths}
    for i, (terms, _) in enumerate(groups):
        for t in terms:
            site = parameters[t.candidate.strength]
            law = Normal(0.0, sd=array(symbol("parameter", f"tau_{i}", ())))
            law.location = site.distribution.location
            parameters[t.candidate.strength] = replace(site, distribution=law)
    trace = replace(trace, parameters={**ordered, **parameters})
    given = {**shapes, **widths}
    fitter = augmented.fitter_of(trace, given)
    values = unpack_parameters(start.problem.trace, start.theta)
    begin = {n: v for n, v in values.items() if n in trace.parameters and n not in given}
    begin |= {t.candidate.strength: np.asarray(0.0) for terms, _ in groups for t in terms}
    return fitter, begin


@dataclass(frozen=True)
class Residual:
    """The statistic of a group of the basis: z, and its family-wise p."""

    z: float
    p: float


def residual_groups(
    screen: Screen, others: Sequence[Candidate]
) -> dict[tuple[str, str, str], Residual]:
    """Each group of the basis with `others` projected out, by equation, moment and variable: the
    functions of one variable, or of one pair, are a group."""
    terms = screen.design.terms
    keys = list(dict.fromkeys((t.equation, t.moment, t.variable) for t in terms))
    if not keys:
        return {}
    groups = []
    for key in keys:
        own = [i for i, t in enumerate(terms) if (t.equation, t.moment, t.variable) == key]
        groups.append(screen.basis_group(own, others))
    z, null = np.array([g.z for g in groups]), np.stack([g.null for g in groups], axis=1)
    p = familywise(z, null, sided=1).p
    return {k: Residual(float(z[i]), float(p[i])) for i, k in enumerate(keys)}
