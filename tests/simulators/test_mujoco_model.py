"""`ssm.simulators.mujoco` against equations of motion, and files with the values in them."""

import os
import pickle
import re
from string import Template

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ssmppl as ssm
from ssmppl.simulators import mujoco

engine = pytest.importorskip("mujoco")

# A bob of 0.7 kg, 0.8 m below its hinge, with an inertia of its own.
PENDULUM = """<mujoco model="pendulum">
<option timestep="0.002" integrator="RK4"/>
<worldbody><body name="bob">
<joint name="pivot" axis="0 -1 0" damping="0.3" armature="0.05"/>
<inertial pos="0 0 -0.8" mass="0.7" diaginertia="0.01 0.02 0.01"/>
</body></worldbody>
<actuator><motor name="motor" joint="pivot" gear="2"/></actuator>
<sensor><jointpos name="angle" joint="pivot"/><framepos name="tip" objtype="body" objname="bob"/>
</sensor></mujoco>"""

# One of everything that can be a parameter; its values are the fields.
MACHINE = Template("""<mujoco model="machine">
<option timestep="0.002" gravity="0 0 -$gravity" density="$density" viscosity="$viscosity"
wind="$wind 0 0"/>
<worldbody><geom name="floor" type="plane" size="5 5 1" friction="$friction 0.005 0.0001"/>
<body name="upper" pos="0 0 1">
<joint name="shoulder" axis="0 1 0" damping="$damping" stiffness="$stiffness"
springref="$springref" frictionloss="$frictionloss" armature="$armature"/>
<geom name="thigh" type="capsule" size="0.04" fromto="0 0 0 0 0 -0.5" density="$thigh"/>
<body name="lower" pos="0 0 -0.5">
<joint name="elbow" axis="0 1 0" damping="0.1" limited="true" range="$range_lower $range_upper"/>
<inertial pos="$com_x 0 $com_z" mass="$mass" diaginertia="$inertia $inertia 0.002"/>
<geom name="shin" type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4"/>
</body></body>
<body name="cart" pos="0 0 0.1"><joint name="rail" type="slide" axis="1 0 0" damping="0.2"/>
<joint name="lift" type="slide" axis="0 0 1"/>
<geom name="box" type="box" size="0.1 0.1 $box" mass="$box_mass"/></body>
</worldbody>
<tendon><fixed name="rope" stiffness="$rope_stiffness" damping="$rope_damping"
frictionloss="$rope_friction"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-1"/>
</fixed></tendon>
<actuator><motor name="push" joint="rail" gear="$gear"/>
<general name="pull" joint="shoulder" gainprm="$gain"/>
<position name="servo" joint="elbow" kp="$kp" kv="$kv"/>
<velocity name="speed" joint="shoulder" kv="$speed_kv"/>
<general name="slow" joint="rail" dyntype="filter" dynprm="$timeconst"/>
</actuator></mujoco>""")
VALUES = {
    "gravity": 9.81, "density": 0.0, "viscosity": 0.0, "wind": 0.0, "friction": 1.0, "damping": 0.2,
    "stiffness": 1.0, "springref": 0.0, "frictionloss": 0.0, "armature": 0.0, "thigh": 1000.0,
    "range_lower": -20.0, "range_upper": 40.0, "com_x": 0.0, "com_z": -0.2, "mass": 1.0,
    "inertia": 0.01, "box": 0.1, "box_mass": 2.0, "rope_stiffness": 0.0, "rope_damping": 0.0,
    "rope_friction": 0.0, "gear": 1.0, "gain": 1.0, "kp": 5.0, "kv": 0.1, "speed_kv": 1.0,
    "timeconst": 0.1,
}  # fmt: skip
SET = [  # target, value, the fields of the file for it
    ("shoulder.damping", 0.9, {"damping": 0.9}),
    ("shoulder.stiffness", 4.0, {"stiffness": 4.0}),
    ("shoulder.springref", 0.5, {"springref": np.degrees(0.5)}),
    ("shoulder.frictionloss", 0.7, {"frictionloss": 0.7}),
    ("shoulder.armature", 0.3, {"armature": 0.3}),
    ("elbow.range_lower", np.radians(-5.0), {"range_lower": -5.0}),
    ("elbow.range_upper", np.radians(10.0), {"range_upper": 10.0}),
    ("lower.mass", 2.5, {"mass": 2.5, "inertia": 0.025}),  # the last inertia is tested below
    ("lower.com_x", 0.07, {"com_x": 0.07}),
    ("lower.com_z", -0.3, {"com_z": -0.3}),
    ("floor.friction", 1.8, {"friction": 1.8}),  # the larger one of two geoms counts
    ("thigh.density", 400.0, {"thigh": 400.0}),
    ("box.size_2", 0.13, {"box": 0.13}),
    ("box.mass", 3.5, {"box_mass": 3.5}),
    ("rope.stiffness", 3.0, {"rope_stiffness": 3.0}),
    ("rope.damping", 0.4, {"rope_damping": 0.4}),
    ("rope.frictionloss", 0.4, {"rope_friction": 0.4}),
    ("push.gear", 3.0, {"gear": 3.0}),
    ("pull.gain", 3.0, {"gain": 3.0}),
    ("servo.kp", 9.0, {"kp": 9.0}),
    ("servo.kv", 0.7, {"kv": 0.7}),
    ("speed.kv", 2.0, {"speed_kv": 2.0}),
    ("slow.timeconst", 0.3, {"timeconst": 0.3}),
    ("option.gravity", 3.7, {"gravity": 3.7}),
    ("option.gravity_z", -3.7, {"gravity": 3.7}),
    ("option.density", 300.0, {"density": 300.0}),
    ("option.viscosity", 2.0, {"viscosity": 2.0}),
]


def machine(**changed):
    return MACHINE.substitute(VALUES | changed)


def points(simulator, rng, size=6):
    """States and inputs at which every joint moves, and the box touches the floor."""
    state = 0.3 * rng.normal(size=(size, len(simulator.state)))
    inputs = rng.normal(size=(size, len(simulator.inputs)))
    lift = [k for k, n in enumerate(simulator.state) if n == "lift"]
    state[:, lift] = -0.02
    return state, inputs


@pytest.fixture(scope="module")
def pendulum():
    return mujoco(PENDULUM, parameters={"damping": "pivot.damping", "m": "bob.mass"}, dt=0.1)


def test_names_are_those_of_the_file(pendulum):
    assert pendulum.state == ("pivot", "pivot_velocity")
    assert pendulum.inputs == ("motor", "pivot_force")
    assert pendulum.forces == {"pivot_force": "pivot_velocity"}
    assert pendulum.outputs == ("angle", "tip_0", "tip_1", "tip_2")
    assert pendulum.step.values == {"damping": 0.3, "m": 0.7}
    assert (pendulum.step.substeps, pendulum.step.interval) == (50, pytest.approx(0.1))


def test_a_step_is_that_of_the_equations_of_motion(pendulum):
    """Runge-Kutta in steps of h has an error of order h^4: 2e-11, times derivatives of order 10^3
    and a duration of 0.1 s."""
    rng = np.random.default_rng(1)
    state, inputs = rng.normal(size=(4, 2)), rng.normal(size=(4, 2))
    parameters = rng.uniform(0.2, 1.0, size=(4, 2))
    found = pendulum.step(state, inputs, parameters)
    for x, u, p, new in zip(state, inputs, parameters, found, strict=True):
        inertia = p[1] * 0.8**2 + 0.02 * p[1] / 0.7 + 0.05

        def slopes(t, y, u=u, p=p, inertia=inertia):
            torque = 2 * u[0] + u[1] - p[1] * 9.81 * 0.8 * np.sin(y[0]) - p[0] * y[1]
            return [y[1], torque / inertia]

        wanted = solve_ivp(slopes, (0, 0.1), x, rtol=1e-12, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(new, wanted, rtol=0, atol=2e-9)


def test_sensors_are_those_at_the_state(pendulum):
    sensed = pendulum.sense(pivot=0.4, pivot_velocity=2.0, motor=0.0, damping=0.1, m=1.0)
    assert sensed.angle == pytest.approx(0.4, abs=1e-15)
    assert sensed.tip_1 == pytest.approx(0.0, abs=1e-15)


def test_without_damping_and_motor_the_energy_is_kept():
    still = PENDULUM.replace('damping="0.3"', "")
    simulator = mujoco(still, dt=1.0)
    inertia = 0.7 * 0.8**2 + 0.02 + 0.05
    q, v = np.array([1.0, 2.0, -0.5]), np.array([0.0, 1.0, -1.0])

    def energy(q, v):
        return 0.5 * inertia * v**2 - 0.7 * 9.81 * 0.8 * np.cos(q)

    new = simulator(pivot=q, pivot_velocity=v, motor=np.zeros(3))
    np.testing.assert_allclose(energy(new.pivot, new.pivot_velocity), energy(q, v), atol=1e-8)


@pytest.fixture(scope="module")
def whole():
    """The machine with all parameters at once."""
    return mujoco(machine(), parameters={f"p{k}": t for k, (t, _, _) in enumerate(SET)}, substeps=5)


@pytest.mark.parametrize("k", range(len(SET)), ids=[t for t, _, _ in SET])
def test_a_parameter_is_as_if_it_stood_in_the_file(k):
    """All is compared after several steps, from states at which it matters."""
    target, value, fields = SET[k]
    rng = np.random.default_rng(k)
    own = mujoco(machine(), parameters={"p": target}, substeps=5)
    there = mujoco(machine(**fields), substeps=5)
    if target == "lower.mass":  # the file's third inertia is not in the template's fields
        text = machine(**fields).replace('0.002"/>\n<geom', '0.005"/>\n<geom')
        there = mujoco(text, substeps=5)
    state, inputs = points(own, rng)
    nothing = np.empty((6, 0))
    found = own.step(state, inputs, np.full((6, 1), value))
    wanted = there.step(state, inputs, nothing)
    before = mujoco(machine(), substeps=5).step(state, inputs, nothing)
    assert np.max(np.abs(wanted - before)) > 1e-5, "the value makes no difference here"
    # the constraint solver stops at a tolerance of 1e-8
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7)


def test_the_inertia_is_a_factor_on_that_of_the_file():
    rng = np.random.default_rng(5)
    own = mujoco(machine(), parameters={"p": "lower.inertia"}, substeps=5)
    text = machine(inertia=0.03).replace('0.002"/>\n<geom', '0.006"/>\n<geom')
    state, inputs = points(own, rng)
    found = own.step(state, inputs, np.full((6, 1), 3.0))
    wanted = mujoco(text, substeps=5).step(state, inputs, np.empty((6, 0)))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7)


def test_values_of_the_file_give_what_the_file_gives(whole):
    rng = np.random.default_rng(2)
    state, inputs = points(whole, rng)
    values = np.array(list(whole.step.values.values()))
    values[[t == "thigh.density" for t, _, _ in SET].index(True)] = 1000.0
    values[[t == "box.mass" for t, _, _ in SET].index(True)] = 2.0
    found = whole.step(state, inputs, np.tile(values, (6, 1)))
    wanted = mujoco(machine(), substeps=5).step(state, inputs, np.empty((6, 0)))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7)


def test_several_targets_and_functions_are_parameters():
    def length(spec, value):
        spec.body("lower").pos[2] = -value

    own = mujoco(
        machine(), substeps=5,
        parameters={"both": ["shoulder.damping", "elbow.damping"], "length": length},
    )  # fmt: skip
    text = machine(damping=0.6).replace('pos="0 0 -0.5"', 'pos="0 0 -0.7"')
    text = text.replace('axis="0 1 0" damping="0.1"', 'axis="0 1 0" damping="0.6"')
    state, inputs = points(own, np.random.default_rng(3))
    found = own.step(state, inputs, np.tile([0.6, 0.7], (6, 1)))
    wanted = mujoco(text, substeps=5).step(state, inputs, np.empty((6, 0)))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7)


def test_each_point_has_its_own_parameters_whatever_else_is_there(pendulum):
    rng = np.random.default_rng(4)
    state, inputs = rng.normal(size=(9, 2)), rng.normal(size=(9, 2))
    parameters = np.tile(rng.uniform(0.2, 1.0, size=(3, 2)), (3, 1))
    whole = pendulum.step(state, inputs, parameters)
    order = rng.permutation(9)
    assert np.array_equal(
        pendulum.step(state[order], inputs[order], parameters[order]), whole[order]
    )
    for k in range(9):
        one = slice(k, k + 1)
        assert np.array_equal(pendulum.step(state[one], inputs[one], parameters[one]), whole[one])


def test_a_constraint_solver_begins_anew_at_each_call():
    """On the floor, with a warm start the result would depend on the call before."""
    simulator = mujoco(machine(), substeps=5)
    rng = np.random.default_rng(6)
    (a, u), nothing = points(simulator, rng), np.empty((6, 0))
    first = simulator.step(a, u, nothing)
    simulator.step(*points(simulator, rng), nothing)
    assert np.array_equal(simulator.step(a, u, nothing), first)
    threads = mujoco(machine(), substeps=5, threads=2)
    assert np.array_equal(threads.step(a, u, nothing), first)


def test_a_row_that_had_no_value_has_its_own_parameters_afterwards(pendulum):
    """The models of a batch are kept while its parameters stay the same."""
    inputs, parameters = np.zeros((3, 2)), np.array([[0.1, 0.7], [0.5, 0.3], [0.2, 0.9]])
    fine = np.array([[0.4, 0.1], [0.8, -0.2], [0.1, 0.3]])
    lost = fine.copy()
    lost[1] = np.nan
    assert np.isnan(pendulum.step(lost, inputs, parameters)[1]).all()
    again = pendulum.step(fine, inputs, parameters)
    alone = [pendulum.step(fine[k:][:1], inputs[:1], parameters[k:][:1])[0] for k in range(3)]
    assert np.array_equal(again, alone)


def test_where_it_diverges_the_result_is_nan_with_a_reason(pendulum, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    state = np.array([[0.1, 0.0], [0.1, 1e11], [np.nan, 0.0], [0.1, 0.0]])
    inputs = np.zeros((4, 2))
    parameters = np.array([[0.1, 0.7], [0.1, 0.7], [0.1, 0.7], [0.1, -1.0]])
    found = pendulum.step(state, inputs, parameters)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:]).all()
    reasons = [pendulum.step.reason(*p) for p in zip(state, inputs, parameters, strict=True)]
    assert reasons[0] == ""
    assert "diverged" in reasons[1]
    assert reasons[2] == "an argument is not finite"
    assert reasons[3] == "bob.mass = -1 is not positive"
    assert os.listdir(tmp_path) == []  # the engine writes no log of it
    assert capfd.readouterr() == ("", "")
    assert np.array_equal(pendulum.step(state[:1], inputs[:1], parameters[:1]), found[:1])


def test_the_clock_of_the_engine_stands_still_within_a_call_alone(pendulum, monkeypatch):
    engine, set_to = pendulum.moves.function.engine, []
    at = np.zeros((2, 2)), np.zeros((2, 2)), np.array([[0.1, 0.7]] * 2)
    was, original = pendulum.step(*at), engine.set_mjcb_time
    assert engine.get_mjcb_time() is None

    def kept(clock):
        set_to.append(clock)
        original(clock)

    monkeypatch.setattr(engine, "set_mjcb_time", kept)
    pendulum.step(*at)
    assert [c and c() for c in set_to] == [0.0, None]

    def own():
        return 1.0

    original(own)
    try:
        assert np.array_equal(pendulum.step(*at), was)
        assert engine.get_mjcb_time() is own
    finally:
        original(None)


def test_activations_are_states_and_controls_of_actuators_inputs():
    simulator = mujoco(machine(), substeps=1)
    assert simulator.state[-1] == "slow_activation"
    assert simulator.inputs[:5] == ("push", "pull", "servo", "speed", "slow")
    state = np.zeros((1, len(simulator.state)))
    inputs = np.zeros((1, len(simulator.inputs)))
    inputs[0, 4] = 1.0
    # act' = (u - act) / 0.1, one step of Euler of 0.002 s
    assert simulator.step(state, inputs, np.empty((1, 0)))[0, -1] == pytest.approx(0.02, rel=1e-12)


def test_mappings_choose_and_rename():
    simulator = mujoco(
        PENDULUM, controls={"u": "motor"}, forces={"friction": "pivot"}, sensors={"x": "tip_0"},
        substeps=2,
    )  # fmt: skip
    assert (simulator.inputs, tuple(simulator.forces), simulator.outputs) == (
        ("u", "friction"), ("friction",), ("x",),
    )  # fmt: skip
    none = mujoco(PENDULUM, controls=(), forces=(), sensors=())
    assert (none.inputs, none.outputs) == ((), ())


def test_names_that_clash_or_are_no_identifiers_are_spelled_apart():
    text = PENDULUM.replace('motor name="motor"', 'motor name="pivot"')
    assert mujoco(text).inputs == ("pivot_control", "pivot_force")
    assert mujoco(PENDULUM.replace('name="motor" ', "")).inputs[0] == "pivot_control"
    text = PENDULUM.replace('"pivot"', '"left/pivot-1"')
    simulator = mujoco(text, parameters={"d": "left/pivot-1.damping"})
    assert simulator.state == ("left_pivot_1", "left_pivot_1_velocity")
    assert simulator.step.values == {"d": 0.3}


def test_a_file_and_its_pickle_move_alike(tmp_path, pendulum):
    path = tmp_path / "bob.xml"
    path.write_text(PENDULUM)
    simulator = mujoco(path, parameters={"damping": "pivot.damping", "m": "bob.mass"}, dt=0.1)
    assert simulator.name == "bob"
    given = np.array([[0.3, 0.1]]), np.array([[0.2, 0.0]]), np.array([[0.1, 0.9]])
    again = pickle.loads(pickle.dumps(simulator.step))
    assert again.interval == simulator.step.interval
    for one in (simulator.step, again):
        assert np.array_equal(one(*given), pendulum.step(*given))


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"parameters": {"d": "pivto.damping"}}, "names 'pivto'"),
        ({"parameters": {"d": "pivot.dampign"}}, "'dampign' of the joint"),
        ({"parameters": {"d": "damping"}}, "no object.attribute"),
        ({"parameters": {"d": 3.0}}, "'d' is 3.0"),
        ({"parameters": {"d": "pivot.range_lower"}}, "no range in the file"),
        ({"parameters": {"d": "motor.kp"}}, "no <position> servo"),
        ({"parameters": {"d": "world.mass"}}, "no mass in the file"),
        ({"parameters": {"d": "option.timestep"}, "dt": 0.1}, "the timestep is a parameter"),
        ({"controls": ["engine"]}, "no 'engine'"),
        ({"forces": ["motor"]}, "no 'motor'"),
        ({"sensors": ["speed"]}, "no 'speed'"),
        ({"sensors": {"x": "tip"}, "controls": {"pivot": "motor"}}, "stands twice"),
        ({"dt": 0.003}, "no multiple of the timestep"),
        ({"dt": 0.1, "substeps": 10}, "give dt alone, which takes 50"),
        ({"substeps": 0}, "no positive whole number"),
    ],
)
def test_what_does_not_fit_the_file_is_refused(options, found):
    with pytest.raises(ssm.ModelError, match=found):
        mujoco(PENDULUM, **options)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ('<joint name="pivot" axis="0 -1 0" damping="0.3" armature="0.05"/>',
         '<joint name="pivot" type="ball"/>', "a quaternion"),
        ('name="pivot" axis', "axis", "has no name"),
        ("</mujoco>", "</mujoc>", "cannot read the model"),
        ('<motor name="motor" joint="pivot" gear="2"/>',
         '<motor name="motor" joint="pivot" delay="0.01" nsample="5"/>', "delays"),
    ],
)  # fmt: skip
def test_files_without_a_vector_of_states_are_refused(old, new, found):
    text = PENDULUM.replace(old, new)
    if "has no name" in found:
        text = text[: text.index("<actuator>")] + "</mujoco>"
    if "quaternion" in found:
        text = text.replace('<jointpos name="angle" joint="pivot"/>', "")
    with pytest.raises(ssm.ModelError, match=found):
        mujoco(text)


def test_an_attribute_of_two_kinds_of_objects_needs_the_kind():
    text = PENDULUM.replace("<inertial", '<geom name="bob" size="0.1" mass="0.1"/><inertial')
    with pytest.raises(ssm.ModelError, match=r'"body:bob\.mass" or "geom:bob\.mass"'):
        mujoco(text, parameters={"m": "bob.mass"})
    assert mujoco(text, parameters={"m": "body:bob.mass"}).step.values == {"m": 0.7}


@pytest.mark.parametrize(
    ("effect", "argument", "shape", "wanted"),
    [
        ("coulomb friction", "pivot_force", {"v0": 0.1}, "frictionloss of the joint 'pivot': 0.25"),
        ("quadratic drag", "pivot_force", {}, "damping of .*second coefficient 0.25"),
        ("cubic stiffness", "pivot_force", {}, "stiffness of .*third coefficient 0.25"),
        ("hard stop", "pivot_force", {"h": 1.5}, "range of .*at 1.5 rad"),
        ("hard stop", "pivot_force", {"h": 1.5, "middle": 0.5}, "-1 to 2 rad"),
        ("input delay", "motor", {"delay": 2.0}, "delay of the actuator 'motor': "),
        ("gravity", "pivot_force", {}, "^$"),
        ("input delay", "pivot_force", {"delay": 2.0}, "^$"),
    ],
)  # fmt: skip
def test_which_attribute_carries_an_effect(pendulum, effect, argument, shape, wanted):
    told = pendulum.step.attribute_of(effect, argument, 0.25, shape)
    assert re.search(wanted, told)


def test_polynomials_of_speed_and_angle_are_the_engines():
    """damping="a b c" is -(a v + b v |v| + c v^3), stiffness="a b c" is -(a x + b x^2 + c x^3)."""
    engine = pytest.importorskip("mujoco")
    for given, values in (("damping", {1.0: -6.0, 2.0: -34.0, -2.0: 34.0}),
                          ("stiffness", {1.0: -6.0, 2.0: -34.0, -2.0: 18.0})):  # fmt: skip
        model = engine.MjModel.from_xml_string(
            f"<mujoco><worldbody><body><joint {given}='1 2 3'/><inertial pos='0 0 0' mass='1' "
            "diaginertia='1 1 1'/></body></worldbody></mujoco>"
        )
        for value, force in values.items():
            data = engine.MjData(model)
            data.qpos[0] = data.qvel[0] = value
            engine.mj_forward(model, data)
            assert data.qfrc_passive[0] == pytest.approx(force)
