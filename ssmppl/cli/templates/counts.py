"""NAME: counts whose rate wanders about a level.

    x_t+1 ~ Normal(phi x_t, q),    y_t ~ Poisson(exp(level + x_t))

NAME.csv was simulated from it; the same again, and the first steps with it:

    SIMULATE
    ssmppl explain NAME.py NAME.csv
    ssmppl sample NAME.py NAME.csv --seed 1
"""

import numpy as np

import ssmppl as ssm

model = ssm.Model("NAME")


# What is known of the parameters before the data are seen. The names of the arguments below say
# what each distribution depends on: parameters, states, and t, the number of the row.
@model.prior
def prior():
    return {
        "level": ssm.Normal(0, sd=2),  # log of the rate
        "phi": ssm.Uniform(-1, 1),
        "q": ssm.InverseGamma(2, scale=0.1),  # a variance
    }


# The state at the first row: here the distribution that the transition keeps.
@model.initial
def initial(phi, q):
    return {"x": ssm.Normal(0, variance=q / (1 - phi**2))}


# The state at the next row, given that at this one.
@model.transition
def transition(x, phi, q):
    return {"x": ssm.Normal(phi * x, variance=q)}


# What is measured: the columns of the data. An empty cell is a missing value. For counts that
# scatter more, there is ssm.NegativeBinomial(mean, dispersion=...).
@model.observation
def observation(x, level):
    return {"y": ssm.Poisson(np.exp(level + x))}
