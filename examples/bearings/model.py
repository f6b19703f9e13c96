"""A ship tracked by bearings alone: constant velocity, and an observer who has to manoeuvre.

The state is position and velocity of the target, (east, north, v_east, v_north), in km and km per
minute; the noise is white acceleration over a step of one minute, so that position and velocity
are disturbed together. The observer's own position is an input. A bearing is the angle from
north, in radians. N. J. Gordon, D. J. Salmond and A. F. M. Smith, *IEE Proceedings F* 140 (1993),
have this problem with a fixed observer.
"""

import numpy as np

import ssmppl as ssm

I2 = np.eye(2)
MOVE = np.block([[I2, I2], [0 * I2, I2]])
NOISE = np.block([[I2 / 3, I2 / 2], [I2 / 2, I2]])

tracking = ssm.Model("bearings", inputs=("east", "north"))


@tracking.prior
def prior():
    return {
        "q": ssm.InverseGamma(3, scale=1e-3),  # of the acceleration, km^2/min^3
        "r": ssm.InverseGamma(3, scale=1e-3),  # variance of a bearing, rad^2
    }


@tracking.initial
def initial():
    mean = np.array([5.0, 12.0, 0.2, 0.0])
    return {"x": ssm.MvNormal(mean, covariance=np.diag([4.0, 4.0, 0.04, 0.04]))}


@tracking.transition
def transition(x, q):
    return {"x": ssm.MvNormal(MOVE @ x, covariance=q * NOISE)}


@tracking.observation
def observation(x, east, north, r):
    return {"bearing": ssm.Normal(np.arctan2(x[0] - east, x[1] - north), variance=r)}
