"""A terminal is told of compilation that takes long; nothing else is."""

import io

import numba
import pytest

from ssmppl.codegen.native import loading


class Screen(io.StringIO):
    def __init__(self, terminal):
        super().__init__()
        self.terminal = terminal

    def isatty(self):
        return self.terminal


def compile_something():
    numba.njit(lambda x: x + 1.0)(2.0)


@pytest.fixture
def told(monkeypatch):
    """Makes a listener of its own, and returns what compilations write to stderr with it."""

    def run(terminal, silent, compilations=2):
        screen, notice = Screen(terminal), loading.Notice()
        monkeypatch.setattr("sys.stderr", screen)
        monkeypatch.setattr(loading, "SILENT_SECONDS", silent)
        monkeypatch.setattr(loading.notice, "given", True)
        loading.event.register("numba:compile", notice)
        try:
            for _ in range(compilations):
                compile_something()
        finally:
            loading.event.unregister("numba:compile", notice)
        return screen.getvalue()

    return run


def test_a_terminal_is_told_once(told):
    assert told(True, 0.0) == loading.TEXT + "\n"


def test_short_compilations_add_up(told):
    compile_something()  # without what Numba loads for its first one
    assert told(True, 1e9) == ""
    assert told(True, 0.05, compilations=12) == loading.TEXT + "\n"


def test_what_is_no_terminal_is_told_nothing(told):
    assert told(False, 0.0) == ""


def test_the_package_listens():
    assert loading.notice in loading.event._registered["numba:compile"]
