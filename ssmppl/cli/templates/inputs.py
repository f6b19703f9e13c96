"""NAME: a body that is heated and loses heat, its temperature measured with noise.

    x_t+1 ~ Normal(x_t - loss x_t + gain u_t, q),    y_t ~ Normal(x_t, r)

The input u_t, the heating, acts in the step from row t to row t + 1; it is a column of the data.
NAME.csv was simulated from the model; the same again, and the first steps with it:

    SIMULATE
    ssmppl explain NAME.py NAME.csv
    ssmppl sample NAME.py NAME.csv --seed 1
"""

import ssmppl as ssm

model = ssm.Model("NAME", inputs=("u",))


# What is known of the parameters before the data are seen. The names of the arguments below say
# what each distribution depends on: parameters, states, inputs, and t, the number of the row.
@model.prior
def prior():
    return {
        "loss": ssm.Uniform(0, 1),  # share of the heat that is lost in a step
        "gain": ssm.Normal(0, sd=5),
        "q": ssm.InverseGamma(2, scale=0.05),  # variances
        "r": ssm.InverseGamma(2, scale=0.2),
    }


# The state at the first row.
@model.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}


# The state at the next row, given that at this one and the input.
@model.transition
def transition(x, u, loss, gain, q):
    return {"x": ssm.Normal(x - loss * x + gain * u, variance=q)}


# What is measured: the columns of the data. An empty cell is a missing value.
@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}
