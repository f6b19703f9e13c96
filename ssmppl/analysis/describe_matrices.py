"""Updates of vectors and matrices in words: sums of outer products, not their many entries.

What is said is read off the laws (Normal or MvNormal, mean affine in the block) that the block
enters. Where they are of another kind, the functions are told one by one (`describe.py`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from ssmppl.analysis.families import Family, Normal
from ssmppl.analysis.families_matrix import MatrixNormalWishart, Wishart
from ssmppl.analysis.sufficient import ROLES, BlockForm, Factor
from ssmppl.errors import NotApplicable
from ssmppl.expressions.algebra import affine, split_constant
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import Expr, symbols_of, to_text
from ssmppl.language import distributions as laws
from ssmppl.language.traced import Site, Trace

FEW = 3  # numbers whose functions are told one by one
LENGTH = 80


def shown_as_matrices(family: Family) -> bool:
    """Whether the functions of a block are too many to be told one by one."""
    if isinstance(family, Normal):
        return len(family.linear) > FEW
    return isinstance(family, (Wishart, MatrixNormalWishart))


def matrix_statistics(family: Family, form: BlockForm, trace: Trace) -> tuple[str, ...] | None:
    """One line for each matrix that the law is made of; None where that cannot be told."""
    teller = _Teller(form, trace)
    if isinstance(family, Normal):
        return teller.normal()
    if isinstance(family, MatrixNormalWishart):
        return teller.matrix_normal(family)
    return teller.wishart() if isinstance(family, Wishart) else None


def named(components: Sequence[Expr], trace: Trace) -> str:
    """The components' names, a parameter that is there as a whole by its own."""
    names: list[str] = []
    for name in dict.fromkeys(c.data[1] for c in components):
        mine = [c for c in components if c.data[1] == name]
        whole = len(mine) == len(trace.parameters[name].components)
        names += [name] if whole else [to_text(c) for c in mine]
    if len(names) > 6:
        names = [*names[:3], "...", names[-1]]
    return names[0] if len(names) == 1 else f"({', '.join(names)})"


class _Teller:
    """The laws that hold a block, in the order of their roles, and how to speak of them."""

    def __init__(self, form: BlockForm, trace: Trace):
        self.form, self.block = form, form.components
        members = frozenset(self.block)
        quantities = [
            *trace.state_symbols, *trace.observation_symbols, *trace.input_symbols,
            *trace.parameter_symbols,
        ]  # fmt: skip
        self.sizes = Counter(s.data[1] for s in quantities)
        by_role = (trace.parameters, trace.initial, trace.transition, trace.observations)
        factors = {(f.role, f.site): f for found in form.origins.values() for f in found}
        self.own: list[Site] = []
        self.others: list[tuple[Factor, Site]] = []
        for role, sites in zip(ROLES, by_role, strict=True):
            for name, site in sites.items():
                if (role, name) not in factors:
                    continue
                if role == "prior" and members & set(site.components):
                    self.own.append(site)
                else:
                    self.others.append((factors[role, name], site))
        self.parameters = trace.parameters

    # -- the families
    def normal(self) -> tuple[str, ...] | None:
        """H and h, as sums over the laws whose means hold the block."""
        first = ["prior"] if self._told_by_prior() else []
        h, linear, notes = [*first], [*first], []
        for factor, site in self.others:
            found = self._regression(site)
            if found is None:
                return None
            weight = self._weight(site.distribution)
            rest, z = self._residual(site.name, found[1]), _kronecker(found[0])
            if z is None:
                h.append(_summed(factor, f"J' {weight} J"))
                linear.append(_summed(factor, f"J' {weight} {rest}"))
                notes.append(f"J = d mean of {site.name} / d {self._names()}")
            else:
                outer = "z z'" if len(found[0]) == 1 else f"kron({weight}, z z')"
                scale = f"{weight} " if len(found[0]) == 1 else ""
                h.append(_summed(factor, scale + outer))
                linear.append(_summed(factor, f"{weight} {rest} z'"))
                notes.append(f"z = ({self._list(z)}) in the mean of {site.name}")
        return (f"H: {' + '.join(h)}", f"h: {' + '.join(linear)}", *notes)

    def matrix_normal(self, family: MatrixNormalWishart) -> tuple[str, ...] | None:
        """S_yy, S_yz and K."""
        first = ["prior"] if self._told_by_prior() else []
        yy, yz, zz, notes = [*first], [*first], [*first], []
        thetas = self.block[: family.thetas]
        for factor, site in self.others:
            found, scale = self._regression(site, thetas), self._scale(site)
            z = None if found is None else _kronecker(found[0])
            if found is None or z is None or scale is None:
                return None
            rest = self._residual(site.name, found[1])
            yy.append(_summed(factor, f"{scale}{rest} {rest}'"))
            yz.append(_summed(factor, f"{scale}{rest} z'"))
            zz.append(_summed(factor, f"{scale}z z'"))
            notes.append(f"z = ({self._list(z)}) in the mean of {site.name}")
        columns = dict.fromkeys(thetas[i].data[1] for i in family.rows[0])
        if len(columns) > 1:
            notes.append(f"A = [{' '.join(columns)}]")
        return (
            f"S_yy: {' + '.join(yy)}", f"S_yz: {' + '.join(yz)}", f"K: {' + '.join(zz)}", *notes
        )  # fmt: skip

    def wishart(self) -> tuple[str, ...] | None:
        """S, the sum of the outer products of the residuals."""
        own = self.parameters[self.block[0].data[1]].distribution
        if not isinstance(own, (laws.Wishart, laws.InverseWishart)):
            return None
        scale = matrix_text(own.parameters["scale"])
        parts, notes = [f"{scale}^-1" if isinstance(own, laws.Wishart) else scale], []
        for factor, site in self.others:
            if not isinstance(site.distribution, laws.MvNormal):
                return None
            times = self._scale(site)
            if times is None:
                return None
            parts.append(_summed(factor, f"{times}r r'"))
            mean = self._product(list(array(site.distribution.mean()).ravel()))
            when = " at t = 1" if factor.role == "initial" else ""
            less = "" if mean == "0" else f" - {mean}"
            notes.append(f"r = {site.name}{less}{when}")
        return (f"S: {' + '.join(parts)}", *dict.fromkeys(notes))

    # -- their parts
    def _told_by_prior(self) -> bool:
        return any(f.role == "prior" for found in self.form.origins.values() for f in found)

    def _names(self) -> str:
        names = dict.fromkeys(c.data[1] for c in self.block)
        return ", ".join(names)

    def _regression(
        self, site: Site, thetas: Sequence[Expr] | None = None
    ) -> tuple[ExprArray, ExprArray] | None:
        """(J, m) of a mean m + J theta."""
        law = site.distribution
        if not isinstance(law, (laws.Normal, laws.MvNormal)):
            return None
        found = affine(array(law.mean()).ravel(), list(thetas or self.block))
        return None if isinstance(found, NotApplicable) else found

    def _residual(self, name: str, rest: ExprArray) -> str:
        text = self._vector(list(rest))
        return name if text == "0" else f"({name} - {_tight(text)})"

    def _weight(self, law: laws.Distribution) -> str:
        """The precision of a law, as a matrix or, of one number, as a number."""
        if isinstance(law, laws.MvNormal):
            text = matrix_text(law.parameters[law.spread])
            if law.spread == "cholesky":
                return f"({text} {text}')^-1"
            return text if law.spread == "precision" else f"{text}^-1"
        precisions = [1.0 / v for v in array(law.variance()).ravel()]
        if len(precisions) == 1:
            return _tight(to_text(precisions[0]))
        if all(e is precisions[0] for e in precisions):
            return f"{_tight(to_text(precisions[0]))} I"
        return f"diag({self._vector(precisions)})"

    def _scale(self, site: Site) -> str | None:
        """ "s " where the precision of a law is s times the block's (inverse) matrix."""
        law = site.distribution
        if not isinstance(law, laws.MvNormal) or law.spread == "cholesky":
            return None
        number = _multiple(law.parameters[law.spread], self.block)
        if number is None:
            return None
        times = number if law.spread == "precision" else 1.0 / number
        return "" if times.op == "const" and times.data == 1.0 else f"{_tight(to_text(times))} "

    def _product(self, mean: list[Expr]) -> str:
        """A mean as a sum of matrices times vectors: A x_prev + B u_prev + c."""
        parts, rest = [], mean
        for name, site in self.parameters.items():
            if not symbols_of(rest) & set(site.components):
                continue
            found = affine(rest, site.components)
            z = None if isinstance(found, NotApplicable) else _kronecker(found[0])
            if z is None or isinstance(found, NotApplicable):
                continue
            one = len(z) == 1 and z[0].op == "const" and z[0].data == 1.0
            text = self._list(z)
            parts.append(name if one else f"{name} {text if len(z) == 1 else _tight(text)}")
            rest = list(found[1])
        left = self._vector(rest)
        parts += [left] if left != "0" or not parts else []
        text = " + ".join(parts)
        return text if " + " not in text or (len(parts) == 1 and text[0] == "(") else f"({text})"

    def _list(self, z: Sequence[Expr]) -> str:
        """Elements one after the other, a whole vector among them by its name."""
        out, left = [], list(z)
        while left:
            size = self.sizes[left[0].data[1]] if left[0].op == "symbol" else 1
            text = self._collapsed(left[:size]) if 1 < size <= len(left) else None
            out.append(to_text(left[0]) if text is None else text)
            left = left[1 if text is None else size :]
        return ", ".join(out)

    def _vector(self, v: Sequence[Expr]) -> str:
        if all(e.op == "const" and e.data == 0.0 for e in v):
            return "0"
        text = self._collapsed(v) if len(v) > 1 else to_text(v[0])
        return text if text is not None else _short(f"({', '.join(map(to_text, v))})")

    def _collapsed(self, v: Sequence[Expr]) -> str | None:
        """0.5*x of (0.5*x[0], 0.5*x[1]), where x has these elements and no others."""
        texts = [to_text(e) for e in v]
        bare = {re.sub(rf"\[{i}\]", "", t) for i, t in enumerate(texts)}
        sizes = {self.sizes[s.data[1]] for s in symbols_of(v) if s.data[2]}
        return bare.pop() if len(bare) == 1 and texts[0] not in bare and sizes == {len(v)} else None


def matrix_text(m: ExprArray) -> str:
    """A matrix by its name, as a multiple of one, or entry by entry."""
    entries = list(m.ravel())
    parts = [split_constant(e) for e in entries]
    number = parts[0][0]
    if number not in (0.0, 1.0) and all(p[0] == number and p[1].op != "const" for p in parts):
        inner = array(array([p[1] for p in parts]).reshape(m.shape))
        return f"({number:.6g} {matrix_text(inner)})"
    first = entries[0]
    if first.op == "item":
        text = to_text(first.args[0])
        same = all(e.op == "item" and e.args[0] is first.args[0] for e in entries)
        return text if same and len(text) < LENGTH else "C"
    names = {e.data[1] for e in entries if e.op == "symbol"}
    if len(names) == 1 and all(e.op == "symbol" for e in entries):
        return names.pop()
    rows = [f"[{', '.join(map(to_text, row))}]" for row in m]
    return _short(f"[{', '.join(rows)}]")


def _multiple(m: ExprArray, block: Sequence[Expr]) -> Expr | None:
    """s of a matrix s Q or s Q^-1, Q the block's matrix and s free of it."""
    members = frozenset(block)
    found: list[Expr] = []
    for e in m.ravel():
        terms = affine([e], sorted(symbols_of([e]) & members, key=to_text))
        if e.op == "item" or isinstance(terms, NotApplicable):
            if e.op != "item" or e.args[0].op != "inverse" or not symbols_of([e]) <= members:
                return None
            found.append(e / e)
            continue
        (row,), (rest,) = terms
        if len(row) != 1 or not (rest.op == "const" and rest.data == 0.0):
            return None
        found.append(row[0])
    return found[0] if all(f is found[0] for f in found) else None


def _kronecker(j: ExprArray) -> list[Expr] | None:
    """z where each row of J holds z at places of its own, all in one order; else None."""
    rows: list[list[Expr]] = [[] for _ in range(len(j))]
    for column in j.T:
        held = [i for i, e in enumerate(column) if not (e.op == "const" and e.data == 0.0)]
        if len(held) != 1:
            return None
        rows[held[0]].append(column[held[0]])
    same = all(
        len(row) == len(rows[0]) and all(a is b for a, b in zip(row, rows[0], strict=True))
        for row in rows
    )
    return rows[0] if same and rows[0] else None


def _summed(factor: Factor, text: str) -> str:
    if factor.role == "initial":
        return f"[{text}]_1"
    if factor.role == "prior":
        return f"[{text}]"
    if any(s.data[0] == "seen" for s in factor.symbols):
        return f"sum_{{t: {factor.site} measured}} {text}"
    return f"sum_{{t={2 if factor.role == 'transition' else 1}}}^T {text}"


def _tight(text: str) -> str:
    return text if re.fullmatch(r"[\w.]+(\[[\d, ]+\])?|\(.*\)", text) else f"({text})"


def _short(text: str) -> str:
    return text if len(text) <= LENGTH else text[: LENGTH - 4] + " ..."
