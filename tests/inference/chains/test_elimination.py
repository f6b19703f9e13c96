"""PGAS without the parameters that are integrated out: weights, invariance, settings."""

from __future__ import annotations

import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats

import ssmppl as ssm
from ssmppl.analysis.conjugacy.family import sum_of
from ssmppl.analysis.elimination.eliminable import eliminable
from ssmppl.analysis.elimination.elimination import eliminate
from ssmppl.data import bind
from ssmppl.errors import ArgumentError
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import constant, symbol, symbols_of
from ssmppl.inference.chains.elimination import (
    Eliminating,
    EliminationState,
    describe_elimination,
    requested_elimination,
)
from ssmppl.inference.chains.gibbs_updates import log_joint
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.model.trace import previous, seen
from tests.models import elimination as models
from tests.models.elimination import GONE, MODELS, STEPS, joint_draws
from tests.statistics.checks import LEVEL, assert_within, mcse_mean, seed_of, some
from tests.statistics.checks import deviations as deviations_of

# --- the model without the block is the integral over it ----------------------------------------


def chain_of(problem, out, i):
    """(theta, [trajectory]) of a simulated draw."""
    trace = problem.trace
    theta = np.array([out[s.data[1]].values[i][s.data[2]] for s in trace.parameter_symbols])
    columns = [out[s.data[1]].values[i][(slice(None), *s.data[2])] for s in trace.state_symbols]
    return theta.astype(float), [np.ascontiguousarray(np.array(columns, dtype=float).T)]


def posed(name, i=0, kind=Eliminating, names=None):
    model, out, data_of = joint_draws(name, 8, 3)
    problem = pose(model, data_of(i))
    found = eliminable(problem.trace, (), problem.program.missing, names)
    theta, paths = chain_of(problem, out, i)
    return kind(problem, found.updates, 5, 0), theta, paths


def values_at(problem, theta, path, t):
    """What every symbol of row t stands for."""
    trace, e = problem.trace, problem.experiments[0]
    out = dict(zip(trace.parameter_symbols, theta, strict=True))
    out |= dict(zip(trace.state_symbols, path[t], strict=True))
    kinds = [(trace.observation_symbols, e.y), (trace.input_symbols, e.u)]
    for symbols_, table in kinds:
        out |= dict(zip(symbols_, table[t], strict=True))
        out |= dict(zip(map(previous, symbols_), table[max(t - 1, 0)], strict=True))
    out |= dict(zip(map(seen, trace.observation_symbols), e.seen[t], strict=True))
    if t:
        out |= dict(zip(map(previous, trace.state_symbols), path[t - 1], strict=True))
    return out | {symbol("time", "t", ()): t + 1.0, symbol("time_prev", "t", ()): float(t)}


def constant_of(family, c):
    return float(evaluate(sum_of(family.log_normaliser([*map(constant, c), constant(0.0)])), {}))


QUADRATURE = {"scale": {"tau": (0.0, 60.0)}, "shared": {"r": (0.0, 60.0), "rate": (0.0, 40.0)}}


@pytest.mark.parametrize("name", QUADRATURE)
def test_density_without_the_block_is_the_integral_over_it(name):
    """log int p(B) p(x, y | B) dB of two trajectories that begin alike, by quadrature of the
    model's own density, missing values and all; and by statistics and what is free of the block."""
    steps, theta, (path,) = posed(name)
    problem = steps.problem
    found = eliminate(problem.trace, problem.program.missing, eliminable(
        problem.trace, (), problem.program.missing))  # fmt: skip
    columns = [[s.data[1] for s in problem.trace.parameter_symbols].index(n)
               for n in QUADRATURE[name]]  # fmt: skip
    other = path + 0.3 * np.random.default_rng(2).standard_normal(path.shape)
    other[0] = path[0]
    sums, whole = [], []
    for x in (path, other):
        rows = steps.rows(problem.experiments[0], theta, x)
        c = steps.prior(theta) + rows.total
        total, at = 0.0, 0
        for u in steps.updates:
            total += constant_of(u.family, c[at : at + len(u.functions)])
            at += len(u.functions)
        for t in range(STEPS):
            at_t = values_at(problem, theta, x, t)
            free = [*(found.connected if t else ()), *found.observed]
            for term in free:
                if term.guard is None or evaluate(term.guard, at_t):
                    total += float(evaluate(term.log_density, at_t))
        sums.append(total)

        def density(*block, x=x):
            trial = theta.copy()
            trial[columns] = block
            part, e = np.empty(1), problem.experiments[0]
            problem.program.entry("log_joint")(trial, e.y, e.seen, e.u, x.copy(), part)
            return np.exp(problem.program.entry("log_prior")(trial) + part[0] + 20.0)

        ranges = list(QUADRATURE[name].values())
        whole.append(np.log(integrate.nquad(density, ranges, opts={"epsabs": 0, "limit": 200})[0]))
    assert abs(sums[1] - sums[0]) > 0.1
    assert sums[1] - sums[0] == pytest.approx(whole[1] - whole[0], abs=1e-6)


def test_nothing_that_is_generated_holds_the_block():
    for name in MODELS:
        steps, _, _ = posed(name)
        found, _ = steps.made
        gone = {c.data[1] for c in found.eliminable.components}
        assert gone == GONE[name]
        p = found.proposal
        roots = [*p.draw.values(), *p.initial_draw.values(), *found.joining]
        roots += [t.log_density for t in (*p.weight, *p.initial_weight, *found.connected)]
        assert not {s.data[1] for s in symbols_of(roots)} & gone


# --- invariance: a draw of (theta, x, y) from the joint law stays one ----------------------------


class AncestorsBlind(Eliminating):
    """A mutant: what the later rows of the reference tell is forgotten in the ancestor weights."""

    def columns(self, base, rate, rows):
        out, size = super().columns(base, rate, rows), rows.moved.shape[1]
        out[:, 3 * size :] = out[:, 2 * size : 3 * size]
        return out


class LastRowOpen(Eliminating):
    """A mutant: the base keeps its warmup's rows to the end."""

    def columns(self, base, rate, rows):
        return super().columns(base + self.worth * rate, 0.0 * rate, rows)


class OldBlock(Eliminating):
    """A mutant: the block stays as it was."""

    def _draw(self, totals, theta, generator):
        return None


class StaleBlock(Eliminating):
    """A mutant: the block is drawn given the trajectory that was left."""

    def trajectory(self, base, rate, rows, e, theta, path, stream):
        new, _, own = super().trajectory(base, rate, rows, e, theta, path, stream)
        return new, rows.total, own


class WithoutPrior(Eliminating):
    """A mutant: the sweep forgets the prior."""

    def columns(self, base, rate, rows):
        return super().columns(0.5 * base, rate, rows)


def experiments_of(problem, data):
    return replace(problem, experiments=tuple(bind(problem.trace, data)))


def changes(name, kind, draws=2000, sweeps=6, names=None):
    """Changes (draws, functions) that some sweeps make to draws of the joint law."""
    _, out, data_of = joint_draws(name, draws, 11)
    rng, stream, rows = np.random.default_rng(5), random_state(np.random.SeedSequence(3)), []
    first, theta, paths = posed(name, 3, kind, names)
    # fixed numbers, of another draw; particles are few and the base is worth much, to show faults
    learned = EliminationState(0, first.begin(theta, tuple(paths)).rate)
    first = replace(first, particles=4, worth=4.0)
    made = first.made
    for i in range(draws):
        problem = experiments_of(first.problem, data_of(i))
        steps = replace(first, problem=problem)
        steps.__dict__["made"] = made
        theta, paths = chain_of(problem, out, i)
        before = functions(steps, theta, paths)
        for _ in range(sweeps):
            steps.sweep(learned, theta, paths, stream, rng)
        rows.append(functions(steps, theta, paths) - before)
    return np.array(rows)


def functions(steps, theta, paths):
    """Of theta, the states, and how they go with each other and with the data: above all their
    log density."""
    x, y = paths[0], steps.problem.experiments[0].y
    z, size = np.tanh(theta), np.log(1e-2 + np.abs(x))
    told = np.nan_to_num(np.tanh(y)).T @ np.tanh(x)
    step = np.tanh(x[1:] * x[:-1])
    rough = np.log(1e-2 + np.concatenate([np.diff(x, axis=0), x]) ** 2).mean(axis=0)
    both = [np.outer(z, f) for f in (size.mean(axis=0), step.mean(axis=0), size[-1], rough, told)]
    joint = log_joint(steps, theta, paths)
    out = [joint, z, z**2, np.tanh(x), size, told, step, rough, *both]
    return np.concatenate([np.ravel(f) for f in out])


def deviations(found):
    sd = found.std(axis=0, ddof=1)
    kept = sd > 1e-9
    return found[:, kept].mean(axis=0) / sd[kept] * np.sqrt(len(found))


CASES = [("scale", None), ("lags", None), ("shared", None), ("regimes", None), ("lags", ("a",))]


def limit_of(found):
    """Of the largest deviation, for all cases together."""
    return stats.norm.isf(LEVEL / (2 * len(deviations(found)) * len(CASES)))


@pytest.mark.parametrize(("name", "names"), some(CASES, 1))
def test_joint_law_is_left_invariant(name, names):
    found = changes(name, Eliminating, names=names)
    z, limit = deviations(found), limit_of(found)
    moved = np.mean(np.abs(found) > 0.0, axis=0).max()
    assert moved > 0.5, moved  # else there is nothing to see
    print(f"{name} {names}: {moved:.2f} moved, largest {np.abs(z).max():.2f} of {limit:.2f}")
    assert np.abs(z).max() < limit, np.round(z, 1)


MUTANTS = [
    ("scale", LastRowOpen),
    ("shared", AncestorsBlind),
    ("lags", WithoutPrior),
    ("regimes", OldBlock),
    ("regimes", StaleBlock),
]


@pytest.mark.parametrize(("name", "kind"), some(MUTANTS, 1, pytest.mark.exhaustive))
def test_mutants_are_found(name, kind):
    """Each beyond the limit that the law itself is held to."""
    found = changes(name, kind)
    z, limit = deviations(found), limit_of(found)
    print(name, kind.__name__, np.round(np.abs(z).max(), 1), np.round(limit, 1))
    assert np.abs(z).max() > limit, np.round(z, 1)


# --- the posterior -------------------------------------------------------------------------------

level = ssm.Model("level and noise, to be eliminated")
level.prior(lambda: {"q": ssm.InverseGamma(3, scale=0.5), "r": ssm.Gamma(3, rate=1.5)})
level.initial(lambda: {"x": ssm.Normal(0, sd=1)})
level.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
level.observation(lambda x, r: {"y": ssm.Normal(x, precision=r)})


def series(steps, seed=2):
    out = ssm.simulate(level, {"q": 0.2, "r": 2.0}, steps=steps, seed=seed)
    y = out["y"].values[0].copy()
    y[2] = np.nan
    return {"y": y}


def log_likelihood_of_level(y, q, r):
    """Kalman's filter of `level`, for a grid of q and r at once."""
    total, mean, variance = 0.0, 0.0, np.ones_like(q)
    for value in y:
        if not np.isnan(value):
            total = total + stats.norm(mean, np.sqrt(variance + 1 / r)).logpdf(value)
            gain = variance / (variance + 1 / r)
            mean, variance = mean + gain * (value - mean), (1 - gain) * variance
        variance = variance + q
    return total


def test_posterior_of_two_experiments_is_exact():
    """Transition variance and observation precision eliminated together, against a grid over the
    exact likelihood; one experiment is swept given what the other tells."""
    data = [series(12), series(7, seed=3)]
    idata = ssm.sample(level, data, ssm.PGAS(particles=10, eliminate=True), draws=1500, warmup=100,
                       chains=2, progress=False, seed=seed_of("elimination", "level"))  # fmt: skip
    assert "q (inverse Gamma); r (Gamma)" in idata["posterior"].attrs["eliminated"]
    axes = np.linspace(-4.5, 2.5, 141), np.linspace(-2.5, 2.8, 141)
    q, r = np.exp(np.meshgrid(*axes, indexing="ij"))
    log_p = stats.invgamma(3, scale=0.5).logpdf(q) + stats.gamma(3, scale=1 / 1.5).logpdf(r)
    log_p += np.log(q) + np.log(r) + sum(log_likelihood_of_level(d["y"], q, r) for d in data)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    assert max(p[0].sum(), p[-1].sum(), p[:, 0].sum(), p[:, -1].sum()) < 1e-4
    found = {}
    for axis, (name, grid) in enumerate(zip("qr", axes, strict=True)):
        marginal = p.sum(axis=1 - axis)
        mean = marginal @ grid
        sd = np.sqrt(marginal @ (grid - mean) ** 2)
        off = deviations_of(np.log(idata["posterior"][name].values), mean=mean, sd=sd)
        found |= {f"{name} {k}": v for k, v in off.items()}
    assert_within(found)


pair = ssm.Model("pair, to be eliminated")
pair.prior(lambda: {"a": ssm.Flat((4,)), "r": ssm.HalfFlat()})
pair.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})


@pair.transition
def pair_transition(x, a):
    mean = np.array([a[0] * x[0] + a[1] * x[1], a[2] * x[0] + a[3] * x[1]])
    return {"x": ssm.MvNormal(mean, covariance=np.array([[0.5, 0.2], [0.2, 0.4]]))}


@pair.observation
def pair_observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}


@pytest.mark.slow
def test_improper_priors_and_correlated_noise_agree_with_gibbs():
    """Flat priors, which the base must make up for, and a vector with correlated noise: the same
    posterior as by exact draws of the states."""
    truth = {"a": np.array([0.6, 0.2, -0.3, 0.5]), "r": 0.3}
    data = {"y": ssm.simulate(pair, truth, steps=60, seed=5)["y"].values[0]}
    without, exact = (
        ssm.sample(pair, data, method, draws=3000, warmup=200, chains=2, progress=False,
                   seed=seed_of("elimination", "pair", k))["posterior"]
        for k, method in enumerate((ssm.PGAS(particles=15, eliminate=True), ssm.Gibbs()))
    )  # fmt: skip
    assert without.attrs["eliminated"] == (
        "a[0], a[1], a[2], a[3] (joint Normal); r (inverse Gamma)"
    )
    found = {}
    for name, k in [("a", 0), ("a", 1), ("a", 2), ("a", 3), ("r", None)]:
        ours, theirs = (p[name].values[..., k] if name == "a" else p[name].values
                        for p in (without, exact))  # fmt: skip
        error = np.hypot(mcse_mean(ours), mcse_mean(theirs))
        found[f"{name} {k}"] = (ours.mean() - theirs.mean()) / error
    assert_within(found)


# --- the setting ---------------------------------------------------------------------------------

SHORT = {"chains": 2, "progress": False, "seed": 1}


Y = np.exp(np.linspace(1, 2, 6))


def described(problem, setting, held, proposal):
    return describe_elimination(requested_elimination(problem, setting, held, proposal))


def test_what_is_eliminated():
    problem = pose(models.scale, {"y": Y})
    for setting in (True, "auto", ("tau",), ["tau"]):
        assert described(problem, setting, {}, "bootstrap") == "tau (Gamma)"
    assert described(problem, False, {}, "bootstrap") == "none: eliminate=False"
    held = described(problem, "auto", {"tau": np.array(2.0)}, "bootstrap")
    assert held.startswith("none: the initial distribution of x is not conjugate")
    better = described(problem, "auto", {}, "auxiliary")
    assert better == "none: particles move by the proposal 'auxiliary'"


@pytest.mark.parametrize(
    ("setting", "settings", "words"),
    [
        ("tau", {}, "eliminate='tau'"),
        (None, {}, "eliminate=None"),
        (("nu",), {}, "no free parameter"),
        (("phi",), {}, r"not conjugate \(outside the Normal family: log\(1 - phi\*\*2\)\)"),
        (True, {"proposal": "guided"}, "moves particles by the transition"),
    ],
)
def test_what_cannot_be(setting, settings, words):
    with pytest.raises(ArgumentError, match=words):
        ssm.sample(models.scale, {"y": Y}, ssm.PGAS(eliminate=setting, **settings), **SHORT)


def test_blocks_that_share_a_term_are_not_both_eliminated():
    problem = pose(models.lags, joint_draws("lags", 1, 1)[2](0))
    missing = problem.program.missing
    both = eliminable(problem.trace, (), missing)
    assert [u.family_name for u in both.updates] == ["Normal-inverse-Gamma"]
    one = eliminable(problem.trace, (), missing, ("a",))
    assert [u.family_name for u in one.updates] == ["joint Normal"]
    apart = eliminable(slope_and_variance(), (), missing)
    assert [u.block for u in apart.updates] == [("q",)]
    assert "holds it together with q" in next(iter(apart.refused.values())).reason


def slope_and_variance():
    """A slope and a variance, each conjugate given the other, without a common family."""
    model = ssm.Model("apart")
    model.prior(lambda: {"q": ssm.InverseGamma(4, scale=2), "a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a, q: {"x": ssm.Normal(a * x, variance=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return pose(model, {"y": [0.1, 0.2]}).trace


@pytest.mark.slow
def test_blocks_and_executors_change_nothing():
    method, data = ssm.PGAS(particles=5, eliminate=True, interweave=True), series(8)
    runs = [
        ssm.sample(level, data, method, draws=20, warmup=20, executor=executor, **SHORT)
        for executor in (None, None, ProcessPoolExecutor(1))
    ]
    for other in runs[1:]:
        np.testing.assert_array_equal(runs[0]["posterior"]["q"], other["posterior"]["q"])


def test_steps_are_pickled_without_their_module():
    steps, theta, paths = posed("scale")
    before = steps.rows(steps.problem.experiments[0], theta, paths[0])
    copied = pickle.loads(pickle.dumps(steps))
    assert "made" not in vars(copied)
    after = copied.rows(copied.problem.experiments[0], theta, paths[0])
    np.testing.assert_array_equal(after.moved, before.moved)


def test_plan_says_what_can_be_eliminated_and_why_not():
    plan = str(ssm.explain(models.scale))
    rows = plan[plan.index("Parameters that PGAS can marginalise") :]
    assert "tau  marginalised in the trajectory update" in rows
    assert "phi  not marginalised: the initial distribution of x" in rows
