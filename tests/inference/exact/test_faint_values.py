"""Finite states of which the data make some so unlikely that no ordinary number holds it, and which
later rows bring back."""

import itertools

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import ssmppl as ssm
from ssmppl.inference.exact import hidden_markov as passes
from ssmppl.inference.exact.hidden_markov import hidden_markov
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.models.finite import MODELS, data_of
from tests.statistics.checks import seed_of


def change():
    """Of level, once; nothing leads back."""
    model = ssm.Model("change")
    model.prior(lambda: {"p": ssm.Beta(1, 9), "r": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"s": ssm.Bernoulli(0.0)})
    model.transition(lambda s, p: {"s": ssm.Bernoulli(np.where(s == 1, 1.0, p))})
    model.observation(lambda s, r: {"y": ssm.Normal(s, sd=r)})
    return model


def with_an_outlier(r=0.1):
    y = np.where(np.arange(50) < 42, 0.0, 1.0) + r * np.sin(np.arange(50.0))
    y[9] = 8.0
    return y


def by_the_change(y, p, r):
    """(T + 1,) log p(y, the first row of 1 is k), k = 1..T-1, and T where there is none."""
    low, high = stats.norm.logpdf(y, 0, r), stats.norm.logpdf(y, 1, r)
    steps = len(y)
    return np.array(
        [
            low[:k].sum() + high[k:].sum() + (k - 1) * np.log1p(-p) + np.log(p) * (k < steps)
            for k in range(1, steps + 1)
        ]
    )


def test_a_change_after_an_outlier():
    """The outlier is 750 nats nearer to what comes after the change, more than a number can hold,
    and the 32 rows until the change are nearer by 50 each to what was before."""
    y, p, r = with_an_outlier(), 0.02, 0.1
    model, theta = change(), {"p": p, "r": r}
    each = by_the_change(y, p, r)
    total = logsumexp(each)
    assert ssm.log_likelihood(model, {"y": y}, theta).item() == pytest.approx(total, rel=1e-12)
    k = np.exp(each - total)
    after = np.concatenate([[0.0], np.cumsum(k)[:-1]])
    assert after[20] < 1e-6
    found = ssm.smooth(model, {"y": y}, theta, trajectories=50, seed=seed_of("change"))
    drawn = found["s"].values.mean(axis=0)
    assert np.all(np.abs(drawn - after) < 4.5 * np.sqrt(after * (1.0 - after) / 50) + 1e-6)
    law = hidden_markov(pose(model, {"y": y}).trace)
    (experiment,) = pose(model, {"y": y}).experiments
    np.testing.assert_allclose(
        law.probabilities(experiment, np.array([p, r]))[:, 1], after, atol=1e-12
    )


def test_its_score_is_the_likelihoods_derivative():
    y, model, h = with_an_outlier(), change(), 1e-5
    slope = ssm.score(model, {"y": y}, {"p": 0.02, "r": 0.1}).gradient
    for name in ("p", "r"):
        ends = [
            logsumexp(by_the_change(y, **{"p": 0.02, "r": 0.1, name: value}))
            for value in ({"p": 0.02, "r": 0.1}[name] * (1 + s * h) for s in (-1, 1))
        ]
        wanted = (ends[1] - ends[0]) / (2 * h * {"p": 0.02, "r": 0.1}[name])
        assert slope[name] == pytest.approx(wanted, rel=1e-6)


def test_the_filter_says_what_was_likely_then():
    """Before the change shows, the outlier speaks for the value that it was nearest to."""
    y, theta = with_an_outlier(), {"p": 0.02, "r": 0.1}
    found = ssm.forward_filter(change(), {"y": y[:15]}, theta)
    longer = ssm.forward_filter(change(), {"y": y}, theta)
    assert found["log_likelihood_increment"].values.sum() == pytest.approx(
        logsumexp(by_the_change(y[:15], 0.02, 0.1)), rel=1e-12
    )
    np.testing.assert_allclose(longer["s"].values[:, :15],
                               found["s"].values)  # fmt: skip


def test_a_class_that_the_first_half_of_the_data_speaks_against():
    model = ssm.Model("class")
    model.initial(lambda: {"s": ssm.Bernoulli(0.5)})
    model.transition(lambda s: {"s": ssm.Dirac(s)})
    model.observation(lambda s: {"y": ssm.Normal(s, sd=0.5)})
    y = np.concatenate([np.full(600, -0.2), np.full(900, 1.2)])
    each = np.array([stats.norm.logpdf(y, s, 0.5).sum() for s in (0, 1)])
    total = logsumexp(each) - np.log(2)
    assert ssm.log_likelihood(model, {"y": y}, {}).item() == pytest.approx(total, rel=1e-12)
    assert np.all(ssm.smooth(model, {"y": y}, {}, trajectories=3)["s"].values == 1)


def test_a_step_that_is_less_likely_than_any_number():
    """Binomial(50, 1e-9) has its probability of 50 at exp(-1036)."""
    model = ssm.Model("rare")
    model.initial(lambda: {"n": ssm.Binomial(50, 1e-9)})
    model.transition(lambda n: {"n": ssm.Binomial(50, 1e-9)})
    model.observation(lambda n: {"y": ssm.Normal(n, sd=0.05)})
    y, n = np.array([50.0, 3.0, 49.0]), np.arange(51)
    law = stats.binom.logpmf(n, 50, 1e-9)
    wanted = sum(logsumexp(law + stats.norm.logpdf(v, n, 0.05)) for v in y)
    assert ssm.log_likelihood(model, {"y": y}, {}).item() == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_both_passes_agree(name, monkeypatch):
    """Where ordinary numbers will do, what is asked of the logarithms has to be the same."""
    build, theta = MODELS[name]
    problem, theta = pose(build(), data_of(name)), np.array(theta)
    law = hidden_markov(problem.trace)
    given = problem.experiments, theta

    def everything():
        found, laws = law.filter_each(*given), law.laws(*given)
        stream = random_state(seed_sequence(seed_of("both", name)))
        draws = law.draw_each(*given, [stream] * len(given[0]), draws=40)
        return (
            [x for f in found for x in (f.log_increments, f.predicted, f.filtered)],
            [x for _, *own in laws for x in own], draws,
        )  # fmt: skip

    plain = everything()
    entry = passes.exact_entry

    def unsure(name):
        def run(*arguments):
            arguments[-1][:] = passes.UNSURE

        return run if name == "finite_forward" else entry(name)

    monkeypatch.setattr(passes, "exact_entry", unsure)
    for a, b in zip(itertools.chain(*plain), itertools.chain(*everything()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-13)
