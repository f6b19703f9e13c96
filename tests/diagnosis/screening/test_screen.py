"""The screen: what was planted is found with its size, what was not is not."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.data import bind, check_parameters
from ssmppl.diagnosis.fitting.fit import Effort, Fitter
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.simulated_records import Simulator
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.screen import ScreenDesign, run_screen
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.small import BREAK, DATE, level, levels
from tests.statistics.checks import LEVEL, seed_of

NAMES = ["level break", "sensor drift", "heteroscedastic noise", "parameter drift"]
THETA = {"q": 0.1, "r": 1.0}


def question_of(data, held=(), names=NAMES, settings=None):
    problem = pose(level(), data)
    rng = np.random.default_rng(1)
    scales = Scales.of(problem.trace, rng.standard_normal((80, 1)), data["y"][:, None],
                       np.empty((80, 0)), 80)  # fmt: skip
    missing = missing_of(problem.experiments)
    return problem, ScreenDesign(
        problem.trace, scales, missing, held, settings or Settings(), names
    )


def asked(data, seed, held=("q", "r"), sets=120, **kwargs):
    problem, design = question_of(data, held, **kwargs)
    theta = check_parameters(problem.trace, THETA)
    return run_screen(
        design, problem.experiments, theta, sets, seed_sequence(seed), Checkpoint(None, {})
    )


def test_a_jump_is_found_where_it_was_and_as_large_as_it_was():
    found = asked(levels(80, BREAK), seed_of("jump"), names=["level break", "sensor drift"])
    best = int(found.family.best[np.argmin(found.family.p)])
    c = found.design.candidates[best]
    assert c.effect.name == "level break"
    assert found.candidate_p[best] <= 0.05
    # A row off costs BREAK^2 / 2 r^2 = 18 nats.
    assert dict(c.shape)["date"] == DATE
    error = 1.0 / np.sqrt(found.efficient.variance[best])
    # V itself is known to a relative sqrt(2 / sets); the jump is linear in the model.
    error = np.hypot(error, abs(BREAK) * np.sqrt(2.0 / 120))
    assert abs(found.efficient.strength[best] - BREAK) <= stats.norm.isf(LEVEL / 2) * error


def test_the_information_of_a_jump_is_the_exact_one():
    """Of a known linear model: V = w' S^-1 w, S the covariance of y, w what a jump does to it."""
    found = asked(levels(80), seed_of("information"), sets=200)
    t = np.arange(1, 81)
    cov = 4.0 + 0.1**2 * (np.minimum.outer(t, t) - 1.0) + np.eye(80)
    for date in (10, DATE, 60):
        (k,) = [i for i, c in enumerate(found.design.candidates)
                if c.effect.name == "level break" and dict(c.shape)["date"] == date]  # fmt: skip
        w = (t > date).astype(float)
        exact = w @ np.linalg.solve(cov, w)
        off = found.efficient.variance[k] / exact - 1.0
        assert abs(off) <= stats.norm.isf(LEVEL / 6) * np.sqrt(2.0 / 200), date


def test_the_score_of_a_jump_is_the_exact_one():
    data = levels(80, BREAK)
    found = asked(data, seed_of("score"), sets=60)
    t = np.arange(1, 81)
    cov = 4.0 + 0.1**2 * (np.minimum.outer(t, t) - 1.0) + np.eye(80)
    solved = np.linalg.solve(cov, data["y"])
    names = [(c.effect.name, dict(c.shape).get("date")) for c in found.design.candidates]
    for date in (10, DATE, 60):
        k = names.index(("level break", date))
        # Antithetic trajectories: linear scores come out without Monte Carlo error.
        np.testing.assert_allclose(
            found.observed.candidate_scores[k], (t > date).astype(float) @ solved, rtol=1e-6
        )


def test_a_second_call_draws_nothing_again(tmp_path, monkeypatch):
    data, file = levels(80), tmp_path / "kept.npz"
    problem, design = question_of(data)
    theta = check_parameters(problem.trace, THETA)
    ran = []
    original = ScreenDesign.statistics

    def counted(self, *args):
        ran.append(1)
        if len(ran) == 30:
            raise KeyboardInterrupt
        return original(self, *args)

    monkeypatch.setattr(ScreenDesign, "statistics", counted)
    call = design, problem.experiments, theta, 60, seed_sequence(5)
    with pytest.raises(KeyboardInterrupt):
        run_screen(*call, Checkpoint(file, {"mode": "x"}))
    before = len(ran)
    kept = Checkpoint(file, {"mode": "x"})
    again = run_screen(*call, kept)
    done = sum(f"screening/{k}" in kept for k in range(66))
    assert done == 66
    assert len(ran) - before <= 66 - 29 + 4, "sets that were done are not drawn again"
    fresh = run_screen(*call, Checkpoint(None, {}))
    np.testing.assert_array_equal(again.efficient.z, fresh.efficient.z)
    np.testing.assert_array_equal(again.family.p, fresh.family.p)


def test_too_few_sets_is_said(monkeypatch):
    problem, design = question_of(levels(80))

    def fails(self, *args):
        raise SamplingError("all weights are zero at t=3")

    monkeypatch.setattr(Simulator, "counted_sets", fails)
    theta = check_parameters(problem.trace, THETA)
    with pytest.raises(ArgumentError, match="0 of 60 parametric-bootstrap data sets") as error:
        run_screen(design, problem.experiments, theta, 60, seed_sequence(1), Checkpoint(None, {}))
    assert "particles" in str(error.value)


@pytest.mark.slow
def test_false_alarms_at_the_rate_that_is_asked_for():
    """Fits and screens of data without any effect: alarms at 5% are binomial with .05."""
    sets, alarms = 60, 0
    problem, design = question_of(levels(80))
    fitter = Fitter(problem, {}, Settings())
    for k in range(sets):
        experiments = bind(problem.trace, levels(80, 0.0, "no effect", k))
        seed = seed_sequence(seed_of("false alarms", k))
        fit = fitter.fit(experiments, seed, {}, Effort(standard_errors=False))
        found = run_screen(design, experiments, fit.theta, 100, seed, Checkpoint(None, {}))
        alarms += bool(found.family.p.min() <= 0.05)
    assert stats.binom.sf(alarms - 1, sets, 0.05) > LEVEL, alarms


@ssm.effect(on="x", name="suction", lower=-2, upper=0)
def suction(x, strength):
    return strength


@ssm.effect(on="x", name="lift", lower=0)
def lift(x, strength):
    return strength


@pytest.mark.parametrize("rise", [0.05, -0.05])
def test_a_strength_has_the_sign_that_its_bounds_leave(rise):
    """One that may only be negative was found with a positive strength."""
    data = {"y": levels(80)["y"] + rise * np.arange(80)}
    found = asked(data, seed_of("suction"), names=[suction, lift])
    by_name = {c.effect.name: k for k, c in enumerate(found.design.candidates)}
    for name, sign in (("suction", -1), ("lift", 1)):
        k = by_name[name]
        assert found.design.sided[k] == sign
        right = sign * rise > 0
        if right:  # z is the score over sqrt(V), 2.6 for the drift and the noise of these data
            assert found.efficient.gain[k] > 1.0
        else:
            assert found.efficient.gain[k] == 0.0
            assert found.candidate_p[k] > 0.5
