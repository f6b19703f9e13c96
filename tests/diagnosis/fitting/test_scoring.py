"""Climbs by Fisher's scoring, against Newton's by differences and exact likelihoods."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.fitting import scoring
from ssmppl.diagnosis.fitting.densities import density_of
from ssmppl.diagnosis.fitting.scoring import climb_by_scoring
from ssmppl.inference.optimisation.newton import climb
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose

ROWS = 150
RNG = np.random.default_rng(8)
INPUT = np.sin(np.arange(ROWS) / 6.0)
START = {"a": 0.5, "k": 0.2, "q": 0.5, "r": 0.5}


def pendulum(counts=False):
    """A damped pendulum that is pushed, its angle read, or counted."""
    model = ssm.Model("pendulum", inputs=("u",))

    @model.prior
    def prior():
        return {
            "a": ssm.LogNormal(0, sd=1), "k": ssm.LogNormal(-1, sd=1),
            "q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=1),
        }  # fmt: skip

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=0.2), "v": ssm.Normal(0, sd=0.2)}

    @model.transition
    def transition(x, v, u, a, k, q):
        return {
            "x": ssm.Dirac(x + 0.2 * v),
            "v": ssm.Normal(v + 0.2 * (u - a * np.sin(x) - k * v), sd=q),
        }  # fmt: skip

    @model.observation
    def observation(x, v, u, r):
        if counts:
            return {"y": ssm.Poisson(np.exp(x))}
        return {"y": ssm.Normal(x, sd=r), "w": ssm.Normal(v + 0.1 * x**2 + 0.2 * u, sd=2 * r)}

    return model


@pytest.fixture(scope="module")
def posed():
    model = pendulum()
    at = {"a": 1.2, "k": 0.3, "q": 0.1, "r": 0.05}
    made = ssm.simulate(model, at, steps=ROWS, inputs={"u": INPUT}, seed=4)
    data = {n: made[n].values[0].copy() for n in ("y", "w")} | {"u": INPUT}
    data["y"][20:25] = np.nan
    return pose(model, [data, {n: v[:60] for n, v in data.items()}])


def function_of(problem, space):
    def smooth(theta):
        gaussian = problem.program.gaussian
        return sum(
            gaussian.extended_log_likelihood(theta, e.y, e.seen, e.u) for e in problem.experiments
        )

    return density_of(space, smooth)


def test_many_points_at_once_are_those_one_by_one(posed):
    """Also where one of them comes to no number, in both data sets."""
    gaussian = posed.program.gaussian
    names = [s.data[1] for s in posed.trace.parameter_symbols]
    at = np.array([[START[n] for n in names], [START[n] * 1.3 for n in names]])
    at = np.vstack([at, np.where(np.array(names) == "q", np.nan, at[0]), 0.7 * at[1]])
    values = scoring.increments_with_predictions(posed.trace, gaussian, posed.experiments, 4, 0.25)
    rows, predicted = values(at)
    bad = 2
    assert np.all(rows[bad] == -np.inf)
    for b in (0, 1, 3):
        alone, own = values(at[b : b + 1])
        np.testing.assert_array_equal(rows[b], alone[0])
        np.testing.assert_array_equal(predicted.error[b], own.error[0])
        np.testing.assert_array_equal(predicted.covariance[b], own.covariance[0])
        total = sum(
            gaussian.extended_log_likelihood(at[b], e.y, e.seen, e.u) for e in posed.experiments
        )
        assert rows[b].sum() == pytest.approx(total + 2 * 0.25, rel=1e-12)
        for e, own_rows in zip(posed.experiments, (slice(0, ROWS), slice(ROWS, None)), strict=True):
            found = gaussian.extended(at[b], e.y, e.seen, e.u)
            x, v = found.predicted.T
            expected = e.y - np.column_stack([x, v + 0.1 * x**2 + 0.2 * e.u[:, 0]])
            np.testing.assert_allclose(
                predicted.error[b, own_rows], np.where(e.seen == 1.0, expected, 0.0), atol=1e-12
            )


def test_the_top_is_newtons(posed):
    space = space_of(posed, {}, {n: np.asarray(v) for n, v in START.items()})
    z = space.z[space.positions]
    found = climb_by_scoring(space, posed.program.gaussian, z, 0.0)
    function = function_of(posed, space)
    exact = climb(function, z)
    assert found.value == pytest.approx(function(found.z), abs=1e-8)
    assert found.value == pytest.approx(exact.value, abs=0.02)
    spread = 1.0 / np.sqrt(np.diagonal(exact.information))
    assert np.all(np.abs(found.z - exact.z) < 0.2 * spread)
    # expected for observed information: of 210 rows, to within a few of their standard deviations
    ratio = np.diagonal(found.information) / np.diagonal(exact.information)
    assert np.all(np.abs(np.log(ratio)) < 4.0 * np.sqrt(2.0 / 210))


def test_it_takes_fewer_values_than_differences(posed, monkeypatch):
    space = space_of(posed, {}, {n: np.asarray(v) for n, v in START.items()})
    z, gaussian = space.z[space.positions], posed.program.gaussian
    asked = []
    original = gaussian.extended
    monkeypatch.setattr(
        type(gaussian), "extended", lambda self, *a: asked.append(1) or original(*a)
    )
    climb_by_scoring(space, gaussian, z, 0.0)
    function, newtons = function_of(posed, space), []
    climb(lambda z: newtons.append(1) or function(z), z)
    assert len(asked) / 2 < 0.5 * len(newtons)  # two data sets for each value


def test_what_is_added_for_each_data_set_is_in_the_value(posed):
    space = space_of(posed, {}, {n: np.asarray(v) for n, v in START.items()})
    z, gaussian = space.z[space.positions], posed.program.gaussian
    plain, more = (climb_by_scoring(space, gaussian, z, shift) for shift in (0.0, 1.5))
    assert more.value - plain.value == pytest.approx(3.0, abs=1e-6)
    np.testing.assert_allclose(more.z, plain.z, atol=1e-9)


def test_counts_and_too_many_numbers_have_none(posed, monkeypatch):
    model = pendulum(counts=True)
    y = RNG.poisson(1.0, ROWS).astype(float)
    problem = pose(model, {"y": y, "u": INPUT})
    space = space_of(problem, {}, {n: np.asarray(v) for n, v in START.items()})
    z = space.z[space.positions]
    assert climb_by_scoring(space, problem.program.gaussian, z, 0.0) is None
    monkeypatch.setattr(scoring, "MOST", 1000)
    space = space_of(posed, {}, {n: np.asarray(v) for n, v in START.items()})
    assert climb_by_scoring(space, posed.program.gaussian, z, 0.0) is None
