"""Leave-future-out scores against the exact predictive densities of a grid over the parameters."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import ssmppl as ssm
from ssmppl.errors import ArgumentError
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.run.problem import pose
from ssmppl.inference.verbs.leave_future_out import _smoothed
from tests.statistics.checks import MCSE, seed_of

STEPS, MISSING = 30, 19


def autoregression(observed):
    model = ssm.Model("autoregression")
    model.prior(lambda: {"a": ssm.Uniform(-1, 1), "tau": ssm.Gamma(2, rate=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a, tau: {"x": ssm.Normal(a * x, precision=tau)})
    model.observation(observed)
    return model


def plain():
    return autoregression(lambda x: {"y": ssm.Normal(x, sd=0.5)})


@pytest.fixture(scope="module")
def y():
    made = ssm.simulate(plain(), {"a": 0.7, "tau": 1.0}, steps=STEPS, seed=seed_of("lfo"))
    y = made["y"].values[0]
    y[MISSING] = np.nan
    return y


@pytest.fixture(scope="module")
def exact(y):
    return by_grid(y)


def by_grid(y):
    """log p(y_t | y_{1:t-1}) for every t, by a grid over a and tau."""
    a, tau = np.meshgrid(np.linspace(-0.995, 0.995, 100), np.linspace(0.02, 9, 150))
    problem = pose(plain(), {"y": y})
    model = kalman_model(problem.trace)
    rows = np.array([
        model.filter(problem.experiments[0], np.array(theta)).log_increments
        for theta in zip(a.ravel(), tau.ravel(), strict=True)
    ])  # fmt: skip
    given = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(rows, axis=1)], axis=1)
    given += (np.log(tau) - tau).ravel()[:, None]
    return logsumexp(given[:, 1:], axis=0) - logsumexp(given[:, :-1], axis=0)


@pytest.mark.parametrize("threshold", [0.7, pytest.param(-2.0, marks=pytest.mark.slow)])
def test_scores_are_those_of_the_grid(threshold, y, exact):
    """With weighted draws all along, and with new ones for many a row."""
    found = ssm.leave_future_out(
        plain(), {"y": y}, first=12 if threshold > 0 else 26, draws=400, warmup=300, chains=2,
        threshold=threshold, seed=seed_of("lfo", threshold), progress=False,
    )  # fmt: skip
    rows = found["time"].values - 1
    there = rows != MISSING
    z = (found["elpd"].values - exact[rows])[there] / found["mc_error"].values[there]
    assert np.abs(z).max() < MCSE
    assert np.all(found["mc_error"].values[there] < 0.1)
    assert np.isnan(found["elpd"].values[~there]).all()
    assert found.attrs["elpd"] == pytest.approx(found["elpd"].values[there].sum())
    assert found.attrs["refits"] == found["sampled_anew"].values.sum()
    if threshold > 0:
        assert found.attrs["refits"] < 3
    else:
        assert found.attrs["refits"] == len(rows)


def test_rows_without_data_leave_the_draws_as_good_as_they_were(y):
    """Their weights are all equal, which needs no new draws; nor do the rows after them."""
    y = y.copy()
    y[11:19] = np.nan
    found = ssm.leave_future_out(
        plain(), {"y": y}, first=12, draws=400, warmup=300, chains=2,
        seed=seed_of("lfo gap"), progress=False,
    )  # fmt: skip
    assert not found["sampled_anew"].values[1:10].any()
    assert np.isneginf(found["pareto_shape"].values[:10]).all()
    row = found.sel(time=21)
    error = float(row["elpd"]) - by_grid(y)[20]
    assert abs(error) < MCSE * float(row["mc_error"])


def test_weights_without_a_tail_need_no_smoothing():
    """Equal up to rounding, or a good share at their greatest, as likelihoods that say yes or no
    give; fewer at their greatest are no sample to trust."""
    rng = np.random.default_rng(1)
    for log_w in (
        np.zeros(500),
        3.0 + 1e-13 * rng.normal(size=500),
        np.where(np.arange(500) % 3, -np.inf, 2.0),
        np.where(np.arange(500) % 3, np.log(0.25), 0.0),
    ):
        smoothed, shape = _smoothed(log_w)
        assert shape == -np.inf
        w = np.exp(log_w)
        assert np.exp(smoothed) == pytest.approx(w / w.sum(), rel=1e-9)
    assert _smoothed(np.where(np.arange(500) < 3, 0.0, -np.inf))[1] == np.inf
    assert _smoothed(np.full(500, -np.inf))[1] == np.inf
    assert abs(_smoothed(0.1 * rng.normal(size=500))[1]) < 0.5
    assert _smoothed(2.0 * rng.standard_exponential(500))[1] > 0.7  # no variance: k = 2


@pytest.mark.slow
def test_scores_by_particle_filters(y, exact):
    """The same model of exp(y), which no longer is linear and Gaussian."""
    model = autoregression(lambda x: {"y": ssm.LogNormal(x, sd=0.5)})
    found = ssm.leave_future_out(
        model, {"y": np.exp(y)}, first=15, draws=1000, warmup=500, particles=500,
        seed=seed_of("lfo particles"), progress=False,
    )  # fmt: skip
    rows = found["time"].values - 1
    there = rows != MISSING
    z = (found["elpd"].values - exact[rows] + y[rows])[there] / found["mc_error"].values[there]
    assert np.abs(z).max() < MCSE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"first": 1}, "first=1"),
        ({"first": 31}, "the data have 30 rows"),
        ({"particles": 0}, "particles=0"),
    ],
)
def test_what_is_out_of_range_is_refused(change, message, y):
    with pytest.raises(ArgumentError, match=message):
        ssm.leave_future_out(plain(), {"y": y}, **change)


def panel(experiment=None):
    """One unknown level, seen by everybody with noise of variance 1: all is known exactly."""
    model = ssm.Model("level", experiment=experiment)
    model.prior(lambda: {"mu": ssm.Normal(0, sd=2)})
    model.initial(lambda: {"x": ssm.Dirac(0.0)})
    model.transition(lambda x: {"x": ssm.Dirac(x)})
    model.observation(lambda x, mu: {"y": ssm.Normal(x + mu, sd=1)})
    return model


@pytest.mark.parametrize("labelled", [True, False])
def test_several_experiments_go_on_together(labelled):
    """By their labels: what comes earlier in one tells of the others, and nothing later does."""
    rng = np.random.default_rng(seed_of("panel"))
    times = {"oak": [1, 2, 3, 5, 6], "elm": [4, 5, 7]}
    y = {k: 1.5 + rng.normal(size=len(v)) for k, v in times.items()}
    y["oak"][3] = np.nan
    data = {k: {"y": v, **({"time": times[k]} if labelled else {})} for k, v in y.items()}
    found = ssm.leave_future_out(panel(), data, first=3, seed=1, draws=2000, progress=False)
    at = times if labelled else {k: list(range(1, len(v) + 1)) for k, v in times.items()}
    labels = sorted({t for own in at.values() for t in own})[2:]
    assert found["time"].values.tolist() == labels
    assert found["elpd"].dims == ("experiment", "time")
    total, limit = 0.0, MCSE
    for k, own in at.items():
        for t in labels:
            got = found.sel(experiment=k, time=t)
            if t not in own or np.isnan(y[k][own.index(t)]):
                assert np.isnan(float(got["elpd"]))
                continue
            past = [v for n in at for s, v in zip(at[n], y[n], strict=True) if s < t and v == v]
            precision = 1 / 4 + len(past)
            expected = stats.norm.logpdf(
                y[k][own.index(t)], sum(past) / precision, np.sqrt(1 + 1 / precision)
            )
            assert abs(float(got["elpd"]) - expected) < limit * float(got["mc_error"])
            total += float(got["elpd"])
    assert found.attrs["elpd"] == pytest.approx(total)


def test_an_experiment_that_begins_later_is_not_sampled_before():
    """The rows of a later record are predicted from those of the first, then from its own too."""
    first = {"y": np.full(4, 3.0), "time": [1, 2, 3, 4]}
    second = {"y": np.full(2, -3.0), "time": [5, 6]}
    found = ssm.leave_future_out(panel(), [first, second], first=5, seed=1, progress=False)
    assert np.isnan(found["elpd"].values[0]).all()
    early, later = found["elpd"].values[1]
    assert later > early  # one of its rows is known


def test_parameters_that_are_all_fixed_leave_nothing_to_integrate_out():
    model = ssm.Model("walk")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, sd=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.raises(ArgumentError, match="no parameter is free"):
        ssm.leave_future_out(model, {"y": np.zeros(9)}, fixed={"q": 1.0})


def test_particles_of_two_experiments_are_their_own():
    """Equal data, and estimates that differ by the noise of the filters."""
    model = ssm.Model("counts")
    model.prior(lambda: {"q": ssm.Gamma(2, rate=10)})
    model.initial(lambda: {"x": ssm.Normal(1, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(0.9 * x, variance=q)})
    model.observation(lambda x: {"y": ssm.Poisson(np.exp(x))})
    data = [{"y": [2, 4, 3, 1, 2]}] * 2
    found = ssm.leave_future_out(
        model, data, first=3, draws=50, warmup=50, chains=2, particles=20, seed=1, progress=False,
        method=ssm.PMMH(particles=20),
    )  # fmt: skip
    one, other = found["elpd"].values
    assert np.all(one != other)
    np.testing.assert_allclose(one, other, atol=1.0)
