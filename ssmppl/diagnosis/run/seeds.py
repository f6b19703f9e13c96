"""Seeds of the parts of a diagnosis, so that each has its own numbers whatever else is run."""

from __future__ import annotations

import numpy as np


def child_seed(seed: np.random.SeedSequence, *path: int) -> np.random.SeedSequence:
    """The seed at a place below `seed`: a stage, a block, a refit."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *path))
