"""What comes before an answer, compilation and a first start, and after a fit, `diagnose`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path

import numpy as np

import ssmppl as ssm

from ..peers import starts
from ..peers.tasks import Task
from .question import OWN, Answer, Program, Question, Run, Unavailable

# --- compilation of 25 Runge-Kutta steps in a transition -----------------------------------------

RUNGE_KUTTA = """
import json, sys, time
import numpy as np
import ssmppl as ssm
steps, stiffness, proposal = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
model = ssm.Model("pendulum by Runge and Kutta", inputs=("u",))

@model.initial
def initial():
    return {"q": ssm.Normal(0, sd=0.2), "v": ssm.Normal(0, sd=0.2)}

def slope(q, v, u):
    return v, u - stiffness * np.sin(q) - 0.5 * v

@model.transition
def transition(q, v, u):
    h = 0.05 / steps
    for _ in range(steps):
        a, b = slope(q, v, u)
        c, d = slope(q + h / 2 * a, v + h / 2 * b, u)
        e, f = slope(q + h / 2 * c, v + h / 2 * d, u)
        g, i = slope(q + h * e, v + h * f, u)
        q, v = q + h / 6 * (a + 2 * c + 2 * e + g), v + h / 6 * (b + 2 * d + 2 * f + i)
    return {"q": ssm.Normal(q, sd=0.002), "v": ssm.Normal(v, sd=0.04)}

@model.observation
def observation(q):
    return {"y": ssm.Normal(q, sd=0.01)}

from bench.questions.pendulum import series
data = series()
runs = []
for _ in range(2):  # the first one compiles
    began = time.perf_counter(), time.process_time()
    values = ssm.log_likelihood(
        model, data, {}, proposal=proposal, particles=1000, repeats=4, seed=1
    )
    runs.append((time.perf_counter() - began[0], time.process_time() - began[1]))
print(json.dumps([runs[0][0] - runs[1][0], runs[0][1] - runs[1][1], values.tolist()]))
"""
# The log-likelihood by an extended Kalman filter, its derivatives by differences; and how far the
# mean of four particle filters may be from it: four standard errors and the bias of a logarithm.
EXTENDED, SCATTER = 2032.03, {"bootstrap": 6.0, "twisted": 0.3}


def _python(code: str, *arguments: str, cache: str) -> str:
    """What a new process prints, with a folder of its own for compiled models."""
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=root,
        env={**os.environ, "SSMPPL_CACHE": cache},
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    return done.stdout


def runge_kutta(proposal: str) -> Run:
    """Seconds of compilation, where the algorithms are there and the model is new: the first
    log-likelihood less a second one. A model of one step compiles the algorithms beforehand; the
    stiffness is a little different each time, so that the model is new."""
    kept, made = tempfile.TemporaryDirectory(), count(1)
    _python(RUNGE_KUTTA, "1", "9.0", proposal, cache=kept.name)

    def run(seed: int) -> Answer:
        stiffness = str(9.0 + 1e-9 * next(made))
        said = _python(RUNGE_KUTTA, "25", stiffness, proposal, cache=kept.name)
        wall, processor, values = json.loads(said)
        mean, sd = float(np.mean(values)), float(np.std(values))
        remarks = {"log-likelihood": mean, "its standard deviation": sd}
        return Answer({}, remarks, seconds=wall, processor=processor)

    return run


def runge_kutta_faults(proposal: str, own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where it is further from an extended Kalman filter's than particles scatter."""
    value, most = float(own.remarks["log-likelihood"]), SCATTER[proposal]
    if abs(value - EXTENDED) <= most:
        return []
    return [f"the log-likelihood is {value:.2f}, by an extended filter {EXTENDED}"]


# --- a first log-likelihood ----------------------------------------------------------------------


def first(module: str) -> Run:
    """From the interpreter's start to a log-likelihood of the varves (`bench/peers/starts.py`)."""
    package = {"particles_": "particles", "jax_by_hand": "jax", "pypomp_": "pypomp"}.get(module)
    if package is not None:
        import_module(package)
    work = starts.prepare(module, Task("start-cold", 1_000, "", "", 1.0, 1))
    if work is None:
        raise Unavailable("it has no such start")

    def run(seed: int) -> Answer:
        work()
        return Answer()

    return run


# --- a diagnosis ---------------------------------------------------------------------------------

STEP, HEATER_ROWS = 4.0, 201  # seconds a row
SENSOR = 25.0  # seconds by which the sensor lags, which the model does not know


def heating() -> dict[str, np.ndarray]:
    """Temperature y (201,) in degrees by a sensor with a lag, heater u (201,) in percent."""
    rng, t = np.random.default_rng(6), np.arange(HEATER_ROWS)
    u = np.where(t % 80 < 45, 60.0, 15.0)
    u[:5] = 0.0
    inside = shown = 21.0
    y = np.empty(HEATER_ROWS)
    for row in range(HEATER_ROWS):
        y[row] = shown + 0.05 * rng.normal()
        shown += STEP / SENSOR * (inside - shown)
        inside += STEP * (0.012 * u[row] - 0.012 * (inside - 21.0)) + 0.03 * rng.normal()
    return {"y": y, "u": u}


def heater() -> ssm.Model:
    """One thermal mass, measured without a lag."""
    made = ssm.Model("heater", inputs=("u",))

    @made.prior
    def prior():
        return {
            "a": ssm.HalfNormal(sd=0.1), "b": ssm.HalfNormal(sd=0.1), "Ta": ssm.Normal(21, sd=2),
            "q": ssm.HalfNormal(sd=0.5), "r": ssm.HalfNormal(sd=0.5),
        }  # fmt: skip

    @made.initial
    def initial(Ta):
        return {"T": ssm.Normal(Ta, sd=1)}

    @made.transition
    def transition(T, u, a, b, Ta, q):
        return {"T": ssm.Normal(T + 4 * (b * u - a * (T - Ta)), sd=q)}

    @made.observation
    def observation(T, r):
        return {"y": ssm.Normal(T, sd=r)}

    return made


def diagnosis() -> Run:
    made, data = heater(), heating()

    def run(seed: int) -> Answer:
        report = ssm.diagnose(made, data, seed=seed, progress=False)
        remarks = {"verdict": report.verdict, "chosen": ", ".join(report.chosen) or "none"}
        if len(report.left_out):
            remarks["left out"] = ", ".join(map(str, report.left_out.iloc[:, 0]))
        return Answer({}, remarks)

    return run


def diagnosis_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where it does not see that there is a gap, or leaves parts of the report out."""
    out = [f"left out: {own.remarks['left out']}"] if "left out" in own.remarks else []
    if "no measurable gap" in str(own.remarks["verdict"]):
        out.append("the lag of the sensor is not seen")
    return out


def _right(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    return []


QUESTIONS = [
    Question(
        f"runge-kutta-{proposal}",
        f"25 Runge-Kutta steps in the transition: compilation, {proposal}", 2.0,
        (Program(OWN, partial(runge_kutta, proposal)),),
        partial(runge_kutta_faults, proposal),
    )
    for proposal in ("bootstrap", "twisted")
] + [
    Question("diagnose", "`diagnose`, one state, 201 rows", 30.0,
             (Program(OWN, diagnosis),), diagnosis_faults),
    Question(
        "first", "first log-likelihood on a machine that never ran it, from source", 3.0,
        (
            Program(OWN, partial(first, "own")),
            Program("particles", partial(first, "particles_"), ("particles",)),
            Program("JAX by hand", partial(first, "jax_by_hand"), ("jax",)),
            Program("pypomp", partial(first, "pypomp_"), ("pypomp",)),
        ),
        _right,
    ),
]  # fmt: skip
