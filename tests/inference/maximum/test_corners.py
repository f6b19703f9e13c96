"""Maximum likelihood where a transition has corners: dry friction that holds, a dead zone."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.inference.maximum.gaussian_climb import has_corners
from ssmppl.language.tracing import trace
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
    model, push = sledge(), pushed(seed_of(f"sledge {seed}"))
    drawn = ssm.simulate(model, {"a": 0.8, "l": 0.1}, inputs={"push": push}, seed=seed)
    data = {"push": push, "y": drawn["y"].values[0]}
    found = ssm.maximize(model, data, start={"a": 0.5, "l": 0.3}, progress=False)
    assert found.attrs["method"] == "DirectOptimization"
    assert found.attrs["converged"]
    at, errors = (np.array([d[n] for n in ("a", "l")])
                  for d in (found.parameters, found.standard_errors))  # fmt: skip
    off, exact = from_the_top(lambda *p: point_mass(data, *p), at, errors)
    assert np.all(np.abs(off) < 0.15)
    gap = found.log_likelihood - exact
    assert abs(gap) < 5.0 * found.attrs["log_likelihood_error"] + 0.01


DT = 0.002
MOTOR = {"R": 2.0, "K": 0.05, "J": 1e-5, "b": 1e-5, "dry": 3e-3}  # ohm, N m / A, kg m2, N m s, N m


def motor():
    """The shaft of a small motor, integrated over a row, with dry friction; its angle is measured,
    by an encoder."""
    model = ssm.Model("motor", inputs=("voltage",))
    model.prior(lambda: {n: ssm.HalfFlat() for n in ("J", "b", "l", "q", "r")})
    model.initial(lambda: {"th": ssm.Normal(0, sd=0.01), "om": ssm.Normal(0, sd=0.1)})
    resistance, constant = MOTOR["R"], MOTOR["K"]

    def step(th, om, voltage, J, b, l, q):
        def rhs(th, om):
            current = (voltage - constant * om) / resistance
            return {"th": om, "om": (constant * current - b * om) / J}

        new = ssm.integrate(rhs, {"th": th, "om": om}, DT)
        by = -np.clip(new["om"], -l, l)
        return {"th": ssm.Dirac(new["th"] + DT / 2 * by), "om": ssm.Normal(new["om"] + by, sd=q)}

    model.transition(step)
    model.observation(lambda th, r: {"angle": ssm.Normal(th, sd=r)})
    return model


def measured(seed, rows=1500, within=40):
    """What such a motor does in a loop: Coulomb's law in short steps, 2,000 counts a turn."""
    rng, h, count = np.random.default_rng(seed), DT / within, 2.0 * np.pi / 2000.0
    wanted = np.repeat(rng.uniform(-1.5, 1.5, rows // 75), 75)
    resistance, k, inertia, b, dry = MOTOR.values()
    th = om = before = 0.0
    voltage, angle = np.zeros(rows), np.zeros(rows)
    for t in range(rows):
        angle[t] = np.round(th / count) * count
        voltage[t] = np.clip(2.0 * (wanted[t] - angle[t]) - 0.02 * (angle[t] - before) / DT, -6, 6)
        before = angle[t]
        for _ in range(within):
            pull = k * (voltage[t] - k * om) / resistance - b * om
            if om == 0.0 and abs(pull) <= dry:
                continue
            new = om + h * (pull - dry * np.sign(om or pull)) / inertia
            om = 0.0 if om * new < 0.0 else new
            th += h * om
    return {"voltage": voltage, "angle": angle}


def test_a_motor_whose_shaft_sticks():
    """By Laplace's likelihood alone it ended hundreds of nats below the top. The twisted filter's
    estimates round the end are the likelihood's own."""
    data = [measured(1), measured(2)]
    start = {"J": 1e-5, "b": 1e-5, "l": 0.5, "q": 0.1, "r": 1e-3}
    found = ssm.maximize(motor(), data, start=start, progress=False)
    assert found.attrs["method"] == "DirectOptimization"
    assert found.attrs["converged"]
    here, errors = (np.array([d[n] for n in ("J", "l")])
                    for d in (found.parameters, found.standard_errors))  # fmt: skip

    def value(*p):
        there = found.parameters | dict(zip(("J", "l"), p, strict=True))
        draws = [
            ssm.log_likelihood(motor(), data, there, proposal="twisted", particles=100, seed=k)[0]
            for k in range(8)
        ]
        return np.log(np.mean(np.exp(draws - np.max(draws)))) + np.max(draws)

    off, _ = from_the_top(value, here, errors)
    assert np.all(np.abs(off) < 0.3)
    lag = MOTOR["J"] / (MOTOR["K"] ** 2 / MOTOR["R"] + MOTOR["b"])
    over_a_row = MOTOR["dry"] / MOTOR["J"] * lag * (1.0 - np.exp(-DT / lag))
    assert found.parameters["l"] == pytest.approx(over_a_row, rel=0.02)
    assert found.parameters["J"] == pytest.approx(MOTOR["J"], rel=0.02)


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
