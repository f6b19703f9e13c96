"""The Kalman filter where covariances settle, against the textbook's recursion in long doubles."""

import numpy as np
import pytest

from ssmppl.codegen.kernels.kalman.square_root import OK, kalman_filter, rests

STEPS = 400
NAMES = (
    "log_increment", "mean", "covariance", "mean_predicted", "covariance_predicted",
    "observation_mean", "observation_covariance",
)  # fmt: skip


def textbook(m, P, A, b, Q, C, d, R, y, seen):
    """All moments by covariances, every step anew (Kalman 1960), R diagonal: one y at a time."""
    wide = (np.asarray(v, dtype=np.longdouble) for v in (m, P, A, b, Q, C, d, R, y))
    m, P, A, b, Q, C, d, R, y = wide
    rows = []
    for t in range(len(y)):
        if t > 0:
            m, P = A @ m + b[t], A @ P @ A.T + Q
        predicted = m, P, C @ m + d[t], C @ P @ C.T + R
        increment = np.longdouble(0.0)
        for j in np.flatnonzero(seen[t]):
            spread, error = C[j] @ P @ C[j] + R[j, j], y[t, j] - d[t, j] - C[j] @ m
            gain = P @ C[j] / spread
            m, P = m + gain * error, P - np.outer(gain, gain) * spread
            increment -= 0.5 * (np.log(2 * np.longdouble(np.pi) * spread) + error**2 / spread)
        rows.append((increment, m, P, *predicted))
    return [np.array([row[i] for row in rows], dtype=float) for i in range(len(NAMES))]


def seen_rows(pattern, k):
    seen = np.ones((STEPS, k))
    if pattern == "gaps":
        seen[150:153] = 0.0
        seen[250, 0] = 0.0
    elif pattern == "every other":
        seen[::2, 0] = 0.0
    elif pattern == "one sensor fails":
        seen[200:, 0] = 0.0
    return seen


def run(d, k, rank, pattern):
    """(what the kernel finds, what the textbook finds)."""
    rng = np.random.default_rng([d, k, rank])
    a = rng.normal(size=(d, d))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    half = rng.normal(size=(d, rank))
    start = rng.normal(size=(d, d))
    given = (
        rng.normal(size=d), start @ start.T, a, rng.normal(size=(STEPS, d)), half @ half.T,
        rng.normal(size=(k, d)), rng.normal(size=(STEPS, k)), np.diag(rng.uniform(0.1, 2.0, k)),
    )  # fmt: skip
    y, seen = 3.0 * rng.normal(size=(STEPS, k)), seen_rows(pattern, k)
    shapes = ((), (d,), (d, d), (d,), (d, d), (k,), (k, k))
    out = [np.empty((STEPS, *s)) for s in shapes]
    m, p, a, b, q, c, offset, r = given
    matrices = (m, p, a[None], b, q[None], c[None], offset, r[None])
    assert kalman_filter(*matrices, np.where(seen > 0, y, np.nan), seen, *out) == (OK, STEPS)
    return out, textbook(*given, y, seen)


@pytest.mark.parametrize("pattern", ["all", "gaps", "every other", "one sensor fails"])
@pytest.mark.parametrize(("d", "k", "rank"), [(1, 1, 1), (3, 2, 3), (4, 2, 2), (12, 3, 12)])
def test_moments(d, k, rank, pattern):
    found, wanted = run(d, k, rank, pattern)
    for name, ours, exact in zip(NAMES, found, wanted, strict=True):
        scale = np.abs(exact).max()
        np.testing.assert_allclose(ours, exact, rtol=1e-10, atol=1e-12 * scale, err_msg=name)


@pytest.mark.parametrize(("d", "k"), [(1, 1), (4, 2), (12, 3)])
def test_covariances_settle_and_start_anew(d, k):
    """Bitwise equal from some row on, but not over a row that misses other components."""
    (_, _, covariance, *_), _ = run(d, k, d, "gaps")
    kept = [np.array_equal(covariance[t], covariance[t - 1]) for t in range(1, STEPS)]
    for rows in (slice(120, 149), slice(220, 249), slice(370, None)):
        assert all(kept[rows])
    for rows in (slice(149, 160), slice(249, 253)):
        assert not any(kept[rows])


def test_roots_at_rest():
    """But for rounding, whatever the signs of the columns."""
    root = np.array([[2.0, 3.0], [0.0, 4.0]])  # transposed: a column in each row
    last = root.copy()
    assert rests(root * np.array([[-1.0], [1.0]]), last)
    np.testing.assert_array_equal(last, root)
    root[0, 1] += 4e-14
    assert not rests(root, last)
    assert rests(root, last)
    root[0, 1] += 4e-15
    assert rests(root, last)


def test_what_is_learned_beside_what_no_data_tell():
    """Of two constants only the difference is measured, and each alone may be anything. In units of
    the rows of the root nothing moved from the first rows on, and the mean of the second half came
    in at the gain of then."""
    wide, steps = 1e9, 4000
    rng = np.random.default_rng(7)
    y = rng.normal(size=(steps, 1)) + 0.5 * (np.arange(steps) >= steps // 2)[:, None]
    shapes = ((), (2,), (2, 2), (2,), (2, 2), (1,), (1, 1))
    out = [np.empty((steps, *s)) for s in shapes]
    given = (
        np.zeros(2), wide**2 * np.eye(2), np.eye(2)[None], np.zeros((1, 2)), np.zeros((1, 2, 2)),
        np.array([[[1.0, -1.0]]]), np.zeros((1, 1)), np.ones((1, 1, 1)), y, np.ones((steps, 1)),
    )  # fmt: skip
    assert kalman_filter(*given, *out) == (OK, steps)
    n, ratio = np.arange(steps), 1.0 / (2.0 * wide**2)
    before = np.concatenate([[0.0], np.cumsum(y[:-1, 0])]) / (n + ratio)
    spread = 1.0 + 1.0 / (n + ratio)
    wanted = -0.5 * (np.log(2 * np.pi * spread) + (y[:, 0] - before) ** 2 / spread)
    np.testing.assert_allclose(out[0], wanted, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(out[5][:, 0], before, atol=1e-5)
