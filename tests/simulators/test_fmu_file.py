"""`ssm.simulators.fmu` on units built here, against the same equations solved by SciPy."""

import pickle
import shutil

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ssmppl as ssm
from ssmppl.simulators import fmu

from .pendulum_fmu import VARIABLES, build

fmpy = pytest.importorskip("fmpy")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

DT = 0.05
POINTS = [(0.3, -0.2, 0.5, 8.0, 0.4), (2.0, 1.0, 0.0, 9.81, 0.1), (-1.0, 3.0, -2.0, 12.0, 0.0)]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return build(tmp_path_factory.mktemp("fmu"))


@pytest.fixture(scope="module")
def pendulum(path):
    return fmu(path, dt=DT, parameters=["k", "d"])


def exact(q, v, torque, k, d, dt=DT):
    def slopes(t, x):
        return [x[1], torque - k * np.sin(x[0]) - d * x[1]]

    return solve_ivp(slopes, (0, dt), [q, v], rtol=1e-12, atol=1e-12).y[:, -1]


def batch(points):
    points = np.array(points)
    return points[:, :2], points[:, 2:3], points[:, 3:]


def test_names_are_those_of_the_file(pendulum):
    assert pendulum.state == ("q", "v")
    assert pendulum.inputs == ("torque",)
    assert pendulum.parameters == ("k", "d")
    assert pendulum.outputs == ("tip",)
    assert pendulum.step.values == {"k": 9.81, "d": 0.1, "q": 0.1, "v": 0.0}


@pytest.mark.parametrize("version", [2, 3])
def test_a_step_is_that_of_its_equations(version, tmp_path):
    unit = fmu(build(tmp_path, version), dt=DT, parameters=["k", "d"])
    found = unit.step(*batch(POINTS))
    # Runge-Kutta in steps of 1 ms: an error of order 1e-12 here
    np.testing.assert_allclose(found, [exact(*p) for p in POINTS], rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        unit.step.output(*batch(POINTS))[:, 0], np.sin([p[0] for p in POINTS])
    )


def test_a_point_does_not_depend_on_the_others_or_on_former_calls(pendulum):
    first = pendulum.step(*batch(POINTS))
    assert np.array_equal(pendulum.step(*batch(POINTS[::-1])), first[::-1])
    assert np.array_equal(pendulum.step(*batch(POINTS[1:2])), first[1:2])


def test_parameters_that_are_not_named_keep_the_values_of_the_file_or_of_start(path):
    point = np.array([[0.4, 0.1]]), np.array([[0.2]]), np.empty((1, 0))
    own = fmu(path, dt=DT)
    np.testing.assert_allclose(own.step(*point)[0], exact(0.4, 0.1, 0.2, 9.81, 0.1), atol=1e-10)
    other = fmu(path, dt=DT, start={"k": 5.0})
    np.testing.assert_allclose(other.step(*point)[0], exact(0.4, 0.1, 0.2, 5.0, 0.1), atol=1e-10)


def test_mappings_rename(path):
    unit = fmu(
        path, dt=DT, state={"angle": "q", "speed": ("v", "v")}, inputs={"u": "torque"},
        parameters={"drag": "d"}, outputs={"y": "tip", "a": "der(v)"}, forces=["u"], substeps=2,
    )  # fmt: skip
    new = unit(angle=0.3, speed=-0.2, drag=0.4)  # the force is left out: 0
    np.testing.assert_allclose(new.vector, exact(0.3, -0.2, 0.0, 9.81, 0.4), atol=1e-10)
    sensed = unit.sense(angle=0.3, speed=-0.2, u=1.0, drag=0.4)
    assert sensed.a == pytest.approx(1.0 - 9.81 * np.sin(0.3) + 0.4 * 0.2, rel=1e-12)


def test_an_error_of_the_unit_is_nan_with_its_message(pendulum):
    points = [*POINTS, (999.9, 1e4, 0.0, 9.81, 0.1), (np.nan, 0.0, 0.0, 9.81, 0.1)]
    found = pendulum.step(*batch(points))
    assert np.isfinite(found[:3]).all()
    assert np.isnan(found[3:]).all()
    assert "the rope has torn" in pendulum.step.reason(*(a[3] for a in batch(points)))
    assert pendulum.step.reason(*(a[4] for a in batch(points))) == "an argument is not finite"
    assert pendulum.step.reason(*(a[0] for a in batch(points))) == ""
    assert np.array_equal(pendulum.step(*batch(points))[:3], found[:3])  # after the error too


def test_it_can_be_pickled(pendulum):
    again = pickle.loads(pickle.dumps(pendulum.step))
    assert np.array_equal(again(*batch(POINTS)), pendulum.step(*batch(POINTS)))


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"parameters": ["drag"]}, "no 'drag'"),
        ({"inputs": ["force"]}, "no 'force'"),
        ({"outputs": ["top"]}, "no 'top'"),
        ({"start": {"mass": 1}}, "no 'mass'"),
        ({"state": ["q"]}, "states v are not among"),
        ({"state": ["q", "v", "angle"]}, "no 'angle'"),
        ({"state": {"q": "q", "v": ("v", "v", "v")}}, "'v' is"),
        ({"state": ["q", "v", "tip"]}, "'tip' cannot be set"),
        ({"dt": 0.0}, "no positive number"),
        ({"substeps": 0}, "no positive whole number"),
    ],
)
def test_what_does_not_fit_the_file_is_refused(path, options, found):
    with pytest.raises(ssm.ModelError, match=found):
        fmu(path, **{"dt": DT, **options})


def test_a_state_that_the_unit_sets_otherwise_is_refused(path):
    with pytest.raises(ssm.ModelError, match=r"'q' was set to 0\.11 and is 0\.1 when it begins"):
        fmu(path, dt=DT, state={"q": ("d", "q"), "v": "v"})


def test_what_is_no_unit_is_refused(tmp_path):
    with pytest.raises(ssm.ModelError, match="there is no file"):
        fmu(tmp_path / "none.fmu", dt=DT)
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(ssm.ModelError, match="no functional mock-up unit"):
        fmu(tmp_path / "text.fmu", dt=DT)


def test_a_unit_that_keeps_more_than_its_state_is_refused(tmp_path):
    hidden = build(
        tmp_path, before="static double hidden;\n", hidden_reset="hidden = 0;",
        extra="+ (hidden += 1e-2)",
    )  # fmt: skip
    with pytest.raises(ssm.ModelError, match="keeps more than its state"):
        fmu(hidden, dt=DT)


def test_a_unit_that_depends_on_time_needs_the_time(tmp_path):
    timed = build(tmp_path, extra="+ 3 * cos(4 * t)")
    with pytest.raises(ssm.ModelError, match="keeps more than its state"):
        fmu(timed, dt=DT)
    unit = fmu(timed, dt=DT, time="t")
    assert unit.inputs == ("torque", "t")

    def slopes(t, x):
        return [x[1], 0.5 - 9.81 * np.sin(x[0]) - 0.1 * x[1] + 3 * np.cos(4 * t)]

    wanted = solve_ivp(slopes, (1.3, 1.3 + DT), [0.2, 0.1], rtol=1e-12, atol=1e-12).y[:, -1]
    found = unit(q=0.2, v=0.1, torque=0.5, t=1.3).vector
    np.testing.assert_allclose(found, wanted, atol=1e-10)


def test_a_state_that_its_start_value_does_not_set_is_refused(tmp_path):
    """Where a unit computes its state when it begins, from a parameter of its own."""
    variables = [list(v) for v in VARIABLES]
    variables[0][3:5] = ["calculated", ""]
    with pytest.raises(ssm.ModelError, match="'q' cannot be set"):
        fmu(build(tmp_path, variables=[tuple(v) for v in variables]), dt=DT)
