"""Draws that do not stay in memory: on disk as they come, and read from there."""

from __future__ import annotations

import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.errors import ArgumentError
from ssmppl.inference.checkpoints import chains, spool
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import stack
from ssmppl.results import arviz, save
from tests.inference.checkpoints.test_checkpoint import (
    CHAINS,
    ROOT,
    WARMUP,
    Crash,
    Dies,
    N,
    crash_at,
    drawn,
    full_disk,
    opened,
    run,
    starts,
    walk,
)
from tests.models.checkpoints import bits, call

ROW = 8 * CHAINS * 5  # bytes of a draw of all chains: four numbers and a statistic


@pytest.fixture
def often(monkeypatch):
    """Written after every block, and few draws held."""
    monkeypatch.setattr(chains, "SECONDS", -1.0)
    monkeypatch.setattr(chains, "SHARE", 1e9)
    monkeypatch.setattr(chains, "HELD", 4 * ROW)


@pytest.fixture(scope="module")
def expected():
    return drawn(run_chains(walk, starts(1), N, WARMUP, progress=False))


def spooled(path, draws=N, step=walk, block=7):
    """(draws, statistics) as `sample` takes them."""
    kept = opened(path, draws=draws)
    result = run_chains(
        step, starts(1), draws, WARMUP, block=block, progress=False, checkpoint=kept
    )  # fmt: skip
    return kept.stack(result)


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("block", [1, 7])
@pytest.mark.parametrize("writes", [14, 20, 31])
def test_a_killed_run_goes_on(tmp_path, monkeypatch, expected, block, writes):
    path = tmp_path / "a.npz"
    with monkeypatch.context() as patch:
        Dies(patch, writes)
        with pytest.raises(Crash):
            run(path, block=5)
    draws, stats = spooled(path, block=block)
    np.testing.assert_array_equal(draws["x"], expected)
    whole = stack(run_chains(walk, starts(1), N, WARMUP, progress=False))[1]
    np.testing.assert_array_equal(stats["acceptance_rate"], whole["acceptance_rate"])
    assert isinstance(draws["x"], np.memmap)
    assert (tmp_path / "a.npz.draws" / f"draws x {N}.raw").stat().st_size == expected.nbytes
    again, _ = spooled(path, step=crash_at(0))
    np.testing.assert_array_equal(again["x"], expected)


@pytest.mark.usefixtures("often")
def test_more_draws_go_to_the_end_and_fewer_are_the_first(tmp_path, expected):
    path = tmp_path / "a.npz"
    short, _ = spooled(path, draws=23)
    assert [f.name for f in (tmp_path / "a.npz.draws").glob("*x*")] == ["draws x 23.raw"]
    np.testing.assert_array_equal(short["x"], expected[:, :23])
    np.testing.assert_array_equal(spooled(path)[0]["x"], expected)
    np.testing.assert_array_equal(short["x"], expected[:, :23], "which did not change")
    assert [f.name for f in (tmp_path / "a.npz.draws").glob("*x*")] == [f"draws x {N}.raw"]
    few, _ = spooled(path, draws=10, step=crash_at(0))
    np.testing.assert_array_equal(few["x"], expected[:, :10])


def test_a_run_in_memory_goes_on_on_disk_and_back(tmp_path, expected, monkeypatch):
    path = tmp_path / "a.npz"
    run(path, draws=20)
    assert not (tmp_path / "a.npz.draws").exists()
    monkeypatch.setattr(chains, "HELD", 4 * ROW)
    assert isinstance(spooled(path, draws=40)[0]["x"], np.memmap)
    monkeypatch.setattr(chains, "HELD", 10**9)
    np.testing.assert_array_equal(spooled(path)[0]["x"], expected)


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("size", [1000, 2500, 4000])
def test_a_disk_that_fills_loses_no_draw(tmp_path, expected, size):
    """Some in the folder, the others in memory; the file on disk stays good."""
    path = tmp_path / "a.npz"
    opened(path)
    biggest = expected.nbytes * size // 6000
    with pytest.warns(UserWarning, match="cannot be written"), full_disk(biggest):
        draws, _ = spooled(path)
    np.testing.assert_array_equal(draws["x"], expected)
    np.testing.assert_array_equal(spooled(path)[0]["x"], expected)


@pytest.mark.parametrize("how", ["cut", "bit", "gone"])
@pytest.mark.usefixtures("often")
def test_draws_that_are_not_as_they_were_are_refused(tmp_path, how):
    path, file = tmp_path / "a.npz", tmp_path / "a.npz.draws" / f"draws x {N}.raw"
    run(path)
    whole = bytearray(file.read_bytes())
    if how == "cut":
        file.write_bytes(whole[:-1])
    elif how == "bit":
        whole[100] ^= 1
        file.write_bytes(whole)
    else:
        file.unlink()
    before = path.read_bytes()
    said = {"cut": "lacks 1 bytes", "bit": "is damaged", "gone": "No such file"}[how]
    with pytest.raises(ArgumentError, match=f"draws x {N}.raw .*{said}"):
        run(path)
    assert path.read_bytes() == before


def test_memory_does_not_grow_with_the_draws(tmp_path, monkeypatch):
    monkeypatch.setattr(chains, "HELD", 2 * 10**6)
    kept = opened(tmp_path / "a.npz", draws=3000)
    tracemalloc.start()
    try:
        result = run_chains(
            wide, starts(1, 1000), 3000, 10, block=10, progress=False, checkpoint=kept
        )
        draws, _ = kept.stack(result)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert draws["x"].nbytes == CHAINS * 3000 * 1000 * 8  # 72 MB
    assert most < draws["x"].nbytes / 4
    np.testing.assert_array_equal(draws["x"][:, 700, :3], [
        c.draws["x"][700, :3] for c in run_chains(wide, starts(1, 1000), 701, 10, progress=False)
    ])  # fmt: skip


def test_an_empty_variable(tmp_path):
    one = spool.Spool(tmp_path / "d", 3)
    for n in (2, 3):
        one.append([{"draws/none": np.zeros((n, 0))}] * 3, 4)
    assert one.view("draws/none").shape == (3, 6, 0)
    one.check(tmp_path / "a.npz")


@pytest.mark.slow
def test_kill_9_at_any_moment(tmp_path):
    path = tmp_path / "a.npz"
    code = (
        "from tests.inference.checkpoints.test_checkpoint_spool import child\n"
        f"child({str(path)!r})"
    )  # fmt: skip
    for delay in np.random.default_rng().uniform(0.05, 0.6, size=2):
        with subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT
        ) as process:
            assert process.stdout.readline() == "ready\n"
            time.sleep(delay)
            process.kill()
    kept = opened(path)
    result = run_chains(wide, starts(1, 1000), 400, WARMUP, progress=False, checkpoint=kept)
    whole = run_chains(wide, starts(1, 1000), 400, WARMUP, progress=False)
    np.testing.assert_array_equal(kept.stack(result)[0]["x"], drawn(whole))


def wide(state, n):
    return walk(state, n, 1000)


def child(path):
    chains.SECONDS, chains.SHARE, chains.HELD = -1.0, 1e9, 10**6
    kept = opened(path)
    print("ready", flush=True)
    run_chains(wide, starts(1, 1000), 400, WARMUP, block=3, progress=False, checkpoint=kept)


# -- through `sample`
def test_sample_returns_what_lies_on_disk(tmp_path, monkeypatch):
    expected = call("PGAS")
    monkeypatch.setattr(chains, "HELD", 5000)
    found = call("PGAS", tmp_path / "a.npz")
    assert bits(found) == bits(expected)
    assert bits(call("PGAS", tmp_path / "a.npz")) == bits(expected)
    owner = found["posterior"]["x"].values
    while owner.base is not None and not isinstance(owner, np.memmap):
        owner = owner.base
    assert isinstance(owner, np.memmap), "of both data sets in one file"
    assert ssm.summary(found).equals(ssm.summary(expected))
    save(found, tmp_path / "a.nc")
    read = arviz().from_netcdf(tmp_path / "a.nc")["posterior"]
    np.testing.assert_array_equal(read["x"], expected["posterior"]["x"])
