"""What these data cannot tell apart among the leading candidates, and what input would.

The class of the best is its confidence set: the refits that lie no further behind than the truth
would by chance, and candidates whose scores are so like the best one's that its gain does not
separate them. See `classes.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.gap.checkpoint import Checkpoint, Numbers
from ssmppl.gap.classes import (
    NATS_APART,
    Classes,
    classes,
    confidence_set,
    cuts,
    likeness,
    separating_input,
    told_apart,
)
from ssmppl.gap.efficient import Null, efficient
from ssmppl.gap.refit import Refit
from ssmppl.gap.screen import Question, Screen
from ssmppl.inference.particles.filtering import random_state

SETS = 25  # simulated under each input
MOST_VARIED = 4  # inputs that are replaced in turn
SLOW, FAST, LEVELS = 0.25, 8.0, 8  # slow period in shares of the rows, fast one in rows, stairs


def heads(screen: Screen, refits: Sequence[Refit]) -> list[int]:
    """Best shape of each group: the refitted by their merit, then the others by their height."""
    done = [r.index[0] for r in refits if len(r.index) == 1]
    family, groups = screen.family, screen.groups
    known = {int(groups[k]) for k in done}
    return done + [
        k for k in family.leaders if not screen.found.status[k] and int(groups[k]) not in known
    ]


def told(screen: Screen, refits: Sequence[Refit], order: Sequence[int]) -> Classes:
    """Classes of the candidates in `order` (of `heads`); one of its own for whatever is weak."""
    refitted = {r.index[0]: max(r.merit, 0.0) for r in refits if len(r.index) == 1}
    at = np.array(order, dtype=int)
    rho, sided = screen.found.rho[np.ix_(at, at)], screen.found.sided[at]
    gains = np.array([refitted.get(int(k), screen.found.gain[k]) for k in at])
    strong = np.array([int(k) in refitted or screen.found.gain[k] >= NATS_APART for k in at], bool)
    class_id, leader = np.zeros(len(at), int), np.arange(len(at))
    if refitted:
        first = _of_the_best(rho, gains, sided, len(refitted), strong)
        class_id[first], leader[first] = 1, 0
    rest = np.flatnonzero(strong & (class_id == 0))
    if len(rest):
        found = classes(rho[np.ix_(rest, rest)], gains[rest], sided[rest])
        class_id[rest] = found.class_id + class_id.max()
        leader[rest] = rest[found.leader]
    weak = np.flatnonzero(class_id == 0)
    class_id[weak] = class_id.max(initial=0) + 1 + np.arange(len(weak))
    return Classes(class_id, leader, rho[leader, np.arange(len(at))])


def _of_the_best(
    rho: np.ndarray, gains: np.ndarray, sided: np.ndarray, refitted: int, strong: np.ndarray
) -> np.ndarray:
    """(K,) bool: the confidence set among the refitted, who come first, and who is like the best
    among those that were not."""
    own = slice(0, refitted)
    cut = cuts(rho[own, own], gains[own], range(refitted), sided=sided[own])
    out = np.zeros(len(gains), bool)
    out[own] = confidence_set(gains[own], cut)
    alike = ~told_apart(gains[0], likeness(rho, sided)[0]) & strong
    out[refitted:] = alike[refitted:]
    return out


# -- another input
def separating(
    screen: Screen, members: Sequence[int], seed: np.random.SeedSequence, kept: Checkpoint
) -> str:
    """The simple input that would separate these candidates best; "" if none would.

    The base model is simulated under each, and its scores say how alike the candidates would be.
    """
    question, columns = screen.question, np.array(members, dtype=int)
    inputs = simple_inputs(screen.experiments, list(map(repr, question.trace.input_symbols)))
    if not inputs:
        return ""
    whole = question.theta(screen.theta)
    names = list(inputs)
    one = partial(_tried, question, list(inputs.values()), whole, columns, seed)
    results = kept.each("trying inputs", SETS * len(names), one)
    covariances = {}
    for which, name in enumerate(names):
        own = results[which :: len(names)]
        done = [r for r in own if not kept.failures.of_task(f"a set under {name}", r) and r]
        if not done:
            continue
        law = Null.of(
            np.stack([r["columns"] for r in done]), np.stack([r["nuisance"] for r in done]),
            quadratic=question.quadratic[columns], sided=question.sided[columns],
        )  # fmt: skip
        try:
            nothing = np.zeros(len(columns)), np.zeros(law.nuisance.shape[1])
            covariances[name] = efficient(law, *nothing).covariance
        except ArgumentError:  # too few sets for so many parameters
            continue
    if not covariances:
        return ""
    best = separating_input(
        range(len(columns)), screen.found.strength[columns], covariances,
        screen.found.sided[columns],
    )  # fmt: skip
    return best.input if best.told_apart else ""


def _tried(
    question: Question, inputs: Sequence[Sequence[Experiment]], theta: np.ndarray,
    columns: np.ndarray, seed: np.random.SeedSequence, k: int,
) -> Numbers:  # fmt: skip
    """The scores of a set that is simulated under one of the inputs; empty where there are none."""
    number, which = divmod(k, len(inputs))
    stream = random_state(seed, which, number)
    own = theta[: len(question.columns.base.parameter_symbols)]
    try:
        data = question.simulator.sets(inputs[which], own, stream)
        passes = question.smoother.run(data, theta, stream, predicted=False)
    except SamplingError:
        return {}
    if not all(np.all(np.isfinite(p.rows)) for p in passes):
        return {}
    found = question.statistics(data, passes, stream, checks=False)
    return {"columns": found.columns[columns], "nuisance": found.nuisance}


def simple_inputs(
    experiments: Sequence[Experiment], names: Sequence[str]
) -> dict[str, list[Experiment]]:
    """The experiments with one of the inputs (L,) replaced at a time, in the units of its own.

    What does not vary in an experiment is no drive (the length of a step, a setting), and stays.
    """
    ends = [(e.u.min(axis=0), e.u.max(axis=0)) for e in experiments]
    varies = np.array([low < high for low, high in ends])
    out: dict[str, list[Experiment]] = {}
    for k in np.flatnonzero(varies.any(axis=0))[:MOST_VARIED].tolist():
        for e, varied in zip(experiments, varies[:, k], strict=True):
            for name, column in _others(e.u[:, k], names[k]).items():
                u = e.u.copy()
                u[:, k] = column if varied else e.u[:, k]
                out.setdefault(name, []).append(replace(e, u=u))
    return out


def _others(u: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Other courses of an input u (T,), by what they are called."""
    t = np.arange(len(u))
    low, high, mean, size = u.min(), u.max(), u.mean(), np.sqrt(2.0) * u.std()
    stair = np.minimum(t * LEVELS // len(u), LEVELS - 1) / (LEVELS - 1.0)
    return {
        f"the same {name} at twice the size": 2.0 * u,
        f"the same {name} at half the size": 0.5 * u,
        f"a slow sine of {name}": mean + size * np.sin(2.0 * np.pi * t / (SLOW * len(u))),
        f"a fast sine of {name}": mean + size * np.sin(2.0 * np.pi * t / FAST),
        f"a staircase of {name} over the same range": low + (high - low) * stair,
    }
