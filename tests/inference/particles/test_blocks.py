"""Filters in blocks (524,288 particles and more): the same law, whoever computes what."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.codegen.kernels.particle.particle_filter import BLOCK, ancestors_of
from ssmppl.codegen.kernels.particle.resampling import PADDING, systematic
from ssmppl.inference.particles import blocks, filtering
from ssmppl.inference.particles.blocks import run_in_blocks
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from tests.statistics.checks import LEVEL, mean_one_p, seed_of

AT = {"a": [0.9, 0.5], "q": 0.4}
THRESHOLDS = (1.0, 0.5, 0.0)


def pair():
    """Two states, an input, and two channels that are missing now and then."""
    model = ssm.Model("pair of states", inputs=("u",))
    model.prior(lambda: {"a": ssm.Normal(np.zeros(2), sd=1), "q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(
        lambda x, u, a, q: {"x": ssm.Normal(a * x + 0.2 * np.roll(x, 1) + u, variance=q)}
    )
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    return model


MODEL = pair()


def data(steps=12):
    u = np.cos(np.arange(steps))
    y = ssm.simulate(MODEL, AT, inputs={"u": u}, steps=steps, seed=5)["y"].values[0].copy()
    y[3], y[6, 1] = np.nan, np.nan
    return {"y": y, "u": u}


PROBLEM = pose(MODEL, data())
THETA = np.array([*AT["a"], AT["q"]])


def estimate(particles, proposal, threshold, seed, threads=1, problem=PROBLEM):
    """(log Z, effective sizes, status, step) of one run."""
    out = np.empty((2, problem.experiments[0].steps))
    rng = random_state(np.random.SeedSequence(seed))
    status, t = run_in_blocks(
        problem, THETA, proposal, particles, threshold, problem.experiments[0], rng, *out, threads
    )
    return out[0].sum(), out[1], status, t


@pytest.mark.parametrize("threshold", THRESHOLDS)
@pytest.mark.parametrize("proposal", ["bootstrap", "guided"])
@pytest.mark.parametrize(("particles", "repeats"), [(7, 500), (2 * BLOCK + 100, 200)])
def test_unbiased(particles, repeats, proposal, threshold):
    """Few particles in a block that is filled up; three blocks, where the error is small."""
    if particles == 7 and threshold == 0.0:
        particles = 500  # seven that are never resampled have no usable mean
    exact = ssm.log_likelihood(MODEL, data(), AT, proposal="kalman")[0]
    seed = seed_of("blocks", particles, proposal, threshold)
    found = [estimate(particles, proposal, threshold, [seed, r])[0] for r in range(repeats)]
    assert mean_one_p(np.array(found) - exact) > LEVEL / 12


@pytest.mark.parametrize("threshold", THRESHOLDS)
def test_threads_change_nothing(threshold):
    particles = 4 * BLOCK + 1
    found = [estimate(particles, "guided", threshold, 1, threads) for threads in (1, 2, 3, 9)]
    for other in found[1:]:
        assert other[0] == found[0][0]
        assert np.array_equal(other[1], found[0][1])


def test_effective_size_is_that_of_the_plain_filter():
    """Same law, other random numbers: means of repeats, within their standard errors."""
    e, repeats = PROBLEM.experiments[0], 40
    plain, out = [], np.empty((2, e.steps))
    settings = filtering.FilterSettings(BLOCK + 100, "bootstrap")
    for r in range(repeats):
        rng = random_state(np.random.SeedSequence([seed_of("plain size"), r]))
        filtering.run_filter(PROBLEM, THETA, settings, e, rng, *out)
        plain.append(out[1].copy())
    seed = seed_of("size in blocks")
    own = [estimate(BLOCK + 100, "bootstrap", 1.0, [seed, r])[1] for r in range(repeats)]
    error = np.sqrt((np.var(own, axis=0, ddof=1) + np.var(plain, axis=0, ddof=1)) / repeats)
    known = error < 1e-6  # where nothing is measured, all weights are equal
    assert np.array_equal(np.flatnonzero(known), [3])
    z = (np.mean(own, axis=0) - np.mean(plain, axis=0))[~known] / error[~known]
    assert np.all(2 * stats.t.sf(np.abs(z), repeats - 1) > LEVEL / len(z))


def weights(shares, rng):
    """(w, ends, the weights of all) whose sums are exact in binary."""
    b = len(shares)
    whole = rng.integers(0, 5, (b, BLOCK)).astype(float)
    whole[:, rng.random(BLOCK) < 0.5] = 0.0
    whole[:, 0] += 2.0**16 - whole.sum(axis=1)
    w = whole / 2.0**16
    ends = np.concatenate([[0.0], np.cumsum(shares)]) * (b * BLOCK)
    return w, ends, (w * np.array(shares)[:, None]).ravel()


@pytest.mark.parametrize(
    "shares", [(1.0,), (0.25, 0.25, 0.25, 0.25), (0.0, 0.5, 0.0, 0.5), (1.0, 0.0), (0.125, 0.875)]
)
def test_children_are_those_of_one_systematic_pass(shares):
    rng = np.random.default_rng(seed_of("children", shares))
    w, ends, flat = weights(shares, rng)
    n = flat.size
    for k in range(20):
        state = random_state(np.random.SeedSequence(k))
        expected = np.empty(n + PADDING, dtype=np.int32)
        points = state.copy()
        systematic(points, flat, expected)
        u = blocks.uniform(state)
        for low in (0, 1, 31, 1000, BLOCK - 1, n // 2, n - 1):
            for high in (low + 1, min(low + 77, n), min(low + BLOCK, n)):
                found = np.full(high - low + PADDING, -1, dtype=np.int32)
                ancestors_of(w, ends, u, low, high, found)
                assert np.array_equal(found[: high - low], expected[low:high])


def test_ends_leave_no_slot_to_blocks_without_weight():
    shares = np.array([0.1, 0.2, 0.7 - 1e-16, 0.0, 0.0])
    ends = blocks._ends(shares, 1000)
    assert ends[0] == 0.0
    assert np.all(ends[3:] == 1000)
    assert np.all(np.diff(ends) >= 0)


def window():
    """Particles above the bound have no weight; the parameter makes some of them NaN or inf."""
    model = ssm.Model("window")
    model.prior(lambda: {"a": ssm.Normal(np.zeros(2), sd=1), "q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(a[0] * x, sd=1)})
    model.observation(lambda x, q: {"y": ssm.Uniform(x - q, x + q)})
    return model


def test_no_particle_can_have_produced_a_row():
    y = {"y": np.array([0.0, 0.1, 500.0, 0.2])}
    problem = pose(window(), y)
    _, _, status, t = estimate(2 * BLOCK, "bootstrap", 1.0, 1, problem=problem)
    assert (status, t) == (filtering.ALL_ZERO, 2)
    at = {"a": [0.9, 0.5], "q": 0.4}
    many = {"particles": blocks.LEAST, "proposal": "bootstrap", "seed": 1}
    assert ssm.log_likelihood(window(), y, at, **many) == -np.inf
    finite = ssm.log_likelihood(window(), {"y": y["y"][:2]}, at, **many)
    plain = ssm.log_likelihood(window(), {"y": y["y"][:2]}, at, **{**many, "particles": 20_000})
    np.testing.assert_allclose(finite, plain, atol=0.1)


def test_a_weight_that_is_no_number_is_told():
    model = ssm.Model("square root")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(np.sqrt(x), sd=1)})
    with pytest.raises(ssm.SamplingError, match="a weight is nan at t=1"):
        ssm.log_likelihood(model, {"y": np.ones(3)}, {}, particles=blocks.LEAST, seed=1)


def test_the_verb_runs_in_blocks(monkeypatch):
    calls = []

    def noted(*args):
        calls.append(args[3])
        return run_in_blocks(*args)

    monkeypatch.setattr(filtering, "run_in_blocks", noted)
    monkeypatch.setattr(filtering, "LEAST", 5000)
    for particles in (4999, 5000):
        for proposal in ("bootstrap", "auxiliary", "twisted"):
            found = ssm.log_likelihood(
                MODEL, data(), AT, particles=particles, proposal=proposal, seed=1
            )
            exact = ssm.log_likelihood(MODEL, data(), AT)
            np.testing.assert_allclose(found, exact, atol=0.2)
    assert calls == [5000]
