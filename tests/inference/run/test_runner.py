"""The runner of chains, on a random walk."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ssmppl.inference.run import chain_runner
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import Block, stack
from ssmppl.inference.run.tasks import run_tasks

ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Walk:
    """A random walk whose step adapts for `warmup` draws; the random state travels with it."""

    seed: int
    warmup: int = 0
    position: float = 0.0
    count: int = 0
    scale: float = 1.0
    generator: dict | None = None


def walk(state, n, *, fail_at=None, pause=0.0):
    bits = np.random.PCG64(state.seed)
    if state.generator is not None:
        bits.state = state.generator
    rng = np.random.Generator(bits)
    x, scale = state.position, state.scale
    positions, accepted = np.empty(n), np.empty(n)
    for i in range(n):
        if state.count + i == fail_at and state.seed == 2:
            raise ArithmeticError("all weights are zero")
        step = scale * rng.normal()
        accepted[i] = abs(step) < 1
        x += step * accepted[i]
        if state.count + i < state.warmup:
            scale *= 1.1 if accepted[i] else 0.9
        positions[i] = x
        time.sleep(pause)
    after = replace(state, position=x, count=state.count + n, scale=scale, generator=bits.state)
    pairs = np.stack([positions, -positions], axis=1)
    return after, Block({"x": positions, "pair": pairs}, {"acceptance_rate": accepted})


def walks(n_chains, warmup=0):
    return [Walk(seed, warmup) for seed in range(1, n_chains + 1)]


@pytest.fixture(scope="module")
def expected():
    """Four chains, each drawn in one go."""
    blocks = [walk(state, 30 + 50)[1] for state in walks(4, warmup=30)]
    return np.stack([block.draws["x"][30:] for block in blocks])


class Inline(Executor):
    """Runs a task when it is submitted."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


EXECUTORS = {
    "default": lambda: None,
    "one thread": lambda: ThreadPoolExecutor(1),
    "eight threads": lambda: ThreadPoolExecutor(8),
    # Not forked: the process that runs the tests has threads by now.
    "processes": lambda: ProcessPoolExecutor(2, multiprocessing.get_context("forkserver")),
    "inline": Inline,
}


@pytest.mark.parametrize("block", [None, 1, 7, 30, 1000])
@pytest.mark.parametrize("kind", EXECUTORS)
def test_draws_depend_neither_on_executor_nor_on_blocks(kind, block, expected):
    executor = EXECUTORS[kind]()
    chains = run_chains(
        walk, walks(4, warmup=30), 50, 30, executor=executor, block=block, progress=False
    )
    draws, stats = stack(chains)
    np.testing.assert_array_equal(draws["x"], expected)
    np.testing.assert_array_equal(draws["pair"][..., 1], -expected)
    assert stats["acceptance_rate"].shape == (4, 50)
    assert not any(chain.interrupted for chain in chains)
    assert [chain.state.count for chain in chains] == [80] * 4
    if executor is not None:
        assert executor.submit(int, "3").result() == 3  # left open
        executor.shutdown()


def test_a_chain_goes_on_from_its_last_state(expected):
    first = run_chains(walk, walks(4, warmup=30), 20, 30, progress=False)
    second = run_chains(walk, [chain.state for chain in first], 30, progress=False)
    joined = np.concatenate([stack(first)[0]["x"], stack(second)[0]["x"]], axis=1)
    np.testing.assert_array_equal(joined, expected)


def test_warmup_statistics_on_request():
    kept = run_chains(walk, walks(2), 5, 12, keep_warmup_stats=True, progress=False)
    assert [len(chain.warmup_stats["acceptance_rate"]) for chain in kept] == [12, 12]
    dropped = run_chains(walk, walks(2), 5, 12, progress=False)
    assert [chain.warmup_stats for chain in dropped] == [{}, {}]


def test_blocks_grow_to_the_time_they_should_take(monkeypatch):
    monkeypatch.setattr(chain_runner, "BLOCK_SECONDS", 0.05)
    sizes = []

    def noted(state, n):
        sizes.append(n)
        return walk(state, n, pause=0.001)

    run_chains(noted, walks(1), 200, progress=False)
    assert sizes[:3] == [1, 4, 16]
    assert max(sizes) <= 50
    assert sum(sizes) == 200


@pytest.mark.parametrize("kind", EXECUTORS)
def test_a_failing_chain_raises_its_own_error_and_says_which(kind):
    step = partial(walk, fail_at=25)
    executor = EXECUTORS[kind]()
    with pytest.raises(ArithmeticError, match="all weights are zero") as caught:
        run_chains(step, walks(3), 40, 10, executor=executor, block=5, progress=False)
    assert caught.value.__notes__ == ["in chain 2 of 3, after 25 of 10 + 40 draws (warmup + kept)"]
    if executor is not None:
        executor.shutdown()


def interrupt_after(seconds, times=1):
    """Ctrl-C for this process, from outside of its main thread."""

    def press():
        for _ in range(times):
            time.sleep(seconds)
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    return thread


class InterruptAt:
    """A `describe` that has Ctrl-C pressed, `seconds` after so many blocks have come back."""

    def __init__(self, blocks, seconds=0.0):
        self.blocks, self.seconds, self.seen = blocks, seconds, 0
        self.thread = None

    def __call__(self, recent):
        self.seen += 1
        if self.seen == self.blocks:
            self.thread = interrupt_after(self.seconds)
        return ""


@pytest.mark.parametrize("kind", ["default", "one thread", "processes"])
def test_ctrl_c_returns_what_was_drawn(kind):
    executor = EXECUTORS[kind]()
    handler = signal.getsignal(signal.SIGINT)
    if executor is not None:
        executor.submit(int).result()
    press = InterruptAt(30)  # by then, every chain has draws
    chains = run_chains(
        partial(walk, pause=0.002), walks(3), 10**6, 20,
        executor=executor, block=20, progress=False, describe=press,
    )  # fmt: skip
    assert press.seen < 60
    press.thread.join()
    assert signal.getsignal(signal.SIGINT) is handler
    assert all(chain.interrupted for chain in chains)
    lengths = {len(chain.draws["x"]) for chain in chains}
    assert len(lengths) == 1
    (n,) = lengths
    assert n >= 20
    whole = [walk(state, 20 + n)[1].draws["x"][20:] for state in walks(3)]
    np.testing.assert_array_equal(stack(chains)[0]["x"], whole)
    if executor is not None:
        executor.shutdown()


@pytest.mark.parametrize("delay", [0.011, 0.023, 0.037, 0.05, 0.061])
def test_ctrl_c_among_tiny_blocks(delay):
    """Wherever it strikes in the loop, no block is lost between others or taken twice."""
    press = InterruptAt(10, delay)
    chains = run_chains(walk, walks(2), 10**7, block=1, progress=False, describe=press)
    press.thread.join()
    (n,) = {len(chain.draws["x"]) for chain in chains}
    whole = [walk(state, n)[1].draws["x"] for state in walks(2)]
    np.testing.assert_array_equal(stack(chains)[0]["x"], whole)


def test_ctrl_c_in_a_terminal_reaches_worker_processes_too(tmp_path):
    """The signal goes to the whole group of processes, as a terminal sends it."""
    script = (
        "import sys, functools; from concurrent.futures import ProcessPoolExecutor\n"
        f"sys.path[:0] = [{str(ROOT)!r}]\n"
        "from tests.inference.run.test_runner import run_chains, walk, walks\n"
        "if __name__ == '__main__':\n"
        "    step = functools.partial(walk, pause=0.005)\n"
        "    with ProcessPoolExecutor(2) as pool:\n"
        "        pool.submit(int).result(); print('ready', flush=True)\n"
        "        chains = run_chains(step, walks(3), 10**6, executor=pool, block=10,\n"
        "                            progress=False)\n"
        "    print(*[len(chain.draws['x']) for chain in chains], chains[0].interrupted)\n"
    )
    path = tmp_path / "script.py"
    path.write_text(script)
    with subprocess.Popen(
        [sys.executable, path], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.5)
        os.killpg(process.pid, signal.SIGINT)
        out, _ = process.communicate(timeout=30)
    first, *others, interrupted = out.split()
    assert int(first) >= 10
    assert others == [first, first]
    assert interrupted == "True"


def test_ctrl_c_before_the_first_draw_is_raised():
    thread = interrupt_after(0.3)
    with pytest.raises(KeyboardInterrupt):
        run_chains(partial(walk, pause=0.01), walks(2), 10, 10**6, block=5, progress=False)
    thread.join()


def test_a_second_ctrl_c_is_raised():
    thread = interrupt_after(0.3, times=2)
    with pytest.raises(KeyboardInterrupt):
        run_chains(partial(walk, pause=0.1), walks(1), 100, block=12, progress=False)
    thread.join()


def test_runs_outside_of_the_main_thread(expected):
    with ThreadPoolExecutor(1) as pool:
        chains = pool.submit(run_chains, walk, walks(4, warmup=30), 50, 30, progress=False).result()
    np.testing.assert_array_equal(stack(chains)[0]["x"], expected)


def test_lines_where_there_is_no_terminal(capsys):
    run_chains(walk, walks(2), 30, 10, title="PMMH")
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith("PMMH: 100% 80/80 [00:00] acceptance 0.")


def test_bar_on_a_terminal(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    run_chains(walk, walks(2), 30, 10, title="PMMH")
    last = capsys.readouterr().err.split("\r")[-1]
    assert last.startswith("PMMH: 100%|")
    assert "80/80" in last
    assert "acceptance 0." in last


def test_nothing_is_shown_when_not_wanted(capsys):
    run_chains(walk, walks(2), 30, 10, progress=False)
    assert capsys.readouterr() == ("", "")


def reciprocal(number):
    return 1 / number


@pytest.mark.parametrize("kind", EXECUTORS)
def test_tasks_come_back_in_order(kind):
    executor = EXECUTORS[kind]()
    assert run_tasks(reciprocal, [4, 2, 1], executor=executor) == [0.25, 0.5, 1]
    with pytest.raises(ZeroDivisionError) as caught:
        run_tasks(reciprocal, [4, 0, 1], executor=executor)
    assert caught.value.__notes__ == ["in task 2 of 3"]
    assert run_tasks(reciprocal, [], executor=executor) == []
    if executor is not None:
        executor.shutdown()


def test_ctrl_c_gives_up_tasks():
    thread = interrupt_after(0.3)
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_tasks(time.sleep, [0.1] * 100)
    assert time.monotonic() - started < 2
    thread.join()
