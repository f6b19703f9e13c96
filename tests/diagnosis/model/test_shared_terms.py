"""What several equations share, and increments of one that move the others as that would."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.equations import Equations, carried, halfway, shared_terms
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbols_of
from ssmppl.language.tracing import trace
from tests.diagnosis.harness import scales, traced

DT = 0.05


def system(start, step, channel, *inputs, **parameters):
    """A model from its parts: laws of the start, of the step (by name), and of one channel."""
    model = ssm.Model("system", inputs=inputs)
    model.prior(lambda: parameters)
    model.initial(lambda: start)
    model.transition(step)
    model.observation(channel)
    return trace(model)


def cart(extra):
    """A cart whose acceleration, with something `extra` in it, swings the pole on it."""

    def step(x, v, th, w, u, b, c, d, friction):
        acceleration = b * u - c * v - x + extra(v, friction)
        turning = -6.0 * np.sin(th) - d * w - acceleration * np.cos(th)
        return {
            "x": ssm.Dirac(x + DT * v),
            "v": ssm.Normal(v + DT * acceleration, sd=0.1),
            "th": ssm.Dirac(th + DT * w),
            "w": ssm.Normal(w + DT * turning, sd=0.1),
        }

    start = {n: ssm.Normal(0, sd=1) for n in ("x", "v", "th", "w")}
    given = {n: ssm.HalfNormal(sd=1) for n in ("b", "c", "d", "friction")}
    return system(start, step, lambda x: {"y": ssm.Normal(x, sd=1)}, "u", **given)


def means(t, at):
    """Every state's mean after one step, at random points or as given."""
    out = {}
    for part in Equations(t).of_role("state"):
        mean = Equations(t).mean(part)
        known = {s: at(s.data[1]) for s in symbols_of(mean)}
        out[part.label] = evaluate(mean, known) + np.zeros(20)
    return out


def test_a_friction_on_the_cart_is_felt_by_the_pole():
    """Against the model in which the same friction stands in the acceleration itself."""
    plain, written = cart(lambda v, l: 0.0 * l), cart(lambda v, l: -l * np.tanh(v / 0.2) / DT)
    found, _ = offers(plain, scales(plain), ["coulomb friction"])
    (c,) = [c.with_shape(v0=0.2) for c in found if c.form == "with w"][:1]
    assert c.equation == "v"
    numbers = dict.fromkeys(["friction", c.strength], 0.3)
    draw = {}

    def at(name):
        rng = np.random.default_rng(len(draw))
        return numbers.get(name) or draw.setdefault(name, rng.uniform(-1.2, 1.2, 20))

    added, whole, base = (means(t, at) for t in (augment(plain, [c]), written, plain))
    for state in ("x", "v", "th", "w"):
        np.testing.assert_allclose(added[state], whole[state], rtol=1e-12, atol=1e-14)
    assert np.max(np.abs(added["w"] - base["w"])) > 0.01
    np.testing.assert_array_equal(added["x"], base["x"])


def test_what_leaves_one_tank_enters_the_next():
    t = traced("gap", "two_tanks")
    found = shared_terms(Equations(t))
    assert [[(label, repr(f)) for label, f in r] for r in found["h1"]] == [[("h2", "-1")]]
    assert [[(label, repr(f)) for label, f in r] for r in found["h2"]] == [[("h1", "-1")]]


@pytest.mark.parametrize("name", ["oscillator", "pendulum", "ar1", "local_level"])
def test_one_equation_has_nothing_to_share(name):
    assert not any(shared_terms(Equations(traced("gap", name))).values())


def two_states(step):
    start = {n: ssm.Normal(0, sd=1) for n in ("a", "b")}
    return system(start, step, lambda a: {"y": ssm.Normal(a, sd=1)}, k=ssm.HalfNormal(sd=1))


def linear(a, b, k):
    flow = k * a * b
    return {"a": ssm.Normal(a - flow, sd=1), "b": ssm.Normal(b + 0.5 * flow, sd=1)}


def squared(a, b, k):
    flow = k * a * b
    return {"a": ssm.Normal(a - flow, sd=1), "b": ssm.Normal(b + flow**2, sd=1)}


def scaled_by_a_state(a, b, k):
    flow = np.sin(k * a * b)
    return {"a": ssm.Normal(a - flow * b, sd=1), "b": ssm.Normal(b + flow * a, sd=1)}


def semi_implicit(a, b, k):
    speed = b - 0.1 * k * np.sin(a)
    return {"a": ssm.Normal(a + 0.1 * speed, sd=1), "b": ssm.Normal(speed, sd=1)}


def geometry(a, b, k):
    apart = a - b
    return {"a": ssm.Normal(a - 0.1 * apart, sd=1), "b": ssm.Normal(b + 0.1 * apart - k, sd=1)}


def of_parameters(a, b, k):
    rate = np.exp(-k)
    return {"a": ssm.Normal(rate * a, sd=1), "b": ssm.Normal(rate * b, sd=1)}


@pytest.mark.parametrize(
    ("step", "of_a"),
    [(linear, {"b": -0.5}), (squared, None), (scaled_by_a_state, None), (semi_implicit, None),
     (geometry, None), (of_parameters, None)],
)  # fmt: skip
def test_a_flow_enters_its_own_equation_with_a_constant_factor_the_others_linearly(step, of_a):
    found = shared_terms(Equations(two_states(step))).get("a", [])
    assert [{k: evaluate(f, {}) for k, f in r} for r in found] == ([of_a] if of_a else [])


def test_an_effect_with_its_reaction_is_a_candidate_of_its_own():
    t = traced("gap", "two_tanks")
    found, _ = offers(t, scales(t, shift=6.0), ["quadratic drag", "level break", "hard stop"])
    forms = {(c.effect.name, c.equation, c.form) for c in found}
    assert {("quadratic drag", "h1", ""), ("quadratic drag", "h1", "with h2")} <= forms
    assert not any(f for name, _, f in forms if name == "level break")  # an event in one state
    assert ("hard stop", "h1", "overflow into another state, by h2, with h2") not in forms
    assert len({c.key for c in found}) == len({c.strength for c in found}) == len(found)


# -- what integrates the new value
def mass(extra):
    """A mass on a spring, its step semi-implicit, with something `extra` in its new speed."""

    def step(x, v, u, k, drag):
        new = v + DT * (u - k * x) + extra(v, drag)
        return {"x": ssm.Dirac(x + DT * new), "v": ssm.Normal(new, sd=0.1)}

    start = {n: ssm.Normal(0, sd=1) for n in ("x", "v")}
    given = {n: ssm.HalfNormal(sd=1) for n in ("k", "drag")}
    return system(start, step, lambda x: {"y": ssm.Normal(x, sd=1)}, "u", **given)


def test_a_force_moves_what_integrates_the_new_speed_in_the_same_step():
    """Against the model in which the same drag stands in the new speed itself."""
    plain, written = mass(lambda v, l: 0.0 * l), mass(lambda v, l: -l * v * np.abs(v))
    found, _ = offers(plain, scales(plain), ["quadratic drag", "level break", "outliers"])
    (c,) = [c for c in found if c.effect.name == "quadratic drag"]
    assert (c.equation, c.form) == ("v", "")  # no form of its own: it is what the model's step does
    numbers = dict.fromkeys(["drag", c.strength], 0.3)
    draw = {}

    def at(name):
        rng = np.random.default_rng(len(draw))
        return numbers.get(name) or draw.setdefault(name, rng.uniform(-1.2, 1.2, 20))

    added, whole = means(augment(plain, [c]), at), means(written, at)
    for state in ("x", "v"):
        np.testing.assert_allclose(added[state], whole[state], rtol=1e-12, atol=1e-14)
    assert not any(c.carried for c in found if c.effect.name != "quadratic drag")


def test_an_explicit_step_carries_nothing():
    assert carried(Equations(traced("gap", "oscillator"))) == {}


def swung(added, dt=None):
    """A driven pendulum integrated over a row, `added` in its acceleration."""

    def step(x, v, u, k, c, **rest):
        def rhs(x, v):
            return {"x": v, "v": u - k * np.sin(x) - c * v + added(v)}

        new = ssm.integrate(rhs, {"x": x, "v": v}, rest.get("dt", DT), steps=4)
        return {"x": ssm.Dirac(new["x"]), "v": ssm.Normal(new["v"], sd=0.1)}

    def timed(x, v, u, dt, k, c):
        return step(x, v, u, k, c, dt=dt)

    def plain(x, v, u, k, c):
        return step(x, v, u, k, c)

    start = {n: ssm.Normal(0, sd=1) for n in ("x", "v")}
    given = {n: ssm.HalfNormal(sd=1) for n in ("k", "c")}
    inputs = ("u", "dt") if dt else ("u",)
    return system(start, timed if dt else plain, lambda x: {"y": ssm.Normal(x, sd=1)}, *inputs,
                  **given)  # fmt: skip


@pytest.mark.parametrize("dt", [None, 0.02])
def test_a_row_that_is_integrated_moves_the_position_by_half(dt):
    """Against the equation with the same constant force in it, to the higher orders of a row."""
    step = dt or DT
    plain = swung(lambda v: 0.0, dt)
    ((label, factor),) = halfway(Equations(plain))["v"]
    given = symbols_of(factor)
    assert label == "x"
    assert [s.data[1] for s in given] == (["dt"] if dt else [])
    assert evaluate(factor, dict.fromkeys(given, step)) == pytest.approx(step / 2, rel=0.02)
    rng = np.random.default_rng(4)
    at = {n: rng.uniform(-1.0, 1.0, 20) for n in ("x", "v", "u", "k", "c")} | {"dt": step}
    force = 0.7
    before, after = (means(swung(lambda v, f=f: f, dt), at.__getitem__) for f in (0.0, force))
    pushed = after["v"] - before["v"]
    whole = after["x"] - before["x"]
    np.testing.assert_allclose(step / 2 * pushed, whole, rtol=0.05)


def test_a_position_that_reads_the_new_speed_is_moved_once():
    model = ssm.Model("mass", inputs=("u",))
    model.prior(lambda: {"k": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)})
    model.transition(lambda x, v, u, k: {"v": ssm.Normal(v + DT * (u - k * x), sd=0.1)})
    model.transition(lambda x, v_next: {"x": ssm.Normal(x + DT * v_next, sd=0.01)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    equations = Equations(trace(model))
    assert equations.integral_of == {"x": "v"}
    assert carried(equations) == {}
    assert halfway(equations) == {}


def test_scores_leave_out_what_moves_halfway():
    plain = swung(lambda v: 0.0)
    found, _ = offers(plain, scales(plain), ["constant load"])
    (c,) = [c for c in found if c.equation == "v"]
    draw = {c.strength: 0.3}

    def at(name):
        rng = np.random.default_rng(len(draw))
        return draw.setdefault(name, rng.uniform(-1.0, 1.0, 20))

    before = means(plain, at)
    whole, scored = (means(augment(plain, [c], first_order=f), at) for f in (False, True))
    np.testing.assert_allclose(whole["x"] - before["x"], DT / 2 * 0.3, rtol=0.02)
    assert np.array_equal(scored["x"], before["x"])
    for one in (whole, scored):
        np.testing.assert_allclose(one["v"] - before["v"], 0.3, rtol=1e-12)


# -- what holds a state back
def held(extra=lambda v, u, strength: 0.0, stick=lambda new, strength: new):
    """A mass with something in its new speed, and something that it then meets."""

    def step(x, v, u, c, load, stop):
        new = stick(v + DT * (u - c * v) + extra(v, u, load), stop)
        return {"x": ssm.Dirac(x + DT * v), "v": ssm.Normal(new, sd=0.1)}

    start = {n: ssm.Normal(0, sd=1) for n in ("x", "v")}
    given = {n: ssm.HalfNormal(sd=1) for n in ("c", "load", "stop")}
    return system(start, step, lambda x: {"y": ssm.Normal(x, sd=1)}, "u", **given)


def test_friction_that_holds_takes_from_the_step_what_all_else_has_made_of_it():
    """A load that is less than the friction does not move what rests, in either order."""
    plain = held()
    written = held(
        lambda v, u, load: load, lambda new, l: np.sign(new) * np.maximum(np.abs(new) - l, 0)
    )
    found, _ = offers(plain, scales(plain), ["coulomb friction", "constant load"])
    (stick,) = [c for c in found if c.effect.form == "sticking"]
    (load,) = [c for c in found if c.effect.name == "constant load"]
    assert stick.equation == load.equation == "v"
    numbers = {"load": 0.11, load.strength: 0.11, "stop": 0.3, stick.strength: 0.3}
    draw = {}

    def at(name):
        rng = np.random.default_rng(len(draw))
        return numbers.get(name) or draw.setdefault(name, rng.uniform(-0.6, 0.6, 20))

    whole = means(written, at)
    assert np.any(whole["v"] == 0.0)
    assert np.any(whole["v"] != 0.0)
    one = augment(plain, [stick])
    for added in (augment(plain, [stick, load]), augment(plain, [load, stick]),
                  augment(one, [load])):  # fmt: skip
        moved = means(added, at)
        for state in ("x", "v"):
            np.testing.assert_allclose(moved[state], whole[state], rtol=1e-12, atol=1e-14)


def test_two_that_hold_hold_together():
    @ssm.effect(on="v", name="brake", lower=0, given={"new": "next"})
    def brake(v, new, strength):
        return -np.clip(new, -strength, strength)

    plain = held()
    found, _ = offers(plain, scales(plain), ["coulomb friction", brake])
    both = [c for c in found if c.reads_next]
    assert len(both) == 2
    known = {both[0].strength: 0.1, both[1].strength: 0.2}
    draw = {}

    def at(name):
        rng = np.random.default_rng(len(draw))
        return known.get(name) or draw.setdefault(name, rng.uniform(-0.6, 0.6, 20))

    before = means(plain, at)["v"]
    after = means(augment(plain, both), at)["v"]
    np.testing.assert_allclose(after, np.sign(before) * np.maximum(np.abs(before) - 0.3, 0.0),
                               atol=1e-14)  # fmt: skip


def test_the_pole_on_a_cart_in_semi_implicit_steps():
    """The new speed is held by the position too: that is no flow, and hides none."""

    def step(x, v, th, w, u, b, c, d):
        acceleration = b * u - c * v - x
        new = v + DT * acceleration
        return {
            "x": ssm.Dirac(x + DT * new),
            "v": ssm.Normal(new, sd=0.1),
            "th": ssm.Dirac(th + DT * w),
            "w": ssm.Normal(w + DT * (-np.sin(th) - d * w - acceleration * np.cos(th)), sd=0.1),
        }

    start = {n: ssm.Normal(0, sd=1) for n in ("x", "v", "th", "w")}
    given = {n: ssm.HalfNormal(sd=1) for n in ("b", "c", "d")}
    t = system(start, step, lambda x: {"y": ssm.Normal(x, sd=1)}, "u", **given)
    equations = Equations(t)
    assert [[label for label, _ in r] for r in shared_terms(equations)["v"]] == [["w"]]
    assert [label for label, _ in carried(equations)["v"]] == ["x"]


def test_a_flow_within_a_flow():
    """What two equations hold lies inside of what one of them holds."""

    def step(a, b, c, k):
        inner = k * a
        outer = np.sin(b) + inner
        return {"a": ssm.Normal(a - outer, sd=1), "b": ssm.Normal(b + outer, sd=1),
                "c": ssm.Normal(c + 2.0 * inner, sd=1)}  # fmt: skip

    start = {n: ssm.Normal(0, sd=1) for n in "abc"}
    t = system(start, step, lambda a: {"y": ssm.Normal(a, sd=1)}, k=ssm.HalfNormal(sd=1))
    found = [{label: evaluate(f, {}) for label, f in r} for r in shared_terms(Equations(t))["a"]]
    assert found == [{"b": -1.0}, {"b": -1.0, "c": -2.0}]


def test_what_follows_the_new_position_keeps_no_effect_from_the_screen():
    """Hysteresis and backlash hold clips, and move with what a force moves within the step: as they
    come in multiplied by a strength of zero, no first derivative needs to know how."""
    t = mass(lambda v, l: 0.0 * l)
    found, _ = offers(t, scales(t))
    found = [c.increment for c in found]
    assert any(c.carried and c.effect.states for c in found)
    columns = score_columns(t, augment(t, found, prior=True), {c.strength for c in found}, (),
                            Missing(none=True))  # fmt: skip
    assert set(columns.names) == {c.strength for c in found}
    assert columns.refused == {}
