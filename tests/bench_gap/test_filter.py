"""The strength solver's likelihoods, against exact ones and against the package's filters."""

import numpy as np
import pytest

import ssmppl as ssm
from bench.gap.filter import predictions, terms
from bench.gap.fit import fit
from bench.gap.run import MODELS
from bench.gap.strength import next_log_strength
from bench.gap.truth import SYSTEMS
from bench.gap.truth.forms import OUTLIERS
from ssmppl.modelfile import load_model
from tests.statistics.checks import LEVEL, mean_one_p, seed_of


def drawn(name, strengths=None, steps=None, seed=0):
    system = SYSTEMS[name]
    rng = np.random.default_rng(seed_of(name, seed))
    p, e = system.drawn_parameters(rng), system.strengths(strengths or {})
    U, _, Y = system.recorded(p, e, system.excite(rng, steps or system.steps), rng)
    data = dict(zip(system.inputs + system.channels, [*U.T, *Y.T], strict=True))
    return system, p, e, U, Y, data


@pytest.mark.slow
@pytest.mark.parametrize("name", ["thermal", "servo", "hot_plate", "ship_steering"])
def test_linear_systems_have_their_exact_likelihood(name):
    system, p, e, U, Y, data = drawn(name, steps=80)
    parameters = dict(zip(system.parameters, p, strict=True))
    model = load_model(str(MODELS / f"{name}.py"))
    exact = ssm.log_likelihood(model, data, parameters)[0]
    assert terms(system, p, e, U, Y)[0].sum() == pytest.approx(exact, rel=1e-7)


@pytest.mark.slow
def test_missing_observations_are_left_out():
    system, p, e, U, Y, data = drawn("thermal", steps=80)
    Y[10:15, 0] = np.nan
    data["y1"] = Y[:, 0]
    model = load_model(str(MODELS / "thermal.py"))
    exact = ssm.log_likelihood(model, data, dict(zip(system.parameters, p, strict=True)))[0]
    ll, _, _ = terms(system, p, e, U, Y)
    assert ll.sum() == pytest.approx(exact, rel=1e-9)
    assert not ll[10:15, 0].any()
    filtered = ssm.kalman_filter(model, data, dict(zip(system.parameters, p, strict=True)))
    means = predictions(system, p, e, U, Y)
    for j, channel in enumerate(system.channels[:1]):  # the others know those before them
        exact = filtered[f"{channel}_predicted"].values[0]
        np.testing.assert_allclose(means[:, j], exact, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["pendulum", "two_tanks", "predator_prey", "epidemic", "cascade", "chemostat"]
)
def test_gains_of_nonlinear_systems_are_those_of_the_particle_filter(name):
    """What the solver uses is differences of log likelihoods: here between two parameter points a
    few nats apart, which are to agree within 0.5 nats beside the particles' error. Hundreds of
    nats away the bootstrap filter's particles miss the data, and its log Z says nothing."""
    system, p, e, U, Y, data = drawn(name, steps=200)
    model = load_model(str(MODELS / f"{name}.py"))
    here, shift = terms(system, p, e, U, Y)[0].sum(), 0.03
    while abs(terms(system, p * (1 + shift), e, U, Y)[0].sum() - here) > 10:
        shift /= 2
    near = p * (1 + shift)
    found = []
    for at in (p, near):
        parameters = dict(zip(system.parameters, at, strict=True))
        log_z = ssm.log_likelihood(
            model, data, parameters, particles=4000, repeats=12, proposal="bootstrap", seed=1
        )
        top = log_z.max()
        mean = top + np.log(np.mean(np.exp(log_z - top)))
        spread = np.exp(log_z - mean)
        found.append((mean, spread.std(ddof=1) / np.sqrt(len(spread))))
    ours = [terms(system, at, e, U, Y)[0].sum() for at in (p, near)]
    error = np.hypot(found[0][1], found[1][1])
    difference = (ours[0] - ours[1]) - (found[0][0] - found[1][0])
    assert abs(difference) < 0.5 + 4 * error


def test_the_density_of_contaminated_observations_has_mean_one():
    """E[exp(l_q - l_p)] = 1 over data from p for predictive densities of the two laws."""
    ratios = []
    for k in range(300):
        system, p, e, U, _, _ = drawn("thermal", steps=6, seed=k)
        e[OUTLIERS] = 0.1
        _, Y = system.simulate(p, e, U, np.random.default_rng(seed_of("wild", k)))
        other = e.copy()
        other[OUTLIERS] = 0.14
        ratios.append(terms(system, p, other, U, Y)[0].sum() - terms(system, p, e, U, Y)[0].sum())
    assert np.std(ratios) > 0.1
    assert mean_one_p(ratios) > LEVEL


def test_a_fit_is_at_a_maximum_and_finds_the_parameters():
    system, p, e, U, Y, _ = drawn("thermal", {"delay": 2.5})
    start = np.array(list(system.parameters.values()))
    found = fit(system, U, Y, ("delay",), start, system.strengths({"delay": 2.0}), len(Y))
    assert found.e[system.effects["delay"].index] == pytest.approx(2.5, abs=0.3)
    np.testing.assert_allclose(found.p, p, rtol=0.35)

    def value(q, strengths):
        prior = -0.5 * np.sum((np.log(q) - np.log(start)) ** 2)
        return terms(system, q, strengths, U, Y)[0].sum() + prior

    top = value(found.p, found.e)
    assert top == pytest.approx(found.value)
    for k in range(len(p)):
        for factor in (0.97, 1.03):
            beside = found.p.copy()
            beside[k] *= factor
            assert value(beside, found.e) < top + 0.02
    assert top > value(p, e)


def test_the_next_strength_lies_where_a_power_law_puts_it():
    law = lambda s: 3.0 * np.exp(1.7 * s)  # noqa: E731
    seen = [(0.0, law(0.0))]
    for _ in range(6):
        s = next_log_strength(seen, 20.0)
        seen.append((s, law(s)))
    assert seen[-1][1] == pytest.approx(20.0, rel=0.02)
    bracketed = next_log_strength([(0.0, 5.0), (1.0, 50.0)], 20.0)
    assert 0 < bracketed < 1
