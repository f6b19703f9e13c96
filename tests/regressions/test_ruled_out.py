"""Values and particles that the data rule out count for nothing, where the laws given them are
undefined or infinite too: against sums over all values and quadrature."""

import itertools
import warnings

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.codegen.kernels.math.flags import interpreted
from ssmppl.codegen.kernels.math.sums import weighted_statistics
from ssmppl.codegen.kernels.particle.conditional_smc import JOINING
from ssmppl.codegen.kernels.particle.weights import NAN
from ssmppl.inference.particles.backward import sweep_failure
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.statistics.checks import seed_of

REMOVED = np.array([3.0, 1.0, 1.0, 0.0, 1.0])
AT = {"p": 0.3, "lam": 6.0}
MOST = 60  # of a Poisson law of mean 6


def removal():
    """What is caught is taken out: a population below the catch is impossible, and has no law."""
    model = ssm.Model("removal")
    model.prior(lambda: {"p": ssm.Beta(2, 4), "lam": ssm.Gamma(10.0, rate=1.0)})
    model.initial(lambda lam: {"x": ssm.Poisson(lam)})
    model.transition(lambda x, y: {"x": ssm.Binomial(x - y, 0.9)})
    model.observation(lambda x, p: {"y": ssm.Binomial(x, p)})
    return model


def removal_exact(y, p, lam):
    """(log p(y), laws of x_t given y_1:t-1, given y_1:t, and given all), over 0, ..., MOST."""
    x = np.arange(MOST + 1)
    predicted, filtered, increments, moves = [], [], [], []
    law = stats.poisson.pmf(x, lam)
    for t in range(len(y)):
        if t:
            left = np.maximum(x - y[t - 1], 0.0)[:, None]
            moves.append(np.where(left >= 0, stats.binom.pmf(x[None, :], left, 0.9), 0.0))
            law = filtered[-1] @ moves[-1]
        predicted.append(law)
        joint = law * stats.binom.pmf(y[t], x, p)
        increments.append(np.log(joint.sum()))
        filtered.append(joint / joint.sum())
    smoothed = [filtered[-1]]
    for t in range(len(y) - 2, -1, -1):
        ratio = np.divide(smoothed[0], predicted[t + 1], where=predicted[t + 1] > 0,
                          out=np.zeros(len(x)))  # fmt: skip
        smoothed.insert(0, filtered[t] * (moves[t] @ ratio))
    return np.array(increments), *map(np.array, (predicted, filtered, smoothed))


@pytest.fixture(scope="module")
def exact():
    return removal_exact(REMOVED, **AT)


def test_filter_means_and_predictions(exact):
    _, predicted, filtered, _ = exact
    n, x = 40_000, np.arange(MOST + 1)
    found = ssm.particle_filter(
        removal(), {"y": REMOVED}, AT, particles=n, seed=seed_of("removal")
    ).isel(draw=0)
    mean, sd = filtered @ x, np.sqrt(filtered @ x**2 - (filtered @ x) ** 2)
    least = found.ess.values.min()
    assert np.all(np.abs(found.x.values - mean) < 5.0 * sd / np.sqrt(least))
    np.testing.assert_allclose(found.x_sd.values, sd, rtol=10.0 / np.sqrt(least))
    p = AT["p"]
    of_y = predicted @ (p * x)
    spread = np.sqrt(predicted @ (p * (1 - p) * x + (p * x) ** 2) - of_y**2)
    assert np.all(np.abs(found.y_predicted.values - of_y) < 5.0 * spread / np.sqrt(least))
    np.testing.assert_allclose(found.y_predicted_sd.values, spread, rtol=10.0 / np.sqrt(least))
    high = (predicted * stats.binom.cdf(REMOVED[:, None], x, p)).sum(axis=1)
    low = (predicted * stats.binom.cdf(REMOVED[:, None] - 1.0, x, p)).sum(axis=1)
    error = 5.0 / np.sqrt(least)
    assert np.all((found.y_pit.values > low - error) & (found.y_pit.values < high + error))


@pytest.mark.parametrize("ess_threshold", [1.0, 0.5, 0.1])
def test_the_likelihood_whenever_it_resamples(exact, ess_threshold):
    """Particles that are kept without weight move by laws that are undefined."""
    estimates = ssm.log_likelihood(
        removal(), {"y": REMOVED}, AT, particles=1000, repeats=100, proposal="bootstrap",
        ess_threshold=ess_threshold, seed=seed_of("removal", ess_threshold),
    )  # fmt: skip
    ratio = np.exp(estimates - exact[0].sum())
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std(ddof=1) / np.sqrt(len(ratio))


KERNELS = {
    "exact": ssm.FFBSi(proposal="bootstrap", kernel="exact"),
    "adaptive": ssm.FFBSi(proposal="bootstrap", kernel="exact", ess_threshold=0.5),
    "mcmc": ssm.FFBSi(proposal="bootstrap", kernel="mcmc"),
    "pgas": "pgas",
    "fixed lag": "fixed_lag",
}


@pytest.mark.parametrize("kernel", KERNELS)
def test_smoothing(exact, kernel):
    smoothed, x = exact[3], np.arange(MOST + 1)
    mean = smoothed @ x
    sd = np.sqrt(smoothed @ x**2 - mean**2)
    draws = {} if kernel == "fixed lag" else {"trajectories": 1000 if kernel != "pgas" else 4000}
    found = ssm.smooth(
        removal(), {"y": REMOVED}, AT, method=KERNELS[kernel], seed=seed_of("removal", kernel),
        particles=100 if kernel == "pgas" else 2000, **draws,
    )  # fmt: skip
    middle = found.x.values.mean(axis=0)
    size = 250.0  # effective draws, at the least, of the particles and of a chain of paths
    assert np.all(np.abs(middle - mean) < 5.0 * sd / np.sqrt(size))


def test_particle_gibbs_samples():
    """Its first sweep ended where the populations below the catch were weighed."""
    idata = ssm.sample(
        removal(), {"y": REMOVED}, ssm.PGAS(), draws=50, warmup=20, chains=1, seed=1,
        progress=False,
    )  # fmt: skip
    assert np.all(idata["posterior"].x.values[0, :, :-1] >= REMOVED[:-1])


def ratios():
    """x = 0 is impossible once something was counted, and nothing is said of where it leads."""
    model = ssm.Model("ratios")
    model.initial(lambda: {"x": ssm.Categorical(np.array([0.3, 0.3, 0.4]))})

    def transition(x, y):
        q = 0.5 * y / x / (1.0 + y / x)
        return {"x": ssm.Categorical(np.stack([0.2, 0.8 - q, q]))}

    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Poisson(x)})
    return model


def ratios_exact(y):
    """(log p(y), paths (M, T), their probabilities given y), of the paths that can be."""
    paths, joint = [], []
    for path in itertools.product(range(3), repeat=len(y)):
        if 0 in path[:-1]:
            continue
        value = [0.3, 0.3, 0.4][path[0]] * stats.poisson.pmf(y[0], path[0])
        for t in range(1, len(y)):
            q = 0.5 * y[t - 1] / path[t - 1] / (1.0 + y[t - 1] / path[t - 1])
            value *= [0.2, 0.8 - q, q][path[t]] * stats.poisson.pmf(y[t], path[t])
        paths.append(path)
        joint.append(value)
    return np.log(np.sum(joint)), np.array(paths), np.array(joint) / np.sum(joint)


def test_exact_passes_over_values_without_a_law():
    y = np.array([1.0, 2.0, 1.0, 3.0])
    log_p, paths, w = ratios_exact(y)
    model = ratios()
    assert ssm.log_likelihood(model, {"y": y}, {})[0] == pytest.approx(log_p, rel=1e-12)
    found = ssm.smooth(model, {"y": y}, {})
    mean = w @ paths
    away = paths - mean
    np.testing.assert_allclose(found.x.values[0], mean, rtol=1e-12)
    np.testing.assert_allclose(found.x_sd.values[0] ** 2, w @ away**2, rtol=1e-10)
    forward = ssm.forward_filter(model, {"y": y}, {}, seed=1)
    assert np.all(np.isfinite(forward.y_predicted_sd.values))
    n = 4000
    drawn = ssm.sample(
        model, {"y": y}, draws=n, warmup=0, chains=1, seed=seed_of("ratios"), progress=False
    )["posterior"].x.values[0]
    assert np.all(np.abs(drawn.mean(axis=0) - mean) < 4.0 * drawn.std(axis=0) / np.sqrt(n) + 1e-12)


def logs():
    """A value of probability 0 at which the spread of the observation is infinite."""
    model = ssm.Model("logs")
    model.initial(lambda: {"x": ssm.Categorical(np.array([0.0, 0.5, 0.5]))})
    model.transition(lambda x: {"x": ssm.Categorical(np.stack([0.0, 0.5, 0.5]))})
    model.observation(lambda x: {"y": ssm.Normal(0, sd=np.log(x) + 1.0)})
    return model


def test_exact_predictions_over_values_without_a_law():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ssm.forward_filter(logs(), {"y": [0.1, 0.2, -0.4]}, {})
    spread = np.sqrt(0.5 * (1.0 + (1.0 + np.log(2.0)) ** 2))
    np.testing.assert_allclose(found.y_predicted_sd.values[0], spread, rtol=1e-12)
    assert np.all(np.isfinite(found.y_pit.values))


def explosive():
    """Paths that grow beyond floating point while nothing is measured."""
    model = ssm.Model("explosive")
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=4.0)})
    model.transition(lambda x: {"x": ssm.Normal(np.exp(x) - 1.0, sd=1.0)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=3.0)})
    return model


UNSEEN = np.array([0.5, np.nan, np.nan, 0.1, -0.2])


def explosive_exact():
    """(log p(y_1:T), mean of x_t given y_1:t at the last rows), by quadrature on a grid."""
    x = np.linspace(-30.0, 30.0, 2001)
    width = x[1] - x[0]
    law, total = stats.norm.pdf(x, 0.0, 4.0), 0.0
    with np.errstate(over="ignore"):
        move = stats.norm.pdf(x[None, :], (np.exp(x) - 1.0)[:, None], 1.0)
    for t, y in enumerate(UNSEEN):
        if t:
            law = law @ move * width
        if np.isfinite(y):
            law = law * stats.norm.pdf(y, x, 3.0)
            total += np.log(law.sum() * width)
            law /= law.sum() * width
    return total, np.sum(law * x) * width


def test_filter_means_after_paths_left_the_numbers():
    log_p, mean = explosive_exact()
    n = 20_000
    found = ssm.particle_filter(
        explosive(), {"y": UNSEEN}, {}, particles=n, proposal="bootstrap", seed=3
    ).isel(draw=0)
    sd = found.x_sd.values[-1]
    assert abs(found.x.values[-1] - mean) < 5.0 * sd / np.sqrt(found.ess.values[-1])
    assert np.all(np.isfinite(found.x.values[3:]))
    assert np.all(np.isfinite(found.x_sd.values[3:]))
    assert found.log_likelihood_increment.sum() == pytest.approx(log_p, abs=0.05)
    lag = ssm.smooth(explosive(), {"y": UNSEEN}, {}, method="fixed_lag", seed=3)
    assert np.all(np.isfinite(lag.x.values))


def test_a_path_without_weight_adds_nothing():
    def statistics(theta, y, seen, u, steps, path, part):
        part[0] = path[0, 0]

    paths, weights = np.array([[[2.0]], [[np.nan]]]), np.array([1.0, 0.0])
    each, part, total = np.empty((2, 1)), np.empty(1), np.zeros(1)
    plain = interpreted(weighted_statistics.py_func)
    plain(statistics, None, np.zeros(1), None, None, paths, weights, each, part, total)
    assert total.tolist() == [2.0]
    assert np.isnan(each[1, 0])


def test_a_sweep_names_the_law_that_is_undefined():
    """The ancestor of the reference is weighed by the transition, not by the observation."""
    model = ssm.Model("roots")
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x: {"x": ssm.Normal(np.sqrt(x + 1.0), sd=1.0)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1.0)})
    problem = pose(model, {"y": [0.1, 0.2, 0.3]})
    (e,) = problem.experiments
    run = problem.program.entry("conditional_smc_bootstrap")
    reference, theta = np.zeros((3, 1)), np.empty(0)
    new, figures = np.empty((3, 1)), np.empty(2)
    stream = random_state(seed_sequence(1))
    status, t = run(theta, e.y, e.seen, e.u, 200, stream, reference, new, figures)
    assert (status, t) == (JOINING + NAN, 1)
    error = sweep_failure(problem, theta, status, t, e)
    assert "the transition density into t=2 is not a number" in str(error)


@pytest.mark.parametrize("proposal", ["bootstrap", "guided", "auxiliary"])
def test_rows_without_data_weigh_nothing_wherever_a_particle_is(proposal):
    """The residual of what was not measured is infinite: it is left out, not multiplied by 0."""
    estimates = ssm.log_likelihood(
        explosive(), {"y": UNSEEN}, {}, particles=1000, repeats=100, proposal=proposal,
        seed=seed_of("unseen", proposal),
    )  # fmt: skip
    ratio = np.exp(estimates - explosive_exact()[0])
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std(ddof=1) / np.sqrt(len(ratio))


def test_sweeps_over_rows_without_data():
    found = ssm.smooth(
        explosive(), {"y": UNSEEN}, {}, method="pgas", trajectories=50, seed=seed_of("unseen")
    )
    assert np.all(np.isfinite(found.x.values))


def test_components_without_data_weigh_nothing_wherever_a_particle_is():
    """A vector of which the measured part stays bounded, the other not; x beyond a grid is one
    more value, which is never left."""
    covariance, y = np.array([[0.25, 0.1], [0.1, 1.0]]), np.array([0.2, 0.9, 0.8, 0.7])
    model = ssm.Model("bounded")
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=4.0)})
    model.transition(lambda x: {"x": ssm.Normal(np.exp(x) - 1.0, sd=1.0)})
    model.observation(
        lambda x: {"y": ssm.MvNormal(np.stack([np.tanh(x), np.exp(x)]), covariance=covariance)}
    )
    x = np.linspace(-30.0, 30.0, 2001)
    width, tanh = x[1] - x[0], np.append(np.tanh(x), 1.0)
    law = np.append(stats.norm.pdf(x, 0.0, 4.0) * width, stats.norm.sf(30.0, 0.0, 4.0))
    with np.errstate(over="ignore"):
        middle = (np.exp(x) - 1.0)[:, None]
    move = np.zeros((len(law), len(law)))
    move[:-1] = np.hstack(
        [stats.norm.pdf(x[None, :], middle, 1.0) * width, stats.norm.sf(30.0, middle, 1.0)]
    )
    move[-1, -1] = 1.0
    total = 0.0
    for t, value in enumerate(y):
        law = (law @ move if t else law) * stats.norm.pdf(value, tanh, 0.5)
        total += np.log(law.sum())
        law /= law.sum()
    data = {"y": np.column_stack([y, np.full(len(y), np.nan)])}
    estimates = ssm.log_likelihood(
        model, data, {}, particles=1000, repeats=100, proposal="bootstrap",
        seed=seed_of("bounded"),
    )  # fmt: skip
    ratio = np.exp(estimates - total)
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std(ddof=1) / np.sqrt(len(ratio))


@pytest.mark.parametrize("proposal", ["bootstrap", "guided", "auxiliary"])
def test_a_particle_far_behind_comes_back_where_nothing_is_resampled(proposal):
    """Two classes, of which the rows at first speak against the right one by more than a number can
    hold. Without resampling a particle is a sample of the class, and its weight the likelihood."""
    model = ssm.Model("class")
    model.initial(lambda: {"s": ssm.Bernoulli(0.5), "x": ssm.Normal(0, sd=1)})
    model.transition(lambda s, x: {"s": ssm.Dirac(s), "x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda s, x: {"y": ssm.Normal(s, sd=0.5), "z": ssm.Normal(x**2, sd=2)})
    y = np.concatenate([np.full(600, -0.2), np.full(900, 1.2)])
    n = 60
    found = ssm.log_likelihood(
        model, {"y": y, "z": np.full(len(y), np.nan)}, {}, proposal=proposal, ess_threshold=0.0,
        particles=n, repeats=2, seed=seed_of("behind", proposal),
    )  # fmt: skip
    right = stats.norm.logpdf(y, 1.0, 0.5).sum()
    # by how many of the particles are of the class, at least one in 2^-n
    assert np.all(found <= right + 1e-6)
    assert np.all(found > right - np.log(n) - 1e-6)
