"""One Gibbs update of a block of parameters, as data, and where its components may lie."""

from __future__ import annotations

from dataclasses import dataclass, field

from ssmppl.analysis.bounds import WHOLE, Interval, interval
from ssmppl.analysis.conjugacy.describe import Explanation
from ssmppl.analysis.conjugacy.family import Family
from ssmppl.analysis.conjugacy.separation import JointTerm
from ssmppl.errors import Location
from ssmppl.expressions.expr import Expr


@dataclass(frozen=True, eq=False)
class Update:
    """One Gibbs update: a block of parameter components and how it is drawn given all else.

    block : names of the parameters; components : the symbols that are drawn, in this order.
    family_name : "Normal-Gamma", "Gamma", ..., or "slice".
    family : its formulas; None of a slice step.
    functions : the s_i of log p(block | rest) = const + sum_i C_i s_i.
    coefficients : role -> summands of the C_i: C = prior + initial + sum_t transition
        + sum_t observation. The initial ones are summed over experiments.
    outside_family : positions of the functions outside the family's span.
    bounds : (lower, upper) of each component, expressions of other parameters.
    needs_log_joint : not separable, so each evaluation takes the whole log joint density; where a
        deterministic state depends on the block, that of the noisy states and the observations.
    inseparable_terms : those of the prior or the initial distribution that the statistics do not
        hold; the log joint density corrects for them.
    reason, where : why nothing better applies, and the user's line.
    """

    block: tuple[str, ...]
    components: tuple[Expr, ...]
    family_name: str
    functions: tuple[Expr, ...]
    coefficients: dict[str, tuple[Expr, ...]]
    outside_family: tuple[int, ...]
    bounds: tuple[tuple[Expr, Expr], ...]
    explanation: Explanation
    reason: str = ""
    where: Location | None = None
    needs_log_joint: bool = False
    inseparable_terms: tuple[JointTerm, ...] = ()
    kind: str = "real"  # or "simplex", "matrix", "correlation"
    family: Family | None = field(default=None, repr=False)


def natural_bounds(update: Update) -> list[Interval]:
    """Where the family itself lives, component by component."""
    family = update.family
    return [WHOLE] * len(update.components) if family is None else family.support


def update_bounds(update: Update) -> list[Interval | None]:
    """The bounds of each component that are numbers; None where one depends on a parameter."""
    return [
        (low.data, high.data) if low.op == high.op == "const" else None
        for low, high in update.bounds
    ]


def correction_ranges(update: Update) -> list[Interval]:
    """An enclosure of each function that the family does not hold, over the bounds."""
    bounds = zip(update.components, update_bounds(update), strict=True)
    known = {c: WHOLE if b is None else b for c, b in bounds}
    return [interval(update.functions[j], known) for j in update.outside_family]
