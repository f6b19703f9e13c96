"""What waits is told of: on terminals, in notebooks, in files of logs, and not where it is not
wanted."""

import io
import logging
import re
import subprocess
import sys
import time
from types import SimpleNamespace

import numba
import numpy as np
import pytest

import ssmppl as ssm
from ssmppl import status
from ssmppl.inference.run.progress import Progress, announced

level = ssm.Model("level")
level.prior(lambda: {"q": ssm.InverseGamma(2, scale=1), "r": ssm.InverseGamma(2, scale=1)})
level.initial(lambda: {"x": ssm.Normal(0, sd=3)})
level.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
level.observation(lambda x, r: {"y": ssm.Normal(x, variance=r)})
DATA = {"y": np.random.default_rng(1).standard_normal(20)}


class Screen(io.StringIO):
    def __init__(self, terminal=False):
        super().__init__()
        self.terminal = terminal

    def isatty(self):
        return self.terminal


class Notebook:
    """Stands for IPython with a kernel; outputs : what each shows, one state after the other."""

    def __init__(self):
        self.outputs = []
        self.display = SimpleNamespace(display=self._display)

    def get_ipython(self):
        return SimpleNamespace(kernel=object())

    def _display(self, bundle, raw, display_id):
        assert raw
        assert display_id
        states = [bundle]
        self.outputs.append(states)
        return SimpleNamespace(update=lambda b, raw: states.append(b))


@pytest.fixture
def screen(monkeypatch):
    """Makes stderr a terminal or not, and everything be told at once."""

    def make(terminal=False, silent=0.02, tick=0.01):
        made = Screen(terminal)
        monkeypatch.setattr("sys.stderr", made)
        monkeypatch.setattr(status, "SILENT_SECONDS", silent)
        monkeypatch.setattr(status, "TICK_SECONDS", tick)
        monkeypatch.setattr(status, "_status", status._Status())
        return made

    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    return make


@pytest.fixture
def notebook(monkeypatch, screen):
    screen()
    made = Notebook()
    monkeypatch.setitem(sys.modules, "IPython", made)
    return made


def compiled(name="particle_filter", seconds=0.1):
    """As the compiler tells of one compilation, with another one inside."""
    told = status.Compilations()
    told.began(name)
    told.began("exp")
    time.sleep(seconds)
    told.ended()
    told.ended()


def filtered(seconds=0.1, times=1):
    """As a verb without a progress bar."""
    with status.call_of("filtered", "level", True, False):
        for _ in range(times):
            compiled(seconds=seconds)


def estimated(progress=True):
    with status.call_of("estimated", "level", progress, True):
        compiled()


def test_a_terminal_is_told_what_is_compiled_and_for_how_long(screen):
    made = screen(True)
    filtered()
    shown = re.split(r"\r", made.getvalue())
    assert any("filtered [00:00]: compiling the particle filter, once" in s for s in shown)
    assert shown[-1].strip() == ""  # nothing is left of it


def test_seconds_go_on(screen, monkeypatch):
    made, clock = screen(True), time.monotonic
    monkeypatch.setattr(status.time, "monotonic", lambda: 20.0 * clock())
    filtered(seconds=0.3)
    assert len(set(re.findall(r"\[00:0\d\]", made.getvalue()))) > 1


def test_short_compilations_add_up(screen):
    made = screen(True, silent=0.2)
    filtered(seconds=0.05)
    assert made.getvalue() == ""
    filtered(seconds=0.03, times=12)
    assert "filtered [00:00]: compiling" in made.getvalue()


def test_lines_where_there_is_no_terminal(screen):
    made = screen()
    filtered()  # a verb without a progress bar is silent there
    assert made.getvalue() == ""
    estimated()
    lines = made.getvalue().splitlines()
    assert lines[0].startswith("estimated [00:00]: compiling the particle filter, once")
    assert len(lines) < 5  # the pauses become longer


@pytest.mark.parametrize("terminal", [False, True])
def test_progress_false_is_quiet(screen, terminal):
    made = screen(terminal)
    estimated(progress=False)
    with announced("sample", "preparing", shown=False):
        time.sleep(0.1)
    assert made.getvalue() == ""


def test_an_inner_verb_that_would_tell_is_quiet_in_one_that_does_not(screen):
    made = screen(True)
    with status.call_of("evidence", "level", False, True):
        estimated()
    assert made.getvalue() == ""


@pytest.mark.parametrize(("verb", "lines"), [(ssm.sample, True), (ssm.kalman_filter, False)])
def test_verbs_tell_under_their_names(screen, monkeypatch, verb, lines):
    def compiling(*args, **kwargs):
        compiled()
        raise ssm.DataError("enough")

    monkeypatch.setattr(sys.modules[verb.__module__], "pose", compiling)
    for terminal in (False, True):
        made = screen(terminal)
        with pytest.raises(ssm.DataError, match="enough"):
            verb(level, DATA, *(() if lines else ({"q": 1.0, "r": 1.0},)))
        assert (f"{verb.__name__} [00:00]: compiling" in made.getvalue()) is (lines or terminal)
    if lines:
        made = screen(True)
        with pytest.raises(ssm.DataError, match="enough"):
            verb(level, DATA, progress=False)
        assert made.getvalue() == ""


def test_what_takes_long_is_announced(screen):
    made = screen(True)
    with announced("PMMH", "preparing"):
        time.sleep(0.1)
    assert "PMMH [00:00]: preparing" in made.getvalue()


def test_a_notebook_has_an_output_that_is_taken_away(notebook):
    filtered()
    filtered()
    first, second = notebook.outputs  # each call its own, as it may be of another cell
    assert "compiling the particle filter" in first[0]["text/plain"]
    assert first[-1] == second[-1] == {"text/plain": "", "text/html": ""}


def test_a_bar_in_a_notebook(notebook, monkeypatch):
    monkeypatch.setattr("ssmppl.inference.run.progress.NOTEBOOK_SECONDS", 0.0)
    with Progress(10, "<PMMH>") as bar:
        for _ in range(10):
            bar.advance(1, "acceptance 0.3")
    ((*_, before, last),) = notebook.outputs
    assert "90% 9/10" in before["text/plain"]
    assert last["text/plain"].startswith("<PMMH>: 100% 10/10")
    assert "value='10' max='10'" in last["text/html"]
    assert "&lt;PMMH&gt;" in last["text/html"]
    with Progress(10, "PMMH", shown=False) as bar:
        bar.advance(10)
    assert len(notebook.outputs) == 1


def test_lines_on_request(notebook, screen, monkeypatch):
    monkeypatch.setenv(status.STYLE, "lines")
    made = screen(True)
    filtered()
    estimated()
    assert notebook.outputs == []
    assert all(
        line.startswith("estimated [00:00]: compiling") for line in made.getvalue().splitlines()
    )


def test_without_a_stderr(screen, monkeypatch):
    screen()
    monkeypatch.setattr("sys.stderr", None)
    estimated()
    with Progress(2, "PMMH") as bar:
        bar.advance(2)


def test_the_package_hears_of_compilations(caplog):
    caplog.set_level(logging.DEBUG, logger="ssmppl")
    numba.njit(lambda x: x + 1.0)(2.0)
    assert any(m.startswith("compiled ") for m in caplog.messages)


def test_the_log_has_the_choice_and_the_time(caplog):
    caplog.set_level(logging.INFO, logger="ssmppl")
    settings = {"draws": 20, "warmup": 20, "chains": 1, "seed": 1, "progress": False}
    ssm.sample(level, DATA, **settings)
    told = [r.getMessage() for r in caplog.records if r.name == "ssmppl"]
    assert any(m.startswith("sample of model 'level': Gibbs, as the model is linear") for m in told)
    assert any(re.fullmatch(r"sample of model 'level' took [\d.]+ s", m) for m in told)
    caplog.clear()
    ssm.sample(level, DATA, ssm.Gibbs(), **settings)
    assert not any("Gibbs, as" in m for m in caplog.messages)


def test_nobody_sees_the_log_who_does_not_ask():
    code = (
        "import logging, ssmppl as ssm; from ssmppl.status import LOG; LOG.warning('seen?');"
        "assert any(isinstance(h, logging.NullHandler) for h in LOG.handlers)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stderr == ""
