"""What is known of states that take finitely many values: the probability of each value, and the
most probable path of all rows together."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from ssmppl.codegen.modules.exact import exact_entry
from ssmppl.data import Experiment
from ssmppl.inference.exact.hidden_markov import HiddenMarkov

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
        paths, heights = np.empty(len(h.y), dtype=np.int64), np.empty(h.size)
        logs = tables.log_start, tables.log_move, tables.log_g
        exact_entry("finite_viterbi")(h.first, *logs, paths, heights)
        for i, s in zip(h.members, h.which, strict=True):
            found[int(i)] = exact.values[paths[h.of(s)]], float(heights[s])
    return [found[i] for i in range(len(found))]
