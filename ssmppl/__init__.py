"""A probabilistic-programming language for state space models.

Declare priors, initial law, transition and observation as decorated functions of a `Model`; the
verbs below derive and compile the rest.
"""

from ssmppl import plots
from ssmppl.errors import ArgumentError, DataError, ModelError, SamplingError, SSMError
from ssmppl.gap.catalogue import effects
from ssmppl.gap.diagnose import diagnose
from ssmppl.gap.effect import effect
from ssmppl.gap.report import GapReport
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
from ssmppl.language.distributions import (
    Bernoulli,
    Beta,
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
    MvNormal,
    NegativeBinomial,
    Normal,
    Poisson,
    StudentT,
    Truncated,
    Uniform,
    Wishart,
)
from ssmppl.language.model import Model
from ssmppl.language.primitive import primitive
from ssmppl.results import summary

__version__ = "0.1.0"

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
    "Binomial",
    "Categorical",
    "Cauchy",
    "DataError",
    "Dirac",
    "DirectOptimization",
    "Dirichlet",
    "Evidence",
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
    "Wishart",
    "compile",
    "diagnose",
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
    "plots",
    "predict",
    "primitive",
    "sample",
    "score",
    "simulate",
    "smooth",
    "summary",
]
