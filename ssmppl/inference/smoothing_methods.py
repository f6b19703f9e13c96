"""Methods of smoothing as settings: small frozen dataclasses, named by the field."""

from __future__ import annotations

from dataclasses import dataclass

from ssmppl.inference.methods import PGAS


@dataclass(frozen=True)
class KalmanSmoother:
    """Exact smoothing of linear Gaussian models: moments (Rauch, Tung and Striebel 1965), or
    independent draws by backward sampling."""


@dataclass(frozen=True)
class ForwardBackward:
    """Exact smoothing where the states take finitely many values (Rabiner 1989): moments, or
    independent draws by backward sampling (Chib 1996)."""


@dataclass(frozen=True)
class FFBSi:
    """Forward filtering, backward simulation: independent draws, given the filter's particles, from
    the joint smoothing distribution (Godsill, Doucet and West 2004; Schön et al. 2015, section 5).

    Parameters
    ----------
    kernel : how the index of x_t is drawn given x_{t+1}: "exact", with all N weights; "rejection",
        the same law by rejection sampling with early stopping (Douc et al. 2011; Taghavi et al.
        2013), where the transition density has a bound; "mcmc" (Bunch and Godsill 2013);
        "genealogy", the filter's own ancestors, which all meet in one soon; "auto".
    moves : Metropolis-Hastings steps for each index of "mcmc".
    proposal, resampling, ess_threshold, rescue : of the particle filter, as in `log_likelihood`.
    """

    kernel: str = "auto"
    moves: int = 20
    proposal: str = "auto"
    resampling: str = "systematic"
    ess_threshold: float = 1.0
    rescue: int = 0


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

    lag: int | None = None
    proposal: str = "auto"
    resampling: str = "systematic"
    ess_threshold: float = 1.0


SmoothingMethod = KalmanSmoother | ForwardBackward | FFBSi | FixedLag | PGAS
