"""Simulation-based calibration of parameters that move on a transform of their own, correlation
matrices and ordered vectors, by every method that applies."""

from __future__ import annotations

import os

import numpy as np
import pytest

import ssmppl as ssm

from .checks import LEVEL, assert_within, deviations, seed_of
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
SHORT = {
    s.name
    for s in STUDIES.values()
    if s.name.startswith("ordered_levels")
    and isinstance(s.method, (ssm.Gibbs, ssm.MetropolisHastings))
} | {"ordered_counts PGAS"}
LONG = set(STUDIES) - SHORT  # minutes each; the moments below are of all methods
NAMES = [pytest.param(n, marks=[pytest.mark.exhaustive] * (n in LONG)) for n in STUDIES]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_ranks_are_uniform(name):
    ranks, thin = calibrate(STUDIES[name], SETS)
    found = {q: uniform_p(c) for q, c in zip(STUDIES[name].ranked, ranks.T, strict=True)}
    print(f"{name}, thinned by {thin}: " + ", ".join(f"{q}: p={p:.3f}" for q, p in found.items()))
    assert min(found.values()) > LEVEL / QUANTITIES, found


# -- posteriors by quadrature, in models whose states tell nothing of the parameters
METHODS_OF_EXACT = {
    "Gibbs": ssm.Gibbs(),
    "MetropolisHastings": ssm.MetropolisHastings(),
    "PGAS": ssm.PGAS(particles=5),
    "PMMH": ssm.PMMH(particles=5),
    "SMC2": ssm.SMC2(parameters=2000, particles=5),
}
Y = np.array([[0.3, 0.9], [1.2, 1.0], [-0.5, 0.1], [2.0, 1.4], [0.1, -0.3]])


def pair():
    """Noises of one correlation, the states apart."""
    model = ssm.Model("pair")
    model.prior(lambda: {"R": ssm.LKJ(2, 1.5)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda x, R: {"y": ssm.MvNormal(np.zeros(2) + 0.0 * x, covariance=R)})
    return model


def levels():
    """Two levels in order, one observation of each a row."""
    model = ssm.Model("levels")
    model.prior(lambda: {"level": ssm.Ordered(ssm.Normal(np.zeros(2), sd=1.5))})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda x, level: {"y": ssm.Normal(level + 0.0 * x, sd=1.2)})
    return model


def moments(weight, *values):
    weight = weight / weight.sum()
    means = [float((weight * v).sum()) for v in values]
    return [
        (m, float(np.sqrt((weight * (v - m) ** 2).sum())))
        for m, v in zip(means, values, strict=True)
    ]


def exact_pair():
    r = np.linspace(-0.9999, 0.9999, 20_001)
    square = np.sum(Y**2), np.sum(Y[:, 0] * Y[:, 1])
    log = -0.5 * len(Y) * np.log1p(-(r**2)) - 0.5 * (square[0] - 2 * r * square[1]) / (1 - r**2)
    return moments(np.exp(log) * np.sqrt(1 - r**2), r)


def exact_levels():
    grid = np.linspace(-4, 5, 1801)
    a, b = grid[:, None], grid[None, :]
    sums = [sum(-0.5 * ((v - m) / 1.2) ** 2 for v in Y[:, k]) for k, m in enumerate((a, b))]
    log = sums[0] + sums[1] - 0.5 * (a**2 + b**2) / 1.5**2
    return moments(np.where(a < b, np.exp(log - log.max()), 0.0), a + 0 * b, b + 0 * a)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS_OF_EXACT)
@pytest.mark.parametrize("of", ["pair", "levels"])
def test_draws_have_the_moments_of_the_posterior(of, name):
    model = {"pair": pair, "levels": levels}[of]()
    exact = {"pair": exact_pair, "levels": exact_levels}[of]()
    idata = ssm.sample(
        model, {"y": Y}, METHODS_OF_EXACT[name], draws=2000 if name != "SMC2" else 500,
        warmup=500, chains=4, seed=seed_of("exact", of, name), progress=False,
    )  # fmt: skip
    posterior = idata["posterior"]
    drawn = (
        [posterior["R"].values[..., 0, 1]] if of == "pair"
        else [posterior["level"].values[..., k] for k in range(2)]
    )  # fmt: skip
    for values, (mean, sd) in zip(drawn, exact, strict=True):
        assert_within(deviations(values, mean=mean, sd=sd))
