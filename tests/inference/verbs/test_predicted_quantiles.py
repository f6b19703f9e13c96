"""Quantiles of one-step predictions, against the exact predictive laws."""

import itertools

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from tests.statistics.checks import LEVEL, seed_of

LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])


def wards():
    """Two regimes, seen through counts, skewed times and shares."""
    model = ssm.Model("wards")
    model.initial(lambda: {"z": ssm.Bernoulli(0.4)})
    model.transition(lambda z: {"z": ssm.Bernoulli(np.where(z, 0.8, 0.3))})
    model.observation(lambda z: {
        "n": ssm.Poisson(1.0 + 6.0 * z),
        "wait": ssm.Gamma(2.0, rate=1.0 + 3.0 * z),
        "share": ssm.Dirichlet(np.stack([1.0 + 4.0 * z, 2.0, 1.5])),
    })  # fmt: skip
    return model


def laws(name, z):
    """Of the components of a channel, given the regime."""
    if name == "n":
        return [stats.poisson(1.0 + 6.0 * z)]
    if name == "wait":
        return [stats.gamma(2.0, scale=1 / (1.0 + 3.0 * z))]
    a = [1.0 + 4.0 * z, 2.0, 1.5]
    return [stats.beta(one, sum(a) - one) for one in a]


def predicted_regime(data):
    """P(z_t = 1 given y_1:t-1), of all rows, by enumeration."""
    out, p = [], 0.4
    for t in range(len(data["n"])):
        out.append(p)
        weight = []
        for z, prior in ((0, 1 - p), (1, p)):
            a = [1.0 + 4.0 * z, 2.0, 1.5]
            g = 1.0 if np.isnan(data["n"][t]) else stats.poisson.pmf(data["n"][t], 1.0 + 6.0 * z)
            g *= stats.gamma.pdf(data["wait"][t], 2.0, scale=1 / (1.0 + 3.0 * z))
            weight.append(prior * g * stats.dirichlet.pdf(data["share"][t], a))
        after = weight[1] / sum(weight)
        p = 0.8 * after + 0.3 * (1 - after)
    return np.array(out)


def data_of_wards(steps=8):
    made = ssm.simulate(wards(), {}, steps=steps, seed=seed_of("wards"))
    data = {n: made[n].values[0].astype(float) for n in ("n", "wait", "share")}
    data["n"][2] = np.nan
    return data


def each(found, name):
    """(component, row, level, quantiles (draw,)) of a channel."""
    values = found[f"{name}_predicted_quantile"].values
    values = values.reshape(*values.shape[:2], -1, len(LEVELS))
    for t, c, j in itertools.product(*map(range, values.shape[1:])):
        yield c, t, j, values[:, t, c, j]


def test_the_forward_filter_inverts_the_exact_distribution_function():
    data = data_of_wards()
    found, p = ssm.forward_filter(wards(), data, {}, seed=1), predicted_regime(data)
    np.testing.assert_array_equal(found["quantile"], LEVELS)
    assert found["share_predicted_quantile"].dims == ("draw", "time", "share_dim_0", "quantile")
    for name in ("n", "wait", "share"):
        for c, t, j, (q,) in each(found, name):
            below = sum(w * laws(name, z)[c].cdf(q) for z, w in ((0, 1 - p[t]), (1, p[t])))
            if name == "n":
                before = sum(w * laws(name, z)[c].cdf(q - 1) for z, w in ((0, 1 - p[t]), (1, p[t])))
                assert q == np.floor(q)
                assert before < LEVELS[j] <= below
            else:
                np.testing.assert_allclose(below, LEVELS[j], rtol=1e-10)


def test_pit_values_of_shares_are_those_of_their_exact_laws():
    """What has quantiles has PIT values: the share's own distribution function."""
    data = data_of_wards()
    p = predicted_regime(data)
    each_regime = [
        np.stack([one.cdf(y) for one, y in zip(laws("share", z), data["share"].T, strict=True)], 1)
        for z in (0, 1)
    ]
    exact = (1 - p)[:, None] * each_regime[0] + p[:, None] * each_regime[1]
    found = ssm.forward_filter(wards(), data, {}, seed=1)
    np.testing.assert_allclose(found["share_pit"].values[0], exact, rtol=1e-10)
    drawn = ssm.particle_filter(
        wards(), data, {}, particles=4000, proposal="bootstrap", seed=seed_of("shares")
    )
    error = 5.0 * 0.5 / np.sqrt(drawn["ess"].values.min())
    assert np.all(np.abs(drawn["share_pit"].values[0] - exact) < error)


def test_quantiles_of_many_data_sets_are_those_of_each():
    """Of two shapes, in turn, one data set twice; one made by inputs of its own."""
    model = ssm.Model("many", inputs=("u",))
    model.initial(lambda: {"z": ssm.Bernoulli(0.4)})
    model.transition(lambda z: {"z": ssm.Bernoulli(np.where(z, 0.8, 0.3))})
    model.observation(lambda z, u: {
        "n": ssm.Poisson(1.0 + 6.0 * z), "y": ssm.Normal(u * z, sd=1.0)
    })  # fmt: skip
    rng, sets = np.random.default_rng(3), []
    for rows in (5, 3, 5, 3):
        sets.append({"n": rng.poisson(3.0, rows), "y": rng.normal(size=rows), "u": np.ones(rows)})
    sets += [sets[0], {**sets[1], "u": np.array([4.0, 1.0, 9.0])}]
    together = ssm.forward_filter(model, sets, {}, seed=1)
    for one, found in zip(sets, together, strict=True):
        alone = ssm.forward_filter(model, one, {}, seed=1)
        for name in ("n", "y"):
            q = f"{name}_predicted_quantile"
            np.testing.assert_allclose(found[q].values, alone[q].values, rtol=1e-12)


def test_quantiles_of_particles_against_enumeration():
    """P(Y < q) <= level <= P(Y <= q), by as much as the draws and the particles may be off."""
    data, n, m = data_of_wards(), 1500, 40
    found = ssm.particle_filter(
        wards(), data, {}, particles=n, repeats=m, proposal="bootstrap", seed=seed_of("quantiles")
    )
    p = predicted_regime(data)
    # the weights are those of the row before
    size = np.hstack([np.full((m, 1), n), found["ess"].values[:, :-1]])
    spread = found["wait_predicted"].values.std(axis=0, ddof=1) / 1.5  # of the particles' P(z_t)
    checks = 5 * len(p) * len(LEVELS) * m * 2
    limit = stats.norm.isf(LEVEL / checks)
    assert np.all(found["n_predicted_quantile"] == np.floor(found["n_predicted_quantile"]))
    for name in ("n", "wait", "share"):
        for c, t, j, q in each(found, name):
            level = LEVELS[j]
            less = q - 1 if name == "n" else q
            off, on = (law[c] for law in (laws(name, 0), laws(name, 1)))
            below, strictly = ((1 - p[t]) * off.cdf(v) + p[t] * on.cdf(v) for v in (q, less))
            drawn = np.maximum(on.cdf(q) * on.sf(q), off.cdf(q) * off.sf(q)) / size[:, t]
            error = np.sqrt(drawn + (spread[t] * (on.cdf(q) - off.cdf(q))) ** 2)
            assert np.all(below > level - limit * error)
            assert np.all(strictly < level + limit * error)
            if name != "n":  # all repeats together
                total = np.sqrt(np.mean(error**2) / m)
                assert abs(below.mean() - level) < limit * total + 1.0 / n


def walk():
    model = ssm.Model("walk of quantiles")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.9 * x, sd=0.7)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.8)})
    return model


WALK = {"y": np.array([0.3, 1.4, np.nan, -0.7, 0.2])}


def test_the_kalman_filter_has_those_of_its_normal_law():
    found = ssm.kalman_filter(walk(), WALK, {}, quantiles=(0.9, 0.1))
    mean, sd = found["y_predicted"].values[0], found["y_predicted_sd"].values[0]
    np.testing.assert_allclose(sd[0], np.sqrt(1.64))
    for j, level in enumerate((0.1, 0.9)):
        np.testing.assert_allclose(
            found["y_predicted_quantile"].values[0, :, j], stats.norm.ppf(level, mean, sd)
        )


WAYS = {
    name: {"proposal": name} for name in ("bootstrap", "guided", "auxiliary", "twisted", "tempered")
} | {
    "seldom": {"proposal": "bootstrap", "ess_threshold": 0.5},
    "alive": {"proposal": "bootstrap", "rescue": 20},
}


def assert_at_levels(below, n):
    """Exact probabilities below estimated quantiles, (draw, time, level), are the levels on
    average; one in n is the bias of a quantile of n draws."""
    error = below.std(axis=0, ddof=1) / np.sqrt(len(below))
    limit = stats.t.isf(LEVEL / (2 * error.size), len(below) - 1)
    assert error.max() < 0.02
    assert np.all(np.abs(below.mean(axis=0) - LEVELS) < limit * error + 1.0 / n)


@pytest.mark.parametrize("way", WAYS)
def test_every_filter_predicts_as_the_kalman_filter_does(way):
    n = 400
    found = ssm.particle_filter(
        walk(), WALK, {}, particles=n, repeats=80, seed=seed_of("walk", way), **WAYS[way]
    )
    exact = ssm.kalman_filter(walk(), WALK, {})
    mean, sd = (exact[f"y_predicted{s}"].values[0][:, None] for s in ("", "_sd"))
    assert_at_levels(stats.norm.cdf(found["y_predicted_quantile"], mean, sd), n)


def regimes():
    """A linear state whose readings are now sharp, now not: Rao-Blackwellised."""
    model = ssm.Model("regimes")
    model.initial(lambda: {"z": ssm.Bernoulli(0.5), "v": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda z, v: {
        "z": ssm.Bernoulli(np.where(z, 0.9, 0.2)), "v": ssm.Normal(0.8 * v, sd=0.6),
    })  # fmt: skip
    model.observation(lambda z, v: {
        "y": ssm.MvNormal(v, covariance=np.where(z, 4.0, 0.25) * np.array([[1.0, 0.5], [0.5, 1.0]]))
    })  # fmt: skip
    return model


def predictive_mixture(y):
    """[(weights, means (M, 2), sd (M, 2))] of each row, over all paths of the regime."""
    steps = len(y)
    cov = np.array([[0.8 ** abs(s - t) for s in range(steps)] for t in range(steps)])
    variance = np.empty(steps)  # of v_t; Cov(v_s, v_t) = 0.8^(t - s) Var(v_s)
    variance[0] = 1.0
    for t in range(1, steps):
        variance[t] = 0.64 * variance[t - 1] + 0.36
    cov *= np.minimum.outer(np.arange(steps), np.arange(steps)).choose(variance)
    noise = np.array([[1.0, 0.5], [0.5, 1.0]])
    out = []
    for t in range(steps):
        weights, means, spreads = [], [], []
        for path in itertools.product((0, 1), repeat=t + 1):
            prior = 0.5
            for a, b in itertools.pairwise(path):
                stay = 0.9 if a else 0.2
                prior *= stay if b else 1 - stay
            r = np.diag(np.where(path, 4.0, 0.25))
            whole = np.kron(cov[: t + 1, : t + 1], np.eye(2)) + np.kron(r, noise)
            seen, new = slice(0, 2 * t), slice(2 * t, 2 * t + 2)
            past = y[:t].ravel()
            gain = np.linalg.solve(whole[seen, seen], whole[seen, new]).T if t else np.zeros((2, 0))
            density = stats.multivariate_normal.pdf(past, None, whole[seen, seen]) if t else 1.0
            weights.append(prior * density)
            means.append(gain @ past)
            spreads.append(np.sqrt(np.diag(whole[new, new] - gain @ whole[seen, new])))
        out.append((np.array(weights) / sum(weights), np.array(means), np.array(spreads)))
    return out


def test_states_that_are_integrated_out():
    n, y = 400, ssm.simulate(regimes(), {}, steps=4, seed=seed_of("regimes"))["y"].values[0]
    found = ssm.particle_filter(
        regimes(), {"y": y}, {}, particles=n, repeats=80, proposal="marginal",
        seed=seed_of("regimes", "marginal"),
    )  # fmt: skip
    q = found["y_predicted_quantile"].values
    below = np.empty(q.shape)
    for t, (weights, means, sd) in enumerate(predictive_mixture(y)):
        below[:, t] = np.einsum(
            "m,mdkl->dkl", weights,
            stats.norm.cdf(q[:, t], means[:, None, :, None], sd[:, None, :, None]),
        )  # fmt: skip
    assert_at_levels(below, n)


@pytest.mark.parametrize("way", [*WAYS, "marginal"])
def test_nothing_else_hangs_on_the_draws(way):
    """Whether and where quantiles are asked for, all other numbers are the same bits."""
    model, data, own = walk(), WALK, WAYS.get(way, {"proposal": way})
    if way == "marginal":
        model, data = regimes(), {"y": np.array([[0.1, 0.4], [1.0, -0.3], [0.2, 0.9]])}
    runs = [
        ssm.particle_filter(model, data, {}, particles=50, seed=3, quantiles=q, **own)
        for q in ((), (0.3,), LEVELS)
    ]
    for name in runs[0].data_vars:
        for run in runs[1:]:
            np.testing.assert_array_equal(runs[0][name], run[name], strict=True)
    assert "y_predicted_quantile" not in runs[0]
    assert runs[1]["y_predicted_quantile"].sizes["quantile"] == 1


def test_a_law_that_is_not_defined_has_none():
    model = ssm.Model("below zero")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x + 100.0, sd=1)})
    model.observation(lambda x: {"n": ssm.Poisson(x)})
    found = ssm.particle_filter(
        model, {"n": np.full(2, np.nan)}, {}, particles=200, proposal="bootstrap", seed=1
    )
    first, second = found["n_predicted_quantile"].values[0]
    assert np.isnan(first).all()
    assert np.isfinite(second).all()


@ssm.distribution(lower=0)
def Decay(y, rate):
    return np.log(rate) - rate * y


@Decay.cdf
def decayed(y, rate):
    return 1 - np.exp(-rate * y)


def test_mixtures_of_laws_given_the_regime_are_inverted_too():
    """Their own quantiles have no formula, and of a law without an inverse there is none."""

    def counts(z):
        return ssm.Mixture([0.3, 0.7], [ssm.Poisson(1.0 + 6.0 * z), ssm.Binomial(4, 0.5)])

    model = ssm.Model("mixed")
    model.initial(lambda: {"z": ssm.Bernoulli(0.4)})
    model.transition(lambda z: {"z": ssm.Bernoulli(np.where(z, 0.8, 0.3))})
    model.observation(lambda z: {
        "y": ssm.Mixture([0.25, 0.75], [ssm.Normal(3.0 * z, sd=0.5), ssm.Laplace(-2.0, scale=1)]),
        "n": ssm.ZeroInflated(counts(z), 0.2),
        "left": ssm.Mixture([0.5, 0.5], [Decay(1.0 + z), ssm.Gamma(2.0, rate=1.0)]),
    })  # fmt: skip
    nothing = np.full(1, np.nan)
    found = ssm.forward_filter(model, {"y": nothing, "n": nothing, "left": nothing}, {})

    def below_y(q):
        return sum(w * (0.25 * stats.norm.cdf(q, 3.0 * z, 0.5) + 0.75 * stats.laplace.cdf(q, -2.0))
                   for z, w in ((0, 0.6), (1, 0.4)))  # fmt: skip

    def below_n(q):
        poisson = 0.6 * stats.poisson.cdf(q, 1.0) + 0.4 * stats.poisson.cdf(q, 7.0)
        parts = 0.3 * poisson + 0.7 * stats.binom.cdf(q, 4, 0.5)
        return np.where(q < 0, 0.0, 0.2 + 0.8 * parts)

    y, n = (found[f"{name}_predicted_quantile"].values[0, 0] for name in ("y", "n"))
    np.testing.assert_allclose(below_y(y), LEVELS, rtol=1e-10)
    assert np.all((below_n(n - 1) < LEVELS) & (below_n(n) >= LEVELS))
    assert np.isnan(found["left_predicted_quantile"].values).all()
