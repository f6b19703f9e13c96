"""Parameters that conditional SMC integrates out, on the way from one trajectory to the next.

Given the states, a block of parameters with a conjugate family has log density sum_i C_i s_i, with
statistics C that are sums over time (`separation.py`). So the states without the block have

    p(x_{1:t}, y_{1:t}) = Z(C_prior + sum_{k <= t} c_k) prod_{k <= t} r_k,

Z the family's normalising constant and r_k the rest of the densities of row k, free of the block
(Wigren, Risuleo, Murray and Lindsten 2019, "Parameter elimination in particle Gibbs sampling").
That is no Markov model in x. It is one in x with the running sums S_t = sum_{k <= t} c_k, which
follow from x as deterministic components do, and so conditional SMC runs on (x, S):

    draw x_t       by the transition, with the block drawn from its distribution given S_{t-1}
    weigh x_t      by Z(B_t + S_t) / Z(B_{t-1} + S_{t-1} + transition's part of c_t), times r
    join x'_t      the reference with ancestor i: by Z(W_t + S'_t) / Z(B_{t-1} + S_{t-1}), times r,
                   S' the statistics as far as the ancestor bears on them and W all the others

B_t, the base, is what is known apart from the trajectory, W_t the same with the statistics that the
rest of the reference brings: both come as columns behind the inputs. Statistics that do not depend
on the states (a count of the rows that were measured) are no components of a particle; they are in
the columns too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ssmppl.analysis.conjugacy.describe import joined
from ssmppl.analysis.conjugacy.update import Update
from ssmppl.analysis.density import Missing, Term, terms
from ssmppl.analysis.elimination.eliminable import Eliminable
from ssmppl.analysis.elimination.moments import ZERO
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap
from ssmppl.analysis.structure import component_means, deterministic, unused_name
from ssmppl.errors import Location, NotApplicable
from ssmppl.expressions.algebra import ONE, Separation, separate
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, apply, constant, substitute, symbol, symbols_of
from ssmppl.language.distributions import Dirac, Draws
from ssmppl.language.model.trace import Site, Trace, previous

COLUMNS = ("before", "moved", "now", "whole")  # of the base: see `Elimination.columns`
INFINITY = float("inf")


@dataclass(frozen=True)
class Elimination:
    """A model without some of its parameters.

    trace : its states are x, then the statistics that differ from particle to particle.
    carried : which these are, positions among all statistics, block by block.
    columns : symbols of the columns behind the inputs, for each statistic in turn: `before` row t
        was reached (B_{t-1}), once the states have `moved` (with what the transition surely adds),
        `now` (B_t), and the `whole` with all other rows of the reference (W_t).
    proposal : how particles move and are weighed. following : values of the deterministic
        components of x_t and of the statistics, by those of x_{t-1} and the others of x_t.
    connected, observed : log r_t of the transition and of the observation.
    joining : log Z(W_t + S'_t) - log Z(B_{t-1} + S_{t-1}).
    initial, later, measured : the increments c_t: of x_1, of x_t given x_{t-1}, of y_t.
    """

    trace: Trace
    eliminable: Eliminable
    carried: tuple[int, ...]
    columns: tuple[Expr, ...]
    proposal: Proposal
    following: dict[Expr, Expr]
    connected: tuple[Term, ...]
    observed: tuple[Term, ...]
    joining: tuple[Expr, Expr]
    initial: tuple[Expr, ...]
    later: tuple[Expr, ...]
    measured: tuple[Expr, ...]


# -- the model without them


def eliminate(trace: Trace, missing: Missing, found: Eliminable) -> Elimination | NotApplicable:
    """The model of (x, S); NotApplicable where some of its densities do not separate."""
    return _Build(trace, missing, found).elimination()


class _Build:
    """One model without parameters in the making."""

    def __init__(self, trace: Trace, missing: Missing, found: Eliminable):
        self.trace, self.missing, self.found = trace, missing, found
        self.block = frozenset(found.components)
        roles = ("initial", "transition", "observation")
        self.c = {r: [e for u in found.updates for e in u.coefficients[r]] for r in roles}
        self.carried = tuple(
            k for k in range(found.functions) if any(_of_states(self.c[r][k]) for r in roles)
        )
        taken = {s.data[1] for s in trace.state_symbols} | set(trace.inputs)
        name = unused_name("statistics", taken)
        self.sums = {k: symbol("state", name, (i,)) for i, k in enumerate(self.carried)}
        self.column = {
            which: [
                symbol("guide", unused_name(which, taken), (k,)) for k in range(found.functions)
            ]
            for which in COLUMNS
        }  # fmt: skip
        self.values = component_means(deterministic(list(trace.transition.values())))

    def elimination(self) -> Elimination | NotApplicable:
        connected = self._rest("transition")
        observed = self._rest("observation")
        if isinstance(connected, NotApplicable):
            return connected
        if isinstance(observed, NotApplicable):
            return observed
        before, after = self._sums("transition"), self._sums("transition", "observation")
        first = self._sums("initial"), self._sums("initial", "observation")
        earlier = {k: previous(s) for k, s in self.sums.items()}
        plain = bootstrap(self.trace, self.missing)
        proposal = Proposal(
            "eliminated",
            self._moved(plain.initial_draw, {}, first[1]),
            (*observed, self._gained({}, first[0])),
            self._moved(plain.draw, earlier, after),
            (*observed, self._gained(earlier, before)),
            explanation=f"particles move by the transition, each with "
            f"{joined(self.found.components)} drawn given its own past",
        )
        own = dict(zip((self.sums[k] for k in self.carried), after, strict=True))
        following = dict(self.values)
        following.update(zip(own, substitute(list(own.values()), self.values), strict=True))
        joining = self._log_z("whole", self.sums), self._log_z("before", earlier)
        made = Elimination(
            self._extended(own), self.found, self.carried,
            tuple(s for which in COLUMNS for s in self.column[which]),
            proposal, following, connected, observed, joining,
            tuple(self.c["initial"]), tuple(self.c["transition"]), tuple(self.c["observation"]),
        )  # fmt: skip
        return self._checked(made)

    # -- statistics and what they are worth
    def _sums(self, *roles: str) -> list[Expr]:
        """The carried statistics with the increments of these roles; of the first row alone
        where the initial distribution is among them."""
        out = []
        for k in self.carried:
            total = ZERO if roles[0] == "initial" else previous(self.sums[k])
            for role in roles:
                total = total + self.c[role][k]
            out.append(total)
        return out

    def _all(self, which: str, carried: Mapping[int, Expr]) -> list[Expr]:
        return [s + carried.get(k, ZERO) for k, s in enumerate(self.column[which])]

    def _blocks(self, values: Sequence[Expr]) -> list[tuple[Update, list[Expr]]]:
        """Each block with its own statistics, and a 0 for those that are absent."""
        out, at = [], 0
        for u in self.found.updates:
            out.append((u, [*values[at : at + len(u.functions)], ZERO]))
            at += len(u.functions)
        return out

    def _log_z(self, which: str, carried: Mapping[int, Expr]) -> Expr:
        """log Z, without what all particles have in common."""
        total = ZERO
        for update, c in self._blocks(self._all(which, carried)):
            assert update.family is not None
            for part in filter(_of_states, update.family.log_normaliser(c)):
                total = total + part
        return total

    def _gained(self, earlier: Mapping[int, Expr], moved: Sequence[Expr]) -> Term:
        """log Z(B_t + S_t) - log Z(... before y_t)."""
        there = dict(zip(self.carried, moved, strict=True))
        ratio = self._log_z("now", self.sums) - self._log_z("moved", there)
        return Term(self._site(), _or_nothing(ratio), None)

    # -- draws
    def _moved(
        self, draws: dict[Expr, Expr], earlier: Mapping[int, Expr], sums: list[Expr]
    ) -> dict[Expr, Expr]:
        """x drawn with the block drawn first, and the statistics that follow."""
        source, drawn = Draws("eliminated"), dict[Expr, Expr]()
        for update, c in self._blocks(self._all("before", earlier)):
            assert update.family is not None
            own = update.family.written_draw(c, source)
            drawn.update(zip(update.components, own, strict=True))
        x = dict(zip(draws, substitute(list(draws.values()), drawn), strict=True))
        carried = (self.sums[k] for k in self.carried)
        return {**x, **dict(zip(carried, substitute(sums, x), strict=True))}

    # -- what is free of the block
    def _rest(self, role: str) -> tuple[Term, ...] | NotApplicable:
        """log r of a role, term by term, -inf outside the supports."""
        out = []
        guarded = terms(self.trace, role, self.missing)
        for term, plain in zip(
            guarded, terms(self.trace, role, self.missing, guard=False), strict=True
        ):
            if role == "transition" and isinstance(term.site.distribution, Dirac):
                continue
            if not symbols_of(plain.log_density) & self.block:
                out.append(term)
                continue
            form = separate(plain.log_density, self.block)
            if isinstance(form, NotApplicable):
                return NotApplicable(form.reason, term.where)
            assert isinstance(form, Separation)
            rest = form.terms.get(ONE, ZERO)
            for inside, outside in _conditions(term.log_density):
                if not symbols_of(inside) & self.block:  # its own law keeps the block in range
                    rest = apply("where", inside, rest, outside)
            out.append(Term(term.site, rest, term.guard))
        return tuple(out)

    # -- the trace
    def _extended(self, sums: Mapping[Expr, Expr]) -> Trace:
        """The trace with the statistics among its states."""
        if not sums:
            return self.trace
        site = self._site(list(sums.values()), list(sums))
        name = site.name
        return replace(
            self.trace, initial={**self.trace.initial, name: site},
            transition={**self.trace.transition, name: site},
        )  # fmt: skip

    def _site(self, values: Sequence[Expr] = (), symbols: Sequence[Expr] = ()) -> Site:
        where = self._where()
        law = Dirac(array(list(values)))
        law.location = where
        name = symbols[0].data[1] if symbols else "statistics"
        return Site(name, "transition", law, array(list(symbols)), where)

    def _where(self) -> Location:
        return self.trace.parameters[self.found.updates[0].block[0]].distribution.location

    def _checked(self, made: Elimination) -> Elimination:
        """No expression may hold what was eliminated."""
        p = made.proposal
        roots = [*p.initial_draw.values(), *p.draw.values(), *made.following.values()]
        roots += [t.log_density for t in (*p.initial_weight, *p.weight, *made.connected)]
        roots += [t.log_density for t in made.observed] + list(made.joining)
        roots += [*made.initial, *made.later, *made.measured]
        assert not symbols_of(roots) & self.block
        return made


def _of_states(e: Expr) -> bool:
    return any(s.data[0] in ("state", "state_prev") for s in symbols_of(e))


def _conditions(guarded: Expr) -> list[tuple[Expr, Expr]]:
    """What guards a log density, summed, the innermost first: where(inside, density, outside) with
    -inf outside the support and NaN where a parameter is out of its range.
    """
    if guarded.op == "add":
        return [c for a in guarded.args for c in _conditions(a)]
    if guarded.op == "where" and guarded.args[2].op == "const":
        inside, density, outside = guarded.args
        if not math.isfinite(outside.data):
            return [*_conditions(density), (inside, outside)]
    return []


def _or_nothing(log_ratio: Expr) -> Expr:
    """A log weight of statistics; -inf where these are beyond floating point."""
    finite = apply("lt", apply("abs", log_ratio), constant(INFINITY))
    return apply("where", finite, log_ratio, constant(-INFINITY))
