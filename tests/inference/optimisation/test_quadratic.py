"""The top of a function with noisy values: identities, and calibration where the top is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ssmppl.inference.optimisation.quadratic import (
    LocalQuadratic,
    count,
    fit_quadratic,
    monomials,
    slopes_of_monomials,
)
from tests.statistics.checks import LEVEL, seed_of

TOP = np.array([0.3, -0.2])
H = np.array([[1.0, -0.5], [-0.5, 0.8]])
C = np.array([0.05, -0.03])


def surface(u):
    """A skew log-likelihood with its top at TOP: a quadratic and cubes of what is off the top."""
    v = u - TOP
    return 2.0 - 0.5 * np.einsum("ni,ij,nj->n", v, H, v) + 0.08 * v[:, 0] ** 3 - 0.05 * v[:, 1] ** 3


def noise_sd(u):
    """Of the log of an estimate: twice as large on one side as on the other."""
    return 0.6 + 0.2 * np.tanh(u[:, 0])


def scattered(rng, n):
    half = 0.9 * rng.standard_normal((n // 2, 2))
    return np.vstack([half, -half])


def newton(fit):
    u = np.zeros(2)
    for _ in range(50):
        u = u + np.linalg.solve(fit.information(u), fit.slope(u))
    return u


def test_what_lies_in_the_family_is_found_exactly():
    u = scattered(np.random.default_rng(1), 60)
    b = np.array([0.2, 0.4])
    log_z = -3.0 + u @ b - 0.5 * np.einsum("ni,ij,nj->n", u, H, u) + (u @ C) * np.sum(u**2, axis=1)
    fit = fit_quadratic(u, log_z, True)
    np.testing.assert_allclose(fit.b, b, atol=1e-8)
    np.testing.assert_allclose(fit.h, H, atol=1e-8)
    np.testing.assert_allclose(fit.c, C, atol=1e-8)
    assert fit.misfit < 1e-15
    values, errors, vectors = fit.shape()
    np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, H, atol=1e-8)
    assert np.all(errors < 1e-7)


def test_derivatives_are_those_of_the_polynomial():
    u, step = np.array([0.3, -0.7]), 1e-5
    x, found = monomials(u[None], True), slopes_of_monomials(u, True)
    assert x.shape == (1, count(2, True))
    for i, e in enumerate(step * np.eye(2)):
        up, down = monomials((u + e)[None], True), monomials((u - e)[None], True)
        np.testing.assert_allclose(found[i], (up - down)[0] / (2 * step), atol=1e-9)
    fit = LocalQuadratic(np.array([0.2, 0.4]), H, C, np.eye(count(2, True)), 0.0)
    minus = [(fit.slope(u + e) - fit.slope(u - e)) / (2 * step) for e in step * np.eye(2)]
    np.testing.assert_allclose(fit.information(u), -np.array(minus), atol=1e-9)
    beta = np.concatenate([[0.0], fit.b, [-H[0, 0] / 2, -H[1, 0], -H[1, 1] / 2], C])
    np.testing.assert_allclose(slopes_of_monomials(u, True) @ beta, fit.slope(u), atol=1e-12)


def tops(skew, values, n=120, repeats=400):
    """(R, 2) tops and (R, 2) errors told, from independent noisy values."""
    rng = np.random.default_rng(seed_of("tops"))
    found = []
    for _ in range(repeats):
        u = scattered(rng, n)
        fit = fit_quadratic(u, values(u, rng), skew)
        top = newton(fit)
        found.append((top, np.sqrt(np.diagonal(fit.error(top)))))
    return np.array([t for t, _ in found]), np.array([e for _, e in found])


def unbiased(u, rng):
    """Estimates of the likelihood with mean exp(surface)."""
    sd = noise_sd(u)
    return surface(u) + sd * rng.standard_normal(len(u)) - 0.5 * sd**2


def z_scores(found, errors):
    return (found - TOP) / errors


def test_the_top_and_its_error_are_right():
    """The noise differs from place to place and the function is skew: neither moves the top by a
    fifth of the error of one fit, and the errors told are those there are."""
    found, errors = tops(True, unbiased)
    z = z_scores(found, errors)
    assert np.all(np.abs(z.mean(axis=0)) < 0.2 + stats.norm.isf(LEVEL / 4) / np.sqrt(len(z)))
    assert np.all(np.abs(np.std(z, axis=0) - 1.0) < 0.1 + 4.0 / np.sqrt(2 * len(z)))


def test_without_its_two_corrections_the_top_is_off():
    """What the test above would see: a plain quadratic, and biased logs."""
    skewless, errors = tops(False, unbiased)
    assert np.max(np.abs(z_scores(skewless, errors).mean(axis=0))) > 0.5
    found, errors = tops(
        True,
        lambda u, rng: surface(u) - 0.5 * noise_sd(u) ** 2 + 0.05 * rng.standard_normal(len(u)),
    )  # logs taken for unbiased
    assert np.max(np.abs((found - TOP).mean(axis=0))) > 0.05


def test_estimates_of_zero_count_and_too_few_do_not_do():
    rng = np.random.default_rng(2)
    u = scattered(rng, 400)
    dead = rng.uniform(size=400) < 0.3  # alive estimates are larger, so that the mean is right
    log_z = np.where(dead, -np.inf, surface(u) - np.log(0.7))
    fit = fit_quadratic(u, log_z, True)
    off = np.abs(newton(fit) - TOP) / np.sqrt(np.diagonal(fit.error(newton(fit))))
    assert np.all(off < stats.norm.isf(LEVEL / 4))
    assert fit_quadratic(u[:6], log_z[:6], True) is None
    assert fit_quadratic(u, np.full(400, -np.inf), True) is None


@pytest.mark.parametrize("skew", [False, True])
def test_the_errors_of_the_shape(skew):
    """Standard errors of the eigenvalues of H are those that there are."""
    rng, values, told = np.random.default_rng(3), [], []
    for _ in range(300):
        u = scattered(rng, 120)
        log_z = -0.5 * np.sum(u**2 * [2.0, 0.5], axis=1)
        log_z = log_z + 0.3 * rng.standard_normal(120) - 0.045
        found, errors, _ = fit_quadratic(u, log_z, skew).shape()
        values.append(found)
        told.append(errors)
    ratio = np.std(values, axis=0) / np.mean(told, axis=0)
    assert np.all(np.abs(ratio - 1.0) < 0.1 + 4.0 / np.sqrt(2 * 300))
