"""Many data sets of finite states at once, against the enumeration of each."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import ssmppl as ssm
from ssmppl.data import bind
from ssmppl.errors import SamplingError
from ssmppl.inference.exact import hidden_markov as tables
from ssmppl.inference.exact.hidden_markov import hidden_markov
from ssmppl.inference.exact.histories import histories
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.language.model.trace import previous
from ssmppl.language.tracing import trace
from tests.models.finite import MODELS, data_of, enumerated, weather
from tests.statistics.checks import LEVEL, seed_of


def beginning(name, steps):
    return {n: v[:steps].copy() for n, v in data_of(name).items()}


def many(name):
    """Data sets of several lengths, some of them equal, some equal but for inputs or gaps."""
    out = [beginning(name, steps) for steps in (4, 3, 4, 1, 3)]
    other = {n: np.flip(v, axis=0).copy() for n, v in beginning(name, 4).items()}
    out += [other, beginning(name, 4), {**other}]
    gap = beginning(name, 3)
    gap["y"][0] = np.nan
    if name != "second order":  # its transition needs y
        out.append(gap)
    if name == "patches":
        out += [
            {**beginning(name, 4), "u": u} for u in (np.zeros(4), np.array([2.0, -1.0, 0, 3.0]))
        ]
    return out


@pytest.fixture(scope="module", params=sorted(MODELS))
def case(request):
    build, theta = MODELS[request.param]
    traced, theta = trace(build()), np.array(theta)
    experiments = bind(traced, many(request.param))
    return traced, experiments, theta, [enumerated(traced, e, theta) for e in experiments]


def test_the_likelihood_is_the_sum_over_data_sets_and_paths(case):
    traced, experiments, theta, paths = case
    found = hidden_markov(traced).log_likelihood(experiments, theta)
    assert found == pytest.approx(sum(logsumexp(p) for _, p in paths), rel=1e-12)
    # the same lists, but for one that came to another place, and one that is not there
    for own in ([1, 0, *range(2, len(experiments))], range(len(experiments) - 1)):
        found = hidden_markov(traced).log_likelihood([experiments[i] for i in own], theta)
        assert found == pytest.approx(sum(logsumexp(paths[i][1]) for i in own), rel=1e-12)


def test_each_data_set_has_its_own_moments_and_increments(case):
    traced, experiments, theta, paths = case
    model = hidden_markov(traced)
    smoothed, filtered = (
        f(experiments, theta) for f in (model.smooth_each, model.filter_each)
    )  # fmt: skip
    laws = [f.predicted for f in filtered]
    predicted = model.predicted_observations(experiments, theta, laws)
    for k, (x, log_p) in enumerate(paths):
        w = np.exp(log_p - logsumexp(log_p))
        mean = np.einsum("m,mtd->td", w, x)
        np.testing.assert_allclose(smoothed[k][0].mean, mean, atol=1e-12)
        np.testing.assert_allclose(smoothed[k][1] @ model.values, mean, atol=1e-12)
        cross = np.einsum("m,mti,mtj->tij", w, (x - mean)[:, 1:], (x - mean)[:, :-1])
        np.testing.assert_allclose(smoothed[k][0].cross[1:], cross, atol=1e-12)
        assert filtered[k].log_increments.sum() == pytest.approx(logsumexp(log_p), rel=1e-12)
        alone = model.predicted_observations([experiments[k]], theta, [laws[k]])[0]
        np.testing.assert_allclose(predicted[k], alone, rtol=1e-12)


def test_scores_and_expectations_are_sums(case, monkeypatch):
    """The score of each alone is held against differences in `test_hidden_markov.py`."""
    traced, experiments, theta, _ = case
    model = hidden_markov(traced)
    alone = [model.score([e], theta) for e in experiments]
    for entries in (tables.ENTRIES, 40, 1):  # in pieces of data sets, and of rows
        monkeypatch.setattr(tables, "ENTRIES", entries)
        value, gradient = model.score(experiments, theta)
        assert value == pytest.approx(sum(v for v, _ in alone), rel=1e-12)
        scale = np.sum([abs(g) for _, g in alone], axis=0)
        total = np.sum([g for _, g in alone], axis=0)
        np.testing.assert_allclose(gradient / scale, total / scale, atol=1e-12)


def test_draws_of_equal_data_sets_are_independent(case):
    """Chi-square over pairs of paths: of the two shortest data sets that are equal."""
    traced, experiments, theta, paths = case
    places = [1, 4, 0]  # the third of another history
    draws = 20_000
    stream = random_state(seed_sequence(seed_of("pairs", traced.name)))
    own = [experiments[i] for i in places]
    drawn = hidden_markov(traced).draw_each(own, theta, [stream] * 3, draws)
    x, log_p = paths[1]
    p = np.exp(log_p - logsumexp(log_p))
    number = {path.tobytes(): i for i, path in enumerate(x)}
    first, second = ([number[d.tobytes()] for d in drawn[k]] for k in (0, 1))
    pairs = np.ravel_multi_index((first, second), (len(p), len(p)))
    _chi_square(np.bincount(pairs, minlength=len(p) ** 2), np.outer(p, p).ravel())
    x, log_p = paths[0]
    number = {path.tobytes(): i for i, path in enumerate(x)}
    count = np.bincount([number[d.tobytes()] for d in drawn[2]], minlength=len(x))
    _chi_square(count, np.exp(log_p - logsumexp(log_p)))


def _chi_square(count, p):
    expected = count.sum() * p
    assert np.all(count[expected == 0.0] == 0)
    common = expected >= 10.0
    seen = np.append(count[common], count[~common].sum())
    wanted = np.append(expected[common], expected[~common].sum())
    kept = wanted > 0.0
    statistic = np.sum((seen[kept] - wanted[kept]) ** 2 / wanted[kept])
    assert stats.chi2.sf(statistic, kept.sum() - 1) > LEVEL


def test_equal_data_sets_stand_once_and_inputs_apart(case):
    traced, experiments, *_ = case
    found = histories(traced, experiments, 10**6)
    assert sum(h.weights.sum() for h in found) == len(experiments)
    assert sorted(i for h in found for i in h.members) == list(range(len(experiments)))
    for h in found:
        for i, s in zip(h.members, h.which, strict=True):
            e = experiments[i]
            assert e.steps == h.steps[s]
            np.testing.assert_array_equal(h.y[h.of(s)], e.y)
            for k, u in enumerate(traced.input_symbols):
                np.testing.assert_array_equal(h.rows[u][h.of(s)], e.u[:, k])
                before = np.concatenate([e.u[:1, k], e.u[:-1, k]])
                np.testing.assert_array_equal(h.rows[previous(u)][h.of(s)], before)
    assert any(h.weights.max() > 1 for h in found)
    assert histories(traced, experiments, 10**6) is found
    assert histories(traced, [*experiments], 10**6) is found
    assert histories(traced, experiments, 2) is not found


def test_all_data_sets_share_one_pass(monkeypatch):
    """Whatever their lengths; no density is left to the interpreter."""
    traced, calls = trace(weather()), []
    evaluate = tables.evaluate
    monkeypatch.setattr(tables, "evaluate", lambda *a: calls.append(1) or evaluate(*a))
    forward = tables.Tables.forward
    monkeypatch.setattr(tables.Tables, "forward", lambda *a: calls.append(2) or forward(*a))
    rng = np.random.default_rng(1)
    experiments = bind(traced, [{"y": rng.normal(size=n)} for n in (7, 3, 5, 1) * 25])
    hidden_markov(traced).score(experiments, np.array(MODELS["weather"][1]))
    assert calls == [2]


def test_what_cannot_be_names_the_data_set():
    model = ssm.Model("strict")
    model.initial(lambda: {"z": ssm.Bernoulli(0.5)})
    model.transition(lambda z: {"z": ssm.Bernoulli(0.5)})
    model.observation(lambda z: {"y": ssm.Uniform(z, z + 1.0)})
    traced = trace(model)
    good, bad = {"y": [0.5, 1.5, 0.5]}, {"y": [0.5, 2.5, 0.5]}
    experiments, theta = bind(traced, [good, {"y": [0.5]}, bad, good, bad]), np.empty(0)
    found = hidden_markov(traced)
    assert found.log_likelihood(experiments, theta) == -np.inf
    assert found.log_likelihood(experiments[:2], theta) == pytest.approx(4 * np.log(0.5))
    assert found.score(experiments, theta)[0] == -np.inf
    for verb in (found.filter_each, found.smooth_each, found.laws):
        with pytest.raises(SamplingError, match="possible at t=2 of data set 3"):
            verb(experiments, theta)


@pytest.mark.slow
def test_em_ends_where_the_score_of_all_is_zero():
    rng = np.random.default_rng(seed_of("em of many"))
    made = [ssm.simulate(weather(), dict(zip(("stay", "leave", "m"), MODELS["weather"][1],
                                             strict=True)), steps=8, seed=int(s))["y"].values[0]
            for s in rng.integers(0, 10**6, 12)]  # fmt: skip
    data = [{"y": y} for y in [*made, *made[:5]]]
    found = ssm.maximize(weather(), data, method=ssm.EM())
    traced = trace(weather())
    theta = np.array([float(found.parameters[n]) for n in ("stay", "leave", "m")])
    model, experiments = hidden_markov(traced), bind(traced, data)
    gradient = np.sum([model.score([e], theta)[1] for e in experiments], axis=0)
    information = sum(model.information([e], theta) for e in experiments)
    # the step that is left, in standard errors
    assert gradient @ np.linalg.solve(information, gradient) < 1e-4
