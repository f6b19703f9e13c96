"""One pass against exact scores: of the Kalman filter, and of a simulator without noise."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.data import bind, check_parameters
from ssmppl.diagnosis.fitting.augmented_models import proposal_of
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.heldout.predictions import stretches
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.diagnosis.model.simulated_records import Simulator
from ssmppl.diagnosis.model.smoothing import (
    PREDICTIVE,
    Settings,
    Smoother,
    probability_transforms,
)
from ssmppl.errors import NotApplicable
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.language.tracing import trace
from tests.models.gaps import THETA, build, simulated
from tests.statistics.checks import LEVEL, seed_of, some

LINEAR = ("noisy_oscillator", "oscillator")
PROPOSAL = {"noisy_oscillator": "auxiliary", "oscillator": "bootstrap"}


ORDINARY = Settings()


def smoother_of(name, settings=ORDINARY, exact=True):
    model = trace(build(name))
    missing = Missing(none=True)
    found = Smoother(score_columns(model, model, (), (), missing), missing, settings)
    if not exact:
        found.__dict__["kalman"] = NotApplicable("particles are tested")
    return model, found


def runs_of(smoother, experiments, theta, count, *name):
    """Sums of the rows (count, F) of independent passes, and their log-likelihoods (count,)."""
    rows, values = [], []
    for r in range(count):
        passes = smoother.run(experiments, theta, random_state(seed_sequence(seed_of(*name)), r))
        rows.append(sum(p.rows.sum(axis=0) for p in passes))
        values.append(sum(p.log_increments.sum() for p in passes))
    return np.array(rows), np.array(values)


def off(estimates, exact):
    """Standardised distance of the mean of estimates (R, F) from exact (F,); what is linear in the
    states has no Monte Carlo error but that of rounding."""
    error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    return (estimates.mean(axis=0) - exact) / np.maximum(error, 1e-7 * np.abs(exact) + 1e-9)


@pytest.mark.parametrize("name", LINEAR)
def test_exact_trajectories_give_the_exact_score(name):
    model, smoother = smoother_of(name)
    theta = check_parameters(model, {k: 1.1 * v for k, v in THETA[name].items()})
    experiments = bind(model, simulated(name, 150))
    assert isinstance(smoother.kalman, KalmanModel)
    value, exact = smoother.kalman.score(experiments, theta)
    rows, values = runs_of(smoother, experiments, theta, 40, "exact rows", name)
    np.testing.assert_allclose(values, value, rtol=1e-10)
    z = off(rows, exact)
    assert np.max(np.abs(z)) < stats.t.isf(LEVEL / (2 * len(z)), 39), z


@pytest.mark.parametrize(
    ("name", "proposal", "particles"),
    [*((n, PROPOSAL[n], 500) for n in LINEAR), *some([(n, "twisted", 100) for n in LINEAR], 0)],
)
def test_particles_come_near_the_exact_score(name, proposal, particles):
    """The genealogy within its error, the bias below a tenth of a standard deviation of the score
    itself: that is what tests and fits can tell. A hundred steered particles do as well."""
    model, smoother = smoother_of(name, Settings(particles, proposal), exact=False)
    theta = check_parameters(model, {k: 1.1 * v for k, v in THETA[name].items()})
    experiments = bind(model, simulated(name, 150))
    kalman = smoother_of(name)[1].kalman
    _, exact = kalman.score(experiments, theta)
    information = kalman.information(experiments, theta)
    rows, _ = runs_of(smoother, experiments, theta, 60, "particle rows", name, proposal)
    error = rows.std(axis=0, ddof=1) / np.sqrt(len(rows))
    slack = 0.1 * np.sqrt(np.abs(np.diagonal(information)))
    excess = (np.abs(rows.mean(axis=0) - exact) - slack) / error
    assert np.max(excess) < stats.t.isf(LEVEL / (2 * len(excess)), 59), (rows.mean(axis=0), exact)


@pytest.mark.parametrize("name", some(LINEAR[::-1], 1))
def test_predictions_beside_steered_particles(name):
    """Of an extended Kalman filter, which in a linear model is the exact one."""
    model, smoother = smoother_of(name, Settings(50, "twisted"), exact=False)
    theta = check_parameters(model, THETA[name])
    experiments = bind(model, simulated(name, 150))
    (found,) = smoother.run(experiments, theta, random_state(seed_sequence(3)))
    (exact,) = smoother_of(name)[1].run(experiments, theta, random_state(seed_sequence(4)))
    mean, variance = exact.prediction[:, 0], exact.prediction[:, 1]
    # the observation's own part of the variance is not drawn, so that these bounds are wide
    z = (found.prediction[:, 0] - mean) / np.sqrt(variance / PREDICTIVE)
    assert np.max(np.abs(z)) < stats.norm.isf(LEVEL / (2 * z.size)), z
    # two draws of a mirrored pair count for one here
    z = (found.prediction[:, 1] - variance) / (variance * np.sqrt(2.0 / (PREDICTIVE // 2)))
    assert np.max(np.abs(z)) < stats.norm.isf(LEVEL / (2 * z.size)), z


@pytest.mark.parametrize("name", LINEAR)
def test_held_out_stretches_have_their_density(name):
    """Sums over the stretches of rows that count, against the exact filter's."""
    model, _ = smoother_of(name)
    problem = pose(build(name), simulated(name, 60))
    fitter = Fitter(problem, {}, Settings(50, "twisted"))
    theta = check_parameters(model, THETA[name])
    (e,) = problem.experiments
    counts = np.zeros(60, dtype=bool)
    counts[:7], counts[40:] = True, True
    fit = SimpleNamespace(theta=theta)
    runs = np.array([
        stretches(fitter, fit, e, counts, random_state(seed_sequence(seed_of(name, str(r)))))
        for r in range(30)
    ])  # fmt: skip
    assert np.all(runs[:, ~counts] == 0.0)
    exact = fitter.kalman.filter(e, theta).log_increments
    parts = [slice(a, b) for a, b in ((0, 5), (5, 7), (40, 45), (45, 50), (50, 55), (55, 60))]
    for rows in parts:  # one figure for each stretch, spread evenly
        assert np.all(runs[:, rows] == runs[:, rows][:, :1])
    z = off(*(np.stack([v[..., p].sum(axis=-1) for p in parts], axis=-1) for v in (runs, exact)))
    assert np.max(np.abs(z)) < stats.t.isf(LEVEL / (2 * len(z)), 29), z


def test_a_simulator_without_noise_is_derived_through_its_states():
    """Deterministic transitions from a known start: the score is that of a regression."""
    model = ssm.Model("decay", inputs=("u",))

    @model.prior
    def prior():
        return {"a": ssm.Uniform(0, 1), "b": ssm.Normal(0, sd=1)}

    @model.initial
    def initial():
        return {"x": ssm.Dirac(1.0)}

    @model.transition
    def transition(x, u, a, b):
        return {"x": ssm.Dirac(a * x + b * u)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.3)}

    traced, missing = trace(model), Missing(none=True)
    u = np.sin(np.arange(40.0))
    y = np.cos(np.arange(40.0))
    smoother = Smoother(score_columns(traced, traced, (), (), missing), missing, Settings(4))

    def log_likelihood(a, b):
        x, total = 1.0, 0.0
        for t in range(40):
            total += stats.norm.logpdf(y[t], x, 0.3)
            x = a * x + b * u[t]
        return total

    h = 1e-5
    exact = [
        (log_likelihood(0.8 + h, 0.5) - log_likelihood(0.8 - h, 0.5)) / (2 * h),
        (log_likelihood(0.8, 0.5 + h) - log_likelihood(0.8, 0.5 - h)) / (2 * h),
    ]
    for kalman in (True, False):
        if not kalman:
            smoother.__dict__["kalman"] = NotApplicable("particles are tested")
        (found,) = smoother.run(
            bind(traced, {"u": u, "y": y}), np.array([0.8, 0.5]), random_state(seed_sequence(1))
        )
        np.testing.assert_allclose(found.rows.sum(axis=0), exact, rtol=1e-6)
        assert found.log_increments.sum() == pytest.approx(log_likelihood(0.8, 0.5), rel=1e-12)


@pytest.mark.parametrize("name", ["pendulum", "noisy_oscillator"])
def test_predictions_of_simulated_data_are_uniform(name):
    """PIT values of data from the model, pooled over independent sets, every tenth row."""
    model, smoother = smoother_of(name, Settings(500, "bootstrap"), exact=False)
    theta = check_parameters(model, THETA[name])
    given = bind(model, simulated(name, 100))
    simulator, pits = Simulator(smoother.program, smoother.missing, None), []
    for r in range(20):
        stream = random_state(seed_sequence(seed_of("pit", name)), r)
        sets = simulator.sets(given, theta, stream)
        passes = smoother.run(sets, theta, stream)
        pits.append(probability_transforms(passes, sets, stream)[0][5::10].ravel())
    assert stats.kstest(np.concatenate(pits), "uniform").pvalue > LEVEL


def test_missing_values_have_no_transform():
    name = "noisy_oscillator"
    model, _ = smoother_of(name)
    missing = Missing()
    smoother = Smoother(score_columns(model, model, (), (), missing), missing, Settings(100))
    data = simulated(name, 30)
    data["y"][[3, 17]] = np.nan
    experiments = bind(model, data)
    theta = check_parameters(model, THETA[name])
    stream = random_state(seed_sequence(1))
    passes = smoother.run(experiments, theta, stream)
    (pit,) = probability_transforms(passes, experiments, stream)
    assert np.flatnonzero(np.isnan(pit[:, 0])).tolist() == [3, 17]
    assert np.all(passes[0].log_increments[[3, 17]] == 0.0)


def test_positive_states_are_left_to_the_transition():
    """The extended Kalman filter may step out of a LogNormal state's support, and then knows
    nothing: neither a guide nor a prediction."""
    positive, plain = ssm.Model("positive"), ssm.Model("plain")
    for model in (positive, plain):
        model.initial(lambda: {"n": ssm.LogNormal(2.0, sd=0.3)})
        model.observation(lambda n: {"y": ssm.Poisson(3.0 * np.abs(n))})
    positive.transition(lambda n: {"n": ssm.LogNormal(np.log(n) + 1.0 - n / 20.0, sd=0.3)})
    plain.transition(lambda n: {"n": ssm.Normal(0.9 * n, sd=0.3)})
    chosen = []
    for model in (positive, plain):
        program = compile_trace(trace(model), Missing(none=True))
        assert not isinstance(program.proposals["twisted"], NotApplicable)
        chosen.append(proposal_of(program))
    assert chosen == ["bootstrap", "twisted"]
