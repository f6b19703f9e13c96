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
        screen_is_current=True, chosen=object() if chosen else None,
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
    candidates = tuple(SimpleNamespace(effect=SimpleNamespace(cause=c)) for c in causes)
    asked = []
    monkeypatch.setattr(decision, "_by_effects", lambda *_: Decision(EFFECT))
    monkeypatch.setattr(
        decision, "strongest_residual", lambda _, others: asked.append(others) or (p, place)
    )
    r = SimpleNamespace(
        held_out=SimpleNamespace(rows=[], curves=curves), blocks=0, alpha=0.05, screen=None,
        screen_is_current=True,
        chosen=SimpleNamespace(candidates=candidates) if causes else None,
    )  # fmt: skip
    found = decide(r, NOTHING, NOTHING)
    assert found.verdict == expected
    assert all(others == candidates for others in asked)  # with what was chosen projected out
    if expected == NONE_OF_THESE:
        assert found == Decision(NONE_OF_THESE, MEAN, candidates)
