"""What threads make at once: without errors, once, and without waiting for each other."""

from __future__ import annotations

import ast
import gc
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path

import numba
import numpy as np
import pytest

import ssmppl as ssm
from ssmppl import compiling
from ssmppl.compiling import (
    LOCK,
    literal,
    once,
    once_property,
    one_at_a_time,
    parse,
    uncollected,
)
from tests.models.statements import build

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0  # seconds; what is asked for takes milliseconds


def within_patience(work):
    """What `work` gives in a thread of its own; an error where it waits for this one."""
    threads = ThreadPoolExecutor(1)
    try:
        return threads.submit(work).result(PATIENCE)
    finally:
        threads.shutdown(wait=False)


@pytest.mark.slow
def test_many_threads_make_many_models_into_an_empty_cache(tmp_path):
    """None fails in Python's parser, none waits for ever, and each thing is made once."""
    environment = {**os.environ, "SSMPPL_CACHE": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-m", "tests.codegen.many_threads"],
        cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-4000:]


# -- parsing
def mismatch(times, message="AST constructor recursion depth mismatch (before=30, after=32)"):
    """Python's parser as it fails beside another thread's, so many times."""
    left, right = [times], ast.parse

    def run(*args, **kwargs):
        left[0] -= 1
        if left[0] >= 0:
            raise SystemError(message)
        return right(*args, **kwargs)

    return run


def test_a_text_is_parsed_again_where_a_thread_that_is_not_ours_parsed_too(monkeypatch):
    monkeypatch.setattr(ast, "parse", mismatch(3))
    assert ast.unparse(parse("x = 1")) == "x = 1"
    monkeypatch.setattr(ast, "parse", mismatch(3))
    assert literal(" (1, 2.5, 'a')") == (1, 2.5, "a")


def test_other_errors_of_the_parser_are_told(monkeypatch):
    with pytest.raises(SyntaxError):
        parse("x = ")
    monkeypatch.setattr(ast, "parse", mismatch(1, "unknown opcode"))
    with pytest.raises(SystemError, match="opcode"):
        parse("x = 1")
    monkeypatch.setattr(ast, "parse", mismatch(10**6))
    with pytest.raises(SystemError, match="mismatch"):
        parse("x = 1")


# -- the lock
class Thing:
    def __init__(self, made):
        self.made = made

    @once_property
    def whole(self):
        """All of it."""
        return self.made(self.part)

    @once_property
    def part(self):
        return self.made(1)


def test_two_threads_that_ask_at_once_get_the_same():
    """Where the first is still at work when the others ask."""
    asked, count = threading.Barrier(4), []

    def made(value):
        count.append(value)
        with pytest.raises(threading.BrokenBarrierError):  # nobody else is here
            alone.wait(0.05)
        return object()

    alone = threading.Barrier(2)
    function, thing = once(made), Thing(made)

    def ask(_):
        asked.wait(PATIENCE)
        return function(1), thing.whole, thing.part

    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(ask, range(4)))
    assert len(count) == 3
    assert all(a is b for each in found for a, b in zip(each, found[0], strict=True))


def test_a_property_that_is_made_once_is_a_cached_property():
    thing = Thing(lambda value: value)
    assert (thing.whole, vars(thing)) == (1, {**vars(thing), "whole": 1, "part": 1})
    assert isinstance(Thing.whole, cached_property)
    assert Thing.whole.__doc__ == "All of it."
    vars(thing).clear()
    thing.whole = 2
    assert thing.whole == 2


def test_making_one_thing_may_ask_for_others_and_an_error_gives_the_lock_back():
    @one_at_a_time
    def fails(depth):
        if depth == 0:
            raise ValueError("here")
        fails(depth - 1)

    with pytest.raises(ValueError, match="here"):
        fails(3)
    assert within_patience(once(lambda: 3)) == 3


def test_numba_compiles_under_the_same_lock():
    """A thread in Numba's compiler may ask for ours, and the other way round."""
    assert LOCK is numba.core.compiler_lock.global_compiler_lock
    assert compiling.LOCK is LOCK


# -- passes over data run beside what is made
@pytest.mark.parametrize(
    ("name", "theta", "settings"),
    [
        ("linear_scalar", {"a": 0.5, "q": 1.0, "r": 0.5}, {}),  # Kalman's filter
        ("varves", {"phi": 0.9, "tau": 8.0}, {"proposal": "guided"}),
        ("varves", {"phi": 0.9, "tau": 8.0}, {"proposal": "twisted"}),
    ],
)
def test_what_is_made_runs_while_another_thread_compiles(name, theta, settings):
    model = build(name)
    data = {"y": np.linspace(1.0, 2.0, 20)}

    def run():
        return ssm.log_likelihood(model, data, theta, seed=1, **settings)

    first = run()
    with LOCK:
        assert within_patience(run) == first


# -- processes
def child(answer):
    answer.put(str(numba.njit(lambda x: x + 1.0)(2.0)))


@pytest.mark.skipif(not hasattr(os, "register_at_fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_process_forked_while_a_thread_compiles_can_compile():
    """The fork waits for the thread, and the lock is free in the child."""
    inside, leave = threading.Event(), threading.Event()

    def compile_long():
        with LOCK:
            inside.set()
            leave.wait(PATIENCE)

    context = get_context("fork")
    answer = context.Queue()
    other = threading.Thread(target=compile_long)
    other.start()
    assert inside.wait(PATIENCE)
    threading.Timer(0.2, leave.set).start()
    process = context.Process(target=child, args=(answer,), daemon=True)
    process.start()
    assert leave.is_set(), "the fork did not wait"
    try:
        assert answer.get(timeout=PATIENCE) == "3.0"
    finally:
        process.kill()
        other.join()
    assert within_patience(once(lambda: 3)) == 3


def test_a_fork_by_the_thread_that_compiles_does_not_wait():
    if not hasattr(os, "fork"):
        pytest.skip("this system does not fork")
    with LOCK:
        process = get_context("fork").Process(target=np.zeros, args=(1,))
        process.start()
        process.join(PATIENCE)
    assert process.exitcode == 0


# -- garbage
def test_garbage_waits_for_what_is_made_and_no_longer():
    """Also within each other, and where it fails; what the user has switched off stays off."""

    @one_at_a_time
    def inner():
        return gc.isenabled()

    @one_at_a_time
    def outer(fails):
        found = inner(), gc.isenabled()
        if fails:
            raise ValueError
        return found

    assert gc.isenabled()
    assert outer(False) == (False, False)
    assert gc.isenabled()
    with pytest.raises(ValueError):
        outer(True)
    assert gc.isenabled()
    gc.disable()
    try:
        with uncollected():
            assert not gc.isenabled()
        assert not gc.isenabled()
    finally:
        gc.enable()
