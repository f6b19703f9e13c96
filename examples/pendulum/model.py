"""A pendulum on a motor: torque in, an encoder of 256 counts per turn out, twenty rows a second.

The state is angle and angular speed, (theta, omega); the angle is 0 where it hangs down. The noise
is white acceleration of spectral density q over a step of DT seconds, so that its two components
are correlated. What the encoder rounds away is taken as Normal noise of the same variance.
"""

import numpy as np

import ssmppl as ssm

DT = 0.05
COUNT = 2 * np.pi / 256  # resolution of the encoder, rad
NOISE = np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])

pendulum = ssm.Model("pendulum", inputs=("torque",))


@pendulum.prior
def prior():
    return {
        "k": ssm.Normal(20, sd=5),  # gravity over length, 1/s^2
        "c": ssm.Normal(0.5, sd=0.5),  # damping, 1/s
        "b": ssm.Normal(10, sd=5),  # acceleration by a torque of 1
        "q": ssm.InverseGamma(3, scale=1),
    }


@pendulum.initial
def initial():
    return {"x": ssm.MvNormal(np.zeros(2), covariance=np.diag([0.01, 0.01]))}


@pendulum.transition
def transition(x, torque, k, c, b, q):
    theta, omega = x[0], x[1]
    a = b * torque - k * np.sin(theta) - c * omega
    mean = np.stack([theta + DT * omega + DT**2 / 2 * a, omega + DT * a])
    return {"x": ssm.MvNormal(mean, covariance=q * NOISE)}


@pendulum.observation
def observation(x):
    return {"angle": ssm.Normal(x[0], sd=COUNT / np.sqrt(12))}
