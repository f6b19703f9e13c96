"""A two-link arm in MuJoCo: noise in the torques, encoders on both joints."""

import ssmppl as ssm

XML = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
<worldbody><body name="upper"><joint name="shoulder" axis="0 -1 0" damping="0.2"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.5" mass="1"/>
<body name="fore" pos="0 0 -0.5"><joint name="elbow" axis="0 -1 0" damping="0.1"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.4" mass="0.6"/></body></body></worldbody>
<actuator><motor name="shoulder_motor" joint="shoulder"/><motor name="elbow_motor" joint="elbow"/>
</actuator></mujoco>"""

step = ssm.simulators.mujoco(
    XML, dt=0.02, name="arm",
    parameters={"d1": "shoulder.damping", "d2": "elbow.damping", "m": "fore.mass"},
)  # fmt: skip

arm = ssm.Model("two-link arm", inputs=("u1", "u2"))


@arm.prior
def prior():
    return {
        "d1": ssm.LogNormal(-1.5, sd=1),
        "d2": ssm.LogNormal(-1.5, sd=1),
        "m": ssm.LogNormal(0, sd=0.5),
        "noise": ssm.LogNormal(-1, sd=1),  # N m, of both torques
    }


@arm.initial
def initial(noise):
    return {
        "q1": ssm.Normal(0.2, sd=0.01),
        "q2": ssm.Normal(0, sd=0.01),
        "v1": ssm.Normal(0, sd=0.01),
        "v2": ssm.Normal(0, sd=0.01),
        "w1": ssm.Normal(0, sd=noise),
        "w2": ssm.Normal(0, sd=noise),
    }


@arm.transition
def transition(q1, q2, v1, v2, w1, w2, u1, u2, d1, d2, m, noise):
    new = step(
        shoulder=q1, elbow=q2, shoulder_velocity=v1, elbow_velocity=v2, shoulder_motor=u1,
        elbow_motor=u2, shoulder_force=w1, elbow_force=w2, d1=d1, d2=d2, m=m,
    )  # fmt: skip
    return {
        "q1": ssm.Dirac(new.shoulder),
        "q2": ssm.Dirac(new.elbow),
        "v1": ssm.Dirac(new.shoulder_velocity),
        "v2": ssm.Dirac(new.elbow_velocity),
        "w1": ssm.Normal(0, sd=noise),
        "w2": ssm.Normal(0, sd=noise),
    }


@arm.observation
def observation(q1, q2):
    return {"y1": ssm.Normal(q1, sd=0.002), "y2": ssm.Normal(q2, sd=0.002)}
