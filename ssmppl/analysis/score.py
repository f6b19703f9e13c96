"""The complete-data score: derivatives of log p(x_{1:T}, y_{1:T} | theta) in theta, symbolically.

What Fisher's and Louis' identities average over the states (Fisher 1925; Louis 1982; Schön et al.
2015, sections on direct optimisation and on the score). The density is that of the noisy components
and of the observations. A deterministic (Dirac) component follows from the noisy ones and theta, so
that its derivatives in theta are carried along by the recursion that gives its value,

    x_t = h(x_{t-1}, theta),    d x_t = dh/dtheta + dh/dx_{t-1} d x_{t-1},

and once more for second derivatives: these sensitivities are further columns of the trajectory.

The identities need a density that changes continuously with theta: a support that depends on a
parameter, or a distribution that changes by steps in it, excludes that parameter.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from textwrap import shorten

from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.structure import component_means, deterministic
from ssmppl.errors import Location, NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import differentiate, jumps
from ssmppl.expressions.expr import Expr, constant, dependent, symbol, symbols_of, topological
from ssmppl.expressions.loops.affine import scaling_of_exponentials
from ssmppl.language.model.trace import Site, Trace, previous

ROLES = ("initial", "transition", "observation")
TEXT = 120  # characters of an expression in a reason
Sensitivity = tuple[Expr, tuple[Expr, ...]]  # a component, and the parameters it is derived in


@dataclass(frozen=True)
class Sums:
    """What is summed over time, and what is set in the trajectory on the way.

    parts : role -> summands. follows : role -> (column of the trajectory, value). columns : the
    sensitivities, in the order in which they stand behind the states.
    """

    parts: dict[str, list[Expr]]
    follows: dict[str, list[tuple[Expr, Expr]]]
    columns: list[Expr] = field(default_factory=list)


class CompleteScore:
    """Derivatives of the complete-data log density in chosen parameters.

    parameters : the components (F of them) that are derived in, in the trace's order.
    inert : deterministic components whose change with the parameters does not matter, as they come
        in multiplied by what is zero.
    """

    def __init__(
        self, trace: Trace, parameters: Sequence[Expr], missing: Missing = Missing(),
        inert: Collection[Expr] = (),
    ):  # fmt: skip
        self.trace, self.parameters, self.missing = trace, list(parameters), missing
        self.inert = frozenset(inert)
        self.value: dict[str, dict[Expr, Expr]] = {}
        for role, sites in (("initial", trace.initial), ("transition", trace.transition)):
            self.value[role] = component_means(deterministic(list(sites.values())))
        self.density = {role: self._density(role) for role in ROLES}
        self.moving = self._moving()
        self._second: set[Sensitivity] = set()

    def _density(self, role: str) -> Expr:
        """The summand of one role: of its noisy components, without their supports."""
        total = constant(0.0)
        known = self.value.get(role, {})
        for t in terms(self.trace, role, self.missing, guard=False):
            if role == "observation" or t.site.value.ravel()[0] not in known:
                total = total + t.guarded()
        return total

    def _moving(self) -> set[tuple[Expr, Expr]]:
        """(deterministic component, parameter) such that the one changes with the other."""
        of: dict[Expr, set[Expr]] = {}  # the parameters each component changes with
        parameters, size = frozenset(self.parameters), -1
        while size != sum(map(len, of.values())):
            size = sum(map(len, of.values()))
            for values in self.value.values():
                for s, e in values.items():
                    if s in self.inert:
                        continue
                    inside = symbols_of(e)
                    found = of.setdefault(s, set())
                    found |= inside & parameters
                    for q in [q for q in of if previous(q) in inside]:
                        found |= of[q]
        return {(s, p) for s, found in of.items() for p in found}

    def involved(self, parameter: Expr) -> list[Expr]:
        """The symbols that change with a parameter when the noisy components do not."""
        own = self._moved_by.get(parameter, [])
        return [parameter, *own, *(previous(s) for s in own)]

    def obstacle(self, parameter: Expr, there: Trace | None = None) -> NotApplicable | None:
        """Why the identities do not hold in this parameter; None where they do.

        there : the trace with the distributions that it has where the score is taken, of which some
        terms may be gone; None: its own.
        """
        trace, symbols = there or self.trace, self.involved(parameter)
        sites = [(r, s) for r, group in (("initial", trace.initial),
                                         ("transition", trace.transition),
                                         ("observation", trace.observations))
                 for s in group.values()]  # fmt: skip
        for role, site in sites:
            if self.inert.issuperset(site.value.ravel()):
                continue
            where: Location = site.distribution.location
            if not _is_known(site, self.value.get(role, {})):
                support = site.distribution.support()
                bounds = [*array(support.lower).ravel(), *array(support.upper).ravel()]
                if any(b in dependent(bounds, symbols) for b in bounds):
                    return NotApplicable(
                        f"the support of {site.name} depends on {parameter!r}", where
                    )
            roots = [e for a in site.distribution.parameters.values() for e in array(a).ravel()]
            changing = dependent(roots, symbols)
            if not any(map(jumps, changing)):
                continue
            smooth = scaling_of_exponentials(roots)
            for node in topological(roots):  # the first of them
                if jumps(node) and node in changing and node not in smooth:
                    text = shorten(repr(node), TEXT, placeholder=" ...")
                    return NotApplicable(
                        f"the distribution of {site.name} changes by steps in {parameter!r}, by "
                        f"{text}",
                        where,
                    )
        return None

    def gradient(self) -> Sums:
        """F summands: the score.

        Raises
        ------
        NotDifferentiable : a derivative has no closed form.
        """
        return Sums(
            {r: [self._derive(d, p) for p in self.parameters] for r, d in self.density.items()},
            self._follow(self._first_values()),
            [_column(s, (p,)) for s, p in self._ordered],
        )

    def hessian(self) -> Sums:
        """F (F + 1) / 2 summands, row by row of the lower half, with their own columns.

        Raises
        ------
        NotDifferentiable : a derivative has no closed form.
        """
        first = self._first_values()
        second = self._second_values(first)
        parts: dict[str, list[Expr]] = {r: [] for r in ROLES}
        for role, density in self.density.items():
            for i, p in enumerate(self.parameters):
                slope = self._derive(density, p)
                parts[role] += [self._derive(slope, q) for q in self.parameters[: i + 1]]
        columns = [_column(s, (p,)) for s, p in self._ordered]
        columns += [_column(s, ps) for s, ps in sorted(self._second, key=repr)]
        return Sums(parts, self._follow(first | second), columns)

    @cached_property
    def _ordered(self) -> list[tuple[Expr, Expr]]:
        return sorted(self.moving, key=repr)

    @cached_property
    def _moved_by(self) -> dict[Expr, list[Expr]]:
        """Parameter -> the deterministic components that change with it, in order."""
        out: dict[Expr, list[Expr]] = {}
        for s, p in self._ordered:
            out.setdefault(p, []).append(s)
        return out

    def _derive(self, expression: Expr, parameter: Expr) -> Expr:
        """The total derivative, through what is deterministic."""
        inside = symbols_of(expression)
        total = differentiate([expression], parameter)[0]
        rates: dict[Expr, Expr] = {}
        for s in self._moved_by.get(parameter, ()):
            rates[s] = _column(s, (parameter,))
        for s, p in self._ordered if self._second else ():
            pair = tuple(sorted((p, parameter), key=repr))
            if (s, pair) in self._second:
                rates[_column(s, (p,))] = _column(s, pair)
        for s, rate in rates.items():
            for own, its in ((s, rate), (previous(s), previous(rate))):
                if own in inside:
                    total = total + differentiate([expression], own)[0] * its
        return total

    def _first_values(self) -> dict[Expr, dict[str, Expr]]:
        """column -> role -> value, for first derivatives."""
        zero = constant(0.0)
        return {
            _column(s, (p,)): {
                role: self._derive(values[s], p) if s in values else zero
                for role, values in self.value.items()
            }
            for s, p in self._ordered
        }

    def _second_values(self, first: dict[Expr, dict[str, Expr]]) -> dict[Expr, dict[str, Expr]]:
        """column -> role -> value, for those second derivatives that are not zero throughout."""
        while True:
            values = {}
            for s, p in self._ordered:
                for q in (q for q in self.parameters if (s, q) in self.moving):
                    pair = tuple(sorted((p, q), key=repr))
                    own = {r: self._derive(e, q) for r, e in first[_column(s, (p,))].items()}
                    if any(not (e.op == "const" and e.data == 0.0) for e in own.values()):
                        values[s, pair] = own
            if set(values) == self._second:
                return {_column(s, pair): own for (s, pair), own in values.items()}
            self._second = set(values)

    def _follow(
        self, sensitivities: dict[Expr, dict[str, Expr]]
    ) -> dict[str, list[tuple[Expr, Expr]]]:
        out: dict[str, list[tuple[Expr, Expr]]] = {}
        for role, values in self.value.items():
            out[role] = [*values.items(), *((c, own[role]) for c, own in sensitivities.items())]
        return out


def _is_known(site: Site, values: dict[Expr, Expr]) -> bool:
    return site.value.ravel()[0] in values


def _column(s: Expr, parameters: tuple[Expr, ...]) -> Expr:
    """The symbol of a sensitivity: a state of its own, under a name that no user can give."""
    return symbol("state", f"d {s!r} / d {' '.join(map(repr, parameters))}", ())
