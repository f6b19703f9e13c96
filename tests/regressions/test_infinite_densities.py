"""A point where a density is infinite is no point: never a place to stay, nor one to end at.

What a method makes of a law that is +inf somewhere is held against what it makes of the same law
with -inf there: the same numbers, to the last digit.
"""

from __future__ import annotations

import itertools
import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.density import terms
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, INFINITE, NAN
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.chains.gibbs_updates import GibbsUpdates, draw_parameters, plan_updates
from ssmppl.inference.chains.interweaving import Collapsed
from ssmppl.inference.exact.hidden_markov import hidden_markov
from ssmppl.inference.particles.backward import pair_failure
from ssmppl.inference.particles.filtering import failure
from ssmppl.inference.preparation import pilot
from ssmppl.inference.preparation.vanishing import without_maximum
from ssmppl.inference.run.problem import pose
from ssmppl.inference.updates.draw_update import draw
from ssmppl.language.model.trace import seen
from ssmppl.language.tracing import trace
from tests.statistics.checks import seed_of

UNDERFLOWN = 1e-170  # whose square is 0
LEAST = 0.4  # of the scale of `Fenced`
SHORT: dict[str, Any] = {"draws": 60, "warmup": 60, "chains": 1, "progress": False}


@ssm.distribution(positive=("scale",))
def Fenced(y, loc, scale, beyond):
    """A Normal law, whose log density is `beyond` where the scale is below LEAST."""
    normal = -0.5 * ((y - loc) / scale) ** 2 - np.log(scale) - 0.5 * np.log(2 * np.pi)
    return np.where(scale < 0.4, beyond, normal)


@Fenced.sampler
def draw_fenced(rng, loc, scale, beyond):
    return rng.normal(loc, scale)


def moving(beyond: float) -> ssm.Model:
    model = ssm.Model("moving")
    model.prior(lambda: {"s": ssm.HalfNormal(sd=1.0), "q": ssm.InverseGamma(3, scale=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(2 * np.sin(x), variance=q)})
    model.observation(lambda x, s: {"y": Fenced(x, s, beyond)})
    return model


def switching(beyond: float) -> ssm.Model:
    model = ssm.Model("switching")
    model.prior(lambda: {"s": ssm.HalfNormal(sd=1.0), "p": ssm.Beta(2, 2)})
    model.initial(lambda: {"z": ssm.Bernoulli(0.5)})
    model.transition(lambda z, p: {"z": ssm.Bernoulli(p + (1 - 2 * p) * z)})
    model.observation(lambda z, s: {"y": Fenced(2 * z, s, beyond)})
    return model


def still(beyond: float) -> ssm.Model:
    model = ssm.Model("still")
    model.prior(lambda: {"s": ssm.HalfNormal(sd=1.0), "a": ssm.Normal(0, sd=1)})
    model.initial(lambda a: {"x": ssm.Dirac(a)})
    model.transition(lambda x: {"x": ssm.Dirac(0.9 * x)})
    model.observation(lambda x, s: {"y": Fenced(x, s, beyond)})
    return model


def fenced_data() -> np.ndarray:
    """(12,) of `moving`, with noise of a scale that is no farther from LEAST than it is known."""
    rng, x, y = np.random.default_rng(5), 0.0, []
    for _ in range(12):
        x = 2 * np.sin(x) + 0.5 * rng.standard_normal()
        y.append(x + 0.5 * rng.standard_normal())
    return np.array(y)


SAMPLERS = [
    (moving, ssm.PMMH(particles=50, proposal="bootstrap")),
    *[pytest.param(*case, marks=pytest.mark.slow) for case in (
        (moving, ssm.PMMH(particles=50)),
        (moving, ssm.PMMH(particles=50, proposal="tempered")),
        (moving, ssm.PMMH(particles=50, correlation=0.9)),
        (moving, ssm.PMMH(particles=50, order=1)),
        (moving, ssm.PGAS(interweave=True)),
        (moving, ssm.PGAS(interweave=False)),
        (moving, ssm.SMC2(parameters=60, particles=30)),
        (switching, ssm.Gibbs()),
        (switching, ssm.MetropolisHastings()),
        (still, ssm.MetropolisHastings()),
        (still, ssm.MetropolisHastings(order=1)),
    )],
]  # fmt: skip


@pytest.mark.parametrize(("build", "method"), SAMPLERS)
def test_samplers_take_an_infinite_density_for_none(build, method):
    found = [
        ssm.sample(build(beyond), {"y": fenced_data()}, method, seed=3, **SHORT).posterior["s"]
        for beyond in (-np.inf, np.inf)
    ]
    assert found[0].values.min() >= LEAST
    assert found[0].values.std() > 0.0
    np.testing.assert_array_equal(*found)


@pytest.mark.slow
def test_a_rescued_filter_takes_an_infinite_density_for_none():
    """It draws less where a density is infinite than where all are zero, so the numbers differ."""
    method = ssm.PMMH(particles=50, proposal="bootstrap", rescue=100)
    found = ssm.sample(moving(np.inf), {"y": fenced_data()}, method, seed=3, **SHORT)
    s = found.posterior["s"].values
    assert s.min() >= LEAST
    assert s.std() > 0.0


MAXIMISERS = [
    (moving, ssm.IF2(particles=100, iterations=20, points=0)),
    *[pytest.param(*case, marks=pytest.mark.slow) for case in (
        (moving, ssm.DirectOptimization(particles=50, averages=2)),
        (moving, ssm.ParticleEM(particles=50, iterations=10, burn_in=5, chains=2)),
        (switching, ssm.EM()),
        (switching, ssm.DirectOptimization()),
        (still, ssm.DirectOptimization()),
    )],
]  # fmt: skip


@pytest.mark.parametrize(("build", "method"), MAXIMISERS)
@pytest.mark.filterwarnings("ignore")  # what a dozen rows tell is no matter
def test_maximisers_take_an_infinite_density_for_none(build, method):
    found = [
        ssm.maximize(build(beyond), {"y": fenced_data()}, method, seed=3, progress=False)
        for beyond in (-np.inf, np.inf)
    ]
    assert found[0].parameters["s"] >= LEAST
    assert found[0].parameters == found[1].parameters


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the chains")
def test_evidence_of_a_model_with_an_infinite_density():
    """What is integrated is the rest of the likelihood, also where the bridge has points beyond."""
    found = [
        ssm.evidence(switching(beyond), {"y": fenced_data()}, draws=200, warmup=100, chains=2,
                     seed=1, progress=False)
        for beyond in (-np.inf, np.inf)
    ]  # fmt: skip
    assert found[0].log_evidence == found[1].log_evidence


def test_a_move_to_where_the_likelihood_is_infinite_is_none():
    for value, taken in ((np.inf, -np.inf), (np.nan, -np.inf), (-3.0, -3.0)):
        model = SimpleNamespace(log_likelihood=lambda experiments, theta, v=value: v)
        move = Collapsed(cast("Any", SimpleNamespace(experiments=())), cast("Any", model))
        assert move.at(np.empty(0), None, [])[0] == taken
        assert move.stand(np.empty(0), [])[0] == taken


# -- a covariance that underflowed, with components that were not measured


def vector(spread: str) -> ssm.Model:
    model = ssm.Model("vector")
    model.prior(lambda: {"s": ssm.HalfNormal(sd=np.ones(2)), "rho": ssm.Uniform(-1, 1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(np.sin(x), sd=1)})

    def observation(x, s, rho):
        c = rho * s[0] * s[1]
        root = np.array([[s[0], 0.0], [rho * s[1], s[1] * np.sqrt(1 - rho**2)]])
        covariance = np.array([[s[0] ** 2, c], [c, s[1] ** 2]])
        both = {"covariance": covariance, "cholesky": root}
        return {"y": ssm.MvNormal(np.stack([x, -x]), **{spread: both[spread]})}

    model.observation(observation)
    return model


ROWS = np.array([[1.0, 2.0], [np.nan, -1.0], [0.5, np.nan], [np.nan, np.nan]])


@pytest.mark.parametrize("spread", ["covariance", "cholesky"])
def test_the_measured_part_of_a_vector(spread):
    """Its density against SciPy's, and -inf where what was measured has no covariance; by the
    interpreter, row by row, and compiled."""
    problem = pose(vector(spread), {"y": ROWS})
    (e,) = problem.experiments
    own = problem.trace
    (term,) = terms(own, "observation", problem.program.missing)
    x = np.array([0.3, -0.2, 0.7, 0.1])
    for s0, rho in itertools.product((0.6, 1e-3, UNDERFLOWN), (0.3, -0.9)):
        s1 = 0.8
        c = rho * s0 * s1
        covariance = np.array([[s0**2, c], [c, s1**2]])
        rows = []
        for t, here in enumerate(np.isfinite(ROWS)):
            part, mean = np.ix_(here, here), np.array([x[t], -x[t]])[here]
            if here[0] and s0 == UNDERFLOWN:
                rows.append(-np.inf)
            elif here.any():
                rows.append(stats.multivariate_normal.logpdf(ROWS[t, here], mean, covariance[part]))
            else:
                rows.append(0.0)
            values = dict(zip(own.parameter_symbols, (s0, s1, rho), strict=True))
            values |= dict(zip(own.state_symbols, x[t : t + 1], strict=True))
            values |= dict(zip(own.observation_symbols, np.nan_to_num(ROWS[t]), strict=True))
            masks = [seen(y) for y in own.observation_symbols]
            values |= dict(zip(masks, here * 1.0, strict=True))
            found = float(evaluate([term.guarded()], values)[0])
            assert found == pytest.approx(rows[-1], rel=1e-9), (s0, rho, t)
        states = stats.norm.logpdf(x - np.r_[0.0, np.sin(x[:-1])]).sum()
        total, path = np.empty(1), x[:, None].copy()
        problem.program.entry("log_joint")(np.array([s0, s1, rho]), e.y, e.seen, e.u, path, total)
        assert total[0] == pytest.approx(states + sum(rows), rel=1e-9), (s0, rho)


@pytest.mark.parametrize(
    ("proposal", "rows"), [
        ("bootstrap", len(ROWS)), ("guided", 1),
        pytest.param("auxiliary", len(ROWS), marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_particles_without_a_covariance_have_likelihood_zero(proposal, rows):
    """The locally optimal proposals weigh by the sum of two covariances, which looks like one."""
    parameters = {"s": [UNDERFLOWN, 0.8], "rho": 0.3}
    found = ssm.log_likelihood(
        vector("covariance"), {"y": ROWS[:rows]}, parameters, proposal=proposal, seed=1,
        particles=50,
    )  # fmt: skip
    assert found[0] == -np.inf


def test_conjugate_draws_that_underflow_are_none():
    """Of a law with half of its mass below the smallest number, drawn as a scale and as shares."""
    model = ssm.Model("vague")
    model.prior(lambda: {
        "tau": ssm.Gamma(1e-3, rate=1.0), "p": ssm.Dirichlet(np.full(3, 1e-3)),
    })  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, tau: {"x": ssm.Normal(x, precision=tau)})
    model.observation(lambda x, p: {"y": ssm.Categorical(p)})
    own = trace(model)
    updates = plan_updates(pose(model, {"y": [0.0]}), {})
    rng = np.random.default_rng(seed_of("underflow"))
    for update in updates:
        totals = np.array([e.data for e in update.coefficients["prior"]])
        current = np.full(len(update.components), 1.0 / len(update.components))
        rest = dict.fromkeys(own.parameter_symbols, 1.0)
        drawn = [draw(update, totals, current, rest, rng)[0] for _ in range(200)]
        assert np.min(drawn) > 0.0, update.block
        assert len(np.unique(drawn)) > 100


# -- a value of the states that tells some rows exactly


def exact_rows() -> tuple[ssm.Model, np.ndarray]:
    """States of two values, one of which has measurements without noise."""
    model = ssm.Model("two values")
    model.prior(lambda: {"s": ssm.HalfNormal(sd=np.ones(2)), "p": ssm.Beta(2, 2)})
    model.initial(lambda: {"z": ssm.Bernoulli(0.5)})
    model.transition(lambda z, p: {"z": ssm.Bernoulli(p + (1 - 2 * p) * z)})
    model.observation(lambda z, s: {"y": ssm.Normal(2 * z, sd=s[0] + (s[1] - s[0]) * z)})
    rng = np.random.default_rng(1)
    z = rng.random(40) < 0.3
    return model, np.where(z, 2.0 + 0.3 * rng.standard_normal(40), 0.0)


TOLD = r"no maximum: the data of y determine the states exactly in \d+ rows"


@pytest.mark.parametrize(
    "method", [ssm.DirectOptimization(), pytest.param(ssm.EM(), marks=pytest.mark.slow)]
)
@pytest.mark.filterwarnings("ignore")
def test_rows_told_exactly_leave_no_maximum(method):
    model, y = exact_rows()
    found = ssm.maximize(model, {"y": y}, method, seed=1, progress=False)
    assert not found.attrs["converged"]
    assert re.search(TOLD, found.attrs["stopped"])


@pytest.mark.parametrize(
    "method", [ssm.MetropolisHastings(), pytest.param(ssm.Gibbs(), marks=pytest.mark.slow)]
)
def test_rows_told_exactly_leave_no_posterior(method):
    """All draws were 5e-324, the smallest number there is."""
    model, y = exact_rows()
    with pytest.raises(ssm.SamplingError, match=TOLD):
        ssm.sample(model, {"y": y}, method, seed=1, **SHORT)


def test_a_single_row_told_exactly_may_have_a_posterior():
    """That of a mean which is free: it has to meet the row, the less likely the smaller s."""
    model, y = exact_rows()
    y = np.where(np.arange(40) == np.flatnonzero(y == 0.0)[0], 0.0, y + 0.1)
    problem = pose(model, {"y": y})
    form, theta = hidden_markov(problem.trace), np.array([1e-20, 2.0, 0.5])
    assert not isinstance(form, NotApplicable)
    assert without_maximum(form, problem.experiments, theta) is not None
    assert without_maximum(form, problem.experiments, theta, rows=2) is None


# -- what errors say

AT = {"s": [1e-200, 0.8], "rho": 0.3}
NO_COVARIANCE = r"the covariance of MvNormal, \[0, 2.4e-201; 2.4e-201, 0.64\], is not positive"


def test_a_filter_names_the_law_without_a_density():
    problem, theta = pose(vector("covariance"), {"y": ROWS}), np.array([1e-200, 0.8, 0.3])
    (e,) = problem.experiments
    for error in (
        failure(problem, theta, ALL_ZERO, 0, e),
        failure(problem, theta, INFINITE, 0, e),
        pair_failure(problem, theta, NAN, 0, e),
    ):
        assert re.search(NO_COVARIANCE, str(error))
        for fragment in (
            "s = [1.e-200",
            "in the distribution of y",
            "ssm.InverseWishart",
            __file__,
        ):
            assert fragment in str(error)


@pytest.mark.slow
def test_the_verb_of_filters_names_the_law_without_a_density():
    with pytest.raises(ssm.SamplingError, match=NO_COVARIANCE):
        ssm.particle_filter(vector("covariance"), {"y": ROWS}, AT, seed=1, proposal="bootstrap")


def test_a_start_names_the_law_without_a_density():
    with pytest.raises(ssm.ArgumentError, match=NO_COVARIANCE) as caught:
        ssm.sample(vector("covariance"), {"y": ROWS}, ssm.PGAS(), start=AT, seed=1, **SHORT)
    assert "200 points tried for a start" in str(caught.value)


def test_an_update_names_the_law_without_a_density():
    problem = pose(vector("covariance"), {"y": ROWS})
    steps = GibbsUpdates(problem, plan_updates(problem, {}))
    theta, paths = np.array([1e-200, 0.8, 0.3]), [np.zeros((len(ROWS), 1))]
    with pytest.raises(ssm.SamplingError, match=NO_COVARIANCE) as caught:
        draw_parameters(steps, theta, paths, np.random.default_rng(1))
    assert "zero at the current value: s[0] = 1e-200" in str(caught.value)


def test_an_update_says_that_a_density_is_infinite():
    problem = pose(moving(np.inf), {"y": fenced_data()})
    steps = GibbsUpdates(problem, plan_updates(problem, {}))
    with pytest.raises(ssm.SamplingError, match="infinite at the current value: s = 0"):
        draw_parameters(steps, np.array([0.1, 1.0]), [np.zeros((12, 1))], np.random.default_rng(1))


def test_an_exact_filter_names_the_law_without_a_density():
    model = ssm.Model("correlated")
    model.prior(lambda: {"c": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(
        lambda x, c: {"y": ssm.MvNormal(np.stack([x, x]), covariance=np.array([[1, c], [c, 1]]))}
    )
    with pytest.raises(ssm.SamplingError, match=r"MvNormal, \[1, 2; 2, 1\], is not positive") as e:
        ssm.kalman_filter(model, {"y": ROWS}, {"c": 2.0})
    assert "c = 2" in str(e.value)


@pytest.mark.parametrize("run", [
    lambda m, y: ssm.maximize(m, y, start={"q": 0.5}, seed=1, progress=False),
    lambda m, y: ssm.sample(m, y, ssm.PMMH(), draws=100, start={"q": 0.5}, seed=1, progress=False),
], ids=["maximize", "PMMH"])  # fmt: skip
def test_an_impossible_row_is_named_where_a_start_was_given(run):
    """Not "give start=": that was given, and no start makes the row possible."""
    model = ssm.Model("window")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, sd=q)})
    model.observation(lambda x: {"y": ssm.Uniform(x - 0.1, x + 0.1)})
    with pytest.raises(ssm.ArgumentError) as caught:
        run(model, {"y": np.array([0.0, 0.2, 1000.0, 0.1])})
    assert "all weights are zero at t=3, where y = 1000.; parameters: q = 0.5" in str(caught.value)
    assert caught.value.fix.startswith("no particle can have produced this row")
    assert caught.value.fix.endswith("or begin with other values of the parameters (start=)")


def test_an_impossible_row_is_named_by_the_gaussian_climb():
    model = ssm.Model("curved")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(np.sin(x), sd=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.1)})
    data = {"y": np.array([0.0, 0.1, 1e200, 0.2])}
    with pytest.raises(ssm.ArgumentError, match=r"zero at t=3, where y = 1\.e\+200"):
        ssm.maximize(model, data, start={"q": 0.5}, seed=1, progress=False)


def test_no_simulator_is_called_in_search_of_a_row(monkeypatch):
    """Twenty thousand particles would call it in every row."""
    problem = pose(vector("covariance"), {"y": ROWS})
    space = SimpleNamespace(problem=problem, theta=np.zeros(0))
    asked = []
    monkeypatch.setattr(pilot, "why_zero", lambda _, __, particles: asked.append(particles))
    error = ssm.ArgumentError("none", fix="start=")
    assert pilot.explained(error, space) is error
    monkeypatch.setattr(pilot, "simulators", lambda trace: ("step",))
    assert pilot.explained(error, space) is error
    assert asked == [pilot.LOOKED_AT, None]


@pytest.mark.parametrize("curved", [False, True])
def test_no_row_is_blamed_of_an_observation_without_noise(curved):
    """No particle hits it, possible or not: the first row was named, which is possible."""
    model = ssm.Model("exact")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)})
    if curved:
        model.transition(
            lambda x, v, q: {"x": ssm.Normal(np.sin(x), sd=q), "v": ssm.Uniform(v - 0.1, v + 0.1)}
        )
    else:
        model.transition(lambda x, v, q: {"x": ssm.Normal(x, sd=q), "v": ssm.Dirac(v)})
    model.observation(lambda x, v: {"y": ssm.Dirac(x), "w": ssm.Dirac(v)})
    data = {"y": np.array([0.0, 0.1, 0.3]), "w": np.array([0.0, 5.0, 0.0])}
    with pytest.raises(ssm.ArgumentError, match="points tried for a start") as caught:
        ssm.sample(model, data, ssm.PMMH(), draws=100, seed=1, progress=False)
    assert "t=1" not in str(caught.value)
    if curved:  # "auto" was asked for, and is no fix
        with pytest.raises(ssm.ArgumentError, match="no proposal applies to this model") as caught:
            ssm.log_likelihood(model, data, {"q": 0.3}, seed=1)
        assert "auto" not in caught.value.fix
