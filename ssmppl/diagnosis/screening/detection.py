"""Detection of a gap: checks of one-step predictions, and of how well several steps are predicted.

z_t = Phi^-1 of the probability integral transform of the one-step prediction is standard normal
white noise under the true parameters (M. Rosenblatt 1952; F. Diebold, T. Gunther and A. Tay 1998).
Under fitted ones it is not quite: what is computed here has its distribution from data sets
simulated at the fit, made orthogonal to the nuisance scores (`efficient`), and never from a table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from ssmppl.diagnosis.effects.candidate import WHOLE, segments
from ssmppl.diagnosis.screening.efficient_score import Null, efficient
from ssmppl.diagnosis.screening.familywise import familywise
from ssmppl.errors import ArgumentError

if TYPE_CHECKING:
    import pandas as pd

EDGE = 1e-9  # a PIT value nearer to 0 or 1 counts as this near: |z| stays below 6
LAGS, DELAYS = 5, 3
LONG = 40  # lags of the sums of squares that look for what rings on
FEWEST = 8  # pairs of values without which a statistic is left out (0 in every data set)


@dataclass(frozen=True)
class PredictionChecks:
    """Named statistics of the predictions of one data set.

    names : (channel, statistic) of each. values : (K,), of order one where the model is right.
    quadratic : (K,) which are sums of squares, large being the only way to be wrong.
    """

    names: tuple[tuple[str, str], ...]
    values: np.ndarray
    quadratic: np.ndarray

    def with_values(self, channel: str, values: Mapping[str, float]) -> PredictionChecks:
        """These and more statistics of a channel, its CRPS at each horizon."""
        names = tuple((channel, name) for name in values)
        return PredictionChecks(
            self.names + names, np.append(self.values, list(values.values())),
            np.append(self.quadratic, np.zeros(len(names), bool)),
        )  # fmt: skip


def normal_scores(pit: np.ndarray) -> np.ndarray:
    """z = Phi^-1(pit), values within `EDGE` of 0 and 1 moved there; NaN stays."""
    return ndtri(np.clip(np.asarray(pit, float), EDGE, 1.0 - EDGE))


def statistics(
    pit: np.ndarray,
    channels: Sequence[str],
    inputs: np.ndarray | None = None,
    input_names: Sequence[str] = (),
    *,
    starts: Sequence[int] = WHOLE,
    lags: int = LAGS,
    delays: int = DELAYS,
) -> PredictionChecks:
    """Statistics of the one-step predictions, channel by channel.

    mean, variance, tails : sqrt(n) times the mean of the Hermite polynomials of degree 1, 2 and 4
    of z, which are uncorrelated for normal z. autocorrelation at each lag, and of `LONG` lags
    jointly (Box and Pierce 1970). Correlation of z_t with u_{t-k} (mean), also of `LONG` of them
    jointly, and of z_t^2 with u_{t-k}^2 (scale).

    Parameters
    ----------
    pit : (T, C) of the one-step predictions; NaN where nothing was observed. A discrete channel's
        are randomised by the caller.
    channels : its C names. inputs : (T, U), with `input_names`.
    starts : first row of each experiment; no lag or delay reaches across.

    Raises
    ------
    ArgumentError : shapes that do not belong together.
    """
    z = normal_scores(pit)
    given = np.zeros((len(z), 0)) if inputs is None else np.asarray(inputs, float)
    if z.ndim != 2 or z.shape[1] != len(channels) or given.shape != (len(z), len(input_names)):
        raise ArgumentError(
            f"PIT values of shape {np.shape(pit)} for {len(channels)} channels, inputs of shape "
            f"{given.shape} for {len(input_names)} names",
            fix="give (T, C) and (T, U) with as many names",
        )
    parts = list(segments(len(z), starts))
    ready = [(name, _standard(u), _standard(u**2))
             for name, u in zip(input_names, given.T, strict=True)]  # fmt: skip
    found: dict[tuple[str, str], float] = {}
    for c, channel in enumerate(channels):
        e = z[:, c]
        for name, values in (("mean", e), ("variance", (e**2 - 1.0) / np.sqrt(2.0)),
                             ("tails", (e**4 - 6.0 * e**2 + 3.0) / np.sqrt(24.0))):  # fmt: skip
            found[channel, name] = _sum(values)
        at_lags = [_sum(_lagged(e, e, k, parts)) for k in range(1, LONG + 1)]
        for k, value in enumerate(at_lags[:lags], start=1):
            found[channel, f"autocorrelation at lag {k}"] = value
        found[channel, f"autocorrelation, {LONG} lags"] = float(np.sum(np.square(at_lags)))
        for name, u, square in ready:
            for k in range(delays + 1):
                when = name if k == 0 else f"{name}, {k} step{'s' * (k > 1)} before"
                found[channel, f"mean with {when}"] = _sum(_lagged(e, u, k, parts))
                scale = _lagged((e**2 - 1.0) / np.sqrt(2.0), square, k, parts)
                found[channel, f"variance with {when} squared"] = _sum(scale)
            before = [_sum(_lagged(e, u, k, parts)) for k in range(LONG + 1)]
            found[channel, f"mean with {name}, {LONG} lags"] = float(np.sum(np.square(before)))
    quadratic = np.array([name.endswith(f"{LONG} lags") for _, name in found], bool)
    return PredictionChecks(tuple(found), np.array(list(found.values())), quadratic)


def detection(
    observed: PredictionChecks,
    null: Sequence[PredictionChecks] | np.ndarray,
    nuisance: np.ndarray,
    null_nuisance: np.ndarray,
) -> pd.DataFrame:
    """Table channel, statistic, value, z, p (family-wise, step-down), by p.

    Parameters
    ----------
    observed : of the data. null : the same of B simulated sets, or their values (B, K).
    nuisance, null_nuisance : (P,), (B, P) scores of the parameters at the fit.
    """
    import pandas as pd

    rows = null if isinstance(null, np.ndarray) else np.stack([s.values for s in null])
    shift = rows.mean(axis=0)  # finitely many particles move every one of them
    law = Null.of(rows - shift, null_nuisance, quadratic=observed.quadratic)
    found = efficient(law, observed.values - shift, nuisance)
    family = familywise(found.statistic, found.null, sided=found.sided)
    table = pd.DataFrame(observed.names, columns=["channel", "statistic"])
    table["value"], table["z"] = observed.values, found.statistic
    table["p"] = family.of_columns(np.arange(len(observed.names)))
    order = np.lexsort((-np.abs(table["z"]), table["p"]))
    return table.iloc[order].reset_index(drop=True)


def _sum(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.sum() / np.sqrt(len(known))) if len(known) >= FEWEST else 0.0


def _standard(u: np.ndarray) -> np.ndarray:
    """u with mean 0 and variance 1; all NaN where it does not vary."""
    spread = np.nanstd(u) if np.isfinite(u).any() else 0.0
    if spread <= 1e-12 * np.nanmax(np.abs(u), initial=0.0):
        return np.full(len(u), np.nan)
    return (u - np.nanmean(u)) / spread


def _lagged(a: np.ndarray, b: np.ndarray, k: int, parts: Sequence[slice]) -> np.ndarray:
    """a_t b_{t-k} within each experiment."""
    return np.concatenate([a[s][k:] * b[s][: max(len(b[s]) - k, 0)] for s in parts])
