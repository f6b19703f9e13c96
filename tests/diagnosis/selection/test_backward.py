"""Effects that others have made needless."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import FROM_START
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.selection.backward import NEEDED, needed_only
from ssmppl.diagnosis.selection.effect_selection import _followers
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.harness import scales
from tests.diagnosis.selection.test_effect_selection import screen_of
from tests.statistics.checks import seed_of

COST = 0.7


def plant():
    model = ssm.Model("plant", inputs=("u",))
    model.prior(lambda: {n: ssm.HalfNormal(sd=1) for n in ("a", "q", "r")})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, u, a, q: {"x": ssm.Normal(a * x + u, sd=q)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


@functools.cache
def fitted(load, drag):
    """A record of the plant with a load and drag of these sizes; all fits with both effects."""
    rng = np.random.default_rng(seed_of("plant", load, drag))
    u = np.repeat(rng.uniform(-1.0, 1.0, 40), 10)
    x, y = 0.0, np.zeros(len(u))
    for t in range(len(u)):
        y[t] = x + 0.1 * rng.standard_normal()
        x = 0.8 * x + u[t] + load - drag * x * abs(x) + 0.05 * rng.standard_normal()
    problem = pose(plant(), {"u": u, "y": y})
    trace = problem.trace
    augmented = AugmentedModels(trace, missing_of(problem.experiments), {}, Settings())
    found, _ = offers(trace, scales(trace), ["quadratic drag", "constant load"])
    named = {c.effect.name: c for c in found}
    return augmented, problem.experiments, named


def chosen(load, drag, first, second):
    augmented, train, named = fitted(load, drag)
    base = augmented.base_fitter.fit(train, seed_sequence(1), {}, FROM_START)
    candidates = named[first], named[second]
    fitter = augmented.fitter(candidates)
    fit = fitter.fit(train, seed_sequence(2), base.by_parameter, FROM_START)
    gain = fit.log_likelihood - base.log_likelihood
    return augmented, train, base, Refit((0, 1), candidates, fitter, fit, gain, 2.0 * COST)


def without(augmented, train, both):
    screen = SimpleNamespace(groups=np.arange(2), family=SimpleNamespace(cost=lambda label: COST))
    return needed_only(augmented, screen, both, train, seed_sequence(3), Checkpoint(None, {}),
                       "leaving out", None)  # fmt: skip


def test_what_came_first_and_is_nothing_beside_the_second_goes():
    augmented, train, base, both = chosen(0.3, 0.0, "quadratic drag", "constant load")
    kept = without(augmented, train, both)
    assert [c.effect.name for c in kept.candidates] == ["constant load"]
    assert kept.index == (1,)
    assert kept.cost == pytest.approx(COST)
    assert 0.0 <= both.gain - kept.gain + 0.05 < NEEDED + 0.05
    own = augmented.fitter(kept.candidates).fit(train, seed_sequence(4), base.by_parameter,
                                                FROM_START)  # fmt: skip
    assert kept.gain == pytest.approx(own.log_likelihood - base.log_likelihood, abs=0.05)
    assert kept.strengths[0] == pytest.approx(0.3, abs=0.05)


@pytest.mark.parametrize("first", ["quadratic drag", "constant load"])
def test_what_both_gain_by_stays(first):
    (second,) = {"quadratic drag", "constant load"} - {first}
    augmented, train, _, both = chosen(0.3, 0.05, first, second)
    assert without(augmented, train, both) is both


def test_mechanisms_have_places_of_their_own_in_a_second_round():
    """Laws of the noise fit what an approximate formula leaves, and stood in all places."""
    heights = 9.0 - 0.5 * np.arange(8)
    found = _followers(screen_of(heights, np.eye(8), "nnnummmm"))
    assert found == [0, 3, 4, 5, 6]
    assert _followers(screen_of(heights[:5], np.eye(5), "mmmmm")) == [0, 1, 2]
