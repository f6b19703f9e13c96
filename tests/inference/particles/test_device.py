"""`device="cuda"`: the filter in Numba's simulator, its compilation, and what is refused.

The simulator runs everything but the launch, thread by thread in Python, against the same random
numbers in NumPy. On a machine with a GPU the estimates are also held against exact ones.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import cuda, types

import ssmppl as ssm
from ssmppl.codegen.modules import device
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.language.tracing import trace
from tests.inference.particles.test_blocks import AT, MODEL, data
from tests.models.statements import MODELS, build
from tests.statistics.checks import LEVEL, mean_one_p, seed_of

ROOT = Path(__file__).parents[3]
MATRICES = "matrices"  # of the state, which a thread cannot factorise
FEW = ["counts:bootstrap", "wishart_noise:guided"]
WITH_GPU = pytest.mark.skipif(
    numba.config.ENABLE_CUDASIM or not cuda.is_available(), reason="no NVIDIA GPU in this machine"
)


def able(program):
    """The proposals of a program that the device runs."""
    return [name for name in program.proposals if program.apart(name)]


def simulated(cases):
    """What `device_runs` prints of each case."""
    out = subprocess.run(
        [sys.executable, "-m", "tests.inference.device_runs", *cases], cwd=ROOT, text=True,
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}, stdout=subprocess.PIPE, check=True,
    ).stdout  # fmt: skip
    return [json.loads(line) for line in out.splitlines()]


def same_numbers(cases):
    found = simulated(cases)
    assert [f["case"] for f in found] == cases
    for f in found:
        assert f["status"][0] == 0, f["case"]
        # absolutely where a row tells nothing, and its log-likelihood is a rounding error of 0
        np.testing.assert_allclose(
            f["found"], f["expected"], rtol=1e-11, atol=1e-14, err_msg=f["case"]
        )


@pytest.mark.slow
def test_the_simulator_finds_the_numbers_of_numpy():
    same_numbers(FEW)


@pytest.mark.slow
@pytest.mark.parametrize("every", [10, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_the_simulator_finds_the_numbers_of_numpy_for_every_model(every):
    cases = []
    for name in MODELS:
        program = compile_trace(trace(build(name)))
        if program.trace.observations and name != MATRICES:
            cases += [f"{name}:{proposal}" for proposal in able(program)]
    same_numbers(cases[::every])


@pytest.mark.skipif(
    not cuda.__file__.partition("numba_cuda")[1], reason="numba-cuda is not installed"
)
@pytest.mark.parametrize("name", [name for name in MODELS if name != MATRICES])
def test_compiles_for_a_gpu_that_is_not_there(name, monkeypatch):
    """To PTX, for compute capability 9.0."""
    from numba.cuda import dispatcher

    class Hopper:
        compute_capability = (9, 0)

    monkeypatch.setattr(dispatcher, "get_current_device", lambda: Hopper)
    monkeypatch.setattr(device, "cuda_module", lambda: cuda)
    monkeypatch.setattr(device, "compiled", lambda function: function)
    vector, plane = types.float64[::1], types.float64[:, ::1]
    whole, words = types.int64[::1], types.uint64[::1]
    move = (vector, vector, plane, types.int64, types.int64, words, vector)
    move += (plane, whole, whole, plane, whole, vector, vector, whole)
    join = (types.int64, types.int64, whole, vector, vector, whole, whole, vector, vector, whole)
    program = compile_trace(trace(build(name)))
    for proposal in able(program):
        made = device.compile_device(program.trace, program.proposals[proposal], 128)
        for kernel, given in ((made.move, move), (made.join, join)):
            ptx, _ = cuda.compile_ptx(kernel, types.void(*given), cc=(9, 0))
            assert ".visible .entry" in ptx


@WITH_GPU
@pytest.mark.parametrize("proposal", ["bootstrap", "guided"])
@pytest.mark.parametrize(("particles", "repeats"), [(50, 2000), (20_000, 300)])
def test_unbiased_on_the_gpu(particles, repeats, proposal):
    exact = ssm.log_likelihood(MODEL, data(), AT, proposal="kalman")[0]
    found = ssm.log_likelihood(
        MODEL, data(), AT, particles=particles, repeats=repeats, proposal=proposal,
        device="cuda", seed=seed_of("gpu", particles, proposal),
    )  # fmt: skip
    assert mean_one_p(found - exact) > LEVEL / 4


@WITH_GPU
def test_the_gpu_repeats_itself():
    many = {"particles": 100_000, "proposal": "bootstrap", "device": "cuda", "seed": 1}
    first, second = (ssm.log_likelihood(MODEL, data(), AT, **many) for _ in range(2))
    assert first == second


class AnyDevice:
    """Stands for a device where none is needed: what is refused is refused before."""


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"resampling": "stratified"}, "resampling='stratified' together with device='cuda'"),
        ({"ess_threshold": 0.5}, "ess_threshold=0.5 together with device='cuda'"),
        ({"rescue": 10}, "rescue=10 together with device='cuda'"),
        ({"proposal": "auxiliary"}, "proposal='auxiliary' is not run by device='cuda'"),
        ({"proposal": "twisted"}, "proposal='twisted' is not run by device='cuda'"),
        ({"proposal": "nothing"}, "proposal='nothing' is not run by device='cuda'"),
        ({"device": "tpu"}, "device='tpu' is unknown"),
    ],
)
def test_what_the_device_does_not_do(monkeypatch, changes, said):
    from ssmppl.inference.particles import on_device

    monkeypatch.setattr(on_device, "cuda_module", AnyDevice)
    call = {"proposal": "bootstrap", "device": "cuda", "seed": 1} | changes
    with pytest.raises(ssm.ArgumentError) as error:
        ssm.log_likelihood(MODEL, data(), AT, **call)
    assert said in str(error.value)


def test_matrices_of_the_state_are_refused(monkeypatch):
    monkeypatch.setattr(device, "cuda_module", AnyDevice)
    program = compile_trace(trace(build(MATRICES)))
    with pytest.raises(ssm.ArgumentError, match="factorises a matrix that depends on the state"):
        device.compile_device(program.trace, program.proposals["bootstrap"])


@pytest.mark.skipif(cuda.is_available(), reason="there is a GPU")
def test_no_gpu_is_told():
    with pytest.raises(ssm.ArgumentError, match=r"device='cuda', but .*\n?.*NVIDIA GPU"):
        ssm.log_likelihood(MODEL, data(), AT, proposal="bootstrap", device="cuda")


def test_exact_likelihoods_need_no_gpu():
    exact = ssm.log_likelihood(MODEL, data(), AT)
    assert ssm.log_likelihood(MODEL, data(), AT, device="cuda") == exact
