"""Equivalence classes of candidates that these data do not separate.

The class of the best is its confidence set: the refits that lie no further behind than the truth
would by chance, here by the scores' normal distribution and in data simulated with each of them
(`experiment/recovery.py`); those of its kind that lose no more to it than a formula that is only
about right would lose to the machine's own law, whose effect may have the better formula next time;
and candidates whose scores correlate so much with the best one's that its gain does not separate
them.

Near the base model the log-likelihood gains are quadratic: under truth k of strength lambda the
efficient scores are S~ ~ N(lambda V[:, k], V), so that z ~ N(delta rho[:, k], rho) with delta^2 / 2
the expected gain of the truth. The gain of candidate j is z_j^2 / 2. A rival whose correlation with
the truth is rho overtakes it with probability Phi(-sqrt(g (1 - |rho|))): 5% where
g = 1.645^2 / (1 - |rho|) = 2.7 / (1 - |rho|).
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.refit import TIE, Refit

SEPARATING = 2.7  # 1.645^2: times 1 / (1 - |rho|), the gain that separates two effects at 5%
LEAST_CUT = 2.0  # nats behind the best that any member of a confidence set may be
FORM = 0.1  # likewise, as a share of what the best gains: no formula is the machine's own
DRAWS = 4000  # of the scores, for the cuts


def similarity(rho: np.ndarray, sided: np.ndarray | None = None) -> np.ndarray:
    """(K, K) how far each candidate can stand in for another: |rho|.

    Between two one-sided candidates the sign counts: one that would have to work backwards to
    mimic the other has similarity 0.
    """
    rho = np.asarray(rho, float)
    if sided is None:
        return np.abs(rho)
    sign = np.multiply.outer(np.sign(sided), np.sign(sided))
    return np.where(sign == 0, np.abs(rho), np.maximum(sign * rho, 0.0))


def separating_gain(rho: np.ndarray | float) -> np.ndarray:
    """The gain in nats that separates two effects of this correlation at 5%; infinite at 1."""
    distance = 1.0 - np.abs(np.asarray(rho, float))
    return np.divide(SEPARATING, distance, out=np.full(distance.shape, np.inf),
                     where=distance > 1e-12)  # fmt: skip


def distinguishable(gain: np.ndarray | float, rho: np.ndarray | float) -> np.ndarray:
    """Whether a gain (nats) separates effects of this correlation at 5%."""
    return np.asarray(gain) >= separating_gain(rho)


@dataclass(frozen=True)
class Classes:
    """Equivalence classes. class_id : (K,), from 1, in order of their leaders' gains.

    leader : (K,) of each candidate's class. rho : (K,) with its leader.
    """

    class_id: np.ndarray
    leader: np.ndarray
    rho: np.ndarray

    def members(self, class_id: int) -> np.ndarray:
        """Columns of a class, the leader first."""
        found = np.flatnonzero(self.class_id == class_id)
        return found[np.argsort(-np.abs(self.rho[found]) - (self.leader[found] == found))]


def classes_by_similarity(
    rho: np.ndarray, gains: np.ndarray, sided: np.ndarray | None = None
) -> Classes:
    """The best candidate takes all that its gain does not separate from it; and so on.

    rho : (K, K). gains : (K,) nats, of the screen or of the refits.
    """
    rho, gains = np.asarray(rho, float), np.asarray(gains, float)
    alike = similarity(rho, sided)
    class_id, leader = np.zeros(len(gains), int), np.full(len(gains), -1)
    for k in np.argsort(-gains, kind="stable"):
        if class_id[k]:
            continue
        same = (class_id == 0) & ~distinguishable(gains[k], alike[k])
        same[k] = True
        class_id[same], leader[same] = class_id.max() + 1, k
    return Classes(class_id, leader, rho[leader, np.arange(len(gains))])


# --- the confidence set --------------------------------------------------------------------------


def cuts(
    rho: np.ndarray,
    gains: np.ndarray,
    leading: Sequence[int],
    *,
    sided: np.ndarray | None = None,
    groups: np.ndarray | None = None,
    level: float = 0.95,
    draws: int = DRAWS,
    seed: int = 1,
) -> np.ndarray:
    """Quantile of (best gain - gain of the truth), each leading candidate taken as the truth.

    (len(leading),) nats, at least `LEAST_CUT`. delta^2 = 2 gain - 1, as E z^2 = delta^2 + 1: a gain
    is flattered by what it was fitted to, and a weaker truth is overtaken by more.

    Parameters
    ----------
    rho : (K, K) of all candidates that are compared. gains : (K,) nats.
    leading : columns that are taken as the truth in turn. sided : (K,) as in `Null`.
    groups : (K,) families of shapes; a family's gain is its largest.
    """
    rho, gains = np.asarray(rho, float), np.asarray(gains, float)
    width = len(gains)
    signs = np.zeros(width, int) if sided is None else np.sign(sided).astype(int)
    marks = np.arange(width) if groups is None else np.asarray(groups)
    values, vectors = np.linalg.eigh(rho)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    noise = np.random.default_rng(seed).standard_normal((draws, width)) @ root.T
    found = []
    for k in leading:
        delta = np.sqrt(max(2.0 * gains[k] - 1.0, 0.0)) * (signs[k] or 1)
        gained = _gain(noise + delta * rho[k], signs)
        excess = gained.max(axis=1) - gained[:, marks == marks[k]].max(axis=1)
        found.append(max(float(np.quantile(excess, level)), LEAST_CUT))
    return np.array(found)


def confidence_set(gains: np.ndarray, cut: np.ndarray | float) -> np.ndarray:
    """(K,) bool: candidates whose refit is no more than their own cut behind the best one."""
    gains = np.asarray(gains, float)
    return np.nanmax(gains) - gains <= cut


def _gain(z: np.ndarray, signs: np.ndarray) -> np.ndarray:
    reached = np.where(signs == 0, np.abs(z), np.maximum(signs * z, 0.0))
    return 0.5 * reached**2


# --- the classes of a screen ---------------------------------------------------------------------


def group_leaders(screen: Screen, refits: Sequence[Refit]) -> list[int]:
    """Best shape of each group: the refitted as they are ordered, then others by height."""
    done = [r.index[0] for r in refits if len(r.index) == 1]
    family, groups = screen.family, screen.groups
    known = {int(groups[k]) for k in done}
    return done + [
        k for k in family.leaders if not screen.efficient.status[k] and int(groups[k]) not in known
    ]


def equivalence_classes(
    screen: Screen, refits: Sequence[Refit], order: Sequence[int], alike: Container[int] = ()
) -> Classes:
    """Classes of the candidates in `order` (of `group_leaders`); each weak one is its own.

    alike : columns that fits to simulated data do not tell from the first. What gained more than
    the first one and was passed over for it only describes a misfit (`preferred`): it is no rival,
    and not in its class.
    """
    refitted = {r.index[0]: max(r.score, 0.0) for r in refits if len(r.index) == 1}
    at = np.array(order, dtype=int)
    rho, sided = screen.efficient.rho[np.ix_(at, at)], screen.efficient.sided[at]
    gains = np.array([refitted.get(int(k), screen.efficient.gain[k]) for k in at])
    kind = np.array([screen.design.candidates[k].effect.cause for k in at])
    strong = np.array(
        [int(k) in refitted or screen.efficient.gain[k] >= SEPARATING for k in at], bool
    )
    class_id, leader = np.zeros(len(at), int), np.arange(len(at))
    if refitted:
        first = _of_the_best(rho, gains, sided, len(refitted), strong, kind)
        first |= np.array([k in alike for k in order], dtype=bool)
        class_id[first], leader[first] = 1, 0
    rest = np.flatnonzero(strong & (class_id == 0))
    if len(rest):
        found = classes_by_similarity(rho[np.ix_(rest, rest)], gains[rest], sided[rest])
        class_id[rest] = found.class_id + class_id.max()
        leader[rest] = rest[found.leader]
    weak = np.flatnonzero(class_id == 0)
    class_id[weak] = class_id.max(initial=0) + 1 + np.arange(len(weak))
    return Classes(class_id, leader, rho[leader, np.arange(len(at))])


def _of_the_best(
    rho: np.ndarray, gains: np.ndarray, sided: np.ndarray, refitted: int, strong: np.ndarray,
    kind: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(K,) bool: the confidence set among the refitted, who come first, and who is like the best
    among those that were not."""
    own = np.flatnonzero(gains[:refitted] <= gains[0] + TIE)
    cut = cuts(rho[np.ix_(own, own)], gains[own], range(len(own)), sided=sided[own])
    cut = np.maximum(cut, np.where(kind[own] == kind[0], FORM * gains[0], 0.0))
    out = np.zeros(len(gains), bool)
    out[own] = confidence_set(gains[own], cut)
    alike = ~distinguishable(gains[0], similarity(rho, sided)[0]) & strong
    out[refitted:] = alike[refitted:]
    return out
