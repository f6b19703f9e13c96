"""Methods of estimation and of smoothing as settings: small frozen dataclasses, named by the field.

Each setting is declared with the rule that its values follow (`settings.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ssmppl.arguments import checked_settings
from ssmppl.counts import check_count
from ssmppl.errors import ArgumentError
from ssmppl.inference.methods.settings import (
    POSITIVE,
    RATE,
    SHARE,
    a_name,
    count,
    count_or_starts,
    finite_matrix,
    flag,
    flag_auto_or_names,
    flag_or_auto,
    number,
    one_of,
    optional,
    rescue_factor,
    scales_by_name,
    setting,
    step_sizes,
    whole_number_to,
)

# Rules of settings that several methods have.
ACCEPTANCE = optional(number(lambda v: 0.0 < v < 1.0, RATE))
ESS = number(lambda v: 0.0 <= v <= 1.0, "give a number from 0 (never resample) to 1 (always)")


@checked_settings
@dataclass(frozen=True)
class MetropolisHastings:
    """Metropolis-Hastings with the exact likelihood of a linear Gaussian model, of one of finitely
    many states, or of one without noise in them (Schön et al. 2015, algorithm 1): a random walk on
    the parameters, or Langevin steps along the exact gradient; the states are drawn afterwards,
    given each kept draw, by exact backward sampling.

    Priors may be improper (`Flat`, `HalfFlat`). Whether the posterior is proper is then for the
    user to know: a chain cannot tell, and its draws mean nothing where it is not.

    Parameters
    ----------
    covariance, scale, transform, adapt, target_acceptance : the walk, as in `PMMH`; the usual
        acceptance rates are those of Gelman, Roberts and Gilks (1996), for order 1 that of Roberts
        and Rosenthal (1998).
    order : 0: a random walk. 1: Langevin steps along the exact gradient of the log posterior, with
        a fixed metric, the covariance (Roberts and Tweedie 1996). None: 1 where the states have no
        noise, so that the gradient costs little, and more than two numbers are free; else 0.
    log_likelihood : whether to keep log p(y_t | y_1:t-1, theta) of each draw too, exact, in the
        group `log_likelihood`.
    """

    covariance: Any = setting(None, optional(finite_matrix))  # noqa: RUF009
    scale: str = setting("unconstrained", a_name)
    transform: Mapping[str, str] | None = setting(None, optional(scales_by_name))
    adapt: bool | None = setting(None, optional(flag))
    target_acceptance: float | None = setting(None, ACCEPTANCE)
    order: int | None = setting(
        None,
        optional(whole_number_to(1, "use 0 (random walk), 1 (Langevin, by the gradient) or None")),
    )
    log_likelihood: bool = setting(False, flag)


@checked_settings
@dataclass(frozen=True)
class Gibbs:
    """Gibbs sampling of a model that is linear and Gaussian or has finitely many states (Schön et
    al. 2015, section 4.2): trajectories by exact draws, of up to three states by backward sampling
    (Frühwirth-Schnatter 1994; Carter and Kohn 1994), of more by Durbin and Koopman's simulation
    smoother (2002); parameters by the updates that were derived for them.

    Parameters
    ----------
    interweave : whether each sweep also moves the parameters with the states integrated out, by a
        random walk on the exact likelihood: True; "auto": those that the warmup finds slow, as in
        `PGAS`, and none where the states take finitely many values; False: none, which is the
        sampler as it was published.
    log_likelihood : whether to keep log p(y_t | y_1:t-1, theta) of each draw too, exact, in the
        group `log_likelihood`.
    """

    interweave: bool | str = setting("auto", flag_or_auto)
    log_likelihood: bool = setting(False, flag)


@checked_settings
@dataclass(frozen=True)
class PMMH:
    """Particle Metropolis-Hastings: a random walk on the parameters with an unbiased estimate of
    the likelihood (Andrieu, Doucet and Holenstein 2010; Schön et al. 2015, algorithm 4).

    Parameters
    ----------
    particles : N; None tunes it in a pilot to a standard deviation of log Z of about `target_sd`
        (Doucet et al. 2015; Sherlock et al. 2015); with the twisted proposal, whose cost hardly
        depends on N, to at most 0.3, from 8 particles up.
    proposal : the particle filter's proposal, as in `log_likelihood`; "auto" considers "twisted".
    target_sd : of the estimate of the log-likelihood, which the pilot aims at; with `correlation`,
        of the difference between two successive estimates, over sqrt(2).
    target_acceptance : what the walk adapts to during warmup (Vihola 2012); None: 0.25 for one
        parameter, less for more; 0.25 for orders 1 and 2; 0.3 with `correlation`.
    covariance : (d, d), of the steps, the free parameters in the order of declaration, on the scale
        below. None: the inverse information at the mode, which a pilot estimates, times 2.562^2 / d
        for a random walk (Sherlock et al. 2015). Where the model has a Gaussian approximation mode
        and information are those of the approximate posterior, and most steps are
        independence proposals round it (Student's t of 5 degrees of freedom), a fifth where few of
        these are accepted.
    scale : on which the walk moves: "unconstrained" (numbers between bounds by logit, positive ones
        by log, simplices by stick breaking, matrices by their Cholesky factor), or "natural".
        What falls outside the support is refused; the Jacobian is accounted for.
    transform : the scale of single parameters: {"tau": "reciprocal", ...}, out of "unconstrained",
        "natural", "log" and "reciprocal".
    adapt : whether the walk adapts during warmup; None: unless `covariance` is given. It is held
        fixed afterwards.
    order : 0: a random walk. 1: Langevin steps along the gradient of the log posterior (PMH1 of
        Dahlin, Lindsten and Schön 2015). 2: Newton-like steps, with the observed information too
        (PMH2 there). Both are estimated by a fixed-lag smoother from the particles that give the
        likelihood, so that a step takes one particle filter whatever the order.
    lag : of that smoother.
    correlation : rho of the correlated pseudo-marginal method (Deligiannidis, Doucet and Pitt
        2018): the normals behind the particle filter move by v' = rho v + sqrt(1 - rho^2) e, and
        particles are sorted before they are resampled, so that successive estimates of log Z err
        alike and fewer particles do. 0: fresh random numbers. Only for models whose particles are
        drawn from normals and uniforms; not with orders 1 and 2.
    rescue : of the particle filter, as in `log_likelihood`: how many times N particles a row may
        take where weights vanish; 0: N, and the parameters are refused. Not with orders 1 and 2
        nor `correlation`.
    delayed_acceptance : whether a proposal is first accepted or refused by Laplace's approximation
        of the likelihood (the extended Kalman filter's, where there is no Laplace's, or where a
        pilot finds it as good), and the particle filter runs only for what that accepts (Christen
        and Fox 2005); the posterior is exact all the same. "auto": with the twisted proposal, whose
        guide then begins from there. Only with order 0, without `correlation` and `rescue`.
    """

    particles: int | None = setting(None, optional(count(1)))
    proposal: str = setting("auto", a_name)
    target_sd: float = setting(1.2, number(lambda v: v > 0.0, POSITIVE))
    target_acceptance: float | None = setting(None, ACCEPTANCE)
    covariance: Any = setting(None, optional(finite_matrix))  # noqa: RUF009
    scale: str = setting("unconstrained", a_name)
    transform: Mapping[str, str] | None = setting(None, optional(scales_by_name))
    adapt: bool | None = setting(None, optional(flag))
    order: int = setting(
        0, whole_number_to(2, "use 0 (random walk), 1 (gradient) or 2 (gradient and information)")
    )
    lag: int = setting(12, count(0))
    correlation: float = setting(
        0.0,
        number(
            lambda v: 0.0 <= v < 1.0,
            "give a number from 0 (fresh random numbers) to below 1, as 0.99",
        ),
    )
    rescue: int = setting(0, rescue_factor)
    delayed_acceptance: bool | str = setting("auto", flag_or_auto)

    def _check_together(self) -> None:
        """The filters of some settings exclude those of others."""
        if self.delayed_acceptance is True and (self.order or self.correlation or self.rescue):
            raise ArgumentError(
                f"delayed_acceptance=True together with order={self.order}, correlation="
                f"{self.correlation}, rescue={self.rescue}",
                fix="use ssm.PMMH(delayed_acceptance=True) with order=0, correlation=0.0 and "
                "rescue=0",
            )
        if self.rescue and (self.order or self.correlation):
            raise ArgumentError(
                f"rescue={self.rescue} together with order={self.order}, correlation="
                f"{self.correlation}: the filters of these draw a fixed number of particles",
                fix="use ssm.PMMH(rescue=...) with order=0 and correlation=0.0",
            )
        if self.rescue and self.proposal == "tempered":
            raise ArgumentError(
                f'rescue={self.rescue} together with proposal="tempered"', fix="use one of them"
            )
        if self.order and self.correlation:
            raise ArgumentError(
                f"order={self.order} together with correlation={self.correlation}",
                fix="use one of them: the sorted filter of the correlated method keeps no scores",
            )


@checked_settings
@dataclass(frozen=True)
class ISMCMC:
    """Markov chains on an approximate posterior, corrected by importance sampling (Vihola, Helske
    and Franks 2020; the R package bssm).

    For models whose states have a Gaussian approximation. A chain moves on the prior times
    Laplace's approximation of the likelihood; at its distinct draws twisted particle filters give
    unbiased estimates of the likelihood, and trajectories, and their ratio to the approximation is
    the draw's weight. The second part is independent tasks for any executor, of which as many run
    at a time as it has workers.

    The posterior has draws of equal weight, resampled by these weights: statistics that count on
    draws (R-hat, effective sample sizes) can be read as they stand. `sample_stats` has of each the
    `weight` that it was resampled by (mean 1 in a chain); the attributes `weights_ess`,
    `weights_ess_share` and `largest_weight_share` tell how good the approximation was, and
    `weights_warning` is there, and given as a warning, where few distinct draws carry all weight.
    Where the posterior reaches where the approximate one does not, no weight tells of it: compare
    with `PMMH` or `PGAS` where it matters.

    Parameters
    ----------
    particles : N of the twisted filters; any number is exact. None: tuned in a pilot to a standard
        deviation of log Z of at most 0.3, from 8 up.
    approximation : of the likelihood: "laplace", "extended" (the extended Kalman filter's), or
        "auto": Laplace's where there is one and a pilot does not find the extended filter's, which
        costs less, as good.
    steps : of the chain between the draws that are corrected, times `thin`. None: 2 where most
        independence proposals round the mode are accepted, else 6.
    target_acceptance : that the walk adapts to during warmup, as in `MetropolisHastings`.
    """

    particles: int | None = setting(None, optional(count(1)))
    approximation: str = setting("auto", one_of(("auto", "laplace", "extended")))
    steps: int | None = setting(None, optional(count(1)))
    target_acceptance: float | None = setting(None, ACCEPTANCE)


@checked_settings
@dataclass(frozen=True)
class PGAS:
    """Particle Gibbs with ancestor sampling (Lindsten, Jordan and Schön 2014; Schön et al. 2015,
    algorithm 7), with the Gibbs updates that were derived for the parameters.

    Parameters
    ----------
    particles : N of the conditional particle filter, at least 2; None: 25, or 200 where ancestors
        cannot be sampled.
    proposal : "auto", "bootstrap", "guided", "auxiliary" or "user".
    log_likelihood : whether to estimate log p(y_t | y_1:t-1, theta) at each draw too, by a particle
        filter, for the group `log_likelihood`.
    interweave : whether each sweep also moves parameters together with the trajectories, holding
        fixed the noises that drive these (Yu and Meng 2011). True: from the first sweep, all
        parameters that can. "auto": the first quarter of the warmup (at most 400 sweeps) runs
        without; then each chain moves the parameters that mixed slowly in it (lag-1 autocorrelation
        above 0.5 on the unconstrained scale), if there are any; never with a warmup of fewer than
        200 sweeps. The walk adapts during warmup.
    eliminate : parameters that are integrated out while trajectories are drawn, each particle
        carrying their statistics, and drawn given the new trajectory (Wigren, Risuleo, Murray and
        Lindsten 2019). True: all whose conjugate family is exact; "auto": the same, and nothing
        where there are none or the proposal is not the transition; or a tuple of names. `explain`
        tells which can be and why others cannot. Particles then move by the transition.
    """

    particles: int | None = setting(None, optional(count(2)))
    proposal: str = setting("auto", a_name)
    log_likelihood: bool = setting(False, flag)
    interweave: bool | str = setting(False, flag_or_auto)
    eliminate: bool | str | tuple[str, ...] = setting(False, flag_auto_or_names)


@checked_settings
@dataclass(frozen=True)
class DirectOptimization:
    """Quasi-Newton ascent of the log-likelihood on the unconstrained scale (Schön et al. 2015,
    section on direct optimisation).

    With the exact likelihood and score on linear Gaussian models, on those of finitely many states
    and where states have no noise. Else, where the states are driven by Gaussian noise and the
    observations' density is twice differentiable, by way of Laplace's approximation of the
    likelihood (Kristensen, Nielsen, Berg, Skaug and Bell 2016), whose top is then moved to that of
    the likelihood by twisted particle filters with common random numbers; by way of the extended
    Kalman filter's first, where a transition or an observation has corners in the states. Else, for
    one scalar state, over a particle filter with common random numbers that is continuous in the
    parameters (Malik and Pitt 2011).

    Parameters
    ----------
    particles : N of the continuous filter; the most that the twisted ones take.
    averages : number of random seeds that the likelihood is averaged over.
    restarts : further starts, dispersed round the first, of which the best is kept; None: 2 where
        the likelihood is exact, and where a climb of Laplace's comes to no top, else 0; where the
        states take finitely many values 24 short climbs, the best 3 of which are gone on with.
    steps : most iterations of a climb of an exact likelihood or of the continuous filter's.
    laplace : whether to go by way of Laplace's approximation, or the extended Kalman filter's,
        where there is one.
    """

    particles: int = setting(1000, count(2))
    averages: int = setting(8, count(2))
    restarts: int | None = setting(None, optional(count(0)))
    steps: int = setting(200, count(1))
    laplace: bool = setting(True, flag)


@checked_settings
@dataclass(frozen=True)
class EM:
    """Expectation maximisation of models that are linear and Gaussian or have finitely many states,
    with exact expectations (Shumway and Stoffer 1982; Schön et al. 2015, section on EM) and the
    M-step that was derived.

    Parameters
    ----------
    iterations : most EM steps.
    tolerance : ends the climb once the limit is estimated to be nearer than this, on the
        unconstrained scale (a relative change, of a positive parameter).
    accelerate : whether to extrapolate the steps by SQUAREM (Varadhan and Roland 2008). The
        log-likelihood never falls, with or without.
    """

    iterations: int = setting(2000, count(1))
    tolerance: float = setting(1e-8, number(lambda v: v > 0.0, POSITIVE))
    accelerate: bool = setting(True, flag)


@checked_settings
@dataclass(frozen=True)
class ParticleEM:
    """EM over a particle smoother: in each iteration fresh trajectories by backward simulation
    (Schön, Wills and Ninness 2011; Schön et al. 2015, section on EM for nonlinear models), and the
    M-step that was derived, or a numerical one where the densities do not separate.

    Parameters
    ----------
    particles : N of each filter.
    runs : filters in each iteration, weighed by their likelihoods, which takes the bias of order
        1 / N off; 1 leaves it in.
    trajectories : number drawn in each iteration, over all runs.
    proposal : "auto", "bootstrap", "guided", "auxiliary" or "user".
    kernel : of backward simulation: "auto", "exact", "rejection" or "mcmc".
    iterations : of each chain.
    burn_in : iterations that are left out of the estimate.
    chains : independent climbs from dispersed starts, which give one estimate; how they differ
        tells its error.
    """

    particles: int = setting(1000, count(2))
    runs: int = setting(2, count(1))
    trajectories: int = setting(200, count(1))
    proposal: str = setting("auto", a_name)
    kernel: str = setting("auto", a_name)
    iterations: int = setting(100, count(1))
    burn_in: int = setting(30, count(0))
    chains: int = setting(8, count(1))

    def _check_together(self) -> None:
        """Some iterations are left for the estimate."""
        check_count("iterations", self.iterations, self.burn_in + 1)


@checked_settings
@dataclass(frozen=True)
class PSAEM:
    """Particle stochastic approximation EM over the PGAS kernel (Lindsten 2013; Schön et al. 2015,
    algorithm of maximum likelihood with PGAS), for densities that separate in the parameters.

    Parameters
    ----------
    particles : N of the conditional particle filter, at least 2; None: 25, or 200 where ancestors
        cannot be sampled.
    proposal : "auto", "bootstrap", "guided", "auxiliary" or "user".
    iterations : of each chain, one sweep and one M-step each.
    burn_in : the first k_0 iterations, with step size 1; later it is (k / k_0)^-exponent. At least
        as many as EM needs to come near its limit.
    exponent : above 0.5, at most 1.
    chains : independent climbs from dispersed starts, whose mean is the estimate; their spread
        tells its error.
    """

    particles: int | None = setting(None, optional(count(2)))
    proposal: str = setting("auto", a_name)
    iterations: int = setting(1000, count(1))
    burn_in: int = setting(150, count(1))
    exponent: float = setting(
        0.7, number(lambda v: 0.5 < v <= 1.0, "give a number above 0.5 and at most 1")
    )
    chains: int = setting(8, count(1))

    def _check_together(self) -> None:
        """Some iterations are left for the estimate."""
        check_count("iterations", self.iterations, self.burn_in + 1)


@checked_settings
@dataclass(frozen=True)
class ScoreAscent:
    """Stochastic approximation on particle estimates of the score (Poyiadjis, Doucet and Singh
    2011; Schön et al. 2015, section on marginalisation and its appendix).

    Parameters
    ----------
    steps : "newton" takes steps scaled by an averaged estimate of the observed information, until
        they are noise; then it averages further iterates, scores and informations, and stops when
        the Monte Carlo error is small. "paper" takes steps gamma k^exponent times the score, for
        the paper's transformed parameters (log, and atanh between bounds), without end but
        `iterations`; from far away, or with a flat likelihood, they stop short of the maximum.
    particles, trajectories, runs : N of the filter, M backward trajectories of each run, and
        independent runs for each score; None: 500, 200 and 8, for "paper" 500, 100 and 1.
    iterations : at most; None: 200, for "paper" 250.
    tolerance : Monte Carlo error at which "newton" stops, as a share of the standard error.
    gamma, exponent : the sequence of "paper".
    proposal, kernel : of the filter and of the backward pass, as in `score`.
    """

    steps: str = setting("newton", one_of(("newton", "paper")))
    particles: int | None = setting(None, optional(count(1)))
    trajectories: int | None = setting(None, optional(count(1)))
    runs: int | None = setting(None, optional(count(1)))
    iterations: int | None = setting(None, optional(count(1)))
    tolerance: float = setting(0.04, number(lambda v: v > 0.0, POSITIVE))
    gamma: float = setting(0.01, number(lambda v: v > 0.0, POSITIVE))
    exponent: float = setting(
        -2.0 / 3.0, number(lambda v: v <= 0.0, "give a number of at most 0, as -2/3")
    )
    proposal: str = setting("auto", a_name)
    kernel: str = setting("auto", a_name)

    def _check_together(self) -> None:
        """The spread of the runs tells the noise of the score."""
        if self.steps != "paper" and self.runs is not None:
            check_count("runs", self.runs, 2)


@checked_settings
@dataclass(frozen=True)
class IF2:
    """Iterated filtering (Ionides, Nguyen, Atchadé, Stoev and King 2015, algorithm IF2): a particle
    filter passes over the data again and again, its particles carrying parameters that take random
    steps on the unconstrained scale, smaller ones in each pass.

    The transition is only simulated: it may have no density (deterministic components, discrete
    states) and no derivatives. Parameters that act in the initial distribution alone are found in
    the model and take their step at the first row only. Several experiments are passed over one
    after another.

    Parameters
    ----------
    particles : N of each run, and of the filters that evaluate the likelihood at its end.
    iterations : passes over the data.
    cooling : what is left of the steps' standard deviation after 50 iterations; it falls
        geometrically, from row to row. 1: no cooling.
    perturbation : standard deviation of a step at the beginning, on the unconstrained scale (of log
        theta, for a positive parameter): one number, or by the names of parameters. Those that are
        not named have 0.02. A parameter of the initial distribution alone has the root of the
        number of rows times as much, at most ten times, unless it is named.
    starts : number of runs, the first at the start, the others dispersed round it; or a list of
        their parameter values. The top is looked for from the end of highest log-likelihood, or
        from the mean of those that agree with it where that is higher still.
    averaged : last iterations that an end is the mean of, on the unconstrained scale.
    evaluations : estimates of the likelihood at each end.
    points : places at which the likelihood is estimated round where the runs ended, to find the
        maximum. The estimate is the maximum of a quadratic fitted to them, its curvature gives the
        standard errors, and the noise of the estimates its Monte Carlo error (Ionides, Bretó, Park,
        Smith and King 2017). None: 24 for each coefficient of the quadratic, at least 160. 0: none
        of this; the estimate is where the runs ended, how far that is off is not known, and only
        an exact likelihood gives standard errors.
    """

    particles: int = setting(2000, count(2))
    iterations: int = setting(100, count(1))
    cooling: float = setting(
        0.5,
        number(
            lambda v: 0.0 < v <= 1.0,
            "give what is left of the steps after 50 iterations: above 0, at most 1",
        ),
    )
    perturbation: float | Mapping[str, float] = setting(0.02, step_sizes)
    starts: int | Sequence[Mapping[str, Any]] = setting(4, count_or_starts)
    averaged: int = setting(25, count(1))
    evaluations: int = setting(10, count(2))
    points: int | None = setting(None, optional(count(0)))


@checked_settings
@dataclass(frozen=True)
class SMC2:
    """SMC^2 (Chopin, Jacob and Papaspiliopoulos 2013): particles in the parameters, each with a
    particle filter of its own, go through the data from the prior to the posterior, and estimate
    the evidence on the way. No start, no warmup and no tuning of a walk; priors must be proper.

    In `sample` the chains are independent runs, whose draws have equal weight, and no trajectories
    are kept (`smooth` has them at given parameters).

    Parameters
    ----------
    parameters : number M of particles in the parameters; None: as many as `sample` is to draw, 500
        for `evidence`.
    particles : number N of each filter at the beginning. It doubles where moves are refused.
    ess_threshold : parameters are resampled and moved when their effective number falls below this
        share of M.
    moves : particle Metropolis-Hastings steps of each parameter then.
    acceptance : rate of these below which N doubles.
    proposal : of the filters: "auto", "bootstrap", "guided" or "user".
    """

    parameters: int | None = setting(None, optional(count(2)))
    particles: int = setting(100, count(1))
    ess_threshold: float = setting(0.5, number(lambda v: 0.0 <= v <= 1.0, SHARE))
    moves: int = setting(3, count(1))
    acceptance: float = setting(0.15, number(lambda v: 0.0 <= v <= 1.0, SHARE))
    proposal: str = setting("auto", a_name)


Method = MetropolisHastings | Gibbs | PMMH | ISMCMC | PGAS | SMC2


@checked_settings
@dataclass(frozen=True)
class KalmanSmoother:
    """Smoothing by Kalman passes: moments (Rauch, Tung and Striebel 1965), or independent draws by
    backward sampling. Exact on linear Gaussian models.

    Parameters
    ----------
    proposal : "kalman", exact; or an approximation for states driven by Gaussian noise: "laplace",
        the Gaussian distribution round the mode of all states together (Tierney and Kadane 1986),
        "extended", or "unscented" (Julier and Uhlmann 1997; Särkkä 2008).
    """

    proposal: str = setting("kalman", one_of(("kalman", "laplace", "extended", "unscented")))


@checked_settings
@dataclass(frozen=True)
class ForwardBackward:
    """Exact smoothing where the states take finitely many values (Rabiner 1989): moments, or
    independent draws by backward sampling (Chib 1996)."""


@checked_settings
@dataclass(frozen=True)
class FFBSi:
    """Forward filtering, backward simulation: independent draws, given the filter's particles, from
    the joint smoothing distribution (Godsill, Doucet and West 2004; Schön et al. 2015, section 5).

    Parameters
    ----------
    kernel : how the index of x_t is drawn given x_{t+1}: "exact", with all N weights; "rejection",
        the same distribution by rejection sampling with early stopping (Douc et al. 2011; Taghavi
        et al. 2013), where the transition density has a bound; "mcmc" (Bunch and Godsill 2013);
        "genealogy", the filter's own ancestors, which all meet in one soon; "auto".
    moves : Metropolis-Hastings steps for each index of "mcmc".
    proposal, resampling, ess_threshold, rescue : of the particle filter, as in `log_likelihood`.
    """

    kernel: str = setting("auto", a_name)
    moves: int = setting(20, count(0))
    proposal: str = setting("auto", a_name)
    resampling: str = setting("systematic", a_name)
    ess_threshold: float = setting(1.0, ESS)
    rescue: int = setting(0, rescue_factor)


@checked_settings
@dataclass(frozen=True)
class FixedLag:
    """Marginal moments from the filter's genealogy: x_t as the particles of step t + lag remember
    it (Kitagawa 1996). What later data tell of x_t is left out, which is a bias that falls with the
    lag; with too long a lag, the genealogy has few distinct ancestors left.

    Parameters
    ----------
    lag : number of steps; None: 20.
    proposal, resampling, ess_threshold : of the particle filter, as in `log_likelihood`.
    """

    lag: int | None = setting(None, optional(count(0)))
    proposal: str = setting("auto", a_name)
    resampling: str = setting("systematic", a_name)
    ess_threshold: float = setting(1.0, ESS)


SmoothingMethod = KalmanSmoother | ForwardBackward | FFBSi | FixedLag | PGAS
