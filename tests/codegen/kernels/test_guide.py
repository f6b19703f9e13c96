"""The guide of the twisted filter against dense Gaussians and, off these, an optimiser.

The generated functions run in plain Python here, the shared kernels compiled.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import optimize

import ssmppl as ssm
from ssmppl.codegen.kernels.twisted import guide
from ssmppl.codegen.kernels.twisted.lookahead import lift, update
from ssmppl.codegen.modules import gaussian
from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.codegen.modules.twisted import TwistedFilter
from ssmppl.data import check_parameters
from ssmppl.inference.exact.kalman import kalman_filter
from ssmppl.inference.run.problem import pose
from tests.codegen.harness import plain_module
from tests.models import standard as models
from tests.models import twisted as twisted_models
from tests.statistics.exact import DenseGaussian

# --- correlated noise, an input, two channels of which single components are missing -------------

correlated = ssm.Model("correlated", inputs=("u",))
A = np.array([[0.8, 0.3, -0.2], [-0.2, 0.7, 0.1], [1.0, -0.5, 0.0]])
Q = np.array([[0.5, 0.3, 0.0], [0.3, 0.4, 0.0], [0.0, 0.0, 0.0]])
C = np.array([[1.0, 0.0, 0.5], [0.3, -1.0, 0.0], [0.0, 0.0, 1.0]])
R = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.6]])


@correlated.initial
def start():
    return {"x": ssm.Dirac(np.array([0.5, -1.0])), "k": ssm.Dirac(0.3)}


@correlated.transition
def move(x, k, u):
    both = np.concatenate([x, np.stack([k])])
    return {
        "x": ssm.MvNormal(A[:2] @ both + u, covariance=Q[:2, :2]),
        "k": ssm.Dirac(x[0] - 0.5 * x[1]),
    }


@correlated.observation
def see(x, k):
    both = np.concatenate([x, np.stack([k])])
    return {"y": ssm.MvNormal(C[:2] @ both, covariance=R[:2, :2]), "z": ssm.Normal(k, variance=0.6)}


STEPS = 12
INPUT = np.sin(np.arange(STEPS))
CORRELATED = {
    "m": [0.5, -1.0, 0.3], "P": np.zeros((3, 3)), "A": A,
    "b": np.outer(np.r_[0.0, INPUT[:-1]], [1.0, 1.0, 0.0]), "Q": Q, "C": C, "d": np.zeros(3),
    "R": R,
}  # fmt: skip
CASES = {
    "autoregression": (models.lgss, {"theta": 1.5, "c": 0.5}, models.lgss_matrices),
    "position": (models.vehicle, {"h": 0.5}, models.vehicle_matrices),
    "correlated": (correlated, {}, lambda: CORRELATED),
}
GAPS = {  # rows and components that are missing; last rows too, whose guide says nothing
    "autoregression": [(3, 0), (4, 0)],
    "position": [(0, 0), (4, 0), (5, 0), (10, 0), (11, 0)],
    "correlated": [(0, 0), (2, 1), (3, 2), (5, 0), (5, 1), (5, 2), (7, 0), (7, 1)],
}


def plainly(problem):
    """The twisted filter with its generated functions in plain Python."""
    made = problem.program.twisted
    of = made.gaussian
    plain = GaussianApproximation(of.trace, of.found, plain_module(of.module))
    return TwistedFilter(made.trace, plain, made.proposals, plain_module(made.module))


@cache
def case(name):
    """(filter, what its verbs take, y (T, K), matrices, trace)."""
    model, parameters, matrices = CASES[name]
    fixed = matrices(**parameters)
    y = 1.5 * np.random.default_rng(1).normal(size=(STEPS, len(fixed["C"])))
    for t, k in GAPS[name]:
        y[t, k] = np.nan
    data = {"y": y[:, 0]}
    if name == "correlated":
        data = {"y": y[:, :2], "z": y[:, 2], "u": INPUT}
    problem = pose(model, data)
    e = problem.experiments[0]
    given = check_parameters(problem.trace, parameters), e.y, e.seen, e.u
    return plainly(problem), given, y, fixed, problem


class Guide:
    """The columns of a guide: precision (T, D, D), pull, centre (T, D), and of the first row the
    mean (R,) and factor (R, R)."""

    def __init__(self, made, given, horizon=0):
        rows = made.guide(*given, horizon)
        known, inputs = made.order, given[3].shape[1]
        np.testing.assert_array_equal(rows[:, :inputs], given[3])
        assert rows.shape == (len(given[1]), inputs + len(known))
        d, r = len(made.trace.state_symbols), len(made.gaussian.found.initial.noise)
        steps = len(rows)
        self.precision, self.factor = np.zeros((steps, d, d)), np.zeros((r, r))
        self.pull, self.centre, self.start = np.zeros((steps, d)), np.zeros((steps, d)), np.zeros(r)
        for k, s in enumerate(known):
            _, name, index = s.data
            column = rows[:, inputs + k]
            if name == "precision":
                self.precision[:, index[0], index[1]] = self.precision[:, index[1], index[0]] = (
                    column
                )
            elif name.startswith("start"):
                {"start": self.start, "start_factor": self.factor}[name][index] = column[0]
            else:
                {"pull": self.pull, "centre": self.centre}[name][:, index[0]] = column

    def log_psi(self, t, x):
        away = x - self.centre[t]
        return self.pull[t] @ away - 0.5 * away @ self.precision[t] @ away


def log_later(y, t, end, x, matrices):
    """log p(y_{t:end} | x_t = x), from row t to before row end, by one dense Gaussian."""
    if np.all(np.isnan(y[t:end])):
        return 0.0
    moved = np.broadcast_to(matrices["b"], (len(y), len(x)))[t:end]
    known = matrices | {"m": x, "P": np.zeros((len(x), len(x))), "b": moved}
    return DenseGaussian(y[t:end], **known).log_likelihood


@pytest.mark.parametrize("horizon", [0, 5])
@pytest.mark.parametrize("name", CASES)
def test_guide_of_a_linear_gaussian_model(name, horizon):
    """It is log p(y_{t:T} | x_t) up to a constant, or, blind to what comes after its stretch of
    rows, the same of the rest of that stretch."""
    made, given, y, matrices, _ = case(name)
    guide, rng = Guide(made, given, horizon), np.random.default_rng(2)
    for t in range(STEPS):
        end = STEPS if horizon == 0 else min((t // horizon + 1) * horizon, STEPS)
        points = 2 * rng.normal(size=(12, len(matrices["m"])))  # more than a quadratic has terms
        found = [guide.log_psi(t, x) - guide.log_psi(t, points[0]) for x in points]
        exact = [log_later(y, t, end, x, matrices) for x in points]
        np.testing.assert_allclose(found, np.array(exact) - exact[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_start_and_centre_of_a_linear_gaussian_model(name):
    """The law of x_1 given all data, by its noise, and the mode of the states, here their mean."""
    made, given, y, matrices, _ = case(name)
    guide, exact = Guide(made, given), DenseGaussian(y, **matrices)
    np.testing.assert_allclose(guide.centre, exact.mean, atol=1e-9)
    d = len(matrices["m"])
    values, vectors = np.linalg.eigh(matrices["P"])
    root = vectors[:, values > 0] * np.sqrt(values[values > 0])  # one noise for each here
    assert np.all((root != 0).sum(0) == 1)
    root = np.abs(root)
    covariance = np.linalg.inv(guide.factor @ guide.factor.T) if len(guide.factor) else np.eye(0)
    np.testing.assert_allclose(matrices["m"] + root @ guide.start, exact.mean[0], atol=1e-9)
    np.testing.assert_allclose(root @ covariance @ root.T, exact.covariance[:d, :d], atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_extended_kalman_filter_of_a_linear_gaussian_model(name):
    made, given, _, _, problem = case(name)
    mean, covariance = made.gaussian.filtered(*given)
    exact = kalman_filter(problem.trace, problem.experiments[0], given[0])
    np.testing.assert_allclose(mean, exact.mean, atol=1e-9)
    np.testing.assert_allclose(covariance, exact.covariance, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_compiled_functions_agree(name):
    made, given, _, _, problem = case(name)
    for found, expected in zip(
        problem.program.gaussian.filtered(*given), made.gaussian.filtered(*given), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    found = problem.program.twisted.guide(*given)
    np.testing.assert_allclose(found, made.guide(*given), atol=1e-11)


# -- a model that is not linear
def pendulum_density(e, y):
    """log p(e, y) up to a constant."""
    seen = ~np.isnan(y)
    away = (y - np.sin(twisted_models.pendulum_path(e)[:, 0]))[seen] / twisted_models.ERROR
    return -0.5 * (e @ e + away @ away)


def pendulum_noise(x):
    """The noise (T + 1,) behind states (T, 2) of the pendulum, which must follow it."""
    e = [(x[0, 0] - 1.0) / 0.3, x[0, 1] / twisted_models.SWING]
    for t in range(1, len(x)):
        angle, speed = x[t - 1]
        pull = -twisted_models.STIFF * np.sin(angle) - twisted_models.DAMPING * speed
        rest = speed + twisted_models.STEP * pull
        e.append((x[t, 1] - rest) / twisted_models.SHAKE)
    return np.array(e)


def climbed(e, y):
    """The largest log density by an optimiser that starts at e."""
    return -optimize.minimize(lambda e: -pendulum_density(e, y), e).fun


@pytest.fixture(scope="module")
def swinging():
    """(filter, what its verbs take, y, the largest log density by an optimiser)."""
    rng = np.random.default_rng(3)
    e = rng.normal(size=STEPS + 1)
    y = np.sin(twisted_models.pendulum_path(e)[:, 0]) + twisted_models.ERROR * rng.normal(
        size=STEPS
    )
    y[[4, 5]] = np.nan
    problem = pose(twisted_models.pendulum, {"y": y})
    x = problem.experiments[0]
    largest = max(climbed(e, y), climbed(np.zeros(STEPS + 1), y))  # sin(angle) leaves several modes
    return plainly(problem), (np.empty(0), x.y, x.seen, x.u), y, largest


def test_reference_is_the_mode_of_the_noise(swinging):
    """It follows the model, and no noise is more likely by more than the climb stops short of."""
    made, given, y, largest = swinging
    guide = Guide(made, given)
    e = pendulum_noise(guide.centre)
    np.testing.assert_allclose(twisted_models.pendulum_path(e), guide.centre, atol=1e-9)
    short = max(largest, climbed(e, y)) - pendulum_density(e, y)
    print(f"short of the mode by {short:.2g} nats")
    assert 0.0 <= short < gaussian.CLOSE


def test_the_climb_is_what_finds_it(swinging, monkeypatch):
    made, given, y, largest = swinging
    mean, _ = made.gaussian.filtered(*given)
    follows = twisted_models.pendulum_path(pendulum_noise(mean))
    assert np.max(np.abs(follows - mean)) > 0.1  # the filter's means are no trajectory
    monkeypatch.setattr(gaussian, "MOST_STEPS", 1)
    short = largest - pendulum_density(pendulum_noise(Guide(made, given).centre), y)
    print(f"after one pass short of the mode by {short:.2g} nats")
    assert short > gaussian.CLOSE


def test_pull_of_a_nonlinear_model(swinging, monkeypatch):
    """At the mode, the slope of the largest log density that is left, in the state at each row;
    which is that with all later noise held where it is."""
    monkeypatch.setattr(gaussian, "CLOSE", 1e-13)
    made, given, y, _ = swinging
    guide = Guide(made, given)
    e = pendulum_noise(guide.centre)

    def left(t, x):
        path = twisted_models.pendulum_path(np.concatenate([np.zeros(2), e[t + 2 :]]), x)
        away = (y[t:] - np.sin(path[:, 0])) / twisted_models.ERROR
        return -0.5 * np.nansum(away**2)

    for t, x in enumerate(guide.centre):
        slope = [(left(t, x + u) - left(t, x - u)) / 2e-5 for u in 1e-5 * np.eye(2)]
        np.testing.assert_allclose(guide.pull[t], slope, atol=1e-4)
    assert np.max(np.abs(guide.pull)) > 1.0


def test_information_of_a_nonlinear_model(swinging):
    """Positive semidefinite at every row, so that no move is wider than the transition."""
    made, given, _, _ = swinging
    guide = Guide(made, given)
    for precision in guide.precision:
        smallest = np.linalg.eigvalsh(precision)[0]
        assert smallest > -1e-12 * np.linalg.norm(precision)
    assert np.all(np.diag(guide.factor) >= 1.0)
    made, given, *_ = case("position")
    for precision in Guide(made, given).precision:
        assert np.linalg.eigvalsh(precision)[0] > -1e-12 * (1 + np.linalg.norm(precision))


# -- where nothing can be computed
@pytest.mark.parametrize(
    ("hole", "sigma"), [(0.0, 0.5), (0.0, np.nan), (-5.0, np.nan), (-5.0, np.inf)]
)
def test_flat_where_the_start_is_hopeless(hole, sigma):
    """At x = 0, where the filter begins, the observation has no density; or nothing is a number."""
    problem = pose(twisted_models.volatility, {"y": [0.3, -0.5, 1.0]})
    e = problem.experiments[0]
    made, given = plainly(problem), (np.array([hole, sigma]), e.y, e.seen, e.u)
    with np.errstate(all="ignore"):
        assert made.gaussian.filtered(*given) is None
        guide = Guide(made, given)
    for part in (guide.precision, guide.pull, guide.centre, guide.start):
        np.testing.assert_array_equal(part, 0.0)
    np.testing.assert_array_equal(guide.factor, np.eye(1))
    steered = Guide(made, (np.array([-5.0, 0.5]), *given[1:]))
    assert np.all(steered.precision > 0)


def test_guides_of_all_data_sets_are_those_of_each():
    """Of several lengths, from wherever the search begins; where one has none, that of no other is
    touched."""
    rng = np.random.default_rng(6)
    series = [np.sin(rng.normal(size=n)) for n in (7, 1, 12)]
    series[1][0] = 1e200  # has no density
    problem = pose(twisted_models.pendulum, [{"y": y} for y in series])
    made, every, theta = plainly(problem), problem.end_to_end, np.empty(0)
    with np.errstate(all="ignore"):
        searched = made.gaussian.guides(theta, *every.data)
    assert searched.found.tolist() == [guide.GUIDE, guide.NO_NUMBER, guide.GUIDE]
    noise = 0.3 * rng.normal(size=searched.e.shape)
    for e, at_mode in ((None, False), (noise, False), (searched.e, True)):
        with np.errstate(all="ignore"):
            found = made.gaussian.guides(theta, *every.data, e=e, at_mode=at_mode)
        begun = [None] * 3 if e is None else every.split(e)
        for one, start, rows, x in zip(
            problem.experiments, begun, every.split(found.rows), every.split(found.x), strict=True
        ):
            given = theta, one.y, one.seen, one.u
            with np.errstate(all="ignore"):
                alone = made.gaussian.guides(*given, e=start, at_mode=at_mode)
            np.testing.assert_array_equal(rows, alone.rows)
            np.testing.assert_array_equal(x, alone.x)
        if at_mode:
            np.testing.assert_allclose(found.x, searched.x, atol=1e-12)
    assert np.any(searched.rows[8:] != 0.0)


def searched(gains, slope=1.0):
    """The search in plain Python, of one state that goes nowhere: what the passes are tells `gains`
    by the share of a step. The shares tried, what was found, and the noise there."""
    tried = []

    def filter_pass(theta, y, seen, u, c, s, x, covariance, increments, *derivatives):
        # rest, jacobian, spread, spread_initial, g, h
        for array, value in zip(derivatives, (0.0, 1.0, 1.0, 1.0, slope, 1.0), strict=True):
            array[:] = value
        return 0.0

    def gains_pass(
        theta, y, seen, u, c, s, share, x_old, e_old, aim, gain, x, e, *derivatives
    ):  # fmt: skip
        tried.append(share)
        e[:] = share
        filter_pass(theta, y, seen, u, c, s, x, None, None, *derivatives)
        return gains(share)

    n, out = 3, np.zeros((3, 5))
    x, e, found = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros(1, dtype=np.int64)
    guide.guide_each.py_func(
        filter_pass, gains_pass, (0, 0), None, np.zeros((n, 1)), np.zeros((n, 1)),
        np.zeros((n, 0)), np.array([0, n]), guide.SEARCHED, 12, 0.05, (1, 1), 0, x, e, out, found,
    )  # fmt: skip
    return tried, int(found[0]), e


def test_shorter_steps_where_the_full_one_is_impossible():
    tried, found, e = searched(lambda share: -np.inf if share > 0.2 else -1.0)
    assert tried == [*guide.SHARES[:3], *guide.SHARES]  # and then none leads higher
    assert found == guide.GUIDE
    np.testing.assert_array_equal(e, 0.2)


def test_a_guide_of_which_something_is_no_number_is_none():
    """The slope of the observation's density, of which the precision knows nothing."""
    assert searched(lambda share: -1.0)[1] == guide.GUIDE
    with np.errstate(invalid="ignore"):
        assert searched(lambda share: -1.0, slope=np.inf)[1] == guide.REFERENCE


def test_a_flat_guide_has_the_inputs():
    made, (theta, y, seen, u), *_ = case("correlated")
    with np.errstate(all="ignore"):
        found = made.gaussian.guides(theta, np.full_like(y, 1e200), seen, u)
    assert found.found[0] == guide.NO_NUMBER
    np.testing.assert_array_equal(found.rows[:, : u.shape[1]], u)
    flat = np.zeros(found.rows.shape[1] - u.shape[1])
    np.testing.assert_array_equal(found.rows[1:, u.shape[1] :], np.tile(flat, (STEPS - 1, 1)))


# -- the parts
def test_lift_is_the_positive_part():
    """The nearest positive semidefinite matrix, by its eigenvalues."""
    rng = np.random.default_rng(4)
    negative = 0
    for d in range(1, 7):
        for k in range(20):
            h = rng.normal(size=(d, d)) * 10.0 ** rng.uniform(-3, 3, d)[:, None]
            h = h + h.T
            if k % 4 == 0:
                h = h @ h  # nothing to lift
            if k % 4 == 1:  # two eigenvalues, each several times
                q = np.linalg.qr(rng.normal(size=(d, d)))[0]
                h = q * rng.choice([-1.0, 2.0], d) @ q.T
                h = 0.5 * (h + h.T)
            values, vectors = np.linalg.eigh(h)
            negative += values[0] < 0
            expected = vectors * np.maximum(values, 0.0) @ vectors.T
            found = h.copy()
            lift(found)
            np.testing.assert_allclose(found, expected, atol=1e-12 * np.linalg.norm(h))
            np.testing.assert_array_equal(found, found.T)
            if k % 4 == 0 and values[0] > 1e-10 * values[-1]:
                np.testing.assert_array_equal(found, h)  # untouched
    assert negative > 60


@pytest.mark.parametrize(
    ("h", "expected"),
    [
        (np.zeros((2, 2)), np.zeros((2, 2))),
        (np.diag([2.0, -1.0, 0.0]), np.diag([2.0, 0.0, 0.0])),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), np.full((2, 2), 0.5)),
        (-np.eye(3), np.zeros((3, 3))),
    ],
)
def test_lift_by_hand(h, expected):
    found = np.array(h)
    lift(found)
    np.testing.assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_update_is_the_textbook_one(rank):
    """x + K (y - C x), (I - K C) P, of a prediction of any rank, from wherever one starts."""
    rng = np.random.default_rng(5)
    for measured in (1, 2, 4):
        half = rng.normal(size=(3, rank))
        p, c = half @ half.T, rng.normal(size=(measured, 3))
        root = rng.normal(size=(measured, measured))
        noise = root @ root.T + 0.1 * np.eye(measured)
        mean, y, x = rng.normal(size=3), rng.normal(size=measured), 3 * rng.normal(size=3)
        gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + noise)
        weight = c.T @ np.linalg.inv(noise)
        z, step = np.full((3, 3), np.nan), np.full(3, np.nan)
        assert np.isfinite(update(p, weight @ c, weight @ (y - c @ x), x - mean, z, step))
        np.testing.assert_allclose(step, gain @ (y - c @ mean), atol=1e-10)
        np.testing.assert_allclose(z, (np.eye(3) - gain @ c) @ p, atol=1e-10)
        np.testing.assert_array_equal(z, z.T)


def test_update_that_needs_a_pivot():
    """The first pivot of I + P H is zero, the matrix is not singular."""
    p, h = np.array([[1.0, 0.5], [0.5, 1.0]]), np.array([[-1.5, 1.0], [1.0, 0.7]])
    s = np.eye(2) + p @ h
    assert s[0, 0] == 0.0
    z, step = np.empty((2, 2)), np.empty(2)
    assert np.isfinite(update(p, h, np.array([1.0, -2.0]), np.array([0.2, 0.1]), z, step))
    np.testing.assert_allclose(z, np.linalg.solve(s, p), atol=1e-12)
    pull = np.array([1.0, -2.0]) + h @ [0.2, 0.1]
    np.testing.assert_allclose(step, np.linalg.solve(s, p) @ pull, atol=1e-12)


@pytest.mark.parametrize("h", [-1.0, np.nan])
def test_update_says_where_there_is_none(h):
    z, step = np.empty((1, 1)), np.empty(1)
    assert update(np.eye(1), np.array([[h]]), np.zeros(1), np.zeros(1), z, step) == np.inf


def test_a_missing_row_leaves_the_prediction():
    z, step = np.empty((2, 2)), np.empty(2)
    p = np.array([[2.0, 0.3], [0.3, 1.0]])
    assert np.isfinite(update(p, np.zeros((2, 2)), np.zeros(2), np.zeros(2), z, step))
    np.testing.assert_array_equal(z, p)
    np.testing.assert_array_equal(step, 0.0)
