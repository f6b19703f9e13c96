"""Two ways to keep the particles of earlier steps, and how much of them is kept."""

from __future__ import annotations

import numpy as np
import pytest

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.particle.conditional_smc import FREE, open_genealogy, recall, remember
from tests.statistics.checks import seed_of

STEPS, STATES = 300, 2


@exact
def followed(x, ancestors, dense, paths, used):
    """All paths (N, T, D) of given particles x (T, D, N); used (T,): nodes of the tree in use."""
    n_steps, d, n = x.shape
    genealogy = open_genealogy(n_steps, d, n, dense)
    for t in range(n_steps):
        genealogy = remember(genealogy, t, x[t], ancestors[t])
        tree = genealogy[2]
        used[t] = tree[1].size - tree[4][FREE]
    for i in range(n):
        recall(genealogy, i, paths[i])


def system(n: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Particles that all differ, and ancestors by weights as uneven as `spread` says."""
    rng = np.random.default_rng(seed_of("genealogy", n, spread))
    x = rng.normal(size=(STEPS, STATES, n))
    weights = rng.dirichlet(np.full(n, spread), size=STEPS)
    ancestors = np.array([rng.choice(n, size=n, p=w) for w in weights], dtype=np.int32)
    return x, ancestors


def by_definition(x: np.ndarray, ancestors: np.ndarray) -> np.ndarray:
    """Each particle's path, followed backwards."""
    paths, index = np.empty((x.shape[2], STEPS, STATES)), np.arange(x.shape[2])
    for t in range(STEPS - 1, -1, -1):
        paths[:, t] = x[t][:, index].T
        index = ancestors[t][index]
    return paths


@pytest.mark.parametrize("n", [1, 2, 7, 200])
@pytest.mark.parametrize("spread", [0.02, 1.0, 50.0])
def test_paths_are_those_of_the_ancestors(n, spread):
    x, ancestors = system(n, spread)
    wanted = by_definition(x, ancestors)
    for dense in (x.size, x.size - 1):  # everything is kept, or the tree
        paths, used = np.empty_like(wanted), np.empty(STEPS, dtype=np.int64)
        followed(x, ancestors, dense, paths, used)
        np.testing.assert_array_equal(paths, wanted)


@pytest.mark.parametrize("spread", [0.02, 1.0, 50.0])
def test_the_tree_holds_just_those_with_descendants(spread):
    """Counted by hand after every step."""
    n = 60
    x, ancestors = system(n, spread)
    used = np.empty(STEPS, dtype=np.int64)
    followed(x, ancestors, 0, np.empty((n, STEPS, STATES)), used)
    for t in (0, 1, 5, STEPS - 1):
        alive, total = np.arange(n), 0
        for s in range(t, -1, -1):
            alive = np.unique(alive)
            total += len(alive)
            alive = ancestors[s][alive]
        assert used[t] == total


def test_paths_coalesce():
    """Under equal weights the step k back holds about 2 N / k distinct ancestors (Kingman 1982,
    the coalescent), and never less than one: T + 2 N log 2 N nodes in all, far below T N."""
    n = 60
    x, ancestors = system(n, 1e6)
    used = np.empty(STEPS, dtype=np.int64)
    followed(x, ancestors, 0, np.empty((n, STEPS, STATES)), used)
    assert used[-1] < STEPS + 2 * n * np.log(2 * n)
    assert used[-1] < STEPS * n / 10
