"""A probabilistic-programming language for state space models.

Declare priors, initial distribution, transition and observation as decorated functions of a
`Model`; the verbs below derive and compile the rest. The diagnosis and its plots are imported when
they are first asked for: most sessions never do, and they make up a third of the package.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ssmppl.errors import (
    ArgumentError,
    DataError,
    ExecutorError,
    ModelError,
    SamplingError,
    SimulatorError,
    SSMError,
)
from ssmppl.expressions.loops.integrate import expm, integrate, repeat
from ssmppl.inference.methods.methods import (
    EM,
    IF2,
    ISMCMC,
    PGAS,
    PMMH,
    PSAEM,
    SMC2,
    DirectOptimization,
    FFBSi,
    FixedLag,
    ForwardBackward,
    Gibbs,
    KalmanSmoother,
    MetropolisHastings,
    ParticleEM,
    ScoreAscent,
)
from ssmppl.inference.verbs.evidence import Evidence, evidence
from ssmppl.inference.verbs.explain import compile, explain
from ssmppl.inference.verbs.filters import forward_filter, kalman_filter, particle_filter
from ssmppl.inference.verbs.forecast import forecast
from ssmppl.inference.verbs.leave_future_out import leave_future_out
from ssmppl.inference.verbs.log_likelihood import log_likelihood
from ssmppl.inference.verbs.maximize import maximize
from ssmppl.inference.verbs.predict import predict
from ssmppl.inference.verbs.sample import sample
from ssmppl.inference.verbs.score import score
from ssmppl.inference.verbs.simulate import simulate
from ssmppl.inference.verbs.smooth import smooth
from ssmppl.language.distributions import (
    LKJ,
    Bernoulli,
    Beta,
    BetaBinomial,
    Binomial,
    Categorical,
    Cauchy,
    Censored,
    Dirac,
    Dirichlet,
    EulerMultinomial,
    Exponential,
    Flat,
    Gamma,
    HalfCauchy,
    HalfFlat,
    HalfNormal,
    InverseGamma,
    InverseWishart,
    Laplace,
    Logistic,
    LogisticNormal,
    LogNormal,
    Mixture,
    Multinomial,
    MvNormal,
    MvStudentT,
    NegativeBinomial,
    Normal,
    Ordered,
    Pareto,
    Poisson,
    Skellam,
    SkewNormal,
    StudentT,
    Truncated,
    Uniform,
    VonMises,
    Weibull,
    Wishart,
    ZeroInflated,
)
from ssmppl.language.model import model as _model
from ssmppl.language.model.model import Model
from ssmppl.language.model.name_hints import name_hint
from ssmppl.language.user_defined.distribution import distribution
from ssmppl.language.user_defined.potential import Potential
from ssmppl.language.user_defined.primitive import primitive
from ssmppl.language.user_defined.sde import SDE
from ssmppl.language.user_defined.simulator import Simulator, simulator
from ssmppl.tables import summary

if TYPE_CHECKING:
    from ssmppl import plots, simulators, structural
    from ssmppl.diagnosis.diagnose import diagnose
    from ssmppl.diagnosis.effects.catalogue import effects
    from ssmppl.diagnosis.effects.effect import effect
    from ssmppl.diagnosis.report.report import GapReport
    from ssmppl.plots import (
        plot_ancestry,
        plot_components,
        plot_filter,
        plot_forecast,
        plot_likelihood,
        plot_maximization,
        plot_model,
        plot_predictions,
        plot_prior_posterior,
        plot_states,
    )

__version__ = "0.1.0"

_MODULES = ("plots", "simulators", "structural")
_LATER = {
    "GapReport": "diagnosis.report.report",
    "diagnose": "diagnosis.diagnose",
    "effect": "diagnosis.effects.effect",
    "effects": "diagnosis.effects.catalogue",
    "plot_ancestry": "plots.filters",
    "plot_components": "plots.structure",
    "plot_filter": "plots.filters",
    "plot_forecast": "plots.states",
    "plot_likelihood": "plots.likelihood",
    "plot_maximization": "plots.parameters",
    "plot_model": "plots.model",
    "plot_predictions": "plots.predictions",
    "plot_prior_posterior": "plots.parameters",
    "plot_states": "plots.states",
}

__all__ = [
    "EM",
    "IF2",
    "ISMCMC",
    "LKJ",
    "PGAS",
    "PMMH",
    "PSAEM",
    "SDE",
    "SMC2",
    "ArgumentError",
    "Bernoulli",
    "Beta",
    "BetaBinomial",
    "Binomial",
    "Categorical",
    "Cauchy",
    "Censored",
    "DataError",
    "Dirac",
    "DirectOptimization",
    "Dirichlet",
    "EulerMultinomial",
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
    "Logistic",
    "LogisticNormal",
    "MetropolisHastings",
    "Mixture",
    "Model",
    "ModelError",
    "Multinomial",
    "MvNormal",
    "MvStudentT",
    "NegativeBinomial",
    "Normal",
    "Ordered",
    "Pareto",
    "ParticleEM",
    "Poisson",
    "Potential",
    "SSMError",
    "SamplingError",
    "ScoreAscent",
    "Simulator",
    "SimulatorError",
    "Skellam",
    "SkewNormal",
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
    "expm",
    "forecast",
    "forward_filter",
    "integrate",
    "kalman_filter",
    "leave_future_out",
    "log_likelihood",
    "maximize",
    "particle_filter",
    "plot_ancestry",
    "plot_components",
    "plot_filter",
    "plot_forecast",
    "plot_likelihood",
    "plot_maximization",
    "plot_model",
    "plot_predictions",
    "plot_prior_posterior",
    "plot_states",
    "plots",
    "predict",
    "primitive",
    "repeat",
    "sample",
    "score",
    "simulate",
    "simulator",
    "simulators",
    "smooth",
    "structural",
    "summary",
]


# Decorators that a model has.
_OF_A_MODEL = ("prior", "initial", "transition", "observation", "proposal")


def _svg(model: Model) -> str:
    found: str = importlib.import_module(f"{__name__}.plots.model").svg_of(model)
    return found


_model.draw = _svg


def __getattr__(name: str) -> Any:
    if name not in _MODULES and name not in _LATER:
        hint = "" if name.startswith("__") else name_hint(name, __all__)
        if name in _OF_A_MODEL:
            hint = f'write model = ssm.Model("name"), and then @model.{name}'
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}" + (f": {hint}" if hint else "")
        )
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    globals()[name] = value = getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
