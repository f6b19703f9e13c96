"""Bad constructions: a ModelError at the user's line, with what was found and the fix."""

import linecache
import pickle

import numpy as np
import pytest

import ssmppl as ssm
import ssmppl.language.distributions as D
from ssmppl.errors import ModelError, UnsupportedOperation
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import symbol

X = symbol("state", "x")
V = array([X, X + 1.0])
I2 = np.eye(2)

# (what is written, what the message must say, what the fix must say)
BAD = [
    # the spread: none, two, without its name, under a wrong name
    (lambda: D.Normal(0), "exactly one of sd=, variance=, precision=; found none", "sd="),
    (lambda: D.Normal(0, sd=1, variance=1), "found sd=, variance=", "name the spread"),
    (lambda: D.Normal(0, 1), "Normal takes its spread by name: sd=, variance= or precision=",
     "write Normal(0, sd=1), or variance= or precision="),
    (lambda: D.Normal(X, 1, 2), "by name: sd=, variance= or precision=", "Normal(mean, sd=...)"),
    (lambda: D.Normal(3 * X + 2 * X**2 + X**3 + 4 * X**4 + X**5, 1), "by name: sd=",
     "Normal(mean, sd=...)"),
    (lambda: D.Normal(X, 1, variance=2), "by name: sd=", "Normal(mean, sd=...)"),
    (lambda: D.Normal(0, std=1), "'std'", "sd"),
    (lambda: D.Normal(0, sigma=1), "'sigma'", "write sd="),
    (lambda: D.Normal(), "missing a required argument: 'mean'", "Normal(mean, sd="),
    (lambda: D.Normal(sd=1), "missing a required argument: 'mean'", "mean"),
    (lambda: D.LogNormal(0, 1), "takes its spread by name: sd=", "LogNormal(0, sd=1)"),
    (lambda: D.LogNormal(0), "missing a required argument: 'sd'", "sd="),
    (lambda: D.StudentT(3, X, 1), "takes its spread by name: scale=",
     "write StudentT(3, x, scale=1)"),
    (lambda: D.Laplace(0, 1), "takes its spread by name: scale=", "scale="),
    (lambda: D.Cauchy(0, 1), "takes its spread by name: scale=", "scale="),
    (lambda: D.HalfNormal(1), "takes its spread by name: sd=", "HalfNormal(sd=1)"),
    (lambda: D.HalfCauchy(1), "takes its spread by name: scale=", "scale="),
    (lambda: D.Gamma(1, 1), "takes its spread by name: rate= or scale=", "rate="),
    (lambda: D.Gamma(1), "exactly one of rate=, scale=", "rate="),
    (lambda: D.Gamma(1, rate=1, scale=1), "found rate=, scale=", "name the spread"),
    (lambda: D.Exponential(), "exactly one of rate=, scale=", "rate="),
    (lambda: D.Exponential(1, scale=2), "found rate=, scale=", "name the spread"),
    (lambda: D.InverseGamma(1, 1), "takes its spread by name: scale=", "scale="),
    (lambda: D.MvNormal(V, I2), "by name: covariance=, precision= or cholesky=", "covariance="),
    (lambda: D.MvNormal(V), "exactly one of covariance=, precision=, cholesky=", "covariance="),
    (lambda: D.Wishart(5, I2), "takes its spread by name: scale=", "scale="),
    (lambda: D.NegativeBinomial(3, 1), "by name: dispersion=", "dispersion="),
    (lambda: D.Poisson(), "missing a required argument: 'rate'", "Poisson(rate)"),
    (lambda: D.Poisson(1, 2), "too many positional arguments", "Poisson(rate)"),
    (lambda: D.Truncated(D.Normal(0, sd=1), 0, 1), "takes its bounds by name: lower= or upper=",
     "lower="),
    # values out of range, under the user's names
    (lambda: D.Normal(0, sd=-1), "Normal: sd = -1 is outside (0, inf)", "give a sd inside"),
    (lambda: D.Normal(0, sd=0), "sd = 0 is outside", "sd"),
    (lambda: D.Normal(0, sd=[1, -2]), "sd = -2 is outside", "sd"),
    (lambda: D.Normal(0, variance=-1), "variance = -1 is outside", "variance"),
    (lambda: D.Normal(0, precision=0), "precision = 0 is outside", "precision"),
    (lambda: D.Normal(0, sd=np.inf), "sd = inf is outside", "sd"),
    (lambda: D.Normal(0, sd=np.nan), "sd is nan", "numbers"),
    (lambda: D.Normal(np.nan, sd=1), "Normal: mean is nan", "numbers"),
    (lambda: D.LogNormal(0, sd=0), "sd = 0", "sd"),
    (lambda: D.StudentT(0, 0, scale=1), "df = 0", "df"),
    (lambda: D.StudentT(1, 0, scale=-1), "scale = -1", "scale"),
    (lambda: D.Laplace(0, scale=0), "scale = 0", "scale"),
    (lambda: D.Cauchy(0, scale=-3), "scale = -3", "scale"),
    (lambda: D.HalfNormal(sd=-1), "sd = -1", "sd"),
    (lambda: D.HalfCauchy(scale=-1), "scale = -1", "scale"),
    (lambda: D.Exponential(-1), "rate = -1", "rate"),
    (lambda: D.Exponential(scale=0), "scale = 0", "scale"),
    (lambda: D.Gamma(-1, rate=1), "Gamma: shape = -1", "give a shape inside"),
    (lambda: D.Gamma(1, rate=0), "rate = 0", "rate"),
    (lambda: D.InverseGamma(0, scale=1), "InverseGamma: shape = 0", "give a shape inside"),
    (lambda: D.Beta(0, 1), "Beta: a = 0", "give a a inside"),
    (lambda: D.Beta(1, -1), "Beta: b = -1", "b"),
    (lambda: D.Dirichlet([1, 0]), "concentration = 0", "concentration"),
    (lambda: D.Dirichlet(1.0), "concentration has shape ()", "vector"),
    (lambda: D.Poisson(-1), "rate = -1 is outside [0, inf]", "rate"),
    (lambda: D.NegativeBinomial(-1, dispersion=1), "NegativeBinomial: mean = -1",
     "give a mean inside"),
    (lambda: D.NegativeBinomial(1, dispersion=0), "dispersion = 0", "dispersion"),
    (lambda: D.Binomial(-1, 0.5), "n = -1", "n"),
    (lambda: D.Binomial(2.5, 0.5), "n = 2.5 is no whole number", "whole"),
    (lambda: D.Binomial(3, 1.5), "p = 1.5 is outside [0, 1]", "p"),
    (lambda: D.Binomial(np.inf, 0.5), "n = inf", "whole"),
    (lambda: D.Bernoulli(-0.1), "p = -0.1", "p"),
    (lambda: D.Categorical([0.5, 0.6]), "p sums to 1.1", "divide p by its sum"),
    (lambda: D.Categorical([0.5, -0.5, 1.0]), "p = -0.5", "p"),
    (lambda: D.Categorical(0.5), "p has shape ()", "at least two"),
    (lambda: D.Categorical([1.0]), "p has shape (1,)", "at least two"),
    (lambda: D.Categorical(I2), "p has shape (2, 2)", "P[state]"),
    (lambda: D.Uniform(1, 0), "lower = 1 and upper = 0", "lower < upper"),
    (lambda: D.Uniform(1, 1), "lower = 1 and upper = 1", "lower < upper"),
    (lambda: D.Uniform(0, np.inf), "upper = inf", "ssm.Flat()"),
    (lambda: D.Uniform(-np.inf, X), "lower = -inf", "ssm.Flat()"),
    # shapes and kinds
    (lambda: D.Normal([0, 1], sd=[1, 2, 3]), "shapes do not agree: mean (2,), sd (3,)",
     "one shape"),
    (lambda: D.Gamma([1, 2], rate=[1, 2, 3]), "shape (2,), rate (3,)", "one shape"),
    (lambda: D.Normal("a", sd=1), "mean is 'a', which is no number or symbol", "numbers"),
    (lambda: D.Normal(None, sd=1), "mean is None", "numbers"),
    (lambda: D.Normal(1j, sd=1), "mean is 1j", "numbers"),
    (lambda: D.Normal(0, sd=D.Gamma(1, rate=1)), "sd is Gamma(shape=1, rate=1)", "numbers"),
    (lambda: D.Normal([[0, 1], [2]], sd=1), "mean is [[0, 1], [2]]", "numbers"),
    (lambda: D.MvNormal([0, 0], covariance=[[1, 2], [2, 1]]), "covariance is not positive definite",
     "ssm.Dirac"),
    (lambda: D.MvNormal([0, 0], covariance=[[1, 0.5], [0.2, 1]]), "covariance is not symmetric",
     "entries"),
    (lambda: D.MvNormal([0, 0], covariance=[[1, X], [0, 1]]),
     "covariance is not symmetric: its entry [1, 0] is 0, and [0, 1] is x", "both the same"),
    (lambda: D.InverseWishart(5, scale=[[1, X], [X**2, 1]]), "its entry [1, 0] is x**2", "same"),
    (lambda: D.MvNormal([0, 0], precision=np.zeros((2, 2))), "precision is not positive definite",
     "entries"),
    (lambda: D.MvNormal([0, 0], covariance=[1, 2]), "covariance has shape (2,)", "square"),
    (lambda: D.MvNormal([0, 0, 0], covariance=I2), "mean has shape (3,), covariance (2, 2)",
     "(d, d)"),
    (lambda: D.MvNormal(V, cholesky=[[1, 0.5], [0.5, 1]]), "cholesky is not lower triangular",
     "np.linalg.cholesky"),
    (lambda: D.MvNormal(V, cholesky=[[-1, 0], [0, 1]]), "cholesky is not positive definite",
     "entries"),
    (lambda: D.MvNormal([[0, 0]], covariance=I2), "mean has shape (1, 2)", "(d,)"),
    (lambda: D.Wishart(0.5, scale=I2), "df = 0.5 is outside (1, inf)", "df"),
    (lambda: D.InverseWishart(1, scale=I2), "df = 1 is outside (1, inf)", "df"),
    (lambda: D.Wishart([3, 4], scale=I2), "df has shape (2,)", "one number"),
    (lambda: D.Wishart(3, scale=-I2), "scale is not positive definite", "entries"),
    # truncation
    (lambda: D.Truncated(D.Normal(0, sd=1), lower=2, upper=1), "lower = 2 is not below upper = 1",
     "lower < upper"),
    (lambda: D.Truncated(D.Normal(0, sd=1), lower=1, upper=1), "lower = 1 is not below upper = 1",
     "lower < upper"),
    (lambda: D.Truncated(D.Poisson(2), lower=1.2, upper=1.8), "lower = 2 is not below upper = 1",
     "lower < upper"),
    (lambda: D.Truncated(D.Normal(0, sd=1)), "neither lower nor upper", "lower="),
    (lambda: D.Truncated(D.Dirac(1.0), lower=0), "cannot truncate Dirac", "Normal"),
    (lambda: D.Truncated(D.Flat(), lower=0), "cannot truncate Flat", "Normal"),
    (lambda: D.Truncated(D.MvNormal(V, covariance=I2), lower=0), "cannot truncate MvNormal",
     "scalar"),
    (lambda: D.Truncated(1.0, lower=0), "cannot truncate float", "scalar"),
    (lambda: D.Truncated(D.Normal(0, sd=1), lower=np.nan), "lower is nan", "numbers"),
    (lambda: D.Truncated(D.Normal([0, 1], sd=1), lower=[0, 1, 2]), "shapes do not agree", "shape"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "found", "fix"), BAD, ids=[b[1] for b in BAD])
def test_bad_constructions(make, found, fix):
    with pytest.raises(ModelError) as caught:
        make()
    error = caught.value
    assert found in error.found
    assert fix in error.fix
    assert error.where.file == __file__
    first = make.__code__.co_firstlineno
    assert error.where.line in (first, first + 1)
    assert linecache.getline(__file__, error.where.line).strip() in str(error)
    for internal in ("mean_", "shape_", "like_", "__init__", "positional argument:"):
        assert internal not in str(error).replace(error.where.file, "")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_symbols_are_not_judged():
    D.Normal(X, sd=X)
    D.Uniform(X, X + 1)
    D.Truncated(D.Normal(X, sd=1), lower=X)
    D.Categorical([X, 1 - X])
    D.MvNormal(V, covariance=X * I2)


def test_errors_of_the_arguments_come_through():
    with pytest.raises(UnsupportedOperation, match="math"):
        D.Normal(float(X), sd=1)


def test_covariances_that_are_symmetric_up_to_rounding_are_taken():
    a = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.7], [0.1, 0.7, 3.0]])
    D.MvNormal(np.zeros(3), covariance=np.linalg.inv(a) @ (X * a))
    D.MvNormal(np.zeros(2), covariance=[[1.0, 0.1 * (3.0 * X)], [0.3 * X, 1.0]])


def test_primitives_are_not_run_to_see_whether_a_covariance_is_symmetric():
    @ssm.primitive
    def table(s: float) -> float:
        if s != 1.0:
            raise ValueError("not a class")
        return 0.5

    r = table(X)
    D.MvNormal(np.zeros(2), covariance=[[1.0, r * (X * 0.5)], [(r * X) * 0.5, 1.0]])
