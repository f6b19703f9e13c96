"""`python -m tests.fuzz.kills 100`: calls of `sample` stopped at random moments, then gone on with.

Each call writes a checkpoint after every block. It is killed (SIGKILL) or interrupted (SIGINT) at a
random moment between its start and its end, over and over, and then left alone: its draws have to
be, bit for bit, those of a call that nobody stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from tests.models import checkpoints as models

NAMES = ("Gibbs", "MetropolisHastings", "PMMH", "PGAS", "PGAS, interweaved", "SMC2")
EACH = 5  # stops of one call, before it is left to end


def start(folder: Path, name: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", models.__name__, str(folder), name], stderr=subprocess.PIPE
    )


def whole(folder: Path, name: str) -> tuple[str, float]:
    """What a call leaves that nobody stops, and its seconds."""
    begun = time.monotonic()
    process = start(folder, name)
    _, error = process.communicate()
    if process.returncode:
        raise SystemExit(f"{name}: {error.decode()}")
    return (folder / f"{name}.txt").read_text(), time.monotonic() - begun


def stopped(folder: Path, name: str, how: signal.Signals, after: float) -> str:
    """Stop a call after some seconds; "in time", "ended before", or what it said instead."""
    process = start(folder, name)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=after)
    if process.poll() is not None:
        return "ended before" if process.returncode == 0 else "died of itself"
    process.send_signal(how)
    try:
        _, error = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        return "did not stop within 60 s"
    text = error.decode()
    ours = "Error" not in text.replace("KeyboardInterrupt", "") or how == signal.SIGKILL
    return "in time" if ours else text


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("stops", type=int, nargs="?", default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--table", type=Path, help="a CSV file for the counts")
    given = parser.parse_args()
    # where this was started in the background, SIGINT is ignored, by what it starts too
    signal.signal(signal.SIGINT, signal.default_int_handler)
    rng, counts = np.random.default_rng(given.seed), Counter[tuple[str, str]]()
    lost: list[str] = []
    with tempfile.TemporaryDirectory() as first:
        for name in NAMES:
            whole(Path(first), name)  # compiles; the second call's time is that of the rest
            (Path(first) / f"{name}.npz").unlink()
        expected = {name: whole(Path(first), name) for name in NAMES}
    stops = 0
    while stops < given.stops:
        name = str(rng.choice(NAMES))
        text, seconds = expected[name]
        with tempfile.TemporaryDirectory() as folder:
            for _ in range(EACH):
                how = signal.SIGKILL if rng.random() < 0.7 else signal.SIGINT
                found = stopped(Path(folder), name, how, rng.uniform(0.2, 1.0) * seconds)
                counts[how.name, found] += 1
                stops += found == "in time"
                if found == "ended before":
                    break
                if found != "in time":
                    lost.append(f"{name}, {how.name}: {found}")
            if whole(Path(folder), name)[0] != text:
                lost.append(f"{name}: other draws than without a stop")
    rows = [f"{how},{found},{n}" for (how, found), n in sorted(counts.items())]
    rows.append(f"all,with other draws or an error afterwards,{len(lost)}")
    print(*rows, sep="\n")
    if given.table:
        given.table.write_text("\n".join(["signal,what came of it,count", *rows]) + "\n")
    print(f"{stops} stops", *lost, sep="\n")
    return int(bool(lost))


if __name__ == "__main__":
    sys.exit(main())
