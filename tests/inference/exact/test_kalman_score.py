"""The exact score and the observed information of linear Gaussian models."""

import mpmath as mp
import numpy as np
import pytest
from scipy import special

import ssmppl.language.distributions as D
from ssmppl import datasets
from ssmppl.data import bind
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.inference.exact.derivatives import jacobian
from ssmppl.inference.exact.kalman import filter_order, kalman_model
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace
from tests.codegen.kernels.test_kalman_adjoint import textbook
from tests.inference.exact.test_kalman import lgss
from tests.models.kalman import MODELS, posed, scalar, time_varying
from tests.statistics.checks import seed_of


@pytest.mark.parametrize(("name", "gain"), [("lgss_main_text", 0.5), ("lgss_appendix", 1.0)])
def test_score_of_the_embedded_series(name, gain, exact_values):
    traced = lgss(gain)
    model, experiments = kalman_model(traced), bind(traced, {"y": datasets.load(name)["y"]})
    values, best = exact_values[name], np.array([exact_values[name]["mle"]])
    value, gradient = model.score(experiments, np.array([1.0]))
    exact = mp_derivatives(gain, datasets.load(name)["y"])
    assert value == pytest.approx(values["log_likelihood"]["1.0"], abs=1e-9)
    assert gradient == pytest.approx([float(exact[0])], rel=1e-12)
    assert gradient == pytest.approx([values["score_at_1"]], rel=1e-8)
    assert abs(model.score(experiments, best)[1][0]) < 1e-6  # the maximum, rounded to 16 digits
    information = model.information(experiments, np.array([1.0]))
    assert information == pytest.approx(np.array([[-float(exact[1])]]), rel=1e-9)


def mp_derivatives(gain, y):
    """First and second derivative of log p(y | theta) at 1, in 60 digits."""

    def log_likelihood(theta):
        x, p, total = mp.mpf(0), 1 / (mp.mpf("0.51") * theta), mp.mpf(0)
        for v in y:
            s = mp.mpf(gain) ** 2 * p + mp.mpf("0.1")
            e = mp.mpf(float(v)) - gain * x
            total -= (mp.log(2 * mp.pi * s) + e**2 / s) / 2
            k = p * gain / s
            x, p = x + k * e, p * (1 - k * gain)
            x, p = mp.mpf("0.7") * x, mp.mpf("0.49") * p + 1 / theta
        return total

    with mp.workdps(60):
        h = mp.mpf(10) ** -20
        down, mid, up = (log_likelihood(1 + i * h) for i in (-1, 0, 1))
        return (up - down) / (2 * h), (up - 2 * mid + down) / h**2


def singular():
    """Everything depends on the parameters: A, b, C, d, Q of rank 1, R and the start's law."""
    model = Model("singular", inputs=("u",))

    @model.prior
    def prior():
        return {"a": D.Uniform(-1, 1), "g": D.Normal(np.zeros(2), sd=1), "s": D.Gamma(1, rate=1)}

    @model.initial
    def initial(a, s, u):
        return {"x": D.Normal(a * u, variance=s / (1 - a**2)), "z": D.Dirac(a**2)}

    @model.transition
    def transition(x, z, a, s, u, g):
        return {"x": D.Normal(a * x - 0.1 * z + g[0] * u, sd=s), "z": D.Dirac(z + np.sin(a) * x)}

    @model.observation
    def observation(x, z, g, s, u):
        mean = np.stack([g[0] * x + g[1] * u, z - g[1] * x])
        cross = 0.3 * s
        return {"y": D.MvNormal(mean, covariance=np.stack([np.stack([s + 0.2, cross]),
                                                           np.stack([cross, s])]))}  # fmt: skip

    return model, {"a": 0.5, "g": np.array([0.7, -0.4]), "s": 0.6}, {"u": ()}


def matrix_valued():
    """A covariance that is itself a parameter."""
    model = Model("matrix parameter")

    @model.prior
    def prior():
        return {"Q": D.InverseWishart(5.0, scale=np.eye(2)), "L": D.Normal(np.zeros((2, 2)), sd=1)}

    @model.initial
    def initial():
        return {"x": D.MvNormal(np.zeros(2), covariance=np.eye(2))}

    @model.transition
    def transition(x, Q, L):
        return {"x": D.MvNormal(0.3 * L @ x, precision=Q)}

    @model.observation
    def observation(x, Q):
        return {"y": D.MvNormal(x, covariance=Q)}

    q = np.array([[1.2, 0.3], [0.3, 0.8]])
    return model, {"Q": q, "L": np.array([[1.0, -0.5], [0.2, 0.8]])}, {}


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("build", [*MODELS, singular, matrix_valued])
def test_score_is_the_slope_of_the_likelihood(build, missing):
    traced, theta, experiment, _ = posed(build, missing, seed=seed_of("score", missing) % 1000)
    if not len(theta):
        return
    model = kalman_model(traced)
    value, gradient = model.score([experiment, experiment], theta)
    assert value == pytest.approx(model.log_likelihood([experiment, experiment], theta), abs=1e-9)
    slope, error = jacobian(
        lambda v: np.array([model.log_likelihood([experiment], v)]), theta,
        0.1 * np.maximum(abs(theta), 0.1),
    )  # fmt: skip
    assert (error < 1e-8 * (1 + abs(slope))).all()  # what the reference is good for
    np.testing.assert_allclose(gradient, 2 * slope[0], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("build", [scalar, time_varying, singular])
def test_information_is_the_curvature(build):
    """Against second differences of second differences: of the likelihood alone."""
    traced, theta, experiment, _ = posed(build, 0.3, steps=12)
    model = kalman_model(traced)
    found = model.information([experiment], theta)
    np.testing.assert_array_equal(found, found.T)
    step = 0.1 * np.maximum(abs(theta), 0.1)

    def slope(v):
        value = lambda w: np.array([model.log_likelihood([experiment], w)])  # noqa: E731
        return jacobian(value, v, step)[0][0]

    exact, error = jacobian(slope, theta, step)
    size = np.sqrt(np.outer(abs(np.diag(found)), abs(np.diag(found))))
    assert (error < 1e-6 * size).all()
    assert (abs(found + (exact + exact.T) / 2) < 1e-6 * size).all()


def test_parts_that_are_fixed():
    traced, theta, experiment, _ = posed(singular, 0.0)
    model = kalman_model(traced)
    free = np.array([True, False, True, False])
    full, part = (model.score([experiment], theta, f)[1] for f in (None, free))
    np.testing.assert_array_equal(part, np.where(free, full, 0.0))
    information = model.information([experiment], theta, free)
    assert not information[~free].any()
    assert not information[:, ~free].any()
    both = np.ix_(free, free)
    np.testing.assert_allclose(
        information[both], model.information([experiment], theta)[both], rtol=1e-7
    )


def test_where_there_is_no_density_or_no_second_derivative():
    traced, _, experiment, _ = posed(scalar, 0.0)
    model = kalman_model(traced)
    value, gradient = model.score([experiment], np.array([0.5, -1.0, 1.0]))
    assert value == -np.inf
    assert np.isnan(gradient).all()
    with pytest.raises(SamplingError, match="no second derivative"):
        model.information([experiment], np.array([0.5, 0.0, 1.0]))


def test_what_has_no_derivative_is_named():
    model = Model("opaque")

    @model.prior
    def prior():
        return {"a": D.Normal(0, sd=1), "q": D.Gamma(1, rate=1)}

    @model.initial
    def initial():
        return {"z": D.Normal(0, sd=1), "x": D.Normal(0, sd=1)}

    @model.transition
    def transition(x, z, a, q):
        return {"z": D.Normal(0.5 * z, sd=1),
                "x": D.Normal(x + special.gammainc(a, 1.0), variance=q)}  # fmt: skip

    @model.observation
    def observation(x):
        return {"y": D.Normal(x, sd=0.5)}

    traced = trace(model)
    experiments = bind(traced, {"y": [0.1, 0.5, -0.2]})
    theta = np.array([0.3, 0.4])
    found = kalman_model(traced)
    with pytest.raises(
        ArgumentError, match=r"score in a .*transition distribution: gammainc\(a, 1\)"
    ) as raised:
        found.score(experiments, theta)
    assert "x + special.gammainc(a, 1.0)" in str(raised.value)  # the line itself
    fixed = np.array([False, True])
    _, gradient = found.score(experiments, theta, fixed)
    slope, _ = jacobian(
        lambda q: np.array([found.log_likelihood(experiments, np.array([0.3, q[0]]))]),
        theta[1:], np.array([0.05]),
    )  # fmt: skip
    assert gradient[1] == pytest.approx(slope[0, 0], rel=1e-8)


def seasonal():
    """A level and a season of four rows, kept in a shift register."""
    model = Model("seasonal")

    @model.prior
    def prior():
        return {"q": D.Gamma(np.full(2, 2.0), rate=4.0), "r": D.Gamma(2, rate=4.0)}

    @model.initial
    def initial():
        return {n: D.Normal(0.5 * i, sd=1.0) for i, n in enumerate(("level", "s0", "s1", "s2"))}

    @model.transition
    def transition(level, s0, s1, s2, q):
        return {"level": D.Normal(level, variance=q[0]),
                "s0": D.Normal(-s0 - s1 - s2, variance=q[1]),
                "s1": D.Dirac(s0), "s2": D.Dirac(s1)}  # fmt: skip

    @model.observation
    def observation(level, s0, r):
        return {"y": D.Normal(level + s0, variance=r)}

    return model


def test_a_shift_register_is_filtered_from_its_end():
    """In another order than the trace's, to the same likelihood and score."""
    traced = trace(seasonal())
    model, theta = kalman_model(traced), np.array([0.3, 0.2, 0.4])
    assert filter_order(model.form) == [3, 2, 1, 0]
    y = np.random.default_rng(4).normal(size=30)
    y[[5, 6, 20]] = np.nan
    (experiment,) = bind(traced, {"y": y})

    def by_hand(v):
        given = model.matrices(experiment, v)
        return np.array([textbook(given, experiment.y, experiment.seen)])

    value, gradient = model.score([experiment], theta)
    assert value == pytest.approx(by_hand(theta)[0], abs=1e-11)
    assert model.log_likelihood([experiment], theta) == pytest.approx(value, abs=1e-11)
    slope, _ = jacobian(by_hand, theta, 0.1 * theta)
    np.testing.assert_allclose(gradient, slope[0], rtol=1e-9, atol=1e-9)
