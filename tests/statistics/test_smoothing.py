"""PGAS at known parameters samples the smoothing distribution, which a dense Gaussian knows.

Mean, standard deviation and covariance with the next step, of every state at every step: Bonferroni
over the table at 0.001, Monte Carlo errors computed from the draws. N = 5 where ancestors are
sampled, 200 where not.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.datasets import lgss_appendix, lgss_main_text
from tests.models import standard as models

from .checks import assert_moments, assert_within, deviations, seed_of, some
from .exact import DenseGaussian, GridPosterior
from .test_likelihood import vector_cells, with_gaps


def gaps_in(label, model, parameters, steps, share=0.2):
    d = ssm.simulate(model, parameters, steps=steps, seed=seed_of("smoothing", label))
    return with_gaps(d["y"].values[0], share, "smoothing", label)


@cache
def cases():
    """label -> (model, data, parameters, order of states, exact)."""
    out = {}
    y = lgss_appendix()[:40]
    parameters = {"theta": 1.0, "c": 1.0}
    exact = DenseGaussian(y, **models.lgss_matrices(**parameters))
    out["lgss"] = models.lgss, {"y": y}, parameters, ["x"], exact
    gappy = with_gaps(lgss_main_text()[:40], 0.25, "smoothing")
    parameters = {"theta": 1.0, "c": 0.5}
    exact = DenseGaussian(gappy, **models.lgss_matrices(**parameters))
    out["gaps"] = models.lgss, {"y": gappy}, parameters, ["x"], exact
    for label, model, data, _, _ in vector_cells():
        if model is models.machine:
            exact = DenseGaussian(data["y"], **models.machine_matrices(data["u"]))
            out["machine"] = model, data, {}, ["x", "s"], exact
        elif model is models.joint_channel:
            matrices = models.two_component_matrices(models.JOINT_COVARIANCE)
            out[label] = model, data, {}, ["x"], DenseGaussian(data["y"], **matrices)
    y = gaps_in("ar2", models.ar2, {}, 40)
    exact = DenseGaussian(y, **models.AR2_MATRICES)
    out["ar2"] = models.ar2, {"y": y}, {}, ["x", "before"], exact
    y = gaps_in("echo", models.echo, {"g": 0.8}, 40)
    exact = DenseGaussian(y, **models.echo_matrices(0.8))
    out["echo"] = models.echo, {"y": y}, {"g": 0.8}, ["x", "e"], exact
    y = gaps_in("vehicle", models.vehicle, {"h": 0.5}, 25)
    exact = DenseGaussian(y, **models.vehicle_matrices(0.5))
    out["vehicle"] = models.vehicle, {"y": y}, {"h": 0.5}, ["v", "p"], exact
    return out


def stacked(posterior, order):
    """States (chain, draw, T, D) in this order."""
    columns = [np.asarray(posterior[n].values) for n in order]
    return np.concatenate([c[..., None] if c.ndim == 3 else c for c in columns], axis=-1)


LABELS = ["lgss", "gaps", "one channel of two", "machine", "ar2", "echo"]
RUNS = [(label, proposal) for label in LABELS for proposal in ("bootstrap", "auxiliary")]
RUNS += [("vehicle", "bootstrap")]  # its observation does not depend on what has noise
STEERED = [("gaps", "twisted"), ("machine", "twisted")]


@pytest.mark.parametrize("draws", [2_000, pytest.param(20_000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize(
    ("label", "proposal"),
    [*some(RUNS, 3), *some(STEERED[:1], 0), *some(STEERED[1:], 0, pytest.mark.exhaustive)],
)
def test_smoother(label, proposal, draws):
    model, data, parameters, order, exact = cases()[label]
    particles = 200 if label == "vehicle" else 5
    idata = ssm.sample(
        model, data, ssm.PGAS(particles=particles, proposal=proposal), draws=draws, warmup=100,
        fixed=parameters, progress=False, seed=seed_of("smoother", label, proposal, draws),
    )  # fmt: skip
    assert idata["posterior"].attrs["ancestor_sampling"] == (label != "vehicle")
    found = stacked(idata["posterior"], order)
    assert_moments(found, exact, f"{label} {proposal} {draws}", len(RUNS) + len(STEERED))


PARAMETERS_OF_DIRAC = {
    "echo": (models.echo, models.echo_matrices, "g", 0.8, (0.0, 1.0), (-4.0, 5.0)),
    "vehicle": (models.vehicle, models.vehicle_matrices, "h", 0.5, (0.4, 0.2), (-0.8, 2.0)),
}


@pytest.mark.parametrize("draws", [1_500, pytest.param(10_000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("label", some(PARAMETERS_OF_DIRAC, 1))
def test_parameter_inside_a_deterministic_law(label, draws):
    model, matrices, name, value, (mean, sd), (lower, upper) = PARAMETERS_OF_DIRAC[label]
    y = gaps_in(label, model, {name: value}, 25)

    def log_density(v):
        return DenseGaussian(y, **matrices(v)).log_likelihood - 0.5 * ((v - mean) / sd) ** 2

    exact = GridPosterior(log_density, lower, upper)
    idata = ssm.sample(
        model, {"y": y}, ssm.PGAS(), draws=draws, warmup=300, progress=False,
        seed=seed_of("dirac", label, draws),
    )  # fmt: skip
    print(ssm.summary(idata).to_string(), exact.mean, exact.sd)
    assert_within(deviations(idata["posterior"][name].values, exact.mean, exact.sd))
