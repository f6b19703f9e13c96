"""Verbs where a likelihood is zero, a score or a parameter beyond what can be squared.

NumPy's warnings are errors here, as they are where verbs are called at random.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.model.scales import VariableScale
from ssmppl.inference.chains import gibbs_updates
from ssmppl.inference.chains.bridge import Student
from ssmppl.inference.maximum.ascent import Maximization
from ssmppl.inference.maximum.direct_optimization import SmoothLikelihood
from ssmppl.inference.particles import backward
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def boxed(prior=None):
    """y within 1/2 of a nonlinear state; far off it is impossible."""
    model = ssm.Model("boxed")
    if prior is not None:

        @model.prior
        def prior_of():
            return {"q": prior}

        @model.transition
        def transition_by(x, q):
            return {"x": ssm.Normal(np.sin(x), sd=q)}
    else:

        @model.transition
        def transition(x):
            return {"x": ssm.Normal(np.sin(x), sd=0.2)}

    @model.initial
    def initial():
        return {"x": ssm.Uniform(-1, 1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Uniform(x - 0.5, x + 0.5)}

    return model


@pytest.mark.slow
def test_the_evidence_of_impossible_data():
    found = ssm.evidence(boxed(), {"y": [0.0, 100.0, 0.0]}, seed=1, progress=False)
    assert found.log_evidence == -np.inf
    assert np.isnan(found.standard_error)


def test_a_t_law_far_away():
    law = Student(np.zeros(1), np.eye(1))
    assert law.log_density(np.array([[1e200]])) == [-np.inf]
    assert np.isfinite(law.log_density(np.array([[1e100]])))


def test_a_row_that_no_draw_allows_in_leave_future_out():
    model = boxed(ssm.Uniform(0.1, 0.3))
    y = np.zeros(9)
    y[8] = 30.0
    found = ssm.leave_future_out(
        model, {"y": y}, first=6, particles=50, draws=20, warmup=20, chains=2, seed=1,
        progress=False,
    )  # fmt: skip
    assert found.attrs["elpd"] == -np.inf
    assert np.isnan(found.attrs["standard_error"])


def switching(observed):
    """Two states; the second value of y is possible with probability `observed` in both."""
    model = ssm.Model("switching")

    @model.prior
    def prior():
        return {"p": ssm.Uniform(0.1, 0.9)}

    @model.initial
    def initial():
        return {"k": ssm.Categorical([0.5, 0.5])}

    @model.transition
    def transition(k, p):
        return {"k": ssm.Categorical(np.stack([p, 1 - p]))}

    @model.observation
    def observation(k):
        return {"y": ssm.Categorical([1 - observed, observed])}

    return model


@pytest.mark.parametrize("restarts", [0, 2])
def test_no_climb_where_the_likelihood_is_zero(restarts):
    method = ssm.DirectOptimization(restarts=restarts)
    with pytest.raises(ssm.ArgumentError, match=r"zero at every point(?s:.*)give start="):
        ssm.maximize(
            switching(0.0), {"y": [0, 1, 0]}, method, start={"p": 0.5}, seed=1, progress=False
        )


@pytest.mark.parametrize("restarts", [0, 2])
def test_no_climb_where_the_continuous_filter_is_zero(restarts, monkeypatch):
    monkeypatch.setattr(SmoothLikelihood, "one", lambda self, theta, seed: -np.inf)
    method = ssm.DirectOptimization(particles=20, averages=2, restarts=restarts)
    with pytest.raises(ssm.SamplingError, match="zero at the start"):
        ssm.maximize(
            boxed(ssm.Uniform(0.1, 0.3)), {"y": np.zeros(3)}, method, seed=1, progress=False
        )


def narrow():
    model = ssm.Model("narrow")

    @model.prior
    def prior():
        return {"s": ssm.Gamma(2, rate=2)}

    @model.initial
    def initial(s):
        return {"x": ssm.Normal(0, sd=s)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(np.sin(x), sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    return model


def test_scores_whose_squares_are_beyond_numbers():
    found = ssm.score(narrow(), {"y": [0.0, 0.1]}, {"s": 1e-160}, seed=1, particles=20)
    assert abs(found.gradient["s"]) > 1e155


def test_a_surface_that_no_axis_holds():
    model = ssm.Model("two scales")

    @model.prior
    def prior():
        return {"a": ssm.HalfNormal(sd=1), "b": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, a):
        return {"x": ssm.Normal(x, sd=a)}

    @model.observation
    def observation(x, b):
        return {"y": ssm.Normal(x, sd=b)}

    with pytest.raises(ssm.ArgumentError, match=r"in 'a', which no axis holds(?s:.*)limits="):
        ssm.plot_likelihood(model, {"y": [0.0, 1.0]}, parameters={"a": 1e308, "b": 1.0}, points=3)


def test_the_scale_of_numbers_that_have_no_squares():
    found = VariableScale.of([1e200, -1e200, 3e200, np.nan])
    assert found.mean == pytest.approx(1e200)
    assert found.sd == pytest.approx(1e200 * np.std([1, -1, 3]))
    assert VariableScale.of([0.0, 0.0]).sd == 0.0


@pytest.mark.parametrize(
    "method",
    [
        ssm.ScoreAscent(particles=10, trajectories=5, runs=2, iterations=2),
        ssm.ParticleEM(particles=10, trajectories=5, runs=1, chains=1, iterations=4, burn_in=1),
    ],
    ids=lambda m: type(m).__name__,
)
def test_a_climb_counts_all_its_backward_passes(method, monkeypatch):
    """One pass over four rows evaluates 10 * 5 * 10 densities, the climb four times as many."""
    model = ssm.Model("position")
    model.prior(lambda: {"q": ssm.InverseGamma(3, scale=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)})
    model.transition(
        lambda x, v, q: {"x": ssm.Dirac(x + v), "v": ssm.Normal(np.sin(x), variance=q)}
    )
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    for most, kernel in [(2001, "exact"), (1000, "mcmc")]:
        monkeypatch.setattr(backward, "MOST_WEIGHTS", most)
        found = ssm.maximize(
            model, {"y": np.zeros(4)}, method, start={"q": 1.0}, seed=1, progress=False
        )
        assert found.attrs["kernel"].startswith(kernel)


def test_a_log_joint_of_both_infinities_is_no_probability(monkeypatch):
    """An infinite prior density at an edge, and data that are impossible there."""
    monkeypatch.setattr(gibbs_updates, "log_joints", lambda *_: np.array([-np.inf]))
    entries = {"log_prior": lambda theta: np.float64(np.inf)}
    problem = SimpleNamespace(
        program=SimpleNamespace(entry=entries.get), trace=SimpleNamespace(transition={}),
        experiments=[None],
    )  # fmt: skip
    steps = SimpleNamespace(problem=problem)
    assert gibbs_updates.log_joint(steps, np.zeros(1), [np.zeros((1, 1))]) == -np.inf


def test_errors_of_an_estimate_that_has_no_square():
    """IF2 at e^460: the variance of its Monte Carlo error is beyond what a number can be."""
    model = ssm.Model("huge")
    model.prior(lambda: {"s": ssm.LogNormal(460.0, sd=1.0)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {"x": ssm.Normal(np.sin(x) + np.log(s) - 460.0, sd=0.3)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.3)})
    y = ssm.simulate(model, {"s": np.exp(460.3)}, steps=40, seed=1)["y"].values[0]
    found = ssm.maximize(
        model, {"y": y}, ssm.IF2(particles=100, iterations=10), start={"s": np.exp(460.0)}, seed=1,
        progress=False,
    )  # fmt: skip
    assert 459.5 < np.log(found.parameters["s"]) < 461.0
    assert "beyond_the_swarms" in found.attrs


@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_the_information_at_an_infinite_parameter_is_no_number(objective):
    model = ssm.Model("far")
    model.prior(lambda: {"s": ssm.Gamma(2, rate=2), "p": ssm.Uniform(0, 1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {"x": ssm.Normal(np.sin(x), sd=s)})
    model.observation(lambda x, p: {"y": ssm.Normal(p * x, sd=1)})
    problem = pose(model, {"y": np.zeros(3)})
    setup = Maximization(
        problem, space_of(problem, {}, {}), objective, {}, {}, np.random.SeedSequence(0)
    )
    assert np.isnan(setup.natural(np.array([800.0, 0.0]), np.eye(2))).all()
    assert np.isfinite(setup.natural(np.array([1.0, 0.0]), np.eye(2))).all()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_pairs_too_far_apart_for_a_square():
    """Backwards, a particle whose next state would be 1e200 is no ancestor of any other."""
    model = ssm.Model("explosive")
    model.initial(lambda: {"x": ssm.Normal(1.01, sd=1), "z": ssm.Normal(0, sd=1)})
    model.transition(
        lambda x, z: {
            "x": ssm.Normal(-0.64 * x**400, sd=0.6), "z": ssm.Normal(0.5 * z + 0.1 * x, sd=0.3)
        }
    )  # fmt: skip
    model.observation(lambda z: {"y": ssm.Normal(z, sd=1)})
    for seed in range(6):
        found = ssm.smooth(
            model, {"y": np.zeros(4)}, {}, "ffbsi", particles=10, trajectories=5, seed=seed
        )
        assert np.all(np.isfinite(found["z"].values))


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("mean", [np.sin, lambda x: 0.5 * x])
def test_data_so_far_off_that_their_log_densities_have_no_sum(mean):
    model = ssm.Model("far off")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(mean(a * x), sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    data, at = {"y": np.full(20, 1.2e154)}, {"a": 0.5}
    assert np.all(ssm.log_likelihood(model, data, at) == -np.inf)
    assert np.all(ssm.log_likelihood(model, data, at, proposal="bootstrap") == -np.inf)
    ssm.plot_filter(ssm.particle_filter(model, data, at, seed=1))
    for method in (ssm.FFBSi(), ssm.FixedLag()):
        found = ssm.smooth(model, data, at, method, particles=20, seed=1)
        assert found.attrs["log_likelihood"] == -np.inf
    if mean is np.sin:
        with pytest.raises(ssm.SamplingError, match="too small for their logarithms"):
            ssm.score(model, data, at, seed=1)
