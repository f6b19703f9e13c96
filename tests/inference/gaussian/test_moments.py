"""Approximate filters, smoothers and draws: exact where the model is linear and Gaussian; elsewhere
against laws computed on a grid, with the order of what they leave out; and by hand."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError, SSMError
from tests.inference.gaussian.test_laplace import linear
from tests.statistics.checks import seed_of

KINDS = ("laplace", "extended", "unscented")
AT = {"a": 0.9, "r": 0.4}


def observed(steps=25):
    rng = np.random.default_rng(seed_of("moments"))
    y, w, u = rng.standard_normal((3, steps))
    y[2:5] = w[4] = w[-1] = np.nan
    return {"y": y, "w": w, "u": u}


@pytest.mark.parametrize("kind", KINDS)
def test_filters_of_a_linear_model_are_exact(kind):
    data = [observed(), observed(7)]
    exact = ssm.kalman_filter(linear(), data, AT)
    found = ssm.kalman_filter(linear(), data, AT, proposal=kind)
    for e, f in zip(exact, found, strict=True):
        assert f.attrs["approximate"] == 1
        assert f.attrs["proposal"] == kind
        assert set(e.variables) == set(f.variables)
        for name in e.data_vars:
            np.testing.assert_allclose(f[name], e[name], rtol=1e-8, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_smoothers_of_a_linear_model_are_exact(kind):
    exact = ssm.smooth(linear(), observed(), AT, "kalman")
    found = ssm.smooth(linear(), observed(), AT, proposal=kind)
    assert found.attrs["approximate"] == 1
    assert "approximate" not in exact.attrs
    assert found.attrs["log_likelihood"] == pytest.approx(exact.attrs["log_likelihood"], rel=1e-9)
    for name in exact.data_vars:
        np.testing.assert_allclose(found[name], exact[name], rtol=1e-7, atol=1e-8, err_msg=name)
    named = ssm.smooth(linear(), observed(), AT, kind)
    np.testing.assert_array_equal(named["x"], found["x"])


@pytest.mark.parametrize("kind", KINDS)
def test_draws_of_a_linear_model_have_the_exact_law(kind):
    exact = ssm.smooth(linear(), observed(12), AT, "kalman")
    n = 4000
    drawn = ssm.smooth(linear(), observed(12), AT, proposal=kind, trajectories=n, seed=3)
    paths = np.concatenate([drawn["x"].values, drawn["z"].values[..., None]], axis=-1)
    mean = np.concatenate([exact["x"].values[0], exact["z"].values[0][:, None]], axis=-1)
    covariance, cross = exact["covariance"].values[0], exact["covariance_previous"].values[0]
    off = paths - mean
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.all(np.abs(off.mean(axis=0)) < 4.5 * sd / np.sqrt(n))
    scale = np.einsum("ti,tj->tij", sd, sd)
    now = np.einsum("nti,ntj->tij", off, off) / n
    # the variance of a product of two Gaussians is at most twice the product of theirs
    assert np.all(np.abs(now - covariance) < 4.5 * np.sqrt(2.0 / n) * scale)
    before = np.einsum("nti,ntj->tij", off[:, 1:], off[:, :-1]) / n
    wide = np.einsum("ti,tj->tij", sd[1:], sd[:-1])
    assert np.all(np.abs(before - cross[1:]) < 4.5 * np.sqrt(2.0 / n) * wide)


def bent():
    """A state that turns, seen through a curve: one dimension, so that a grid tells all. d is the
    size of all that is random."""
    model = ssm.Model("bent")
    model.prior(lambda: {"d": ssm.HalfNormal(sd=1)})
    model.initial(lambda d: {"x": ssm.Normal(0.2, sd=0.6 * d)})
    model.transition(lambda x, d: {"x": ssm.Normal(0.8 * x + 0.3 * np.sin(2 * x), sd=0.3 * d)})
    model.observation(lambda x, d: {"y": ssm.Normal(x + 0.1 * x**2, sd=0.4 * d)})
    return model


def bent_data(d):
    """What is seen of the path without noise, and residuals of the size of d."""
    x, y = 0.2, []
    for off in (0.5, 0.9, np.nan, -0.3, 0.1, 0.8, -0.4, 0.2):
        y.append(x + 0.1 * x**2 + 0.5 * d * off)
        x = 0.8 * x + 0.3 * np.sin(2 * x)
    return {"y": np.array(y)}


BENT = bent_data(1.0)


def on_a_grid(y, d):
    """(means (T,), sds (T,)) of the filter, and of the smoother."""
    x = np.linspace(-1.5, 2.5, 2401)
    h = x[1] - x[0]
    move = stats.norm.pdf(x[:, None], 0.8 * x + 0.3 * np.sin(2 * x), 0.3 * d) * h
    p, filtered, likelihoods = stats.norm.pdf(x, 0.2, 0.6 * d), [], []
    for t, seen in enumerate(y):
        p = move @ p if t else p
        g = stats.norm.pdf(seen, x + 0.1 * x**2, 0.4 * d) if np.isfinite(seen) else np.ones(len(x))
        p = p * g
        p = p / (p.sum() * h)
        filtered.append(p)
        likelihoods.append(g)
    smoothed, later = [], np.ones(len(x))
    for t in range(len(y) - 1, -1, -1):
        q = filtered[t] * later
        smoothed.insert(0, q / (q.sum() * h))
        later = (move.T / h) @ (likelihoods[t] * later) * h
        later /= later.max()

    def moments(laws):
        mean = np.array([(q * x).sum() * h for q in laws])
        return mean, np.sqrt(np.array([(q * x**2).sum() * h for q in laws]) - mean**2)

    return moments(filtered), moments(smoothed)


@pytest.mark.parametrize("kind", KINDS)
def test_what_they_leave_out_shrinks_with_the_noise(kind):
    """Laws are Gaussian up to terms of the order of all spreads: a quarter of these, a quarter of
    what is left out, in standard deviations."""
    worst = []
    for d in (0.2, 0.05):
        data = bent_data(d)
        (mean, sd), (smooth_mean, smooth_sd) = on_a_grid(data["y"], d)
        f = ssm.kalman_filter(bent(), data, {"d": d}, proposal=kind)
        g = ssm.smooth(bent(), data, {"d": d}, proposal=kind)
        off = [np.abs(f["x"].values[0] - mean) / sd, np.abs(f["x_sd"].values[0] / sd - 1.0),
               np.abs(g["x"].values[0] - smooth_mean) / smooth_sd,
               np.abs(g["x_sd"].values[0] / smooth_sd - 1.0)]  # fmt: skip
        worst.append([o.max() for o in off])
    assert np.all(np.array(worst[1]) < 0.35 * np.array(worst[0])), worst
    assert np.all(np.array(worst[1]) < 0.05), worst


def test_the_unscented_filter_by_hand():
    """One step and one update, written with NumPy."""
    y, d = np.array([0.5, 0.9]), 1.0
    found = ssm.kalman_filter(bent(), {"y": y}, {"d": d}, proposal="unscented")
    mean, variance, total = 0.2, 0.36, 0.0
    for t in range(2):
        if t:  # two components: x and e, kappa = 1
            reach = np.sqrt(3.0)
            x = mean + np.sqrt(variance) * reach * np.array([0, 1, -1, 0, 0])
            e = reach * np.array([0, 0, 0, 1, -1])
            moved = 0.8 * x + 0.3 * np.sin(2 * x) + 0.3 * e
            w = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6])
            mean = w @ moved
            variance = w @ (moved - mean) ** 2
        x = mean + np.sqrt(3.0 * variance) * np.array([0, 1, -1])
        w = np.array([2 / 3, 1 / 6, 1 / 6])
        seen = x + 0.1 * x**2
        middle = w @ seen
        spread = w @ (seen - middle) ** 2 + 0.16
        cross = w @ ((x - mean) * (seen - middle))
        assert found["y_predicted"].values[0, t] == pytest.approx(middle, rel=1e-12)
        assert found["y_predicted_sd"].values[0, t] == pytest.approx(np.sqrt(spread), rel=1e-12)
        total += stats.norm.logpdf(y[t], middle, np.sqrt(spread))
        mean = mean + cross / spread * (y[t] - middle)
        variance = variance - cross**2 / spread
        assert found["x"].values[0, t] == pytest.approx(mean, rel=1e-12)
        assert found["x_sd"].values[0, t] == pytest.approx(np.sqrt(variance), rel=1e-12)
    value = ssm.log_likelihood(bent(), {"y": y}, {"d": d}, proposal="unscented")[0]
    assert value == pytest.approx(total, rel=1e-12)


def test_a_law_without_variance_has_no_unscented_filter():
    model = ssm.Model("wild")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * np.sin(x), sd=1)})
    model.observation(lambda x: {"y": ssm.StudentT(1, x, scale=1)})
    data = {"y": np.zeros(5)}
    with pytest.raises(ArgumentError, match="no mean, or no variance"):
        ssm.kalman_filter(model, data, {}, proposal="unscented")
    assert np.isfinite(ssm.smooth(model, data, {}, proposal="laplace").attrs["log_likelihood"])


def test_what_is_asked_for_wrongly_is_said():
    walk = ssm.Model("walk")
    walk.initial(lambda: {"n": ssm.Poisson(5)})
    walk.transition(lambda n: {"n": ssm.Poisson(n + 0.1)})
    walk.observation(lambda n: {"y": ssm.Normal(n, sd=1)})
    data = {"y": np.arange(4.0)}
    for kind in KINDS:
        with pytest.raises(ArgumentError, match="Poisson, not driven by Gaussian noise"):
            ssm.smooth(walk, data, {}, proposal=kind)
    with pytest.raises(ArgumentError, match="beside method"):
        ssm.smooth(bent(), BENT, {"d": 1.0}, "ffbsi", proposal="laplace")
    with pytest.raises(ArgumentError, match="use one of: kalman, laplace"):
        ssm.kalman_filter(bent(), BENT, {"d": 1.0}, proposal="bootstrap")
    with pytest.raises(SSMError):
        ssm.smooth(bent(), BENT, {"d": 1.0}, ssm.KalmanSmoother("nonsense"))
