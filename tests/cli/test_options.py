"""Every verb has a command, every argument an option; the help says what, how and where."""

import inspect

import click
import pytest

import ssmppl as ssm
from ssmppl.cli import main
from ssmppl.cli.options import CLIMBERS, SAMPLERS, method_of
from ssmppl.errors import ArgumentError
from tests.cli.shared import fails, run

COMMANDS = sorted(main.commands)
VERBS = [n.replace("-", "_") for n in COMMANDS if n.replace("-", "_") in ssm.__all__]
OTHER_NAMES = {"idata": "posterior"}


def plain(default):
    return None if default in ((), False) or "UNSET" in repr(default) else default


@pytest.mark.parametrize("verb", VERBS)
def test_every_argument_of_a_verb_is_an_option_with_its_default(verb):
    command = main.commands[verb.replace("_", "-")]
    options = {p.name: p for p in command.params}
    # an executor is an object of Python's
    for name, argument in inspect.signature(getattr(ssm, verb)).parameters.items():
        if name == "executor":
            continue
        if (verb, name) == ("forecast", "data"):  # the file stands in the posterior's place
            continue
        option = options[OTHER_NAMES.get(name, name)]
        if isinstance(option, click.Argument):
            continue
        dashed = name.replace("_", "-")
        assert any(o in (f"--{dashed}", f"--{name}") for o in option.opts), option.opts
        if argument.default is not inspect.Parameter.empty:
            assert plain(option.default) == plain(argument.default), name


def test_no_verb_is_without_a_command():
    lower = {n for n in ssm.__all__ if n[0].islower() and not n.startswith("plot_")}
    assert lower - {n.replace("-", "_") for n in COMMANDS} == {
        "distribution", "effect", "effects", "plots", "primitive",
        "expm", "integrate", "repeat", "simulator", "simulators", "structural",
    }  # fmt: skip


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_teaches_with_an_example(command):
    text = run(*filter(None, [command]), "--help").stdout
    assert f"      ssmppl {command}".rstrip() in text or f"(ssmppl {command} " in text
    assert max(map(len, text.splitlines())) <= 100
    if command:
        words = " ".join(text.split())  # what is written where
        assert "Nothing is written" in words or "rites" in words or "re written to" in words
        assert "\nShown:\n" in text
        assert ("--json" in text) == (command != "completion")
        assert "\nOptions:\n" not in text  # all of them stand in a group


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_stands_in_a_section_with_words(command):
    context = click.Context(main.commands[command], info_name=command)
    for parameter in main.commands[command].params:
        name, text = parameter.get_help_record(context)
        assert text, name
        assert parameter.section in ("Model and data", "Method", "Run", "Output", "Shown")
    text = run(command, "--help").stdout
    places = [text.find(f"\n{s}:\n") for s in ("Model and data", "Method", "Run", "Output")]
    found = [place for place in places if place > 0]
    assert found == sorted(found)


def test_defaults_are_shown():
    text = run("log-likelihood", "--help").stdout
    for shown in ("[default: 1000]", "[default: auto]", "[default: cpu]"):
        assert shown in " ".join(text.split())


def test_every_command_stands_in_the_list():
    text = run("--help").stdout
    for command in COMMANDS:
        assert f"\n  {command} " in text
    assert "..." not in text.partition("First steps")[2]  # none is cut short


def test_names_of_python_are_understood():
    assert run("log_likelihood", "--help").stdout == run("log-likelihood", "--help").stdout
    assert "DATA" in fails("log_likelihood", "walk.py", code=2)


# -- methods
def test_a_method_has_its_short_name_or_that_of_its_class(series):
    short = run("sample", "walk.py", series, "--method", "mh", "--draws", 4, "--warmup", 4,
                "--chains", 1, "--seed", 1, "-o", "a.nc").stdout  # fmt: skip
    long = run("sample", "walk.py", series, "--method", "MetropolisHastings", "--draws", 4,
               "--warmup", 4, "--chains", 1, "--seed", 1, "-o", "b.nc").stdout  # fmt: skip
    assert short.splitlines()[2:4] == long.splitlines()[2:4]
    assert "by MetropolisHastings" in long


def test_settings_of_a_method():
    found = method_of(
        SAMPLERS, "pgas", ["interweave=auto", 'eliminate=["q", "r"]', "log_likelihood=True"], 7
    )
    assert found == ssm.PGAS(
        particles=7, interweave="auto", eliminate=("q", "r"), log_likelihood=True
    )
    assert method_of(SAMPLERS, "mh", ["adapt=none", "scale=natural"]) == ssm.MetropolisHastings(
        scale="natural"
    )
    assert method_of(CLIMBERS, "em", ["iterations=3", "tolerance=1e-3"]) == ssm.EM(3, 1e-3)
    assert method_of(CLIMBERS, "if2", ['perturbation={"q": 0.1}']) == ssm.IF2(
        perturbation={"q": 0.1}
    )
    assert method_of(CLIMBERS, None) is None
    with pytest.raises(ArgumentError) as fault:
        method_of(CLIMBERS, "em", ["iteration=3"])
    assert str(fault.value).splitlines() == [
        "--settings: EM has no setting 'iteration'",
        "Fix: it has: iterations, tolerance, accelerate",
    ]


def test_settings_and_particles_need_a_method(series):
    assert "--settings needs --method" in fails(
        "sample", "walk.py", series, "--settings", "particles=5", code=2
    )
    said = fails("sample", "walk.py", series, "--particles", 5, "--method", "mh", code=2)
    assert "--particles needs --method pmmh, ismcmc, pgas or smc2" in said


@pytest.mark.parametrize("text", ["0.1,x", ",", "0.5;0.6"])
def test_quantiles_are_numbers_separated_by_commas(series, text):
    said = fails("kalman-filter", "walk.py", series, "-p", "q=0.3", "--quantiles", text, code=2)
    assert "number" in said
