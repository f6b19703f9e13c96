"""Which argument of a distribution left its range and what to write so that it cannot; which
distribution has no density at some parameters; and sums of log densities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from ssmppl.errors import Location
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbols_of, topological
from ssmppl.language.distributions import Dirac, Distribution, Truncated
from ssmppl.language.distributions.multivariate import Centred
from ssmppl.language.distributions.nested import SUM_ROUNDING
from ssmppl.language.model.trace import Trace

_SHARES = (
    "that are shares of 1 whatever the state, such as [1 - p, p] with "
    "p = 1 / (1 + np.exp(-z)), or w / np.sum(w) of positive w"
)
WHOLE = ("floor", "ceil")  # of which numbers of trials may be made
DOMAIN = "some parameter, state or input leads outside the domain of an operation"


def out_of_range(law: Distribution, values: Mapping[Expr, float]) -> tuple[str, str] | None:
    """What was found, and the fix; None where no argument that has a range can be at fault.

    values : of the symbols, as far as they are known. An argument whose value they tell is named
        with it, where it lies outside; else the arguments that might are named with their ranges.
    """
    might: list[tuple[str, str]] = []
    for inner in _laws_in(law):
        found = _of_one(inner, values, might)
        if found is not None:
            return found
    return might[0] if might else None


def law_without_density_at(trace: Trace, theta: np.ndarray) -> tuple[str, str, Location] | None:
    """Which distribution has no density at theta (P,) whatever the states are, a spread being none
    there: what was found, the fix, and the user's line. None where every distribution has one, as
    far as the parameters alone tell.
    """
    known = dict(zip(trace.parameter_symbols, theta.tolist(), strict=True))
    for sites in (trace.observations, trace.transition, trace.initial):
        for name, site in sites.items():
            for law in _laws_in(site.distribution):
                found = _of_one(law, known, []) or _covariance(law, known)
                if found is not None:
                    return (
                        f"{found[0]}, in the distribution of {name}",
                        found[1],
                        site.distribution.location,
                    )
    return None


def trials_of_a_continuous_state(trace: Trace) -> tuple[str, str, Location] | None:
    """Which observation counts out of a number that no particle has as a whole one: what was found,
    the fix, and the user's line. None where every such number may be whole."""
    drawn = {
        s for site in trace.transition.values()
        if not site.distribution.discrete and not isinstance(site.distribution, Dirac)
        for s in site.components
    }  # fmt: skip
    for site in trace.observations.values():
        for law in _laws_in(site.distribution):
            for e in law.parameters[law.trials].ravel() if law.trials else ():
                inside = topological([e])
                if drawn.isdisjoint(inside) or any(n.op in WHOLE for n in inside):
                    continue
                found = (
                    f"the {law.trials} of {type(law).__name__}, {e!r}, is no whole number, as it "
                    "depends on a state of a continuous distribution"
                )
                return found, _fix(law, law.trials, e, 0.0, np.inf), law.location
    return None


def _covariance(law: Distribution, values: Mapping[Expr, float]) -> tuple[str, str] | None:
    """A covariance, or the inverse of one, that is not positive definite at these values."""
    if not isinstance(law, Centred) or law.spread == "cholesky" or law.root is not None:
        return None
    entries = list(law.parameters[law.spread].ravel())
    if not symbols_of(entries) <= set(values):
        return None
    n = len(law.parameters[law.spread])
    with np.errstate(all="ignore"):
        matrix = np.array(evaluate(entries, values), dtype=float).reshape(n, n)
    try:
        if np.all(np.isfinite(matrix)) and np.all(np.diag(np.linalg.cholesky(matrix)) > 0.0):
            return None
    except np.linalg.LinAlgError:
        pass
    rows = "; ".join(", ".join(f"{x:.6g}" for x in row) for row in matrix)
    return (
        f"the {law.spread} of {type(law).__name__}, [{rows}], is not positive definite there",
        "give its parameters priors that keep variances off zero and correlations off -1 and 1, as "
        "ssm.InverseGamma does, or ssm.InverseWishart for the whole matrix, or ssm.LKJ for the "
        "correlations",
    )


def _laws_in(law: Distribution) -> list[Distribution]:
    """The distribution, and those that it is made of: of a truncated one the base alone."""
    base = getattr(law, "base", None)
    inside = [*getattr(law, "components", ()), *([] if base is None else [base])]
    own = [] if isinstance(law, Truncated) else [law]
    return own + [one for part in inside for one in _laws_in(part)]


def _of_one(
    law: Distribution, values: Mapping[Expr, float], might: list[tuple[str, str]]
) -> tuple[str, str] | None:
    """As `out_of_range`, without the distributions inside; `might` gets what may be at fault."""
    name = type(law).__name__
    for argument, (low, high, strict) in law.ranges.items():
        called = re.sub(r"^weight_(\d+)$", r"weights[\1]", argument.rstrip("_"))
        brackets = "()" if strict else "[]"
        allowed = f"{brackets[0]}{low:g}, {high:g}{brackets[1] if np.isfinite(high) else ')'}"
        for e in law.parameters[argument].ravel():
            needed = symbols_of(e)
            if not needed:
                continue
            fix = _fix(law, called, e, low, high)
            if needed <= set(values):
                value = float(evaluate(e, values))
                if np.isnan(value):
                    return f"the {called} of {name}, {e!r}, is nan there", DOMAIN
                if not (low < value < high if strict else low <= value <= high):
                    found = (
                        f"the {called} of {name}, {e!r}, is {value:.6g} there, outside {allowed}"
                    )
                    return found, fix
                if argument == law.trials and not value.is_integer():
                    found = f"the {called} of {name}, {e!r}, is {value:.6g} there, no whole number"
                    return found, fix
            else:
                place = "be a whole number" if argument == law.trials else f"lie in {allowed}"
                demand = f"the {called} of {name}, {e!r}, has to {place}"
                might.append((demand, f"if it leaves that range, {fix}; if not, {DOMAIN}"))
    return _sums(law, values)


def _sums(law: Distribution, values: Mapping[Expr, float]) -> tuple[str, str] | None:
    """Shares that do not sum to 1, where their symbols have values."""
    called, own = law.shares() or ("", [])
    for index in np.ndindex(array(own[0]).shape if own else ()):
        shares = [array(share)[index] for share in own]
        if symbols_of(shares) and symbols_of(shares) <= set(values):
            total = float(np.sum(evaluate(shares, values)))
            if not abs(total - 1.0) <= SUM_ROUNDING:
                text = ", ".join(map(repr, shares))
                found = f"the {called} of {type(law).__name__}, [{text}], sum to {total:.6g} there"
                return found, f"write {called} {_SHARES}"
    return None


def _fix(law: Distribution, called: str, e: Expr, low: float, high: float) -> str:
    """A function that maps all numbers into the range."""
    if called == law.trials:
        return (
            f"write {called} whole and never below 0, np.maximum(np.floor({e!r} + 0.5), 0); "
            "where several flows empty one compartment, draw each out of what the others have "
            "left, or all at once by ssm.EulerMultinomial"
        )
    shares = law.shares()
    if shares is not None:
        return f"write {shares[0]} {_SHARES}"
    if (low, high) == (0.0, 1.0):
        logistic = f"1 / (1 + np.exp(-({e!r})))"
        return f"write a {called} between 0 and 1 whatever the state, such as {logistic}"
    if low == 0.0 and high == np.inf:
        return f"write a {called} that is positive whatever the state, such as np.exp({e!r})"
    return f"keep the {called} inside by np.clip or np.maximum"


def total_of(increments: np.ndarray) -> float:
    """The log density of all rows; -inf where it is below what floating point holds."""
    with np.errstate(over="ignore"):
        return float(np.sum(increments))
