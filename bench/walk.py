"""What somebody new does first, from a fresh clone: each step timed, as at a terminal.

A clone in a temporary folder, with no environment, no cache of compiled models, and settings of its
own. Model and data of the later steps are new to the package: the Nile's flow, with outliers. Each
step runs at a pseudo-terminal, where the longest time without a new word on the screen is measured
too: it is what a person has to trust blindly.


    python bench/walk.py [FOLDER]

What the screen showed goes to FOLDER (walk/ unless given), the times to docs/figures/walk.csv, for
the page on performance.
"""

from __future__ import annotations

import csv
import fcntl
import os
import pty
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import termios
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "figures" / "walk.csv"
LONGEST = 1800.0  # seconds of a step
MODEL = '''"""The flow of the Nile at Aswan: a level that wanders, and years that do not fit."""

import ssmppl as ssm

flow = ssm.Model("flow")


@flow.prior
def prior():
    return {"drift": ssm.HalfNormal(sd=100), "spread": ssm.HalfNormal(sd=200)}


@flow.initial
def initial():
    return {"level": ssm.Normal(1000, sd=300)}


@flow.transition
def transition(level, drift):
    return {"level": ssm.Normal(level, sd=drift)}


@flow.observation
def observation(level, spread):
    return {"y": ssm.StudentT(4, level, scale=spread)}
'''
PYTHON = """
import numpy as np, pandas as pd, ssmppl as ssm
from flow import flow
data = pd.read_csv("flow.csv", index_col="year")
"""
PLOTS = """
idata = ssm.sample(flow, data, seed=1)
print(ssm.summary(idata))
np.ravel(ssm.plot_states(idata))[0].figure.savefig("states.png")
np.ravel(ssm.plot_prior_posterior(idata, flow))[0].figure.savefig("prior_posterior.png")
"""
FILTER = """
found = ssm.particle_filter(flow, data, {"drift": 40.0, "spread": 110.0}, seed=1)
np.ravel(ssm.plot_predictions(found))[0].figure.savefig("predictions.png")
np.ravel(ssm.plot_filter(found))[0].figure.savefig("filter.png")
"""
BIN = ".venv/bin"
STEPS = [  # what, command
    ("install", "make .venv/.installed-run"),
    ("the main job on the embedded data", "make demo"),
    ("a model to begin with", f"{BIN}/ssmppl new mine"),
    ("own model, own data: what is derived", f"{BIN}/ssmppl explain flow.py flow.csv"),
    ("draws", f"{BIN}/ssmppl sample flow.py flow.csv --seed 1 -o flow.nc"),
    ("the same in Python, with plots", f"{BIN}/python sampled.py"),
    ("filter and its predictions, plotted", f"{BIN}/python filtered.py"),
    ("maximum likelihood", f"{BIN}/ssmppl maximize flow.py flow.csv --seed 1"),
    ("smoothed states", f"{BIN}/ssmppl smooth flow.py flow.csv -p drift=40 spread=110 --seed 1"),
    ("the next ten years", f"{BIN}/ssmppl forecast flow.py flow.nc --steps 10 --seed 1"),
    ("how well each year was predicted",
     f"{BIN}/ssmppl leave-future-out flow.py flow.csv --first 80 --seed 1"),
    ("evidence", f"{BIN}/ssmppl evidence flow.py flow.csv --seed 1"),
    ("what the model lacks", f"{BIN}/ssmppl diagnose flow.py flow.csv --fast"),
]  # fmt: skip


def prepare(home: Path) -> Path:
    """A fresh clone, with a model and data of one's own in it."""
    clone = home / "ssmppl"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    (clone / "flow.py").write_text(MODEL)
    (clone / "sampled.py").write_text(PYTHON + PLOTS)
    (clone / "filtered.py").write_text(PYTHON + FILTER)
    with (clone / "examples" / "nile" / "data.csv").open() as file:
        rows = [(row["time"], row["y"]) for row in csv.DictReader(file)]
    (clone / "flow.csv").write_text("year,y\n" + "".join(f"{t},{y}\n" for t, y in rows))
    return clone


def at_terminal(
    command: str, folder: Path, environment: dict[str, str]
) -> tuple[float, float, str]:
    """Seconds in all, the longest without a word, and what was shown.

    Raises
    ------
    RuntimeError : the command failed, or took too long.
    """
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))
    begun = last = time.monotonic()
    process = subprocess.Popen(
        command, shell=True, cwd=folder, env=environment, stdin=theirs, stdout=theirs,
        stderr=theirs, start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    shown, silence = [], 0.0
    while True:
        ready, _, _ = select.select([ours], [], [], 1.0)
        now = time.monotonic()
        if now - begun > LONGEST:
            process.kill()
            raise RuntimeError(f"{command}: no end after {LONGEST:.0f} s")
        if not ready:
            continue
        silence, last = max(silence, now - last), now
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        shown.append(part)
    os.close(ours)
    text = b"".join(shown).decode(errors="replace")
    if process.wait():
        raise RuntimeError(f"{command}: exit status {process.returncode}\n{text}")
    return time.monotonic() - begun, silence, text


def main(kept: Path) -> None:
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as home:
        clone = prepare(Path(home))
        environment = {
            k: v for k, v in os.environ.items() if not k.startswith(("SSMPPL", "PYTHON"))
        }
        environment |= {
            "SSMPPL_CACHE": str(Path(home) / "cache"), "MPLBACKEND": "Agg", "TERM": "xterm",
        }  # fmt: skip
        os.mkdir(environment["SSMPPL_CACHE"], 0o700)
        rows = []
        for i, (what, command) in enumerate(STEPS, 1):
            seconds, silence, text = at_terminal(command, clone, environment)
            (kept / f"{i:02d}.txt").write_text(text)
            plain = command.replace(f"{BIN}/", "")
            rows.append([what, plain, f"{seconds:.1f}", f"{silence:.1f}"])
            print(*rows[-1], sep="  ", flush=True)
        for picture in clone.glob("*.png"):
            shutil.copy(picture, kept)
    with TABLE.open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["step", "command", "seconds", "longest silence"])
        out.writerows(rows)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "walk"))
