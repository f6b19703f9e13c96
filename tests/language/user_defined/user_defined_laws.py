"""Laws of a user's own, by the interface that users have."""

import numpy as np
from scipy import special, stats

import ssmppl as ssm


@ssm.distribution(lower=0, positive=("shape", "scale"))
def Lomax(y, shape, scale):
    return np.log(shape / scale) - (shape + 1) * np.log1p(y / scale)


@Lomax.sampler
def draw_lomax(rng, shape, scale):
    return scale * ((1 - rng.uniform()) ** (-1 / shape) - 1)


@Lomax.mean
def mean_of_lomax(shape, scale):
    return np.where(shape > 1, scale / (shape - 1), np.inf)


@Lomax.cdf
def cdf_of_lomax(y, shape, scale):
    return -np.expm1(-shape * np.log1p(y / scale))


@ssm.distribution(positive=("scale",))
def Gumbel(y, loc, scale=1.0):
    z = (y - loc) / scale
    return -np.log(scale) - z - np.exp(-z)


@Gumbel.quantile
def quantile_of_gumbel(p, loc, scale):
    return loc - scale * np.log(-np.log(p))


@Gumbel.cdf
def cdf_of_gumbel(y, loc, scale):
    return np.exp(-np.exp(-(y - loc) / scale))


@Gumbel.mean
def mean_of_gumbel(loc, scale):
    return loc + np.euler_gamma * scale


@Gumbel.variance
def variance_of_gumbel(scale):
    return np.pi**2 / 6 * scale**2


@ssm.distribution(lower="low", upper="high", closed=True)
def Triangle(y, low, high):
    """With its peak in the middle."""
    half = (high - low) / 2
    return np.log(half - np.abs(y - low - half)) - 2 * np.log(half)


@Triangle.sampler
def draw_triangle(rng, low, high):
    return low + (high - low) * (rng.uniform() + rng.uniform()) / 2


@ssm.distribution(discrete=True, lower=0, positive=("alpha",))
def Yule(k, alpha):
    """The Yule-Simon law of k + 1."""
    return np.log(alpha) + special.gammaln(k + 1) + special.gammaln(alpha + 1) - (
        special.gammaln(k + alpha + 2)
    )  # fmt: skip


@Yule.sampler
def draw_yule(rng, alpha):
    w = np.exp(-rng.exponential() / alpha)  # geometric, with success probability w
    return np.floor(np.log(rng.uniform()) / np.log1p(-w))


@ssm.distribution(discrete=True, lower=-1, upper=2)
def Steps(k, up):
    """-1, 0, 1, 2 with probabilities in proportion to exp(up k)."""
    return up * k - np.log(np.exp(-up) + 1 + np.exp(up) + np.exp(2 * up))


# The same as laws of the language
@ssm.distribution(lower=0, positive=("shape", "rate"))
def OwnGamma(y, shape, rate):
    return shape * np.log(rate) + (shape - 1) * np.log(y) - rate * y - special.gammaln(shape)


@OwnGamma.sampler
def draw_gamma(rng, shape, rate):
    return rng.gamma(shape, 1 / rate)


@OwnGamma.mean
def mean_of_gamma(shape, rate):
    return shape / rate


@OwnGamma.cdf
def cdf_of_gamma(y, shape, rate):
    return special.gammainc(shape, rate * y)


@ssm.distribution(positive=("sd",))
def OwnNormal(y, mean, sd):
    return -np.log(sd) - ((y - mean) / sd) ** 2 / 2 - np.log(2 * np.pi) / 2


@OwnNormal.sampler
def draw_normal(rng, mean, sd):
    return rng.normal(mean, sd)


@ssm.distribution(discrete=True, lower=0, positive=("rate",))
def OwnPoisson(k, rate):
    return k * np.log(rate) - rate - special.gammaln(k + 1)


@OwnPoisson.sampler
def draw_poisson(rng, rate):
    return rng.poisson(rate)


# law, arguments, the same of scipy.stats
TABLE = [
    (Lomax, {"shape": 2.5, "scale": 3.0}, stats.lomax(2.5, scale=3.0)),
    (Lomax, {"shape": 0.7, "scale": 0.2}, stats.lomax(0.7, scale=0.2)),
    (Gumbel, {"loc": -2.0, "scale": 0.5}, stats.gumbel_r(-2.0, 0.5)),
    (Triangle, {"low": 1.0, "high": 4.0}, stats.triang(0.5, loc=1.0, scale=3.0)),
    (Yule, {"alpha": 3.0}, stats.yulesimon(3.0, loc=-1)),
    (OwnGamma, {"shape": 0.3, "rate": 2.0}, stats.gamma(0.3, scale=0.5)),
    (OwnNormal, {"mean": 1e4, "sd": 0.01}, stats.norm(1e4, 0.01)),
    (OwnPoisson, {"rate": 40.0}, stats.poisson(40.0)),
]
NAMES = [f"{law.__name__} {i}" for i, (law, _, _) in enumerate(TABLE)]


def mixed_model(gamma, normal, poisson):
    """Priors, states and channels of these three families, vectors among them."""
    model = ssm.Model("mixed")

    @model.prior
    def prior():
        return {
            "tau": gamma(2.0, rate=1.5),
            "phi": normal(np.zeros(2), sd=0.7),
            "lam": gamma(3.0, rate=1.0),
        }

    @model.initial
    def initial():
        return {"x": normal(0.0, sd=1.0), "v": normal(np.array([0.5, -0.5]), sd=0.4)}

    @model.transition
    def transition(x, v, phi, tau):
        return {
            "x": normal(phi[0] * x + v[0], sd=1 / np.sqrt(tau)),
            "v": normal(0.9 * v, sd=np.array([0.2, 0.3])),
        }

    @model.observation
    def observation(x, v, lam, phi):
        return {"y": poisson(lam * np.exp(x)), "z": normal(phi[1] * v, sd=0.5)}

    return model
