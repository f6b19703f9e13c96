"""How factorisations of small matrices separate: rules of `separation.py` for matrix nodes.

A matrix is a function of the block times what is free of it, or the other way round, or linear in a
symmetric matrix Q of the block so that its inverse is linear in Q^-1 (`congruence.py`).
"""

from __future__ import annotations

import numpy as np

from ssmppl.expressions.congruence import congruent
from ssmppl.expressions.expr import (
    Expr,
    apply,
    constant,
    dependent,
    item,
    matrix_op,
    split_constant,
    symbols_of,
    to_text,
)
from ssmppl.expressions.terms import (
    ONE,
    Monomial,
    Terms,
    added,
    gathered,
    monomial_expr,
    scaled,
)

_MINUS = constant(-1.0)


class NotSeparable(Exception):
    """Raised at the node at which a separation fails."""

    def __init__(self, node: Expr, reason: str):
        self.node, self.reason = node, reason


class MatrixRules:
    """The rules for "logdet" and for items of "inverse" and "cholesky"."""

    block: frozenset[Expr]
    involved: set[Expr]
    done: dict[Expr, Terms]

    def terms_of(self, root: Expr) -> Terms:
        """The separated form of an expression."""
        raise NotImplementedError

    def _log(self, terms: Terms, node: Expr) -> Terms:
        raise NotImplementedError

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


def _inverse_of(node: Expr) -> Expr | None:
    """The "inverse" node whose entries, in order, are the arguments of a matrix node."""
    first = node.args[0]
    if first.op != "item" or first.args[0].op != "inverse" or first.args[0].data != node.data:
        return None
    n, source = node.data, first.args[0]
    whole = [item(source, i, j) for i in range(n) for j in range(n)]
    return source if all(a is b for a, b in zip(node.args, whole, strict=True)) else None
