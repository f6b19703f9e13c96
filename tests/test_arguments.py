"""Arguments by the names that other packages have for them."""

import inspect
import re

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.arguments import OF_DISTRIBUTIONS, OF_ONE_DISTRIBUTION, OF_VERBS
from ssmppl.errors import ArgumentError
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


def options(called) -> list[str]:
    return list(inspect.signature(called).parameters)


def number(expression) -> float:
    return float(str(expression))


LAWS = [v for v in vars(ssm).values() if inspect.isclass(v) and issubclass(v, Distribution)]


@pytest.mark.parametrize(
    ("function", "given", "fix"),
    [
        (ssm.sample, "tune", "write warmup="),
        (ssm.sample, "num_samples", "write draws="),
        (ssm.sample, "random_seed", "write seed="),
        (ssm.sample, "cores", "write executor="),
        (ssm.sample, "wramup", "write warmup="),
        (ssm.particle_filter, "Np", "write particles="),
        (ssm.forecast, "trace", "write idata="),
        (ssm.PGAS, "num_particles", "write particles="),
        (ssm.PMMH, "target_accept", "write target_acceptance="),
        (ssm.PGAS, "qqq", "the arguments of PGAS are particles, proposal, "),
        (ssm.sample, "qqq", "the arguments of sample are model, data, method, draws, "),
    ],
)
def test_a_verb_and_a_method_say_what_the_argument_is_called_here(function, given, fix):
    with pytest.raises(ssm.ArgumentError) as caught:
        function(**{given: 1})
    name = function.__name__
    assert f"{name} has no argument {given!r}" in str(caught.value)
    assert f"Fix: {fix}" in str(caught.value)


@pytest.mark.parametrize(
    ("function", "given", "written"),
    [
        (ssm.sample, "particles", "method=ssm.PMMH(particles=...), "),
        (ssm.sample, "n_particles", "method=ssm.PMMH(particles=...), "),
        (ssm.sample, "target_accept", "method=ssm.MetropolisHastings(target_acceptance=...), "),
        (ssm.sample, "eliminate", "method=ssm.PGAS(eliminate=...)"),
        (ssm.maximize, "maxiter", "method=ssm.DirectOptimization(steps=...), ssm.EM(iterations="),
        (ssm.maximize, "starts", "method=ssm.IF2(starts=...)"),
        (ssm.smooth, "kernel", "method=ssm.FFBSi(kernel=...)"),
        (ssm.evidence, "moves", "method=ssm.SMC2(moves=...)"),
        (ssm.PGAS, "draws", "ssm.sample(model, data, ssm.PGAS(...), draws=...)"),
        (ssm.PGAS, "num_chains", "ssm.sample(model, data, ssm.PGAS(...), chains=...)"),
        (ssm.EM, "seed", "ssm.maximize(model, data, ssm.EM(...), seed=...)"),
        (ssm.Gibbs, "order", "a setting of ssm.MetropolisHastings and ssm.PMMH; the arguments of "),
        (ssm.maximize, "trajectories", "method=ssm.ParticleEM(trajectories=...) or ssm.ScoreAsc"),
        (ssm.maximize, "warmup", "an argument of ssm.sample, ssm.evidence and ssm.leave_future"),
    ],
)  # fmt: skip
def test_a_setting_of_another_place_is_said_to_be_one(function, given, written):
    with pytest.raises(ssm.ArgumentError) as caught:
        function(**{given: 1})
    fix = caught.value.fix
    assert fix.startswith(("it is a setting of the method: write ", "it is an argument of ",
                           "it is a setting of "))  # fmt: skip
    assert written in fix


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: v.__name__)
def test_a_fix_names_no_argument_that_is_not_there(verb):
    """What it says to write can be written, of every name that is known anywhere."""
    own = options(verb)
    for given in {*OF_VERBS, *(n for k in SETTINGS for n in options(k))} - set(own):
        with pytest.raises(ssm.ArgumentError) as caught:
            verb(**{given: 1})
        fix = caught.value.fix
        assert set(re.findall(r"^write (\w+)=", fix)) <= set(own)
        for method, setting in re.findall(r"ssm\.(\w+)\((\w+)=", fix):
            assert setting in options(getattr(ssm, method))


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


MU, SIGMA, KAPPA = 2.0, 0.7, 5.0


@pytest.mark.parametrize(
    ("law", "given", "names", "mean", "variance"),
    [
        (ssm.Gamma, "mu", {"mu": MU, "sigma": SIGMA}, MU, SIGMA**2),
        (ssm.Gamma, "sigma", {"mu": MU, "sigma": SIGMA}, MU, SIGMA**2),
        (ssm.InverseGamma, "mu", {"mu": MU, "sigma": SIGMA}, MU, SIGMA**2),
        (ssm.Beta, "mu", {"mu": 0.3, "kappa": KAPPA}, 0.3, 0.21 / (KAPPA + 1)),
        (ssm.NegativeBinomial, "p", {"n": 3.0, "p": 0.25}, 9.0, 36.0),
    ],
)  # fmt: skip
def test_parameters_of_other_kinds_are_written_in_those_here(law, given, names, mean, variance):
    """Of the fix itself, which is code: its moments are those of the parameters elsewhere."""
    with pytest.raises(ssm.ModelError) as caught:
        law(**{given: 1.0})
    written = caught.value.fix.removeprefix("write ").partition(", of the ")[0]
    written = written.partition(", of n ")[0]
    made = eval(f"law({written})", {"law": law, "np": np, **names})
    assert number(made.mean()) == pytest.approx(mean)
    assert number(made.variance()) == pytest.approx(variance)


@pytest.mark.parametrize(
    ("law", "given", "names", "variance"),
    [
        (ssm.StudentT, "sd", {"df": 5.0, "sd": SIGMA}, SIGMA**2),
        (ssm.Laplace, "std", {"sd": SIGMA}, SIGMA**2),
    ],
)
def test_a_standard_deviation_is_not_called_a_scale(law, given, names, variance):
    with pytest.raises(ssm.ModelError) as caught:
        law(**{given: 1.0})
    written = caught.value.fix.removeprefix("write ")
    before = "5.0, 0.0" if law is ssm.StudentT else "0.0"
    made = eval(f"law({before}, {written})", {"law": law, "np": np, **names})
    assert number(made.variance()) == pytest.approx(variance)


def test_what_a_distribution_alone_means_is_no_argument_of_it():
    """Else the hint could never be seen; and the names of its fix are its own."""
    for law in LAWS:
        for given, fix in OF_ONE_DISTRIBUTION.get(law.__name__, {}).items():
            assert given not in options(law)
            assert set(re.findall(r"(?:^|, )(\w+)=(?!=)", fix)) <= set(options(law)), fix


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


@pytest.mark.parametrize(
    ("given", "meant"),
    [("Ts", "time_step"), ("covariates", "inputs"), ("covar", "inputs"), ("unit", "experiment"),
     ("dim", "dims")],
)  # fmt: skip
def test_arguments_of_a_model_have_other_names_elsewhere(given, meant):
    with pytest.raises(ArgumentError, match=f"Model has no argument '{given}'") as error:
        ssm.Model("name", **{given: ("a",)})
    assert f"write {meant}=" in str(error.value)
