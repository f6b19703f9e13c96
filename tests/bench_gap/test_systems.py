"""The true systems without effects are the models given; their effects are other functions."""

import numpy as np
import pytest

from bench.gap.names import ITEMS
from bench.gap.plan import SPLIT
from bench.gap.run import MODELS
from bench.gap.truth import SYSTEMS
from bench.gap.truth.forms import DELAY, SLOTS, delayed, driven, lagged, play
from ssmppl.diagnosis.effects.catalogue import effects
from ssmppl.expressions.evaluate import evaluate
from ssmppl.language.model.trace import previous
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model

# Models that integrate over a row: the true systems integrate more finely, and differ by the error
# of the models' steps, of which `test_what_the_models_steps_leave_is_far_below_the_noise` tells.
FINER = {"servo": 1e-8, "swing": 1e-5}


def laws(sites, values):
    """name -> (mean, sd) of the model's normal, Dirac and Poisson laws."""
    found = {}
    for name, site in sites.items():
        own = site.distribution.parameters
        kind = type(site.distribution).__name__
        location = {"Normal": "mean_", "Dirac": "value", "Poisson": "rate"}[kind]
        mean = float(evaluate(own[location], values))
        sd = {"Normal": lambda o=own: float(evaluate(o["sd"], values)), "Dirac": lambda: 0.0,
              "Poisson": lambda m=mean: np.sqrt(m)}[kind]()  # fmt: skip
        found[name] = mean, sd
    return found


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_true_system_without_effects_is_the_model_given(name):
    system = SYSTEMS[name]
    traced = trace(load_model(str(MODELS / f"{name}.py")))
    assert list(traced.parameters) == list(system.parameters)
    names = list(traced.initial)
    assert tuple(names) == system.states[: len(names)]
    assert tuple(traced.observations) == system.channels
    assert tuple(traced.inputs) == system.inputs
    rng = np.random.default_rng(1)
    p = system.drawn_parameters(rng)
    theta = dict(zip(traced.parameter_symbols, p, strict=True))
    start = laws(traced.initial, theta)
    assert [start[n] for n in names] == list(system.start[: len(names)])

    U = system.excite(rng, 60)
    X, _ = system.simulate(p, system.strengths({}), U, rng)
    mean, sd = np.zeros(len(system.start)), np.zeros(len(system.start))
    level, spread, wild = (np.zeros(len(system.channels)) for _ in range(3))
    for t in range(0, 60, 7):
        x, u = dict(zip(traced.state_symbols, X[t], strict=False)), traced.input_symbols
        now = {**theta, **x, **dict(zip(u, U[t], strict=True))}
        ahead = {previous(s): v for s, v in now.items() if s not in theta} | theta
        system.step(X[t], U[t], t + 1, p, system.strengths({}), mean, sd)
        system.observe(X[t], U[t], t + 1, p, system.strengths({}), level, spread, wild)
        step, seen = laws(traced.transition, ahead), laws(traced.observations, now)
        k = len(names)
        np.testing.assert_allclose([step[n] for n in names], np.stack([mean, sd], 1)[:k],
                                   rtol=1e-7, atol=FINER.get(name, 0))  # fmt: skip
        np.testing.assert_allclose([seen[n] for n in system.channels],
                                   np.stack([level, spread], 1))  # fmt: skip
        assert not wild.any()


@pytest.mark.parametrize("name", FINER)
def test_what_the_models_steps_leave_is_far_below_the_noise(name):
    """The largest shift of a row's law by the model's steps, in standard deviations of the noise
    of the row, along a whole run: its square, summed over the rows, bounds what it is worth in
    nats."""
    system = SYSTEMS[name]
    traced = trace(load_model(str(MODELS / f"{name}.py")))
    rng = np.random.default_rng(2)
    p = np.array(list(system.parameters.values()))
    U, X, _ = system.recorded(p, system.strengths({}), system.excite(rng, system.steps), rng)
    theta = dict(zip(traced.parameter_symbols, p, strict=True))
    mean, sd, largest = np.zeros(len(system.start)), np.zeros(len(system.start)), 0.0
    for t in range(0, system.steps, 20):
        state = {previous(s): v for s, v in zip(traced.state_symbols, X[t], strict=False)}
        inputs = dict(zip(map(previous, traced.input_symbols), U[t], strict=True))
        step = laws(traced.transition, theta | state | inputs)
        system.step(X[t], U[t], t + 1, p, system.strengths({}), mean, sd)
        largest = max(largest, abs(step[system.states[1]][0] - mean[1]) / sd[1])
    assert system.steps * largest**2 < 0.05


def test_a_closed_loop_commands_what_the_encoder_told():
    system = SYSTEMS["servo"]
    p = np.array(list(system.parameters.values()))
    excited = system.excite(np.random.default_rng(0), system.steps)
    U, _, Y = system.recorded(p, system.strengths({}), excited, np.random.default_rng(1))
    memory = np.zeros(system.memory)
    again = [system.control(y, w, memory) for y, w in zip(Y, excited, strict=True)]
    np.testing.assert_array_equal(U, again)
    assert np.abs(U).max() <= 1
    assert np.abs(Y[:, 0] - excited[:, 0])[100:].max() < 0.1  # it follows
    counts = Y / system.resolution
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    late = system.strengths({})
    late[DELAY] = 3.0
    V, _, _ = system.recorded(p, late, excited, np.random.default_rng(1))
    assert np.abs(U - V).max() > 0.01  # the loop answers to what delays it
    np.testing.assert_array_equal(excited, system.excite(np.random.default_rng(0), system.steps))


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_effect_changes_what_is_observed(name):
    system = SYSTEMS[name]
    p = np.array(list(system.parameters.values()))
    U = system.excite(np.random.default_rng(0), system.steps)
    _, plain = system.simulate(p, system.strengths({}), U, np.random.default_rng(1))
    for key, effect in system.effects.items():
        X, Y = system.simulate(p, system.strengths({key: effect.start}), U,
                               np.random.default_rng(1))  # fmt: skip
        assert np.isfinite(X).all(), key
        assert np.abs(Y - plain).max() > 1e-6, key


@pytest.mark.parametrize("name", SYSTEMS)
def test_names_and_equations_are_those_of_the_catalogue_and_the_model(name):
    system = SYSTEMS[name]
    known = {*system.states, *system.inputs, *system.channels, *system.parameters}
    for effect in system.effects.values():
        assert effect.slot in SLOTS
        assert set(effect.equations) <= known
        assert effect.item is None or set(ITEMS[effect.item]) <= set(effects.names())
    assert system.outside
    assert len(system.inside) >= 7


def test_the_halves_share_no_system_and_no_seed():
    halves = list(SPLIT["halves"].values())
    systems = [s for h in halves for s in h["systems"]]
    assert sorted(systems) == sorted(SYSTEMS)
    assert len({h["seed"] for h in halves} | {SPLIT["solver_seed"]}) == len(halves) + 1


def test_delays_between_samples_interpolate():
    u = np.arange(10.0)
    np.testing.assert_allclose(delayed(u, 2.25), np.maximum(u - 2.25, 0))


def test_a_lag_keeps_a_constant_and_forgets_an_impulse():
    u = np.zeros(50)
    u[5] = 1
    out = lagged(u, 4.0)
    np.testing.assert_allclose(out[5:9], (1 - np.exp(-0.25)) * np.exp(-np.arange(4) / 4))
    np.testing.assert_allclose(lagged(np.full(9, 3.0), 4.0), 3.0)


def test_a_play_follows_at_its_half_width():
    u = np.concatenate([np.linspace(0, 3, 31), np.linspace(3, 0, 31)])
    out = play(u, 0.5)
    assert out[30] == pytest.approx(2.5)
    assert out[-1] == pytest.approx(0.5)
    assert out[33] == out[30]


def test_inputs_without_effects_are_left_alone():
    U = np.ones((5, 2))
    assert driven(U, np.zeros(len(SLOTS))) is U
