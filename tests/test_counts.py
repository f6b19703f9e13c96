"""Calls that ask for more than the machine's memory are refused before anything is done."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl import counts

ROWS, MEGABYTE = 50, 10**6
model = ssm.Model("level")


@model.prior
def prior():
    return {"q": ssm.Gamma(2, rate=1)}


@model.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}


@model.transition
def transition(x, q):
    return {"x": ssm.Normal(x, variance=q)}


@model.observation
def observation(x):
    return {"y": ssm.StudentT(4, x, scale=1)}


DATA = {"y": np.random.default_rng(1).normal(size=ROWS)}
AT = {"q": 0.5}
FILTER = ssm.FFBSi(proposal="bootstrap")
CALLS = {  # what is refused, the numbers of 8 bytes that it takes, and what the error names
    "particles of a filter": (
        lambda n: ssm.log_likelihood(model, DATA, AT, particles=n, proposal="bootstrap"),
        lambda n: 4 * n,
        "particles=",
    ),
    "history": (
        lambda n: ssm.particle_filter(
            model, DATA, AT, particles=n, proposal="bootstrap", history=True, repeats=2
        ),
        lambda n: 2 * ROWS * n * 3,
        "history=True of 50 rows with particles=",
    ),
    "particles of a smoother": (
        lambda n: ssm.smooth(model, DATA, AT, FILTER, particles=n, trajectories=2),
        lambda n: ROWS * n * 3,
        "particles of each of 50 rows",
    ),
    "trajectories": (
        lambda n: ssm.smooth(model, DATA, AT, FILTER, particles=10, trajectories=n),
        lambda n: ROWS * n,
        "trajectories of 50 rows",
    ),
    "steps": (
        lambda n: ssm.simulate(model, AT, steps=n, draws=3, seed=1),
        lambda n: 3 * n * 2,
        "3 draws of [0-9]+ rows",
    ),
    "predictions": (
        lambda n: ssm.predict(model, None, DATA, draws=n, seed=1),
        lambda n: n * ROWS * 2,
        "draws of 50 rows",
    ),
    "draws of states": (
        lambda n: ssm.sample(
            model, DATA, ssm.PGAS(particles=5), draws=n, warmup=0, chains=2, progress=False
        ),
        lambda n: 2 * 2 * n * ROWS,
        "2 chains of [0-9]+ draws of the states of 50 rows",
    ),
}


@pytest.mark.parametrize("what", CALLS)
def test_what_takes_more_memory_than_there_is_is_refused(what, monkeypatch):
    call, numbers, told = CALLS[what]
    least = next(n for n in range(1, MEGABYTE) if 8 * numbers(n) > MEGABYTE)
    monkeypatch.setattr(counts, "memory", lambda: MEGABYTE)
    with pytest.raises(ssm.ArgumentError, match=told) as error:
        call(least)
    assert "memory is 0.0 GB" in str(error.value)
    call(least - 1)  # takes all that there is
    monkeypatch.setattr(counts, "memory", lambda: None)
    call(least)  # where nobody knows, it is tried


def test_draws_on_disk_take_no_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(counts, "memory", lambda: 10_000)
    short = {"draws": 30, "warmup": 0, "chains": 2, "progress": False}
    with pytest.raises(ssm.ArgumentError, match="checkpoint= keeps them on disk"):
        ssm.sample(model, DATA, ssm.PGAS(particles=5), **short)
    ssm.sample(model, DATA, ssm.PGAS(particles=5), **short, checkpoint=tmp_path / "run.npz")
    ssm.sample(model, DATA, ssm.PGAS(particles=5), **short, states=False)


def test_log_likelihoods_of_rows_take_memory_without_states_too(monkeypatch):
    monkeypatch.setattr(counts, "memory", lambda: 10_000)
    short = {"draws": 30, "warmup": 0, "chains": 2, "states": False, "progress": False}
    for method in (ssm.PMMH(particles=5), ssm.PGAS(particles=5, log_likelihood=True)):
        with pytest.raises(ssm.ArgumentError, match="draws of the log-likelihoods of 50 rows") as e:
            ssm.sample(model, DATA, method, **short)
        assert "states=False" not in str(e.value)
        with pytest.raises(ssm.ArgumentError, match="of the states and log-likelihoods of 50 rows"):
            ssm.sample(model, DATA, method, **{**short, "states": True})


@pytest.mark.parametrize("name", ["particles", "repeats"])
def test_counts_that_no_machine_holds_are_refused(name):
    with pytest.raises(ssm.ArgumentError, match=f"{name}=1000000000000: 8,000 GB of numbers"):
        ssm.log_likelihood(model, DATA, AT, **{name: 10**12})
    with pytest.raises(ssm.ArgumentError, match="steps=1000000000000: 8,000 GB"):
        ssm.simulate(model, AT, steps=10**12)


@pytest.mark.parametrize("value", [0, -1, 2.5, True, "10", None])
def test_a_count_is_a_whole_number(value):
    with pytest.raises(ssm.ArgumentError, match="give a whole number of at least 1") as error:
        ssm.simulate(model, AT, steps=10, draws=value)
    assert f"draws={value!r}" in str(error.value)


def test_this_machine_tells_its_memory():
    assert counts.memory() is None or counts.memory() > 2**28


@pytest.mark.parametrize("value", ["10", 2.5, True, [10]])
def test_particles_whose_history_is_asked_for_are_a_whole_number_too(value):
    with pytest.raises(ssm.ArgumentError, match="particles="):
        ssm.particle_filter(model, DATA, AT, particles=value, history=True)
