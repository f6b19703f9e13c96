"""Names of a user's that results could take for their own: statistics, axes of time, numbers."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.plots.density import prior_draws
from ssmppl.plots.parameters import parameter_draws
from ssmppl.tables import wide_table

rng = np.random.default_rng(0)
U = np.ones(12)
DATA = [{"y": rng.normal(size=n), "u": U[:n]} for n in (12, 9)]
SHORT = {"draws": 12, "warmup": 8, "chains": 2, "seed": 1, "progress": False}


def model(parameter, state="x", shape=()):
    """A linear Gaussian model with a parameter, and a state, of these names."""
    made = ssm.Model("names", inputs=("u",))
    text = f"""
def prior():
    return {{{parameter!r}: ssm.Gamma(np.full({shape!r}, 2.0), rate=2), "q": ssm.Gamma(2, rate=2)}}

def initial({parameter}):
    return {{{state!r}: ssm.Normal(np.sum({parameter}), sd=0.5)}}

def transition({state}, u, q):
    return {{{state!r}: ssm.Normal(0.9 * {state} + u, precision=q)}}

def observation({state}):
    return {{"y": ssm.Normal({state}, sd=1)}}
"""
    space = {"np": np, "ssm": ssm}
    exec(text, space)
    for role in ("prior", "initial", "transition", "observation"):
        getattr(made, role)(space[role])
    return made


# -- experiments
@pytest.mark.parametrize("parameter", ["experiment", "rows", "times"])
def test_a_parameter_called_like_a_dim_of_several_experiments_is_refused(parameter):
    """Its draws would be written over by the labels."""
    with pytest.raises(ssm.ModelError, match=f"'{parameter}' is a parameter.*several") as error:
        ssm.sample(model(parameter), DATA, ssm.MetropolisHastings(), **SHORT)
    assert f"as {parameter}_" in str(error.value)
    with pytest.raises(ssm.ModelError, match=f"'{parameter}' is a parameter.*several"):
        ssm.predict(model(parameter), None, DATA, draws=5, seed=1)
    idata = ssm.sample(model(parameter), DATA[0], ssm.MetropolisHastings(), **SHORT)
    assert idata["posterior"][parameter].dims == ("chain", "draw")


@pytest.mark.parametrize("parameter", ["x_1", "y_2", "time_1"])
def test_numbers_are_no_ones(parameter):
    posterior = ssm.sample(model(parameter), DATA, ssm.MetropolisHastings(), **SHORT)["posterior"]
    assert posterior[parameter].dims == ("chain", "draw")
    assert posterior["x"].dims == ("chain", "draw", "experiment", "time")


# -- statistics
METHODS = {
    ssm.MetropolisHastings(): ["lp", "log_marginal_likelihood", "acceptance_rate"],
    ssm.Gibbs(): ["lp"],
    ssm.PMMH(particles=20, proposal="bootstrap"): ["log_marginal_likelihood"],
    ssm.PGAS(particles=5, proposal="bootstrap"): ["update_rate", "ess"],
}


@pytest.mark.parametrize(
    ("method", "name"), [(m, n) for m, names in METHODS.items() for n in names]
)
def test_a_state_called_like_a_statistic(method, name):
    """After all sampling the statistic was taken for one by row, and nothing was returned."""
    own, plain = (ssm.sample(model("a", state), DATA[0], method, **SHORT) for state in (name, "x"))
    assert own["posterior"][name].dims == ("chain", "draw", "time")
    assert own["sample_stats"][name].dims == ("chain", "draw")
    np.testing.assert_array_equal(own["posterior"]["a"], plain["posterior"]["a"])
    np.testing.assert_array_equal(own["posterior"][name], plain["posterior"]["x"])
    np.testing.assert_array_equal(own["sample_stats"][name], plain["sample_stats"][name])


# -- axes
@pytest.mark.parametrize("data", [DATA[0], DATA], ids=["one", "two"])
@pytest.mark.parametrize("name", ["time_constants", "timeout"])
def test_a_vector_of_times_is_a_parameter(name, data):
    made = model(name, shape=(2,))
    idata = ssm.sample(made, data, ssm.MetropolisHastings(), **SHORT)
    labels = [f"{name}[0]", f"{name}[1]", "q"]
    assert list(ssm.summary(idata).index) == labels
    assert list(parameter_draws(idata, "plot")) == labels
    prior = ssm.predict(made, None, data, draws=5, seed=1)["prior"]
    assert list(prior_draws(prior)) == labels
    predicted = ssm.predict(made, idata, data, seed=1)
    assert predicted["posterior_predictive"].attrs["conditional"] == 1
    forecast = ssm.forecast(made, idata, 3, {"u": U[:3]}, seed=1,
                            experiment=2 if isinstance(data, list) else None)  # fmt: skip
    assert forecast["y"].shape == (24, 3)


# -- nothing
@pytest.mark.parametrize("method", [None, ssm.Gibbs(), ssm.SMC2(parameters=20)])
def test_nothing_to_draw_is_said_at_once(method):
    fixed = {"a": 1.0, "q": 1.0}
    states = {} if isinstance(method, ssm.SMC2) else {"states": False}
    with pytest.raises(ssm.ArgumentError, match="nothing to draw: no parameter is free"):
        ssm.sample(model("a"), DATA[0], method, fixed=fixed, **states, **SHORT)


def test_an_improper_prior_is_told_what_the_call_has():
    improper = ssm.Model("improper")

    @improper.prior
    def prior():
        return {"q": ssm.HalfFlat()}

    @improper.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @improper.transition
    def transition(x, q):
        return {"x": ssm.Normal(x, variance=q)}

    @improper.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    data = {"y": DATA[0]["y"]}
    calls = {
        "its value by fixed=": lambda: ssm.sample(improper, data, ssm.SMC2(parameters=20), **SHORT),
        "posterior draws by idata=": lambda: ssm.predict(improper, None, data, draws=5),
        "its value by parameters=": lambda: ssm.simulate(improper, steps=5),
    }
    for fix, call in calls.items():
        with pytest.raises(ssm.ArgumentError, match=f"'q' a proper prior, or {fix}"):
            call()


# -- iterates of estimates


@pytest.mark.parametrize("method", [ssm.EM(), ssm.DirectOptimization(), ssm.IF2(20, 3)])
@pytest.mark.parametrize(
    "name", ["iteration", "start", "objective", "perturbed_log_likelihood", "theta"]
)
def test_iterates_of_a_parameter_named_as_they_are(name, method):
    """The climb was lost at its end, or the parameter's iterates were those of the objective."""
    found = ssm.maximize(model(name), DATA[:1], method, seed=1, progress=False)
    values = found.iterates[name].values
    assert np.all(values > 0)
    if not isinstance(method, ssm.IF2):
        assert values[-1] == pytest.approx(found.parameters[name], rel=1e-3, abs=1e-4)
    ssm.plot_maximization(found)


def test_components_and_a_parameter_of_one_name_in_a_table():
    """The parameter had the state's values."""
    made = ssm.Model("names")
    made.prior(lambda: {"x_0": ssm.Normal(0, sd=1)})
    made.initial(lambda x_0: {"x": ssm.Normal(np.stack([x_0, x_0]), sd=1)})
    made.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    made.observation(lambda x: {"y": ssm.Normal(x[0], sd=1)})
    found = ssm.simulate(made, steps=3, seed=1)
    table = wide_table(found)
    assert list(table["x_0"]) == [float(found["x_0"].values[0])] * 3
    assert np.array_equal(table["x[0]"], found["x"].values[0, :, 0])
    assert np.array_equal(table["x_1"], found["x"].values[0, :, 1])


# -- names of proposals


def test_the_proposals_that_are_told_are_taken():
    for method, beside in ((ssm.PMMH, "twisted"), (ssm.PGAS, None)):
        with pytest.raises(ssm.ArgumentError, match="exact filter") as found:
            ssm.sample(model("p"), DATA[:1], method(proposal="kalman"), **SHORT)
        assert "kalman" not in found.value.fix
        with pytest.raises(ssm.ArgumentError, match="'foo' is not known") as found:
            ssm.sample(model("p"), DATA[:1], method(proposal="foo"), **SHORT)
        assert ("twisted" in found.value.fix) == (beside == "twisted")
        assert "kalman" not in found.value.fix
    with pytest.raises(ssm.ArgumentError, match="kalman"):
        ssm.log_likelihood(model("p"), DATA[:1], {"p": 1.0, "q": 1.0}, proposal="foo")
