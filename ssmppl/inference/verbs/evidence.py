"""The verb `evidence`: log p(y), the parameters integrated out, by bridge sampling.

The estimate of the likelihood by a particle filter is a density over the parameters *and* the
filter's random numbers: the posterior draws of particle Metropolis-Hastings, with the estimates
that they were accepted with, are draws from it (Andrieu, Doucet and Holenstein 2010), and fresh
estimates at draws of any other distribution are draws from that distribution on the same space.
Bridge sampling between the two is therefore consistent for every number of particles, which only
sets its error.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ssmppl.analysis.density import terms
from ssmppl.arguments import checked_with
from ssmppl.counts import check_count
from ssmppl.data import check_values
from ssmppl.data.notices import noticed
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.chains import smc2
from ssmppl.inference.chains.bridge import Bridge, Student, bridge, importance
from ssmppl.inference.chains.sampling import SamplingSetup
from ssmppl.inference.methods.methods import PMMH, SMC2, MetropolisHastings
from ssmppl.inference.methods.settings import check_settings
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    log_likelihood_estimate,
    log_of_mean,
    repeated_estimates,
)
from ssmppl.inference.preparation.exact_models import exact_log_likelihood, exact_model, filter_of
from ssmppl.inference.preparation.pilot import find_mode, tune_particles
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.preparation.space import Space, space_of
from ssmppl.inference.run.convergence import unjudged
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.inference.verbs.sample import sample
from ssmppl.language.model.model import Model
from ssmppl.language.model.transforms import unconstrain

TASKS = 16
TARGET_SD = 1.0
FEW = 20  # draws of a chain that was interrupted, half of which fit the law bridged to
POINTS = 5  # that the law is fitted to, for each number and one more
PARAMETERS = 500  # particles of SMC^2
REPEATS = 200  # estimates of the likelihood where there is no parameter to integrate out


@dataclass(frozen=True)
class Evidence:
    """The log evidence log p(y) of a model.

    Parameters
    ----------
    log_evidence : the estimate.
    standard_error : its Monte Carlo standard error.
    report : how it was made: method, particles, draws, and the estimate by importance sampling
        from the same draws, which is a check on the other; and whether Ctrl-C ended the sampling,
        so that fewer draws were used.
    """

    log_evidence: float
    standard_error: float
    report: Mapping[str, Any] = field(default_factory=dict)

    def bayes_factor(self, other: Evidence) -> tuple[float, float]:
        """Compare with another model of the same data.

        Parameters
        ----------
        other : its evidence.

        Returns
        -------
        tuple of float
            Log of p(y | this model) / p(y | other), and its standard error.
        """
        error = float(np.hypot(self.standard_error, other.standard_error))
        return self.log_evidence - other.log_evidence, error

    def __str__(self) -> str:
        return f"log evidence {self.log_evidence:.4f} (standard error {self.standard_error:.4f})"


@checked_with((PMMH, MetropolisHastings, SMC2))
def evidence(
    model: Model,
    data: Any,
    method: PMMH | MetropolisHastings | SMC2 | None = None,
    *,
    draws: int = 2000,
    warmup: int = 1000,
    chains: int = 4,
    start: Mapping[str, Any] | None = None,
    fixed: Mapping[str, Any] | None = None,
    seed: int | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> Evidence:
    """Estimate log p(y), the log of the likelihood averaged over the prior.

    Posterior draws by `method` are bridged to a multivariate t fitted to the first half of them,
    on the unconstrained scale (Meng and Wong 1996; Overstall and Forster 2010), the second half
    and as many draws of the t giving the estimate.

    Parameters
    ----------
    model : the model, as declared.
    data : as in `sample`.
    method : `ssm.PMMH(...)`, or `ssm.MetropolisHastings(...)` for linear Gaussian models; None:
        the exact one where it applies. `ssm.SMC2(...)` estimates it without a bridge, by `chains`
        independent runs, at least two, whose spread gives the error.
    draws, warmup, chains : of the sampler.
    start, fixed, seed, executor, progress : as in `sample`. Fixed parameters are held, not
        integrated over.

    Returns
    -------
    Evidence : log p(y), and the standard error of the estimate.

    Raises
    ------
    ArgumentError : a free parameter has an improper prior, so that p(y) has no meaning; or there
        are too few draws for the number of parameters.
    SamplingError : the likelihood is zero wherever the distribution bridged to puts its points.
    """
    for name, value, least in (("draws", draws, 4), ("warmup", warmup, 0), ("chains", chains, 1)):
        check_count(name, value, least)
    check_executor(executor)
    check_settings(method)
    problem = pose(model, data, noting=True)
    fixed_values = check_values(problem.trace, fixed, argument="fixed")
    near = check_values(problem.trace, start, argument="start")
    _refuse_improper(problem, fixed_values)
    root = seed_sequence(seed)
    space = space_of(problem, fixed_values, near)
    if isinstance(method, SMC2):
        check_count("chains", chains, 2)
        setup = SamplingSetup(problem, space, fixed_values, chains, 0, 1, root, False)
        return _by_smc2(setup, method, executor, progress)
    chosen = _chosen(problem, method)
    if isinstance(chosen, PMMH):
        chosen = _with_filter(problem, space, chosen, root)
    d = space.positions.size
    if not d:
        return _without_parameters(problem, space, chosen, root)
    if draws * chains < 2 * POINTS * (d + 1):
        raise ArgumentError(
            f"draws={draws} of each of {chains} chain{'s' if chains > 1 else ''}: half of them are "
            f"too few to fit a distribution of {d} number{'s' if d > 1 else ''} to",
            fix=f"give at least {-(-2 * POINTS * (d + 1) // chains)} draws",
        )
    with noticed(), unjudged():  # its own error counts effective draws
        result = sample(
            model, data, chosen, draws=draws, warmup=warmup, chains=chains, start=start,
            fixed=fixed, states=False, seed=seed, executor=executor, progress=progress,
        )  # fmt: skip
    interrupted = bool(result["posterior"].attrs["interrupted"])
    z, own = _posterior(space, result)
    if interrupted and z.shape[1] < FEW:
        raise KeyboardInterrupt(f"interrupted after {z.shape[1]} draws of each chain: too few")
    half = z.shape[1] // 2
    law = Student.fitted(z[:, :half].reshape(-1, z.shape[-1]))
    own_ratio = own[:, half:] - law.log_density(z[:, half:])
    generator = np.random.default_rng(_child(root, 1))
    points = law.draw(generator, own_ratio.size)
    task = partial(_log_densities, space, chosen, root)
    pieces = np.array_split(np.arange(len(points)), TASKS)
    density = run_tasks(
        task, [(points[p], p) for p in pieces], executor=executor, progress=progress,
        title="evidence",
    )  # fmt: skip
    other_ratio = np.concatenate(density) - law.log_density(points)
    if not np.any(other_ratio > -np.inf):
        raise SamplingError(
            "the likelihood is zero at all draws from the fitted t proposal, so that there is "
            "nothing to compare the draws of the posterior with",
            fix="give more draws, or method=ssm.SMC2(), which needs no such distribution",
        )
    found, check = bridge(own_ratio, other_ratio), importance(other_ratio)
    known = _log_prior_of_fixed(problem, fixed_values)
    return Evidence(
        found.log_constant - known, found.standard_error,
        {
            **_report(chosen, own_ratio, replace(check, log_constant=check.log_constant - known)),
            "interrupted": interrupted,
        },
    )  # fmt: skip


def _by_smc2(
    setup: SamplingSetup, method: SMC2, executor: Executor | None, progress: bool
) -> Evidence:
    """The mean over independent runs, each of which estimates p(y) without bias."""
    wanted = PARAMETERS if method.parameters is None else method.parameters
    found = smc2.run_smc2(setup, replace(method, parameters=wanted), executor, progress)
    value, error = log_of_mean(found.log_evidence)
    return Evidence(value, error, {"method": "SMC2", **found.report})


def _refuse_improper(problem: Problem, fixed_values: Mapping[str, np.ndarray]) -> None:
    for site in problem.trace.parameters.values():
        if not site.distribution.proper and site.name not in fixed_values:
            kind = type(site.distribution).__name__
            raise ArgumentError(
                f"the prior of {site.name!r} is {kind}, which is improper: the evidence is then "
                f"only defined up to a constant ({site.distribution.location})",
                fix=f"give {site.name!r} a proper prior, or its value by fixed=",
            )


def _log_prior_of_fixed(problem: Problem, fixed_values: Mapping[str, np.ndarray]) -> float:
    """What the priors of fixed parameters add to the log density; they are conditioned on.

    That of one whose prior depends on a free parameter stays: it is data for that parameter.
    """
    known = {s: fixed_values[s.data[1]][s.data[2]] for s in problem.trace.parameter_symbols
             if s.data[1] in fixed_values}  # fmt: skip
    total = 0.0
    for term in terms(problem.trace, "prior"):
        if term.site.name in fixed_values and symbols_of(term.log_density) <= known.keys():
            total += float(evaluate([term.log_density], known)[0])
    return total


def _chosen(
    problem: Problem, method: PMMH | MetropolisHastings | None
) -> PMMH | MetropolisHastings:
    exact = not isinstance(exact_model(problem.trace), NotApplicable)
    if method is None:
        return MetropolisHastings() if exact else PMMH()
    if not isinstance(method, (PMMH, MetropolisHastings)):
        raise ArgumentError(
            f"method={method!r} gives no estimates of the likelihood to bridge with",
            fix="use ssm.PMMH(...), ssm.MetropolisHastings(...), ssm.SMC2(...) or None",
        )
    if isinstance(method, PMMH) and method.correlation:
        raise ArgumentError(
            f"correlation={method.correlation!r}: its "
            "correlated estimates have a different distribution from the independent ones needed",
            fix="leave correlation=0 for the evidence",
        )
    return method


def _with_filter(
    problem: Problem, space: Space, method: PMMH, root: np.random.SeedSequence
) -> PMMH:
    """The method with its proposal and particles, which the sampler and the bridge share."""
    proposal, particles = method.proposal, method.particles
    if proposal == "auto" or particles is None:
        theta, _ = space.parameters(find_mode(space, root, rescue=method.rescue).z)
        if proposal == "auto":
            plain = method.order == 0  # filters with scores know all states, and no guide
            choice = choose_by_pilot(
                problem, theta, exact=False, whole=plain, integrate=plain,
                temper=plain and not method.rescue,
            )  # fmt: skip
            proposal = choice.name
        problem.proposal(proposal, integrate=method.order == 0)
        if particles is None:
            tuned = tune_particles(problem, theta, proposal, TARGET_SD, root, method.rescue)
            particles = tuned.particles
    # One law of estimates on both sides: a first stage would give the twisted filter another guide.
    return replace(method, proposal=proposal, particles=particles, delayed_acceptance=False)


def _without_parameters(
    problem: Problem, space: Space, method: PMMH | MetropolisHastings, root: np.random.SeedSequence
) -> Evidence:
    if isinstance(method, MetropolisHastings):
        model = exact_model(problem.trace)
        assert not isinstance(model, NotApplicable)
        exact = model.log_likelihood(problem.experiments, space.theta)
        return Evidence(exact, 0.0, {"method": filter_of(model)})
    assert method.particles is not None
    settings = FilterSettings(method.particles, method.proposal, rescue=method.rescue)
    estimates = repeated_estimates(problem, space.theta, settings, root, range(REPEATS))
    return Evidence(
        *log_of_mean(estimates),
        {"method": "particle filter", "particles": method.particles, "repeats": REPEATS},
    )  # fmt: skip


def _posterior(space: Space, result: Any) -> tuple[np.ndarray, np.ndarray]:
    """z (chains, draws, free) and log p(y | theta) + log prior + log Jacobian at each."""
    trace = space.problem.trace
    posterior = result["posterior"]
    likelihood = result["sample_stats"]["log_marginal_likelihood"].values
    fixed = dict(zip(trace.parameter_symbols, space.theta, strict=True))
    z = np.empty((*likelihood.shape, len(space.positions)))
    total = likelihood.astype(float).copy()
    drawn = {n: posterior[n].values for n in trace.parameters if n in posterior}
    for index in np.ndindex(likelihood.shape):
        values = {n: v[index] for n, v in drawn.items()}
        for site in trace.parameters.values():
            if site.name not in values:
                values[site.name] = np.reshape([fixed[s] for s in site.value.ravel()], site.shape)
        theta = np.array([values[s.data[1]][s.data[2]] for s in trace.parameter_symbols])
        z[index] = unconstrain(trace, theta, values)[space.positions]
        total[index] += space.parameters(z[index])[1]
    return z, total


def _log_densities(
    space: Space, method: PMMH | MetropolisHastings, root: np.random.SeedSequence,
    piece: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:  # fmt: skip
    """log p~ at points z of the distribution bridged to, with fresh estimates of the likelihood."""
    problem, out = space.problem, np.full(len(piece[0]), -np.inf)
    for i, (z, number) in enumerate(zip(*piece, strict=True)):
        theta, log_prior = space.parameters(z)
        if log_prior == -np.inf:
            continue
        if isinstance(method, PMMH):
            assert method.particles is not None
            settings = FilterSettings(method.particles, method.proposal, rescue=method.rescue)
            stream = random_state(root, 2, int(number))
            out[i] = log_likelihood_estimate(problem, theta, settings, stream) + log_prior
        else:
            out[i] = exact_log_likelihood(problem.trace, problem.experiments, theta) + log_prior
    return out


def _report(method: PMMH | MetropolisHastings, own: np.ndarray, check: Bridge) -> dict[str, Any]:
    out: dict[str, Any] = {"method": f"bridge sampling over {type(method).__name__}"}
    if isinstance(method, PMMH):
        out |= {"particles": method.particles, "proposal": method.proposal}
    return out | {
        "chains": own.shape[0], "draws": own.shape[1],
        "importance_sampling": check.log_constant,
        "importance_sampling_standard_error": check.standard_error,
    }  # fmt: skip


def _child(root: np.random.SeedSequence, *path: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, 11, *path))
