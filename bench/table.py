"""Tables, the machine and the versions, as the benchmarks report them."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

WIDEST = (("avx512f", "AVX-512"), ("avx2", "AVX2"))


def show(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table in Markdown, the columns aligned."""
    print(text(header, rows), flush=True)


def text(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """The table in Markdown, the columns aligned."""
    cells = [[str(c) for c in row] for row in (header, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |"
             for row in cells]  # fmt: skip
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def machine() -> str:
    """Cores, maker and vector registers: nothing that names the machine."""
    from os import cpu_count

    from llvmlite import binding

    features = binding.get_host_cpu_features()
    vectors = next((name for key, name in WIDEST if features.get(key)), "no AVX2")
    try:
        with open("/proc/cpuinfo") as file:
            found = [li.split(":")[1].strip() for li in file if li.startswith("model name")]
    except OSError:
        found = []
    return f"{cpu_count()} cores, {found[0] if found else platform.machine()}, {vectors}"


def versions(*packages: str) -> str:
    """Python, the packages and the C compiler."""
    found = [f"Python {platform.python_version()}"]
    found += [f"{name} {version(name)}" for name in packages]
    try:
        run = subprocess.run(["gcc", "-dumpfullversion"], capture_output=True, text=True)
        found.append(f"gcc {run.stdout.strip()}")
    except OSError:
        pass
    return ", ".join(found)
