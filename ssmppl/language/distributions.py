"""All distributions of the language, by name."""

from ssmppl.language.continuous import Flat, HalfFlat, LogNormal, Normal, Uniform
from ssmppl.language.discrete import (
    Bernoulli,
    Binomial,
    Categorical,
    Dirac,
    NegativeBinomial,
    Poisson,
)
from ssmppl.language.distribution import Distribution, Support
from ssmppl.language.draws import Draws
from ssmppl.language.multivariate import Dirichlet, InverseWishart, MvNormal, Wishart
from ssmppl.language.positive import Beta, Exponential, Gamma, InverseGamma
from ssmppl.language.symmetric import Cauchy, HalfCauchy, HalfNormal, Laplace, StudentT
from ssmppl.language.truncated import Truncated

DISTRIBUTIONS: dict[str, type[Distribution]] = {
    cls.__name__: cls
    for cls in (
        Normal, MvNormal, LogNormal, StudentT, Laplace, Cauchy, HalfNormal, HalfCauchy, Uniform,
        Exponential, Gamma, InverseGamma, Beta, Dirichlet, Wishart, InverseWishart, Poisson,
        NegativeBinomial, Binomial, Bernoulli, Categorical, Dirac, Truncated, Flat, HalfFlat,
    )
}  # fmt: skip

__all__ = [*DISTRIBUTIONS, "DISTRIBUTIONS", "Distribution", "Draws", "Support"]
