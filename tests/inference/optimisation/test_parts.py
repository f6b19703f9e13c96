"""What the parts of a sum tell of its second derivatives, against their exact values."""

import numpy as np
import pytest

from ssmppl.inference.optimisation.batched_newton import NEAR, climb_together
from ssmppl.inference.optimisation.parts import Parts, Predictions, parts_of, summed

ROWS = 300
RNG = np.random.default_rng(11)
X = RNG.normal(size=ROWS)
MIXED = np.array([[1.0, 0.3], [-0.4, 0.8]])


def moments(z):
    """Means (B, R, 2) and covariances (B, R, 2, 2) of two channels that are correlated: a line in
    x, and logarithms of two standard deviations."""
    scales = np.exp(z[:, 2:4])
    root = MIXED * scales[:, None, :]
    covariance = root @ root.transpose(0, 2, 1)
    line = z[:, :1] + z[:, 1:2] * X
    mean = np.stack([line, 0.5 * line + z[:, :1]], axis=-1)
    return mean, np.repeat(covariance[:, None], ROWS, axis=1)


TOP = np.array([0.5, -1.2, 0.3, -0.7])
MEAN, COVARIANCE = (part[0] for part in moments(TOP[None]))
Y = MEAN + np.einsum("rij,rj->ri", np.linalg.cholesky(COVARIANCE), RNG.normal(size=(ROWS, 2)))


def likelihood(z, predicted=True):
    mean, covariance = moments(np.asarray(z))
    error = Y - mean
    weighed = np.einsum("bri,brij,brj->br", error, np.linalg.inv(covariance), error)
    rows = -0.5 * (weighed + np.linalg.slogdet(covariance)[1] + 2.0 * np.log(2.0 * np.pi))
    prior = -0.5 * np.sum(z**2, axis=1)
    return Parts(
        np.column_stack([rows, prior]), Predictions(error, covariance) if predicted else None
    )


def information():
    """Exact: of a mean d' S^-1 d; of the logarithm of a standard deviation of independent noises
    2, whatever they are mixed by."""
    slopes = np.zeros((4, ROWS, 2))
    slopes[0] = [1.0, 1.5]
    slopes[1, :, 0], slopes[1, :, 1] = X, 0.5 * X
    out = np.einsum("fri,rij,grj->fg", slopes, np.linalg.inv(COVARIANCE), slopes)
    out[2, 2] = out[3, 3] = 2.0 * ROWS
    return out


def beside(z, h, sides):
    moved = [z + s * h * e for s in sides for e in np.eye(len(z))]
    return np.array([z, *moved])


@pytest.mark.parametrize("sides", [(1.0,), (1.0, -1.0)], ids=["one side", "both"])
def test_slopes_of_predictions_tell_the_expected_information(sides):
    h, bent = np.full(4, 1e-5), np.array([1.0, 2.0, 3.0, 4.0])
    found = likelihood(beside(TOP, 1e-5, sides)).information(h, bent)
    np.testing.assert_allclose(found, information() + np.diag(bent), rtol=1e-4, atol=1e-2)


def test_it_does_not_matter_how_far_off_the_predictions_are():
    """Where outer products of slopes are hundreds of times too large."""
    h, far = np.full(4, 1e-5), TOP + [20.0, 0.0, 0.0, 0.0]
    exact, nothing = information(), np.zeros(4)
    points = beside(far, 1e-5, (1.0, -1.0))
    np.testing.assert_allclose(
        likelihood(points).information(h, nothing), exact, rtol=1e-4, atol=1e-2
    )
    outer = likelihood(points, predicted=False).information(h, nothing)
    assert outer[0, 0] > 100.0 * exact[0, 0]


def test_rows_that_were_not_measured_tell_nothing():
    points = beside(TOP, 1e-5, (1.0, -1.0))
    whole = likelihood(points)
    error, covariance = whole.predictions.error.copy(), whole.predictions.covariance.copy()
    error[:, 100:], covariance[:, 100:] = 0.0, np.eye(2)
    found = Parts(whole.rows, Predictions(error, covariance)).information(
        np.full(4, 1e-5), np.zeros(4)
    )
    assert found[3, 3] == pytest.approx(200.0, rel=1e-4)


def test_outer_products_stand_in_where_a_covariance_has_no_root():
    points = beside(TOP, 1e-5, (1.0, -1.0))
    whole = likelihood(points)
    covariance = whole.predictions.covariance.copy()
    covariance[:, 7, 1] = covariance[:, 7, 0]
    h, nothing = np.full(4, 1e-5), np.zeros(4)
    found = Parts(whole.rows, Predictions(whole.predictions.error, covariance))
    expected = Parts(whole.rows).information(h, nothing)
    np.testing.assert_array_equal(found.information(h, nothing), expected)


@pytest.mark.filterwarnings("error")
def test_what_is_next_to_overflow_is_no_value_and_tells_nothing():
    """A point beside it runs away, as a model that is pushed too far does."""
    h, nothing = np.full(4, 1e-5), np.zeros(4)
    whole = likelihood(beside(TOP, 1e-5, (1.0, -1.0)))
    known = whole.information(h, nothing)
    rows, error = whole.rows.copy(), whole.predictions.error.copy()
    rows[2], error[2] = -1e305, 1e155
    away = Parts(rows, Predictions(error, whole.predictions.covariance))
    assert summed(away)[2] == -np.inf
    np.testing.assert_allclose(away.information(h, nothing), known, rtol=1e-3, atol=0.05)
    outer = Parts(rows).information(h, nothing)
    assert np.isfinite(outer).all()

    def runs_away(z):
        found = likelihood(z)
        found.rows[z[:, 1] > -1.0] = -1e305
        return found

    found = climb_together(runs_away, np.array([TOP + [0.5, 0.15, 0.2, 0.2]]), precise=False)
    assert summed(likelihood(found.z[None]))[0] > summed(likelihood(TOP[None]))[0] - 5.0


def test_where_nothing_is_free_there_is_no_information():
    nothing = np.empty(0)
    assert likelihood(TOP[None]).information(nothing, nothing).shape == (0, 0)
    found = climb_together(lambda z: likelihood(TOP[None]), np.empty((1, 0)))
    assert found.ended
    assert found.top.distance == 0.0
    assert found.top.information.shape == (0, 0)


def test_points_without_a_prior_density_have_no_value_and_leave_the_others_alone():
    z = np.array([TOP, TOP + 1.0, TOP + 2.0])

    def increments(theta):
        found = likelihood(theta)
        return found.rows[:, :-1], found.predictions

    found = parts_of(increments, z, np.array([-1.0, -np.inf, -2.0]))
    whole = likelihood(z)
    assert summed(found)[1] == -np.inf
    np.testing.assert_allclose(summed(found)[[0, 2]], whole.rows[[0, 2], :-1].sum(1) - [1.0, 2.0])
    np.testing.assert_array_equal(found.predictions.error[2], whole.predictions.error[2])
    assert summed(parts_of(increments, z, np.full(3, -np.inf))).max() == -np.inf


def test_a_climb_by_them_takes_fewer_points_to_the_same_top():
    def climbed(predicted):
        asked = []

        def counted(z):
            asked.append(len(z))
            return likelihood(z, predicted)

        start = TOP + [3.0, 2.0, 1.0, -2.0]
        return climb_together(counted, start[None], precise=False), sum(asked)

    (found, points), (same, more) = climbed(True), climbed(False)
    exact = information() + np.eye(4)
    away = found.z - same.z
    assert 0.5 * away @ exact @ away < 4.0 * NEAR
    assert points < 0.7 * more
    np.testing.assert_allclose(found.information, exact, rtol=0.3, atol=0.1 * exact.max())
