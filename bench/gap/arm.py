"""A two-link arm in MuJoCo, beside the true systems: data sets whose model calls an engine.

The real arm is the model's own file with one thing more, stepped here by MuJoCo itself: dry
friction in the elbow, a stop of the elbow either way, a drag of the elbow by the square of its
speed, or motors that act late. It is no `System` and has no filter of its own: strengths are drawn
between bounds set by hand, and how many nats they are worth is not solved. Its sets stand in
cells of their own, `arm` and `arm-none`, and the rivals that need a filter leave them out.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.gap.truth.forms import delayed
from bench.gap.truth.system import UNCERTAIN

MODEL = Path(__file__).parent / "systems" / "mujoco_arm.py"
NAME, CELL, CELL_NONE = "mujoco_arm", "arm", "arm-none"
ROWS, SUBSTEPS, DT = 400, 10, 0.02
PARAMETERS = {"d1": 0.3, "d2": 0.12, "m": 0.7, "s1": 0.02, "s2": 0.04, "r": 0.002}
ELBOW = 'name="elbow" axis="0 -1 0" damping="0.12"'


@dataclass(frozen=True)
class ArmEffect:
    """item, equations : as of `truth.Effect`. weakest, strongest : bounds of the strength."""

    item: str
    equations: tuple[str, ...]
    weakest: float
    strongest: float


EFFECTS = {
    "friction": ArmEffect("coulomb friction", ("v2",), 0.02, 0.08),  # N m
    "stop": ArmEffect("hard stop", ("v2",), 70.0, 90.0),  # degrees
    "drag": ArmEffect("quadratic drag", ("v2",), 0.0005, 0.003),  # N m s^2
    "delay": ArmEffect("input delay", ("u1", "u2"), 0.2, 1.0),  # rows
}


def turns(count: int) -> list[tuple[str, ...]]:
    """What so many sets of the cell `arm` hold: the effects in turn."""
    return [(list(EFFECTS)[k % len(EFFECTS)],) for k in range(count)]


def torques(rng: np.random.Generator) -> np.ndarray:
    """Sums of three sines a motor, N m, (ROWS, 2)."""
    t = DT * np.arange(ROWS)
    speeds, phases = rng.uniform(1.0, 8.0, (2, 3)), rng.uniform(0.0, 2 * np.pi, (2, 3))
    waves = np.sin(t[:, None, None] * speeds + phases).sum(axis=2)
    return waves * np.array([1.6, 0.6])


def engine_text(d2: float, key: str, strength: float) -> str:
    """The MJCF text of the arm as it is."""
    more = {
        "friction": f' frictionloss="{strength:.9g}"',
        "stop": f' limited="true" range="{-strength:.9g} {strength:.9g}" solreflimit="0.02 1"',
    }.get(key, "")
    damping = f"{d2:.9g} {strength:.9g}" if key == "drag" else f"{d2:.9g}"
    text = MODEL.read_text().split('XML = """')[1].split('"""')[0]
    assert ELBOW in text
    return text.replace(ELBOW, ELBOW.replace("0.12", damping) + more)


def simulate(
    p: np.ndarray, key: str, strength: float, asked: np.ndarray, rng: np.random.Generator | None
) -> np.ndarray:
    """Angles as read (ROWS, 2) under the torques asked for; without a generator, no noise."""
    import mujoco

    given = dict(zip(PARAMETERS, p.tolist(), strict=True))
    m = mujoco.MjModel.from_xml_string(engine_text(given["d2"], key, strength))
    m.dof_damping[0] = given["d1"]
    fore = m.body("fore").id
    m.body_inertia[fore] *= given["m"] / m.body_mass[fore]
    m.body_mass[fore] = given["m"]
    d = mujoco.MjData(m)
    mujoco.mj_setConst(m, d)
    used = np.stack([delayed(u, strength) for u in asked.T], 1) if key == "delay" else asked
    noise = np.zeros((len(asked), 2, 2)) if rng is None else rng.standard_normal((len(asked), 2, 2))
    if rng is not None:
        d.qpos[:], d.qvel[:] = 0.01 * rng.standard_normal((2, 2))
    Y = np.empty_like(asked)
    for t, u in enumerate(used):
        Y[t] = d.qpos + given["r"] * noise[t, 0]
        d.ctrl[:] = u
        for _ in range(SUBSTEPS):
            mujoco.mj_step(m, d)
        d.qvel[:] += noise[t, 1] * (given["s1"], given["s2"])
    return Y


def made(seed: int, effects: tuple[str, ...]) -> tuple[str, dict[str, float], dict[str, float]]:
    """(data.csv, parameters, strength of each effect) of one set."""
    rng = np.random.default_rng(seed)
    nominal = np.array(list(PARAMETERS.values()))
    p = nominal * np.exp(UNCERTAIN * rng.standard_normal(len(nominal)))
    asked = torques(rng)
    key, strength = "", 0.0
    for key in effects:
        bounds = np.log([EFFECTS[key].weakest, EFFECTS[key].strongest])
        strength = float(f"{np.exp(rng.uniform(*bounds)):.6g}")
    Y = simulate(p, key, strength, asked, rng)
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    write.writerow(["u1", "u2", "y1", "y2"])
    write.writerows([f"{v:.6g}" for v in row] for row in np.hstack([asked, Y]))
    told = {k: float(f"{v:.12g}") for k, v in zip(PARAMETERS, p, strict=True)}
    return out.getvalue(), told, {key: strength} if effects else {}
