"""Compartments that binomial flows empty: paths joined to another ancestor may be impossible ones.

Of twenty who are ill some recover on each day, and half of those are reported. Joined to an
ancestor with fewer ill, a path would have more of them recover than there are: its law has no
number of trials there, and the path no probability. All is held against sums over all states.
"""

import numpy as np
import pytest
from scipy.stats import binom

import ssmppl as ssm

ILL, ROWS, AT = 20, 10, {"g": 0.3}
model = ssm.Model("recovery")


@model.prior
def prior():
    return {"g": ssm.Beta(2, 5)}


@model.initial
def initial():
    return {"ill": ssm.Dirac(ILL), "recovered": ssm.Dirac(0)}


@model.transition
def transition(ill, recovered, g):
    left = ill - recovered
    return {"ill": ssm.Dirac(left), "recovered": ssm.Binomial(left, g)}


@model.observation
def observation(recovered):
    return {"y": ssm.Binomial(recovered, 0.5)}


DATA = {"y": np.array([0.0, 2, 1, 5, 1, 0, 2, 1, 0, 0])}
STATES = [(i, r) for i in range(ILL + 1) for r in range(i + 1)]


def passes(g):
    """The log-likelihood, and the probabilities (T, S) of the states given all data."""
    place = {state: k for k, state in enumerate(STATES)}
    move = np.zeros((len(STATES), len(STATES)))
    for k, (i, r) in enumerate(STATES):
        for new in range(i - r + 1):
            move[k, place[i - r, new]] = binom.pmf(new, i - r, g)
    seen = np.array([binom.pmf(y, [r for _, r in STATES], 0.5) for y in DATA["y"]])
    forward = [np.eye(len(STATES))[place[ILL, 0]] * seen[0]]
    for row in seen[1:]:
        forward.append(forward[-1] @ move * row)
    back = [np.ones(len(STATES))]
    for row in seen[:0:-1]:
        back.insert(0, move @ (row * back[0]))
    total = forward[-1].sum()
    return np.log(total), np.array(forward) * back / total


@pytest.mark.parametrize("kernel", [pytest.param("exact", marks=pytest.mark.slow), "mcmc"])
def test_smoothed_means_are_those_of_the_sums(kernel):
    exact = passes(AT["g"])[1] @ np.array([r for _, r in STATES])
    method = ssm.FFBSi(kernel=kernel, proposal="bootstrap", moves=20)
    means = []
    for seed in range(20):
        drawn = ssm.smooth(model, DATA, AT, method, particles=1000, trajectories=200, seed=seed)
        means.append(drawn["recovered"].mean("trajectory").values)
    error = np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    assert np.all(abs(np.mean(means, axis=0) - exact) <= 4.5 * error + 2e-3)  # bias of 1 / N


@pytest.mark.slow
def test_the_score_is_the_slope_of_the_sums():
    step = 1e-4
    exact = (passes(AT["g"] + step)[0] - passes(AT["g"] - step)[0]) / (2 * step)
    found = ssm.score(model, DATA, AT, particles=400, repeats=10, seed=1)
    assert abs(found.gradient["g"] - exact) < 4.5 * found.gradient_errors["g"]


@pytest.mark.slow
@pytest.mark.exhaustive
def test_the_maximum_is_that_of_the_sums():
    grid = np.linspace(0.15, 0.45, 121)
    values = np.array([passes(g)[0] for g in grid])
    top = slice(values.argmax() - 3, values.argmax() + 4)
    a, b, _ = np.polyfit(grid[top], values[top], 2)
    found = ssm.maximize(model, DATA, ssm.ScoreAscent(), seed=1, progress=False)
    assert abs(found.parameters["g"] + b / (2 * a)) < 4.5 * found.attrs["monte_carlo_errors"]["g"]


# -- a path that another ancestor makes impossible two rows later
CAPACITY, PRESENT = 6, np.array([2.0, 1, 3, 2, 0, 4])


@pytest.fixture(scope="module")
def places():
    """Of six places some are taken, those by the last two rows' arrivals not again."""
    model = ssm.Model("places")
    model.initial(lambda: {"x": ssm.Binomial(CAPACITY, 0.4), "last": ssm.Dirac(0)})
    model.transition(lambda x, last: {
        "x": ssm.Binomial(CAPACITY - x - last, 0.6), "last": ssm.Dirac(x)
    })  # fmt: skip
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1.5)})
    return model


def arrivals():
    """E[x_t] given all data, by the sum over all pairs (x_t, x_t-1)."""
    pairs = [(x, b) for x in range(CAPACITY + 1) for b in range(CAPACITY + 1 - x)]
    place = {pair: k for k, pair in enumerate(pairs)}
    move = np.zeros((len(pairs), len(pairs)))
    for k, (x, b) in enumerate(pairs):
        for new in range(CAPACITY - x - b + 1):
            move[k, place[new, x]] = binom.pmf(new, CAPACITY - x - b, 0.6)
    x = np.array([x for x, _ in pairs])
    seen = np.exp(-0.5 * ((PRESENT[:, None] - x) / 1.5) ** 2)
    forward = [np.where([b == 0 for _, b in pairs], binom.pmf(x, CAPACITY, 0.4), 0.0) * seen[0]]
    for row in seen[1:]:
        forward.append(forward[-1] @ move * row)
    back = [np.ones(len(pairs))]
    for row in seen[:0:-1]:
        back.insert(0, move @ (row * back[0]))
    return np.array(forward) * back @ x / forward[-1].sum()


@pytest.mark.parametrize("kernel", ["PGAS", "exact", "mcmc"])
def test_a_path_impossible_two_rows_later_is_not_taken(places, kernel):
    method = ssm.PGAS(20) if kernel == "PGAS" else ssm.FFBSi(
        kernel=kernel, proposal="bootstrap", moves=20
    )  # fmt: skip
    given = {"trajectories": 1000} if kernel == "PGAS" else {"trajectories": 200, "particles": 1000}
    means = [
        ssm.smooth(places, {"y": PRESENT}, {}, method, seed=seed, **given)["x"].mean("trajectory")
        for seed in range(20)
    ]
    error = np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    assert np.all(abs(np.mean(means, axis=0) - arrivals()) <= 4.5 * error)
