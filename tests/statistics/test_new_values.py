"""Simulation-based calibration where laws read new values, a draw of the step among them."""

import os

import pytest

import ssmppl as ssm

from .checks import LEVEL
from .sbc import Study, calibrate, uniform_p

SETS = int(os.environ.get("SSMPPL_SBC_SETS", "24"))
STUDIES = [
    Study("arrivals", method, ("phi", "q", "b"), "x")
    for method in (ssm.PGAS(particles=20, interweave=False), ssm.PMMH(particles=100))
]


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES, ids=lambda s: s.label)
def test_ranks_are_uniform(study):
    """Every parameter, and a state in the middle."""
    ranks, thin = calibrate(study, SETS)
    found = {q: uniform_p(column) for q, column in zip(study.ranked, ranks.T, strict=True)}
    print(f"{study.name}, thinned by {thin}: {found}")
    assert min(found.values()) > LEVEL / (len(STUDIES) * len(study.ranked)), found
