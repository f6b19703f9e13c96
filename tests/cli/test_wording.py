"""Fixes are told in the words of the command line."""

import pytest

from ssmppl.cli import main
from ssmppl.cli.group import in_words_of
from tests.cli.shared import fails

TOLD = [  # the command, the fix as Python has it, and as the command line has it
    ("simulate", "pass steps=100", "pass --steps 100"),
    ("smooth", "give every parameter of the model a value: {'a': ..., 'q': ...}",
     "give every parameter of the model a value: --parameters a=... q=..."),
    ("smooth", "leave particles= out, or use method=ssm.FFBSi()",
     "leave --particles out, or use --method ffbsi"),
    ("sample", "use ssm.PMMH(...), ssm.MetropolisHastings(...), ssm.SMC2(...) or None",
     "use --method pmmh, --method mh, --method smc2 or none of them"),
    ("sample", "use ssm.PMMH(correlation=0.0, order=0)",
     "use --method pmmh --settings correlation=0.0 order=0"),
    ("sample", "states=False leaves them out, thin= keeps fewer, checkpoint= keeps them on disk",
     "--no-states leaves them out, --thin keeps fewer, --checkpoint keeps them on disk"),
    ("sample", "give another path, or checkpoint=None", "give another path, or no --checkpoint"),
    ("sample", "give start={name: value} near plausible values",
     "give --start name=value near plausible values"),
    ("sample", "fix the parameter by fixed={...}", "fix the parameter by --fixed name=value"),
    ("sample", "fix it by fixed={'phi': 0.5, 'q': [1, 2]}", "fix it by --fixed phi=0.5 'q=[1, 2]'"),
    ("sample", "leave out fixed=, or use ssm.log_likelihood",
     "leave out --fixed, or use `ssmppl log-likelihood`"),
    ("particle-filter", 'use proposal="auto" or "bootstrap"',
     'use --proposal auto or "bootstrap"'),
    ("particle-filter", "leave resampling= and ess_threshold= out",
     "leave --resampling and --ess-threshold out"),
    ("summary", "run it with ssm.particle_filter(..., history=True)",
     "run it with `ssmppl particle-filter --history`"),
    ("simulate", "pass inputs={'u': ..., 'v': ...}, one row for each step",
     "pass --inputs FILE, with the columns u, v, one row for each step"),
    ("sample", "give a whole number of at least 0, or None for a random one",
     "give a whole number of at least 0, or leave --seed out for a random one"),
    ("predict", "give all the data sets, or conditional=False",
     "give all the data sets, or --free-run"),
]  # fmt: skip

KEPT = [  # what is about the model, which is in Python, or has no counterpart
    ("sample", "write ssm.Normal(0, sd=1), or variance= or precision="),
    ("simulate", 'give a tuple of names, inputs=("torque",), or their lengths by name'),
    ("sample", 'give a string, ssm.Model("ice varves")'),
    ("sample", "use ssm.FFBSi()"),
    ("sample", "leave trajectories= out"),
    ("sample", "run the cell of ssm.Model(...) again; ssm.plot_states(idata) shows them"),
]


@pytest.mark.parametrize(("command", "fix", "told"), TOLD)
def test_arguments_methods_and_verbs_are_options_and_commands(command, fix, told):
    assert in_words_of(main.commands[command].params, main.commands, fix) == told


@pytest.mark.parametrize(("command", "fix"), KEPT)
def test_other_words_stay(command, fix):
    assert in_words_of(main.commands[command].params, main.commands, fix) == fix


def test_an_error_of_a_verb_is_told_so(series):
    told = fails("log-likelihood", "walk.py", series)
    assert "Fix: give every parameter of the model a value: --parameters q=..." in told
