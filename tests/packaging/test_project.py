"""What the sources say of the package agrees, and everything in its folder is shipped."""

import re

import pytest
import yaml

import ssmppl
from tests.packaging.environments import PYTHONS, SETS
from tests.packaging.project import (
    PROJECT,
    ROOT,
    SDIST_TOP,
    VERSION,
    lower_bounds,
    present,
    shipped,
)


def test_one_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (\S+)$", citation, re.MULTILINE) == [VERSION]
    assert ssmppl.__version__ == VERSION
    # A released version has its heading, with the day; what comes next stands above it.
    log = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (.*)$", log, re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)", one) for one in headings[1:])
    assert not headings[1:] or headings[1].split()[0] == VERSION


CONDA_NAMES = {"matplotlib": "matplotlib-base"}  # without the windows of a desktop


def test_the_conda_recipe_asks_for_the_same():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == VERSION
    project = PROJECT["project"]
    least = recipe["context"]["python_min"]
    run = [r.replace("${{ python_min }}", least).split() for r in recipe["requirements"]["run"]]
    asked = [re.match(r"([\w-]+)(.*)", d).groups() for d in project["dependencies"]]
    assert run == [
        ["python", project["requires-python"]],
        *([CONDA_NAMES.get(n, n), bounds] for n, bounds in asked),
    ]
    (build,) = PROJECT["build-system"]["requires"]
    assert recipe["requirements"]["host"][-1].replace(" ", "") == build
    (script,) = project["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [" = ".join(script)]
    about = recipe["about"]
    assert (about["summary"], about["license"]) == (project["description"], project["license"])


def test_the_wheel_takes_all_that_is_in_the_folder():
    assert present() == shipped()
    assert {"ssmppl/py.typed", "ssmppl/datasets/nile.csv"} <= shipped()


@pytest.mark.parametrize(
    "stray", ["diagnosis/table.json", "datasets/more/x.csv", "extra/module.py"]
)
def test_a_file_that_no_pattern_takes_is_seen(tmp_path, stray):
    for name in ("__init__.py", "py.typed", "diagnosis/__init__.py", "datasets/__init__.py", stray):
        file = tmp_path / "ssmppl" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    assert present(tmp_path) - shipped(tmp_path) == {f"ssmppl/{stray}"}


def test_the_sdist_has_what_stands_at_the_top():
    lines = (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
    included = {name for line in lines if line.startswith("include ") for name in line.split()[1:]}
    # setuptools takes these three by itself, and the licence because pyproject.toml names it
    assert (
        included
        | {"MANIFEST.in", "README.md", "pyproject.toml"}
        | {*PROJECT["project"]["license-files"]}
        == SDIST_TOP
    )
    assert all((ROOT / name).is_file() for name in SDIST_TOP)


def test_every_dependency_has_the_lower_bound_that_is_tried():
    bounds = lower_bounds(PROJECT["project"]["dependencies"])
    assert SETS["oldest"] == [f"{name}=={version}" for name, version in bounds.items()]
    assert "numba==" + bounds["numba"] in SETS["oldest"]


@pytest.mark.parametrize("text", ["numpy", "numpy>=2,<3", "numpy>2", "numpy==2.1", "numpy~=2.1"])
def test_a_requirement_that_is_no_lower_bound_is_refused(text):
    with pytest.raises(ValueError, match="not of the form"):
        lower_bounds(["scipy>=1.14.1", text])


def test_extras_are_read_too():
    assert lower_bounds(["numba-cuda[cu12]>=0.20"]) == {"numba-cuda": "0.20"}


def test_pythons_of_the_classifiers_are_those_that_are_tried():
    project = PROJECT["project"]
    named = [c.rpartition(" ")[2] for c in project["classifiers"] if re.search(r":: 3\.\d+$", c)]
    assert tuple(named) == PYTHONS
    first, last = PYTHONS[0], int(PYTHONS[-1].split(".")[1])
    assert project["requires-python"] == f">={first},<3.{last + 1}"
