"""Effects: how they are declared, which of them a model is offered, and with what numbers."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.effects.catalogue import effects
from ssmppl.diagnosis.effects.effect import Auxiliary, effect, sds
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.changed_laws import has_scale
from ssmppl.diagnosis.model.equations import Equations, time_symbol
from ssmppl.diagnosis.model.scales import Scales, VariableScale
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol, symbols_of
from ssmppl.language.tracing import trace
from tests.diagnosis.harness import EVERY, offered, scales, traced

# gap.md's catalogue, item by item, and what was added to it.
ITEMS = """coulomb friction, stribeck, asymmetric friction, load-dependent friction, quadratic drag,
    cubic stiffness, quadratic stiffness, state-dependent damping, hard stop, cross-coupling,
    extra loss, constant load, gravity, bouc-wen hysteresis, input saturation, dead zone,
    input asymmetry, backlash, input delay, actuator lag, missing input, periodic forcing,
    parameter drift, parameter break, parameter random walk, sensor bias, sensor drift,
    sensor gain nonlinearity, sensor clipping, sensor rectification, sensor lag, sensor delay,
    quantisation, outliers, heteroscedastic noise, coloured noise, wrong initial state,
    coarse discretisation, level break"""


def in_equations(where, name, item):
    return {c.equation for c in offered(where, name)[0] if c.effect.name == item}


# -- the catalogue
def test_names_are_those_of_the_method():
    assert set(effects.names()) == {" ".join(n.split()) for n in ITEMS.split(",")}
    assert len({(e.name, e.form, e.kind, e.on) for e in effects}) == len(effects)
    for e in effects:
        assert e in effects.get(e.name)
        assert e.note
        assert e.name in repr(effects)
    with pytest.raises(ArgumentError, match=r"(?s)no effect called 'coulomb'.*coulomb friction"):
        effects.get("coulomb")


@pytest.mark.parametrize("name", ["local_level", "epidemic"])
def test_weights_are_the_functions_of_time(name):
    """Against the slopes of the laws' means in the strength, row by row."""
    t, rows = traced("gap", name), np.arange(1.0, 301.0)
    profiled = [c for c in offered("gap", name)[0] if c.effect.profile and c.kind != "parameter"]
    assert {c.change for c in profiled} == {"transition", "observation"}
    for c in profiled:
        role = {"transition": "transition", "observation": "observations"}[c.change]
        base, law = (getattr(m, role)[c.equation].distribution for m in (t, augment(t, [c])))
        strength = symbol("parameter", c.strength)
        slope = differentiate([law.mean()[()]], strength)[0]
        at = dict.fromkeys(symbols_of([slope, base.mean()[()]]), 0.7) | {strength: 0.0}
        at[time_symbol(c.change)] = rows - 1.0 if c.change == "transition" else rows
        size = evaluate(base.mean()[()], at) if c.equation == "cases" else 1.0  # on the log scale
        np.testing.assert_allclose(evaluate(slope, at), c.weights(300) * size, rtol=1e-9, atol=1e-9)


def test_what_users_need_stands_beside_the_catalogue():
    assert effects.Auxiliary is Auxiliary
    assert effects.sds(0.5, of="x") == sds(0.5, of="x")
    assert len(list(effects)) == len(effects)


def test_effects_and_candidates_cross_process_borders():
    for e in effects:
        assert pickle.loads(pickle.dumps(e)) is e
    renamed = pickle.loads(pickle.dumps(replace(effects.get("gravity")[0], name="pull")))
    assert (renamed.name, renamed.function) == ("pull", effects.get("gravity")[0].function)
    for c in offered("gap", "oscillator")[0]:
        assert pickle.loads(pickle.dumps(c)) == c
        assert pickle.loads(pickle.dumps(c.increment)) == c.increment


# -- declaring
def test_a_declared_effect_keeps_what_was_said():
    @effect(on="rate", name="odd drag", lower=0, shapes={"d": sds(0.5, 1.0)}, form="smooth")
    def drag(v, strength, d):
        """-l v"""
        return -strength * v / d

    assert (drag.name, drag.kind, drag.lower, drag.upper) == ("odd drag", "transition", 0, np.inf)
    assert drag.where.function == "drag"
    assert drag(2.0, 1.0, 4.0) == -0.5

    @effect
    def linear_drag(v, strength):
        return -strength * v

    assert (linear_drag.name, linear_drag.on) == ("linear drag", "any")


def plain(v, strength):
    return -strength * v


@pytest.mark.parametrize(
    ("options", "function", "message"),
    [
        ({"kind": "transiton"}, plain, "kind is 'transiton'.*\n.*transition"),
        ({}, lambda v: v, "no argument `strength`"),
        ({"lower": 0, "upper": 1, "afresh": 2.0}, lambda v, strength: v, "between 0 and 1"),
        ({}, lambda strength, v: v, "first argument is `strength`"),
        ({}, lambda v, strength, *args: v, r"takes \*arguments"),
        ({"lower": 1}, plain, "between 1 and inf"),
        ({"lower": -1}, plain, "one bound -1"),
        ({"shapes": {"v0": (1,)}}, plain, "shapes names 'v0'"),
        ({"shapes": {"d": ()}}, lambda v, strength, d: v, r"values \(\)"),
        ({"given": {"u": "an input"}}, lambda v, u, strength: v, "'u' is 'an input'"),
        ({"states": ("w",)}, lambda v, w, strength: v, "kind is 'transition' and its auxiliary"),
        ({"kind": "state", "on": "rate"}, plain, r"auxiliary states are \[\]"),
        ({"profile": "ramp", "given": {"w": "profile"}}, lambda v, w, strength: v, "ramp"),
        ({"profile": "step", "given": {"w": "profile"}}, lambda v, w, strength: v, "date"),
        ({"on": ""}, plain, "on is ''"),
        ({"requires": "luck"}, plain, "requires 'luck'"),
    ],
)
def test_faults_of_a_declaration_are_named_with_their_place(options, function, message):
    with pytest.raises(ModelError, match=f"(?s){message}") as caught:
        effect(**options)(function)
    assert caught.value.where.file == __file__
    assert caught.value.fix


def with_function(function, **options):
    return offers(traced("gap", "oscillator"), scales(traced("gap", "oscillator")),
                  {"mine": effect(**{"on": "v", **options})(function)})  # fmt: skip


@pytest.mark.parametrize(
    ("function", "options", "message"),
    [
        (lambda v, strength: v, {}, "at strength 0 it gives v_prev"),
        (lambda v, strength: 1.0, {}, "at strength 0 it gives 1"),
        (lambda v, strength: np.maximum(v - 18, 0) + strength, {}, "at strength 0 it gives max"),
        (lambda u, strength: 2.0 * u, {"kind": "input", "on": "u"}, "at strength 0 it gives 2"),
        (lambda v, strength, lenght: 0.0, {}, "asks for 'lenght'"),
        (lambda v, strength: np.stack([v, v]), {}, "it returned"),
        (lambda v, strength: {"w": strength}, {}, "increment for 'w'"),
        (lambda v, strength: v.missing, {}, "missing"),
        (lambda v, w, strength: w, {"kind": "state", "states": ("w",)}, "Auxiliary"),
        (lambda v, w, strength: Auxiliary(0.0, {}, {}), {"kind": "state", "states": ("w",)},
         "transition distributions are"),
    ],
)  # fmt: skip
def test_faults_of_a_function_are_named_with_their_place(function, options, message):
    with pytest.raises(ModelError, match=f"(?s){message}") as caught:
        with_function(function, **options)
    assert caught.value.where.file == __file__


def test_an_auxiliary_state_starts_from_what_an_initial_law_may_know():
    def lagged(v, w, strength):
        law = ssm.Dirac(0.5 * (w + v))
        return Auxiliary(strength * w, {"w": law}, {"w": ssm.Dirac(v)})

    (c,), _ = with_function(lagged, kind="state", states=("w",))
    with pytest.raises(ModelError, match="initial distribution of 'w_v' depends on 'v'"):
        augment(traced("gap", "oscillator"), [c])


# -- who is offered what
def test_friction_is_for_what_is_no_integral():
    assert in_equations("gap", "oscillator", "coulomb friction") == {"v"}
    assert in_equations("gap", "noisy_oscillator", "quadratic drag") == {"v"}
    assert in_equations("gap", "pendulum", "coulomb friction") == {"speed"}
    assert in_equations("gap", "two_tanks", "quadratic drag") == {"h1", "h2"}
    assert in_equations("gap", "simulator", "coulomb friction") == {"v"}
    assert in_equations("gap", "vector", "stribeck") == {"x[0]", "x[1]"}
    assert in_equations("gap", "ar1", "quadratic drag") == {"x"}
    refused = offered("gap", "oscillator")[1]
    assert "coulomb friction in x: its transition is only the integral of v" in map(str, refused)


def two_states(step):
    """A model of x and v, deterministic, with the given means."""
    model = ssm.Model("pair", inputs=("u", "dt"))

    @model.prior
    def prior():
        return {"k": ssm.HalfNormal(sd=1), "c": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial():
        return {"x": ssm.Dirac(0.0), "v": ssm.Dirac(1.0)}

    @model.transition
    def transition(x, v, u, dt, k, c):
        new_x, new_v = step(x, v, u, dt, k, c)
        return {"x": ssm.Dirac(new_x), "v": ssm.Dirac(new_v)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    t = trace(model)
    return Equations(t)


def pull(x, v, u, dt, k, c):
    return v + dt * (u - k * x - c * v)


@pytest.mark.parametrize(
    ("step", "integral_of", "copies"),
    [
        (lambda x, v, u, dt, k, c: (x + dt * v, pull(x, v, u, dt, k, c)), {"x": "v"}, {}),
        (lambda x, v, u, dt, k, c: (x + dt * pull(x, v, u, dt, k, c), pull(x, v, u, dt, k, c)),
         {"x": "v"}, {}),
        (lambda x, v, u, dt, k, c: (x + dt / 2 * (v + pull(x, v, u, dt, k, c)),
                                    pull(x, v, u, dt, k, c)), {"x": "v"}, {}),
        (lambda x, v, u, dt, k, c: (x + 0.1 * v, v - 0.1 * k * x), {"x": "v"}, {}),
        (lambda x, v, u, dt, k, c: (x + k * v, 0.9 * v), {}, {}),
        (lambda x, v, u, dt, k, c: (x + 0.1 * v - c * x, v - k * x), {}, {}),
        (lambda x, v, u, dt, k, c: (k * x + c * v, x), {}, {"v": "x"}),
        (lambda x, v, u, dt, k, c: (k * x + v, u), {}, {"v": "u"}),
        (lambda x, v, u, dt, k, c: (x, v), {}, {}),
    ],
)  # fmt: skip
def test_integrals_are_found_however_the_step_is_written(step, integral_of, copies):
    found = two_states(step)
    assert (found.integral_of, found.copies) == (integral_of, copies)


def test_without_inputs_their_effects_are_refused_with_the_reason():
    found, refused = offered("gap", "ar1")
    assert not [c for c in found if c.change == "input"]
    assert {r.effect for r in refused if r.reason == "the model has no input"} >= {
        "input saturation", "dead zone", "backlash", "input delay", "actuator lag"
    }  # fmt: skip


def test_what_a_law_cannot_carry_is_refused():
    assert in_equations("gap", "epidemic", "outliers") == {"log_i"}
    assert in_equations("gap", "epidemic", "sensor bias") == {"cases"}
    assert not in_equations("features", "simplex", "constant load")
    reasons = {(r.effect, r.equation): r.reason for r in offered("gap", "epidemic")[1]}
    assert "Poisson" in reasons["outliers", "cases"]
    assert "variance follows from its mean" in reasons["heteroscedastic noise", "cases"]
    assert "Dirac" in reasons["heteroscedastic noise", "log_s"]
    for name in ("quantisation", "sensor rectification"):  # of a count's logarithm
        assert "Poisson: effects act on the logarithm" in reasons[name, "cases"]
    assert in_equations("gap", "two_tanks", "extra loss") == {"h1", "h2"}
    assert not in_equations("gap", "oscillator", "extra loss")


@pytest.mark.parametrize(("where", "name"), EVERY)
def test_every_candidate_has_a_key_and_a_name_of_its_own(where, name):
    found, refused = offered(where, name)
    t = traced(where, name)
    taken = {*t.parameters, *t.initial, *t.observations, *t.inputs}
    assert len({c.key for c in found}) == len(found)
    assert len({c.strength for c in found} - taken) == len(found)
    assert all(c.strength.isidentifier() for c in found)
    assert all(r.reason for r in refused)
    groups = {c.group: (c.effect, c.form, c.equation) for c in found}
    assert all(groups[c.group] == (c.effect, c.form, c.equation) for c in found)


def test_the_number_of_columns_stays_moderate():
    sizes = {n: len(offered("gap", n)[0]) for n in ("oscillator", "noisy_oscillator", "two_tanks")}
    print(sizes)
    assert all(60 <= s <= 220 for s in sizes.values())


# -- shapes
def test_shapes_are_relative_to_the_variable():
    values = np.linspace(-1.0, 3.0, 4001)
    scale = VariableScale.of(values)
    assert scale.quantile(0.9) == pytest.approx(2.6, abs=1e-3)
    assert scale.size(0.5) == pytest.approx(1.0, abs=1e-3)
    assert scale.quantile(0.85) == pytest.approx(2.4, abs=1e-3)  # between levels
    t = traced("gap", "oscillator")
    given = Scales.of(t, np.stack([values, 10 * values], 1), values[:, None], values[:, None], 600)
    found, _ = offers(t, given)
    shape = {c.key: dict(c.shape) for c in found}
    sd = 10 * values.std()
    frictions = [s["v0"] for k, s in shape.items() if k.startswith("coulomb") and "v0" in s]
    np.testing.assert_allclose(frictions, [0.05 * sd, 0.3 * sd], rtol=1e-3)
    stops = [s["h"] for k, s in shape.items() if k.startswith("hard stop | upper")]
    np.testing.assert_allclose(stops, [1.4, 2.2, 2.8], rtol=1e-3)  # of the position x, not of v
    dates = [s["date"] for k, s in shape.items() if k.startswith("level break")]
    assert dates == [100, 200, 300, 400, 500]


def test_a_time_step_is_no_input_that_acts():
    """A friction "dependent on the load dt" stood among the first on a record of uneven rows."""
    model = ssm.Model("cart", inputs=("u",), time_step="dt")
    model.prior(lambda: {"c": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"v": ssm.Normal(0, sd=1)})
    model.transition(lambda v, u, dt, c: {"v": ssm.Normal(v + dt * (u - c * v), sd=1)})
    model.observation(lambda v: {"y": ssm.Normal(v, sd=1)})
    t = trace(model)
    found, refused = offers(t, scales(t))
    assert any(c.equation == "u" for c in found)
    assert any("u" in dict(c.bound).values() for c in found)
    for c in found:
        assert "dt" not in (c.equation, *c.alike, *dict(c.bound).values()), c
    assert not [r for r in refused if r.equation == "dt"]


def test_a_variable_that_does_not_vary_has_no_shapes():
    t = traced("gap", "oscillator")
    still = Scales.of(t, np.zeros((50, 2)), np.ones((50, 1)), np.ones((50, 1)), 50)
    found, refused = offers(t, still)
    assert not [c for c in found if c.effect.name in ("coulomb friction", "dead zone 0")]
    assert "coulomb friction in v: v does not vary" in map(str, refused)


def test_shapes_can_be_refined():
    c = next(c for c in offered("gap", "local_level")[0] if c.effect.name == "level break")
    moved = c.with_shape(date=28)
    assert dict(moved.shape) == {"date": 28.0}
    assert (moved.group, moved.strength) == (c.group, c.strength)
    assert moved.weights(100).nonzero()[0].tolist() == [28]  # the step into the 29th row
    with pytest.raises(ModelError, match="no shape parameter 'day'"):
        c.with_shape(day=3)


# -- processes
def test_processes_point_to_the_column_of_their_constant():
    found, _ = offered("gap", "oscillator")
    keys = {c.key for c in found}
    for c in found:
        if c.process:
            assert not c.first_order
        assert c.increment.first_order
        if c.effect.constant in effects.names():
            assert c.increment.key in keys
    loads = [c for c in found if c.effect.name in ("missing input", "level break")]
    assert {c.increment.key for c in loads} == {"constant load |  | transition | v"}
    assert {(c.process, dict(c.shape).get("memory")) for c in loads if c.process} == {
        ("random walk", None), ("ar1", 0.8), ("ar1", 0.97)
    }  # fmt: skip


# -- the user's choice
def test_names_restrict_effects_add_and_a_mapping_renames():
    t = traced("gap", "oscillator")
    mine = effect(on="v", name="my drag")(plain)
    only = offers(t, scales(t), ["gravity", "dead zone"])[0]
    assert {c.effect.name for c in only} == {"gravity", "dead zone"}
    added = offers(t, scales(t), [mine])[0]
    assert {c.effect.name for c in added} >= {"my drag", "gravity", "outliers"}
    both = offers(t, scales(t), ["gravity", mine])[0]
    assert {c.effect.name for c in both} == {"gravity", "my drag"}
    renamed = offers(t, scales(t), {"bearing": "coulomb friction", "wind": mine})[0]
    assert {c.effect.name for c in renamed} == {"bearing", "wind"}
    assert {c.strength for c in renamed} == {"bearing_v", "bearing_v_2", "bearing_v_3", "wind_v"}
    with pytest.raises(ArgumentError, match="gravity"):
        offers(t, scales(t), ["gravitation"])
    with pytest.raises(ArgumentError, match="effects holds 'gravity' twice"):
        offers(t, scales(t), ["gravity", "gravity"])
    own = effect(on="v", name="gravity")(plain)
    replaced = [c for c in offers(t, scales(t), [own])[0] if c.effect.name == "gravity"]
    assert [c.effect for c in replaced] == [own]
    with pytest.raises(ArgumentError, match="effects holds 3"):
        offers(t, scales(t), [3])


def test_a_mixture_is_not_told_to_have_a_variance_that_follows_from_its_mean():
    law = ssm.Mixture([0.5, 0.5], [ssm.Normal(0, sd=1), ssm.Normal(0, sd=9)])
    assert "no argument is known to be its spread" in str(has_scale(law))


def test_a_sensor_that_saturates_shows_all_in_the_middle_and_no_more_than_its_range():
    """With the whole strength: a reading within m - s and m + s, of slope 1 at m."""
    (saturating,) = [e for e in effects.get("sensor gain nonlinearity") if e.form == "saturating"]
    h, (s, middle) = np.array([-50.0, 2.999, 3.0, 3.001, 60.0]), (2.0, 3.0)
    reading = h + saturating.function(h, 1.0, s, middle)
    assert reading[[0, 2, 4]] == pytest.approx([middle - s, middle, middle + s])
    assert np.diff(reading)[1:3] == pytest.approx(np.diff(h)[1:3], rel=1e-5)
    assert h + saturating.function(h, 0.0, s, middle) == pytest.approx(h)
