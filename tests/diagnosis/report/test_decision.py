"""The verdict in the light of held-out rows: simulations count beside one row ahead."""

from types import SimpleNamespace

import pandas as pd
import pytest

from ssmppl.diagnosis.effects.effect import MECHANISM, NOISE_LAW, UNKNOWN_INPUT
from ssmppl.diagnosis.verdict import decision
from ssmppl.diagnosis.verdict.decision import Decision, decide
from ssmppl.diagnosis.verdict.verdicts import EFFECT, NO_GAP, NONE_OF_THESE

NAN = float("nan")
NOTHING = pd.DataFrame({"p": [0.5], "equation": ["v"], "moment": ["mean"]})


def effects(*causes, gain=40.0):
    """A chosen set with effects of these kinds."""
    candidates = tuple(SimpleNamespace(effect=SimpleNamespace(cause=c)) for c in causes)
    return SimpleNamespace(candidates=candidates, penalised_gain=gain)


@pytest.mark.parametrize(
    ("first", "chosen", "blocks", "nats", "interval", "expected"),
    [
        # On rows not used the gain one row ahead is open: it counts, or that of simulations does.
        (EFFECT, True, 0, 0.1, (NAN, NAN), EFFECT),
        (EFFECT, True, 0, -0.1, (NAN, NAN), NO_GAP),
        (EFFECT, True, 0, -0.1, (0.13, 0.35), EFFECT),
        (EFFECT, True, 0, -0.1, (-0.1, 0.35), NO_GAP),
        (NONE_OF_THESE, True, 0, 0.1, (NAN, NAN), EFFECT),
        (NONE_OF_THESE, False, 0, 0.1, (NAN, NAN), NO_GAP),
        # Blocks that were left out in turn: what makes simulations worse is not what is missing.
        (EFFECT, True, 10, -0.1, (-0.2, 0.05), EFFECT),
        (EFFECT, True, 10, 0.1, (-0.18, -0.01), NONE_OF_THESE),
        (NO_GAP, False, 10, -0.1, (-0.18, -0.01), NO_GAP),
    ],
)
def test_where_the_share_is_open(monkeypatch, first, chosen, blocks, nats, interval, expected):
    monkeypatch.setattr(decision, "_by_effects", lambda *_: Decision(first))
    low, high = interval
    rows = [
        {"horizon": "free run", "F": NAN, "nats_per_sample": nats},
        {"horizon": "1 to 20", "low": low, "high": high},
    ]
    r = SimpleNamespace(
        held_out=SimpleNamespace(rows=rows, curves=False), blocks=blocks, alpha=0.05,
        screen_is_current=True, chosen=effects(MECHANISM) if chosen else None, curves_alone=0.0,
    )  # fmt: skip
    assert decide(r, NOTHING, NOTHING).verdict == expected
    rows[0]["F"] = 0.8
    assert decide(r, NOTHING, NOTHING).verdict == first


def test_what_stands_out_is_a_gap_whatever_the_catalogue_says(monkeypatch):
    monkeypatch.setattr(decision, "_by_effects", lambda *_: Decision(NO_GAP))
    r = SimpleNamespace(held_out=None, blocks=0, alpha=0.05, screen_is_current=True, chosen=None)
    assert decide(r, NOTHING.assign(p=0.01), NOTHING).verdict == NONE_OF_THESE
    assert decide(r, NOTHING, NOTHING.assign(p=0.01)).verdict == NONE_OF_THESE
    r.screen_is_current = False
    assert decide(r, NOTHING.assign(p=0.01), NOTHING).verdict == NO_GAP


MEAN, SCALE = ("v", "mean"), ("v", "scale")


@pytest.mark.parametrize(
    ("causes", "curves", "p", "place", "expected"),
    [
        ([NOISE_LAW], True, 0.01, MEAN, NONE_OF_THESE),
        ([NOISE_LAW, NOISE_LAW], True, 0.01, MEAN, NONE_OF_THESE),
        ([NOISE_LAW], False, 0.01, MEAN, EFFECT),  # the curves predict no other rows
        ([NOISE_LAW], True, 0.2, MEAN, EFFECT),  # chance
        ([NOISE_LAW], True, 0.01, SCALE, EFFECT),
        ([NOISE_LAW, MECHANISM], True, 0.01, MEAN, EFFECT),
        ([UNKNOWN_INPUT], True, 0.01, MEAN, EFFECT),
        ([], True, 0.01, MEAN, EFFECT),
    ],
)
def test_a_law_of_the_noise_is_no_answer_while_a_mean_is_open(
    monkeypatch, causes, curves, p, place, expected
):
    chosen = effects(*causes) if causes else None
    held_out = SimpleNamespace(rows=[], curves=curves)
    _check(monkeypatch, chosen, held_out, 0.0, (p, place), expected)


@pytest.mark.parametrize(
    ("alone", "p", "place", "expected"),
    [
        (81.0, 0.01, MEAN, NONE_OF_THESE),  # more than twice the 40 nats of what was chosen
        (79.0, 0.01, MEAN, EFFECT),
        (81.0, 0.2, MEAN, EFFECT),  # nothing of it stands out beside what was chosen
        (81.0, 0.01, SCALE, EFFECT),
    ],
)
def test_curves_that_explain_far_more_by_themselves_are_no_effect_of_the_catalogue(
    monkeypatch, alone, p, place, expected
):
    """Whatever they predict of other rows, at places where a machine has not been."""
    for held_out in (SimpleNamespace(rows=[], curves=False), None):
        chosen = effects(MECHANISM, MECHANISM, gain=40.0)
        _check(monkeypatch, chosen, held_out, alone, (p, place), expected)


def _check(monkeypatch, chosen, held_out, alone, residual, expected):
    candidates, asked = chosen.candidates if chosen else (), []
    monkeypatch.setattr(decision, "_by_effects", lambda *_: Decision(EFFECT))
    monkeypatch.setattr(
        decision, "strongest_residual", lambda _, others: asked.append(others) or residual
    )
    r = SimpleNamespace(
        held_out=held_out, blocks=0, alpha=0.05, screen=None, screen_is_current=True,
        chosen=chosen, curves_alone=alone,
    )  # fmt: skip
    found = decide(r, NOTHING, NOTHING)
    assert found.verdict == expected
    assert all(others == candidates for others in asked)  # with what was chosen projected out
    if expected == NONE_OF_THESE:
        assert found == Decision(NONE_OF_THESE, MEAN, candidates)
