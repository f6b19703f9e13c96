"""Rows in which the data leave a variance of zero, or a singular covariance: two measurements at
the same time, a noise that is switched off, a sensor that is exact once.

Held against the joint normal distribution of all data. The first value is that of a report:
duplicate times, dt = [1, 0, 1, 1], whose four numbers have the covariance min(s, t) / 2 + 1 +
[s = t] at the times 0, 1, 1, 2.
"""

from __future__ import annotations

import numpy as np
import pytest

import ssmppl as ssm
from tests.models.kalman import Dense
from tests.models.singular import (
    OTHERS,
    QUICK,
    ROWS,
    exact_now_and_then,
    exact_sensor,
    exact_sensors,
    integrated,
    one_force,
    one_force_always,
    switched,
    velocity,
    walk,
)
from tests.statistics.checks import mean_one_p, some

CASES = [*QUICK, *some(OTHERS, 0)]
PARTICLES = ("bootstrap", "guided", "auxiliary", "twisted", "tempered")
APPROXIMATE = ("laplace", "extended", "unscented")
OF_EXACT_ROWS = {
    "bootstrap",
    "twisted",
    "tempered",
    *APPROXIMATE,
}  # which weigh or expand a density
OF_ONE_NOISE = {"guided", "auxiliary", "tempered"}
REFUSED = dict.fromkeys((exact_sensor, exact_sensors, exact_now_and_then), OF_EXACT_ROWS) | (
    dict.fromkeys((one_force, one_force_always, integrated), OF_ONE_NOISE)
)
LEAST = 1e-4  # p value of a ratio whose mean is one; some eighty are looked at


def posed(build, seed: int = 1):
    model, inputs = build()
    dense = Dense(model, {}, inputs, ROWS)
    y = dense.simulate(np.random.default_rng(seed))
    data = {**inputs, "y": y[:, 0] if y.shape[1] == 1 else y}
    return model, data, dense, dense.log_likelihood(y, np.ones_like(y), ROWS), y


def test_duplicate_times():
    model, _ = walk()
    data = {"dt": [1, 0, 1, 1], "y": [0.1, 0.3, -0.2, 0.4]}
    assert ssm.log_likelihood(model, data, {})[0] == pytest.approx(-4.97311086, abs=1e-8)


@pytest.mark.parametrize("build", CASES)
def test_exact(build):
    model, data, dense, expected, y = posed(build)
    assert ssm.log_likelihood(model, data, {})[0] == pytest.approx(expected, abs=1e-9)
    found = ssm.smooth(model, data, {})
    for i, (name, index) in enumerate(dense.states):
        for t in range(ROWS):
            target = dense.x[t][0][[i]], dense.x[t][1][[i]]
            mean, variance = dense.given(target, y, np.ones_like(y), ROWS)
            own = (0, t, *index)
            assert found[name].to_numpy()[own] == pytest.approx(mean[0], abs=1e-7)
            sd = np.sqrt(max(variance[0, 0], 0.0))
            assert found[f"{name}_sd"].to_numpy()[own] == pytest.approx(sd, abs=1e-6)


@pytest.mark.parametrize("build", CASES)
def test_proposals_agree_or_name_the_row(build):
    model, data, _, expected, _ = posed(build)
    refused = set()
    for proposal in (*PARTICLES, *APPROXIMATE):
        some_particles = proposal in PARTICLES
        numbers = {"particles": 300, "repeats": 200, "seed": 2} if some_particles else {}
        try:
            log_z = ssm.log_likelihood(model, data, {}, proposal=proposal, **numbers)
        except ssm.ArgumentError:
            refused.add(proposal)
            continue
        if some_particles:
            p = mean_one_p(log_z - expected)
            assert p > LEAST, f"{proposal}: p = {p:.2g}, {np.mean(log_z)} for {expected}"
        else:
            assert log_z[0] == pytest.approx(expected, abs=1e-6), proposal
    assert refused == REFUSED.get(build, set())


@pytest.mark.parametrize("build", CASES)
def test_draws(build):
    """Means and variances of draws from the model: of the joint distribution."""
    model, inputs = build()
    dense, draws = Dense(model, {}, inputs, ROWS), 4000
    found = ssm.simulate(model, {}, steps=ROWS, inputs=inputs or None, draws=draws, seed=3)
    for i, (name, index) in enumerate(dense.states):
        for t in range(ROWS):
            own = found[name].to_numpy()[(slice(None), t, *index)]
            sd = float(np.sqrt(np.sum(dense.x[t][1][i] ** 2)))
            assert abs(own.mean() - dense.x[t][0][i]) <= 4.5 * sd / np.sqrt(draws) + 1e-12
            assert abs(own.var() - sd**2) <= 4.5 * sd**2 * np.sqrt(2.0 / draws) + 1e-12


@pytest.mark.parametrize("method", [ssm.PGAS(), ssm.Gibbs()])
@pytest.mark.parametrize(("build", "named"), [
    (walk, "row 2 (dt = 0)"), (velocity, "row 2 (dt = 0)"), (switched, "row 3 (on = 0)"),
    (exact_sensor, "row 3 (s = 0)"),
])  # fmt: skip
def test_what_needs_a_density_is_refused_by_row(build, named, method):
    model, data, *_ = posed(build)
    with pytest.raises(ssm.ArgumentError) as caught:
        ssm.sample(model, data, method, draws=10, warmup=10, progress=False)
    assert named in str(caught.value)
    assert named in str(ssm.explain(model, data))
    assert "has no density" not in str(ssm.explain(model))


def test_the_diagnosis_is_refused_by_row():
    model, data, *_ = posed(walk)
    with pytest.raises(ssm.ArgumentError, match=r"row 2 \(dt = 0\)") as caught:
        ssm.diagnose(model, data, mode="fast", seed=1, progress=False)
    assert "leave out the rows" in str(caught.value)


def test_proposals_by_newton_steps_are_refused_by_row():
    """They divide by the covariance of the states; those of the twisted filter do not, and agree
    with the transition's."""
    model, inputs = velocity()
    counts = ssm.Model("counts", inputs=("dt",))
    counts.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))})
    counts.transition(model.functions["transition"][0])
    counts.observation(lambda x: {"y": ssm.Poisson(np.exp(1.0 + 0.3 * x[0]))})
    data = {**inputs, "y": np.array([3.0, 2, 5, 1, 0, 2, 4, 3])}
    with pytest.raises(ssm.ArgumentError, match=r"row 2 \(dt = 0\)"):
        ssm.log_likelihood(counts, data, {}, proposal="guided")
    plain = ssm.log_likelihood(
        counts, data, {}, proposal="bootstrap", particles=20_000, repeats=50, seed=1
    )
    twisted = ssm.log_likelihood(
        counts, data, {}, proposal="twisted", particles=500, repeats=50, seed=2
    )
    apart = np.exp(plain - plain.mean()).mean(), np.exp(twisted - plain.mean()).mean()
    error = np.hypot(plain.std(), twisted.std()) / np.sqrt(50.0)
    assert abs(apart[0] - apart[1]) < 4.0 * error


def test_rows_without_measurement_are_no_exact_ones():
    model, data, *_ = posed(exact_sensor)
    data["y"] = np.where(data["s"] == 0.0, np.nan, data["y"])
    assert np.isfinite(ssm.log_likelihood(model, data, {}, proposal="bootstrap", seed=1)[0])


def test_steps_that_are_only_short_keep_their_densities():
    model, data, *_ = posed(walk)
    data["dt"] = np.where(data["dt"] == 0.0, 1e-9, data["dt"])
    ssm.sample(model, data, ssm.PGAS(), draws=5, warmup=5, chains=1, progress=False)
