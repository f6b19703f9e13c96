"""Maximum likelihood by way of Laplace's approximation: the corrected top against exact ones."""

import numpy as np
import pytest
from scipy import optimize, stats

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.inference.gaussian.likelihood import LaplaceLikelihood, laplace_approximation
from ssmppl.inference.maximum import gaussian_climb
from ssmppl.inference.maximum.ascent import Maximization
from ssmppl.inference.maximum.direct_optimization import ExactClimb
from ssmppl.inference.maximum.gaussian_climb import GaussianClimb
from ssmppl.inference.methods.methods import DirectOptimization
from ssmppl.inference.preparation.exact_score import exact_score
from ssmppl.inference.preparation.space import free_components, space_of
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import seed_sequence
from ssmppl.inference.verbs.maximize import natural_covariance
from tests.models import standard as models
from tests.statistics.checks import seed_of

SEEDS = 12


def scores(estimates, exact):
    """(SEEDS, P) how many Monte Carlo errors the estimates are off."""
    return np.array([
        [(e.parameters[n] - v) / e.attrs["monte_carlo_errors"][n] for n, v in exact.items()]
        for e in estimates
    ])  # fmt: skip


def assert_fair(z):
    """The errors that are stated are about those that are made. Of one seed the error is itself
    estimated, from eight: a t of seven degrees of freedom, whose square has the mean 7 / 5."""
    assert np.all(np.abs(z) < 8.0)
    for column in z.T:
        p = stats.ttest_1samp(column, 0.0).pvalue
        assert p > 1e-4, column
        assert np.mean(column**2) < 7.0 / 5.0 * 4.0


def test_the_top_of_the_varves(exact_values):
    exact = exact_values["ice_varves"]
    found = [
        ssm.maximize(models.varves, {"y": datasets.ice_varves()}, seed=s, progress=False)
        for s in range(SEEDS)
    ]
    errors = np.sqrt(np.diag(exact["inverse_observed_information_at_mle"]))
    assert_fair(scores(found, exact["mle"]))
    for one in found:
        assert one.attrs["method"] == "DirectOptimization"
        assert "corrected by twisted particle filters" in one.attrs["likelihood"]
        off = [abs(one.parameters[n] - v) for n, v in exact["mle"].items()]
        assert np.all(off < 0.1 * errors)
        assert np.sqrt(np.diag(one.covariance)) == pytest.approx(errors, rel=0.03)


def counts():
    """A short series of small counts, where Laplace's approximation is not that good."""
    model = ssm.Model("small counts")
    model.prior(lambda: {"a": ssm.Uniform(0, 1), "s": ssm.HalfNormal(sd=2)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1.0)})
    model.transition(lambda x, a, s: {"x": ssm.Normal(a * x, sd=s)})
    model.observation(lambda x: {"y": ssm.Poisson(0.15 * np.exp(x))})
    drawn = ssm.simulate(model, {"a": 0.7, "s": 1.6}, steps=80, seed=seed_of("small counts"))
    return model, drawn["y"].values[0]


def point_mass(y, a, s, points=600):
    """log p(y | a, s) on a grid of x."""
    x = np.linspace(-14.0, 14.0, points)
    move = stats.norm.pdf(x[:, None], a * x, s) * (x[1] - x[0])
    p, total = stats.norm.pdf(x) * (x[1] - x[0]), 0.0
    for t, seen in enumerate(y):
        p = (move @ p if t else p) * stats.poisson.pmf(seen, 0.15 * np.exp(x))
        total += np.log(p.sum())
        p /= p.sum()
    return total


@pytest.mark.slow
def test_small_counts():
    model, y = counts()

    def value(v):
        return -point_mass(y, 1.0 / (1.0 + np.exp(-v[0])), np.exp(v[1]))

    top = optimize.minimize(value, [1.0, -0.5], method="Nelder-Mead",
                            options={"xatol": 1e-5, "fatol": 1e-8})  # fmt: skip
    exact = {"a": 1.0 / (1.0 + np.exp(-top.x[0])), "s": np.exp(top.x[1])}
    found = [ssm.maximize(model, {"y": y}, seed=s, progress=False) for s in range(SEEDS)]
    assert_fair(scores(found, exact))
    laplace = ssm.log_likelihood(model, {"y": y}, exact, proposal="laplace")[0]
    assert abs(laplace + top.fun) > 0.02, "an approximation without an error shows nothing"
    for one in found:
        off = one.log_likelihood + top.fun
        assert abs(off) < 5.0 * one.attrs["log_likelihood_error"] + 0.01


def climbs(objective):
    """Of a linear Gaussian model whose prior counts: this climb, and the exact one."""
    model = ssm.Model("level")
    model.prior(lambda: {"q": ssm.Gamma(40, rate=40)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(0.8 * x, precision=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    data = {"y": np.random.default_rng(seed_of("level")).standard_normal(60)}
    problem = pose(model, data)
    space = space_of(problem, {}, {})
    setup = Maximization(problem, space, objective, {}, {}, seed_sequence(1))
    approximation = laplace_approximation(problem)
    mine = GaussianClimb(
        setup, DirectOptimization(), LaplaceLikelihood(problem, approximation)
    ).run()
    return setup, mine, ExactClimb(setup, setup.exact, DirectOptimization()).run()


@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_a_linear_gaussian_model_needs_no_correction(objective):
    setup, mine, exact = climbs(objective)
    assert mine.report["converged"]
    error = np.sqrt(np.diag(mine.error))
    assert np.all(np.abs(mine.theta - exact.theta) < 6.0 * error + 1e-4 * np.abs(exact.theta))
    value = setup.exact.log_likelihood(setup.problem.experiments, exact.theta)
    assert mine.report["approximate_log_likelihood"] == pytest.approx(value, abs=1e-2)
    known = natural_covariance(setup, exact.theta, setup_information(setup, exact.theta))
    found = natural_covariance(setup, mine.theta, mine.information)
    assert found[0, 0] == pytest.approx(known[0, 0], rel=0.03)


def setup_information(setup, theta):
    """(P, P) of the exact likelihood alone."""
    free = free_components(setup.problem.trace, setup.fixed)
    return exact_score(setup.exact, setup.problem.experiments, free, theta).information(theta)


@pytest.mark.parametrize("after", [5, 300])
def test_an_interrupted_climb_gives_the_best_so_far(monkeypatch, after):
    """Ctrl-C on the way up, and in the correction."""
    model, y = counts()
    plain, seen = LaplaceLikelihood.__call__, []

    def interrupted(self, theta):
        if len(seen) == after:
            raise KeyboardInterrupt
        seen.append((plain(self, theta), theta.tolist()))
        return seen[-1][0]

    monkeypatch.setattr(LaplaceLikelihood, "__call__", interrupted)
    monkeypatch.setattr(gaussian_climb, "RESTS", 0.0)
    monkeypatch.setattr(gaussian_climb, "LEAST", 0.0)
    monkeypatch.setattr(gaussian_climb, "ROUNDS", 10**6)
    found = ssm.maximize(model, {"y": y}, seed=1, progress=False)
    assert found.attrs["interrupted"]
    assert "interrupted" in found.attrs["likelihood"]
    best = max(seen[:after])[1]
    if after == 5:
        assert list(found.parameters.values()) == pytest.approx(best)
    else:
        value = ssm.log_likelihood  # the top of Laplace's, about
        monkeypatch.undo()
        got, top = (
            value(model, {"y": y}, dict(zip(("a", "s"), p, strict=True)), proposal="laplace")[0]
            for p in (list(found.parameters.values()), best)
        )
        assert got == pytest.approx(top, abs=0.01)


def test_where_it_cannot_be_corrected_the_next_method_takes_over(monkeypatch):
    monkeypatch.setattr(gaussian_climb, "HOPELESS", 0.0)
    model, y = counts()
    found = ssm.maximize(model, {"y": y[:15]}, seed=1, progress=False)
    assert "twisted particle filters of" in found.attrs["method_chosen"]
    assert "continuous in the parameters" in found.attrs["likelihood"]
    asked = ssm.maximize(model, {"y": y[:15]}, ssm.DirectOptimization(), seed=1, progress=False)
    assert asked.attrs["likelihood"].startswith("Laplace's approximation, not corrected: the sd")
    assert asked.attrs["approximate"]


def test_a_scale_whose_maximum_is_at_zero_is_held_there():
    """A population without noise of its own: the rest by quadrature over its start."""
    model = ssm.Model("voles")
    model.prior(lambda: {
        "r": ssm.Normal(0, sd=1), "b": ssm.HalfNormal(sd=1), "s": ssm.HalfNormal(sd=1)
    })  # fmt: skip
    model.initial(lambda: {"n": ssm.Normal(3, sd=1)})
    model.transition(lambda n, r, b, s: {"n": ssm.Normal(n + r - b * np.exp(n) / 100, sd=s)})
    model.observation(lambda n: {"y": ssm.Poisson(np.exp(n))})
    n = [3.0]
    for _ in range(24):
        n.append(n[-1] + 0.5 - 0.5 * np.exp(n[-1]) / 50)
    # between the expected counts' whole numbers: less scatter than Poisson's, so that no noise of
    # the state makes the data likelier
    y = np.round(np.exp(n))
    y[[4, 5, 12]] = np.nan
    start = np.linspace(1.0, 5.0, 2001)
    weight = stats.norm.pdf(start, 3.0, 1.0)

    def value(v):
        r, b = v
        n, total = start, np.zeros(len(start))
        for t, seen in enumerate(y):
            n = n + r - b * np.exp(n) / 100 if t else n
            total += stats.poisson.logpmf(seen, np.exp(n)) if np.isfinite(seen) else 0.0
        return -np.log(weight @ np.exp(total - total.max())) - total.max()

    top = optimize.minimize(value, [0.5, 1.0], method="Nelder-Mead",
                            options={"xatol": 1e-6, "fatol": 1e-10})  # fmt: skip
    found = ssm.maximize(model, {"y": y}, seed=1, progress=False)
    assert found.attrs["held_at_edge"] == {"s": 0.0}
    assert found.attrs["converged"]
    assert np.isnan(found.standard_errors["s"])
    for name, exact in zip(("r", "b"), top.x, strict=True):
        assert 0.0 < found.standard_errors[name] < 1.0
        assert abs(found.parameters[name] - exact) < 0.05 * found.standard_errors[name]
