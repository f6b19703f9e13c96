"""What a shell and a terminal see: completion, colours, warnings, exit codes."""

import contextlib
import dataclasses
import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
import warnings
from pathlib import Path

import click
import pytest

import ssmppl as ssm
from ssmppl.inference.run import progress as progress_module
from ssmppl.inference.run.executors import workers_of
from ssmppl.inference.run.progress import Progress
from tests.cli.shared import QUICK, answer, fails, interrupted_after, run, write
from tests.diagnosis.made_up import effect_found

ROOT = Path(__file__).parent.parent.parent
RED, YELLOW, BOLD = "\x1b[31m", "\x1b[33m", "\x1b[1m"
Q = ("-p", "q=0.3")


# -- completion
@pytest.mark.parametrize(
    ("shell", "said"),
    [
        ("bash", "complete -o nosort -F _ssmppl_completion ssmppl"),
        ("zsh", "#compdef ssmppl"),
        ("fish", "complete --no-files --command ssmppl"),
    ],
)
def test_the_script_of_a_shell(shell, said):
    text = run("completion", shell).stdout
    assert said in text
    assert f"_SSMPPL_COMPLETE={shell}_complete" in text


def test_other_shells_are_refused():
    assert "'bash', 'zsh', 'fish'" in fails("completion", "tcsh", code=2)


def completed(*words, monkeypatch):
    """What bash is told for a line that ends with the last of `words`."""
    environment = {
        "_SSMPPL_COMPLETE": "bash_complete",
        "COMP_WORDS": " ".join(["ssmppl", *words]),
        "COMP_CWORD": str(len(words)),
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    return run().stdout.split()


def test_what_is_completed(monkeypatch):
    def found(*words):
        return completed(*words, monkeypatch=monkeypatch)

    assert found("le") == ["plain,leave-future-out"]
    assert found("s") == ["plain,simulate", "plain,sample", "plain,summary", "plain,smooth",
                          "plain,score"]  # fmt: skip
    assert found("sample", "m.py", "d.csv", "--che") == ["plain,--checkpoint"]
    assert found("sample", "--method", "p") == ["plain,pmmh", "plain,pgas"]
    assert found("explain", "mo") == ["file,mo"]
    assert found("log-likelihood", "m.py", "d.csv", "--proposal", "mar") == [
        "plain,marginal", "plain,marginal_guided", "plain,marginal_auxiliary",
    ]  # fmt: skip


# -- colours
def test_colours_where_there_is_a_terminal(series):
    words = ("sample", "walk.py", series, *QUICK, "-o", "post.nc")
    shown = run(*words, color=True).stdout
    assert BOLD in shown
    (row,) = [line for line in shown.splitlines() if "q " in line and "0." in line]
    assert row.startswith((RED, YELLOW))  # sixty draws are few
    assert "Note: ess below 400" in shown
    assert "\x1b[" not in run(*words).stdout


@pytest.mark.parametrize("where", ["variable", "command", "group"])
def test_no_colours_where_none_are_wanted(series, where, monkeypatch):
    words = ["summary", "walk.py"]
    if where == "variable":
        monkeypatch.setenv("NO_COLOR", "1")
    else:
        words.insert(0 if where == "group" else 2, "--no-color")
    result = run(*words, code=1, color=True)
    assert "\x1b[" not in result.stderr
    assert "Error: DataError" in result.stderr
    assert os.environ.get("NO_COLOR") == ("1" if where == "variable" else None)
    monkeypatch.setenv("NO_COLOR", "")  # as if it were not set
    assert RED in run("summary", "walk.py", code=1, color=True).stderr


def test_rows_are_marked_by_how_they_mixed(posterior, monkeypatch):
    def table(**changes):
        row = {"mean": 1.0, "sd": 1.0, "mcse_mean": 0.1, "mcse_sd": 0.1, "ess_bulk": 900.0,
               "ess_tail": 900.0, "r_hat": 1.0} | changes  # fmt: skip
        found = summary_of("post.nc")
        for name, value in row.items():
            found.loc["q", name] = value
        monkeypatch.setattr(ssm, "summary", lambda *args: found)
        return run("summary", "post.nc", color=True).stdout

    def summary_of(path, summary=ssm.summary):
        from ssmppl.cli.reading import read_posterior

        return summary(read_posterior(Path(path)))

    monkeypatch.chdir(posterior)
    good, apart, few = table(), table(r_hat=1.05), table(ess_tail=399.0)
    assert RED not in good + few
    assert YELLOW not in good + apart
    assert "Note" not in good
    assert f"{RED}q " in apart
    assert "r_hat not below 1.01" in apart
    assert f"{YELLOW}q " in few


def terminal(*args, columns=0, **environment):
    """What a run of Python with these arguments writes to a terminal."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", columns // 2, columns, 0, 0))
    process = subprocess.Popen(
        [sys.executable, *args], stdout=theirs, stderr=theirs, stdin=theirs,
        env=os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm"} | environment,
    )  # fmt: skip
    os.close(theirs)
    parts = []
    while True:
        try:
            part = os.read(ours, 4096)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        parts.append(part)
    os.close(ours)
    return process.wait(timeout=60), b"".join(parts).decode()


@pytest.mark.parametrize(("environment", "plain"), [({}, False), ({"NO_COLOR": "1"}, True)])
def test_a_terminal(folder, environment, plain):
    code, text = terminal("-m", "ssmppl", "explain", "none.py", **environment)
    assert code == 1
    assert "there: plane.py, walk.py" in text
    assert ("\x1b[" in text) != plain


@pytest.mark.parametrize(("variable", "value"), [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_the_bar_has_colours_unless_none_are_wanted(monkeypatch, capsys, variable, value):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")

    def bar():
        with Progress(4, "drawing") as progress:
            progress.advance(2)
        return capsys.readouterr().err

    assert "\x1b[36m" in bar()
    monkeypatch.setenv(variable, value)
    text = bar()
    assert "drawing" in text
    assert "\x1b[36m" not in text


def test_the_time_left_is_that_of_draws_without_what_was_compiled_before_the_first(
    monkeypatch, capsys
):
    clock = iter([0.0, 60.0, 60.0, 70.0])  # begun; the first quarter, after a minute; the second
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: next(clock))
    with Progress(4, "drawing") as progress:
        progress.advance(1)
        progress.advance(1)
    assert "50% 2/4 [01:10<00:20]" in capsys.readouterr().err


PROGRESS = """
from ssmppl.inference.run.progress import Progress
with Progress(4, "drawing") as progress:
    progress.advance(2)
"""


@pytest.mark.parametrize(("columns", "width"), [(0, 80), (60, 60), (120, 120)])
def test_a_bar_is_as_wide_as_the_terminal_and_there_where_that_does_not_tell(columns, width):
    code, text = terminal("-c", PROGRESS, columns=columns, NO_COLOR="1")
    assert code == 0
    bars = [bar for bar in text.replace("\n", "\r").split("\r") if "50%" in bar]
    assert bars
    assert abs(len(bars[-1].rstrip()) - width) <= 1


@pytest.mark.parametrize("verb", [("sample", *QUICK), ("maximize",)], ids=["sample", "maximize"])
def test_the_verbs_tell_of_work_without_a_bar(series, monkeypatch, verb):
    @contextlib.contextmanager
    def waiting(title, what):
        click.echo(f"{title}: {what}", err=True)
        yield

    monkeypatch.setattr(progress_module, "waiting", waiting)
    name, *few = verb
    told = {"sample": "Gibbs: preparing", "maximize": "DirectOptimization: maximising"}[name]
    assert told in run(name, "walk.py", series, *few).stderr
    assert told not in run(name, "walk.py", series, "--no-progress", *few).stderr


# -- what is said of a run
def test_warnings_go_to_standard_error(folder, monkeypatch):
    def warning(*args, compile=ssm.compile):
        warnings.warn("the draws share few values", UserWarning, stacklevel=2)
        return compile(*args)

    monkeypatch.setattr(ssm, "compile", warning)
    result = run("compile", "walk.py", "--path")
    assert result.stderr == "Warning: the draws share few values\n"
    assert "Warning" not in result.stdout


def test_an_error_leaves_standard_output_empty(series):
    result = run("score", "walk.py", series, "--json", code=1)
    assert result.stdout == ""
    assert "'q'" in result.stderr


def test_progress_can_be_left_out(series):
    words = ("sample", "walk.py", series, *QUICK, "-o", "post.nc")
    assert "Gibbs: 100%" in run(*words).stderr
    assert run(*words, "--no-progress").stderr == ""


# -- interrupts
def test_an_interrupted_climb_keeps_the_best(series, monkeypatch):
    def interrupted(*args, maximize=ssm.maximize, **kwargs):
        found = maximize(*args, **kwargs)
        return dataclasses.replace(found, attrs=found.attrs | {"interrupted": True})

    monkeypatch.setattr(ssm, "maximize", interrupted)
    result = run("maximize", "walk.py", series, "--seed", 1, "-o", "best.csv", code=130)
    assert "Interrupted: this is the best point so far, written to best.csv." in result.stderr
    assert "q" in Path("best.csv").read_text(encoding="utf-8")
    assert answer("maximize", "walk.py", series, "--seed", 1, code=130)["interrupted"] is True


def test_an_interrupted_sample_says_so_as_json(series, monkeypatch):
    monkeypatch.setattr(ssm, "sample", interrupted_after(5))
    found = answer("sample", "walk.py", series, *QUICK, "-o", "post.nc", code=130)
    assert (found["draws"], found["interrupted"]) == (5, True)


def test_an_interrupted_diagnosis_says_what_is_kept(series, monkeypatch):
    report = dataclasses.replace(effect_found(), missing=None, interrupted=True)
    monkeypatch.setattr(ssm, "diagnose", lambda *a, **k: report, raising=False)
    monkeypatch.setattr(type(report), "save", lambda self, folder: folder / "index.html")
    words = ("diagnose", "walk.py", series, "-o", "out")
    assert answer(*words, "--checkpoint", "kept", code=130)["interrupted"] is True
    assert "kept holds them" in run(*words, "--checkpoint", "kept", code=130).stderr

    def at_once(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(ssm, "diagnose", at_once, raising=False)
    result = run(*words, "--json", code=130)
    assert "out/stages holds the stages that are done" in result.stderr
    assert result.stdout == ""


CALLED = """
import ssmppl as ssm

@ssm.simulator(state=("x",))
def halved(state, inputs, parameters):
    return 0.5 * state

model = ssm.Model("halved")

@model.prior
def prior():
    return {"q": ssm.HalfNormal(sd=1.0)}

@model.initial
def initial():
    return {"x": ssm.Normal(0.0, sd=1.0)}

@model.transition
def transition(x, q):
    return {"x": ssm.Normal(halved([x], [], []).x, sd=q)}

@model.observation
def observation(x):
    return {"y": ssm.Normal(x, sd=0.5)}
"""


@pytest.mark.parametrize(
    ("model", "words", "workers"),
    [("walk.py", (), None), ("walk.py", ("--workers", 3), 3), ("walk.py", ("--workers", 1), None),
     ("called.py", (), 2), ("called.py", ("--workers", 1), None)],
)  # fmt: skip
def test_a_diagnosis_shares_simulators_over_processes(series, monkeypatch, model, words, workers):
    seen = []

    def diagnose(*args, executor, **settings):
        seen.append(executor)
        return dataclasses.replace(effect_found(), missing=None)

    write("called.py", CALLED)
    monkeypatch.setattr("ssmppl.cli.diagnosis.cpu_count", lambda: 2)
    monkeypatch.setattr(ssm, "diagnose", diagnose, raising=False)
    run("diagnose", model, series, *words, "-o", "out")
    (executor,) = seen
    assert (executor and workers_of(executor)) == workers
    if executor:
        with pytest.raises(RuntimeError, match="after shutdown"):
            executor.submit(int)


def test_processes_have_what_the_model_file_defines(series, monkeypatch):
    """Its functions are pickled by name: a simulator of one's own is one of them."""
    seen = []

    def diagnose(*args, executor, **settings):
        own = sys.modules["model_file_called"]
        seen.append(executor.submit(own.double, 21).result())
        return dataclasses.replace(effect_found(), missing=None)

    write("called.py", CALLED + "\n\ndef double(value):\n    return 2 * value\n")
    monkeypatch.setattr(ssm, "diagnose", diagnose, raising=False)
    run("diagnose", "called.py", series, "--workers", 2, "-o", "out")
    assert seen == [42]


def test_of_many_cores_a_diagnosis_takes_some(series, monkeypatch):
    """Each process holds the package and its compiled code."""
    seen = []

    def diagnose(*args, executor, **settings):
        seen.append(workers_of(executor))
        return dataclasses.replace(effect_found(), missing=None)

    write("called.py", CALLED)
    monkeypatch.setattr("ssmppl.cli.diagnosis.cpu_count", lambda: 64)
    monkeypatch.setattr(ssm, "diagnose", diagnose, raising=False)
    run("diagnose", "called.py", series, "-o", "out")
    run("diagnose", "called.py", series, "--workers", 9, "-o", "out")
    assert seen == [8, 9]


def test_an_interrupted_evidence_says_what_it_is_made_of(series, monkeypatch):
    monkeypatch.setattr("ssmppl.inference.verbs.evidence.sample", interrupted_after(20))
    words = ("evidence", "walk.py", series, "--draws", 60, "--warmup", 30, "--seed", 1)
    assert answer(*words, code=130)["interrupted"] is True
    assert "the estimate from 10 draws of each chain" in run(*words, code=130).stderr
    monkeypatch.setattr("ssmppl.inference.verbs.evidence.sample", interrupted_after(5))
    result = run(*words, "--json", code=130)
    assert result.stdout == "", "five draws are too few to make anything of"


def test_an_interrupt_ends_leave_future_out(series, monkeypatch):
    calls, cut = [], interrupted_after(20)

    def interrupted(*args, **kwargs):
        calls.append(args)
        return cut(*args, **kwargs)

    monkeypatch.setattr("ssmppl.inference.verbs.leave_future_out.sample", interrupted)
    words = ("leave-future-out", "walk.py", series, "--draws", 60, "--warmup", 30, "--seed", 1)
    result = run(*words, "--json", code=130)
    assert len(calls) == 1
    assert result.stdout == ""
    assert "nothing written" in result.stderr


@pytest.mark.parametrize("words", [("score", *Q), ("kalman-filter", *Q), ("evidence",)])
def test_an_interrupt_of_what_keeps_nothing(series, monkeypatch, words):
    def at_once(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(ssm, words[0].replace("-", "_"), at_once)
    result = run(words[0], "walk.py", series, *words[1:], code=130)
    assert "nothing written" in result.stderr
    assert result.stdout == ""


def test_a_file_that_cannot_be_written(series, monkeypatch):
    Path("locked").mkdir()
    Path("locked/f.nc").mkdir()  # root may write everywhere, but not on a folder
    said = fails("kalman-filter", "walk.py", series, *Q, "-o", "locked/f.nc", code=2)
    assert "locked/f.nc" in said

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ssmppl.cli.rendering.save", full)
    said = fails("kalman-filter", "walk.py", series, *Q, "-o", "f.nc")
    assert "f.nc cannot be written: No space left on device" in said
