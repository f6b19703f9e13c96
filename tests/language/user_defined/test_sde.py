"""SDEs: linear ones against their exact law, others against many small Euler-Maruyama steps."""

import numpy as np
import pytest
from scipy import linalg

import ssmppl as ssm
from ssmppl.analysis.structure import linear_gaussian
from ssmppl.errors import NotApplicable
from ssmppl.language.tracing import trace
from tests.statistics.checks import seed_of

OSCILLATOR = np.array([[0.0, 1.0], [-4.0, -0.6]])
NOISE = np.array([[0.1], [0.8]])


def oscillator():
    model = ssm.Model("oscillator", time_step="dt")

    @model.prior
    def prior():
        return {"k": ssm.HalfNormal(sd=10), "d": ssm.HalfNormal(sd=2)}

    @model.initial
    def initial():
        return {"x": ssm.MvNormal(np.array([1.0, 0.0]), covariance=0.2 * np.eye(2))}

    @model.transition
    def transition(x, dt, k, d):
        return {"x": ssm.SDE(lambda x: np.stack([x[1], -k * x[0] - d * x[1]]), NOISE, dt)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x[0], sd=0.3)}

    return model


def exact_likelihood(y, dt):
    m, p, total = np.array([1.0, 0.0]), 0.2 * np.eye(2), 0.0
    for t, value in enumerate(y):
        if t:
            block = np.zeros((4, 4))
            block[:2, :2], block[:2, 2:], block[2:, 2:] = -OSCILLATOR, NOISE @ NOISE.T, OSCILLATOR.T
            whole = linalg.expm(block * dt[t - 1])
            phi = whole[2:, 2:].T
            m, p = phi @ m, phi @ p @ phi.T + phi @ whole[:2, 2:]
        if np.isnan(value):
            continue
        s = p[0, 0] + 0.09
        total -= 0.5 * (np.log(2 * np.pi * s) + (value - m[0]) ** 2 / s)
        gain = p[:, 0] / s
        m, p = m + gain * (value - m[0]), p - np.outer(gain, p[0])
    return total


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(seed_of("oscillator record"))
    time = np.cumsum(rng.uniform(0.02, 1.5, 60))
    y = rng.normal(size=60)
    y[[0, 7, 8]] = np.nan
    return time, y


def test_a_linear_sde_at_uneven_times_is_exact(record):
    time, y = record
    assert not isinstance(linear_gaussian(trace(oscillator())), NotApplicable)
    (found,) = ssm.log_likelihood(oscillator(), {"y": y, "time": time}, {"k": 4.0, "d": 0.6})
    assert found == pytest.approx(exact_likelihood(y, np.diff(time)), abs=1e-9)


def test_the_time_step_may_be_given_and_dates_have_a_unit(record):
    import pandas as pd

    time, y = record
    steps = np.append(np.diff(time), 1.0)
    (given,) = ssm.log_likelihood(oscillator(), {"y": y, "dt": steps}, {"k": 4.0, "d": 0.6})
    dates = pd.Timestamp("2026-03-01") + pd.to_timedelta(60.0 * time, unit="s")
    model = oscillator()
    model.time_step = ("dt", "min")
    (found,) = ssm.log_likelihood(model, pd.DataFrame({"y": y}, index=dates), {"k": 4.0, "d": 0.6})
    assert found == pytest.approx(given, abs=1e-6)  # dates are whole nanoseconds
    plan = ssm.explain(model, pd.DataFrame({"y": y}, index=dates))
    text, parts = str(plan), dict(plan.sections())
    assert ("steps", "dt is the time from each row to the next, in min") in parts["Data"]
    assert all(what == "the exponential of a matrix" for _, what in parts["Numerical integration"])
    assert "approximated" not in text


def test_forecasts_at_the_times_that_are_asked_for():
    model = ssm.Model("flow", time_step="dt")

    @model.prior
    def prior():
        return {"rate": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial():
        return {"x": ssm.Dirac(8.0)}

    @model.transition
    def transition(x, dt, rate):
        return {"x": ssm.Dirac(ssm.integrate(lambda x: -rate * x, x, dt))}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.1)}

    data = {"y": np.zeros(3), "time": np.array([0.0, 0.5, 2.0])}
    ahead = ssm.forecast(model, {"rate": 0.5}, inputs={"time": [3.0, 7.0]}, data=data, seed=1)
    np.testing.assert_allclose(ahead["x"].values.mean(axis=0), 8 * np.exp([-1.5, -3.5]), rtol=1e-9)
    one = ssm.forecast(model, {"rate": 0.5}, inputs={"time": [3.0]}, data=data, seed=1)
    np.testing.assert_allclose(one["x"].values.mean(axis=0), 8 * np.exp([-1.5]), rtol=1e-9)
    even = data | {"time": np.array([0.0, 1.0, 2.0])}
    on = ssm.forecast(model, {"rate": 0.5}, steps=2, data=even, seed=1)
    np.testing.assert_allclose(on["x"].values.mean(axis=0), 8 * np.exp([-1.5, -2.0]), rtol=1e-9)
    with pytest.raises(ssm.SSMError, match="time"):
        ssm.forecast(model, {"rate": 0.5}, steps=2, data=data, seed=1)
    with pytest.raises(ssm.ArgumentError, match="not after the data"):
        ssm.forecast(model, {"rate": 0.5}, inputs={"time": [1.0, 3.0]}, data=data, seed=1)


def test_what_has_no_times_is_refused(record):
    _, y = record
    with pytest.raises(ssm.DataError, match="no times"):
        ssm.log_likelihood(oscillator(), {"y": y}, {"k": 4.0, "d": 0.6})
    labels = [f"row {k}" for k in range(60)]
    with pytest.raises(ssm.DataError, match="texts"):
        ssm.log_likelihood(oscillator(), {"y": y, "time": labels}, {"k": 4.0, "d": 0.6})
    with pytest.raises(ssm.ModelError, match="time_unit"):
        ssm.Model("m", time_step="dt", time_unit="week")
    with pytest.raises(ssm.ModelError, match="time_step"):
        ssm.Model("m", time_step="d t")


def law_of(drift, diffusion, dt=0.3, size=2, **options):
    """(mean, covariance) of the law of x at x = (0.7, -0.4) as numbers."""
    from ssmppl.expressions.arrays import array
    from ssmppl.expressions.evaluate import evaluate

    model = ssm.Model("small")

    @model.initial
    def initial():
        law = ssm.MvNormal(np.zeros(2), covariance=np.eye(2)) if size > 1 else ssm.Normal(0, sd=1)
        return {"x": law}

    @model.transition
    def transition(x):
        return {"x": ssm.SDE(drift, diffusion, dt, **options)}

    traced = trace(model)
    law = traced.transition["x"].distribution
    values = dict(zip(traced.state_prev_symbols, [0.7, -0.4], strict=False))
    spread = law.covariance_matrix() if size > 1 else law.variance()
    mean, spread = (np.asarray(evaluate(array(e), values), float) for e in (law.mean(), spread))
    return mean, spread, law


def by_euler(drift, root, dt, paths=200_000, steps=300, seed=0):
    """The same by simulated paths of steps so small that their error does not count."""
    rng = np.random.default_rng(seed)
    x = np.tile([[0.7], [-0.4]], (1, paths))
    h = dt / steps
    for _ in range(steps):
        g = root(x)
        x = x + h * drift(x) + np.sqrt(h) * g * rng.standard_normal(x.shape)
    return x.mean(axis=1), np.cov(x)


def test_a_nonlinear_sde_is_near_its_law_over_a_short_time():
    def drift(x):
        return np.stack([x[1], 1.5 * (1 - x[0] ** 2) * x[1] - x[0]])

    def spread(x):
        return np.stack([0.05 * np.exp(0.2 * x[1]), 0.3 + 0.0 * x[1]])

    mean, covariance, law = law_of(drift, spread, dt=0.1)
    expected = by_euler(drift, spread, 0.1, seed=seed_of("van der pol"))
    np.testing.assert_allclose(mean, expected[0], atol=4 * np.sqrt(0.01 / 200_000) + 5e-4)
    np.testing.assert_allclose(covariance, expected[1], rtol=0.03, atol=1e-4)
    assert "approximated" in law.approximation


def test_results_say_that_the_law_of_a_nonlinear_sde_is_approximate(record):
    model = van_der_pol("linearised", 4)
    drawn = ssm.simulate(model, {}, steps=5, seed=1)
    assert (
        "x: the distribution of an SDE, approximated by its lin"
        in drawn.attrs["approximate_distributions"]
    )
    filtered = ssm.particle_filter(model, {"y": drawn["y"].values[0]}, {}, particles=20, seed=1)
    assert filtered.attrs["approximate_distributions"] == drawn.attrs["approximate_distributions"]
    time, y = record
    exact = ssm.kalman_filter(oscillator(), {"y": y, "time": time}, {"k": 4.0, "d": 0.6})
    assert "approximate_distributions" not in exact.attrs


def test_loops_are_told_by_name():
    model = ssm.Model("loops", inputs=("n",))

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1), "w": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, w, n):
        def decay(x):
            return -(x**3)

        def fold(w):
            return 1.0 - w**2

        after = ssm.integrate(decay, x, 0.5, method="midpoint", steps=7)
        return {"x": ssm.Normal(after, sd=1), "w": ssm.Normal(ssm.repeat(fold, w, n), sd=1)}

    @model.observation
    def observation(x, w):
        return {"y": ssm.Normal(x + w, sd=1)}

    parts = dict(ssm.explain(model).sections())
    told, laws = dict(parts["Numerical integration"]), str(parts["Transition, x_prev to x"])
    assert list(told.values()) == [
        "decay_midpoint, repeated 7 times",
        "fold, repeated n_prev times",
    ]
    assert all(name in laws for name in told)


def van_der_pol(method, steps):
    model = ssm.Model("van der pol")

    @model.initial
    def initial():
        return {"x": ssm.Dirac(np.array([0.7, -0.4]))}

    @model.transition
    def transition(x):
        def drift(x):
            return np.stack([x[1], 1.5 * (1 - x[0] ** 2) * x[1] - x[0]])

        def spread(x):
            return np.stack([0.05 * np.exp(0.2 * x[1]), 0.6 * np.abs(x[0])])

        return {"x": ssm.SDE(drift, spread, 0.4, steps=steps, method=method)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x[0], sd=0.1)}

    return model


@pytest.mark.parametrize("steps", [1, 3])
def test_small_steps_of_euler_and_maruyama(steps):
    """Draws have the moments of steps by hand; the noises of all but the last are a quantity."""
    model, n = van_der_pol("euler-maruyama", steps), 20_000
    seed = seed_of("euler maruyama", steps)
    found = ssm.simulate(model, {}, steps=2, draws=n, seed=seed)
    x = found["x"].values.reshape(n, 2, 2)[:, 1]
    by_hand = by_euler(
        lambda x: np.stack([x[1], 1.5 * (1 - x[0] ** 2) * x[1] - x[0]]),
        lambda x: np.stack([0.05 * np.exp(0.2 * x[1]), 0.6 * np.abs(x[0])]),
        0.4, steps=steps, seed=seed,
    )  # fmt: skip
    spread = np.sqrt(np.diag(by_hand[1]) * (1 / n + 1 / 200_000))
    np.testing.assert_array_less(np.abs(x.mean(axis=0) - by_hand[0]), 4.5 * spread)
    np.testing.assert_allclose(np.diag(np.cov(x.T)), np.diag(by_hand[1]), rtol=0.06)
    traced = trace(model)
    assert list(traced.transition) == (["x_noise", "x"] if steps > 1 else ["x"])
    assert "Euler and Maruyama" in traced.transition["x"].distribution.approximation
    assert ("x_noise" in found) == (steps > 1)
    with pytest.raises(ssm.ModelError, match="method"):
        ssm.SDE(lambda x: x, 0.1, 0.1, method="milstein")


def test_small_steps_of_a_number():
    model, n = ssm.Model("decay"), 20_000

    @model.initial
    def initial():
        return {"x": ssm.Dirac(0.7)}

    @model.transition
    def transition(x):
        return {"x": ssm.SDE(lambda x: -2.0 * x, 0.5, 0.3, method="euler-maruyama", steps=3)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.1)}

    seed = seed_of("euler maruyama of a number")
    x = ssm.simulate(model, {}, steps=2, draws=n, seed=seed)["x"].values[:, 1]
    mean, variance = 0.7 * 0.8**3, 0.025 * (1 + 0.8**2 + 0.8**4)  # h = 0.1: x + h f = 0.8 x
    assert abs(x.mean() - mean) < 4.5 * np.sqrt(variance / n)
    assert abs(x.var() / variance - 1) < 4.5 * np.sqrt(2 / n)


def test_the_number_of_steps_makes_it_exact_in_the_limit():
    def drift(x):
        return np.stack([np.sin(x[1]), -(x[0] ** 2)])

    few, many = (law_of(drift, 0.2, steps=n) for n in (20, 40))
    for a, b in zip(few[:2], many[:2], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_scalars_and_what_is_refused():
    mean, variance, law = law_of(lambda x: -2.0 * x, 0.5, size=1)
    assert mean == pytest.approx(0.7 * np.exp(-0.6), rel=1e-13)
    assert variance == pytest.approx(0.25 / 4.0 * (1 - np.exp(-1.2)), rel=1e-13)
    assert not law.approximation
    mean, variance, law = law_of(lambda x: -2.0 * x, lambda x: 0.5 * x, size=1)
    assert mean == pytest.approx(0.7 * np.exp(-0.6), rel=1e-6)
    assert law.approximation
    for drift, diffusion, said in (
        (lambda x: x[0], 0.1, "shape"),
        (lambda x: x, np.ones(3), "shape"),
        (lambda x: x, 0.1, None),
    ):
        if said:
            with pytest.raises(ssm.ModelError, match=said):
                law_of(drift, diffusion)
    with pytest.raises(ssm.ModelError, match="steps"):
        ssm.SDE(lambda x: x, 0.1, 0.1, steps=0)
    model = ssm.Model("first")

    @model.initial
    def initial():
        return {"x": ssm.SDE(lambda x: x, 0.1, 0.1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(x, sd=1)}

    with pytest.raises(ssm.ModelError, match="next value"):
        trace(model)
