"""The separable form of an `Expr` in chosen symbols.

`separate(e, block)` writes e = sum_i c_i s_i where each s_i is a product of powers of functions of
the block alone and each c_i is free of the block. It does not depend on how the user spelled e:
products are multiplied out, quotients and roots become exponents, common factors are taken out
of sums, and log and exp are carried through products and sums.

Logarithms and fractional powers of products are split as for positive factors, which is what the
terms of a log density are on their support. Callers that build on a form check it numerically.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import (
    Expr,
    apply,
    constant,
    dependent,
    matrix_op,
    split_constant,
    substitute,
    symbols_of,
    to_text,
    topological,
)
from ssmppl.expressions.separation_matrices import MatrixRules, NotSeparable
from ssmppl.expressions.terms import (
    ONE,
    Monomial,
    Terms,
    added,
    gathered,
    monomial_expr,
    scaled,
    summed,
)

MAX_TERMS = 600
_MINUS = constant(-1.0)


@dataclass(frozen=True)
class Separation:
    """sum_i coefficient_i * function_i; `terms` maps a monomial to its coefficient."""

    terms: dict[Monomial, Expr]

    def items(self) -> list[tuple[Expr, Expr]]:
        """(function of the block, coefficient free of it) in a fixed, readable order."""
        pairs = [(monomial_expr(m), c) for m, c in self.terms.items()]
        return sorted(pairs, key=lambda p: to_text(p[0]))

    def assemble(self) -> Expr:
        """The sum as one expression, equal to the separated one."""
        total = constant(0.0)
        for function, coefficient in self.items():
            total = total + coefficient * function
        return total


def separate(expression: Expr, block: Iterable[Expr]) -> Separation | NotApplicable:
    """Separate an expression in the symbols of `block`; the reason where it is not separable."""
    try:
        separator = _Separator([expression], block)
        terms = separator.terms_of(expression)
    except NotSeparable as failure:
        return NotApplicable(failure.reason)
    return Separation(gathered(terms))


class _Separator(MatrixRules):
    """One pass over a graph, bottom up; remembers which atoms are sums."""

    def __init__(self, roots: list[Expr], block: Iterable[Expr]):
        self.block = frozenset(block)
        self.involved = dependent(roots, self.block)
        self.sums: dict[Expr, Terms] = {}
        self.done: dict[Expr, Terms] = {}

    def terms_of(self, root: Expr) -> Terms:
        failures: dict[Expr, NotSeparable] = {}
        for node in topological([root]):
            if node in self.done or node in failures:
                continue
            if node not in self.involved:
                self.done[node] = {ONE: [node]}
                continue
            bad = next((failures[a] for a in node.args if a in failures), None)
            try:
                if bad is not None:
                    raise bad
                self.done[node] = self._expand_by_cases(node)
            except NotSeparable as failure:
                if symbols_of(node) <= self.block:  # a function of the block alone
                    self.done[node] = {frozenset({(node, 1.0)}): [constant(1.0)]}
                else:
                    failures[node] = failure
        if root in failures:
            raise failures[root]
        return self.done[root]

    def _expand_by_cases(self, node: Expr) -> Terms:
        """`_expand`; where that fails, the two cases of a condition under the node apart.

        log(where(c, a, b)) = where(c, log a, log b), and so for every function. Where the
        condition is an equation, it holds in its case: a sum over the values that a state may
        have becomes the one term of the value that it has.
        """
        try:
            return self._expand(node)
        except NotSeparable:
            under = [
                n
                for n in topological([node])
                if n.op == "where" and n.args[0] not in self.involved and n is not node
            ]
            if not under:
                raise
            condition = next((n for n in under[::-1] if n in self.involved), under[-1]).args[0]
            known = {condition: constant(1.0)} | _equated(condition)
            cases = [substitute([node], case)[0] for case in (known, {condition: constant(0.0)})]
            self.involved |= dependent(cases, self.block)
            return self._where(condition, *(self.terms_of(case) for case in cases))

    # -- one rule per operation
    def _expand(self, node: Expr) -> Terms:
        op, args = node.op, node.args
        if op == "symbol":
            return {frozenset({(node, 1.0)}): [constant(1.0)]}
        parts = [self.done.get(a, {}) for a in args]
        if op in ("cholesky", "inverse"):
            return {}  # taken apart by its items
        if op == "item":
            return self._matrix_item(node)
        if op == "logdet":
            return self._logdet(node)
        if op == "det" and (found := self._common_factor(node)) is not None:
            power = frozenset((a, round(e * node.data, 12)) for a, e in found[0])
            return {power: [matrix_op("det", found[1], node.data)]}
        if op == "add":
            return added(parts[0], parts[1])
        if op == "sub":
            return added(parts[0], scaled(parts[1], constant(-1.0)))
        if op == "neg":
            return scaled(parts[0], constant(-1.0))
        if op == "mul":
            return self._multiply(parts[0], parts[1])
        if op == "div":
            return self._multiply(parts[0], self._power(parts[1], -1.0, node))
        if op == "sqrt":
            return self._power(parts[0], 0.5, node)
        if op == "pow":
            if args[1].op == "const":
                return self._power(parts[0], args[1].data, node)
            if args[0] not in self.involved:
                return self._exp(self._multiply(parts[1], {ONE: [apply("log", args[0])]}), node)
            raise self._mixed(node)
        if op == "exp":
            return self._exp(parts[0], node)
        if op == "expm1":
            return added(self._exp(parts[0], node), {ONE: [constant(-1.0)]})
        if op == "log":
            return self._log(parts[0], node)
        if op == "log1p":
            return self._log(added({ONE: [constant(1.0)]}, parts[0]), node)
        if op == "where" and args[0] not in self.involved:
            return self._where(args[0], parts[1], parts[2])
        raise self._mixed(node)

    def _multiply(self, a: Terms, b: Terms) -> Terms:
        out: Terms = {}
        for ma, ca in a.items():
            for mb, cb in b.items():
                coefficient = summed(ca) * summed(cb)
                for m, parts in self._combine(ma, mb).items():
                    out.setdefault(m, []).extend(coefficient * p for p in parts)
        if len(out) > MAX_TERMS:
            raise NotSeparable(constant(0.0), f"more than {MAX_TERMS} terms when multiplied out")
        return out

    def _combine(self, a: Monomial, b: Monomial) -> Terms:
        """The product of two monomials; a sum raised to a whole power is multiplied out."""
        exponents: dict[Expr, float] = dict(a)
        for atom, e in b:
            exponents[atom] = round(exponents.get(atom, 0.0) + e, 12)
        whole = [
            (atom, int(e))
            for atom, e in exponents.items()
            if atom in self.sums and e > 0 and e == int(e)
        ]
        for atom, _ in whole:
            del exponents[atom]
        out: Terms = {frozenset((x, e) for x, e in exponents.items() if e != 0): [constant(1.0)]}
        for atom, e in whole:
            for _ in range(e):
                out = self._multiply(out, self.sums[atom])
        return out

    def _power(self, terms: Terms, e: float, node: Expr) -> Terms:
        terms = {m: [c] for m, c in gathered(terms).items()}
        if not math.isfinite(e) or (e < 0 and not terms):  # 1/0
            raise self._mixed(node)
        if not terms:
            return {}
        if len(terms) == 1:
            ((m, c),) = terms.items()
            return {frozenset((a, round(k * e, 12)) for a, k in m): [summed(c) ** e]}
        if e == int(e) and 0 < e <= 8:
            out = terms
            for _ in range(int(e) - 1):
                out = self._multiply(out, terms)
            return out
        common, scale, atom = self._factor(terms, node)
        factors = frozenset((a, round(k * e, 12)) for a, k in common)
        return self._multiply(
            {factors: [scale**e]}, {frozenset({(atom, float(e))}): [constant(1.0)]}
        )

    def _factor(self, terms: Terms, node: Expr) -> tuple[Monomial, Expr, Expr]:
        """terms = common * scale * atom, atom a sum with numbers for coefficients."""
        exponents = [dict(m) for m in terms]
        shared = set(exponents[0]).intersection(*exponents[1:])
        common = {a: min(d[a] for d in exponents) for a in shared}
        reduced: dict[Monomial, Expr] = {}
        for m, c in terms.items():
            left = {a: round(e - common.get(a, 0.0), 12) for a, e in m}
            reduced[frozenset((a, e) for a, e in left.items() if e != 0)] = summed(c)
        order = sorted(reduced, key=lambda m: (len(m), to_text(monomial_expr(m))))
        split = {m: split_constant(reduced[m]) for m in order}
        core = split[order[0]][1]
        if any(s[1] is not core for s in split.values()):
            raise self._mixed(node)
        size = abs(split[order[0]][0])
        numeric: Terms = {m: [constant(split[m][0] / size)] for m in order}
        total = constant(0.0)
        for m in order:
            total = total + summed(numeric[m]) * monomial_expr(m)
        self.sums[total] = numeric
        return frozenset(common.items()), core * size, total

    def _log(self, terms: Terms, node: Expr) -> Terms:
        terms = {m: [c] for m, c in gathered(terms).items()}
        if not terms:  # of 0
            raise self._mixed(node)
        if len(terms) == 1:
            ((monomial, c),) = terms.items()
            scale, atoms = summed(c), dict(monomial)
        else:
            common, scale, atom = self._factor(terms, node)
            atoms = {**dict(common), atom: 1.0}
        out: Terms = {ONE: [apply("log", scale)]}
        for atom, e in atoms.items():
            if atom.op == "det":  # a logarithm's argument is positive
                logdet = matrix_op("logdet", atom.args, atom.data)
                self.involved |= dependent([logdet], self.block)
                out = added(out, scaled(self.terms_of(logdet), constant(e)))
                continue
            inner = (
                self.done[atom.args[0]]
                if atom.op == "exp" and atom.args[0] in self.done
                else {frozenset({(apply("log", atom), 1.0)}): [constant(1.0)]}
            )
            out = added(out, scaled(inner, constant(e)))
        return out

    def _exp(self, terms: Terms, node: Expr) -> Terms:
        out: Terms = {ONE: [constant(1.0)]}
        for monomial, c in gathered(terms).items():
            if monomial == ONE:
                out = scaled(out, apply("exp", c))
                continue
            factor, core = split_constant(c)
            if not (core.op == "const"):
                raise self._mixed(node)
            argument = monomial_expr(monomial)
            if argument.op == "log":
                base = self.done.get(argument.args[0])
                atom_terms = (
                    self._power(base, factor, node)
                    if base
                    else {frozenset({(argument.args[0], factor)}): [constant(1.0)]}
                )
            else:
                self.done.setdefault(argument, {monomial: [constant(1.0)]})
                atom_terms = {frozenset({(apply("exp", argument), factor)}): [constant(1.0)]}
            out = self._multiply(out, atom_terms)
        return out

    def _where(self, condition: Expr, a: Terms, b: Terms) -> Terms:
        zero = constant(0.0)
        return {
            m: [
                apply(
                    "where",
                    condition,
                    summed(a[m]) if m in a else zero,
                    summed(b[m]) if m in b else zero,
                )
            ]
            for m in {**a, **b}
        }


def _equated(condition: Expr) -> dict[Expr, Expr]:
    """What an equation with a number says: {x: 2} of x == 2."""
    if condition.op == "eq":
        for x, value in (condition.args, condition.args[::-1]):
            if value.op == "const" and x.op != "const":
                return {x: value}
    return {}
