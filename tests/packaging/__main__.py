"""Build the package, install it in clean environments, use it there; one table at the end."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.packaging import archives, platform_wheel
from tests.packaging.environments import PYTHONS, SETS, SHOWN, Environment, interpreter, run
from tests.packaging.project import PROJECT, ROOT

HERE = Path(__file__).parent

# What depends on other packages most: data, results, files, plots, the command line, compilers.
SUITE = [
    "tests/data/test_data.py",
    "tests/diagnosis/report/test_panels.py",
    "tests/test_results.py",
    "tests/cli/test_commands.py",
    "tests/cli/test_reading.py",
    "tests/codegen/test_native.py",
    "tests/codegen/test_program.py",
    "tests/inference/verbs/test_forecast.py",
    "tests/inference/verbs/test_predict.py",
    "tests/inference/verbs/test_sample.py",
    "tests/plots",
]
# Of the development's packages, those that the tests do not import.
NO_TEST = ("mypy", "ruff")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.packaging", description=__doc__)
    parser.add_argument("--python", nargs="+", choices=PYTHONS, default=PYTHONS, metavar="VERSION")
    sets = "newest dependencies, newest with ArviZ below 1, lower bounds; all if not given"
    parser.add_argument(
        "--set", nargs="+", choices=SETS, default=list(SETS), dest="sets", help=sets
    )
    parser.add_argument("--tests", action="store_true", help="a part of the test suite, too")
    parser.add_argument(
        "--machine-code", action="store_true",
        help="a wheel with machine code, too: the kernels are compiled for each target",
    )  # fmt: skip
    parser.add_argument("--workers", default="2", help="of the test suite")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ssmppl-packaging-") as temporary:
        folder = Path(temporary)
        began = time.monotonic()
        tools = _tools(folder / "tools")
        wheel = archives.make(tools)
        print(f"built in {time.monotonic() - began:.0f} s", flush=True)
        rows = [
            row for version in asked.python for row in _rows(version, folder, wheel, tools, asked)
        ]
    _table([["Python", "set", *SHOWN, "seconds", "result"], *rows])
    results = {row[-1] for row in rows}
    return 0 if results <= {"pass", "absent"} and "pass" in results else 1


def _rows(
    version: str, folder: Path, wheel: Path, tools: Environment, asked: argparse.Namespace
) -> Iterator[list[str]]:
    """A row of the table for each set of dependencies under one Python."""
    python = interpreter(version)
    if python is None:
        print(f"\n==== Python {version} is not on this machine: skipped", flush=True)
        yield [version, "-", *"-" * len(SHOWN), "-", "absent"]
        return
    newest_arviz = ""
    for name in asked.sets:
        if name == "arviz0" and newest_arviz.startswith("0."):
            print(f"\n==== Python {version}, {name}: the same as newest, skipped", flush=True)
            continue
        print(f"\n==== Python {version}, {name}", flush=True)
        began = time.monotonic()
        place = folder / f"{version}-{name}"
        place.mkdir()
        result, found = _try(python, place, name, version, wheel, tools, asked)
        shutil.rmtree(place)
        if name == "newest":
            newest_arviz = found.get("arviz", "")
        seconds = f"{time.monotonic() - began:.0f}"
        print(f"==== {result} after {seconds} s", flush=True)
        yield [version, name, *(found.get(package, "-") for package in SHOWN), seconds, result]


def _tools(folder: Path) -> Environment:
    """An environment with what builds and checks, so that those under test stay clean."""
    folder.mkdir()
    tools = Environment(Path(sys.executable), folder)
    (mypy,) = (one for one in _development() if one.startswith("mypy"))
    tools.install("build", mypy)
    return tools


def _development() -> list[str]:
    return list(PROJECT["project"]["optional-dependencies"]["dev"])


def _try(
    python: Path,
    folder: Path,
    name: str,
    version: str,
    wheel: Path,
    tools: Environment,
    asked: argparse.Namespace,
) -> tuple[str, dict[str, str]]:
    """Install and use the wheel; return "pass" or what failed, and the installed versions."""
    found: dict[str, str] = {}
    step = "install"
    try:
        environment = Environment(python, folder)
        environment.install(wheel, constraints=SETS[name])
        found = environment.versions()
        step = "pip check"
        environment.run("-m", "pip", "check")
        step = "smoke test"
        shutil.copy(HERE / "smoke.py", environment.work)
        environment.run("smoke.py")
        step = "types"
        shutil.copy(HERE / "user.py", environment.work)
        run([tools.python, "-m", "mypy", "--strict", "--python-executable", environment.python,
             "--cache-dir", folder / "mypy", "user.py"], environment.work)  # fmt: skip
        if asked.machine_code and name == "newest" and platform_wheel.FITS:
            step = "machine code"
            _with_machine_code(environment, wheel, version)
        if asked.tests:
            step = "tests"
            _suite(environment, name, asked.workers)
    except subprocess.CalledProcessError as error:
        print(f"==== {step} FAILED: {error}", flush=True)
        return f"{step} FAILED", found
    return "pass", found


def _with_machine_code(environment: Environment, wheel: Path, version: str) -> None:
    """Make the wheel with machine code for this Python, into dist/, and use it."""
    shutil.copy(HERE / "machine_code.py", environment.work)
    shutil.copy(HERE / "cold.py", environment.work)
    environment.run("machine_code.py", "archives")
    made = sorted((environment.work / "archives").iterdir())
    full = platform_wheel.with_machine_code(wheel, {f.name: f.read_bytes() for f in made}, version)
    print(f"{full.name}: {full.stat().st_size / 1e6:.2f} MB", flush=True)
    environment.run("-m", "pip", "install", "--quiet", "--no-deps", "--force-reinstall", full)
    environment.run("cold.py")


def _suite(environment: Environment, name: str, workers: str) -> None:
    """The tests against the installed package: they are copied to where no source of it lies."""
    needed = [one for one in _development() if not one.startswith(NO_TEST)]
    environment.install(*needed, constraints=SETS[name], sources=True)
    source = environment.work / "source"
    for part in ("tests", "examples", "bench"):
        shutil.copytree(ROOT / part, source / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", source)
    run([environment.python, "-m", "pytest", "-q", "-n", workers, "-p", "no:cacheprovider", *SUITE],
        source)  # fmt: skip


def _table(rows: list[list[str]]) -> None:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    print()
    for row in rows:
        print(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        )


if __name__ == "__main__":
    sys.exit(main())
