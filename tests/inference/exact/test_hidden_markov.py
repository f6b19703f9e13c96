"""Exact passes over finite states against the enumeration of all paths."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import ssmppl as ssm
from ssmppl.analysis.finite import MOST, finite_states
from ssmppl.data import bind
from ssmppl.errors import NotApplicable, SamplingError
from ssmppl.inference.exact.hidden_markov import hidden_markov
from ssmppl.inference.exact.state_values import viterbi_paths
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.language.tracing import trace
from tests.models.finite import MODELS, data_of, enumerated, independent, weather
from tests.statistics.checks import LEVEL, seed_of


@pytest.fixture(scope="module", params=sorted(MODELS))
def case(request):
    build, theta = MODELS[request.param]
    traced = trace(build())
    (e,) = bind(traced, data_of(request.param))
    theta = np.array(theta)
    return request.param, traced, e, theta, *enumerated(traced, e, theta)


def test_the_likelihood_is_the_sum_over_all_paths(case):
    _, traced, e, theta, _, log_p = case
    model = hidden_markov(traced)
    assert model.log_likelihood([e, e], theta) == pytest.approx(2.0 * logsumexp(log_p), rel=1e-12)


def test_by_matrices_written_by_hand():
    theta, data = np.array([0.9, 0.2, 1.4]), data_of("weather", 200)
    traced = trace(weather())
    found = hidden_markov(traced).log_likelihood(bind(traced, data), theta)
    assert found == pytest.approx(independent(theta, data["y"]), rel=1e-12)


def test_moments_are_those_of_all_paths(case):
    _, traced, e, theta, paths, log_p = case
    w = np.exp(log_p - logsumexp(log_p))
    found = hidden_markov(traced).smooth(e, theta)
    mean = np.einsum("m,mtd->td", w, paths)
    np.testing.assert_allclose(found.mean, mean, atol=1e-12)
    away = paths - mean
    np.testing.assert_allclose(
        found.covariance, np.einsum("m,mti,mtj->tij", w, away, away), atol=1e-12
    )
    cross = np.einsum("m,mti,mtj->tij", w, away[:, 1:], away[:, :-1])
    np.testing.assert_allclose(found.cross[1:], cross, atol=1e-12)
    assert found.log_likelihood == pytest.approx(logsumexp(log_p), rel=1e-12)


def test_the_most_probable_path_is_the_best_of_all(case):
    _, traced, e, theta, paths, log_p = case
    ((path, height),) = viterbi_paths(hidden_markov(traced), [e], theta)
    assert height == pytest.approx(log_p.max(), rel=1e-12)
    best = {p.tobytes() for p, v in zip(paths, log_p, strict=True) if v > log_p.max() - 1e-9}
    assert path.tobytes() in best


def test_the_filter_knows_no_later_rows(case):
    """Its laws at row t are the smoothed ones of the data up to t."""
    name, traced, e, theta, *_ = case
    model = hidden_markov(traced)
    found = model.filter(e, theta)
    full = data_of(name)
    for t in (1, 3, e.steps):
        (short,) = bind(traced, {n: v[:t] for n, v in full.items()})
        np.testing.assert_allclose(found.filtered[t - 1], model.probabilities(short, theta)[-1],
                                   atol=1e-12)  # fmt: skip
        value = model.log_likelihood([short], theta)
        assert found.log_increments[:t].sum() == pytest.approx(value, rel=1e-12)


def test_draws_are_paths_with_their_probabilities(case):
    """Chi-square over all paths that can be, the rare ones together."""
    name, traced, e, theta, paths, log_p = case
    draws, stream = 20_000, random_state(seed_sequence(seed_of("draws", name)))
    drawn = hidden_markov(traced).draw(e, theta, stream, draws)
    number = {p.tobytes(): i for i, p in enumerate(paths)}
    count = np.bincount([number[p.tobytes()] for p in drawn], minlength=len(paths))
    expected = draws * np.exp(log_p - logsumexp(log_p))
    assert np.all(count[expected == 0.0] == 0)
    common = expected >= 10.0
    seen = np.append(count[common], count[~common].sum())
    wanted = np.append(expected[common], expected[~common].sum())
    kept = wanted > 0.0
    statistic = np.sum((seen[kept] - wanted[kept]) ** 2 / wanted[kept])
    assert stats.chi2.sf(statistic, kept.sum() - 1) > LEVEL


def test_the_score_is_the_likelihoods_derivative(case):
    _, traced, e, theta, *_ = case
    model, h = hidden_markov(traced), 1e-5
    value, gradient = model.score([e], theta)
    assert value == pytest.approx(model.log_likelihood([e], theta), rel=1e-13)
    for i in range(len(theta)):
        step = h * np.eye(len(theta))[i]
        ends = [model.log_likelihood([e], theta + s * step) for s in (2, 1, -1, -2)]
        slope = (-ends[0] + 8 * ends[1] - 8 * ends[2] + ends[3]) / (12 * h)
        assert gradient[i] == pytest.approx(slope, rel=1e-7, abs=1e-8)
    free = np.zeros(len(theta), bool)
    free[0] = True
    assert model.score([e], theta, free)[1].tolist() == [gradient[0], *[0.0] * (len(theta) - 1)]
    second = model.information([e], theta)
    ends = [model.score([e], theta + s * h * np.eye(len(theta))[0])[1] for s in (1, -1)]
    np.testing.assert_allclose(second[0], -(ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-6)


def test_what_cannot_be_is_said():
    """A reading that no value allows."""
    model = ssm.Model("strict")
    model.initial(lambda: {"z": ssm.Bernoulli(0.5)})
    model.transition(lambda z: {"z": ssm.Bernoulli(0.5)})
    model.observation(lambda z: {"y": ssm.Uniform(z, z + 1.0)})
    traced = trace(model)
    (e,) = bind(traced, {"y": [0.5, 1.5, 2.5, 0.5]})
    found = hidden_markov(traced)
    assert found.log_likelihood([e], np.empty(0)) == -np.inf
    with pytest.raises(SamplingError, match=r"no value of the states is possible at t=3"):
        found.smooth(e, np.empty(0))


def far(offset):
    """A switch that is read, and remembered, far from zero."""
    model = ssm.Model("far")
    model.initial(lambda: {"z": ssm.Bernoulli(0.5), "level": ssm.Dirac(offset)})
    model.transition(
        lambda z, level: {"z": ssm.Bernoulli(0.2 + 0.6 * z), "level": ssm.Dirac(offset + z)}
    )
    model.observation(lambda z: {"y": ssm.Normal(offset + z, sd=0.1)})
    return model


def test_moments_far_from_zero_are_those_near_it():
    y, offset = np.array([0.3, 0.6, np.nan, 0.45]), 1e9
    near, there = (ssm.smooth(far(o), {"y": o + y}, {}) for o in (0.0, offset))
    for name in ("z_sd", "level_sd", "covariance", "covariance_previous"):
        np.testing.assert_allclose(there[name].values, near[name].values, atol=1e-6, err_msg=name)
    near, there = (ssm.forward_filter(far(o), {"y": o + y}, {}) for o in (0.0, offset))
    for name in ("y_predicted_sd", "level_sd", "y_pit"):
        np.testing.assert_allclose(there[name].values, near[name].values, atol=1e-6, err_msg=name)
    one = near.z_probability.sel(z_value=1.0).values[0] * 0.6 + 0.2  # of the row that follows
    spread = np.sqrt(0.1**2 + one * (1.0 - one))
    np.testing.assert_allclose(there.y_predicted_sd.values[0, 1:], spread[:-1], rtol=1e-6)


def of(transition, initial=None):
    model = ssm.Model("made")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: initial or {"z": ssm.Bernoulli(0.5)})
    model.transition(transition)
    model.observation(lambda z: {"y": ssm.Normal(z, sd=1)})
    return finite_states(trace(model))


def test_which_states_are_finite():
    begin = {"z": ssm.Bernoulli(0.5), "d": ssm.Dirac(0.0)}
    two = of(lambda z: {"z": ssm.Truncated(ssm.Poisson(2.0 + z), lower=1, upper=3)})
    assert two.values.ravel().tolist() == [0.0, 1.0, 2.0, 3.0]
    counter = of(
        lambda z, d: {
            "z": ssm.Bernoulli(0.3), "d": ssm.Dirac(np.where(z, 0.0, np.minimum(d + 1, 4))),
        },
        begin,
    )  # fmt: skip
    assert np.unique(counter.values[:, 1]).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    reasons = {
        "continuum": of(lambda z: {"z": ssm.Normal(z, sd=1)}),
        "infinitely many": of(lambda z: {"z": ssm.Poisson(z + 1)}),
        "depend on a": of(lambda z, a: {"z": ssm.Dirac(z + a)}),
        "'z' takes more than 64 values": of(lambda z: {"z": ssm.Dirac(z + 1)}),
        "'d' takes so many values": of(
            lambda z, d: {"z": ssm.Bernoulli(0.5), "d": ssm.Dirac(np.where(z, d + 0.1, 0.0))}, begin
        ),
        "'d' takes no value": of(
            lambda z, d: {"z": ssm.Bernoulli(0.5), "d": ssm.Dirac(d + 1)},
            {"z": ssm.Bernoulli(0.5), "d": ssm.Dirac(np.inf)},
        ),
        "8192 combinations": of(
            lambda z, d: {"z": ssm.Bernoulli(0.5 + np.zeros(13)), "d": ssm.Dirac(np.sum(z))},
            {"z": ssm.Bernoulli(0.5 + np.zeros(13)), "d": ssm.Dirac(0.0)},
        ),
        f"more than {MOST}": of(lambda z: {"z": ssm.Binomial(100, 0.5)}),
    }
    for words, found in reasons.items():
        assert isinstance(found, NotApplicable)
        assert words in found.reason


@pytest.mark.parametrize("cap", [16, 17, 20, 31])
def test_durations_count_up_to_where_they_saturate(cap):
    """A renewal whose probability depends on the time since the last, by hand."""

    def chance(d):
        return 0.02 + 0.4 * d / cap

    model = ssm.Model("durations")
    model.initial(lambda: {"z": ssm.Bernoulli(0.5), "d": ssm.Dirac(0.0)})
    model.transition(lambda z, d: {
        "z": ssm.Bernoulli(chance(d)), "d": ssm.Dirac(np.where(z, 0.0, np.minimum(d + 1, cap))),
    })  # fmt: skip
    model.observation(lambda z, d: {"y": ssm.Normal(z + 0.1 * d, sd=1)})
    y = np.random.default_rng(seed_of("durations", cap)).normal(1.0, 1.0, 3 * cap)

    law = {(0, 0): 0.5, (1, 0): 0.5}
    for t, value in enumerate(y):
        if t:
            before, law = law, {}
            for (z, d), p in before.items():
                now = 0 if z else min(d + 1, cap)
                for new, share in ((0, 1.0 - chance(d)), (1, chance(d))):
                    law[new, now] = law.get((new, now), 0.0) + p * share
        law = {(z, d): p * stats.norm.pdf(value, z + 0.1 * d) for (z, d), p in law.items()}
    found = ssm.log_likelihood(model, {"y": y}, {}, proposal="auto")
    assert found.tolist() == pytest.approx([np.log(sum(law.values()))], rel=1e-12)
