"""Simulation-based calibration of parameters that move on a transform of their own, correlation
matrices and ordered vectors, by every method that applies."""

from __future__ import annotations

import os

import pytest

import ssmppl as ssm

from .checks import LEVEL
from .sbc import APPROXIMATED, EXACT, METHODS, Study, calibrate, uniform_p

SETS = int(os.environ.get("SSMPPL_SBC_SETS", "24"))
PLAIN, PMMH, SMC2 = METHODS[0], METHODS[3], METHODS[4]
PARAMETERS = {
    "correlated": (("R[0, 1]", "R[0, 2]", "R[1, 2]", "sd[0]"), "x"),
    "sensors": (("R[0, 1]", "q"), "x"),
    "ordered_counts": (("rate[0]", "rate[1]", "stay"), "k"),
    "ordered_levels": (("level[0]", "level[1]", "a[0]", "a[1]"), "x"),
}
PAIRS = [
    *(("correlated", m) for m in (*EXACT, PLAIN, SMC2)),
    *(("sensors", m) for m in (PLAIN, METHODS[1], PMMH, SMC2, *APPROXIMATED)),
    *(("ordered_counts", m) for m in (PLAIN, PMMH, SMC2)),
    *(("ordered_levels", m) for m in (*EXACT, PLAIN, SMC2)),
]
STUDIES = {s.name: s for name, m in PAIRS for s in [Study(name, m, *PARAMETERS[name])]}
QUANTITIES = sum(len(s.ranked) for s in STUDIES.values())
LONG = {n for n, s in STUDIES.items() if isinstance(s.method, (ssm.ISMCMC, ssm.PMMH))}
NAMES = [pytest.param(n, marks=[pytest.mark.exhaustive] * (n in LONG)) for n in STUDIES]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_ranks_are_uniform(name):
    ranks, thin = calibrate(STUDIES[name], SETS)
    found = {q: uniform_p(c) for q, c in zip(STUDIES[name].ranked, ranks.T, strict=True)}
    print(f"{name}, thinned by {thin}: " + ", ".join(f"{q}: p={p:.3f}" for q, p in found.items()))
    assert min(found.values()) > LEVEL / QUANTITIES, found
