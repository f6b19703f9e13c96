"""What each smoothing method finds: draws from the joint law, or moments of the marginal ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri

from ssmppl.counts import check_room
from ssmppl.data import unpack_parameters
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains import pgas
from ssmppl.inference.chains.sampling import Setup
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.methods import PGAS
from ssmppl.inference.particles.backward import choose_kernel, draw_paths, particle_system
from ssmppl.inference.particles.degeneracy import collapse, distinct
from ssmppl.inference.particles.filtering import FilterSettings, random_state
from ssmppl.inference.particles.fixed_lag import LAG, lag_moments
from ssmppl.inference.particles.marginal import is_marginal
from ssmppl.inference.particles.marginal_backward import marginal_paths, may_integrate
from ssmppl.inference.particles.pilot import space_of
from ssmppl.inference.particles.proposal_choice import choose, resolve_settings
from ssmppl.inference.problem import EXACT, Problem
from ssmppl.inference.runner import run_chains
from ssmppl.inference.singular import need_density
from ssmppl.inference.smoothing_methods import (
    FFBSi,
    FixedLag,
    KalmanSmoother,
    SmoothingMethod,
)
from ssmppl.inference.totals import total_of

PARTICLES, TRAJECTORIES = 1000, 1000
PGAS_WARMUP = 100  # sweeps that are dropped
COLLAPSED = 'Use more particles, proposal="twisted", or method=ssm.PGAS().'


@dataclass(frozen=True)
class Call:
    """A call of `smooth`, checked; None where the caller left a number to the method."""

    problem: Problem
    theta: np.ndarray
    particles: int | None
    trajectories: int | None
    levels: np.ndarray
    root: np.random.SeedSequence


@dataclass(frozen=True)
class Found:
    """What a method gives for one experiment: draws (M, T, D), or moments; and its report.

    moments : mean (T, D), covariance (T, D, D), cross (T, D, D), quantiles (T, P, D).
    over_time : further variables (T,).
    """

    attrs: dict[str, Any]
    paths: np.ndarray | None = None
    moments: tuple[np.ndarray, ...] | None = None
    over_time: Mapping[str, np.ndarray] | None = None


def by_exact_passes(
    call: Call, chosen: SmoothingMethod, method: SmoothingMethod | str | None
) -> list[Found]:
    """Exact moments, or exact draws."""
    if call.particles is not None and method is not None:
        raise ArgumentError(
            f"particles={call.particles}: {type(chosen).__name__} is exact and has none",
            fix="leave particles= out, or use method=ssm.FFBSi()",
        )
    trace = call.problem.trace
    model = kalman_model(trace) if isinstance(chosen, KalmanSmoother) else hidden_markov(trace)
    assert not isinstance(model, NotApplicable)
    _check_draws(call, call.trajectories or 0)
    experiments, theta = call.problem.experiments, call.theta
    if call.trajectories is not None:
        streams = [random_state(call.root, i) for i in range(len(experiments))]
        drawn = model.draw_each(experiments, theta, streams, call.trajectories)
        if isinstance(model, HiddenMarkov):
            values = [total_of(f.log_increments) for f in model.filter_each(experiments, theta)]
        else:
            values = [model.log_likelihood([e], theta) for e in experiments]
        pairs = zip(drawn, values, strict=True)
        return [Found({"log_likelihood": v}, paths=paths) for paths, v in pairs]
    if isinstance(model, HiddenMarkov):
        smoothed = model.smooth_each(experiments, theta)
        spreads = [model.quantiles(law, call.levels) for _, law in smoothed]
        moments = [m for m, _ in smoothed]
    else:
        moments = [model.smooth(e, theta) for e in experiments]
        spreads = []
        for m in moments:
            sd = np.sqrt(np.maximum(np.diagonal(m.covariance, axis1=1, axis2=2), 0.0))
            spreads.append(m.mean[:, None, :] + ndtri(call.levels)[None, :, None] * sd[:, None, :])
    return [
        Found({"log_likelihood": m.log_likelihood}, moments=(m.mean, m.covariance, m.cross, s))
        for m, s in zip(moments, spreads, strict=True)
    ]


def _filter(call: Call, method: FFBSi | FixedLag, integrate: bool = False) -> FilterSettings:
    """The filter's settings, "auto" resolved among the particle proposals."""
    proposal = method.proposal
    if proposal in EXACT:
        exact = {"kalman": "ssm.KalmanSmoother(), or ", "forward": "ssm.ForwardBackward(), or "}
        raise ArgumentError(
            f'{type(method).__name__}(proposal="{proposal}") has no particles',
            fix=f"use {exact.get(proposal, '')}another proposal",
        )
    if proposal == "auto":
        proposal = choose(call.problem, call.theta, exact=False, integrate=integrate).name
    n = PARTICLES if call.particles is None else call.particles
    settings = resolve_settings(
        call.problem, call.theta, n, proposal, method.resampling, method.ess_threshold,
        method.rescue if isinstance(method, FFBSi) else 0, integrate=integrate,
    )  # fmt: skip
    longest = max(e.steps for e in call.problem.experiments)
    each = len(call.problem.trace.state_symbols) + 2  # with weight and ancestor
    check_room(
        f"{n} particles of each of {longest} rows", longest * n * each, "give fewer particles"
    )
    return settings


def _check_draws(call: Call, draws: int) -> None:
    """That memory holds the trajectories."""
    rows = call.problem.rows
    numbers = draws * rows * len(call.problem.trace.state_symbols)
    check_room(f"{draws} trajectories of {rows} rows", numbers, "give fewer trajectories")


def by_ffbsi(call: Call, method: FFBSi) -> list[Found]:
    """Independent draws, given a particle filter's particles."""
    if method.kernel != "genealogy":
        need_density(call.problem.trace, f'FFBSi(kernel="{method.kernel}")', "smooth")
    settings = _filter(call, method, integrate=may_integrate(call.problem, method))
    draws = TRAJECTORIES if call.trajectories is None else call.trajectories
    _check_draws(call, draws)
    marginal = is_marginal(settings.proposal)
    kernel, why = "exact", "states that are linear given the others are integrated out"
    if not marginal:
        kernel, why = choose_kernel(call.problem, settings, draws, method.kernel)
    out = []
    for i, e in enumerate(call.problem.experiments):
        stream = random_state(call.root, i)
        system = particle_system(call.problem, call.theta, settings, e, stream)
        own = call.problem, call.theta, e, system, draws, stream
        paths = marginal_paths(*own) if marginal else draw_paths(*own, kernel, method.moves)
        report = {
            "particles": settings.particles, "proposal": settings.proposal, "kernel": kernel,
            "kernel_chosen": why, "log_likelihood": system.log_Z,
        }  # fmt: skip
        over_time = {"distinct": distinct(paths), "ess": system.ess}
        if not marginal:
            report |= collapse(over_time["distinct"], system, draws, e, COLLAPSED)
        out.append(Found(report, paths=paths, over_time=over_time))
    return out


def by_fixed_lag(call: Call, method: FixedLag) -> list[Found]:
    """Moments, each row's from the ancestors of particles some rows later."""
    if call.trajectories is not None:
        raise ArgumentError(
            f"trajectories={call.trajectories}: FixedLag knows marginals only, no joint law to "
            "draw trajectories from",
            fix="leave trajectories= out, or use ssm.FFBSi()",
        )
    settings = _filter(call, method)
    lag = LAG if method.lag is None else method.lag
    out = []
    for i, e in enumerate(call.problem.experiments):
        stream = random_state(call.root, i)
        system = particle_system(call.problem, call.theta, settings, e, stream)
        m = lag_moments(system, lag, call.levels)
        report = {
            "particles": settings.particles, "proposal": settings.proposal, "lag": lag,
            "log_likelihood": system.log_Z,
        }  # fmt: skip
        moments = m.mean, m.covariance, m.cross, m.quantiles
        over_time = {"distinct": m.distinct, "ess": system.ess}
        n = settings.particles
        report |= collapse(m.distinct, system, n, e, COLLAPSED)
        out.append(Found(report, moments=moments, over_time=over_time))
    return out


def by_pgas(call: Call, method: PGAS) -> list[Found]:
    """Successive trajectories of one chain at fixed parameters."""
    draws = TRAJECTORIES if call.trajectories is None else call.trajectories
    if method.particles is None and call.particles is not None:
        method = PGAS(call.particles, method.proposal)
    held = unpack_parameters(call.problem.trace, call.theta)
    space = space_of(call.problem, held, {})
    setup = Setup(call.problem, space, held, 1, PGAS_WARMUP, 1, call.root)
    sampler = pgas.prepare(setup, method)
    (chain,) = run_chains(
        sampler.step_block, sampler.states, draws, PGAS_WARMUP, progress=False
    )  # fmt: skip
    report = {k: sampler.report[k] for k in ("particles", "proposal", "ancestor_sampling")}
    report |= {"warmup": PGAS_WARMUP, "update_rate": float(chain.stats["update_rate"].mean())}
    report["trajectories_are"] = "successive draws of a Markov chain, correlated"
    out = []
    for i in range(len(call.problem.experiments)):
        paths = chain.draws[f"path_{i}"]
        out.append(Found(report, paths=paths, over_time={"distinct": distinct(paths)}))
    return out
