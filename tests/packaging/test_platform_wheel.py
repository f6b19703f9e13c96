"""A pure wheel with machine code in it is a wheel for one Python, whole by its own RECORD."""

import base64
import csv
import hashlib
import zipfile

import pytest

from tests.packaging.platform_wheel import HOME, with_machine_code

INFO = "ssmppl-1.0.dist-info"


@pytest.fixture
def pure(tmp_path):
    path = tmp_path / "ssmppl-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr("ssmppl/__init__.py", "one = 1\n")
        wheel.writestr(
            f"{INFO}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n\n"
        )
        wheel.writestr(f"{INFO}/RECORD", "old\n")
    return path


def test_it_holds_what_the_pure_one_does_and_the_archives(pure):
    made = with_machine_code(pure, {"x86-64-v3.archive": b"\x00\x01"}, "3.12")
    assert made.name == "ssmppl-1.0-cp312-none-manylinux_2_17_x86_64.whl"
    with zipfile.ZipFile(made) as wheel:
        held = {name: wheel.read(name) for name in wheel.namelist()}
    assert held[f"{HOME}/x86-64-v3.archive"] == b"\x00\x01"
    assert held["ssmppl/__init__.py"] == b"one = 1\n"
    lines = held[f"{INFO}/WHEEL"].decode().split("\n")
    assert "Tag: cp312-none-manylinux_2_17_x86_64" in lines
    assert "Tag: py3-none-any" not in lines
    rows = list(csv.reader(held[f"{INFO}/RECORD"].decode().splitlines()))
    assert {row[0] for row in rows} == set(held)
    for name, digest, size in rows:
        if name == f"{INFO}/RECORD":
            assert (digest, size) == ("", "")
            continue
        found = base64.urlsafe_b64encode(hashlib.sha256(held[name]).digest()).decode()
        assert (digest, int(size)) == ("sha256=" + found.rstrip("="), len(held[name]))


def test_what_is_no_pure_wheel_is_refused(pure):
    made = with_machine_code(pure, {}, "3.11")
    with pytest.raises(ValueError, match="no pure wheel"):
        with_machine_code(made, {}, "3.11")
