"""Components as functions of a model: their source, names, priors, starts, and what is refused."""

from __future__ import annotations

import inspect
import linecache
import pickle
from typing import Any

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.language.tracing import trace

st = ssm.structural
SCALE = 0.5  # read by a function below


def declared(model: ssm.Model) -> list[str]:
    """The laws of a model, as text."""
    traced = trace(model)
    groups = (traced.parameters, traced.initial, traced.transition, traced.observations)
    return sorted(f"{n} {s.distribution!r}" for g in groups for n, s in g.items())


def run(text: str) -> ssm.Model:
    """The model of a file, which `inspect` finds."""
    names: dict[str, Any] = {}
    linecache.cache["printed.py"] = (len(text), None, text.splitlines(keepends=True), "printed.py")
    exec(compile(text, "printed.py", "exec"), names)
    return names["model"]


def airline() -> ssm.Model:
    model = ssm.Model("airline")
    st.observe(model, "y", st.trend(model), st.seasonal(model, 4))
    return model


def mixed() -> ssm.Model:
    """Components, a state of the user's own and an observation of their own."""
    model = ssm.Model("mixed", inputs=("u",))
    st.level(model)
    st.autoregression(model, 2)

    @model.prior
    def prior():
        return {"gain": ssm.Normal(0, sd=SCALE), "r": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial():
        return {"heat": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(heat, u, gain):
        return {"heat": ssm.Normal(kept(heat) + gain * u, sd=0.1)}

    @model.observation
    def observation(level, ar, heat, r):
        return {"y": ssm.Normal(level + ar[0] + heat, sd=r)}

    return model


def kept(x):
    return 0.9 * x


def parts() -> ssm.Model:
    """One of each, with starts and priors of every kind."""
    model = ssm.Model("one of each", inputs={"u": None, "w": 2})
    model.prior(shared)
    st.observe(
        model,
        "y",
        st.trend(model, damping=ssm.Beta(8, 2), level_sd=ssm.HalfNormal(sd=0.1)),
        st.level(model, sd="shared", initial=ssm.Normal(3, sd=1.5), name="second"),
        st.seasonal(model, 12),
        st.seasonal(model, 7, form="trigonometric", harmonics=2, sd=0.125, name="week"),
        st.cycle(model, (18, 60.5)),
        st.cycle(model, 9.5, damping=0.75, sd=0.25, name="short"),
        st.regression(model, "u"),
        st.regression(model, ("w",), random_walk=True, name="moving"),
        st.intervention(model, 31),
        st.intervention(model, 40, kind="ramp", effect=ssm.Normal(0, sd=1), name="ramp"),
        st.autoregression(model),
        st.autoregression(model, 6, coefficients=ssm.Normal(0, sd=0.2), name="ar6"),
        distribution="normal",
        sd=0.5,
    )
    return model


def shared():
    return {"shared": ssm.HalfNormal(sd=2.5)}


MODELS = [airline, mixed, parts]


@pytest.mark.parametrize("make", MODELS)
def test_the_source_is_the_model(make):
    model = make()
    text = st.source(model)
    assert declared(run(text)) == declared(model)
    assert max(map(len, text.splitlines())) <= 100
    assert st.source(run(text)) == text


def test_what_is_printed():
    assert "\n\n\n".join(st.source(airline()).split("\n\n\n")[1:4]) == (
        '@model.prior\ndef trend_prior():\n'
        '    return {"level_sd": ssm.HalfFlat(), "slope_sd": ssm.HalfFlat()}\n\n\n'
        '@model.initial\ndef trend_initial():\n'
        '    return {"level": ssm.Flat(), "slope": ssm.Flat()}\n\n\n'
        '@model.transition\ndef trend_transition(level, slope, level_sd, slope_sd):\n'
        '    return {\n'
        '        "level": ssm.Normal(level + slope, sd=level_sd),\n'
        '        "slope": ssm.Normal(slope, sd=slope_sd),\n'
        '    }'
    )  # fmt: skip


def test_what_no_file_can_hold_is_refused():
    model, held = ssm.Model("refused"), object()
    st.level(model)

    @model.observation
    def observation(level):
        return {"y": ssm.Normal(level, sd=1 if held else 2)}

    with pytest.raises(ArgumentError, match="reads 'held' from outside, which is object"):
        st.source(model)


@pytest.mark.parametrize("make", [airline, parts])
def test_models_travel(make):
    model = make()
    there = pickle.loads(pickle.dumps(model))
    assert declared(there) == declared(model)
    assert list(there.components) == list(model.components)


def test_functions_have_their_source():
    model = airline()
    for functions in model.functions.values():
        for function in functions:
            assert f"def {function.__name__}(" in inspect.getsource(function)
    text = str(ssm.explain(model))
    assert "the initial distribution of 'level' is Flat" in text
    assert "<trend 'trend' of airline" in text


def test_every_scale_has_a_closed_form():
    found = {u.block: u.family_name for u in derive_updates(trace(airline()))}
    assert set(found.values()) == {"inverse Gamma of the square"}


def test_names_and_values():
    model = ssm.Model("names", inputs=("u",))
    trend = st.trend(model, name="north")
    assert trend.states == ("north_level", "north_slope")
    assert trend.parameters == ("north_level_sd", "north_slope_sd")
    season = st.seasonal(model, 4, form="trigonometric", name="q")
    assert (season.value, season.arguments) == ("sum(q[::2])", ("q",))
    step = st.intervention(model, 5, name="strike")
    assert step.arguments == ("strike", "t")
    assert list(model.components) == ["north", "q", "strike"]
    st.observe(model, "y", "north", season)  # by name, too
    assert list(trace(model).observations) == ["y"]


@pytest.mark.parametrize(
    ("distribution", "law"),
    [("student_t", "StudentT"), ("poisson", "Poisson"), ("bernoulli", "Bernoulli"),
     ("negative_binomial", "NegativeBinomial")],
)  # fmt: skip
def test_other_observations(distribution: str, law: str):
    model = ssm.Model("counts")
    start = ssm.Normal(0, sd=1)
    level, season = st.level(model, initial=start), st.seasonal(model, 3, initial=start)
    st.observe(model, "y", level, season, distribution=distribution)
    site = trace(model).observations["y"]
    assert type(site.distribution).__name__ == law
    theta = dict.fromkeys(trace(model).parameters, 2.0)
    drawn = ssm.simulate(model, theta, steps=5, draws=3, seed=1)
    assert np.all(np.isfinite(drawn["y"]))


def bad_model() -> ssm.Model:
    return ssm.Model("m", inputs=("u",))


BAD = {
    "a second of one name": (lambda m: (st.level(m), st.level(m)), "already", 'name="level_2"'),
    "a state of two": (lambda m: (st.level(m), st.trend(m)), "gives 'level', as 'level'", "name="),
    "no model": (lambda m: st.level("m"), "is str, not a model", "ssm.Model"),
    "name": (lambda m: st.level(m, name="a level"), "name='a level'", "letters"),
    "sd of any sign": (
        lambda m: st.level(m, sd=ssm.Normal(0, sd=1)), "sd=Normal", "ssm.HalfNormal"
    ),
    "sd of a vector": (
        lambda m: st.level(m, sd=ssm.HalfNormal(sd=np.ones(2))), "sd=HalfNormal", "positive number"
    ),
    "another argument": (lambda m: st.level(m, sigma=1), "no argument 'sigma'", "sd"),
    "negative": (lambda m: st.level(m, sd=-1), "sd=-1", "not negative"),
    "sd": (lambda m: st.level(m, sd=[1, 2]), "sd=[1, 2]", "a distribution as its prior"),
    "sd of symbols": (
        lambda m: st.level(m, sd=ssm.Truncated(ssm.Normal(0, sd=1), lower=0.0)),
        "no plain distribution", 'sd="my_parameter"',
    ),
    "initial": (lambda m: st.level(m, initial="high"), "initial='high'", "ssm.Normal"),
    "initial of a vector": (
        lambda m: st.seasonal(m, 4, initial=ssm.StudentT(3, 0, scale=1)), "initial=",
        "one Normal",
    ),
    "period": (lambda m: st.seasonal(m, 1), "period=1", "at least 2"),
    "period of 4.5": (lambda m: st.seasonal(m, 4.5), "period=4.5", "whole number"),
    "form": (lambda m: st.seasonal(m, 4, form="fourier"), "form='fourier'", "'trigonometric'"),
    "harmonics": (
        lambda m: st.seasonal(m, 4, form="trigonometric", harmonics=3), "harmonics=3", "at most 2"
    ),
    "harmonics of dummies": (lambda m: st.seasonal(m, 4, harmonics=1), "harmonics=1", "form="),
    "bounds": (lambda m: st.cycle(m, (60, 18)), "period=(60, 18)", "bounds"),
    "damping": (lambda m: st.cycle(m, 9, damping=1.5), "damping=1.5", "at most 1"),
    "input": (lambda m: st.regression(m, "v"), "no input 'v'; it has u", 'inputs=('),
    "sd without random walk": (lambda m: st.regression(m, "u", sd=1), "sd=1", "random_walk=True"),
    "kind": (lambda m: st.intervention(m, 3, kind="jump"), "kind='jump'", "'step'"),
    "row": (lambda m: st.intervention(m, 0), "row=0", "counted from 1"),
    "order": (lambda m: st.autoregression(m, 0), "order=0", "from 1 on"),
    "coefficients": (
        lambda m: st.autoregression(m, 2, coefficients=[1]), "coefficients=[1]", "2 numbers"
    ),
    "distribution": (
        lambda m: st.observe(m, "y", st.level(m), distribution="gamma"), "'gamma'", "'poisson'"
    ),
    "diffuse counts": (
        lambda m: st.observe(m, "y", st.level(m), distribution="poisson"), "starts diffuse",
        "initial=ssm.Normal",
    ),
    "no component": (lambda m: st.observe(m, "y"), "no component", "components are: none"),
    "an unknown component": (lambda m: st.observe(m, "y", "trend"), "'trend' is no", "none"),
    "of another model": (
        lambda m: st.observe(m, "y", st.level(ssm.Model("n"))), "no component of the model 'm'",
        "none",
    ),
    "twice": (lambda m: st.observe(m, "y", st.level(m), "level"), "given twice", "once"),
    "no noise": (lambda m: st.observe(m, "y", st.level(m), sd=0), "sd=0", "positive"),
    "not of it": (lambda m: st.observe(m, "y", st.level(m), df=3), "df=3", "leave it out"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_refused(name: str):
    bad, found, fix = BAD[name]
    with pytest.raises(ArgumentError) as caught:
        bad(bad_model())
    assert found in caught.value.found
    assert fix in caught.value.fix
    if name != "another argument":
        assert caught.value.where.file == __file__


def test_a_parameter_that_is_not_there():
    model = ssm.Model("m")
    st.observe(model, "y", st.level(model, sd="sigma"))
    with pytest.raises(ModelError, match="sigma"):
        trace(model)


def test_what_its_own_functions_declare_twice():
    model = ssm.Model("m")
    st.level(model)
    model.initial(lambda: {"level": ssm.Normal(0, sd=1)})
    with pytest.raises(ModelError, match="'level' is given by two @initial functions"):
        trace(model)


PRIORS = [
    ssm.HalfNormal(sd=0.1), ssm.HalfCauchy(scale=2), ssm.Gamma(2, rate=0.5), ssm.Gamma(2, scale=4),
    ssm.InverseGamma(3, scale=0.125), ssm.Exponential(rate=3), ssm.LogNormal(-1, sd=0.5),
    ssm.Weibull(1.5, scale=2), ssm.Uniform(0, 1e-7), ssm.HalfFlat(), ssm.Beta(2, 3),
    ssm.StudentT(4, 0, scale=1), ssm.Cauchy(0, scale=1), ssm.Laplace(0, scale=1),
    ssm.Normal(0, variance=2), ssm.Normal(1 / 3, precision=7),
]  # fmt: skip


@pytest.mark.parametrize("law", PRIORS, ids=repr)
def test_priors_are_written_as_they_are(law):
    model = ssm.Model("m")
    st.observe(model, "y", st.level(model, initial=1), st.intervention(model, 3, effect=law))
    found = trace(model).parameters["step_3"].distribution
    assert repr(found) == repr(law)
    for name, values in law.parameters.items():
        assert found.parameters[name].ravel()[0] is values.ravel()[0]
