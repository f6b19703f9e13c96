"""The verdict in the light of held-out rows: simulations count beside one row ahead."""

from types import SimpleNamespace

import pandas as pd
import pytest

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
        held_out=SimpleNamespace(rows=rows), blocks=blocks, alpha=0.05, screen_is_current=True,
        chosen=object() if chosen else None,
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
