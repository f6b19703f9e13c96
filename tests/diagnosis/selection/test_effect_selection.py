"""Which candidates are refitted, how refits are ranked and tested, and which base they stand on."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssmppl.diagnosis.effects import catalogue_sensor as ssm_effects
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue import effects
from ssmppl.diagnosis.effects.effect import CAUSES
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.model.scales import Scales, VariableScale
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.familywise import familywise, tail_p
from ssmppl.diagnosis.screening.screen import ScreenDesign, run_screen
from ssmppl.diagnosis.selection import effect_selection as module
from ssmppl.diagnosis.selection import refit as refits_of
from ssmppl.diagnosis.selection.effect_selection import EffectSelection, SelectionResult
from ssmppl.diagnosis.selection.equivalence import _of_the_best
from ssmppl.diagnosis.selection.horizons import SimulationGain
from ssmppl.diagnosis.selection.refit import (
    Refit,
    best_of_groups,
    correlated_candidates,
    delays,
    leading,
    one_signed_candidates,
    other_noise_laws,
    preferred,
)
from ssmppl.diagnosis.selection.refit_test import GainTest, gain_p
from ssmppl.errors import ArgumentError
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.small import level, levels
from tests.statistics.checks import seed_of


# -- which
def screen_of(heights, rho, kinds=""):
    """A screen with one column for each group. kinds : the first letters of their kinds."""
    heights, count = np.asarray(heights, float), len(heights)
    names = {"m": "mechanism", "c": "change in time", "u": "unknown input", "n": "noise law"}
    causes = [SimpleNamespace(effect=SimpleNamespace(cause=names[k])) for k in kinds or "m" * count]
    return SimpleNamespace(
        design=SimpleNamespace(candidates=causes),
        family=SimpleNamespace(leaders=np.argsort(-heights, kind="stable").tolist()),
        efficient=SimpleNamespace(gain=0.5 * heights**2, status=("",) * count, rho=np.asarray(rho)),
        groups=np.arange(count),
    )


def test_what_is_almost_the_same_as_one_above_it_waits():
    rho = np.eye(7)
    rho[0, 1] = rho[1, 0] = 0.99
    rho[2, 4] = rho[4, 2] = -0.97
    found = leading(screen_of([9.0, 8.9, 7.0, 6.0, 5.0, 4.0, 1.2], rho))
    assert found == [0, 2, 3, 5]  # the last promises less than a nat


def test_a_cause_has_a_place_beside_a_change_in_time_that_is_almost_the_same():
    """A loss that grows stands behind a drift of a parameter with which it correlates."""
    rho = np.eye(3)
    rho[0, 1] = rho[1, 0] = 0.99
    assert leading(screen_of([9.0, 8.0, 7.0], rho, "cmm")) == [0, 1, 2]
    assert leading(screen_of([9.0, 8.0, 7.0], rho, "ccm")) == [0, 2]
    assert leading(screen_of([9.0, 8.0, 7.0], rho, "mcm")) == [0, 2]


@pytest.mark.parametrize(
    ("kinds", "found"),
    [
        ("cccccmmm", [0, 1, 5, 6, 7]),
        ("cuccunnmm", [0, 1, 2, 7, 8]),
        ("nnnummmm", [0, 3, 4, 5, 6]),
        ("cccnnm", [0, 1, 2, 3, 5]),  # too few causes: what waited fills up, the highest first
        ("mmmmmmc", [0, 1, 2, 3, 4]),
    ],
)
def test_places_are_kept_for_causes(kinds, found):
    heights = 9.0 - 0.5 * np.arange(len(kinds))
    assert leading(screen_of(heights, np.eye(len(kinds)), kinds)) == found


def test_what_is_like_the_best_refit_comes_next():
    rho = np.eye(6)
    for k, r in {1: 0.99, 2: -0.85, 3: 0.5, 4: 0.9}.items():
        rho[0, k] = rho[k, 0] = r
    screen = screen_of([5.0, 5.0, 4.0, 6.0, 3.0, 5.0], rho)
    done = [SimpleNamespace(index=(0,)), SimpleNamespace(index=(4,))]
    assert correlated_candidates(screen, done) == [1, 2]
    assert correlated_candidates(screen, []) == []


def test_a_choice_among_shapes_costs():
    """A date among hundreds gains nats by that alone: less is enough for one that had no choice."""
    dated = Refit((0,), (), None, None, gain=10.6, cost=np.log(300.0))
    plain = Refit((1,), (), None, None, gain=9.0, cost=0.0)
    assert plain.penalised_gain > dated.penalised_gain
    assert dated.penalised_gain == pytest.approx(10.6 - np.log(300.0))


def test_what_the_fit_cannot_show_is_fitted_anew():
    """A fold of a channel that is never below 0; not of one that is, and of no other effect."""
    fold = ssm_effects.sensor_rectification
    bound = [Candidate(fold, "y", role="channel"), Candidate(fold, "z", role="channel"),
             Candidate(fold, "noisy", role="channel"),
             Candidate(ssm_effects.sensor_bias, "y", role="channel"),
             Candidate(replace(fold), "gain", role="parameter")]  # fmt: skip
    values = np.linspace(0.1, 3.0, 50)
    scale = {
        "y": VariableScale.of(values),
        "z": VariableScale.of(values - 1.0),
        "noisy": VariableScale.of(values - 0.3),
    }
    screen = SimpleNamespace(
        family=SimpleNamespace(leaders=[3, 1, 4, 2, 0]),
        design=SimpleNamespace(candidates=bound, scales=Scales(scale, 50)),
    )
    assert one_signed_candidates(screen) == [4, 2, 0]


# -- tested
def test_the_p_of_a_gain_is_that_of_a_score_as_large():
    rng = np.random.default_rng(seed_of("gain p"))
    groups = np.repeat([0, 1], [1, 200])
    null = rng.standard_normal((200, 201))
    family = familywise(np.zeros(201), null, groups=groups)
    screen = SimpleNamespace(family=family, groups=groups)

    def p(column, gain):
        return gain_p(screen, SimpleNamespace(index=(column,), gain=gain))

    for column, label in ((0, 0), (5, 1)):
        assert p(column, 12.0) == tail_p(family.put(label, np.sqrt(24.0)), family.maxima)
    gains = [p(0, g) for g in (-3.0, 0.0, 2.0, 5.0, 9.0, 20.0, 300.0)]
    assert gains == sorted(gains, reverse=True)
    assert gains[0] == 1.0
    assert gains[-1] < 1e-6
    assert p(0, 8.0) < 0.1 * p(5, 8.0)


# -- fitted
@pytest.fixture(scope="module")
def asked():
    """The screen of a random walk that is right, at its fit."""
    problem = pose(level(), levels(120, 0.0, "right"))
    missing = missing_of(problem.experiments)
    augmented = AugmentedModels(problem.trace, missing, {}, Settings())
    fitter = augmented.base_fitter
    fit = fitter.fit(problem.experiments, seed_sequence(1), {})
    e = problem.experiments[0]
    states = fitter.states(e, fit.theta, np.ones(4, np.uint64))
    scales = Scales.of(problem.trace, states, e.y, e.u, e.steps)
    design = ScreenDesign(problem.trace, scales, missing, (), Settings(),
                        ["constant load", "outliers", "level break"])  # fmt: skip
    screen = run_screen(design, problem.experiments, fit.theta, 100, seed_sequence(2),
                 Checkpoint(None, {}))  # fmt: skip
    return augmented, fit, screen


def lower(augmented, fit):
    """The same fit, stopped at another place, some nats below."""
    fitter, theta = augmented.base_fitter, fit.theta * np.array([6.0, 0.7])
    experiments = fit.problem.experiments
    value = fitter.kalman.log_likelihood(experiments, theta)
    assert value < fit.log_likelihood - 5.0
    numbers = fit.numbers | {"theta": theta, "log_likelihood": np.asarray(value)}
    return fitter.restored(experiments, numbers)


@pytest.mark.slow
def test_a_fit_that_lost_its_way_is_no_refit(asked, monkeypatch):
    """A model with an effect holds the model without it: what ends far below is not ranked."""
    augmented, fit, screen = asked
    made = refits_of.refit

    def lost(*args):
        found = made(*args)
        value = found.fit.log_likelihood - 40.0
        return replace(found, fit=replace(found.fit, log_likelihood=value))

    own = [[leading(screen)[0]]]
    given = (augmented, fit, screen, own, screen.experiments, seed_sequence(3))
    done, reasons = refits_of.refit_all(*given, Checkpoint(None, {}), "refitting")
    assert [len(done), reasons] == [1, []]
    monkeypatch.setattr(refits_of, "refit", lost)
    done, reasons = refits_of.refit_all(*given, Checkpoint(None, {}), "refitting")
    assert done == []
    assert "nats below the nested base model" in reasons[0]


@pytest.mark.slow
def test_a_better_place_for_the_parameters_is_no_effect(asked):
    """A base fit that stopped too early makes every effect gain; the model is fitted again from
    where the best of them ended, and the gains shrink by what that gives."""
    augmented, fit, screen = asked
    bad, kept = lower(augmented, fit), Checkpoint(None, {})
    done, _ = refits_of.refit_all(
        augmented, bad, screen, [[k] for k in leading(screen)], screen.experiments,
        seed_sequence(3), kept, "refitting",
    )  # fmt: skip
    out = SelectionResult(bad, list(done))
    assert out.refits[0].gain > 5.0
    EffectSelection(
        augmented, screen, screen.experiments, seed_sequence(4), 0.05, kept
    )._refit_base(out)
    assert out.base.log_likelihood == pytest.approx(fit.log_likelihood, abs=0.05)
    shift = fit.log_likelihood - bad.log_likelihood
    for before, after in zip(done, out.refits, strict=True):
        assert after.gain == pytest.approx(before.gain - shift, abs=0.05)


@pytest.mark.slow
def test_a_right_model_is_not_accused_by_a_bad_start(asked):
    augmented, fit, screen = asked
    out = SelectionResult(lower(augmented, fit))
    kept = Checkpoint(None, {})
    EffectSelection(augmented, screen, screen.experiments, seed_sequence(5), 0.05, kept).run(out)
    assert out.chosen is None
    assert out.base.log_likelihood == pytest.approx(fit.log_likelihood, abs=0.05)


@pytest.mark.slow
def test_a_shape_that_was_sharpened_stands_for_its_group(asked):
    """What is projected out of the basis: a wave whose period no screen has, among others."""
    _, _, screen = asked
    load = next(c for c in screen.design.candidates if c.effect.name == "constant load")
    columns, seen = screen.columns_of([load])
    assert columns.shape == (screen.sets, 1)
    k = screen.design.candidates.index(load)
    np.testing.assert_array_equal(columns[:, 0], screen.simulated.candidate_scores[:, k])
    assert seen[0] == screen.observed.candidate_scores[k]
    jump = next(c for c in screen.design.candidates if c.effect.name == "level break")
    other = replace(jump, shape=(("date", 17.3),))
    found, _ = screen.columns_of([other])
    best = next(int(j) for j in screen.family.best
                if screen.design.candidates[j].group == jump.group)  # fmt: skip
    np.testing.assert_array_equal(found[:, 0], screen.simulated.candidate_scores[:, best])


# -- shapes that are whole numbers, and effects that fail
def refit_at(k, penalised_gain):
    return Refit((k,), (), None, None, gain=penalised_gain)


NO_SITES = SimpleNamespace(parameters={}, initial={}, transition={}, observations={})


def delayed_screen():
    """Columns 0 to 2 are the delays of one effect, 3 is an effect without, 4 and 5 another's."""
    delayed = SimpleNamespace(effect=SimpleNamespace(states={"past": "delay"}, profile=""))
    plain = SimpleNamespace(effect=SimpleNamespace(states={"held": None}, profile=""))
    return SimpleNamespace(
        design=SimpleNamespace(candidates=[delayed] * 3 + [plain] + [delayed] * 2, trace=NO_SITES),
        groups=np.array([7, 7, 7, 3, 8, 8]),
        efficient=SimpleNamespace(status=["", "", "too little", "", "", ""]),
    )


def test_dates_next_to_that_of_a_break_near_the_best_are_refitted(monkeypatch):
    def dated(day, profile="step"):
        return SimpleNamespace(
            effect=SimpleNamespace(states={}, profile=profile), shape=(("date", float(day)),)
        )

    days = [3, 9, 10, 11, 12, 13, 14, 15, 40]
    screen = SimpleNamespace(
        design=SimpleNamespace(
            candidates=[dated(d) for d in days] + [dated(12, "pulse")], trace=NO_SITES
        ),
        groups=np.array([1] * 9 + [2]),
        efficient=SimpleNamespace(status=["", "", "", "too little"] + [""] * 6),
    )
    found = delays(screen, [refit_at(4, 10.0)])
    assert sorted(days[k] for k in found) == [3, 9, 10, 13, 14, 15]
    assert delays(screen, [refit_at(0, 100.0), refit_at(4, 10.0)])[:1] == [1]
    monkeypatch.setattr("ssmppl.diagnosis.selection.refit.simulators", lambda trace: ("arm",))
    assert delays(screen, [refit_at(4, 10.0)]) == [], "each would call the simulator for long"


def test_other_delays_of_those_near_the_best_are_refitted():
    screen = delayed_screen()
    assert delays(screen, [refit_at(3, 40.0), refit_at(0, 30.0), refit_at(4, 10.0)]) == [1]
    assert delays(screen, [refit_at(0, 30.0), refit_at(4, 10.0)]) == [1, 5]
    assert delays(screen, []) == []


def test_of_refits_that_differ_in_their_shape_the_best_stands():
    screen = delayed_screen()
    found = best_of_groups(screen, [refit_at(k, m) for k, m in ((0, 5.0), (3, 7.0), (1, 9.0))])
    assert [(r.index[0], r.gain) for r in found] == [(1, 9.0), (3, 7.0)]


@pytest.mark.parametrize(
    ("refitted", "gain", "p", "expected"),
    [
        ((), 0.0, 0.001, 0),
        ((1,), 5.0, 0.001, 0),
        ((1,), 19.0, 0.001, None),  # another one gains more
        ((1,), 5.0, 0.04, None),  # it does not stand out
        ((0, 1), 5.0, 0.001, None),
    ],
)
def test_what_leads_and_could_not_be_refitted(refitted, gain, p, expected):
    screen = screen_of([6.0, 3.0, 0.5], np.eye(3))
    screen.candidate_p = np.array([p, 0.2, 1.0])
    refits = [Refit((k,), (), None, None, gain) for k in refitted]
    assert module._unfitted(screen, refits, 0.025) == expected


@pytest.mark.parametrize("wanted", [1, 2, 3])
def test_selection_in_a_fold_takes_as_many_steps_as_were_taken(monkeypatch, wanted):
    """Where one effect stands for the best, and each step forward adds one."""
    taken = []

    def forward(self, out, most):
        taken.append(most)
        more = most - len(out.chosen.candidates)
        out.chosen = replace(out.chosen, candidates=out.chosen.candidates + (effect,) * more)

    effect = SimpleNamespace(effect=SimpleNamespace(cause="mechanism"), strength="one")
    one = Refit((0,), (effect,), None, None, 9.0)
    monkeypatch.setattr(module, "refit_all", lambda *_, **__: ([one], []))
    monkeypatch.setattr(EffectSelection, "_best_pair", lambda *_: None)
    monkeypatch.setattr(EffectSelection, "_forward", forward)
    screen = screen_of([6.0, 3.0], np.eye(2))
    screen.design.scales, screen.family.maxima = None, np.full(60, 2.0)
    out = SelectionResult(None)
    kept = Checkpoint(None, {})
    EffectSelection(
        None, screen, (), seed_sequence(1), 0.05, kept, always=True, singles=2, most=wanted,
        approximate=True,
    ).run(out)  # fmt: skip
    assert len(out.chosen.candidates) == wanted
    assert taken == {1: [], 2: [2, 2], 3: [2, 3]}[wanted]


@pytest.mark.parametrize(("top", "share"), [(1.1, 1.0), (0.6, 0.5), (0.1, 0.25)])
def test_a_fit_starts_where_the_data_are_likelier(monkeypatch, top, share):
    """The quadratic promises a strength of 1; the likelihood is highest at `top`."""

    def space(_, fixed, start):
        return SimpleNamespace(theta=np.array([start["old"], start["new"]]))

    monkeypatch.setattr(refits_of, "space_of", space)
    fitter = SimpleNamespace(
        exact=False, problem=None, fixed={},
        estimates=lambda _, theta, stream: theta[:, 0] - (theta[:, 1] - top) ** 2,
    )  # fmt: skip
    start = {"old": 3.0, "new": 1.0}
    found = refits_of._backtracked(fitter, start, ["new"], (), seed_sequence(1))
    assert found == {"old": 3.0, "new": share}
    fitter.exact = True
    assert refits_of._backtracked(fitter, start, ["new"], (), seed_sequence(1)) == start


# -- causes and descriptions of a misfit
def refitted(cause, gain, ahead=0.0):
    effect = SimpleNamespace(effect=SimpleNamespace(cause=cause))
    return Refit((0,), (effect,), None, None, gain, 0.0, ahead)


@pytest.mark.parametrize(
    ("refits", "first"),
    [
        ([("mechanism", 617.0, 317.0), ("unknown input", 581.0, 390.0)], 0),  # a servo's friction
        ([("mechanism", 9.0, 0.0), ("unknown input", 40.0, 0.0)], 1),  # it explains too little
        ([("mechanism", 21.0, 0.0), ("unknown input", 40.0, 0.0)], 0),
        ([("mechanism", 21.0, -15.0), ("unknown input", 40.0, 0.0)], 1),  # and nothing further on
        ([("mechanism", 7.0, 0.0), ("unknown input", 12.0, 0.0)], 1),  # it may be chance
        ([("noise law", 50.0, 0.0), ("unknown input", 40.0, 0.0), ("mechanism", 30.0, 0.0)], 2),
        ([("noise law", 50.0, 0.0), ("change in time", 40.0, 0.0)], 1),
        (
            [("change in time", 33.0, 56.0), ("unknown input", 78.0, 72.0)],
            1,
        ),
        ([("mechanism", 20.0, 5.0), ("mechanism", 22.0, 0.0)], 0),  # all horizons together
        ([("unknown input", 20.0, 0.0), ("mechanism", 22.0, 0.0)], 1),
    ],
)
def test_what_describes_a_misfit_comes_behind_a_cause_that_explains_it(refits, first):
    made = [refitted(*r) for r in refits]
    ordered = preferred(made, worth=8.0)
    assert ordered[0] is made[first]
    assert len(ordered) == len(made)


def test_of_equal_refits_the_one_of_the_catalogue_that_comes_first_is_named():
    """A constant load and an offset of the only input are one model: rounding would decide."""
    offset, load = (
        replace(refitted("mechanism", g), index=(k,)) for g, k in ((117.01, 7), (117, 3))
    )
    assert preferred([offset, load], worth=8.0) == [load, offset]
    more = replace(offset, gain=117.6)
    assert preferred([more, load], worth=8.0) == [more, load]
    kinds = np.array(["mechanism"] * 2)
    together = _of_the_best(np.ones((2, 2)), np.array([117.0, 117.01]), np.zeros(2, int), 2,
                            np.ones(2, bool), kinds)  # fmt: skip
    assert together.all()


@pytest.mark.parametrize(
    ("first", "expected"),
    [
        ((0, "noise law"), [2, 3]),  # the best form of each other one; 4 promises nothing
        ((1, "mechanism"), []),
    ],
)
def test_other_laws_of_noises_are_refitted_where_one_gains_most(first, expected):
    """The score of outliers at none promised 8 nats of the 71 that they gained."""
    screen = screen_of([5.0, 4.0, 3.0, 2.5, 0.1, 2.0, 2.2], np.eye(7), "nmnnnnn")
    names = ["growing", "drag", "outliers", "outliers", "memory", "outliers", "growing"]
    places = ["y1", "x", "y1", "y2", "y1", "y1", "y1"]
    for c, name, place in zip(screen.design.candidates, names, places, strict=True):
        c.effect.name, c.equation = name, place
    refits = [
        Refit((k,), (screen.design.candidates[k],), None, None, g)
        for k, g in ((first[0], 9.0), (1 - first[0], 5.0))
    ]
    assert other_noise_laws(screen, refits) == expected


def test_other_laws_of_noises_are_among_the_single_refits(monkeypatch):
    """The screen has the growing variance first; outliers, behind it, gain far more."""
    screen = screen_of([5.0, 3.0], np.eye(2), "nn")
    for c, name in zip(screen.design.candidates, ["growing", "outliers"], strict=True):
        c.effect.name, c.equation = name, "y1"
    gains = {0: 24.0, 1: 71.0}

    def fitted(augmented, base, screen, sets, *_, **__):
        ones = [(k, screen.design.candidates[k]) for (k,) in sets]
        return [Refit((k,), (c,), None, None, gains[k]) for k, c in ones], []

    monkeypatch.setattr(module, "refit_all", fitted)
    monkeypatch.setattr(module, "leading", lambda screen: [0])
    for name in ("correlated_candidates", "delays"):
        monkeypatch.setattr(module, name, lambda screen, refits: [])
    monkeypatch.setattr(module, "one_signed_candidates", lambda screen: [])
    monkeypatch.setattr(EffectSelection, "_delayed", lambda *_: [])
    monkeypatch.setattr(EffectSelection, "_overlooked", lambda *_: [])
    out = SelectionResult(None)
    EffectSelection(None, screen, (), seed_sequence(1), 0.05, Checkpoint(None, {}))._refit_singles(
        out
    )
    assert [r.index for r in out.refits] == [(1,), (0,)]


@pytest.mark.parametrize(
    ("cause", "gain", "ahead", "expected"),
    [
        ("mechanism", 20.0, 0.0, True),
        ("mechanism", 20.0, -5.0, True),
        ("mechanism", 20.0, -10.0, False),
        ("mechanism", 266.0, -3.0, False),  # a delay beside a cubic spring
        ("mechanism", 266.0, 60.0, True),
        ("noise law", 20.0, -1.0, True),
        ("change in time", 20.0, 1.0, False),  # a jump in one row gains there alone
        ("change in time", 20.0, 3.0, True),
        ("noise law", 20.0, -2.0, False),
        ("noise law", 100.0, -67.0, False),  # as on a servo: simulations a third further off
        ("unknown input", 100.0, 3.0, True),
    ],
)
def test_a_further_effect_does_not_ruin_simulations(cause, gain, ahead, expected):
    r = refitted(cause, gain, ahead)
    assert module._simulates(r, r.candidates, worth=8.0) is expected


def test_every_effect_says_what_naming_it_means():
    found = {(e.name, e.form): e.cause for e in effects}
    assert set(found.values()) == set(CAUSES)
    for name in ("coulomb friction", "sensor lag", "input delay", "coarse discretisation"):
        assert {c for (n, _), c in found.items() if n == name} == {"mechanism"}
    for name in ("parameter break", "parameter drift", "sensor drift", "level break",
                 "wrong initial state", "periodic forcing"):  # fmt: skip
        assert {c for (n, _), c in found.items() if n == name} == {"change in time"}
    for name in ("missing input", "parameter random walk"):
        assert {c for (n, _), c in found.items() if n == name} == {"unknown input"}
    for name in ("outliers", "heteroscedastic noise", "coloured noise"):
        assert {c for (n, _), c in found.items() if n == name} == {"noise law"}


def test_p_of_every_refit_is_kept_where_none_stands_out(monkeypatch):
    """A break of 10 nats among many dates had p = 1 in the table, that of its score alone."""
    monkeypatch.setattr(module, "gain_p", lambda screen, r: {0: 0.614, 1: 0.9}[r.index[0]])
    out = SelectionResult(
        None, refits=[replace(refitted("mechanism", 9.0), index=(k,)) for k in (0, 1)]
    )
    choice = EffectSelection(None, None, (), seed_sequence(1), 0.05, Checkpoint(None, {}))
    assert choice._by_refit(out, 0.025) is False
    assert out.p == {0: 0.614, 1: 0.9}


@pytest.mark.parametrize(("simulated", "found"), [(np.linspace(0, 8, 99), True), ([10.0], False)])
def test_what_gained_most_in_the_test_is_refitted(monkeypatch, simulated, found):
    """The test looks at more candidates of a kind than are refitted to begin with: what it finds
    was never named, and its p was that of another one."""
    monkeypatch.setattr(module, "gain_p", lambda screen, r: 0.1)
    monkeypatch.setattr(module, "affordable", lambda *_: True)
    monkeypatch.setattr(module, "one_signed_candidates", lambda _: [])
    test = GainTest(9.0, 2, np.array(simulated), 0.025)
    monkeypatch.setattr(module, "gain_test", lambda *_: test)
    asked = []

    def refit_all(augmented, base, screen, sets, *_, **__):
        asked.append(sets)
        return [replace(refitted("change in time", 9.2), index=(2,))], []

    monkeypatch.setattr(module, "refit_all", refit_all)
    monkeypatch.setattr(module, "best_of_groups", lambda screen, refits: refits)
    screen = SimpleNamespace(groups=np.array([0, 0, 1]))
    out = SelectionResult(None, refits=[refitted("mechanism", 6.0)])
    assert choice_of(screen)._by_refit(out, 0.025) is found
    assert asked == [[[2]]] * found
    assert out.p == ({0: test.p_of(6.0), 2: 0.01} if found else {0: 1.0})


@pytest.mark.parametrize(
    ("together", "first"),
    [
        (900.0, "mechanism"),  # 300 of 795 nats are left
        (1100.0, "unknown input"),
        (None, "mechanism"),  # the two could not be refitted
    ],
)
def test_a_cause_comes_first_only_where_it_explains_what_gains_more(monkeypatch, together, first):
    friction = refitted("mechanism", 500.0, 100.0)
    wandering = refitted("unknown input", 595.0, 200.0)
    both = [] if together is None else [refitted("unknown input", together)]
    asked = []

    def refit_all(augmented, base, screen, sets, *_, **__):
        asked.append(sets)
        return both, []

    monkeypatch.setattr(module, "refit_all", refit_all)
    out = SelectionResult(None, refits=[friction, replace(wandering, index=(1,))])
    choice = EffectSelection(None, None, (), seed_sequence(1), 0.05, Checkpoint(None, {}))
    choice._name_what_explains(out)
    assert asked == [[(0, 1)]]
    assert out.refits[0].candidates[0].effect.cause == first
    out.refits = [wandering, friction]  # the one that gains most is first
    choice._name_what_explains(out)
    simulates = refitted("mechanism", 300.0, 250.0)  # better than what gains most
    out.refits = [simulates, wandering]
    choice._name_what_explains(out)
    assert out.refits[0] is simulates
    assert len(asked) == 1


def test_two_causes_come_before_a_cause_and_a_description(monkeypatch):
    """Friction and a load, beside friction and an input that wanders, of a servo."""
    monkeypatch.setattr(module, "critical_gain", lambda *_: 8.0)
    choice = EffectSelection(None, None, (), seed_sequence(1), 0.05, Checkpoint(None, {}))
    load, wandering = refitted("mechanism", 400.0), refitted("unknown input", 600.0)
    assert choice._better(load, wandering) is load
    assert choice._better(refitted("mechanism", 200.0), wandering) is wandering
    one_more = replace(wandering, candidates=wandering.candidates * 2)
    assert choice._better(load, one_more) is one_more


def choice_of(screen=None, **augmented):
    return EffectSelection(
        SimpleNamespace(**augmented), screen, (), seed_sequence(1), 0.05, Checkpoint(None, {})
    )


@pytest.mark.parametrize(
    ("promised", "ahead", "taken", "told"),
    [
        (20.0, 96.0, True, 0), (20.0, 80.0, False, 0), (20.0, 130.0, True, 0),
        (20.0, 94.0, False, 1), (3.8, 130.0, True, 0), (3.7, 130.0, None, 0),
    ],
)  # fmt: skip
def test_a_step_forward_counts_what_it_adds(monkeypatch, promised, ahead, taken, told):
    """Refits beside those chosen tell what all of them gain many rows ahead; less than a tenth of
    that is what the formula of the first may be off by. What promises a quarter of a tenth is
    refitted."""
    effect = SimpleNamespace(effect=SimpleNamespace(cause="mechanism"), key="new")
    chosen = replace(
        refitted("mechanism", 50.0, 100.0), fitter=SimpleNamespace(exact=True), candidates=(effect,)
    )
    more = replace(refitted("mechanism", 20.0, ahead), candidates=(effect, effect))
    again = SimpleNamespace(
        family=SimpleNamespace(p=np.array([0.001])), design=SimpleNamespace(candidates=[effect]),
        efficient=SimpleNamespace(gain=np.array([promised])),
    )  # fmt: skip
    monkeypatch.setattr(module, "_others", lambda *_: [effect])
    monkeypatch.setattr(module, "leading", lambda *_: [0])
    monkeypatch.setattr(module, "critical_gain", lambda *_: 8.0)
    monkeypatch.setattr(module, "refit_all", lambda *_, **__: ([more], ["it failed"]))
    monkeypatch.setattr(EffectSelection, "_screen_again", lambda *_: again)
    screen = SimpleNamespace(design=SimpleNamespace(candidates=[effect]))
    out = SelectionResult(None, chosen=chosen)
    choice_of(screen, settings=SimpleNamespace(particles=1))._forward(out, 2)
    assert (len(out.chosen.candidates) == 2) is bool(taken)
    assert out.notes[:1] == ["not refitted: it failed"] * (taken is not None)
    assert ["gains 20.0 nats in addition to" in n for n in out.notes[1:]] == [True] * told
    if taken:
        assert (out.chosen.gain, out.chosen.ahead) == (70.0, ahead)


@pytest.mark.parametrize(
    ("gain", "ahead", "taken"),
    [(80.0, 90.0, False), (80.0, 110.0, True), (60.0, 104.0, False), (60.0, 106.0, True)],
)
def test_a_pair_counts_what_it_adds_to_the_single_effect(monkeypatch, gain, ahead, taken):
    single, pair = refitted("mechanism", 50.0, 100.0), refitted("mechanism", gain, ahead)
    monkeypatch.setattr(module, "pairs", lambda *_: [(0, 1)])
    monkeypatch.setattr(module, "critical_gain", lambda *_: 8.0)
    monkeypatch.setattr(module, "refit_all", lambda *_, **__: ([pair], []))
    out = SelectionResult(None, refits=[single])
    assert choice_of()._best_pair(out) is (pair if taken else None)


def test_what_a_better_place_for_the_model_simulates_is_no_gain_of_an_effect(monkeypatch):
    def gain(before):
        return SimulationGain((3,), 5, np.array([60]), np.array(before), seed_sequence(1), 60)

    place = SimpleNamespace(log_likelihood=10.0, error=0.0)
    fitter = SimpleNamespace(
        fit=lambda *_: SimpleNamespace(numbers={"theta": np.zeros(1)}), restored=lambda *_: place
    )
    monkeypatch.setattr(module, "critical_gain", lambda *_: 8.0)
    better = gain([[0.5], [1.0]])
    monkeypatch.setattr(EffectSelection, "_simulation", lambda *_: (better, None))
    one = replace(refitted("mechanism", 30.0, 40.0), fit=SimpleNamespace(by_parameter={}))
    base = SimpleNamespace(log_likelihood=0.0, error=0.0)
    out = SelectionResult(base, refits=[one], simulation=gain([[1.0], [1.0]]))
    choice_of(base_fitter=fitter, trace=SimpleNamespace(parameters={}))._refit_base(out)
    assert out.rebased
    assert out.refits[0].gain == 20.0
    assert out.refits[0].ahead == pytest.approx(40.0 - 60 / 6 * np.log(2))


@pytest.mark.parametrize(
    ("alpha", "least", "too_few", "asked"),
    [
        (0.05, 0.6, False, [30]),  # by the first sets there is nothing
        (0.05, 0.4, False, [30, 60]),  # they do not tell
        (0.05, 0.6, True, [30, 60]),  # they are too few for so many parameters
        (0.2, 0.6, False, [60]),  # so rare a p would be looked at more closely anyhow
    ],
)
def test_a_further_screen_ends_where_nothing_stands_out(monkeypatch, alpha, least, too_few, asked):
    sets_of = []

    def screened(*_, sets, **__):
        sets_of.append(sets)
        if too_few and sets == 30:
            raise ArgumentError("too few sets", fix="more")
        return SimpleNamespace(family=SimpleNamespace(p=np.array([least, 0.9])), sets=sets)

    monkeypatch.setattr(module, "run_screen", screened)
    monkeypatch.setattr(module, "ScreenDesign", lambda *_, **__: None)
    monkeypatch.setattr(module, "simulators", lambda _: [1])
    problem = SimpleNamespace(trace=None)
    fitter = SimpleNamespace(problem=problem, fixed={}, settings=None, initial_law=None)
    chosen = SimpleNamespace(fitter=fitter, fit=SimpleNamespace(bounds=[], theta=None),
                             candidates=(1,))  # fmt: skip
    screen = SimpleNamespace(design=SimpleNamespace(scales=None), sets=100)
    choice = replace(choice_of(screen, trace=None, missing=None), alpha=alpha)
    assert choice._screen_again(chosen, [], None).sets == asked[-1]
    assert sets_of == asked


def test_shapes_of_one_effect_are_ranked_by_all_horizons():
    screen = SimpleNamespace(groups=np.array([0, 0, 1]))
    likely, simulates, other = (
        replace(refitted("mechanism", *v), index=(k,))
        for k, v in enumerate([(10.0, 0.0), (8.0, 20.0), (1.0, 1.0)])
    )
    assert best_of_groups(screen, [likely, simulates, other]) == [simulates, other]


def test_what_was_passed_over_is_no_rival():
    gains, rho = np.array([10.0, 14.0, 9.5]), np.eye(3)
    kinds = np.array(["mechanism"] * 3)
    found = _of_the_best(rho, gains, np.zeros(3, int), 3, np.ones(3, bool), kinds)
    assert found.tolist() == [True, False, True]


def test_formulas_of_a_kind_that_do_nearly_as_well_are_in_one_class():
    """A tenth of what the best gains, which chance alone does not make up for; not those of another
    kind, nor what was not refitted."""
    gains, rho = np.array([100.0, 91.0, 89.0, 95.0, 92.0]), np.eye(5)
    kinds = np.array(["mechanism", "mechanism", "mechanism", "unknown input", "mechanism"])
    found = _of_the_best(rho, gains, np.zeros(5, int), 4, np.ones(5, bool), kinds)
    assert found.tolist() == [True, True, False, False, False]
