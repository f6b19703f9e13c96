"""SMC^2: particles in the parameters, each with a particle filter of its own, through the data.

N. Chopin, P. E. Jacob and O. Papaspiliopoulos, "SMC^2: an efficient algorithm for sequential
analysis of state space models", *JRSS B* 75 (2013). Parameters are drawn from the prior and weighed
row by row by their filters' estimates of p(y_t | y_{1:t-1}, theta). Where the weights have become
uneven, parameters are resampled with their filters and moved by particle Metropolis-Hastings on the
rows so far, by a random walk of the particles' own covariance (section 3.1, steps (c) and (d)).
Where too few moves are accepted, each filter is exchanged for one with twice the particles
(section 3.6.1: weights times Z_new / Z_old).

The product over rows of the mean incremental weights, those of exchanges included, estimates p(y)
without bias, but for what adapting does, which is of order 1 / M. M particles in the parameters, N
in each filter.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ssmppl.analysis.density import terms
from ssmppl.codegen.kernels.particle.resampling import PADDING, systematic
from ssmppl.codegen.kernels.particle.weights import NO_POINT, OK
from ssmppl.codegen.modules.filter_variants import compile_filter_rows
from ssmppl.compiling import once_property
from ssmppl.counts import check_count
from ssmppl.data import unpack_parameters
from ssmppl.errors import ArgumentError
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.chains.sampling import SamplingMethod, SamplingSetup
from ssmppl.inference.methods.methods import SMC2
from ssmppl.inference.particles.filtering import failure, log_of_mean
from ssmppl.inference.preparation.proposal_choice import Choice, choose_by_pilot
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import Block, ChainDraws
from ssmppl.inference.run.prior import draw_prior
from ssmppl.inference.run.problem import Problem
from ssmppl.language.model.transforms import transforms, unconstrain

STEP = 2.38  # of the random walk, over sqrt(F), in standard deviations (Roberts et al. 1997)
MOST_PARTICLES = 100_000


@dataclass(frozen=True)
class Filters:
    """What all runs of a call share; other processes generate the filter again."""

    space: Space
    method: SMC2
    proposal: str

    @property
    def problem(self) -> Problem:
        return self.space.problem

    @once_property
    def run(self) -> Callable[..., Any]:
        return compile_filter_rows(self.problem.trace, self.problem.proposal(self.proposal))

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "run"}

    def on(
        self, theta: np.ndarray, particles: Particles, experiment: int, start: int, stop: int,
        stream: np.ndarray,
    ) -> float:  # fmt: skip
        """The sum of a filter's log increments from row `start` to `stop` - 1 of an experiment;
        -inf where they are zero. The particles move."""
        e = self.problem.experiments[experiment]
        out = np.zeros(e.steps)
        status, t = self.run(
            theta, e.y, e.seen, e.u, start, stop, stream, particles.x, particles.w, out
        )
        if status in NO_POINT:
            return -np.inf
        if status != OK:
            raise failure(self.problem, theta, status, t, e)
        return float(out[start:stop].sum())

    def anew(
        self, theta: np.ndarray, n: int, experiment: int, stop: int, stream: np.ndarray
    ) -> tuple[Particles, float]:
        """A filter of n particles over all rows so far: all earlier experiments, and the rows
        before `stop` of this one; with its log Z."""
        own, total = self.particles(n), 0.0
        for k in range(experiment + 1):
            last = self.problem.experiments[k].steps if k < experiment else stop
            total += self.on(theta, own, k, 0, last, stream)
            if total == -np.inf:
                break
        return own, total

    def particles(self, n: int) -> Particles:
        return Particles(np.zeros((len(self.problem.trace.state_symbols), n)), np.full(n, 1.0 / n))


@dataclass(frozen=True)
class Particles:
    """x (D, N) and normalised weights w (N,)."""

    x: np.ndarray
    w: np.ndarray

    def copy(self) -> Particles:
        return Particles(self.x.copy(), self.w.copy())


@dataclass(frozen=True)
class SMC2State:
    """Where a run stands, before row `row` of an experiment.

    z (M, F), theta (M, P), log_prior (M,) with the Jacobian; log_w (M,); log_z (M,) of the filters
    of `particles`. log_evidence of the rows so far.
    """

    z: np.ndarray
    theta: np.ndarray
    log_prior: np.ndarray
    log_w: np.ndarray
    log_z: np.ndarray
    filters: tuple[Particles, ...]
    log_evidence: float
    experiment: int
    row: int
    generator: np.random.Generator
    stream: np.ndarray

    @property
    def size(self) -> int:
        """The number N of particles."""
        return len(self.filters[0].w)

    def weights(self) -> np.ndarray:
        """(M,) normalised; all equal where every one is zero."""
        top = self.log_w.max()
        w = np.exp(self.log_w - top) if top > -np.inf else np.ones(len(self.log_w))
        return w / w.sum()

    def weighted(self, log_factor: np.ndarray) -> SMC2State:
        """With these factors in the weights, and their mean in the evidence."""
        top = np.max(log_factor)
        if not top > -np.inf:
            return replace(self, log_evidence=-np.inf)
        mean = np.log(self.weights() @ np.exp(log_factor - top)) + top
        return replace(
            self, log_w=self.log_w + log_factor, log_evidence=self.log_evidence + float(mean)
        )


def begin(filters: Filters, setup: SamplingSetup, run: int) -> SMC2State:
    """M draws from the prior, given the fixed parameters; the priors of fixed ones that depend on
    free ones are their first data."""
    method, trace, space = filters.method, setup.problem.trace, setup.space
    assert method.parameters is not None
    generator, stream = setup.streams(run)
    theta = draw_prior(trace, generator, method.parameters, setup.fixed)
    # a fixed one may lie outside of bounds that were drawn: these have no weight
    made = [t for t, free in zip(transforms(trace), space.free, strict=True) if free]
    z = np.array([unconstrain(trace, t, unpack_parameters(trace, t), made) for t in theta])
    log_prior = np.array([space.parameters(v)[1] for v in z])
    m = len(theta)
    state = SMC2State(
        z, theta, log_prior, np.zeros(m), np.zeros(m),
        tuple(filters.particles(method.particles) for _ in range(m)), 0.0, 0, 0, generator, stream,
    )  # fmt: skip
    values = dict(zip(trace.parameter_symbols, theta.T, strict=True))
    for term in terms(trace, "prior"):
        names = {s.data[1] for s in symbols_of(term.log_density)}
        if term.site.name in setup.fixed and not names <= setup.fixed.keys():
            factor = np.broadcast_to(evaluate([term.log_density], values)[0], (m,))
            state = state.weighted(np.asarray(factor, dtype=float))
    return state


def rows_block(filters: Filters, state: SMC2State, n: int) -> tuple[SMC2State, Block]:
    """n rows of one run."""
    state = replace(
        state, generator=copy.deepcopy(state.generator), stream=state.stream.copy(),
        filters=tuple(p.copy() for p in state.filters),
    )  # fmt: skip
    evidence, ess, rates, sizes = [], [], [], []
    for _ in range(n):
        before = state.log_evidence
        state, share, rate = one_row(filters, state)
        evidence.append(state.log_evidence - before if state.log_evidence > -np.inf else -np.inf)
        ess.append(share)
        rates.append(rate)
        sizes.append(state.size)
    stats: dict[str, list[Any]] = {"ess": ess, "acceptance_rate": rates, "particles": sizes}
    return state, Block.of({"log_evidence": evidence}, stats)


def one_row(filters: Filters, state: SMC2State) -> tuple[SMC2State, float, float]:
    """(the state after the next row, ESS / M before any move, acceptance rate or nan)."""
    k, t, method = state.experiment, state.row, filters.method
    increments = np.full(len(state.theta), -np.inf)
    for i, (theta, own) in enumerate(zip(state.theta, state.filters, strict=True)):
        if state.log_w[i] > -np.inf:
            increments[i] = filters.on(theta, own, k, t, t + 1, state.stream)
    state = state.weighted(increments)
    last = t + 1 == filters.problem.experiments[k].steps
    end = last and k + 1 == len(filters.problem.experiments)
    state = replace(state, log_z=state.log_z + increments, row=t + 1)
    if state.log_evidence == -np.inf:
        raise ArgumentError(
            f"no parameter out of {len(state.theta)} can have produced row {t + 1}",
            fix="give more parameters=, filters of more particles=, or a prior nearer to the data",
        )
    share = 1.0 / np.sum(state.weights() ** 2) / len(state.theta)
    rate = np.nan
    if share < method.ess_threshold or end:
        state, rate = rejuvenate(filters, state)
        if rate < method.acceptance and not end and 2 * state.size <= MOST_PARTICLES:
            state = exchange(filters, state, 2 * state.size)
    if last and not end:
        state = replace(state, experiment=k + 1, row=0)
    return state, share, rate


def rejuvenate(filters: Filters, state: SMC2State) -> tuple[SMC2State, float]:
    """Resample, and move each parameter by particle Metropolis-Hastings; (state, acceptance)."""
    w, m, f = state.weights(), len(state.theta), state.z.shape[1]
    factor = _factor(state.z, w)
    ancestors = np.empty(m + PADDING, dtype=np.int32)
    systematic(state.stream, w, ancestors)
    chosen = ancestors[:m]
    z, theta = state.z[chosen], state.theta[chosen]
    log_prior, log_z = state.log_prior[chosen], state.log_z[chosen]
    own, accepted = [state.filters[j].copy() for j in chosen], 0
    for _ in range(filters.method.moves if f else 0):
        steps = state.generator.standard_normal((m, f)) @ factor.T * STEP / np.sqrt(f)
        log_u = np.log(state.generator.uniform(size=m))
        for i in range(m):
            new = z[i] + steps[i]
            there, density = filters.space.parameters(new)
            if density == -np.inf:
                continue
            fresh, value = filters.anew(
                there, state.size, state.experiment, state.row, state.stream
            )
            if log_u[i] < value + density - log_z[i] - log_prior[i]:
                z[i], theta[i], log_prior[i], log_z[i] = new, there, density, value
                own[i] = fresh
                accepted += 1
    rate = accepted / (m * filters.method.moves) if f else 1.0
    return replace(
        state, z=z, theta=theta, log_prior=log_prior, log_z=log_z, log_w=np.zeros(m),
        filters=tuple(own),
    ), rate  # fmt: skip


def exchange(filters: Filters, state: SMC2State, n: int) -> SMC2State:
    """New filters of n particles for the old ones, with weights Z_new / Z_old."""
    made = [
        filters.anew(theta, n, state.experiment, state.row, state.stream) for theta in state.theta
    ]
    log_z = np.array([value for _, value in made])
    moved = state.weighted(log_z - state.log_z)
    return replace(moved, log_z=log_z, filters=tuple(p for p, _ in made))


def _factor(z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Cholesky factor (F, F) of the particles' covariance, never singular."""
    off = z - w @ z
    covariance = (w[:, None] * off).T @ off
    variance = np.diagonal(covariance)  # of parameters in any unit, so that no size is small
    return np.linalg.cholesky(
        covariance + np.diag(np.where(variance > 0.0, 1e-8 * variance, 1e-12))
    )


@dataclass(frozen=True)
class Runs:
    """What the runs (R) gave: theta (R, M, P) of equal weight, in random order, log p(y) of each
    (R,), and what to report."""

    theta: np.ndarray
    log_evidence: np.ndarray
    report: dict[str, Any]


def run_smc2(setup: SamplingSetup, method: SMC2, executor: Any, progress: bool) -> Runs:
    """Independent runs through all rows.

    Raises
    ------
    ArgumentError : a prior is improper; no parameter explains a row.
    KeyboardInterrupt : by Ctrl-C, as parameters given some of the rows are not what was asked for.
    """
    check_count("parameters", method.parameters, 2)  # as many as draws, where none were given
    draw_prior(  # improper: refused now
        setup.problem.trace, np.random.default_rng(0), 1, setup.fixed, "or its value by fixed="
    )
    filters = Filters(setup.space, method, _proposal(setup, method))
    states = [begin(filters, setup, r) for r in range(setup.chains)]
    rows = setup.problem.rows
    chains: Sequence[ChainDraws[SMC2State]] = run_chains(
        partial(rows_block, filters), states, rows, executor=executor, progress=progress,
        title="SMC2", describe=_describe, checkpoint=setup.checkpoint,
    )  # fmt: skip
    if any(c.interrupted for c in chains):
        raise chains[0].lost or KeyboardInterrupt("interrupted before all rows were seen")
    kept = [c.state.theta[c.state.generator.permutation(len(c.state.theta))] for c in chains]
    log_evidence = np.array([c.state.log_evidence for c in chains])
    rates = np.concatenate([c.stats["acceptance_rate"] for c in chains])
    value, error = log_of_mean(log_evidence)
    report = {
        "settings": asdict(method), "proposal": filters.proposal,
        "particles": [c.state.size for c in chains],
        "log_evidence": value, "log_evidence_error": error,
        "log_evidence_of_runs": log_evidence.tolist(),
        "rejuvenations": [int(np.isfinite(c.stats["acceptance_rate"]).sum()) for c in chains],
        "acceptance_of_moves": float(np.nanmean(rates)),
    }  # fmt: skip
    return Runs(np.stack(kept), log_evidence, report)


def _describe(recent: Sequence[Mapping[str, np.ndarray]]) -> str:
    share = np.mean([stats["ess"][-1] for stats in recent])
    return f"{max(int(stats['particles'][-1]) for stats in recent)} particles, ESS {share:.2f}"


def with_parameters(method: SMC2, draws: int) -> SMC2:
    """With its number of parameters.

    Raises
    ------
    ArgumentError : more draws are wanted than there are particles in the parameters.
    """
    method = replace(method, parameters=draws if method.parameters is None else method.parameters)
    assert method.parameters is not None
    if draws > method.parameters:
        raise ArgumentError(
            f"draws={draws} from SMC2(parameters={method.parameters})",
            fix=f"give at most {method.parameters} draws, or more parameters=",
        )
    return method


def drawn(
    setup: SamplingSetup, method: SMC2, draws: int, executor: Any, progress: bool
) -> tuple[list[ChainDraws[Any]], dict[str, Any]]:
    """The runs of a method whose number of parameters is known, as chains of `draws` draws, and
    what to report."""
    found = run_smc2(setup, method, executor, progress)
    chains = [ChainDraws({"theta": theta[:draws]}, {}, {}, None) for theta in found.theta]
    return chains, found.report


def _proposal(setup: SamplingSetup, method: SMC2) -> str:
    """The proposal of the filters, one without look-ahead."""
    name = method.proposal
    if name == "auto":
        theta = setup.space.theta
        name = setup.once(
            "proposal", lambda: choose_by_pilot(setup.problem, theta, exact=False)
        ).name
        name = {"auxiliary": "guided", "twisted": "bootstrap"}.get(name, name)
    found = setup.problem.proposal(name)
    if found.look_ahead is not None or found.unsuited:
        raise ArgumentError(
            f"proposal={name!r} looks ahead, which the filters of SMC2 do not",
            fix='use "auto", "bootstrap" or "guided"',
        )
    return name


METHOD = SamplingMethod(
    None, drawn, state_classes=(SMC2State, Particles, Choice), complete=with_parameters
)
