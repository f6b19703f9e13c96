"""Which parameters can be integrated out of conditional SMC: what `elimination.py` goes by.

Only what is exact: a family that holds every term of the block, the initial distribution included,
and no truncation. Blocks are eliminated together if no term of the density holds two of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from ssmppl.analysis.conjugacy.derive import conjugate_update
from ssmppl.analysis.conjugacy.describe import joined
from ssmppl.analysis.conjugacy.families import Gamma, NormalGamma
from ssmppl.analysis.conjugacy.family import Family
from ssmppl.analysis.conjugacy.numerical_check import verify
from ssmppl.analysis.conjugacy.search import Found, Search
from ssmppl.analysis.conjugacy.separation import (
    BlockForm,
    CompleteData,
    complete_data,
    separate_block,
)
from ssmppl.analysis.conjugacy.update import Update, natural_bounds
from ssmppl.analysis.density import Missing
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.language.model.trace import Trace

LARGEST = 8  # numbers that are jointly Normal: their Cholesky factor is written out


@dataclass(frozen=True)
class Eliminable:
    """Which parameters can be integrated out.

    updates : of the blocks, with their families; a block's components are drawn from its family
    once the trajectory is known. refused : of all other free parameters, why not.
    """

    updates: tuple[Update, ...]
    refused: Mapping[Expr, NotApplicable]

    @property
    def components(self) -> tuple[Expr, ...]:
        return tuple(c for u in self.updates for c in u.components)

    @property
    def functions(self) -> int:
        """How many statistics there are, of all blocks."""
        return sum(len(u.functions) for u in self.updates)


def eliminable(
    trace: Trace, fixed: Iterable[str], missing: Missing, wanted: Iterable[str] | None = None
) -> Eliminable:
    """The blocks that can be integrated out together, of the parameters `wanted` (None: all)."""
    data = complete_data(trace, missing)
    held = set(fixed) | (set() if wanted is None else set(trace.parameters) - set(wanted))
    search = Search(data, frozenset(held))
    refused: dict[Expr, NotApplicable] = {}
    taken: list[Update] = []
    for components, found in _candidates(search):
        if any(not set(components).isdisjoint(u.components) for u in taken):
            continue
        update = _exact(data, search, found)
        if isinstance(update, Update):
            update = _apart(data, taken, update)
        if isinstance(update, NotApplicable):
            refused.update(dict.fromkeys(components, update))
        else:
            taken.append(update)
            for c in components:
                refused.pop(c, None)
    order = {s: i for i, s in enumerate(trace.parameter_symbols)}
    taken.sort(key=lambda u: order[u.components[0]])
    return Eliminable(tuple(taken), dict(sorted(refused.items(), key=lambda p: order[p[0]])))


def _candidates(search: Search) -> list[tuple[tuple[Expr, ...], Found | NotApplicable]]:
    """Normal blocks with what scales them, then precisions and variances, which mix worst given
    the states, then Normal blocks, then all that is left."""
    scaled = [(u, f) for u, f in search.found() if isinstance(_family(f), NormalGamma)]
    single = list(search.single.items())
    scales = [(u, f) for u, f in single if isinstance(_family(f), Gamma)]
    return [*scaled, *scales, *((f.components, f) for f in search.joint_normals()), *single]


def _family(found: Found | NotApplicable) -> Family | None:
    return found.family if isinstance(found, Found) else None


def _exact(
    data: CompleteData, search: Search, found: Found | NotApplicable
) -> Update | NotApplicable:
    """The block's update where its family is its whole conditional, else why it is not."""
    if isinstance(found, NotApplicable):
        return found
    update, family = conjugate_update(search, found), found.family
    name = joined(found.components)
    if update.inseparable_terms or update.outside_family:
        return NotApplicable(update.reason, update.where)
    if not family.written_out:
        return NotApplicable(
            f"a distribution of matrices, {family.name}, is not written out in scalars"
        )
    if family.normals > LARGEST:
        return NotApplicable(f"{family.normals} numbers jointly Normal, more than {LARGEST}")
    if update.kind == "real":
        for (low, high), natural in zip(update.bounds, natural_bounds(update), strict=True):
            constant_ = low.op == high.op == "const"
            if not constant_ or low.data > natural[0] or high.data < natural[1]:
                return NotApplicable(
                    f"the prior truncates {name}, and the {family.name} distribution with it",
                    search.site(found.components[0]).distribution.location,
                )
    return verify(data, update) or update


def _apart(data: CompleteData, taken: Sequence[Update], update: Update) -> Update | NotApplicable:
    """The update, if no term of the density holds it and a block that is taken already."""
    for other in taken:
        form = separate_block(data, (*other.components, *update.components))
        if not isinstance(form, BlockForm):
            return form
        for monomial in form.monomials:
            held = symbols_of([a for a, _ in monomial])
            if held & set(other.components) and held & set(update.components):
                term = form.origins[monomial][0]
                return NotApplicable(
                    f"the {term.role} distribution of {term.site} holds it together with "
                    f"{joined(other.components)}, which is eliminated, and both have no common "
                    "family",
                    term.where,
                )
    return update
