"""Moves of the twisted filter in loops: Gaussian integrals and conditionals, against SciPy's."""

import numpy as np
import pytest
from scipy import stats

from ssmppl.analysis.proposals import twisted
from ssmppl.codegen.kernels.twisted import twisting

D, R, N = 4, 3, 5
SIZE = D * (D + 1) // 2


def plain(name):
    return getattr(twisting, name).py_func


class Setting:
    """A guide, and a model x = f + L e, at random; L the same for all particles or not."""

    def __init__(self, varies):
        rng = np.random.default_rng(20 + varies)
        root = rng.normal(size=(D, D - 1))
        self.a = root @ root.T  # of the rank of a guide that knows nothing of one direction
        self.g, self.m = rng.normal(size=(2, D))
        self.rest = rng.normal(size=(D, N))
        self.spread = rng.normal(size=(D, R, N))
        if not varies:
            self.spread[:] = self.spread[:, :, :1]
        self.spread[1, 2] = 0.0
        self.varies = varies
        start, own = rng.normal(size=R), np.tril(rng.normal(size=(R, R)))
        own[np.diag_indices(R)] = rng.uniform(0.5, 2.0, size=R)
        self.start, self.start_factor = start, own
        lower, lower_r = np.tril_indices(D), np.tril_indices(R)
        self.s = np.concatenate([[R], self.a[lower], self.g, self.m, start, own[lower_r], [7.0]])
        self.x = rng.normal(size=(D, N))
        kept = R * (R + 1) // 2 if varies else 0
        self.fits = np.full((R + 1 + kept, N), np.nan)
        self.rng = rng

    def write_rest(self, theta, c, s, x, out):
        assert x is self.x
        out[:] = self.rest

    def write_spread(self, theta, c, s, x, states, out):
        n = x.shape[1]
        assert states.shape == x.shape
        out[:] = self.spread[:, :, :n].reshape(D * R, n)

    def spread_of(self, theta, c, s, x):
        return plain("spread_of")(self.write_spread, self.varies, theta, c, s, x)

    def kept_factors(self, theta, c, s, x, fits):
        return plain("kept_factors")(self.spread_of, self.varies, theta, c, s, x, fits)

    def fit(self):
        plain("twisted_fit")(
            self.write_rest, self.spread_of, self.varies, None, None, self.s, self.x, self.fits
        )
        return self.fits

    def conditional(self, i):
        """Mean and covariance of the i-th particle's noise under the guide."""
        spread = self.spread[:, :, i]
        covariance = np.linalg.inv(np.eye(R) + spread.T @ self.a @ spread)
        pull = self.g - self.a @ (self.rest[:, i] - self.m)
        return covariance @ spread.T @ pull, covariance


@pytest.fixture(params=[False, True], ids=["the same for all", "of each particle"])
def setting(request):
    return Setting(request.param)


def test_mean_and_expectation(setting):
    fits = setting.fit()
    for i in range(N):
        mean, covariance = setting.conditional(i)
        np.testing.assert_allclose(fits[:R, i], mean, rtol=1e-12)
        # E psi: the integrand's mode is the mean, and its curvature the inverse covariance
        away = setting.rest[:, i] + setting.spread[:, :, i] @ mean - setting.m
        log_psi = setting.g @ away - 0.5 * away @ setting.a @ away
        at_mode = log_psi + stats.norm.logpdf(mean).sum()
        expected = at_mode + 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
        assert fits[R, i] == pytest.approx(expected, rel=1e-12)
    log_w = np.empty(N)
    plain("twisted_look_ahead")(None, None, setting.s, setting.x, fits, log_w)
    np.testing.assert_array_equal(log_w, fits[R])


def test_a_particle_without_numbers_goes_by_the_transition(setting):
    setting.rest[2, 1] = -np.inf
    fits = setting.fit()
    np.testing.assert_array_equal(fits[:R, 1], 0.0)
    assert fits[R, 1] == -np.inf
    assert np.all(np.isfinite(np.delete(fits, 1, axis=1)))


def test_draws_and_their_density(setting):
    """Noise by its normals, and log f + log g - log q at that noise."""
    fits, draws = setting.fit(), {}
    normals = setting.rng.normal(size=R * N)
    uniforms = np.array([0.5, 0.999, 0.5 * twisting.DEFENSIVE, 0.1, 0.0])
    x = np.empty((D, N))

    def follow(theta, c, s, x_prev, e, states):
        draws["e"] = e.copy()
        states[:] = 1.0

    plain("twisted_draw")(
        setting.kept_factors, follow, None, None, setting.s, setting.x, fits, x, normals, uniforms,
        None,
    )  # fmt: skip
    assert np.all(x == 1.0)
    z, e = normals.reshape(R, N), draws["e"]
    for i in range(N):
        mean, covariance = setting.conditional(i)
        if uniforms[i] < twisting.DEFENSIVE:
            np.testing.assert_array_equal(e[:, i], z[:, i])
            continue
        # of this covariance: the normals are those that the factor C takes it back to
        factor = np.linalg.cholesky(np.linalg.inv(covariance))
        np.testing.assert_allclose(factor.T @ (e[:, i] - mean), z[:, i], rtol=1e-10)

    def recover(theta, c, s, x_prev, states, out):
        out[:] = e

    def weigh_observed(theta, c, s, states, log_w):
        log_w[:] = 0.25

    log_w = np.full(N, np.nan)
    plain("twisted_weigh")(
        setting.kept_factors, recover, weigh_observed, None, None, setting.s, setting.x, fits, x,
        log_w,
    )  # fmt: skip
    for i in range(N):
        q = stats.multivariate_normal.pdf(e[:, i], *setting.conditional(i))
        f = stats.norm.pdf(e[:, i]).prod()
        share = twisting.DEFENSIVE
        assert log_w[i] == pytest.approx(0.25 - np.log(share + (1 - share) * q / f), rel=1e-10)


def test_the_first_state(setting):
    normals, x, draws = setting.rng.normal(size=R * N), np.empty((D, N)), {}

    def begin(theta, c, s, e, states):
        draws["e"] = e.copy()

    plain("twisted_draw_initial")(begin, None, None, setting.s, x, normals, np.full(N, 0.5), None)
    e, factor = draws["e"], setting.start_factor
    expected = setting.start[:, None] + np.linalg.solve(factor.T, normals.reshape(R, N))
    np.testing.assert_allclose(e, expected, rtol=1e-12)

    def recover(theta, c, s, states, out):
        out[:] = e

    def weigh_observed(theta, c, s, states, log_w):
        log_w[:] = -1.0

    log_w = np.empty(N)
    plain("twisted_weigh_initial")(recover, weigh_observed, None, None, setting.s, x, log_w)
    covariance = np.linalg.inv(factor @ factor.T)
    q = stats.multivariate_normal.pdf(e.T, setting.start, covariance)
    f = stats.norm.pdf(e).prod(axis=0)
    share = twisting.DEFENSIVE
    np.testing.assert_allclose(log_w, -1.0 - np.log(share + (1 - share) * q / f), rtol=1e-10)


def test_weights_of_noise_a_thousand_spreads_away(setting):
    """Neither the density's ratio nor its reciprocal is a number there."""
    e = np.zeros((R, N))
    e[0] = [1e3, -1e3, 40.0, 1e6, 0.0]
    log_w = np.zeros(N)
    root = np.zeros((R * (R + 1) // 2, 1))
    root[[0, 2, 5]] = 3.0  # a third of the transition's spread
    twisting.twisted_ratio(e, np.zeros((R, 1)), root, log_w)
    far = -np.log(twisting.DEFENSIVE)
    near = -np.log(twisting.DEFENSIVE + (1 - twisting.DEFENSIVE) * 27)
    np.testing.assert_allclose(log_w, [far] * 4 + [near], rtol=1e-12)


def test_the_share_of_the_transition_is_that_of_the_analysis():
    assert twisting.DEFENSIVE == twisted.DEFENSIVE
