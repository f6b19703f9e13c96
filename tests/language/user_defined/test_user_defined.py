"""Laws of a user's own: densities, draws, what is derived of them, what they refuse."""

import math
import pickle

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.proposals.smooth import smooth_filter_applies
from ssmppl.errors import DataError, ModelError, NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.inference.checkpoints.origin import model_digest
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.tracing import trace
from tests.language.user_defined.user_defined_laws import (
    NAMES,
    TABLE,
    Gumbel,
    Lomax,
    OwnGamma,
    OwnNormal,
    OwnPoisson,
    Steps,
    Triangle,
    Yule,
    mixed_model,
)
from tests.statistics.checks import seed_of

Y = symbol("state", "y")
SCALE = 2.0  # read by a law below


def log_densities(law, values):
    form = law.log_density(Y)
    return np.broadcast_to(evaluate(form, {Y: values}), np.shape(values))


def of(law, part, *given):
    return float(evaluate(array(getattr(law, part)(*map(array, given)))[()]))


# -- one law
@pytest.mark.parametrize(("law", "arguments", "exact"), TABLE, ids=NAMES)
def test_densities_and_draws_are_those_of_scipy(law, arguments, exact):
    made = law(**arguments)
    values = exact.ppf(np.linspace(0.001, 0.999, 41))
    expected = exact.logpmf(values) if made.discrete else exact.logpdf(values)
    np.testing.assert_allclose(log_densities(made, values), expected, rtol=1e-11, atol=1e-11)
    rng = np.random.default_rng(seed_of("written draws", law.__name__))
    drawn = evaluate(array(made.sample(Draws("y")))[()], {}, numpy_draws(rng, (20_000,)))
    if made.discrete:  # Kolmogorov's test is conservative there
        k, share = np.unique(drawn, return_counts=True)
        distance = np.max(np.abs(np.cumsum(share) / len(drawn) - exact.cdf(k)))
        assert stats.kstwo.sf(distance, len(drawn)) > 1e-4
    else:
        assert stats.kstest(drawn, exact.cdf).pvalue > 1e-4


@pytest.mark.parametrize(("law", "arguments", "exact"), TABLE, ids=NAMES)
def test_what_was_declared_agrees_with_the_density(law, arguments, exact):
    found = law.check(**arguments, seed=seed_of("check", law.__name__))
    assert abs(found.total - 1.0) < 1e-6
    assert found.p_value > 1e-4
    if np.isfinite(exact.mean()):
        assert found.mean == pytest.approx(exact.mean(), rel=1e-5)
    assert str(found).startswith(repr(law(**arguments)))
    if not law.bounds.discrete:
        source = numpy_draws(np.random.default_rng(seed_of("check", law.__name__)), (10_000,))
        drawn = evaluate(array(law(**arguments).sample(Draws("check")))[()], {}, source)
        assert found.p_value == pytest.approx(stats.kstest(drawn, exact.cdf).pvalue, rel=1e-6)


def test_densities_are_integrated_to_many_digits():
    """With two peaks, the one far narrower than the other; and with a jump aside of the peak."""

    @ssm.distribution
    def Two(y, at, sd):
        wide = -(y**2) / 2
        return np.logaddexp(wide, -(((y - at) / sd) ** 2) / 2 - np.log(sd)) - np.log(8 * np.pi) / 2

    assert Two.check(50.0, 0.05).total == pytest.approx(1.0, abs=1e-10)

    @ssm.distribution(lower=0)
    def Jump(y, at):
        rate = np.where(y < at, 3.0, 1.0)
        return np.log(rate) - np.where(y < at, 3 * y, 3 * at + (y - at))

    assert Jump.check(0.7).total == pytest.approx(1.0, abs=1e-10)


def test_sums_of_heavy_tails_are_allowed_for():
    found = Yule.check(0.5)
    assert 1e-4 < 1.0 - found.total < 1e-2
    with pytest.raises(ModelError, match="not to 1"):
        ssm.distribution(
            lambda k: 0.01 + np.log(0.5) - np.log(k + 1) - np.log(k + 1.5), lower=0, discrete=True
        ).check()


def test_outside_of_the_support_the_density_is_zero():
    np.testing.assert_array_equal(log_densities(Lomax(2.0, 1.0), [-1.0, 0.0]), [-np.inf, -np.inf])
    at_bounds = log_densities(Triangle(0.0, 2.0), [-0.1, 0.0, 1.0, 2.0, 2.1])
    np.testing.assert_allclose(at_bounds, [-np.inf, -np.inf, 0.0, -np.inf, -np.inf])
    counts = log_densities(OwnPoisson(2.0), [-1.0, 0.5, 0.0])
    np.testing.assert_allclose(counts, [-np.inf, -np.inf, -2.0])


def test_bounds_belong_to_a_closed_support_only():
    def flat(y):
        return 0.0

    for closed, expected in ((False, -np.inf), (True, 0.0)):
        law = ssm.distribution(flat, lower=0, upper=1, closed=closed)()
        np.testing.assert_array_equal(log_densities(law, [0.0, 1.0]), [expected] * 2)


def test_few_values_need_the_density_alone():
    law, exact = Steps(0.4), np.exp(0.4 * np.arange(-1, 3))
    exact /= exact.sum()
    k = np.arange(-1, 3)
    assert of(law, "mean") == pytest.approx(exact @ k, rel=1e-14)
    assert of(law, "variance") == pytest.approx(exact @ k**2 - (exact @ k) ** 2, rel=1e-14)
    cdf = np.cumsum(exact)
    for value, below in zip(k, cdf, strict=True):
        assert of(law, "cdf", value) == pytest.approx(below, rel=1e-14)
        assert of(law, "quantile", below - 1e-9) == value
    assert of(law, "cdf", -1.5) == 0.0
    Steps.check(0.4)


def test_arguments_go_by_name_by_place_and_by_default():
    x = symbol("state", "x")
    assert repr(Gumbel(1.0)) == "Gumbel(loc=1, scale=1)"
    assert repr(Gumbel(scale=2, loc=x)) == repr(Gumbel(x, 2)) == "Gumbel(loc=x, scale=2)"
    wide = Gumbel(np.stack([x, 2 * x]), np.array([1.0, 3.0]))
    assert wide.shape == (2,)
    found = evaluate(array(wide.log_densities(array([0.3, 0.4]))), {x: 0.7})
    np.testing.assert_allclose(found, stats.gumbel_r.logpdf([0.3, 0.4], [0.7, 1.4], [1.0, 3.0]))


def test_arguments_that_have_to_be_positive():
    s = symbol("parameter", "s")
    for law in (Lomax(s, 1.0), OwnGamma(s, 1.0), OwnPoisson(s)):
        with np.errstate(all="ignore"):
            found = evaluate(law.log_density(Y), {Y: 1.0, s: np.array([-1.5, 2.0])})
        np.testing.assert_array_equal(np.isnan(found), [True, False])


def test_a_truncated_law_of_ones_own():
    exact = stats.gumbel_r(0.5, 2.0)
    law = ssm.Truncated(Gumbel(0.5, 2.0), lower=-1, upper=4)
    mass = exact.cdf(4) - exact.cdf(-1)
    values = np.linspace(-0.9, 3.9, 7)
    np.testing.assert_allclose(log_densities(law, values), exact.logpdf(values) - np.log(mass))
    rng = np.random.default_rng(seed_of("truncated Gumbel"))
    drawn = evaluate(array(law.sample(Draws("y")))[()], {}, numpy_draws(rng, (20_000,)))
    cdf = lambda v: (exact.cdf(v) - exact.cdf(-1)) / mass  # noqa: E731
    assert stats.kstest(drawn, cdf).pvalue > 1e-4


def test_functions_run_twice_for_each_pattern_of_numbers(tmp_path):
    """And never again: what the model is made of are the expressions. (They are counted in a file:
    a counter that a law reads would change with each call, and the law be traced again.)"""
    calls = tmp_path / "calls"

    @ssm.distribution
    def Counted(y, loc, scale):
        with calls.open("a") as file:
            file.write("1")
        return -np.log(2 * scale) - np.abs(y - loc) / scale

    @Counted.sampler
    def draw(rng, loc, scale):
        u = rng.uniform() - 0.5
        return loc - scale * np.sign(u) * np.log1p(-2 * np.abs(u))

    model = ssm.Model("counted")
    model.initial(lambda: {"x": Counted(0.0, 1.0)})
    model.transition(lambda x: {"x": Counted(0.5 * x, 1.0)})
    model.observation(lambda x: {"y": Counted(np.stack([x, 2 * x, x]), 2.0)})
    data = {"y": np.zeros((4, 3))}
    ssm.log_likelihood(model, data, {}, particles=10, seed=1)
    assert len(calls.read_text()) == 6  # (0, 1), (symbol, 1), (symbol, 2)
    ssm.simulate(model, {}, steps=3, seed=1)
    ssm.particle_filter(model, data, {}, particles=10, seed=1)
    assert len(calls.read_text()) == 6


def test_functions_divide_by_numbers_that_are_zero():
    """As NumPy does, on all that np.where leaves out too."""
    found = [float(evaluate(array(Lomax(shape, 2.0).mean()))) for shape in (0.5, 1.0, 3.0)]
    assert found == [math.inf, math.inf, 1.0]
    by_symbol = Lomax(Y, 2.0).mean()
    assert evaluate(array(by_symbol)[()], {Y: np.array([1.0, 3.0])}).tolist() == [math.inf, 1.0]


def test_one_draw_that_is_used_twice_is_one_draw():
    @ssm.distribution(lower=0, upper=1)
    def Arcsine(y):
        return -np.log(np.pi) - 0.5 * np.log(y) - 0.5 * np.log1p(-y)

    @Arcsine.sampler
    def draw(rng):
        a, b = rng.gamma(0.5), rng.gamma(0.5)
        return a / (a + b)

    Arcsine.check()


# -- in a model
def test_the_same_law_written_by_a_user_gives_the_same_numbers():
    plain = mixed_model(ssm.Gamma, ssm.Normal, ssm.Poisson)
    own = mixed_model(OwnGamma, OwnNormal, OwnPoisson)
    parameters = {"tau": 2.0, "phi": [0.5, 0.8], "lam": 3.0}
    made = [ssm.simulate(m, parameters, steps=40, seed=3) for m in (plain, own)]
    for name in made[0].data_vars:
        np.testing.assert_allclose(made[0][name], made[1][name], rtol=1e-12)
    data = {n: made[0][n].values[0] for n in ("y", "z")}
    data["z"][5, 1] = np.nan
    found = [
        ssm.log_likelihood(m, data, parameters, proposal="bootstrap", repeats=3, seed=4)
        for m in (plain, own)
    ]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)


def test_conjugate_updates_are_found_in_the_density():
    plans = [
        ssm.explain(mixed_model(*laws))
        for laws in (
            (ssm.Gamma, ssm.Normal, ssm.Poisson),
            (OwnGamma, OwnNormal, OwnPoisson),
            (OwnGamma, ssm.Normal, OwnPoisson),
        )
    ]
    told = [
        dict(p.sections())["Gibbs updates (full conditionals given states and data)"] for p in plans
    ]
    assert told[0] == told[1] == told[2]
    families = {u.block[0]: u.family_name for u in plans[1].updates}
    assert families == {"tau": "Gamma", "phi": "Normal", "lam": "Gamma"}


def test_posteriors_under_a_users_gamma_prior_are_the_same_draws():
    def model(gamma):
        m = ssm.Model("level")
        m.prior(lambda: {"tau": gamma(3.0, rate=2.0)})
        m.initial(lambda: {"x": ssm.Normal(0, sd=1)})
        m.transition(lambda x, tau: {"x": ssm.Normal(x, precision=tau)})
        m.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
        return m

    data = {"y": np.sin(np.arange(25.0))}
    found = [
        ssm.sample(
            model(gamma), data, ssm.Gibbs(), draws=50, warmup=20, chains=2, seed=5,
            progress=False,
        )["posterior"]["tau"].values
        for gamma in (ssm.Gamma, OwnGamma)
    ]  # fmt: skip
    np.testing.assert_allclose(found[0], found[1], rtol=1e-10)


def lomax_model(shape=2.5):
    model = ssm.Model("claims")
    model.prior(lambda: {"scale": ssm.Gamma(4, rate=2)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=0.1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=0.1)})
    model.observation(lambda scale: {"y": Lomax(shape, scale)})
    return model


def test_predictions_and_pit_values():
    data = {"y": np.array([0.1, 3.0, 0.7, 12.0])}
    found = ssm.particle_filter(lomax_model(), data, {"scale": 3.0}, particles=50, seed=1)
    exact = stats.lomax(2.5, scale=3.0)
    np.testing.assert_allclose(found["y_pit"].values[0], exact.cdf(data["y"]), rtol=1e-12)
    np.testing.assert_allclose(found["y_predicted"].values[0], 2.0, rtol=1e-12)
    total = exact.logpdf(data["y"]).sum()
    value = ssm.log_likelihood(lomax_model(), data, {"scale": 3.0}, particles=50, seed=1)
    np.testing.assert_allclose(value, total, rtol=1e-12)


def test_simulate_predict_and_forecast():
    model = lomax_model()
    made = ssm.simulate(model, {"scale": 3.0}, steps=1000, seed=2)["y"].values
    assert stats.kstest(made.ravel(), stats.lomax(2.5, scale=3.0).cdf).pvalue > 1e-4
    data = {"y": made[0, :30]}
    idata = ssm.sample(model, data, draws=300, warmup=100, chains=2, seed=3, progress=False)
    scale = idata["posterior"]["scale"].values.ravel()
    for drawn in (
        ssm.predict(model, idata, data, seed=4)["posterior_predictive"]["y"].values.reshape(
            600, 30
        ),
        ssm.forecast(model, idata, steps=30, seed=5)["y"].values,
    ):
        uniform = stats.lomax(2.5, scale=scale[:, None]).cdf(drawn)  # each under its own scale
        assert stats.kstest(uniform.ravel(), "uniform").pvalue > 1e-4


def test_a_finite_chain_of_a_users_law_is_exact():
    """Steps of a queue, by matrices of the law's probabilities."""
    model = ssm.Model("steps")
    model.initial(lambda: {"k": Steps(0.0)})
    model.transition(lambda k: {"k": Steps(0.5 * k)})
    model.observation(lambda k: {"y": ssm.Normal(k, sd=0.7)})
    y = np.array([0.2, 1.1, -0.6, 2.3, 1.9])
    values = np.arange(-1.0, 3.0)
    step = np.exp(0.5 * values[:, None] * values)
    step /= step.sum(axis=1, keepdims=True)
    alpha = np.full(4, 0.25) * stats.norm.pdf(y[0], values, 0.7)
    for one in y[1:]:
        alpha = (alpha @ step) * stats.norm.pdf(one, values, 0.7)
    found = ssm.log_likelihood(model, {"y": y}, {}, repeats=2)
    np.testing.assert_allclose(found, math.log(alpha.sum()), rtol=1e-12)
    drawn = ssm.log_likelihood(
        model, {"y": y}, {}, proposal="bootstrap", particles=20_000, repeats=20, seed=1
    )
    ratio = np.exp(drawn) / alpha.sum()
    assert abs(ratio.mean() - 1.0) < 4 * ratio.std(ddof=1) / np.sqrt(20)


def test_values_outside_of_the_support_are_refused():
    for value, bounds in ((-1.0, "(0, inf)"), (0.0, "(0, inf)")):
        with pytest.raises(DataError, match="outside the support of Lomax") as error:
            ssm.log_likelihood(lomax_model(), {"y": [1.0, value]}, {"scale": 1.0})
        assert bounds in str(error.value)


def test_an_argument_that_left_its_range_is_named():
    model = ssm.Model("left")
    model.initial(lambda: {"x": ssm.Normal(-5, sd=0.1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=0.1)})
    model.observation(lambda x: {"y": Lomax(2.0, x)})
    with pytest.raises(ssm.SSMError, match="the scale of Lomax, x, ") as error:
        ssm.simulate(model, {}, steps=3, seed=1)
    assert "np.exp(x)" in str(error.value)


def test_samplers_that_jump_have_no_smooth_filter():
    @ssm.distribution
    def Two(y, loc):
        return np.logaddexp(-((y - loc) ** 2) / 2, -((y + loc) ** 2) / 2) - np.log(8 * np.pi) / 2

    @Two.sampler
    def draw(rng, loc):
        return np.where(rng.uniform() < 0.5, loc, -loc) + rng.normal()

    Two.check(3.0)
    for law, jumps in ((Two, True), (Gumbel, False)):
        model = ssm.Model("jumps")
        model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
        model.transition(lambda x, law=law: {"x": law(0.5 * x)})
        model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
        assert isinstance(smooth_filter_applies(trace(model)), NotApplicable) == jumps


# -- changes and travels
def test_a_trace_travels_without_the_functions():
    model = mixed_model(OwnGamma, OwnNormal, OwnPoisson)
    before = trace(model)
    digest = model_digest(before)
    content = pickle.dumps(before)
    assert b"user_defined_laws" in content  # where it was declared, for messages
    law = pickle.loads(pickle.dumps(before.observations["y"].distribution))
    assert type(law).__name__ == "OwnPoisson"
    assert law.log_density(Y) is before.observations["y"].distribution.log_density(Y)
    assert model_digest(before) == digest


def test_a_declared_law_travels_by_name():
    assert pickle.loads(pickle.dumps(Lomax)) is Lomax


def test_another_density_is_another_model():
    def model(law):
        m = ssm.Model("digest")
        m.initial(lambda: {"x": law(0.0, 1.0)})
        m.transition(lambda x: {"x": law(x, 1.0)})
        return trace(m)

    def make(power, factor):
        def Power(y, loc, scale):
            return -(np.abs((y - loc) / scale) ** power)

        law = ssm.distribution(Power)

        @law.sampler
        def draw(rng, loc, scale):
            return loc + factor * scale * rng.normal()

        return law

    digests = [model_digest(model(make(*own))) for own in ((2, 1), (4, 1), (2, 2), (2, 1))]
    assert digests[0] == digests[3] != digests[1]
    assert digests[0] != digests[2]


def test_models_follow_what_a_law_reads():
    def scaled(y, loc):
        return -np.log(SCALE) - ((y - loc) / SCALE) ** 2 / 2

    law = ssm.distribution(scaled)
    model = ssm.Model("reads")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": law(x)})
    first = trace(model)
    assert trace(model) is first
    global SCALE
    SCALE, before = 3.0, SCALE
    try:
        second = trace(model)
    finally:
        SCALE = before
    at = {second.state_symbols[0]: 0.0, second.observation_symbols[0]: 1.0}
    value = evaluate(second.observations["y"].distribution.log_density(
        second.observation_symbols[0]), at)  # fmt: skip
    assert value == pytest.approx(-np.log(3.0) - 1 / 18, rel=1e-14)

    assert not second.observations["y"].distribution.drawable
    third = trace(model)
    law.sampler(lambda rng, loc: loc + SCALE * rng.normal())
    fourth = trace(model)
    assert fourth is not third
    assert fourth.observations["y"].distribution.drawable


# -- what `check` finds
def broken(density=None, sampler=None, **parts):
    """A declared Exponential law with one part of it wrong."""
    law = ssm.distribution(density or (lambda y, rate: np.log(rate) - rate * y), lower=0)
    law.sampler(sampler or (lambda rng, rate: -np.log(rng.uniform()) / rate))
    for part, function in parts.items():
        getattr(law, part)(function)
    return law


@pytest.mark.parametrize(
    ("law", "found"),
    [
        (broken(lambda y, rate: -rate * y), "integrates to 0.5, not to 1\nFix: add 0.693147181"),
        (broken(sampler=lambda rng, rate: rng.exponential(rate)), "do not follow its density"),
        (broken(sampler=lambda rng, rate: rng.normal()), "which is outside of its support, 0 to"),
        (broken(mean=lambda rate: rate), "the mean of <lambda>(rate=2) is 2, by its density 0.5"),
        (broken(variance=lambda rate: 1 / rate), "the variance of"),
        (broken(cdf=lambda y, rate: 1 - np.exp(-y)), "the distribution function at"),
        (
            broken(cdf=lambda y, rate: -np.expm1(-rate * y), quantile=lambda p, rate: p / rate),
            "the quantile of",
        ),
        (broken(lambda y, rate: np.log(np.log(rate * y) - 1)), "is nan at"),
    ],
)
def test_check_tells_what_does_not_agree(law, found):
    with pytest.raises(ModelError) as error:
        law.check(2.0, draws=2000)
    assert found in str(error.value)
    assert "test_user_defined.py" in str(error.value)


def test_check_of_counts_tells_what_does_not_agree():
    def wrong(k, p):
        return k * np.log(p)

    law = ssm.distribution(wrong, lower=0, discrete=True)
    with pytest.raises(ModelError, match="sums to 2, not to 1"):
        law.check(0.5)

    def geometric(k, p):
        return np.log1p(-p) + k * np.log(p)

    law = ssm.distribution(geometric, lower=0, discrete=True)
    law.check(0.5)
    law.sampler(lambda rng, p: np.log(rng.uniform()) / np.log(p))
    with pytest.raises(ModelError, match="no whole number"):
        law.check(0.5)
    law.sampler(lambda rng, p: np.floor(np.log(rng.uniform()) / np.log(p)) + 1)
    with pytest.raises(ModelError, match="do not follow"):
        law.check(0.5)
    law.sampler(lambda rng, p: np.floor(np.log(rng.uniform()) / np.log(p)))
    assert law.check(0.5).mean == pytest.approx(1.0)


@pytest.mark.slow
def test_a_right_sampler_fails_the_check_as_often_as_its_level_says():
    """Kolmogorov's test is exact: at the level 0.1 the count of failures is Binomial(400, 0.1)."""
    failed = 0
    for seed in range(400):
        try:
            Lomax.check(1.5, 2.0, draws=200, level=0.1, seed=seed)
        except ModelError:
            failed += 1
    assert stats.binomtest(failed, 400, 0.1).pvalue > 1e-3


@ssm.distribution(lower="low", upper="high")
def Between(y, low, high):
    return -np.log(high - low) + 0.0 * y


@Between.sampler
def between(rng, low, high):
    return rng.uniform(low, high)


def test_a_sampler_draws_uniform_numbers_between_arguments():
    model = ssm.Model("between")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x, a: {"y": Between(a, a + 2.0)})
    y = ssm.simulate(model, {"a": 5.0}, steps=2000, seed=1)["y"].values[0]
    assert stats.kstest(y, "uniform", args=(5.0, 2.0)).pvalue > 1e-4
    assert Between.check(0.0, 1.0).p_value > 1e-4
