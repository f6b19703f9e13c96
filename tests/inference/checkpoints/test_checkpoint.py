"""Checkpoints of chains: what is kept bit for bit, what is refused, what a full disk does.

On a random walk that needs no compilation; that `sample` continues its methods is tested in
test_checkpoint_sample.py.
"""

from __future__ import annotations

import errno
import io
import os
import pickle
import resource
import signal
import subprocess
import sys
import time
import warnings
import zipfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmppl.errors import ArgumentError
from ssmppl.inference.checkpoints import archive, chains
from ssmppl.inference.checkpoints.chains import CheckpointFile
from ssmppl.inference.checkpoints.codec import Codec, Store
from ssmppl.inference.checkpoints.origin import Origin
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import Block, stack

ROOT = Path(__file__).parents[3]
N, WARMUP, CHAINS, WIDTH = 60, 20, 3, 4


@dataclass(frozen=True)
class Scale:
    value: Any
    seen: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class Walk:
    """A walk whose step adapts for WARMUP draws."""

    x: np.ndarray
    scale: Scale
    generator: np.random.Generator
    count: int = 0


CODEC = Codec([Walk, Scale])


def walk(state: Walk, n: int, width: int = WIDTH) -> tuple[Walk, Block]:
    generator = np.random.default_rng()
    generator.bit_generator.state = state.generator.bit_generator.state
    x, scale, out, rates = state.x, state.scale, [], []
    for i in range(n):
        x = x + scale.value * generator.normal(size=width)
        if state.count + i < WARMUP:
            scale = Scale(scale.value * 1.01, (*scale.seen[-2:], x))
        out.append(x)
        rates.append(generator.uniform())
    after = Walk(x, scale, generator, state.count + n)
    return after, Block({"x": np.array(out)}, {"acceptance_rate": np.array(rates)})


def starts(seed, width=WIDTH):
    return [Walk(np.zeros(width), Scale(1.0), np.random.default_rng([seed, i]))
            for i in range(CHAINS)]  # fmt: skip


def opened(path, seed=1, draws=N, **changes):
    origin = Origin({"model": "m", "data": "d"}, {"chains=": "3", "numpy": "2.0", **changes})
    return CheckpointFile(path, origin, seed, np.random.SeedSequence(seed), CODEC, draws)


def run(path, draws=N, step=walk, block=7, seed=1, **changes):
    kept = opened(path, seed, draws, **changes)
    first = starts(kept.root.entropy)
    return run_chains(step, first, draws, WARMUP, block=block, progress=False, checkpoint=kept)


def drawn(result):
    return stack(result)[0]["x"]


@pytest.fixture(scope="module")
def expected():
    return drawn(run_chains(walk, starts(1), N, WARMUP, progress=False))


@pytest.fixture
def often(monkeypatch):
    """Written after every block."""
    monkeypatch.setattr(chains, "SECONDS", -1.0)
    monkeypatch.setattr(chains, "SHARE", 1e9)


class Crash(BaseException):
    """A kill that a test survives."""


def crash_at(count, step=walk):
    def failing(state, n):
        if state.count + n > count:
            raise Crash
        return step(state, n)

    return failing


class Dies:
    """A CheckpointFile whose process dies at a write: nothing is written after."""

    def __init__(self, monkeypatch, after):
        self.left, self.write = after, archive.write
        monkeypatch.setattr(chains, "write", self)

    def __call__(self, file, members):
        if self.left == 0:
            raise Crash
        self.left -= 1
        self.write(file, members)


# -- states
STATES = [
    None, True, 3, -(2**80), 0.1 + 0.2, -0.0, float("inf"), "naïve \x00 text", (), [], {},
    (1, (2.0, [None, "x"])), {"a": (1, 2), 3: [4]}, np.float64(1 / 3), np.int64(-5), np.bool_(True),
    np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(12).reshape(3, 4)[:, 1:3], np.empty((0, 3)), np.array(2.5), np.array([True, False]),
    np.array([1, 2**64 - 1], dtype=np.uint64), np.array(["ab", "c"]), np.float32([1, 2]),
    np.frombuffer(np.uint64(0x7FF8000000000ABC).tobytes(), dtype=float),
    Walk(np.ones(2), Scale(0.5, (np.zeros(1),)), np.random.default_rng(1), 7),
]  # fmt: skip


def alike(a, b):
    """Whether a is b as it was read, to the last bit."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray | np.generic):
        assert a.dtype == b.dtype
        assert np.shape(a) == np.shape(b)
        assert a.tobytes() == b.tobytes()
        if isinstance(a, np.ndarray) and (a.flags.c_contiguous or a.flags.f_contiguous):
            assert a.flags.f_contiguous == b.flags.f_contiguous
            assert a.flags.writeable
    elif isinstance(a, tuple | list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            alike(x, y)
    elif isinstance(a, dict):
        alike(list(a.items()), list(b.items()))
    elif isinstance(a, Walk | Scale):
        alike(list(vars(a).values()), list(vars(b).values()))
    elif isinstance(a, np.random.Generator):
        assert a.bit_generator.state == b.bit_generator.state
    else:
        assert repr(a) == repr(b)


def test_states_come_back_bit_for_bit(tmp_path):
    kept = opened(tmp_path / "a.npz")
    kept.once("all", lambda: STATES)
    alike(opened(tmp_path / "a.npz").once("all", None), STATES)


def test_a_generator_in_the_middle_of_a_word():
    """A 32-bit draw leaves half a word for the next."""
    one = np.random.default_rng(3)
    one.integers(10, dtype=np.uint32)
    store = Store()
    node = CODEC.encode(one, store)
    two = CODEC.decode(node, Store(store.members()))
    np.testing.assert_array_equal(*(g.integers(1000, size=9, dtype=np.uint32) for g in (one, two)))


@pytest.mark.parametrize("value", [object(), np.array([None]), {1, 2}, Path("x"), Codec([])])
def test_what_is_no_state_is_not_kept(value):
    with pytest.raises(TypeError, match="in a state"):
        CODEC.encode((1, value), Store())


# -- going on
@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("block", [1, 7, None])
@pytest.mark.parametrize("writes", [1, 5, 20])
def test_a_killed_run_goes_on_as_if_nothing_had_been(
    tmp_path, monkeypatch, expected, block, writes
):
    path = tmp_path / "a.npz"
    with monkeypatch.context() as patch:
        Dies(patch, writes)
        with pytest.raises(Crash):
            run(path, block=2)
    np.testing.assert_array_equal(drawn(run(path, block=block)), expected)
    assert [f.name for f in tmp_path.iterdir()] == ["a.npz"]


def test_a_finished_run_is_returned_without_a_step(tmp_path, expected):
    run(tmp_path / "a.npz")
    before = (tmp_path / "a.npz").read_bytes()
    result = run(tmp_path / "a.npz", step=crash_at(0))
    np.testing.assert_array_equal(drawn(result), expected)
    assert not result[0].interrupted
    assert (tmp_path / "a.npz").read_bytes() == before


def test_more_draws_and_fewer(tmp_path, expected):
    path = tmp_path / "a.npz"
    run(path, draws=23)
    np.testing.assert_array_equal(drawn(run(path)), expected)
    few = run(path, draws=10, step=crash_at(0))
    np.testing.assert_array_equal(drawn(few), expected[:, :10])
    np.testing.assert_array_equal(drawn(run(path, step=crash_at(0))), expected)


def test_without_a_seed_that_of_the_file_is_taken_up(tmp_path, expected):
    path = tmp_path / "a.npz"
    first = drawn(run(path, draws=5, seed=None))
    second = drawn(run(path, seed=None))
    np.testing.assert_array_equal(second[:, :5], first)
    assert not np.array_equal(second, expected)
    entropy = opened(path, None).root.entropy
    np.testing.assert_array_equal(drawn(run(path, seed=entropy)), second)


def test_ctrl_c_writes_before_it_returns(tmp_path):
    class Pressed(CheckpointFile):
        def due(self, chains):
            if min(c.done for c in chains) > WARMUP + 10 and not pressed:
                pressed.append(os.kill(os.getpid(), signal.SIGINT))
            return False

    pressed = []
    kept = opened(tmp_path / "a.npz")
    kept.__class__ = Pressed
    result = run_chains(
        walk, starts(1), 10**6, WARMUP, block=3, progress=False, checkpoint=kept
    )  # fmt: skip
    assert result[0].interrupted
    assert [s.done for s in opened(tmp_path / "a.npz").standings()] == [
        c.state.count for c in result
    ]
    n = drawn(result).shape[1]
    assert 10 < n < 10**5
    whole = drawn(run_chains(walk, starts(1), n + 5, WARMUP, progress=False))
    np.testing.assert_array_equal(drawn(result), whole[:, :n])
    np.testing.assert_array_equal(drawn(run(tmp_path / "a.npz", draws=n + 5)), whole)


def test_an_error_in_a_chain_keeps_the_others(tmp_path, expected):
    def failing(state, n):
        if state.count > 40:
            raise ArithmeticError("all weights are zero")
        return walk(state, n)

    with pytest.raises(ArithmeticError):
        run(tmp_path / "a.npz", step=failing, block=3)
    done = [s.done for s in opened(tmp_path / "a.npz").standings()]
    assert max(done) > 40
    np.testing.assert_array_equal(drawn(run(tmp_path / "a.npz")), expected)


def test_what_the_pilot_found_is_not_found_again(tmp_path):
    def pilot():
        made.append(1)
        return Scale(np.array([1.0, np.pi])), len(made)

    made = []
    first = opened(tmp_path / "a.npz").once("pilot", pilot)
    second = opened(tmp_path / "a.npz").once("pilot", pilot)
    alike(second, first)
    assert made == [1]


def test_writing_takes_a_small_share_of_the_time(tmp_path, monkeypatch):
    """The longer a writing takes, the longer until the next."""
    kept = opened(tmp_path / "a.npz")
    kept._cost, kept._written = 60.0, time.monotonic() - 1900.0
    assert not kept.due([])
    kept._written -= 101.0
    assert kept.due([])
    kept._cost = 0.0
    kept._written = time.monotonic() - 29.0
    assert not kept.due([])


# -- refusals
def unchanged_after(path, call, *said):
    before = path.read_bytes()
    with pytest.raises(ArgumentError) as error:
        call()
    for text in (str(path), *said):
        assert text in str(error.value)
    assert path.read_bytes() == before


@pytest.fixture
def finished(tmp_path):
    run(tmp_path / "a.npz", draws=5)
    return tmp_path / "a.npz"


def test_a_checkpoint_of_another_call_is_refused(finished):
    unchanged_after(finished, lambda: opened(finished, 2), "seed=1 (now 2)", "another path")
    changes = {"chains=": "4", "numpy": "2.1"}
    unchanged_after(finished, lambda: opened(finished, **changes), "chains=3 (now 4) and numpy 2.0")
    unchanged_after(finished, lambda: opened(finished, new="x"), "new nothing (now x)")
    origin, root = Origin({"model": "n", "data": "e"}, {}), np.random.SeedSequence(1)
    for seed in (None, 1):
        unchanged_after(
            finished, lambda s=seed: CheckpointFile(finished, origin, s, root, CODEC, N),
            "another model and other data",
        )  # fmt: skip


def test_a_file_cut_anywhere_is_refused(finished):
    whole = finished.read_bytes()
    for length in [1, 2, 30, *np.linspace(40, len(whole) - 1, 25).astype(int)]:
        finished.write_bytes(whole[:length])
        unchanged_after(finished, lambda: run(finished), "no checkpoint of `sample`")
    finished.write_bytes(b"")
    unchanged_after(finished, lambda: run(finished), "it is empty")


def test_a_file_with_other_bits_is_refused(finished):
    """Wherever they are, but in the few bytes of a zip that say nothing (times, attributes)."""
    whole, refused = finished.read_bytes(), 0
    expected = drawn(run(finished, draws=5))
    places = np.random.default_rng(0).integers(len(whole), size=150)
    for at in places:
        damaged = bytearray(whole)
        damaged[at] ^= 0x10
        finished.write_bytes(damaged)
        try:
            result = run(finished, draws=5)
        except ArgumentError as error:
            assert "no checkpoint" in str(error)  # noqa: PT017
            refused += 1
        else:
            np.testing.assert_array_equal(drawn(result), expected)
    assert refused > 0.8 * len(places)


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("executed",)


def test_reading_executes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.npz"
    np.savez(path, sample=np.array([Bomb()], dtype=object))
    unchanged_after(path, lambda: run(path), "no checkpoint")
    path.write_bytes(pickle.dumps(Bomb()))
    unchanged_after(path, lambda: run(path), "no checkpoint", "something else")
    assert not Path("executed").exists()


def test_a_file_names_no_class_but_those_of_states(finished):
    def other(text):
        assert b"test_checkpoint.Walk" in text
        return text.replace(b"test_checkpoint.Walk", b"subprocess.Popen")

    rewritten(finished, chains.MORE, other)
    unchanged_after(finished, lambda: run(finished), "do not fit together")


def rewritten(file, member, change):
    with zipfile.ZipFile(file) as old:
        parts = {n: old.read(n) for n in old.namelist()}
    values = np.load(io.BytesIO(parts[f"{member}.npy"]))
    out = io.BytesIO()
    np.save(out, np.frombuffer(change(values.tobytes()), dtype=np.uint8))
    parts[f"{member}.npy"] = out.getvalue()
    with zipfile.ZipFile(file, "w") as new:
        for name, content in parts.items():
            new.writestr(name, content)


@pytest.mark.parametrize("kind", ["array", "text", "archive"])
def test_other_files_are_refused(tmp_path, kind):
    path = tmp_path / "a.npz"
    if kind == "array":
        with open(path, "wb") as f:
            np.save(f, np.ones(3))
    elif kind == "text":
        path.write_text("phi,tau\n1,2\n")
    else:
        np.savez(path, y=np.ones(3))
    unchanged_after(path, lambda: run(path), "no checkpoint of `sample`", "delete it")


def test_places_where_no_file_can_be(tmp_path):
    with pytest.raises(ArgumentError, match=r"is a folder\nFix: give a file"):
        run(tmp_path)
    with pytest.raises(ArgumentError, match=r"(?s)does not exist.*make the folder .*missing"):
        run(tmp_path / "missing" / "a.npz")
    with pytest.raises(ArgumentError, match="checkpoint=5"):
        run(5)
    assert not list(tmp_path.iterdir())


def test_another_type_of_cpu_is_told(finished, monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(finished, draws=5)
    monkeypatch.setattr(chains, "_cpu", lambda: "znver9")
    with pytest.warns(UserWarning, match="this is znver9"):
        run(finished, draws=5)


# -- disks
@contextmanager
def full_disk(size):
    """No file can grow beyond so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_is_full_at_the_start_is_an_error(tmp_path):
    with full_disk(100), pytest.raises(ArgumentError, match="cannot be written"):
        run(tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("often")
def test_a_disk_that_fills_loses_no_draw(tmp_path, expected):
    """Sampling goes on in memory; the file keeps what it last held, and is good."""
    path = tmp_path / "a.npz"
    with pytest.warns(UserWarning, match="cannot be written") as caught, full_disk(9000):
        result = run(path)
    assert len(caught) == 1
    assert "File too large" in str(caught[0].message)
    np.testing.assert_array_equal(drawn(result), expected)
    assert [f.name for f in tmp_path.iterdir()] == ["a.npz"]
    assert 0 < sum(s.done for s in opened(path).standings()) < CHAINS * (WARMUP + N)
    np.testing.assert_array_equal(drawn(run(path)), expected)
    assert opened(path).finished(WARMUP + N)


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("call", ["replace", "fsync"])
def test_a_write_that_fails_late_leaves_the_older(tmp_path, monkeypatch, expected, call):
    path, real, calls = tmp_path / "a.npz", getattr(os, call), []

    def failing(*args):
        calls.append(1)
        if 12 < len(calls) < 25:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*args)

    monkeypatch.setattr(os, call, failing)
    with pytest.warns(UserWarning, match="No space left on device") as caught:
        result = run(path, block=2)
    assert len(caught) == 1
    np.testing.assert_array_equal(drawn(result), expected)
    assert opened(path).finished(WARMUP + N), "and there was room again"
    assert [f.name for f in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.usefixtures("often")
def test_two_runs_do_not_write_over_each_other(tmp_path, expected):
    path = tmp_path / "a.npz"
    one, two = opened(path), opened(path)
    run_chains(walk, starts(1), N, WARMUP, block=7, progress=False, checkpoint=one)
    before = path.read_bytes()
    with pytest.warns(UserWarning, match="another run has written it"):
        result = run_chains(walk, starts(1), 5, WARMUP, block=7, progress=False, checkpoint=two)
    np.testing.assert_array_equal(drawn(result), expected[:, :5])
    assert path.read_bytes() == before


def test_a_file_that_was_deleted_is_written_again(tmp_path, expected):
    kept = opened(tmp_path / "a.npz")
    (tmp_path / "a.npz").unlink()
    run_chains(walk, starts(1), N, WARMUP, progress=False, checkpoint=kept)
    np.testing.assert_array_equal(drawn(run(tmp_path / "a.npz", step=crash_at(0))), expected)


# -- kill -9
WIDE, LONG = 2000, 400


def wide(state, n):
    return walk(state, n, WIDE)


def child(path):
    """Writes after every block: most of its time goes into writing, and kills hit that."""
    chains.SECONDS, chains.SHARE = -1.0, 1e9
    kept = opened(path)
    print("ready", flush=True)
    run_chains(wide, starts(1, WIDE), LONG, WARMUP, block=5, progress=False, checkpoint=kept)
    print("done", flush=True)


def test_kill_9_at_any_moment(tmp_path):
    path, delays = tmp_path / "a.npz", np.random.default_rng().uniform(0.05, 0.6, size=3)
    code = f"from tests.inference.checkpoints.test_checkpoint import child; child({str(path)!r})"
    for delay in delays:
        with subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT
        ) as process:
            assert process.stdout.readline() == "ready\n"
            time.sleep(delay)
            process.kill()
        opened(path)
        assert not list(tmp_path.glob("*.part"))
    kept = opened(path)
    result = run_chains(wide, starts(1, WIDE), LONG, WARMUP, progress=False, checkpoint=kept)
    whole = run_chains(wide, starts(1, WIDE), LONG, WARMUP, progress=False)
    np.testing.assert_array_equal(drawn(result), drawn(whole), str(delays))
