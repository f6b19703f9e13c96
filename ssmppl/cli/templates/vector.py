"""NAME: a position and its velocity, of which the position is measured with noise.

    x_t = (position, velocity),    x_t+1 ~ Normal(A x_t, q Q),    y_t ~ Normal(x_t[0], r)

NAME.csv was simulated from it; the same again, and the first steps with it:

    SIMULATE
    ssmppl explain NAME.py NAME.csv
    ssmppl sample NAME.py NAME.csv --seed 1
"""

import numpy as np

import ssmppl as ssm

model = ssm.Model("NAME")

STEP = 1.0  # time between two rows
A = np.array([[1.0, STEP], [0.0, 1.0]])  # the position moves with the velocity
Q = np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])  # of a velocity that drifts


# What is known of the parameters before the data are seen. The names of the arguments below say
# what each distribution depends on: parameters, states, and t, the number of the row.
@model.prior
def prior():
    return {
        "q": ssm.InverseGamma(2, scale=0.02),  # variances
        "r": ssm.InverseGamma(2, scale=0.5),
    }


# The state at the first row. Vectors are arrays; the CSV file has the columns x_0 and x_1.
@model.initial
def initial():
    return {"x": ssm.Normal(np.zeros(2), sd=np.array([10.0, 1.0]))}


# The state at the next row, given that at this one.
@model.transition
def transition(x, q):
    return {"x": ssm.MvNormal(A @ x, covariance=q * Q)}


# What is measured: the columns of the data. An empty cell is a missing value.
@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x[0], variance=r)}
