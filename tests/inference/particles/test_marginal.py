"""Rao-Blackwellised particle filters and smoothers against exact answers."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.elimination.conditional import ConditionallyLinear, conditionally_linear
from ssmppl.codegen.modules.marginal import compile_marginal
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.particles.backward import particle_system
from ssmppl.inference.particles.filtering import FilterSettings, repeated_estimates
from ssmppl.inference.particles.marginal import _Step, backward_pass, draw_given, marginal_paths
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.language.tracing import trace
from tests.models.conditional import THETA, enumerated, four_states, regimes
from tests.statistics.checks import LEVEL, MCSE, deviations, mean_one_p, seed_of

NAMES = ("marginal", "marginal_guided", "marginal_auxiliary")
STEPS = 7


def made_up(model, theta, steps, holes):
    """Simulated rows with an input, of which some are missing in part."""
    rng = np.random.default_rng(seed_of(model.name))
    u = rng.normal(size=steps)
    drawn = ssm.simulate(model, theta, steps=steps, inputs={"u": u}, seed=seed_of(model.name, 1))
    data = {n: drawn[n].values[0].copy() for n in drawn.data_vars if n in holes}
    for name, rows in holes.items():
        for row in rows:
            data[name][row] = np.nan
    return {**data, "u": u}


@pytest.fixture(scope="module")
def data():
    return made_up(regimes(), THETA, STEPS, {"y": [2, 4], "v": [(1, 0), 4]})


@pytest.fixture(scope="module")
def exact(data):
    return enumerated(data, **THETA)


@pytest.fixture(scope="module")
def sampled_pair():
    """The linear Gaussian model with x[0] and x[1] sampled; its data."""
    model = four_states()
    problem = pose(model, made_up(model, {}, 12, {"y": [3, (5, 1)], "w": [3, 7]}))
    s = problem.trace.state_symbols
    split = ConditionallyLinear(
        (s[2], s[3]), (s[0], s[1]), tuple(problem.trace.observation_symbols)
    )
    found = compile_marginal(problem.trace, problem.program.missing, split)
    problem.program.__dict__["marginal"] = found
    yield problem
    del problem.program.__dict__["marginal"]


def test_the_split():
    split = conditionally_linear(trace(regimes()))
    assert list(map(repr, split.linear)) == ["z[0]", "z[1]"]
    assert split.coupled == ()
    assert len(split.channels) == 3


def tracking(observed):
    model = ssm.Model("tracking")
    model.initial(lambda: {
        "p": ssm.Normal(np.zeros(2), sd=1), "v": ssm.Normal(np.zeros(2), sd=1),
        "turn": ssm.Normal(0, sd=1), "count": ssm.Dirac(0.0),
    })  # fmt: skip
    model.transition(lambda p, v, turn, count: {
        "p": ssm.Dirac(p + 0.1 * v),
        "v": ssm.Normal(np.stack([v[0] - turn * v[1], v[1] + turn * v[0]]), sd=0.1),
        "turn": ssm.Normal(turn, sd=0.1), "count": ssm.Dirac(count + 1),
    })  # fmt: skip
    model.observation(observed)
    return model


@pytest.mark.parametrize(
    ("observed", "linear", "coupled"),
    [
        (lambda p: {"y": ssm.Normal(p, sd=1)}, ["p[0]", "p[1]", "v[0]", "v[1]"], []),
        (lambda p: {"y": ssm.Normal(np.sum(p**2), sd=1)}, ["v[0]", "v[1]"], ["p[0]", "p[1]"]),
        (lambda p, v: {"y": ssm.Normal(p, sd=np.exp(v[0]))}, ["p[0]", "p[1]", "turn"],
         ["v[0]", "v[1]"]),
        (lambda p, v, turn: {"y": ssm.Poisson(np.exp(p[0] + v[1] + turn))}, ["p[1]", "v[0]"],
         ["p[0]", "v[1]"]),
    ],
)  # fmt: skip
def test_products_spreads_and_laws_decide_the_split(observed, linear, coupled):
    """turn * v: one of the two; what a count or a spread depends on is out; so is what no noise
    reaches."""
    split = conditionally_linear(trace(tracking(observed)))
    assert sorted(map(repr, split.linear)) == linear
    assert sorted(map(repr, split.coupled)) == coupled


def test_reasons_why_there_is_no_split():
    split = conditionally_linear(trace(four_states()))
    assert isinstance(split, NotApplicable)
    assert "whole model is linear" in split.reason
    model = ssm.Model("volatility")
    model.initial(lambda: {"h": ssm.Normal(0, sd=1)})
    model.transition(lambda h: {"h": ssm.Normal(0.9 * h, sd=0.2)})
    model.observation(lambda h: {"y": ssm.Normal(0, sd=np.exp(h / 2))})
    split = conditionally_linear(trace(model))
    assert "the spread of y depends on h" in str(split)
    with pytest.raises(ArgumentError, match="the spread of y depends on h"):
        ssm.log_likelihood(model, {"y": np.zeros(3)}, {}, proposal="marginal")


@pytest.mark.parametrize("name", ["marginal"])
@pytest.mark.parametrize("ess_threshold", [1.0, 0.5])
def test_likelihood_is_unbiased_over_regimes(name, ess_threshold, data, exact):
    found = ssm.log_likelihood(
        regimes(), data, THETA, proposal=name, particles=30, repeats=800,
        ess_threshold=ess_threshold, seed=seed_of(name, ess_threshold),
    )  # fmt: skip
    assert mean_one_p(found - exact.log_likelihood[-1]) > LEVEL
    assert 0.05 < found.std() < 1.0


@pytest.mark.parametrize(
    "name", [NAMES[0], *(pytest.param(n, marks=pytest.mark.slow) for n in NAMES[1:])]
)
def test_likelihood_is_unbiased_with_coupled_states(name, sampled_pair):
    problem = sampled_pair
    exact = kalman_model(problem.trace).log_likelihood(problem.experiments, np.empty(0))
    found = repeated_estimates(
        problem, np.empty(0), FilterSettings(400, name), seed_sequence(seed_of(name)), range(600)
    )
    assert mean_one_p(found - exact) > LEVEL


def test_filter_moments_are_those_of_the_mixture(data, exact):
    """Means, covariances, predictions and increments; each draw is a filter of its own."""
    found = ssm.particle_filter(
        regimes(), data, THETA, proposal="marginal", particles=2000, repeats=30, seed=seed_of("m")
    )
    mean = np.concatenate([found["k"].values[..., None], found["z"].values], axis=-1)
    wanted = np.array([exact.means[t][t] for t in range(STEPS)])
    _agree(mean, wanted)
    _agree(found["covariance"].values, np.array([exact.covariances[t][t] for t in range(STEPS)]))
    _agree(found["log_likelihood_increment"].values, np.diff(exact.log_likelihood, prepend=0.0))
    # row 1 was measured, row 4 not at all: its prediction is all that is known of it
    sd = found["z_sd"].values[:, 4, 0]
    assert np.all(np.abs(sd - np.sqrt(exact.covariances[4][4][1, 1])) < 0.05)
    within = found["z_quantile"].values[..., 4] - found["z_quantile"].values[..., 0]
    assert np.all(within > 0)


def _agree(draws, wanted, least=1e-9):
    """Means over the first axis within the error of its spread, all of them together.

    least : of that error; a rare value that no run has drawn would leave none.
    """
    n = draws.shape[0]
    error = np.maximum(draws.std(axis=0, ddof=1) / np.sqrt(n), least)
    z = (draws.mean(axis=0) - wanted) / error
    assert np.abs(z).max() < stats.t.isf(LEVEL / 2 / z.size, n - 1)


@pytest.mark.slow
def test_the_quantiles_are_those_of_the_mixture(data):
    """Against many draws of all states, by a plain filter."""
    own = {"particles": 20_000, "repeats": 4, "seed": seed_of("quantiles")}
    a = ssm.particle_filter(regimes(), data, THETA, proposal="marginal", **own)
    b = ssm.particle_filter(regimes(), data, THETA, proposal="bootstrap", **own)
    difference = (a["z_quantile"].mean("draw") - b["z_quantile"].mean("draw")) / b["z_sd"].mean()
    assert np.abs(difference.values).max() < 0.1
    for name in ("y_predicted", "v_predicted", "y_predicted_sd", "v_predicted_sd"):
        error = np.abs(a[name].mean("draw") - b[name].mean("draw")).values
        assert error.max() < 0.08, name
    pit = np.abs(a["v_pit"].mean("draw") - b["v_pit"].mean("draw")).values
    assert np.nanmax(pit) < 0.03


def test_linear_states_given_a_path(sampled_pair):
    """Draws of z given the sampled states against one Gaussian of everything."""
    problem, m = sampled_pair, 4000
    (experiment,) = problem.experiments
    model = kalman_model(problem.trace)
    path = model.draw(experiment, np.empty(0), random_state(seed_sequence(1), 0))[0]
    columns = np.full(
        (experiment.steps, len(problem.program.marginal.found.trace.state_symbols)), np.nan
    )
    columns[:, :2] = path[:, :2]
    stream = random_state(seed_sequence(seed_of("given a path")), 0)
    paths = np.broadcast_to(columns, (m, *columns.shape))
    drawn = draw_given(problem, experiment, np.empty(0), paths, stream)
    np.testing.assert_array_equal(
        drawn[:, :, :2], np.broadcast_to(path[:, :2], (m, *path[:, :2].shape))
    )
    mean, covariance = _conditioned(model.matrices(experiment, np.empty(0)), experiment, path)
    z = drawn[:, :, 2:].reshape(m, -1)
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-12))
    off = np.abs(z.mean(axis=0) - mean) / (sd / np.sqrt(m) + 1e-7)
    assert off.max() < stats.norm.isf(LEVEL / 2 / len(off))
    error = np.abs(np.cov(z.T) - covariance) / (np.outer(sd, sd) * np.sqrt(2 / m) + 1e-9)
    assert error.max() < 6.0


def _conditioned(matrices, experiment, path):
    """Mean and covariance of all z given y and the path of the first two states."""
    steps, d = len(path), 4
    k = experiment.y.shape[1]

    def at(a, t):
        return a[min(t, len(a) - 1)]

    mean, root = np.zeros(steps * d), np.zeros((steps * d, steps * d))

    def factor(c):
        values, vectors = np.linalg.eigh(c)
        return vectors * np.sqrt(np.maximum(values, 0.0))

    for t in range(steps):
        now = slice(t * d, t * d + d)
        if t == 0:
            mean[now], root[now, now] = matrices.m, factor(matrices.P)
            continue
        before = slice(t * d - d, t * d)
        mean[now] = at(matrices.A, t) @ mean[before] + at(matrices.b, t)
        root[now] = at(matrices.A, t) @ root[before]
        root[now, now] = factor(at(matrices.Q, t))
    prior = root @ root.T
    rows, values, noise = [], [], []
    for t in range(steps):
        for i in range(k):
            if experiment.seen[t, i]:
                row = np.zeros(steps * d)
                row[t * d : t * d + d] = at(matrices.C, t)[i]
                rows.append(row)
                values.append(experiment.y[t, i] - at(matrices.d, t)[i])
                noise.append((t, i))
        for j in range(2):
            row = np.zeros(steps * d)
            row[t * d + j] = 1.0
            rows.append(row), values.append(path[t, j]), noise.append(None)
    rows, values = np.array(rows), np.array(values)
    r = np.zeros((len(rows), len(rows)))
    for a, p in enumerate(noise):
        for b, q in enumerate(noise):
            if p is not None and q is not None and p[0] == q[0]:
                r[a, b] = at(matrices.R, p[0])[p[1], q[1]]
    gain = np.linalg.solve(rows @ prior @ rows.T + r, rows @ prior).T
    mean = mean + gain @ (values - rows @ mean)
    covariance = prior - gain @ rows @ prior
    keep = [t * d + j for t in range(steps) for j in (2, 3)]
    return mean[keep], covariance[np.ix_(keep, keep)]


def test_smoothed_paths_are_those_of_the_enumeration(data, exact):
    """Independent runs of the backward simulator, each with a few hundred paths."""
    runs = []
    for i in range(24):
        found = ssm.smooth(
            regimes(), data, THETA, ssm.FFBSi(proposal="marginal"), particles=300,
            trajectories=200, seed=seed_of("smooth", i),
        )  # fmt: skip
        x = np.concatenate([found["k"].values[..., None], found["z"].values], axis=-1)
        z = x[:, :, 1:]
        runs.append((x.mean(axis=0), np.einsum("mti,mtj->tij", z, z) / len(z)))
    mean, covariance = np.array(exact.means[-1]), np.array(exact.covariances[-1])
    least = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2) / (24 * 200))
    _agree(np.array([r[0] for r in runs]), mean, least)
    second = covariance + np.einsum("ti,tj->tij", mean, mean)
    _agree(np.array([r[1] for r in runs]), second[:, 1:, 1:])


def test_paths_back_from_values_that_a_particle_tells_exactly():
    """A vehicle that starts at rest: where it is in the second row only one of the two modes leads
    to. Point masses that miss it counted as much as those that do not."""
    model = ssm.Model("at rest")
    model.initial(lambda: {"s": ssm.Bernoulli(0.5), "v": ssm.Dirac(0.0), "p": ssm.Dirac(0.0)})
    model.transition(
        lambda s, v, p: {
            "s": ssm.Bernoulli(np.where(s == 1, 0.9, 0.1)), "v": ssm.Normal(0.5 * v, sd=0.3),
            "p": ssm.Dirac(p + v + s),
        }
    )  # fmt: skip
    model.observation(lambda p: {"y": ssm.Normal(p, sd=0.3)})
    y, jump = np.array([0.0, 0.6, 1.4, 2.6]), 0.3 * np.tril(0.5 ** _behind(4))
    jump[:, 0] = 0.0
    moved = np.vstack([np.zeros(4), np.cumsum(jump, axis=0)[:-1]])
    law = stats.multivariate_normal(np.zeros(4), moved @ moved.T + 0.09 * np.eye(4))
    paths = np.array(list(itertools.product([0, 1], repeat=4)))
    place = np.hstack([np.zeros((16, 1)), np.cumsum(paths[:, :-1], axis=1)])
    stays = np.where(np.diff(paths, axis=1) == 0, 0.9, 0.1).prod(axis=1)
    weights = stays * law.pdf(y - place)
    expected = weights @ paths / weights.sum()
    runs = [
        ssm.smooth(
            model, {"y": y}, {}, ssm.FFBSi(proposal="marginal"), particles=400, trajectories=300,
            seed=seed_of("at rest", i),
        )["s"].values.mean(axis=0)
        for i in range(24)
    ]  # fmt: skip
    _agree(np.array(runs), expected, np.sqrt(expected * (1 - expected) / (24 * 300)))


def test_point_masses_that_fit_are_alike_and_outdo_densities():
    """Of five particles for one component two tell it exactly, by covariances of another size in
    the component before, one tells another value, and two know it with a spread, one far off."""
    n, spread = 5, np.zeros((2, 2, 5))
    spread[0, 0] = [1.0, 1.0, 1.0, 1.0, 1.0]
    spread[1, 1] = [4.0, 9.0, 4.0, 5.0, 5.0]  # of which the first component tells 4, 9, 4, 4, 4
    spread[0, 1] = spread[1, 0] = [2.0, 3.0, 2.0, 2.0, 2.0]
    predicted = np.zeros((2, n))
    predicted[1] = [1.0, 0.0, 1.5, 1.0, 9.0]
    law = SimpleNamespace(free=[], columns=SimpleNamespace(coupled=[]))
    step = _Step(law, {}, np.zeros(n), *(np.zeros(1),) * 3, predicted, spread)
    # the first component is 1: the second is then 1 + 2, 0 + 3, 1.5 + 2, and 1 + 2 and 9 + 2 +- 1
    log_w = step.log_weights(np.zeros((0, 1)), np.array([[1.0], [3.0]]))[:, 0]
    assert log_w[0] == pytest.approx(log_w[1])
    assert log_w[3] - log_w[4] == pytest.approx(0.5 * 8.0**2)
    assert log_w[2] < log_w[4] - 1e6
    assert log_w[3] < log_w[0] - 10.0


def _behind(n):
    return np.subtract.outer(np.arange(n), np.arange(n)).clip(min=0)


def test_states_that_no_observation_depends_on():
    """Two of the three are integrated out, and the data say nothing of them: their paths are those
    of the transition, and independent."""
    model = ssm.Model("apart")

    @model.initial
    def initial():
        return {"k": ssm.Binomial(6, 0.4), "z": ssm.Normal(np.array([1.0, 0.0]), sd=0.5)}

    @model.transition
    def transition(k, z):
        return {"k": ssm.Binomial(6, 0.2 + 0.1 * k), "z": ssm.Normal(0.8 * z, sd=0.3)}

    @model.observation
    def observation(k):
        return {"y": ssm.Poisson(1.0 + k)}

    z = ssm.smooth(
        model, {"y": [2, 3, 1]}, {}, ssm.FFBSi(proposal="marginal"), particles=20,
        trajectories=4_000, seed=seed_of("apart"),
    )["z"].values  # fmt: skip
    variance = [0.25, 0.64 * 0.25 + 0.09, 0.64 * (0.64 * 0.25 + 0.09) + 0.09]
    for t in range(3):
        wanted = np.array([0.8**t, 0.0]), variance[t] * np.eye(2)
        error = np.sqrt(np.array([variance[t], 2 * variance[t] ** 2]) / len(z))
        assert np.abs(z[:, t].mean(axis=0) - wanted[0]).max() < 4.5 * error[0]
        assert np.abs(np.cov(z[:, t], rowvar=False) - wanted[1]).max() < 4.5 * error[1]


@pytest.mark.slow
def test_smoothed_paths_with_coupled_states(sampled_pair):
    """Against the Kalman smoother."""
    problem = sampled_pair
    (experiment,) = problem.experiments
    smoothed = kalman_model(problem.trace).smooth(experiment, np.empty(0))
    first, second, backward = [], [], []
    for i in range(24):
        stream = random_state(seed_sequence(seed_of("coupled")), i)
        system = particle_system(
            problem, np.empty(0), FilterSettings(400, "marginal"), experiment, stream
        )
        given = problem, np.empty(0), experiment, system, 200, stream
        x = marginal_paths(*given)
        first.append(x.mean(axis=0))
        second.append(np.einsum("mti,mtj->tij", x, x) / len(x))
        _, z = backward_pass(*given)
        backward.append(np.einsum("mti,mtj->tij", z, z) / len(z))
    _agree(np.array(first), smoothed.mean)
    product = np.einsum("ti,tj->tij", smoothed.mean, smoothed.mean)
    _agree(np.array(second), smoothed.covariance + product)
    _agree(np.array(backward), (smoothed.covariance + product)[:, 2:, 2:])


@pytest.mark.slow
def test_posterior_of_pmmh_is_that_of_a_grid(data):
    grid = np.linspace(-0.99, 0.99, 67)
    logs = np.array([enumerated(data, a, THETA["q"]).log_likelihood[-1] for a in grid])
    w = np.exp(logs - logs.max())
    w /= w.sum()
    mean = float(w @ grid)
    sd = float(np.sqrt(w @ (grid - mean) ** 2))
    found = ssm.sample(
        regimes(), data, ssm.PMMH(proposal="marginal", particles=50), draws=4000, warmup=1000,
        fixed={"q": THETA["q"]}, seed=seed_of("pmmh"), progress=False,
    )  # fmt: skip
    off = deviations(found.posterior["a"].values, mean=mean, sd=sd)
    assert max(map(abs, off.values())) < MCSE
    states = found.posterior["z"].values
    assert states.shape == (4, 4000, STEPS, 2)
    assert np.all(np.isfinite(states))


def test_explain_names_what_is_integrated_out():
    assert "z[0], z[1], given the other states" in str(ssm.explain(regimes()))


@pytest.mark.slow
def test_auto_integrates_out(data):
    found = ssm.particle_filter(regimes(), data, THETA, particles=50, seed=1)
    assert found.attrs["proposal"].startswith("marginal")
    drawn = ssm.smooth(regimes(), data, THETA, ssm.FFBSi(), particles=50, trajectories=5, seed=1)
    assert drawn.attrs["proposal"].startswith("marginal")


@pytest.mark.parametrize(
    "call",
    [
        lambda m, d: ssm.sample(m, d, ssm.PGAS(proposal="marginal"), draws=2, warmup=2),
        lambda m, d: ssm.sample(
            m, d, ssm.PMMH(proposal="marginal", correlation=0.9), draws=2, warmup=2
        ),
        lambda m, d: ssm.smooth(m, d, THETA, ssm.FixedLag(proposal="marginal")),
    ],
)
def test_methods_that_need_all_states_say_so(call, data):
    with pytest.raises(ArgumentError, match="needs particles of all"):
        call(regimes(), data)


def test_backward_simulation_says_where_it_does_not_apply(data):
    with pytest.raises(ArgumentError, match='kernel="mcmc" is of filters of all states'):
        ssm.smooth(regimes(), data, THETA, ssm.FFBSi(proposal="marginal", kernel="mcmc"))
    model = ssm.Model("lagged regime")
    model.initial(lambda: {"k": ssm.Bernoulli(0.5), "b": ssm.Dirac(0.0), "z": ssm.Normal(0, sd=1)})
    model.transition(lambda k, b, z: {
        "k": ssm.Bernoulli(np.where(k + b > 1, 0.9, 0.2)), "b": ssm.Dirac(k),
        "z": ssm.Normal(0.5 * z + k, sd=1),
    })  # fmt: skip
    model.observation(lambda z: {"y": ssm.Normal(z, sd=1)})
    with pytest.raises(ArgumentError, match="b follows from the state before without noise"):
        ssm.smooth(model, {"y": np.zeros(4)}, {}, ssm.FFBSi(proposal="marginal"))
