"""Linear Gaussian models for smoothers, with exact moments, and checks of moments over runs."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import stats

import ssmppl as ssm
from ssmppl.data import check_parameters
from ssmppl.inference.run.problem import pose
from tests.models import standard as models
from tests.statistics.checks import seed_of
from tests.statistics.exact import DenseGaussian
from tests.statistics.test_likelihood import with_gaps

LEVEL = 0.001  # chance of a false alarm over one table of moments
LIMIT = 4.0  # standard errors that a moment may lie off, where the table is small

# --- two damped oscillators, coupled, of which two sums are measured -----------------------------

four_states = ssm.Model("four states")

A = np.array([
    [0.9, 0.25, 0.05, 0.0], [-0.25, 0.9, 0.0, 0.05], [0.1, 0.0, 0.6, 0.4], [0.0, 0.1, -0.4, 0.6]
])  # fmt: skip
ROOT = np.array([
    [0.5, 0.0, 0.0, 0.0], [0.2, 0.5, 0.0, 0.0], [0.0, 0.1, 0.6, 0.0], [0.1, 0.0, -0.2, 0.6]
])  # fmt: skip
C = np.array([[1.0, 0.0, 0.5, 0.0], [0.0, 1.0, 0.0, -0.5]])


@four_states.initial
def four_initial():
    return {"x": ssm.MvNormal(np.zeros(4), covariance=np.eye(4))}


@four_states.transition
def four_transition(x):
    return {"x": ssm.MvNormal(A @ x, covariance=ROOT @ ROOT.T)}


@four_states.observation
def four_observation(x):
    return {"y": ssm.Normal(C @ x, sd=0.8)}


FOUR_MATRICES = {
    "m": np.zeros(4), "P": np.eye(4), "A": A, "b": np.zeros(4), "Q": ROOT @ ROOT.T, "C": C,
    "d": np.zeros(2), "R": 0.64 * np.eye(2),
}  # fmt: skip

CASES = {
    "four states": (four_states, {}, lambda: FOUR_MATRICES, 30),
    "one state, gaps": (models.lgss, {"theta": 1.0, "c": 0.5}, models.lgss_matrices, 40),
    "ar2": (models.ar2, {}, lambda: models.AR2_MATRICES, 30),
    "echo": (models.echo, {"g": 0.8}, models.echo_matrices, 30),
    "vehicle": (models.vehicle, {"h": 0.5}, models.vehicle_matrices, 25),
}


@cache
def smoothing_case(label):
    """(problem, theta, exact `DenseGaussian`, data, parameters), a quarter of the data missing."""
    model, parameters, matrices, steps = CASES[label]
    d = ssm.simulate(model, parameters, steps=steps, seed=seed_of("smoothing case", label))
    y = np.asarray(d["y"].values[0])
    y = with_gaps(y, 0.25, "smoothing case", label)
    problem = pose(model, {"y": y})
    exact = DenseGaussian(y, **matrices(**parameters))
    return problem, check_parameters(problem.trace, parameters), exact, {"y": y}, parameters


def exact_moments(exact):
    """Mean (T, D), covariance (T, D, D) and covariance with the step before (T - 1, D, D)."""
    steps, d = exact.mean.shape
    full = exact.covariance.reshape(steps, d, steps, d)
    t = np.arange(steps)
    return exact.mean, full[t, :, t], full[t[1:], :, t[:-1]]


def moments_of(paths, exact):
    """The same of draws (M, T, D), round the exact means, so that only the smoother is biased."""
    z = paths - exact.mean
    return (
        paths.mean(0), np.einsum("mti,mtj->tij", z, z) / len(z),
        np.einsum("mti,mtj->tij", z[:, 1:], z[:, :-1]) / len(z),
    )  # fmt: skip


def deviations(runs, exact, names=("mean", "covariance", "pair")):
    """By kind of moment, deviations in standard errors over independent runs, one flat array."""
    out = {}
    for k, (name, truth) in enumerate(zip(names, exact_moments(exact), strict=True)):
        found = np.array([run[k] for run in runs])
        error = found.std(0, ddof=1) / np.sqrt(len(runs))
        off = found.mean(0) - truth
        known = error < 1e-12  # deterministic
        np.testing.assert_allclose(off[known], 0.0, atol=1e-9)
        out[name] = off[~known] / error[~known]
    return out


def assert_moments(runs, exact, label):
    """All moments within 4 standard errors, or what Student's t allows over so many of them."""
    for name, z in deviations(runs, exact).items():
        limit = max(LIMIT, float(stats.t.isf(LEVEL / (2 * z.size), len(runs) - 1)))
        worst = float(np.max(np.abs(z)))
        print(f"{label} {name}: {z.size} moments, rms {np.sqrt(np.mean(z**2)):.2f}, "
              f"worst {worst:.2f} of {limit:.2f}")  # fmt: skip
        assert worst <= limit, (label, name, np.round(z, 1))
