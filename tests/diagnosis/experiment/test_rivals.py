"""Expected log-likelihood ratios of rivals, against what theory says of them."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.data import bind
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue_motion import level_break
from ssmppl.diagnosis.experiment import rivals as rivals_module
from ssmppl.diagnosis.experiment.rivals import (
    PLENTY,
    Look,
    Rival,
    has_filter,
    increments,
    look_at,
    observed_range,
    together,
)
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import APPROXIMATELY, Fitter
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.tracing import trace
from tests.statistics.checks import seed_of

ROWS = 150
VALUES = {"a": 0.8, "q": 0.3, "r": 0.2}
STRENGTH = 0.6
SEED = np.random.SeedSequence(seed_of("rivals"))


def lag():
    """A first-order lag that is driven by u."""
    model = ssm.Model("lag", inputs=("u",))
    model.prior(
        lambda: {
            "a": ssm.Uniform(0, 1), "q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=1)
        }
    )  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=0.3)})
    model.transition(lambda x, u, a, q: {"x": ssm.Normal(a * x + u, sd=q)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


@functools.cache
def made():
    """(trace, candidates by name, the recorded experiment)."""
    traced, rng = trace(lag()), np.random.default_rng(seed_of("lag"))
    u = rng.standard_normal(ROWS)
    draws = [rng.standard_normal((ROWS, 1)) for _ in range(2)]
    offered, _ = offers(traced, Scales.of(traced, *draws, u[:, None], ROWS))
    found = {}
    for c in offered:
        found.setdefault(c.effect.name, c)
    (e,) = bind(traced, {"y": np.zeros(ROWS), "u": u})
    return traced, found, e


def rivals_of(*names, fixed=("a", "q", "r")):
    """(models, rivals) with these effects, of which only what is not fixed is fitted."""
    traced, found, _ = made()
    held = {n: np.asarray(VALUES[n]) for n in fixed}
    augmented = AugmentedModels(traced, Missing(none=True), held, Settings(100, "twisted"))
    every = {n: np.asarray(v) for n, v in VALUES.items()}
    own = [Rival((found[n],), every | {found[n].strength: np.asarray(STRENGTH)}) for n in names]
    return augmented, own


def ratios_of(augmented, rivals, look, e=None, seed=SEED, alternatives=None, k=0):
    alternatives = [made()[2] if e is None else e] if alternatives is None else alternatives
    return look_at(augmented, rivals, alternatives, look, seed, k)


def means_by_theory(augmented, rivals, e):
    """(R, R) of a linear Gaussian model with one free strength each: half the squared innovations
    that are left of the data's mean under the truth, with the other's strength at its best."""
    fitters = [r.fitter(augmented) for r in rivals]
    out = np.full((len(rivals),) * 2, np.nan)
    for i, (truth, fitter) in enumerate(zip(rivals, fitters, strict=True)):
        own = theta_of(fitter, truth)
        y = mean_of(augmented, truth, e)
        data = [replace(e, y=y)]
        for j, (rival, other) in enumerate(zip(rivals, fitters, strict=True)):

            def loss(strength, rival=rival, other=other, data=data):
                values = rival.values | {rival.candidates[0].strength: np.asarray(strength)}
                return -other.value(data, theta_of(other, replace(rival, values=values)))

            best = minimize_scalar(loss, bounds=(1e-6, 3.0), method="bounded")
            out[i, j] = fitter.value(data, own) + best.fun
    return out


def theta_of(fitter, rival):
    known = rival.values | fitter.fixed
    return np.array([float(known[s.data[1]]) for s in fitter.problem.trace.parameter_symbols])


def mean_of(augmented, rival, e):
    """(T, 1) the mean of the data: a lag of the input that its effect has bent."""
    u, (c,) = e.u[:, 0], [v for _, v in rival.candidates[0].shape]
    bent = {"input saturation": np.clip(u, -c, c),
            "dead zone": np.sign(u) * np.maximum(np.abs(u) - c, 0.0)}  # fmt: skip
    driven = u + STRENGTH * (bent[rival.candidates[0].effect.name] - u)
    x = np.zeros(len(u))
    for t in range(1, len(u)):
        x[t] = VALUES["a"] * x[t - 1] + driven[t - 1]
    return x[:, None]


@pytest.mark.slow
def test_the_mean_ratio_is_that_of_theory():
    """Saturation and dead zone of an input, all else known: 5% errors of either sign are seen."""
    augmented, rivals = rivals_of("input saturation", "dead zone")
    expected = means_by_theory(augmented, rivals, made()[2])
    assert np.nanmin(expected[~np.eye(2, dtype=bool)]) > 1.0
    found = ratios_of(augmented, rivals, Look(400, True))["ratios"]
    mean, error = found.mean(axis=0), found.std(axis=0) / np.sqrt(len(found))
    for i, j in ((0, 1), (1, 0)):
        assert abs(mean[i, j] - expected[i, j]) < 4.0 * error[i, j]
        # and of variance 2 m, by which the needed ratio is reckoned
        assert found[:, i, j].var() == pytest.approx(2.0 * expected[i, j], rel=0.5)
    assert np.isnan(mean[0, 0])
    assert np.isnan(mean[1, 1])


@pytest.mark.slow
def test_a_rival_is_not_told_from_itself():
    """Nothing is left on average, whatever number of parameters is fitted."""
    augmented, (rival,) = rivals_of("input saturation", fixed=())
    found = ratios_of(augmented, [rival, rival], Look(150, True))["ratios"]
    for mean, error in (
        (found[:, i, j].mean(), found[:, i, j].std() / np.sqrt(len(found)))
        for i, j in ((0, 1), (1, 0))
    ):
        assert abs(mean) < 4.0 * error + 0.15  # a prior and a bound at zero are felt a little
        assert error < 0.25  # half a nat for each of four numbers is far beyond that


@pytest.mark.slow
def test_a_fit_to_the_data_is_at_its_top():
    """As that of a fit of its own, from the same start; and as they are gives a bound."""
    augmented, rivals = rivals_of("input saturation", "dead zone", fixed=())
    fitted = ratios_of(augmented, rivals, Look(1, True))["ratios"][0]
    as_it_is = ratios_of(augmented, rivals, Look(1, False))["ratios"][0]
    fitters = [r.fitter(augmented) for r in rivals]
    for i, j in ((0, 1), (1, 0)):
        stream = random_state(SEED, 0, i)
        theta = theta_of(fitters[i], rivals[i])
        data = fitters[i].simulator.sets([made()[2]], theta, stream)
        fit = fitters[j].fit(data, SEED, rivals[j].values, APPROXIMATELY)
        own = fitters[i].value(data, theta)
        assert fitted[i, j] == pytest.approx(own - fit.log_likelihood + 0.5 * 4, abs=0.1)
        assert as_it_is[i, j] == pytest.approx(own - fitters[j].value(data, theta_of(
            fitters[j], rivals[j])))  # fmt: skip
        assert fitted[i, j] - 0.5 * 4 < as_it_is[i, j]


@pytest.mark.slow
def test_what_ran_to_a_bound_stays_there():
    """Held values are not fitted, and cost no half nat."""
    augmented, (rival,) = rivals_of("input saturation", fixed=())
    held = replace(rival, held=("q", "r"))
    free = ratios_of(augmented, [rival, rival], Look(1, True))["ratios"][0, 0, 1]
    less = ratios_of(augmented, [held, held], Look(1, True))["ratios"][0, 0, 1]
    fitter = held.fitter(augmented)
    assert {"q", "r"} <= set(fitter.fixed)
    assert less != free
    refit = SimpleNamespace(
        candidates=rival.candidates, bounds=["q", "b[0]"],
        fit=SimpleNamespace(by_parameter={"q": np.asarray(1e-8), "b": np.zeros(2)}),
    )  # fmt: skip
    assert Rival.of(refit).held == ("q",)


def test_truths_apart_give_what_they_give_together():
    """Each is a task: with the same data, of the same alternative."""
    augmented, rivals = rivals_of("input saturation", "dead zone")
    e = made()[2]
    two = [e, replace(e, u=2.0 * e.u)]
    for k in range(2):
        whole = ratios_of(augmented, rivals, Look(2, True), alternatives=two, k=k)
        apart = Look(2, True, apart=True)
        each = [ratios_of(augmented, rivals, apart, alternatives=two, k=2 * k + i)
                for i in range(2)]  # fmt: skip
        assert np.isnan(each[0]["ratios"][:, 1]).all()
        found = together(each)
        assert found.keys() == whole.keys()
        for name, value in whole.items():
            np.testing.assert_array_equal(found[name], value)
    assert together([each[0], {}]) == {}
    outside = [f | {"left": np.array([True, False])} for f in each]
    assert together(outside)["inside"]  # half of them
    outside[0]["left"] = np.array([True, True])
    assert not together(outside)["inside"]


def test_sets_that_leave_the_range_are_told():
    augmented, rivals = rivals_of("input saturation", "dead zone")
    narrow = Look(2, False, (np.array([-1e-3]), np.array([1e-3])))
    assert not ratios_of(augmented, rivals, narrow)["inside"]
    each = [ratios_of(augmented, rivals, replace(narrow, apart=True), k=i) for i in range(2)]
    assert all(f["left"].all() for f in each)
    assert not together(each)["inside"]
    wide = replace(narrow, within=(np.array([-1e3]), np.array([1e3])))
    assert not ratios_of(augmented, rivals, wide)["left"].any()


@pytest.mark.slow
def test_alternatives_have_the_same_noise_and_places_of_their_own():
    augmented, rivals = rivals_of("input saturation", "dead zone")
    e = made()[2]
    twice = [e, replace(e, u=2.0 * e.u), e]
    look = Look(2, False)
    one, other, again = (
        ratios_of(augmented, rivals, look, alternatives=twice, k=k) for k in range(3)
    )
    np.testing.assert_array_equal(one["ratios"], again["ratios"])
    assert np.nanmin(np.abs(one["ratios"] - other["ratios"])) > 0.0
    assert len(np.unique(one["ratios"][:, 0, 1])) == 2
    new = ratios_of(augmented, rivals, look, seed=np.random.SeedSequence(9))
    assert np.nanmin(np.abs(one["ratios"] - new["ratios"])) > 0.0


@pytest.mark.slow
def test_what_leaves_the_range_in_most_sets_has_no_ratios():
    augmented, rivals = rivals_of("input saturation", "dead zone")
    found = ratios_of(augmented, rivals, Look(4, False))
    low, high = found["low"], found["high"]
    assert low < -1.0
    assert high > 1.0
    at_ease = ratios_of(augmented, rivals, Look(4, False, (low - 1e-9, high + 1e-9)))
    assert at_ease["inside"]
    np.testing.assert_array_equal(at_ease["ratios"], found["ratios"])
    for within in ((low - 1e-9, high / 3.0), (low / 3.0, high + 1e-9)):
        left = ratios_of(augmented, rivals, Look(4, False, within))
        assert not left["inside"]
        assert "ratios" not in left
    # one set in eight that leaves it is no reason
    middle = ratios_of(augmented, rivals, Look(4, False, (low + 1e-9, high + 1e-9)))
    assert middle["inside"]


@pytest.mark.slow
def test_of_an_event_no_data_are_drawn():
    augmented, (rival, other) = rivals_of("input saturation", "dead zone")
    once = _Once(rival.candidates, rival.values)
    ratios = ratios_of(augmented, [once, other], Look(2, False))["ratios"]
    assert np.isnan(ratios[:, 0]).all()
    assert np.isfinite(ratios[:, 1, 0]).all()
    assert Rival((Candidate(level_break, "v", (("date", 3.0),)),), {}).happens_once
    assert not rival.happens_once


class _Once(Rival):
    happens_once = True


@pytest.mark.slow
def test_a_rival_without_a_number_has_no_ratio():
    augmented, (rival, other) = rivals_of("input saturation", "dead zone")
    strength = other.candidates[0].strength
    lost = replace(other, values=other.values | {strength: np.asarray(np.nan)})
    ratios = ratios_of(augmented, [rival, lost], Look(1, False))["ratios"][0]
    assert np.isnan(ratios).all()


@pytest.mark.slow
def test_increments_add_up_to_the_likelihood_of_all_experiments():
    augmented, (rival,) = rivals_of("input saturation", fixed=())
    fitter, e = rival.fitter(augmented), made()[2]
    theta = theta_of(fitter, rival)
    data = [replace(e, y=e.u.copy()), e]
    assert has_filter(fitter)
    found, _ = increments(fitter, data, np.stack([theta, 1.01 * theta]))
    assert found.shape == (2, 2 * ROWS)
    assert found[0].sum() == pytest.approx(fitter.value(data, theta))
    assert found[1].sum() != pytest.approx(found[0].sum())
    first, _ = increments(fitter, [data[0]], theta[None])
    np.testing.assert_allclose(first[0], found[0, :ROWS])
    exact = fitter.kalman.filter(data[0], theta).log_increments
    np.testing.assert_allclose(first[0], exact, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("ended", [False, True])
def test_a_climb_that_went_nowhere_is_tried_another_way(monkeypatch, ended):
    """One that did not end, whatever it is for; one that says it did, where rivals seem to be far
    apart, in the first of several sets."""
    augmented, rivals = rivals_of("input saturation", "dead zone", fixed=())
    before = ratios_of(augmented, rivals, Look(2, True))["ratios"]

    def lost(densities, starts, precise):
        away = starts[0] + np.array([0.0, 0.0, 3.0, 0.0])  # r, twenty times as large
        return SimpleNamespace(z=away, ended=ended)

    monkeypatch.setattr(rivals_module, "climb_together", lost)
    after = ratios_of(augmented, rivals, Look(2, True))["ratios"]
    single = ratios_of(augmented, rivals, Look(1, True))["ratios"]
    recovered = after[0] if ended else after
    np.testing.assert_allclose(recovered, before[0] if ended else before, atol=0.1)
    assert np.nanmin(single) > PLENTY if ended else np.nanmax(np.abs(single - before[0])) < 0.1


@pytest.mark.slow
def test_initial_laws_in_place_of_flat_ones_are_corrected_for(monkeypatch):
    """As in the gains of refits: once for each experiment."""
    augmented, (rival,) = rivals_of("input saturation")
    fitter, e = rival.fitter(augmented), made()[2]
    plain = rivals_module._Model.of(rival, fitter).value([e, e])
    monkeypatch.setattr(Fitter, "log_correction", property(lambda self: 1.5))
    corrected = rivals_module._Model.of(rival, fitter).value([e, e])
    assert corrected == pytest.approx(plain + 3.0)
    assert corrected == pytest.approx(fitter.value([e, e], theta_of(fitter, rival)))


def test_the_range_of_what_was_measured():
    y = np.array([[1.0, 0.0], [-2.0, 0.0], [5.0, 0.0]])
    seen = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    e = SimpleNamespace(y=y, seen=seen)
    low, high = observed_range([e, SimpleNamespace(y=y + 3.0, seen=seen)])
    assert (low[0], high[0]) == (-2.0, 4.0)
    assert low[1] == np.inf == -high[1]
    assert PLENTY > 5.4
