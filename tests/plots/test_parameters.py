"""`plot_prior_posterior`, `plot_maximization` and `plot_likelihood`."""

import dataclasses

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.contour import QuadContourSet
from scipy import stats

import ssmppl as ssm
from ssmppl.drawing.style import MAIN, OTHER
from ssmppl.errors import ArgumentError
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.run.problem import pose
from ssmppl.language.tracing import trace
from ssmppl.plots.density import estimated, priors_of
from ssmppl.plots.likelihood import surface
from tests.plots.results import TRUTH, counts, data, level, maximised, sampled, smoothed

mpl.use("Agg")


@pytest.fixture(autouse=True)
def _closed():
    yield
    pyplot.close("all")


def labelled(ax, label):
    return [line for line in ax.lines if line.get_label() == label]


# -- densities
def test_kernel_estimates_come_near_the_density_and_integrate_to_one():
    draws = np.random.default_rng(1).normal(size=20_000)
    x = np.linspace(-4, 4, 300)
    found = estimated(draws, x)
    np.testing.assert_allclose(found, stats.norm.pdf(x), atol=0.02)
    assert np.trapezoid(found, x) == pytest.approx(1.0, abs=5e-3)


def test_at_the_end_of_a_support_nothing_is_lost_or_beyond():
    draws = np.random.default_rng(1).exponential(size=20_000)
    x = np.linspace(-1, 8, 901)
    found = estimated(draws, x, lower=0.0)
    assert np.all(found[x < 0] == 0.0)
    assert np.trapezoid(found, x) == pytest.approx(1.0, abs=0.01)
    assert found[x >= 0][0] > 0.85  # without reflection half of it


def test_draws_outside_of_the_window_count():
    draws = np.concatenate([np.random.default_rng(1).normal(size=5000), np.full(5000, 1e6)])
    x = np.linspace(-4, 4, 300)
    assert np.trapezoid(estimated(draws, x), x) == pytest.approx(0.5, abs=0.01)


def test_priors_are_exact_where_they_depend_on_nothing():
    model = ssm.Model("hierarchy")
    model.prior(lambda: {"a": ssm.Gamma(3, rate=2), "m": ssm.Normal(np.zeros(2), sd=[1.0, 2.0])})
    model.prior(lambda a: {"b": ssm.Exponential(rate=a), "flat": ssm.Flat()})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, m: {"x": ssm.Normal(x + m[0], sd=1)})
    model.observation(lambda x, b, flat: {"y": ssm.Normal(x + flat, sd=b)})
    found = priors_of(trace(model))
    x = np.linspace(0.01, 4, 50)
    np.testing.assert_allclose(found["a"].density(x), stats.gamma.pdf(x, 3, scale=0.5))
    np.testing.assert_allclose(found["m[1]"].density(x), stats.norm.pdf(x, scale=2.0))
    assert (found["a"].lower, found["m[0]"].lower) == (0.0, -np.inf)
    assert not found["flat"].known


# -- plot_prior_posterior
def test_prior_posterior_and_chains_are_drawn():
    axes = ssm.plot_prior_posterior(sampled(), level)
    assert [ax.get_xlabel() for ax in axes] == ["q", "r"]
    (prior,) = labelled(axes[1], "prior")
    x = prior.get_xdata()
    np.testing.assert_allclose(prior.get_ydata(), stats.gamma.pdf(x, 2, scale=0.5), rtol=1e-6)
    draws = sampled()["posterior"]["r"].values
    (posterior,) = labelled(axes[1], "posterior")
    np.testing.assert_allclose(posterior.get_ydata(), estimated(draws.ravel(), x, 0.0))
    thin = [k for k in axes[1].lines if k.get_linewidth() == 0.6]
    assert len(thin) == 2
    np.testing.assert_allclose(thin[1].get_ydata(), estimated(draws[1], x, 0.0))
    assert (prior.get_color(), posterior.get_color()) == (OTHER, MAIN)
    assert x.min() >= 0.0
    assert x.min() < draws.min()
    assert x.max() > draws.max()
    assert axes[1].get_ylim()[1] >= max(k.get_ydata().max() for k in thin)


def test_a_group_of_prior_draws_does_as_well():
    prior = ssm.predict(level, data=data(), draws=3000, seed=1)
    ax = ssm.plot_prior_posterior(sampled(), prior, var_names="r")
    (line,) = labelled(ax, "prior")
    x = line.get_xdata()
    inside = (x > 0.4) & (x < 1.0)
    expected = stats.gamma.pdf(x[inside], 2, scale=0.5)
    np.testing.assert_allclose(line.get_ydata()[inside], expected, rtol=0.15)


def test_prior_and_posterior_have_to_be_there():
    with pytest.raises(ArgumentError, match=r"(?s)no group `prior`.*idata, model"):
        ssm.plot_prior_posterior(sampled())
    with pytest.raises(ArgumentError, match=r"(?s)neither a Model"):
        ssm.plot_prior_posterior(sampled(), 3)
    with pytest.raises(ArgumentError, match=r"(?s)'q', and the prior has not"):
        ssm.plot_prior_posterior(sampled(), counts)
    with pytest.raises(ArgumentError, match=r"(?s)'rr'.*takes: r, q"):
        ssm.plot_prior_posterior(sampled(), level, var_names="rr")
    with pytest.raises(ArgumentError, match=r"(?s)Dataset of.*ssm.sample"):
        ssm.plot_prior_posterior(smoothed(), level)


# -- plot_maximization
def test_the_way_the_estimate_and_its_error():
    estimate = maximised()
    axes = ssm.plot_maximization(estimate)
    assert [ax.get_ylabel() for ax in axes] == ["q", "r", "log-likelihood"]
    for ax, name in zip(axes, ("q", "r"), strict=False):
        path, at = ax.lines
        np.testing.assert_array_equal(path.get_ydata(), estimate.iterates[name])
        value, error = estimate.parameters[name], estimate.standard_errors[name]
        assert at.get_ydata()[0] == value
        if np.isfinite(error):
            (band,) = ax.patches
            low, high = band.get_extents().transformed(ax.transData.inverted()).intervaly
            np.testing.assert_allclose([low, high], [value - error, value + error])
        else:
            assert len(ax.patches) == 0
    assert axes[-1].get_xlabel() == "iteration"


@pytest.mark.parametrize("method", [ssm.EM(iterations=10), ssm.DirectOptimization(restarts=0)])
@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_exact_methods_tell_what_they_maximised(method, objective):
    estimate = ssm.maximize(level, data(), method, objective=objective, seed=1, progress=False)
    values = estimate.iterates["objective"].values
    prior = 0.0
    for k in (0, -1):
        here = {n: float(estimate.iterates[n].values[k]) for n in ("q", "r")}
        exact = ssm.log_likelihood(level, data(), here)[0]
        if objective == "posterior":
            prior = stats.halfnorm.logpdf(here["q"]) + stats.gamma.logpdf(here["r"], 2, scale=0.5)
        assert values[k] == pytest.approx(exact + prior, rel=1e-9)
    label = ssm.plot_maximization(estimate)[-1].get_ylabel()
    assert label.replace("\n", " ") == (
        "log-likelihood" if objective == "likelihood" else "log-likelihood + log prior"
    )


def test_fixed_parameters_have_no_panel_and_starts_one_line_each():
    held = dataclasses.replace(maximised(), standard_errors={"r": 0.1})
    axes = ssm.plot_maximization(held)
    assert [ax.get_ylabel() for ax in axes] == ["r", "log-likelihood"]
    iterates = maximised().iterates.drop_vars("objective")
    several = iterates.expand_dims(start=2).assign(
        perturbed_log_likelihood=(("start", "iteration"), np.ones((2, iterates.sizes["iteration"])))
    )
    axes = ssm.plot_maximization(dataclasses.replace(maximised(), iterates=several), var_names="r")
    assert len(axes[0].lines) == 3
    assert axes[1].get_ylabel() == "perturbed\nlog-likelihood"


def test_maximization_refuses_other_things():
    with pytest.raises(ArgumentError, match=r"(?s)InferenceData|DataTree.*ssm.maximize"):
        ssm.plot_maximization(sampled())
    with pytest.raises(ArgumentError, match=r"(?s)'phi'.*q, r|r, q"):
        ssm.plot_maximization(maximised(), var_names="phi")


# -- plot_likelihood
def test_the_surface_is_the_exact_likelihood():
    limits = {"q": (0.1, 1.0), "r": (0.3, 1.5)}
    ax = ssm.plot_likelihood(level, data(), parameters=TRUTH, limits=limits, points=5)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("q", "r")
    assert ax.get_xlim() == limits["q"]
    assert ax.get_ylim() == limits["r"]
    heights = np.array([
        [ssm.log_likelihood(level, data(), {"q": q, "r": r})[0] for q in np.linspace(0.1, 1, 5)]
        for r in np.linspace(0.3, 1.5, 5)
    ])  # fmt: skip
    lines = [c for c in ax.collections if isinstance(c, QuadContourSet)][1]
    np.testing.assert_allclose(lines.levels, np.log([0.01, 0.1, 0.5]))
    np.testing.assert_allclose(lines.zmax, 0.0)
    np.testing.assert_allclose(lines.zmin, max((heights - heights.max()).min(), -12.0))
    assert f"{heights.max():.1f}".replace("-", "−") in ax.figure.axes[1].get_ylabel()


def test_rows_of_the_surface_are_the_second_parameter():
    problem = pose(level, data())
    settings, root = FilterSettings(10, "kalman"), np.random.SeedSequence(1)
    q, r = np.array([0.2, 0.5, 0.9]), np.array([0.4, 1.1])
    found = surface(problem, np.array([1.0, 1.0]), [0, 1], q, r, settings, 1, root)
    expected = [[ssm.log_likelihood(level, data(), {"q": a, "r": b})[0] for a in q] for b in r]
    np.testing.assert_allclose(found, expected)


def test_particle_estimates_are_averaged_as_log_likelihood_does():
    y = {"y": [0, 1, 3, 2, 0]}
    limits = {"phi": (0.2, 0.9), "s": (0.2, 1.0)}
    ax = ssm.plot_likelihood(counts, y, limits=limits, points=3, particles=20, repeats=3, seed=4,
                             proposal="bootstrap")  # fmt: skip
    logs = np.array([
        [ssm.log_likelihood(counts, y, {"phi": p, "s": s}, particles=20, repeats=3, seed=4,
                            proposal="bootstrap") for p in np.linspace(0.2, 0.9, 3)]
        for s in np.linspace(0.2, 1.0, 3)
    ])  # fmt: skip
    expected = np.log(np.exp(logs).mean(axis=-1))
    lines = [c for c in ax.collections if isinstance(c, QuadContourSet)][1]
    np.testing.assert_allclose(lines.zmin, expected.min() - expected.max(), atol=1e-9)
    assert "3 particle estimates a point, 20 particles, bootstrap" in ax.get_title(loc="left")


def test_draws_and_paths_are_drawn_on_it():
    ax = ssm.plot_likelihood(level, data(), sampled(), ["r", "q"], points=3)
    (draws,) = labelled(ax, "draws")
    posterior = sampled()["posterior"]
    np.testing.assert_array_equal(draws.get_xdata(), posterior["r"].values.ravel())
    np.testing.assert_array_equal(draws.get_ydata(), posterior["q"].values.ravel())
    low, high = ax.get_xlim()
    assert 0 <= low < posterior["r"].values.min()
    assert high > posterior["r"].values.max()
    ax = ssm.plot_likelihood(level, data(), maximised(), points=3)
    (path,) = labelled(ax, "iterates")
    np.testing.assert_array_equal(path.get_ydata(), maximised().iterates["r"])
    (end,) = labelled(ax, "estimate")
    assert (end.get_xdata()[0], end.get_ydata()[0]) == tuple(maximised().parameters.values())
    assert ax.get_xlim()[0] >= 0.0  # no spread is negative


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"var_names": "q"}, "2|two parameters, and 1 is chosen: q"),
        ({"var_names": ["q", "w"]}, "'w'"),
        ({}, "(?s)which values of 'q'.*limits="),
        ({"limits": {"q": (1, 2)}}, "(?s)which values of 'r'"),
        ({"limits": {"q": (2, 1), "r": (1, 2)}}, "low < high"),
        ({"limits": {"w": (2, 1)}}, "names 'w'"),
        ({"points": 1}, "points=1"),
        ({"result": smoothed}, "Dataset of"),
    ],
)
def test_a_surface_needs_two_parameters_with_limits(options, found):
    if "result" in options:
        options = {"result": options["result"]()}
    with pytest.raises(ArgumentError, match=found):
        ssm.plot_likelihood(level, data(), **options)


def test_where_there_is_no_likelihood_nothing_is_drawn():
    with pytest.raises(ArgumentError, match="finite nowhere"):
        ssm.plot_likelihood(level, data(), limits={"q": (-2, -1), "r": (-2, -1)}, points=3)


def test_of_correlations_each_is_drawn_once():
    """Not the diagonal, nor the other half, unless they are asked for."""
    model = ssm.Model("correlated")
    model.prior(lambda: {"R": ssm.LKJ(2, 2), "sd": ssm.HalfNormal(sd=np.ones(2))})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x, R, sd: {
        "x": ssm.MvNormal(0.5 * x, covariance=sd[:, None] * R * sd[None, :])
    })  # fmt: skip
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.3)})
    data = {"y": np.random.default_rng(1).standard_normal((30, 2))}
    idata = ssm.sample(model, data, draws=20, warmup=20, chains=2, seed=1, progress=False)
    drawn = [a.get_xlabel() for a in np.ravel(ssm.plot_prior_posterior(idata, model))]
    assert drawn == ["R[0, 1]", "sd[0]", "sd[1]"]
    asked = ssm.plot_prior_posterior(idata, model, var_names=["R[1, 0]", "sd"])
    assert [a.get_xlabel() for a in np.ravel(asked)] == ["R[1, 0]", "sd[0]", "sd[1]"]
    estimate = ssm.maximize(model, data, seed=1)
    shown = [a.get_ylabel() for a in np.ravel(ssm.plot_maximization(estimate))]
    assert shown[:3] == ["R[0, 1]", "sd[0]", "sd[1]"]
    surface = ssm.plot_likelihood(model, data, estimate, points=3)
    assert [surface.get_xlabel(), surface.get_ylabel()] == ["R[1, 0]", "sd[0]"]
