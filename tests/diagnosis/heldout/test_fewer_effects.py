"""Further effects have to carry to rows that they were not fitted to."""

from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.heldout import fewer_effects
from ssmppl.diagnosis.heldout.fewer_effects import drop_by_later_rows
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
    def predicted(fitter, start, split, seed):
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
