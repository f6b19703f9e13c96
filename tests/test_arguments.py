"""Arguments by the names that other packages have for them."""

import inspect

import pytest

import ssmppl as ssm
from ssmppl.arguments import OF_DISTRIBUTIONS, OF_VERBS
from ssmppl.inference.methods import methods
from ssmppl.language.distributions import Distribution

VERBS = (
    ssm.compile, ssm.diagnose, ssm.evidence, ssm.explain, ssm.forecast, ssm.forward_filter,
    ssm.kalman_filter, ssm.leave_future_out, ssm.log_likelihood, ssm.maximize, ssm.particle_filter,
    ssm.predict, ssm.sample, ssm.score, ssm.simulate, ssm.smooth,
)  # fmt: skip
SETTINGS = [
    v for v in vars(methods).values()
    if inspect.isclass(v) and v.__module__ == methods.__name__
]  # fmt: skip
LAWS = [v for v in vars(ssm).values() if inspect.isclass(v) and issubclass(v, Distribution)]


@pytest.mark.parametrize(
    ("function", "given", "fix"),
    [
        (ssm.sample, "tune", "write warmup="),
        (ssm.sample, "num_samples", "write draws="),
        (ssm.sample, "random_seed", "write seed="),
        (ssm.sample, "cores", "write executor="),
        (ssm.sample, "wramup", "the arguments of sample are warmup, "),
        (ssm.particle_filter, "Np", "write particles="),
        (ssm.forecast, "trace", "write idata="),
        (ssm.PGAS, "num_particles", "write particles="),
        (ssm.PMMH, "target_accept", "write target_acceptance="),
        (ssm.PGAS, "qqq", "the arguments of PGAS are "),
    ],
)
def test_a_verb_and_a_method_say_what_the_argument_is_called_here(function, given, fix):
    with pytest.raises(ssm.ArgumentError) as caught:
        function(**{given: 1})
    name = function.__name__
    assert f"{name} has no argument {given!r}" in str(caught.value)
    assert f"Fix: {fix}" in str(caught.value)


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: v.__name__)
def test_what_is_needed_is_said(verb):
    with pytest.raises(ssm.ArgumentError, match=f"write {verb.__name__}\\(model, "):
        verb()


@pytest.mark.parametrize(
    ("law", "given", "fix"),
    [
        (ssm.Normal, "sigma", "sd"), (ssm.Normal, "std", "sd"), (ssm.Normal, "scale", "sd"),
        (ssm.Normal, "tau", "precision"), (ssm.Normal, "loc", "mean"), (ssm.Normal, "mu", "mean"),
        (ssm.Normal, "var", "variance"), (ssm.StudentT, "sigma", "scale"),
        (ssm.StudentT, "nu", "df"), (ssm.MvNormal, "cov", "covariance"),
        (ssm.MvNormal, "sigma", "covariance"), (ssm.MvNormal, "scale_tril", "cholesky"),
        (ssm.Gamma, "alpha", "shape"), (ssm.Gamma, "beta", "rate"), (ssm.Beta, "alpha", "a"),
        (ssm.Beta, "beta", "b"), (ssm.InverseGamma, "beta", "scale"), (ssm.Poisson, "mu", "rate"),
        (ssm.Weibull, "beta", "scale"), (ssm.Exponential, "lam", "rate"),
        (ssm.NegativeBinomial, "alpha", "dispersion"), (ssm.Uniform, "low", "lower"),
        (ssm.Binomial, "total_count", "n"), (ssm.Bernoulli, "probs", "p"),
        (ssm.VonMises, "kappa", "concentration"), (ssm.Dirichlet, "alpha", "concentration"),
    ],
)  # fmt: skip
def test_a_distribution_says_what_the_argument_is_called_here(law, given, fix):
    with pytest.raises(ssm.ModelError, match=f"has no argument {given!r}") as caught:
        law(**{given: 1.0})
    assert f"Fix: write {fix}=" in str(caught.value)


@pytest.mark.parametrize(
    ("aliases", "callables"),
    [(OF_VERBS, (*VERBS, *SETTINGS)), (OF_DISTRIBUTIONS, LAWS)],
    ids=["verbs", "distributions"],
)
def test_every_answer_is_an_argument(aliases, callables):
    own = {n for c in callables for n in inspect.signature(c).parameters}
    assert {n for meant in aliases.values() for n in meant} <= own


def test_a_whole_number_is_written_as_one():
    model = ssm.Model("m")
    with pytest.raises(ssm.ArgumentError, match=r"draws=1000.0\nFix: write draws=1000, a whole"):
        ssm.sample(model, {}, draws=1000.0)
