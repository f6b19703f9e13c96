"""Updates in words: what is drawn, from which distribution, with which statistics.

A block of few numbers is described function by function. One of vectors or matrices is described
by sums of outer products, read off the distributions (Normal or MvNormal, mean affine in the block)
that it enters; by its functions where these distributions are of another kind.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from ssmppl.analysis.conjugacy.separation import ROLES, BlockForm, JointTerm, shorten
from ssmppl.errors import NotApplicable
from ssmppl.expressions.algebra import Separation, affine, separate
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import (
    MATRIX_OPS,
    Expr,
    constant,
    split_constant,
    substitute,
    symbol,
    symbols_of,
    to_text,
    topological,
)
from ssmppl.language import distributions as laws
from ssmppl.language.model.trace import Site, Trace

MAX_STATISTICS = 12
TIDIED = 100  # operations beyond which a coefficient is written as it stands
MAX_NAMES = 6  # of a block
MATRIX_LENGTH = 80  # of the text of a matrix or a vector
ARITHMETIC = frozenset(["add", "sub", "mul", "neg", "const", "symbol"])


@dataclass(frozen=True)
class Explanation:
    """title : what is drawn; law : one line; statistics : one line for each C_i;
    notes : truncation, correction, fallbacks, reasons."""

    title: str
    law: str
    statistics: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.title}: {self.law}"]
        lines += [f"    {s}" for s in self.statistics]
        lines += [f"  {n}" for n in self.notes]
        return "\n".join(lines)


def prior_alone(
    components: Sequence[Expr], hyperparameters: Sequence[str], how: str
) -> Explanation:
    """The explanation of a block that no distribution of the model reads, moved as `how` says."""
    given = f", given {', '.join(hyperparameters)}," if hyperparameters else ""
    verb, noun = ("does", "its") if len(components) == 1 else ("do", "their")
    return Explanation(
        joined(components),
        f"{verb} not enter the model: {noun} posterior{given} equals {noun} prior, {how}",
    )


def joined(components: Sequence[Expr]) -> str:
    """The components' names: "phi", "(phi, tau)"."""
    names = [to_text(c) for c in components]
    return names[0] if len(names) == 1 else f"({', '.join(names)})"


def statistics(form: BlockForm) -> tuple[str, ...]:
    """A heading, and a line for each function of the block: how its statistic is summed."""
    words = Wording(form, "")
    lines = [
        f"{shorten(to_text(function))}: {words.linear(i)}"
        for i, function in enumerate(form.functions[:MAX_STATISTICS])
    ]
    if lines:
        lines = ["sufficient statistics C[.]:", *("  " + line for line in lines)]
    hidden = len(form.functions) - MAX_STATISTICS
    return tuple(lines) + ((f"  ... and {hidden} more",) if hidden > 0 else ())


def _sum(parts: list[str]) -> str:
    out = parts[0] if parts else "0"
    for p in parts[1:]:
        out += f" - {p[1:]}" if p.startswith("-") else f" + {p}"
    return out


def _part(role: str, coefficient: Expr) -> list[str]:
    """The summands of a statistic as text; none where it is zero."""
    number, core = split_constant(coefficient)
    if core.op in ("add", "sub") and (role == "prior" or _measured(core.args[0])):
        sign = -1.0 if core.op == "sub" else 1.0
        parts = [constant(number) * core.args[0], constant(sign * number) * core.args[1]]
        return [text for e in parts for text in _part(role, e)]
    measured = _measured(core) if role == "observation" else None
    if measured is not None:
        names, inner = measured
        more, core = split_constant(inner)
        number *= more
        index, count = f"{{t: {names} measured}}", f"#{{t: {names} measured}}"
    else:
        index = {"transition": "{t=2}^T", "observation": "{t=1}^T"}.get(role, "")
        count = {"transition": "(T - 1)", "observation": "T"}.get(role, "")
    if number == 0.0:
        return []
    if core.op == "const":
        return [_times(number, count) if count else f"{number:.6g}"]
    condition = _indicator(core)
    if condition is not None:
        text = f"1{{{', '.join(condition)}}}"
    else:
        factor, text = tidy(core)
        number *= factor
        if index or role == "initial" or " + " in text or " - " in text:
            text = f"[{text}]"
    if role == "initial":
        text = f"{text}_1"
    elif index:
        text = f"sum_{index} {text}"
    return [_times(number, text)]


def _measured(core: Expr) -> tuple[str, Expr] | None:
    """(components, a) of a summand where(measured, a, 0)."""
    if core.op != "where" or not _is_number(core.args[2], 0.0):
        return None
    symbols = symbols_of(core.args[0])
    if {s.data[0] for s in symbols} != {"seen"}:
        return None
    return ", ".join(sorted(map(to_text, symbols))), core.args[1]


def _indicator(core: Expr) -> list[str] | None:
    """The conditions under which this is 1, else 0."""
    if core.op != "where":
        return None
    condition, a, b = core.args
    if _is_number(b, 0.0):
        inner = [] if _is_number(a, 1.0) else _indicator(a)
        return None if inner is None else [to_text(condition), *inner]
    if _is_number(a, 0.0) and condition.op == "eq":
        inner = [] if _is_number(b, 1.0) else _indicator(b)
        opposite = Expr("ne", condition.args)
        return None if inner is None else [to_text(opposite), *inner]
    return None


def _is_number(e: Expr, value: float) -> bool:
    return e.op == "const" and e.data == value


def tidy(coefficient: Expr) -> tuple[float, str]:
    """A coefficient as number times text, a polynomial in its lowest terms.

    For reading only: what is computed stays as it was written, which rounds better. Functions are
    taken for symbols, named by their text.
    """
    while coefficient.op == "where" and _vanishes_anyway(coefficient):
        coefficient = coefficient.args[2]
    number, core = split_constant(coefficient)
    nodes = topological([coefficient])
    if len(nodes) > TIDIED:
        return number, shorten(to_text(core))
    opaque = {
        n: symbol("parameter", to_text(n))
        for n in nodes
        if n.op not in ARITHMETIC and not _whole_power(n)
    }
    (plain,) = substitute([coefficient], opaque)
    form = separate(plain, symbols_of(plain))
    if isinstance(form, Separation) and 0 < len(form.terms) <= 4:
        pairs = form.items()
        if all(c.op == "const" for _, c in pairs) and all(
            e == int(e) for m in form.terms for _, e in m
        ):
            numbers = [c.data for _, c in pairs]
            scale = numbers[0] if all(abs(n) == abs(numbers[0]) for n in numbers) else 1.0
            total = constant(0.0)
            for (function, _), n in zip(pairs, numbers, strict=True):
                total = total + constant(n / scale) * function
            if _sums(total) <= _sums(core):  # (y - x)**2 rather than its three terms
                return scale, shorten(to_text(total))
    return number, shorten(to_text(core))


def _sums(e: Expr) -> int:
    """How many sums are written in an expression."""
    total = dict.fromkeys(topological([e]), 0)
    for n in topological([e]):
        total[n] = sum(total[a] for a in n.args) + (n.op in ("add", "sub"))
    return total[e]


def _vanishes_anyway(node: Expr) -> bool:
    """where(a == 0, 0, a), which is a."""
    condition, zero, value = node.args
    return (
        _is_number(zero, 0.0)
        and condition.op == "eq"
        and condition.args[0] is value
        and _is_number(condition.args[1], 0.0)
    )


def _whole_power(node: Expr) -> bool:
    if node.op == "div":
        return node.args[1].op in ("const", "symbol")
    return node.op == "pow" and _is_number(node.args[1], 2.0)


# -- the law
@dataclass(frozen=True)
class Wording:
    """What a family writes its distribution with. name : of the block as a whole."""

    form: BlockForm
    name: str

    @property
    def names(self) -> list[str]:
        """Names of the components."""
        return [to_text(c) for c in self.form.components]

    @property
    def block(self) -> str:
        """The components' names together."""
        return joined(self.form.components)

    def linear(self, i: int, factor: float = 1.0, plus: float = 0.0) -> str:
        """plus + factor * C_i as the sums that it is made of, numbers gathered."""
        parts, total = [], plus
        by_role = {
            role: constant(factor) * c[i] if i >= 0 else constant(0.0)
            for role, c in self.form.coefficients.items()
        }
        for role in ("prior", "initial"):
            if by_role[role].op == "const":
                total += by_role.pop(role).data
        merged = _merged(by_role.get("initial"), by_role["transition"])
        if merged:
            del by_role["initial"], by_role["transition"]
            parts.append(merged)
        for role, e in by_role.items():
            parts += _part(role, e)
        if abs(total) > 1e-12 or not parts:
            parts.insert(0, f"{total:.6g}")
        return _sum(parts)

    def statistic(self, i: int) -> str:
        """C_i by its function."""
        return f"C[{to_text(self.form.functions[i])}]" if i >= 0 else "0"


def _merged(initial: Expr | None, transition: Expr) -> str | None:
    """The initial and the transition summands as one sum, where they are of one form.

    f(x_t) at t = 1 and at t = 2..T: a sum from 1. -f(x_t) at t = 1 and f(x_{t-1}) at t = 2..T:
    what is left of the latter is a sum from 2 to T - 1.
    """
    if initial is None:
        return None
    (a, first), (b, text) = tidy(initial), tidy(transition)
    before = {s: _next(s) for s in symbols_of(transition) if s.data[0].endswith("_prev")}
    if not before and first == text and a == b:
        return _times(b, f"sum_{{t=1}}^T [{text}]")
    if before and len(before) == sum(s.data[0] != "parameter" for s in symbols_of(transition)):
        (moved,) = substitute([transition], before)
        if tidy(moved) == (-a, first):
            return _times(-a, f"sum_{{t=2}}^{{T-1}} [{first}]")
    return None


def _next(s: Expr) -> Expr:
    kind, name, index = s.data
    return symbol(kind.removesuffix("_prev"), name, index)


def _times(number: float, text: str) -> str:
    return {1.0: text, -1.0: f"-{text}"}.get(number, f"{number:.6g}*{text}")


def correction_text(form: BlockForm, positions: Sequence[int]) -> str:
    """exp(sum_j C_j s_j) as a person writes it, where the C_j are numbers."""
    total, rest = constant(1.0), []
    for j in positions:
        function = form.functions[j]
        numbers = [form.coefficients[r][j] for r in ("prior", "initial")]
        if all(n.op == "const" for n in numbers) and function.op == "log":
            exponent = math.fsum(n.data for n in numbers)
            total = total * function.args[0] ** exponent
        else:
            parts = [t for r in ("prior", "initial") for t in _part(r, form.coefficients[r][j])]
            value = _sum(parts)
            value = f"({value})" if len(parts) > 1 else value
            rest.append(f"exp({value}*{shorten(to_text(function))})")
    if not _is_number(total, 1.0):
        rest.insert(0, to_text(total))
    return " * ".join(rest) or "1"


def named(components: Sequence[Expr], trace: Trace) -> str:
    """The components' names, a parameter that is there as a whole by its own."""
    names: list[str] = []
    for name in dict.fromkeys(c.data[1] for c in components):
        mine = [c for c in components if c.data[1] == name]
        whole = len(mine) == len(trace.parameters[name].components)
        names += [name] if whole else [to_text(c) for c in mine]
    if len(names) > MAX_NAMES:
        names = [*names[:3], "...", names[-1]]
    return names[0] if len(names) == 1 else f"({', '.join(names)})"


class MatrixWording:
    """The statistics of a block as sums of outer products; None where they are not of that form."""

    def __init__(self, form: BlockForm, trace: Trace):
        self.form, self.block = form, form.components
        members = frozenset(self.block)
        quantities = [
            *trace.state_symbols, *trace.observation_symbols, *trace.input_symbols,
            *trace.parameter_symbols,
        ]  # fmt: skip
        self.sizes = Counter(s.data[1] for s in quantities)
        by_role = (trace.parameters, trace.initial, trace.transition, trace.observations)
        terms = {(f.role, f.site): f for found in form.origins.values() for f in found}
        self.own: list[Site] = []
        self.others: list[tuple[JointTerm, Site]] = []
        for role, sites in zip(ROLES, by_role, strict=True):
            for name, site in sites.items():
                if (role, name) not in terms:
                    continue
                if role == "prior" and members & set(site.components):
                    self.own.append(site)
                else:
                    self.others.append((terms[role, name], site))
        self.parameters = trace.parameters

    # -- the families
    def normal(self) -> tuple[str, ...] | None:
        """H and h, as sums over the distributions whose means hold the block."""
        first = ["prior"] if self._told_by_prior() else []
        h, linear, notes = [*first], [*first], []
        for term, site in self.others:
            found = self._regression(site)
            if found is None:
                return None
            weight = self._weight(site.distribution)
            rest, z = self._residual(site.name, found[1]), _kronecker(found[0])
            if z is None:
                h.append(_summed(term, f"J' {weight} J"))
                linear.append(_summed(term, f"J' {weight} {rest}"))
                notes.append(f"J = d mean of {site.name} / d {self._names()}")
            else:
                outer = "z z'" if len(found[0]) == 1 else f"kron({weight}, z z')"
                scale = f"{weight} " if len(found[0]) == 1 else ""
                h.append(_summed(term, scale + outer))
                linear.append(_summed(term, f"{weight} {rest} z'"))
                notes.append(f"z = ({self._list(z)}) in the mean of {site.name}")
        return (f"H: {' + '.join(h)}", f"h: {' + '.join(linear)}", *notes)

    def matrix_normal(self, thetas: int, row: Sequence[int]) -> tuple[str, ...] | None:
        """S_yy, S_yz and K, of a matrix A; thetas : how many entries it has, row : its first."""
        first = ["prior"] if self._told_by_prior() else []
        yy, yz, zz, notes = [*first], [*first], [*first], []
        block = self.block[:thetas]
        for term, site in self.others:
            found, scale = self._regression(site, block), self._scale(site)
            z = None if found is None else _kronecker(found[0])
            if found is None or z is None or scale is None:
                return None
            rest = self._residual(site.name, found[1])
            yy.append(_summed(term, f"{scale}{rest} {rest}'"))
            yz.append(_summed(term, f"{scale}{rest} z'"))
            zz.append(_summed(term, f"{scale}z z'"))
            notes.append(f"z = ({self._list(z)}) in the mean of {site.name}")
        columns = dict.fromkeys(block[i].data[1] for i in row)
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
        for term, site in self.others:
            if not isinstance(site.distribution, laws.MvNormal):
                return None
            times = self._scale(site)
            if times is None:
                return None
            parts.append(_summed(term, f"{times}r r'"))
            mean = self._product(list(array(site.distribution.mean()).ravel()))
            when = " at t = 1" if term.role == "initial" else ""
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
        """The precision of a distribution, as a matrix or, of one number, as a number."""
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
        """ "s " where the precision of a distribution is s times the block's (inverse) matrix."""
        law = site.distribution
        if not isinstance(law, laws.MvNormal) or law.spread == "cholesky":
            return None
        number = _multiple(law.parameters[law.spread], self.block)
        if number is None:
            return None
        times = number if law.spread == "precision" else 1.0 / number
        return "" if _is_number(times, 1.0) else f"{_tight(to_text(times))} "

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
            one = len(z) == 1 and _is_number(z[0], 1.0)
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
        if all(_is_number(e, 0.0) for e in v):
            return "0"
        if len(v) == 1:
            return to_text(v[0])
        entries = f"({', '.join(map(to_text, v))})"
        return self._collapsed(v) or shorten(entries, MATRIX_LENGTH)

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
    if first.op == "item" and first.args[0].op in MATRIX_OPS:
        text = to_text(first.args[0])
        same = all(e.op == "item" and e.args[0] is first.args[0] for e in entries)
        return text if same and len(text) < MATRIX_LENGTH else "C"
    names = {e.data[1] for e in entries if e.op == "symbol"}
    if len(names) == 1 and all(e.op == "symbol" for e in entries):
        return names.pop()
    rows = [f"[{', '.join(map(to_text, row))}]" for row in m]
    return shorten(f"[{', '.join(rows)}]", MATRIX_LENGTH)


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
        if len(row) != 1 or not _is_number(rest, 0.0):
            return None
        found.append(row[0])
    return found[0] if all(f is found[0] for f in found) else None


def _kronecker(j: ExprArray) -> list[Expr] | None:
    """z where each row of J holds z at places of its own, all in one order; else None."""
    rows: list[list[Expr]] = [[] for _ in range(len(j))]
    for column in j.T:
        held = [i for i, e in enumerate(column) if not _is_number(e, 0.0)]
        if len(held) != 1:
            return None
        rows[held[0]].append(column[held[0]])
    same = all(
        len(row) == len(rows[0]) and all(a is b for a, b in zip(row, rows[0], strict=True))
        for row in rows
    )
    return rows[0] if same and rows[0] else None


def _summed(term: JointTerm, text: str) -> str:
    if term.role == "initial":
        return f"[{text}]_1"
    if term.role == "prior":
        return f"[{text}]"
    if any(s.data[0] == "seen" for s in term.symbols):
        return f"sum_{{t: {term.site} measured}} {text}"
    return f"sum_{{t={2 if term.role == 'transition' else 1}}}^T {text}"


def _tight(text: str) -> str:
    return text if re.fullmatch(r"[\w.]+(\[[\d, ]+\])?|\(.*\)", text) else f"({text})"
