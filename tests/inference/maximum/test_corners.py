"""Maximum likelihood where a transition has corners: dry friction that holds, a dead zone."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.inference.maximum.gaussian_climb import has_corners
from ssmppl.language.tracing import trace
from tests.models import dc_motor
from tests.statistics.checks import seed_of

ROWS, Q, R = 300, 0.02, 0.02


def sledge():
    """A speed under a push; dry friction takes l a row from it, and what is slower rests."""
    model = ssm.Model("sledge", inputs=("push",))
    model.prior(lambda: {"a": ssm.Uniform(0, 1), "l": ssm.HalfFlat()})
    model.initial(lambda: {"v": ssm.Normal(0, sd=0.1)})

    def step(v, push, a, l):
        new = a * v + push
        return {"v": ssm.Normal(new - np.clip(new, -l, l), sd=Q)}

    model.transition(step)
    model.observation(lambda v: {"y": ssm.Normal(v, sd=R)})
    return model


def pushed(seed):
    """(ROWS,) a push that changes every ten rows, often too weak to start it."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-0.25, 0.25, ROWS // 10), 10)


def point_mass(data, a, l, points=600):
    """log p(y | a, l) on a grid of v."""
    v = np.linspace(-1.8, 1.8, points)
    width = v[1] - v[0]

    def moves(push):
        new = a * v + push
        mean = new - np.clip(new, -l, l)
        return stats.norm.pdf(v[:, None], mean, Q) * width

    known = {u: moves(u) for u in np.unique(data["push"])}
    p, total = stats.norm.pdf(v, 0.0, 0.1) * width, 0.0
    for t, y in enumerate(data["y"]):
        p = known[data["push"][t - 1]] @ p if t else p
        p = p * stats.norm.pdf(y, v, R)
        total += np.log(p.sum())
        p /= p.sum()
    return total


def from_the_top(value, at, errors):
    """How many standard errors the top of `value` is off, by a quadratic through points half of one
    away; and the value."""
    steps = 0.5 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]])
    found = np.array([value(*(at + s * errors)) for s in steps])
    x, y = steps.T
    basis = np.stack([np.ones(len(x)), x, y, x * x / 2.0, y * y / 2.0, x * y], axis=1)
    (_, dx, dy, xx, yy, xy), *_ = np.linalg.lstsq(basis, found)
    slope, bend = np.array([dx, dy]), -np.array([[xx, xy], [xy, yy]])
    off = np.linalg.solve(bend, slope)
    return off, found[0]


@pytest.mark.parametrize("seed", range(5))
def test_dry_friction_against_a_grid(seed):
    """What is left is skew: slopes are differences over one standard deviation."""
    model, push = sledge(), pushed(seed_of(f"sledge {seed}"))
    drawn = ssm.simulate(model, {"a": 0.8, "l": 0.1}, inputs={"push": push}, seed=seed)
    data = {"push": push, "y": drawn["y"].values[0]}
    found = ssm.maximize(model, data, start={"a": 0.5, "l": 0.3}, seed=seed, progress=False)
    assert found.attrs["method"] == "DirectOptimization"
    assert found.attrs["converged"]
    at, errors = (np.array([d[n] for n in ("a", "l")])
                  for d in (found.parameters, found.standard_errors))  # fmt: skip
    off, exact = from_the_top(lambda *p: point_mass(data, *p), at, errors)
    assert np.all(np.abs(off) < 0.1)
    gap = found.log_likelihood - exact
    assert abs(gap) < 5.0 * found.attrs["log_likelihood_error"] + 0.01


def test_a_motor_whose_shaft_sticks():
    """By Laplace's likelihood alone it ended hundreds of nats below the top. The twisted filter's
    estimates round the end are the likelihood's own."""
    motor, data = dc_motor.model(friction=True), [dc_motor.measured(1), dc_motor.measured(2)]
    start = {"J": 1e-5, "b": 1e-5, "l": 0.5, "q": 0.1, "r": 1e-3}
    found = ssm.maximize(motor, data, start=start, seed=1, progress=False)
    assert found.attrs["method"] == "DirectOptimization"
    assert found.attrs["converged"]
    here, errors = (np.array([d[n] for n in ("J", "l")])
                    for d in (found.parameters, found.standard_errors))  # fmt: skip

    def value(*p):
        there = found.parameters | dict(zip(("J", "l"), p, strict=True))
        draws = [
            ssm.log_likelihood(motor, data, there, proposal="twisted", particles=100, seed=k)[0]
            for k in range(8)
        ]
        return np.log(np.mean(np.exp(draws - np.max(draws)))) + np.max(draws)

    off, _ = from_the_top(value, here, errors)
    assert np.all(np.abs(off) < 0.1)
    assert found.parameters["l"] == pytest.approx(dc_motor.taken_in_a_row(), rel=0.02)
    assert found.parameters["J"] == pytest.approx(dc_motor.PARTS["J"], rel=0.02)


def tanks():
    """Two tanks, the second one measured; the first flows over at h."""
    model = ssm.Model("tanks", inputs=("u",))
    scales = {"a": 1.0, "b": 1.0, "q": 0.1, "r": 0.1}
    model.prior(lambda: {n: ssm.HalfNormal(sd=v) for n, v in scales.items()}
                | {"h": ssm.LogNormal(0, sd=0.5)})  # fmt: skip
    model.initial(lambda: {n: ssm.Normal(0.5, sd=0.2) for n in ("x", "w")})

    def step(x, w, u, a, b, h, q):
        flow = a * np.sqrt(np.maximum(x, 0.0))
        over = np.maximum(x - h, 0.0)
        left = w + flow - b * np.sqrt(np.maximum(w, 0.0))
        return {"x": ssm.Normal(x + u - flow - over, sd=q), "w": ssm.Normal(left, sd=q)}

    model.transition(step)
    model.observation(lambda w, r: {"y": ssm.Normal(w, sd=r)})
    return model


@pytest.mark.parametrize("seed", [3, 4, 6])
def test_a_top_at_an_edge_that_is_not_corrected_is_not_the_last_word(seed):
    """On these records the climb by the extended filter's likelihood ends at one, ten nats and more
    below Laplace's."""
    model, at = tanks(), {"a": 0.2, "b": 0.22, "h": 1.0, "q": 0.01, "r": 0.02}
    rng = np.random.default_rng(seed)
    x = w = 0.5
    u, y = np.zeros(80), np.zeros(80)
    for t in range(80):
        y[t] = w + at["r"] * rng.standard_normal()
        u[t] = np.clip(0.2 + 0.8 * (0.3 * np.sign(np.sin(t / 8)) + 0.6 - y[t]), 0.0, 0.6)
        flow, noise = at["a"] * np.sqrt(max(x, 0.0)), at["q"] * rng.standard_normal(2)
        over = max(x - at["h"], 0.0)
        x, w = x + u[t] - flow - over + noise[0], w + flow - at["b"] * np.sqrt(w) + noise[1]
    found = ssm.maximize(model, {"u": u, "y": y}, seed=0, progress=False)
    true = ssm.log_likelihood(model, {"u": u, "y": y}, at, particles=2000, seed=1)[0]
    assert found.attrs["converged"]
    assert found.log_likelihood > true
    assert found.parameters["r"] == pytest.approx(at["r"], abs=4.0 * found.standard_errors["r"])


def test_what_has_corners():
    def model(mean):
        m = ssm.Model("m", inputs=("u",))
        m.prior(lambda: {"a": ssm.Uniform(0, 1)})
        m.initial(lambda: {"x": ssm.Normal(0, sd=1)})
        m.transition(lambda x, u, a: {"x": ssm.Normal(mean(x, u, a), sd=1)})
        m.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
        return trace(m)

    def stepped(x, u, a):
        return ssm.integrate(lambda x: {"x": -a * np.abs(x)}, {"x": x}, 0.1, steps=3)["x"]

    assert has_corners(model(lambda x, u, a: np.clip(a * x, -1.0, 1.0)))
    assert has_corners(model(lambda x, u, a: np.where(x > a, x, 0.0)))
    assert has_corners(model(stepped))
    assert not has_corners(model(lambda x, u, a: a * x + np.maximum(u, 0.0)))
    assert not has_corners(model(lambda x, u, a: a * np.tanh(x)))
