"""Records drawn from a model that may leave its domain, and from one that cannot."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.data import bind
from ssmppl.diagnosis.model import simulated_records
from ssmppl.diagnosis.model.simulated_records import Simulator
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.diagnosis.small import fished, fished_data, levels
from tests.statistics.checks import LEVEL

AT_FIT = np.array([0.28, 800.0, 0.1, 0.1])  # r, K, q, s: a stock that dies in six of seven records


def simulator_of(model, data):
    problem = pose(model, data)
    linear = kalman_model(problem.trace)
    return Simulator(problem.program, problem.program.missing, linear), tuple(problem.experiments)


def walk(transition):
    model = ssm.Model("walk")
    model.prior(lambda: {"a": ssm.Normal(1, sd=1), "q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return model


def test_a_stock_that_dies_out_is_drawn_again():
    """Those that are kept have the conditional distribution: that of the draws which stay."""
    simulator, data = simulator_of(fished(), fished_data(1))
    draws = simulator.observations(data[0], AT_FIT, random_state(seed_sequence(1)), 2000)[:, 0]
    seen = data[0].seen[:, 0] == 1.0
    with np.errstate(invalid="ignore"):
        stay = np.all(np.isfinite(draws[seen]), axis=0) & (np.min(draws[seen], axis=0) > 2.0)
    assert 0.05 < stay.mean() < 0.4
    found = [
        simulator.counted_sets(data, AT_FIT, random_state(seed_sequence(2), r)) for r in range(200)
    ]
    kept = np.array([e.y[:, 0] for (e,), _ in found])
    assert np.all(kept[:, seen] > 0.0)
    assert np.all(kept[:, ~seen] == 0.0)
    assert stay.mean() == pytest.approx(200 / sum(n for _, n in found), rel=0.3)
    for row in (20, 63):
        assert stats.ks_2samp(kept[:, row], draws[row, stay]).pvalue > LEVEL


def test_no_more_is_cut_off_than_leaves():
    """A walk that drifts far from its data is no crash: a record in closed loop stays nearer."""
    model = walk(lambda x, a, q: {"x": ssm.Normal(x + a * np.sin(x), sd=q)})
    simulator, data = simulator_of(model, levels(80))
    theta = np.array([0.01, 8.0])  # seventy in eighty rows, where the data have a range of a few
    draws = simulator.observations(data[0], theta, random_state(seed_sequence(1)), 500)[:, 0]
    reach = np.abs(draws).max(axis=0) / np.ptp(data[0].y)
    assert np.mean(reach > simulated_records.REACHES[0]) > 0.5
    found = [
        simulator.counted_sets(data, theta, random_state(seed_sequence(2), r)) for r in range(50)
    ]
    assert {n for _, n in found} == {1}


def test_a_linear_model_is_drawn_once():
    """Its scores do not depend on where it went: nothing is chosen among the draws."""
    model = walk(lambda x, a, q: {"x": ssm.Normal(a * x, sd=q)})
    simulator, data = simulator_of(model, levels(80))
    theta = np.array([1.08, 0.1])  # some records go far beyond the data, and some do not
    sets = [
        simulator.counted_sets(data, theta, random_state(seed_sequence(3), r)) for r in range(9)
    ]
    assert {number for _, number in sets} == {1}
    reach = [np.abs(e.y).max() / np.ptp(data[0].y) for (e,), _ in sets]
    assert min(reach) < 100 < max(reach)
    same = simulator.observations(data[0], theta, random_state(seed_sequence(3), 0), 1)[:, :, 0]
    np.testing.assert_array_equal(sets[0][0][0].y, same)


def test_where_none_stays_one_is_drawn():
    simulator, data = simulator_of(fished(), fished_data(1))
    theta = AT_FIT * np.array([0.01, 1.0, 1.0, 1.0])  # no growth: nothing survives the catch
    _, number = simulator.counted_sets(data, theta, random_state(seed_sequence(4)))
    assert number == 1


def test_a_record_of_few_values_has_no_range():
    """Their range says little of that of others, and what is finite is kept."""
    model = fished()
    few = fished_data(1)
    few["y"][5:] = np.nan
    (experiment,) = bind(pose(model, few).trace, few)
    middle, width = simulated_records.middle_and_range([experiment])
    assert (middle[0], width[0]) == (0.0, np.inf)
