"""Iterated filtering: particles that carry their own parameters, passed over the data many times.

E. L. Ionides, D. Nguyen, Y. Atchadé, S. Stoev and A. A. King, "Inference for dynamic and latent
variable models via iterated, perturbed Bayes maps", *PNAS* 112 (2015), algorithm IF2. In pass m the
parameters of a particle take a random step before it moves at row t, of standard deviation

    s a^(m - 1 + (t - 1) / T),    a = cooling^(1/50),

on the unconstrained scale; parameters and states are resampled together, and the parameters that
are left begin the next pass. As the steps vanish the swarm settles where the likelihood is highest.

Numbers that act in the initial law alone step at the first row only, which the model itself tells
(`analysis/perturbed.py`); those that act nowhere stay. Several experiments are passed over one
after another with one swarm, whose parameters all of them share.

At the end of a pass the swarm leans to the last rows. Averaged over all rows of a pass it does not,
to first order: the filtered mean of a random walk is a weighted mean of what the rows say whose
weights, over a whole period, are the same for each row. So the iterates are means over rows; those
of the initial law's numbers are the swarm's means at the end.

What is left, all swarms may share: steps that have not vanished, a ridge not yet climbed. How the
ends differ does not tell it. So from the ends the top itself is looked for, by estimates of the
likelihood round it (`hilltop.py`); their noise is the error of the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ssmppl.analysis.perturbed import Perturbed
from ssmppl.data import check_values, unpack_parameters
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError, listing
from ssmppl.inference.draws import stack
from ssmppl.inference.maximum.ascent import Ascent, Setup
from ssmppl.inference.maximum.hilltop import Hilltop, check_points, hilltop
from ssmppl.inference.maximum.m_step import starts
from ssmppl.inference.maximum.summit import HALF_INTERVAL, Summit, evaluate, summit
from ssmppl.inference.maximum.swarms import State, Swarms, perturbed_model, swarm_block
from ssmppl.inference.methods import IF2
from ssmppl.inference.particles.filtering import random_state
from ssmppl.inference.particles.pilot import space_of
from ssmppl.inference.progress import announced
from ssmppl.inference.runner import run_chains

USUAL = 0.02  # standard deviation of a step
MOST_FOR_INITIAL = 10.0  # times that of a number that steps at every row
SWITCHED_OFF = "IF2(points=0) asks for none, nor for the Monte Carlo error"


def climb(setup: Setup, method: IF2) -> Ascent:
    """Maximise; see the module.

    Raises
    ------
    ArgumentError : a setting does not apply; no particle can be drawn from the initial law.
    SamplingError : the likelihood cannot be evaluated where any of the swarms ended.
    """
    setup.problem.proposal("bootstrap")
    check_points(method, len(setup.space.where))
    model = perturbed_model(setup.space, setup.with_prior)
    scales = step_scales(setup, method, model)
    swarms = Swarms(setup.space, setup.with_prior, scales, model.moving, method.cooling)
    points = begin(setup, method)
    states = [
        State(np.tile(z[:, None], (1, method.particles)), random_state(setup.seed(6, k)), 0)
        for k, z in enumerate(points)
    ]
    chains = run_chains(
        partial(swarm_block, swarms), states, method.iterations, executor=setup.executor,
        progress=setup.progress, title="IF2", describe=_describe,
    )  # fmt: skip
    drawn, stats = stack(chains)
    averaged = min(method.averaged, drawn["z"].shape[1])
    ends = drawn["z"][:, -averaged:].mean(axis=1)
    interrupted = cut_short = any(c.interrupted for c in chains)
    top = summit(setup, method, ends)
    found, interrupted = _beyond(setup, method, top, len(ends), interrupted)
    report = _report(setup, model, scales, ends, top, averaged)
    if cut_short:  # swarms that have hardly left their starts agree by these
        report["converged"] = None
    if stats["impossible"][top.best, -averaged:].any():
        report["impossible_rows"] = int(stats["impossible"][top.best, -averaged:].sum())
    z, error, information, none = top.z, None, None, ""
    by_particles = isinstance(setup.exact, NotApplicable)
    if isinstance(found, Hilltop):
        z = found.z
        jacobian = setup.chart.at(z).jacobian
        with np.errstate(over="ignore", invalid="ignore"):  # as far out as floating point goes
            error = jacobian @ found.error @ jacobian.T
        report |= {"beyond_the_swarms": found.moved, "estimate": f"{found}, the search for which "
                   f"began at the {report['estimate']}"}  # fmt: skip
        if by_particles:
            report["information"] = "from a quadratic fitted to estimates of the log-likelihood"
            information = setup.natural(z, found.information)
    else:
        report["monte_carlo_error"] = f"none: {found.reason}"
        none = found.reason if by_particles else ""
        if method.points != 0 and not interrupted:
            report |= {"converged": False, "stopped": f"{found.reason}: give more particles"}
    way = np.concatenate([np.array(points)[:, None], drawn["z"]], axis=1)
    log_p = stats["perturbed_log_likelihood"]
    return Ascent(
        setup.chart.at(z).theta, None,
        np.array([[setup.space.parameters(z)[0] for z in c] for c in way]),
        report, information, error, interrupted,
        {"perturbed_log_likelihood": np.hstack([np.full((len(log_p), 1), np.nan), log_p])}, none,
    )  # fmt: skip


def _beyond(
    setup: Setup, method: IF2, top: Summit, number: int, interrupted: bool
) -> tuple[Hilltop | NotApplicable, bool]:
    """The top beyond the ends of `number` swarms, and whether Ctrl-C was pressed by now."""
    if method.points == 0:
        return NotApplicable(SWITCHED_OFF), interrupted
    if not interrupted:
        try:
            return highest(setup, method, top, number), False
        except KeyboardInterrupt:
            pass
    return NotApplicable("interrupted before the top was looked for"), True


def highest(setup: Setup, method: IF2, ends: Summit, number: int) -> Hilltop | NotApplicable:
    """The top near where `number` swarms ended, unless the likelihood there is below theirs."""
    if not ends.value > -np.inf:
        return NotApplicable("the likelihood is zero where the swarms ended")
    noise = ends.noise * np.sqrt(method.evaluations)
    with announced("IF2", "looking for the top", shown=setup.progress):
        found = hilltop(setup, method, ends.z, noise)
    if isinstance(found, NotApplicable):
        return found
    try:
        (value,), (error,) = evaluate(setup, method, found.z[None], number + 1)
    except SamplingError:
        value, error = -np.inf, 0.0
    gain = value - ends.value
    if setup.with_prior:
        gain += setup.chart.at(found.z).log_prior - setup.chart.at(ends.z).log_prior
    if not gain > -HALF_INTERVAL - 2.0 * np.hypot(error, ends.noise):
        return NotApplicable("where the fitted quadratic has its top, the likelihood is low")
    return found


def _describe(recent: Sequence[Mapping[str, np.ndarray]]) -> str:
    best = max(float(stats["perturbed_log_likelihood"][-1]) for stats in recent)
    return f"perturbed log-likelihood {best:.2f}"


def step_scales(setup: Setup, method: IF2, model: Perturbed) -> np.ndarray:
    """(F,) standard deviations of the first steps: as asked for, 0 for what acts nowhere.

    Raises
    ------
    ArgumentError : a name is no free parameter.
    """
    given = method.perturbation
    named = given if isinstance(given, Mapping) else {}
    free = [n for n in setup.problem.trace.parameters if n not in setup.held]
    for name in named:
        if name not in free:
            raise ArgumentError(
                f"perturbation names {name!r}, which is no free parameter",
                fix=f"the free parameters are: {listing(str(name), free)}",
            )
    usual = USUAL if isinstance(given, Mapping) else float(given)
    rows = np.mean([e.steps for e in setup.problem.experiments])
    rare = usual * min(float(np.sqrt(rows)), MOST_FOR_INITIAL)
    out = np.where(model.moving, usual, rare)
    for k, name in enumerate(_owners(setup)):
        out[k] = named.get(name, out[k])
    return np.where(model.acting, out, 0.0)


def _owners(setup: Setup) -> list[str]:
    """(F,) the parameter that each unconstrained number belongs to."""
    return [s.data[1] for s in setup.chart.z]


def begin(setup: Setup, method: IF2) -> list[np.ndarray]:
    """(F,) where each swarm begins."""
    wanted = method.starts
    if isinstance(wanted, Sequence) and not isinstance(wanted, str):
        out = []
        for k, values in enumerate(wanted):
            own = check_values(setup.problem.trace, values, argument=f"starts[{k}]")
            space = space_of(setup.problem, setup.held, {**setup.near, **own})
            out.append(space.z[space.where])
        return out
    others = starts(setup, int(wanted) - 1) if int(wanted) > 1 else []  # type: ignore[call-overload]
    return [setup.start, *(setup.space_at(theta) for theta in others)]


def _report(
    setup: Setup, model: Perturbed, scales: np.ndarray, ends: np.ndarray, top: Summit,
    averaged: int,
) -> dict[str, Any]:  # fmt: skip
    names, agree = _owners(setup), int(top.near.sum())
    noise = f", Monte Carlo error {top.noise:.2g}" if top.noise > 0.0 else ""
    what = f"the {agree} swarms that agree" if top.pooled else f"swarm {top.best + 1}"
    ends_by_name = [
        unpack_parameters(setup.problem.trace, setup.space.parameters(z)[0]) for z in ends
    ]
    report: dict[str, Any] = {
        "converged": None if len(ends) == 1 else agree > 1,
        "estimate": f"mean over the rows and the last {averaged} passes of {what}, out of "
        f"{len(ends)}: the highest log-likelihood ({top.value:.3f}{noise})",
        "perturbation": dict(zip(_labels(setup), scales.tolist(), strict=True)),
        "initial_law_only": _named(names, model.acting & ~model.moving),
        "best_start": top.best,
        "starts_that_agree": np.flatnonzero(top.near).tolist(),
        "start_log_likelihoods": top.values.tolist(),
        "start_log_likelihood_errors": top.errors.tolist(),
        "start_parameters": [{n: v.tolist() for n, v in e.items()} for e in ends_by_name],
    }
    if not model.acting.all():
        report["without_effect"] = _named(names, ~model.acting)
    if report["converged"] is False:
        report["stopped"] = (
            f"no other of the {len(ends)} swarms ended near the best one: give more iterations, "
            "larger perturbations or more starts"
        )
    return report


def _labels(setup: Setup) -> list[str]:
    """(F,) the unconstrained numbers by name, with an index where a parameter has several."""
    names = _owners(setup)
    return [
        n if names.count(n) == 1 else repr(s) for n, s in zip(names, setup.chart.z, strict=True)
    ]


def _named(names: list[str], which: np.ndarray) -> list[str]:
    return list(dict.fromkeys(n for n, w in zip(names, which, strict=True) if w))
