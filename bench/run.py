"""Run every benchmark and write what they print to RESULTS.md: `make bench`."""

from __future__ import annotations

import datetime
import subprocess
import sys
from pathlib import Path

from table import machine, versions

HERE = Path(__file__).parent
SCRIPTS = (
    "against.py",
    "filters.py",
    "start.py",
    "proposals.py",
    "smoothing.py",
    "samplers.py",
    "interweaving.py",
    "updates.py",
    "kalman.py",
    "histories.py",
    "scaling.py",
    "cores.py",
)


def main() -> None:
    parts = [
        "# Results",
        f"{datetime.date.today().isoformat()}. {machine()}; one thread. "
        f"{versions('numba', 'llvmlite', 'numpy', 'particles')}.",
        "Written by `make bench`. Times differ between machines and days: compare the ratios.",
    ]
    for script in SCRIPTS:
        print(f"== {script}", flush=True)
        out = subprocess.run(
            [sys.executable, HERE / script], stdout=subprocess.PIPE, text=True, check=True
        ).stdout
        print(out, flush=True)
        parts += [f"## `python bench/{script}`", out.strip()]
    (HERE / "RESULTS.md").write_text("\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
