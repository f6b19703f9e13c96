"""Methods of estimation as settings: small frozen dataclasses, named by the field."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PMMH:
    """Particle Metropolis-Hastings: a random walk on the parameters with an unbiased estimate of
    the likelihood (Andrieu, Doucet and Holenstein 2010; Schön et al. 2015, algorithm 4).

    Parameters
    ----------
    particles : N; None tunes it in a pilot to a standard deviation of log Z of about `target_sd`
        (Doucet et al. 2015; Sherlock et al. 2015).
    proposal : the particle filter's proposal, as in `log_likelihood`.
    target_sd : of the estimate of the log-likelihood, which the pilot aims at.
    target_acceptance : what the covariance of the random walk adapts to during warmup (Vihola
        2012); None: 0.25 for one parameter, less for more.
    """

    particles: int | None = None
    proposal: str = "auto"
    target_sd: float = 1.2
    target_acceptance: float | None = None


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
    """

    particles: int | None = None
    proposal: str = "auto"
    log_likelihood: bool = False


Method = PMMH | PGAS
