"""Which method a verb takes where it is left to choose, and why."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from ssmppl.analysis.conjugacy.update import Update
from ssmppl.analysis.proposals.noises import noises
from ssmppl.analysis.proposals.smooth import smooth_filter_applies
from ssmppl.analysis.structure import deterministic_memory, noisy_start, singular_covariance
from ssmppl.errors import NotApplicable
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.exact.hidden_markov import HiddenMarkov
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.inference.methods.methods import (
    IF2,
    PGAS,
    PMMH,
    DirectOptimization,
    FFBSi,
    ForwardBackward,
    Gibbs,
    KalmanSmoother,
    Method,
    MetropolisHastings,
    ScoreAscent,
)
from ssmppl.inference.particles.deterministic import Deterministic
from ssmppl.inference.preparation.exact_models import KIND, exact_kind, exact_model
from ssmppl.inference.preparation.pilot import TunedParticles
from ssmppl.inference.run.problem import Problem
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.trace import Trace

ROWS_WITHOUT_ANCESTORS = 100  # over which the particles of PGAS still move all of a trajectory
LEAST_WARMUP = 200  # sweeps, below which interweave="auto" has no time to look and to tune
FEW = 6  # numbers that a random walk moves at once without trouble


def choose_sampler(
    kind: str | NotApplicable,
    updates: Sequence[Update],
    numbers: int,
    stuck: str = "",
    singular: NotApplicable | None = None,
    twisted: TunedParticles | None = None,
    laplace: bool = False,
    counted: bool = False,
) -> tuple[MetropolisHastings | Gibbs | PGAS | PMMH, str]:
    """The method for a model of this kind with these updates, and the reason.

    kind : of an exact model (`KIND`), or why it is none. Where the states are drawn exactly, Gibbs
    needs no tuning if every parameter has a closed-form conditional; those that mix slowly given
    the states are moved with them integrated out besides. Where some have none, slices given the
    states mix slowly and cost a pass over the data each, and a random walk on the exact likelihood,
    which integrates the states out, is better as long as the parameters are few; where the states
    have no noise there is nothing else.
    updates : where the states are drawn exactly. numbers : of the free parameters. stuck : as of
    `why_stuck`, for the others. singular : why the states have no joint density, as Gibbs and PGAS
    need it. twisted : how well a pilot found that the twisted filter knows the likelihood, where
    that is well enough. laplace : whether there may be such a pilot, before there are data.
    counted : as of `only_counts`.
    """
    if isinstance(kind, NotApplicable) and twisted is not None:
        return PMMH(proposal="twisted"), (
            "the states have a Gaussian approximation, and twisted particle filters along it "
            f"estimate the likelihood precisely (sd of log Z {twisted.sd:.2g} with "
            f"{twisted.particles} particles, by a pilot): Metropolis-Hastings over them, with "
            "proposals from the approximate posterior"
        )
    if isinstance(kind, NotApplicable) and laplace:
        other, why = choose_sampler(kind, updates, numbers, stuck, singular, counted=counted)
        return PMMH(), (
            "over twisted particle filters, where a pilot on the data finds that these estimate "
            f"the likelihood precisely; else {type(other).__name__}: {why}"
        )
    if singular is not None and kind != KIND[Extended]:
        if isinstance(kind, NotApplicable):
            return (
                PMMH(),
                f"{singular.reason}: random-walk Metropolis on the particle filter's likelihood",
            )
        return MetropolisHastings(), (
            f"the model is {kind}, and {singular.reason}: a random walk on the exact "
            "likelihood, which needs none"
        )
    if isinstance(kind, NotApplicable):
        if not stuck and counted and numbers <= FEW:
            return PMMH(), (
                "the states are counts; parameters mix slowly conditional on the states: "
                "random-walk Metropolis on the particle filter's likelihood"
            )
        if not stuck:
            return PGAS(interweave="auto"), (
                "the model is not linear Gaussian: trajectories by conditional SMC; parameters "
                "with high autocorrelation in the warmup are also updated jointly with them"
            )
        if numbers <= FEW:
            return PMMH(), f"{stuck}: random-walk Metropolis on the particle filter's likelihood"
        return PGAS(), (
            f"{stuck}, but {numbers} parameters are too many for a random walk: conditional SMC "
            "without ancestor sampling; see the attribute trajectory_update_rate, and take more "
            "particles where it is low"
        )
    if kind == KIND[Extended]:
        return MetropolisHastings(), (
            f"the model is {kind}: a chain on the likelihood of the extended Kalman filter, an "
            "approximation"
        )
    if kind == KIND[Deterministic]:
        return MetropolisHastings(), (
            f"the model is {kind}, so that its likelihood is exact, and its gradient, where "
            "there is one in closed form, guides the steps"
        )
    open_ = [c for u in updates if u.family is None for c in u.block]
    if not open_:
        if not updates:
            return Gibbs(), (
                f"the model is {kind}, without free parameters: exact trajectories by backward "
                "sampling"
            )
        reason = (
            f"the model is {kind}, and every parameter has a closed-form conditional: exact "
            "trajectories by backward sampling"
        )
        if kind != "linear Gaussian":
            return Gibbs(), reason
        return Gibbs(), (
            f"{reason}; parameters with high autocorrelation in the warmup are also updated with "
            "the states integrated out"
        )
    named = ", ".join(dict.fromkeys(open_))
    if numbers <= FEW:
        return MetropolisHastings(), (
            f"the model is {kind}, but {named} has no closed-form conditional: random-walk "
            "Metropolis on the exact likelihood"
        )
    return Gibbs(), (
        f"the model is {kind}, with {numbers} parameters, too many for a random walk: exact "
        f"trajectories, and slice sampling for {named}"
    )


def why_stuck(trace: Trace, rows: int | None) -> str:
    """Why PGAS cannot be relied on to move the trajectories of a model; empty where it can.

    Where a deterministic component never forgets its past, no ancestor can be sampled for the
    reference trajectory, and its early states change the less the more rows there are for each
    particle (Lindsten, Jordan and Schön 2014; Lindsten, Bunch, Singh and Schön 2015). PMMH draws
    all of the trajectory anew. Given a trajectory of counts, parameters can move only little,
    however well it moves itself.

    rows : of the longest data set; None: not known.
    """
    if deterministic_memory(trace) is not None:
        return ""
    if noisy_start(trace):
        return (
            "the transition is noise-free, so that PGAS cannot update the states; "
            + start_as_parameter(trace)
        )
    reason = (
        "the model has a deterministic state with infinite memory, so that ancestor sampling is "
        "impossible"
    )
    if only_counts(trace):
        return f"{reason}, and parameters mix slowly conditional on a trajectory of counts"
    if rows is None or rows > ROWS_WITHOUT_ANCESTORS:
        return f"{reason}; with more than {ROWS_WITHOUT_ANCESTORS} rows early states mix slowly"
    return ""


def only_counts(trace: Trace) -> bool:
    """Whether every state that moves by chance is a whole number: then there are no noises to hold
    fixed, and what the parameters are known by given a trajectory is all that moves them."""
    random = [
        s.distribution for s in trace.transition.values() if not isinstance(s.distribution, Dirac)
    ]
    return bool(random) and all(d.support().kind == "integers" for d in random)


def start_as_parameter(trace: Trace) -> str:
    """How a model whose states have noise in their first row only is made exact."""
    name = noisy_start(trace)[0].name
    return (
        f"only the first row of the states has noise: with it as a parameter ({name}_first in "
        f"@prior, ssm.Dirac({name}_first) in @initial) the likelihood is exact, and everything "
        "faster"
    )


def what_else(settings: Method, problem: Problem, fixed: Collection[str], sweeps: int) -> str:
    """What to try, besides more draws, where parameters mix slowly: only what this model can.

    fixed : names of the parameters that are held. sweeps : of the warmup.

    Returns
    -------
    str : ", or ..."; empty where there is nothing else.
    """
    trace = problem.trace
    exact, singular = exact_model(trace), singular_covariance(trace)
    kind = exact_kind(exact)
    noisy = any(not isinstance(s.distribution, Dirac) for s in trace.transition.values())
    drawn = singular is None and noisy and kind in (KIND[KalmanModel], KIND[HiddenMarkov])
    if isinstance(settings, Gibbs | PGAS) and settings.interweave is False:
        joint = _interweaved(type(settings), problem, fixed, sweeps)
        if joint:
            return f", or {joint}"
    if isinstance(settings, PMMH):
        flat = any(not s.distribution.proper for s in trace.initial.values())
        stuck = why_stuck(trace, max(e.steps for e in problem.experiments))
        if singular is not None or flat or stuck:
            return ", or more particles"
        other = _interweaved(PGAS, problem, fixed, sweeps) or "ssm.PGAS()"
        return f", more particles, or another method, such as {other}"
    if isinstance(settings, PGAS):
        return ", more particles, or another method, such as ssm.PMMH()"
    if isinstance(settings, Gibbs):
        return ", or another method, such as ssm.MetropolisHastings()"
    if isinstance(settings, MetropolisHastings):
        return ", or another method, such as ssm.Gibbs()" if drawn else ""
    return ", or another method, such as ssm.PMMH()"


def _interweaved(
    kind: type[Gibbs | PGAS], problem: Problem, fixed: Collection[str], sweeps: int
) -> str:
    """The method with interweaving, written out; empty where it could move no free parameter."""
    found = noises(problem.trace, problem.program.missing)
    finite = exact_kind(exact_model(problem.trace)) == KIND[HiddenMarkov]
    if isinstance(found, NotApplicable) or finite or not set(found.tied) - set(fixed):
        return ""
    longer = f" with warmup={LEAST_WARMUP} or more" if sweeps < LEAST_WARMUP else ""
    return f'ssm.{kind.__name__}(interweave="auto"){longer}'


def choose_maximiser(
    kind: str | NotApplicable, trace: Trace, laplace: NotApplicable | None
) -> tuple[DirectOptimization | ScoreAscent | IF2, str]:
    """The method of `maximize` for a model of this kind, and the reason.

    laplace : why it cannot go by way of Laplace's approximation, None where it can.
    """
    if kind == KIND[Extended]:
        return DirectOptimization(), (
            f"the model is {kind}: the likelihood of the extended Kalman filter, an approximation, "
            "is maximised with finite-difference gradients"
        )
    if not isinstance(kind, NotApplicable):
        return DirectOptimization(), (
            f"the model is {kind}, so that its likelihood and score are exact"
        )
    if laplace is None:
        return DirectOptimization(), (
            "the states have a Gaussian approximation, whose likelihood is maximised and then "
            "corrected by particle filters"
        )
    obstacle = smooth_filter_applies(trace)
    if obstacle is None:
        return DirectOptimization(laplace=False), (
            "for one scalar state a particle filter's likelihood can be made continuous in the "
            "parameters"
        )
    singular = singular_covariance(trace)
    if singular is not None:
        return IF2(), f"{singular.reason}: iterated filtering, which needs none"
    if deterministic_memory(trace) is None and not noisy_start(trace):
        return IF2(), (
            "the model has a deterministic state with infinite memory, so that particle smoothing "
            "takes time quadratic in the number of rows: iterated filtering, which only simulates; "
            "for a few hundred rows ScoreAscent is more precise"
        )
    return ScoreAscent(), (
        "Fisher's identity gives the score by particle smoothing; direct optimisation does not "
        f"apply: {obstacle.reason}"
        + (f"; {start_as_parameter(trace)}" if noisy_start(trace) else "")
    )


def choose_smoother(
    kind: str | NotApplicable, trace: Trace
) -> tuple[KalmanSmoother | ForwardBackward | FFBSi, str]:
    """The method of `smooth` for a model of this kind, and the reason."""
    if isinstance(kind, NotApplicable):
        singular = singular_covariance(trace)
        if singular is not None:
            return FFBSi(kernel="genealogy"), (
                f"{singular.reason}: the ancestors of the filter's own particles, which need none"
            )
        return FFBSi(), f"the model is not linear and Gaussian: {kind.reason}"
    if kind == KIND[Extended]:
        return KalmanSmoother("extended"), (
            f"the model is {kind}: the smoother of the extended Kalman filter, an approximation"
        )
    if kind == KIND[Deterministic]:
        return FFBSi(kernel="genealogy"), f"the model is {kind}, and every trajectory is the same"
    chosen = KalmanSmoother() if kind == "linear Gaussian" else ForwardBackward()
    return chosen, f"the model is {kind}"
