"""`maximize` and `Estimate`: exact maxima, the chain rule, and what has to be refused or said."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.data import unpack_parameters
from ssmppl.errors import ArgumentError
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.inference.maximum.ascent import Ascent, UnconstrainedTransform
from ssmppl.inference.preparation.exact_score import ExactScore
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose
from ssmppl.inference.verbs import maximize as verb
from tests.models import standard as models
from tests.statistics.checks import seed_of

LGSS = [("lgss_main_text", 0.5), ("lgss_appendix", 1.0)]

# Every kind of transform, one with a bound that is another parameter.
shapes = ssm.Model("shapes")


@shapes.prior
def shapes_prior():
    return {
        "free": ssm.Normal(np.zeros(2), sd=1),
        "positive": ssm.Gamma(2, rate=1),
        "between": ssm.Uniform(-1, 2),
        "p": ssm.Dirichlet(np.array([2.0, 3.0, 4.0])),
        "S": ssm.Wishart(5, scale=np.array([[0.5, 0.1], [0.1, 0.4]])),
    }


@shapes.prior
def shapes_prior_above(positive):
    return {"above": ssm.Truncated(ssm.Normal(0, sd=2), lower=positive)}


@shapes.initial
def shapes_initial():
    return {"x": ssm.Normal(0, sd=1)}


@shapes.transition
def shapes_transition(x):
    return {"x": ssm.Normal(x, sd=1)}


@shapes.observation
def shapes_observation(x):
    return {"y": ssm.Normal(x, sd=1)}


@pytest.fixture(scope="module")
def shaped():
    problem = pose(shapes, {"y": np.zeros(3)})
    space = space_of(problem, {"free": np.array([0.3, -0.2])}, {})
    z = np.random.default_rng(seed_of("chart")).normal(size=len(space.positions))
    return space, UnconstrainedTransform(space), z


def differences(function, z, h=1e-4):
    """Central differences, extrapolated; last axis that of z."""
    out = []
    for unit in np.eye(len(z)):
        one, two = ((function(z + k * h * unit) - function(z - k * h * unit)) / (2 * k * h)
                    for k in (1, 2))  # fmt: skip
        out.append((4 * one - two) / 3)
    return np.stack(out, axis=-1)


def test_first_derivatives_on_the_unconstrained_scale(shaped):
    space, transform, z = shaped
    point = transform.at(z)
    np.testing.assert_allclose(point.theta, space.parameters(z)[0])
    assert point.log_prior + point.log_jacobian == pytest.approx(space.parameters(z)[1], rel=1e-12)
    expected = differences(lambda v: space.parameters(v)[0].copy(), z)
    np.testing.assert_allclose(point.jacobian, expected, atol=1e-8)
    np.testing.assert_array_equal(point.jacobian[:2], 0.0)  # the fixed ones
    total = differences(lambda v: np.float64(space.parameters(v)[1]), z)
    np.testing.assert_allclose(point.d_log_prior + point.d_log_jacobian, total, atol=1e-7)
    own = differences(lambda v: np.float64(transform.at(v).log_jacobian), z)
    np.testing.assert_allclose(point.d_log_jacobian, own, atol=1e-7)


def test_second_derivatives_on_the_unconstrained_scale(shaped):
    _, transform, z = shaped
    rng = np.random.default_rng(seed_of("weights"))
    weights = rng.normal(size=len(transform.symbols))
    found = transform.curvature(z, weights)
    np.testing.assert_allclose(
        found.theta, differences(lambda v: transform.at(v).pull(weights), z), atol=1e-7
    )
    for name in ("log_prior", "log_jacobian"):
        expected = differences(lambda v, n=name: getattr(transform.at(v), f"d_{n}"), z)
        np.testing.assert_allclose(getattr(found, name), expected, atol=1e-6)


def test_outside_of_floating_point_there_is_no_prior(shaped):
    _, transform, z = shaped
    assert transform.at(np.full(len(z), 800.0)).log_prior == -np.inf


@pytest.fixture(scope="module")
def lgss_estimates():
    return {
        name: ssm.maximize(models.lgss, {"y": datasets.load(name)["y"]}, fixed={"c": c},
                           seed=1, progress=False)
        for name, c in LGSS
    }  # fmt: skip


@pytest.mark.parametrize(("name", "c"), LGSS)
def test_direct_optimisation_finds_the_exact_maximum(name, c, lgss_estimates, exact_values):
    estimate, exact = lgss_estimates[name], exact_values[name]
    assert estimate.attrs["method"] == "DirectOptimization"
    assert "linear Gaussian" in estimate.attrs["method_chosen"]
    assert estimate.attrs["converged"]
    assert estimate.parameters["theta"] == pytest.approx(exact["mle"], abs=1e-6)
    assert estimate.log_likelihood == pytest.approx(exact["max_log_likelihood"], abs=1e-9)

    # the standard error against second differences of the exact likelihood
    def value(theta):
        parameters = {"theta": theta, "c": c}
        data = {"y": datasets.load(name)["y"]}
        return ssm.log_likelihood(models.lgss, data, parameters)[0]

    top, h = estimate.parameters["theta"], 1e-3
    curve = -(value(top + h) - 2 * value(top) + value(top - h)) / h**2
    assert estimate.standard_errors["theta"] == pytest.approx(curve**-0.5, rel=1e-4)


def test_an_estimate_names_its_parts(lgss_estimates):
    estimate = lgss_estimates["lgss_main_text"]
    assert estimate.parameters["c"] == 0.5
    assert set(estimate.standard_errors) == {"theta"}
    assert list(estimate.covariance.index) == list(estimate.covariance.columns) == ["theta"]
    assert estimate.iterates["theta"].dims == ("iteration",)
    assert estimate.iterates["theta"].values[-1] == pytest.approx(estimate.parameters["theta"])
    text = repr(estimate)
    assert "0.757987" in text and "fixed" in text and "-101.9317" in text  # noqa: PT018


@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_vectors_and_matrices_against_closed_forms(objective):
    """Independent rows y ~ N(mu, S^-1): the mean and the inverse covariance of the sample."""
    model = ssm.Model("rows")

    @model.prior
    def prior():
        return {
            "mu": ssm.Normal(np.zeros(2), sd=0.5),
            "C": ssm.InverseWishart(6, scale=np.array([[3.0, 0.5], [0.5, 2.0]])),
        }

    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda x, mu, C: {"y": ssm.MvNormal(mu + 0.0 * x, covariance=C)})
    rng = np.random.default_rng(seed_of("rows"))
    y = rng.multivariate_normal([1.0, -1.0], [[1.0, 0.6], [0.6, 2.0]], size=60)
    estimate = ssm.maximize(model, {"y": y}, objective=objective, seed=1, progress=False)
    mu, c = estimate.parameters["mu"], estimate.parameters["C"]
    labels = ["mu[0]", "mu[1]", "C[0, 0]", "C[1, 0]", "C[1, 1]"]
    assert list(estimate.covariance.index) == labels
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
    assert estimate.standard_errors["C"].shape == (2, 2)
    if objective == "likelihood":
        np.testing.assert_allclose(mu, y.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(c, np.cov(y, rowvar=False, bias=True), atol=1e-6)
        np.testing.assert_allclose(
            estimate.covariance.values[:2, :2], c / len(y), rtol=1e-5, atol=1e-8
        )
        variance = 2 * c[0, 0] ** 2 / len(y)
        assert estimate.covariance.loc["C[0, 0]", "C[0, 0]"] == pytest.approx(variance, rel=1e-4)
        return

    def log_posterior(mu, c):
        return (stats.multivariate_normal.logpdf(y, mu, c).sum() - 2 * (mu @ mu)
                + stats.invwishart.logpdf(c, 6, np.array([[3.0, 0.5], [0.5, 2.0]])))  # fmt: skip

    moves = [np.array([[1, 0], [0, 0]]), np.array([[0, 1], [1, 0]]), np.array([[0, 0], [0, 1]])]
    slopes = [(log_posterior(mu + h, c) - log_posterior(mu - h, c)) for h in 1e-5 * np.eye(2)]
    slopes += [(log_posterior(mu, c + 1e-5 * m) - log_posterior(mu, c - 1e-5 * m)) for m in moves]
    np.testing.assert_allclose(np.array(slopes) / 2e-5, 0.0, atol=2e-4)
    h = 1e-3 * np.eye(2)[0]
    curve = -(log_posterior(mu + h, c) - 2 * log_posterior(mu, c) + log_posterior(mu - h, c)) / 1e-6
    precision = np.linalg.inv(estimate.covariance.values)
    assert precision[0, 0] == pytest.approx(curve, rel=1e-4)


def test_flat_priors_and_several_experiments():
    """The mean of all rows, with its standard error, under Flat; HalfFlat for the variance."""
    model = ssm.Model("flat")
    model.prior(lambda: {"m": ssm.Flat(), "v": ssm.HalfFlat()})
    model.initial(lambda m: {"x": ssm.Dirac(m)})
    model.transition(lambda m: {"x": ssm.Dirac(m)})
    model.observation(lambda x, v: {"y": ssm.Normal(x, variance=v)})
    rng = np.random.default_rng(seed_of("flat"))
    data = [{"y": rng.normal(3, 2, size=n)} for n in (20, 30)]
    y = np.concatenate([d["y"] for d in data])
    estimate = ssm.maximize(model, data, seed=1, progress=False)
    assert estimate.parameters["m"] == pytest.approx(y.mean(), abs=1e-6)
    assert estimate.parameters["v"] == pytest.approx(y.var(), rel=1e-6)
    assert estimate.standard_errors["m"] == pytest.approx(y.std() / np.sqrt(50), rel=1e-5)
    assert estimate.standard_errors["v"] == pytest.approx(y.var() * np.sqrt(2 / 50), rel=1e-5)


def test_nothing_free_gives_the_likelihood_alone(exact_values):
    name, c = LGSS[0]
    estimate = ssm.maximize(models.lgss, {"y": datasets.load(name)["y"]},
                            fixed={"theta": 1.0, "c": c}, progress=False)  # fmt: skip
    assert estimate.parameters == {"theta": 1.0, "c": c}
    assert estimate.covariance.empty
    assert estimate.standard_errors == {}
    assert estimate.log_likelihood == pytest.approx(exact_values[name]["log_likelihood"]["1.0"])
    assert "every parameter is fixed" in estimate.attrs["method_chosen"]
    assert "likelihood of the given parameters" in str(estimate)
    assert "maximum" not in str(estimate)


def test_a_likelihood_without_a_maximum_is_not_called_converged():
    """One row at its mean: the likelihood grows without bound as the variance vanishes."""
    model = ssm.Model("spike")
    model.prior(lambda: {"v": ssm.HalfFlat()})
    model.initial(lambda: {"x": ssm.Dirac(0.0)})
    model.transition(lambda x: {"x": ssm.Dirac(x)})
    model.observation(lambda x, v: {"y": ssm.Normal(x, variance=v)})
    estimate = ssm.maximize(model, {"y": np.zeros(3)}, seed=1, progress=False)
    assert not estimate.attrs["converged"]
    assert np.isnan(estimate.standard_errors["v"])
    assert "not converged" in repr(estimate)


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ({"method": ssm.PGAS()}, "not a maximisation method"),
        ({"objective": "evidence"}, "objective='evidence'"),
        ({"start": {"theta": -1.0}}, "start: parameter 'theta'"),
        ({"start": {"nothing": 1.0}}, "start names 'nothing'"),
        ({"start": {"c": 1.0}, "fixed": {"c": 0.5}}, "in start and in fixed"),
        ({"seed": -1}, "seed=-1"),
        ({"method": ssm.DirectOptimization(steps=0)}, "steps=0"),
        ({"method": ssm.ScoreAscent(steps="far")}, "steps='far'"),
        ({"method": ssm.ScoreAscent(tolerance=0.0)}, "tolerance=0.0"),
        ({"method": ssm.ScoreAscent(runs=1)}, "runs=1"),
    ],
)
def test_what_is_refused(arguments, found):
    data = {"y": datasets.load("lgss_main_text")["y"]}
    with pytest.raises(ArgumentError, match=found.replace("(", r"\(")):
        ssm.maximize(models.lgss, data, progress=False, **arguments)


def test_direct_optimisation_of_several_nonlinear_states_is_refused_with_the_reason():
    model = ssm.Model("two")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(a * np.sin(x), sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x[0], sd=1)})
    method = ssm.DirectOptimization(laplace=False)
    with pytest.raises(ArgumentError, match="2 components") as raised:
        ssm.maximize(model, {"y": np.zeros(4)}, method, progress=False)
    assert "ScoreAscent" in raised.value.fix


def test_an_interrupted_climb_gives_the_best_so_far(monkeypatch):
    """Ctrl-C comes at the fifth evaluation: the best of the four before it is returned."""
    seen = []
    plain = ExactScore.score

    def interrupted(self, theta):
        if len(seen) == 4:
            raise KeyboardInterrupt
        seen.append((plain(self, theta)[0], theta[0]))
        return plain(self, theta)

    monkeypatch.setattr(ExactScore, "score", interrupted)
    data = {"y": datasets.load("lgss_main_text")["y"]}
    estimate = ssm.maximize(models.lgss, data, fixed={"c": 0.5}, start={"theta": 5.0}, seed=1,
                            progress=False)  # fmt: skip
    assert estimate.attrs["interrupted"]
    assert estimate.parameters["theta"] == pytest.approx(max(seen)[1])
    assert np.isnan(estimate.standard_errors["theta"])
    assert "interrupted" in repr(estimate)
    seen[:] = []
    monkeypatch.setattr(ExactScore, "score", _interrupt)
    with pytest.raises(KeyboardInterrupt):
        ssm.maximize(models.lgss, data, fixed={"c": 0.5}, seed=1, progress=False)


def _interrupt(*_):
    raise KeyboardInterrupt


def test_a_full_start_is_where_the_climb_begins():
    data = {"y": datasets.load("lgss_main_text")["y"]}
    estimate = ssm.maximize(models.lgss, data, start={"theta": 3.0}, fixed={"c": 0.5}, seed=1,
                            progress=False)  # fmt: skip
    assert estimate.iterates["theta"].values[0] == pytest.approx(3.0)


def test_a_prior_without_derivative_in_closed_form_is_differenced():
    """Truncated Gamma with an unknown shape: its normalising constant has none."""
    model = ssm.Model("hierarchy")
    model.prior(lambda: {"k": ssm.Gamma(2, rate=1)})
    model.prior(lambda k: {"m": ssm.Truncated(ssm.Gamma(k, rate=1), upper=4)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, m: {"x": ssm.Normal(m * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    space = space_of(pose(model, {"y": np.zeros(3)}), {}, {})
    transform, z = UnconstrainedTransform(space), space.z.copy()
    point = transform.at(z)
    expected = differences(lambda v: np.float64(space.parameters(v)[1]), z)
    np.testing.assert_allclose(point.d_log_prior + point.d_log_jacobian, expected, atol=1e-5)
    assert np.all(np.isfinite(transform.curvature(z, np.ones(2)).log_prior))
    assert set(unpack_parameters(space.problem.trace, point.theta)) == {"k", "m"}


@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_the_objective_of_each_iterate_is_kept_and_not_computed_again(monkeypatch, objective):
    y = ssm.simulate(models.stationary, {"phi": 0.7, "tau": 2.0}, steps=40, seed=3)["y"].values[0]
    plain, calls = KalmanModel.log_likelihood, []
    monkeypatch.setattr(
        KalmanModel, "log_likelihood", lambda *args: calls.append(1) or plain(*args)
    )
    found = ssm.maximize(
        models.stationary, {"y": y}, ssm.DirectOptimization(), objective=objective, seed=1,
        progress=False,
    )  # fmt: skip
    assert len(calls) < 3  # at the end, not at each iterate
    monkeypatch.undo()
    way = found.iterates
    assert len(way["iteration"]) > 6
    phi, tau = way["phi"].values, way["tau"].values
    exact = np.array([
        ssm.log_likelihood(models.stationary, {"y": y}, {"phi": p, "tau": t})[0]
        for p, t in zip(phi, tau, strict=True)
    ])  # fmt: skip
    if objective == "posterior":
        exact += stats.gamma(6, scale=1 / 3).logpdf(tau) + stats.uniform(-0.5, 1.48).logpdf(phi)
    np.testing.assert_allclose(way["objective"].values, exact, atol=1e-8)


def test_an_ascent_may_know_its_likelihood_and_its_error(monkeypatch):
    """What a method tells is what the estimate tells."""

    def climb(setup, method):
        theta = setup.space.theta.copy()
        theta[0] = 2.0
        error = np.zeros((2, 2))
        error[0, 0] = 0.25
        return Ascent(theta, -7.0, theta[None], {"converged": True}, np.diag([4.0, 0.0]), error)

    monkeypatch.setitem(verb.METHODS, ssm.DirectOptimization, climb)
    data = {"y": datasets.load("lgss_main_text")["y"]}
    estimate = ssm.maximize(models.lgss, data, fixed={"c": 0.5}, progress=False)
    assert estimate.log_likelihood == -7.0
    assert estimate.standard_errors["theta"] == pytest.approx(0.5)
    assert estimate.attrs["monte_carlo_errors"] == {"theta": 0.5}


def test_the_diffuse_maximum_of_the_nile():
    """Level and noise variance as Durbin and Koopman (2012, section 2.10) print them."""
    model = ssm.Model("nile level")
    model.prior(lambda: {"r": ssm.HalfFlat(), "q": ssm.HalfFlat()})
    model.initial(lambda: {"x": ssm.Flat()})
    model.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, variance=r)})
    estimate = ssm.maximize(model, {"y": datasets.nile()}, seed=1, progress=False)
    assert estimate.attrs["converged"]
    assert estimate.parameters["r"] == pytest.approx(15098.5, abs=0.06)
    assert estimate.parameters["q"] == pytest.approx(1469.17, abs=0.02)
    assert estimate.log_likelihood == pytest.approx(-632.5456, abs=1e-4)


def test_an_estimate_at_the_edge_of_its_support_says_so():
    """All of thirty throws come up: the likelihood grows up to p = 1; of q it has a maximum."""
    model = ssm.Model("throws")
    model.prior(lambda: {"p": ssm.Uniform(0, 1), "q": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(np.sin(x) + q, sd=1)})
    model.observation(lambda x, p: {"y": ssm.Bernoulli(p), "z": ssm.Normal(x, sd=1)})
    z = np.random.default_rng(1).normal(size=30)
    data = {"y": np.ones(30), "z": z}
    held = ssm.maximize(model, data, seed=1, progress=False)
    assert held.attrs["held_at_edge"] == {"p": 1.0}
    assert np.isnan(held.standard_errors["p"])
    assert "p" in "".join(held.notes)
    method = ssm.DirectOptimization(laplace=False)  # which does not look for edges
    found = ssm.maximize(model, data, method, seed=1, progress=False)
    assert held.parameters["q"] == pytest.approx(
        found.parameters["q"], abs=0.2 * held.standard_errors["q"]
    )
    assert found.attrs["at_edge"] == {"p": 1.0}
    (note,) = found.notes
    assert note.startswith("p is within a standard error of 1, the boundary")
    half = ssm.maximize(
        model, {"y": np.arange(30.0) % 2, "z": z}, seed=1, progress=False, fixed={"q": 0.0}
    )
    assert not half.notes
    assert abs(half.parameters["p"] - 0.5) < 0.01


def test_a_step_that_is_lost_to_rounding_does_not_end_the_climb():
    """Variances of all sizes beside flat starts: the filters disagree at one point of the way."""
    from ssmppl.datasets import airline

    def found(scale):
        y = np.log(np.asarray(airline(), dtype=float)) * scale
        y[[30, 31, 32, 77]] = np.nan
        model = ssm.Model("airline")
        parts = ssm.structural.trend(model), ssm.structural.seasonal(model, 12)
        ssm.structural.observe(model, "y", *parts)
        return ssm.maximize(model, {"y": y}, seed=1, progress=False)

    one, other = found(1e6), found(1e3)
    assert one.attrs["converged"]
    for name in ("level_sd", "season_sd", "y_sd"):
        assert one.parameters[name] == pytest.approx(1e3 * other.parameters[name], rel=1e-3)
