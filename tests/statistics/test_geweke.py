"""Joint-distribution tests (Geweke 2004) of all samplers; see `geweke.py`, which also makes the
docs' table, and `geweke_mutants.py`, the samplers made wrong that these tests have to find."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from . import geweke_kernels as kernels
from .checks import LEVEL, seed_of
from .geweke import (
    RENEW,
    STEPS,
    STUDIES,
    compare,
    first_data,
    joint_draws,
    judged,
    leverage_data,
    model_of,
)
from .geweke import least as bonferroni
from .geweke_mutants import ALARM, MUTANTS

SHORT = {"chains": 32, "sweeps": 30, "forward": 1000}
EXPECTED = {"PGAS", "PMMH", "Gibbs", "MetropolisHastings"}


def test_every_sampler_and_ten_models_are_studied():
    assert {type(s.method).__name__ for s in STUDIES.values()} == EXPECTED
    assert len({s.model for s in STUDIES.values()}) >= 10


def test_statistic_has_its_level_on_skew_means():
    """Of means of few squares, which a test by Student's t alone calls too small too often."""
    rng = np.random.default_rng(seed_of("geweke level"))
    direct = rng.standard_normal((5000, 400)) ** 2
    means = (rng.standard_normal((64, 4, 400)) ** 2).mean(axis=1)
    p = np.array([f.p for f in judged([""] * 400, direct, means)])
    assert stats.kstest(p, "uniform").pvalue > LEVEL
    assert bonferroni(judged([""] * 400, direct, means + 0.3)) < LEVEL


def transitions(name: str) -> kernels.Transitions:
    study = STUDIES[name]
    return kernels.prepare(
        model_of(study), study.method, first_data(study, 1), 0, 1, RENEW.get(study.model)
    )


def test_data_given_states_that_follow_them():
    """The hand-written law of the leverage model's data: its density ratios are the joint's."""
    made = transitions("leverage PGAS")
    theta, x, _ = joint_draws(made, 1, 5)
    (mu, phi, tau, k), path = theta[0], x[0][:, 0]
    rng = np.random.default_rng(6)
    precision = np.append(np.full(STEPS - 1, 1.0 + k * k * tau), 1.0)
    pull = np.append(k * tau * (path[1:] - mu - phi * (path[:-1] - mu)), 0.0)
    own, joint = [], []
    for _ in range(5):
        y = leverage_data(made.problem, theta[0], x[0], rng)
        made.write(y)
        joint.append(made.log_joint(theta[0], x[0]))
        e = y[:, 0] * np.exp(-path / 2)
        own.append(stats.norm.logpdf(e, pull / precision, precision**-0.5).sum())
    np.testing.assert_allclose(np.diff(joint), np.diff(own), rtol=1e-9, atol=1e-9)


def test_gaps_in_the_data_stay():
    made = transitions("bounded PGAS")
    e = made.problem.experiments[0]
    made.write(np.full(e.y.shape, 7.0))
    np.testing.assert_array_equal(e.y[e.seen == 0.0], 0.0)
    np.testing.assert_array_equal(e.y[e.seen == 1.0], 7.0)
    assert 0.0 < e.seen.mean() < 1.0


def test_short_run_tells_right_from_wrong():
    assert bonferroni(compare(STUDIES["counts PGAS"], **SHORT)) > LEVEL
    with MUTANTS["data never renewed"].at_work():
        assert bonferroni(compare(STUDIES["counts PGAS"], **SHORT)) < LEVEL


# One study of each sampler and each model; `make exhaustive` runs all.
SLOW = (
    "proper_varves PGAS", "regression PGAS eliminated", "two_states PMMH", "counts PGAS guided",
    "stationary MetropolisHastings", "vector_ar_apart Gibbs", "three_regimes Gibbs",
    "leverage PGAS", "ricker PMMH", "growth PGAS interweaved", "bounded PGAS", "delay PGAS",
    "delay Gibbs interweaved", "counts PMMH delayed", "proper_varves PMMH twisted",
)  # fmt: skip
NAMES = [pytest.param(n, marks=[pytest.mark.exhaustive] * (n not in SLOW)) for n in STUDIES]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_joint_distribution_is_left_invariant(name):
    found = compare(STUDIES[name])
    worst = min(found, key=lambda f: f.p)
    print(f"{name}: {worst.quantity} z={worst.z:+.2f}, p x functions = {bonferroni(found):.3g}")
    assert bonferroni(found) > ALARM, (name, worst)


FEW = ("wrong rate", "stationary initial law forgotten", "no Jacobian of the scale",
       "no prior in the ratio")  # fmt: skip
WEAK = {  # beyond the power of this length
    "no Jacobian of the scale, PMMH", "states of before", "given the other blocks of before",
}  # fmt: skip
MADE = [pytest.param(n, marks=[pytest.mark.exhaustive] * (n not in FEW)) for n in MUTANTS
        if n not in WEAK]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", MADE)
def test_wrong_samplers_are_found(name):
    assert MUTANTS[name].p(100) < ALARM
