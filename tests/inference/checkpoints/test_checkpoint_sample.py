"""`sample(..., checkpoint=)`: every method goes on bit for bit; other calls are refused."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.checkpoints import archive, chains, origin
from ssmppl.inference.checkpoints.chains import CheckpointFile
from ssmppl.inference.run import chain_runner
from ssmppl.inference.verbs.sample import METHODS
from tests.models import checkpoints as models
from tests.models.checkpoints import CALLS, bits, call

ROOT = Path(__file__).parents[3]
DEFAULT = ["PGAS", "SMC2"]  # what is fast to compile
EXHAUSTIVE = pytest.mark.exhaustive
TRIES = 10  # to kill a call that ends within a fraction of a second


class Crash(BaseException):
    """A kill that a test survives."""


@pytest.fixture
def killed(monkeypatch):
    """The call, ended at its n-th write."""
    monkeypatch.setattr(chains, "SECONDS", -1.0)
    monkeypatch.setattr(chains, "SHARE", 1e9)
    monkeypatch.setattr(chain_runner, "BLOCK_SECONDS", 1e-9)
    monkeypatch.setattr(chain_runner, "TIMES_SENDING", 0)

    def until(n, name, path, **changes):
        left = [n]

        def write(file, members):
            if left[0] == 0:
                raise Crash
            left[0] -= 1
            archive.write(file, members)

        with monkeypatch.context() as patch:
            patch.setattr(chains, "write", write)
            try:
                call(name, path, **changes)
            except Crash:
                return True
        return False

    return until


def goes_on(killed, name, path, writes):
    expected = bits(call(name))
    for n in writes:
        assert killed(n, name, path)
    found = call(name, path)
    assert bits(found) == expected
    assert bits(call(name, path)) == expected, "once more, from the finished file"


@pytest.mark.parametrize("name", DEFAULT)
def test_a_killed_call_goes_on(killed, tmp_path, name):
    """In the pilot, in the warmup, and while drawing."""
    goes_on(killed, name, tmp_path / "a.npz", (2, 9, 30))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.exhaustive] * n.endswith(("auto", "correlated")))
        for n in CALLS
        if n not in DEFAULT
    ],
)
def test_every_method_goes_on(killed, tmp_path, name):
    goes_on(killed, name, tmp_path / "a.npz", (2, 9, 30, 41))


@pytest.mark.parametrize("name", ["PGAS", "PMMH, gradient", "Gibbs"])
def test_a_call_without_states_goes_on_and_keeps_none(killed, tmp_path, monkeypatch, name):
    """All other draws, and how often trajectories changed, are those of a call that keeps them."""
    path, whole, kept, real = tmp_path / "a.npz", bits(call(name)), [], CheckpointFile.stack

    def stack(self, chains):
        kept.append(real(self, chains))
        return kept[-1]

    monkeypatch.setattr(CheckpointFile, "stack", stack)
    expected = {k: v for k, v in whole.items() if k[:11] != "posterior x"}
    assert len(expected) == len(whole) - 1
    for n in (9, 30):
        assert killed(n, name, path, states=False)
    assert bits(call(name, path, states=False)) == expected
    assert bits(call(name, path, states=False)) == expected, "once more, from the finished file"
    assert [set(drawn) & {"theta", "path_0", "path_1"} for drawn, _ in kept] == 2 * [{"theta"}]


def test_more_draws_without_states_count_in_how_often_they_changed(tmp_path):
    path = tmp_path / "a.npz"
    call("PGAS", path, states=False, draws=7)
    assert bits(call("PGAS", path, states=False)) == bits(call("PGAS", states=False))


def test_seed_none_goes_on_with_the_seed_of_the_file(killed, tmp_path):
    path = tmp_path / "a.npz"
    assert killed(20, "PGAS", path, seed=None)
    first = call("PGAS", path, seed=None)
    entropy = int(first["posterior"].attrs["seed"])
    assert bits(call("PGAS", seed=entropy)) == bits(first)
    assert bits(call("PGAS", tmp_path / "b.npz", seed=None)) != bits(first)


def test_more_draws_are_those_of_one_longer_run(tmp_path):
    path = tmp_path / "a.npz"
    short = call("PGAS", path, draws=7)
    assert bits(call("PGAS", path)) == bits(call("PGAS"))
    assert bits(call("PGAS", path, draws=7)) == bits(short), "and fewer the first of them"
    path = tmp_path / "b.npz"
    call("SMC2", path, draws=7)
    assert bits(call("SMC2", path)) == bits(call("SMC2"))


def test_more_corrected_draws_are_those_of_one_longer_run(tmp_path):
    path = tmp_path / "a.npz"
    short = bits(call("ISMCMC", path, draws=20))
    assert bits(call("ISMCMC", path, draws=50)) == bits(call("ISMCMC", draws=50))
    assert bits(call("ISMCMC", path, draws=20)) == short, "and fewer those of a shorter one"


def test_a_finished_call_prepares_nothing(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    expected = bits(call("PGAS", path))
    monkeypatch.setitem(METHODS, ssm.PGAS, replace(METHODS[ssm.PGAS], prepare=None.__class__))
    assert bits(call("PGAS", path)) == expected
    monkeypatch.setattr(origin, "sources_digest", lambda *folders: "0" * 20)
    with pytest.raises(ssm.ArgumentError, match=r"ssmppl .*sources.*now .*sources 00000000"):
        call("PGAS", path)


def shifted():
    data = [{k: v.copy() for k, v in d.items()} for d in models.DATA]
    data[1]["y"][0, 0] += 1e-9
    return data


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"warmup": 17}, "warmup=16 (now 17)"),
        ({"chains": 2}, "chains=3 (now 2)"),
        ({"thin": 1}, "thin=2 (now 1)"),
        ({"seed": 2}, "seed=1 (now 2)"),
        ({"states": False}, "states=True (now False)"),
        ({"fixed": {"r": 0.3}}, "fixed={} (now {r: [0.3]})"),
        ({"start": {"r": 0.3}}, "start={} (now {r: [0.3]})"),
    ],
)
def test_another_call_is_refused(tmp_path, killed, changes, said):
    path = tmp_path / "a.npz"
    assert killed(3, "PGAS", path)
    before = path.read_bytes()
    with pytest.raises(ssm.ArgumentError) as error:
        call("PGAS", path, **changes)
    assert said.replace("[0.3]", "0.3") in str(error.value).replace("[0.3]", "0.3")
    assert path.read_bytes() == before


def test_another_model_method_or_data_is_refused(tmp_path, killed, monkeypatch):
    path = tmp_path / "a.npz"
    assert killed(3, "PGAS", path)
    before = path.read_bytes()
    with pytest.raises(
        ssm.ArgumentError, match=r"method PGAS\(particles=10.*now PGAS\(particles=5"
    ):
        call("PGAS, auto", path)
    with monkeypatch.context() as patch:
        patch.setattr(models, "DATA", shifted())
        with pytest.raises(ssm.ArgumentError, match="with other data"):
            call("PGAS", path)
    other = ssm.Model("pair", inputs=("u",))
    other.prior(models.pair_prior)
    other.initial(models.pair_initial)
    other.observation(models.pair_observation)

    @other.transition
    def other_transition(x, u, b, q):
        return {"x": ssm.Normal(0.71 * x + b * u, variance=q)}

    monkeypatch.setattr(models, "pair", other)
    with pytest.raises(ssm.ArgumentError, match="with another model"):
        call("PGAS", path)
    assert path.read_bytes() == before


def test_a_full_disk_loses_no_draw(tmp_path, monkeypatch):
    def full(file, members):
        if calls:
            raise OSError(28, "No space left on device")
        calls.append(1)
        archive.write(file, members)

    calls = []
    monkeypatch.setattr(chains, "write", full)
    with pytest.warns(UserWarning, match="No space left on device"):
        found = bits(call("PGAS", tmp_path / "a.npz"))
    monkeypatch.undo()
    assert found == bits(call("PGAS"))
    assert bits(call("PGAS", tmp_path / "a.npz")) == found


def begun(child, path):
    """Whether the checkpoint appeared while the child lived."""
    while not path.exists():
        if child.poll() is not None:
            return False
        time.sleep(0.001)
    return True


def kill_9(tmp_path, name, rng):
    """Once, somewhere between the first write of the checkpoint and the end of the call."""
    file, text = tmp_path / f"{name}.npz", tmp_path / f"{name}.txt"
    for _ in range(TRIES):
        with subprocess.Popen(
            [sys.executable, "-m", models.__name__, str(tmp_path), name], cwd=ROOT
        ) as child:
            assert begun(child, file)
            time.sleep(rng.uniform(0.0, 0.3))
            child.kill()
        if not text.exists():
            return
        file.unlink()  # the call had ended: again from its beginning
        text.unlink()
    raise AssertionError(f"{name} ended before each of {TRIES} kills")


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [("Gibbs", "PMMH", "ISMCMC", "PGAS", "SMC2"), pytest.param(tuple(CALLS), marks=EXHAUSTIVE)],
)
def test_kill_9_of_every_method(tmp_path, names):
    rng = np.random.default_rng()
    for name in names:
        kill_9(tmp_path, name, rng)
    command = [sys.executable, "-m", models.__name__, str(tmp_path), *names]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    for name in names:
        text = "\n".join(f"{k}: {v}" for k, v in bits(call(name)).items())
        assert (tmp_path / f"{name}.txt").read_text() == text, name
