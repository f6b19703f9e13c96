"""Models with plausible parameters for the tests of the diagnosis, and data simulated from them.

`MODELS` maps a name to a function that declares the model, `THETA` gives its parameters and
`INPUTS` functions of (T, random generator) giving its inputs.
"""

import numpy as np

import ssmppl as ssm
from ssmppl.language.tracing import trace
from tests.statistics.checks import seed_of

MODELS, THETA, INPUTS = {}, {}, {}


def register(theta, **inputs):
    def add(declare):
        MODELS[declare.__name__] = declare
        THETA[declare.__name__], INPUTS[declare.__name__] = theta, inputs
        return declare

    return add


def build(name):
    """A fresh model."""
    return MODELS[name]()


def inputs_of(name, steps, seed=0):
    """The model's inputs, (T,) or (T, n) each; an empty dict where it has none."""
    rng = np.random.default_rng(seed_of("inputs", name, seed))
    return {key: make(steps, rng) for key, make in INPUTS[name].items()}


def simulated(name, steps=200, seed=0, parameters=None):
    """Data (inputs and observations, arrays by name) simulated from a model at `THETA`."""
    inputs = inputs_of(name, steps, seed)
    given = THETA[name] | (parameters or {})
    drawn = ssm.simulate(build(name), given, steps=steps, inputs=inputs or None,
                         seed=seed_of("data", name, seed))  # fmt: skip
    channels = trace(build(name)).observations
    return inputs | {c: drawn[c].values[0] for c in channels}


def coloured(scale, memory=0.9):
    """Coloured noise of that standard deviation."""

    def make(steps, rng):
        out, noise = np.zeros(steps), rng.standard_normal(steps) * np.sqrt(1 - memory**2)
        for t in range(steps):
            out[t] = memory * out[t - 1] + noise[t] if t else rng.standard_normal()
        return scale * out

    return make


def steps_up_and_down(levels, length=40):
    """A staircase, as pumps are driven."""

    def make(steps, rng):
        return np.repeat(rng.choice(levels, steps // length + 1), length)[:steps]

    return make


OSCILLATOR = {"k": 1.0, "c": 0.4, "b": 1.0, "q": 0.1, "r": 0.1}


@register(OSCILLATOR, u=coloured(2.0))
def oscillator():
    """Position that integrates a noisy velocity; position measured."""
    model = ssm.Model("oscillator", inputs=("u",))

    @model.prior
    def prior():
        return {"k": ssm.HalfNormal(sd=3), "c": ssm.HalfNormal(sd=2), "b": ssm.Normal(0, sd=3),
                "q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=1)}  # fmt: skip

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=0.5), "v": ssm.Normal(0, sd=0.5)}

    @model.transition
    def transition(x, v, u, k, c, b, q):
        return {
            "x": ssm.Dirac(x + 0.1 * v),
            "v": ssm.Normal(v + 0.1 * (-k * x - c * v + b * u), sd=q),
        }

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, sd=r)}

    return model


@register(OSCILLATOR | {"p": 0.05}, u=coloured(2.0))
def noisy_oscillator():
    """The oscillator with noise on both states."""
    model = ssm.Model("noisy oscillator", inputs=("u",))

    @model.prior
    def prior():
        return {"k": ssm.HalfNormal(sd=3), "c": ssm.HalfNormal(sd=2), "b": ssm.Normal(0, sd=3),
                "p": ssm.HalfNormal(sd=1), "q": ssm.HalfNormal(sd=1),
                "r": ssm.HalfNormal(sd=1)}  # fmt: skip

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=0.5), "v": ssm.Normal(0, sd=0.5)}

    @model.transition
    def transition(x, v, u, k, c, b, p, q):
        return {
            "x": ssm.Normal(x + 0.1 * v, sd=p),
            "v": ssm.Normal(v + 0.1 * (-k * x - c * v + b * u), sd=q),
        }

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, sd=r)}

    return model


@register({"gain": 9.81, "damping": 0.3, "q": 0.1, "r": 0.05}, torque=coloured(2.0))
def pendulum():
    """Nonlinear in its angle; angle and speed measured."""
    model = ssm.Model("pendulum", inputs=("torque",))
    dt = 0.05

    @model.prior
    def prior():
        return {"gain": ssm.HalfNormal(sd=20), "damping": ssm.HalfNormal(sd=1),
                "q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=1)}  # fmt: skip

    @model.initial
    def initial():
        return {"angle": ssm.Normal(0.5, sd=0.1), "speed": ssm.Normal(0, sd=0.1)}

    @model.transition
    def transition(angle, speed, torque, gain, damping, q):
        pull = -gain * np.sin(angle) - damping * speed + torque
        return {
            "angle": ssm.Dirac(angle + dt * speed),
            "speed": ssm.Normal(speed + dt * pull, sd=q),
        }

    @model.observation
    def observation(angle, speed, r):
        return {"angle_m": ssm.Normal(angle, sd=r), "speed_m": ssm.Normal(speed, sd=4 * r)}

    return model


@register({"k1": 0.08, "k2": 0.07, "b": 0.12, "q": 0.01, "r": 0.05},
          pump=steps_up_and_down([0.8, 1.2, 1.6, 2.0]))  # fmt: skip
def two_tanks():
    """Two tanks in a row, outflow by Torricelli's law; the lower level measured."""
    model = ssm.Model("two tanks", inputs=("pump",))

    @model.prior
    def prior():
        return {"k1": ssm.HalfNormal(sd=0.5), "k2": ssm.HalfNormal(sd=0.5),
                "b": ssm.HalfNormal(sd=0.5), "q": ssm.HalfNormal(sd=0.1),
                "r": ssm.HalfNormal(sd=0.5)}  # fmt: skip

    @model.initial
    def initial():
        return {"h1": ssm.Normal(4, sd=0.3), "h2": ssm.Normal(5, sd=0.3)}

    @model.transition
    def transition(h1, h2, pump, k1, k2, b, q):
        out1 = k1 * np.sqrt(np.maximum(h1, 0.0))
        out2 = k2 * np.sqrt(np.maximum(h2, 0.0))
        return {
            "h1": ssm.Normal(h1 - out1 + b * pump, sd=q),
            "h2": ssm.Normal(h2 + out1 - out2, sd=q),
        }

    @model.observation
    def observation(h2, r):
        return {"level": ssm.Normal(h2, sd=r)}

    return model


@register({"phi": 0.8, "q": 1.0, "r": 0.5})
def ar1():
    """An autoregression behind white noise, stationary from the start."""
    model = ssm.Model("ar1")

    @model.prior
    def prior():
        return {"phi": ssm.Uniform(-1, 1), "q": ssm.HalfNormal(sd=2), "r": ssm.HalfNormal(sd=2)}

    @model.initial
    def initial(phi, q):
        return {"x": ssm.Normal(0, variance=q**2 / (1 - phi**2))}

    @model.transition
    def transition(x, phi, q):
        return {"x": ssm.Normal(phi * x, sd=q)}

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, sd=r)}

    return model


@register({"level_variance": 1469.0, "noise_variance": 15099.0})
def local_level():
    """A random walk behind white noise, as fitted to the Nile."""
    model = ssm.Model("local level")

    @model.prior
    def prior():
        return {"level_variance": ssm.InverseGamma(0.01, scale=0.01),
                "noise_variance": ssm.InverseGamma(0.01, scale=0.01)}  # fmt: skip

    @model.initial
    def initial():
        return {"level": ssm.Normal(1000, sd=300)}

    @model.transition
    def transition(level, level_variance):
        return {"level": ssm.Normal(level, variance=level_variance)}

    @model.observation
    def observation(level, noise_variance):
        return {"flow": ssm.Normal(level, variance=noise_variance)}

    return model


@register({"beta": 0.3, "gamma": 0.15, "report": 0.3, "s": 0.08})
def epidemic():
    """Logs of susceptible and infected shares with noisy infection; counted cases."""
    model = ssm.Model("epidemic")
    population = 20000.0

    @model.prior
    def prior():
        return {"beta": ssm.HalfNormal(sd=1), "gamma": ssm.HalfNormal(sd=1),
                "report": ssm.Beta(2, 2), "s": ssm.HalfNormal(sd=0.5)}  # fmt: skip

    @model.initial
    def initial():
        return {"log_s": ssm.Normal(-0.01, sd=0.005), "log_i": ssm.Normal(-4.5, sd=0.2)}

    @model.transition
    def transition(log_s, log_i, beta, gamma, s):
        return {
            "log_s": ssm.Dirac(log_s - beta * np.exp(log_i)),
            "log_i": ssm.Normal(log_i + beta * np.exp(log_s) - gamma, sd=s),
        }

    @model.observation
    def observation(log_i, gamma, report):
        return {"cases": ssm.Poisson(report * gamma * population * np.exp(log_i))}

    return model


VECTOR = {"A": np.array([[0.8, 0.1], [-0.2, 0.7]]), "b": np.array([0.5, 0.0]), "q": 0.3, "r": 0.2}


@register(VECTOR, u=coloured(1.0))
def vector():
    """A state of two components with correlated noise; both measured as one channel."""
    model = ssm.Model("vector", inputs=("u",))

    @model.prior
    def prior():
        return {"A": ssm.Normal(np.zeros((2, 2)), sd=1), "b": ssm.Normal(np.zeros(2), sd=1),
                "q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=1)}  # fmt: skip

    @model.initial
    def initial():
        return {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))}

    @model.transition
    def transition(x, u, A, b, q):
        noise = q**2 * np.array([[1.0, 0.4], [0.4, 1.0]])
        return {"x": ssm.MvNormal(A @ x + b * u, covariance=noise)}

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, sd=r)}

    return model


def _machine(start):
    """A simulator without process noise, whose x_1 is known or drawn."""
    model = ssm.Model("simulator", inputs=("u",))

    @model.prior
    def prior():
        return {"k": ssm.HalfNormal(sd=3), "c": ssm.HalfNormal(sd=2), "r": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial():
        return start()

    @model.transition
    def transition(x, v, u, k, c):
        return {"x": ssm.Dirac(x + 0.1 * v), "v": ssm.Dirac(v + 0.1 * (u - k * x - c * v))}

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, sd=r)}

    return model


MACHINE = {"k": 1.0, "c": 0.4, "r": 0.1}


@register(MACHINE, u=coloured(2.0))
def simulator():
    """All transitions deterministic, x_1 known."""
    return _machine(lambda: {"x": ssm.Dirac(0.2), "v": ssm.Dirac(0.0)})


@register(MACHINE, u=coloured(2.0))
def simulator_random_start():
    """All transitions deterministic, x_1 drawn."""
    return _machine(lambda: {"x": ssm.Normal(0.2, sd=0.3), "v": ssm.Normal(0, sd=0.3)})
