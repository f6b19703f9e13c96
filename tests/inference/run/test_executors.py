"""Verbs over executors of other processes: the same numbers, sent once, nothing lost with a worker.

Dask's cluster of two worker processes, started once for all tests; the others are pools of the
standard library, and loky's.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.inference.run import executors
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import stack
from ssmppl.inference.run.executors import Absent, Sent, workers_of
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model import pickling
from ssmppl.language.tracing import trace
from tests.models import standard as models
from tests.statistics.test_reproducibility import DATA, THETA, VERBS

from .test_runner import walk, walks

ROOT = Path(__file__).parents[3]
# One import of the package for all pools of this file.
get_context("forkserver").set_forkserver_preload(["ssmppl"])


@pytest.fixture(scope="module")
def client():
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with cluster, distributed.Client(cluster) as client:
        yield client


# -- the same numbers
EXHAUSTIVE = pytest.mark.exhaustive


@pytest.mark.parametrize("verb", ["log_likelihood", "PMMH"])
def test_dask_gives_the_same_numbers(client, verb):
    run = VERBS[verb]
    np.testing.assert_array_equal(run(client.get_executor()), run(None))


QUIET = {"seed": 5, "progress": False}


def maximized(method, executor):
    found = ssm.maximize(models.varves, DATA, method, start=THETA, executor=executor, **QUIET)
    return np.array([*found.parameters.values(), found.log_likelihood], dtype=float)


def evidence(executor):
    short = {"draws": 40, "warmup": 20, "chains": 2}
    found = ssm.evidence(
        models.proper_varves, DATA, ssm.PMMH(particles=30), executor=executor, **short, **QUIET
    )
    return np.array([found.log_evidence, found.standard_error])


def left_out(executor):
    found = ssm.leave_future_out(
        models.varves, DATA, method=ssm.PMMH(particles=30), first=50, draws=20, warmup=20,
        chains=2, particles=50, executor=executor, **QUIET,
    )  # fmt: skip
    return found["elpd"].values


def scored(executor):
    found = ssm.score(
        models.varves, DATA, THETA, particles=50, repeats=4, seed=5, executor=executor
    )
    return np.array(list(found.gradient.values()), dtype=float)


def squared(executor):
    found = ssm.sample(
        models.proper_varves, DATA, ssm.SMC2(parameters=20, particles=30), draws=20, chains=2,
        executor=executor, **QUIET,
    )["posterior"]  # fmt: skip
    return np.concatenate([found[v].values.ravel() for v in ("phi", "tau")])


def corrected(executor):
    found = ssm.sample(
        models.proper_varves, DATA, ssm.ISMCMC(particles=8), draws=20, warmup=20, chains=2,
        executor=executor, **QUIET,
    )["posterior"]  # fmt: skip
    return np.concatenate([found[v].values.ravel() for v in ("phi", "tau", "x")])


MORE = {
    "evidence": evidence,
    "leave_future_out": left_out,
    "score": scored,
    "SMC2": squared,
    "ISMCMC": corrected,
    "particle EM": partial(maximized, ssm.ParticleEM(iterations=4, burn_in=1, particles=30)),
    "PSAEM": partial(maximized, ssm.PSAEM(iterations=20, burn_in=5, particles=10)),
    "score ascent": partial(maximized, ssm.ScoreAscent(iterations=4, particles=50)),
    "IF2": partial(maximized, ssm.IF2(iterations=4, particles=50)),
    "particle_filter": VERBS["particle_filter"],
    "PGAS": VERBS["PGAS"],
}


FEW = ("evidence", "ISMCMC", "SMC2", "PSAEM")  # of each kind of task one; the others are exhaustive


@pytest.mark.slow
@pytest.mark.parametrize(
    "verb", [pytest.param(v, marks=[EXHAUSTIVE] * (v not in FEW)) for v in MORE]
)
def test_dask_gives_the_same_numbers_to_every_verb(client, verb):
    expected = MORE[verb](None)
    assert np.all(np.isfinite(expected))
    np.testing.assert_array_equal(MORE[verb](client.get_executor()), expected)


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", ["fast", "full"])
def test_dask_gives_the_same_diagnosis(client, mode):
    rng = np.random.default_rng(3)
    data = {"y": np.cumsum(rng.normal(size=120)) + rng.normal(size=120)}
    chosen = ["level break", "sensor bias", "outliers", "sensor drift"]
    there, here = (
        ssm.diagnose(models.stationary, data, chosen, mode=mode, executor=e, progress=False)
        for e in (client.get_executor(), None)
    )
    for name, table in here.tables().items():
        pd.testing.assert_frame_equal(there.tables()[name], table, check_exact=True)


SPAWNED = """
import multiprocessing, sys, warnings
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
import numpy as np
import ssmppl as ssm

kick = 0.01

@ssm.primitive
def wobble(v):
    return kick if v > 0.0 else -kick

@ssm.distribution
def Logistic(y, loc, scale):
    z = np.abs(y - loc) / scale
    return -z - 2 * np.log1p(np.exp(-z)) - np.log(scale)

model = ssm.Model("of a script")

@model.prior
def prior():
    return {"tau": ssm.Gamma(20, rate=1)}

@model.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}

@model.transition
def transition(x, tau):
    return {"x": ssm.Normal(0.9 * x + wobble(x), precision=tau)}

@model.observation
def observation(x):
    return {"y": ssm.Normal(x, sd=0.5), "z": Logistic(x, kick)}

def run(executor):
    data = {"y": np.sin(np.arange(30.0)), "z": np.zeros(30)}
    found = ssm.sample(
        model, data, ssm.PMMH(particles=20), draws=20, warmup=10, chains=2, seed=1,
        progress=False, executor=executor,
    )["posterior"]
    return found["x"].values

def pools(kind):
    if kind == "loky":
        import loky
        return loky.get_reusable_executor(2)
    if kind == "dask":
        from distributed import Client
        return Client(sys.argv[2]).get_executor()
    return ProcessPoolExecutor(2, multiprocessing.get_context(kind))

if __name__ == "__main__":
    with pools(sys.argv[1]) as executor:
        np.testing.assert_array_equal(run(executor), run(None))
    print("the same")
"""


def script(tmp_path, *arguments):
    """What a script prints whose model has a primitive and a law of its own."""
    path = tmp_path / "script.py"
    path.write_text(SPAWNED)
    done = subprocess.run(
        [sys.executable, path, *arguments], text=True, capture_output=True, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["forkserver", "loky", *(pytest.param(k, marks=EXHAUSTIVE) for k in ("fork", "spawn"))]
)
def test_what_a_script_defines_travels(tmp_path, kind):
    if kind == "loky":
        pytest.importorskip("loky", reason="loky is not installed")
    assert script(tmp_path, kind) == "the same\n"


@pytest.mark.slow
@pytest.mark.exhaustive
def test_dask_over_commands(tmp_path):
    """A scheduler and workers that were started by themselves, on the loopback interface."""
    pytest.importorskip("distributed", reason="distributed is not installed")
    told = tmp_path / "scheduler.json"
    common = ["--scheduler-file", str(told), "--host", "127.0.0.1", "--no-dashboard"]
    scheduler = [sys.executable, "-m", "dask", "scheduler", "--port", "0", *common]
    worker = [sys.executable, "-m", "dask", "worker", "--nthreads", "1", *common]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "SSMPPL_CACHE": str(tmp_path / "cache")}
    started = [
        subprocess.Popen(c, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL)
        for c in (scheduler, worker, worker)
    ]
    try:
        until = time.monotonic() + 60
        while not told.exists() and time.monotonic() < until:
            time.sleep(0.1)
        address = json.loads(told.read_text())["address"]
        assert script(tmp_path, "dask", address) == "the same\n"
        assert list((tmp_path / "cache" / "ssmppl").glob("of_a_script*.py"))
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.wait(30)


# -- sent once
class Counted:
    """Says how often it was unpickled in this process."""

    unpickled = 0

    def __init__(self, size):
        self.data = np.zeros(size)

    def __setstate__(self, state):
        self.__dict__.update(state)
        Counted.unpickled += 1

    def __call__(self, number):
        return number, Counted.unpickled


def test_a_function_is_unpickled_once_in_a_process():
    sent = Sent(Counted(10**5))
    first = pickle.loads(pickle.dumps(sent.task()))
    again = pickle.loads(pickle.dumps(sent.task()))
    by_digest = pickle.loads(pickle.dumps(sent.task(whole=False)))
    before = Counted.unpickled
    assert [task(1) for task in (first, again, by_digest)] == 3 * [(1, before + 1)]
    assert len(pickle.dumps(sent.task())) > 8 * 10**5
    assert len(pickle.dumps(sent.task(whole=False))) < 500


class Elsewhere(Executor):
    """As of two other processes, but here: it notes how many tasks come at a time."""

    _max_workers = 2

    def __init__(self):
        self.sizes = []

    def submit(self, fn, /, *args):
        self.sizes.append(len(args[0]))
        future = Future()
        try:
            future.set_result(fn(*args))
        except Exception as error:
            future.set_exception(error)
        return future


def test_quick_tasks_are_sent_several_at_a_time():
    pool, taken = Elsewhere(), []
    found = run_tasks(
        lambda k: 3 * k, range(200), executor=pool, take=lambda k, v: taken.append((k, v))
    )
    assert found == [3 * k for k in range(200)]
    assert sorted(taken) == list(enumerate(found))
    assert sum(pool.sizes) == 200
    assert pool.sizes[0] == 1  # nothing is known yet of how long they take
    assert len(pool.sizes) < 60
    assert max(pool.sizes) <= 200 // 6  # the last of them would keep others waiting


def test_slow_tasks_are_sent_one_by_one(monkeypatch):
    monkeypatch.setattr("ssmppl.inference.run.tasks.TOGETHER_SECONDS", 0.0)
    pool = Elsewhere()
    run_tasks(lambda k: k, range(30), executor=pool)
    assert pool.sizes == [1] * 30


def test_an_error_among_several_is_that_of_its_task():
    """Those before it in the same submission are kept."""
    pool, taken = Elsewhere(), []

    def task(k):
        if k == 137:
            raise ValueError("no")
        return k

    with pytest.raises(ValueError, match="no") as caught:
        run_tasks(task, range(200), executor=pool, take=lambda k, v: taken.append(k))
    assert caught.value.__notes__ == ["in task 138 of 200"]
    assert set(taken) >= set(range(137))
    assert max(pool.sizes) > 1


def threads_of_tasks(_=None):
    return run_tasks(lambda _: threading.get_ident(), range(4)), threading.get_ident()


def test_a_task_from_another_process_takes_one_core():
    """Those that it has itself run one after the other: the other cores are other tasks' own."""
    received = pickle.loads(pickle.dumps(Sent(threads_of_tasks).task()))
    inside, own = received(None)
    assert set(inside) == {own}
    assert own not in threads_of_tasks()[0]  # here again


def test_a_worker_says_what_it_does_not_know():
    sent = Sent(partial(Counted(3)))
    task = pickle.loads(pickle.dumps(sent.task(whole=False)))
    assert isinstance(task(1), Absent)
    assert pickle.loads(pickle.dumps(sent.task()))(1)[0] == 1
    assert task(1)[0] == 1


def test_a_worker_forgets_what_was_long_unused():
    known = pickling.UnpackedCache(most=2)
    for digest in (b"1", b"2", b"1", b"3"):
        known.get(digest, lambda digest=digest: digest)
    assert [known.get(d) for d in (b"1", b"2", b"3")] == [b"1", None, b"3"]


class Forgetful(ThreadPoolExecutor):
    """Sends every task through pickle, to a worker that knows nothing at every third one."""

    def __init__(self):
        super().__init__(2)
        self.sizes = []

    def submit(self, function, /, *args):
        sent = pickle.dumps((function, args))
        self.sizes.append(len(sent))
        return super().submit(self.there, sent, len(self.sizes) % 3 == 0)

    @staticmethod
    def there(sent, forget):
        function, args = pickle.loads(sent)
        if forget:
            executors._functions = pickling.UnpackedCache(executors.MOST)
        return function(*args)


def test_chains_go_on_where_workers_know_nothing():
    """A worker that joins, or that takes a dead one's place, is sent what it lacks."""
    with Forgetful() as executor:
        found = run_chains(walk, walks(3), 60, 10, executor=executor, block=5, progress=False)
    alone = run_chains(walk, walks(3), 60, 10, progress=False)
    np.testing.assert_array_equal(stack(found)[0]["x"], stack(alone)[0]["x"])
    assert len(executor.sizes) > 3 * 70 / 5  # some were sent again


def test_tasks_are_sent_again_where_workers_know_nothing():
    with Forgetful() as executor:
        found = run_tasks(Counted(10**5), list(range(20)), executor=executor)
    assert [number for number, _ in found] == list(range(20))
    assert sum(size > 8 * 10**5 for size in executor.sizes) < len(executor.sizes)


def test_a_trace_is_one_object_in_a_process():
    t = trace(models.varves)
    assert pickle.loads(pickle.dumps(t)) is t
    code = (
        "import pickle, sys; from ssmppl.codegen.modules.program import compile_trace\n"
        "content = sys.stdin.buffer.read(); a, b = pickle.loads(content), pickle.loads(content)\n"
        "print(a is b, a.name, len(a.locations), compile_trace(a) is compile_trace(b))"
    )
    done = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(t), cwd=ROOT,
                          capture_output=True, check=True)  # fmt: skip
    assert done.stdout.decode().split() == ["True", "varves", str(len(t.locations)), "True"]


def test_what_cannot_be_sent_is_named():
    lock = threading.Lock()
    with (
        ProcessPoolExecutor(1, get_context("forkserver")) as pool,
        pytest.raises(ssm.ArgumentError, match="cannot be sent to another process") as caught,
    ):
        run_tasks(partial(walk, fail_at=lock), [1], executor=pool)
    assert "lock" in str(caught.value)


class Unreadable:
    def __reduce__(self):
        return os.open, ("/nowhere/at/all", os.O_RDONLY)

    def __call__(self, argument):
        return argument


def test_what_a_worker_cannot_restore_is_named_and_its_pool_lives():
    with ProcessPoolExecutor(1, get_context("forkserver")) as pool:
        with pytest.raises(ssm.ExecutorError, match="cannot restore the task: FileNotFoundError"):
            run_tasks(Unreadable(), [1], executor=pool)
        assert pool.submit(int, "3").result() == 3


# -- workers that die
class KillAt:
    """A `describe` that kills a worker, when so many blocks have come back."""

    def __init__(self, block, kill):
        self.block, self.kill, self.seen = block, kill, 0

    def __call__(self, recent):
        self.seen += 1
        if self.seen == self.block:
            self.kill()
        return ""


def killer(pool):
    return lambda: os.kill(next(iter(pool._processes)), signal.SIGKILL)


@pytest.mark.parametrize("kind", ["forkserver", pytest.param("loky", marks=pytest.mark.slow)])
def test_a_killed_process_costs_no_draws(kind):
    if kind == "loky":
        loky = pytest.importorskip("loky", reason="loky is not installed")
        pool = loky.get_reusable_executor(2)
    else:
        pool = ProcessPoolExecutor(2, get_context(kind))
    with pool:
        # late enough that each of three chains has draws, however two busy workers take turns
        kill = KillAt(60, killer(pool))
        with pytest.warns(UserWarning, match=r"of 100000 draws of each chain are returned: a wor"):
            chains = run_chains(
                partial(walk, pause=0.001), walks(3), 10**5, 20, executor=pool, block=20,
                progress=False, describe=kill,
            )  # fmt: skip
    (n,) = {len(chain.draws["x"]) for chain in chains}
    assert n >= 20
    assert all(chain.interrupted and chain.lost is not None for chain in chains)
    whole = [walk(state, 20 + n)[1].draws["x"][20:] for state in walks(3)]
    np.testing.assert_array_equal(stack(chains)[0]["x"], whole)


def test_a_process_killed_before_the_first_draw_is_an_error():
    with ProcessPoolExecutor(2, get_context("forkserver")) as pool:
        kill = KillAt(2, killer(pool))
        with pytest.raises(ssm.ExecutorError, match="a worker process died") as caught:
            run_chains(
                partial(walk, pause=0.001), walks(2), 10, 10**5, executor=pool, block=5,
                progress=False, describe=kill,
            )  # fmt: skip
    assert "Fix: make a new executor" in str(caught.value)


def die(argument):
    if argument == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return argument


def test_tasks_of_a_killed_process():
    done = {}
    with ProcessPoolExecutor(1, get_context("forkserver")) as pool:
        for _ in range(2):  # the second call finds the pool broken
            with pytest.raises(ssm.ExecutorError, match="a worker process died"):
                run_tasks(die, [1, 2, 3, 4], executor=pool, take=done.__setitem__)
    assert done == {0: 1, 1: 2}  # what a checkpoint keeps


def test_dask_runs_the_block_of_a_killed_worker_elsewhere(client):
    first = next(iter(client.run(os.getpid).values()))
    kill = KillAt(12, lambda: os.kill(first, signal.SIGKILL))
    chains = run_chains(
        partial(walk, pause=0.002), walks(3), 400, 20, executor=client.get_executor(), block=20,
        progress=False, describe=kill,
    )  # fmt: skip
    assert kill.seen > 12
    assert not any(chain.interrupted for chain in chains)
    whole = [walk(state, 420)[1].draws["x"][20:] for state in walks(3)]
    np.testing.assert_array_equal(stack(chains)[0]["x"], whole)
    client.wait_for_workers(2)


@pytest.mark.slow
def test_dask_gives_up_on_a_task_that_kills_its_workers(client):
    with pytest.raises(ssm.ExecutorError, match="Dask gave up on a task: KilledWorker"):
        run_tasks(die, [3], executor=client.get_executor())
    client.wait_for_workers(2)


# -- calls from workers
def nested_in_threads(pool):
    return VERBS["log_likelihood"](pool)


def test_a_call_on_a_thread_of_its_own_executor():
    expected = VERBS["log_likelihood"](None)
    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(nested_in_threads, pool).result(timeout=60)
    np.testing.assert_array_equal(found, expected)


def nested_in_dask(_):
    from distributed import get_client

    return VERBS["log_likelihood"](get_client().get_executor())


def nested_alone(_):
    return VERBS["log_likelihood"](None)


@pytest.mark.parametrize("call", [nested_in_dask, nested_alone])
def test_calls_on_all_of_dasks_workers(client, call):
    expected = VERBS["log_likelihood"](None)
    for future in client.map(call, range(4), pure=False):
        np.testing.assert_array_equal(future.result(timeout=60), expected)


def test_how_many_workers_there_are(client):
    assert workers_of(None) is None
    assert workers_of(ThreadPoolExecutor(3)) == 3
    assert workers_of(client.get_executor()) == 2


def test_processes_leave_ctrl_c_to_the_one_that_waits():
    with executors.processes(1) as pool:
        assert pool.submit(signal.getsignal, signal.SIGINT).result() == signal.SIG_IGN
