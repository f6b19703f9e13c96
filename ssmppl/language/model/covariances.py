"""What the covariance of a traced MvNormal is made of: independent components, or too few noises.

One with zeros off its diagonal is a Normal distribution of each component, and is taken as such.
One with rows of zeros, as of a companion form, is taken apart (`by_noise`): components with noise,
of a covariance of their own, and those that follow without any.
One whose rank is less than its size (q G G', one noise that drives several states) has no density;
draws need a root of it, found by the Cholesky recursion in the given order, whose pivots of zero
leave columns of zeros (Higham 2002, "Accuracy and stability of numerical algorithms", section
10.3). A pivot that is zero in some cases only leaves zeros there. What was found is held against
the matrix over a wide range, as one that is singular at moderate values may have another noise
beyond.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, constant
from ssmppl.expressions.properties import may_vanish_by_data
from ssmppl.expressions.test_points import PLAIN, TestPoints, moderate, numbers_at, wide, with_cases
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.distributions.continuous import Normal
from ssmppl.language.distributions.discrete import Dirac
from ssmppl.language.distributions.multivariate import MvNormal, singular_numbers
from ssmppl.language.model.trace import Site, Trace

ZERO = 1e-10  # of the variances: what is zero in floating point
AGREE = 1e-8  # of the variances: what a root may differ by
LARGEST = 12  # components; the root of more is not written out in symbols


def independent(law: Distribution) -> Distribution:
    """A Normal distribution of each component in place of an MvNormal one with zeros off its
    diagonal."""
    if not isinstance(law, MvNormal):
        return law
    matrix = law.parameters[law.spread].view(np.ndarray)
    zero = constant(0.0)
    if any((matrix[i, j] is zero) == (i == j) for i, j in np.ndindex(matrix.shape)):
        return law
    name = {"covariance": "variance", "precision": "precision", "cholesky": "sd"}[law.spread]
    spread: dict[str, ExprArray] = {name: array(np.diagonal(matrix))}
    normal = Normal(law.mean_, **spread)  # type: ignore[arg-type]
    normal.location, normal.approximation = law.location, law.approximation
    return normal


def noiseless(law: Distribution) -> tuple[int, ...]:
    """The components of an MvNormal distribution whose variance is zero whatever the values of its
    symbols are."""
    if not isinstance(law, MvNormal) or law.spread != "covariance":
        return ()
    matrix, zero = law.parameters["covariance"].view(np.ndarray), constant(0.0)
    return tuple(i for i, row in enumerate(matrix) if all(e is zero for e in row))


def without_density(law: Distribution) -> MvNormal | None:
    """The MvNormal distribution, this one or one inside of it, whose covariance is singular
    whatever the values of its symbols are; None where there is none."""
    for inner in law.inside():
        if (found := without_density(inner)) is not None:
            return found
    if not isinstance(law, MvNormal) or law.spread != "covariance":
        return None
    return law if noiseless(law) or singular_numbers(law.parameters["covariance"]) else None


def by_noise(site: Site) -> list[Site]:
    """A site of states taken apart into what has noise and what has none; itself where there is
    nothing to part.

    The density of the whole is that of the components with noise: the others follow.
    """
    law, fixed = site.distribution, noiseless(site.distribution)
    if not fixed:
        return [site]
    assert isinstance(law, MvNormal)
    noisy = [i for i in range(len(law.mean_)) if i not in fixed]
    out = []
    for index in (noisy, list(fixed)):
        if not index:
            continue
        own: Distribution = Dirac(array(law.mean_[index]))
        if index is noisy:
            matrix = law.parameters["covariance"].view(np.ndarray)[np.ix_(noisy, noisy)]
            own = independent(_placed(MvNormal(law.mean_[noisy], covariance=array(matrix)), law))
            find_root(own)
        name = f"{site.name}[{_indexes(index)}]" if len(fixed) < len(law.mean_) else site.name
        value = array(site.value[index])
        out.append(Site(name, site.role, _placed(own, law), value, site.where))
    return out


def together(trace: Trace) -> Trace:
    """The trace with every state under one distribution, as it was declared: `by_noise` undone."""
    initial, transition = _whole(trace.initial), _whole(trace.transition)
    if initial is trace.initial and transition is trace.transition:
        return trace
    return replace(trace, initial=initial, transition=transition)


def _whole(sites: dict[str, Site]) -> dict[str, Site]:
    """The sites of one role, each quantity in one."""
    groups: dict[str, list[Site]] = {}
    for site in sites.values():
        groups.setdefault(site.quantity, []).append(site)
    if len(groups) == len(sites):
        return sites
    return {name: own[0] if len(own) == 1 else _joined(name, own) for name, own in groups.items()}


def _joined(name: str, sites: list[Site]) -> Site:
    n, first = sum(len(s.value) for s in sites), sites[0]
    zero = constant(0.0)
    mean, matrix = np.full(n, zero, dtype=object), np.full((n, n), zero, dtype=object)
    value = np.empty(n, dtype=object)
    for site in sites:
        law = site.distribution
        at = [s.data[2][0] for s in site.value]
        value[at], mean[at] = list(site.value), list(array(law.mean()))
        if isinstance(law, MvNormal):
            matrix[np.ix_(at, at)] = law.covariance_matrix().view(np.ndarray)
        elif isinstance(law, Normal):
            matrix[at, at] = list(array(law.variance_in_range()))
    law = _placed(MvNormal(array(mean), covariance=array(matrix)), first.distribution)
    find_root(law)
    return Site(name, first.role, law, array(value), first.where)


def _placed(law: Distribution, like: Distribution) -> Distribution:
    law.location, law.approximation = like.location, like.approximation
    return law


def _indexes(index: list[int]) -> str:
    """Of a vector, as NumPy takes them."""
    if len(index) == 1:
        return str(index[0])
    if index == list(range(index[0], index[-1] + 1)):
        return f"{index[0]}:{index[-1] + 1}"
    return str(index)


def find_root(law: Distribution) -> None:
    """Give an MvNormal distribution of singular covariance its root."""
    if not isinstance(law, MvNormal) or law.spread != "covariance":
        return
    matrix = law.parameters["covariance"]
    if len(matrix) <= LARGEST:
        law.root = _singular_root(matrix)


def _singular_root(matrix: ExprArray) -> ExprArray | None:
    """Lower triangular L, (d, d), with L L' = the matrix wherever it is a covariance; None where
    its rank is full at moderate values of its symbols, or no such L was found."""
    entries = with_cases(matrix.ravel())
    points = moderate(entries)
    values, scale, valid = _covariances(entries, points)
    plain = values[:PLAIN][valid[:PLAIN]]
    if not len(plain) or np.linalg.matrix_rank(plain, hermitian=True).max() == len(matrix):
        return None
    n, zero = len(matrix), constant(0.0)
    left = np.array(matrix.view(np.ndarray), dtype=object)
    root = np.full((n, n), zero, dtype=object)
    for k in range(n):
        column = numbers_at(with_cases(left[k:, k]), points)[valid]
        small = np.abs(column) <= ZERO * (scale[:, k:] * scale[:, k, None])[valid]  # (points, rows)
        gone = small[:, 0]
        if not small[gone].all() or np.any(column[~gone, 0] < 0.0):
            return None
        if gone.all():
            continue
        pivot = ew("sqrt", left[k, k])
        for i in range(k, n):
            if not small[:, i - k].all():
                own = pivot if i == k else left[i, k] / pivot
                if gone.any() or may_vanish_by_data([left[k, k]]):
                    # a noise that is there in some cases, or in some rows of the data only
                    own = ew("where", ew("lt", ZERO * matrix[k, k], left[k, k]), own, 0.0)
                root[i, k] = own
        for i in range(k + 1, n):
            for j in range(k + 1, n):
                left[i, j] = left[i, j] - root[i, k] * root[j, k]
    return array(root) if _is_root(array(root), matrix) else None


def _is_root(root: ExprArray, matrix: ExprArray) -> bool:
    """Whether L L' = the matrix at wide points, and in all cases of the conditions in it.

    Points where rounding leaves L without a number are no witness.
    """
    n = len(matrix)
    entries = with_cases(matrix.ravel())
    forms = with_cases([*matrix.ravel(), *root.ravel()])
    points = wide(entries)
    values, scale, valid = _covariances(entries, points)
    found = numbers_at(forms[n * n :], points).reshape(-1, n, n)
    with np.errstate(all="ignore"):
        apart = np.abs(found @ found.transpose(0, 2, 1) - values)
        differs = apart > AGREE * scale[:, :, None] * scale[:, None, :]
    return not np.any(differs[valid])


def _covariances(
    entries: list[Expr], points: TestPoints
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The matrix at each point, (P, d, d), the roots of its diagonal, (P, d), and whether it is a
    covariance there, (P,)."""
    n = math.isqrt(len(entries))
    values = numbers_at(entries, points).reshape(-1, n, n)
    valid = np.isfinite(values).all(axis=(1, 2))
    values = np.where(valid[:, None, None], values, 0.0)
    diagonal = np.diagonal(values, axis1=1, axis2=2)
    scale = np.sqrt(np.abs(diagonal))
    unit = np.where(scale > 0.0, scale, 1.0)
    least = np.linalg.eigvalsh(values / unit[:, :, None] / unit[:, None, :])[:, 0]
    return values, scale, valid & (diagonal >= 0.0).all(axis=1) & (least >= -AGREE)
