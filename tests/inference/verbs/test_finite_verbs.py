"""The verbs on models of finitely many states: exact wherever they can be."""

import itertools

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

import ssmppl as ssm
from ssmppl.data import bind
from ssmppl.errors import ArgumentError
from ssmppl.inference.exact.hidden_markov import hidden_markov
from ssmppl.language.tracing import trace
from tests.models.finite import MODELS, independent, second_order, weather
from tests.statistics.checks import LEVEL, seed_of

NAMES = ("stay", "leave", "m")
VALUES = dict(zip(NAMES, MODELS["weather"][1], strict=True))


@pytest.fixture(scope="module")
def data():
    y = ssm.simulate(weather(), VALUES, steps=80, seed=seed_of("weather"))["y"].values[0]
    y[[5, 6, 30]] = np.nan
    return {"y": y}


def test_likelihoods_are_exact(data):
    exact = independent(list(VALUES.values()), data["y"])
    found = ssm.log_likelihood(weather(), data, VALUES, repeats=2)
    np.testing.assert_allclose(found, exact, rtol=1e-12)
    particles = ssm.log_likelihood(
        weather(), data, VALUES, proposal="bootstrap", particles=500, repeats=400,
        seed=seed_of("finite"),
    )  # fmt: skip
    share = np.exp(particles - exact)
    limit = stats.norm.isf(LEVEL / 2)
    assert abs(share.mean() - 1.0) < limit * share.std() / np.sqrt(len(share))
    with pytest.raises(ArgumentError, match="needs a linear Gaussian model"):
        ssm.log_likelihood(weather(), data, VALUES, proposal="kalman")
    level = ssm.Model("level")
    level.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    level.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    level.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.raises(ArgumentError, match=r"finite-state .hidden Markov. model: .*continuum"):
        ssm.log_likelihood(level, data, {}, proposal="forward")
    with pytest.raises(ArgumentError, match="ForwardBackward needs states of finitely many"):
        ssm.smooth(level, data, {}, ssm.ForwardBackward())
    with pytest.raises(ArgumentError, match=r"call ssm\.forward_filter"):
        ssm.particle_filter(weather(), data, VALUES, proposal="forward")


def test_filtering_is_exact(data):
    """By the smoothing laws of ever longer beginnings, and by hand one step ahead."""
    found = ssm.forward_filter(weather(), data, VALUES, quantiles=(0.5,)).isel(draw=0)
    stay, leave, m = VALUES.values()
    theta, y = np.array(list(VALUES.values())), data["y"]
    before = leave
    for t in range(12):
        (e,) = bind(trace(weather()), {"y": y[: t + 1]})
        p = hidden_markov(trace(weather())).probabilities(e, theta)[-1, 1]
        row = found.isel(time=t)
        np.testing.assert_allclose(row["z"], p, rtol=1e-12)
        np.testing.assert_allclose(row["z_probability"], [1 - p, p], rtol=1e-12)
        np.testing.assert_allclose(row["z_sd"] ** 2, p * (1 - p), rtol=1e-9)
        assert row["z_quantile"].values[0] == float(p > 0.5)
        np.testing.assert_allclose(row["y_predicted"], before * m, rtol=1e-12)
        variance = 0.64 + m**2 * before * (1 - before)
        np.testing.assert_allclose(row["y_predicted_sd"] ** 2, variance, rtol=1e-12)
        pit = (1 - before) * stats.norm.cdf(y[t], 0, 0.8) + before * stats.norm.cdf(y[t], m, 0.8)
        np.testing.assert_allclose(row["y_pit"], pit, rtol=1e-12)
        before = p * stay + (1 - p) * leave
    exact = independent(list(VALUES.values()), y)
    np.testing.assert_allclose(found["log_likelihood_increment"].sum(), exact, rtol=1e-12)
    assert list(found["z_value"].values) == [0.0, 1.0]


@pytest.mark.parametrize("name", ["patches", pytest.param("second order", marks=pytest.mark.slow)])
def test_filtering_agrees_with_particles(name):
    """Inputs, counts, vectors missing in part, a lagged copy: within Monte Carlo error."""
    build, values = MODELS[name]
    model = build()
    inputs = {"u": np.sin(np.arange(12.0))} if model.inputs else None
    parameters = dict(zip(model_parameters(model), values, strict=True))
    made = ssm.simulate(model, parameters, steps=12, inputs=inputs, seed=seed_of(name))
    data = {k: made[k].values[0].astype(float) for k in observed(model)} | (inputs or {})
    if name == "patches":
        data["n"][2] = data["y"][3] = data["y"][5, 0] = np.nan
    exact = ssm.forward_filter(model, data, parameters, seed=1)
    particles = ssm.particle_filter(
        model, data, parameters, particles=4000, repeats=40, proposal="bootstrap", seed=2
    )
    checked = 0
    for variable in particles.data_vars:
        if variable == "ess" or variable.endswith(("quantile", "_pit", "_observed")):
            continue
        runs = particles[variable].values
        error = runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
        off = np.abs(runs.mean(axis=0) - exact[variable].values[0])
        # a finite N biases ratios by about its variance, that is a fraction of the error
        assert np.all(off <= 5 * error + 1e-3 * np.abs(exact[variable].values[0]) + 1e-9), variable
        checked += 1
    assert checked > 6


def observed(model):
    return list(trace(model).observations)


def model_parameters(model):
    return list(trace(model).parameters)


def test_smoothing_is_exact(data):
    (e,) = bind(trace(weather()), data)
    law = hidden_markov(trace(weather())).probabilities(e, np.array(list(VALUES.values())))
    found = ssm.smooth(weather(), data, VALUES, quantiles=(0.25, 0.5))
    assert found.attrs["method"] == "ForwardBackward"
    np.testing.assert_allclose(found["z"].values[0], law[:, 1])
    np.testing.assert_allclose(found["z_sd"].values[0] ** 2, law[:, 1] * law[:, 0], atol=1e-12)
    for k, level in enumerate((0.25, 0.5)):
        wanted = (law[:, 0] < level).astype(float)
        np.testing.assert_array_equal(found["z_quantile"].values[0, :, k], wanted)
    drawn = ssm.smooth(weather(), data, VALUES, trajectories=4000, seed=1)["z"]
    assert drawn.dims == ("trajectory", "time")
    error = np.sqrt(law[:, 1] * law[:, 0] / 4000)
    off = np.abs(drawn.mean("trajectory").values - law[:, 1])
    assert np.all(off <= stats.norm.isf(LEVEL / 160) * error + 1e-3)
    with pytest.raises(ArgumentError, match="ForwardBackward works without particles"):
        ssm.smooth(weather(), data, VALUES, "forward_backward", particles=10)


def test_smoothed_probabilities_and_the_most_probable_path(data):
    """Of several experiments too; the path's probability against those of drawn paths."""
    other = {"y": data["y"][:50]}
    for found, own in zip(ssm.smooth(weather(), [data, other], VALUES), (data, other), strict=True):
        one = found.isel(draw=0)
        shares = one["z_probability"]
        assert shares.sum("z_value").to_numpy() == pytest.approx(np.ones(len(own["y"])))
        mean = (shares * shares["z_value"]).sum("z_value").to_numpy()
        assert mean == pytest.approx(one["z"].to_numpy(), abs=1e-12)
        (e,) = bind(trace(weather()), own)
        smoothed = hidden_markov(trace(weather())).probabilities(e, np.array([*VALUES.values()]))
        assert shares.sel(z_value=1).to_numpy() == pytest.approx(smoothed[:, 1], abs=1e-12)
        path, height = one["z_viterbi"].to_numpy(), found.attrs["viterbi_log_probability"]
        assert height == pytest.approx(_log_joint(path, own["y"]), abs=1e-9)
        drawn = ssm.smooth(weather(), own, VALUES, trajectories=200, seed=1)["z"].to_numpy()
        assert max(_log_joint(x, own["y"]) for x in drawn) <= height + 1e-9


def _log_joint(x, y) -> float:
    """By the model's own density, at fixed parameters."""
    traced = trace(weather())
    (e,) = bind(traced, {"y": y})
    model = hidden_markov(traced)
    (h,) = model.histories_of([e])
    tables = model.tables(h, np.array([*VALUES.values()]))
    index = x.astype(int)
    move = tables.log_move[0]
    total = tables.log_start[0, index[0]] + tables.log_g[np.arange(len(x)), index].sum()
    return float(total + sum(move[a, b] for a, b in itertools.pairwise(index)))


def test_the_score_and_the_maximum(data):
    found = ssm.score(weather(), data, VALUES)
    assert "forward and backward" in found.attrs["method"]
    h = 1e-5
    for i, name in enumerate(NAMES):
        ends = [independent(np.array(list(VALUES.values())) + s * h * np.eye(3)[i], data["y"])
                for s in (1, -1)]  # fmt: skip
        assert found.gradient[name] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-5)
    best = ssm.maximize(weather(), data, start=VALUES, seed=1)
    assert best.attrs["method"] == "DirectOptimization"
    assert "forward algorithm" in best.attrs["likelihood"]
    top = minimize(
        lambda v: -independent(v, data["y"]), list(VALUES.values()), method="L-BFGS-B",
        bounds=[(1e-3, 1 - 1e-3)] * 2 + [(None, None)], options={"ftol": 1e-14},
    )  # fmt: skip
    assert best.log_likelihood == pytest.approx(-top.fun, abs=1e-6)


def tied():
    """leave = 1 - stay^2, which no family holds."""
    model = ssm.Model("tied")
    model.prior(lambda: {"stay": ssm.Beta(2, 2), "m": ssm.Normal(1, sd=1)})
    model.initial(lambda: {"z": ssm.Bernoulli(0.5)})
    model.transition(lambda z, stay: {"z": ssm.Bernoulli(np.where(z, stay, 1.0 - stay**2))})
    model.observation(lambda z, m: {"y": ssm.Normal(m * np.exp(z), sd=0.8)})
    return model


def logistic():
    """Odds that change with time: the density does not separate."""
    model = ssm.Model("logistic")
    model.prior(lambda: {"a": ssm.Normal(0, sd=2), "b": ssm.Normal(0, sd=2)})
    model.initial(lambda: {"z": ssm.Bernoulli(0.5)})
    model.transition(lambda z, t, a, b: {
        "z": ssm.Bernoulli(1.0 / (1.0 + np.exp(-a * (2.0 * z - 1.0) - b * t / 40.0)))
    })  # fmt: skip
    model.observation(lambda z: {"y": ssm.Normal(z, sd=0.4)})
    return model


EM_CASES = {"closed form": weather, "Newton": tied, "BFGS": logistic}


@pytest.mark.parametrize("step", EM_CASES)
@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_em_reaches_the_same_top(data, step, objective):
    """Baum and Welch's steps, of which none falls."""
    model = EM_CASES[step]()
    plain = ssm.EM(accelerate=False, iterations=30)
    slow = ssm.maximize(model, data, plain, objective=objective, seed=1)
    assert step in slow.attrs["m_step"]
    if objective == "likelihood":
        at = [{n: float(slow.iterates[n][k]) for n in slow.parameters} for k in range(0, 30, 3)]
        path = [float(ssm.log_likelihood(model, data, v)[0]) for v in at]
        assert np.all(np.diff(path) > -1e-9)
    found = ssm.maximize(model, data, ssm.EM(), objective=objective, seed=1)
    best = ssm.maximize(model, data, objective=objective, seed=1)
    assert found.attrs["converged"]
    for name, value in best.parameters.items():
        assert found.parameters[name] == pytest.approx(value, abs=1e-4)


def posterior_by_grid(y):
    """Means and standard deviations of (stay, leave, m), by the midpoint rule."""
    unit = (np.arange(40) + 0.5) / 40
    m = np.linspace(-0.5, 3.0, 60)
    grid = np.array(np.meshgrid(unit, unit, m, indexing="ij")).reshape(3, -1)
    law = np.stack([1.0 - grid[1], grid[1]], axis=1)
    density = stats.norm.pdf(y[None, :, None], np.stack([0 * m, m]).T[:, None, :], 0.8)
    density = np.where(np.isnan(density), 1.0, density)  # (60, T, 2)
    which = np.tile(np.arange(60), 1600)
    total = np.log(grid[0]) + np.log(1 - grid[1]) - 0.5 * (grid[2] - 1.0) ** 2
    for t in range(len(y)):
        if t:
            up = law[:, 0] * grid[1] + law[:, 1] * grid[0]
            law = np.stack([1.0 - up, up], axis=1)
        law = law * density[which, t]
        norm = law.sum(axis=1)
        total, law = total + np.log(norm), law / norm[:, None]
    w = np.exp(total - total.max())
    w /= w.sum()
    mean = grid @ w
    return mean, np.sqrt((grid - mean[:, None]) ** 2 @ w)


@pytest.mark.slow
def test_gibbs_is_chosen_and_has_the_right_posterior(data):
    """Every parameter has a closed-form conditional: Beta rows of the transition, Normal mean."""
    idata = ssm.sample(weather(), data, draws=3000, warmup=200, seed=5, progress=False)
    attrs = idata["posterior"].attrs
    assert attrs["method"] == "Gibbs"
    assert "finite-state (hidden Markov)" in attrs["method_reason"]
    table = ssm.summary(idata)
    mean, sd = posterior_by_grid(data["y"])
    assert np.all(np.abs(table["mean"] - mean) < 4 * table["mcse_mean"] + 1e-3)
    assert np.all(np.abs(table["sd"] - sd) < 4 * table["mcse_sd"] + 1e-3)
    assert set(np.unique(idata["posterior"]["z"].values)) == {0.0, 1.0}


@pytest.mark.slow
@pytest.mark.parametrize("method", [ssm.MetropolisHastings(), ssm.PGAS(10)])
def test_other_samplers_agree(data, method):
    idata = ssm.sample(weather(), data, method, draws=2000, warmup=500, seed=6, progress=False)
    table = ssm.summary(idata)
    mean, sd = posterior_by_grid(data["y"])
    assert np.all(np.abs(table["mean"] - mean) < 4 * table["mcse_mean"] + 1e-3)
    assert np.all(np.abs(table["sd"] - sd) < 4 * table["mcse_sd"] + 1e-3)


def test_evidence_without_parameters_is_exact(data):
    found = ssm.evidence(weather(), data, fixed=VALUES)
    assert found.log_evidence == pytest.approx(independent(list(VALUES.values()), data["y"]))
    assert found.standard_error == 0.0


def test_explain_says_so():
    text = str(ssm.explain(second_order()))
    assert "4 combinations of values: the likelihood is exact, by the forward algorithm" in text
    assert "ForwardBackward: the model is finite-state (hidden Markov)" in " ".join(text.split())


def regimes(matrix):
    """Three regimes, whose transition matrix is one parameter, or one for each row."""
    model, strength = ssm.Model("regimes"), 1.0 + 4.0 * np.eye(3)
    if matrix:
        model.prior(lambda: {"P": ssm.Dirichlet(strength)})
        model.transition(lambda k, P: {"k": ssm.Categorical(P[k])})
    else:
        model.prior(lambda: {f"P{i}": ssm.Dirichlet(strength[i]) for i in range(3)})
        model.transition(lambda k, P0, P1, P2: {"k": ssm.Categorical(np.stack([P0, P1, P2])[k])})
    model.initial(lambda: {"k": ssm.Categorical([0.4, 0.3, 0.3])})
    model.observation(lambda k: {"y": ssm.Normal(2.0 * k, sd=1)})
    return model


@pytest.mark.slow
@pytest.mark.parametrize("method", [ssm.Gibbs(), ssm.MetropolisHastings()])
def test_a_matrix_of_shares_is_its_rows(method):
    """The same draws, whichever way the transition matrix is declared; and the same maximum."""
    P = np.array([[0.8, 0.1, 0.1], [0.2, 0.7, 0.1], [0.1, 0.3, 0.6]])
    y = ssm.simulate(regimes(True), {"P": P}, steps=60, seed=3)["y"].values[0]
    call = {"draws": 30, "warmup": 30, "chains": 1, "seed": 4, "progress": False}
    whole = ssm.sample(regimes(True), {"y": y}, method, **call)["posterior"]["P"].values
    rows = ssm.sample(regimes(False), {"y": y}, method, **call)["posterior"]
    apart = np.stack([rows[f"P{i}"].values for i in range(3)], axis=2)
    np.testing.assert_allclose(whole, apart, rtol=1e-10)
    np.testing.assert_allclose(whole.sum(axis=-1), 1.0)
    if isinstance(method, ssm.Gibbs):
        top = ssm.maximize(regimes(True), {"y": y}, objective="posterior", progress=False)
        other = ssm.maximize(regimes(False), {"y": y}, objective="posterior", progress=False)
        own = np.stack([other.parameters[f"P{i}"] for i in range(3)])
        np.testing.assert_allclose(top.parameters["P"], own, atol=1e-5)


def test_a_row_that_does_not_sum_to_one_is_named():
    P = np.array([[0.8, 0.1, 0.1], [0.3, 0.7, 0.1], [0.1, 0.3, 0.6]])
    with pytest.raises(ArgumentError, match=r"'P'\[1\]: the shares .* sum to 1\.1"):
        ssm.simulate(regimes(True), {"P": P}, steps=3)
