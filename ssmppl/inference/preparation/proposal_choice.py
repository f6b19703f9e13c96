"""Choice of the particle filter's proposal by a pilot: the least variance of log Z per second; and
of that of conditional SMC, without one.

The cost of a step is counted from the expressions that the generated code evaluates, not timed,
so that the choice, and with it every result, is the same wherever and whenever a seed is run.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssmppl.analysis.proposals.proposals import Proposal
from ssmppl.codegen.modules.marginal import MarginalFilter
from ssmppl.codegen.text.module import PARTICLE, level_of
from ssmppl.codegen.text.render import depends, is_small_power
from ssmppl.counts import check_room
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.expressions.expr import Expr, topological
from ssmppl.expressions.operations import CHEAP, OPERATIONS, SLOW
from ssmppl.inference.particles.filtering import FilterSettings, filter_settings, repeated_estimates
from ssmppl.inference.particles.on_device import check_device
from ssmppl.inference.preparation.exact_models import NEEDED, exact_model, filter_of, form_of
from ssmppl.inference.run.problem import EXACT, Problem

# Nanoseconds per particle, as those of `Operation.cost`.
COST = {n: o.cost for n, o in OPERATIONS.items()} | {"item": CHEAP}  # others are `SLOW`
STEP = 2.6  # normalise, resample, gather
NORMAL, UNIFORM = 1.5, 0.6
LOOPED = 0.4  # a multiplication in a loop over matrices
LOOK_AHEAD = 4.0  # one more normalisation and the second-stage weights
PILOT_PARTICLES, PILOT_REPEATS, PILOT_STEPS = 100, 24, 400
ENOUGH = 1.2  # sd of log Z up to which the last resorts are not tried; what PMMH asks for
TEMPERING = 50.0  # cost of the tempered filter, in that of the bootstrap filter that it begins with
TEMPERED_REPEATS = 8  # fewer, as it takes longest


@dataclass(frozen=True)
class Choice:
    """The chosen proposal and the figures behind it: name -> (sd of log Z, ns per particle)."""

    name: str
    figures: dict[str, tuple[float, float]]

    def __str__(self) -> str:
        if not self.figures:
            return self.name
        rows = ", ".join(f"{n}: sd {s:.2f}, {c:.0f} ns" for n, (s, c) in self.figures.items())
        return f"{self.name} (pilot sd of log Z and cost per particle: {rows})"


def cost(proposal: Proposal) -> float:
    """Estimated nanoseconds per particle and step."""
    fit = list(proposal.fit)  # computed once, and read by the other passes
    later = [list(proposal.draw.values()), [t.guarded() for t in proposal.weight]]
    extra = LOOPED * proposal.looped
    if proposal.look_ahead is not None:
        later.append([proposal.look_ahead])
        extra += LOOK_AHEAD
    known = dict.fromkeys(fit, True)
    return STEP + extra + _pass_cost(fit, {}) + sum(_pass_cost(p, known) for p in later)


def _pass_cost(roots: list[Expr], known: dict[Expr, bool]) -> float:
    level = depends(roots, level_of)
    total = 0.0
    for node in topological(roots, until=known):
        if level[node] != PARTICLE or node.op == "symbol" or node in known:
            continue
        if node.op == "random":
            total += {"normal": NORMAL, "uniform": UNIFORM}.get(node.data[0], SLOW)
        else:
            total += _cost_of(node)
    return total


def _cost_of(node: Expr) -> float:
    if node.op == "pow" and is_small_power(node):
        return CHEAP
    if node.op != "loop":
        return COST.get(node.op, SLOW)
    times = node.args[-1].data if node.args[-1].op == "const" else 1.0
    inside = [n for n in topological(node.data.update) if n.args]
    return times * sum(map(_cost_of, inside))  # type: ignore[no-any-return]


_choices: dict[tuple, Choice] = {}


def choose_by_pilot(
    problem: Problem, theta: np.ndarray, exact: bool = True, *, whole: bool = False,
    integrate: bool = False, temper: bool = False, look_ahead: bool = True,
) -> Choice:  # fmt: skip
    """The exact filter where there is one, the user's proposal where there is one, else the
    winner of a pilot at theta; remembered for each program and data.

    whole : only the likelihood of all the data, or a trajectory given all of them, is wanted. Then
    the twisted proposal may be chosen; few of its particles tell what was known at a single row.
    integrate : whether states that are linear given the others may be integrated out; the
    particles are then of the others.
    temper : whether the tempered filter may be chosen, where no better proposal than the transition
        is derived.
    look_ahead : whether proposals may be chosen whose particles resample by what comes next.
    """
    found = exact_model(problem.trace)
    if exact and not isinstance(found, NotApplicable):
        return Choice(filter_of(found), {})
    if isinstance(problem.program.proposals.get("user"), Proposal):
        return Choice("user", {})
    derived = problem.program.proposals
    candidates, last = (
        {
            n: p for n in names
            if isinstance(p := derived[n], Proposal) and (look_ahead or p.look_ahead is None)
        }
        for names in ([n for n in derived if n != "twisted"], ["twisted"] if whole else [])
    )  # fmt: skip
    if temper and "guided" not in candidates:
        tempered = problem.program.proposal("tempered")
        last |= {"tempered": tempered} if isinstance(tempered, Proposal) else {}
    found_marginal = problem.program.marginal if integrate else None
    if isinstance(found_marginal, MarginalFilter):
        candidates |= {
            n: p for n, p in found_marginal.proposals.items() if not isinstance(p, NotApplicable)
        }
    if not candidates and not last and problem.program.missing.noise is not None:
        raise ArgumentError(
            f"no proposal applies to this model: {problem.program.missing.noise}",
            fix="give the observation some noise; particles are drawn given an exact observation "
            "where it is affine in states that have noise of their own in that row",
        )
    if len(candidates) == 1 and not last:
        return Choice(next(iter(candidates)), {})
    flags = whole, integrate, temper, look_ahead
    key = (problem.program.path, digest_of(problem), theta.tobytes(), *flags)
    if key not in _choices:
        _choices[key] = _pilot(problem, theta, candidates, last)
    return _choices[key]


def choose_for_csmc(problem: Problem) -> str:
    """The proposal for conditional SMC, without a pilot: the user's, else the locally optimal one
    where it is exact, else the transition."""
    proposals = problem.program.proposals
    if "user" in proposals:
        return "user"
    auxiliary = proposals.get("auxiliary")
    if auxiliary is None or isinstance(auxiliary, NotApplicable):
        return "bootstrap"
    return "auxiliary" if auxiliary.exact_look_ahead else "bootstrap"


def digest_of(problem: Problem) -> bytes:
    """A digest of the data."""
    digest = hashlib.sha256()
    for e in problem.experiments:
        for a in (e.y, e.seen, e.u):
            digest.update(a.tobytes())
    return digest.digest()


def _pilot(
    problem: Problem, theta: np.ndarray, candidates: dict[str, Proposal],
    last_resort: dict[str, Proposal],
) -> Choice:  # fmt: skip
    """The best of the candidates, and of the last resort, which takes seconds to compile, where
    none of them tells log Z to `ENOUGH`."""
    figures: dict[str, tuple[float, float]] = {}
    _try(problem, theta, candidates, figures)
    if min((s for s, _ in figures.values()), default=np.inf) > ENOUGH:
        _try(problem, theta, last_resort, figures)
    score = {n: s**2 * c for n, (s, c) in figures.items() if np.isfinite(s)}
    best = min(score, key=lambda n: score[n]) if score else next(iter(candidates), "bootstrap")
    return Choice(best, figures)


def _try(
    problem: Problem, theta: np.ndarray, candidates: dict[str, Proposal],
    figures: dict[str, tuple[float, float]],
) -> None:  # fmt: skip
    """Add the figures of these proposals."""
    shortened = _beginning(problem)
    for name, proposal in candidates.items():
        settings = FilterSettings(PILOT_PARTICLES, name)
        seed = np.random.SeedSequence(20150)
        repeats, times = PILOT_REPEATS, 1.0
        if name == "tempered":
            repeats, times = TEMPERED_REPEATS, TEMPERING
        try:
            log_z = repeated_estimates(shortened, theta, settings, seed, range(repeats))
        except SamplingError:
            continue
        finite = np.isfinite(log_z)
        with np.errstate(over="ignore"):  # of estimates beyond 1e154, which spread hopelessly
            sd = float(np.std(log_z[finite], ddof=1)) if finite.mean() > 0.9 else float("inf")
        figures[name] = (sd, times * cost(proposal))


def _beginning(problem: Problem) -> Problem:
    """The problem with its first rows only: enough to compare proposals."""
    short = tuple(
        replace(
            e, y=e.y[:PILOT_STEPS], seen=e.seen[:PILOT_STEPS], u=e.u[:PILOT_STEPS],
            steps=min(e.steps, PILOT_STEPS),
        )
        for e in problem.experiments[:3]
    )  # fmt: skip
    return replace(problem, experiments=short)


def tempers(resampling: str, ess_threshold: float, rescue: int) -> bool:
    """Whether a filter with these settings can be tempered."""
    return resampling == "systematic" and ess_threshold >= 1.0 and not rescue


def resolve_settings(
    problem: Problem,
    theta: np.ndarray,
    particles: Any,
    proposal: str,
    resampling: str = "systematic",
    ess_threshold: float = 1.0,
    rescue: int = 0,
    *,
    whole: bool = False,
    integrate: bool = False,
    temper: bool = False,
    device: str = "cpu",
) -> FilterSettings:
    """The settings of a call with "auto" resolved, checked against what could be derived.

    whole, integrate, temper : as in `choose_by_pilot`.
    """
    settings = filter_settings(particles, proposal, resampling, ess_threshold, rescue)
    each = 2 * len(problem.trace.state_symbols) + 2  # of this row and the last; weight and ancestor
    check_room(f"particles={particles}", each * settings.particles, "give fewer particles")
    if device != "cpu":
        return _on_device(problem, theta, settings, resampling, device)
    if proposal == "auto":
        temper = temper and tempers(resampling, ess_threshold, rescue)
        flags = {"whole": whole, "integrate": integrate, "temper": temper}
        chosen = choose_by_pilot(problem, theta, **flags).name
        return replace(settings, proposal=chosen)
    if proposal in EXACT:
        found = form_of(proposal, problem.trace)
        if isinstance(found, NotApplicable):
            raise ArgumentError(
                f'proposal="{proposal}" needs a {NEEDED[proposal]}: {found}',
                fix='use proposal="auto"',
            )
    else:
        problem.proposal(proposal, integrate, EXACT)
    return settings


def _on_device(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, resampling: str, device: str
) -> FilterSettings:
    """The settings for a device other than the processor; exact likelihoods need none."""
    if device != "cuda":
        raise ArgumentError(f"device={device!r} is unknown", fix="use 'cpu' or 'cuda'")
    name = settings.proposal
    if name == "auto":
        name = choose_by_pilot(problem, theta, look_ahead=False).name
    if name not in EXACT:
        check_device(
            problem, name, resampling=(resampling, "systematic"),
            ess_threshold=(settings.ess_threshold, 1.0), rescue=(settings.rescue, 0),
        )  # fmt: skip
    return replace(settings, proposal=name, device=device)
