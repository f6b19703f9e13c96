"""A two-link arm in MuJoCo with noise in its torques: parameters from simulated records, by ssmppl
and by `mujoco.sysid`.

    python bench/arms.py [--records 20] [--rows 500] [--threads 1]

Each record is simulated by the model itself: ten steps of 2 ms a row, independent torque noise of
0.3 N m in each row on both joints, encoders with 2 mrad of noise. ssmppl maximises the likelihood
of the extended Kalman filter, of two dampings, a mass and the sd of the noise. `mujoco.sysid`
(extra `mujoco[sysid]`), told the true initial state, fits dampings and mass by least squares over
the whole record at once, which takes all that the arm does for an effect of parameters and
encoders; its intervals are those that it computes from the residuals.

Printed for both: mean and root mean square of the errors, in how many of the records an interval of
two standard errors holds the truth, and the median time of a record. Two standard errors hold it in
95 of 100, of 20 records in 17 or more with a probability of 0.99.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import logging
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from table import show

import ssmppl as ssm

XML = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
<worldbody><body name="upper"><joint name="shoulder" axis="0 -1 0" damping="0.2"/>
<inertial pos="0 0 -0.25" mass="1" diaginertia="0.02 0.02 0.001"/>
<body name="fore" pos="0 0 -0.5"><joint name="elbow" axis="0 -1 0" damping="0.1"/>
<inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.008 0.008 0.0005"/></body></body></worldbody>
<actuator><motor name="shoulder_motor" joint="shoulder"/><motor name="elbow_motor" joint="elbow"/>
</actuator></mujoco>"""
TRUTH = {"d1": 0.2, "d2": 0.1, "m": 0.6, "noise": 0.3}
START = {"d1": 0.5, "d2": 0.5, "m": 1.0}  # where mujoco.sysid begins
DT, SUBSTEPS, ENCODER = 0.02, 10, 0.002


def simulator(xml: str, threads: int) -> ssm.Simulator:
    """An arm, two dampings and a mass its parameters."""
    return ssm.simulators.mujoco(
        xml, dt=DT, name="arm", threads=threads,
        parameters={"d1": "shoulder.damping", "d2": "elbow.damping", "m": "fore.mass"},
    )  # fmt: skip


def model(threads: int) -> ssm.Model:
    """The arm, with the noise of each row's torques as states that the next row draws anew."""
    step = simulator(XML, threads)
    arm = ssm.Model("two-link arm", inputs=("u1", "u2"))

    @arm.prior
    def prior():
        return {
            "d1": ssm.LogNormal(-1, sd=1), "d2": ssm.LogNormal(-1, sd=1),
            "m": ssm.LogNormal(0, sd=0.5), "noise": ssm.LogNormal(-1, sd=1),
        }  # fmt: skip

    @arm.initial
    def initial(noise):
        still = {n: ssm.Dirac(0.0) for n in ("q1", "q2", "v1", "v2")}
        return still | {"w1": ssm.Normal(0, sd=noise), "w2": ssm.Normal(0, sd=noise)}

    @arm.transition
    def transition(q1, q2, v1, v2, w1, w2, u1, u2, d1, d2, m, noise):
        new = step([q1, q2, v1, v2], [u1, u2, w1, w2], [d1, d2, m])
        moved = zip(("q1", "q2", "v1", "v2"), new.values(), strict=True)
        return {n: ssm.Dirac(v) for n, v in moved} | {
            "w1": ssm.Normal(0, sd=noise), "w2": ssm.Normal(0, sd=noise),
        }  # fmt: skip

    @arm.observation
    def observation(q1, q2):
        return {"y1": ssm.Normal(q1, sd=ENCODER), "y2": ssm.Normal(q2, sd=ENCODER)}

    return arm


def torques(rows: int, seed: int) -> dict[str, np.ndarray]:
    """Sums of sines that move both links, N m."""
    rng, t = np.random.default_rng(seed), DT * np.arange(rows)
    out = {}
    for name, size in (("u1", 2.0), ("u2", 0.7)):
        speeds, phases = rng.uniform(1.0, 8.0, 3), rng.uniform(0.0, 2 * np.pi, 3)
        out[name] = size * np.sin(np.outer(t, speeds) + phases).sum(axis=1) / 1.5
    return out


def by_ssmppl(arm: ssm.Model, data: Mapping[str, np.ndarray]) -> tuple[dict, dict]:
    found = ssm.maximize(arm, data, progress=False)
    return (
        {n: float(found.parameters[n]) for n in TRUTH},
        {n: float(found.standard_errors[n]) for n in TRUTH},
    )


def by_sysid(data: Mapping[str, np.ndarray]) -> tuple[dict, dict]:
    """Least squares of MuJoCo's own toolbox; standard errors of its covariance."""
    import mujoco
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(XML)
    compiled = spec.compile()

    def scaled(spec: Any, parameter: Any) -> None:  # as ssmppl sets a mass: the inertia with it
        body, value = spec.body("fore"), float(parameter.value[0])
        body.mass = value
        body.inertia = np.array([0.008, 0.008, 0.0005]) * value / 0.6

    setters = {
        "d1": lambda s, p: s.joint("shoulder").damping.__setitem__(0, p.value[0]),
        "d2": lambda s, p: s.joint("elbow").damping.__setitem__(0, p.value[0]),
        "m": scaled,
    }
    parameters = sysid.ParameterDict()
    for name, setter in setters.items():
        parameters.add(sysid.Parameter(name, START[name], 1e-3, 5.0, modifier=setter))
    y = np.stack([data["y1"], data["y2"]], axis=1)
    times = DT * np.arange(len(y))
    fine = compiled.opt.timestep * np.arange((len(y) - 1) * SUBSTEPS + 1)
    held = np.repeat(np.stack([data["u1"], data["u2"]], axis=1), SUBSTEPS, axis=0)[: len(fine)]
    sequences = sysid.ModelSequences(
        "arm", spec, "record",
        sysid.create_initial_state(compiled, np.zeros(2), np.zeros(2)),
        sysid.TimeSeries(fine, held),
        sysid.TimeSeries.from_names(times, y, compiled, ["shoulder_qpos", "elbow_qpos"]),
        allow_missing_sensors=True,
    )  # fmt: skip
    residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=1)
    with contextlib.redirect_stdout(io.StringIO()):  # the optimiser's own lines
        fitted, result = sysid.optimize(parameters, residual, optimizer="scipy", verbose=False)
    residuals, _, _ = residual(result.x, fitted)
    covariance, _ = sysid.calculate_intervals(residuals, result.jac)
    sds = np.sqrt(np.diag(covariance))
    return (
        {n: float(fitted[n].value[0]) for n in setters},
        dict(zip(setters, sds.tolist(), strict=True)),
    )


def summary(name: str, found: list[tuple[dict, dict]], seconds: list[float]) -> list[list[str]]:
    rows = []
    for n in found[0][0]:
        errors = np.array([estimate[n] - TRUTH[n] for estimate, _ in found])
        sds = np.array([sd[n] for _, sd in found])
        rows.append([
            name, n, f"{TRUTH[n]:g}", f"{errors.mean():+.4f}", f"{np.sqrt(np.mean(errors**2)):.4f}",
            f"{np.median(sds):.4f}", f"{int(np.sum(np.abs(errors) < 2 * sds))}/{len(errors)}",
            f"{np.median(seconds):.1f}",
        ])  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--records", type=int, default=20)
    parser.add_argument("--rows", type=int, default=500)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    logging.getLogger("absl").setLevel(logging.ERROR)  # encoders stand for sensors: it warns
    arm = model(options.threads)
    rivals: dict[str, Any] = {"ssmppl": lambda data: by_ssmppl(arm, data)}
    if importlib.util.find_spec("colorama") and importlib.util.find_spec("mujoco.sysid"):
        rivals["mujoco.sysid"] = by_sysid
    found: dict[str, list] = {name: [] for name in rivals}
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    for k in range(options.records):
        u = torques(options.rows, k)
        record = ssm.simulate(arm, TRUTH, steps=options.rows, inputs=u, seed=k)
        data = {n: record[n].values[0] for n in ("y1", "y2")} | u
        for name, fit in rivals.items():
            begun = time.process_time()
            found[name].append(fit(data))
            seconds[name].append(time.process_time() - begun)
            print(k, name, found[name][-1], f"{seconds[name][-1]:.1f} s", flush=True)
    table = [row for name in rivals for row in summary(name, found[name], seconds[name])]
    show(
        ["by", "parameter", "truth", "mean error", "rms error", "standard error", "within 2",
         "CPU s"], table,
    )  # fmt: skip


if __name__ == "__main__":
    main()
