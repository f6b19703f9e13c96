"""The report names the effects that were chosen, on their equations and with their strengths."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.heldout.gain_ratio import Gain, HeldOutGain
from ssmppl.diagnosis.heldout.row_split import GAP, head, three_parts
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.report.build import build_report
from ssmppl.diagnosis.report.panels import bars, ranked_effects
from ssmppl.diagnosis.report.text import cause_rows
from ssmppl.diagnosis.report.words import headline, how_far, how_sure, leaders, which
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.screen import ScreenDesign, run_screen
from ssmppl.diagnosis.selection.effect_selection import SelectionResult
from ssmppl.diagnosis.selection.refit import refit, refit_all, start_of
from ssmppl.diagnosis.verdict import decision
from ssmppl.diagnosis.verdict.results import Results, labels
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.diagnosis.made_up import effect_found, fast
from tests.statistics.checks import seed_of

EFFECTS = ["constant load", "sensor bias"]


def pair():
    """Two levels that return to zero, each with a channel of its own."""
    model = ssm.Model("pair")

    @model.prior
    def prior():
        return {"q": ssm.LogNormal(0, sd=1), "r": ssm.LogNormal(0, sd=1)}

    @model.initial
    def initial():
        return {"v1": ssm.Normal(0, sd=0.1), "v2": ssm.Normal(0, sd=0.1)}

    @model.transition
    def transition(v1, v2, q):
        return {"v1": ssm.Normal(0.9 * v1, sd=q), "v2": ssm.Normal(0.9 * v2, sd=q)}

    @model.observation
    def observation(v1, v2, r):
        return {"y1": ssm.Normal(v1, sd=r), "y2": ssm.Normal(v2, sd=r)}

    return model


@pytest.fixture(scope="module")
def loaded():
    """The results where a load on v1 and a bias of y2 were chosen together, of four refits."""
    rng, v = np.random.default_rng(seed_of("pair")), np.zeros((120, 2))
    for k in range(1, len(v)):
        v[k] = 0.9 * v[k - 1] + 0.3 * rng.normal(size=2) + [0.4, 0.0]
    y = v + 0.3 * rng.normal(size=v.shape) + [0.0, 1.0]
    problem = pose(pair(), {"y1": y[:, 0], "y2": y[:, 1]})
    train, missing = problem.experiments, missing_of(problem.experiments)
    augmented = AugmentedModels(problem.trace, missing, {}, Settings())
    base, kept = augmented.base_fitter, Checkpoint(None, {})
    fit = base.fit(train, seed_sequence(1), {})
    states = base.states(train[0], fit.theta, random_state(seed_sequence(2)))
    scales = Scales.of(problem.trace, states, train[0].y, train[0].u, 120)
    design = ScreenDesign(problem.trace, scales, missing, (), Settings(), EFFECTS)
    screen = run_screen(design, train, fit.theta, 60, seed_sequence(3), kept)
    where = {(c.effect.name, c.equation): k for k, c in enumerate(design.candidates)}
    load, bias = where["constant load", "v1"], where["sensor bias", "y2"]
    singles, failed = refit_all(
        augmented, fit, screen, [[k] for k in range(4)], train, seed_sequence(4), kept, "one"
    )
    assert not failed
    both = [design.candidates[k] for k in (load, bias)]
    start = start_of(fit, screen, [load, bias], train, both)
    found = refit(augmented, fit, [load, bias], both, train, seed_sequence(5), start)
    found = dataclasses.replace(
        found, fit=found.fitter.with_information(found.fit, seed_sequence(6))
    )
    selection = SelectionResult(fit, singles, [], found)
    return Results(
        problem.trace, train, None, "full", 0.05, base, fit, screen, {"model": "pair"}, [],
        selection,
    )  # fmt: skip


@pytest.mark.slow
def test_the_report_names_what_was_chosen_where_it_was_chosen(loaded):
    report = build_report(loaded, 1.0)
    assert report.verdict == "effect"
    assert report.chosen == ["constant load on v1", "sensor bias on y2"]
    # The bias of y1 stands before that of y2: a load on v1 looks like it.
    names = list(zip(report.causes["effect"], report.causes["equation"], strict=True))
    assert names.index(("sensor bias", "y1")) < names.index(("sensor bias", "y2"))
    found = leaders(report)
    assert [(r["effect"], r["equation"]) for r in found] == [
        ("constant load", "v1"),
        ("sensor bias", "y2"),
    ]
    for row, name in zip(found, ("constant_load_v1", "sensor_bias_y2"), strict=True):
        assert (row["estimate"], row["se"]) == report.estimates["after"][name]
    assert "constant load in v1 and sensor bias of y2" in headline(report)
    assert "sensor bias of y1" not in " ".join([headline(report), *which(report)])
    marked = {line[0] for line in cause_rows(report) if line[0].startswith("→")}
    assert marked == {"→ constant load in v1", "→ sensor bias of y2"}
    assert "constant load on v1 and sensor bias on y2" in report.model_text.splitlines()[0]


@pytest.mark.slow
def test_what_stands_out_and_could_not_be_fitted_is_named(loaded):
    """Nothing else in its place: the gap is there, and is not measured."""
    (load,) = [k for k, c in enumerate(loaded.screen.design.candidates)
               if (c.effect.name, c.equation) == ("constant load", "v1")]  # fmt: skip
    rest = [r for r in loaded.refits if r.index != (load,)]
    found = SelectionResult(loaded.fit, rest, unfitted=load, notes=["not refitted: it failed"])
    report = build_report(dataclasses.replace(loaded, selection=found), 1.0)
    assert report.verdict == "effect"
    assert report.model is None
    assert [(r["effect"], r["equation"]) for r in leaders(report)] == [("constant load", "v1")]
    text = headline(report)
    assert "indicate a missing effect in the model “pair”: constant load in v1 (p" in text
    assert "could not be fitted" in text
    assert how_far(report) == ["Not measured: the effect could not be fitted."]
    assert "confirm" not in report.parts
    assert "(score-test approximation)" in which(report)[0]


@pytest.mark.slow
def test_the_p_of_a_screen_at_another_fit_is_not_told(loaded):
    """Of a model that a refit led to a better fit of: only what refits were tested for is known."""
    base = build_report(loaded, 1.0).causes
    tested = {loaded.refits[0].index[0]: 0.3}
    found = SelectionResult(loaded.fit, loaded.refits, p=tested, rebased=True)
    report = build_report(dataclasses.replace(loaded, selection=found), 1.0)
    assert base["p"].min() < 0.001
    assert report.causes["p"].iloc[0] == pytest.approx(0.6)  # the larger of two tests
    assert report.causes["p"].iloc[1:].isna().all()
    assert report.verdict == "no measurable gap"
    assert "is significant after correction for multiple testing" in headline(report)
    assert "p = 0.60" in headline(report)


@pytest.mark.slow
def test_parts_tell_the_rows_that_were_measured(loaded):
    """From the first that counts, of the longest experiment, and only where something was."""
    e = loaded.experiments[0]
    two = (head(e, 20), e)
    parts = three_parts(two)
    results = dataclasses.replace(loaded, experiments=two, split=parts)
    report = build_report(results, 1.0)
    assert report.parts == {"screen": (1, 84)}
    assert "The held-out gain has not been measured." in headline(report)
    assert "held-out data" not in str(report)
    run = SimpleNamespace(mean=e.y, low=e.y, high=e.y)
    short = SimpleNamespace(mean=e.y[:20], low=e.y[:20], high=e.y[:20])
    row = {"effect": "x", "F": 0.9, "F_low": 0.8, "F_high": 1.0, "nats_per_sample": 0.1}
    far = HeldOutGain([row], None, [short, run])
    report = build_report(dataclasses.replace(results, held_out=far), 1.0)
    first = int(np.flatnonzero(parts.held_out[1])[0]) + 1
    assert report.parts == {"screen": (1, 84), "confirm": (first, 120)}
    assert first == 84 + GAP + 1
    assert (
        f"t = {first} to 120 of experiment 2 and the corresponding rows of the other experiments"
        in how_far(report)[0]
    )
    assert "t = 1 to 84 of experiment 2" in how_sure(report)[0]
    disjoint = "other experiments were used likewise. Selection and evaluation rows are disjoint."
    assert disjoint in how_sure(report)[0]
    results.selection.left_out = True
    report = build_report(dataclasses.replace(results, held_out=far), 1.0)
    results.selection.left_out = False
    assert "rows are disjoint" not in str(report)
    assert "held-out data that were also used to drop one effect" in how_far(report)[0]
    assert "reduced by their held-out gain" in " ".join(how_sure(report))


@pytest.mark.slow
def test_an_effect_that_gained_is_not_denied_where_the_share_is_open(loaded, monkeypatch):
    """Curves predict better still, but it is not known how large the gap is in all."""
    monkeypatch.setattr(decision, "strongest_residual", lambda *_: (1e-4, ("v1", "mean")))
    e = loaded.experiments[0]
    run = SimpleNamespace(mean=e.y, low=e.y, high=e.y)
    row = {"effect": "x", "F_low": np.nan, "F_high": np.nan}
    verdicts = {}
    for share, gained in ((np.nan, 0.4), (np.nan, -0.1), (0.5, 0.4)):
        far = HeldOutGain(
            [{**row, "F": share, "nats_per_sample": gained}], Gain(9.0, 1.0, 0.1), [run]
        )
        report = build_report(dataclasses.replace(loaded, held_out=far), 1.0)
        verdicts[share, gained] = report.verdict
        assert (report.model is not None) == (report.verdict == "effect")
    # What gained nothing is no effect; that its place stands out is a gap all the same.
    assert list(verdicts.values()) == ["effect", "none of these", "none of these"]


@pytest.mark.slow
def test_an_effect_offered_once_needs_no_equation(loaded):
    offered = loaded.screen.design.candidates
    assert labels(offered[:1], offered[:1]) == ["constant load"]
    assert labels(offered[:1], offered) == ["constant load on v1"]


def test_of_two_forms_the_chosen_one_is_marked():
    """Rows 2 and 3 are of one effect on one equation: the second of them was chosen."""
    chosen = [{"row": 3, "form": "v0 = 0.04", "sign": "one-sided", "estimate": 0.5, "se": 0.1}]
    report = dataclasses.replace(effect_found(), chosen=["coulomb friction"], leading=chosen)
    assert [r["estimate"] for r in leaders(report)] == [0.5]
    assert "v0 = 0.04: strength 0.50 ± 0.10" in which(report)[0]
    lines = cause_rows(report)
    assert [i for i, line in enumerate(lines) if line[0].startswith("→")] == [4]
    assert "v0 = 0.05" in [r["form"] for r in bars(report)]


def test_the_best_of_a_screen_is_marked_though_it_was_not_refitted():
    import matplotlib.pyplot as plt

    lines = cause_rows(fast())
    assert [line[0].startswith("→") for line in lines] == [False, True, *[False] * (len(lines) - 2)]
    figure, ax = plt.subplots()
    ranked_effects(fast(), ax)
    bold = [t.get_text() for t in ax.texts if t.get_weight() == "bold"]
    plt.close(figure)
    assert len(bold) == 2
    assert "quadratic drag in v" in bold[1]
