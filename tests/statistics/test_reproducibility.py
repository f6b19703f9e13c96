"""The same seed gives the same numbers: on threads, on processes, on any number of them, whatever
the size of blocks. And another seed gives others."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.datasets import ice_varves
from ssmppl.inference.run import chain_runner
from tests.models import standard as models

DATA = {"y": ice_varves()[:60]}
THETA = {"phi": 0.9, "tau": 20.0}


def log_likelihoods(executor, seed=5):
    return ssm.log_likelihood(
        models.varves, DATA, THETA, particles=50, repeats=20, proposal="bootstrap", seed=seed,
        executor=executor,
    )  # fmt: skip


def filtered(executor, seed=5):
    found = ssm.particle_filter(
        models.varves, DATA, THETA, particles=50, repeats=3, proposal="bootstrap", seed=seed,
        executor=executor,
    )  # fmt: skip
    return np.concatenate([found[v].values.ravel() for v in ("x", "x_quantile", "y_pit", "ess")])


def sampled(method, executor, seed=5):
    posterior = ssm.sample(
        models.varves, DATA, method, draws=40, warmup=20, chains=3, progress=False, seed=seed,
        executor=executor,
    )["posterior"]  # fmt: skip
    return np.concatenate([posterior[v].values.ravel() for v in ("phi", "tau", "x")])


VERBS = {
    "log_likelihood": log_likelihoods,
    "particle_filter": filtered,
    "PGAS": partial(sampled, ssm.PGAS(particles=10)),
    "PMMH": partial(sampled, ssm.PMMH(particles=50, proposal="bootstrap")),
}


@pytest.mark.parametrize("verb", VERBS)
def test_threads(verb):
    run = VERBS[verb]
    first = run(None)
    assert np.all(np.isfinite(first))
    for workers in (1, 3):
        with ThreadPoolExecutor(workers) as executor:
            np.testing.assert_array_equal(run(executor), first)
    assert not np.array_equal(run(None, seed=6), first)


@pytest.fixture(scope="module")
def processes():
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as one,
        ProcessPoolExecutor(2, mp_context=get_context("forkserver")) as two,
    ):
        yield {"one, spawn": one, "two, forkserver": two}


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("kind", ["one, spawn", "two, forkserver"])
def test_processes(processes, verb, kind):
    run = VERBS[verb]
    np.testing.assert_array_equal(run(processes[kind]), run(None))


@pytest.mark.parametrize("method", ["PGAS", "PMMH"])
@pytest.mark.parametrize("seconds", [1e-9, 60.0], ids=["small", "large"])
def test_size_of_blocks(monkeypatch, method, seconds):
    first = VERBS[method](None)
    monkeypatch.setattr(chain_runner, "BLOCK_SECONDS", seconds)
    monkeypatch.setattr(chain_runner, "TIMES_SENDING", 0)
    np.testing.assert_array_equal(VERBS[method](None), first)


def test_repeats_do_not_depend_on_their_number():
    few = ssm.log_likelihood(
        models.varves, DATA, THETA, particles=50, repeats=3, proposal="bootstrap", seed=5
    )
    np.testing.assert_array_equal(few, log_likelihoods(None)[:3])


def test_no_seed_is_a_new_one_every_time():
    assert not np.array_equal(log_likelihoods(None, seed=None), log_likelihoods(None, seed=None))


COLD_AND_WARM = """
import hashlib
from tests.statistics.test_reproducibility import VERBS
for verb in ("PMMH", "particle_filter", "PGAS", "log_likelihood"):
    print(verb, hashlib.sha256(VERBS[verb](None).tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_a_process_that_compiles_and_one_that_finds_the_cache(tmp_path):
    """Passes over particles are in one form, whichever entry point they are reached through."""
    environment = {**os.environ, "SSMPPL_CACHE": str(tmp_path)}
    cold, warm = (
        subprocess.run(
            [sys.executable, "-c", COLD_AND_WARM], cwd=Path(__file__).parents[2], text=True,
            env=environment, capture_output=True, check=True,
        ).stdout
        for _ in range(2)
    )  # fmt: skip
    assert cold == warm
