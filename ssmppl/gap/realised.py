"""Statistics on the scale of the information that each data set holds of them.

What acts only where a state seldom goes (a stop, an overflow, a curve far out) has next to no
information in most simulated sets and very much in a few. Its variance over the sets is that of
the few, and one of them may lie forty standard deviations out: enough to hide everything else in
the law of the largest. Given where the states went the information is known, and the score is
compared with that (D. Cox and D. Hinkley, *Theoretical Statistics* 1974, section 4.8, on observed
and expected information): a score S with the sum of squares R of its rows is divided by
sqrt(R / (2 r)) where R is more than twice the r of a typical set. Below that nothing is changed, as
R counts what is unmodelled along with the information.
"""

from __future__ import annotations

import numpy as np

FREE = 2.0  # times a typical set's sum of squares, up to which a score is left as it is


def typical(squares: np.ndarray) -> np.ndarray:
    """(K,) median of sums of squares (B, K) over the sets that have any; NaN where none has."""
    some = np.where(squares > 0.0, squares, np.nan)
    none = np.all(np.isnan(some), axis=0)
    return np.where(none, np.nan, np.nanmedian(np.where(none, 0.0, some), axis=0))


def excess(squares: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """By what scores with these sums of squares (..., K) are to be divided, usual (K,)."""
    return np.sqrt(np.fmax(squares / (FREE * usual), 1.0))
