"""Known vulnerabilities of what `pip install ssmppl` brings today, by pip-audit.

    python -m tests.packaging.audit                   fails on one, and where none is told
    python -m tests.packaging.audit --no-answer-ok    fails on one

pip-audit asks PyPI for the advisories of each version. A mirror that does not have them answers as
if there were none; so a version with advisories that are years old is asked for too, and where none
comes back for it, nothing was looked up.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from tests.packaging.environments import Environment
from tests.packaging.project import PROJECT

# Has CVE-2019-11236 among others; no dependency of the package, so that it cannot be mistaken.
CONTROL = ("urllib3", "1.24.1")

# Extras for users, besides what every installation brings. `cuda` is its own platform's matter.
EXTRAS = ("parquet", "dask")

# How pip-audit, and requests under it, speak of advisories that could not be asked for.
NO_CONNECTION = (
    "ConnectionError", "HTTPError", "Could not connect", "Max retries exceeded", "ReadTimeout",
    "not redirecting properly",
)  # fmt: skip


@dataclass(frozen=True)
class Verdict:
    """Lines on known vulnerabilities, and on what could not be looked up."""

    known: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()

    def status(self, no_answer_ok: bool) -> int:
        """Exit status: 1 for a known vulnerability, 3 where something was not looked up."""
        return 1 if self.known else 3 if self.unknown and not no_answer_ok else 0


def verdict(status: int, answer: str, messages: str, asked: Collection[str]) -> Verdict:
    """Judge what pip-audit said.

    Parameters
    ----------
    status, answer, messages : its exit status, standard output (JSON) and standard error.
    asked : canonical names of the packages that it was asked about, `CONTROL` aside.

    Raises
    ------
    RuntimeError : it did not run as it should, for another reason than that nobody answered.
    """
    try:
        found = {canonical(one["name"]): one for one in json.loads(answer)["dependencies"]}
    except (ValueError, KeyError, TypeError):
        if status == 1 and any(words in messages for words in NO_CONNECTION):
            return Verdict(unknown=("no advisories: " + messages.strip().splitlines()[-1],))
        raise RuntimeError(f"pip-audit ended with status {status}:\n{messages}") from None
    known = tuple(
        f"{name} {found[name]['version']}: {one['id']}"
        f" (fixed in {', '.join(one['fix_versions']) or 'no version'})"
        for name in sorted(asked)
        for one in found.get(name, {}).get("vulns", ())
    )
    if not found.get(CONTROL[0], {}).get("vulns"):
        none = f"no advisories at all: {' '.join(CONTROL)} has some, and none came back"
        return Verdict(known, unknown=(none,))
    unknown = tuple(
        f"{name}: {found.get(name, {}).get('skip_reason', 'no answer')}"
        for name in sorted(asked)
        if "vulns" not in found.get(name, {})
    )
    return Verdict(known, unknown)


def canonical(name: str) -> str:
    """A distribution's name as indices compare it (PEP 503)."""
    return re.sub("[-_.]+", "-", name).lower()


def resolved(environment: Environment) -> dict[str, str]:
    """What pip would install for a user of this Python, without installing it: version by name."""
    project = PROJECT["project"]
    wanted = list(project["dependencies"])
    for extra in EXTRAS:
        wanted += project["optional-dependencies"][extra]
    report = environment.folder / "report.json"
    environment.run("-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed",
                    "--only-binary", ":all:", "--report", report, *wanted)  # fmt: skip
    plan = json.loads(report.read_text(encoding="utf-8"))["install"]
    return {canonical(one["metadata"]["name"]): one["metadata"]["version"] for one in plan}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.packaging.audit")
    parser.add_argument("--no-answer-ok", action="store_true",
                        help="do not fail where the advisories cannot be reached")  # fmt: skip
    no_answer_ok = parser.parse_args().no_answer_ok
    with tempfile.TemporaryDirectory(prefix="ssmppl-audit-") as temporary:
        environment = Environment(Path(sys.executable), Path(temporary))
        environment.install("pip-audit")
        pins = resolved(environment)
        file = environment.folder / "pins.txt"
        lines = [f"{name}=={version}\n" for name, version in (pins | dict([CONTROL])).items()]
        file.write_text("".join(lines), encoding="utf-8")
        command = [environment.python, "-m", "pip_audit", "--requirement", file, "--no-deps",
                   "--disable-pip", "--format", "json", "--progress-spinner", "off"]  # fmt: skip
        ran = subprocess.run(command, cwd=environment.work, capture_output=True, text=True)
    found = verdict(ran.returncode, ran.stdout, ran.stderr, pins)
    print(f"{len(pins)} packages:", *(f"{name} {version}" for name, version in pins.items()))
    for line in found.known:
        print(f"KNOWN VULNERABILITY  {line}")
    for line in found.unknown:
        print(f"NOT LOOKED UP  {line}")
    if found.unknown:
        print("The audit says nothing about what was not looked up; repeat it where PyPI answers.")
    elif not found.known:
        print("No known vulnerabilities.")
    return found.status(no_answer_ok)


if __name__ == "__main__":
    sys.exit(main())
