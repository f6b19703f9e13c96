"""MetropolisHastings, Gibbs and the variants of PMMH: settings, refusals, choice, bookkeeping.

Whether they sample the posterior is tested in tests/statistics/test_metropolis.py.
"""

from __future__ import annotations

import pickle

import arviz as az
import numpy as np
import pytest
import scipy.stats as st

import ssmppl as ssm
from ssmppl.inference.chains.metropolis_kernel import coordinates, local_derivatives
from ssmppl.inference.chains.smc2 import _factor
from ssmppl.inference.optimisation.quadratic import fitted_covariance
from ssmppl.inference.preparation.pilot import find_mode, scale_of
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose
from tests.statistics.checks import some

SHORT = {"draws": 12, "warmup": 8, "chains": 2, "progress": False, "seed": 1}
C = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 0.5]])

vector = ssm.Model("vector", inputs=("u",))


@vector.prior
def vector_prior():
    return {
        "b": ssm.Normal(np.zeros(2), sd=1),
        "Q": ssm.InverseWishart(5, scale=np.eye(2)),
        "r": ssm.InverseGamma(3, scale=1),
    }


@vector.initial
def vector_initial():
    return {"x": ssm.Normal(np.zeros(2), sd=1), "s": ssm.Dirac(0.0)}


@vector.transition
def vector_transition(x, u, b, Q):
    A = np.array([[0.8, 0.1], [0.0, 0.6]])
    return {"x": ssm.MvNormal(A @ x + b * u, covariance=Q), "s": ssm.Dirac(x[0])}


@vector.observation
def vector_observation(x, s, r):
    return {"y": ssm.Normal(C @ x + 0.2 * s, variance=r)}


def vector_data(steps, seed):
    inputs = {"u": np.sin(np.arange(steps) / 3.0)}
    values = {"b": [0.5, -0.5], "Q": np.eye(2) * 0.3, "r": 0.2}
    y = ssm.simulate(vector, values, inputs=inputs, seed=seed)["y"].values[0].copy()
    y[3, 1], y[5] = np.nan, np.nan
    return {"y": y, **inputs}


EXPERIMENTS = [vector_data(15, 1), vector_data(9, 2)]
VARIANTS = [
    ssm.MetropolisHastings(),
    ssm.MetropolisHastings(scale="natural", transform={"Q": "unconstrained", "r": "log"}),
    ssm.Gibbs(),
    *some([ssm.PMMH(particles=20, order=2, lag=3, proposal="bootstrap"),
           ssm.PMMH(particles=20, correlation=0.9, proposal="bootstrap")], 0),
]  # fmt: skip


@pytest.mark.parametrize("method", VARIANTS, ids=str)
def test_vectors_matrices_inputs_gaps_and_experiments(method):
    """Several states, one deterministic; matrix parameters; missing values; two experiments."""
    one = ssm.sample(vector, EXPERIMENTS, method, **SHORT)
    posterior = one["posterior"]
    assert posterior["Q"].shape == (2, 12, 2, 2)
    rows = posterior["rows"].values
    assert posterior["x"].shape == (2, 12, 2, max(rows), 2)
    assert rows[1] == 9
    assert np.all(np.linalg.eigvalsh(posterior["Q"].values) > 0)
    assert np.all(np.isfinite(one["sample_stats"]["lp"]))
    s, x = (posterior[n].values[:, :, 0, : rows[0]] for n in ("s", "x"))
    np.testing.assert_allclose(s[..., 1:], x[..., :-1, 0], atol=1e-8)
    again = ssm.sample(vector, EXPERIMENTS, method, **SHORT, states=False)
    assert "x" not in again["posterior"]
    if not isinstance(method, ssm.MetropolisHastings):  # which draws no states nobody asked for
        np.testing.assert_array_equal(again["posterior"]["r"], posterior["r"])
    fixed = {"Q": np.eye(2), "b": np.zeros(2), "r": 0.2}
    held = ssm.sample(vector, EXPERIMENTS, method, fixed=fixed, **SHORT)
    assert "Q" not in held["posterior"]
    if not getattr(method, "order", 0) and not getattr(method, "correlation", 0):
        return
    seen = [np.isfinite(np.asarray(e["y"])).any(axis=1).sum() for e in EXPERIMENTS]
    assert one["log_likelihood"]["one_step"].shape == (2, 12, sum(seen))


nonlinear = ssm.Model("nonlinear")


@nonlinear.prior
def nonlinear_prior():
    return {"p": ssm.Dirichlet(np.ones(3)), "q": ssm.HalfFlat(), "c": ssm.Flat()}


@nonlinear.initial
def nonlinear_initial():
    return {"x": ssm.Normal(0, sd=1), "k": ssm.Poisson(2)}


@nonlinear.transition
def nonlinear_transition(x, k, q, c):
    return {"x": ssm.Normal(np.sin(x) + c, variance=q), "k": ssm.Poisson(1 + 0.5 * k)}


@nonlinear.observation
def nonlinear_observation(x, k, p):
    return {"y": ssm.Normal(x + p[0] + k, sd=0.5)}


NONLINEAR_DATA = {"y": np.array([2.0, 1.0, 3.0, 2.5, 4.0])}


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ({"method": ssm.Gibbs()}, ["Gibbs needs a linear Gaussian", "ssm.PGAS", "line "]),
        ({"method": ssm.MetropolisHastings()}, ["MetropolisHastings needs a linear", "ssm.PMMH"]),
        ({"method": ssm.PMMH(correlation=0.9)}, ["poisson sampler", "correlation=0.0", "line "]),
        ({"method": ssm.PMMH(correlation=1.0)}, ["correlation=1.0", "0.99"]),
        ({"method": ssm.PMMH(order=3)}, ["order=3", "gradient"]),
        ({"method": ssm.PMMH(order=1, correlation=0.5)}, ["order=1 together with", "one of them"]),
        ({"method": ssm.PMMH(lag=-1)}, ["lag=-1"]),
        ({"method": ssm.PMMH(scale="log")}, ["scale='log'", "natural"]),
        ({"method": ssm.PMMH(transform={"q": "sqrt"})}, ["sqrt", "reciprocal"]),
        ({"method": ssm.PMMH(transform={"qq": "log"})}, ["'qq'", "q"]),
        ({"method": ssm.PMMH(scale="natural")}, ["p is a probability vector", "unconstrained"]),
        ({"method": ssm.PMMH(transform={"c": "log"})}, ["c is not confined", "natural"]),
        ({"method": ssm.PMMH(covariance=np.eye(2))}, ["(2, 2)", "4 x 4"]),
        ({"method": ssm.PMMH(covariance=-np.eye(4))}, ["not positive definite"]),
    ],
)
def test_refusals_say_why(arguments, fragments):
    with pytest.raises(ssm.ArgumentError) as error:
        ssm.sample(nonlinear, NONLINEAR_DATA, **{**SHORT, "start": {"q": 0.5}, **arguments})
    for fragment in fragments:
        assert fragment in str(error.value)


chosen = ssm.Model("chosen")


@chosen.prior
def chosen_prior():
    return {"a": ssm.Normal(0, sd=1), "q": ssm.Gamma(2, rate=1)}


@chosen.initial
def chosen_initial():
    return {"x": ssm.Normal(0, sd=1)}


@chosen.transition
def chosen_transition(x, a, q):
    return {"x": ssm.Normal(a * x, precision=q)}


@chosen.observation
def chosen_observation(x):
    return {"y": ssm.Normal(x, sd=0.5)}


def test_choice_by_structure_is_told():
    plan = str(ssm.explain(chosen))
    assert "Gibbs: the model is linear Gaussian, and every parameter has a closed-form" in " ".join(
        plan.split()
    )
    idata = ssm.sample(chosen, {"y": np.array([0.3, 0.1, -0.2])}, **SHORT)
    assert idata["posterior"].attrs["method"] == "Gibbs"
    assert "closed-form" in idata["posterior"].attrs["method_reason"]
    assert "'interweave': 'auto'" in str(idata["posterior"].attrs["settings"]).replace('"', "'")

    model = ssm.Model("no closed form")
    model.initial(chosen_initial)
    model.observation(chosen_observation)
    model.prior(lambda: {"w": ssm.Uniform(0, 3)})
    model.transition(lambda x, w: {"x": ssm.Normal(np.cos(w) * x, sd=0.5)})
    plan = " ".join(str(ssm.explain(model)).split())
    assert "the model is linear Gaussian, but w has no closed-form conditional" in plan
    assert "PGAS: the model is not linear" in " ".join(str(ssm.explain(nonlinear)).split())


def test_walk_stands_still_without_adaptation():
    """A covariance that was given is kept, and its chain differs from that of an adapting one."""
    data = {"y": np.array([0.3, 0.1, -0.2, 0.7])}
    given = ssm.MetropolisHastings(covariance=0.1 * np.eye(2))
    idata = ssm.sample(chosen, data, given, **SHORT)
    covariance = np.array(eval(str(idata["posterior"].attrs["walk_covariance"])))
    np.testing.assert_allclose(covariance, 0.1 * np.eye(2))
    adapting = ssm.MetropolisHastings(covariance=0.1 * np.eye(2), adapt=True)
    other = ssm.sample(chosen, data, adapting, **SHORT)
    assert not np.array_equal(idata["posterior"]["a"], other["posterior"]["a"])


def test_coordinates_are_one_to_one_with_their_jacobian():
    """exp(log density) integrates to the same over every scale: densities differ by |dw / dw'|."""
    space = space_of(pose(chosen, {"y": np.array([0.3, 0.1])}), {}, {"a": 0.4, "q": 1.7})
    z = space.z[space.positions]
    theta, log_p = space.parameters(z)
    for kind, slope in (("natural", 1.0), ("log", 1.0 / 1.7), ("reciprocal", 1.0 / 1.7**2)):
        w = coordinates(space, "natural", {"q": kind})
        point = w.at(z)
        own, log_density = w.parameters(point)
        np.testing.assert_allclose(own, theta)
        # p(w) |dw / dq| = p(q), and space.parameters is on the scale of log q
        assert log_density + np.log(slope) == pytest.approx(log_p - np.log(1.7))
    w = coordinates(space, "natural", {"q": "reciprocal"})
    assert w.parameters(np.array([0.4, -1.0]))[1] == -np.inf
    assert w.parameters(np.array([0.4, 0.0]))[1] == -np.inf


def test_a_chain_goes_nowhere_that_the_prior_density_is_infinite():
    """It would never leave: 1 - p is 0 from 37 on of the unconstrained scale."""

    @ssm.distribution(lower=0, upper=1, closed=True)
    def Steep(p):
        return np.log(0.5) - 0.5 * np.log(1.0 - p)

    model = ssm.Model("steep")
    model.prior(lambda: {"p": Steep()})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, p: {"x": ssm.Normal(p * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    space = space_of(pose(model, {"y": np.array([0.3, 0.1])}), {}, {})
    natural = coordinates(space, "natural", None)
    for parameters, inside, end in ((space.parameters, 3.0, 40.0), (natural.parameters, 0.9, 1.0)):
        assert np.isfinite(parameters(np.array([inside]))[1])
        theta, log_density = parameters(np.array([end]))
        assert theta == [1.0]
        assert log_density == -np.inf


def test_chart_gives_derivatives_of_the_change_of_scale():
    space = space_of(pose(chosen, {"y": np.array([0.3, 0.1])}), {}, {"a": 0.4, "q": 1.7})
    w = coordinates(space, "unconstrained", {"q": "reciprocal"})
    point = w.at(space.z[space.positions])
    found = local_derivatives(w, point, np.array([0.3, 0.2]), second=True)
    v = 1 / 1.7
    np.testing.assert_allclose(found.jacobian, [[1, 0], [0, -1 / v**2]], atol=1e-6)
    np.testing.assert_allclose(found.second[1], [[0, 0], [0, 2 / v**3]], atol=1e-5)
    # log prior of a is -a^2 / 2; that of v = 1 / q with q ~ Gamma(2, 1) is -3 log v - 1 / v
    np.testing.assert_allclose(found.slope, [-0.4, -3 / v + 1 / v**2], atol=1e-5)
    np.testing.assert_allclose(found.curvature, [[-1, 0], [0, 3 / v**2 - 2 / v**3]], atol=1e-4)


def in_units_of(c):
    """A model of which every number has the unit of the data."""
    model = ssm.Model("units")
    model.prior(lambda: {"m": ssm.StudentT(4, 0, scale=10 * c), "s": ssm.HalfNormal(sd=10 * c)})
    model.initial(lambda m, s: {"x": ssm.Normal(m, sd=s)})
    model.transition(lambda x, m, s: {"x": ssm.Normal(m + 0.5 * (x - m), sd=s)})
    model.observation(lambda x, s: {"y": ssm.Normal(x, sd=s)})
    return model


@pytest.mark.parametrize("c", [1e-10, 1e-6, 1e6, 1e10, 1e100])
def test_the_pilot_finds_the_same_mode_and_scale_in_any_unit(c):
    """Climbing in steps of one, and measuring no scale above 5 or below 1e-4, it stayed at the
    start with scales of its own limits: chains of data in pounds did not mix."""
    y = np.random.default_rng(1).normal(0.3, 1.0, 40)

    def pilot(unit):
        space = space_of(pose(in_units_of(unit), {"y": y * unit}), {}, {})
        found = find_mode(space, np.random.SeedSequence(3), "kalman")
        theta, _ = space.parameters(found.z)
        return theta / unit, found.scale / [unit, 1.0]

    (here, scale), (expected, known) = pilot(c), pilot(1.0)
    assert np.all(np.abs(here - expected) < 0.5 * known * [1.0, expected[1]])
    np.testing.assert_allclose(scale, known, rtol=0.4)


def test_scales_at_an_edge_are_those_of_the_side_that_there_is():
    found = scale_of(np.zeros(1), lambda z: -3.0 * z[0] if z[0] >= 0.0 else -np.inf)
    assert 0.5 < found[0] < 1.0  # log p falls by 8 over 8 / 3


def test_the_factor_of_particles_has_their_unit():
    z = np.random.default_rng(2).standard_normal((50, 2))
    w, units = np.full(50, 0.02), np.array([1e-9, 1e9])
    np.testing.assert_allclose(_factor(z * units, w), units[:, None] * _factor(z, w), rtol=1e-6)


def test_fitted_covariance_is_that_of_a_gaussian():
    """Exact on a quadratic, from a guess that is far off; robust to noise of half a unit."""
    rng = np.random.default_rng(5)
    covariance = np.array([[1.0, 0.6, 0.0], [0.6, 2.0, -0.5], [0.0, -0.5, 0.5]])
    precision = np.linalg.inv(covariance)

    def log_p(w):
        return float(-0.5 * w @ precision @ w)

    scale = np.array([0.5, 2.0, 1.0])
    exact = fitted_covariance(log_p, np.zeros(3), scale, np.random.default_rng(1))
    np.testing.assert_allclose(exact, covariance, rtol=1e-6, atol=1e-8)
    noisy = fitted_covariance(
        lambda w: log_p(w) + 0.5 * rng.standard_normal(), np.zeros(3), scale,
        np.random.default_rng(1), rounds=4,
    )  # fmt: skip
    ratio = np.linalg.eigvals(np.linalg.solve(covariance, noisy)).real
    assert np.all((ratio > 0.3) & (ratio < 3.0)), ratio


def test_states_cross_process_borders():
    for method in VARIANTS[-2:]:
        assert pickle.loads(pickle.dumps(method)) == method


idle = ssm.Model("idle")


@idle.prior
def idle_prior():
    return {"p": ssm.Uniform(0, 1), "q": ssm.Gamma(3, rate=2), "m": ssm.Normal(1, sd=2)}


@idle.initial
def idle_initial():
    return {"x": ssm.Normal(0, sd=1)}


@idle.transition
def idle_transition(x):
    return {"x": ssm.Normal(0.5 * x, sd=1)}


@idle.observation
def idle_observation(x):
    return {"y": ssm.Normal(x, sd=1)}


@pytest.mark.parametrize(
    ("method", "draws"),
    [
        (ssm.Gibbs(), 150),  # independent draws
        (ssm.PGAS(particles=5, proposal="bootstrap"), 150),
        (ssm.PMMH(particles=50, proposal="bootstrap"), 1500),
        (ssm.MetropolisHastings(), 1500),
    ],
    ids=["Gibbs", "PGAS", "PMMH", "MetropolisHastings"],
)
def test_parameters_that_nothing_depends_on_keep_their_prior(method, draws):
    """Kolmogorov and Smirnov's distance from the prior, with as many draws as are independent."""
    idata = ssm.sample(
        idle, {"y": np.array([0.3, -1.0, 0.8])}, method, draws=draws, warmup=draws // 3, chains=2,
        seed=4, states=False, progress=False,
    )  # fmt: skip
    laws = {"p": st.uniform(), "q": st.gamma(3, scale=0.5), "m": st.norm(1, 2)}
    for name, law in laws.items():
        draws = idata["posterior"][name].values
        size = min(float(az.ess(draws)), draws.size)
        distance = st.kstest(draws.ravel(), law.cdf).statistic
        assert size > 100
        assert st.kstwobign.sf(distance * np.sqrt(size)) > 1e-3, (name, distance, size)


def bounded_initial():
    return {"x": ssm.Normal(0, sd=1)}


def bounded_transition(x, a):
    return {"x": ssm.Normal(0.5 * x + np.sum(a), sd=1)}


def bounded_observation(x):
    return {"y": ssm.Normal(x, sd=1)}


BOUNDED_DATA = {"y": np.array([1.5, 2.2, 0.9])}


def bounded(parent, child):
    """b has a law, and a has one given b."""
    model = ssm.Model("bounded")

    @model.prior
    def parents():
        return {"b": parent}

    @model.prior
    def children(b):
        return {"a": child(b)}

    model.initial(bounded_initial)
    model.transition(bounded_transition)
    model.observation(bounded_observation)
    return pose(model, BOUNDED_DATA)


POSITIVE, REAL = ssm.Gamma(2, rate=1), ssm.Normal(1, sd=2)
LOGARITHMS = {
    "a real one": (POSITIVE, lambda b: ssm.Normal(1, sd=2), {}, False),
    "a positive one": (REAL, lambda b: ssm.LogNormal(b, sd=2), {}, True),
    "truncated at 0": (REAL, lambda b: ssm.Truncated(ssm.Normal(b, sd=2), lower=0), {}, True),
    "truncated below 0": (REAL, lambda b: ssm.Truncated(ssm.Normal(b, sd=2), lower=-1), {}, False),
    "between constants": (REAL, lambda b: ssm.Uniform(0, 3), {}, True),
    "above a positive one": (POSITIVE, lambda b: ssm.Uniform(b, 9), {}, True),
    "above a real one": (REAL, lambda b: ssm.Uniform(b, 9), {}, False),
    "above a known one": (REAL, lambda b: ssm.Uniform(b, 9), {"b": 0.5}, True),
    "above a known negative one": (REAL, lambda b: ssm.Uniform(b, 9), {"b": -0.5}, False),
}


@pytest.mark.parametrize("name", LOGARITHMS)
def test_a_logarithm_is_taken_where_the_support_has_one(name):
    """Whatever the value that the chain begins from: it moves on, and there was no warning."""
    parent, child, fixed, fits = LOGARITHMS[name]
    held = {n: np.asarray(v) for n, v in fixed.items()}
    space = space_of(bounded(parent, child), held, {"a": np.asarray(2.0)})
    if fits:
        where = coordinates(space, "unconstrained", {"a": "log"})
        w = where.at(space.z[space.positions])
        np.testing.assert_allclose(where.parameters(w)[0], space.theta, rtol=1e-12)
        return
    with pytest.raises(ssm.ArgumentError, match="a is not confined to positive numbers"):
        coordinates(space, "unconstrained", {"a": "log"})


def test_a_start_without_a_reciprocal_is_refused():
    space = space_of(bounded(POSITIVE, lambda b: ssm.Normal(0, sd=1)), {}, {})
    assert space.theta[1] == 0.0
    where = coordinates(space, "unconstrained", {"a": "reciprocal"})
    with pytest.raises(ssm.ArgumentError, match=r"start at a = 0, .* reciprocal scale"):
        where.at(space.z[space.positions])


def test_a_logarithm_is_of_every_component():
    model = ssm.Model("two")

    @model.prior
    def prior():
        return {"a": ssm.Uniform([0.0, -1.0], 9)}

    model.initial(bounded_initial)
    model.transition(bounded_transition)
    model.observation(bounded_observation)
    space = space_of(pose(model, BOUNDED_DATA), {}, {})
    with pytest.raises(ssm.ArgumentError, match="a is not confined"):
        coordinates(space, "unconstrained", {"a": "log"})
