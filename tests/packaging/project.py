"""What the sources say of the package: its requirements, and the files that have to be shipped."""

from __future__ import annotations

import re
import tomllib
from fnmatch import fnmatchcase
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NAME, VERSION = PROJECT["project"]["name"], PROJECT["project"]["version"]

# At the top of the sdist, besides what setuptools writes there itself.
SDIST_TOP = {
    "CHANGELOG.md",
    "CITATION.cff",
    "LICENSE",
    "MANIFEST.in",
    "README.md",
    "pyproject.toml",
}
SDIST_MADE = {"PKG-INFO", "setup.cfg"}


def lower_bounds(requirements: list[str]) -> dict[str, str]:
    """Version of each requirement's lower bound, by name.

    Raises ValueError for a requirement without one, or one that says more than this function knows.
    """
    found = {}
    for requirement in requirements:
        match = re.fullmatch(r"([\w.-]+)(?:\[[\w,-]+\])?>=([\d.]+)", requirement)
        if match is None:
            raise ValueError(f"{requirement!r} is not of the form name>=version")
        found[match[1]] = match[2]
    return found


def oldest() -> list[str]:
    """Constraints under which pip installs the oldest dependencies that the package allows."""
    bounds = lower_bounds(PROJECT["project"]["dependencies"])
    return [f"{name}=={version}" for name, version in bounds.items()]


def shipped(root: Path = ROOT) -> set[str]:
    """Files of the package that setuptools puts into a wheel as pyproject.toml has it."""
    settings = PROJECT["tool"]["setuptools"]
    (pattern,) = settings["packages"]["find"]["include"]
    found = set()
    for top in sorted(root.iterdir()):
        if not fnmatchcase(top.name, pattern) or not (top / "__init__.py").is_file():
            continue
        data = settings["package-data"][top.name]
        found |= {
            path
            for path in top.rglob("*.py")
            if all((folder / "__init__.py").is_file() for folder in _folders(path, root))
        }
        found |= {path for pattern in data for path in top.glob(pattern)}
    return {path.relative_to(root).as_posix() for path in found}


def present(root: Path = ROOT) -> set[str]:
    """All files in the folder of the package, but what interpreters and caches leave there."""
    files = (path for path in (root / NAME).rglob("*") if path.is_file())
    return {
        path.relative_to(root).as_posix()
        for path in files
        if "__pycache__" not in path.parts and path.suffix != ".pyc"
    }


def _folders(path: Path, root: Path) -> list[Path]:
    return [folder for folder in path.parents if folder != root and root in folder.parents]
