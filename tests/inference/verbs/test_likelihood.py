"""The verbs round the likelihood: arguments, limits, errors at run time."""

import re

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl import datasets

varves = ssm.Model("ice varves")


@varves.prior
def prior():
    return {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)}


@varves.initial
def initial(phi, tau):
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@varves.transition
def transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@varves.observation
def observation(x):
    return {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))}


DATA = {"y": datasets.ice_varves()[:60]}
AT = {"phi": 0.95, "tau": 50.0}


@pytest.mark.parametrize("proposal", ["bootstrap", "guided", "auxiliary"])
def test_minus_infinity_where_nothing_is_finite(proposal):
    for parameters in ({"phi": 1.5, "tau": 50.0}, {"phi": 0.9, "tau": -1.0}):
        values = ssm.log_likelihood(varves, DATA, parameters, proposal=proposal, repeats=3, seed=1)
        assert values.shape == (3,)
        assert values.dtype == np.float64
        assert np.all(values == -np.inf)


def test_the_same_seed_gives_the_same_numbers():
    one, two = (ssm.log_likelihood(varves, DATA, AT, repeats=5, seed=7) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert len(set(one)) == 5
    more = ssm.log_likelihood(varves, DATA, AT, repeats=11, seed=7)
    np.testing.assert_array_equal(one, more[:5])


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ({"proposal": "gided"}, ["'gided'", "guided"]),
        ({"proposal": "kalman"}, ["linear Gaussian", "y is Gamma", __file__]),
        ({"resampling": "sistematic"}, ["sistematic", "systematic"]),
        ({"particles": 0}, ["particles=0", "at least 1"]),
        ({"particles": 10.5}, ["particles=10.5"]),
        ({"repeats": 0}, ["repeats=0"]),
        ({"ess_threshold": 1.5}, ["ess_threshold=1.5", "from 0"]),
        ({"ess_threshold": None}, ["ess_threshold=None", "from 0"]),
        ({"ess_threshold": "half"}, ["ess_threshold='half'", "from 0"]),
        ({"seed": "a"}, ["seed='a'"]),
    ],
)
def test_bad_arguments(arguments, fragments):
    with pytest.raises(ssm.ArgumentError) as error:
        ssm.log_likelihood(varves, DATA, AT, **arguments)
    for fragment in fragments:
        assert fragment in str(error.value)


uniform = ssm.Model("bounded")


@uniform.initial
def start():
    return {"x": ssm.Normal(0, sd=1)}


@uniform.transition
def move(x):
    return {"x": ssm.Normal(x, sd=1)}


@uniform.observation
def see(x):
    return {"y": ssm.Uniform(x - 1, x + 1)}


def test_vanishing_weights_name_the_step_the_row_and_the_line():
    y = np.zeros(20)
    y[12] = 1e4
    values = ssm.log_likelihood(uniform, {"y": y}, {}, particles=50, repeats=2, seed=1)
    assert np.all(values == -np.inf)
    with pytest.raises(ssm.SamplingError) as error:
        ssm.particle_filter(uniform, {"y": y}, {}, particles=50, seed=1)
    for fragment in ("t=13", "10000", "all weights are zero", "Uniform(x - 1, x + 1)", __file__):
        assert fragment in str(error.value)


broken = ssm.Model("leaves its domain")


@broken.prior
def scale():
    return {"s": ssm.Gamma(1, rate=1)}


@broken.initial
def begin():
    return {"x": ssm.Normal(0, sd=1)}


@broken.transition
def go(x, s):
    return {"x": ssm.Normal(np.log(x + 1.5), sd=s)}


@broken.observation
def look(x):
    return {"y": ssm.Normal(x, sd=1)}


def test_nan_for_some_particles_is_an_error_not_a_silent_drop():
    data = {"y": np.zeros(30)}
    with pytest.raises(ssm.SamplingError, match="weight is nan at t="):
        ssm.log_likelihood(broken, data, {"s": 1.0}, proposal="bootstrap", seed=1)
    with pytest.raises(ssm.SamplingError, match="nan at t=") as error:
        ssm.simulate(broken, {"s": 1.0}, steps=50, draws=20, seed=1)
    assert __file__ in str(error.value)


def out_of_range(law):
    """A model whose state g has a law with a parameter that leaves its range: x goes below 0."""
    model = ssm.Model("out of range")

    @model.initial
    def initial():
        return {"x": ssm.Normal(1, sd=1), "g": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(0.5 * x, sd=1), "g": law(x)}

    @model.observation
    def observation(x, g):
        return {"y": ssm.Normal(g, sd=1), "z": ssm.Normal(x, sd=1)}

    return model


LAWS = [
    lambda x: ssm.Gamma(2, rate=x), lambda x: ssm.Gamma(x, rate=1), lambda x: ssm.Exponential(x),
    lambda x: ssm.Exponential(scale=x), lambda x: ssm.Normal(0, sd=x),
    lambda x: ssm.Normal(0, variance=x), lambda x: ssm.HalfNormal(sd=x),
    lambda x: ssm.InverseGamma(2, scale=x), lambda x: ssm.Beta(1, x), lambda x: ssm.Poisson(x),
    lambda x: ssm.Binomial(5, x), lambda x: ssm.Bernoulli(x), lambda x: ssm.LogNormal(0, sd=x),
    lambda x: ssm.StudentT(4, 0, scale=x), lambda x: ssm.Laplace(0, scale=x),
    lambda x: ssm.NegativeBinomial(x, dispersion=2),
    lambda x: ssm.Truncated(ssm.Gamma(2, rate=x), upper=3),
    lambda x: ssm.Truncated(ssm.Exponential(rate=x), upper=3),
    lambda x: ssm.Truncated(ssm.Normal(0, sd=x), lower=-3, upper=3),
    lambda x: ssm.Categorical(np.stack([x, 1 - x])),
    lambda x: ssm.Normal(0, sd=np.where(x < 0, -1.0, 1.0)),
]  # fmt: skip


@pytest.mark.parametrize("law", LAWS, ids=lambda law: repr(law(1.0 * 0.5)))
def test_nothing_is_drawn_from_a_law_out_of_its_range(law):
    """Neither by the simulator, nor silently by a filter that asks for no density of the states."""
    model = out_of_range(law)
    with pytest.raises(ssm.SamplingError, match=r"'?g'? is nan at t=") as error:
        ssm.simulate(model, steps=30, draws=5, seed=1)
    assert __file__ in str(error.value)
    data = {"y": np.full(30, 0.5), "z": np.zeros(30)}
    with pytest.raises(ssm.SamplingError, match="nan at t="):
        ssm.log_likelihood(model, data, {}, particles=200, proposal="bootstrap", seed=1)


def test_no_observation_is_simulated_by_a_law_out_of_its_range():
    model = ssm.Model("observed")

    @model.initial
    def initial():
        return {"x": ssm.Normal(-1, sd=0.1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(x, sd=0.1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Exponential(rate=x)}

    with pytest.raises(ssm.SamplingError, match="y is nan at t=1 of draw 1") as error:
        ssm.simulate(model, steps=3, seed=1)
    assert __file__ in str(error.value)


def test_laws_at_the_end_of_their_range_are_drawn_from():
    """A spread of zero is one point; probabilities miss 0 and 1 by rounding."""
    model = ssm.Model("ends")

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1), "k": ssm.Bernoulli(0.5)}

    @model.transition
    def transition(x, k, t):
        return {
            "x": ssm.Normal(x, sd=np.where(t > 3, 0.0, 1.0)),
            "k": ssm.Bernoulli((0.1 + 0.2) * k / 0.3),
        }

    @model.observation
    def observation(x, k):
        return {"y": ssm.Normal(x + k, sd=1)}

    drawn = ssm.simulate(model, steps=8, draws=20, seed=1)
    assert np.ptp(drawn["x"].values[:, 3:], axis=1).max() == 0.0
    assert set(np.unique(drawn["k"])) == {0.0, 1.0}
    found = ssm.log_likelihood(model, {"y": np.zeros(8)}, {}, proposal="bootstrap", seed=1)
    assert np.isfinite(found)


def test_simulate_shapes_and_prior_draws():
    own = ssm.Model("vector", inputs=("u",))

    @own.prior
    def prior():
        return {"a": ssm.Normal(np.zeros(2), sd=1), "q": ssm.Gamma(2, rate=1)}

    @own.initial
    def initial(q):
        return {"x": ssm.Normal(np.zeros(2), precision=q)}

    @own.transition
    def transition(x, u, a):
        return {"x": ssm.Normal(0.5 * x + a * u, sd=1)}

    @own.observation
    def observation(x):
        return {"y": ssm.MvNormal(x, covariance=np.eye(2)), "z": ssm.Poisson(np.exp(x[0]))}

    inputs = {"u": np.arange(7.0)}
    out = ssm.simulate(own, inputs=inputs, draws=3, seed=2)
    assert out["x"].shape == out["y"].shape == (3, 7, 2)
    assert out["z"].shape == (3, 7)
    assert out["a"].shape == (3, 2)
    assert out["q"].shape == (3,)
    assert list(out["time"].values) == list(range(1, 8))
    again = ssm.simulate(own, inputs=inputs, draws=3, seed=2)
    np.testing.assert_array_equal(out["y"], again["y"])


def test_improper_priors_cannot_be_simulated_from():
    flat = ssm.Model("flat")

    @flat.prior
    def prior():
        return {"m": ssm.Flat(), "s": ssm.HalfFlat()}

    @flat.initial
    def initial(m, s):
        return {"x": ssm.Normal(m, sd=s)}

    @flat.transition
    def transition(x):
        return {"x": ssm.Normal(x, sd=1)}

    @flat.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    with pytest.raises(ssm.ArgumentError, match="improper"):
        ssm.simulate(flat, steps=5)
    out = ssm.simulate(flat, {"m": 0.0, "s": 1.0}, steps=5)
    assert out["y"].shape == (1, 5)


@pytest.mark.parametrize("particles", [2, 7, 40])
def test_probability_transforms_do_not_exceed_one(particles):
    """Where all particles put y_t above everything, rounding of the weights' sum is not added."""
    far = {"y": np.where(np.arange(60) % 2, 1e6, 10.0)}
    out = ssm.particle_filter(varves, far, AT, particles=particles, repeats=5, seed=1)
    pit = out["y_pit"].values[:, 1::2]
    assert pit.max() == 1.0
    assert pit.min() > 1 - 1e-12


def test_filter_datasets():
    out = ssm.particle_filter(varves, DATA, AT, particles=200, repeats=2, seed=1)
    assert out["x"].dims == ("draw", "time")
    assert out["covariance"].dims == ("draw", "time", "state", "state_")
    assert out["x_quantile"].dims == ("draw", "time", "quantile")
    assert np.all(np.diff(out["x_quantile"].values, axis=-1) >= 0)
    np.testing.assert_allclose(out["x_sd"] ** 2, out["covariance"][..., 0, 0])
    assert np.all((out["y_pit"] > 0) & (out["y_pit"] < 1))
    total = out["log_likelihood_increment"].sum("time").values
    assert np.all(np.isfinite(total))
    assert np.all(out["ess"] <= 200)


LAWS_OF_A_STATE = {  # law of y, the argument that the state leads out of its range, a fix
    "Poisson": (lambda x: ssm.Poisson(x), "the rate of Poisson, x,", "np.exp(x)"),
    "Binomial": (lambda x: ssm.Binomial(5, x), " of Binomial, x,", "1 / (1 + np.exp(-(x)))"),
    "Gamma": (lambda x: ssm.Gamma(x, rate=1), "the shape of Gamma, x,", "np.exp(x)"),
    "in a mixture": (
        lambda x: ssm.Mixture([0.5, 0.5], [ssm.Normal(0, sd=1), ssm.Exponential(x)]),
        "the rate of Exponential, x,",
        "np.exp(x)",
    ),
    "of a mixture": (
        lambda x: ssm.Mixture([x, 1 - x], [ssm.Normal(0, sd=1), ssm.Normal(0, sd=2)]),
        "the weights[0] of Mixture, x,",
        "such as [1 - p, p] with p = 1 / (1 + np.exp(-z))",
    ),
    "with zeros": (
        lambda x: ssm.ZeroInflated(ssm.Poisson(x), 0.2),
        "the rate of Poisson, x,",
        "np.exp(x)",
    ),
}


def negative(law):
    model = ssm.Model("negative")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    # before the law at fault one that is in order
    model.observation(lambda x: {"z": ssm.Normal(x, sd=1), "y": law(x)})
    return model


@pytest.mark.parametrize("name", LAWS_OF_A_STATE)
def test_simulate_names_the_argument_out_of_range_with_its_value_and_a_fix(name):
    law, argument, fix = LAWS_OF_A_STATE[name]
    with pytest.raises(ssm.SamplingError) as simulated:
        ssm.simulate(negative(law), steps=20, seed=1)
    assert re.search(re.escape(argument) + r" is -[.0-9]+ there, outside", str(simulated.value))
    assert fix in str(simulated.value)


SUMS = {
    "weights of Mixture": lambda share, x: ssm.Mixture(
        [0.3, share], [ssm.Normal(0, sd=1), ssm.Normal(x, sd=2)]
    ),
    "probabilities of Categorical": lambda share, x: ssm.Categorical([0.3, share]),
}


@pytest.mark.parametrize("name", SUMS)
def test_simulate_names_shares_that_do_not_sum_to_one(name):
    model = negative(lambda x: SUMS[name](0.5 / (1 + x**2), x))
    with pytest.raises(ssm.SamplingError) as simulated:
        ssm.simulate(model, steps=20, seed=1)
    found = str(simulated.value)
    assert re.search(rf"the {name}, \[.*\], sum to 0\.\d+ there", found)
    assert f"write {name.split()[0]} that" in found
    assert "w / np.sum(w)" in found


@pytest.mark.parametrize("proposal", [None, "bootstrap"])
def test_no_likelihood_of_a_chain_whose_rows_do_not_sum_to_one(proposal):
    model = ssm.Model("chain")
    model.prior(lambda: {"a": ssm.Uniform(0, 1)})
    model.initial(lambda a: {"z": ssm.Categorical([a, 0.5])})
    model.transition(lambda z: {"z": ssm.Categorical(np.where(z == 0, [0.9, 0.1], [0.3, 0.7]))})
    model.observation(lambda z: {"y": ssm.Normal(z, sd=1)})
    options = {"seed": 1} if proposal is None else {"proposal": proposal, "seed": 1}
    data = {"y": np.array([0.3, 1.2, -0.4])}
    assert np.isfinite(ssm.log_likelihood(model, data, {"a": 0.5}, **options))
    assert ssm.log_likelihood(model, data, {"a": 0.2}, **options) == -np.inf


@pytest.mark.parametrize("name", LAWS_OF_A_STATE)
def test_a_filter_names_the_argument_that_may_be_out_of_range_and_a_fix(name):
    law, argument, fix = LAWS_OF_A_STATE[name]
    data = {"z": np.zeros(3), "y": np.ones(3)}
    with pytest.raises(ssm.SamplingError, match="a weight is nan at t=1") as filtered:
        ssm.log_likelihood(negative(law), data, {}, seed=1, particles=100)
    assert argument + " has to lie in" in str(filtered.value)
    assert fix in str(filtered.value)


def test_trials_of_a_continuous_state_are_no_whole_numbers():
    data = {"z": np.zeros(3), "y": np.ones(3)}
    law = negative(lambda x: ssm.Binomial(10 * np.exp(x), 0.5))
    with pytest.raises(ssm.SamplingError) as error:
        ssm.particle_filter(law, data, {}, seed=1, particles=100)
    assert "the n of Binomial, 10*exp(x), is no whole number" in error.value.found
    assert "np.maximum(np.floor(10*exp(x) + 0.5), 0)" in error.value.fix
    law = negative(lambda x: ssm.Binomial(np.maximum(np.floor(10 * np.exp(x) + 0.5), 0), 0.5))
    assert np.isfinite(ssm.log_likelihood(law, data, {}, seed=1, particles=100)[0])


def test_trials_of_a_count_are_not_blamed_for_a_row_that_is_too_high():
    model = ssm.Model("count")
    model.initial(lambda: {"S": ssm.Poisson(5)})
    model.transition(lambda S: {"S": ssm.Binomial(S, 0.9)})
    model.observation(lambda S: {"y": ssm.Binomial(S, 0.5)})
    with pytest.raises(ssm.SamplingError) as error:
        ssm.particle_filter(model, {"y": [2.0, 400.0]}, {}, seed=1, particles=100)
    assert "whole number" not in error.value.found


ZERO = {
    "n": (lambda N, p: ssm.Binomial(N, p), {"N": 10.5, "p": 0.5}, "N, is 10.5 there, no whole num"),
    "p": (lambda N, p: ssm.Binomial(N, p), {"N": 9.0, "p": -0.2}, "p, is -0.2 there, outside"),
    "row": (lambda N, p: ssm.Uniform(0, N + p), {"N": 2.0, "p": 0.5}, "zero at t=2, where y = 3"),
}


@pytest.mark.parametrize("name", ZERO)
def test_a_likelihood_of_zero_says_why(name):
    law, parameters, why = ZERO[name]
    model = ssm.Model("zero")
    model.prior(lambda: {"N": ssm.Flat(), "p": ssm.Flat()})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=0.3)})
    model.observation(lambda x, N, p: {"y": law(N, p), "z": ssm.Laplace(x, scale=1)})
    data = {"y": [2.0, 3.0, 1.0], "z": [0.1, 0.2, 0.3]}
    with pytest.warns(UserWarning, match="the likelihood is zero: .*" + why):
        found = ssm.log_likelihood(model, data, parameters, particles=50, repeats=2, seed=1)
    assert found.tolist() == [-np.inf] * 2


def test_an_asymmetric_matrix_has_no_likelihood():
    model = ssm.Model("vector")
    model.prior(lambda: {"Q": ssm.InverseWishart(5, scale=np.eye(2))})
    model.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))})
    model.transition(lambda x, Q: {"x": ssm.MvNormal(0.5 * x, covariance=Q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    data = {"y": np.ones((4, 2))}
    with pytest.raises(ssm.ArgumentError, match=r"'Q'\[0, 1\]: the matrix is not symmetric"):
        ssm.log_likelihood(model, data, {"Q": [[1.0, 0.4], [0.3, 0.8]]})
    assert np.isfinite(ssm.log_likelihood(model, data, {"Q": [[1.0, 0.3], [0.3, 0.8]]})[0])


@pytest.mark.parametrize("seed", [True, 1.0, -1, [1, 2], "1"])
def test_a_seed_is_one_whole_number(seed):
    with pytest.raises(ssm.ArgumentError, match="seed="):
        ssm.log_likelihood(varves, DATA, AT, seed=seed)
