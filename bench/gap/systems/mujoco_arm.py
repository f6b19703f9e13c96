"""An arm of two links that hang, in MuJoCo; u1 and u2 are the torques of its motors (N m).

y1 and y2 are the angles of shoulder and elbow (rad), read with noise. Rows of 20 ms, ten steps of
the engine each.
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
XML = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
<worldbody><body name="upper"><joint name="shoulder" axis="0 -1 0" damping="0.3"/>
<inertial pos="0 0 -0.22" mass="1.4" diaginertia="0.024 0.024 0.001"/>
<body name="fore" pos="0 0 -0.45"><joint name="elbow" axis="0 -1 0" damping="0.12"/>
<inertial pos="0 0 -0.19" mass="0.7" diaginertia="0.009 0.009 0.0005"/></body></body></worldbody>
<actuator><motor name="shoulder_motor" joint="shoulder"/><motor name="elbow_motor" joint="elbow"/>
</actuator></mujoco>"""

step = ssm.simulators.mujoco(
    XML,
    dt=0.02,
    name="arm",
    parameters={"d1": "shoulder.damping", "d2": "elbow.damping", "m": "fore.mass"},
)
model = ssm.Model("two-link arm", inputs=("u1", "u2"))


@model.prior
def prior():
    return {
        "d1": ssm.LogNormal(np.log(0.4 * GUESS), sd=1.0),
        "d2": ssm.LogNormal(np.log(0.2 * GUESS), sd=1.0),
        "m": ssm.LogNormal(np.log(1.0 * GUESS), sd=1.0),
        "s1": ssm.LogNormal(np.log(0.03 * NOISE), sd=1.0),
        "s2": ssm.LogNormal(np.log(0.03 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.003 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "q1": ssm.Normal(0.0, sd=0.01),
        "q2": ssm.Normal(0.0, sd=0.01),
        "v1": ssm.Normal(0.0, sd=0.01),
        "v2": ssm.Normal(0.0, sd=0.01),
    }


@model.transition
def transition(q1, q2, v1, v2, u1, u2, d1, d2, m, s1, s2):
    new = step([q1, q2, v1, v2], [u1, u2, 0.0, 0.0], [d1, d2, m])
    return {
        "q1": ssm.Dirac(new.shoulder),
        "q2": ssm.Dirac(new.elbow),
        "v1": ssm.Normal(new.shoulder_velocity, sd=s1),
        "v2": ssm.Normal(new.elbow_velocity, sd=s2),
    }


@model.observation
def observation(q1, q2, r):
    return {"y1": ssm.Normal(q1, sd=r), "y2": ssm.Normal(q2, sd=r)}
