"""Iterated filtering: particles that carry their own parameters, passed over the data many times.

E. L. Ionides, D. Nguyen, Y. Atchadé, S. Stoev and A. A. King, "Inference for dynamic and latent
variable models via iterated, perturbed Bayes maps", *PNAS* 112 (2015), algorithm IF2. In pass m the
parameters of a particle take a random step before it moves at row t, of standard deviation

    s a^(m - 1 + (t - 1) / T),    a = cooling^(1/50),

on the unconstrained scale; parameters and states are resampled together, and the parameters that
are left begin the next pass. As the steps vanish the particles gather where the likelihood is
highest.

Numbers that act in the initial distribution alone step at the first row only, which the model
itself tells (`analysis/proposals/perturbed.py`); those that act nowhere stay. Several experiments
are passed over one after another with the same particles, whose parameters all of them share.

At the end of a pass the particles lean to the last rows. Averaged over all rows of a pass they do
not, to first order: the filtered mean of a random walk is a weighted mean of what the rows say
whose weights, over a whole period, are the same for each row. So the iterates are means over rows;
those of the initial distribution's numbers are the particles' means at the end.

What is left, all runs may share: steps that have not vanished, a ridge not yet climbed. How the
ends differ does not tell it. So from the ends the top itself is looked for, by estimates of the
likelihood round it (`noisy_maximum.py`); their noise is the error of the estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ssmppl.analysis.proposals.perturbed import Perturbed, perturbed
from ssmppl.analysis.structure import exact_observation
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.modules.filter_variants import compile_iterated_filter
from ssmppl.compiling import once_property
from ssmppl.data import check_values, unpack_parameters
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError, listing
from ssmppl.inference.maximum.ascent import Ascent, Maximization
from ssmppl.inference.maximum.m_step import starts
from ssmppl.inference.maximum.noisy_maximum import LocalMaximum, check_points, local_maximum
from ssmppl.inference.methods.methods import IF2
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    failure,
    log_of_mean,
    repeated_estimates,
)
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.preparation.space import Space, space_of
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import Block, stack
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.progress import announced
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.run.tasks import run_tasks

HALF_INTERVAL = 1.92  # half of the 0.95 quantile of chi-square with one degree of freedom
USUAL = 0.02  # standard deviation of a step
MOST_FOR_INITIAL = 10.0  # times that of a number that steps at every row
SWITCHED_OFF = "IF2(points=0) asks for none, nor for the Monte Carlo error"


@dataclass(frozen=True)
class PerturbedFilter:
    """What all runs of IF2 in a call share; other processes generate the filter again.

    perturbation : (F,) standard deviation of the first step. moving : (F,) see `Perturbed`.
    cooling : factor of the standard deviation over 50 passes.
    """

    space: Space
    with_prior: bool
    perturbation: np.ndarray
    moving: np.ndarray
    cooling: float

    @property
    def problem(self) -> Problem:
        return self.space.problem

    @once_property
    def run(self) -> Callable[..., Any]:
        return compile_iterated_filter(perturbed_model(self.space, self.with_prior))

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "run"}

    def steps(self, iteration: int) -> list[np.ndarray]:
        """Standard deviations of the steps in a pass (from 1), (T, F) for each experiment."""
        rows = [e.steps for e in self.problem.experiments]
        part = iteration - 1.0 + np.arange(sum(rows)) / sum(rows)
        scale = (self.cooling ** (part / 50.0))[:, None] * self.perturbation
        out = np.split(scale, np.cumsum(rows)[:-1])
        for own in out:
            own[1:, ~self.moving] = 0.0
        return out

    def one_pass(
        self, particles: np.ndarray, iteration: int, stream: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Move the particles (F, N) over all experiments; (iterate (F,), log_increment of all
        rows).

        Raises
        ------
        SamplingError : a weight is infinite.
        """
        every, sums = [], np.zeros(len(particles))
        for k, (e, steps) in enumerate(
            zip(self.problem.experiments, self.steps(iteration), strict=True)
        ):
            parts = [e.u, steps]
            if self.with_prior:
                counts = np.zeros((e.steps, 1))
                counts[0] = k == 0
                parts.append(counts)
            increment, means = np.empty(e.steps), np.empty(steps.shape)
            status, t = self.run(
                self.space.theta, e.y, e.seen, np.hstack(parts), stream, particles, increment, means
            )
            if status != OK:
                theta, _ = self.space.parameters(particles.mean(axis=1))
                raise failure(self.problem, theta, status, t, e)
            every.append(increment)
            sums += means.sum(axis=0)
        log_increment = np.concatenate(every)
        mean = np.where(self.moving, sums / len(log_increment), particles.mean(axis=1))
        return mean, log_increment


@dataclass(frozen=True)
class IF2State:
    """Where a run stands: its particles (F, N), the kernels' random state, passes made."""

    particles: np.ndarray
    stream: np.ndarray
    done: int


def if2_block(perturbed_filter: PerturbedFilter, state: IF2State, n: int) -> tuple[IF2State, Block]:
    """n passes of one run."""
    particles, stream = state.particles.copy(), state.stream.copy()
    z, totals, impossible = [], [], []
    for k in range(state.done + 1, state.done + n + 1):
        mean, log_increment = perturbed_filter.one_pass(particles, k, stream)
        z.append(mean)
        totals.append(total_of(log_increment))
        impossible.append(np.sum(log_increment == -np.inf))
    stats = {"perturbed_log_likelihood": np.array(totals), "impossible": np.array(impossible)}
    return IF2State(particles, stream, state.done + n), Block({"z": np.array(z)}, stats)


def perturbed_model(space: Space, with_prior: bool) -> Perturbed:
    """The perturbed form of a problem's model."""
    problem = space.problem
    return perturbed(problem.trace, problem.program.missing, space.free.tolist(), with_prior)


@dataclass(frozen=True)
class BestEnd:
    """The best of S ends, or the mean of those that agree with it.

    z : (F,) the estimate. value, noise : log-likelihood there and its standard error. values,
    errors : (S,) those of the ends. near : (S,) which ends agree. pooled : whether z is their mean.
    """

    z: np.ndarray
    value: float
    noise: float
    values: np.ndarray
    errors: np.ndarray
    best: int
    near: np.ndarray
    pooled: bool


def best_end(setup: Maximization, method: IF2, ends: np.ndarray) -> BestEnd:
    """Where the likelihood is highest out of the ends (S, F) of the runs and their mean.

    Ends agree where their log-likelihoods differ by less than half the width of a 0.95 interval of
    a profile, and two standard errors.
    """
    values, errors = evaluate(setup, method, ends, 0)
    heights = values + np.array([setup.log_prior(z) for z in ends])
    best = int(np.argmax(heights))
    with np.errstate(invalid="ignore"):  # none is near where all likelihoods are zero
        near = heights[best] - heights <= HALF_INTERVAL + 2.0 * np.hypot(errors, errors[best])
    z, value, noise, pooled = ends[best], values[best], errors[best], False
    if near.sum() > 1:
        middle = ends[near].mean(axis=0)
        (own,), (own_noise,) = evaluate(setup, method, middle[None], len(ends))
        if own + setup.log_prior(middle) >= heights[best]:
            z, value, noise, pooled = middle, own, own_noise, True
    return BestEnd(z, float(value), float(noise), values, errors, best, near, pooled)


def evaluate(
    setup: Maximization, method: IF2, ends: np.ndarray, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """(log-likelihood, its standard error) at each end (S, F), numbered from `first`; exact where
    that can be. An end at which the filter fails has -inf.
    """
    problem, thetas = setup.problem, [setup.space.parameters(z)[0].copy() for z in ends]
    if not isinstance(setup.exact, NotApplicable):
        exact = [setup.exact.log_likelihood(problem.experiments, theta) for theta in thetas]
        return np.array(exact), np.zeros(len(ends))
    task = partial(_estimates, problem, method.particles, method.evaluations)
    pieces = [(theta, setup.seed(7, first + k)) for k, theta in enumerate(thetas)]
    found = run_tasks(task, pieces, executor=setup.executor)
    failed = [e for e in found if isinstance(e, SamplingError)]
    if len(failed) == len(found):
        raise failed[0]
    pairs = [(-np.inf, np.nan) if isinstance(e, SamplingError) else log_of_mean(e) for e in found]
    values, errors = np.array(pairs).T
    return values, np.nan_to_num(errors)


def _estimates(
    problem: Problem, particles: int, repeats: int, piece: tuple[np.ndarray, np.random.SeedSequence]
) -> np.ndarray | SamplingError:
    theta, seed = piece
    try:
        chosen = choose_by_pilot(problem, theta, exact=False, temper=True).name
        settings = FilterSettings(particles, chosen)
        return repeated_estimates(problem, theta, settings, seed, range(repeats))
    except SamplingError as error:
        return error


def climb(setup: Maximization, method: IF2) -> Ascent:
    """The maximum of the likelihood, or of the posterior density, by iterated filtering.

    setup : model, data, start and objective. method : its settings. The `Ascent` has the end, the
    iterates and the report.

    Raises
    ------
    ArgumentError : a setting does not apply; no particle can be drawn from the initial
        distribution.
    SamplingError : the likelihood cannot be evaluated where any of the runs ended.
    """
    exact = exact_observation(setup.problem.trace)
    if exact is not None:
        raise ArgumentError(
            f"IF2 weighs particles by the density of the observation, and {exact.reason}",
            fix="use ssm.sample, or give the observation some noise",
            where=exact.where,
        )
    setup.problem.proposal("bootstrap")
    check_points(method, len(setup.space.positions))
    model = perturbed_model(setup.space, setup.with_prior)
    scales = step_scales(setup, method, model)
    perturbed_filter = PerturbedFilter(
        setup.space, setup.with_prior, scales, model.moving, method.cooling
    )
    points = begin(setup, method)
    states = [
        IF2State(np.tile(z[:, None], (1, method.particles)), random_state(setup.seed(6, k)), 0)
        for k, z in enumerate(points)
    ]
    chains = run_chains(
        partial(if2_block, perturbed_filter), states, method.iterations, executor=setup.executor,
        progress=setup.progress, title="IF2", describe=_describe,
    )  # fmt: skip
    drawn, stats = stack(chains)
    averaged = min(method.averaged, drawn["z"].shape[1])
    ends = drawn["z"][:, -averaged:].mean(axis=1)
    interrupted = cut_short = any(c.interrupted for c in chains)
    top = best_end(setup, method, ends)
    found, interrupted = _beyond(setup, method, top, len(ends), interrupted)
    report = _report(setup, model, scales, ends, top, averaged)
    if cut_short:  # runs that have hardly left their starts agree by these
        report["converged"] = None
    if stats["impossible"][top.best, -averaged:].any():
        report["impossible_rows"] = int(stats["impossible"][top.best, -averaged:].sum())
    z, error, information, none = top.z, None, None, ""
    by_particles = isinstance(setup.exact, NotApplicable)
    if isinstance(found, LocalMaximum):
        z = found.z
        error = setup.natural_error(z, found.error)
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
        setup.transform.at(z).theta, None,
        np.array([[setup.space.parameters(z)[0] for z in c] for c in way]),
        report, information, error, interrupted,
        {"perturbed_log_likelihood": np.hstack([np.full((len(log_p), 1), np.nan), log_p])}, none,
    )  # fmt: skip


def _beyond(
    setup: Maximization, method: IF2, top: BestEnd, number: int, interrupted: bool
) -> tuple[LocalMaximum | NotApplicable, bool]:
    """The top beyond the ends of `number` runs, and whether Ctrl-C was pressed by now."""
    if method.points == 0:
        return NotApplicable(SWITCHED_OFF), interrupted
    if not interrupted:
        try:
            return maximum_near(setup, method, top, number), False
        except KeyboardInterrupt:
            pass
    return NotApplicable("interrupted before the maximum was located"), True


def maximum_near(
    setup: Maximization, method: IF2, ends: BestEnd, number: int
) -> LocalMaximum | NotApplicable:
    """The top near where `number` runs ended, unless the likelihood there is below theirs."""
    if not ends.value > -np.inf:
        return NotApplicable("the likelihood is zero where the IF2 runs ended")
    noise = ends.noise * np.sqrt(method.evaluations)
    with announced("IF2", "locating the maximum", shown=setup.progress):
        found = local_maximum(setup, method, ends.z, noise)
    if isinstance(found, NotApplicable):
        return found
    try:
        (value,), (error,) = evaluate(setup, method, found.z[None], number + 1)
    except SamplingError:
        value, error = -np.inf, 0.0
    gain = value - ends.value + (setup.log_prior(found.z) - setup.log_prior(ends.z))
    if not gain > -HALF_INTERVAL - 2.0 * np.hypot(error, ends.noise):
        return NotApplicable("where the fitted quadratic has its maximum, the likelihood is low")
    return found


def _describe(recent: Sequence[Mapping[str, np.ndarray]]) -> str:
    best = max(float(stats["perturbed_log_likelihood"][-1]) for stats in recent)
    return f"perturbed log-likelihood {best:.2f}"


def step_scales(setup: Maximization, method: IF2, model: Perturbed) -> np.ndarray:
    """(F,) standard deviations of the first steps: as asked for, 0 for what acts nowhere.

    Raises
    ------
    ArgumentError : a name is no free parameter.
    """
    given = method.perturbation
    named = given if isinstance(given, Mapping) else {}
    free = [n for n in setup.problem.trace.parameters if n not in setup.fixed]
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


def _owners(setup: Maximization) -> list[str]:
    """(F,) the parameter that each unconstrained number belongs to."""
    return [s.data[1] for s in setup.transform.z]


def begin(setup: Maximization, method: IF2) -> list[np.ndarray]:
    """(F,) where each run begins."""
    wanted = method.starts
    if isinstance(wanted, Sequence) and not isinstance(wanted, str):
        out = []
        for k, values in enumerate(wanted):
            own = check_values(setup.problem.trace, values, argument=f"starts[{k}]")
            space = space_of(setup.problem, setup.fixed, {**setup.near, **own})
            out.append(space.z[space.positions])
        return out
    others = starts(setup, int(wanted) - 1) if int(wanted) > 1 else []  # type: ignore[call-overload]
    return [setup.start, *(setup.space_at(theta) for theta in others)]


def _report(
    setup: Maximization, model: Perturbed, scales: np.ndarray, ends: np.ndarray, top: BestEnd,
    averaged: int,
) -> dict[str, Any]:  # fmt: skip
    names, agree = _owners(setup), int(top.near.sum())
    noise = f", Monte Carlo error {top.noise:.2g}" if top.noise > 0.0 else ""
    what = f"the {agree} runs that agree" if top.pooled else f"run {top.best + 1}"
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
            f"no other of the {len(ends)} runs ended near the best one: give more iterations, "
            "larger perturbations or more starts"
        )
    return report


def _labels(setup: Maximization) -> list[str]:
    """(F,) the unconstrained numbers by name, with an index where a parameter has several."""
    names = _owners(setup)
    return [
        n if names.count(n) == 1 else repr(s) for n, s in zip(names, setup.transform.z, strict=True)
    ]


def _named(names: list[str], which: np.ndarray) -> list[str]:
    return list(dict.fromkeys(n for n, w in zip(names, which, strict=True) if w))
