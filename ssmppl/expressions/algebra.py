"""Algebraic forms of an `Expr` in chosen symbols: separable, polynomial, affine, quadratic.

`separate(e, block)` writes e = sum_i c_i s_i where each s_i is a product of powers of functions of
the block alone, a monomial, and each c_i is free of the block. It does not depend on how the user
spelled e: products are multiplied out, quotients and roots become exponents, common factors are
taken out of sums, and log and exp are carried through products and sums. Logarithms and fractional
powers of products are split as for positive factors, which is what the terms of a log density are
on their support. Callers that build on a form check it numerically.

Of the factorisations of a small matrix, the matrix is a function of the block times what is free of
it, or the other way round, or linear in a symmetric matrix Q of the block so that its inverse is
linear in Q^-1 (`Congruence`): L Q L' with L a matrix of numbers, Kronecker products of Q with one,
several Q down the diagonal,

    (M^-1)_ij = sum_kl G_ijkl (Q^-1)_kl,        log det M = (n / p) log det Q + c,

n and p the sizes of M and Q. G and c are found from M at a few Q, whatever way M was written, and
the form is taken only if it holds at others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    Expr,
    apply,
    constant,
    dependent,
    item,
    matrix_op,
    split_constant,
    substitute,
    symbols_of,
    to_text,
    topological,
)
from ssmppl.expressions.zero import cancels, wide_points

Monomial = frozenset  # of (atom: Expr, exponent: float)
ONE: Monomial = frozenset()
Terms = dict[Monomial, list[Expr]]  # coefficient as a list of summands
Matrix = Callable[[np.ndarray], np.ndarray]
MAX_TERMS = 600  # of a product that is multiplied out
MAX_SUMMANDS = 2000  # of all its coefficients together, before what is alike is gathered
POINTS = 64  # at which a form is compared with what it was made of
_CONGRUENCE_POINTS = 4
_TOLERANCE = 1e-11
_MINUS = constant(-1.0)


def monomial_expr(monomial: Monomial) -> Expr:
    """The product of powers as an expression; atoms in the order of their text."""
    total = constant(1.0)
    for atom, exponent in sorted(monomial, key=lambda p: to_text(p[0])):
        total = total * atom**exponent
    return total


def gathered(terms: Terms) -> dict[Monomial, Expr]:
    """Coefficients as one expression each; without those that are, or cancel to, zero."""
    out = {}
    for monomial, parts in terms.items():
        parts = [p for p in parts if not (p.op == "const" and p.data == 0.0)]
        if parts and not (len(parts) > 1 and cancels(parts)):
            total = summed(parts)
            if not (total.op == "const" and total.data == 0.0):
                out[monomial] = total
    return out


def summed(parts: list[Expr]) -> Expr:
    """The sum of a coefficient's summands."""
    total = parts[0]
    for p in parts[1:]:
        total = total + p
    return total


def added(a: Terms, b: Terms) -> Terms:
    """a + b."""
    out = {m: list(c) for m, c in a.items()}
    for m, c in b.items():
        out.setdefault(m, []).extend(c)
    return out


def scaled(a: Terms, factor: Expr) -> Terms:
    """a times a factor free of the block."""
    return {m: [factor * p for p in c] for m, c in a.items()}


# -- matrices that are linear in a symmetric matrix, with inverses that are linear in its inverse
@dataclass(frozen=True, eq=False)
class Congruence:
    """entries : of Q, row by row, (p * p,). inverse : G, (n, n, p, p). power : n / p."""

    entries: tuple[Expr, ...]
    inverse: np.ndarray
    power: float
    constant: float

    @property
    def size(self) -> int:
        """The size p of the matrix."""
        return self.inverse.shape[2]


@lru_cache(maxsize=512)
def congruent(node: Expr) -> Congruence | None:
    """The form of the matrix under a node of `MATRIX_OPS`; None where it has none.

    None also for Q itself, of which nothing is to be said.
    """
    matrix, n = node.args, node.data
    half = _lower_half(symbols_of(matrix))
    if half is None:
        return None
    p = 1 + max(i for i, _ in half)
    entries = tuple(half[max(i, j), min(i, j)] for i in range(p) for j in range(p))
    if n == p and all(a is b for a, b in zip(entries, matrix, strict=True)):
        return None

    def at(q: np.ndarray) -> np.ndarray:
        values = {s: q[cell] for cell, s in half.items()}
        return np.array([float(e) for e in evaluate(matrix, values)]).reshape(n, n)

    def inverted(precision: np.ndarray) -> np.ndarray:
        return np.linalg.inv(at(np.linalg.inv(precision)))

    with np.errstate(all="ignore"):
        try:
            return _fitted(at, inverted, entries, n)
        except np.linalg.LinAlgError:
            return None


def _fitted(at: Matrix, inverted: Matrix, entries: tuple[Expr, ...], n: int) -> Congruence | None:
    """G and c from M^-1 as a function of Q^-1, if they hold at random Q as well."""
    p = math.isqrt(len(entries))
    identity = np.eye(p)
    middle = inverted(identity)
    g = np.zeros((n, n, p, p))
    for i in range(p):
        for j in range(i + 1):
            unit = np.zeros((p, p))
            unit[i, j] = unit[j, i] = 0.5
            change = inverted(identity + unit) - middle
            # of the two places of one number, each carries half: exact, as Q^-1 is symmetric
            g[:, :, i, j] = g[:, :, j, i] = change if i != j else 2.0 * change
    g[np.abs(g) < _TOLERANCE * np.abs(g).max()] = 0.0
    form = Congruence(entries, g, n / p, float(np.linalg.slogdet(at(identity))[1]))
    rng = np.random.default_rng(1)
    for _ in range(_CONGRUENCE_POINTS):
        a = rng.standard_normal((p, p))
        q = a @ a.T + identity
        found, expected = np.linalg.inv(at(q)), np.einsum("ijkl,kl->ij", g, np.linalg.inv(q))
        sign, log_det = np.linalg.slogdet(at(q))
        change = form.power * float(np.linalg.slogdet(q)[1]) + form.constant - log_det
        if not (sign > 0.0 and abs(change) < 1e-9):
            return None
        if not np.all(np.abs(found - expected) < 1e-9 * np.abs(found).max()):
            return None
    return form


def _lower_half(symbols: frozenset[Expr]) -> dict[tuple[int, int], Expr] | None:
    """(i, j) -> symbol, if these are all components of one symmetric matrix, i >= j."""
    if len({s.data[:2] for s in symbols}) != 1 or any(len(s.data[2]) != 2 for s in symbols):
        return None
    half = {s.data[2]: s for s in symbols}
    p = 1 + max(i for i, _ in half)
    return half if set(half) == {(i, j) for i in range(p) for j in range(i + 1)} else None


# -- separation
class NotSeparable(Exception):
    """Raised at the node at which a separation fails."""

    def __init__(self, node: Expr, reason: str):
        self.node, self.reason = node, reason


def _inverse_of(node: Expr) -> Expr | None:
    """The "inverse" node whose entries, in order, are the arguments of a matrix node."""
    first = node.args[0]
    if first.op != "item" or first.args[0].op != "inverse" or first.args[0].data != node.data:
        return None
    n, source = node.data, first.args[0]
    whole = [item(source, i, j) for i in range(n) for j in range(n)]
    return source if all(a is b for a, b in zip(node.args, whole, strict=True)) else None


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


class _Separator:
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
        if op == "item" and args[0].op != "loop":
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
        size = 0
        for ma, ca in a.items():
            for mb, cb in b.items():
                coefficient = summed(ca) * summed(cb)
                for m, parts in self._combine(ma, mb).items():
                    out.setdefault(m, []).extend(coefficient * p for p in parts)
                    size += len(parts)
            if len(out) > MAX_TERMS or size > MAX_SUMMANDS:
                most = f"{MAX_TERMS} terms" if len(out) > MAX_TERMS else f"{MAX_SUMMANDS} summands"
                raise NotSeparable(constant(0.0), f"more than {most} when multiplied out")
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

    # -- "logdet", and items of "inverse" and "cholesky"
    def _mixed(self, node: Expr) -> NotSeparable:
        names = sorted({s.data[1] for s in symbols_of(node) & self.block})
        return NotSeparable(node, f"{to_text(node)} does not separate in {', '.join(names)}")

    def _scaled_matrix(self, node: Expr) -> tuple[Expr, tuple[Expr, ...]]:
        """The matrix under `node` as one factor free of the block times block-only entries."""
        entries, core = [], None
        for a in node.args:
            entry = constant(0.0)
            terms = gathered(self.done[a]) if a in self.done else None
            if terms is None:
                raise self._mixed(node)
            for m, c in sorted(terms.items(), key=lambda pair: to_text(monomial_expr(pair[0]))):
                number, own = split_constant(c)
                core = own if core is None else core
                if own is not core:
                    raise self._mixed(node)
                entry = entry + number * monomial_expr(m)
            entries.append(entry)
        if core is None:
            raise self._mixed(node)
        return core, tuple(entries)

    def _common_factor(self, node: Expr) -> tuple[Monomial, list[Expr]] | None:
        """The matrix under `node` as one function of the block times entries free of it."""
        common, entries = None, []
        for a in node.args:
            terms = gathered(self.done[a]) if a in self.done else {}
            if not terms and a in self.done:  # an entry that is zero
                entries.append(constant(0.0))
                continue
            if len(terms) != 1:
                return None
            ((m, c),) = terms.items()
            common = m if common is None else common
            if m != common:
                return None
            entries.append(c)
        return None if common is None else (common, entries)

    def _logdet(self, node: Expr) -> Terms:
        if (found := self._common_factor(node)) is not None:
            common, free = found
            logs = self._log({common: [constant(1.0)]}, node)
            logs = scaled(logs, constant(float(node.data)))
            return added(logs, {ONE: [matrix_op("logdet", free, node.data)]})
        original = _inverse_of(node)
        if original is not None:  # log det A^-1 = -log det A
            logdet = matrix_op("logdet", original.args, node.data)
            self.involved |= dependent([logdet], self.block)
            return scaled(self.terms_of(logdet), _MINUS)
        scale, entries = self._scaled_matrix(node)
        atom = matrix_op("logdet", entries, node.data)
        form = congruent(atom)
        free, power = constant(float(node.data)) * apply("log", scale), 1.0
        if form is not None:
            free, power = free + form.constant, form.power
            atom = matrix_op("logdet", form.entries, form.size)
        return {ONE: [free], frozenset({(atom, 1.0)}): [constant(power)]}

    def _matrix_item(self, node: Expr) -> Terms:
        matrix = node.args[0]
        power = -1.0 if matrix.op == "inverse" else 0.5
        if (found := self._common_factor(matrix)) is not None:
            common, free = found
            factor = frozenset((a, round(e * power, 12)) for a, e in common)
            return {factor: [item(matrix_op(matrix.op, free, matrix.data), *node.data)]}
        original = _inverse_of(matrix) if matrix.op == "inverse" else None
        if original is not None:  # (A^-1)^-1 = A
            row, column = node.data
            return self.done[original.args[row * matrix.data + column]]
        scale, entries = self._scaled_matrix(matrix)
        whole = matrix_op(matrix.op, entries, matrix.data)
        form = congruent(whole) if matrix.op == "inverse" else None
        if form is not None:
            inverse = matrix_op("inverse", form.entries, form.size)
            return {
                frozenset({(item(inverse, k, m), 1.0)}): [number * scale**-1.0]
                for (k, m), number in np.ndenumerate(form.inverse[node.data])
                if number != 0.0
            }
        atom = item(whole, *node.data)
        return {frozenset({(atom, 1.0)}): [scale**power]}


def _equated(condition: Expr) -> dict[Expr, Expr]:
    """What an equation with a number says: {x: 2} of x == 2."""
    if condition.op == "eq":
        for x, value in (condition.args, condition.args[::-1]):
            if value.op == "const" and x.op != "const":
                return {x: value}
    return {}


# -- polynomials
def polynomial(
    expression: Expr, symbols: Sequence[Expr], degree: int
) -> dict[tuple[Expr, ...], Expr] | NotApplicable:
    """Coefficients by monomial (the symbols of it, in the order given, repeated by power)."""
    try:
        terms = _Separator([expression], symbols).terms_of(expression)
    except NotSeparable as failure:
        return NotApplicable(failure.reason)
    rank = {s: i for i, s in enumerate(symbols)}
    refusals = {m: r for m in terms if (r := _refusal(m, rank, degree)) is not None}
    for monomial, reason in refusals.items():  # before all others are gathered, which takes long
        if gathered({monomial: terms[monomial]}):
            return NotApplicable(reason)
    separation = Separation(gathered({m: c for m, c in terms.items() if m not in refusals}))
    out = {}
    for monomial, coefficient in separation.terms.items():
        key = [atom for atom, exponent in monomial for _ in range(int(exponent))]
        out[tuple(sorted(key, key=rank.__getitem__))] = coefficient
    if _splits(expression, symbols) and not _holds(expression, separation, symbols):
        names = ", ".join(sorted({s.data[1] for s in symbols_of(expression) & set(symbols)}))
        return NotApplicable(
            f"{to_text(expression)} is {to_text(separation.assemble())} only where its roots and "
            f"logarithms are of positive numbers, whatever the sign of {names}"
        )
    return out


def _refusal(monomial: Monomial, rank: dict[Expr, int], degree: int) -> str | None:
    """Why a term with this monomial is none of a polynomial of the degree; None where it is one."""
    total = 0
    for atom, exponent in monomial:
        if atom not in rank or exponent != int(exponent) or exponent < 0:
            names = ", ".join(sorted({s.data[1] for s in symbols_of(atom)}))
            return f"{to_text(monomial_expr(monomial))} is not a polynomial in {names}"
        total += int(exponent)
    if total > degree:
        return f"{to_text(monomial_expr(monomial))} is of degree {total}, above {degree}"
    return None


def _splits(expression: Expr, symbols: Sequence[Expr]) -> bool:
    """Whether roots (of matrices too) or logarithms were split as for positive factors."""
    return any(
        n.op in ("sqrt", "cholesky", "log", "log1p")
        or (n.op == "pow" and not (n.args[1].op == "const" and float(n.args[1].data).is_integer()))
        for n in dependent([expression], symbols)
    )


def _holds(expression: Expr, separation: Separation, symbols: Sequence[Expr]) -> bool:
    """Whether the separated form is the expression for symbols of both signs and many sizes."""
    rng = np.random.default_rng(20151)
    others = sorted(symbols_of(expression) - set(symbols), key=to_text)
    moderate = {s: rng.uniform(0.3, 1.7, POINTS) for s in others}
    terms = [function * coefficient for function, coefficient in separation.items()]
    for known in (moderate, wide_points(others, POINTS, rng)):
        at = known | wide_points(symbols, POINTS, rng)
        with np.errstate(all="ignore"):
            whole, *parts = (np.broadcast_to(v, POINTS) for v in evaluate([expression, *terms], at))
            size = np.abs(parts).sum(axis=0)
            off = np.abs(whole - np.sum(parts, axis=0)) > 1e-8 * size
        finite = np.isfinite(whole)
        if known is moderate and finite.any() and np.any(np.isfinite(size) & ~finite):
            return False  # it has no value where its form has one
        if np.any(off & finite & np.isfinite(size)):
            return False
    return True


def affine(
    expressions: Iterable[Expr], symbols: Sequence[Expr]
) -> tuple[ExprArray, ExprArray] | NotApplicable:
    """(A, b) with expressions = A @ symbols + b, A of shape (len(expressions), len(symbols))."""
    rows, offsets = [], []
    zero = constant(0.0)
    for e in expressions:
        form = polynomial(e, symbols, 1)
        if isinstance(form, NotApplicable):
            return form
        rows.append([form.get((s,), zero) for s in symbols])
        offsets.append(form.get((), zero))
    matrix = array(array(rows).reshape(len(rows), len(symbols)))
    return matrix, array(offsets)


def quadratic(
    expression: Expr, symbols: Sequence[Expr]
) -> tuple[ExprArray, ExprArray, Expr] | NotApplicable:
    """(H, g, c) with expression = -x' H x / 2 + g' x + c, H symmetric (a precision)."""
    form = polynomial(expression, symbols, 2)
    if isinstance(form, NotApplicable):
        return form
    n, zero = len(symbols), constant(0.0)
    h = np.empty((n, n), dtype=object)
    for i, a in enumerate(symbols):
        for j, b in enumerate(symbols):
            c = form.get((a, b) if i <= j else (b, a), zero)
            h[i, j] = -2.0 * c if i == j else -c
    return array(h), array([form.get((s,), zero) for s in symbols]), form.get((), zero)
