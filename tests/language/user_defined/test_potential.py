"""Potentials: terms of the log density, against the model that they are another way to write."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.errors import DataError, ModelError
from ssmppl.inference.run.problem import pose
from tests.statistics.checks import LEVEL, mean_one_p, seed_of

AT = {"a": 0.8, "q": 0.4}
LOG_NORM = -np.log(0.3) - 0.5 * np.log(2 * np.pi)


def model(observation, initial=None):
    made = ssm.Model("pulled towards 2")
    made.prior(lambda: {"a": ssm.Normal(0.5, sd=0.3), "q": ssm.HalfNormal(sd=1)})
    made.initial(initial or (lambda: {"x": ssm.Normal(0, sd=1)}))
    made.transition(lambda x, a, q: {"x": ssm.Normal(a * x, sd=q)})
    made.observation(observation)
    return made


def pulled(x):
    near = -0.5 * ((x - 2.0) / 0.3) ** 2 + LOG_NORM
    return {"y": ssm.Normal(x, sd=0.5), "near": ssm.Potential(near)}


def measured(x):
    return {"y": ssm.Normal(x, sd=0.5), "near": ssm.Normal(x, sd=0.3)}


def data():
    y = np.random.default_rng(seed_of("potential")).normal(1.0, 1.0, size=12)
    y[4] = np.nan
    return {"y": y}


def exact(values=AT):
    given = data() | {"near": np.full(12, 2.0)}
    return float(ssm.log_likelihood(model(measured), given, values)[0])


@pytest.mark.parametrize("proposal", ["bootstrap", "guided", "twisted"])
def test_the_likelihood_is_that_of_density_times_potential(proposal):
    runs = ssm.log_likelihood(
        model(pulled), data(), AT, proposal=proposal, particles=2000, repeats=30,
        seed=seed_of("pulled", proposal),
    )  # fmt: skip
    assert mean_one_p(np.asarray(runs) - exact()) > LEVEL


def test_states_are_those_of_density_times_potential():
    given = data() | {"near": np.full(12, 2.0)}
    kalman = ssm.smooth(model(measured), given, AT)
    found = ssm.smooth(model(pulled), data(), AT, particles=2000, trajectories=4000, seed=3)
    error = kalman["x_sd"].to_numpy().ravel() / np.sqrt(400)
    gap = found["x"].mean("trajectory").to_numpy().ravel() - kalman["x"].to_numpy().ravel()
    assert np.all(np.abs(gap) < 5 * error)
    assert "near_observed" not in found


def test_the_maximum_is_that_of_the_other_model():
    found = ssm.maximize(model(pulled), data(), fixed={"q": 0.4}, seed=1)
    given = data() | {"near": np.full(12, 2.0)}
    expected = ssm.maximize(model(measured), given, fixed={"q": 0.4})
    assert found.parameters["a"] == pytest.approx(expected.parameters["a"], abs=1e-3)
    assert found.log_likelihood == pytest.approx(expected.log_likelihood, abs=0.1)


def test_components_are_added_and_rows_chosen():
    """A term of parameters alone counts once, in the row that it is given for."""

    def each(x, t):
        return {"y": ssm.Normal(x, sd=0.5), "v": ssm.Potential(np.stack([0.5 * x, 0.25 * x]))}

    def whole(x, t):
        return {"y": ssm.Normal(x, sd=0.5), "v": ssm.Potential(0.75 * x)}

    def first(x, a, t):
        return {"y": ssm.Normal(x, sd=0.5), "v": ssm.Potential(np.where(t == 1, np.log(a), 0.0))}

    def of(observation):
        return np.asarray(ssm.log_likelihood(
            model(observation), data(), AT, particles=300, seed=5, proposal="bootstrap"
        ))  # fmt: skip

    plain = of(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    np.testing.assert_allclose(of(each), of(whole), rtol=1e-12)
    np.testing.assert_allclose(of(first), plain + np.log(0.8), rtol=1e-12)


def test_posterior_of_parameters_and_its_groups():
    idata = ssm.sample(model(pulled), data(), draws=50, warmup=50, chains=2, seed=1, progress=False)
    assert list(idata.observed_data) == ["y"]
    assert "near" not in idata.posterior


def test_it_has_no_data_and_no_draws():
    with pytest.raises(DataError, match="'near' is a Potential, a term of the log density"):
        pose(model(pulled), data() | {"near": np.zeros(12)})
    with pytest.raises(ModelError, match="nothing is drawn from"):
        ssm.simulate(model(pulled), AT, steps=5)


@pytest.mark.parametrize("role", ["prior", "initial", "transition"])
def test_it_stands_in_the_place_of_an_observation(role):
    made = model(measured)
    getattr(made, role)({
        "prior": lambda: {"b": ssm.Potential(1.0)},
        "initial": lambda a: {"z": ssm.Potential(a)},
        "transition": lambda a: {"z": ssm.Potential(a)},
    }[role])  # fmt: skip
    with pytest.raises(ModelError, match=r"is Potential, a term of the log density") as error:
        ssm.explain(made)
    assert "return it from @observation" in str(error.value)


def test_a_record_of_potentials_alone_needs_its_rows():
    """With steps by an input: a model whose only knowledge of the states is a term."""
    made = ssm.Model("by a term", inputs=("target",))
    made.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    made.transition(lambda x: {"x": ssm.Normal(x, sd=0.1)})
    made.observation(lambda x, target: {"pull": ssm.Potential(-0.5 * (x - target) ** 2)})
    one = ssm.log_likelihood(made, {"target": np.array([1.0])}, {}, particles=200_000, seed=1)
    assert float(one[0]) == pytest.approx(-0.25 - 0.5 * np.log(2.0), abs=0.01)
