"""`score`: exact on linear Gaussian models; by particles against quadrature, within its errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.errors import ArgumentError
from ssmppl.inference.particles.scores import SmootherRun, combine, run_weights
from tests.models import standard as models
from tests.statistics.checks import seed_of, some
from tests.statistics.exact import DenseGaussian

VARVES = {(0.95, 50.0): "0.95,50", (0.9, 20.0): "0.9,20"}


@pytest.mark.parametrize(("name", "c"), some([("lgss_main_text", 0.5), ("lgss_appendix", 1.0)], 1))
def test_the_exact_score_of_the_linear_series(name, c, exact_values):
    data = {"y": datasets.load(name)["y"]}
    found = ssm.score(models.lgss, data, {"theta": 1.0}, fixed={"c": c})
    assert found.gradient["theta"] == pytest.approx(exact_values[name]["score_at_1"], abs=1e-8)
    assert found.gradient_errors == {"theta": 0.0}
    assert found.log_likelihood == pytest.approx(exact_values[name]["log_likelihood"]["1.0"])
    assert "exact" in found.attrs["method"]
    top = ssm.score(models.lgss, data, {"theta": exact_values[name]["mle"]}, fixed={"c": c})
    assert abs(top.gradient["theta"]) < 1e-6
    assert top.information.loc["theta", "theta"] > 0


def dense(model_matrices, y, **parameters):
    return DenseGaussian(y, **model_matrices(**parameters)).log_likelihood


@pytest.mark.slow
def test_particles_agree_with_the_exact_score_of_a_deterministic_position():
    """A position that integrates a velocity, with the step h a parameter: Fisher's identity through
    the recursion of sensitivities, against the dense Gaussian's derivative."""
    rng = np.random.default_rng(seed_of("vehicle score"))
    y = np.cumsum(0.4 * np.ones(12)) + 0.5 * rng.normal(size=12)
    h, step = 0.35, 1e-4
    values = [dense(models.vehicle_matrices, y, h=h + k * step) for k in (-1, 0, 1)]
    slope = (values[2] - values[0]) / (2 * step)
    curve = -(values[2] - 2 * values[1] + values[0]) / step**2
    found = ssm.score(models.vehicle, {"y": y}, {"h": h}, proposal="bootstrap", particles=400,
                      trajectories=200, repeats=30, seed=seed_of("vehicle runs"))  # fmt: skip
    z = (found.gradient["h"] - slope) / found.gradient_errors["h"]
    z2 = (found.information.loc["h", "h"] - curve) / found.information_errors.loc["h", "h"]
    print(f"score {z:+.2f}, information {z2:+.2f} standard errors off")
    assert abs(z) < 4
    assert abs(z2) < 4
    assert found.gradient_errors["h"] < 0.2 * np.sqrt(curve), "too noisy to tell"
    exact = ssm.score(models.vehicle, {"y": y}, {"h": h})
    assert exact.gradient["h"] == pytest.approx(slope, rel=1e-6)
    assert exact.information.loc["h", "h"] == pytest.approx(curve, rel=1e-4)


@pytest.mark.parametrize(("at", "key"), some(VARVES.items(), 1))
def test_the_score_of_the_varves(at, key, exact_values):
    exact = dict(zip(("phi", "tau"), exact_values["ice_varves"]["score_at"][key], strict=True))
    found = ssm.score(models.varves, {"y": datasets.ice_varves()},
                      dict(zip(("phi", "tau"), at, strict=True)), particles=500, trajectories=300,
                      repeats=24, seed=seed_of("varves score", at))  # fmt: skip
    assert found.attrs["weighted"]
    for name, value in exact.items():
        z = (found.gradient[name] - value) / found.gradient_errors[name]
        print(f"{name}: {found.gradient[name]:.4f}, exact {value:.4f}, {z:+.2f} errors off")
        assert abs(z) < 4
    assert found.gradient_errors["phi"] < 1.5
    assert found.gradient_errors["tau"] < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("at", "key"), VARVES.items())
def test_weights_take_away_the_bias_of_order_one_over_n(at, key, exact_values):
    """With as few particles as leave equally weighted runs several of these errors off (3 to 5 at
    (0.95, 50)), the weighted score is within its error, and twice the particles do not move it."""
    exact = np.array(exact_values["ice_varves"]["score_at"][key])
    parameters = dict(zip(("phi", "tau"), at, strict=True))
    answers, errors = [], []
    for particles in (400, 800):
        found = ssm.score(models.varves, {"y": datasets.ice_varves()}, parameters,
                          particles=particles, trajectories=200, repeats=100,
                          seed=seed_of("bias", at, particles))  # fmt: skip
        answers.append(np.array(list(found.gradient.values())))
        errors.append(np.array(list(found.gradient_errors.values())))
        z = (answers[-1] - exact) / errors[-1]
        print(particles, np.round(z, 2))
        assert np.all(np.abs(z) < 4)
    assert np.all(np.abs(answers[0] - answers[1]) < 4 * np.hypot(*errors))


@pytest.mark.slow
def test_the_observed_information_of_the_varves(exact_values):
    """The exact inverse is given; the information is compared, whose entries have errors."""
    top, exact = exact_values["ice_varves"]["mle"], exact_values["ice_varves"]
    inverse = np.array(exact["inverse_observed_information_at_mle"])
    found = ssm.score(models.varves, {"y": datasets.ice_varves()}, top, particles=1000,
                      trajectories=1000, repeats=50, seed=seed_of("information"))  # fmt: skip
    z = (found.information.values - np.linalg.inv(inverse)) / found.information_errors.values
    print(np.round(z, 2))
    assert np.all(np.abs(z) < 4)
    relative = found.information_errors.values.diagonal() / found.information.values.diagonal()
    assert np.all(relative < 0.15)


def runs_of(seed, repeats, bias=0.0):
    """Runs whose mean is biased by minus the covariance with the likelihood estimate."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(repeats):
        noise = rng.normal(size=2)
        log_z = 0.6 * noise[0] - 0.18
        mean = np.array([1.0 - 0.6 + noise[0], 2.0 + noise[1] + bias])
        square = np.array([[4.0, 1.0], [1.0, 6.0]])
        out.append(SmootherRun(log_z, mean, square, -np.diag([9.0, 7.0])))
    return out


def test_weighted_runs_have_the_smoothed_mean():
    """E[Z m] / E[Z] is (1, 2) here, while E[m] is (0.4, 2); errors cover what they should."""
    z, share = [], []
    for k in range(300):
        found = combine(runs_of((seed_of("weighted"), k), 60))
        error = np.sqrt(np.diagonal(found.gradient_covariance))
        z.append((found.gradient - [1.0, 2.0]) / error)
        share.append(found.information)
    z = np.array(z)
    assert np.all(np.abs(z.mean(axis=0)) < 0.25)  # a bias of 1/60 is left
    assert np.all(np.abs(z.std(axis=0) - 1) < 0.15)
    # E[-H] - E[SS'] + E[S]E[S]' with E[S] = (1, 2), of which a bias of order 1/60 is left too
    exact = np.diag([9.0, 7.0]) - [[4.0, 1.0], [1.0, 6.0]] + np.outer([1, 2], [1, 2])
    assert np.max(np.abs(np.mean(share, axis=0) - exact)) < 0.15


def test_uneven_weights_are_not_used():
    assert np.allclose(run_weights(np.array([0.0, -50.0, -60.0, -55.0])), 0.25)
    assert np.ptp(run_weights(np.array([0.0, -0.5, -0.2, -1.0]))) > 0
    assert np.allclose(run_weights(np.array([0.0, -800.0])), 0.5), "one run alone"


def test_vectors_matrices_and_names():
    """Independent Gaussian rows: closed forms of every entry, and what is fixed is left out."""
    model = ssm.Model("named")
    model.prior(lambda: {"mu": ssm.Normal(np.zeros(2), sd=1),
                         "C": ssm.InverseWishart(6, scale=np.eye(2))})  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda x, mu, C: {"y": ssm.MvNormal(mu + 0.0 * x, covariance=C)})
    y = np.random.default_rng(seed_of("named")).normal(size=(40, 2))
    mu, c = np.array([0.1, -0.2]), np.array([[1.0, 0.3], [0.3, 0.8]])
    found = ssm.score(model, {"y": y}, {"mu": mu, "C": c})
    s = np.linalg.inv(c)
    np.testing.assert_allclose(found.gradient["mu"], s @ (y - mu).sum(axis=0), rtol=1e-8)
    slope = 0.5 * (s @ ((y - mu).T @ (y - mu)) @ s - 40 * s)
    slope[0, 1] = slope[1, 0] = 2 * slope[0, 1]  # the mirror image moves along
    np.testing.assert_allclose(found.gradient["C"], slope, rtol=1e-8)
    assert list(found.information.columns) == ["mu[0]", "mu[1]", "C[0, 0]", "C[1, 0]", "C[1, 1]"]
    np.testing.assert_allclose(found.information.values[:2, :2], 40 * s, rtol=1e-6)
    part = ssm.score(model, {"y": y}, {"mu": mu}, fixed={"C": c})
    assert list(part.gradient) == list(part.gradient_errors) == ["mu"]
    np.testing.assert_allclose(part.information, 40 * s, rtol=1e-6)
    assert "mu[1]" in repr(part)


@ssm.primitive
def doubled(a):
    return 2.0 * a


def also_doubled(a):
    return 2.0 * a * (special.gammainc(1.0 + a * a, 1.0) + special.gammaincc(1.0 + a * a, 1.0))


@pytest.mark.parametrize(("gain", "differenced"), [(also_doubled, True), (doubled, False)])
def test_a_likelihood_is_differenced_where_a_matrix_has_no_derivative(gain, differenced):
    """And says so; a primitive has one."""

    def of(law):
        model = ssm.Model("gain")
        model.prior(lambda: {"a": ssm.Normal(0.3, sd=1)})
        model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
        model.transition(lambda x, a: {"x": ssm.Normal(law(a) * x, sd=1)})
        model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
        return model

    y = np.random.default_rng(seed_of("gain")).normal(size=30)
    plain, opaque = (ssm.score(of(g), {"y": y}, {"a": 0.3}) for g in (lambda a: 2.0 * a, gain))
    assert ("central_differences" in opaque.attrs) == differenced
    assert "central_differences" not in plain.attrs
    assert opaque.gradient["a"] == pytest.approx(plain.gradient["a"], rel=1e-8)
    np.testing.assert_allclose(opaque.information, plain.information, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ({"parameters": {"phi": 2.0, "tau": 1.0}}, "phi"),
        ({"parameters": {"phi": 0.9}}, "no value is given"),
        ({"repeats": 1}, "repeats=1"),
        ({"fixed": {"phi": 0.9, "tau": 20.0}, "parameters": {}}, "all of them are fixed"),
        ({"kernel": "fast", "particles": 20}, "kernel='fast'"),
        ({"proposal": "kalman"}, "linear Gaussian"),
    ],
)
def test_what_is_refused(arguments, found):
    given = {"parameters": {"phi": 0.9, "tau": 20.0}, "proposal": "bootstrap"} | arguments
    with pytest.raises(ArgumentError, match=found):
        ssm.score(models.varves, {"y": datasets.ice_varves()[:20]}, **given)


def test_where_there_is_no_finite_slope_score_says_so():
    model = ssm.Model("root")
    model.prior(lambda: {"b": ssm.HalfNormal(sd=1.0), "c": ssm.Normal(0.0, sd=1.0)})
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x: {"x": ssm.Normal(0.9 * x, sd=1.0)})
    model.observation(lambda x, b, c: {"y": ssm.Normal(x + np.sqrt(b) + c, sd=1.0)})
    data = {"y": np.ones(5)}
    with pytest.warns(UserWarning, match=r"gradient is not finite.*the score in b is inf$"):
        found = ssm.score(model, data, {"b": 0.0, "c": 0.0})
    near = ssm.score(model, data, {"b": 1e-12, "c": 0.0})
    assert found.gradient["c"] == pytest.approx(near.gradient["c"], rel=1e-5)


def test_runs_that_few_of_count_are_said(recwarn):
    """A heavy-tailed track of which the first and the last row are known: no filter looks ahead."""
    model = ssm.Model("track", inputs=("precision",))
    model.prior(lambda: {"s": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {"x": ssm.StudentT(4, x, scale=s)})
    model.observation(lambda x, precision: {"y": ssm.Normal(x, sd=precision)})
    data = {"y": np.array([0.0, *[np.nan] * 10, 3.0])}

    def scored(sd, proposal):
        given = data | {"precision": np.full(12, sd)}
        return ssm.score(
            model, given, {"s": 0.5}, seed=1, particles=500, repeats=8, proposal=proposal
        )

    scored(0.5, "bootstrap")
    found = scored(1e-8, "auto")  # tempered
    assert not recwarn.list
    error = found.log_likelihood_error
    assert found.log_likelihood == pytest.approx(log_density_of_the_last(3.0, 0.5), abs=5 * error)
    with pytest.warns(UserWarning, match="the 8 runs have a standard deviation of .*bootstrap"):
        scored(1e-3, "bootstrap")


def log_density_of_the_last(y, s):
    """Of the sum of eleven steps, by their characteristic function, with the first row's at 0."""
    h = 0.01
    x = np.arange(-30_000, 30_000) * h
    step = np.fft.fft(np.fft.ifftshift(stats.t(4, scale=s).pdf(x))) * h
    total = np.real(np.fft.fftshift(np.fft.ifft(step**11))) / h
    return float(np.log(np.interp(y, x, total)) + stats.norm.logpdf(0.0))
