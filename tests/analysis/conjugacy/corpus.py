"""Models and the updates that must be derived for them.

Each function declares one model and says what to expect: `expects(...)` lists (parameters of the
block, family). The state is x and the data y unless the model needs others.
"""

import numpy as np

from ssmppl.language.distributions import (
    Bernoulli,
    Beta,
    Binomial,
    Categorical,
    Dirichlet,
    Exponential,
    Flat,
    Gamma,
    HalfCauchy,
    HalfNormal,
    InverseGamma,
    InverseWishart,
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
from ssmppl.language.model.model import Model

CORPUS = {}


def expects(*blocks, corrections=()):
    """Register a function that declares laws on the model it is given.

    blocks : (names, family) or (names, family, number of such updates).
    corrections : texts of the functions outside the span.
    """

    def register(declare):
        CORPUS[declare.__name__] = (declare, blocks, corrections)
        return declare

    return register


def build(name):
    declare, blocks, corrections = CORPUS[name]
    inputs = getattr(declare, "inputs", ())
    model = Model(name, inputs=inputs)
    declare(model)
    return model, blocks, corrections


def with_inputs(**lengths):
    def mark(declare):
        declare.inputs = lengths
        return declare

    return mark


def laws(m, prior, transition, initial=None, observation=None):
    """Declare the four laws; by default x_1 ~ N(0, 1) and y ~ N(x, 1)."""

    def first():
        return {"x": Normal(0, sd=1)}

    def measured(x):
        return {"y": Normal(x, sd=1)}

    m.prior(prior)
    m.initial(initial or first)
    m.transition(transition)
    m.observation(observation or measured)


NG = "Normal-Gamma"


# -- autoregressions, spelled in many ways
@expects((("phi", "tau"), NG), corrections=["log(1 - phi**2)"])
def varves(m):
    def prior():
        return {"phi": Uniform(-1, 1), "tau": Gamma(0.01, rate=0.01)}

    def initial(phi, tau):
        return {"x": Normal(0, precision=(1 - phi**2) * tau)}

    def transition(x, phi, tau):
        return {"x": Normal(phi * x, precision=tau)}

    def observation(x):
        return {"y": Gamma(6.25, rate=0.256 * np.exp(-x))}

    laws(m, prior, transition, initial, observation)


@expects((("phi", "tau"), NG), corrections=["log(1 - phi**2)"])
def varves_by_sd(m):
    """The same laws with the spread as a standard deviation, and the product written out."""

    def prior():
        return {"phi": Uniform(-1, 1), "tau": Gamma(2, rate=1)}

    def initial(phi, tau):
        return {"x": Normal(0, sd=1 / np.sqrt(tau * (1 - phi) * (1 + phi)))}

    def transition(x, phi, tau):
        return {"x": Normal(x - (1 - phi) * x, sd=1 / np.sqrt(tau))}

    laws(m, prior, transition, initial)


@expects((("phi", "v"), "Normal-inverse-Gamma"), corrections=["log(1 - phi**2)"])
def varves_by_variance(m):
    def prior():
        return {"phi": Uniform(0, 1), "v": InverseGamma(2, scale=1)}

    def initial(phi, v):
        return {"x": Normal(0, variance=v / (1 - phi**2))}

    def transition(x, phi, v):
        return {"x": Normal(phi * x, variance=v)}

    laws(m, prior, transition, initial)


@expects((("c", "a"), "joint Normal"), (("q",), "inverse Gamma"))
def intercept(m):
    def prior():
        return {
            "c": Normal(0, sd=2),
            "a": Normal(0, variance=3),
            "q": InverseGamma(2, scale=1),
        }

    def transition(x, c, a, q):
        return {"x": Normal(c + a * x, variance=q)}

    laws(m, prior, transition)


@expects((("b",), "Normal"))
def halves(m):
    def prior():
        return {"b": Normal(1, sd=2)}

    def transition(x, b):
        return {"x": Normal((x + b) / 2, sd=0.5)}

    laws(m, prior, transition)


@expects((("k",), "Normal"))
def difference(m):
    """x - 0.5 x + k (1 - x), over a common denominator."""

    def prior():
        return {"k": Normal(0, sd=1)}

    def transition(x, k):
        return {"x": Normal((2 * (x - 0.5 * x) + 2 * k * (1 - x)) / 2, sd=1)}

    laws(m, prior, transition)


@expects((("w",), "joint Normal"))
def loop(m):
    def prior():
        return {"w": Normal(np.zeros(3), sd=1)}

    def transition(x, w):
        mean = 0
        for k in range(3):
            mean = mean + w[k] * x**k
        return {"x": Normal(mean, sd=1)}

    laws(m, prior, transition)


@expects((("w",), "joint Normal"))
def dot(m):
    """The same sum by `@`."""

    def prior():
        return {"w": MvNormal(np.zeros(3), covariance=np.eye(3) + 0.2)}

    def transition(x, w):
        return {"x": Normal(w @ np.stack([1 + 0 * x, x, x**2]), sd=1)}

    laws(m, prior, transition)


@expects((("A",), "joint Normal"), (("P",), "Wishart"))
def vector_autoregression(m):
    def prior():
        return {"A": Normal(np.zeros((2, 2)), sd=1), "P": Wishart(4, scale=np.eye(2) * 0.3)}

    def initial():
        return {"x": MvNormal(np.zeros(2), covariance=np.eye(2))}

    def transition(x, A, P):
        return {"x": MvNormal(A @ x, precision=P)}

    def observation(x):
        return {"y": Normal(x, sd=1)}

    laws(m, prior, transition, initial, observation)


@expects((("Q",), "inverse Wishart"))
def covariance(m):
    """One covariance in the initial and, scaled, in the transition law."""

    def prior():
        return {"Q": InverseWishart(5, scale=np.array([[1.0, 0.3], [0.3, 2.0]]))}

    def initial(Q):
        return {"x": MvNormal(np.zeros(2), covariance=4 * Q)}

    def transition(x, Q):
        return {"x": MvNormal(0.5 * x, covariance=Q)}

    def observation(x):
        return {"y": Normal(x, sd=1)}

    laws(m, prior, transition, initial, observation)


@expects((("Q",), "inverse Wishart"))
def covariance_as_precision(m):
    def prior():
        return {"Q": InverseWishart(5, scale=np.eye(2))}

    def initial():
        return {"x": Normal(np.zeros(2), sd=1)}

    def transition(x, Q):
        return {"x": MvNormal(x, precision=np.linalg.inv(Q))}

    def observation(x):
        return {"y": Normal(x, sd=1)}

    laws(m, prior, transition, initial, observation)


# -- precisions, variances, standard deviations
@expects((("tau",), "Gamma"))
def shared_precision(m):
    """One precision in the prior law of x_1, the transition and the observation."""

    def prior():
        return {"tau": Gamma(3, rate=2)}

    def initial(tau):
        return {"x": Normal(0, precision=0.1 * tau)}

    def transition(x, tau):
        return {"x": Normal(x, precision=2 * tau)}

    def observation(x, tau):
        return {"y": Normal(x, variance=3 / tau)}

    laws(m, prior, transition, initial, observation)


@expects((("h",), "Gamma"))
def roundabout(m):
    """1 / sqrt(tau) by way of log and exp."""

    def prior():
        return {"h": Gamma(2, rate=1)}

    def transition(x, h):
        return {"x": Normal(x, sd=np.exp(-0.5 * np.log(h)))}

    laws(m, prior, transition)


@expects((("s",), "inverse Gamma of the square"))
def uniform_sd(m):
    def prior():
        return {"s": Uniform(0.1, 3)}

    def transition(x, s):
        return {"x": Normal(0.9 * x, sd=s)}

    laws(m, prior, transition)


@expects((("s",), "inverse Gamma of the square"), corrections=["s**2"])
def half_normal_sd(m):
    def prior():
        return {"s": HalfNormal(sd=1)}

    def transition(x, s):
        return {"x": Normal(0.9 * x, variance=s**2)}

    laws(m, prior, transition)


@expects((("s",), "inverse Gamma of the square"), corrections=["log(1 + s**2)"])
def half_cauchy_sd(m):
    def prior():
        return {"s": HalfCauchy(scale=1)}

    def transition(x, s):
        return {"x": Normal(np.sin(x), sd=s)}

    laws(m, prior, transition)


@expects((("q",), "inverse Gamma"), (("r",), "inverse Gamma"))
def two_variances(m):
    def prior():
        return {"q": InverseGamma(2, scale=1), "r": InverseGamma(np.array(3.0), scale=2)}

    def transition(x, q, t):
        return {"x": Normal(0.5 * x + 8 * np.cos(1.2 * t), sd=np.sqrt(q))}

    def observation(x, r):
        return {"y": Normal(0.05 * x**2, variance=r)}

    laws(m, prior, transition, None, observation)


@expects((("tau",), "Gamma", 2))
def vector_precision(m):
    """Two independent states; one precision each, drawn apart."""

    def prior():
        return {"tau": Gamma(np.array([2.0, 3.0]), rate=1)}

    def initial():
        return {"x": Normal(np.zeros(2), sd=1)}

    def transition(x, tau):
        return {"x": Normal(x, precision=tau)}

    def observation(x):
        return {"y": Normal(x, sd=1)}

    laws(m, prior, transition, initial, observation)


# -- regressions
@expects((("beta", "sigma"), "Normal-inverse-Gamma"))
@with_inputs(u=2)
def regression(m):
    """A flat prior on the coefficients: joint with the standard deviation."""

    def prior():
        return {"beta": Flat((2,)), "sigma": InverseGamma(3, scale=1)}

    def transition(x):
        return {"x": Normal(0.8 * x, sd=0.5)}

    def observation(x, beta, sigma, u):
        return {"y": Normal(x + beta @ u, variance=sigma)}

    laws(m, prior, transition, None, observation)


@expects((("a", "b"), "joint Normal"), (("tau",), "Gamma"))
@with_inputs(u=None)
def input_gain(m):
    def prior():
        return {"a": Uniform(-1, 1), "b": Normal(0, sd=1), "tau": Gamma(2, rate=1)}

    def transition(x, a, b, tau, u):
        return {"x": Normal(a * x + b * u, precision=tau)}

    laws(m, prior, transition)


@expects((("b", "tau"), NG))
@with_inputs(u=None)
def scaled_prior(m):
    """A prior that the precision scales, declared in a hierarchy: jointly conjugate."""

    def first():
        return {"tau": Gamma(2, rate=1)}

    def prior(tau):
        return {"b": Normal(0.5, precision=4 * tau)}

    def transition(x, b, tau, u):
        return {"x": Normal(0.5 * x + b * u, precision=tau)}

    m.prior(first)
    laws(m, prior, transition)


@expects((("g", "tau"), NG))
def both_laws(m):
    """A gain in the transition and in the observation, one precision for both."""

    def prior():
        return {"g": Uniform(-3, 3), "tau": Gamma(3, rate=1)}

    def transition(x, g, tau):
        return {"x": Normal(g * np.tanh(x), precision=tau)}

    def observation(x, g, tau):
        return {"y": Normal(2 - g * x / 3, precision=tau / 4)}

    laws(m, prior, transition, None, observation)


# -- hierarchies
@expects((("mu", "a"), "joint Normal"), (("lam",), "Gamma"))
def hierarchy(m):
    def hyper():
        return {"mu": Normal(0, sd=2), "lam": Gamma(2, rate=1)}

    def prior(mu, lam):
        return {"a": Normal(mu + np.zeros(2), precision=lam)}

    def initial():
        return {"x": Normal(np.zeros(2), sd=1)}

    def transition(x, a):
        return {"x": Normal(a * x, sd=1)}

    def observation(x):
        return {"y": Normal(x, sd=1)}

    m.prior(hyper)
    laws(m, prior, transition, initial, observation)


@expects((("rate",), "Gamma"), (("tau",), "Gamma"))
def gamma_rate(m):
    def hyper():
        return {"rate": Exponential(1.0)}

    def prior(rate):
        return {"tau": Gamma(2, rate=rate)}

    def transition(x, tau):
        return {"x": Normal(x, precision=tau)}

    m.prior(hyper)
    laws(m, prior, transition)


# -- other laws
@expects((("p",), "Beta"))
def detection(m):
    def prior():
        return {"p": Beta(2, 3)}

    def transition(x):
        return {"x": Normal(x, sd=1)}

    def observation(x, p):
        return {"y": Normal(x, sd=1), "seen_by": Bernoulli(p), "count": Binomial(7, 1 - p)}

    laws(m, prior, transition, None, observation)


@expects((("lam",), "Gamma"))
@with_inputs(exposure=None)
def exposure(m):
    def prior():
        return {"lam": Gamma(2, rate=1)}

    def transition(x):
        return {"x": Normal(x, sd=0.3)}

    def observation(x, lam, exposure):
        return {"y": Poisson(exposure * lam * np.exp(x))}

    laws(m, prior, transition, None, observation)


@expects((("rows0",), "Dirichlet"), (("rows1",), "Dirichlet"), (("level",), "joint Normal"))
def hidden_markov(m):
    def prior():
        return {
            "rows0": Dirichlet([2.0, 1.0]),
            "rows1": Dirichlet([1.0, 2.0]),
            "level": Normal(np.zeros(2), sd=2),
        }

    def initial():
        return {"x": Categorical([0.5, 0.5])}

    def transition(x, rows0, rows1):
        return {"x": Categorical(np.stack([rows0, rows1])[x])}

    def observation(x, level):
        return {"y": Normal(level[0] + level[1] * x, sd=1)}

    laws(m, prior, transition, initial, observation)


@expects((("p",), "Dirichlet"))
def three_classes(m):
    def prior():
        return {"p": Dirichlet([1.5, 1.0, 2.0])}

    def transition(x):
        return {"x": Normal(x, sd=1)}

    def observation(x, p):
        return {"y": Normal(x, sd=1), "kind": Categorical(p)}

    laws(m, prior, transition, None, observation)


@expects((("mu", "tau"), NG))
def log_normal(m):
    def prior():
        return {"mu": Flat(), "tau": Gamma(2, rate=1)}

    def transition(x):
        return {"x": Normal(0.5 * x, sd=1)}

    def observation(x, mu, tau):
        return {"y": LogNormal(mu + x, sd=tau**-0.5)}

    laws(m, prior, transition, None, observation)


@expects((("lam",), "Gamma"))
def exponential(m):
    def prior():
        return {"lam": Gamma(2, rate=2)}

    def transition(x):
        return {"x": Normal(0.5 * x, sd=1)}

    def observation(x, lam):
        return {"y": Exponential(lam * np.exp(-x))}

    laws(m, prior, transition, None, observation)


@expects((("scale",), "inverse Gamma"))
def gamma_scale(m):
    def prior():
        return {"scale": InverseGamma(3, scale=2)}

    def transition(x):
        return {"x": LogNormal(0.5 * np.log(x), sd=1)}

    def initial():
        return {"x": LogNormal(0, sd=1)}

    def observation(x, scale):
        return {"y": Gamma(2.5, scale=x * scale)}

    laws(m, prior, transition, initial, observation)


@expects((("level",), "Normal"), (("tau",), "Gamma"))
def vector_observation(m):
    """A shared level in two channels, whose components are missing one by one."""

    def prior():
        return {"level": Truncated(Normal(0, sd=2), lower=0.2), "tau": Gamma(2, rate=1)}

    def transition(x):
        return {"x": Normal(0.5 * x, sd=1)}

    def observation(x, level, tau):
        return {"y": Normal(level + np.array([1.0, -1.0]) * x, precision=tau)}

    laws(m, prior, transition, None, observation)


@expects((("lower",), "slice"), (("upper",), "Normal"))
def bounds_by_a_parameter(m):
    """A prior bounded by another parameter, whose own conditional it bounds in turn."""

    def first():
        return {"lower": Normal(0, sd=1)}

    def prior(lower):
        return {"upper": Uniform(lower, 5)}

    def transition(x, lower, upper):
        return {"x": Normal(lower + (upper - lower) * np.tanh(x) ** 2, sd=1)}

    m.prior(first)
    laws(m, prior, transition)


@expects((("a",), "Normal"), (("b",), "Normal"))
def product(m):
    """Each enters linearly, the two together do not."""

    def prior():
        return {"a": Normal(1, sd=1), "b": Normal(1, sd=1)}

    def transition(x, a, b):
        return {"x": Normal(a * b * x, sd=1)}

    laws(m, prior, transition)


@expects((("p",), "Beta"))
def transition_probability(m):
    """A hidden switch that is left with probability p, written with np.where."""

    def prior():
        return {"p": Uniform(0, 1)}

    def initial():
        return {"x": Bernoulli(0.5)}

    def transition(x, p):
        return {"x": Bernoulli(np.where(x == 1, 1 - p, p))}

    def observation(x):
        return {"y": Normal(x, sd=1)}

    laws(m, prior, transition, initial, observation)


@expects((("r",), "slice"), (("mean",), "slice"))
def negative_binomial(m):
    def prior():
        return {"r": Gamma(2, rate=1), "mean": Gamma(2, rate=1)}

    def transition(x):
        return {"x": Normal(0.5 * x, sd=1)}

    def observation(x, r, mean):
        return {"y": NegativeBinomial(mean * np.exp(x), dispersion=r)}

    laws(m, prior, transition, None, observation)


@expects((("scale",), "slice"))
def student(m):
    def prior():
        return {"scale": HalfNormal(sd=1)}

    def transition(x):
        return {"x": Normal(0.5 * x, sd=1)}

    def observation(x, scale):
        return {"y": StudentT(4, x, scale=scale)}

    laws(m, prior, transition, None, observation)


# -- vector autoregressions: a covariance or precision matrix, all coefficients jointly
MNIW = "matrix Normal-inverse-Wishart"


def two_states():
    return {"x": MvNormal(np.zeros(2), covariance=np.eye(2))}


@expects((("A", "B", "c"), "joint Normal"), (("Q",), "inverse Wishart"))
@with_inputs(u=2)
def vector_regression(m):
    def prior():
        return {
            "A": Normal(np.zeros((2, 2)), sd=1),
            "B": Normal(np.zeros((2, 2)), sd=2),
            "c": MvNormal(np.zeros(2), covariance=np.eye(2) + 0.3),
            "Q": InverseWishart(5, scale=np.eye(2)),
        }

    def transition(x, u, A, B, c, Q):
        return {"x": MvNormal(A @ x + B @ u + c, covariance=Q)}

    laws(m, prior, transition, two_states)


@expects((("a", "c"), "joint Normal"), (("Q",), "inverse Wishart"))
def vector_by_rows(m):
    """A as one vector with a joint prior, the noise by its Cholesky factor."""

    def prior():
        return {
            "a": MvNormal(np.zeros(4), covariance=np.eye(4) + 0.2),
            "c": Normal(np.zeros(2), sd=1),
            "Q": InverseWishart(5, scale=np.eye(2)),
        }

    def transition(x, a, c, Q):
        mean = [a[2 * i] * x[0] + a[2 * i + 1] * x[1] + c[i] for i in range(2)]
        return {"x": MvNormal(np.stack(mean), cholesky=np.linalg.cholesky(Q))}

    laws(m, prior, transition, two_states)


@expects((("Q",), "inverse Wishart"))
def noise_through_a_matrix(m):
    """The covariance L Q L' with known L, and blocks of Q by a Kronecker product."""

    def prior():
        return {"Q": InverseWishart(5, scale=np.eye(2))}

    def initial(Q):
        return {"x": MvNormal(np.zeros(4), covariance=np.kron(np.array([[2.0, 0.5], [0.5, 1]]), Q))}

    def transition(x, Q):
        root = np.array([[1.0, 0.0], [0.5, 2.0]])
        both = np.kron(np.eye(2), root)
        return {"x": MvNormal(0.5 * x, covariance=both @ np.kron(np.eye(2), 3 * Q) @ both.T)}

    laws(m, prior, transition, initial)


@expects((("a0", "a1", "Q"), MNIW))
def conjugate_columns(m):
    """The columns of A have Q, times a number, as their prior covariance."""

    def first():
        return {"Q": InverseWishart(5, scale=np.array([[1.0, 0.3], [0.3, 2.0]]))}

    def prior(Q):
        return {
            "a0": MvNormal([0.5, 0.0], covariance=2 * Q),
            "a1": MvNormal([0.0, 0.5], precision=np.linalg.inv(Q)),
        }

    def transition(x, a0, a1, Q):
        return {"x": MvNormal(a0 * x[0] + a1 * x[1], covariance=Q)}

    m.prior(first)
    laws(m, prior, transition, two_states)


@expects((("a", "Q"), MNIW))
def conjugate_rows(m):
    """The same kind of prior on A's entries in a row: cov(A_ik, A_jl) = Q_ij V_kl."""

    def first():
        return {"Q": InverseWishart(5, scale=np.eye(2))}

    def prior(Q):
        spread = np.kron(Q, np.array([[1.0, 0.3], [0.3, 2.0]]))
        return {"a": MvNormal([0.5, 0, 0, 0.5], covariance=spread)}

    def initial(Q):
        return {"x": MvNormal(np.zeros(2), covariance=4 * Q)}

    def transition(x, a, Q):
        return {"x": MvNormal(np.reshape(a, (2, 2)) @ x, cholesky=np.linalg.cholesky(Q))}

    m.prior(first)
    laws(m, prior, transition, initial)


@expects((("A", "Q"), MNIW))
@with_inputs(dt=None)
def flat_coefficients(m):
    """A flat prior on A; the noise grows with the step."""

    def prior():
        return {"A": Flat((2, 2)), "Q": InverseWishart(5, scale=np.eye(2))}

    def transition(x, A, Q, dt):
        return {"x": MvNormal(A @ x, covariance=Q * dt)}

    laws(m, prior, transition, two_states)


@expects((("d", "P"), "matrix Normal-Wishart"))
@with_inputs(u=None)
def conjugate_precision(m):
    """In the observation, by precisions: some of its rows are missing."""

    def first():
        return {"P": Wishart(4, scale=np.eye(2) * 0.5)}

    def prior(P):
        return {"d": MvNormal([1.0, 2.0], precision=P / 3)}

    def transition(x):
        return {"x": Normal(0.5 * x, sd=1)}

    def observation(x, u, d, P):
        return {"y": MvNormal(x + d * u, precision=P)}

    m.prior(first)
    laws(m, prior, transition, None, observation)


@expects((("C", "d"), "joint Normal"), (("R",), "inverse Wishart"))
@with_inputs(u=None)
def observation_matrix(m):
    def prior():
        return {
            "C": Normal(np.zeros((2, 2)), sd=1),
            "d": Normal(np.zeros(2), sd=1),
            "R": InverseWishart(4, scale=np.eye(2)),
        }

    def transition(x):
        return {"x": Normal(0.5 * x, sd=1)}

    def observation(x, u, C, d, R):
        return {"y": MvNormal(C @ x + d * u, covariance=R)}

    laws(m, prior, transition, two_states, observation)


# -- equations that share parameters
def level_and_slope():
    return {"x": Normal(0, sd=1), "z": Normal(0, sd=1)}


@expects((("a", "b"), "joint Normal"), (("q",), "inverse Gamma"), (("r",), "inverse Gamma"))
def shared_coefficient(m):
    """a in the laws of two states and of the observation, each with a variance of its own."""

    def prior():
        return {
            "a": Normal(0, sd=1),
            "b": Normal(0, sd=1),
            "q": InverseGamma(3, scale=1),
            "r": InverseGamma(3, scale=1),
        }

    def transition(x, z, a, b, q, r):
        return {"x": Normal(a * x + b * z, variance=q), "z": Normal(z - a * z / 2, variance=r)}

    def observation(x, z, a, r):
        return {"y": Normal(x + a * z, variance=2 * r)}

    laws(m, prior, transition, level_and_slope, observation)


@expects((("a", "q"), "Normal-inverse-Gamma"))
def shared_variance(m):
    def prior():
        return {"a": Flat(), "q": InverseGamma(3, scale=1)}

    def transition(x, z, a, q):
        return {"x": Normal(a * x, variance=q), "z": Normal(a + z, sd=np.sqrt(2 * q))}

    laws(m, prior, transition, level_and_slope)


@expects((("tau",), "Gamma"))
def random_walk(m):
    """The precision of a random walk, shared by its vague initial law."""

    def prior():
        return {"tau": Gamma(2, rate=1)}

    def initial(tau):
        return {"x": Normal(0, sd=10 / np.sqrt(tau))}

    def transition(x, tau):
        return {"x": Normal(x, precision=tau)}

    laws(m, prior, transition, initial)


# -- rows of a transition matrix, chosen in many ways
def three_values():
    return {"x": Categorical(np.ones(3) / 3)}


def rows_prior():
    return {f"row{i}": Dirichlet(1.0 + np.eye(3)[i]) for i in range(3)}


ROWS = tuple(((f"row{i}",), "Dirichlet") for i in range(3))


@expects(*ROWS)
def rows_by_where(m):
    def transition(x, row0, row1, row2):
        return {"x": Categorical(np.where(x == 0, row0, np.where(x == 1, row1, row2)))}

    laws(m, rows_prior, transition, three_values)


@expects(*ROWS)
def rows_by_index(m):
    def transition(x, row0, row1, row2):
        return {"x": Categorical(np.stack([row0, row1, row2])[x, :])}

    laws(m, rows_prior, transition, three_values)


@expects(*((("P",), "Dirichlet") for _ in range(3)))
def rows_of_a_matrix(m):
    """One parameter, each of whose rows is a block of its own."""

    def transition(x, P):
        return {"x": Categorical(P[x])}

    laws(m, lambda: {"P": Dirichlet(1.0 + np.eye(3))}, transition, three_values)


@expects(*ROWS)
def rows_by_indicators(m):
    """A sum over the values that the state may have, of which one counts."""

    def transition(x, row0, row1, row2):
        chosen = np.stack([np.where(x == k, 1.0, 0.0) for k in range(3)])
        return {"x": Categorical(chosen @ np.stack([row0, row1, row2]))}

    laws(m, rows_prior, transition, three_values)


@expects((("stay",), "Beta"), (("kind0",), "Dirichlet"), (("kind1",), "Dirichlet"))
def stay_or_leave(m):
    """One probability of staying, the rest shared out; a Dirichlet law for what each shows."""

    def prior():
        return {
            "stay": Beta(3, 2),
            "kind0": Dirichlet([1.0, 2.0, 1.0]),
            "kind1": Dirichlet([2.0, 1.0, 1.0]),
        }

    def transition(x, stay):
        return {"x": Bernoulli(np.where(x == 1, stay, 1 - stay))}

    def observation(x, kind0, kind1):
        return {"y": Categorical((x == 0) * kind0 + (x == 1) * kind1)}

    def initial():
        return {"x": Bernoulli(0.5)}

    laws(m, prior, transition, initial, observation)


@expects((("mu",), "joint Normal"), (("v",), "inverse Gamma", 2), (("stay",), "Beta"))
def regimes(m):
    """Mean and variance chosen by a switch."""

    def prior():
        return {
            "mu": Normal(np.zeros(2), sd=3),
            "v": InverseGamma(np.array([3.0, 4.0]), scale=1),
            "stay": Beta(3, 2),
        }

    def transition(x, stay):
        return {"x": Bernoulli(np.where(x < 0.5, 1 - stay, stay))}

    def observation(x, mu, v):
        return {"y": Normal(mu[x], variance=np.where(x == 1, v[1], v[0]))}

    def initial():
        return {"x": Bernoulli(0.5)}

    laws(m, prior, transition, initial, observation)


# -- counts: detection and survival, exposure in a state
@expects((("p",), "Beta"), (("s",), "Beta"))
def thinned_counts(m):
    def prior():
        return {"p": Beta(2, 2), "s": Uniform(0.2, 0.9)}

    def initial():
        return {"x": Binomial(20, 0.5)}

    def transition(x, s):
        return {"x": Binomial(x, s)}

    def observation(x, p):
        return {"y": Binomial(x, 1 - p)}

    laws(m, prior, transition, initial, observation)


@expects((("lam",), "Gamma", 2))
def exposed_state(m):
    def prior():
        return {"lam": Gamma(np.array([2.0, 3.0]), rate=1)}

    def initial():
        return {"x": LogNormal(0, sd=1)}

    def transition(x):
        return {"x": LogNormal(0.5 * np.log(x), sd=1)}

    def observation(x, lam):
        return {"y": Poisson(lam[0] * x), "n": Poisson(np.exp(np.log(lam[1]) + np.log(x)))}

    laws(m, prior, transition, initial, observation)


# -- rates and scales of positive laws
@expects((("b",), "Gamma"), (("v",), "inverse Gamma", 2), (("w",), "inverse Gamma"))
def scales_of_scales(m):
    """The scale of inverse Gamma priors, and of an exponential and a Gamma law."""

    def first():
        return {"b": Gamma(2, rate=1), "w": InverseGamma(3, scale=2)}

    def prior(b):
        return {"v": InverseGamma(np.array([2.0, 3.0]), scale=b)}

    def initial():
        return {"x": LogNormal(0, sd=1)}

    def transition(x, v):
        return {"x": LogNormal(0.5 * np.log(x), sd=np.sqrt(v[0]))}

    def observation(x, v, w):
        return {
            "y": LogNormal(np.log(x), sd=np.exp(np.log(v[1]) / 2)),
            "gap": Exponential(scale=w * x),
            "size": Gamma(2.5, rate=2.5 / (w * x)),
        }

    m.prior(first)
    laws(m, prior, transition, initial, observation)


@expects((("b",), "Gamma"), (("Q",), "inverse Wishart"))
def scale_of_a_covariance(m):
    def first():
        return {"b": Gamma(2, rate=1)}

    def prior(b):
        return {"Q": InverseWishart(5, scale=b * np.array([[1.0, 0.2], [0.2, 1.0]]))}

    def transition(x, Q):
        return {"x": MvNormal(0.5 * x, covariance=Q)}

    m.prior(first)
    laws(m, prior, transition, two_states)
