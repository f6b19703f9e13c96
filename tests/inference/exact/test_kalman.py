"""The exact filter against the joint Gaussian of all states and observations, written densely."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
import ssmppl.language.distributions as D
from ssmppl import datasets
from ssmppl.analysis.structure import linear_gaussian
from ssmppl.codegen.kernels.kalman import square_root as kernel
from ssmppl.data import bind
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.exact.kalman import kalman_filter, kalman_log_likelihood, kalman_model
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace
from tests.models.kalman import MODELS, posed


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("build", MODELS)
def test_filter_is_the_dense_gaussian(build, missing):
    traced, theta, experiment, dense = posed(build, missing)
    steps = experiment.steps
    run = kalman_filter(traced, experiment, theta)
    seen = experiment.seen
    total = 0.0
    for t in range(steps):
        upto = dense.log_likelihood(experiment.y, seen, t + 1)
        assert run.log_increments[t] == pytest.approx(upto - total, abs=1e-9)
        total = upto
        for target, at, mean, covariance in (
            (dense.x[t], t + 1, run.mean, run.covariance),
            (dense.x[t], t, run.mean_predicted, run.covariance_predicted),
            (dense.y[t], t, run.observation_mean, run.observation_covariance),
        ):
            exact_mean, exact_covariance = dense.given(target, experiment.y, seen, at)
            np.testing.assert_allclose(mean[t], exact_mean, atol=1e-9)
            np.testing.assert_allclose(covariance[t], exact_covariance, atol=1e-9)
    assert run.log_likelihood == pytest.approx(total, abs=1e-9)
    assert kalman_log_likelihood(traced, [experiment], theta) == run.log_likelihood
    twice = kalman_log_likelihood(traced, [experiment, experiment], theta)
    assert twice == pytest.approx(2 * total, abs=1e-8)


# -- published and tabulated values
def lgss(gain):
    model = Model("lgss")

    @model.prior
    def prior():
        return {"theta": D.Gamma(0.01, rate=0.01)}

    @model.initial
    def initial(theta):
        return {"x": D.Normal(0, precision=0.51 * theta)}

    @model.transition
    def transition(x, theta):
        return {"x": D.Normal(0.7 * x, precision=theta)}

    @model.observation
    def observation(x):
        return {"y": D.Normal(gain * x, variance=0.1)}

    return trace(model)


@pytest.mark.parametrize(("name", "gain"), [("lgss_main_text", 0.5), ("lgss_appendix", 1.0)])
def test_lgss(name, gain, exact_values):
    traced = lgss(gain)
    experiments = bind(traced, {"y": datasets.load(name)["y"]})
    for text, exact in exact_values[name]["log_likelihood"].items():
        theta = np.array([float(text)])
        assert kalman_log_likelihood(traced, experiments, theta) == pytest.approx(exact, abs=1e-9)


def level(start, q, r):
    model = Model("local level")

    @model.initial
    def initial():
        return {"level": start}

    @model.transition
    def transition(level):
        return {"level": D.Normal(level, variance=q)}

    @model.observation
    def observation(level):
        return {"y": D.Normal(level, variance=r)}

    return trace(model)


def test_random_walk_from_a_known_start(exact_values):
    traced, exact = level(D.Normal(0, variance=1), 1, 2), exact_values["scalar_lg"]
    (experiment,) = bind(traced, {"y": [0.0, 1.0, 2.0]})
    run = kalman_filter(traced, experiment, np.zeros(0))
    assert run.log_likelihood == pytest.approx(exact["log_likelihood"], abs=1e-6)
    np.testing.assert_allclose(run.mean[:, 0], exact["filter_means"], atol=1e-3)
    np.testing.assert_allclose(run.covariance[:, 0, 0], exact["filter_variances"], atol=1e-3)


# -- numbers that ruin the textbook form
def test_precise_measurements_of_a_vague_state():
    """Subtraction of covariances would leave nothing of the posterior variance."""
    traced = level(D.Normal(0, variance=1e10), 1e-12, 1e-14)
    (experiment,) = bind(traced, {"y": np.zeros(50)})
    run = kalman_filter(traced, experiment, np.zeros(0))
    precision = 1e-10 + 1e14
    for t in range(50):
        assert run.covariance[t, 0, 0] == pytest.approx(1 / precision, rel=1e-9)
        precision = 1 / (1 / precision + 1e-12) + 1e14


def test_square_root_of_semidefinite_matrices():
    rng = np.random.default_rng(0)
    for n in range(1, 6):
        for rank in range(n + 1):
            half = rng.normal(size=(n, rank))
            c = half @ half.T
            root = np.empty((n, n))
            assert kernel.square_root(c, root)
            np.testing.assert_allclose(root @ root.T, c, atol=1e-7)
    for bad in ([[1.0, 2.0], [2.0, 1.0]], [[-1.0]], [[np.nan]], [[0.0, 1.0], [1.0, 0.0]],
                [[np.inf]]):  # fmt: skip
        assert not kernel.square_root(np.array(bad), np.empty((len(bad), len(bad))))


@pytest.mark.parametrize("zeros", [0.0, 0.5])
@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 3), (3, 7), (5, 6)])
def test_reflections_keep_the_product(shape, zeros):
    rng = np.random.default_rng(1)
    a = rng.normal(size=shape) * (rng.random(shape) >= zeros)
    columns = a.T.copy()
    kernel.reflect_columns(columns, shape[1], shape[0], np.empty(shape[0]))
    np.testing.assert_allclose(columns.T @ columns, a @ a.T, atol=1e-12)
    assert not np.tril(columns, -1).any()


# -- what does not exist
def test_parameters_without_a_density():
    model = Model()

    @model.prior
    def prior():
        return {"q": D.Normal(0, sd=1)}

    @model.initial
    def initial():
        return {"x": D.Normal(0, sd=1)}

    @model.transition
    def transition(x, q):
        return {"x": D.Normal(x, variance=q)}

    @model.observation
    def observation(x, q):
        return {"y": D.Normal(x, sd=0.1)}

    traced = trace(model)
    (experiment,) = bind(traced, {"y": [0.1, 0.2, 0.3]})
    assert kalman_log_likelihood(traced, [experiment], np.array([-1.0])) == -np.inf
    with pytest.raises(
        SamplingError, match=r"(?s)positive semidefinite at t=2; parameters: q = -1"
    ):
        kalman_filter(traced, experiment, np.array([-1.0]))
    assert np.isfinite(kalman_log_likelihood(traced, [experiment], np.array([0.0])))


def test_refuses_other_models():
    model = Model()

    @model.initial
    def initial():
        return {"x": D.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": D.Normal(np.sin(x), sd=1)}

    @model.observation
    def observation(x):
        return {"y": D.Normal(x, sd=1)}

    traced = trace(model)
    assert isinstance(kalman_model(traced), NotApplicable)
    assert kalman_model(traced).reason == linear_gaussian(traced).reason
    (experiment,) = bind(traced, {"y": [0.0]})
    with pytest.raises(ArgumentError, match="not linear and Gaussian"):
        kalman_log_likelihood(traced, [experiment], np.zeros(0))


@pytest.mark.slow
def test_compiled_once_for_all_processes(tmp_path):
    code = (
        "import numpy as np\n"
        "from ssmppl.codegen.modules.exact import exact_entry\n"
        "f = exact_entry('kalman_filter')\n"
        "one, e = np.eye(1), np.eye(1)[None]\n"
        "v, inc, y = np.zeros((1, 1)), np.empty(3), np.zeros((3, 1))\n"
        "f(v[0], one, e, v, e, e, v, e, y, y + 1, inc, *[np.empty((0,) + s) for s in"
        " ((1,), (1, 1)) * 3])\n"
        "print(sum(f.stats.cache_hits.values()), sum(f.stats.cache_misses.values()))\n"
    )
    for expected in ("0 1", "1 0"):
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True,
            env={**os.environ, "SSMPPL_CACHE": str(tmp_path)},
        )  # fmt: skip
        assert run.stdout.split() == expected.split()


@pytest.mark.filterwarnings("error")
def test_what_is_predicted_exactly_and_not_seen_has_no_rank():
    """Without a warning of NumPy's for 0 / 0."""
    model = ssm.Model("read exactly", inputs=("r",))
    model.initial(lambda: {"x": ssm.Dirac(0.0)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    y, r = np.array([np.nan, 1.0, np.nan, 2.0]), np.array([0.0, 0.0, 0.0, 1.0])
    found = ssm.kalman_filter(model, {"y": y, "r": r}, {})
    np.testing.assert_allclose(found["y_predicted_sd"].values[0], [0.0, 1.0, 1.0, np.sqrt(3.0)])
    expected = [np.nan, stats.norm.cdf(1.0), np.nan, stats.norm.cdf(1.0 / np.sqrt(3.0))]
    np.testing.assert_allclose(found["y_pit"].values[0], expected)
