"""One Gibbs update of a block of parameters, as data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ssmppl.analysis.describe import Explanation
from ssmppl.analysis.families import Family
from ssmppl.analysis.sampler import DrawInfo, Sampler
from ssmppl.errors import Location
from ssmppl.expressions.expr import Expr


@dataclass(frozen=True)
class Update:
    """One Gibbs update: a block of parameter components and how it is drawn given all else.

    block : names of the parameters; components : the symbols that are drawn, in this order.
    family : "Normal-Gamma", "Gamma", ..., or "slice".
    functions : the s_i of log p(block | rest) = const + sum_i C_i s_i.
    coefficients : role -> summands of the C_i: C = prior + initial + sum_t transition
        + sum_t observation. The initial ones are summed over experiments.
    correction : positions of the functions outside the family's span.
    bounds : (lower, upper) of each component, expressions of other parameters.
    needs_log_joint : not separable, so each evaluation takes the whole log joint density; where a
        deterministic state depends on the block, that of the noisy states and the observations.
    reason, where : why nothing better applies, and the user's line.
    """

    block: tuple[str, ...]
    components: tuple[Expr, ...]
    family: str
    functions: tuple[Expr, ...]
    coefficients: dict[str, tuple[Expr, ...]]
    correction: tuple[int, ...]
    bounds: tuple[tuple[Expr, Expr], ...]
    explanation: Explanation
    reason: str = ""
    where: Location | None = None
    needs_log_joint: bool = False
    kind: str = "real"  # or "simplex", "matrix"
    conditional: Family | None = field(default=None, repr=False)

    @cached_property
    def sampler(self) -> Sampler:
        """Made when first needed."""
        return Sampler(self)

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "sampler"}  # made again


def draw(
    update: Update,
    totals: np.ndarray,
    current: np.ndarray,
    rest: Mapping[Expr, float],
    rng: np.random.Generator,
    log_joint: Callable[[np.ndarray], float] | None = None,
) -> tuple[np.ndarray, DrawInfo]:
    """New values of the block's components, given the statistics.

    Parameters
    ----------
    totals : the C_i, (len(functions),).
    current : values of the components.
    rest : values of the other parameters, read where bounds depend on them.
    log_joint : log joint density as a function of the components' values; needed (and used) only
        where update.needs_log_joint.
    """
    return update.sampler.draw(totals, current, rest, rng, log_joint)
