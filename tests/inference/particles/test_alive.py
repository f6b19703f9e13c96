"""The alive particle filter (`rescue=`), where no particle of the plain one survives."""

from collections import defaultdict

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm

SLOW = pytest.mark.slow
HALF = 0.15  # of the window that an observation leaves to the state
SD = 0.5
AT = {"phi": 0.9}


def bounded():
    """An autoregression seen with bounded noise; `z`, where it is there, is Gaussian."""
    model = ssm.Model("bounded noise")
    model.prior(lambda: {"phi": ssm.Uniform(0, 1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, phi: {"x": ssm.Normal(phi * x, sd=SD)})
    model.observation(lambda x: {"y": ssm.Uniform(x - HALF, x + HALF)})
    return model


def two_channels():
    """The same with a second, Gaussian channel, which proposals can look ahead to."""
    model = bounded()
    model.prior(lambda: {"r": ssm.HalfNormal(sd=1)})
    model.observation(lambda x, r: {"z": ssm.Normal(x, variance=r)})
    return model


MODEL = bounded()


def data_of(steps=12, seed=3):
    y = ssm.simulate(MODEL, AT, steps=steps, seed=seed)["y"].values[0]
    y[4] = np.nan
    return y


def quadrature(y, phi, z=None):
    """(log p(y), filter means, smoothed means) by Gauss's rule on each row's window; where y is
    missing, on eight standard deviations."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    x, w, joint = [], [], []
    for t, seen in enumerate(np.isfinite(y)):
        centre, half = (y[t], HALF) if seen else (0.0, 8.0)
        x.append(centre + half * nodes)
        g = np.full(len(nodes), 0.5 / HALF if seen else 1.0)
        if z is not None and np.isfinite(z[t]):
            g = g * stats.norm.pdf(z[t], x[t], 0.3)
        w.append(half * weights * g)
        if t:
            joint.append(stats.norm.pdf(x[t][None], phi * x[t - 1][:, None], SD))
    log_z, f = 0.0, stats.norm.pdf(x[0])
    filtered = []
    for t in range(len(y)):
        if t:
            f = (f * w[t - 1]) @ joint[t - 1]
        total = np.sum(f * w[t])
        log_z += np.log(total)
        f = f / total
        filtered.append(f)
    mean = [np.sum(x[t] * f * w[t]) for t, f in enumerate(filtered)]
    b, smoothed = np.ones(len(nodes)), []
    for t in reversed(range(len(y))):
        own = filtered[t] * b * w[t]
        smoothed.append(np.sum(x[t] * own) / own.sum())
        if t:
            b = joint[t - 1] @ (w[t] * b)
            b /= b.max()
    return log_z, np.array(mean), np.array(smoothed[::-1])


def assert_mean_one(log_ratio):
    ratio = np.exp(log_ratio)
    error = ratio.std(ddof=1) / np.sqrt(len(ratio))
    assert error < 0.1
    assert abs(ratio.mean() - 1) < 4 * error


def law_of_z(initial, moves, weight, steps, n, most):
    """The exact law of the estimate Z, {(alive at the end, Z): probability}, for a state of
    finitely many values and the same weights at each step: every sequence of draws there is."""
    law = {(None, 1.0): 1.0}
    for _ in range(steps):
        after = defaultdict(float)
        for (alive, z), chance in law.items():
            p = initial
            if alive is not None:
                share = weight[list(alive)]
                p = (share / share.sum()) @ moves[list(alive)]
            for drawn, own in sequences(p, weight, n, most):
                kept = [v for v in drawn if weight[v] > 0]
                tries = len(drawn) - 1 if len(kept) > n else len(drawn)
                estimate = weight[kept[:n]].sum() / tries
                key = tuple(sorted(kept[:n])) if kept else None
                after[key, round(z * estimate, 12) if kept else 0.0] += chance * own
        law = defaultdict(float)
        for (alive, z), chance in after.items():
            law[alive, z] += chance
        law = {k: v for k, v in law.items() if k[0] is not None}
    return law


def sequences(p, weight, n, most):
    """Draws until n + 1 are alive or there were `most`, and the probability of each sequence."""
    stack = [((), 1.0)]
    while stack:
        drawn, chance = stack.pop()
        if len(drawn) == most or sum(weight[v] > 0 for v in drawn) > n:
            yield drawn, chance
            continue
        stack += [((*drawn, v), chance * q) for v, q in enumerate(p) if q > 0]


START = np.array([0.5, 0.3, 0.2])
MOVES = np.array([[0.6, 0.3, 0.1], [0.05, 0.15, 0.8], [0.9, 0.06, 0.04]])
WEIGHT = np.array([0.0, 0.3, 0.8])


@pytest.mark.parametrize(("n", "rescue"), [(1, 2), (1, 5), (2, 2), (2, 3)])
def test_the_estimate_has_the_law_that_enumeration_gives_it_and_no_bias(n, rescue):
    model = ssm.Model("three values")
    model.initial(lambda: {"k": ssm.Categorical(START)})

    def transition(k):
        row = sum(np.where(k == i, 1.0, 0.0) * MOVES[i] for i in range(3))
        return {"k": ssm.Categorical(row)}

    model.transition(transition)
    model.observation(
        lambda k: {"y": ssm.Bernoulli(np.where(k == 2, 0.8, np.where(k == 1, 0.3, 0.0)))}
    )
    steps = 3
    data = {"y": np.ones(steps)}
    law = law_of_z(START, MOVES, WEIGHT, steps, n, rescue * n)
    (exact,) = np.exp(ssm.log_likelihood(model, data, {}))
    assert sum(z * p for (_, z), p in law.items()) == pytest.approx(exact, rel=1e-9)
    runs = 20_000
    z = np.exp(
        ssm.log_likelihood(
            model, data, {}, particles=n, rescue=rescue, proposal="bootstrap", repeats=runs, seed=5
        )
    )
    expected = defaultdict(float)
    for (_, value), p in law.items():
        expected[round(value, 9)] += p
    expected[0.0] = 1.0 - sum(expected.values())
    values, counts = np.unique(np.round(z, 9), return_counts=True)
    found = dict(zip(values, counts, strict=True))
    assert set(found) <= set(expected)
    ordered = sorted(expected, key=lambda v: expected[v])
    bins, own = [], [0.0, 0]
    for v in ordered:  # the rare ones together
        own = [own[0] + runs * expected[v], own[1] + found.get(v, 0)]
        if own[0] >= 20:
            bins.append(own)
            own = [0.0, 0]
    e, o = np.transpose(bins)
    e = e * o.sum() / e.sum()
    assert len(bins) > 5
    assert stats.chisquare(o, e).pvalue > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("rescue", [5, 200])
def test_unbiased_where_the_plain_filter_dies(rescue):
    y = data_of()
    data = [{"y": y}, {"y": data_of(5, 8)}]
    exact = sum(quadrature(e["y"], AT["phi"])[0] for e in data)
    settings = {"particles": 20, "repeats": 4000, "seed": 2}
    plain = ssm.log_likelihood(MODEL, data, AT, **settings)
    assert np.mean(plain == -np.inf) > 0.4
    assert_mean_one(ssm.log_likelihood(MODEL, data, AT, rescue=rescue, **settings) - exact)


@pytest.mark.parametrize("proposal", [pytest.param("guided", marks=SLOW), "auxiliary"])
def test_unbiased_with_proposals_that_look_at_the_row(proposal):
    model = two_channels()
    at = {**AT, "r": 0.09}
    made = ssm.simulate(model, at, steps=10, seed=4)
    y, z = made["y"].values[0], made["z"].values[0]
    y[4] = z[6] = np.nan
    exact = quadrature(y, AT["phi"], z)[0]
    found = ssm.log_likelihood(
        model, {"y": y, "z": z}, at, particles=20, repeats=3000, proposal=proposal, rescue=50,
        seed=6,
    )  # fmt: skip
    assert_mean_one(found - exact)
    nowhere = ssm.log_likelihood(  # undefined for every particle, so that more are of no use
        model, {"y": y, "z": z}, {**AT, "r": -1.0}, proposal=proposal, rescue=10**6, seed=1
    )
    assert np.all(nowhere == -np.inf)


def test_counts_that_a_population_must_reach():
    """Of a population one counts a part: numbers below the count are impossible."""
    model = ssm.Model("counts")
    model.initial(lambda: {"n": ssm.Poisson(12.0)})
    model.transition(lambda n: {"n": ssm.Poisson(0.5 + 0.95 * n)})
    model.observation(lambda n: {"y": ssm.Binomial(n, 0.9)})
    y = np.array([11, 14, 21, 24, 38, 36.0])
    values = np.arange(400)
    f = stats.poisson.pmf(values, 12.0)
    log_z = 0.0
    for t, count in enumerate(y):
        if t:
            f = f @ stats.poisson.pmf(values[None], 0.5 + 0.95 * values[:, None])
        f = f * stats.binom.pmf(count, values, 0.9)
        log_z += np.log(f.sum())
        f = f / f.sum()
    settings = {"particles": 30, "repeats": 3000, "seed": 3, "proposal": "bootstrap"}
    plain = ssm.log_likelihood(model, {"y": y}, {}, **settings)
    assert np.mean(plain == -np.inf) > 0.2
    assert_mean_one(ssm.log_likelihood(model, {"y": y}, {}, rescue=200, **settings) - log_z)


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["twisted", "marginal", "marginal_guided"])
def test_the_filters_of_other_modules_agree_with_many_plain_particles(proposal):
    model = ssm.Model("two states")
    model.initial(lambda: {"a": ssm.Normal(0, sd=1), "b": ssm.Normal(0, sd=1)})
    model.transition(lambda a, b: {"a": ssm.Normal(0.8 * a, sd=0.4),
                                   "b": ssm.Normal(0.5 * b + np.sin(a), sd=0.7)})  # fmt: skip
    model.observation(lambda a, b: {"y": ssm.Normal(b, sd=0.5), "z": ssm.Normal(a, sd=0.5)})
    made = ssm.simulate(model, {}, steps=8, seed=1)
    data = {"y": made["y"].values[0], "z": made["z"].values[0]}
    plain = ssm.log_likelihood(
        model, data, {}, particles=20_000, repeats=40, proposal="guided", seed=2
    )  # fmt: skip
    found = ssm.log_likelihood(
        model, data, {}, particles=20, repeats=3000, proposal=proposal, rescue=3, seed=6
    )
    assert_mean_one(found - np.log(np.mean(np.exp(plain))))


@pytest.mark.slow
def test_filter_means_against_quadrature_and_an_error_at_the_limit():
    y = data_of()
    _, mean, _ = quadrature(y, AT["phi"])
    found = ssm.particle_filter(
        MODEL, {"y": y}, AT, particles=200, repeats=50, rescue=1000, seed=1
    )  # fmt: skip
    draws = found["x"].values
    error = draws.std(axis=0, ddof=1) / np.sqrt(len(draws))
    assert np.all(np.abs(draws.mean(axis=0) - mean) < 4.5 * error + 1e-4)
    assert found.attrs["rescue"] == 1000
    y[7] = 1e3
    with pytest.raises(ssm.SamplingError, match="all weights are zero at t=8"):
        ssm.particle_filter(MODEL, {"y": y}, AT, particles=20, rescue=50, seed=1)
    assert np.all(
        ssm.log_likelihood(MODEL, {"y": y}, AT, particles=20, rescue=50, seed=1) == -np.inf
    )


@pytest.mark.slow
def test_smoothed_means_against_quadrature():
    y = data_of()
    _, _, mean = quadrature(y, AT["phi"])
    found = ssm.smooth(
        MODEL, {"y": y}, AT, ssm.FFBSi(rescue=1000), particles=1000, trajectories=1000, seed=1
    )["x"].values  # fmt: skip
    seen = np.isfinite(y)
    assert np.all(np.abs(found - y)[:, seen] <= HALF)
    assert np.max(np.abs(found.mean(axis=0) - mean)[seen]) < 0.02
    assert abs(found.mean(axis=0) - mean)[~seen] < 0.06


@pytest.mark.slow
def test_posterior_of_pmmh_against_quadrature():
    y = data_of(20)
    grid = np.linspace(0.005, 0.995, 100)
    log_p = np.array([quadrature(y, phi)[0] for phi in grid])
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    mean = np.sum(grid * p)
    sd = np.sqrt(np.sum((grid - mean) ** 2 * p))
    idata = ssm.sample(
        MODEL, {"y": y}, ssm.PMMH(particles=20, rescue=500), draws=2500, warmup=500, chains=4,
        seed=1, progress=False,
    )  # fmt: skip
    row = ssm.summary(idata).loc["phi"]
    error = sd / np.sqrt(row["ess_bulk"])
    assert row["ess_bulk"] > 300
    assert abs(row["mean"] - mean) < 4 * error
    assert abs(row["sd"] / sd - 1) < 4 / np.sqrt(2 * row["ess_bulk"])
    seen = np.isfinite(y)
    assert np.all(np.abs(idata["posterior"]["x"].values - y)[:, :, seen] <= HALF)


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        ({"rescue": -1}, "rescue=-1"),
        ({"rescue": 1}, "rescue=1 allows"),
        ({"rescue": 2.5}, "rescue=2.5"),
        ({"rescue": 10, "resampling": "stratified"}, "stratified"),
        ({"rescue": 10, "ess_threshold": 0.5}, "ess_threshold"),
    ],
)
def test_bad_settings(call, fragment):
    with pytest.raises(ssm.ArgumentError, match=fragment):
        ssm.log_likelihood(MODEL, {"y": data_of()}, AT, **call)


def test_pmmh_refuses_it_with_filters_of_a_fixed_number():
    for other in ({"order": 1}, {"correlation": 0.9}):
        with pytest.raises(ssm.ArgumentError, match="rescue=10 together with"):
            ssm.sample(MODEL, {"y": data_of()}, ssm.PMMH(rescue=10, **other), progress=False)
