"""Effects through a simulator's force: they move all that the force moves, in its unit."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.equations import Equations
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.diagnosis.report.engine_attributes import attribute_of
from ssmppl.diagnosis.report.model_file import model_text, to_model
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbols_of, topological
from ssmppl.language.tracing import trace

T = 40
H, STEPS = 0.01, 5
MASS = np.linalg.inv(np.array([[2.0, 0.7], [0.7, 1.0]]))  # what a force on one moves of the other


def step(state, inputs, parameters):
    x, v = state[:, :2], state[:, 2:]
    for _ in range(STEPS):
        force = inputs[:, :2] + inputs[:, 2:] - parameters * v - 3.0 * np.sin(x)
        v = v + H * force @ MASS.T
        x = x + H * v
    return np.concatenate([x, v], axis=1)


NAMES = {"state": ["x1", "x2", "v1", "v2"], "inputs": ["u1", "u2", "f1", "f2"], "parameters": "d"}
coupled = ssm.simulator(**NAMES, forces={"f1": "v1", "f2": "v2"})(step)
unsaid = ssm.simulator(**NAMES, forces=["f1", "f2"], name="unsaid")(step)


def model_of(simulator=coupled, torque_noise=False):
    model = ssm.Model("coupled", inputs=("u1", "u2"))
    model.prior(lambda: {"d": ssm.LogNormal(-1, sd=1), "s": ssm.LogNormal(-2, sd=1)})
    noise = {"w1": ssm.Normal(0, sd=0.1), "w2": ssm.Normal(0, sd=0.1)} if torque_noise else {}
    start = {n: ssm.Normal(0, sd=0.1) for n in ("x1", "x2", "v1", "v2")}
    model.initial(lambda: start | noise)

    def moved(state, forces, d, s):
        new = simulator(state, forces, [d])
        out = {n: ssm.Dirac(new[n]) for n in ("x1", "x2")}
        if torque_noise:
            out |= {n: ssm.Dirac(new[n]) for n in ("v1", "v2")}
            return out | {n: ssm.Normal(0, sd=s) for n in ("w1", "w2")}
        return out | {n: ssm.Normal(new[n], sd=s) for n in ("v1", "v2")}

    if torque_noise:

        @model.transition
        def by_torques(x1, x2, v1, v2, w1, w2, u1, u2, d, s):
            return moved([x1, x2, v1, v2], [u1, u2, w1, w2], d, s)

    else:

        @model.transition
        def by_speeds(x1, x2, v1, v2, u1, u2, d, s):
            return moved([x1, x2, v1, v2], [u1, u2, 0.0, 0.0], d, s)

    model.observation(lambda x1, x2: {"y1": ssm.Normal(x1, sd=0.01), "y2": ssm.Normal(x2, sd=0.01)})
    return model


def offered(model, names):
    traced = trace(model)
    rng = np.random.default_rng(1)
    states = rng.normal(size=(T, 4, len(traced.state_symbols)))
    scales = Scales.of(traced, states, rng.normal(size=(T, 2)), rng.normal(size=(T, 2)), T)
    return traced, offers(traced, scales, names)[0]


def drag(model, on="v2"):
    traced, found = offered(model, ["quadratic drag"])
    (one,) = (c for c in found if c.equation == on)
    return traced, one


def test_the_force_on_a_rate_is_found_where_it_is_said():
    equations = Equations(trace(model_of()))
    assert equations.integral_of == {"x1": "v1", "x2": "v2"}
    assert [equations.force(equations.parts[n]).name for n in ("v1", "v2")] == ["f1", "f2"]
    assert equations.force(equations.parts["x1"]) is None
    unnamed = Equations(trace(model_of(unsaid)))
    assert unnamed.force(unnamed.parts["v1"]) is None
    assert "through f2" in str(drag(model_of())[1])
    assert "through" not in str(drag(model_of(unsaid))[1])


def test_a_friction_that_holds_is_not_offered_where_a_force_acts():
    """Its strength is in the state's unit, and a simulator takes a force."""
    _traced, found = offered(model_of(), ["coulomb friction"])
    assert {c.effect.form for c in found} == {""}
    _, found = offered(model_of(unsaid), ["coulomb friction"])
    assert {c.effect.form for c in found} == {"", "sticking"}


def test_the_augmented_model_pushes_inside_of_the_step():
    """Its transition at a point is the simulator's with the friction among its forces."""
    traced, candidate = drag(model_of())
    added = augment(traced, [candidate])
    at = dict(
        zip(("x1", "x2", "v1", "v2", "u1", "u2"), (0.2, -0.1, 0.7, -1.3, 0.4, 0.6), strict=True)
    )
    at |= {"d": 0.3, "s": 0.1, candidate.strength: 0.8, "t": 1.0}
    roots = [added.transition[n].distribution.mean()[()] for n in ("x1", "x2", "v1", "v2")]
    found = evaluate(roots, {s: at[s.data[1]] for s in symbols_of(roots)})
    wanted = coupled(
        [at[n] for n in ("x1", "x2", "v1", "v2")], [0.4, 0.6, 0.0, 0.8 * 1.3**2], [0.3]
    )
    np.testing.assert_allclose(found, wanted.vector, rtol=1e-12)


def test_a_stop_pushes_against_where_the_step_would_end():
    """The simulator is asked without the stop first; in a written-out step the position counts."""
    traced, found = offered(model_of(), ["hard stop"])
    stop = next(c for c in found if (c.equation, c.effect.form) == ("v2", "upper"))
    stop = stop.with_shape(h=0.15)
    state, forces = [0.2, 0.1, 0.7, 1.9], [0.4, 0.6, 0.0, 0.0]
    free = coupled(state, forces, [0.3])
    assert state[1] < 0.15 < free.x2
    wanted = coupled(state, [*forces[:3], -5.0 * (free.x2 - 0.15)], [0.3])
    at = dict(zip(("x1", "x2", "v1", "v2", "u1", "u2"), [*state, *forces[:2]], strict=True))
    at |= {"d": 0.3, "s": 0.1, stop.strength: 5.0, "t": 1.0}
    added = augment(traced, [stop])
    roots = [added.transition[n].distribution.mean()[()] for n in ("x1", "x2", "v1", "v2")]
    values = evaluate(roots, {s: at[s.data[1]] for s in symbols_of(roots)})
    np.testing.assert_allclose(values, wanted.vector, rtol=1e-12)


@pytest.mark.parametrize("torque_noise", [False, True])
def test_the_score_at_zero_is_that_of_the_speeds(torque_noise):
    """With noise in the speeds (v - f) / s^2 df / dF g, of both speeds; with noise in the torques
    w / s^2 g at the state that the torque acts on."""
    traced, candidate = drag(model_of(torque_noise=torque_noise))
    added = augment(traced, [candidate], first_order=True)
    columns = score_columns(traced, added, [candidate.strength], [], Missing(none=True))
    assert columns.names == (candidate.strength,)
    assert not [n for n in columns.carried.transition if candidate.strength in n]
    later = columns.later[-1]
    rng = np.random.default_rng(2)
    known = {s: float(v) for s, v in zip(sorted(symbols_of([later]), key=repr), rng.uniform(
        0.2, 1.0, len(symbols_of([later]))), strict=True)}  # fmt: skip
    (found,) = evaluate([later], known)
    by_name = {(s.data[0], s.data[1]): v for s, v in known.items()}
    s = by_name["parameter", "s"]
    if torque_noise:
        v = by_name["state", "v2"]
        assert found == pytest.approx(by_name["state", "w2"] / s**2 * -v * abs(v))
        return
    before = [by_name["state_prev", n] for n in ("x1", "x2", "v1", "v2")]
    forces = [by_name["input_prev", n] for n in ("u1", "u2")]

    def ahead(f2):
        return coupled(before, [*forces, 0.0, f2], [by_name["parameter", "d"]]).vector[2:]

    slope = (ahead(1e-5) - ahead(-1e-5)) / 2e-5
    off = np.array([by_name["state", n] for n in ("v1", "v2")]) - ahead(0.0)
    assert found == pytest.approx(off @ slope / s**2 * -before[3] * abs(before[3]), rel=1e-6)


def test_several_effects_on_one_force_add_up():
    traced, found = offered(model_of(), ["quadratic drag", "cubic stiffness"])
    both = [c for c in found if c.equation == "v2"]
    assert len(both) == 2
    for first_order in (False, True):
        added = augment(traced, both, first_order=first_order)
        inside = {s.data[1] for s in symbols_of([added.transition["v1"].distribution.mean()[()]])}
        assert {c.strength for c in both} <= inside


@pytest.mark.parametrize("torque_noise", [False, True])
def test_the_score_of_a_further_effect_is_taken_where_the_first_one_acts(torque_noise):
    """That one stays inside of the step, at its own strength: only what is new is linear."""
    traced, found = offered(model_of(torque_noise=torque_noise), ["quadratic drag", "gravity"])
    drag_, gravity = (
        next(c for c in found if c.equation == "v2" and c.effect.name == n)
        for n in ("quadratic drag", "gravity")
    )
    first = augment(traced, [drag_])
    both = augment(first, [gravity], first_order=True)
    columns = score_columns(first, both, [gravity.strength], [], Missing(none=True))
    followed = [e for _, e in columns.follows["transition"]]
    calls = [n for n in topological([*columns.later, *followed]) if n.op == "simulator"]
    assert calls
    for call in calls:
        assert drag_.strength in {s.data[1] for s in symbols_of([call.args[7]])}  # f2


@pytest.mark.parametrize("torque_noise", [False, True])
@pytest.mark.parametrize("first", [None, "quadratic drag", "bouc-wen hysteresis", "input delay"])
def test_effects_with_states_of_their_own_join_those_on_forces(first, torque_noise):
    """A delay line in the input, the memory of a hysteresis in the force, in the model or new."""
    names = ["quadratic drag", "bouc-wen hysteresis", "input delay", "coarse discretisation"]
    traced, found = offered(model_of(torque_noise=torque_noise), names)
    chosen = [c for c in found if c.effect.name == first][:1]
    before = augment(traced, chosen) if chosen else traced
    rest = [c for c in found if c not in chosen]
    both = augment(before, rest, first_order=True)
    columns = score_columns(before, both, [c.strength for c in rest], [], Missing(none=True))
    assert set(columns.names) | set(columns.refused) >= {c.strength for c in rest}
    assert columns.names


def test_the_model_with_an_effect_is_there_where_no_module_has_the_simulator():
    """As one made inside of a function; its file says which name is wanted."""

    def made():
        return ssm.simulator(**NAMES, forces={"f1": "v1", "f2": "v2"}, name="local")(step)

    traced, candidate = drag(model_of(made()))
    added = augment(traced, [candidate])
    again = to_model(added)
    at = {"d": 0.3, "s": 0.1, candidate.strength: 0.8}
    inputs = {n: np.zeros(5) for n in ("u1", "u2")}
    assert np.isfinite(ssm.simulate(again, at, steps=5, inputs=inputs, seed=1)["v2"]).all()
    text = model_text(added, added=[candidate])
    assert "# local, made in test_forces.py:" in text
    assert "import local" in text


def test_the_file_of_the_augmented_model_calls_the_simulator_with_the_force():
    traced, candidate = drag(model_of())
    text = model_text(augment(traced, [candidate]), added=[candidate])
    assert "added: quadratic drag (through f2) in v2" in text
    call = next(line for line in text.splitlines() if "coupled([" in line)
    assert "[u1, u2, 0, -quadratic_drag]" in call
    assert "def transition(x1, x2, v1, v2, u1, u2, d, s, quadratic_drag_v2):" in text


def test_the_report_asks_the_engine_that_the_effect_acts_through():
    traced, (delay, *_) = offered(model_of(), ["input delay"])
    assert attribute_of(traced, delay, 0.7) == ""  # a function of NumPy has no file

    class Engine:
        def __call__(self, state, inputs, parameters):
            return step(state, inputs, parameters)

        def attribute_of(self, effect, argument, strength, shape):
            return f"{effect}, {argument}, {strength}, {sorted(shape)}"

    own = ssm.simulator(**NAMES, forces={"f1": "v1", "f2": "v2"}, name="engine")(Engine())
    traced, (delay, *_) = offered(model_of(own), ["input delay"])
    assert attribute_of(traced, delay, 0.7) == "input delay, u1, 0.7, ['before', 'delay']"
    traced, candidate = drag(model_of(own))
    assert attribute_of(traced, candidate, 0.7) == "quadratic drag, f2, 0.7, []"
    assert attribute_of(traced, candidate, 0.0) == ""
