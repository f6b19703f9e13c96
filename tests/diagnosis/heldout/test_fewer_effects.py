"""Further effects have to carry to rows that they were not fitted to."""

from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.heldout import fewer_effects
from ssmppl.diagnosis.heldout.fewer_effects import (
    HeldOutTest,
    drop_by_held_out_rows,
    drop_by_later_rows,
)
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.selection.effect_selection import SelectionResult
from ssmppl.errors import SamplingError
from tests.statistics.checks import seed_of

FAILS, DATED = "fails", "level break"


def chain(names):
    """One effect, two and so on."""
    made = [
        SimpleNamespace(
            candidates=tuple(names[: k + 1]), fitter=k + 1, fit=SimpleNamespace(by_parameter={})
        )
        for k in range(len(names))
    ]  # fmt: skip
    return SelectionResult(None, chosen=made[-1], fewer=made[:-1])


@pytest.mark.parametrize(
    ("names", "later", "left"),
    [
        ("abc", {1: 5.0, 2: 9.0, 3: 12.0}, 3),
        ("abc", {1: 5.0, 2: 9.0, 3: 9.5}, 2),  # next to nothing
        ("abc", {1: 5.0, 2: 3.0, 3: 3.5}, 1),
        ("abc", {1: 5.0, 2: 3.0, 3: 30.0}, 3),  # the second with the third
        ("abc", {1: 5.0, 2: 9.0, 3: FAILS}, 2),
        ("abc", {1: 5.0, 2: FAILS, 3: 3.0}, 3),  # without the third nothing can be said
        (["a", DATED], {1: 5.0, 2: 0.0}, 2),
        ([DATED, "a"], {1: 5.0, 2: 0.0}, 1),
        ("a", {}, 1),
    ],
)
def test_what_does_not_carry_is_not_named(monkeypatch, names, later, left):
    def predicted(fitter, start, split, seed, executor):
        if later[fitter] is FAILS:
            raise SamplingError("it predicts nothing", fix="none")
        return later[fitter]

    renewed = []
    monkeypatch.setattr(fewer_effects, "predicted_later", predicted)
    monkeypatch.setattr(fewer_effects, "is_dated", lambda c: c == DATED)
    monkeypatch.setattr(
        fewer_effects, "add_standard_errors", lambda found, *_: renewed.append(found.chosen)
    )
    found = chain(names)
    drop_by_later_rows(found, None, None, Checkpoint(None, {}))
    assert found.chosen.fitter == left
    assert len(found.fewer) == left - 1
    assert len(found.notes) == len(names) - left
    assert [r.fitter for r in renewed] == list(range(len(names) - 1, left - 1, -1))
    if found.notes:
        assert found.notes[-1].endswith("retained: " + " and ".join(names[:left]))
    assert not found.left_out  # no held-out row was looked at


def held_out(gains, worse=(), fails=None):
    """A test of which these effects' numbers gain so much, simulate worse, cannot be looked at."""

    def predictions(fitter, fit=None):
        if fitter == fails:
            raise SamplingError("all weights are zero at t=301", fix="look at it")
        gain = ({0: 0.0} | gains)[fitter]
        return SimpleNamespace(log_density=np.full((8, 4), gain / 4.0))

    return SimpleNamespace(
        base=(0, None), predictions=predictions,
        simulated_worse=lambda refit: 0.19 if refit.fitter in worse else 0.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gains", "worse", "left"),
    [
        ({1: 5.0, 2: 4.0, 3: 2.0}, (), 3),
        ({1: 5.0, 2: 4.0, 3: -2.0}, (), 2),
        ({1: 5.0, 2: -4.0, 3: -2.0}, (), 1),
        ({1: -5.0, 2: -4.0, 3: -2.0}, (), 1),
        ({1: 5.0, 2: 4.0, 3: 2.0}, (3,), 2),  # a break whose new value did not last
        ({1: 5.0, 2: 4.0, 3: 2.0}, (1, 2, 3), 1),
        ({1: 5.0, 2: -4.0, 3: 2.0}, (3,), 1),
    ],
)
def test_what_fails_on_held_out_rows_is_left_out_again(monkeypatch, gains, worse, left):
    """The number of effects left, by what each number of them gains on the held-out rows."""
    monkeypatch.setattr(fewer_effects, "add_standard_errors", lambda *_: None)
    found = chain("abc")
    drop_by_held_out_rows(found, held_out(gains, worse), None, Checkpoint(None, {}))
    assert len(found.chosen.candidates) == left
    assert len(found.notes) == 3 - left
    assert found.left_out is (left < 3)
    if found.notes:
        assert found.notes[-1].endswith(f"retained: {' and '.join('abc'[:left])}")
    if worse and left == 2:
        assert "simulate held-out rows worse than the base model (error +19%)" in found.notes[0]


@pytest.mark.parametrize("which", [0, 2])
def test_effects_stay_together_where_held_out_rows_cannot_be_predicted(which):
    """Of the model itself, of both together: nothing is left out for it, and nothing raised."""
    found = chain("ab")
    drop_by_held_out_rows(found, held_out({2: -5.0}, fails=which), None, Checkpoint(None, {}))
    assert len(found.chosen.candidates) == 2
    assert found.notes == ["a and b fit better together, and whether they predict held-out rows "
                           "better is not known: all weights are zero at t=301"
                           ][:which]  # fmt: skip


@pytest.mark.parametrize(
    ("share", "high", "worse"), [(-0.19, -0.05, 0.19), (-0.19, 0.02, 0.0), (0.3, 0.4, 0.0)]
)
def test_simulations_are_worse_only_beyond_chance(monkeypatch, share, high, worse):
    asked = []
    monkeypatch.setattr(fewer_effects, "horizons", lambda *_: ["100", "1 to 79"])
    monkeypatch.setattr(fewer_effects, "compared", lambda *a: asked.append(a))
    monkeypatch.setattr(
        fewer_effects, "table_rows", lambda *_: [{"share": share, "high": high, "low": -1.0}]
    )
    split = SimpleNamespace(experiments=(), held_out=())
    test = HeldOutTest(("m", 1), ("m", 2), split, None, None)
    chosen = SimpleNamespace(simulator=("with", 3))
    assert test.simulated_worse(chosen) == worse
    assert asked[0][:2] == (("m", 2), ("with", 3))
    assert asked[0][4] == ["1 to 79"]  # the windows


@pytest.mark.slow
def test_a_second_cause_stays_and_chance_does_not():
    """Of a walk with a drag and a load that both act all the time both are named."""
    rng, v = np.random.default_rng(seed_of("fewer effects")), np.zeros(600)
    u = np.repeat(rng.normal(0.0, 1.5, 60), 10)
    for t in range(1, 600):
        past = v[t - 1]
        v[t] = (
            0.9 * past
            + 0.3 * u[t - 1]
            - 0.12 * np.tanh(past / 0.05)
            - 0.08 * u[t - 1] ** 2
            + 0.1 * rng.standard_normal()
        )
    y = v + 0.05 * rng.standard_normal(600)
    model = ssm.Model("cart", inputs=["u"])
    model.prior(lambda: {"a": ssm.Normal(0.9, sd=0.2), "b": ssm.Normal(0.3, sd=0.2),
                         "q": ssm.HalfNormal(sd=0.3), "r": ssm.HalfNormal(sd=0.3)})  # fmt: skip
    model.initial(lambda: {"v": ssm.Normal(0.0, sd=0.1)})
    model.transition(lambda v, u, a, b, q: {"v": ssm.Normal(a * v + b * u, sd=q)})
    model.observation(lambda v, r: {"y": ssm.Normal(v, sd=r)})
    report = ssm.diagnose(
        model, {"y": y, "u": u}, ["coulomb friction", "input asymmetry", "periodic forcing"],
        seed=1, progress=False,
    )  # fmt: skip
    print(report)
    assert set(report.chosen) == {"coulomb friction", "input asymmetry"}
