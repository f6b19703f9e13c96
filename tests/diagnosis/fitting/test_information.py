"""Information matrices: which of two is believed."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.fitting.fit import FROM_START, Fitter, standard_errors
from ssmppl.diagnosis.fitting.information import INFLATED, not_inflated, positive_definite
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import seed_sequence

CURVATURE = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 9.0]])
EVERYTHING = np.ix_([True] * 3, [True] * 3)


def test_scores_that_scatter_as_the_likelihood_bends_are_believed():
    simulated = CURVATURE * 1.5
    assert not_inflated(simulated, CURVATURE, EVERYTHING) is simulated
    less = CURVATURE / 50.0  # errors on the safe side
    assert not_inflated(less, CURVATURE, EVERYTHING) is less


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_one_direction_that_is_all_scatter_is_enough(factor):
    along = np.array([1.0, -2.0, 0.5])
    root = np.linalg.cholesky(CURVATURE)
    unit = along / np.linalg.norm(np.linalg.solve(root, along))
    simulated = CURVATURE + (factor * INFLATED - 1.0) * np.outer(unit, unit)
    found = not_inflated(simulated, CURVATURE, EVERYTHING)
    assert found is (CURVATURE if factor > 1.0 else simulated)


def test_what_is_no_top_or_no_number_is_not_believed():
    saddle = np.diag([1.0, -1.0, 1.0])
    simulated = 1e6 * CURVATURE
    nothing = np.full((3, 3), np.nan)
    assert not_inflated(simulated, saddle, EVERYTHING) is simulated
    assert not_inflated(simulated, nothing, EVERYTHING) is simulated
    assert not_inflated(nothing, CURVATURE, EVERYTHING) is CURVATURE


def test_what_is_at_a_bound_does_not_count():
    free = np.ix_([True, True, False], [True, True, False])
    simulated, curvature = CURVATURE.copy(), CURVATURE.copy()
    curvature[2, :] = curvature[:, 2] = np.nan
    simulated[2, 2] = 1e9
    assert not_inflated(simulated, curvature, free) is simulated
    simulated[0, 0] = 1e9
    assert not_inflated(simulated, curvature, free) is curvature


def test_steps_are_made_with_a_positive_definite_matrix():
    found = positive_definite(np.diag([1.0, -4.0, 0.0]), np.array([False, False, True]))
    assert np.all(np.linalg.eigvalsh(found) > 0.0)
    assert found[1, 1] == pytest.approx(4.0)


def test_the_error_of_what_acts_on_a_position_that_is_measured_exactly():
    """The position tells the speeds, and these the drag as in a regression of their changes. Scores
    through the position are Monte Carlo error: by them it is forty thousand times less."""
    dt, q, r, rows = 0.05, 0.02, 1e-7, 200
    model = ssm.Model("sled", inputs=("u",))
    model.prior(lambda: {"c": ssm.HalfNormal(sd=2)})
    model.initial(lambda: {"p": ssm.Normal(0, sd=1e-3), "v": ssm.Normal(0, sd=1e-3)})

    def step(p, v, u, c):
        new = v + dt * (u - c * np.tanh(v / 0.3))
        return {"p": ssm.Dirac(p + dt * new), "v": ssm.Normal(new, sd=q)}

    model.transition(step)
    model.observation(lambda p: {"y": ssm.Normal(p, sd=r)})
    u = np.repeat(np.random.default_rng(1).uniform(-2.0, 2.0, rows // 10), 10)
    drawn = ssm.simulate(model, {"c": 0.8}, inputs={"u": u}, seed=1)
    problem = pose(model, {"u": u, "y": drawn["y"].values[0]})
    fitter = Fitter(problem, {}, Settings(100, "twisted"))
    fit = fitter.fit(problem.experiments, seed_sequence(1), {"c": np.array(1.0)}, FROM_START)
    fit = fitter.with_information(fit, seed_sequence(2))
    slopes = dt * np.tanh(drawn["v"].values[0][:-1] / 0.3)
    assert standard_errors(fit, {})["c"] == pytest.approx(q / np.sqrt(np.sum(slopes**2)), rel=0.15)
