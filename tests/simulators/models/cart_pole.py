"""A cart with a pole in MuJoCo: noise in the force on the cart, the pole's angle by a sensor."""

import ssmppl as ssm

XML = """<mujoco model="cart_pole">
<option timestep="0.005"><flag contact="disable"/></option>
<worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="0.5"/>
<geom type="box" size="0.1 0.05 0.05" mass="1"/>
<body name="pole"><joint name="hinge" axis="0 1 0" damping="0.05"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.6" mass="0.3"/></body></body></worldbody>
<actuator><motor name="push" joint="rail" gear="10"/></actuator>
<sensor><jointpos name="angle" joint="hinge"/><jointpos name="place" joint="rail"/></sensor>
</mujoco>"""

step = ssm.simulators.mujoco(
    XML, dt=0.05, name="cart_pole", parameters={"drag": "rail.damping", "d": "hinge.damping"}
)

cart_pole = ssm.Model("cart with pole", inputs=("u",))


@cart_pole.prior
def prior():
    return {
        "drag": ssm.LogNormal(-1, sd=1),
        "d": ssm.LogNormal(-3, sd=1),
        "noise": ssm.LogNormal(-1, sd=1),  # N
    }


@cart_pole.initial
def initial(noise):
    return {
        "x": ssm.Normal(0, sd=0.01),
        "a": ssm.Normal(0, sd=0.01),
        "vx": ssm.Normal(0, sd=0.01),
        "va": ssm.Normal(0, sd=0.01),
        "w": ssm.Normal(0, sd=noise),
    }


@cart_pole.transition
def transition(x, a, vx, va, w, u, drag, d, noise):
    new = step([x, a, vx, va], {"push": u, "rail_force": w}, [drag, d])
    return {
        "x": ssm.Dirac(new.rail),
        "a": ssm.Dirac(new.hinge),
        "vx": ssm.Dirac(new.rail_velocity),
        "va": ssm.Dirac(new.hinge_velocity),
        "w": ssm.Normal(0, sd=noise),
    }


@cart_pole.observation
def observation(x, a, vx, va, u, drag, d):
    sensed = step.sense([x, a, vx, va], {"push": u}, [drag, d])
    return {
        "angle": ssm.Normal(sensed.angle, sd=0.002),
        "place": ssm.Normal(sensed.place, sd=0.005),
    }
