"""Maxima at an edge of the support: the other parameters' errors are those of the smaller model."""

from __future__ import annotations

import numpy as np
import pytest

import ssmppl as ssm


def trend(slope: str | None) -> ssm.Model:
    """A local linear trend; the slope's noise by this name of its spread, None: without noise."""
    model = ssm.Model("local linear trend")
    own = {} if slope is None else {"s": ssm.HalfFlat()}
    model.prior(lambda: {"q": ssm.HalfFlat(), **own, "r": ssm.HalfFlat()})
    model.initial(lambda: {"x": ssm.Normal(0, sd=10.0), "v": ssm.Normal(0, sd=1.0)})
    if slope is None:
        model.transition(lambda x, v, q: {"x": ssm.Normal(x + v, variance=q), "v": ssm.Dirac(v)})
    else:
        model.transition(
            lambda x, v, q, s: {
                "x": ssm.Normal(x + v, variance=q), "v": ssm.Normal(v, **{slope: s})
            }
        )  # fmt: skip
    model.observation(lambda x, r: {"y": ssm.Normal(x, variance=r)})
    return model


def steady(seed: int = 1, rows: int = 200) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(0.1 + 0.5 * rng.standard_normal(rows)) + rng.standard_normal(rows)


@pytest.mark.parametrize(("slope", "edge"), [("variance", 0.0), ("sd", 0.0), ("precision", np.inf)])
def test_a_variance_at_zero_leaves_the_others_their_errors(slope: str, edge: float):
    data = {"y": steady()}
    found = ssm.maximize(trend(slope), data, seed=1, progress=False)
    smaller = ssm.maximize(trend(None), data, seed=1, progress=False)
    assert found.attrs["converged"]
    assert found.attrs["held_at_edge"] == {"s": edge}
    assert found.log_likelihood == pytest.approx(smaller.log_likelihood, abs=1e-5)
    assert np.isnan(found.standard_errors["s"])
    assert np.all(np.isnan(found.covariance.loc["s"]))
    names = ["q", "r"]
    assert found.covariance.loc[names, names].to_numpy() == pytest.approx(
        smaller.covariance.loc[names, names].to_numpy(), rel=1e-4
    )
    (note,) = found.notes
    assert note.startswith(f"the maximum in s is at {edge:g}, the boundary of its parameter space")


@pytest.mark.parametrize("start", [1e-60, 1e-200, 3e-296, 1e-310])
def test_a_variance_that_all_digits_have_left_is_at_zero(start: float):
    """Also where nothing changes over many powers of ten: it was "at inf", or at no edge, and the
    others had no errors."""
    data = {"y": steady()}
    found = ssm.maximize(trend("variance"), data, seed=1, progress=False, start={"s": start})
    smaller = ssm.maximize(trend(None), data, seed=1, progress=False)
    assert found.attrs["converged"]
    assert found.attrs["held_at_edge"] == {"s": 0.0}
    for name in ("q", "r"):
        assert found.standard_errors[name] == pytest.approx(smaller.standard_errors[name], rel=1e-3)


def test_em_on_its_way_to_the_edge_has_the_errors_too():
    data = {"y": steady()}
    found = ssm.maximize(trend("variance"), data, ssm.EM(iterations=300), seed=1, progress=False)
    smaller = ssm.maximize(trend(None), data, seed=1, progress=False)
    assert found.attrs["held_at_edge"] == {"s": 0.0}
    for name in ("q", "r"):
        assert found.standard_errors[name] == pytest.approx(smaller.standard_errors[name], rel=0.02)


def test_a_posterior_mode_at_the_edge():
    """A half-normal prior of the variance has its mode at zero; those of the others count."""

    def model(slope: bool) -> ssm.Model:
        out = trend("variance" if slope else None)
        out.functions["prior"].clear()
        own = {"s": ssm.HalfNormal(sd=0.1)} if slope else {}
        out.prior(lambda: {"q": ssm.HalfNormal(sd=0.05), **own, "r": ssm.HalfFlat()})
        return out

    data = {"y": steady()}
    settings = {"seed": 1, "progress": False, "objective": "posterior"}
    found, smaller = (ssm.maximize(model(slope), data, **settings) for slope in (True, False))
    assert found.attrs["held_at_edge"] == {"s": 0.0}
    for name in ("q", "r"):
        assert found.standard_errors[name] == pytest.approx(smaller.standard_errors[name], rel=1e-4)


def test_what_is_not_identified_is_at_no_edge():
    model = trend("variance")
    model.prior(lambda: {"idle": ssm.HalfFlat()})
    model.initial(lambda idle: {"unseen": ssm.Normal(idle, sd=1)})
    model.transition(lambda unseen: {"unseen": ssm.Normal(unseen, sd=1)})
    found = ssm.maximize(model, {"y": steady()}, seed=1, progress=False)
    assert list(found.attrs["held_at_edge"]) == ["s"]
    assert np.isnan(found.standard_errors["q"])
    assert any("not identified" in note for note in found.notes)


def test_an_interior_maximum_is_at_no_edge():
    rng = np.random.default_rng(3)
    y = np.cumsum(np.cumsum(0.3 * rng.standard_normal(200)) + rng.standard_normal(200))
    data = {"y": y + rng.standard_normal(200)}
    found = ssm.maximize(trend("variance"), data, seed=1, progress=False)
    assert "held_at_edge" not in found.attrs
    assert not found.covariance.isna().any(axis=None)


def switching(sticky: bool) -> ssm.Model:
    """Three states, the first two never follow each other in the data of `switched`."""
    model = ssm.Model("switching")
    if sticky:
        model.prior(lambda: {
            "p": ssm.Dirichlet(np.ones((3, 3))), "m": ssm.Normal(np.zeros(3), sd=100.0)
        })  # fmt: skip
    else:
        model.prior(lambda: {
            "a": ssm.Uniform(0, 1), "b": ssm.Uniform(0, 1), "c": ssm.Dirichlet(np.ones(3)),
            "m": ssm.Normal(np.zeros(3), sd=100.0),
        })  # fmt: skip
    model.initial(lambda: {"k": ssm.Categorical(np.ones(3) / 3)})
    if sticky:
        model.transition(lambda k, p: {"k": ssm.Categorical(p[k])})
    else:
        model.transition(lambda k, a, b, c: {"k": ssm.Categorical(
            np.stack([np.stack([a, 0.0, 1.0 - a]), np.stack([0.0, b, 1.0 - b]), c])[k]
        )})  # fmt: skip
    model.observation(lambda k, m: {"y": ssm.Normal(m[k], sd=1.0)})
    return model


def switched(rows: int = 300) -> np.ndarray:
    rng = np.random.default_rng(5)
    p = np.array([[0.8, 0.0, 0.2], [0.0, 0.7, 0.3], [0.2, 0.2, 0.6]])
    k = np.zeros(rows, dtype=int)
    for t in range(1, rows):
        k[t] = rng.choice(3, p=p[k[t - 1]])
    return np.array([-8.0, 0.0, 8.0])[k] + rng.standard_normal(rows)


@pytest.mark.slow
@pytest.mark.parametrize("method", [None, ssm.EM()])
def test_shares_at_zero(method):
    data = {"y": switched()}
    means = np.array([-8.0, 0.0, 8.0])
    settings = {"seed": 1, "progress": False}
    start = {"m": means, "p": np.full((3, 3), 1 / 3)}
    found = ssm.maximize(switching(True), data, method, start=start, **settings)
    start = {"m": means, "a": 0.5, "b": 0.5, "c": np.full(3, 1 / 3)}
    smaller = ssm.maximize(switching(False), data, start=start, **settings)
    assert found.attrs["held_at_edge"] == {"p[0, 1]": 0.0, "p[1, 0]": 0.0}
    assert found.log_likelihood == pytest.approx(smaller.log_likelihood, abs=1e-3)
    errors, own = found.standard_errors["p"], smaller.standard_errors
    expected = np.array([[own["a"], np.nan, own["a"]], [np.nan, own["b"], own["b"]], own["c"]])
    assert errors == pytest.approx(expected, rel=0.01, nan_ok=True)
    assert found.standard_errors["m"] == pytest.approx(own["m"], rel=1e-3)


@pytest.mark.parametrize(("k", "seen"), [(2, 0), (2, 1), (3, 0), (3, 1), (3, 2)])
def test_a_share_of_all(k: int, seen: int):
    """What was seen only ever: neither it nor the rest has a standard error, not even one of 0."""
    model = ssm.Model("shares")
    model.prior(lambda: {"p": ssm.Dirichlet(np.ones(k)), "m": ssm.Normal(0, sd=5)})
    model.initial(lambda: {"s": ssm.Bernoulli(0.5)})
    model.transition(lambda s: {"s": ssm.Bernoulli(0.5)})
    model.observation(lambda s, p, m: {"c": ssm.Categorical(p), "y": ssm.Normal(m * s, sd=1)})
    rng = np.random.default_rng(2)
    data = {"y": rng.standard_normal(20) + 4.0 * rng.integers(0, 2, 20), "c": np.full(20, seen)}
    found = ssm.maximize(model, data, seed=1, progress=False)
    assert found.attrs["held_at_edge"] == {f"p[{i}]": float(i == seen) for i in range(k)}
    assert np.isnan(found.standard_errors["p"]).all()
    held = {"p": np.full(k, 1 / k)}
    alone = ssm.maximize(model, data, fixed=held, seed=1, progress=False)
    assert found.standard_errors["m"] == pytest.approx(alone.standard_errors["m"], rel=1e-3)


def test_what_grows_without_bound_beside_an_edge_is_not_taken_for_certain():
    model = ssm.Model("logit")
    model.prior(lambda: {"s": ssm.HalfFlat(), "r": ssm.HalfFlat(), "a": ssm.Normal(0, sd=3)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {"x": ssm.Normal(0.5 * x, sd=s)})
    model.observation(lambda x, r, a: {
        "y": ssm.Normal(x, sd=r), "z": ssm.Normal(1 / (1 + np.exp(-a)), sd=0.1)
    })  # fmt: skip
    rng = np.random.default_rng(0)
    y = rng.standard_normal(30)
    data = {"y": y - 0.6 * np.r_[0.0, y[:-1]], "z": 1.5 + 0.1 * rng.standard_normal(30)}
    found = ssm.maximize(model, data, seed=1, progress=False)
    assert list(found.attrs["held_at_edge"]) == ["s"]
    assert not found.standard_errors["a"] < 1e3


# -- data that a model follows exactly
def level(prior: type) -> ssm.Model:
    model = ssm.Model("level")
    law = prior() if prior is ssm.HalfFlat else prior(2.0, scale=1.0)
    model.prior(lambda: {"q": law, "r": law})
    model.initial(lambda: {"x": ssm.Flat()})
    model.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, variance=r)})
    return model


CONSTANT = {"y": np.full(20, 3.0)}


def test_the_likelihood_of_constant_data():
    """Differences of zero: (T-1) of them, with covariance q I + r D D' (D of differences)."""
    q, r, n = 0.7, 0.2, 19
    d = np.diff(np.eye(n + 1), axis=0)
    covariance = q * np.eye(n) + r * d @ d.T
    expected = -0.5 * (n * np.log(2.0 * np.pi) + np.linalg.slogdet(covariance)[1])
    found = ssm.log_likelihood(level(ssm.HalfFlat), CONSTANT, {"q": q, "r": r})
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("value", [3.0, 0.0])
@pytest.mark.parametrize("method", [None, ssm.EM(iterations=500)])
def test_constant_data_have_no_maximum_and_are_blamed(method, value: float):
    if method is not None and value == 0.0:
        pytest.skip("EM has its own rate, and 500 steps do not take it to 1e-100")
    data = {"y": np.full(20, value)}
    found = ssm.maximize(level(ssm.HalfFlat), data, method, seed=1, progress=False)
    assert not found.attrs["converged"]
    assert np.isnan(found.standard_errors["q"])
    (note,) = found.notes
    assert f"no maximum: the data of y are constant ({value:g} in every row)" in note
    assert "without bound as the variances of the noises go to zero" in note


def test_constant_data_with_one_variance_held():
    """With q = 1 there is a maximum, at r = 0: 19 differences of zero, each N(0, 1)."""
    found = ssm.maximize(
        level(ssm.HalfFlat), CONSTANT, fixed={"q": 1.0}, seed=1, progress=False
    )  # fmt: skip
    assert found.attrs["held_at_edge"] == {"r": 0.0}
    assert found.attrs["converged"]
    assert found.log_likelihood == pytest.approx(-9.5 * np.log(2.0 * np.pi), rel=1e-6)
    assert len(found.notes) == 1


def test_a_ramp_is_followed_exactly():
    """A level that moves in steps of one: no constant, and no bound either."""
    model = trend("variance")
    data = {"y": np.arange(20.0)}
    found = ssm.maximize(model, data, seed=1, progress=False)
    assert not found.attrs["converged"]
    assert "the data of y are fitted exactly" in found.notes[0]


def test_sampling_constant_data():
    settings = {"seed": 1, "progress": False, "draws": 50, "warmup": 50, "chains": 2}
    for method in (None, ssm.MetropolisHastings()):
        with pytest.raises(ssm.SamplingError, match="the data of y are constant"):
            ssm.sample(level(ssm.HalfFlat), CONSTANT, method, **settings)
    idata = ssm.sample(level(ssm.InverseGamma), CONSTANT, **settings)
    assert np.all(idata.posterior["r"].to_numpy() > 0.01)


def test_constant_data_of_states_without_noise():
    """Beside counts, which are certain at the end of their support, and not without a bound."""
    model = ssm.Model("steady", inputs=("u",))
    model.prior(lambda: {"s": ssm.HalfNormal(sd=1), "p": ssm.Uniform(0, 1)})
    model.initial(lambda: {"x": ssm.Dirac(1.0)})
    model.transition(lambda x, u: {"x": ssm.Dirac(x**2 + u)})
    model.observation(lambda x, s, p, u: {
        "y": ssm.Normal(x + u, sd=s), "c": ssm.Bernoulli(p)
    })  # fmt: skip
    data = {"u": np.zeros(20), "c": np.ones(20), "y": np.ones(20)}
    settings = {"seed": 1, "progress": False}
    found = ssm.maximize(model, data, **settings)
    assert not found.attrs["converged"]
    assert "no maximum: the data of y are constant (1 in every row)" in found.notes[0]
    with pytest.raises(ssm.SamplingError, match="the data of y are constant"):
        ssm.sample(model, data, draws=50, warmup=50, chains=2, **settings)
    data["y"] = data["y"] + 0.1 * np.random.default_rng(1).standard_normal(20)
    found = ssm.maximize(model, data, **settings)
    assert found.attrs["converged"]
    assert found.attrs["held_at_edge"] == {"p": 1.0}
    assert found.parameters["s"] == pytest.approx(
        np.sqrt(np.mean((data["y"] - 1.0) ** 2)), rel=1e-5
    )


@pytest.mark.parametrize("power", [1.0, 2.0])
@pytest.mark.parametrize("method", [ssm.DirectOptimization(), ssm.EM()])
def test_an_edge_that_another_parameter_moves(power, method):
    """What the data tell of the bound, by way of the parameter that lies on it, was left out."""
    model = ssm.Model("bounded")
    model.prior(lambda: {"b": ssm.Gamma(3, rate=2)})
    model.prior(lambda b: {"r": ssm.Uniform(0, b**power)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=0.5)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    data = {"y": ssm.simulate(model, parameters={"b": 1.0, "r": 1.0}, steps=60, seed=3)["y"][0]}
    found = ssm.maximize(model, data, method, objective="posterior", seed=1, progress=False)
    assert set(found.attrs["held_at_edge"]) == {"r"}

    def density(b):  # of b where r = b**power; the density of r is one over that
        return ssm.log_likelihood(model, data, {"b": b, "r": b**power}) + np.log(
            b ** (2.0 - power)
        ) - 2.0 * b  # fmt: skip

    b, h = found.parameters["b"], 1e-3
    slope = (density(b + h) - density(b - h)) / (2 * h)
    information = -(density(b + h) - 2 * density(b) + density(b - h)) / h**2
    assert abs(slope) < 1e-3 * information
    assert found.standard_errors["b"] == pytest.approx(information**-0.5, rel=1e-3)


@pytest.mark.parametrize("scale", [1e4, 1e8])
def test_a_flat_stretch_on_the_way_is_no_edge(scale):
    """From r = 1 the likelihood of data of 1e8 is flat in r: it was said to be at 0."""
    model = ssm.Model("local level")
    model.prior(lambda: {"q": ssm.HalfFlat(), "r": ssm.HalfFlat(), "m": ssm.Flat()})
    model.initial(lambda m, q: {"x": ssm.Normal(m, sd=q)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, sd=q)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    rng = np.random.default_rng(0)
    y = np.cumsum(rng.normal(size=40)) + rng.normal(size=40)
    plain = ssm.maximize(model, {"y": y}, seed=1, progress=False)
    found = ssm.maximize(model, {"y": scale * y}, seed=1, progress=False)
    assert found.attrs["converged"]
    assert "held_at_edge" not in found.attrs
    for name in ("q", "r", "m"):
        assert found.parameters[name] / scale == pytest.approx(plain.parameters[name], rel=1e-5)
        assert found.standard_errors[name] / scale == pytest.approx(
            plain.standard_errors[name], rel=1e-3
        )
