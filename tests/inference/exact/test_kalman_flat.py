"""Flat laws in @initial: exact for linear Gaussian models, refused by all else."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.data import bind
from ssmppl.errors import ArgumentError, ModelError, SamplingError
from ssmppl.inference.exact.derivatives import jacobian
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.language.tracing import trace
from tests.statistics.checks import seed_of


def nile(start):
    model = ssm.Model("nile")

    @model.prior
    def prior():
        return {"r": ssm.HalfFlat(), "q": ssm.HalfFlat()}

    @model.initial
    def initial():
        return {"level": start}

    @model.transition
    def transition(level, q):
        return {"level": ssm.Normal(level, variance=q)}

    @model.observation
    def observation(level, r):
        return {"y": ssm.Normal(level, variance=r)}

    return model


DATA = {"y": datasets.nile()}
AT = {"r": 15099.0, "q": 1469.1}


@pytest.mark.parametrize("proposal", ["auto", "kalman"])
def test_log_likelihood_of_the_nile(proposal, exact_values):
    known, flat = exact_values["nile_local_level"]["log_likelihood"].values()
    vague = nile(ssm.Normal(0, variance=1e7))
    assert ssm.log_likelihood(vague, DATA, AT, proposal=proposal) == pytest.approx(known, abs=5e-5)
    found = ssm.log_likelihood(nile(ssm.Flat()), DATA, AT, proposal=proposal)
    assert found == pytest.approx(flat, abs=5e-5)


def test_a_flat_start_is_the_limit_of_vague_ones():
    """log p + log(sd) + log(2 pi)/2 of a start N(0, sd^2); moments and score without more ado."""
    experiments = bind(trace(nile(ssm.Flat())), DATA)
    theta, sd = np.array([15099.0, 1469.1]), 1e9
    exact = kalman_model(trace(nile(ssm.Flat())))
    vague = kalman_model(trace(nile(ssm.Normal(0, sd=sd))))
    more = np.log(sd) + 0.5 * np.log(2 * np.pi)
    value, gradient = exact.score(experiments, theta)
    other, slope = vague.score(experiments, theta)
    assert value == pytest.approx(other + more, abs=1e-8)
    np.testing.assert_allclose(gradient, slope, atol=1e-10)
    one, two = (m.smooth(experiments[0], theta) for m in (exact, vague))
    np.testing.assert_allclose(one.mean, two.mean, rtol=1e-9)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-7)
    np.testing.assert_allclose(one.cross, two.cross, rtol=1e-7)
    assert one.log_likelihood == pytest.approx(value, abs=1e-9)
    np.testing.assert_allclose(
        exact.information(experiments, theta), vague.information(experiments, theta), rtol=1e-6
    )


def test_maximum_of_the_nile(exact_values):
    best = exact_values["nile_local_level"]["mle"]
    model = kalman_model(trace(nile(ssm.Flat())))
    experiments = bind(model.trace, DATA)
    theta = np.array([best["r"], best["q"]])
    _, gradient = model.score(experiments, theta)
    step = np.linalg.solve(model.information(experiments, theta), gradient)
    assert (np.abs(step) < [0.5, 0.05]).all()  # the digits that are given


def test_filter_of_the_nile():
    found = ssm.kalman_filter(nile(ssm.Flat()), DATA, AT).isel(draw=0)
    assert found.level.values[0] == pytest.approx(1120.0, rel=1e-12)  # the first measurement
    assert found.level_sd.values[0] == pytest.approx(np.sqrt(15099.0))
    assert np.isnan(found.y_predicted.values[0])
    assert np.isinf(found.y_predicted_sd.values[0])
    assert np.isnan(found.y_pit.values[0])
    assert np.isfinite(found.y_pit.values[1:]).all()
    assert found.log_likelihood_increment.values[0] == pytest.approx(0.0, abs=1e-12)
    assert found.log_likelihood_increment.values.sum() == pytest.approx(-632.5456, abs=5e-5)


def trend():
    """A trend with a regression on an input, flat but for a deterministic and a proper state."""
    model = ssm.Model("trend", inputs=("u",))

    @model.prior
    def prior():
        return {"a": ssm.Uniform(-1, 1), "s": ssm.Gamma(1, rate=1)}

    @model.initial
    def initial(s):
        return {"c": ssm.Dirac(0.5), "line": ssm.Flat((2,)), "e": ssm.Normal(0, sd=s),
                "effect": ssm.Flat()}  # fmt: skip

    @model.transition
    def transition(line, effect, c, e, a, s):
        return {"line": ssm.Normal(np.stack([line[0] + line[1], line[1] + 0.1 * e]), sd=s),
                "effect": ssm.Dirac(effect), "c": ssm.Dirac(c * a),
                "e": ssm.Normal(a * e, sd=1)}  # fmt: skip

    @model.observation
    def observation(line, effect, c, e, u, a):
        return {"y": ssm.Normal(line[0] + effect * u + c, sd=0.5), "z": ssm.Normal(a * e, sd=1)}

    return model


@pytest.mark.slow
def test_several_flat_components_and_experiments():
    """Score, information and draws of a model with inputs, gaps and a Dirac component."""
    traced = trace(trend())
    rng = np.random.default_rng(seed_of("trend"))
    data = []
    for steps in (12, 20):
        y, z = rng.normal(size=(2, steps)).cumsum(axis=1)
        y[[0, 5]], z[:3] = np.nan, np.nan
        data.append({"y": y, "z": z, "u": rng.normal(size=steps)})
    experiments = bind(traced, data)
    model, theta = kalman_model(traced), np.array([0.6, 0.4])
    value, gradient = model.score(experiments, theta)
    assert value == pytest.approx(model.log_likelihood(experiments, theta), abs=1e-9)
    slope, error = jacobian(
        lambda v: np.array([model.log_likelihood(experiments, v)]), theta, np.array([0.05, 0.05])
    )
    assert (error < 1e-8 * (1 + abs(slope))).all()
    np.testing.assert_allclose(gradient, slope[0], rtol=1e-8, atol=1e-8)
    found = model.smooth(experiments[1], theta)
    draws = model.draw(
        experiments[1], theta, new_state(np.random.SeedSequence(seed_of("trend"))), 4_000
    )
    spread = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert (abs(draws.mean(axis=0) - found.mean) <= 5 * spread / np.sqrt(4_000) + 1e-9).all()
    effect = 4  # after c, line, e
    np.testing.assert_allclose(draws[:, :, effect], draws[:, :1, effect] + np.zeros(20), atol=1e-9)
    noises = model.disturbances(experiments[1], theta)
    y = experiments[1].observed["y"]
    fitted = found.mean[:, 1] + found.mean[:, effect] * data[1]["u"] + 0.5 * 0.6 ** np.arange(20)
    np.testing.assert_allclose(noises.observation_mean[1:5, 0], (y - fitted)[1:5], atol=1e-9)


# -- what is refused
def test_data_that_do_not_tell_the_start():
    model = ssm.Model("two levels")

    @model.initial
    def initial():
        return {"x": ssm.Flat(), "hidden": ssm.Flat()}

    @model.transition
    def transition(x, hidden):
        return {"x": ssm.Normal(x, sd=1), "hidden": ssm.Normal(hidden, sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    data = {"y": [0.1, 0.2, 0.3]}
    with pytest.raises(SamplingError, match=r"start of hidden is Flat, and the data do not tell"):
        ssm.log_likelihood(model, data, {})
    (experiment,) = bind(trace(model), data)
    with pytest.raises(SamplingError, match="hidden"):
        kalman_model(trace(model)).smooth(experiment, np.zeros(0))
    found = ssm.kalman_filter(model, data, {})  # tells what there is
    assert np.isfinite(found.x.values).all()
    assert np.isinf(found.hidden_sd.values).all()
    with pytest.raises(SamplingError, match="of x is Flat"):
        ssm.log_likelihood(model, {"y": [np.nan, np.nan]}, {})


def test_effects_that_outgrow_the_rounding_errors():
    """Without noise, nothing holds the path of an unstable state near the data."""
    model = ssm.Model("explosive")

    @model.initial
    def initial():
        return {"x": ssm.Flat()}

    @model.transition
    def transition(x):
        return {"x": ssm.Dirac(1.3 * x + 0.1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    traced = trace(model)
    y = np.random.default_rng(seed_of("explosive")).normal(size=400)
    (experiment,) = bind(traced, {"y": y})
    with pytest.raises(SamplingError, match="rounding errors"):
        kalman_model(traced).smooth(experiment, np.zeros(0))


def test_particles_and_simulation_refuse_it():
    model = nile(ssm.Flat())
    for call in (
        lambda: ssm.log_likelihood(model, DATA, AT, proposal="bootstrap"),
        lambda: ssm.log_likelihood(model, DATA, AT, proposal="auxiliary"),
        lambda: ssm.particle_filter(model, DATA, AT),
        lambda: ssm.sample(model, DATA, method=ssm.PMMH(), draws=5, warmup=5, progress=False),
        lambda: ssm.sample(model, DATA, method=ssm.PGAS(), draws=5, warmup=5, progress=False),
        lambda: ssm.smooth(model, DATA, AT, method=ssm.FFBSi()),
        lambda: ssm.maximize(model, DATA, method=ssm.PSAEM()),
        lambda: ssm.maximize(model, DATA, method=ssm.ParticleEM()),
        lambda: ssm.maximize(model, DATA, method=ssm.ScoreAscent()),
    ):
        with pytest.raises(ArgumentError, match="initial distribution of 'level' is Flat"):
            call()
    with pytest.raises(ModelError, match="'level' is Flat, and cannot be drawn"):
        ssm.simulate(model, AT, steps=5)
    assert "'level' is Flat" in str(ssm.explain(model))


def test_nonlinear_models_refuse_it():
    model = ssm.Model("bent")

    @model.initial
    def initial():
        return {"x": ssm.Flat()}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(np.sin(x), sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    for call in (lambda: ssm.log_likelihood(model, {"y": [0.0]}, {}), lambda: ssm.explain(model)):
        with pytest.raises(ModelError, match=r"only a linear Gaussian model.*transition of x"):
            call()


@pytest.mark.parametrize("law", [ssm.HalfFlat, ssm.Flat])
def test_other_places_refuse_it(law):
    model = nile(law())
    if law is ssm.Flat:  # which @initial may hold
        model.observation(lambda: {"w": law()})
    with pytest.raises(ModelError, match="improper"):
        trace(model)
