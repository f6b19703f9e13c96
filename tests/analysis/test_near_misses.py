"""What is not conjugate is refused or corrected, with the reason and the user's line."""

import numpy as np
import pytest

from ssmppl.analysis.conjugacy import derive_updates, draw
from ssmppl.errors import SamplingError
from ssmppl.language.trace import trace
from tests.analysis.near_misses import NEAR_MISSES, build
from tests.analysis.test_draws import compare, conditionals


@pytest.mark.parametrize("name", NEAR_MISSES)
def test_near_miss(name):
    model, parameter, family, line, words = build(name)
    update = next(u for u in derive_updates(trace(model)) if parameter in u.block)
    text = str(update.explanation)
    assert update.family == family, text
    assert line in update.where.text, (update.where.text, text)
    for word in words:
        assert word in update.reason, text
    assert "near_misses.py" in text or not words


@pytest.mark.parametrize("name", [n for n, v in NEAR_MISSES.items() if v[2] != "none"])
def test_its_draws_follow_the_exact_conditional(name):
    model, *_ = build(name)
    for conditional in conditionals(model):
        compare(conditional)


def test_a_degenerate_parameter_cannot_be_drawn():
    model, *_ = build("deterministic")
    (update,) = derive_updates(trace(model))
    with pytest.raises(SamplingError, match="Dirac"):
        draw(update, np.zeros(0), np.ones(1), {}, np.random.default_rng(1))
