"""Models without noise in their states: one run of the states is the whole of inference."""

import numpy as np
import pytest
from scipy import optimize, special, stats
from scipy.special import logsumexp

import ssmppl as ssm
from ssmppl.inference.exact.derivatives import jacobian, observed_information
from tests.statistics.checks import MCSE, assert_within, deviations, seed_of


@pytest.fixture(scope="module")
def tank():
    """A tank with an outflow by Torricelli's law: an output-error model with an input."""
    model = ssm.Model("tank", inputs=("inflow",))
    model.prior(
        lambda: {
            "k": ssm.Uniform(0.05, 1),
            "start": ssm.Gamma(4, rate=2),
            "r": ssm.InverseGamma(3, scale=0.05),
        }
    )
    model.initial(lambda start: {"level": ssm.Dirac(start), "total": ssm.Dirac(0.0)})
    model.transition(
        lambda level, total, inflow, k: {
            "level": ssm.Dirac(level + 0.5 * (inflow - k * np.sqrt(np.abs(level)))),
            "total": ssm.Dirac(total + inflow),
        }
    )
    model.observation(
        lambda level, r, k: {
            "y": ssm.Normal(level, variance=r),
            "flow": ssm.Normal(k * np.sqrt(np.abs(level)), sd=0.1),
        }
    )
    return model


def tank_rows(steps, seed):
    rng = np.random.default_rng(seed)
    y, flow = 1.5 + 0.3 * rng.normal(size=steps), 0.4 + 0.1 * rng.normal(size=steps)
    y[3] = flow[5] = np.nan
    return {"inflow": 0.4 + 0.3 * np.sin(np.arange(steps) / 4), "y": y, "flow": flow}


def tank_levels(data, k, start):
    level = np.empty(len(data["y"]))
    level[0] = start
    for t in range(1, len(level)):
        level[t] = level[t - 1] + 0.5 * (data["inflow"][t - 1] - k * np.sqrt(abs(level[t - 1])))
    return level


def tank_log_likelihood(sets, k, start, r):
    total = 0.0
    for data in sets:
        level = tank_levels(data, k, start)
        total += np.nansum(stats.norm.logpdf(data["y"], level, np.sqrt(r)))
        total += np.nansum(stats.norm.logpdf(data["flow"], k * np.sqrt(np.abs(level)), 0.1))
    return total


TANK = {"k": 0.3, "start": 1.2, "r": 0.09}


@pytest.fixture(scope="module")
def garch():
    """GARCH(1, 1) with leverage: the variance follows from what was observed."""
    model = ssm.Model("garch")
    model.prior(
        lambda: {
            "w": ssm.HalfNormal(sd=1),
            "a": ssm.Uniform(0, 1),
            "g": ssm.Uniform(0, 1),
            "b": ssm.Uniform(0, 1),
        }
    )
    model.initial(lambda w: {"h": ssm.Dirac(5 * w)})
    model.transition(
        lambda h, y, w, a, g, b: {
            "h": ssm.Dirac(w + (a + g * np.where(y < 0, 1.0, 0.0)) * y**2 + b * h)
        }
    )
    model.observation(lambda h: {"y": ssm.Normal(0, variance=h)})
    return model


def garch_log_likelihood(y, w, a, g, b):
    h, total = 5 * w, 0.0
    for value in y:
        total += stats.norm.logpdf(value, 0, np.sqrt(h)) if h > 0 else -np.inf
        h = w + (a + g * (value < 0)) * value**2 + b * h
    return total


def returns(steps, seed):
    rng, h, y = np.random.default_rng(seed), 1.0, np.empty(steps)
    for t in range(steps):
        y[t] = np.sqrt(h) * rng.normal()
        h = 0.1 + (0.05 + 0.1 * (y[t] < 0)) * y[t] ** 2 + 0.8 * h
    return y


# -- likelihood, score and information
def test_likelihood_and_increments_are_those_of_the_recursion(tank, garch):
    sets = [tank_rows(30, 1), tank_rows(7, 2)]
    exact = tank_log_likelihood(sets, **TANK)
    assert ssm.log_likelihood(tank, sets, TANK, repeats=2) == pytest.approx([exact] * 2, rel=1e-13)
    one = ssm.log_likelihood(tank, sets, TANK, proposal="bootstrap", particles=1)
    assert one == pytest.approx(exact, rel=1e-12)
    y, theta = returns(50, 3), {"w": 0.1, "a": 0.05, "g": 0.1, "b": 0.8}
    exact = garch_log_likelihood(y, **theta)
    assert ssm.log_likelihood(garch, {"y": y}, theta) == pytest.approx(exact, rel=1e-13)


@pytest.mark.parametrize("fixed", [(), ("k",), ("start", "r")])
def test_score_and_information_are_those_of_the_recursion(tank, fixed):
    sets, names = [tank_rows(30, 1), tank_rows(7, 2)], list(TANK)
    x, free = np.array(list(TANK.values())), np.array([n not in fixed for n in names])

    def gradient(v):
        def value(u):
            return np.array([tank_log_likelihood(sets, *u)])

        return jacobian(value, v, np.full(3, 1e-2))[0][0]

    found = ssm.score(tank, sets, TANK, fixed={n: TANK[n] for n in fixed})
    assert found.attrs["method"] == "exact, by the sensitivities of the states"
    exact = dict(zip(names, gradient(x), strict=True))
    assert found.gradient == pytest.approx({n: exact[n] for n in found.gradient}, rel=1e-8)
    assert list(found.gradient) == [n for n in names if n not in fixed]
    information, _ = observed_information(gradient, x, free)
    scale = np.sqrt(np.diagonal(information)[free])
    own = found.information.to_numpy() / np.outer(scale, scale)
    assert own == pytest.approx(information[np.ix_(free, free)] / np.outer(scale, scale), abs=1e-5)


def rooted(level):
    """The root, by way of functions without a derivative in their first argument."""
    s = 1.0 + level * level
    return np.sqrt(np.abs(level)) * (special.gammainc(s, 1.0) + special.gammaincc(s, 1.0))


@ssm.primitive
def outflow(level):
    return np.sqrt(abs(level))


@pytest.mark.parametrize("law", [rooted, outflow])
def test_functions_without_a_derivative_leave_differences(tank, law):
    """Primitives have one."""
    model = ssm.Model("tank with a function", inputs=("inflow",))
    model.prior(lambda: {"k": ssm.Uniform(0.05, 1)})
    model.initial(lambda: {"level": ssm.Dirac(1.2)})
    model.transition(
        lambda level, inflow, k: {"level": ssm.Dirac(level + 0.5 * (inflow - k * law(level)))}
    )
    model.observation(lambda level: {"y": ssm.Normal(level, sd=0.3)})
    rows = {n: tank_rows(30, 1)[n] for n in ("inflow", "y")}

    def value(k):
        level = tank_levels(rows, k[0], 1.2)
        return np.array([np.nansum(stats.norm.logpdf(rows["y"], level, 0.3))])

    exact = jacobian(value, np.array([0.3]), np.array([1e-2]))[0][0, 0]
    found = ssm.score(model, rows, {"k": 0.3})
    assert found.gradient["k"] == pytest.approx(exact, rel=1e-8)
    told = found.attrs.get("central_differences", "")
    assert ("the states have no derivatives in closed form" in told) == (law is rooted)
    idata = ssm.sample(model, rows, draws=4, warmup=4, chains=2, seed=1, progress=False)
    assert idata.attrs["method"] == "MetropolisHastings"


def test_the_likelihood_is_zero_where_the_run_leaves_the_numbers():
    model = ssm.Model("explosive")
    model.prior(lambda: {"a": ssm.Normal(0, sd=10), "s": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Dirac(1.0)})
    model.transition(lambda x, a: {"x": ssm.Dirac(a * x**2)})
    model.observation(lambda x, s: {"y": ssm.Normal(x, sd=s)})
    rows = {"y": np.zeros(40)}
    for bad in ({"a": 9.0, "s": 1.0}, {"a": 0.5, "s": -1.0}):
        assert ssm.log_likelihood(model, rows, bad) == -np.inf
    assert np.isfinite(ssm.log_likelihood(model, rows, {"a": 0.5, "s": 1.0}))


# -- the verbs
def test_the_maximum_is_that_of_the_recursion(tank, garch):
    sets = [tank_rows(60, 4)]
    found = ssm.maximize(tank, sets, seed=1, progress=False)
    assert found.attrs["method"] == "DirectOptimization"
    assert found.attrs["likelihood"] == "exact, by one deterministic simulation"
    best = optimize.minimize(
        lambda v: -tank_log_likelihood(sets, v[0], v[1], np.exp(v[2])), [0.3, 1.2, -2.4],
        method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 10_000},
    )  # fmt: skip
    assert found.log_likelihood == pytest.approx(-best.fun, rel=1e-10)
    k, start, log_r = best.x
    values = np.array([k, start, np.exp(log_r)])
    assert list(found.parameters.values()) == pytest.approx(values, rel=1e-5)

    def gradient(v):
        def value(u):
            return np.array([tank_log_likelihood(sets, *u)])

        return jacobian(value, v, 1e-2 * np.ones(3))[0][0]

    information, _ = observed_information(gradient, values, np.ones(3, dtype=bool))
    errors = np.sqrt(np.diagonal(np.linalg.inv(information)))
    assert list(found.standard_errors.values()) == pytest.approx(errors, rel=1e-3)

    y = returns(400, 5)
    found = ssm.maximize(garch, {"y": y}, seed=1, progress=False)
    best = optimize.minimize(
        lambda v: -garch_log_likelihood(y, *v) if np.all((v > 0) & (v < 1)) else np.inf,
        list(found.parameters.values()), method="Nelder-Mead",
    )  # fmt: skip
    assert found.log_likelihood >= -best.fun - 1e-6


@pytest.mark.slow
def test_the_posterior_and_the_evidence_are_those_of_a_grid(tank):
    rows = tank_rows(40, 6)
    held = {"r": 0.09}
    k, start = np.linspace(0.2, 0.5, 61), np.linspace(0.3, 3, 301)
    log_p = np.array([[tank_log_likelihood([rows], a, b, 0.09) for b in start] for a in k])
    joint = log_p + stats.gamma.logpdf(start, 4, scale=0.5) - np.log(0.95)
    share = np.exp(joint - joint.max())
    exact = np.log(share.sum() * (k[1] - k[0]) * (start[1] - start[0])) + joint.max()
    share /= share.sum()
    assert share[[0, -1]].sum() + share[:, [0, -1]].sum() < 1e-9  # the grid holds it all
    seed = seed_of("tank on a grid")
    found = ssm.evidence(tank, rows, fixed=held, seed=seed, progress=False)
    assert abs(found.log_evidence - exact) < MCSE * found.standard_error
    for order in (None, 1):
        method = None if order is None else ssm.MetropolisHastings(order=order)
        idata = ssm.sample(
            tank, rows, method, fixed=held, draws=4000, chains=4, seed=seed, progress=False
        )
        assert idata.attrs["method"] == "MetropolisHastings"
        for name, values, law in (("k", k, share.sum(axis=1)), ("start", start, share.sum(axis=0))):
            mean = law @ values
            sd = np.sqrt(law @ (values - mean) ** 2)
            assert_within(deviations(idata["posterior"][name].values, mean, sd))


def test_drawn_states_follow_from_the_parameters_drawn(tank):
    rows = tank_rows(20, 7)
    idata = ssm.sample(tank, rows, draws=20, warmup=20, chains=2, seed=1, progress=False)
    posterior = idata["posterior"]
    for chain in range(2):
        for draw in (0, 19):
            one = posterior.isel(chain=chain, draw=draw)
            level = tank_levels(rows, float(one["k"]), float(one["start"]))
            assert one["level"].values == pytest.approx(level, rel=1e-12)
    forecast = ssm.forecast(tank, idata, 3, inputs={"inflow": [0.4] * 3}, seed=1)
    assert np.isfinite(forecast["y"].values).all()
    predictive = ssm.predict(tank, idata, rows, seed=1)
    assert np.isfinite(predictive["posterior_predictive"]["y"].values).all()


def test_smoothing_gives_the_one_trajectory_without_a_warning(tank, recwarn):
    rows = tank_rows(200, 8)
    draws = ssm.smooth(tank, rows, TANK, trajectories=5, seed=1)
    level = tank_levels(rows, TANK["k"], TANK["start"])
    assert draws["level"].values == pytest.approx(np.tile(level, (5, 1)), rel=1e-12)
    assert not recwarn.list


@pytest.mark.slow
def test_leave_future_out_is_that_of_a_grid(garch):
    y, held = returns(60, 9), {"w": 0.1, "a": 0.05, "g": 0.1}
    found = ssm.leave_future_out(
        garch, {"y": y}, fixed=held, first=51, chains=2, seed=seed_of("garch ahead"), progress=False
    )
    b = (np.arange(400) + 0.5) / 400
    until = np.array([[garch_log_likelihood(y[:t], b=v, **held) for v in b] for t in range(50, 61)])
    exact = np.diff(logsumexp(until, axis=1))
    off = found["elpd"].values - exact
    assert np.all(np.abs(off) < 1.25 * MCSE * found["mc_error"].values)  # ten rows


def test_a_model_without_parameters_is_run(garch):
    theta = {"w": 0.1, "a": 0.05, "g": 0.1, "b": 0.8}
    y = returns(10, 2)
    idata = ssm.sample(garch, {"y": y}, fixed=theta, draws=5, chains=2, seed=1, progress=False)
    assert np.ptp(idata["posterior"]["h"].values, axis=(0, 1)) == pytest.approx(np.zeros(10))


# -- what does not apply
@pytest.mark.parametrize(
    ("verb", "method", "fix"),
    [
        ("sample", ssm.Gibbs(), "use ssm.MetropolisHastings(), whose likelihood is exact"),
        ("maximize", ssm.EM(), "use ssm.DirectOptimization(), whose likelihood and score are"),
    ],
)
def test_methods_for_unknown_states_are_refused(tank, verb, method, fix):
    with pytest.raises(ssm.ArgumentError) as refused:
        getattr(ssm, verb)(tank, tank_rows(20, 1), method=method)
    assert fix in " ".join(str(refused.value).split())
    assert "test_deterministic.py" in str(refused.value)


def test_the_name_of_the_exact_run(tank):
    rows = tank_rows(20, 1)
    exact = tank_log_likelihood([rows], **TANK)
    found = ssm.log_likelihood(tank, rows, TANK, proposal="deterministic")
    assert found == pytest.approx(exact, rel=1e-13)
    noisy = ssm.Model("noisy")
    noisy.initial(lambda: {"x": ssm.Dirac(0.0)})
    noisy.transition(lambda x: {"x": ssm.Normal(np.sin(x), sd=1)})
    noisy.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.raises(ssm.ArgumentError, match="the transition of x is Normal"):
        ssm.log_likelihood(noisy, {"y": [0.0]}, {}, proposal="deterministic")
    with pytest.raises(ssm.ArgumentError, match='Fix: use proposal="bootstrap"'):
        ssm.particle_filter(tank, rows, TANK, proposal="deterministic")
    filtered = ssm.particle_filter(tank, rows, TANK, proposal="bootstrap", seed=1)
    assert np.all(np.diff(filtered["y_predicted_quantile"].values, axis=-1) > 0.0)


def test_noise_in_the_first_row_only_is_told_how_to_be_exact():
    model = ssm.Model("unknown start")
    model.prior(lambda: {"a": ssm.Uniform(0, 1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Dirac(a * np.sin(x))})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    text = " ".join(str(ssm.explain(model)).split())
    assert "with it as a parameter (x_first in @prior, ssm.Dirac(x_first) in @initial)" in text
