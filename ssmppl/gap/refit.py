"""Attribution: the leading candidates and pairs of them, refitted with all parameters.

The score is a screen only: noise that has grown shrinks it, and near equivalents swap places. What
ranks is the log-likelihood after refitting, each fit starting where the screen's quadratic
expects its top.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.codegen.program import Program, compile_trace
from ssmppl.data import Experiment, unpack_parameters
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.gap.augment import augment
from ssmppl.gap.basis import lifted
from ssmppl.gap.candidate import Candidate
from ssmppl.gap.fit import Fit, Fitter
from ssmppl.gap.screen import Screen, with_parameters
from ssmppl.gap.smoothing import Settings
from ssmppl.inference.maximum.ascent import Setup
from ssmppl.inference.problem import Problem
from ssmppl.inference.runner import run_tasks
from ssmppl.language.trace import Trace

SINGLES, MATES, PAIRS = 5, 3, 3  # candidates refitted, further ones like them, pairs
ALIKE = 0.8  # correlation from which a candidate is refitted as a class mate
LEAST_GAIN = 1.0  # nats that the score must promise for a refit


@dataclass(frozen=True)
class Refit:
    """A model with effects, fitted. index : their places among the screen's candidates."""

    index: tuple[int, ...]
    candidates: tuple[Candidate, ...]
    fitter: Fitter
    fit: Fit
    gain: float

    @property
    def strengths(self) -> list[float]:
        """Estimated strengths of the effects."""
        values = self.fit.values()
        return [values[c.strength] for c in self.candidates]

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors of all free parameters, from the information at the fit."""
        return standard_errors(self.fit, self.fitter.fixed)


def standard_errors(fit: Fit, fixed: Mapping[str, np.ndarray]) -> dict[str, float]:
    """By the text of each component; 0 for what is fixed."""
    setup = Setup(fit.problem, fit.space, "posterior", dict(fixed), {}, np.random.SeedSequence(0))
    jacobian = setup.chart.at(fit.z).jacobian
    covariance = jacobian @ np.linalg.pinv(fit.information) @ jacobian.T
    symbols = fit.problem.trace.parameter_symbols
    spread = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    return {repr(s): float(v) for s, v in zip(symbols, spread, strict=True)}


class Workshop:
    """Makes and fits augmented models of one base model."""

    def __init__(
        self, trace: Trace, missing: Missing, fixed: Mapping[str, np.ndarray], settings: Settings,
    ):  # fmt: skip
        self.trace, self.missing, self.fixed, self.settings = trace, missing, dict(fixed), settings

    def fitter(self, candidates: Sequence[Candidate]) -> Fitter:
        """The fitter of the model with these effects; shapes are fixed parameters, so that the
        generated code is the same for all data."""
        made, shapes = lifted(list(candidates))
        trace = with_parameters(augment(self.trace, made), shapes) if made else self.trace
        program = compile_trace(trace, self.missing)
        fixed = self.fixed | {n: np.asarray(v) for n, v in shapes.items()}
        settings = Settings(self.settings.particles, proposal_of(program), self.settings.lag)
        return Fitter(Problem(trace, (), program), fixed, settings)


def proposal_of(program: Program) -> str:
    """The proposal of a program's filters: with an exact look-ahead where there is one."""
    found = program.proposals.get("auxiliary")
    if found is not None and not isinstance(found, NotApplicable) and found.exact_look_ahead:
        return "auxiliary"
    return "user" if "user" in program.proposals else "bootstrap"


def refit(
    workshop: Workshop, base: Fit, screen: Screen, index: Sequence[int],
    train: Sequence[Experiment], seed: np.random.SeedSequence,
) -> Refit | NotApplicable:  # fmt: skip
    """Fit the model with the screen's candidates at `index` to `train`."""
    question = screen.question
    candidates = tuple(question.candidates[k] for k in index)
    try:
        fitter = workshop.fitter(candidates)
        start = _start(base, screen, index)
        fit = fitter.fit(train, seed, start, searched=True)
    except (ArgumentError, SamplingError) as error:
        return NotApplicable(f"{' and '.join(map(str, candidates))}: {error.found}")
    return Refit(tuple(index), candidates, fitter, fit, fit.log_likelihood - base.log_likelihood)


def _start(base: Fit, screen: Screen, index: Sequence[int]) -> dict[str, np.ndarray]:
    """Where the quadratic expects the top: the strengths jointly, the parameters as they are."""
    found, at = screen.found, list(index)
    v = found.covariance[np.ix_(at, at)]
    strengths = np.linalg.lstsq(v, found.score[at], rcond=1e-6)[0]
    out = unpack_parameters(base.problem.trace, base.theta)
    for k, value in zip(at, strengths, strict=True):
        c = screen.question.candidates[k]
        if screen.question.quadratic[k]:
            value = np.sqrt(max(float(value), 1e-12))
        e = c.effect
        if np.isfinite(e.upper):  # between two bounds: well inside
            width = e.upper - e.lower
            value = np.clip(value, e.lower + 0.02 * width, e.upper - 0.02 * width)
        elif e.lower == 0.0:
            least = 0.2 / np.sqrt(max(float(found.variance[k]), 1e-12))
            value = max(float(value), least)
        out[c.strength] = np.asarray(float(value))
    return out


def leading(screen: Screen) -> list[int]:
    """The best shape of each of the best groups, and those that are like the best of all."""
    family, found = screen.family, screen.found
    heads = [int(k) for k in family.best if found.gain[k] >= LEAST_GAIN and not found.status[k]]
    heads.sort(key=lambda k: -found.gain[k])
    if not heads:
        return []
    out, rest = heads[:SINGLES], heads[SINGLES:]
    mates = [k for k in rest if abs(found.rho[out[0], k]) >= ALIKE]
    return out + mates[:MATES]


def pairs(screen: Screen, refits: Sequence[Refit]) -> list[tuple[int, int]]:
    """Pairs of which the quadratic expects more than of the best single one."""
    found = screen.found
    heads = [int(k) for k in screen.family.best
             if not found.status[k] and not screen.question.quadratic[k]]  # fmt: skip
    heads = sorted(heads, key=lambda k: -found.gain[k])[:12]
    heads = list(dict.fromkeys([*(r.index[0] for r in refits[:3]), *heads]))
    best, out = float(np.max(found.gain, initial=0.0)), []
    for i, a in enumerate(heads):
        for b in heads[i + 1 :]:
            if abs(found.rho[a, b]) > 0.98:
                continue
            v = found.covariance[np.ix_([a, b], [a, b])]
            s = found.score[[a, b]]
            strength = np.linalg.solve(v, s)
            signs = found.sided[[a, b]]
            if np.any(signs * strength < 0.0):
                continue
            out.append((0.5 * float(s @ strength), (a, b)))
    out.sort(reverse=True)
    return [pair for gain, pair in out if gain > best + 2.0][:PAIRS]


def refit_all(
    workshop: Workshop, base: Fit, screen: Screen, sets: Sequence[Sequence[int]],
    train: Sequence[Experiment], seed: np.random.SeedSequence, executor: Executor | None,
    progress: bool, title: str,
) -> tuple[list[Refit], list[NotApplicable]]:  # fmt: skip
    """The refits that came to an end, best first, and why the others did not."""

    def one(k: int) -> Refit | NotApplicable:
        own = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 5, k))
        return refit(workshop, base, screen, sets[k], train, own)

    results = run_tasks(one, range(len(sets)), executor=executor, progress=progress, title=title)
    done = [r for r in results if isinstance(r, Refit)]
    done.sort(key=lambda r: -r.gain)
    return done, [r for r in results if isinstance(r, NotApplicable)]
