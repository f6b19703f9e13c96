"""What the held-out rows must say before a verdict."""

from types import SimpleNamespace

import pytest

from ssmppl.gap.answer import _curves_beat
from ssmppl.gap.closed import Gain


@pytest.mark.parametrize(
    ("nats", "error", "share", "chosen", "expected"),
    [
        (16.0, 3.0, 0.58, True, True),
        (16.0, 9.0, 0.58, True, False),  # chance explains it
        (2.9, 0.9, 0.94, True, False),  # the catalogue's effects close nearly all
        (6.0, 2.0, float("nan"), True, True),  # no share is given
        (6.0, 2.0, 1.0, False, True),  # nothing was chosen: the share is the curves' own
        (-6.0, 2.0, 1.2, True, False),
    ],
)
def test_curves_beat_the_catalogue(nats, error, share, chosen, expected):
    far = SimpleNamespace(beyond=Gain(nats, error, nats / 150), rows=[{"F": share}])
    assert _curves_beat(far, chosen) is expected
    assert _curves_beat(SimpleNamespace(beyond=None, rows=[]), chosen) is False
