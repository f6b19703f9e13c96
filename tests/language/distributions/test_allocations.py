"""Multinomial and EulerMultinomial: beside SciPy's, summed over all counts, drawn, and in a model
whose likelihood is enumerated."""

import itertools
import math

import numpy as np
import pytest
import scipy.stats as st

import ssmppl as ssm
import ssmppl.language.distributions as D
from ssmppl.errors import DataError, ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from tests.language.distributions.test_distributions import draws_of, number
from tests.statistics.checks import LEVEL, assert_within, deviations, mean_one_p, seed_of

N = 4
RATES, DT = np.array([0.7, 0.0, 1.9]), 0.3


def counts(n, places):
    """All (K,) counts of at most n together."""
    return [c for c in itertools.product(range(n + 1), repeat=places) if sum(c) <= n]


def exits(rates, dt):
    total = sum(rates)
    leave = (1 - math.exp(-total * dt)) * np.asarray(rates) / total
    return np.append(leave, 1 - leave.sum())


@pytest.mark.parametrize("p", [[0.2, 0.5, 0.3], [0.6, 0.0, 0.4], [1.0, 0.0]])
def test_a_multinomial_is_scipys(p):
    law = D.Multinomial(N, p)
    for c in counts(N, len(p)):
        expected = st.multinomial(N, p).logpmf(c) if sum(c) == N else -np.inf
        assert evaluate(law.log_density(c)) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(number(law.mean()), N * np.array(p))
    np.testing.assert_allclose(number(law.variance()), N * np.array(p) * (1 - np.array(p)))


def test_competing_exits_are_a_multinomial_with_those_that_stay():
    law, p = D.EulerMultinomial(N, RATES, DT), exits(RATES, DT)
    total = 0.0
    for c in counts(N, 3):
        found = evaluate(law.log_density(c))
        assert found == pytest.approx(st.multinomial(N, p).logpmf([*c, N - sum(c)]), rel=1e-11)
        total += math.exp(found)
    assert total == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(number(law.mean()), N * p[:-1])
    np.testing.assert_allclose(number(law.variance()), N * p[:-1] * (1 - p[:-1]))


def test_small_steps_keep_their_digits():
    law = D.EulerMultinomial(1.0, [1e-9, 2e-9], 1e-6)
    assert evaluate(law.log_density([0, 1])) == pytest.approx(math.log(2e-15), rel=1e-14)


def test_nobody_leaves_at_rates_of_zero():
    law = D.EulerMultinomial(5.0, [0.0, 0.0], 1.0)
    assert evaluate(law.log_density([0, 0])) == 0.0
    assert evaluate(law.log_density([1, 0])) == -np.inf
    assert not draws_of(law, 100, 3).any()


@pytest.mark.parametrize("law", [D.Multinomial(N, [0.3, 0.7]), D.EulerMultinomial(N, [1, 2], 0.5)])
@pytest.mark.parametrize("c", [[-1, 5], [0.5, 3.5], [3, 2], [math.inf, 0]])
def test_other_counts_have_no_density(law, c):
    assert evaluate(law.log_density(c)) == -np.inf


@pytest.mark.parametrize("n", [2.5, -1.0])
def test_trials_that_are_none_have_nan(n):
    trials = symbol("state", "n", ())
    for law in (D.Multinomial(trials, [0.3, 0.7]), D.EulerMultinomial(trials, [1.0, 2.0], 0.5)):
        assert np.isnan(evaluate(law.log_density([0, 0]), {trials: n}))


@pytest.mark.parametrize(
    "law", [D.Multinomial(N, [0.25, 0.0, 0.15, 0.6]), D.EulerMultinomial(N, RATES, DT)], ids=repr
)
def test_draws_have_the_law(law):
    x = draws_of(law, 20_000, seed_of(repr(law)))
    places = law.shape[0]
    every = counts(N, places)
    p = np.exp([evaluate(law.log_density(c)) for c in every])
    seen = np.array([np.all(x == np.reshape(c, (-1, 1)), axis=0).sum() for c in every])
    assert seen.sum() == x.shape[1]
    assert not seen[p == 0.0].any()
    expected = p * x.shape[1]
    often = expected >= 5.0
    o, e = np.append(seen[often], seen[~often].sum()), np.append(expected[often], 0.0)
    e[-1] = expected[~often].sum()
    keep = e > 0.0
    assert st.chi2.sf(((o - e)[keep] ** 2 / e[keep]).sum(), keep.sum() - 1) > LEVEL


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: D.Multinomial(2.5, [0.5, 0.5]), "n = 2.5 is no whole number"),
        (lambda: D.Multinomial(-1, [0.5, 0.5]), "n = -1 is outside"),
        (lambda: D.Multinomial(3, [0.5, 0.6]), "p sums to 1.1"),
        (lambda: D.Multinomial(3, [1.0]), "one probability"),
        (lambda: D.Multinomial([3, 4], [0.5, 0.5]), "n has shape (2,)"),
        (lambda: D.Multinomial(3, 0.5), "p has shape ()"),
        (lambda: D.EulerMultinomial(3, [-1.0, 1.0], 0.1), "rates = -1 is outside"),
        (lambda: D.EulerMultinomial(3, [1.0], 0.0), "dt = 0 is outside"),
        (lambda: D.EulerMultinomial(3, [1.0], [0.1, 0.2]), "dt has shape (2,)"),
        (lambda: D.EulerMultinomial(3, 1.0, 0.1), "rates has shape ()"),
    ],
)
def test_what_is_no_such_law_is_refused(make, said):
    with pytest.raises(ModelError) as error:
        make()
    assert said in error.value.found
    assert error.value.fix


# -- in a model: susceptible, infected, of whom some are counted
HOSTS, BETA, MU, GONE, COUNTED = 5, 1.6, 0.3, 0.4, 0.7
CASES = [1.0, 2.0, np.nan, 1.0, 0.0]


def outbreak(prior):
    model = ssm.Model("outbreak")
    model.prior(lambda: {"beta": prior})
    model.initial(lambda: {"S": ssm.Dirac(HOSTS - 1.0), "I": ssm.Dirac(1.0)})

    @model.transition
    def flows(S, I, beta):
        return {
            "left": ssm.EulerMultinomial(S, [beta * I / HOSTS, MU], 0.5),
            "gone": ssm.Binomial(I, GONE),
        }

    @model.transition
    def hosts(S, I, left_next, gone_next):
        return {
            "S": ssm.Dirac(S - left_next[0] - left_next[1]),
            "I": ssm.Dirac(I + left_next[0] - gone_next),
        }

    model.observation(lambda I: {"y": ssm.Binomial(I, COUNTED)})
    return model


def test_flows_that_are_observed_are_told_to_be_states():
    model = outbreak(ssm.Flat())
    model.observation(lambda left: {"cases": ssm.Binomial(left[0], 0.5)})
    with pytest.raises(ModelError) as error:
        ssm.explain(model)
    assert "ssm.Dirac(np.zeros(n))" in error.value.fix


def surveyed(law, inputs=("n",)):
    """Of a state that is no matter: counts whose number of trials is an input."""
    model = ssm.Model("survey", inputs=inputs)
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.9 * x, sd=0.3)})
    model.observation(law)
    return model


@pytest.mark.parametrize(
    ("law", "counts", "said"),
    [
        (lambda x, n: {"y": ssm.Multinomial(n, share(x))}, [2.0, 2.0], "sum to 4, and n of Mult"),
        (lambda x, n: {"y": ssm.Multinomial(n, share(x))}, [4.0, 2.0], "sum to 6, and n of Mult"),
        (lambda x, n: {"y": ssm.EulerMultinomial(n, share(x), 1.0)}, [4.0, 2.0], "sum to 6, and"),
    ],
)
def test_counts_that_do_not_sum_up_are_refused_by_row(law, counts, said):
    data = {"n": [5.0, 5.0, 5.0], "y": [[3.0, 2.0], [np.nan, np.nan], counts]}
    with pytest.raises(DataError) as error:
        ssm.log_likelihood(surveyed(law), data, {}, seed=1)
    assert said in error.value.found
    assert "row 3" in str(error.value)
    data["n"] = [5.0, 5.0, float(sum(counts))]
    assert np.isfinite(ssm.log_likelihood(surveyed(law), data, {}, seed=1)[0])


def share(x):
    return [1 / (1 + np.exp(-x)), 1 / (1 + np.exp(x))]


def test_shares_that_do_not_sum_to_one_are_named():
    model = ssm.Model("shares")
    model.prior(lambda: {"a": ssm.Flat()})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(
        lambda x, a: {"y": ssm.Multinomial(3, [a, 0.5]), "z": ssm.Laplace(x, scale=1)}
    )
    data = {"y": [[1.0, 2.0]], "z": [0.0]}
    with pytest.warns(UserWarning, match="the probabilities of Multinomial.* sum to 0.7"):
        assert ssm.log_likelihood(model, data, {"a": 0.2}, seed=1) == [-np.inf]


def enumerated(beta=BETA):
    """log p(y) by the forward recursion over (S, I)."""
    states = [(s, i) for s in range(HOSTS + 1) for i in range(HOSTS + 1)]
    weight = {x: float(x == (HOSTS - 1, 1)) for x in states}
    total = 0.0
    for k, y in enumerate(CASES):
        if k:
            moved = dict.fromkeys(states, 0.0)
            for (s, i), w in weight.items():
                p = exits([beta * i / HOSTS, MU], 0.5)
                for new, dead in counts(s, 2) if w else ():
                    q = w * st.multinomial(s, p).pmf([new, dead, s - new - dead])
                    for gone in range(i + 1):
                        to = (s - new - dead, i + new - gone)
                        if to in moved:
                            moved[to] += q * st.binom(i, GONE).pmf(gone)
            weight = moved
        if np.isfinite(y):
            weight = {x: w * st.binom(x[1], COUNTED).pmf(y) for x, w in weight.items()}
        total += math.log(sum(weight.values()))
        weight = {x: w / sum(weight.values()) for x, w in weight.items()}
    return total


def test_a_filters_likelihood_is_unbiased():
    found = ssm.log_likelihood(
        outbreak(ssm.Flat()),
        {"y": np.array(CASES)},
        {"beta": BETA},
        particles=200,
        repeats=400,
        seed=seed_of("outbreak"),
    )  # fmt: skip
    assert mean_one_p(np.asarray(found) - enumerated()) > LEVEL


@pytest.mark.slow
@pytest.mark.parametrize("method", [ssm.PMMH(particles=60), ssm.PGAS(particles=20)], ids=str)
def test_chains_have_the_posterior_of_a_rate(method):
    """Its density by enumeration, on a grid that is as fine as its curve is smooth."""
    log = np.linspace(math.log(0.02), math.log(60.0), 81)
    prior = st.norm(0.5, 0.8)
    weight = np.exp([prior.logpdf(v) + enumerated(math.exp(v)) for v in log])
    weight /= weight.sum()
    mean = float(weight @ log)
    sd = float(np.sqrt(weight @ (log - mean) ** 2))
    drawn = ssm.sample(
        outbreak(ssm.LogNormal(0.5, sd=0.8)), {"y": np.array(CASES)}, method, draws=2000,
        warmup=500, chains=4, seed=seed_of("rate", str(method)), progress=False,
    )["posterior"]["beta"]  # fmt: skip
    assert_within(deviations(np.log(drawn.values), mean=mean, sd=sd))


def test_shapes_of_arguments_go_through_expressions():
    p = array([symbol("parameter", "p", (k,)) for k in range(2)])
    law = D.Multinomial(3, p)
    values = dict(zip(p, [0.4, 0.6], strict=True))
    expected = st.multinomial(3, [0.4, 0.6]).logpmf([1, 2])
    assert evaluate(law.log_density([1, 2]), values) == pytest.approx(expected)
    assert np.isnan(evaluate(law.log_density([1, 2]), dict(zip(p, [0.4, 0.5], strict=True))))
