"""The nearest formula of a missing term: a few simple terms in place of curves.

A curve over one variable does not say what it is. Terms that are written in models of physics (a
variable, its square and cube, its size, drag, a root, a sine, and products of two of these) are
written in the basis of the curves, a few of them are chosen one after the other, and their
coefficients estimated together from the same efficient scores: with scores S~ of covariance V of
the basis and coordinates A of the terms, (A' V A)^-1 A' S~, which gains A' S~ times half of that. A
further term has to gain more than the Bayesian information criterion asks and the logarithm of the
number of terms among which it was chosen, and more than the curves' own error in writing a term. It
is a sparse regression of what is missing, in the
manner of Brunton, Proctor and Kutz (*PNAS* 113, 2016), and a suggestion: another formula may be as
near, and what the model's own parameters absorb is left out of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.model.basis import CURVES, BasisTerm
from ssmppl.diagnosis.model.scales import LEVELS, VariableScale
from ssmppl.diagnosis.screening.location import BasisGroupScore
from ssmppl.diagnosis.screening.screen import Screen

Function = Callable[[np.ndarray], np.ndarray]

# By how they are written, the simplest first; a root needs values that are nowhere below zero.
FUNCTIONS: dict[str, Function] = {
    "{}": lambda x: x, "{}**2": lambda x: x**2, "np.abs({})": np.abs,
    "{0}*np.abs({0})": lambda x: x * np.abs(x), "{}**3": lambda x: x**3, "np.sqrt({})": np.sqrt,
    "np.sin({})": np.sin,
}  # fmt: skip
FACTORS = ("{}", "{}**2", "np.abs({})", "np.sin({})")  # of products
MOST = 3  # terms
WORTH = 0.05  # of what the curves gain: a term has to gain as much beside those before it, and one
# that gains less than so much more than a simpler one is not taken for it
WRITTEN = 0.8  # of a function's variance, that the curves have to write
LEFT = 0.02  # of a term's information, that the model's parameters have to leave


@dataclass(frozen=True)
class NearestFormula:
    """Terms of a missing increment of an equation's mean, as they would be written.

    coefficients, errors : of each, in units of the equation a row. share : of what the curves gain,
    in nats.
    """

    equation: str
    terms: tuple[str, ...]
    coefficients: tuple[float, ...]
    errors: tuple[float, ...]
    share: float


def nearest_formula(
    screen: Screen, place: tuple[str, str], others: Sequence[Candidate]
) -> NearestFormula | None:
    """The nearest formula of what is missing at a place (equation, "mean"); None where no term
    gains enough.

    others : candidates that are projected out.
    """
    terms = screen.design.terms
    own = [i for i, t in enumerate(terms) if (t.equation, t.moment) == place and t.factors]
    if not own:
        return None
    group = screen.basis_group(own, others)
    offered = written([terms[i] for i in own], screen.design.scales.scale)
    raw = screen.simulated.basis[:, own]
    rows = sum(e.steps for e in screen.experiments)
    return chosen(place[0], offered, group, raw.T @ raw / len(raw), rows)


def chosen(
    equation: str, offered: Mapping[str, np.ndarray], group: BasisGroupScore, whole: np.ndarray,
    rows: int,
) -> NearestFormula | None:  # fmt: skip
    """The terms, one after the other.

    offered : coordinates (D,) of each term. whole : (D, D) information with nothing projected out.
    """
    score, v = group.score, group.covariance
    known = {
        text: a for text, a in offered.items() if a @ v @ a > LEFT * (a @ whole @ a) > 0.0
    }  # fmt: skip
    total = 0.5 * (float(score @ group.inverse @ score) - group.rank)
    price = 0.5 * np.log(max(rows, 2)) + np.log(max(len(known), 1))
    price = max(price, WORTH * total)
    taken: list[str] = []
    gained = 0.0
    while known and len(taken) < MOST:
        gains = {t: _gain([known[k] for k in (*taken, t)], score, v) for t in known}
        most = max(gains.values())
        if not most - gained > price:
            break
        best = next(t for t in known if gains[t] >= most - WORTH * (most - gained))
        taken, gained = [*taken, best], gains[best]
    if not taken:
        return None
    a = np.array([known[t] for t in taken]).T
    inverse = np.linalg.pinv(a.T @ v @ a)
    return NearestFormula(
        equation, tuple(taken), tuple((inverse @ (a.T @ score)).tolist()),
        tuple(np.sqrt(np.diagonal(inverse)).tolist()), gained / max(total, gained),
    )  # fmt: skip


def _gain(columns: Sequence[np.ndarray], score: np.ndarray, v: np.ndarray) -> float:
    """Nats that these terms gain together; terms that say the same count once."""
    a = np.array(columns).T
    along, information = a.T @ score, a.T @ v @ a
    size = np.sqrt(np.diagonal(information))
    inverse = np.linalg.pinv(information / np.outer(size, size), rcond=1e-3, hermitian=True)
    return 0.5 * float((along / size) @ inverse @ (along / size))


def written(
    basis: Sequence[BasisTerm], scales: Mapping[str, VariableScale]
) -> dict[str, np.ndarray]:
    """Coordinates (D,) in these functions of each term that they can write."""
    place = {frozenset(t.factors): i for i, t in enumerate(basis)}
    variables = list(dict.fromkeys(v for t in basis for v, _ in t.factors))
    out: dict[str, np.ndarray] = {}
    single = {v: _of_one(scales[v]) for v in variables}
    for v in variables:
        for text, c in single[v].items():
            a = np.zeros(len(basis))
            for k, value in enumerate(c[1:], 1):
                if frozenset([(v, k)]) in place:
                    a[place[frozenset([(v, k)])]] = value
            out[text.format(v)] = a
    for v, w in combinations(variables, 2):
        for first in FACTORS:
            for second in FACTORS:
                if first not in single[v] or second not in single[w]:
                    continue
                a = np.zeros(len(basis))
                for i, x in enumerate(single[v][first]):
                    for j, y in enumerate(single[w][second]):
                        factors = frozenset((name, k) for name, k in ((v, i), (w, j)) if k)
                        if factors in place:
                            a[place[factors]] += x * y
                out[f"{first.format(v)}*{second.format(w)}"] = a
    return {text: a for text, a in out.items() if np.any(a)}


def _of_one(scale: VariableScale) -> dict[str, np.ndarray]:
    """Coefficients of 1 and of `CURVES` by which each function is written, where they write it."""
    x = np.array(scale.quantiles)
    weights = np.sqrt(np.gradient(np.array(LEVELS)))
    z = (x - scale.mean) / scale.sd
    design = np.stack([np.ones_like(z), *(np.broadcast_to(c(z), z.shape) for c in CURVES)], axis=1)
    out = {}
    for text, function in FUNCTIONS.items():
        if "sqrt" in text and x[0] < 0.0:
            continue
        y = function(x)
        found = np.linalg.lstsq(design * weights[:, None], y * weights, rcond=None)[0]
        left = weights * (y - design @ found)
        middle = np.average(y, weights=weights**2)
        spread = float(np.sum((weights * (y - middle)) ** 2))
        if spread > 0.0 and float(left @ left) < (1.0 - WRITTEN) * spread:
            out[text] = found
    return out
