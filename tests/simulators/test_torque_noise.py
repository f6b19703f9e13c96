"""A cart with a pole and a two-link arm in MuJoCo, with noise in force and torques: the verbs."""

from pathlib import Path

import numpy as np
import pytest

import ssmppl as ssm
from tests.cli.shared import run

pytest.importorskip("mujoco")

ARM = {"d1": 0.2, "d2": 0.1, "m": 0.6, "noise": 0.3}
CART_POLE = {"drag": 0.5, "d": 0.05, "noise": 0.5}
FOLDER = Path(__file__).parent / "models"


def arm():
    from tests.simulators.models import two_link_arm

    return two_link_arm


def cart_pole():
    from tests.simulators.models import cart_pole

    return cart_pole


def record(model, parameters, rows, seed):
    """Simulated data of a model, under inputs that move it."""
    t = np.arange(rows)
    inputs = {
        name: (np.sin(0.31 * t + j) + 0.5 * np.sin(0.077 * t * (j + 1))) * (1 - 0.5 * j)
        for j, name in enumerate(model.inputs)
    }
    drawn = ssm.simulate(model, parameters, steps=rows, inputs=inputs, seed=seed)
    return {n: drawn[n].values[0] for n in model_channels(drawn)} | inputs


def model_channels(drawn):
    return [n for n in drawn if n in ("y1", "y2", "angle", "place")]


def extended_kalman(step, data, p):
    """Log-likelihood of the arm by the extended Kalman filter, written out; Jacobians by central
    differences of the simulator."""
    n, q, r = 4, p["noise"] ** 2, 0.002**2
    inputs = np.stack([data["u1"], data["u2"]], axis=1)
    y = np.stack([data["y1"], data["y2"]], axis=1)
    parameters = np.array([p["d1"], p["d2"], p["m"]])

    def moved(x, u):  # (B, 6) -> (B, 6): the torques' noise is drawn anew
        forces = np.concatenate([np.tile(u, (len(x), 1)), x[:, n:]], axis=1)
        new = step.step(x[:, :n], forces, np.tile(parameters, (len(x), 1)))
        return np.concatenate([new, np.zeros((len(x), 2))], axis=1)

    mean = np.array([0.2, 0, 0, 0, 0, 0])
    cov = np.diag([1e-4] * n + [q] * 2)
    total, h = 0.0, np.eye(2, 6)
    for t in range(len(y)):
        s = h @ cov @ h.T + r * np.eye(2)
        error = y[t] - h @ mean
        total -= 0.5 * (
            error @ np.linalg.solve(s, error) + np.linalg.slogdet(s)[1] + 2 * np.log(2 * np.pi)
        )
        gain = cov @ h.T @ np.linalg.inv(s)
        mean, cov = mean + gain @ error, cov - gain @ h @ cov
        steps = 1e-5 * np.eye(6)
        up, down = moved(mean + steps, inputs[t]), moved(mean - steps, inputs[t])
        jacobian = ((up - down) / 2e-5).T
        mean = moved(mean[None], inputs[t])[0]
        cov = jacobian @ cov @ jacobian.T + np.diag([0] * n + [q] * 2)
    return total


def test_the_log_likelihood_of_an_arm_is_that_of_the_extended_filter_written_out():
    """Both take central differences, of errors of order 1e-9 relative to values of order 1."""
    module = arm()
    data = record(module.arm, ARM, 40, seed=3)
    found = ssm.log_likelihood(module.arm, data, ARM, proposal="extended")
    wanted = extended_kalman(module.step, data, ARM)
    assert found[0] == pytest.approx(wanted, abs=1e-5)


def test_a_model_file_with_a_simulator_is_simulated_at_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.py").write_text((FOLDER / "two_link_arm.py").read_text())
    (tmp_path / "torques.csv").write_text("u1,u2\n" + "1,0.5\n" * 6)
    values = [part for n, v in ARM.items() for part in ("-p", f"{n}={v}")]
    run("simulate", "arm.py", "--inputs", "torques.csv", *values, "--seed", 1, "-o", "out.csv")
    drawn = np.genfromtxt("out.csv", delimiter=",", names=True)
    assert len(drawn) == 6
    assert np.isfinite(drawn["y1"]).all()
    assert np.ptp(drawn["y1"]) > 0.001


@pytest.mark.slow
@pytest.mark.parametrize(("of", "truth"), [(arm, ARM), (cart_pole, CART_POLE)])
def test_maximize_finds_the_parameters_within_three_standard_errors(of, truth):
    module = of()
    model = module.arm if of is arm else module.cart_pole
    data = record(model, truth, 120, seed=11)
    found = ssm.maximize(model, data, progress=False)
    for name, value in truth.items():
        error = found.standard_errors[name]
        assert abs(found.parameters[name] - value) < 3 * error, name
        assert error < 0.7 * value, name  # the record says something of it
