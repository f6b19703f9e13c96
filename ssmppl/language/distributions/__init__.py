"""All distributions of the language, by name."""

from ssmppl.language.distributions.base import Distribution, Support
from ssmppl.language.distributions.continuous import (
    Flat,
    HalfFlat,
    LogNormal,
    Normal,
    SkewNormal,
    Uniform,
    VonMises,
)
from ssmppl.language.distributions.discrete import (
    Bernoulli,
    BetaBinomial,
    Binomial,
    Categorical,
    Dirac,
    NegativeBinomial,
    Poisson,
    Skellam,
)
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.distributions.mixtures import Mixture, ZeroInflated
from ssmppl.language.distributions.multivariate import Dirichlet, InverseWishart, MvNormal, Wishart
from ssmppl.language.distributions.positive import (
    Beta,
    Exponential,
    Gamma,
    InverseGamma,
    Pareto,
    Weibull,
)
from ssmppl.language.distributions.symmetric import (
    Cauchy,
    HalfCauchy,
    HalfNormal,
    Laplace,
    Logistic,
    StudentT,
)
from ssmppl.language.distributions.truncated import Censored, Truncated
from ssmppl.language.distributions.vectors.allocations import EulerMultinomial, Multinomial
from ssmppl.language.distributions.vectors.correlations import LKJ
from ssmppl.language.distributions.vectors.ordered import Ordered
from ssmppl.language.distributions.vectors.shares import LogisticNormal
from ssmppl.language.distributions.vectors.student import MvStudentT

DISTRIBUTIONS: dict[str, type[Distribution]] = {
    cls.__name__: cls
    for cls in (
        Normal, MvNormal, LogNormal, SkewNormal, StudentT, Laplace, Logistic, Cauchy, HalfNormal,
        HalfCauchy, Uniform, Exponential, Weibull, Pareto, Gamma, InverseGamma, Beta, VonMises,
        Dirichlet, Wishart, InverseWishart, LKJ, Ordered, LogisticNormal, MvStudentT, Poisson,
        NegativeBinomial, Binomial, BetaBinomial, Bernoulli, Skellam, Categorical, Multinomial,
        EulerMultinomial, Dirac, Truncated, Censored, Mixture, ZeroInflated, Flat, HalfFlat,
    )
}  # fmt: skip

__all__ = [*DISTRIBUTIONS, "DISTRIBUTIONS", "Distribution", "Draws", "Support"]
