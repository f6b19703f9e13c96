"""What the held-out rows must say before a verdict."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis import diagnose
from ssmppl.diagnosis.heldout import gain_ratio as gain_ratio_module
from ssmppl.diagnosis.heldout.gain_ratio import Gain, HeldOutGain, HeldOutRows, _left, gain_ratio
from ssmppl.diagnosis.heldout.simulation import Horizon
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.report import build, tables
from ssmppl.diagnosis.report.words import headline
from ssmppl.diagnosis.verdict.decision import curves_beat
from ssmppl.drawing.numerals import interval
from ssmppl.language.tracing import trace
from tests.diagnosis.harness import scales
from tests.diagnosis.small import level, levels
from tests.models import gaps as models


@pytest.mark.parametrize(
    ("nats", "error", "share", "simulated", "chosen", "expected"),
    [
        (16.0, 3.0, 0.58, None, True, True),
        (16.0, 3.0, 0.58, (0.4, 0.2), True, True),
        (16.0, 3.0, 0.58, (0.4, -0.1), True, False),  # as far as simulations tell
        (16.0, 3.0, 0.58, (0.1, 0.05), True, False),  # a trifle, many rows ahead
        (16.0, 9.0, 0.58, (0.4, 0.2), True, False),  # chance explains it
        (16.0, 3.0, 0.69, (0.16, 0.1), True, True),
        (16.0, 3.0, 0.71, (0.16, 0.1), True, False),  # friction, in steps too coarse for it
        (2.9, 0.9, 0.94, None, True, False),  # the catalogue's effects close nearly all
        (6.0, 2.0, float("nan"), None, True, True),  # no share is given
        (6.0, 2.0, 1.0, None, False, True),  # nothing was chosen: the share is the curves' own
        (-6.0, 2.0, 1.2, None, True, False),
    ],
)
def test_curves_beat_the_catalogue(nats, error, share, simulated, chosen, expected):
    gain = Gain(nats, error, nats / 150)
    far = SimpleNamespace(beyond_catalogue=gain, rows=[{"F": share}], simulated_beyond=simulated)
    assert curves_beat(far, chosen) is expected
    assert curves_beat(SimpleNamespace(beyond_catalogue=None, rows=[]), chosen) is False


@pytest.mark.parametrize(
    ("after", "reference", "left"),
    [
        (0.0003, 0.0002, 0.1 / 2.8),  # next to nothing of what can be taken off
        (0.0020, 0.0010, 0.5),
        (0.0030, 0.0030, 0.0),
        (0.0030, 0.0040, 0.0),  # the reference simulates worse than nothing
    ],
)
def test_what_is_left_is_a_share_of_what_curves_take_off(after, reference, left):
    rows = [{"horizon": "10", "share": 0.1}, {"horizon": "1 to 25", "share": 1 - after / 0.003}]
    beyond = [{"horizon": "1 to 25", "share": 1 - reference / after, "low": 0.1}]
    assert _left(rows, beyond) == pytest.approx((left, 0.1))
    assert _left(rows[:1], beyond) is None
    assert _left(rows, []) is None


def test_simulations_of_the_model_as_it_was_stand_beside_those_with_the_effect(monkeypatch):
    rows, asked = np.array([[1.0, 0.25, 0.1]] * 8), []

    def compared(before, after, *_):
        asked.append((before, after))
        return [rows]

    monkeypatch.setattr(gain_ratio_module, "compared", compared)
    monkeypatch.setattr(gain_ratio_module, "horizons", lambda *_: [Horizon(5, window=True)])
    held = SimpleNamespace(experiments=(), held_out=[np.ones(9, bool)])
    chosen = SimpleNamespace(simulator="with the effect")
    at = HeldOutRows(None, held, "fitted", None, chosen, None, "as it was")
    out = HeldOutGain()
    at._look_ahead(out, "drag", "with curves", None, same=False)
    assert asked == [("as it was", "with the effect"), ("with the effect", "with curves")]
    assert out.rows[0]["share"] == 0.5
    assert out.simulated_beyond is not None


# -- a verdict agrees with the checks
@pytest.fixture
def few_sets(monkeypatch):
    monkeypatch.setattr(diagnose, "SETS", {"fast": 60, "full": 60})


def quiet(**kwargs):
    """A report on data of the model itself."""
    return ssm.diagnose(level(), levels(80), ["sensor drift"], mode="fast", progress=False,
                        **kwargs)  # fmt: skip


def test_where_nothing_stands_out_no_gap_is_measurable(few_sets):
    report = quiet()
    assert report.verdict == "no measurable gap"
    assert min(report.where["p"].min(), report.detection["p"].min()) > 0.05
    assert "passed all" in str(report)


def test_a_check_that_fails_is_a_gap(few_sets, monkeypatch):
    """z = 39 and "no measurable gap" stood in one report."""
    whole = build._detection

    def failed(screen):
        table = whole(screen)
        table.loc[table.index[0], ["z", "p"]] = 39.0, 1e-6
        return table

    monkeypatch.setattr(build, "_detection", failed)
    report = quiet()
    assert report.verdict == "none of these"
    first = report.detection.iloc[0]
    assert f"({first['statistic']} of y, p < 0.001)" in headline(report)
    assert "no measurable gap" not in str(report).lower()


def test_a_place_that_stands_out_is_a_gap_with_its_stretch_and_curve(few_sets, monkeypatch):
    whole = tables.where_table

    def found(screen, alpha):
        table, groups = whole(screen, alpha)
        mean = table.index[table["moment"] == "mean"][0]
        table.loc[mean, ["t_from", "t_to", "z", "p"]] = 20, 40, 39.0, 1e-6
        return table.sort_values("p").reset_index(drop=True), groups

    monkeypatch.setattr(tables, "where_table", found)
    report = quiet()
    assert report.verdict == "none of these"
    equation = report.where.iloc[0]["equation"]
    assert f"in the mean of {equation}, strongest at t = 20 to 40 (p < 0.001)" in headline(report)
    assert set(report.missing["equation"]) == {equation}


def test_places_and_checks_share_the_error_rate():
    """A fifth of it each, so that their p is five times the family's own."""
    assert tables.bonferroni([0.004, 0.02, 0.5]).tolist() == pytest.approx([0.02, 0.1, 1.0])


# -- the chosen effects need not have the shape that led the screen
def test_a_chosen_effect_of_another_shape_has_its_numbers():
    """KeyError: 'stribeck_v' ended every run on a record of a ship."""
    head = next(c for c in models_candidates() if c.effect.name == "coulomb friction")
    other = replace(head.with_shape(v0=0.123), strength="coulomb_friction_v_2")
    refit = SimpleNamespace(
        candidates=(other,), strengths=[0.25], errors={"coulomb_friction_v_2": 0.01}, bounds=[]
    )
    design = SimpleNamespace(candidates=[head], trace=SimpleNamespace(time_step=None))
    screen = SimpleNamespace(design=design, experiments=[SimpleNamespace(time=None)])
    results = SimpleNamespace(chosen=refit, screen=screen, unfitted=None)
    (found,) = build._leading(results, [0])
    assert np.isnan(found.pop("rate"))
    assert found == {"row": 0, "form": "v0 = 0.123", "sign": "one-sided", "estimate": 0.25,
                     "se": 0.01}  # fmt: skip


def models_candidates():
    """Of the oscillator."""
    made = trace(models.build("oscillator"))
    return offers(made, scales(made))[0]


# -- an interval of a model against itself
def test_a_share_of_the_reference_itself_is_no_comparison():
    rng = np.random.default_rng(1)
    gains = 1.0 + 0.1 * rng.standard_normal((1, 200))
    base = np.zeros((1, 200))
    share = gain_ratio(base, gains, gains)
    assert share.F == 1.0
    assert np.isnan(share.interval).all()
    assert interval(*share.interval) == "no comparison: the reference is this model itself"
    other = gain_ratio(base, 0.9 * gains, gains)
    assert np.isfinite(other.interval).all()
