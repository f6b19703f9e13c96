"""One small model for all methods of `sample`, and the calls that tests stop and continue.

Vectors, inputs, missing values and two experiments of different lengths. Run as a program it makes
the calls one after the other, and is killed on the way (test_checkpoint_sample.py).
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import ssmppl as ssm
from ssmppl.inference.checkpoints import archive
from ssmppl.inference.checkpoints import chains as checkpoints
from ssmppl.inference.run import chain_runner

pair = ssm.Model("pair", inputs=("u",))


@pair.prior
def pair_prior():
    return {
        "b": ssm.Normal(np.zeros(2), sd=1),
        "q": ssm.InverseGamma(3, scale=1),
        "r": ssm.InverseGamma(3, scale=1),
    }


@pair.initial
def pair_initial():
    return {"x": ssm.Normal(np.zeros(2), sd=1)}


@pair.transition
def pair_transition(x, u, b, q):
    return {"x": ssm.Normal(0.7 * x + b * u, variance=q)}


@pair.observation
def pair_observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}


def experiment(steps: int, seed: int) -> dict[str, np.ndarray]:
    u = np.sin(np.arange(steps) / 3.0)
    values = {"b": [0.5, -0.5], "q": 0.3, "r": 0.2}
    y = ssm.simulate(pair, values, inputs={"u": u}, steps=steps, seed=seed)["y"].values[0].copy()
    y[3, 1], y[5] = np.nan, np.nan
    return {"y": y, "u": u}


DATA = [experiment(15, 1), experiment(9, 2)]
LENGTHS: dict[str, Any] = {"draws": 24, "warmup": 16, "chains": 3, "seed": 1, "progress": False}
CALLS: dict[str, tuple[Any, dict[str, Any]]] = {
    "MetropolisHastings": (ssm.MetropolisHastings(), {"thin": 2}),
    "Gibbs": (ssm.Gibbs(), {}),
    "Gibbs, interweaved": (ssm.Gibbs(interweave=True), {"thin": 2}),
    "Gibbs, auto": (ssm.Gibbs(interweave="auto"), {"warmup": 220}),
    "PMMH": (ssm.PMMH(target_sd=2.0, proposal="bootstrap"), {"fixed": {"r": 0.2}}),
    "PMMH, gradient": (ssm.PMMH(particles=20, order=2, lag=3, proposal="bootstrap"), {}),
    "PMMH, correlated": (ssm.PMMH(particles=20, correlation=0.9, proposal="bootstrap"), {}),
    "PMMH, delayed": (ssm.PMMH(particles=8, proposal="twisted"), {}),
    "ISMCMC": (ssm.ISMCMC(), {"chains": 2, "draws": 40}),
    "PGAS": (ssm.PGAS(particles=10, log_likelihood=True, proposal="bootstrap"), {"thin": 2}),
    "PGAS, interweaved": (ssm.PGAS(particles=10, interweave=True, proposal="bootstrap"), {}),
    "PGAS, auto": (
        ssm.PGAS(particles=5, interweave="auto", proposal="bootstrap"), {"warmup": 220, "chains": 2}
    ),
    "PGAS, eliminated": (ssm.PGAS(particles=10, eliminate=True), {}),
    "SMC2": (ssm.SMC2(parameters=30, particles=20, proposal="bootstrap"), {"chains": 2}),
}  # fmt: skip


def call(name: str, checkpoint: Any = None, **changes: Any) -> Any:
    method, own = CALLS[name]
    return ssm.sample(pair, DATA, method, **{**LENGTHS, **own, "checkpoint": checkpoint, **changes})


def bits(idata: Any) -> dict[str, str]:
    """A digest of every variable, and all attributes but the times."""
    out = {}
    for group in ("posterior", "sample_stats", "log_likelihood"):
        if group in set(getattr(idata, "children", None) or idata.groups()):
            for n, v in idata[group].data_vars.items():
                own = hashlib.sha256(np.ascontiguousarray(v.values).tobytes()).hexdigest()[:12]
                out[f"{group} {n}"] = f"{v.dtype} {v.shape} {own}"
    attrs = idata["posterior"].attrs
    return out | {k: str(v) for k, v in attrs.items() if k not in ("seconds", "created_at")}


def main() -> None:
    """Calls in turn, slowed down, each writing its state after every block."""

    def write_slowly(file: Path, members: Any) -> None:
        archive.write(file, members)
        time.sleep(0.01)

    checkpoints.SECONDS, checkpoints.SHARE, checkpoints.write = -1.0, 1e9, write_slowly
    chain_runner.BLOCK_SECONDS, chain_runner.TIMES_SENDING = 1e-9, 0
    folder = Path(sys.argv[1])
    for name in sys.argv[2:]:
        found = bits(call(name, folder / f"{name}.npz"))
        (folder / f"{name}.txt").write_text("\n".join(f"{k}: {v}" for k, v in found.items()))
    os._exit(0)


if __name__ == "__main__":
    main()
