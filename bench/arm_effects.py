"""What a two-link arm in MuJoCo lacks, by `ssm.diagnose` on records of arms that have more.

    python bench/arm_effects.py [--kinds friction stop delay drag none] [--seeds 1 2 3 4 5]
        [--rows 500] [--mode full] [--processes 2] [--only-sysid]

The real arm is the model's file with one thing more, which the diagnosis is not told: dry friction
in the elbow (`frictionloss`), a stop at 65 degrees either way, motors that act four rows late, a
quadratic drag of the elbow, or nothing. Records have torques that are sums of sines, noise in both
speeds, encoders with 2 mrad of noise, ten steps of the engine a row. Right is an effect of that
kind first, in the elbow (of the delay: in one of the inputs); of nothing, that no effect is named.
Beside it `mujoco.sysid` (extra `mujoco[sysid]`) fits its three parameters to the same record: what
it makes of what is missing; `--only-sysid` prints that alone, as means and spreads over the seeds.
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from arms import ENCODER, XML, by_sysid, simulator, torques
from table import show

import ssmppl as ssm
from ssmppl.inference.run.executors import processes

TRUTH = {"d1": 0.2, "d2": 0.1, "m": 0.6, "s1": 0.02, "s2": 0.04}
LATE = 4  # rows
ELBOW = 'name="elbow" axis="0 -1 0" damping="0.1"'
KINDS = {  # what the elbow has, and the effects that say so
    "friction": (f'{ELBOW} frictionloss="0.15"', ("coulomb friction", "stribeck")),
    "stop": (f'{ELBOW} limited="true" range="-65 65" solreflimit="0.02 1"', ("hard stop",)),
    "drag": (ELBOW.replace('"0.1"', '"0.1 0.04"'), ("quadratic drag",)),
    "delay": (ELBOW, ("input delay", "actuator lag")),
    "none": (ELBOW, ()),
}


def model(xml: str, threads: int) -> ssm.Model:
    """The arm of `arms.py`, with noise in its speeds."""
    step, arm = simulator(xml, threads), ssm.Model("two-link arm", inputs=("u1", "u2"))

    @arm.prior
    def prior():
        return {
            "d1": ssm.LogNormal(-1, sd=1), "d2": ssm.LogNormal(-1, sd=1),
            "m": ssm.LogNormal(0, sd=0.5),
            "s1": ssm.LogNormal(-4, sd=1), "s2": ssm.LogNormal(-4, sd=1),
        }  # fmt: skip

    @arm.initial
    def initial():
        return {n: ssm.Normal(0.0, sd=0.01) for n in ("q1", "q2", "v1", "v2")}

    @arm.transition
    def transition(q1, q2, v1, v2, u1, u2, d1, d2, m, s1, s2):
        new = step([q1, q2, v1, v2], [u1, u2, 0.0, 0.0], [d1, d2, m])
        return {
            "q1": ssm.Dirac(new.shoulder), "q2": ssm.Dirac(new.elbow),
            "v1": ssm.Normal(new.shoulder_velocity, sd=s1),
            "v2": ssm.Normal(new.elbow_velocity, sd=s2),
        }  # fmt: skip

    @arm.observation
    def observation(q1, q2):
        return {"y1": ssm.Normal(q1, sd=ENCODER), "y2": ssm.Normal(q2, sd=ENCODER)}

    return arm


def record(kind: str, rows: int, seed: int) -> dict[str, np.ndarray]:
    """Of the arm that has more; of the delay the torques that were asked for."""
    assert ELBOW in XML
    real = model(XML.replace(ELBOW, KINDS[kind][0]), 1)
    asked = torques(rows, seed)
    used = asked
    if kind == "delay":
        used = {n: np.r_[np.zeros(LATE), v[:-LATE]] for n, v in asked.items()}
    made = ssm.simulate(real, TRUTH, steps=rows, inputs=used, seed=seed)
    return {n: made[n].values[0] for n in ("y1", "y2")} | asked


def right(kind: str, report: Any) -> bool:
    names = KINDS[kind][1]
    if not names:
        return report.verdict != "effect"
    if report.verdict != "effect" or not len(report.causes):
        return False
    best = report.causes.iloc[0]
    where = ("u1", "u2", "u1 and u2") if kind == "delay" else ("v2",)
    return best["effect"].startswith(names) and best["equation"] in where


def told(report: Any) -> str:
    if report.verdict != "effect":
        return str(report.verdict)
    best = report.causes.iloc[0]
    label = f"{best['effect']} in {best['equation']}"
    return f"{label}: {best['estimate']:.3f} ± {best['se']:.3f}"


def sysid(data: Mapping[str, np.ndarray]) -> str:
    if not (importlib.util.find_spec("colorama") and importlib.util.find_spec("mujoco.sysid")):
        return ""
    found, _ = by_sysid(data)
    return ", ".join(f"{n} {v:.3f}" for n, v in found.items())


def damped(kinds: Sequence[str], seeds: Sequence[int], rows: int) -> None:
    """What `mujoco.sysid` makes of what is missing, over the seeds."""
    lines = []
    for kind in kinds:
        found = [by_sysid(record(kind, rows, seed))[0] for seed in seeds]
        each = [np.array([f[n] for f in found]) for n in found[0]]
        lines.append([kind, *(f"{v.mean():.3f} ± {v.std(ddof=1):.3f}" for v in each)])
    show(["missing", *found[0]], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--rows", type=int, default=500)
    parser.add_argument("--mode", default="full", choices=("fast", "full"))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only-sysid", action="store_true")
    options = parser.parse_args()
    logging.getLogger("absl").setLevel(logging.ERROR)
    if options.only_sysid:
        damped(options.kinds, options.seeds, options.rows)
        return
    arm, rows = model(XML, 1), []
    for seed in options.seeds:
        for kind in options.kinds:
            data = record(kind, options.rows, seed)
            begun = time.perf_counter(), cpu_seconds()
            with processes(options.processes) as pool:
                report = ssm.diagnose(
                    arm, data, mode=options.mode, seed=seed, progress=False, executor=pool
                )
            seconds, cpu = time.perf_counter() - begun[0], cpu_seconds() - begun[1]
            carried = " ".join(str(v) for v in report.attributes.values())
            rows.append([
                kind, str(seed), "right" if right(kind, report) else "wrong", told(report),
                carried, f"{seconds:.0f}", f"{cpu:.0f}", sysid(data),
            ])  # fmt: skip
            print(*rows[-1], f"{len(report.left_out)} parts left out", sep=" | ", flush=True)
    show(["missing", "seed", "", "first", "in the file", "s", "CPU s", "mujoco.sysid"], rows)


def cpu_seconds() -> float:
    """Of this process and of those that it has waited for."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


if __name__ == "__main__":
    main()
