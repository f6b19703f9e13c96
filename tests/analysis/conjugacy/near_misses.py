"""Models that look conjugate and are not, or not wholly; and what must be said of them.

Each function declares a model and its mark says: parameter, family of its update, text of the
source line that the reason must point to, words of the reason.
"""

import numpy as np

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
    HalfNormal,
    InverseGamma,
    InverseWishart,
    Laplace,
    LogNormal,
    MvNormal,
    Normal,
    Poisson,
    StudentT,
    Truncated,
    Uniform,
    Wishart,
)
from ssmppl.language.model.model import Model
from tests.analysis.conjugacy.corpus import laws, with_inputs

NEAR_MISSES = {}


def refused(parameter, family, line, *words):
    def register(declare):
        NEAR_MISSES[declare.__name__] = (declare, parameter, family, line, words)
        return declare

    return register


def build(name):
    declare, *expected = NEAR_MISSES[name]
    model = Model(name, inputs=getattr(declare, "inputs", ()))
    declare(model)
    return model, *expected


def normal_prior():
    return {"a": Normal(0.5, sd=1)}


def gamma_prior():
    return {"a": Gamma(2, rate=1)}


def walk(x):
    return {"x": Normal(0.5 * x, sd=1)}


@refused("a", "slice", "Normal(a * x, sd=np.exp(a))", "transition of x", "exp(a)")
def in_two_places(m):
    """In the mean and in the spread."""

    def transition(x, a):
        return {"x": Normal(a * x, sd=np.exp(a))}

    laws(m, normal_prior, transition)


@refused("a", "slice", "np.exp(a) * x", "transition of x", "exp(a)")
def exponential_in_disguise(m):
    def transition(x, a):
        return {"x": Normal(np.exp(a) * x, sd=1)}

    laws(m, normal_prior, transition)


@refused("a", "slice", "np.sin(a * x)", "sin(a*x_prev)", "does not separate")
def sine(m):
    def transition(x, a):
        return {"x": Normal(np.sin(a * x), sd=1)}

    laws(m, normal_prior, transition)


@refused("a", "slice", "a**2 * x", "a**4")
def square(m):
    def transition(x, a):
        return {"x": Normal(a**2 * x, sd=1)}

    laws(m, normal_prior, transition)


@refused("a", "slice", "Truncated(Normal(a * x, sd=1), lower=0)", "transition of x")
def truncated_child(m):
    def initial():
        return {"x": Exponential(1.0)}

    def transition(x, a):
        return {"x": Truncated(Normal(a * x, sd=1), lower=0)}

    laws(m, normal_prior, transition, initial)


@refused("a", "slice", "Truncated(Normal(a, sd=1), lower=0)", "observation of y")
def truncated_child_of_the_parameter_alone(m):
    """Separable, as a function of the parameter alone that grows with the series."""

    def observation(x, a):
        return {"y": Truncated(Normal(a, sd=1), lower=0)}

    laws(m, normal_prior, walk, None, observation)


@refused("a", "slice", "Uniform(0, a)", "bounds the support of y")
def bound(m):
    """log(a) alone looks like a Gamma; the support says a > max y."""

    def prior():
        return {"a": Gamma(2, rate=0.5)}

    def observation(x, a):
        return {"y": Uniform(0, a)}

    laws(m, prior, walk, None, observation)


@refused("a", "slice", "lower=x - a", "bounds the support of x")
def truncation_point(m):
    def transition(x, a):
        return {"x": Truncated(Normal(x, sd=1), lower=x - a)}

    laws(m, gamma_prior, transition)


@refused(
    "a",
    "Normal",
    "Normal(0, variance=1 / (1 - a**2))",
    "initial distribution of x",
    "log(1 - a**2)",
)
def stationary_start(m):
    """Corrected: the initial law counts."""

    def prior():
        return {"a": Uniform(-1, 1)}

    def initial(a):
        return {"x": Normal(0, variance=1 / (1 - a**2))}

    def transition(x, a):
        return {"x": Normal(a * x, sd=1)}

    laws(m, prior, transition, initial)


@refused("a", "Normal", "Normal(np.exp(a), sd=1)", "initial distribution of x", "exp(a)")
def initial_mean(m):
    """Corrected by a Metropolis step: exp(a) x_1 has no upper bound."""

    def initial(a):
        return {"x": Normal(np.exp(a), sd=1)}

    def transition(x, a):
        return {"x": Normal(a * x, sd=1)}

    laws(m, normal_prior, transition, initial)


@refused("a", "slice", "Normal(x + u**a, sd=1)", "does not separate")
@with_inputs(u=None)
def through_an_input(m):
    def transition(x, a, u):
        return {"x": Normal(x + u**a, sd=1)}

    laws(m, normal_prior, transition)


@refused("a", "slice", "StudentT(4, x, scale=a)", "observation of y")
def student_scale(m):
    def observation(x, a):
        return {"y": StudentT(4, x, scale=a)}

    laws(m, gamma_prior, walk, None, observation)


@refused("a", "slice", "Bernoulli(1 / (1 + np.exp(-a * x)))", "observation of y")
def logistic_regression(m):
    def observation(x, a):
        return {"y": Bernoulli(1 / (1 + np.exp(-a * x)))}

    laws(m, normal_prior, walk, None, observation)


@refused("a", "slice", "variance=a", "1/a", "a**(-2)", "observation of y")
def different_powers(m):
    """A standard deviation of one law and the variance of another."""

    def transition(x, a):
        return {"x": Normal(x, variance=a)}

    def observation(x, a):
        return {"y": Normal(x, sd=a)}

    laws(m, gamma_prior, transition, None, observation)


@refused("a", "slice", "sd=np.sqrt(a**2)", "no density", "split as if")
def absolute_value(m):
    """|a| in disguise: the splitting of the root is refused by the check."""

    def prior():
        return {"a": Normal(0, sd=1)}

    def transition(x, a):
        return {"x": Normal(0.5 * x, sd=np.sqrt(a**2))}

    laws(m, prior, transition)


@refused("a", "slice", "Normal(np.sqrt(a**2) * x, sd=1)", "disagrees", "split as if")
def absolute_mean(m):
    def prior():
        return {"a": Normal(0, sd=1)}

    def transition(x, a):
        return {"x": Normal(np.sqrt(a**2) * x, sd=1)}

    laws(m, prior, transition)


@refused("a", "slice", "precision=a + x**2", "transition of x")
def shifted_precision(m):
    def transition(x, a):
        return {"x": Normal(x, precision=a + x**2)}

    laws(m, gamma_prior, transition)


@refused("a", "slice", "Laplace(a * x, scale=1)", "transition of x")
def laplace_location(m):
    def transition(x, a):
        return {"x": Laplace(a * x, scale=1)}

    laws(m, normal_prior, transition)


@refused("a", "slice", "Gamma(a, rate=1)", "gammaln(a)", "observation of y")
def gamma_shape(m):
    def observation(x, a):
        return {"y": Gamma(a, rate=1)}

    laws(m, gamma_prior, walk, None, observation)


@refused("a", "slice", "Poisson(a + np.exp(x))", "observation of y")
def added_rate(m):
    """A rate that is added to another, not multiplied."""

    def observation(x, a):
        return {"y": Poisson(a + np.exp(x))}

    laws(m, gamma_prior, walk, None, observation)


@refused("a", "slice", "Normal(x, precision=a)", "full conditional contains")
def negative_precision(m):
    """A precision whose prior reaches below zero is no Gamma."""

    def transition(x, a):
        return {"x": Normal(x, precision=a)}

    laws(m, normal_prior, transition)


@refused("a", "slice", "Dirac(a * x)", "Dirac", "determines")
def deterministic(m):
    def initial():
        return {"x": Normal(0, sd=1), "z": Normal(0, sd=1)}

    def transition(x, z, a):
        return {"x": Dirac(a * x), "z": Normal(z + x, sd=1)}

    laws(m, normal_prior, transition, initial)


@refused("a", "Gamma", "Beta(a, 2)", "prior distribution of p", "betaln")
def child_of_a_hierarchy(m):
    """Corrected by a Metropolis step: one term, however long the series."""

    def first():
        return {"a": Gamma(2, rate=1)}

    def prior(a):
        return {"p": Beta(a, 2)}

    def observation(x, p):
        return {"y": Bernoulli(p)}

    m.prior(first)
    laws(m, prior, walk, None, observation)


@refused("a", "Gamma", "HalfNormal(sd=1)", "a**2")
def half_normal_precision(m):
    """Corrected: the prior is no Gamma, and grows not with the series."""

    def prior():
        return {"a": HalfNormal(sd=1)}

    def transition(x, a):
        return {"x": Normal(x, precision=a)}

    laws(m, prior, transition)


@refused("a", "inverse Gamma", "Gamma(2, rate=1)", "prior distribution of a")
def gamma_on_a_variance(m):
    def transition(x, a):
        return {"x": Normal(x, variance=a)}

    laws(m, gamma_prior, transition)


@refused("q", "inverse Gamma", "InverseGamma(2, scale=1)")
def semi_conjugate(m):
    """A Normal prior not scaled by the variance: Normal and inverse Gamma, not joint."""

    def prior():
        return {"b": Normal(0, sd=1), "q": InverseGamma(2, scale=1)}

    def transition(x, b, q):
        return {"x": Normal(b * x, variance=q)}

    laws(m, prior, transition)


# -- of vectors and matrices
def two_states():
    return {"x": Normal(np.zeros(2), sd=1)}


def noise_prior():
    return {"Q": InverseWishart(5, scale=np.eye(2))}


def damped(x, Q):
    return {"x": MvNormal(0.5 * x, covariance=Q)}


def stationary(m):
    """x_1 has the covariance that A = diag(a) and Q settle at: S = A S A' + Q."""

    def prior():
        return {"a": Normal(np.zeros(2), sd=0.4), "Q": InverseWishart(5, scale=np.eye(2))}

    def initial(a, Q):
        return {"x": MvNormal(np.zeros(2), covariance=Q / (1 - np.outer(a, a)))}

    def transition(x, a, Q):
        return {"x": MvNormal(np.diag(a) @ x, covariance=Q)}

    laws(m, prior, transition, initial)


@refused("a", "joint Normal", "covariance=Q / (1 - np.outer(a, a))", "initial of x", "logdet")
def stationary_coefficients(m):
    """Corrected: the initial law counts, though it does not separate."""
    stationary(m)


@refused("Q", "inverse Wishart", "covariance=Q / (1 - np.outer(a, a))", "initial of x", "logdet")
def stationary_covariance(m):
    stationary(m)


@refused("Q", "inverse Wishart", "Wishart(5, scale=np.eye(2))", "prior distribution of Q")
def wishart_on_a_covariance(m):
    def prior():
        return {"Q": Wishart(5, scale=np.eye(2))}

    laws(m, prior, damped, two_states)


@refused("Q", "slice", "covariance=Q + 0.1 * np.eye(2)", "transition of x", "inverse(")
def covariance_with_a_nugget(m):
    def transition(x, Q):
        return {"x": MvNormal(0.5 * x, covariance=Q + 0.1 * np.eye(2))}

    laws(m, noise_prior, transition, two_states)


@refused("Q", "slice", "variance=b @ Q @ b", "observation of y")
def variance_of_a_projection(m):
    """One number made of Q: its inverse is no part of Q's."""

    def observation(x, Q):
        b = np.array([1.0, 0.5])
        return {"y": Normal(x[0], variance=b @ Q @ b)}

    laws(m, noise_prior, damped, two_states, observation)


@refused("Q", "inverse Wishart", "InverseWishart(5, scale=np.eye(2))")
def one_column_apart(m):
    """Prior of one column not scaled by Q: both conditionals are known, their joint is not."""

    def prior(Q):
        return {
            "a0": MvNormal(np.zeros(2), covariance=2 * Q),
            "a1": MvNormal(np.zeros(2), covariance=np.eye(2)),
        }

    def transition(x, a0, a1, Q):
        return {"x": MvNormal(a0 * x[0] + a1 * x[1], covariance=Q)}

    m.prior(noise_prior)
    laws(m, prior, transition, two_states)


@refused("Q", "inverse Wishart", "InverseWishart(5, scale=np.eye(2))")
def regressors_of_their_own(m):
    """As many coefficients in each equation, but of different regressors."""

    def prior():
        return {"a": Flat((2,)), "Q": InverseWishart(5, scale=np.eye(2))}

    def transition(x, a, Q):
        return {"x": MvNormal(a * x, covariance=Q)}

    laws(m, prior, transition, two_states)


@refused("Q", "inverse Wishart", "InverseWishart(5, scale=np.eye(2))")
def rows_of_different_scale(m):
    """A prior covariance of A that holds Q, but not as Q (x) V."""

    def prior(Q):
        scale = np.diag([1.0, 1.0, 2.0, 2.0])
        spread = scale @ np.kron(Q, np.eye(2)) @ scale
        return {"a": MvNormal(np.zeros(4), covariance=spread)}

    def transition(x, a, Q):
        return {"x": MvNormal(np.reshape(a, (2, 2)) @ x, covariance=Q)}

    m.prior(noise_prior)
    laws(m, prior, transition, two_states)


@refused("b", "Normal", "Cauchy(mu, scale=1)", "prior of b", "log1p")
def cauchy_around_another(m):
    """Corrected by the log joint: the prior ties b to mu inside a logarithm."""

    def first():
        return {"mu": Normal(0, sd=1)}

    def prior(mu):
        return {"b": Cauchy(mu, scale=1)}

    def transition(x, b):
        return {"x": Normal(b * x, sd=1)}

    m.prior(first)
    laws(m, prior, transition)


@refused("a", "slice", "Normal(a**2 * z, sd=1)", "transition of z", "a**4")
def squared_elsewhere(m):
    """Linear in one equation, squared in the other."""

    def initial():
        return {"x": Normal(0, sd=1), "z": Normal(0, sd=1)}

    def transition(x, z, a):
        return {
            "x": Normal(a * x, sd=1),
            "z": Normal(a**2 * z, sd=1),
        }

    laws(m, normal_prior, transition, initial)


# -- of probabilities, counts and positive numbers
@refused("p", "slice", "Categorical(0.9 * p + 0.1 / 3)", "observation of y", "log(")
def contaminated_classes(m):
    def prior():
        return {"p": Dirichlet([2.0, 1.0, 1.5])}

    def observation(x, p):
        return {"y": Categorical(0.9 * p + 0.1 / 3)}

    laws(m, prior, walk, None, observation)


@refused("p", "slice", "Binomial(5, p * q)", "observation of y")
def detection_of_the_present(m):
    """Present with q, seen with p: only their product is a probability of the law."""

    def prior():
        return {"p": Beta(2, 2), "q": Beta(2, 2)}

    def observation(x, p, q):
        return {"y": Binomial(5, p * q)}

    laws(m, prior, walk, None, observation)


@refused("v", "slice", "LogNormal(x - v / 2, sd=np.sqrt(v))", "observation of y")
def mean_of_a_log_normal(m):
    """The variance is in the mean as well: v beside 1 / v."""

    def prior():
        return {"v": InverseGamma(3, scale=1)}

    def observation(x, v):
        return {"y": LogNormal(x - v / 2, sd=np.sqrt(v))}

    laws(m, prior, walk, None, observation)


@refused("q", "slice", "variance=q + 0.5", "observation of y")
def added_variance(m):
    """The variance of a step, and of the same step seen with noise."""

    def prior():
        return {"q": InverseGamma(3, scale=1)}

    def transition(x, q):
        return {"x": Normal(x, variance=q)}

    def observation(x, q):
        return {"y": Normal(x, variance=q + 0.5)}

    laws(m, prior, transition, None, observation)


@refused("b", "slice", "Gamma(b, rate=b)", "gammaln(b)", "observation of y")
def shape_and_rate(m):
    def prior():
        return {"b": Gamma(2, rate=1)}

    def observation(x, b):
        return {"y": Gamma(b, rate=b)}

    laws(m, prior, walk, None, observation)
