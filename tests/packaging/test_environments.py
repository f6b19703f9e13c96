"""Interpreters are found on the PATH, and those that do not run are passed over."""

import os

from tests.packaging.environments import interpreter


def script(folder, name, text):
    folder.mkdir(exist_ok=True)
    file = folder / name
    file.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    file.chmod(0o755)
    return file


def test_a_python_that_does_not_run_is_passed_over(tmp_path, monkeypatch):
    # The first as pyenv's shims are where no version is chosen; the second another than it says.
    script(tmp_path / "shims", "python3.99", "echo 'command not found' >&2; exit 127")
    script(tmp_path / "other", "python3.99", "echo 3.98")
    monkeypatch.setenv("PATH", os.pathsep.join(str(tmp_path / f) for f in ("shims", "other")))
    assert interpreter("3.99") is None
    good = script(tmp_path / "good", "python3.99", "echo 3.99")
    monkeypatch.setenv("PATH", os.environ["PATH"] + os.pathsep + str(good.parent))
    assert interpreter("3.99") == good


def test_pyenv_is_asked_where_the_path_has_none(tmp_path, monkeypatch):
    good = script(tmp_path / "bin", "python", "echo 3.99")
    script(tmp_path / "tools", "pyenv", f'test "$*" = "prefix 3.99" && echo "{tmp_path}"')
    monkeypatch.setenv("PATH", str(tmp_path / "tools"))
    assert interpreter("3.99") == good
    assert interpreter("3.98") is None
