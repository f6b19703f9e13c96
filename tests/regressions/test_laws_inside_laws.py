"""Laws of a user's own as parts of other laws."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate


@ssm.distribution(lower=0, positive=("shape", "scale"))
def Lomax(y, shape, scale):
    return np.log(shape / scale) - (shape + 1) * np.log1p(y / scale)


@Lomax.sampler
def draw(rng, shape, scale):
    return scale * ((1 - rng.uniform()) ** (-1 / shape) - 1)


@ssm.distribution(lower=0)
def Silent(y, rate):
    return np.log(rate) - rate * y


@ssm.distribution(lower=0, discrete=True)
def Geometric(k, p):
    return np.log(p) + k * np.log1p(-p)


@Geometric.sampler
def draw_count(rng, p):
    return np.floor(np.log(rng.uniform()) / np.log1p(-p))


def model_of(law):
    model = ssm.Model("inside")
    model.prior(lambda: {"a": ssm.Gamma(2, rate=1)})
    model.initial(lambda: {"x": ssm.Bernoulli(0.5)})
    model.transition(lambda x: {"x": ssm.Bernoulli(0.2 + 0.6 * x)})
    model.observation(lambda x, a: {"y": law(x, a)})
    return model


def by_paths(y, density):
    """log p(y) of the two-state chain, by the forward sums."""
    move, weight, total = np.array([[0.8, 0.2], [0.2, 0.8]]), np.array([0.5, 0.5]), 0.0
    for t, value in enumerate(y):
        weight = (weight if t == 0 else weight @ move) * np.array(
            [density(value, 0), density(value, 1)]
        )
        total += np.log(weight.sum())
        weight = weight / weight.sum()
    return total


def test_a_mixture_of_own_laws_and_others():
    def law(x, a):
        return ssm.Mixture([0.3, 0.7], [Lomax(2 + a, scale=1 + x), ssm.Gamma(3, rate=2)])

    def density(y, x):
        own = stats.lomax.pdf(y, 3.5, scale=1 + x)
        return 0.3 * own + 0.7 * stats.gamma.pdf(y, 3, scale=0.5)

    model, y = model_of(law), np.array([0.3, 2.0, 0.1, 5.0, 1.1])
    found = ssm.log_likelihood(model, {"y": y}, {"a": 1.5})
    assert found == pytest.approx(by_paths(y, density), rel=1e-12)
    drawn = ssm.simulate(model, {"a": 1.5}, steps=4000, seed=1)
    u = [0.3 * stats.lomax.cdf(v, 3.5, scale=1 + x) + 0.7 * stats.gamma.cdf(v, 3, scale=0.5)
         for v, x in zip(drawn["y"].values[0], drawn["x"].values[0], strict=True)]  # fmt: skip
    assert stats.kstest(u, "uniform").pvalue > 1e-4


def test_more_zeros_than_an_own_law_of_counts_has():
    def density(y, x):
        p = 0.2 + 0.5 * x
        return 0.25 * (y == 0) + 0.75 * p * (1 - p) ** y

    model = model_of(lambda x, a: ssm.ZeroInflated(Geometric(0.2 + 0.5 * x), a / (a + 4.5)))
    y = np.array([0.0, 3.0, 0.0, 0.0, 7.0])
    found = ssm.log_likelihood(model, {"y": y}, {"a": 1.5})
    assert found == pytest.approx(by_paths(y, density), rel=1e-12)
    assert (ssm.simulate(model, {"a": 1.5}, steps=200, seed=1)["y"] == 0).mean() > 0.25


def test_a_part_without_a_sampler_is_named_before_anything_is_drawn():
    model = model_of(lambda x, a: ssm.Mixture([0.5, 0.5], [Silent(a), Lomax(2, scale=1 + x)]))
    with pytest.raises(ssm.ModelError, match="Silent has no sampler"):
        ssm.simulate(model, {"a": 1.5}, steps=4, seed=1)
    y = {"y": np.array([0.3, 2.0])}
    assert np.isfinite(ssm.log_likelihood(model, y, {"a": 1.5}))
    # predictions that nobody can draw have no quantiles
    filtered = ssm.particle_filter(model, y, {"a": 1.5}, seed=1)
    assert np.isnan(filtered["y_predicted_quantile"].values).all()


def test_parts_are_rebuilt():
    law = ssm.ZeroInflated(Geometric(np.array([0.3, 0.4])), 0.2)
    element = law.rebuilt({"p": 0.1}).element((1,))
    assert element.shape == ()
    zero = float(evaluate([element.log_densities(array(0.0))[()]], {})[0])
    assert np.exp(zero) == pytest.approx(0.1 + 0.9 * 0.4)
    with pytest.raises(ValueError, match="another number"):  # its function is not kept
        law.rebuilt({"like_p": 0.5})


@Geometric.cdf
def cdf(k, p):
    return 1 - (1 - p) ** (k + 1)


@Geometric.quantile
def quantile(u, p):
    return np.maximum(0, np.ceil(np.log1p(-u) / np.log1p(-p) - 1))


@pytest.mark.parametrize("bounds", [{"upper": 3}, {"lower": 2, "upper": 30}, {"upper": 200}])
@pytest.mark.parametrize("zeros", [0.0, 0.2])
def test_moments_of_truncated_counts_are_sums(bounds, zeros):
    law, k = Geometric(0.3), np.arange(1000)
    p = (1 - zeros) * stats.geom(0.3, loc=-1).pmf(k) + zeros * (k == 0)
    assert_moments(ssm.ZeroInflated(law, zeros) if zeros else law, p, bounds)


@pytest.mark.parametrize("bounds", [{"upper": 3}, {"lower": 2}, {"lower": 0, "upper": 500}])
def test_moments_of_a_truncated_hurdle(bounds):
    k = np.arange(1000)
    p = 0.7 * (k > 0) * stats.poisson(2).pmf(k) / stats.poisson(2).sf(0) + 0.3 * (k == 0)
    hurdle = ssm.ZeroInflated(ssm.Truncated(ssm.Poisson(2.0), lower=1), 0.3)
    assert_moments(hurdle, p, bounds)


def assert_moments(law, p, bounds):
    k = np.arange(1000)
    p = p * (k >= bounds.get("lower", 0)) * (k <= bounds.get("upper", 1000))
    mean = p @ k / p.sum()
    found = ssm.Truncated(law, **bounds)
    assert evaluate(array(found.mean())[()]) == pytest.approx(mean)
    variance = p @ (k - mean) ** 2 / p.sum()
    assert evaluate(array(found.variance())[()]) == pytest.approx(variance)


def test_moments_of_endless_counts_without_a_formula_are_not_told():
    assert np.isnan(evaluate(array(ssm.Truncated(Geometric(0.3), lower=1).mean())[()]))
