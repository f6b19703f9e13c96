"""Gibbs updates of the parameters given states and data, derived from the log density alone.

`derive_updates` looks for the largest blocks with a closed-form conditional (`search.py`), by the
table of families (`families.py`). What lies outside a family's span, if it comes from the prior or
the initial distribution only (a bounded number of terms, however long the series), becomes a
correction of the draw; if it grows with the series, the block is sampled by slices on its exact
conditional. Every update is compared with the model's own density when it is derived
(`numerical_check.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial

from ssmppl.analysis.conjugacy import describe
from ssmppl.analysis.conjugacy.describe import Explanation, MatrixWording, Wording, joined, named
from ssmppl.analysis.conjugacy.family import Family
from ssmppl.analysis.conjugacy.numerical_check import Attempts, verify
from ssmppl.analysis.conjugacy.search import Found, Search, block_kind
from ssmppl.analysis.conjugacy.separation import (
    BOUNDED_ROLES,
    NOTHING_MISSING,
    ROLES,
    BlockForm,
    complete_data,
    degenerate,
    separate_block,
)
from ssmppl.analysis.conjugacy.update import Update, correction_ranges, natural_bounds
from ssmppl.analysis.density import Missing
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, to_text
from ssmppl.language.model.trace import Trace


def derive_updates(
    trace: Trace,
    fixed: Iterable[str] = (),
    missing: Missing = NOTHING_MISSING,
    check: bool = True,
) -> list[Update]:
    """The updates that together move every parameter that is not fixed, in the order declared.

    check=False leaves out the comparison with the model's own density.
    """
    data = complete_data(trace, missing)
    search = Search(data, frozenset(fixed))
    updates: list[Update] = []
    attempts = Attempts(data)
    waiting = [(unit, found, False) for unit, found in search.found()]
    while waiting:
        unit, found, refused = waiting.pop(0)
        update = _update(search, unit, found, refused)
        failure = verify(data, update, attempts) if check and update.functions else None
        if failure is None:
            updates.append(update)
        elif unit in search.single:
            waiting.append((unit, failure, True))
        else:  # a joint block is taken apart
            waiting += [
                (u, f, False) for u, f in search.single.items() if not set(u).isdisjoint(unit)
            ]
    order = {s: i for i, s in enumerate(trace.parameter_symbols)}
    return sorted(updates, key=lambda u: min(order[c] for c in u.components))


def _update(
    search: Search, unit: tuple[Expr, ...], found: Found | NotApplicable, refused: bool
) -> Update:
    if isinstance(found, Found):
        return conjugate_update(search, found)
    return _slice(search, unit, found, use_statistics=not refused)


def conjugate_update(search: Search, found: Found) -> Update:
    """A finding as an update, explained."""
    form, family = found.form, found.family
    site = search.site(found.components[0])
    where, reason = site.distribution.location, ""
    if found.outside_family:
        sources = [f for j in found.outside_family for f in form.origins[form.monomials[j]]]
        laws = sorted({f"{f.role} distribution of {f.site}" for f in sources})
        left = ", ".join(to_text(form.functions[j]) for j in found.outside_family)
        where = sources[0].where
        reason = (
            f"the {' and the '.join(laws)} {'is' if len(laws) == 1 else 'are'} not conjugate "
            f"(outside the {family.name} family: {left})"
        )
    if form.inseparable:
        where, reason = form.inseparable[0][1].where or where, form.inseparable[0][1].reason
    update = Update(
        block=tuple(dict.fromkeys(c.data[1] for c in found.components)),
        components=found.components,
        family_name=family.name,
        functions=form.functions,
        coefficients=form.coefficients,
        outside_family=found.outside_family,
        bounds=tuple(search.bound[c] for c in found.components),
        explanation=Explanation(joined(found.components), ""),
        reason=reason,
        where=where,
        kind=block_kind(site),
        family=family,
        inseparable_terms=tuple(term for term, _ in form.inseparable),
    )
    hyperparameters = search.unread(found.components)
    if hyperparameters is not None and not found.outside_family and not form.inseparable:
        explanation = describe.prior_alone(
            found.components, hyperparameters, "from which it is drawn"
        )
        return replace(update, explanation=explanation)
    title = name = joined(found.components)
    lines = None
    if family.as_matrices:
        title = name = named(found.components, search.data.trace)
        lines = family.matrix_statistics(MatrixWording(form, search.data.trace))
    if len(update.block) > 1:
        title += " jointly"
    explanation = Explanation(
        title,
        family.law(Wording(form, name)),
        describe.statistics(form) if lines is None else lines,
        tuple(_notes(update, family, form)),
    )
    return replace(update, explanation=explanation)


def _notes(update: Update, family: Family, form: BlockForm) -> list[str]:
    """Truncation, what is done where the family is improper, and correction."""
    notes = []
    cut = [
        f"{to_text(c)} to ({to_text(low)}, {to_text(high)})"
        for c, (low, high), natural in zip(
            update.components, update.bounds, natural_bounds(update), strict=True
        )
        if update.kind == "real"
        and not (low.op == high.op == "const" and low.data <= natural[0] <= natural[1] <= high.data)
    ]
    if cut:
        notes.append(f"truncated: {', '.join(cut)}")
    improper = family.when_improper(partial(_known, update))
    if improper:
        notes.append(improper)
    if update.inseparable_terms:
        laws = " and the ".join(
            dict.fromkeys(f"{f.role} distribution of {f.site}" for f in update.inseparable_terms)
        )
        notes.append(
            f"Metropolis-Hastings with the {update.family_name} distribution, which omits the "
            f"{laws}, as independence proposal, followed by univariate slice sampling: "
            f"{update.reason}"
        )
        if update.where is not None:
            notes.append(update.where.short)
    elif update.outside_family:
        text = describe.correction_text(form, update.outside_family)
        if _may_be_bounded(update):
            notes.append(
                f"rejection sampling from the {update.family_name} distribution with acceptance "
                f"probability proportional to {text}: {update.reason}"
            )
        else:
            notes.append(
                f"Metropolis-Hastings with the {update.family_name} distribution as independence "
                f"proposal (density ratio {text} not known to be bounded), followed by univariate "
                f"slice sampling: {update.reason}"
            )
        if update.where is not None:
            notes.append(update.where.short)
    return notes


def _known(update: Update, i: int) -> float | None:
    """The statistic at a position that prior and initial distribution alone give, if it is a
    number."""
    parts = [update.coefficients[r][i] for r in BOUNDED_ROLES] if i >= 0 else []
    return math.fsum(e.data for e in parts) if all(e.op == "const" for e in parts) else None


def _may_be_bounded(update: Update) -> bool:
    """Whether the correction has a known bound, for whatever sign its coefficients can have."""
    for (low, high), j in zip(correction_ranges(update), update.outside_family, strict=True):
        total = _known(update, j)
        if (total is None or total > 0.0) and high == math.inf:
            return False
        if (total is None or total < 0.0) and low == -math.inf:
            return False
    return True


def _slice(
    search: Search, unit: tuple[Expr, ...], why: NotApplicable, use_statistics: bool
) -> Update:
    """Slice steps on the exact conditional; through the statistics where it separates."""
    kind = block_kind(search.site(unit[0]))
    separated = separate_block(search.data, unit) if use_statistics else why
    form = separated if isinstance(separated, BlockForm) else None
    how = {
        "real": "slice sampling of the full conditional",
        "simplex": "slice sampling of the full conditional of its log ratios",
        "matrix": "slice sampling of the full conditional of its Cholesky factor (log diagonal)",
        "correlation": "slice sampling of the full conditional of its partial correlations (atanh)",
    }[kind]
    cost = "each density evaluation costs one pass over the data"
    law = f"{how}, evaluated from sufficient statistics" if form else f"{how}; {cost}"
    if degenerate(search.data, unit) is not None:
        law = f"{how}, given the noisy states only; deterministic states are recomputed"
    notes = (f"because {why.reason}", *([why.where.short] if why.where else []))
    explanation = Explanation(joined(unit), law, describe.statistics(form) if form else (), notes)
    hyperparameters = search.unread(unit)
    if hyperparameters is not None:
        explanation = describe.prior_alone(unit, hyperparameters, f"updated by {how}")
    return Update(
        block=(unit[0].data[1],),
        components=unit,
        family_name="slice",
        functions=form.functions if form else (),
        coefficients=form.coefficients if form else dict.fromkeys(ROLES, ()),
        outside_family=(),
        bounds=tuple(search.bound[c] for c in unit),
        explanation=explanation,
        reason=why.reason,
        where=why.where,
        needs_log_joint=form is None,
        kind=kind,
    )
