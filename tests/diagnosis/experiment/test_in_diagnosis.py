"""The experiment in a whole diagnosis: what is compared, and that the file can be run."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.diagnosis import diagnose as diagnose_module
from ssmppl.diagnosis.diagnose import _Diagnosis
from ssmppl.diagnosis.experiment.design import MOST_ROWS
from ssmppl.diagnosis.selection.equivalence import Classes

STEP, ROWS, NOISE, SENSOR = 0.05, 240, 0.02, 0.015


# -- who is compared
def refit(k, score, smooth=True, pair=()):
    return SimpleNamespace(
        index=(k, *pair), score=score, fitter=smooth, bounds=[],
        candidates=("both",) if pair else (f"c{k}",),
        fit=SimpleNamespace(by_parameter={"k": np.asarray(float(k))}),
    )  # fmt: skip


def compared(monkeypatch, refits, class_id, *, chosen="one", rows=100, result="found"):
    """(names of the rivals in order, members, notes) that a search would be made for."""
    calls = []

    def separate(augmented, trace, rivals, members, experiments, seed, checkpoint):
        calls.append(([r.candidates[0] for r in rivals], members))
        return result

    monkeypatch.setattr(diagnose_module, "separate", separate)
    monkeypatch.setattr(diagnose_module, "has_filter", lambda fitter: fitter)
    leader = np.array([class_id.index(k) for k in class_id], dtype=int)
    found = Classes(np.array(class_id, dtype=int), leader, np.ones(len(class_id)))
    order = [10, 11, 12, 13][: len(class_id)]
    design = SimpleNamespace(candidates={k: f"effect {k}" for k in order})
    results = SimpleNamespace(
        chosen=chosen, refits=refits, separation=None, classes=lambda: (order, found),
        screen=SimpleNamespace(design=design),
    )  # fmt: skip
    run = SimpleNamespace(
        experiments=[SimpleNamespace(steps=rows)], augmented=None, trace=None, checkpoint=None,
        notes=[], _seed=lambda stage: None,
    )  # fmt: skip
    _Diagnosis._separating_experiment(run, results)
    return (calls[0] if calls else None), results.separation, run.notes


def test_refitted_members_of_the_first_class_are_compared_the_best_first(monkeypatch):
    refits = [refit(10, 20.0), refit(11, 5.0), refit(12, 9.0), refit(13, 30.0),
              refit(10, 99.0, pair=(11,))]  # fmt: skip
    call, found, notes = compared(monkeypatch, refits, [1, 1, 1, 2])
    assert call == (["c10", "c12", "c11"], 3)
    assert (found, notes) == ("found", [])


def test_where_there_is_nobody_to_compare_it_is_noted(monkeypatch):
    alone = [refit(10, 20.0), refit(11, 5.0, smooth=False)]
    call, found, notes = compared(monkeypatch, alone, [1, 1])
    assert (call, found) == (None, None)
    assert notes[0].startswith(
        "no experiment to distinguish effect 10 and effect 11 was designed: this needs fits of at "
        "least two of them with likelihoods by a Kalman"
    )
    call, _, notes = compared(
        monkeypatch, [refit(10, 2.0), refit(11, 1.0)], [1, 1], rows=MOST_ROWS + 1
    )
    assert call is None
    assert f"too long ({MOST_ROWS + 1:,} rows)" in notes[0]
    both = [refit(10, 2.0), refit(11, 1.0)]
    call, found, notes = compared(monkeypatch, both, [1, 1], result=None)
    assert call is not None
    assert "they happen once, or fail" in notes[0]


def test_without_a_class_or_a_choice_nothing_is_looked_for(monkeypatch):
    both = [refit(10, 20.0), refit(11, 5.0)]
    assert compared(monkeypatch, both, [1, 2]) == (None, None, [])
    assert compared(monkeypatch, both, [1, 1], chosen=None) == (None, None, [])
    assert compared(monkeypatch, both, []) == (None, None, [])


# -- the whole
def slider():
    """A mass on a spring, as its maker thinks it is: linear."""
    model = ssm.Model("slider", inputs=("u",))
    model.prior(
        lambda: {
            "k": ssm.LogNormal(np.log(4.0), sd=0.5), "c": ssm.LogNormal(np.log(0.5), sd=0.7),
            "q": ssm.LogNormal(np.log(0.05), sd=1.0), "r": ssm.LogNormal(np.log(0.02), sd=0.7),
        }
    )  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=0.1), "v": ssm.Normal(0, sd=0.1)})

    @model.transition
    def transition(x, v, u, k, c, q):
        return {
            "x": ssm.Dirac(x + STEP * v),
            "v": ssm.Normal(v + STEP * (u - k * x - c * v), sd=q),
        }

    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


def measured(u, seed):
    """Its position under a force: the spring is stiffer further out."""
    rng, substeps = np.random.default_rng(seed), 20
    x = v = 0.0
    y = np.empty(len(u))
    for t, force in enumerate(u):
        y[t] = x + SENSOR * rng.standard_normal()
        for _ in range(substeps):
            v += STEP / substeps * (force - 4.0 * x - 0.4 * v - 8.0 * x**3)
            x += STEP / substeps * v
        v += NOISE * rng.standard_normal()
    return y


def wandering(seed):
    rng, u = np.random.default_rng(seed), np.zeros(ROWS)
    for t in range(1, ROWS):
        u[t] = 0.85 * u[t - 1] + 0.6 * rng.standard_normal()
    return u


@pytest.mark.slow
def test_the_experiment_tells_the_rivals_apart_when_it_is_made(tmp_path):
    """A stiffening spring and a stop cannot be told apart in a record; the experiment is run on the
    real thing, and the spring is far ahead."""
    u = wandering(104)
    first = {"u": u, "y": measured(u, 4)}
    effects = ["cubic stiffness", "hard stop"]
    report = ssm.diagnose(slider(), first, effects, progress=False)
    found = report.separation
    assert {e for e, _ in found.effects} == set(effects)
    assert not found.as_recorded
    assert found.best.nats > found.needed > found.recorded
    assert len(report.experiment) == ROWS
    assert report.experiment["u"].between(u.min(), u.max()).all()
    separating = report.classes.set_index("class_id").loc[1, "separating_input"]
    assert set(separating) == {found.best.signal.words}
    report.save(tmp_path)
    inputs = pd.read_csv(tmp_path / "experiment.csv")
    values = {n: v for n, (v, _) in report.estimates["after"].items()}
    runs = ssm.simulate(report.model, values, inputs=inputs, seed=1)
    assert runs.sizes["time"] == ROWS
    assert np.ptp(runs["y"].values) < 1.5 * np.ptp(first["y"])

    second = {"u": inputs["u"].to_numpy(), "y": measured(inputs["u"], 99)}
    both = ssm.diagnose(slider(), [first, second], effects, progress=False)
    gain = both.causes.set_index("effect")["gain_refit"]
    ahead = gain["cubic stiffness"] - gain["hard stop"].max()
    assert ahead > found.needed
    assert both.chosen[0].startswith("cubic stiffness")
    assert both.separation is None
