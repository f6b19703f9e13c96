"""NAME: a signal that falls back to zero, measured with noise.

    x_1 ~ Normal(0, 1),    x_t+1 ~ Normal(a x_t, q),    y_t ~ Normal(x_t, r)

NAME.csv was simulated from it; the same again, and the first steps with it:

    SIMULATE
    ssmppl explain NAME.py NAME.csv
    ssmppl sample NAME.py NAME.csv --seed 1
"""

import ssmppl as ssm

model = ssm.Model("NAME")


# What is known of the parameters before the data are seen. The names of the arguments below say
# what each distribution depends on: parameters, states, and t, the number of the row.
@model.prior
def prior():
    return {
        "a": ssm.Uniform(-1, 1),
        "q": ssm.InverseGamma(2, scale=0.5),  # variances
        "r": ssm.InverseGamma(2, scale=0.5),
    }


# The state at the first row.
@model.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}


# The state at the next row, given that at this one.
@model.transition
def transition(x, a, q):
    return {"x": ssm.Normal(a * x, variance=q)}


# What is measured: the columns of the data. An empty cell is a missing value.
@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}
