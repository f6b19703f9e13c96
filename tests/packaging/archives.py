"""sdist and wheel: made, and compared file by file with what they have to hold."""

from __future__ import annotations

import shutil
import tarfile
import zipfile
from pathlib import Path

from tests.packaging.environments import Environment
from tests.packaging.project import NAME, ROOT, SDIST_MADE, SDIST_TOP, VERSION, present

DIST = ROOT / "dist"


def make(tools: Environment) -> Path:
    """Build the sdist, the wheel from the sdist, into dist/; return the wheel.

    Raises ValueError where one of them holds something else than it should.
    """
    shutil.rmtree(DIST, ignore_errors=True)
    tools.run("-m", "build", "--outdir", DIST, ROOT)
    (sdist,) = DIST.glob("*.tar.gz")
    (wheel,) = DIST.glob("*.whl")
    with tarfile.open(sdist) as archive:
        names = [member.name for member in archive.getmembers() if not member.isdir()]
    _compare(sdist, {name.partition("/")[2] for name in names}, present() | SDIST_TOP | SDIST_MADE)
    with zipfile.ZipFile(wheel) as archive:
        _compare(wheel, set(archive.namelist()), present() | {licence()})
    return wheel


def licence() -> str:
    """Where PEP 639 puts the licence into a wheel."""
    return f"{NAME}-{VERSION}.dist-info/licenses/LICENSE"


def _compare(archive: Path, found: set[str], expected: set[str]) -> None:
    """Metadata that setuptools makes aside, the archive holds the expected files and no others."""
    made = {f for f in found if f.split("/")[0].endswith((".egg-info", ".dist-info"))} - expected
    missing, unwanted = expected - found, found - expected - made
    if missing or unwanted:
        raise ValueError(f"{archive.name}: missing {sorted(missing)}, unwanted {sorted(unwanted)}")
    print(f"{archive.name}: {len(found)} files, {archive.stat().st_size / 1e6:.2f} MB", flush=True)
