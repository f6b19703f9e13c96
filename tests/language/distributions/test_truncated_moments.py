"""Means and variances of truncated laws in intervals narrow or far out, where formulas cancel.

Held against fine quadrature of the density, scaled to the interval; of counts, against sums.
"""

import functools

import numpy as np
import pytest
import scipy.stats as st

import ssmppl as ssm
import ssmppl.language.distributions as D
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from tests.statistics.checks import some

LOWER, UPPER, X = symbol("input", "lower"), symbol("input", "upper"), symbol("state", "x")
NODES, WEIGHTS = np.polynomial.legendre.leggauss(30)
NORMAL = D.Normal(0.0, sd=1.0)
PIECES = np.arange(100)[:, None]
SIDES = {"lower": LOWER, "upper": UPPER}
# Laws of heavy tails, of which each writes its expressions once.
STUDENT, LAPLACE = D.StudentT(5.0, 0.0, scale=1.0), D.Laplace(0.0, scale=1.0)
INVERSE_GAMMA = D.InverseGamma(30.0, scale=30.0)


def moments(law, lower: float, upper: float) -> tuple[float, float]:
    """(mean - lower, variance) of a law between symbols for the bounds, with numbers for them."""
    mean, variance = evaluate(forms(law), {LOWER: lower, UPPER: upper})
    return float(mean) - lower, float(variance)


@functools.cache
def forms(law):
    d = D.Truncated(law, lower=LOWER, upper=UPPER)
    return [array(f)[()] for f in (d.mean(), d.variance())]


def one_sided(law, **bounds: float) -> tuple[float, float]:
    """(mean, variance) of a law between numbers, of which one may be left out."""
    values = {SIDES[side]: value for side, value in bounds.items()}
    mean, variance = evaluate(cut_forms(law, tuple(bounds)), values)
    return float(mean), float(variance)


@functools.cache
def cut_forms(law, sides: tuple[str, ...]):
    """The same expressions whatever the bounds are: quadratures, which take seconds to write."""
    d = D.Truncated(law, **{side: SIDES[side] for side in sides})
    return [array(f)[()] for f in (d.mean(), d.variance())]


@pytest.mark.parametrize(
    "bounds", some([{"lower": -2.0, "upper": 1.0}, {"lower": -1e4}, {"upper": 30.0}], 1)
)
def test_bounds_may_be_numbers(bounds):
    d = D.Truncated(LAPLACE, **bounds)
    found = [float(evaluate(array(f)[()])) for f in (d.mean(), d.variance())]
    assert found == pytest.approx(one_sided(LAPLACE, **bounds), rel=1e-12)


def integrated(log_density, width: float) -> tuple[float, float]:
    """Mean and variance of d in (0, width) with this density."""
    d = ((PIECES + 0.5 * (1.0 + NODES)) / PIECES.size).ravel()
    logs = log_density(width * d)
    p = np.exp(logs - logs.max()) * np.tile(WEIGHTS, PIECES.size)
    p /= p.sum()
    mean = p @ d
    return width * mean, width**2 * (p @ (d - mean) ** 2)


def check(found, expected, lower: float) -> None:
    """To 1e-9 of the width, but for the rounding of the mean itself."""
    sd = np.sqrt(expected[1])
    assert abs(found[0] - expected[0]) <= 1e-9 * sd + 2.0 * np.spacing(abs(lower) + sd)
    assert found[1] == pytest.approx(expected[1], rel=1e-8, abs=0.0)


STARTS = [0.0, 0.5, 3.0, 8.0, 20.0, 100.0, 1e4, 1e6]
WIDTHS = [1e-8, 1e-4, 0.01, 0.3, 0.999, 1.001, 3.0, 50.0]


@pytest.mark.parametrize("start", [*(-s for s in STARTS[1:5]), *STARTS])
def test_normal(start: float):
    """From `start` standard deviations on; and mirrored."""
    for width in WIDTHS:
        upper = start + width
        width = upper - start  # as it is in floating point
        if width == 0.0:
            continue
        reach = min(width, 60.0 / (abs(start) + 1.0) if start > 0.0 else 9.0 - start)
        expected = integrated(lambda d: -d * (start + 0.5 * d), reach)
        check(moments(NORMAL, start, upper), expected, start)
        off, variance = moments(NORMAL, -upper, -start)
        check((width - off, variance), expected, upper)
    if start >= -1.0:
        reach = 60.0 / (start + 1.0) if start > 0.0 else 9.0 - start
        expected = integrated(lambda d: -d * (start + 0.5 * d), reach)
        mean, variance = one_sided(NORMAL, lower=start)
        check((mean - start, variance), expected, start)
        mean, variance = one_sided(NORMAL, upper=-start)
        check((-mean - start, variance), expected, start)
        if start > 0.0:
            mean, variance = one_sided(D.HalfNormal(sd=1.0), lower=start)
            check((mean - start, variance), expected, start)


def test_normal_far_out_by_its_series():
    """Abramowitz and Stegun (1972), 26.2.12: 1/a - 2/a^3 and 1/a^2 - 6/a^4, and smaller terms."""
    for a in (1e3, 1e4, 1e8):
        mean, variance = one_sided(D.Normal(5.0, sd=2.0), lower=5.0 + 2.0 * a)
        assert mean == pytest.approx(5.0 + 2.0 * (a + 1 / a - 2 / a**3), rel=1e-15)
        assert variance == pytest.approx(4.0 * (1 / a**2 - 6 / a**4), rel=1e-9, abs=0.0)


@pytest.mark.parametrize("width", [1e-9, 1e-7, 1e-3, 0.199, 0.2, 1.0, 30.0, 709.0, 710.0, 1e4])
def test_exponential(width: float):
    expected = integrated(lambda d: -d, min(width, 60.0))
    found = moments(D.Exponential(rate=10.0), 0.0, width / 10.0)
    assert found[0] == pytest.approx(expected[0] / 10.0, rel=1e-12, abs=0.0)
    assert found[1] == pytest.approx(expected[1] / 100.0, rel=1e-12, abs=0.0)


@pytest.mark.parametrize(
    "law",
    [D.Gamma(2.5, rate=1.0), D.Gamma(0.3, rate=1.0), D.LogNormal(0.3, sd=0.8), D.Beta(2.0, 3.0)],
    ids=repr,
)  # fmt: skip
def test_narrow(law):
    log_density = array(law.log_densities(array(X)))[()]
    for lower in (0.01, 0.5, 0.9):
        for width in (1e-1, 1e-3, 1e-5, 1e-7):
            upper = min(lower + width, 1.0)
            expected = integrated(
                lambda d, lower=lower: evaluate(log_density, {X: lower + d}), upper - lower
            )
            mean, variance = moments(law, lower, upper)
            assert mean == pytest.approx(expected[0], abs=1e-6 * width)
            assert variance == pytest.approx(expected[1], rel=1e-6, abs=0.0)


def test_beta_at_one():
    """Beta(2, 3) in (1 - w, 1): of Y = 1 - X the density is y^2 - y^3, up to a factor."""
    for w in (1e-7, 1e-4, 0.1, 0.4):
        low = 1.0 - w
        w = 1.0 - low
        mass, first, second = (w ** (3 + k) * (1 / (3 + k) - w / (4 + k)) for k in range(3))
        mean, variance = moments(D.Beta(2.0, 3.0), low, 1.0)
        assert w - mean == pytest.approx(first / mass, rel=1e-8, abs=1e-15)
        assert variance == pytest.approx(second / mass - (first / mass) ** 2, rel=1e-8, abs=0.0)


def test_a_steep_density_in_an_interval_that_is_narrow():
    """Most of LogNormal(0, sd=1e-3) between 0.99 and 1.01."""
    found = moments(D.LogNormal(0.0, sd=1e-3), 0.99, 1.01)
    law = st.lognorm(1e-3)
    assert found[1] == pytest.approx(law.var(), rel=1e-6)
    assert found[0] == pytest.approx(law.mean() - 0.99, rel=1e-9)


@pytest.mark.parametrize(
    "law",
    [D.Poisson(2.0), D.NegativeBinomial(2.0, dispersion=3.0), D.Binomial(50, 0.3),
     D.ZeroInflated(D.Poisson(2.0), 0.3)],
    ids=repr,
)  # fmt: skip
def test_counts_between_expressions(law):
    log_density = array(law.log_densities(array(X)))[()]
    for lower in (-2, 0, 1, 5, 20):
        for upper in (0, 1, 2, 3, 8, 30):
            if upper < max(lower, 0):
                continue
            k = np.arange(max(lower, 0), upper + 1.0)
            p = np.exp(evaluate(log_density, {X: k}))
            p /= p.sum()
            mean, variance = moments(law, lower, upper)
            assert mean + lower == pytest.approx(p @ k, rel=1e-9, abs=1e-12)
            assert variance == pytest.approx(p @ (k - p @ k) ** 2, rel=1e-8, abs=1e-10)
            assert variance >= 0.0


def test_bounds_in_the_wrong_order_have_no_moments():
    for law in (NORMAL, D.Exponential(rate=1.0), D.Gamma(2.0, rate=1.0)):
        assert np.all(np.isnan(moments(law, 2.0, 1.0)))


def test_predictions_of_a_particle_filter():
    """The compiled forms, at one row each."""
    model = ssm.Model("moments", inputs=("low", "high"))
    model.initial(lambda: {"x": ssm.Dirac(0.0)})
    model.transition(lambda x: {"x": ssm.Dirac(x)})
    model.observation(lambda x, low, high: {
        "n": ssm.Truncated(ssm.Normal(x, sd=1), lower=low, upper=high),
        "o": ssm.Truncated(ssm.Normal(x, sd=1), lower=low),
        "e": ssm.Truncated(ssm.Exponential(rate=10.0), lower=low, upper=high),
        "g": ssm.Truncated(ssm.Gamma(2.5, rate=1.0), lower=low, upper=high),
        "p": ssm.Truncated(ssm.Poisson(2.0), lower=low, upper=high),
    })  # fmt: skip
    low = np.array([0.0, 1.0, 3.0, 0.0, 30.0])
    high = np.array([1.0, 1.0 + 1e-6, 100.0, 1e3, 40.0])
    inputs = {"low": low, "high": high}
    laws = {
        "n": NORMAL, "e": D.Exponential(rate=10.0), "g": D.Gamma(2.5, rate=1.0),
        "p": D.Poisson(2.0),
    }  # fmt: skip
    y = {k: np.full(5, np.nan) for k in (*laws, "o")}
    found = ssm.particle_filter(model, y | inputs, {}, particles=2, proposal="bootstrap", seed=1)
    expected = {k: np.array([moments(law, *b) for b in zip(low, high, strict=True)])
                for k, law in laws.items()}  # fmt: skip
    expected["o"] = np.array([one_sided(NORMAL, lower=b) for b in low])
    expected["o"][:, 0] -= low
    for k, own in expected.items():
        assert found[f"{k}_predicted"].values[0] - low == pytest.approx(own[:, 0], abs=1e-9)
        sd = found[f"{k}_predicted_sd"].values[0]
        np.testing.assert_allclose(sd, np.sqrt(own[:, 1]), rtol=1e-5, atol=1e-9)


FAR = [1e4, 1e7, 1e9, 1e12]


@pytest.mark.parametrize("bound", FAR)
@pytest.mark.parametrize("sides", ["lower", "upper", "both"])
def test_bounds_far_in_heavy_tails_leave_the_moments(bound, sides):
    bounds = {"lower": {"lower": -bound}, "upper": {"upper": bound}}
    given = bounds.get(sides, {"lower": -bound, "upper": bound})
    for law, variance, left in [
        (STUDENT, 5.0 / 3.0, 100.0 / bound**3),
        (LAPLACE, 2.0, 0.0),
    ]:
        found = one_sided(law, **given)
        assert abs(found[0]) < 1e-9 + left
        assert found[1] == pytest.approx(variance, rel=1e-8 + left)
    if sides == "upper":
        found = one_sided(INVERSE_GAMMA, **given)
        assert found[1] == pytest.approx(st.invgamma(30, scale=30).var(), rel=1e-8)


@pytest.mark.parametrize("upper", [-0.5, 0.0, 0.1, 2.0, 30.0])
def test_laplace_cut_on_either_side_of_its_kink(upper):
    """From below it is upper - Exponential on the far side; X and its reflection beyond."""
    found = one_sided(LAPLACE, lower=-1e9, upper=upper)
    rest = np.exp(-max(upper, 0.0))  # the density is exp(-|x|) / 2
    mass = 2.0 - rest if upper > 0.0 else np.exp(upper)
    first = -(upper + 1.0) * rest if upper > 0.0 else (upper - 1.0) * mass
    second = (4.0 - (upper**2 + 2 * upper + 2.0) * rest if upper > 0.0
              else (upper**2 - 2 * upper + 2.0) * mass)  # fmt: skip
    assert found[0] == pytest.approx(first / mass, rel=1e-9, abs=1e-12)
    assert found[1] == pytest.approx(second / mass - (first / mass) ** 2, rel=1e-8)


@pytest.mark.parametrize(("lower", "rel"), [(1.0, 1e-4), (100.0, 0.02)])
def test_a_law_of_the_users_own_has_the_moments_that_exist(lower, rel):
    """Its upper tail is one less its distribution function, to 1e-16 of the law."""
    law, heavy = PARETO
    found = one_sided(law, lower=lower)
    assert found[0] == pytest.approx(lower + 0.5 * (lower + 1.0), rel=rel)
    assert found[1] == pytest.approx(0.75 * (lower + 1.0) ** 2, rel=10 * rel)
    assert one_sided(law, upper=1e9)[1] == pytest.approx(0.75, rel=1e-4)
    assert one_sided(heavy, lower=lower)[0] == np.inf


@ssm.distribution(lower=0, positive=("shape",))
def Pareto(y, shape):
    return np.log(shape) - (shape + 1) * np.log1p(y)


@Pareto.cdf
def below(y, shape):
    return -np.expm1(-shape * np.log1p(y))


@Pareto.quantile
def value(p, shape):
    return np.expm1(-np.log1p(-p) / shape)


@Pareto.mean
def mean_of_pareto(shape):
    return np.where(shape > 1, 1 / (shape - 1.0), np.inf)


PARETO = Pareto(3.0), Pareto(0.5)
