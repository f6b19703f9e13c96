"""Moves of the parameters that take the trajectory along: maps, Jacobians, invariance, settings."""

from __future__ import annotations

import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.proposals.noises import noises
from ssmppl.data import bind
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.chains.interweaving import (
    Collapsed,
    Interweaving,
    InterweavingTuning,
    NoiseMove,
    Reference,
)
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose
from ssmppl.language.model.transforms import parameter_bounds
from tests.models import noise as models
from tests.models.noise import CASES, STEPS, joint_draws
from tests.statistics.checks import LEVEL, some


def chain_of(problem, out, i):
    """(theta, [trajectory]) of a simulated draw."""
    trace = problem.trace
    theta = np.array([out[s.data[1]].values[i][s.data[2]] for s in trace.parameter_symbols])
    columns = [out[s.data[1]].values[i][(slice(None), *s.data[2])] for s in trace.state_symbols]
    return theta.astype(float), [np.ascontiguousarray(np.array(columns, dtype=float).T)]


def move_of(problem, near, steered):
    found = noises(problem.trace, problem.program.missing)
    assert not isinstance(found, NotApplicable)
    return NoiseMove(problem, found, steered, near)


def posed(name, i, draws=8, seed=3):
    model, out, data_of = joint_draws(name, draws, seed)
    problem = pose(model, data_of(i))
    theta, paths = chain_of(problem, out, i)
    return problem, theta, paths


# A vector takes long to compile.
SHAPES = [pytest.param(*c, marks=[pytest.mark.slow] * (c[0] == "vector")) for c in CASES]


@pytest.mark.parametrize(("name", "steered"), SHAPES)
def test_noises_and_back(name, steered):
    for i in range(3):
        problem, theta, paths = posed(name, i)
        near, _ = chain_of(problem, joint_draws(name, 8, 3)[1], 5)
        move = move_of(problem, near, steered)
        value, held = move.stand(theta, paths)
        again, same = move.at(theta, held, paths)
        np.testing.assert_allclose(same[0], paths[0], rtol=1e-9, atol=1e-9)
        assert again == pytest.approx(value, abs=1e-8)
        _other, away = move.at(near, held, paths)
        assert np.abs(away[0] - paths[0]).max() > 1e-3
        _back, home = move.at(theta, held, away)
        np.testing.assert_allclose(home[0], paths[0], rtol=1e-8, atol=1e-8)
        _, held_there = move.stand(near, away)
        np.testing.assert_allclose(held_there, held, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("name", "steered"), SHAPES)
def test_volume_is_that_of_finite_differences(name, steered):
    """log |dx / de| over the states that move, against a determinant of central differences."""
    problem, theta, paths = posed(name, 1)
    move = move_of(problem, theta, steered)
    _, held = move.stand(theta, paths)
    e, (experiment,) = held, problem.experiments
    guide = move._guide(theta)

    def path_of(noise):
        new = np.empty_like(paths[0])
        given = (theta, experiment.y, experiment.seen, experiment.u, *guide, paths[0], noise, new)
        return new, move.module.path_of(*given)

    x, volume = path_of(e)
    counts = [len(move.found.initial.noise)] + [len(move.found.transition.noise)] * (STEPS - 1)
    columns = []
    for t, k in [(s, k) for s in range(STEPS) for k in range(counts[s])]:
        step = np.zeros_like(e)
        step[t, k] = 1e-5
        columns.append((path_of(e + step)[0] - path_of(e - step)[0]).ravel() / 2e-5)
    jacobian = np.array(columns).T
    deterministic = {
        s for s, site in ((s, problem.trace.transition[s.data[1]])
                          for s in problem.trace.state_symbols)
        if type(site.distribution).__name__ == "Dirac"
    }  # fmt: skip
    own = [
        t * x.shape[1] + k
        for t in range(STEPS)
        for k, s in enumerate(problem.trace.state_symbols)
        if s not in deterministic and s.data[1] not in move.found.transition.centred
    ]
    assert len(own) == jacobian.shape[1]
    _, log_det = np.linalg.slogdet(jacobian[own])
    assert volume == pytest.approx(log_det, abs=1e-5)


def test_steered_noises_of_a_linear_model_are_independent_of_theta():
    """Where the approximation is exact, log pi is log p(theta | y) plus a function of e alone."""
    problem, theta, paths = posed("linear", 2)
    move = move_of(problem, theta, True)
    value, held = move.stand(theta, paths)
    rng = np.random.default_rng(1)
    for _ in range(5):
        other = theta * np.exp(0.3 * rng.standard_normal(3) - [0.4, 0.0, 0.0])
        there, _ = move.at(other, held, paths)
        named = dict(zip(("phi", "q", "r"), other, strict=True))
        here = dict(zip(("phi", "q", "r"), theta, strict=True))
        data = {"y": np.where(problem.experiments[0].seen[:, 0] == 1.0,
                              problem.experiments[0].y[:, 0], np.nan)}  # fmt: skip
        change = ssm.log_likelihood(models.linear, data, named, seed=1)[0]
        change -= ssm.log_likelihood(models.linear, data, here, seed=1)[0]
        assert there - value == pytest.approx(change, abs=1e-8)


# --- invariance: a draw of (theta, x, y) from the joint law stays one ----------------------------


def normal_log(x, variance):
    return -0.5 * np.log(2 * np.pi * variance) - 0.5 * x**2 / variance


class WithoutVolume(NoiseMove):
    """A mutant: |dx / de| is left out."""

    @cached_property
    def module(self):
        real = NoiseMove.module.func(self)
        return SimpleNamespace(
            noise_of=lambda *a: 0.0 * real.noise_of(*a),
            path_of=lambda *a: 0.0 * real.path_of(*a),
            linearise=getattr(real, "linearise", None),
        )


class WithoutStart(NoiseMove):
    """A mutant, of `linear`: the initial law is forgotten."""

    def _log_joints(self, theta, rows):
        phi, q, _ = theta
        return super()._log_joints(theta, rows) - normal_log(rows[0, 0], q / (1 - phi**2))


class WithoutData(NoiseMove):
    """A mutant, of `linear`: the observations' ratio is forgotten."""

    def _log_joints(self, theta, rows):
        (e,) = self.problem.experiments
        away = normal_log(e.y[:, 0] - rows[:, 0], theta[2])
        return super()._log_joints(theta, rows) - away[e.seen[:, 0] == 1.0].sum()


def changes(name, steered, kind, draws=2000, sweeps=5):
    """Changes (draws, functions) that some sweeps of the kernel make to draws of the joint law."""
    model, out, data_of = joint_draws(name, draws, 11)
    rng = np.random.default_rng(5)
    first, rows = None, []
    for i in range(draws):
        if first is None:
            problem = pose(model, data_of(i))
        else:  # the same program for other data
            problem = replace(problem, experiments=tuple(bind(problem.trace, data_of(i))))
        theta, paths = chain_of(problem, out, i)
        if first is None:
            found = noises(problem.trace, problem.program.missing)
            first = kind(problem, found, steered, theta.copy())
            space = space_of(problem, {}, {})
            d, bounds = len(space.positions), parameter_bounds(problem.trace)
        move = replace(first, problem=problem)
        move.__dict__["module"] = first.module  # else it is generated anew for each data set
        kernel = Interweaving(
            replace(space, problem=problem), (move,), np.arange(d), np.ones(d), 0, 0,
            bounds,
        )  # fmt: skip
        tuning = InterweavingTuning(0, np.arange(d), (0.5 * np.eye(d),), 0, ())
        before = functions(kernel, theta, paths, problem.experiments[0].y)
        for _ in range(sweeps):
            tuning, _ = kernel.step(tuning, theta, paths, rng)
        rows.append(functions(kernel, theta, paths, problem.experiments[0].y) - before)
    return np.array(rows)


def functions(kernel, theta, paths, y):
    """Of theta, the states, and how they go with each other and with the data."""
    z, x = kernel._free(theta), paths[0]
    size = np.log(1e-3 + np.abs(x))
    told = np.nan_to_num(np.tanh(y)).T @ np.tanh(x)
    out = [z, z**2, np.outer(z, size.mean(axis=0)), np.outer(z, size[0]), np.tanh(x), size, told]
    return np.concatenate([np.ravel(f) for f in out])


def deviations(found):
    sd = found.std(axis=0, ddof=1)
    kept = sd > 1e-9
    return found[:, kept].mean(axis=0) / sd[kept] * np.sqrt(len(found))


def limit_of(found):
    """Of the largest deviation, for all cases together."""
    return stats.norm.isf(LEVEL / (2 * len(deviations(found)) * len(CASES)))


@pytest.mark.parametrize(("name", "steered"), some(CASES, 1))
def test_joint_law_is_left_invariant(name, steered):
    found = changes(name, steered, NoiseMove)
    moved = np.mean(np.abs(found[:, 0]) > 0.0)
    assert moved > 0.3, moved  # else there is nothing to see
    z, limit = deviations(found), limit_of(found)
    print(f"{name} {steered}: {moved:.2f} moved, largest {np.abs(z).max():.2f} of {limit:.2f}")
    assert np.abs(z).max() < limit, np.round(z, 1)


@pytest.mark.parametrize(
    ("kind", "steered"),
    some([(k, s) for k in (WithoutVolume, WithoutStart, WithoutData) for s in (True, False)], 1),
)
def test_mutants_are_found(kind, steered):
    """Each beyond the limit that the law itself is held to."""
    found = changes("linear", steered, kind)
    z, limit = deviations(found), limit_of(found)
    print(kind.__name__, steered, np.round(np.abs(z).max(), 1), np.round(limit, 1))
    assert np.abs(z).max() > limit, np.round(z, 1)


# --- the choice among moves ----------------------------------------------------------------------


class OnPrior:
    """A move whose density is flat, so that the steps are on the prior; where `here` says not, it
    cannot be made at all."""

    def __init__(self, here=lambda theta: True):
        self.here = here

    def stand(self, theta, paths):
        return (0.0 if self.here(theta) else -np.inf), None

    def at(self, theta, held, paths):
        return self.stand(theta, paths)[0], paths


NEVER, SELDOM = OnPrior(lambda theta: False), OnPrior(lambda theta: theta[0] > 0.93)


@pytest.mark.parametrize("other", [NEVER, SELDOM], ids=["never", "seldom"])
@pytest.mark.parametrize("place", [0, 1])
def test_a_move_that_cannot_be_made_is_not_chosen(other, place):
    """However wide its walk is left; and the law of the chain is the prior, exactly."""
    problem, theta, paths = posed("linear", 2)
    moves = (other, OnPrior()) if place == 0 else (OnPrior(), other)
    space, adapting = space_of(problem, {}, {}), 400
    d = len(space.positions)
    kernel = Interweaving(
        space, moves, np.arange(d), np.full(d, 3.0), adapting, 0, parameter_bounds(problem.trace)
    )
    tuning, rng, drawn = kernel.begin(), np.random.default_rng(7), []
    for k in range(adapting + 12_000):
        tuning, share = kernel.step(tuning, theta, paths, rng)
        if k >= adapting:
            assert tuning.chosen == 1 - place
            assert share in (0.0, 0.25, 0.5, 0.75, 1.0)
        if k >= adapting and k % 30 == 0:
            drawn.append(theta.copy())
    laws = stats.uniform(0.3, 0.65), stats.invgamma(4, scale=2), stats.gamma(4, scale=1 / 8)
    for values, law in zip(np.array(drawn).T, laws, strict=True):
        assert stats.kstest(values, law.cdf).pvalue > LEVEL


def test_of_two_moves_that_can_be_made_the_wider_is_chosen():
    problem, theta, paths = posed("linear", 2)
    start = theta[0]
    narrow, wide = (OnPrior(lambda t, w=w: abs(t[0] - start) < w) for w in (0.02, 0.1))
    space = space_of(problem, {}, {})
    kernel = Interweaving(
        space, (narrow, wide), np.arange(1), np.ones(3), 400, 0, parameter_bounds(problem.trace)
    )
    tuning, rng = kernel.begin(), np.random.default_rng(7)
    for _ in range(402):
        tuning, _ = kernel.step(tuning, theta, paths, rng)
    assert tuning.chosen == 1


class AboutPrior(Collapsed):
    """The prior as the law of the chain, about a Gaussian that is not quite its approximation."""

    def about(self, space, near):
        d = len(near)
        precision = 1.5 * np.eye(d) + 0.4 * np.ones((d, d)) / d
        return Reference(near + 0.3, precision)

    def stand(self, theta, paths):
        return 0.0, None

    def at(self, theta, held, paths):
        return 0.0, paths


@pytest.mark.parametrize("some_of_them", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_steps_about_a_mode_leave_the_law_invariant(some_of_them):
    """All numbers, or some given the others, which stay; heavier tails than the Gaussian's."""
    model = ssm.Model("many")
    model.prior(lambda: {"a": ssm.StudentT(np.full(6, 5.0), loc=0.0, scale=1.0),
                         "q": ssm.Gamma(np.full(2, 4.0), rate=2.0)})  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a, q: {"x": ssm.Normal(0.5 * x + a.sum(), sd=q[0])})
    model.observation(lambda x, q: {"y": ssm.Normal(x, sd=q[1])})
    problem = pose(model, {"y": np.zeros(2)})
    space, adapting = space_of(problem, {}, {}), 300
    moves = (AboutPrior(problem, None),)
    kernel = Interweaving(
        space, moves, np.arange(8), np.ones(8), adapting, 0, parameter_bounds(problem.trace),
        np.zeros(8),
    )  # fmt: skip
    tuning, rng = kernel.begin(), np.random.default_rng(8)
    if some_of_them:
        tuning = kernel._tune(tuning, np.arange(1, 8))
    theta, drawn = space.theta.copy(), []
    first = theta[0]
    for k in range(adapting + 20_000):
        tuning, _ = kernel.step(tuning, theta, [], rng)
        if k >= adapting and k % 40 == 0:
            drawn.append(theta.copy())
    assert 0.05 < tuning.share <= 1.0
    laws = [stats.t(5)] * 6 + [stats.gamma(4, scale=0.5)] * 2
    for i, (values, law) in enumerate(zip(np.array(drawn).T, laws, strict=True)):
        if some_of_them and i == 0:
            assert np.all(values == first)
        else:
            assert stats.kstest(values, law.cdf).pvalue > LEVEL


def without_guide():
    """The data are seen through a root, which has no slope where the approximation begins."""
    model = ssm.Model("through a root")
    model.prior(lambda: {"s": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {"x": ssm.Normal(0.9 * x, sd=s)})
    model.observation(lambda x, r: {"y": ssm.Normal(np.sqrt(np.maximum(x, 0.0)), sd=r)})
    return model


def test_an_approximation_that_comes_to_no_number_is_left_out():
    y = ssm.simulate(without_guide(), {"s": 0.5, "r": 0.3}, steps=30, seed=1)["y"].values[0]
    found = ssm.sample(
        without_guide(), {"y": y}, ssm.PGAS(particles=10, interweave=True), draws=5, warmup=20,
        chains=1, seed=1, progress=False,
    )  # fmt: skip
    told = found["posterior"].attrs["interweaving"]
    assert told == "s, r: moved with the noises of the transition held fixed"


def test_where_nothing_else_could_be_held_the_reason_is_told():
    model = ssm.Model("through a root, of known states")
    model.prior(lambda: {"r": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.9 * x, sd=0.5)})
    model.observation(lambda x, r: {"y": ssm.Normal(np.sqrt(np.maximum(x, 0.0)), sd=r)})
    y = ssm.simulate(model, {"r": 0.3}, steps=30, seed=1)["y"].values[0]
    few = {"draws": 3, "warmup": 200, "chains": 1, "seed": 1, "progress": False}
    found = ssm.sample(model, {"y": y}, ssm.PGAS(particles=10, interweave="auto"), **few)
    assert "none: the Gaussian approximation" in found["posterior"].attrs["interweaving"]
    with pytest.raises(ArgumentError, match="interweave=True does not apply: the Gaussian"):
        ssm.sample(model, {"y": y}, ssm.PGAS(particles=10, interweave=True), **few)


def test_data_cut_off_on_one_side_have_an_approximation():
    """At every parameter point; the derivatives of their density were NaN."""
    for i in range(4):
        problem, theta, _ = posed("cut", i)
        move = move_of(problem, theta, True)
        assert move.stands_near()


# --- the verb ------------------------------------------------------------------------------------

FAST = ssm.Model("states seen plainly")


@FAST.prior
def fast_prior():
    return {"m": ssm.Normal(0, sd=1), "r": ssm.Gamma(4, rate=8)}


@FAST.initial
def fast_initial(m):
    return {"x": ssm.Normal(m, sd=1.0)}


@FAST.transition
def fast_transition(x, m):
    return {"x": ssm.Normal(m, sd=1.0)}


@FAST.observation
def fast_observation(x, r):
    return {"y": ssm.Normal(x, sd=0.05), "z": ssm.Normal(0.0, variance=r)}


SHORT = {"chains": 2, "progress": False, "seed": 1}


def series(steps=60):
    out = ssm.simulate(models.linear, {"phi": 0.9, "q": 0.05, "r": 1.0}, steps=steps, seed=4)
    return {"y": out["y"].values[0]}


def test_auto_moves_what_is_slow_and_nothing_else():
    slow = ssm.sample(
        models.linear, series(), ssm.Gibbs(interweave="auto"), draws=100, warmup=300, **SHORT
    )
    assert (slow["sample_stats"]["interweaved"].mean("draw") > 0.1).all()
    assert "states integrated out" in slow["posterior"].attrs["interweaving"]
    y = ssm.simulate(FAST, {"m": 0.3, "r": 0.5}, steps=40, seed=2)
    data = {"y": y["y"].values[0], "z": y["z"].values[0]}
    fast = ssm.sample(FAST, data, ssm.Gibbs(interweave="auto"), draws=50, warmup=400, **SHORT)
    assert (fast["sample_stats"]["interweaved"] == 0.0).all()


def test_auto_needs_a_warmup_to_learn_in():
    idata = ssm.sample(
        models.linear, series(10), ssm.PGAS(interweave="auto"), draws=5, warmup=199, **SHORT
    )
    assert "interweaved" not in idata["sample_stats"]
    assert "fewer than 200 sweeps" in idata["posterior"].attrs["interweaving"]
    off = ssm.sample(models.linear, series(10), ssm.PGAS(interweave=False), draws=5, warmup=200,
                     **SHORT)  # fmt: skip
    assert "interweaved" not in off["sample_stats"]


@pytest.mark.parametrize("method", [ssm.PGAS, ssm.Gibbs])
def test_several_experiments_and_fixed_parameters(method):
    data = [series(12), series(7)]
    idata = ssm.sample(
        models.linear, data, method(interweave=True), draws=30, warmup=30, fixed={"phi": 0.9},
        **SHORT,
    )  # fmt: skip
    assert "phi" not in idata["posterior"]
    assert idata["sample_stats"]["interweaved"].mean() > 0.05
    assert np.all(np.isfinite(idata["sample_stats"]["lp"]))


@pytest.mark.slow
def test_blocks_and_executors_change_nothing():
    method, data = ssm.PGAS(particles=5, interweave=True), series(8)
    here = ssm.sample(models.linear, data, method, draws=20, warmup=20, **SHORT)
    again = ssm.sample(models.linear, data, method, draws=20, warmup=20, **SHORT)
    np.testing.assert_array_equal(here["posterior"]["q"], again["posterior"]["q"])
    with ProcessPoolExecutor(1) as pool:
        there = ssm.sample(models.linear, data, method, draws=20, warmup=20, executor=pool, **SHORT)
    np.testing.assert_array_equal(here["posterior"]["q"], there["posterior"]["q"])


def test_a_move_is_pickled_without_its_module():
    problem, theta, paths = posed("linear", 0)
    move = move_of(problem, theta, False)
    value, _ = move.stand(theta, paths)
    copied = pickle.loads(pickle.dumps(move))
    assert "module" not in vars(copied)
    assert copied.stand(theta, paths)[0] == value


@pytest.mark.parametrize("value", ["yes", 1, None])
def test_unknown_setting(value):
    with pytest.raises(ArgumentError, match="interweave="):
        ssm.sample(models.linear, series(5), ssm.PGAS(interweave=value), draws=1, **SHORT)


coin = ssm.Model("two states")
coin.prior(lambda: {"p": ssm.Beta(2, 2)})
coin.initial(lambda p: {"k": ssm.Bernoulli(p)})
coin.transition(lambda k, p: {"k": ssm.Bernoulli(np.where(k == 1, p, 0.2))})
coin.observation(lambda k: {"y": ssm.Normal(k, sd=0.5)})


@pytest.mark.parametrize("method", [ssm.PGAS, ssm.Gibbs])
def test_finite_states_are_left_alone(method):
    data = {"y": [0.1, 1.2, 0.8, -0.3]}
    with pytest.raises(ArgumentError, match="does not apply"):
        ssm.sample(coin, data, method(interweave=True), draws=1, **SHORT)
    if method is ssm.Gibbs:  # particles would have to be compiled
        idata = ssm.sample(coin, data, method(interweave="auto"), draws=5, warmup=200, **SHORT)
        assert idata["posterior"].attrs["interweaving"].startswith("none")


def test_plan_says_who_moves_and_why():
    plan = str(ssm.explain(models.mixed))
    assert "Joint parameter-trajectory moves (ASIS interweaving)" in plan
    flat = " ".join(plan.split())
    assert "a, s, c: if warmup autocorrelation is high" in flat
    assert "others stay centred: z, k" in flat
    exact = " ".join(str(ssm.explain(models.linear)).split())
    assert "phi, q, r: moved with the states integrated out" in exact
    assert "finitely many values" in str(ssm.explain(coin))
