"""The verb `sample`: shapes, arguments, interrupts, several experiments; not its statistics."""

import signal
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import ssmppl as ssm

walk = ssm.Model("walk with input", inputs=("u",))


@walk.prior
def prior():
    return {"b": ssm.Normal(0, sd=1), "q": ssm.InverseGamma(3, scale=1), "p": ssm.Beta(2, 2)}


@walk.initial
def initial():
    return {"x": ssm.Normal(np.zeros(2), sd=1)}


@walk.transition
def transition(x, u, b, q):
    return {"x": ssm.Normal(0.9 * x + b * u, variance=q)}


@walk.observation
def observation(x, p):
    return {"y": ssm.Normal(x, sd=0.5), "k": ssm.Bernoulli(p)}


def simulated(steps, seed):
    rng = np.random.default_rng(seed)
    inputs = {"u": np.sin(np.arange(steps) / 3.0)}
    out = ssm.simulate(walk, {"b": 1.0, "q": 0.3, "p": 0.4}, inputs=inputs, seed=seed)
    y = out["y"].values[0].copy()
    y[rng.uniform(size=y.shape) < 0.1] = np.nan
    return {"y": y, "k": out["k"].values[0], **inputs}


DATA = simulated(40, 1)
METHODS = [ssm.PGAS(particles=10), ssm.PMMH(particles=50)]
SHORT = {"draws": 20, "warmup": 10, "chains": 2, "progress": False}


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_groups_and_shapes(method):
    idata = ssm.sample(walk, DATA, method, seed=3, **SHORT)
    posterior = idata["posterior"]
    assert posterior["b"].shape == (2, 20)
    assert posterior["x"].shape == (2, 20, 40, 2)
    assert posterior["x"].dims == ("chain", "draw", "time", "x_dim_0")
    assert idata["observed_data"]["y"].shape == (40, 2)
    assert idata["constant_data"]["u"].shape == (40,)
    assert np.all(np.isfinite(idata["sample_stats"]["lp"]))
    assert np.all(posterior["q"] > 0)
    assert np.all((posterior["p"] > 0) & (posterior["p"] < 1))
    attrs = posterior.attrs
    assert attrs["method"] == type(method).__name__
    assert attrs["seed"] == "3"
    assert attrs["interrupted"] == 0
    assert attrs["seconds"] > 0
    if isinstance(method, ssm.PMMH):
        per_step = idata["log_likelihood"]["one_step"].sum("time")
        np.testing.assert_allclose(
            per_step, idata["sample_stats"]["log_marginal_likelihood"], rtol=1e-9
        )


def test_predictive_densities_after_pgas_on_request():
    plain = ssm.sample(walk, DATA, ssm.PGAS(particles=10), seed=3, **SHORT)
    asked = ssm.sample(walk, DATA, ssm.PGAS(particles=10, log_likelihood=True), seed=3, **SHORT)
    np.testing.assert_array_equal(plain["posterior"]["q"], asked["posterior"]["q"])
    values = asked["log_likelihood"]["one_step"]
    assert values.shape == (2, 20, 40)
    at = {n: asked["posterior"][n].values[0, 0] for n in ("b", "q", "p")}
    reference = ssm.particle_filter(walk, DATA, at, particles=20_000, seed=1)
    exact = reference["log_likelihood_increment"].values[0]
    # 500 particles: each increment is right to a few hundredths; a wrong row would be off by ones
    assert np.abs(values[0, 0] - exact).mean() < 0.1


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_same_seed_same_draws_and_thinning(method):
    one = ssm.sample(walk, DATA, method, seed=5, **SHORT)["posterior"]
    two = ssm.sample(walk, DATA, method, seed=5, **SHORT)["posterior"]
    np.testing.assert_array_equal(one["q"], two["q"])
    np.testing.assert_array_equal(one["x"], two["x"])
    other = ssm.sample(walk, DATA, method, seed=6, **SHORT)["posterior"]
    assert not np.array_equal(one["q"], other["q"])


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_fixed_parameters_and_no_states(method):
    idata = ssm.sample(
        walk, DATA, method, fixed={"b": 1.0}, start={"q": 0.4}, states=False, seed=1, **SHORT
    )
    assert set(idata["posterior"].data_vars) == {"q", "p"}
    idata = ssm.sample(walk, DATA, method, fixed={"b": 1.0, "q": 0.3, "p": 0.5}, seed=1, **SHORT)
    assert set(idata["posterior"].data_vars) == {"x"}


def test_several_experiments_have_their_own_time():
    idata = ssm.sample(walk, [DATA, simulated(25, 2)], ssm.PGAS(particles=10), seed=1, **SHORT)
    x = idata["posterior"]["x"]
    assert x.shape == (2, 20, 2, 40, 2)
    assert x.dims == ("chain", "draw", "experiment", "time", "x_dim_0")
    assert np.isfinite(x.values[:, :, 1, :25]).all()
    assert np.isnan(x.values[:, :, 1, 25:]).all()
    assert x["rows"].values.tolist() == [40, 25]
    assert idata["observed_data"]["k"].dims[:2] == ("experiment", "time")


def test_a_model_without_parameters():
    model = ssm.Model("no parameters")

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(x, sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Poisson(np.exp(x))}

    for method in METHODS:
        idata = ssm.sample(model, {"y": np.arange(6)}, method, seed=1, **SHORT)
        assert idata["posterior"]["x"].shape == (2, 20, 6)


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ({"method": "pgas"}, ["'pgas'", "ssm.PGAS"]),
        ({"method": ssm.PGAS(particles=1)}, ["particles=1", "at least 2"]),
        ({"method": ssm.PGAS(proposal="guidd")}, ["guidd", "guided"]),
        ({"draws": 0}, ["draws=0"]),
        ({"chains": -1}, ["chains=-1"]),
        ({"start": {"qq": 1.0}}, ["'qq'", "q"]),
        ({"fixed": {"q": -1.0}}, ["'q'", "-1"]),
    ],
)
def test_bad_arguments(arguments, fragments):
    with pytest.raises(ssm.ArgumentError) as error:
        ssm.sample(walk, DATA, **{**SHORT, **arguments})
    for fragment in fragments:
        assert fragment in str(error.value)


def test_no_finite_start_says_so():
    model = ssm.Model("impossible")

    @model.prior
    def prior():
        return {"a": ssm.Normal(0, sd=1)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, a):
        return {"x": ssm.Normal(a * x, sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Uniform(x - 0.1, x + 0.1)}

    with pytest.raises(ssm.ArgumentError, match=r"(?s)zero at t=2, where y = 1000000.*start="):
        ssm.sample(model, {"y": np.array([0.0, 1e6, 0.0])}, **SHORT)


class InterruptAfter(ThreadPoolExecutor):
    """Ctrl-C in the main thread when the given number of blocks has been submitted."""

    def __init__(self, blocks):
        super().__init__(2)
        self.left = blocks

    def submit(self, *args, **kwargs):
        self.left -= 1
        if self.left == 0:
            signal.raise_signal(signal.SIGINT)
        return super().submit(*args, **kwargs)


def test_an_interrupt_keeps_what_was_drawn():
    with InterruptAfter(blocks=8) as executor:
        idata = ssm.sample(
            walk, DATA, METHODS[0], draws=10**7, warmup=0, chains=2, states=False,
            progress=False, executor=executor,
        )  # fmt: skip
    assert idata["posterior"].attrs["interrupted"] == 1
    assert 0 < idata["posterior"].sizes["draw"] < 10**7
