"""The twisted filter's likelihood is unbiased, its Markov kernels keep the posterior, and "auto"
turns to it where nothing else will do."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.proposals import twisted as analysis
from ssmppl.analysis.proposals.twisted import DEFENSIVE
from ssmppl.codegen.kernels.particle.particle_filter import GUIDED_SHARE
from ssmppl.codegen.modules import program
from ssmppl.codegen.native.entries import ByAddress
from ssmppl.datasets import ice_varves
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.inference.chains.pmmh import ParticleLikelihood
from ssmppl.inference.particles import filtering
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    log_likelihood_estimate,
    repeated_estimates,
)
from ssmppl.inference.preparation import proposal_choice
from ssmppl.inference.preparation.proposal_choice import ENOUGH, choose_by_pilot
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from tests.models import standard as models
from tests.models.twisted import (
    crash,
    crash_log_likelihood,
    pendulum,
    ricker,
    ricker_log_likelihood,
    volatility,
    volatility_log_likelihood,
)
from tests.statistics.checks import (
    LEVEL,
    assert_moments,
    assert_within,
    deviations,
    seed_of,
    some,
)
from tests.statistics.exact import DenseGaussian, GridPosterior
from tests.statistics.test_likelihood import SCHEMES, THRESHOLDS, Table, estimates, with_gaps

COMBINATIONS = [("twisted", scheme, threshold) for scheme in SCHEMES for threshold in THRESHOLDS]
# Systematic resampling is compiled apart, and soon.
SYSTEMATIC = pytest.param(COMBINATIONS[:2], id="systematic")
OTHER_SCHEMES = pytest.param(COMBINATIONS[2:], id="other schemes", marks=pytest.mark.slow)


# -- position and velocity, of which the position is seen
def vehicle_rows(steps, h, *name):
    d = ssm.simulate(models.vehicle, {"h": h}, steps=steps, seed=seed_of("twisted", *name))
    return with_gaps(d["y"].values[0], 0.25, "twisted", *name)


def vehicle_exact(y, h):
    return DenseGaussian(y, **models.vehicle_matrices(h)).log_likelihood


@pytest.mark.parametrize(("particles", "repeats"), [
    *some([(2, 1000), (10, 1000), (100, 200)], 0),
])  # fmt: skip
def test_position_and_velocity(particles, repeats):
    """Every scheme and threshold. The guide is exact here, so that even two particles do.

    One run in a hundred ends in the long tail that the transition's share of the moves leaves, on
    which the mean and its error hang: hence so many repeats of small N.
    """
    y = vehicle_rows(25, 0.5, "rows")
    exact, table = vehicle_exact(y, 0.5), Table(3 * len(COMBINATIONS))
    for combination in COMBINATIONS:
        name = f"vehicle {particles} {combination}"
        log_z = estimates(
            models.vehicle, {"y": y}, {"h": 0.5}, combination, particles, repeats, seed_of(name)
        )
        table.cell(name, log_z, exact, particles, len(y))
    table.judge()


def test_every_experiment_and_parameter_has_its_own_guide():
    """Three series of different lengths, at values of h that the data are not from.

    Under a guide that is exact only the transition's shares, of moves and of weights, leave
    variance: at most that share, a row and particle.
    """
    series = [vehicle_rows(steps, 0.5, "several", steps) for steps in (12, 1, 30)]
    data, table = [{"y": y} for y in series], Table(2)
    for h in (0.2, 0.9):
        exact = sum(vehicle_exact(y, h) for y in series)
        name = f"several {h}"
        log_z = estimates(
            models.vehicle, data, {"h": h}, ("twisted", "systematic", 1.0), 20, 400, seed_of(name)
        )
        table.cell(name, log_z, exact, 20, 43)
        assert np.var(log_z, ddof=1) < (DEFENSIVE + GUIDED_SHARE) * 43 / 20
    table.judge()


def test_filter_that_keeps_a_path():
    """What PMMH runs makes the same estimate, and its path follows the model."""
    y = vehicle_rows(25, 0.5, "rows")
    problem, theta = pose(models.vehicle, {"y": y}), np.array([0.5])
    likelihood = ParticleLikelihood(problem, FilterSettings(20, "twisted"))
    stream = random_state(np.random.SeedSequence(seed_of("twisted path")))
    log_z = np.empty(1000)
    for i in range(len(log_z)):
        run = likelihood.run(theta, None, stream)
        log_z[i] = run.log_likelihood
        assert log_z[i] == pytest.approx(run.increments[0].sum())
        v, p = run.paths[0].T
        np.testing.assert_allclose(p[1:], p[:-1] + 0.5 * v[:-1], atol=1e-12)
    table = Table(1)
    table.cell("path of the vehicle", log_z, vehicle_exact(y, 0.5), 20, len(y))
    table.judge()


def test_far_less_variance_than_by_the_transition():
    """Which is all that the other proposals have to offer where a position alone is seen."""
    y = vehicle_rows(25, 0.5, "rows")
    spread = {
        p: np.std(estimates(models.vehicle, {"y": y}, {"h": 0.5}, (p, "systematic", 1.0), 50, 200,
                            seed_of("variance", p)), ddof=1)
        for p in ("bootstrap", "twisted")
    }  # fmt: skip
    print(spread)
    # of 200 draws each, the ratio of the variances is known to a factor of 1.6 (F test, 0.001)
    assert 1.6 * 10 * spread["twisted"] ** 2 < spread["bootstrap"] ** 2


def test_the_same_seed_gives_the_same_numbers():
    problem = pose(models.vehicle, {"y": vehicle_rows(25, 0.5, "rows")})
    settings, root = FilterSettings(20, "twisted"), np.random.SeedSequence(1)
    one = repeated_estimates(problem, np.array([0.5]), settings, root, range(6))
    two = repeated_estimates(problem, np.array([0.5]), settings, root, range(3, 6))
    np.testing.assert_array_equal(one[3:], two)
    assert len(set(one)) == 6


# -- models that are not linear
RETURNS = np.array([0.7, -1.1, 0.9, 2.5, -0.7, np.nan, 0.8, -0.6])
CRASHES = np.array([0, 26, 136, 0, 1, 27, 217, 0, 0, 0, 5, np.nan, np.nan, 169, 0, 1.0])
COUNTS = np.array([6.0, 17.0, np.nan, np.nan, 30.0, 19.0, 22.0, 28.0])


def test_quadrature():
    """A grid half as fine gives the same, so that the grid is fine enough."""
    for hole, y in ((0.0, RETURNS), (-5.0, 5 * RETURNS)):
        fine, coarse = (volatility_log_likelihood(y, hole, 0.5, points) for points in (1200, 600))
        assert fine == pytest.approx(coarse, abs=1e-6)
    fine, coarse = (ricker_log_likelihood(COUNTS, points) for points in (1600, 800))
    assert fine == pytest.approx(coarse, abs=1e-9)
    fine, coarse = (crash_log_likelihood(CRASHES, points) for points in (4000, 2000))
    assert fine == pytest.approx(coarse, abs=1e-6)


@pytest.mark.parametrize("combinations", [SYSTEMATIC, OTHER_SCHEMES])
@pytest.mark.parametrize("hole", some([-5.0, 0.0], 1))
def test_volatility(hole, combinations):
    """A spread that depends on the state. Where the hole is at 0 the guide comes to no number, so
    that particles move by the transition."""
    y = 5 * RETURNS if hole else RETURNS
    parameters = {"hole": hole, "sigma": 0.5}
    exact, table = volatility_log_likelihood(y, hole, 0.5), Table(2 * len(COMBINATIONS))
    for combination in combinations:
        name = f"volatility {hole} {combination}"
        log_z = estimates(
            volatility, {"y": y}, parameters, combination, 100, 1000, seed_of(name)
        )  # fmt: skip
        table.cell(name, log_z, exact, 100, len(y))
    table.judge()


@pytest.mark.parametrize("combinations", [SYSTEMATIC, OTHER_SCHEMES])
@pytest.mark.parametrize("particles", [2, 10, 100])
def test_counts_of_what_multiplies(particles, combinations):
    """Noise in an exponent, in which the state is not affine."""
    exact, table = ricker_log_likelihood(COUNTS), Table(3 * len(COMBINATIONS))
    for combination in combinations:
        name = f"ricker {particles} {combination}"
        log_z = estimates(ricker, {"y": COUNTS}, {}, combination, particles, 1000, seed_of(name))
        table.cell(name, log_z, exact, particles, len(COUNTS))
    table.judge()


def test_populations_that_crash():
    """exp(x) under- and overflows, and the first linearisation leads astray."""
    exact, table = crash_log_likelihood(CRASHES), Table(3)
    for proposal in ("guided", "auxiliary", "twisted"):
        name = f"crash {proposal}"
        combination = (proposal, "systematic", 1.0)
        log_z = estimates(crash, {"y": CRASHES}, {}, combination, 400, 1000, seed_of(name))
        assert np.var(log_z) < 1.0
        table.cell(name, log_z, exact, 400, len(CRASHES))
    table.judge()


def test_no_likelihood_where_nothing_fits():
    parameters = {"hole": -5.0, "sigma": 1e200}
    values = ssm.log_likelihood(
        volatility, {"y": RETURNS}, parameters, proposal="twisted", repeats=3, seed=1
    )
    assert np.all(values < -1e100)


# -- Markov chains
def test_conditional_smc_keeps_the_law_of_the_states():
    """Trajectories at a known parameter have the moments of a dense Gaussian."""
    y = vehicle_rows(25, 0.5, "rows")
    exact = DenseGaussian(y, **models.vehicle_matrices(0.5))
    idata = ssm.sample(
        models.vehicle, {"y": y}, ssm.PGAS(particles=5, proposal="twisted"), draws=1000,
        warmup=50, fixed={"h": 0.5}, progress=False, seed=seed_of("twisted pgas"),
    )  # fmt: skip
    found = np.stack([idata["posterior"][n].values for n in ("v", "p")], axis=-1)
    assert_moments(found, exact, "twisted vehicle", 1)


def test_metropolis_hastings():
    """The posterior of the step that stands in the deterministic law of the position."""
    y = vehicle_rows(25, 0.5, "rows")
    exact = GridPosterior(
        lambda h: vehicle_exact(y, h) - 0.5 * ((h - 0.4) / 0.2) ** 2, -0.8, 2.0
    )  # fmt: skip
    idata = ssm.sample(
        models.vehicle, {"y": y}, ssm.PMMH(particles=10, proposal="twisted"), draws=1000,
        warmup=500, progress=False, seed=seed_of("twisted pmmh"),
    )  # fmt: skip
    assert idata["posterior"].attrs["proposal"] == "twisted"
    print(ssm.summary(idata).to_string(), exact.mean, exact.sd)
    assert_within(deviations(idata["posterior"]["h"].values, exact.mean, exact.sd))


@pytest.mark.slow
def test_moments_of_the_filter():
    """At the last row, where the guide knows no more than the filter, weighted particles are a
    sample of the exact filter's law; before it few of them matter."""
    y = vehicle_rows(25, 0.5, "rows")
    exact = ssm.kalman_filter(models.vehicle, {"y": y}, {"h": 0.5})
    runs = ssm.particle_filter(
        models.vehicle, {"y": y}, {"h": 0.5}, particles=2000, repeats=40, proposal="twisted",
        seed=seed_of("twisted moments"),
    )  # fmt: skip
    z = []
    for name in ("v", "p"):
        for found, truth in (
            (runs[name].values, exact[name].values),
            (runs[f"{name}_sd"].values ** 2, exact[f"{name}_sd"].values ** 2),
        ):
            last = found[:, -1]
            error = last.std(ddof=1) / np.sqrt(len(last))  # their bias is a seventh of that
            z.append((last.mean() - truth[0, -1]) / error)
    limit = float(stats.t.isf(LEVEL / (2 * len(z)), 39))
    print(f"deviations {np.round(z, 2)}, limit {limit:.2f}")
    assert np.max(np.abs(z)) < limit
    log_z = runs["log_likelihood_increment"].sum("time").values
    table = Table(1)
    table.cell("with moments", log_z, vehicle_exact(y, 0.5), 2000, len(y))
    table.judge()


# -- "auto"
@pytest.fixture
def pilot(monkeypatch):
    """Pretended estimates: choose(...) with given standard deviations of log Z by proposal; None
    where the filter fails. Returns what was tried, and the choice."""

    def run(problem, theta, spreads, whole=True):
        tried = []

        def pretended(problem, theta, settings, seed, repeats):
            tried.append(settings.proposal)
            if spreads[settings.proposal] is None:
                raise SamplingError("nothing is finite")
            z = np.linspace(-1, 1, len(repeats))
            return spreads[settings.proposal] * z / np.std(z, ddof=1)

        monkeypatch.setattr(proposal_choice, "_choices", {})
        monkeypatch.setattr(proposal_choice, "repeated_estimates", pretended)
        return tried, choose_by_pilot(problem, theta, whole=whole)

    return run


OTHERS = ["bootstrap", "guided", "auxiliary"]


def forgotten(problem, monkeypatch):
    """The problem, with no twisted filter generated by another test."""
    monkeypatch.delitem(vars(problem.program), "twisted", raising=False)
    return problem


def generated(problem):
    """Whether its twisted filter was generated; compiled it is later."""
    return "twisted" in vars(problem.program)


def test_the_twisted_proposal_is_a_last_resort(pilot, monkeypatch):
    problem = forgotten(pose(models.varves, {"y": [20.0, 30.0, 22.0]}), monkeypatch)
    theta = np.array([0.9, 20.0])
    enough = {"bootstrap": 9.0, "guided": 2 * ENOUGH, "auxiliary": 0.99 * ENOUGH, "twisted": 0.01}
    tried, choice = pilot(problem, theta, enough)
    assert (tried, choice.name) == (OTHERS, "auxiliary")
    assert not generated(problem)
    assert "twisted" not in choice.figures
    too_much = dict.fromkeys(OTHERS, 1.01 * ENOUGH)
    tried, choice = pilot(problem, theta, too_much | {"twisted": 0.1 * ENOUGH})
    assert (tried, choice.name) == ([*OTHERS, "twisted"], "twisted")
    tried, choice = pilot(problem, theta, too_much | {"twisted": 1.01 * ENOUGH})
    assert tried == [*OTHERS, "twisted"]  # and no better, at a higher cost than the transition
    assert choice.name == "bootstrap"


def test_a_last_resort_where_filters_fail(pilot):
    problem = pose(models.varves, {"y": [20.0, 30.0, 22.0]})
    theta, fail = np.array([0.9, 20.0]), dict.fromkeys(OTHERS)
    assert pilot(problem, theta, fail | {"twisted": 3.0})[1].name == "twisted"
    tried, choice = pilot(problem, theta, fail | {"twisted": None})
    assert (tried, choice.name) == ([*OTHERS, "twisted"], "bootstrap")
    infinite = dict.fromkeys(OTHERS, np.inf) | {"twisted": 2.0}
    assert pilot(problem, theta, infinite)[1].name == "twisted"


def test_a_last_resort_where_nothing_else_is_derived(pilot):
    """Particles could only move by the transition; so there is a pilot after all."""
    problem = pose(pendulum, {"y": [0.8, 0.7, 0.6]})
    assert pilot(problem, np.empty(0), {"bootstrap": 0.5 * ENOUGH})[0] == ["bootstrap"]
    tried, choice = pilot(problem, np.empty(0), {"bootstrap": 2 * ENOUGH, "twisted": 0.2})
    assert (tried, choice.name) == (["bootstrap", "twisted"], "twisted")


def test_a_last_resort_for_whole_records_only(pilot):
    """Where moments at single rows are wanted, few twisted particles would tell them."""
    problem = pose(models.varves, {"y": [20.0, 30.0, 22.0]})
    too_much = dict.fromkeys(OTHERS, 2 * ENOUGH) | {"twisted": 0.1}
    tried, choice = pilot(problem, np.array([0.9, 20.0]), too_much, whole=False)
    assert tried == OTHERS
    assert choice.name != "twisted"


@pytest.mark.parametrize("variant", [{"order": 1}, {"order": 2}, {"correlation": 0.9}])
def test_variants_that_know_no_guide_say_so(variant):
    method = ssm.PMMH(particles=20, proposal="twisted", **variant)
    with pytest.raises(ArgumentError, match="guide of the twisted proposal"):
        ssm.sample(
            models.varves, {"y": [20.0, 30.0, 22.0]}, method, draws=2, warmup=2, chains=1, seed=1
        )


@pytest.mark.slow
def test_the_pendulum_chooses_it_and_the_varves_do_not(monkeypatch):
    y = ssm.simulate(pendulum, {}, steps=200, seed=seed_of("swing"))["y"].values[0]
    choice = choose_by_pilot(pose(pendulum, {"y": y}), np.empty(0), whole=True)
    assert choice.name == "twisted", choice
    assert list(choice.figures) == ["bootstrap", "twisted"]
    assert 10 * choice.figures["twisted"][0] < choice.figures["bootstrap"][0]
    assert generated(pose(pendulum, {"y": y}))
    problem = forgotten(pose(models.varves, {"y": ice_varves()}), monkeypatch)
    choice = choose_by_pilot(problem, np.array([0.6, 5.0]), whole=True)
    assert sorted(choice.figures) == sorted(OTHERS)
    assert not generated(problem)


# -- many noises: the moves in loops
@pytest.fixture
def in_loops(monkeypatch):
    """Models of few noises take the road of those with many; programs are forgotten afterwards."""
    monkeypatch.setattr(analysis, "WRITTEN_OUT", 0)
    monkeypatch.setattr(program, "_programs", OrderedDict())


@pytest.mark.parametrize(
    "case",
    [
        *some(["vehicle", "volatility"], 0),
        *some(["ricker"], 0, pytest.mark.exhaustive),
    ],
)
def test_moves_in_loops(case, in_loops):
    """Fewer noises in x_t than in x_1; a spread of each particle; noise in an exponent."""
    combination, parameters = ("twisted", "systematic", 1.0), {}
    if case == "vehicle":
        model, parameters, y = models.vehicle, {"h": 0.5}, vehicle_rows(25, 0.5, "rows")
        exact = vehicle_exact(y, 0.5)
    elif case == "volatility":
        model, parameters, y = volatility, {"hole": -5.0, "sigma": 0.5}, 5 * RETURNS
        exact = volatility_log_likelihood(y, -5.0, 0.5)
    else:
        model, y, exact = ricker, COUNTS, ricker_log_likelihood(COUNTS)
    table = Table(1)
    log_z = estimates(model, {"y": y}, parameters, combination, 100, 1000, seed_of("loops", case))
    table.cell(f"loops {case}", log_z, exact, 100, len(y))
    table.judge()
    assert not pose(model, {"y": y}).program.gaussian.found.written_out


RING = 20


def ring_matrices():
    """Twenty states in a ring, each pulled to its neighbour; every other one is seen."""
    A = 0.7 * np.eye(RING) + 0.25 * np.roll(np.eye(RING), 1, axis=0)
    C = np.eye(RING)[::2]
    one, noise = np.eye(RING), {"Q": 0.09 * np.eye(RING), "R": 0.04 * np.eye(len(C))}
    return {"m": np.zeros(RING), "P": one, "A": A, "b": 0.0, "C": C, "d": 0.0, **noise}


@pytest.fixture(scope="module")
def ring():
    """The model, rows of which a few are missing, and the exact answer."""
    ring = ssm.Model("ring")
    ring.initial(lambda: {"x": ssm.Normal(np.zeros(RING), sd=1)})
    ring.transition(lambda x: {"x": ssm.Normal(0.7 * x + 0.25 * np.roll(x, 1), sd=0.3)})
    ring.observation(lambda x: {"y": ssm.Normal(x[::2], sd=0.2)})
    y = ssm.simulate(ring, {}, steps=20, seed=seed_of("ring"))["y"].values[0]
    y[4, 3] = y[9] = np.nan
    return ring, y, DenseGaussian(y, **ring_matrices())


@pytest.mark.slow
def test_twenty_noises(ring):
    """More than can be written out, in a moderate dimension; the guide is exact here, so that the
    variance is little, where the transition's is hopeless."""
    (ring, y, dense), table = ring, Table(1)
    exact = dense.log_likelihood
    log_z = estimates(
        ring, {"y": y}, {}, ("twisted", "systematic", 1.0), 50, 300, seed_of("ring z")
    )
    assert np.std(log_z) < 0.5
    table.cell("ring", log_z, exact, 50, len(y))
    table.judge()
    plain = estimates(ring, {"y": y}, {}, ("bootstrap", "systematic", 1.0), 50, 20, seed_of("r"))
    assert np.median(plain) < exact - 20


@pytest.mark.slow
def test_conditional_smc_with_twenty_noises(ring):
    ring, y, dense = ring
    idata = ssm.sample(
        ring, {"y": y}, ssm.PGAS(particles=5, proposal="twisted"), draws=400, warmup=20, chains=2,
        progress=False, seed=seed_of("ring pgas"),
    )  # fmt: skip
    assert_moments(idata["posterior"]["x"].values, dense, "ring", 1)


# -- several data sets
@ssm.primitive
def with_room(v):
    room = np.zeros(2)
    room[0] = np.sin(v)
    return room.sum()


roomy = ssm.Model("roomy")
roomy.prior(lambda: {"a": ssm.Normal(0, sd=1)})
roomy.initial(lambda: {"x": ssm.Normal(0, sd=1)})
roomy.transition(lambda x, a: {"x": ssm.Normal(a * x, sd=0.5)})
roomy.observation(lambda x: {"y": ssm.Normal(with_room(x), sd=0.3)})
PANELS = {  # whether the model's functions are called by address, or compiled by Numba
    "volatility": (volatility, np.array([-5.0, 0.5]), True),
    "roomy": (roomy, np.array([0.5]), False),
}


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("name", ["volatility", pytest.param("roomy", marks=pytest.mark.slow)])
def test_data_sets_and_repeats_share_calls_and_not_numbers(name, count, monkeypatch):
    """Of each data set by itself, its guide looked for anew, one random stream through all; a
    trajectory likewise."""
    model, theta, by_address = PANELS[name]
    rng = np.random.default_rng(seed_of("panel", name))
    data = [{"y": 0.3 * rng.normal(size=n)} for n in (6, 1, 9)[:count]]
    data[-1]["y"][2:3] = np.nan
    problem, settings = pose(model, data), FilterSettings(8, "twisted")
    seed = np.random.SeedSequence(seed_of("panel", name, count))
    run = problem.program.entry("filter_twisted")
    assert isinstance(run.run, ByAddress) is by_address
    alone = []
    for k in range(3):
        stream, total = random_state(seed, k), 0.0
        for e in problem.experiments:
            increments, ess = np.empty(e.steps), np.empty(e.steps)
            run(theta, e.y, e.seen, e.u, 8, None, 1.0, stream, increments, ess, None, None)
            total += increments.sum()
        alone.append(total)
    assert len(set(alone)) == 3
    for least in (filtering.LEAST, 1):  # particles from which each data set has a call of its own
        monkeypatch.setattr(filtering, "LEAST", least)
        found = repeated_estimates(problem, theta, settings, seed, range(3))
        np.testing.assert_allclose(found, alone, rtol=1e-12)
    found = log_likelihood_estimate(problem, theta, settings, random_state(seed, 2))
    np.testing.assert_allclose(found, alone[2], rtol=1e-12)

    path_of, stream = problem.program.entry("filtered_path_twisted"), random_state(seed, 7)
    found = ParticleLikelihood(problem, settings).run(theta, None, random_state(seed, 7))
    for e, path in zip(problem.experiments, found.paths, strict=True):
        expected = np.empty_like(path)
        path_of(theta, e.y, e.seen, e.u, 8, stream, expected, np.empty(e.steps))
        np.testing.assert_array_equal(path, expected)
