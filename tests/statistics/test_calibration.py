"""Simulation-based calibration of PGAS and PMMH; see `sbc.py`, which also makes the docs' table."""

from __future__ import annotations

import os

import numpy as np
import pytest

import ssmppl as ssm

from .checks import LEVEL
from .sbc import (
    APPROXIMATED,
    BINS,
    BLOCKS,
    DELAYED,
    KEPT,
    STUDIES,
    WIDER,
    calibrate,
    histogram,
    uniform_p,
)

SETS = int(os.environ.get("SSMPPL_SBC_SETS", "24"))  # `make exhaustive` asks for 100
QUANTITIES = sum(len(study.ranked) for study in STUDIES.values())


def test_statistic_knows_uniform_from_not():
    rng = np.random.default_rng(3)
    ranks = rng.integers(0, KEPT + 1, 20_000)
    assert histogram(ranks).sum() == len(ranks)
    assert len(histogram(ranks)) == BINS
    assert uniform_p(ranks) > LEVEL
    # a posterior too narrow puts the truth into the outer ranks: a U, beyond doubt at 2,000 ranks
    narrow = np.floor((KEPT + 1) * rng.beta(0.7, 0.7, 2_000)).astype(int)
    assert uniform_p(narrow) < LEVEL


# The studies of joint blocks, interweaved moves, eliminated parameters and of the wider models take
# hours together, those of chains by the Gaussian approximation likewise but for a few.
LONG = [
    n for n, s in STUDIES.items()
    if s.model in {*BLOCKS, *WIDER, *DELAYED}
    or "interweaved" in s.label or "eliminated" in s.label
    or n == "two_states PMMH"
    or (s.model in ("regression", "two_states") and s.method in APPROXIMATED)
    or n in ("counts ISMCMC", "proper_varves ISMCMC")
]  # fmt: skip
NAMES = [pytest.param(n, marks=[pytest.mark.exhaustive] * (n in LONG)) for n in STUDIES]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_ranks_are_uniform(name):
    """Every parameter, and the state in the middle, over the first data sets."""
    study = STUDIES[name]
    # Chains of chains take longest: of those a third of the sets, unless all are asked for.
    few = isinstance(study.method, ssm.ISMCMC) and "SSMPPL_SBC_SETS" not in os.environ
    ranks, thin = calibrate(study, SETS // 3 if few else SETS)
    found = {q: uniform_p(column) for q, column in zip(study.ranked, ranks.T, strict=True)}
    print(f"{name}, thinned by {thin}: " + ", ".join(f"{q}: p={p:.3f}" for q, p in found.items()))
    assert min(found.values()) > LEVEL / QUANTITIES, found
