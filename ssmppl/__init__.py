"""A probabilistic-programming language for state space models.

Declare priors, initial law, transition and observation as decorated functions of a `Model`; the
verbs below derive and compile the rest. The diagnosis and its plots are imported when they are
first asked for: most sessions never do, and they make up a third of the package.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ssmppl.errors import (
    ArgumentError,
    DataError,
    ExecutorError,
    ModelError,
    SamplingError,
    SSMError,
)
from ssmppl.inference.evidence import Evidence, evidence
from ssmppl.inference.exact_filters import forward_filter, kalman_filter
from ssmppl.inference.explain import compile, explain
from ssmppl.inference.filters import particle_filter
from ssmppl.inference.forecast import forecast
from ssmppl.inference.leave_future_out import leave_future_out
from ssmppl.inference.likelihood import log_likelihood
from ssmppl.inference.maximize import maximize
from ssmppl.inference.methods import (
    EM,
    IF2,
    PGAS,
    PMMH,
    PSAEM,
    SMC2,
    DirectOptimization,
    Gibbs,
    MetropolisHastings,
    ParticleEM,
    ScoreAscent,
)
from ssmppl.inference.predict import predict
from ssmppl.inference.sample import sample
from ssmppl.inference.score import score
from ssmppl.inference.simulation import simulate
from ssmppl.inference.smooth import smooth
from ssmppl.inference.smoothing_methods import FFBSi, FixedLag, ForwardBackward, KalmanSmoother
from ssmppl.language.declaring import distribution
from ssmppl.language.distributions import (
    Bernoulli,
    Beta,
    BetaBinomial,
    Binomial,
    Categorical,
    Cauchy,
    Dirac,
    Dirichlet,
    Exponential,
    Flat,
    Gamma,
    HalfCauchy,
    HalfFlat,
    HalfNormal,
    InverseGamma,
    InverseWishart,
    Laplace,
    LogNormal,
    Mixture,
    MvNormal,
    NegativeBinomial,
    Normal,
    Poisson,
    StudentT,
    Truncated,
    Uniform,
    VonMises,
    Weibull,
    Wishart,
    ZeroInflated,
)
from ssmppl.language.elsewhere import advice
from ssmppl.language.model import Model
from ssmppl.language.primitive import primitive
from ssmppl.tables import summary

if TYPE_CHECKING:
    from ssmppl import plots
    from ssmppl.gap.catalogue import effects
    from ssmppl.gap.diagnose import diagnose
    from ssmppl.gap.effect import effect
    from ssmppl.gap.report import GapReport
    from ssmppl.plots import (
        plot_ancestry,
        plot_filter,
        plot_forecast,
        plot_likelihood,
        plot_maximization,
        plot_predictions,
        plot_prior_posterior,
        plot_states,
    )

__version__ = "0.1.0"

_LATER = {
    "GapReport": "gap.report",
    "diagnose": "gap.diagnose",
    "effect": "gap.effect",
    "effects": "gap.catalogue",
    "plot_ancestry": "plots.filters",
    "plot_filter": "plots.filters",
    "plot_forecast": "plots.states",
    "plot_likelihood": "plots.likelihood",
    "plot_maximization": "plots.parameters",
    "plot_predictions": "plots.predictions",
    "plot_prior_posterior": "plots.parameters",
    "plot_states": "plots.states",
}

__all__ = [
    "EM",
    "IF2",
    "PGAS",
    "PMMH",
    "PSAEM",
    "SMC2",
    "ArgumentError",
    "Bernoulli",
    "Beta",
    "BetaBinomial",
    "Binomial",
    "Categorical",
    "Cauchy",
    "DataError",
    "Dirac",
    "DirectOptimization",
    "Dirichlet",
    "Evidence",
    "ExecutorError",
    "Exponential",
    "FFBSi",
    "FixedLag",
    "Flat",
    "ForwardBackward",
    "Gamma",
    "GapReport",
    "Gibbs",
    "HalfCauchy",
    "HalfFlat",
    "HalfNormal",
    "InverseGamma",
    "InverseWishart",
    "KalmanSmoother",
    "Laplace",
    "LogNormal",
    "MetropolisHastings",
    "Mixture",
    "Model",
    "ModelError",
    "MvNormal",
    "NegativeBinomial",
    "Normal",
    "ParticleEM",
    "Poisson",
    "SSMError",
    "SamplingError",
    "ScoreAscent",
    "StudentT",
    "Truncated",
    "Uniform",
    "VonMises",
    "Weibull",
    "Wishart",
    "ZeroInflated",
    "compile",
    "diagnose",
    "distribution",
    "effect",
    "effects",
    "evidence",
    "explain",
    "forecast",
    "forward_filter",
    "kalman_filter",
    "leave_future_out",
    "log_likelihood",
    "maximize",
    "particle_filter",
    "plot_ancestry",
    "plot_filter",
    "plot_forecast",
    "plot_likelihood",
    "plot_maximization",
    "plot_predictions",
    "plot_prior_posterior",
    "plot_states",
    "plots",
    "predict",
    "primitive",
    "sample",
    "score",
    "simulate",
    "smooth",
    "summary",
]


def __getattr__(name: str) -> Any:
    if name != "plots" and name not in _LATER:
        told = "" if name.startswith("__") else advice(name, __all__)
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}" + (f": {told}" if told else "")
        )
    plots = importlib.import_module(f"{__name__}.plots")  # a report has to know who draws it
    if name == "plots":
        return plots
    globals()[name] = value = getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
