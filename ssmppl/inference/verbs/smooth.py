"""The verb `smooth`: states given all of the data, at known parameters.

A method finds draws from the joint distribution of the states, or moments of the marginal ones
(`SmoothedStates`); `METHODS` has the function of each, under the class of its settings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.analysis.proposals.proposals import Proposal
from ssmppl.arguments import checked_with
from ssmppl.counts import check_count, check_room
from ssmppl.data import Experiment, check_parameters, unpack_parameters, unpack_states
from ssmppl.errors import ArgumentError, NotApplicable, listing, written_as
from ssmppl.inference.chains import pgas
from ssmppl.inference.chains.sampling import SamplingSetup
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.inference.exact.kalman_matrices import SmoothedMoments
from ssmppl.inference.exact.state_values import probabilities, viterbi_paths
from ssmppl.inference.gaussian.likelihood import APPROXIMATE, approximation_of
from ssmppl.inference.gaussian.moments import ApproximateKalman
from ssmppl.inference.methods.methods import (
    PGAS,
    FFBSi,
    FixedLag,
    ForwardBackward,
    KalmanSmoother,
    SmoothingMethod,
)
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.methods.settings import check_settings
from ssmppl.inference.particles.backward import choose_kernel, draw_paths, particle_system
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.particles.fixed_lag import LAG, collapse, distinct, lag_moments
from ssmppl.inference.particles.marginal import is_marginal, marginal_paths, may_integrate
from ssmppl.inference.preparation.exact_models import exact_kind, exact_model
from ssmppl.inference.preparation.method_choice import choose_smoother
from ssmppl.inference.preparation.proposal_choice import (
    choose_by_pilot,
    resolve_settings,
    tempers,
)
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.inference.run.labels import (
    by_experiment,
    component_dims,
    model_attributes,
    observes,
    with_data,
)
from ssmppl.inference.run.problem import EXACT, Problem, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.verbs.filters import LEVELS, normal_quantiles, quantile_levels
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace
from ssmppl.results import to_dataset
from ssmppl.status import LOG

if TYPE_CHECKING:
    import xarray as xr

PARTICLES, TRAJECTORIES = 1000, 1000
PGAS_WARMUP = 100  # sweeps that are dropped


@dataclass(frozen=True)
class SmoothingSetup:
    """A call of `smooth`, checked; None where the caller left a number to the method.

    by_user : whether the caller named the method.
    """

    problem: Problem
    theta: np.ndarray
    particles: int | None
    trajectories: int | None
    levels: np.ndarray
    root: np.random.SeedSequence
    by_user: bool


@dataclass(frozen=True)
class SmoothedStates:
    """What a method gives for one experiment: draws (M, T, D), or moments; and its report.

    moments : mean (T, D), covariance (T, D, D), cross (T, D, D), quantiles (T, P, D).
    over_time : further variables (T,). finite : of states of finitely many values, their
    probabilities (T, K) by combination, and the most probable path (T, D).
    """

    attrs: dict[str, Any]
    paths: np.ndarray | None = None
    moments: tuple[np.ndarray, ...] | None = None
    over_time: Mapping[str, np.ndarray] | None = None
    finite: tuple[np.ndarray, np.ndarray] | None = None


def by_kalman(setup: SmoothingSetup, method: KalmanSmoother) -> list[SmoothedStates]:
    """Moments, or draws: exact of a linear Gaussian model, or by an approximation."""
    _without_particles(setup, method)
    if method.proposal in APPROXIMATE:
        return _by_approximation(setup, method.proposal)
    model = kalman_model(setup.problem.trace)
    assert not isinstance(model, NotApplicable)
    experiments, theta = setup.problem.experiments, setup.theta
    if setup.trajectories is not None:
        return _exact_draws(setup, model, [model.log_likelihood([e], theta) for e in experiments])
    moments = [model.smooth(e, theta) for e in experiments]
    return _exact_moments(moments, _normal_spreads(moments, setup.levels))


def _by_approximation(setup: SmoothingSetup, kind: str) -> list[SmoothedStates]:
    found = approximation_of(setup.problem, kind, "use method=ssm.FFBSi()")
    model, experiments = ApproximateKalman(setup.problem, found, kind), setup.problem.experiments
    if setup.trajectories is not None:
        out = []
        for e, seeds in zip(experiments, setup.root.spawn(len(experiments)), strict=True):
            rng = np.random.default_rng(seeds)
            value, paths = model.draw(e, setup.theta, rng, setup.trajectories)
            out.append(SmoothedStates({"log_likelihood": value}, paths=paths))
    else:
        moments = [model.smooth(e, setup.theta) for e in experiments]
        out = _exact_moments(moments, _normal_spreads(moments, setup.levels))
    for one in out:
        one.attrs.update(approximate=1, proposal=kind)
    return out


def _normal_spreads(moments: Sequence[SmoothedMoments], levels: np.ndarray) -> list[np.ndarray]:
    sds = [np.sqrt(np.maximum(np.diagonal(m.covariance, 0, 1, 2), 0.0)) for m in moments]
    return [normal_quantiles(m.mean, sd, levels) for m, sd in zip(moments, sds, strict=True)]


def by_forward_backward(setup: SmoothingSetup, method: ForwardBackward) -> list[SmoothedStates]:
    """Exact moments, or exact draws, where states take finitely many values."""
    _without_particles(setup, method)
    model = hidden_markov(setup.problem.trace)
    assert not isinstance(model, NotApplicable)
    experiments, theta = setup.problem.experiments, setup.theta
    if setup.trajectories is not None:
        filtered = model.filter_each(experiments, theta)
        return _exact_draws(setup, model, [total_of(f.log_increments) for f in filtered])
    smoothed = model.smooth_each(experiments, theta)
    spreads = [model.quantiles(law, setup.levels) for _, law in smoothed]
    paths = viterbi_paths(model, experiments, theta)
    found = _exact_moments([m for m, _ in smoothed], spreads)
    return [
        replace(one, finite=(law, path), attrs={**one.attrs, "viterbi_log_probability": height})
        for one, (_, law), (path, height) in zip(found, smoothed, paths, strict=True)
    ]


def _without_particles(setup: SmoothingSetup, method: SmoothingMethod) -> None:
    if setup.particles is not None and setup.by_user:
        raise ArgumentError(
            f"particles={setup.particles}: {type(method).__name__} works without particles",
            fix="leave particles= out, or use method=ssm.FFBSi()",
        )
    _check_draws(setup, setup.trajectories or 0)


def _exact_draws(
    setup: SmoothingSetup, model: KalmanModel | HiddenMarkov, log_likelihoods: Sequence[float]
) -> list[SmoothedStates]:
    experiments = setup.problem.experiments
    streams = [random_state(setup.root, i) for i in range(len(experiments))]
    drawn = model.draw_each(experiments, setup.theta, streams, setup.trajectories or 0)
    pairs = zip(drawn, log_likelihoods, strict=True)
    return [SmoothedStates({"log_likelihood": v}, paths=paths) for paths, v in pairs]


def _exact_moments(
    moments: Sequence[SmoothedMoments], spreads: Sequence[np.ndarray]
) -> list[SmoothedStates]:
    return [
        SmoothedStates(
            {"log_likelihood": m.log_likelihood}, moments=(m.mean, m.covariance, m.cross, s)
        )
        for m, s in zip(moments, spreads, strict=True)
    ]


def _filter(
    setup: SmoothingSetup, method: FFBSi | FixedLag, integrate: bool = False
) -> FilterSettings:
    """The filter's settings, "auto" resolved among the particle proposals."""
    proposal = method.proposal
    if proposal in EXACT:
        exact = {"kalman": "ssm.KalmanSmoother(), or ", "forward": "ssm.ForwardBackward(), or "}
        raise ArgumentError(
            f'{type(method).__name__}(proposal="{proposal}") has no particles',
            fix=f"use {exact.get(proposal, '')}another proposal",
        )
    rescue = method.rescue if isinstance(method, FFBSi) else 0
    if proposal == "auto":
        proposal = choose_by_pilot(
            setup.problem, setup.theta, exact=False, whole=isinstance(method, FFBSi),
            integrate=integrate, temper=tempers(method.resampling, method.ess_threshold, rescue),
        ).name  # fmt: skip
    n = PARTICLES if setup.particles is None else setup.particles
    settings = resolve_settings(
        setup.problem, setup.theta, n, proposal, method.resampling, method.ess_threshold,
        rescue, integrate=integrate,
    )  # fmt: skip
    longest = max(e.steps for e in setup.problem.experiments)
    each = len(setup.problem.trace.state_symbols) + 2  # with weight and ancestor
    check_room(
        f"{n} particles of each of {longest} rows", longest * n * each, "give fewer particles"
    )
    return settings


def _check_draws(setup: SmoothingSetup, draws: int) -> None:
    """That memory holds the trajectories."""
    rows = setup.problem.rows
    numbers = draws * rows * len(setup.problem.trace.state_symbols)
    check_room(f"{draws} trajectories of {rows} rows", numbers, "give fewer trajectories")


def by_ffbsi(setup: SmoothingSetup, method: FFBSi) -> list[SmoothedStates]:
    """Independent draws, given a particle filter's particles."""
    if method.kernel != "genealogy":
        need_density(setup.problem.trace, f'FFBSi(kernel="{method.kernel}")', "smooth")
    settings = _filter(setup, method, integrate=may_integrate(setup.problem, method))
    draws = TRAJECTORIES if setup.trajectories is None else setup.trajectories
    _check_draws(setup, draws)
    marginal = is_marginal(settings.proposal)
    kernel, why = "exact", "states that are linear given the others are integrated out"
    if not marginal:
        kernel, why = choose_kernel(setup.problem, settings, draws, method.kernel)
    out = []
    for i, e in enumerate(setup.problem.experiments):
        stream = random_state(setup.root, i)
        system = particle_system(setup.problem, setup.theta, settings, e, stream)
        own = setup.problem, setup.theta, e, system, draws, stream
        paths = marginal_paths(*own) if marginal else draw_paths(*own, kernel, method.moves)
        report = {
            "particles": settings.particles, "proposal": settings.proposal, "kernel": kernel,
            "kernel_chosen": why, "log_likelihood": system.log_Z,
        }  # fmt: skip
        over_time = {"distinct": distinct(paths), "ess": system.ess}
        if not marginal:
            report |= collapse(over_time["distinct"], system, draws, e, _remedy(setup, settings))
        out.append(SmoothedStates(report, paths=paths, over_time=over_time))
    return out


def _remedy(setup: SmoothingSetup, settings: FilterSettings) -> str:
    """What to do where few distinct particles are left: proposals that were derived alone."""
    fixes = ["more particles"]
    twisted = setup.problem.program.proposals.get("twisted")
    if settings.proposal != "twisted" and isinstance(twisted, Proposal):
        fixes.append('proposal="twisted"')
    return f"Use {', '.join(fixes)}{',' * (len(fixes) > 1)} or method=ssm.PGAS()."


def by_fixed_lag(setup: SmoothingSetup, method: FixedLag) -> list[SmoothedStates]:
    """Moments, each row's from the ancestors of particles some rows later."""
    if setup.trajectories is not None:
        raise ArgumentError(
            f"trajectories={setup.trajectories}: FixedLag knows marginals only, no joint "
            "distribution to draw trajectories from",
            fix="leave trajectories= out, or use ssm.FFBSi()",
        )
    settings = _filter(setup, method)
    lag = LAG if method.lag is None else method.lag
    out = []
    for i, e in enumerate(setup.problem.experiments):
        stream = random_state(setup.root, i)
        system = particle_system(setup.problem, setup.theta, settings, e, stream)
        m = lag_moments(system, lag, setup.levels)
        report = {
            "particles": settings.particles, "proposal": settings.proposal, "lag": lag,
            "log_likelihood": system.log_Z,
        }  # fmt: skip
        moments = m.mean, m.covariance, m.cross, m.quantiles
        over_time = {"distinct": m.distinct, "ess": system.ess}
        n = settings.particles
        report |= collapse(m.distinct, system, n, e, _remedy(setup, settings))
        out.append(SmoothedStates(report, moments=moments, over_time=over_time))
    return out


def by_pgas(setup: SmoothingSetup, method: PGAS) -> list[SmoothedStates]:
    """Successive trajectories of one chain at fixed parameters."""
    draws = TRAJECTORIES if setup.trajectories is None else setup.trajectories
    if method.particles is None and setup.particles is not None:
        method = PGAS(setup.particles, method.proposal)
    fixed = unpack_parameters(setup.problem.trace, setup.theta)
    space = space_of(setup.problem, fixed, {})
    one_chain = SamplingSetup(setup.problem, space, fixed, 1, PGAS_WARMUP, 1, setup.root)
    sampler = pgas.prepare(one_chain, method)
    (chain,) = run_chains(
        sampler.step_block, sampler.states, draws, PGAS_WARMUP, progress=False
    )  # fmt: skip
    report = {k: sampler.report[k] for k in ("particles", "proposal", "ancestor_sampling")}
    report |= {"warmup": PGAS_WARMUP, "update_rate": float(chain.stats["update_rate"].mean())}
    report["trajectories_are"] = "successive draws of a Markov chain, correlated"
    out = []
    for i in range(len(setup.problem.experiments)):
        paths = chain.draws[f"path_{i}"]
        out.append(SmoothedStates(report, paths=paths, over_time={"distinct": distinct(paths)}))
    return out


# The methods, under the classes of their settings, and what they may be called by.
METHODS: dict[type, Callable[[SmoothingSetup, Any], list[SmoothedStates]]] = {
    KalmanSmoother: by_kalman,
    ForwardBackward: by_forward_backward,
    FFBSi: by_ffbsi,
    FixedLag: by_fixed_lag,
    PGAS: by_pgas,
}
NEEDED: dict[type, tuple[str, Callable[[Trace], Any]]] = {  # what a method needs, and finds it
    KalmanSmoother: ("a linear Gaussian model", kalman_model),
    ForwardBackward: ("states of finitely many values", hidden_markov),
}
NAMES: dict[str, SmoothingMethod] = {
    "kalman": KalmanSmoother(),
    **{kind: KalmanSmoother(kind) for kind in APPROXIMATE},
    "forward_backward": ForwardBackward(),
    "ffbsi": FFBSi(),
    "exact": FFBSi(kernel="exact"),
    "rejection": FFBSi(kernel="rejection"),
    "mcmc": FFBSi(kernel="mcmc"),
    "genealogy": FFBSi(kernel="genealogy"),
    "fixed_lag": FixedLag(),
    "pgas": PGAS(),
}


@checked_with(METHODS)
def smooth(
    model: Model,
    data: Any,
    parameters: Mapping[str, Any],
    method: SmoothingMethod | str | None = None,
    *,
    particles: int | None = None,
    trajectories: int | None = None,
    proposal: str | None = None,
    quantiles: tuple[float, ...] = LEVELS,
    seed: int | None = None,
) -> xr.Dataset | list[xr.Dataset] | dict[Any, xr.Dataset]:
    """The states given all of the data, p(x_{1:T} | y_{1:T}, parameters).

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    parameters : value of each parameter of the model, {} where it has none.
    method : `ssm.KalmanSmoother()`, exact, for linear Gaussian models; `ssm.ForwardBackward()`,
        exact, where the states take finitely many values; `ssm.FFBSi(...)`, particles
        with backward simulation; `ssm.PGAS(...)`, a Markov chain of conditional particle filters;
        `ssm.KalmanSmoother("laplace")`, "extended" or "unscented", approximations without
        particles where states are driven by Gaussian noise;
        `ssm.FixedLag(...)`, marginal moments from the genealogy. Or one of the names "kalman",
        "forward_backward", "laplace", "extended", "unscented", "ffbsi", "exact", "rejection",
        "mcmc", "genealogy", "pgas", "fixed_lag". None: the exact one where there is one, else
        FFBSi; the attribute `method_chosen` says why.
    particles : number N; None: 1000, and for PGAS its own. An exact smoother, where `method` is
        left to the model, does without. Moments have a bias of order 1 / N, but
        those of PGAS, whose chain has the right distribution for every N >= 2.
    trajectories : number M of draws; None: exact moments from an exact smoother, and 1000 draws
        from FFBSi and PGAS.
    proposal : in place of `method`: "laplace", "extended" or "unscented", as of `kalman_filter`, or
        the proposal of FFBSi's particle filter.
    quantiles : levels of the quantiles that go with moments.
    seed : the same seed gives the same numbers; None: a random one.

    Returns
    -------
    Dataset; of several experiments a list of them, or a dictionary by their labels
        Draws: the states, dims (trajectory, time, ...), and over time `distinct`, how many values
        the draws have at each step, and for FFBSi `ess`, of the filter.
        Moments, dim `draw` of length 1: as of `kalman_filter`, ``x``, ``x_sd``, ``x_quantile`` and
        ``covariance`` of all stacked components, but given all of the data; and
        ``covariance_previous``, that of x_t (`state`) with x_{t-1} (`state_`), NaN in the first
        row. Of states of finitely many values also ``x_probability``, P(x_t = value given all of
        the data), last dim `x_value`, and ``x_viterbi``, the most probable path of all rows and
        states together, whose log p(x, y) is the attribute `viterbi_log_probability`.
        For FixedLag also `distinct`, the ancestors that are left.
        Both: the data, ``y_observed`` of channels y and ``u_input`` of inputs u, (time, ...).
        Attributes name method, settings, seed and the log-likelihood (exact, or the filter's
        estimate); `approximate` is 1 where moments, draws and log-likelihood are those of a
        Gaussian approximation.

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or setup, and the fix.
    SamplingError : weights vanish or are NaN; names the step, the user's line, the parameters.
    """
    began = time.perf_counter()
    method = _with_proposal(method, proposal)
    check_settings(method)
    problem = pose(model, data, noting=True)
    theta = check_parameters(problem.trace, parameters)
    chosen, why = _choose(problem, method)
    levels = quantile_levels(quantiles)
    root = seed_sequence(seed)
    for name, value, least in (("particles", particles, 1), ("trajectories", trajectories, 1)):
        if value is not None:
            check_count(name, value, least)
    setup = SmoothingSetup(
        problem, theta, particles, trajectories, levels, root, method is not None
    )
    found = METHODS[_kind(chosen) or type(chosen)](setup, chosen)
    attrs = {
        **model_attributes(problem.trace), "method": type(chosen).__name__, "method_chosen": why,
        "settings": asdict(chosen), "seed": str(root.entropy),
        "seconds": time.perf_counter() - began,
    }  # fmt: skip
    datasets = [
        _dataset(setup, e, f, attrs) for e, f in zip(problem.experiments, found, strict=True)
    ]
    return by_experiment(problem.experiments, datasets)


def _with_proposal(
    method: SmoothingMethod | str | None, proposal: str | None
) -> SmoothingMethod | str | None:
    """The method that a proposal alone asks for."""
    if proposal is None:
        return method
    if method is not None:
        raise ArgumentError(
            f"proposal={proposal!r} beside method={method!r}",
            fix=f"give it to the method, as in ssm.FFBSi(proposal={proposal!r})",
        )
    return KalmanSmoother(proposal) if proposal in APPROXIMATE else FFBSi(proposal=proposal)


def _kind(method: Any) -> type | None:
    """The method that these settings are of, also where they are of a class derived from it."""
    return next((t for t in type(method).__mro__ if t in METHODS), None)


def _choose(problem: Problem, method: SmoothingMethod | str | None) -> tuple[SmoothingMethod, str]:
    if method is None:
        chosen, why = choose_smoother(exact_kind(exact_model(problem.trace)), problem.trace)
        LOG.info("smooth of model %r: %s, as %s", problem.trace.name, type(chosen).__name__, why)
        return chosen, f"automatically: {why}"
    if isinstance(method, str):
        if method not in NAMES:
            raise ArgumentError(
                f"method={method!r} is unknown",
                fix=written_as(method, METHODS) or f"use one of: {listing(method, NAMES)}",
            )
        method = NAMES[method]
    kind = _kind(method)
    if kind is None:
        names = ", ".join(f"ssm.{t.__name__}(...)" for t in METHODS)
        raise ArgumentError(
            f"method={method!r} is not a smoothing method",
            fix=written_as(method, METHODS) or f"use {names}, a name, or None",
        )
    if isinstance(method, KalmanSmoother) and method.proposal in APPROXIMATE:
        return method, "by the user"
    what, find = NEEDED.get(kind, ("", None))
    if find is not None and isinstance(model := find(problem.trace), NotApplicable):
        raise ArgumentError(
            f"{type(method).__name__} needs {what}: {model.reason}",
            fix="use ssm.FFBSi(...) or ssm.PGAS(...), or None, which picks by structure",
            where=model.where,
        )
    return method, "by the user"


def _dataset(
    setup: SmoothingSetup, experiment: Experiment, found: SmoothedStates, attrs: dict[str, Any]
) -> xr.Dataset:
    trace = setup.problem.trace
    dims: dict[str, list[str]] = {}
    coords: dict[str, Any] = {}
    if found.paths is not None:
        variables, sample_dim = dict(unpack_states(trace, found.paths)), "trajectory"
    else:
        assert found.moments is not None
        sample_dim = "draw"
        mean, covariance, cross, spread = (m[None] for m in found.moments)
        cross = cross.copy()
        cross[:, 0] = np.nan
        variables = dict(unpack_states(trace, mean))
        sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=2, axis2=3), 0.0))
        for n, v in unpack_states(trace, sd).items():
            variables[f"{n}_sd"] = v
            dims[f"{n}_sd"] = ["time", *component_dims(n, v, 2)]
        if found.finite is not None:
            for n, v in unpack_states(trace, found.finite[1][None]).items():
                variables[f"{n}_viterbi"] = v
                dims[f"{n}_viterbi"] = ["time", *component_dims(n, v, 2)]
        variables |= {"covariance": covariance, "covariance_previous": cross}
        dims |= {n: ["time", "state", "state_"] for n in ("covariance", "covariance_previous")}
        coords["state"] = coords["state_"] = [trace.label(s) for s in trace.state_symbols]
        if len(setup.levels):
            by_level = [unpack_states(trace, spread[:, :, p]) for p in range(len(setup.levels))]
            for name in by_level[0]:
                variables[f"{name}_quantile"] = np.stack([q[name] for q in by_level], axis=-1)
                own = component_dims(name, by_level[0][name], 2)
                dims[f"{name}_quantile"] = ["time", *own, "quantile"]
            coords["quantile"] = setup.levels
    out = to_dataset(
        variables, sample_dim=sample_dim, time=experiment.time, dims=dims,
        coords={**trace.component_names.coords, **coords}, renamed=trace.component_names.renamed,
        attrs={**attrs, **found.attrs, "observes": observes(trace)},
    )  # fmt: skip
    if found.finite is not None:
        model = hidden_markov(trace)
        assert not isinstance(model, NotApplicable)
        out = out.assign(probabilities(model, found.finite[0], out))
    out = out.assign({k: ("time", v) for k, v in (found.over_time or {}).items()})
    return with_data(out, trace, experiment)
