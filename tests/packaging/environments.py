"""Interpreters that are on this machine, clean environments of them, and what stands in them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.packaging.project import oldest

PYTHONS = ("3.11", "3.12", "3.13")

# Sets of dependencies, as constraints for pip.
SETS = {"newest": [], "arviz0": ["arviz<1"], "oldest": oldest()}

SHOWN = ("numpy", "numba", "arviz", "xarray", "pandas", "scipy")


def interpreter(version: str) -> Path | None:
    """This Python, one on the PATH or one of pyenv's, if it is of that version and runs."""
    candidates = [sys.executable] if _is(sys.executable, version) else []
    for folder in os.get_exec_path():
        candidates += filter(None, [shutil.which(f"python{version}", path=folder)])
    if shutil.which("pyenv"):
        found = subprocess.run(["pyenv", "prefix", version], capture_output=True, text=True)
        candidates += [f"{folder}/bin/python" for folder in found.stdout.splitlines()]
    return next((Path(path) for path in candidates if _is(path, version)), None)


def _is(python: str, version: str) -> bool:
    """Whether it runs, and is that version: the shims of pyenv stand on the PATH and may not."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    try:
        found = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True)
    except OSError:
        return False
    return found.returncode == 0 and found.stdout.strip() == version


class Environment:
    """A fresh environment in `folder`, with a work folder beside it where nothing else lies."""

    def __init__(self, python: Path, folder: Path):
        self.folder = folder
        self.work = folder / "work"
        self.python = folder / "env" / "bin" / "python"
        run([python, "-I", "-m", "venv", folder / "env"], Path.home())
        self.work.mkdir()

    def install(
        self, *requirements: str | Path, constraints: Sequence[str] = (), sources: bool = False
    ) -> None:
        """Install; without `sources` from wheels alone: no user has to compile a dependency."""
        command = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"]
        if constraints:
            file = self.folder / "constraints.txt"
            file.write_text("\n".join(constraints) + "\n", encoding="utf-8")
            command += ["--constraint", str(file)]
        if not sources:
            command += ["--only-binary", ":all:"]
        self.run(*command, *requirements)

    def run(self, *arguments: str | Path) -> None:
        """Run this Python in the work folder; CalledProcessError where it fails."""
        run([self.python, *arguments], self.work)

    def versions(self) -> dict[str, str]:
        """Every installed distribution and its version."""
        command = [self.python, "-m", "pip", "list", "--format", "json"]
        found = subprocess.run(
            command, cwd=self.work, env=_surroundings(self.work), check=True,
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        return {one["name"].lower(): one["version"] for one in json.loads(found.stdout)}


def run(command: Sequence[str | Path], folder: Path) -> None:
    """Run a command in a folder, away from the source tree and from what points to it."""
    subprocess.run(
        [str(part) for part in command], cwd=folder, env=_surroundings(folder), check=True
    )


def _surroundings(folder: Path) -> dict[str, str]:
    kept = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    }
    return kept | {"MPLBACKEND": "Agg", "SSMPPL_CACHE": str(folder / "cache")}
