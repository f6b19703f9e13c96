"""What is known of states that take finitely many values: the probability of each value, and the
most probable path of all rows together."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from ssmppl.data import Experiment
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, Tables

if TYPE_CHECKING:
    import xarray as xr


def probabilities(
    exact: HiddenMarkov, law: np.ndarray, dataset: xr.Dataset
) -> dict[str, xr.DataArray]:
    """Probabilities of each state's values, from the distributions (T, K) of their combinations.

    dataset : with the states, whose dims and coordinates they get.
    """
    import xarray as xr

    out = {}
    for name, site in exact.trace.transition.items():
        own = [k for k, s in enumerate(exact.trace.state_symbols) if s.data[1] == name]
        columns = exact.values[:, own]
        values, index = np.unique(columns, return_inverse=True)
        shares = np.eye(len(values))[index.reshape(columns.shape)]  # (K, size, values)
        chances = np.einsum("tk,kdv->tdv", law, shares).reshape(-1, *site.shape, len(values))
        if name in exact.trace.auxiliary:
            chances[0] = np.nan
        out[f"{name}_probability"] = xr.DataArray(
            chances[None], dims=(*dataset[name].dims, f"{name}_value"),
            coords={**dataset[name].coords, f"{name}_value": values},
        )  # fmt: skip
    return out


def viterbi_paths(
    exact: HiddenMarkov, experiments: Iterable[Experiment], theta: np.ndarray
) -> list[tuple[np.ndarray, float]]:
    """The most probable path of each experiment, (T, D), and log p(path, y).

    Of several that are equally probable, one. A. J. Viterbi, "Error bounds for convolutional codes
    and an asymptotically optimum decoding algorithm", *IEEE Transactions on Information Theory* 13
    (1967); Rabiner (1989), section III.B.
    """
    found: dict[int, tuple[np.ndarray, float]] = {}
    for h in exact.histories_of(experiments):
        tables = exact.tables(h, theta)
        each = [_path(tables, s, slice(*h.first[s : s + 2])) for s in range(h.size)]
        for i, s in zip(h.members, h.which, strict=True):
            index, height = each[s]
            found[int(i)] = exact.values[index], height
    return [found[i] for i in range(len(found))]


def _path(tables: Tables, s: int, rows: slice) -> tuple[np.ndarray, float]:
    """(T,) index of the value at each row of history s, and the log probability."""
    log_g = tables.log_g[rows]
    move = tables.log_move[rows] if len(tables.log_move) > 1 else tables.log_move
    best = tables.log_start[s] + log_g[0]
    from_where = np.zeros(log_g.shape, dtype=np.int64)
    for t in range(1, len(log_g)):
        reached = best[:, None] + move[t if len(move) > 1 else 0]  # before, now
        from_where[t] = np.argmax(reached, axis=0)
        best = np.max(reached, axis=0) + log_g[t]
    index = np.empty(len(log_g), dtype=np.int64)
    index[-1] = np.argmax(best)
    for t in range(len(log_g) - 1, 0, -1):
        index[t - 1] = from_where[t, index[t]]
    return index, float(best[index[-1]])
