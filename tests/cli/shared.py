"""Models and helpers of the tests of the command line."""

import inspect
import json
import textwrap
from pathlib import Path

import click.testing

import ssmppl as ssm
from ssmppl import cli

# click 8.1 mixes standard error into standard output unless it is told not to; 8.2 cannot be told.
PARAMETERS = inspect.signature(click.testing.CliRunner).parameters
SEPARATE = {"mix_stderr": False} if "mix_stderr" in PARAMETERS else {}

WALK = """
    import ssmppl as ssm

    walk = ssm.Model("walk")

    @walk.prior
    def prior():
        return {"q": ssm.InverseGamma(3, scale=1)}

    @walk.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @walk.transition
    def transition(x, q):
        return {"x": ssm.Normal(x, variance=q)}

    @walk.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.5)}
"""
PLANE = """
    import numpy as np
    import ssmppl as ssm

    plane = ssm.Model("plane", inputs=("u",))

    @plane.prior
    def prior():
        return {"beta": ssm.Normal(np.zeros(2), sd=1)}

    @plane.initial
    def initial():
        return {"x": ssm.Normal(np.zeros(2), sd=1)}

    @plane.transition
    def transition(x, u, beta):
        return {"x": ssm.Normal(0.5 * x + beta * u, sd=0.1)}

    @plane.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.3)}
"""


WEATHER = """
    import ssmppl as ssm

    weather = ssm.Model("weather")

    @weather.prior
    def prior():
        return {"stay": ssm.Beta(4, 1)}

    @weather.initial
    def initial():
        return {"wet": ssm.Bernoulli(0.5)}

    @weather.transition
    def transition(wet, stay):
        return {"wet": ssm.Bernoulli(stay * wet + (1 - stay) * (1 - wet))}

    @weather.observation
    def observation(wet):
        return {"y": ssm.Normal(2.0 * wet, sd=1)}
"""


def write(name, text):
    Path(name).write_text(textwrap.dedent(text).lstrip(), encoding="utf-8")


def run(*args, code=0, **settings):
    runner = click.testing.CliRunner(**SEPARATE)
    result = runner.invoke(cli.main, [str(a) for a in args], prog_name="ssmppl", **settings)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def fails(*args, code=1):
    result = run(*args, code=code)
    assert "Traceback" not in result.stderr
    return result.stderr


def answer(*args, code=0):
    """What a command prints under `--json`: one line, and no numbers that JSON does not have."""
    out = run(*args, "--json", code=code).stdout
    assert out.endswith("\n")
    assert out.count("\n") == 1

    def refused(name):
        raise AssertionError(f"{name} in {out}")

    return json.loads(out, parse_constant=refused)


def interrupted_after(draws, sample=ssm.sample):
    """`ssm.sample` as it returns when Ctrl-C comes after so many draws."""

    def interrupted(*args, **kwargs):
        idata = sample(*args, **{**kwargs, "draws": draws})
        idata["posterior"].attrs["interrupted"] = 1
        return idata

    return interrupted


QUICK = ("--draws", 30, "--warmup", 10, "--chains", 2, "--seed", 1)
