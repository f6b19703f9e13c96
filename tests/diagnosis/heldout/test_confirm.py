"""Held-out predictions and free runs: which rows count, and what cannot be predicted."""

import warnings
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.diagnosis import diagnose
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.heldout.predictions import (
    FreeRun,
    Predictions,
    gain_of_mean,
    predict,
    rmse,
    stretches,
)
from ssmppl.diagnosis.heldout.row_split import three_parts, without
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.inference.run.problem import pose
from tests.diagnosis.small import level, levels
from tests.statistics.checks import seed_of


def fitted(problem, theta, **settings):
    """A fitter, and a fit at theta."""
    fitter = Fitter(problem, {}, Settings(**settings))
    n = len(theta)
    numbers = {"theta": theta, "z": np.zeros(n), "log_likelihood": 0.0, "error": 0.0,
               "information": np.eye(n), "distance": 0.0, "converged": True,
               "at_bound": np.zeros(n)}  # fmt: skip
    return fitter, fitter.restored(problem.experiments, numbers)


def test_experiments_without_rows_that_count_are_left_out():
    """The densities are those of the rows behind the cut, by the Kalman filter's own increments."""
    problem = pose(level(), [levels(2), levels(400), levels(3), levels(50)])
    base, parts = fitted(problem, [0.1, 1.0]), three_parts(problem.experiments)
    found = predict(*base, problem.experiments, parts.held_out, np.random.SeedSequence(1))
    assert found.starts == (0, 115)
    wanted = []
    for i in (1, 3):
        y, mean, variance = problem.experiments[i].y[:, 0], 0.0, 4.0
        for t, v in enumerate(y):
            if parts.held_out[i][t]:
                wanted.append(stats.norm(mean, np.sqrt(variance + 1.0)).logpdf(v))
            gain = variance / (variance + 1.0)
            mean, variance = mean + gain * (v - mean), (1.0 - gain) * variance + 0.01
    np.testing.assert_allclose(found.log_density[0], wanted, atol=1e-9)
    nothing = [np.zeros(e.steps, bool) for e in problem.experiments]
    assert predict(*base, problem.experiments, nothing, np.random.SeedSequence(1)).starts == (0,)


def runs(*errors):
    """Experiments of (rows, error), with free runs that are off by as much; all rows count."""
    out = []
    for n, error in errors:
        (e,) = pose(level(), levels(n)).experiments
        mean = e.y + error * np.where(np.arange(n) % 2, 1.0, -1.0)[:, None]
        out.append((FreeRun(mean, mean, mean), e, np.ones(n, bool)))
    return list(map(list, zip(*out, strict=True)))


def test_the_error_is_over_rows_and_not_over_experiments():
    given = runs((1000, 1.0), (10, 10.0))
    assert rmse(*given) == pytest.approx(np.sqrt((1000 + 10 * 100) / 1010))
    _, e, _ = given
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        e[1] = without(e[1], np.ones(10, bool))
        assert rmse(*given) == pytest.approx(1.0)
        e[0] = without(e[0], np.arange(1000) >= 1)
        assert rmse(*given) == pytest.approx(1.0)
        e[0] = without(e[0], np.ones(1000, bool))
        assert np.isnan(rmse(*given))


def test_a_channel_without_data_does_not_count():
    (e,) = pose(level(), levels(50)).experiments
    y = np.concatenate([e.y, np.zeros((50, 1))], axis=1)
    both = type(e)(**{**vars(e), "y": y, "seen": np.tile([1.0, 0.0], (50, 1))})
    run = FreeRun(y + 2.0, y, y)
    assert rmse([run], [both], [np.ones(50, bool)]) == pytest.approx(2.0)


def bounded():
    """A level whose sensor errs by less than 3."""
    model = ssm.Model("bounded")
    model.prior(lambda: {"q": ssm.LogNormal(-1, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(0.9 * x, sd=q)})
    model.observation(
        lambda x: {"y": ssm.Truncated(ssm.Normal(x, sd=0.5), lower=x - 3, upper=x + 3)}
    )
    return model


@pytest.mark.slow
def test_a_held_out_row_that_cannot_be_leaves_the_rest_of_the_report(monkeypatch):
    """What was found and fitted is told; that the gap is not measured, and why, is a note."""
    monkeypatch.setattr(diagnose, "SETS", {"fast": 40, "full": 40})
    rng, x = np.random.default_rng(seed_of("bounded")), np.zeros(320)
    for t in range(1, 320):
        x[t] = 0.9 * x[t - 1] + 0.3 * rng.standard_normal()
    y = x + 0.5 * rng.standard_normal(320)
    y[300] += 30.0
    report = ssm.diagnose(bounded(), {"y": y}, ["constant load"], particles=200, progress=False)
    assert report.closed.empty
    assert len(report.free_run) == 320
    (note,) = [n for n in report.notes if "share of the reference model's gain" in n]
    assert "could not be computed: all weights are zero at t=301" in note


def sensors(n, together):
    """A walk that n sensors see, one channel each or one vector."""
    model = ssm.Model("sensors")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1), "b": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=2)})
    model.transition(lambda x, q, b: {"x": ssm.Normal(x + b, sd=q)})
    if together:
        noise = 0.01 * np.eye(n) + 0.005
        model.observation(lambda x: {"y": ssm.MvNormal(x + np.zeros(n), covariance=noise)})
    else:
        model.observation(lambda x: {f"y{k}": ssm.Normal(x, sd=0.1 * (k + 1)) for k in range(n)})
    return model


@pytest.mark.parametrize("together", [False, True])
def test_channels_that_go_together_count_as_one(together):
    """Of three sensors of one state, errors that they have in common counted three times.

    Of a linear Gaussian model a change of the mean alone is all that the density gains.
    """
    rng = np.random.default_rng(seed_of("sensors", together))
    x = np.cumsum(0.3 + 0.5 * rng.standard_normal(60))
    values = x[:, None] + 0.1 * rng.standard_normal((60, 3))
    values[10:13, 1] = values[20, :] = np.nan
    data = {"y": values} if together else {f"y{k}": values[:, k] for k in range(3)}
    problem = pose(sensors(3, together), data)
    counts = [np.ones(60, bool)]
    seed = np.random.SeedSequence(1)
    base, other = (
        predict(*fitted(problem, [0.5, b]), problem.experiments, counts, seed) for b in (0.0, 0.3)
    )
    whole = other.log_density[0].sum() - base.log_density[0].sum()
    assert abs(whole) > 5.0
    assert gain_of_mean(base, other) == pytest.approx(whole, rel=1e-9)


def test_channels_whose_covariance_nobody_knows_have_no_share_of_the_mean():
    two, none = np.ones((4, 2)), np.full((4, 2), np.nan)
    base, other = (Predictions(none, m * two, two, 1.0 * two, (0,)) for m in (0.0, 0.5))
    assert np.isnan(gain_of_mean(base, other))
    alone = np.array([[1.0, np.nan], [np.nan, 1.0]] * 2)
    base, other = (Predictions(none, m * two, two, alone, (0,)) for m in (0.0, 0.5))
    assert gain_of_mean(base, other) == pytest.approx(4 * 0.5 * (1.0 - 0.25))


def test_a_stretch_is_shared_out_over_rows_with_data():
    """Missing rows had their part of the nats, and counted as samples."""
    data = levels(40)
    data["y"][np.arange(40) % 4 != 1] = np.nan
    (e,) = pose(level(), data).experiments
    counts, fit = np.arange(40) >= 20, SimpleNamespace(theta=None)
    fitter = SimpleNamespace(estimate=lambda own, theta, stream: -2.0 * own[0].seen.sum())
    found = stretches(fitter, fit, e, counts, np.empty(0))
    np.testing.assert_allclose(found, np.where(e.seen.any(axis=1) & counts, -2.0, 0.0))


@pytest.mark.parametrize(
    ("profiles", "by"),
    [(("",), "later rows"), (("", "pulse"), "later rows"), (("pulse",), "blocks"),
     (("pulse", "pulse"), "blocks"), (("step",), "later rows")],
)  # fmt: skip
def test_later_rows_tell_of_all_but_what_happened_once(monkeypatch, profiles, by):
    def measured(name):
        return lambda *args: SimpleNamespace(gain=lambda *args: name)

    monkeypatch.setattr(diagnose, "HeldOutRows", measured("later rows"))
    monkeypatch.setattr(diagnose, "CrossValidation", measured("blocks"))
    for name in ("AugmentedModels", "ScreenDesign", "replace"):
        monkeypatch.setattr(diagnose, name, lambda *args, **settings: MagicMock())
    effects = [SimpleNamespace(effect=SimpleNamespace(profile=p)) for p in profiles]
    results = MagicMock(chosen=SimpleNamespace(candidates=effects))
    assert diagnose._Diagnosis._held_out_gain(MagicMock(), results) == by
