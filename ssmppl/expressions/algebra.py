"""Algebraic forms of an `Expr` in chosen symbols: separable, affine and quadratic.

`separate(e, block)` writes e = sum_i c_i s_i where each s_i is a product of powers of functions of
the block alone and each c_i is free of the block. It does not depend on how the user spelled e:
products are multiplied out, quotients and roots become exponents, common factors are taken out
of sums, and log and exp are carried through products and sums.

Logarithms and fractional powers of products are split as for positive factors, which is what the
terms of a log density are on their support. Callers that build on a form check it numerically.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

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
    substitute,
    symbols_of,
    to_text,
    topological,
)

Monomial = frozenset  # of (atom: Expr, exponent: float)
ONE: Monomial = frozenset()
Terms = dict[Monomial, list[Expr]]  # coefficient as a list of summands
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


class _NotSeparable(Exception):
    def __init__(self, node: Expr, reason: str):
        self.node, self.reason = node, reason


def monomial_expr(monomial: Monomial) -> Expr:
    """The product of powers as an expression; atoms in the order of their text."""
    total = constant(1.0)
    for atom, exponent in sorted(monomial, key=lambda p: to_text(p[0])):
        total = total * atom**exponent
    return total


def separate(expression: Expr, block: Iterable[Expr]) -> Separation | NotApplicable:
    """Separate an expression in the symbols of `block`; the reason where it is not separable."""
    try:
        separator = _Separator([expression], block)
        terms = separator.terms_of(expression)
    except _NotSeparable as failure:
        return NotApplicable(failure.reason)
    return Separation(_finish(terms))


def _finish(terms: Terms) -> dict[Monomial, Expr]:
    out = {}
    for monomial, parts in terms.items():
        parts = [p for p in parts if not (p.op == "const" and p.data == 0.0)]
        if parts and not (len(parts) > 1 and _cancels(parts)):
            total = parts[0]
            for p in parts[1:]:
                total = total + p
            if not (total.op == "const" and total.data == 0.0):
                out[monomial] = total
    return out


def _cancels(parts: list[Expr]) -> bool:
    """Whether the summands add to zero, at three random points of their symbols."""
    rng = np.random.default_rng(20150)
    symbols = sorted(symbols_of(parts), key=to_text)
    values = np.array(
        [
            np.broadcast_to(v, 3)
            for v in evaluate(parts, {s: rng.uniform(0.3, 1.7, 3) for s in symbols})
        ]
    )
    scale = np.abs(values).sum(0)
    return bool(np.all(np.isfinite(scale)) and np.all(np.abs(values.sum(0)) <= 1e-12 * scale))


class _Separator:
    """One pass over a graph, bottom up; remembers which atoms are sums."""

    def __init__(self, roots: list[Expr], block: Iterable[Expr]):
        self.block = frozenset(block)
        self.involved = dependent(roots, self.block)
        self.sums: dict[Expr, Terms] = {}
        self.done: dict[Expr, Terms] = {}
        self.roots = roots

    def terms_of(self, root: Expr) -> Terms:
        failures: dict[Expr, _NotSeparable] = {}
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
            except _NotSeparable as failure:
                if symbols_of(node) <= self.block:  # a function of the block alone
                    self.done[node] = {frozenset({(node, 1.0)}): [constant(1.0)]}
                else:
                    failures[node] = failure
        if root in failures:
            raise failures[root]
        return self.done[root]

    def _expand_by_cases(self, node: Expr) -> Terms:
        """`_expand`; where that fails, the two cases of a condition under the node apart.

        log(where(c, a, b)) = where(c, log a, log b), and so for every function.
        """
        try:
            return self._expand(node)
        except _NotSeparable:
            under = [
                n
                for n in topological([node])
                if n.op == "where" and n in self.involved and n.args[0] not in self.involved
            ]
            if not under or under[-1] is node:
                raise
            condition = under[-1].args[0]
            same = [n for n in under if n.args[0] is condition]
            cases = [substitute([node], {n: n.args[k] for n in same})[0] for k in (1, 2)]
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
            return _add(parts[0], parts[1])
        if op == "sub":
            return _add(parts[0], _scale(parts[1], constant(-1.0)))
        if op == "neg":
            return _scale(parts[0], constant(-1.0))
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
            return _add(self._exp(parts[0], node), {ONE: [constant(-1.0)]})
        if op == "log":
            return self._log(parts[0], node)
        if op == "log1p":
            return self._log(_add({ONE: [constant(1.0)]}, parts[0]), node)
        if op == "where" and args[0] not in self.involved:
            return self._where(args[0], parts[1], parts[2])
        raise self._mixed(node)

    def _mixed(self, node: Expr) -> _NotSeparable:
        names = sorted({s.data[1] for s in symbols_of(node) & self.block})
        return _NotSeparable(node, f"{to_text(node)} does not separate in {', '.join(names)}")

    def _multiply(self, a: Terms, b: Terms) -> Terms:
        out: Terms = {}
        for ma, ca in a.items():
            for mb, cb in b.items():
                coefficient = _total(ca) * _total(cb)
                for m, parts in self._combine(ma, mb).items():
                    out.setdefault(m, []).extend(coefficient * p for p in parts)
        if len(out) > MAX_TERMS:
            raise _NotSeparable(constant(0.0), f"more than {MAX_TERMS} terms when multiplied out")
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
        terms = {m: [c] for m, c in _finish(terms).items()}
        if len(terms) == 1:
            ((m, c),) = terms.items()
            return {frozenset((a, round(k * e, 12)) for a, k in m): [_total(c) ** e]}
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
            reduced[frozenset((a, e) for a, e in left.items() if e != 0)] = _total(c)
        order = sorted(reduced, key=lambda m: (len(m), to_text(monomial_expr(m))))
        split = {m: _split_constant(reduced[m]) for m in order}
        core = split[order[0]][1]
        if any(s[1] is not core for s in split.values()):
            raise self._mixed(node)
        size = abs(split[order[0]][0])
        numeric: Terms = {m: [constant(split[m][0] / size)] for m in order}
        total = constant(0.0)
        for m in order:
            total = total + _total(numeric[m]) * monomial_expr(m)
        self.sums[total] = numeric
        return frozenset(common.items()), core * size, total

    def _log(self, terms: Terms, node: Expr) -> Terms:
        terms = {m: [c] for m, c in _finish(terms).items()}
        if len(terms) == 1:
            ((monomial, c),) = terms.items()
            scale, atoms = _total(c), dict(monomial)
        else:
            common, scale, atom = self._factor(terms, node)
            atoms = {**dict(common), atom: 1.0}
        out: Terms = {ONE: [apply("log", scale)]}
        for atom, e in atoms.items():
            if atom.op == "det":  # a logarithm's argument is positive
                logdet = matrix_op("logdet", atom.args, atom.data)
                self.involved |= dependent([logdet], self.block)
                out = _add(out, _scale(self.terms_of(logdet), constant(e)))
                continue
            inner = (
                self.done[atom.args[0]]
                if atom.op == "exp" and atom.args[0] in self.done
                else {frozenset({(apply("log", atom), 1.0)}): [constant(1.0)]}
            )
            out = _add(out, _scale(inner, constant(e)))
        return out

    def _exp(self, terms: Terms, node: Expr) -> Terms:
        out: Terms = {ONE: [constant(1.0)]}
        for monomial, c in _finish(terms).items():
            if monomial == ONE:
                out = _scale(out, apply("exp", c))
                continue
            factor, core = _split_constant(c)
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
                    _total(a[m]) if m in a else zero,
                    _total(b[m]) if m in b else zero,
                )
            ]
            for m in {**a, **b}
        }

    def _scaled_matrix(self, node: Expr) -> tuple[Expr, tuple[Expr, ...]]:
        """The matrix under `node` as one factor free of the block times block-only entries."""
        entries, core = [], None
        for a in node.args:
            terms = _finish(self.done[a]) if a in self.done else None
            if terms is None or len(terms) != 1:
                raise self._mixed(node)
            ((m, c),) = terms.items()
            core = c if core is None else core
            if c is not core:
                raise self._mixed(node)
            entries.append(monomial_expr(m))
        return core, tuple(entries)

    def _common_factor(self, node: Expr) -> tuple[Monomial, list[Expr]] | None:
        """The matrix under `node` as one function of the block times entries free of it."""
        common, entries = None, []
        for a in node.args:
            terms = _finish(self.done[a]) if a in self.done else {}
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
            scaled = _scale(self._log({common: [constant(1.0)]}, node), constant(float(node.data)))
            return _add(scaled, {ONE: [matrix_op("logdet", free, node.data)]})
        original = _inverse_of(node)
        if original is not None:  # log det A^-1 = -log det A
            logdet = matrix_op("logdet", original.args, node.data)
            self.involved |= dependent([logdet], self.block)
            return _scale(self.terms_of(logdet), _MINUS)
        scale, entries = self._scaled_matrix(node)
        atom = matrix_op("logdet", entries, node.data)
        n = constant(float(node.data))
        unit = {frozenset({(atom, 1.0)}): [constant(1.0)]}
        return _add({ONE: [n * apply("log", scale)]}, unit)

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
        atom = item(matrix_op(matrix.op, entries, matrix.data), *node.data)
        return {frozenset({(atom, 1.0)}): [scale**power]}


def _inverse_of(node: Expr) -> Expr | None:
    """The "inverse" node whose entries, in order, are the arguments of a matrix node."""
    first = node.args[0]
    if first.op != "item" or first.args[0].op != "inverse" or first.args[0].data != node.data:
        return None
    n, source = node.data, first.args[0]
    whole = [item(source, i, j) for i in range(n) for j in range(n)]
    return source if all(a is b for a, b in zip(node.args, whole, strict=True)) else None


def _total(parts: list[Expr]) -> Expr:
    total = parts[0]
    for p in parts[1:]:
        total = total + p
    return total


def _add(a: Terms, b: Terms) -> Terms:
    out = {m: list(c) for m, c in a.items()}
    for m, c in b.items():
        out.setdefault(m, []).extend(c)
    return out


def _scale(a: Terms, factor: Expr) -> Terms:
    return {m: [factor * p for p in c] for m, c in a.items()}


def _split_constant(e: Expr) -> tuple[float, Expr]:
    """e = number * core."""
    number, one = 1.0, constant(1.0)
    while True:
        if e.op == "const":
            return number * e.data, one
        if e.op == "neg":
            number, e = -number, e.args[0]
        elif e.op == "mul" and e.args[0].op == "const":
            number, e = number * e.args[0].data, e.args[1]
        elif e.op == "mul" and e.args[1].op == "const":
            number, e = number * e.args[1].data, e.args[0]
        elif e.op == "div" and e.args[1].op == "const":
            number, e = number / e.args[1].data, e.args[0]
        else:
            return number, e


def polynomial(
    expression: Expr, symbols: Sequence[Expr], degree: int
) -> dict[tuple[Expr, ...], Expr] | NotApplicable:
    """Coefficients by monomial (the symbols of it, in the order given, repeated by power)."""
    separation = separate(expression, symbols)
    if not isinstance(separation, Separation):
        return separation
    rank = {s: i for i, s in enumerate(symbols)}
    out = {}
    for monomial, coefficient in separation.terms.items():
        key: list[Expr] = []
        for atom, exponent in monomial:
            if atom not in rank or exponent != int(exponent) or exponent < 0:
                names = ", ".join(sorted({s.data[1] for s in symbols_of(atom)}))
                text = to_text(monomial_expr(monomial))
                return NotApplicable(f"{text} is not a polynomial in {names}")
            key += [atom] * int(exponent)
        if len(key) > degree:
            text = to_text(monomial_expr(monomial))
            return NotApplicable(f"{text} is of degree {len(key)}, above {degree}")
        out[tuple(sorted(key, key=rank.__getitem__))] = coefficient
    return out


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
    return array(rows).reshape(len(rows), len(symbols)), array(offsets)


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
