"""Errors many rows ahead against what is known of them, and the fits that simulate best."""

from dataclasses import replace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue import effects
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.heldout.simulation import Horizon, compared, horizons, table_rows
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.selection import horizons as module
from ssmppl.diagnosis.selection import simulation_fit
from ssmppl.diagnosis.selection.horizons import SimulationGain, look_ahead
from ssmppl.diagnosis.selection.simulation_fit import fit_for_simulation, gain_of_base, restored
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import seed_sequence
from tests.statistics.checks import seed_of

Q, R = 0.3, 0.2


def walk():
    model = ssm.Model("walk")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1.0), "r": ssm.HalfNormal(sd=1.0)})
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, sd=q)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


def fitted(model, data, theta, settings=None):
    """(fitter, fit) at parameters that are given."""
    problem = pose(model, data)
    augmented = AugmentedModels(
        problem.trace, missing_of(problem.experiments), {}, settings or Settings(200, "twisted")
    )
    fitter = augmented.base_fitter
    start = {n: np.asarray(v) for n, v in theta.items()}
    fit = fitter.fit(problem.experiments, seed_sequence(1), start)
    symbols = [repr(s) for s in problem.trace.parameter_symbols]
    at = np.array([theta[n] for n in symbols])
    return fitter, replace(fit, theta=at), problem.experiments


def walks(rows, number, *name):
    rng = np.random.default_rng(seed_of("horizons", *name))
    x = np.cumsum(Q * rng.standard_normal((number, rows)), axis=1)
    return [{"y": v + R * rng.standard_normal(rows)} for v in x]


def every(experiments):
    return [np.ones(e.steps, bool) for e in experiments]


def test_errors_of_a_random_walk_grow_as_they_must():
    """The filter's variance is P; so many rows ahead the error has P + h q^2 + r^2."""
    fitter, fit, experiments = fitted(walk(), walks(200, 60, "walk"), {"q": Q, "r": R})
    found = look_ahead(fitter, fit, experiments, every(experiments), 30, seed_sequence(2))
    p = 0.5 * (-(Q**2) + np.sqrt(Q**4 + 4 * Q**2 * R**2))  # of x_t given y_1:t, in the long run
    for h in (1, 10, 30):
        expected = p + h * Q**2 + R**2
        errors = found.unit**2 * found.at(h).square
        by_record = errors.reshape(len(experiments), -1).mean(axis=1)
        z = by_record.mean() - expected * (1 + 1 / module.DRAWS)
        assert abs(z) < 4 * by_record.std(ddof=1) / np.sqrt(len(by_record))
        density = found.at(h).density.reshape(len(experiments), -1).mean(axis=1)
        known = -0.5 * (1 + np.log(2 * np.pi * expected))
        assert abs(density.mean() - known) < 4 * density.std(ddof=1) / np.sqrt(len(density)) + 0.02
    window = found.unit**2 * found.window(10).square
    assert np.mean(window) == pytest.approx(
        np.mean([found.unit**2 * found.at(h).square[: len(window)].mean() for h in range(1, 11)]),
        rel=0.05,
    )


def test_rows_that_do_not_count_and_values_that_are_missing_are_left_out():
    data = walks(60, 1, "missing")
    data[0]["y"][40:] = np.nan
    fitter, fit, experiments = fitted(walk(), data, {"q": Q, "r": R})
    counts = [np.arange(60) >= 30]
    found = look_ahead(fitter, fit, experiments, counts, 12, seed_sequence(2))
    assert found.square.shape[1:] == (12, 1)
    # From row 29 on: ten rows that are measured.
    assert len(found.window(10).square) == 1
    assert len(found.window(11).square) == 0
    assert np.isnan(found.window(11).rmse)
    none = look_ahead(fitter, fit, experiments, [np.zeros(60, bool)], 3, seed_sequence(2))
    assert len(none.square) == 0


def test_what_lies_behind_the_rows_that_count_does_not_count():
    fitter, fit, experiments = fitted(walk(), walks(60, 1, "behind"), {"q": Q, "r": R})
    rows = np.arange(60)
    found = look_ahead(fitter, fit, experiments, [(rows >= 30) & (rows < 50)], 12, seed_sequence(2))
    assert len(found.at(1).square) == 20  # from rows 29 to 48 on
    assert len(found.at(10).square) == 11  # from rows 29 to 39 on


def test_simulations_begin_when_the_filter_knows_the_state(monkeypatch):
    fitter, fit, experiments = fitted(walk(), walks(200, 1, "settled"), {"q": Q, "r": R})
    asked, simulate = [], module.samples_ahead

    def watched(*args):
        asked.append(args[7])
        return simulate(*args)

    monkeypatch.setattr(module, "samples_ahead", watched)
    look_ahead(fitter, fit, experiments, every(experiments), 3, seed_sequence(2))
    assert asked[0][0] == 200 * module.SETTLING
    assert asked[0][-1] == 198


def test_a_simulation_that_goes_astray_is_infinitely_far_off():
    samples = np.zeros((2, 1, 1, 4))
    samples[0, 0, 0, 1] = np.inf
    square, density = module._compared(samples, np.ones((2, 1, 1)), np.ones(1))
    assert square[:, 0, 0].tolist() == [np.inf, 1.0]
    assert density[0, 0] == -np.inf
    samples[1] = np.nan  # was not simulated
    square, density = module._compared(samples, np.ones((2, 1, 1)), np.ones(1))
    assert np.isnan(square[1, 0, 0])
    assert np.isnan(density[1, 0])


def test_the_gain_counts_one_in_so_many_rows():
    window = [1.0, 1.0]  # of no weight
    before = np.array([[1.0, 4.0], [2.0, np.nan], window])
    gain = SimulationGain((3, 10), 9, np.array([90, 60]), before, seed_sequence(1), 60)
    assert gain.gain(before) == 0.0
    after = np.array([[0.5, 4.0], [2.0, np.nan], window])
    assert gain.gain(after) == pytest.approx(90 / 6 * np.log(2))
    after = np.array([[1.0, 4.0], [1.0, np.nan], window])
    assert gain.gain(after) == pytest.approx(90 / 20 * np.log(2))
    assert replace(gain, origins=8).gain(after) == pytest.approx(8 / 2 * np.log(2))
    astray = np.full((3, 2), np.inf)
    largest = np.log(module.LARGEST_RATIO)
    assert gain.gain(astray) == pytest.approx(-(150 / 6 + 90 / 20) * largest)
    nothing = SimulationGain((), 1, np.array([4]), np.ones((1, 1)), seed_sequence(1), 60)
    assert nothing.gain(np.full((1, 1), 0.1)) == 0.0


# -- fits for simulation
def spring():
    model = ssm.Model("spring", inputs=("u",))
    model.prior(
        lambda: {
            "k": ssm.LogNormal(np.log(4.0), sd=1.0), "c": ssm.LogNormal(np.log(0.5), sd=1.0),
            "q": ssm.LogNormal(np.log(0.05), sd=2.0), "r": ssm.LogNormal(np.log(0.02), sd=1.0),
        }
    )  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=0.3), "v": ssm.Normal(0, sd=0.3)})

    @model.transition
    def transition(x, v, u, k, c, q):
        return {"x": ssm.Dirac(x + 0.1 * v), "v": ssm.Normal(v + 0.1 * (u - k * x - c * v), sd=q)}

    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


def hardening(rows, *name):
    """A spring with a cubic term, and next to no noise but in the readings."""
    rng = np.random.default_rng(seed_of("simulation", *name))
    u = 4.0 * np.sin(np.cumsum(0.2 + 0.3 * rng.random(rows)))
    x, v, y = 0.0, 0.0, np.empty(rows)
    for t in range(rows):
        y[t] = x + 0.004 * rng.standard_normal()
        x, v = x + 0.1 * v, v + 0.1 * (u[t] - 3.0 * x - 2.0 * x**3 - 1.2 * v)
    return {"u": u, "y": y}


def cubic(augmented):
    (effect,) = effects.get("cubic stiffness")
    return augmented.fitter((Candidate(effect, "v", bound=(("x", "x"),)),))


@pytest.fixture(scope="module")
def spring_fit():
    problem = pose(spring(), hardening(500, "spring"))
    augmented = AugmentedModels(
        problem.trace, missing_of(problem.experiments), {}, Settings(100, "twisted")
    )
    fit = augmented.base_fitter.fit(problem.experiments, seed_sequence(1), {})
    return augmented, fit, problem.experiments


def test_the_fit_for_simulation_errs_less_where_noise_has_grown(spring_fit):
    """The likelihood takes process noise for the cubic term; without it the spring is stiffer."""
    augmented, fit, train = spring_fit
    assert fit.by_component["q"] > 0.01  # there is none
    gain, best = gain_of_base(augmented.base_fitter, fit, train, seed_sequence(3))
    assert best.share < 1.0
    # The noises are fitted to the other parameters, so that the filter follows the data.
    assert best.fit.log_likelihood > fit.log_likelihood - 200.0
    assert best.fit.by_component["k"] > fit.by_component["k"]
    plain, own = (gain.mean_squares(*m, train) for m in ((augmented.base_fitter, fit), best.model))
    assert np.all(own[-1] < 0.9 * plain[-1])
    assert gain.gain(gain.before) == 0.0
    assert max(gain.gain(plain), gain.gain(own)) <= 0.0
    fresh = pose(spring(), hardening(500, "fresh")).experiments
    last = [
        look_ahead(*m, fresh, every(fresh), 60, seed_sequence(4)).window(60).rmse
        for m in ((augmented.base_fitter, fit), best.model)
    ]
    assert last[1] < last[0]


def test_a_model_that_is_right_keeps_its_fit():
    data = {"y": walks(400, 1, "right")[0]["y"]}
    problem = pose(walk(), data)
    augmented = AugmentedModels(
        problem.trace, missing_of(problem.experiments), {}, Settings(100, "twisted")
    )
    fitter = augmented.base_fitter
    fit = fitter.fit(problem.experiments, seed_sequence(1), {})
    gain, best = gain_of_base(fitter, fit, problem.experiments, seed_sequence(3))
    assert gain.horizons == (3, 10, 30)
    assert gain.gain(best.squares) == 0.0
    plain, own = (gain.mean_squares(*m, problem.experiments) for m in ((fitter, fit), best.model))
    assert own[-1] == pytest.approx(plain[-1], rel=0.1)


def test_a_kept_fit_is_restored(spring_fit):
    augmented, fit, train = spring_fit
    gain, best = gain_of_base(augmented.base_fitter, fit, train, seed_sequence(3))
    again = restored(augmented.base_fitter, fit, train, best.numbers)
    np.testing.assert_array_equal(again.fit.theta, best.fit.theta)
    assert (again.share, again.fit.log_likelihood) == (best.share, best.fit.log_likelihood)
    at = [gain.mean_squares(*m.model, train) for m in (again, best)]
    np.testing.assert_array_equal(*at)


def test_the_share_that_gains_most_ranks_and_the_one_with_the_least_error_simulates(
    spring_fit, monkeypatch
):
    augmented, fit, train = spring_fit
    gain, _ = gain_of_base(augmented.base_fitter, fit, train, seed_sequence(3))
    gain = replace(gain, before=np.ones_like(gain.before))
    count = len(gain.horizons)
    found = iter([np.full((count + 1, 1), 1.0), np.r_[np.full((count, 1), 0.5), [[0.99]]],
                  np.r_[np.full((count, 1), 2.0), [[0.5]]]])  # fmt: skip
    monkeypatch.setattr(SimulationGain, "mean_squares", lambda *_: next(found))
    best = fit_for_simulation(augmented.base_fitter, fit, train, gain)
    assert best.share == simulation_fit.SHARES[1]
    assert np.all(best.squares[:-1] == 0.5)


def test_only_what_scales_the_noise_is_held(spring_fit):
    augmented, _, _ = spring_fit
    assert simulation_fit.process_noises(augmented.base_fitter) == ["q"]
    model = ssm.Model("walk whose mean depends on its noise")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1.0)})
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x, q: {"x": ssm.Normal((1 - q) * x, sd=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.1)})
    problem = pose(model, {"y": np.arange(20.0)})
    other = AugmentedModels(problem.trace, missing_of(problem.experiments), {}, Settings())
    assert simulation_fit.process_noises(other.base_fitter) == []


def test_a_fault_of_a_fit_leaves_the_one_of_the_likelihood(spring_fit, monkeypatch):
    augmented, fit, train = spring_fit
    gain, _ = gain_of_base(augmented.base_fitter, fit, train, seed_sequence(3))

    def failing(*_, **__):
        raise ssm.errors.SamplingError("the filter failed", fix="")

    monkeypatch.setattr(type(augmented.base_fitter), "fit", failing)
    found = fit_for_simulation(augmented.base_fitter, fit, train, gain)
    assert found.share == 1.0
    assert found.fit is fit


# -- the table
def test_horizons_go_by_the_rows_that_are_held_out():
    experiments = pose(walk(), walks(300, 1, "table")).experiments
    held = [np.arange(300) >= 210]
    assert [str(h) for h in horizons(experiments, held)] == ["1", "3", "10", "30", "1 to 30"]
    assert [str(h) for h in horizons(experiments, held, 45)][-1] == "1 to 45"
    assert [str(h) for h in horizons(experiments, held, 400)][-1] == "1 to 90"
    assert horizons(experiments, [np.zeros(300, bool)]) == []


def test_the_table_holds_errors_and_the_share_that_is_gone_with_its_interval(spring_fit):
    augmented, fit, train = spring_fit
    fitter = cubic(augmented)
    with_cubic = fitter.fit(train, seed_sequence(1), dict(fit.by_parameter))
    held = [np.arange(500) >= 300]
    which = horizons(train, held)
    found = compared(
        (augmented.base_fitter, fit), (fitter, with_cubic), train, held, which, seed_sequence(5)
    )
    rows = {r["horizon"]: r for r in table_rows("cubic", which, found, 200)}
    assert set(rows) == {"1", "3", "10", "30", "1 to 50"} | ({"100"} & set(rows))
    window = rows["1 to 50"]
    assert window["share"] == pytest.approx(1 - window["rmse_after"] / window["rmse_before"])
    assert 0.5 < window["low"] <= window["share"] <= window["high"] <= 1.0
    assert window["nats_per_sample"] > 0.0
    assert window["rmse_after"] < 0.01


def test_the_interval_covers_the_share_of_independent_origins():
    rng = np.random.default_rng(seed_of("interval of the share"))
    covered, sets = 0, 400
    for _ in range(sets):
        both = np.stack([rng.standard_normal(60), 0.6 * rng.standard_normal(60)], axis=1) ** 2
        values = np.hstack([both, np.zeros((60, 1))])
        (row,) = table_rows("x", [Horizon(1)], [values], None)
        covered += row["low"] <= 0.4 <= row["high"]
    # 0.95, less what sixty origins and percentiles cost.
    assert covered / sets > 0.9
    assert table_rows("x", [Horizon(1)], [values[:3]], None) == []


def test_origins_that_are_off_together_are_resampled_together():
    """Blocks of ten equal pairs: their mean is known as by six, and not as by sixty."""
    rng = np.random.default_rng(seed_of("blocks of origins"))
    each = np.stack([rng.standard_normal(6), 0.6 * rng.standard_normal(6)], axis=1) ** 2
    values = np.hstack([np.repeat(each, 10, axis=0), np.zeros((60, 1))])
    widths = []
    for rows in (6000, 60):  # the horizon of ten rows reaches over no origin, and over ten
        (row,) = table_rows("x", [Horizon(10)], [values], rows)
        widths.append(row["high"] - row["low"])
    assert widths[1] > 1.7 * widths[0]
