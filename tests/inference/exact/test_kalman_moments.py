"""Exact smoothing and sampling of whole models, against the dense Gaussian of the same laws."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.errors import SamplingError
from ssmppl.inference.exact import kalman
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.exact.kalman_matrices import drawn_by_correction
from ssmppl.inference.run.problem import pose
from tests.models.kalman import MODELS, posed, scalar
from tests.statistics.checks import seed_of


def joint(dense, experiment):
    """Mean (T, D) and covariance (T, D, T, D) of all states given the data."""
    steps = experiment.steps
    target = np.concatenate([x[0] for x in dense.x]), np.concatenate([x[1] for x in dense.x])
    mean, covariance = dense.given(target, experiment.y, experiment.seen, steps)
    return mean.reshape(steps, -1), covariance.reshape(steps, len(mean) // steps, steps, -1)


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("build", MODELS)
def test_smoother_is_the_dense_gaussian(build, missing):
    traced, theta, experiment, dense = posed(build, missing)
    model = kalman_model(traced)
    found = model.smooth(experiment, theta)
    mean, covariance = joint(dense, experiment)
    upto = dense.log_likelihood(experiment.y, experiment.seen, experiment.steps)
    assert found.log_likelihood == pytest.approx(upto, abs=1e-9)
    np.testing.assert_allclose(found.mean, mean, atol=1e-9)
    for t in range(experiment.steps):
        np.testing.assert_allclose(found.covariance[t], covariance[t, :, t], atol=1e-9)
        if t:
            np.testing.assert_allclose(found.cross[t], covariance[t, :, t - 1], atol=1e-9)
    noises = model.disturbances(experiment, theta)
    forms = model.matrices(experiment, theta)
    a, b = (np.broadcast_to(f, (experiment.steps, *f.shape[1:])) for f in (forms.A, forms.b))
    step = mean[1:] - np.einsum("tij,tj->ti", a[1:], mean[:-1]) - b[1:]
    np.testing.assert_allclose(noises.state_mean[1:], step, atol=1e-9)


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("build", MODELS)
def test_draws_are_of_the_dense_gaussian(build, together):
    """Many draws at once go back by square roots, a single one by the mean of another record."""
    traced, theta, experiment, dense = posed(build, 0.3)
    stream = new_state(np.random.SeedSequence(seed_of("kalman draws", build.__name__, together)))
    model = kalman_model(traced)
    if together:
        draws = model.draw(experiment, theta, stream, 4_000)
    else:
        matrices = model.matrices(experiment, theta)
        start = matrices.m[:, None].copy()
        one = [drawn_by_correction(matrices, start, [experiment], stream) for _ in range(4_000)]
        draws = np.concatenate([d[0] for d in one])  # none of them is None
    mean, covariance = joint(dense, experiment)
    size = mean.size
    x, c = draws.reshape(len(draws), size) - mean.ravel(), covariance.reshape(size, size)
    spread = np.sqrt((np.outer(np.diag(c), np.diag(c)) + c**2) / len(draws))
    assert (np.abs(x.mean(0)) <= 5 * np.sqrt(np.diag(c).clip(0) / len(draws)) + 1e-9).all()
    assert (np.abs(x.T @ x / len(draws) - c) <= 5 * spread + 1e-9).all()


def trend(vague, growth=1.0, rows=120):
    """A level with a slope, measured in most rows, posed with its Kalman model."""
    made = ssm.Model("trend")
    made.initial(lambda: {"x": ssm.Normal(0, sd=vague), "v": ssm.Normal(0, sd=1)})
    made.transition(lambda x, v: {"x": ssm.Normal(growth * x + v, sd=0.1), "v": ssm.Dirac(v)})
    made.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    rng = np.random.default_rng(seed_of("trend", rows))
    y = 3.0 + 0.2 * np.arange(rows) + rng.normal(size=rows)
    y[::7] = np.nan
    problem = pose(made, {"y": y})
    return kalman_model(problem.trace), problem.experiments[0]


@pytest.mark.parametrize(
    ("vague", "growth", "sure"),
    [(1.0, 1.0, True), (100.0, 0.9, True), (1e9, 1.0, False), (1.0, 1.4, False)],
)
def test_what_rounding_has_eaten_is_drawn_in_the_other_way(monkeypatch, vague, growth, sure):
    """A start that is next to unknown, and a model that grows until only its end is known."""
    model, e = trend(vague, growth)
    matrices = model.matrices(e, np.empty(0))
    start = matrices.m[:, None].copy()
    stream = new_state(np.random.SeedSequence(seed_of("rounding", vague, growth)))
    quick = [drawn_by_correction(matrices, start, [e], stream) for _ in range(300)]
    assert all((d is not None) is sure for d in quick)
    exact = model.smooth(e, np.empty(0))
    monkeypatch.setattr(kalman, "LEAST_STATES", 1)
    draws = np.concatenate([model.draw(e, np.empty(0), stream) for _ in range(300)])
    sd = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2))
    assert np.all(np.abs(draws.mean(0) - exact.mean) < 5.5 * sd / np.sqrt(300) + 1e-9)
    assert np.all(draws.std(0) < 1.35 * sd + 1e-9)
    assert np.all(draws.std(0) > 0.7 * sd - 1e-9)


def test_a_single_draw_keeps_what_is_deterministic(monkeypatch):
    """To the last digit: a slope without noise, and a state that is another one's past."""
    monkeypatch.setattr(kalman, "LEAST_STATES", 1)
    model, e = trend(1.0)
    draw = model.draw(e, np.empty(0), new_state(np.random.SeedSequence(1)))[0]
    np.testing.assert_allclose(draw[:, 1], draw[0, 1], rtol=1e-13)


def several(moved=False):
    """Five records of one model: of other lengths, two of them with a row of their own missing;
    moved by an input of their own, or alike."""
    made = ssm.Model("panel", inputs=("u",) if moved else ())
    made.prior(lambda: {"phi": ssm.Uniform(-1, 1), "q": ssm.HalfNormal(sd=1)})
    made.initial(lambda: {"x": ssm.Normal(1, sd=2), "v": ssm.Normal(0, sd=0.5)})
    if moved:
        made.transition(lambda x, v, u, phi, q: {
            "x": ssm.Normal(phi * u * x + v, sd=q), "v": ssm.Normal(0.9 * v, sd=0.2)
        })  # fmt: skip
    else:
        made.transition(
            lambda x, v, phi, q: {
                "x": ssm.Normal(phi * x + v, sd=q),
                "v": ssm.Normal(0.9 * v, sd=0.2),
            }
        )
    made.observation(
        lambda x, v: {"y": ssm.Normal(x + 0.3, sd=0.5), "z": ssm.Normal(x - v, sd=0.8)}
    )
    rng = np.random.default_rng(seed_of("several"))
    data = [{"y": rng.normal(size=n), "z": rng.normal(size=n)} for n in (5, 9, 7, 9, 3)]
    data[2]["y"][3], data[3]["z"][8], data[3]["y"][0] = np.nan, np.nan, np.nan
    for d in data if moved else []:
        d["u"] = rng.uniform(0.2, 1.4, size=len(d["y"]))
    return pose(made, data)


@pytest.mark.parametrize("moved", [False, True])
def test_records_that_share_their_matrices_are_filtered_in_one_call(moved):
    problem, theta = several(moved), np.array([0.7, 0.4])
    model = kalman_model(problem.trace)
    each = [model.log_likelihood([e], theta) for e in problem.experiments]
    together = model.log_likelihood(problem.experiments, theta)
    assert together == pytest.approx(sum(each), abs=1e-10)
    reverse = model.log_likelihood(problem.experiments[::-1], theta)
    assert reverse == pytest.approx(sum(each), abs=1e-10)
    assert model.log_likelihood(problem.experiments, np.array([0.7, np.nan])) == -np.inf


def test_records_that_share_their_matrices_are_drawn_in_one_call(monkeypatch):
    problem, theta, count = several(), np.array([0.7, 0.4]), 3_000
    model = kalman_model(problem.trace)
    monkeypatch.setattr(type(model), "draw", None)  # not one by one
    stream = new_state(np.random.SeedSequence(seed_of("several draws")))
    streams = [stream] * len(problem.experiments)
    drawn = [model.draw_each(problem.experiments, theta, streams) for _ in range(count)]
    for i, e in enumerate(problem.experiments):
        found = model.smooth(e, theta)
        x = np.concatenate([d[i] for d in drawn])
        assert x.shape == (count, e.steps, 2)
        sd = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        assert np.all(np.abs(x.mean(0) - found.mean) < 5 * sd / np.sqrt(count))
        assert np.all(np.abs(x.var(0) / sd**2 - 1) < 5 * np.sqrt(2 / count))
    first = np.concatenate([d[0][0, 0] for d in drawn]).reshape(count, 2)
    second = np.concatenate([d[1][0, 0] for d in drawn]).reshape(count, 2)
    together = np.corrcoef(first.T, second.T)[:2, 2:]  # of records that have nothing to do
    assert np.all(np.abs(together) < 5 / np.sqrt(count))


def test_what_does_not_exist_is_named():
    traced, theta, experiment, _ = posed(scalar, 0.0)
    bad = np.where(np.arange(len(theta)) == 1, -1.0, theta)
    model = kalman_model(traced)
    for call in (model.smooth, model.disturbances):
        with pytest.raises(SamplingError, match="positive semidefinite at t=1"):
            call(experiment, bad)
    with pytest.raises(SamplingError, match="positive semidefinite at t=1"):
        model.draw(experiment, bad, np.ones(4, dtype=np.uint64), 2)
