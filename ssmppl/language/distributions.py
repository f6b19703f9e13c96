"""All distributions of the language, by name."""

from ssmppl.language.circular import VonMises
from ssmppl.language.continuous import Flat, HalfFlat, LogNormal, Normal, Uniform
from ssmppl.language.counts import BetaBinomial, Binomial, NegativeBinomial, Poisson
from ssmppl.language.discrete import Bernoulli, Categorical, Dirac
from ssmppl.language.distribution import Distribution, Support
from ssmppl.language.draws import Draws
from ssmppl.language.inflated import ZeroInflated
from ssmppl.language.mixtures import Mixture
from ssmppl.language.multivariate import Dirichlet, InverseWishart, MvNormal, Wishart
from ssmppl.language.positive import Beta, Exponential, Gamma, InverseGamma, Weibull
from ssmppl.language.symmetric import Cauchy, HalfCauchy, HalfNormal, Laplace, StudentT
from ssmppl.language.truncated import Truncated

DISTRIBUTIONS: dict[str, type[Distribution]] = {
    cls.__name__: cls
    for cls in (
        Normal, MvNormal, LogNormal, StudentT, Laplace, Cauchy, HalfNormal, HalfCauchy, Uniform,
        Exponential, Weibull, Gamma, InverseGamma, Beta, VonMises, Dirichlet, Wishart,
        InverseWishart, Poisson, NegativeBinomial, Binomial, BetaBinomial, Bernoulli, Categorical,
        Dirac, Truncated, Mixture, ZeroInflated, Flat, HalfFlat,
    )
}  # fmt: skip

__all__ = [*DISTRIBUTIONS, "DISTRIBUTIONS", "Distribution", "Draws", "Support"]
