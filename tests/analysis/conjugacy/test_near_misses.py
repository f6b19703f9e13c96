"""What is not conjugate is refused or corrected, with the reason and the user's line."""

import numpy as np
import pytest

from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.inference.updates.draw_update import draw
from ssmppl.language.tracing import trace
from tests.analysis.conjugacy.near_misses import NEAR_MISSES, build
from tests.analysis.conjugacy.test_draws import compare, conditionals


@pytest.mark.parametrize("name", NEAR_MISSES)
def test_near_miss(name):
    model, parameter, family, line, words = build(name)
    update = next(u for u in derive_updates(trace(model)) if parameter in u.block)
    text = str(update.explanation)
    assert update.family_name == family, text
    assert line in update.where.text, (update.where.text, text)
    for word in words:
        assert word in update.reason, text
    assert "near_misses.py" in text or not words


LONG = {  # slices on a matrix or a simplex, each a pass over the whole density
    "stationary_coefficients",
    "stationary_covariance",
    "wishart_on_a_covariance",
    "covariance_with_a_nugget",
    "variance_of_a_projection",
    "contaminated_classes",
}
LONGEST = LONG - {"wishart_on_a_covariance", "contaminated_classes"}  # a minute and more each


def _mark(name):
    if name in LONGEST:
        return pytest.mark.exhaustive
    return pytest.mark.slow if name in LONG else ()


DRAWN = [pytest.param(n, marks=_mark(n)) for n in NEAR_MISSES if n != "deterministic"]


@pytest.mark.parametrize("name", DRAWN)
def test_its_draws_follow_the_exact_conditional(name):
    model, *_ = build(name)
    for conditional in conditionals(model):
        compare(conditional)


def test_a_parameter_of_a_deterministic_law_moves_on_the_density_of_the_noisy_states():
    model, *_ = build("deterministic")
    (update,) = derive_updates(trace(model))
    assert update.needs_log_joint
    assert "noisy states only" in update.explanation.law
    rng, value, draws = np.random.default_rng(1), np.ones(1), []
    for _ in range(4000):
        value, _ = draw(
            update, np.zeros(0), value, {}, rng, lambda v: -0.5 * float((v[0] - 3.0) ** 2)
        )
        draws.append(value[0])
    # slices of a unimodal density forget quickly: 4 standard errors at a tenth of the draws
    assert abs(np.mean(draws) - 3.0) < 4.0 / np.sqrt(len(draws) / 10)
