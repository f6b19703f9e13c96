"""Seeds of runs, and of all places within a run: chains, repeats, experiments; and draws."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from ssmppl.codegen.kernels.math import random
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.modules.exact import load_kernels
from ssmppl.compiling import once
from ssmppl.errors import ArgumentError


def seed_sequence(seed: Any) -> np.random.SeedSequence:
    """The root of a call's random numbers."""
    whole = isinstance(seed, (int, np.integer)) and not isinstance(seed, bool)
    if seed is not None and (not whole or seed < 0):
        raise ArgumentError(
            f"seed={seed!r}", fix="give a whole number of at least 0, or None for a random one"
        )
    return np.random.SeedSequence(seed)


def random_state(root: np.random.SeedSequence, *path: int) -> np.ndarray:
    """State of the kernels' generator at a place in the work (chain, repeat, experiment, ...)."""
    return new_state(np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, *path)))


def fill_normal(stream: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (n,), contiguous, with standard normals of a stream, which moves on."""
    _draws().normals(stream, out)


def fill_uniform(stream: np.ndarray, out: np.ndarray) -> None:
    """Likewise with uniforms on the open interval (0, 1)."""
    _draws().uniforms(stream, out)


@once
def _draws() -> ModuleType:
    kernels = {"normals": random.normals, "uniforms": random.uniforms}
    return load_kernels("draws", "draws that Python asks for", kernels)
