"""Blocks left out in turn: what only a search at finite strengths found is refitted in each."""

from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.selection.effect_selection import EffectSelection, SelectionResult
from ssmppl.diagnosis.selection.refit import Begin
from ssmppl.diagnosis.verdict.results import Results
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.selection.test_overlooked import stopped  # noqa: F401
from tests.statistics.checks import seed_of

ROWS, MOST = 200, 24.0
NAMES = [
    "sensor clipping", "sensor lag", "sensor delay", "sensor gain nonlinearity", "missing input",
    "periodic forcing", "input saturation", "heteroscedastic noise", "quadratic drag",
]  # fmt: skip


def greenhouse():
    model = ssm.Model("greenhouse", inputs=("valve", "outside"))
    model.prior(
        lambda: {
            "a": ssm.LogNormal(-2.5, sd=1), "b": ssm.LogNormal(0.5, sd=1),
            "q": ssm.HalfNormal(sd=0.3), "r": ssm.HalfNormal(sd=0.3),
        }
    )  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(18, sd=3)})

    @model.transition
    def transition(x, valve, outside, a, b, q):
        return {"x": ssm.Normal(x + a * (outside - x) + b * valve, sd=q)}

    model.observation(lambda x, r: {"air": ssm.Normal(x, sd=r)})
    return model


def logged():
    """Its air through a logger whose range ends at `MOST`, the valve stepped by hand."""
    rng, x, rows = np.random.default_rng(seed_of("logger")), 18.0, []
    for t in range(ROWS):
        valve, outside = 0.3 + 0.6 * (t // 24 % 2), 5.0 + 4.0 * np.sin(0.05 * t)
        air = min(x, MOST) + 0.1 * rng.standard_normal()
        rows.append((valve, outside, air))
        x += 0.09 * (outside - x) + 2.3 * valve + 0.03 * rng.standard_normal()
    return dict(zip(("valve", "outside", "air"), np.array(rows).T, strict=True))


@pytest.mark.slow
def test_a_range_that_a_filter_follows_is_found_without_each_block():
    """Its score says nothing: the whole record's search finds it, and so have the blocks to."""
    found = ssm.diagnose(greenhouse(), logged(), effects=NAMES, mode="full", seed=1, progress=False)
    assert found.chosen == ["sensor clipping"]
    (windows,) = (row for _, row in found.closed.iterrows() if row["horizon"].startswith("1 to"))
    assert windows["low"] > 0.5


def selected(stopped, searched):  # noqa: F811
    augmented, base, screen, train = stopped
    out = SelectionResult(base)
    EffectSelection(
        augmented, screen, train, seed_sequence(4), 0.05, Checkpoint(None, {}), always=True,
        singles=1, approximate=True, most=1, further=False, searched=searched,
    ).run(out)  # fmt: skip
    return out


def test_what_a_search_found_is_refitted_with_its_shape(stopped):  # noqa: F811
    screen = stopped[2]
    stop = next(c for c in screen.design.candidates
                if (c.effect.name, c.equation, c.form) == ("hard stop", "v", "upper"))  # fmt: skip
    assert all(r.candidates[0].group != stop.group for r in selected(stopped, ()).refits)
    (name,) = (n for n, v in stop.shape if v)
    begun = Begin(3.0, {name: 1.1})
    out = selected(stopped, [(stop, begun)])
    (made,) = (r for r in out.refits if r.candidates[0].group == stop.group)
    assert made.begin == begun
    assert dict(made.candidates[0].shape)[name] != 1.1
    assert made is out.chosen


def test_only_chosen_effects_that_a_search_found_begin_there_again():
    candidates = [SimpleNamespace(group=g) for g in "abc"]
    begun = Begin(1.0, {})

    def refit(k, begin):
        return SimpleNamespace(index=(k,), begin=begin, candidates=(candidates[k],))

    singles = [refit(0, begun), refit(1, begun), refit(2, None)]
    results = SimpleNamespace(
        screen=SimpleNamespace(design=SimpleNamespace(candidates=candidates)), refits=singles,
        chosen=SimpleNamespace(candidates=(candidates[0], candidates[2])),
    )  # fmt: skip
    assert Results.searched.fget(results) == [(candidates[0], begun)]
    results.chosen = None
    assert Results.searched.fget(results) == []
