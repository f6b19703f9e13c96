"""Every setting of every method: what it cannot be is refused by its name, what it can be runs."""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.methods import methods
from ssmppl.inference.methods.settings import rules_of
from ssmppl.inference.verbs.sample import METHODS

model = ssm.Model("level")


@model.prior
def prior():
    return {"q": ssm.Gamma(2, rate=1)}


@model.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}


@model.transition
def transition(x, q):
    return {"x": ssm.Normal(x, variance=q)}


@model.observation
def observation(x):
    return {"y": ssm.Normal(x, sd=1)}


DATA = {"y": np.random.default_rng(1).normal(size=6)}
AT = {"q": 0.5}
SMALL = [
    ssm.MetropolisHastings(),
    ssm.Gibbs(),
    ssm.PMMH(particles=8, proposal="bootstrap"),
    ssm.ISMCMC(particles=5),
    ssm.PGAS(particles=5, proposal="bootstrap"),
    ssm.SMC2(parameters=4, particles=5, moves=1, proposal="bootstrap"),
    ssm.DirectOptimization(restarts=0, steps=3),
    ssm.EM(iterations=3),
    ssm.ParticleEM(particles=8, trajectories=4, runs=1, iterations=3, burn_in=1, chains=1),
    ssm.PSAEM(particles=5, iterations=3, burn_in=1, chains=1),
    ssm.ScoreAscent("paper", particles=8, trajectories=4, iterations=3),
    ssm.IF2(particles=8, iterations=3, starts=1, averaged=2, evaluations=2, points=0),
    ssm.KalmanSmoother(),
    ssm.ForwardBackward(),
    ssm.FFBSi(moves=2, proposal="bootstrap"),
    ssm.FixedLag(proposal="bootstrap"),
]
ODD = ["a", -1, 0, np.nan, np.inf, [1.0], 1.5]
# What of these a method can go with; everything else it has to refuse.
FINE = {
    ("MetropolisHastings", "order"): [0],
    ("PMMH", "target_sd"): [1.5],
    ("PMMH", "order"): [0],
    ("PMMH", "lag"): [0],
    ("PMMH", "correlation"): [0],
    ("PMMH", "rescue"): [0],
    ("MetropolisHastings", "covariance"): [1.5, [1.0]],
    ("PMMH", "covariance"): [1.5, [1.0]],
    ("SMC2", "ess_threshold"): [0],
    ("SMC2", "acceptance"): [0],
    ("DirectOptimization", "restarts"): [0],
    ("EM", "tolerance"): [1.5],
    ("ParticleEM", "burn_in"): [0],
    ("ScoreAscent", "tolerance"): [1.5],
    ("ScoreAscent", "gamma"): [1.5],
    ("ScoreAscent", "exponent"): [-1, 0],
    ("IF2", "perturbation"): [1.5],
    ("IF2", "points"): [0],
    ("FFBSi", "ess_threshold"): [0],
    ("FixedLag", "ess_threshold"): [0],
    ("FFBSi", "moves"): [0],
    ("FFBSi", "rescue"): [0],
    ("FixedLag", "lag"): [0],
}


def goes_on(method, name, value):
    return any(value == fine for fine in FINE.get((type(method).__name__, name), []))


CALLS = [
    pytest.param(
        method,
        field.name,
        value,
        id=f"{type(method).__name__} {field.name}={value!r}",
        marks=[pytest.mark.slow] * goes_on(method, field.name, value),
    )
    for method in SMALL
    for field in fields(method)
    for value in ODD
]


def run(method):
    kind = type(method).__name__
    if type(method) in METHODS:
        few = {"draws": 4, "warmup": 4, "chains": 1}
        return ssm.sample(model, DATA, method, **few, seed=1, progress=False)
    if kind in ("FFBSi", "FixedLag"):
        return ssm.smooth(model, DATA, AT, method, particles=8, seed=1)
    return ssm.maximize(model, DATA, method, seed=1, progress=False)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("method", "name", "value"), CALLS)
def test_odd_settings_are_refused_by_their_names(method, name, value):
    given = replace(method, **{name: value})
    if goes_on(method, name, value):
        run(given)
        return
    with pytest.raises(ssm.ArgumentError) as error:
        run(given)
    assert f"{name}=" in str(error.value) or str(error.value).startswith(f"{name} ")
    assert "Fix: " in str(error.value)


def test_every_method_is_tried():
    known = {
        kind
        for kind in vars(methods).values()
        if isinstance(kind, type) and hasattr(kind, "__dataclass_fields__")
    }
    assert known == {type(m) for m in SMALL}


@pytest.mark.parametrize("method", SMALL, ids=lambda m: type(m).__name__)
def test_every_setting_has_a_rule(method):
    assert set(rules_of(method)) == {f.name for f in fields(method)}


@pytest.mark.parametrize(
    ("method", "name"),
    [
        (ssm.MetropolisHastings(target_acceptance=25), "target_acceptance=25"),
        (ssm.PMMH(target_acceptance=0.0), "target_acceptance=0.0"),
        (ssm.PMMH(correlation="0.9"), "correlation='0.9'"),
        (ssm.PMMH(adapt="no"), "adapt='no'"),
        (ssm.PMMH(transform={"q": 3}), "transform={'q': 3}"),
        (ssm.MetropolisHastings(covariance=[[np.nan]]), "covariance=[[nan]]"),
        (ssm.SMC2(parameters=True), "parameters=True"),
        (ssm.PGAS(eliminate=("q", 3)), "eliminate=('q', 3)"),
    ],
)
def test_samplers_say_which_setting(method, name):
    with pytest.raises(ssm.ArgumentError, match=re.escape(name)):
        ssm.sample(model, DATA, method)
    if isinstance(method, (ssm.PMMH, ssm.MetropolisHastings, ssm.SMC2)):
        with pytest.raises(ssm.ArgumentError, match=re.escape(name)):
            ssm.evidence(model, DATA, method)


@pytest.mark.parametrize(
    ("method", "name"),
    [
        (ssm.ScoreAscent(runs=1), "runs=1"),
        (ssm.ParticleEM(iterations=10, burn_in=10), "iterations=10"),
        (ssm.PSAEM(iterations=10, burn_in=10), "iterations=10"),
        (ssm.IF2(starts=[{"q": 1.0}, 2.0]), "starts="),
        (ssm.IF2(perturbation={"q": 0.0}), "perturbation="),
        (ssm.IF2(cooling=10**400), "cooling="),
    ],
)
def test_maximisers_say_which_setting(method, name):
    with pytest.raises(ssm.ArgumentError, match=name):
        ssm.maximize(model, DATA, method, progress=False)


def test_numbers_of_numpy_are_numbers():
    method = ssm.EM(iterations=np.int64(3), tolerance=np.float32(0.1), accelerate=np.True_)
    assert ssm.maximize(model, DATA, method, progress=False).attrs["em_steps"] >= 2


VERBS = {
    "log_likelihood": lambda e: ssm.log_likelihood(model, DATA, AT, executor=e),
    "particle_filter": lambda e: ssm.particle_filter(model, DATA, AT, executor=e),
    "score": lambda e: ssm.score(model, DATA, AT, executor=e),
    "sample": lambda e: ssm.sample(model, DATA, executor=e),
    "maximize": lambda e: ssm.maximize(model, DATA, executor=e),
    "evidence": lambda e: ssm.evidence(model, DATA, executor=e),
    "leave_future_out": lambda e: ssm.leave_future_out(model, DATA, executor=e),
    "diagnose": lambda e: ssm.diagnose(model, DATA, executor=e),
    "plot_likelihood": lambda e: ssm.plot_likelihood(model, DATA, AT, executor=e),
}


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("executor", [4, "threads", ThreadPoolExecutor])
def test_what_is_no_executor_is_refused(verb, executor):
    with pytest.raises(ssm.ArgumentError, match=r"executor=.* is no concurrent"):
        VERBS[verb](executor)


def test_a_client_is_told_to_give_its_executor():
    class Client:
        def get_executor(self):
            """As Dask's has it."""

    with pytest.raises(ssm.ArgumentError, match=r"client\.get_executor\(\)"):
        ssm.sample(model, DATA, executor=Client())


@pytest.mark.parametrize("threshold", ["a", np.nan, None, [0.7]])
def test_a_threshold_is_a_number(threshold):
    with pytest.raises(ssm.ArgumentError, match="threshold="):
        ssm.leave_future_out(model, DATA, threshold=threshold)


@pytest.mark.parametrize("alpha", ["a", np.nan, 0.5])
def test_an_error_rate_is_a_number(alpha):
    with pytest.raises(ssm.ArgumentError, match="alpha="):
        ssm.diagnose(model, DATA, alpha=alpha)


@pytest.mark.parametrize("name", ["proposal", "resampling", "ess_threshold"])
def test_filters_say_which_setting(name):
    with pytest.raises(ssm.ArgumentError, match=rf"{name}=\['a'\]"):
        ssm.log_likelihood(model, DATA, AT, **{"proposal": "bootstrap", name: ["a"]})
